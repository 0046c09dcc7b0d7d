"""Every figure has labels with units, shows what it was given, and survives hostile text."""

import dataclasses
import re
import subprocess
import sys
from collections.abc import Callable
from typing import cast

import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from capsule_id.inference.result import Posterior, Result
from capsule_id.report.columns import sampled_parameters
from capsule_id.report.figures import fits as figures
from capsule_id.report.figures.style import figure_of, new_axes, new_figure, png
from capsule_id.report.html import Picture, comparison_caption, drawings, pictures
from capsule_id.views import Comparison, Curve, Finding, Points

#: ``name, unit``; a name alone has no unit.
UNIT = re.compile(r",\s[^,]+$|^(autocorrelation|residual / sd|friction coefficient|step after burn-in|μ)$")


def _named(result: Result, label: str) -> Comparison:
    return next(item for item in result.comparisons if item.label == label)


def drawn(panel: Callable[..., None], data: object, **size: float) -> Axes:
    """The axes of a panel in a figure of its own."""
    panel(data, ax := new_axes(**size))
    return ax


def corner_of(result: Result) -> Figure:
    columns = sampled_parameters(result)
    figures.corner(columns, figure := new_figure(*figures.corner_size(columns)))
    return figure


def traces_of(result: Result) -> Figure:
    columns = sampled_parameters(result)
    figures.traces(columns, figure := new_figure(*figures.traces_size(columns)))
    return figure


def _assert_units(figure: Figure) -> None:
    for ax in figure.axes:
        if not ax.axison:
            continue
        # A shared x-axis carries its label on the lowest panel only.
        sharing = ax.get_shared_x_axes().get_siblings(ax)
        assert any(UNIT.search(other.get_xlabel()) for other in sharing)
        named_rows = any(label.get_text().isidentifier() for label in ax.get_yticklabels())
        assert named_rows or UNIT.search(ax.get_ylabel())


def test_every_panel_has_labels_with_units(result: Result) -> None:
    for item in result.comparisons:
        _assert_units(figures.comparison_figure(item))
    _assert_units(figure_of(drawn(figures.point_fit_starts, result.point_fit)))
    _assert_units(traces_of(result))


def test_corner_names_every_physical_parameter_with_its_unit(result: Result) -> None:
    axes = corner_of(result).axes
    labels = [label for ax in axes for label in (ax.get_xlabel(), ax.get_ylabel()) if label]
    # Each on the horizontal axis, and all but the first, which has a histogram in its row, on the vertical one.
    assert len(labels) == 2 * len(result.summary) - 1
    assert {"m₁,\nkg", "k₂ stiff,\nN/m", "vₛ,\nm/s", "μ"} <= set(labels)
    assert not any("noise" in label for label in labels)


def test_parameters_of_one_unit_share_its_prefix(result: Result) -> None:
    """Gaps of 1.0004, 0.9997 and 0.02 mm stood in mm, in µm and in µm, beside each other."""
    gaps = {"k2[soft]": 1.0004e-3, "k2[medium]": 0.9997e-3, "k2[stiff]": 2e-5}
    summary = result.summary.copy()
    for name, value in gaps.items():
        summary.loc[name, ["unit", "value", "map", "sd"]] = ["m", value, value, 3e-7]
    gapped = dataclasses.replace(result, summary=summary)
    columns = sampled_parameters(gapped)
    shown = dict(zip(columns.names, zip(columns.units, columns.map, strict=True), strict=True))
    assert {name: shown[name] for name in gaps} == {name: ("mm", pytest.approx(1e3 * gaps[name])) for name in gaps}
    labels = [ax.get_ylabel() for ax in traces_of(gapped).axes]
    assert sum(label.endswith(", mm") for label in labels) == len(gaps)


def _inside(polygons: list[np.ndarray], points: np.ndarray) -> np.ndarray:
    """Even-odd rule over closed polygons: an independent count of the draws within a contour."""
    inside = np.zeros(len(points), dtype=bool)
    x, y = points.T
    for polygon in polygons:
        for (x0, y0), (x1, y1) in zip(polygon, np.roll(polygon, -1, axis=0), strict=True):
            crosses = (y0 > y) != (y1 > y)
            with np.errstate(divide="ignore", invalid="ignore"):
                inside ^= crosses & (x < x0 + (y - y0) * (x1 - x0) / (y1 - y0))
    return inside


