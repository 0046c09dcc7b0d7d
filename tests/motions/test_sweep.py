"""Sweeps: every leaf, continuation and co-existing motions, maps, basins, what fails, and what is written."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from capsule_id.errors import InputError
from capsule_id.motions.response import Settling, response
from capsule_id.motions.sweep import (
    MOTION_COLUMNS,
    SUMMARY,
    basins,
    continuation,
    diagram,
    motion_map,
    spread_starts,
    swept_leaf,
)
from capsule_id.parameters import CAPSULE_LEAVES, SWEPT
from capsule_id.physics.drives import Pulses
from capsule_id.physics.model import CapsuleParameters, Excitation, Status

P = CapsuleParameters(m1=0.11, m2=0.53, k1=1420.0, k2=18960.0, c=3.89, mu=0.66, v_s=0.3, G=1e-3)
E = Excitation(4.0, 34.56)
#: Every term acts.
GENERAL = replace(
    P, k_cubic=1e8, c2=5.0, k2_back=1e4, G_back=1e-3, slope=0.05, N0=1.0, mu_back=0.5, ratio=0.6, viscous=1.0
)
GENERAL_E = Excitation(8.0, 34.56, 0.3, 0.2)
PULSES = Pulses(P_on=12.0, period=0.18, duty=0.4, P_off=-3.0, phase=0.5, lag=5e-3, reaction=0.2)
SHORT = Settling(dropped=10, observed=6, exponent_periods=0)
QUICK = Settling(dropped=60, observed=12, exponent_periods=0)
# A lightly damped capsule with a period-1 motion beside chaos between 4.5 and 6 N.
LIGHT = CapsuleParameters(m1=0.11, m2=0.3, k1=1420.0, k2=56410.0, c=0.5, mu=0.2, v_s=0.3, G=0.5e-3)


def test_a_diagram_is_the_responses_value_by_value() -> None:
    k2 = np.array([3e3, 18960.0, 51050.0])
    data = diagram(P, E, "k2", k2)
    r = response(CapsuleParameters(**{**vars(P), "k2": k2}), E)
    assert data["label"].dims == ("branch", "k2")
    np.testing.assert_array_equal(data["label"][0], r.label)
    np.testing.assert_array_equal(data["mean_velocity"][0], r.mean_velocity)
    assert data["x_rel"].shape == (1, 3, 49)
    np.testing.assert_allclose(data["efficiency"][0] * r.work_per_period, r.mean_velocity * 2.0 * np.pi / 34.56)


@pytest.mark.full
@pytest.mark.parametrize("e", [GENERAL_E, PULSES], ids=["harmonic", "pulses"])
def test_every_quantity_can_be_swept(e: Excitation | Pulses) -> None:
    """Each one moves the motion, and leaves as attributes all the others."""
    given = {name: value for name, value in {**vars(GENERAL), **vars(e)}.items() if name != "forces"}
    for name in SWEPT:
        if name not in {"f", *CAPSULE_LEAVES, *(row.symbol for row in e.parameters)}:
            continue
        base = 1.0 / float(e.period) if name == "f" else given[name]
        data = diagram(GENERAL, e, name, base * np.array([0.8, 1.0]), settling=SHORT)
        assert (data["status"] <= Status.GRAZING).all()
        assert data[name].attrs["units"] == SWEPT[name].unit
        assert set(data.attrs) & set(given) == set(given) - {swept_leaf(name, e)}
        # A drive with another phase ends in the same motion, met at another point of it.
        assert data["x_rel"][0, 0, -1] != data["x_rel"][0, 1, -1], name
        assert name == "phase" or data["mean_velocity"][0, 0] != data["mean_velocity"][0, 1], name


@pytest.mark.full
def test_a_frequency_is_that_of_the_drive() -> None:
    hertz = diagram(P, E, "f", [5.0], settling=QUICK)
    radians = diagram(P, E, "Omega", [10.0 * np.pi], settling=QUICK)
    np.testing.assert_allclose(hertz["mean_velocity"].to_numpy(), radians["mean_velocity"].to_numpy(), rtol=1e-12)
    hertz = diagram(GENERAL, PULSES, "f", [5.0], settling=SHORT)
    seconds = response(GENERAL, replace(PULSES, period=0.2), settling=SHORT)
    np.testing.assert_allclose(hertz["mean_velocity"].to_numpy(), seconds.mean_velocity, rtol=1e-12)
    with pytest.raises(InputError, match="P_d, choose from m1"):
        diagram(P, PULSES, "P_d", [1.0])


@pytest.mark.full
def test_continuation_follows_a_motion_to_where_rest_does_not_lead_and_shows_what_coexists() -> None:
    values = np.linspace(4.0, 5.5, 9)
    data = continuation(LIGHT, E, "P_d", values, settling=QUICK)
    forward, backward = data["label"].to_numpy()
    assert set(forward) == {"P-1-F-5"}
    assert backward[-1] == "aperiodic"
    several = data["attractors"].to_numpy() > 1
    np.testing.assert_array_equal(several, forward != backward)
    assert several.any()
    # Values in descending order go the other way: forward there is backward here.
    reverse = continuation(LIGHT, E, "P_d", values[::-1], directions=("backward", "forward"), settling=QUICK)
    for here, there in (("backward", "forward"), ("forward", "backward")):
        np.testing.assert_array_equal(
            reverse["mean_velocity"].sel(branch=here)[::-1], data["mean_velocity"].sel(branch=there)
        )


@pytest.mark.full
def test_many_starts_find_the_motions_that_coexist() -> None:
    starts = spread_starts(LIGHT, E, 12)
    assert [float(x[0]) for x in starts] == [0.0, 0.0, 0.0, 0.0]
    data = diagram(LIGHT, E, "P_d", [3.7, 5.0], starts=starts, settling=Settling(dropped=150, observed=24))
    assert list(data["attractors"].to_numpy()) == [1, 2]
    label, attractor = data["label"].to_numpy()[:, 1], data["attractor"].to_numpy()[:, 1]
    assert {"P-1-F-5", "aperiodic"} == set(label)
    np.testing.assert_array_equal(attractor == attractor[0], label == label[0])
    exponent = data["lyapunov"].to_numpy()[:, 1]
    assert (exponent[label == "aperiodic"] > 0.0).all()
    assert np.isnan(exponent[label != "aperiodic"]).all()


def test_basins_agree_with_the_motions_from_the_same_starts() -> None:
    e, settling = Excitation(5.0, 34.56), Settling(dropped=100, observed=12, exponent_periods=0)
    x, w = np.linspace(-2e-3, 2e-3, 5), np.linspace(-0.1, 0.1, 4)
    data = basins(LIGHT, e, x, w, Y2=0.02, settling=settling)
    assert data["attractor"].dims == ("x_rel_0", "rate_0")
    at = (np.full(4, x[1]), w + 0.02, np.zeros(4), np.full(4, 0.02))
    same = diagram(LIGHT, e, "P_d", [5.0], starts=at, settling=settling)
    np.testing.assert_array_equal(data["label"][1], same["label"][:, 0])
    assert int(data["attractors"]) == data["attractor"].to_numpy().max() + 1 == len(np.unique(data["label"]))


@pytest.mark.full
def test_two_parameter_map_is_its_points_and_goes_through_a_file(tmp_path: Path) -> None:
    over = {"k2": np.linspace(1e3, 55e3, 5), "f": np.linspace(3.0, 6.5, 4)}
    data = motion_map(P, E, over, settling=QUICK)
    assert data["label"].dims == ("k2", "f")
    assert set(data.data_vars) == set(SUMMARY)
    column = diagram(P, Excitation(4.0, 2.0 * np.pi * over["f"][1]), "k2", over["k2"], settling=QUICK)
    for name in ("label", "mean_velocity", "efficiency", "work_per_period"):
        np.testing.assert_array_equal(data[name][:, 1], column[name][0])
    data.to_netcdf(tmp_path / "map.nc", engine="h5netcdf")
    with xr.open_dataset(tmp_path / "map.nc", engine="h5netcdf") as read:
        xr.testing.assert_identical(read.load(), data)
        for name in read.data_vars:
            assert read[name].attrs == dict(zip(("units", "long_name"), MOTION_COLUMNS[str(name)], strict=True))


@pytest.mark.full
def test_a_run_that_is_given_up_says_so_and_disturbs_no_other() -> None:
    k2 = np.array([18960.0, -1.0, 51050.0])
    broken = diagram(P, E, "k2", k2, settling=QUICK)
    assert list(broken["label"].to_numpy()[0] == "failed") == [False, True, False]
    assert broken["status"].to_numpy()[0, 1] == Status.INVALID
    assert (broken["attractor"].to_numpy()[0, 1], broken["attractors"].to_numpy()[1]) == (-1, 0)
    whole = diagram(P, E, "k2", k2[[0, 2]], settling=QUICK)
    for name in ("x_rel", "mean_velocity"):
        np.testing.assert_array_equal(broken[name][:, [0, 2]], whole[name])
    # A continuation goes on from rest behind it.
    after = continuation(P, E, "k2", k2, settling=QUICK)
    np.testing.assert_array_equal(after["label"] == "failed", [[False, True, False]] * 2)


def test_errors() -> None:
    with pytest.raises(InputError, match="can be swept, k3"):
        diagram(P, E, "k3", [1.0])
    with pytest.raises(InputError, match="finite numbers"):
        diagram(P, E, "k2", [])
    with pytest.raises(InputError, match="one set of parameters"):
        diagram(P, Excitation(np.ones(2), 30.0), "k2", [1.0, 2.0])
    with pytest.raises(InputError, match="same quantity"):
        motion_map(P, E, {"f": [1.0], "Omega": [1.0]})
    with pytest.raises(InputError, match="forward or backward"):
        continuation(P, E, "k2", [1.0], directions=())
    with pytest.raises(InputError, match="at least 1"):
        spread_starts(P, E, 0)
