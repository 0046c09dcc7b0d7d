"""Bands over draws: probabilities and quantiles against counting by hand, and the best operating point of a known law."""

import numpy as np
import pytest
import xarray as xr

from capsule_id.errors import InputError
from capsule_id.motions.response import Settling, response
from capsule_id.motions.sweep import bands, draws_diagram
from capsule_id.physics.model import CapsuleParameters, Excitation

QUICK = Settling(dropped=60, observed=12, exponent_periods=0)


def _seen(velocity: np.ndarray, label: np.ndarray) -> xr.Dataset:
    """A diagram of draws over G = 1, 2, 3, ... by hand: velocity and label (values, draws)."""
    about = {"units": "m/s", "long_name": "mean velocity"}
    axis = ("G", np.arange(1.0, len(velocity) + 1.0), {"units": "m", "long_name": "gap"})
    data = {"mean_velocity": (("G", "draw"), velocity, about), "efficiency": (("G", "draw"), -velocity, about)}
    return xr.Dataset(data | {"label": (("G", "draw"), label)}, {"G": axis, "draw": np.arange(velocity.shape[1])})


def test_probabilities_are_shares_and_failed_runs_are_counted_but_not_averaged() -> None:
    velocity = np.array([[1.0, 2.0, 3.0, np.nan], [4.0, 0.0, 5.0, 6.0]])
    label = np.array([["P-1-F-1", "P-1-F-1", "P-1-B-2", "failed"], ["P-1-F-1"] * 4])
    found = bands(_seen(velocity, label))
    shares = {str(name): found["probability"].sel(label=name).to_numpy().tolist() for name in found["label"].to_numpy()}
    assert shares == {"P-1-F-1": [0.5, 1.0], "P-1-B-2": [0.25, 0.0], "failed": [0.25, 0.0]}
    np.testing.assert_allclose(found["probability"].sum("label"), 1.0)
    np.testing.assert_allclose(found["mean_velocity_quantiles"].sel(quantile=0.5), [2.0, 4.5])
    assert found["best"].to_numpy().tolist() == [2.0, 1.0, 2.0, 2.0]
    assert found["best_mean_velocity"].to_numpy().tolist() == [4.0, 2.0, 5.0, 6.0]
    # In the mean 2.0 against 3.75.
    assert float(found["chosen"]) == 2.0
    assert bands(_seen(velocity, label), "efficiency")["best"].to_numpy().tolist() == [1.0, 2.0, 1.0, 2.0]


def test_the_best_point_of_a_parabola_has_the_spread_of_its_summit() -> None:
    """v = -(G - summit)^2 with summits drawn from a normal law: the interval is its own, to the grid's step."""
    rng = np.random.default_rng(0)
    G, summit = np.arange(1.0, 101.0), rng.normal(50.0, 5.0, 4000)
    velocity = -((G[:, None] - summit) ** 2)
    found = bands(_seen(velocity, np.full(velocity.shape, "P-1-F-1")))
    np.testing.assert_allclose(found["best_quantiles"], 50.0 + 5.0 * np.array([-1.96, 0.0, 1.96]), atol=0.75)
    assert abs(float(found["chosen"]) - summit.mean()) <= 0.5


@pytest.mark.full
def test_every_draw_is_the_response_of_its_parameters() -> None:
    k1, mu = np.array([1400.0, 1420.0, 1440.0]), np.array([0.6, 0.66, 0.7])
    p = CapsuleParameters(m1=0.11, m2=0.53, k1=k1, k2=18960.0, c=3.89, mu=mu, v_s=0.3, G=1e-3)
    k2, e = np.array([5e3, 3e4]), Excitation(4.0, 34.56)
    seen = draws_diagram(p, e, "k2", k2, settling=QUICK)
    assert seen["label"].dims == ("k2", "draw")
    for i, stiffness in enumerate(k2):
        r = response(CapsuleParameters(**{**vars(p), "k2": stiffness}), e, settling=QUICK)
        np.testing.assert_array_equal(seen["label"][i], r.label)
        np.testing.assert_array_equal(seen["mean_velocity"][i], r.mean_velocity)
    assert bands(seen).attrs["draws"] == 3


def test_errors() -> None:
    p = CapsuleParameters(m1=0.11, m2=0.53, k1=1420.0, k2=18960.0, c=3.89, mu=0.66, v_s=0.3, G=1e-3)
    with pytest.raises(InputError, match="band needs draws"):
        draws_diagram(p, Excitation(4.0, 34.56), "k2", [1e4])
    seen = _seen(np.ones((2, 2)), np.array([["failed", "P-1-F-1"], ["failed", "P-1-F-1"]]))
    with pytest.raises(InputError, match="every value and every draw"):
        bands(seen)
    with pytest.raises(InputError, match="objective is"):
        bands(seen, "beauty")