def test_contours_hold_the_shares_they_claim(maker: Callable[..., Result]) -> None:
    result = maker(draws=250, walkers=32)
    posterior = cast(Posterior, result.posterior)
    panel = corner_of(result).axes[1]  # of row 1, column 0
    draws = posterior.draws.reshape(-1, len(posterior.names))[:, :2]
    (contours,) = [item for item in panel.collections if type(item).__name__ == "QuadContourSet"]
    for path, share in zip(contours.get_paths(), (0.95 - 0.68, 0.68), strict=True):
        # Smoothing over five bins widens a contour a little; 3 % is the tolerance of the eye, not of the table.
        assert _inside(path.to_polygons(), draws).mean() == pytest.approx(share, abs=0.03)


@pytest.mark.parametrize(
    ("low", "high"), [(0.0, 1.0), (1418.2, 1424.9), (-3e-4, 7e-4), (56399.0, 56401.0), (1e-9, 1e9)]
)
def test_corner_ticks_are_distinct_inside_and_say_where_they_are(result: Result, low: float, high: float) -> None:
    columns = sampled_parameters(result)
    draws = np.linspace(low, high, columns.draws.size).reshape(columns.draws.shape)
    figures.corner(dataclasses.replace(columns, draws=draws), figure := new_figure(*figures.corner_size(columns)))
    axis = figure.axes[-1].xaxis
    ends, texts = axis.get_view_interval(), [text.get_text() for text in axis.get_ticklabels()]
    shown = [(value, text) for value, text in zip(axis.get_ticklocs(), texts, strict=True) if ends[0] < value < ends[1]]
    values = np.array([value for value, _ in shown])
    assert 2 <= len(shown) <= 5
    said = [float(text.replace("−", "-")) for _, text in shown]
    np.testing.assert_allclose(said, values, rtol=0, atol=1e-9 * (high - low))


def test_a_frozen_chain_is_drawn(result: Result) -> None:
    posterior = cast(Posterior, result.posterior)
    frozen = dataclasses.replace(posterior, draws=np.broadcast_to(posterior.draws[:1, :1, :1], posterior.draws.shape))
    assert png(corner_of(dataclasses.replace(result, posterior=frozen)))
    assert png(traces_of(dataclasses.replace(result, posterior=frozen)))


@pytest.mark.parametrize("count", [1, 2, 5])
def test_few_parameters(result: Result, count: int) -> None:
    few = dataclasses.replace(result, summary=result.summary.iloc[:count])
    assert len(traces_of(few).axes) == count  # an empty panel is none
    assert png(corner_of(few))


def test_no_sample_is_refused(unsampled: Result) -> None:
    with pytest.raises(ValueError, match="nothing was sampled"):
        sampled_parameters(unsampled)


def test_panel_shows_points_curves_band_and_flag(result: Result) -> None:
    item = _named(result, "support_spring_stiff")
    ax = drawn(figures.comparison, item)
    labels = ax.get_legend_handles_labels()[1]
    assert set(labels) == {"this fit", "95 % band", "measured", "flagged by a check, kept"}
    flagged = ax.lines[[line.get_label() for line in ax.lines].index("flagged by a check, kept")]
    assert flagged.get_xdata() == item.points[0].x[4:5]
    plain = drawn(figures.comparison, _named(result, "support_spring_soft"))
    assert "flagged by a check, kept" not in plain.get_legend_handles_labels()[1]


def test_residual_panel_shows_all_and_the_band(result: Result) -> None:
    item = _named(result, "motor_current")
    ax = drawn(figures.residuals, item)
    np.testing.assert_array_equal(ax.lines[-1].get_ydata(), item.residuals)
    wild = dataclasses.replace(item, residuals=np.array([*item.residuals[:-1], 40.0]))
    assert drawn(figures.residuals, wild).get_ylim()[1] > 40.0


