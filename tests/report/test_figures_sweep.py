"""Figures of sweeps draw what they are given: points, units, directions, measured runs, areas, intervals."""

from collections.abc import Callable

import numpy as np
import pytest
import xarray as xr
from matplotlib.axes import Axes

from capsule_id.report.figures import sweeps
from capsule_id.report.figures.style import new_axes, png
from capsule_id.report.figures.sweeps import MeasuredPoint, in_units, label_looks

UNITS = {"k2": ("kN/m", 1e3)}


def drawn(panel: Callable[..., None], *data: object) -> Axes:
    """The axes of a panel in a figure of its own."""
    panel(*data, ax := new_axes())
    return ax


def _diagram(branches: int) -> xr.Dataset:
    """Four values of k2; period 2 at the last one, which is the only one with two attractors; one run has failed."""
    n = 4
    x = np.tile(1e-3 * np.arange(1.0, n + 1.0)[None, :, None], (branches, 1, 3))
    x[:, -1, 1] += 5e-4
    label = np.tile(np.array(["P-1-B-1", "P-1-S-0", "failed", "P-2-F-1/2"]), (branches, 1))
    velocity = np.tile(1e-3 * np.array([-1.0, 0.0, np.nan, 2.0]), (branches, 1))
    over = ("branch", "k2")
    return xr.Dataset(
        {
            "x_rel": ((*over, "section"), np.where((label == "failed")[..., None], np.nan, x)),
            "label": (over, label),
            "period": (over, np.tile([1, 1, 0, 2], (branches, 1))),
            "direction": (over, np.tile(np.array(["B", "S", "", "F"]), (branches, 1))),
            "mean_velocity": (over, velocity),
            "attractors": ("k2", [1, 1, 0, 2]),
        },
        {
            "k2": ("k2", [1e3, 2e3, 3e3, 4e3], {"units": "N/m"}),
            "branch": ["forward", "backward", "other"][:branches],
        },
        {"G": 1.5e-3},
    )


def test_poincare_points_stand_at_their_values_in_the_wanted_unit() -> None:
    ax = drawn(sweeps.poincare, in_units(_diagram(1), UNITS))
    points, several, impact = ax.lines
    np.testing.assert_allclose(points.get_xdata(), np.repeat([1.0, 2.0, 3.0, 4.0], 3))
    np.testing.assert_allclose(points.get_ydata()[-3:], [4.0, 4.5, 4.0])
    assert list(several.get_xdata()) == [4.0]
    np.testing.assert_allclose(impact.get_ydata(), 1.5)
    assert ax.get_xlabel() == "k2, kN/m"
    assert drawn(sweeps.poincare, _diagram(1)).get_xlabel() == "k2, N/m"


def test_many_branches_are_coloured_by_period() -> None:
    ax = drawn(sweeps.poincare, in_units(_diagram(3), UNITS))
    looks = {line.get_label(): line for line in ax.lines}
    assert set(looks) == {"aperiodic", "period 1", "period 2", "several attractors", "impact line"}
    np.testing.assert_allclose(np.unique(looks["period 2"].get_xdata()), [4.0])
    two = drawn(sweeps.poincare, in_units(_diagram(2), UNITS))
    assert [line.get_label() for line in two.lines][:2] == ["forward", "backward"]


def test_velocity_is_marked_by_direction_with_labels_and_measured_runs() -> None:
    measured = [MeasuredPoint(2500.0, "P-1-F-2", 1.5e-3)]
    ax = drawn(sweeps.mean_velocity, in_units(_diagram(1), UNITS), measured)
    shown = {line.get_label(): (list(line.get_xdata()), list(line.get_ydata())) for line in ax.lines}
    assert shown["forward"] == ([4.0], [2.0])
    assert shown["backward"] == ([1.0], [-1.0])
    assert shown["standing"] == ([2.0], [0.0])
    assert shown["measured"] == ([2.5], [1.5])
    assert shown["run given up"][0] == [3.0, 3.0]
    texts = [text.get_text() for text in ax.texts]
    assert {"P-1-F-2", "P-1-B-1", "P-2-F-1/2", "failed"} <= set(texts)