def test_missing_parts_are_refused_not_drawn_empty(result: Result) -> None:
    friction = _named(result, "friction")
    with pytest.raises(ValueError, match="no residuals"):
        drawn(figures.residuals, friction)
    with pytest.raises(ValueError, match="no autocorrelation"):
        drawn(figures.autocorrelation, friction)
    assert len(figures.comparison_figure(friction).axes) == 1
    assert len(figures.comparison_figure(_named(result, "motor_current")).axes) == 2
    assert len(figures.comparison_figure(_named(result, "free_vibration_1")).axes) == 3


def forced_run(period: int = 150, n: int = 1800, decay: float = 0.0, bad: int = 700, trend: float = 0.3) -> Comparison:
    """A record whose third harmonic is the largest one; its largest residuals are in the samples from ``bad`` on."""
    rng, t = np.random.default_rng(0), np.arange(n) / 1000.0
    phase = 2.0 * np.pi * np.arange(n) / period
    fitted = np.exp(-decay * t) * (np.sin(phase) + 2.0 * np.sin(3.0 * phase)) + trend * t
    residuals = rng.normal(size=n)
    residuals[bad : bad + 200] *= 3.0
    return Comparison(
        "forced_run", "run_1_x_rel", "run_1: x_rel", "time, s", "x_rel, mm",
        points=(Points("run_1", t, fitted + 0.02 * residuals),),
        curves=(Curve("this fit", t, fitted, fitted - 0.1, fitted + 0.1),),
        residuals=residuals, autocorrelation=np.zeros(40),
    )  # fmt: skip