def test_areas_add_up_and_rare_labels_go_together() -> None:
    names = [f"P-1-F-{i}" for i in range(1, 9)] + ["P-1-B-1", "aperiodic", "failed"]
    heights = np.linspace(1.0, 2.0, len(names))[:, None] * np.array([1.0, 2.0])
    looks, places = label_looks(dict(zip(names, heights.sum(axis=1), strict=True)))
    assert list(looks)[-1] == "other"
    assert {"aperiodic", "failed", "P-1-B-1", "P-1-F-8"} <= set(looks)
    assert "P-1-F-1" not in looks
    data = xr.Dataset(
        {"probability": (("label", "k2"), heights)}, {"label": names, "k2": ("k2", [1.0, 2.0], {"units": "N/m"})}
    )
    areas = drawn(sweeps.probabilities, data).collections
    tops = np.max([area.get_paths()[0].get_extents().get_points()[1] for area in areas], axis=0)
    assert tops[1] == pytest.approx(heights.sum(axis=0).max())
    kept, places = label_looks({"P-1-F-1": 2, "P-1-B-1": 1, "failed": 1})
    assert [list(kept)[place] for place in places.values()] == list(places)
    assert len(set(kept.values())) == len(kept)


def test_bands_show_the_chosen_value_and_its_interval() -> None:
    si = xr.Dataset(
        {
            "probability": (("label", "k2"), [[0.25, 1.0], [0.75, 0.0]]),
            "mean_velocity_quantiles": (("quantile", "k2"), 1e-3 * np.array([[0.0, 1.0], [1.0, 2.0], [2.0, 4.0]])),
            "chosen": ((), 2e3),
            "chosen_mean_velocity_quantiles": ("quantile", 1e-3 * np.array([1.0, 2.0, 4.0])),
            "best_quantiles": ("quantile", [1e3, 2e3, 2e3]),
        },
        {"label": ["P-1-F-1", "P-1-B-1"], "k2": ("k2", [1e3, 2e3], {"units": "N/m"}), "quantile": [0.025, 0.5, 0.975]},
        {"objective": "mean_velocity"},
    )
    data = in_units(si, UNITS)
    ax = drawn(sweeps.objective_band, data)
    (bar,) = ax.containers
    np.testing.assert_allclose(bar.lines[0].get_xydata(), [[2.0, 2.0]])
    np.testing.assert_allclose(bar.lines[2][0].get_segments()[0][:, 1], [1.0, 4.0])
    top = drawn(sweeps.probabilities, data)
    edges = [area.get_paths()[0].vertices[:, 1].max() for area in top.collections]
    np.testing.assert_allclose(edges, [1.0, 1.0])
    assert png(sweeps.bands(data, "rig")).startswith(b"\x89PNG")


@pytest.mark.parametrize("failed", [False, True])
def test_a_map_keeps_its_cells_in_place(failed: bool) -> None:
    velocity = 1e-3 * np.array([[1.0, -2.0], [np.nan if failed else 0.0, 4.0], [0.5, 0.5]])
    label = np.where(np.isnan(velocity), "failed", np.where(velocity < 0.0, "P-1-B-1", "P-1-F-1"))
    over = ("k2", "f")
    si = xr.Dataset(
        {"label": (over, label), "mean_velocity": (over, velocity), "efficiency": (over, velocity)},
        {"k2": ("k2", [1e3, 2e3, 3e3], {"units": "N/m"}), "f": ("f", [2.0, 4.0], {"units": "Hz"})},
    )
    data = in_units(si, UNITS)
    ax = drawn(sweeps.quantity, data, "mean_velocity")
    (mesh,) = ax.collections
    np.testing.assert_allclose(np.ma.filled(mesh.get_array(), np.nan), 1e3 * velocity.T)
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("k2, kN/m", "f, Hz")
    np.testing.assert_allclose(ax.get_xlim(), [0.5, 3.5])
    names = [text.get_text() for text in drawn(sweeps.labels, data, "").get_legend().get_texts()]
    assert set(names) == set(np.unique(label))
    assert png(sweeps.motion_map(data, "rig")).startswith(b"\x89PNG")