@pytest.mark.parametrize("period", [60, 150])
def test_a_record_of_many_periods_shows_three_of_them_in_full(period: int) -> None:
    """2,000 dots covered the line."""
    item = forced_run(period)
    assert figures.period_of(item) == period
    shown = figures.worst_periods(item, period)
    (points,), (curve,) = shown.points, shown.curves
    assert points.x.size == curve.y.size == curve.lower.size == 3 * period
    assert points.x[0] <= 0.7 + 1e-9 + max(0.2 - 3e-3 * period, 0.0)
    assert points.x[-1] >= min(0.7 + 3e-3 * period, 0.9) - 2e-3
    np.testing.assert_array_equal(points.y, item.points[0].y[np.isin(item.points[0].x, points.x)])
    figures.ranges(item, period, ax := new_axes())
    low, high = ax.lines
    in_periods = item.curves[0].y[: 1800 // period * period].reshape(-1, period)
    np.testing.assert_array_equal(low.get_ydata(), in_periods.min(axis=1))
    np.testing.assert_array_equal(high.get_ydata(), in_periods.max(axis=1))
    assert len(figures.comparison_figure(item).axes) == 4
    assert "the periods with the largest residuals" in comparison_caption(item, {})
    assert "periods" not in comparison_caption(dataclasses.replace(item, curves=()), {})


def test_a_decay_is_drawn_until_it_dies_away_and_its_residuals_whole(result: Result) -> None:
    """Half of the panel was noise. A decay that still moves at its end, and a run, are drawn to their ends."""
    dying, moving = forced_run(decay=12.0, trend=0.0), forced_run(decay=1.0, trend=0.0)
    end, whole = figures.end_of_motion(dying) or 0.0, dying.points[0].x
    assert np.max(np.abs(dying.curves[0].y[whole > end])) < 0.1 * np.ptp(dying.curves[0].y)
    assert 0.2 * whole[-1] < end < 0.75 * whole[-1]
    top, below, _ = figures.comparison_figure(dying).axes
    assert top.get_xlim()[1] == end
    assert "dies away" in top.get_title(loc="left")
    assert below.get_xlim()[1] >= whole[-1]
    for item in (moving, forced_run(period=150), _named(result, "motor_current")):
        assert figures.end_of_motion(item) is None


def test_a_decay_and_a_short_record_are_drawn_whole(result: Result) -> None:
    decaying = forced_run(decay=12.0)
    for item in (decaying, forced_run(n=90), forced_run(period=500), _named(result, "free_vibration_1")):
        assert figures.period_of(item) == 0
        assert len(figures.comparison_figure(item).axes) == 3
    constant = dataclasses.replace(decaying, curves=(Curve("this fit", decaying.curves[0].x, np.ones(1800)),))
    assert figures.period_of(constant) == figures.period_of(dataclasses.replace(decaying, curves=())) == 0
    assert figures.period_of(_named(result, "motor_current")) == 0


def test_stalled_starts_end_in_a_cross(result: Result) -> None:
    stalled = np.array([False, True, False, False, True, False])
    ends = result.point_fit.ends.copy()
    ends[1] += 1.0
    ax = drawn(figures.point_fit_starts, dataclasses.replace(result.point_fit, stalled=stalled, ends=ends))
    assert sum(line.get_marker() == "x" for line in ax.lines) == 2
    assert "end, stalled" in ax.get_legend_handles_labels()[1]
    broken = dataclasses.replace(result.point_fit, covariance=np.full_like(result.point_fit.covariance, np.nan))
    assert png(figure_of(drawn(figures.point_fit_starts, broken)))


def test_hostile_text_is_drawn_as_it_stands(result: Result) -> None:
    bad = r"$\frac{$ <script> 50 % {x} \n"
    item = _named(result, "support_spring_soft")
    points = tuple(dataclasses.replace(points, label=bad) for points in item.points)
    hostile = dataclasses.replace(item, title=bad, x_label=bad, y_label=bad, points=points, label="../../$etc")
    assert png(figures.comparison_figure(hostile))
    twice = dataclasses.replace(result, comparisons=(hostile, hostile), posterior=None)
    names = [picture.name for picture in pictures(twice)]
    assert len(set(names)) == len(names)
    assert all(re.fullmatch(r"[A-Za-z0-9_-]+", name) for name in names)


def test_of_many_tables_the_worst_are_drawn(result: Result, monkeypatch: pytest.MonkeyPatch) -> None:
    """Before: 500 decays were drawn in eight minutes, and the page held all of them. The captions name the others."""
    monkeypatch.setattr("capsule_id.report.html.MOST_TABLES", 3)
    decay = _named(result, "free_vibration_1")
    n = len(cast(np.ndarray, decay.residuals))
    sizes = [2.0 if i == 4 else 1.0 - 0.01 * i for i in range(10)]
    decays = [dataclasses.replace(decay, label=f"d{i}", residuals=np.full(n, x)) for i, x in enumerate(sizes)]
    findings = (Finding("decays.drift", "warn", {}, "d9"), Finding("residuals.white", "fail", {}, "d0"))
    many = dataclasses.replace(result, comparisons=(*decays, _named(result, "friction")), findings=findings)
    drawn = [(name, caption) for name, section, _, caption, *_ in drawings(many) if section == "measured"]
    assert [name for name, _ in drawn] == ["free_vibration_d0", "free_vibration_d4", "free_vibration_d9", "friction"]
    assert ["3 of 10" in caption for _, caption in drawn] == [True, True, True, False]


def test_a_script_without_glyphs_is_no_failure(result: Result) -> None:
    item = dataclasses.replace(_named(result, "friction"), title="ばね 弹簧")
    assert png(figures.comparison_figure(item))


@pytest.mark.full
def test_synthetic_mark_changes_every_picture(result: Result, drawn: tuple[Picture, ...]) -> None:
    real = dataclasses.replace(result, rig=dataclasses.replace(result.rig, synthetic=False))
    for marked, plain in zip(drawn, pictures(real), strict=True):
        assert marked.name == plain.name
        assert marked.png != plain.png


def test_no_pyplot_and_no_matplotlib_for_text() -> None:
    code = """
import sys
import capsule_id.report.columns
assert "matplotlib" not in sys.modules and "xarray" not in sys.modules
import capsule_id.report.write
assert "matplotlib.figure" in sys.modules
assert "matplotlib.pyplot" not in sys.modules and "jax" not in sys.modules
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
