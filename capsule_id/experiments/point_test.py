"""Common form of lines and friction tests: a row per trial, its reading, and what parameters and other columns predict.

Linear nuisances and the scatter are integrated out, and errors of the other columns are carried over to the reading
to first order. Lines add a prior along the line, and friction tests share a panel. A kind of another package needs
little more than ``predict``.
"""

from abc import abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from types import ModuleType
from typing import Any, ClassVar, Self

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from scipy import stats

from capsule_id.experiments.base import (
    LEVEL,
    About,
    Fitted,
    Start,
    ValuesBySymbol,
    axis_label,
    band,
    refit,
    scatter_prior,
)
from capsule_id.experiments.friction_model import (
    EQUATION_1,
    FrictionModel,
    GroundExperiment,
    ground_of,
    ground_parameters,
    instrument_parameters,
)
from capsule_id.experiments.kind import Values
from capsule_id.experiments.lint import lint_reading_errors, lint_rows
from capsule_id.experiments.misfit import NUISANCE_WIDTH, Misfit
from capsule_id.parameters import SAME, STEP_SD, Parameter, parameter
from capsule_id.rig.model import Column, Rig, Table
from capsule_id.rig.schema import Entry
from capsule_id.views import Comparison, Curve, Finding, Message, Points, ResultTable

#: Name of the friction law of the fit in ``PointTest.reads``.
FRICTION = "friction"
#: Part of the range of the abscissa that a curve goes on beyond the readings, and its points.
MARGIN, CURVE = 0.04, 60


class PointTest(GroundExperiment):
    """Trials of one table; subclasses name the reading, its scatter and the parameters, and predict it.

    Attributes
    ----------
    readings : by column, SI: (n,), or () where all rows have one value
    sds : their reading errors, () or (n,), by column
    uncertain : columns other than the reading that have errors
    """

    readings: dict[str, np.ndarray]
    sds: dict[str, Any]
    uncertain: tuple[str, ...] = eqx.field(static=True)

    #: Column that is predicted.
    reading: ClassVar[str]
    #: Row of the scatter, and whether it is relative to the prediction.
    scatter: ClassVar[Parameter]
    relative: ClassVar[bool] = True
    #: What the prediction reads: rows, names of the package's parameters, or ``FRICTION``, the law of the fit.
    reads: ClassVar[tuple[str | Parameter, ...]] = ()
    #: Whether slope and N0 of the settings act.
    on_track: ClassVar[bool] = True

    def __init__(self, table: Table, rig: Rig, friction: FrictionModel = EQUATION_1) -> None:
        self.friction = replace(friction, direction=getattr(table.settings, "direction", friction.direction))
        self.ground = ground_of(table) if self.on_track else {}
        self.readings, self.sds = self.read(table)
        others = (name for name in self.sds if name != self.reading)
        self.uncertain = tuple(name for name in others if np.any(np.asarray(self.sds[name]) > 0.0))
        ground = ground_parameters(table, rig) if self.on_track else ()
        self.read_instruments(table)
        self.about = About(table, rig, (*self.own_parameters(table), *ground, *instrument_parameters(table)))

    def read(self, table: Table) -> tuple[dict[str, Any], dict[str, Any]]:
        """``readings`` and ``sds`` of a table."""
        columns = table.columns.items()
        return {name: c.values for name, c in columns}, {name: c.reading_sd for name, c in columns}

    def own_parameters(self, table: Table) -> tuple[Parameter, ...]:
        """The rows that ``reads`` names, and the scatter."""
        rows: list[Parameter] = []
        for one in self.reads:
            rows += self.friction.parameters if one == FRICTION else [parameter(one) if isinstance(one, str) else one]
        return (*rows, self.scatter)

    @abstractmethod
    def predict(self, theta: ValuesBySymbol, x: Mapping[str, Any]) -> Any:
        """The reading, SI, () or (n,), at ``theta`` and the columns ``x``; NumPy and JAX."""

    def unstated_errors(self, symbol: str) -> set[str]:
        """See ``Experiment``."""
        errors = [column.instrument.errors if column.instrument else {} for column in self.table.columns.values()]
        words = {"gain": "gain", "offset": "zero"}
        return {word for error, word in words.items() if not all(error in stated for stated in errors)}

    def with_readings(self, changed: Mapping[str, np.ndarray], rows: Any = slice(None)) -> Self:
        """The test with ``rows`` of its table and with other values of some columns."""
        columns = {name: replace(c, values=changed.get(name, c.values)[rows]) for name, c in self.table.columns.items()}
        table = replace(self.table, columns=columns, rows=np.arange(1, 1 + len(columns[next(iter(columns))].values)))
        made: Any = type(self).make(table, self.rig, self.friction)[0]
        return made

    def as_read(self, slope: Any, column: str, theta: ValuesBySymbol) -> Any:
        """A derivative of the true reading by a true column, as the readings of both instruments show it."""
        return slope * self.instrument(self.reading, theta)[0] / self.instrument(column, theta)[0]

    def true(self, column: str, values: Any, theta: ValuesBySymbol) -> Any:
        """What a column would read without the errors of its instrument at ``theta``."""
        factor, offset = self.instrument(column, theta)
        return (values - offset) / factor

    def shown(self, theta: ValuesBySymbol, x: Mapping[str, Any]) -> Any:
        """What its instrument reads where the reading is as predicted at the readings ``x`` of the other columns."""
        if not self.instruments:
            return self.predict(theta, x)
        factor, offset = self.instrument(self.reading, theta)
        return offset + factor * self.predict(
            theta, {name: self.true(name, values, theta) for name, values in x.items()}
        )

    def slopes(self, theta: ValuesBySymbol) -> Mapping[str, Any]:
        """Derivative of what is shown by each column of ``uncertain``, by name; () or (n,)."""
        return _slopes(self, theta) if self.uncertain else {}

    def change(self, theta: ValuesBySymbol) -> Any:
        """Change of the reading with its scatter, () or (n,)."""
        return self.predict(theta, self.readings) if self.relative else 1.0

    def design(self, n: int, xp: ModuleType = jnp) -> Any:
        """Effect (n, p) of linear nuisances on the readings, SI, each scaled to a standard normal prior."""
        return xp.zeros((n, 0))

    @property
    def masses(self) -> tuple[str, ...]:  # type: ignore[override]  # pyright: ignore
        return self.friction.masses if FRICTION in self.reads else ()

    @property
    def observed(self) -> np.ndarray:
        return self.readings[self.reading]

    @property
    def scatters(self) -> tuple[str | None, ...]:
        return (self.scatter.symbol,)

    def misfits(self, theta: ValuesBySymbol, xp: ModuleType = jnp) -> tuple[Misfit, ...]:
        raw = self.observed - xp.asarray(self.shown(theta, self.readings))
        carried = ((slope * self.sds[name]) ** 2 for name, slope in self.slopes(theta).items())
        variance = sum(carried, self.sds[self.reading] ** 2)
        size = self.instrument(self.reading, theta)[0] if self.relative else 1.0
        return (Misfit(raw, variance, size * self.change(theta), self.design(self.n, xp)),)

    def comparisons(self, theta: ValuesBySymbol, draws: list[ValuesBySymbol]) -> tuple[Comparison, ...]:
        """Readings against the first other column, or in order; curves hold the further columns at their means."""
        y, others = self.table.columns[self.reading], (c for c in self.table.columns.values() if c.name != self.reading)
        column = next(others, Column("trial", "1", 1.0, np.arange(1.0, self.n + 1.0)))
        x = column.values
        margin = MARGIN * np.ptp(x)
        along = np.linspace(np.min(x) - margin, np.max(x) + margin, CURVE)
        held = {name: np.mean(values) for name, values in self.readings.items()}

        def curve(values: ValuesBySymbol) -> np.ndarray:
            nuisances = self.design(CURVE, np) @ self.nuisance_mean(values)
            return (np.asarray(self.shown(values, {**held, column.name: along})) + nuisances) * y.to_display

        lower, upper = band(np.array([curve(draw) for draw in draws]))
        return (
            Comparison(
                self.kind,
                self.label,
                f"{self.label}: {y.name} against {column.name}",
                axis_label(column),
                axis_label(y),
                (
                    Points(
                        self.label,
                        x * column.to_display,
                        self.observed * y.to_display,
                        np.full(self.n, y.sd * y.to_display) if y.sd else None,
                    ),
                ),
                (Curve("this fit", along * column.to_display, curve(theta), lower, upper),),
                self.residuals(theta, np)[: self.n],
            ),
        )


@jax.jit
def _slopes(test: PointTest, theta: ValuesBySymbol) -> dict[str, jax.Array]:
    """See ``PointTest.slopes``."""

    def slope(name: str) -> jax.Array:
        x = test.readings[name]
        return jax.jvp(lambda x: test.shown(theta, {**test.readings, name: x}), (x,), (jnp.ones_like(x),))[1]

    return {name: slope(name) for name in test.uncertain}


# line: Shared declarations of calibration lines: rule on reading errors, the paper's straight line, lint.


LINE_MESSAGES = {
    "lines.rise": Message(
        "linearity",
        fail="{name} is positive, but the line falls: {slope:.3g} {unit}. Check the signs of {x} and {y}.",
    ),
    "lines.straight": Message(
        "linearity",
        ok="no bend in {number:# calibration line}",
        fail=(
            "expected a straight line; a parabola departs from it by {departure:.1%} of the range at mid range "
            "({p:p}), so {name} depends on where it is read. Use the part of the range that the runs use."
        ),
    ),
    "lines.origin": Message(
        "linearity",
        warn=(
            "the line misses the origin by {intercept:.2g} {unit} ({p:p}), and a parabola through the origin fits better: "
            "{name} is {at_origin:.4g} {slope_unit} at small {x}, or {slope:.4g} {slope_unit} with a wrong zero. Add rows at "
            "small {x}, or leave out the rows beyond the {x} of the runs."
        ),
    ),
    "lines.replicates": Message(
        "repeated readings",
        ok="the means of repeated readings lie on {number:# calibration line}",
        fail=(
            "expected the means of repeated readings on the line; they deviate by {deviation:.1f} sd of a reading "
            "({p:p}), so {name} has errors that repetition does not show. Set {x} anew before each reading, and check "
            "for hysteresis."
        ),
    ),
    "lines.branches": Message(
        "hysteresis",
        ok="no difference between loading and unloading on {number:# calibration line}",
        warn=(
            "{y} is {difference:+.3g} {unit} while {x} falls, against the same {x} while it rises ({share:.1%} of the range, "
            "{p:p}): hysteresis. The slope is {rising:.5g} on the way up and {falling:.5g} on the way down; {name} is that of "
            "both. If the motion uses one way alone, keep its rows: data_from_line and data_to_line in the entry of this table."
        ),
    ),
    "lines.two_rows": Message(
        "scatter of calibration lines",
        warn=(
            "two readings show nothing of their own scatter, so the sd of {name} follows from an assumed one. State {y}_sd, "
            "or measure more rows."
        ),
    ),
    "lines.step": Message(
        "scatter of calibration lines",
        warn=(
            "the readings scatter less about the line than rounding to {step:g} {unit}, their last digit, lets them, so the "
            "sd of {name} follows from this step. State {y}_resolution or {y}_sd."
        ),
    ),
    "lines.slopes": Message(
        "Calibration lines",
        caption=(
            "Slopes by generalised least squares. The ordinary line is the paper's estimate. Flagged rows are shown, not "
            "dropped."
        ),
    ),
}


def line_estimates(experiments: Sequence["Line"]) -> Values:
    """Return the slopes of ordinary straight lines, by name; the mean over tables."""
    slopes = [(e.slope.name, e.ordinary_line()[0]) for e in experiments]
    return {name: float(np.mean([slope for own, slope in slopes if own == name])) for name, _ in slopes}


def refuse_idle_sd_ratio(entry: Entry[Any]) -> None:
    """Reject ``sd_ratio`` where both reading errors are stated, because they already define the ratio.

    Raises
    ------
    InputError
        If ``sd_ratio`` and both reading errors are stated.
    """
    columns = entry.table.columns
    if entry.table.settings.sd_ratio is not None and all(column.sd is not None for column in columns.values()):
        one, other = (f"{name}_sd" for name in sorted(columns, key=lambda name: name != "force"))
        rule = f"state sd_ratio or both of {one} and {other}"
        raise entry.error("sd_ratio", rule, "all three", "remove sd_ratio", of_key=True)


def lint_line(table: Table[Any], rig: Rig) -> Iterable[Finding]:
    """Report few rows and missing reading errors."""
    yield from lint_rows(table, rig, 2)
    if table.settings.sd_ratio is None:
        yield from lint_reading_errors(table, rig)


# line replicates: Lack of fit of a calibration line against the scatter of repeated readings.


#: Smallest deviation of the levels from the line that counts, in sd of the repeated readings.
SMALLEST_DEVIATION = 0.5
#: Coefficients of a parabola: fewer levels show no curvature of a line, and as many rows no error of one.
OF_PARABOLA = 3
#: Fewest rows of loading and of unloading that are compared.
FEWEST_OF_A_BRANCH = 4


def check_replicates(lines: "Sequence[Line]", fit: Fitted) -> list[Finding]:
    """Check that the means of repeated readings lie on the line (F test; Draper & Smith 1998, section 2.1)."""
    tests = []
    for e in lines:
        keep = np.setdiff1d(np.arange(e.n), fit.flagged.get(e.label, []))
        tests += [(e, *found) for found in [lack_of_fit(e.x[keep], e.observed[keep])] if found is not None]
    findings = [
        Finding("lines.replicates", "fail", {"name": e.slope.name, "x": e.x_name, "deviation": size, "p": p}, e.label)
        for e, size, p in tests
        if p * len(lines) < LEVEL and size > SMALLEST_DEVIATION
    ]
    return findings or [Finding("lines.replicates", "ok", {"number": len(tests)})] * bool(tests)


def check_branches(lines: "Sequence[Line]", fit: Fitted) -> list[Finding]:
    """Compare the branches of lines whose x rises and then falls, at equal x (t-test of their difference)."""
    findings, number = list[Finding](), 0
    for e in lines:
        away = e.x - e.x[0]
        away = away * np.sign(away[np.argmax(np.abs(away))])  # a spring that is pulled may have negative readings
        top = int(np.argmax(away))
        rise, fall = np.arange(top + 1), top + 1 + np.flatnonzero(away[top + 1 :] >= 0.0)
        if min(len(rise), len(fall)) < FEWEST_OF_A_BRANCH or np.any(
            (np.diff(away) > 0.0) != (np.arange(1, e.n) <= top)
        ):
            continue
        number, (x, y) = number + 1, (away, e.observed)
        differences = y[fall] - np.interp(x[fall], x[rise], y[rise])
        size, error = float(np.mean(differences)), float(np.std(differences, ddof=1)) / np.sqrt(len(fall))
        p = float(2.0 * stats.t.sf(abs(size) / max(error, np.finfo(float).tiny), len(fall) - 1))
        if p < LEVEL:
            rising, falling = (float(np.polyfit(e.x[rows], y[rows], 1)[0]) for rows in (rise, fall))
            column, share = e.table.columns[e.reading], abs(size) / float(np.ptp(y))
            facts = {
                "y": e.reading,
                "x": e.x_name,
                "unit": column.unit,
                "name": e.slope.name,
                "share": share,
                "p": p,
                "difference": size * column.to_display,
                "rising": rising,
                "falling": falling,
            }
            findings.append(Finding("lines.branches", "warn", facts, e.label, (e.slope.name,)))
    return findings or [Finding("lines.branches", "ok", {"number": number})] * bool(number)


def lack_of_fit(x: np.ndarray, y: np.ndarray) -> tuple[float, float] | None:
    """Deviation of the levels from the line, in sd of repeated readings, and p-value; None without repetitions."""
    order = np.argsort(x, kind="stable")
    level = np.concatenate([[0], np.cumsum(np.diff(x[order]) > SAME * np.ptp(x))])
    count = np.bincount(level)
    levels, freedom = len(count), len(x) - len(count)
    if levels < OF_PARABOLA or freedom < 3:
        return None
    mean = np.bincount(level, y[order]) / count
    within = float(np.sum((y[order] - mean[level]) ** 2)) / freedom
    total = np.polyval(np.polyfit(x, y, 1), x[order])
    between = float(np.sum((mean[level] - total) ** 2)) / (levels - 2)
    if within == 0.0:
        return None
    size = len(x) / levels
    return float(np.sqrt(max(between / within - 1.0, 0.0) / size)), float(
        stats.f.sf(between / within, levels - 2, freedom)
    )


# line experiment: Calibration line y = y0 + slope x, shared by motor current and support spring.
#
# Both columns have errors where both reading errors, or their ratio, are stated. Otherwise the model has one total
# scatter about the line, in addition to any stated reading error. The true point of a reading is integrated out along
# the line. Its prior is flat in length, in units of the reading errors, so that neither column is preferred. Where one
# reading error alone is stated, it is flat in x, because the other error is not known.
# The slope is then that of orthogonal (Deming) regression (Hogg, Bovy & Lang 2010, section 7; Fuller 1987, section
# 1.3).
# A prior flat in x would bias the slope towards ordinary least squares, by -(sd_x / sd of the x's)^2 relative. The
# intercept is integrated out under a wide normal prior.


#: Factor of the default prior of a scatter where the table has too few rows to show any.
SCATTER_FACTOR_OF_FEW = 3.0


def check_linearity(lines: "Sequence[Line]", fit: Fitted) -> list[Finding]:
    """Check that calibration lines rise and are straight, without flagged rows."""
    findings = []
    for e in lines:
        theta, left_out = e.local(fit.values), fit.flagged.get(e.label, [])
        # One outlier can tilt the whole line. The outlier check reports it, so it is excluded here.
        slope = refit(e, theta, left_out)[e.symbol][0]
        if slope <= 0.0:
            facts = {"name": e.slope.name, "slope": slope, "unit": e.slope.unit, "x": e.x_name, "y": e.reading}
            findings.append(Finding("lines.rise", "fail", facts, e.label))
            continue
        keep = np.setdiff1d(np.arange(e.n), left_out)
        readings = e.x[keep], e.observed[keep], e.misfit(theta).sd[keep]
        bend, p = curvature_test(*readings, e.scale_known)
        # Of exact readings only the rounding is left, which may bend and miss the origin.
        rounding = e.table.columns[e.reading].rounding_sd
        if p * len(lines) < LEVEL and abs(bend) * np.ptp(e.observed) > rounding:
            facts = {"name": e.slope.name, "departure": bend, "p": p}
            findings.append(Finding("lines.straight", "fail", facts, e.label))
            continue
        intercept, p, at_origin = origin_test(*readings, e.scale_known)
        if e.from_origin and at_origin is not None and p * len(lines) < LEVEL and abs(intercept) > rounding:
            facts = {
                "name": e.slope.name,
                "slope": slope,
                "at_origin": at_origin,
                "slope_unit": e.slope.unit,
                "intercept": intercept,
                "unit": e.unit_of_y,
                "x": e.x_name,
                "p": p,
            }
            findings.append(Finding("lines.origin", "warn", facts, e.label, (e.slope.name,)))
    return findings or [Finding("lines.straight", "ok", {"number": len(lines)})]


def check_scatter(lines: "Sequence[Line]", fit: Fitted) -> list[Finding]:
    """Report lines whose scatter the readings do not show: two rows, or readings closer to the line than their step."""
    findings = []
    for e in lines:
        column = e.table.columns[e.reading]
        few = e.n <= 2
        if e.scale_known or (column.sd is not None if few else e.step == 0.0):
            continue
        code = "lines.two_rows" if few else "lines.step"
        facts = {"y": e.reading, "unit": column.unit, "step": e.step * column.to_display, "name": e.slope.name}
        findings.append(Finding(code, "warn", facts, e.label, (e.slope.name,)))
    return findings


def curvature_test(x: np.ndarray, y: np.ndarray, sd: np.ndarray, scale_known: bool) -> tuple[float, float]:
    """Test readings y (n,) with errors ``sd`` for curvature: relative deviation of the best parabola at mid range, p-value."""
    z = (x - np.mean(x)) / (np.ptp(x) or 1.0)
    if len(x) <= OF_PARABOLA or len(np.unique(np.round(z, 9))) < OF_PARABOLA:
        return 0.0, 1.0
    coefficients, covariance = np.polyfit(z, y, 2, w=1.0 / sd, cov="unscaled" if scale_known else True)
    p = _p_of(coefficients[0], covariance[0, 0], np.inf if scale_known else len(x) - OF_PARABOLA)
    return float(coefficients[0] * 0.25 / abs(coefficients[1])), p


def origin_test(x: np.ndarray, y: np.ndarray, sd: np.ndarray, scale_known: bool) -> tuple[float, float, float | None]:
    """Test readings y (n,) with errors ``sd`` for a line that misses the origin: its intercept, and p-value.

    Also return the slope at the origin of a parabola through it, where that fits better than the line.
    """
    if len(x) <= OF_PARABOLA:
        return 0.0, 1.0, None
    line, covariance = np.polyfit(x, y, 1, w=1.0 / sd, cov="unscaled")
    parabola = np.linalg.lstsq(np.column_stack([x, x**2]) / sd[:, None], y / sd)[0]
    misfits = [np.sum(((y - np.polyval(own, x)) / sd) ** 2) for own in (line, [*parabola[::-1], 0.0])]
    freedom = np.inf if scale_known else len(x) - 2
    p = _p_of(line[1], covariance[1, 1] * (1.0 if scale_known else min(misfits) / freedom), freedom)
    return float(line[1]), p, float(parabola[0]) if misfits[1] < misfits[0] else None


def _p_of(value: float, variance: float, freedom: float) -> float:
    """Two-sided p-value of an estimate whose true value is 0."""
    return 2.0 * float(stats.t.sf(abs(value) / np.sqrt(max(variance, 1e-300)), freedom))


def line_table(lines: "Sequence[Line]", fit: Fitted) -> list[ResultTable]:
    """Compare the slopes with and without flagged rows and the paper's ordinary line."""
    import pandas as pd  # half a second, which capsule-id check does without

    rows = []
    for e in lines:
        theta, left_out = e.local(fit.values), fit.flagged.get(e.label, [])
        value, sd = refit(e, theta, [])[e.symbol]
        row: dict[str, object] = {
            "table": e.label,
            "slope": f"{e.slope.name}, {e.slope.unit}",
            "all rows": value,
            "±": sd,
            "ordinary line": e.ordinary_line()[0],
        }
        if fit.flagged:
            without = refit(e, theta, left_out)[e.symbol] if left_out else (np.nan, np.nan)
            row |= {"without flagged rows": without[0], "± without": without[1]}
        length = getattr(e.table.settings, "length", None)
        rows.append(row | ({} if length is None else {"length, m": length.value}) | {"errors": e.errors})
    return [ResultTable("lines.slopes", pd.DataFrame(rows).set_index("table"))]


class Line(PointTest):
    """A line y against x; subclasses name the columns and the slope.

    Attributes
    ----------
    width : sd of the intercept's prior, SI
    sd_ratio : stated ratio of both errors; None: not stated
    step : step of the last digit of y, SI, where it exceeds the scatter about the line and no error of y is stated; else 0
    scale_known : whether both reading errors are stated
    """

    width: float
    sd_ratio: float | None
    step: float
    scale_known: bool = eqx.field(static=True)  # type: ignore[misc]  # pyright: ignore

    #: Column of x, and symbol of the slope.
    x_name: ClassVar[str]
    symbol: ClassVar[str]
    #: SI unit of y, and whether y is 0 where x is 0.
    unit_of_y: ClassVar[str] = "N"
    from_origin: ClassVar[bool] = False
    relative = False
    estimates_may_be_negative = True
    checks = (check_linearity, check_replicates, check_branches, check_scatter)
    tables = (line_table,)

    def __init__(self, table: Table, rig: Rig, friction: FrictionModel = EQUATION_1) -> None:
        y = table.columns[self.reading]
        self.width, self.sd_ratio = NUISANCE_WIDTH * float(np.ptp(y.values)), table.settings.sd_ratio
        self.scale_known = all(table.columns[name].sd is not None for name in (self.x_name, self.reading))
        super().__init__(table, rig, friction)
        step = y.unstated_step
        self.step = step if self.ordinary_line()[2] < step * STEP_SD else 0.0
        self.sds = {**self.sds, self.reading: max(self.sds[self.reading], self.step * STEP_SD)}

    def slope_of(self, table: Table) -> Parameter:
        """Row of the slope: of the spring that the settings name, or of the rig."""
        return parameter(self.symbol, getattr(table.settings, "spring", ""))

    def own_parameters(self, table: Table) -> tuple[Parameter, ...]:
        slope, prior = self.slope_of(table), scatter_prior(float(np.ptp(self.observed)))
        prior = prior if self.n > 2 else replace(prior, spread=SCATTER_FACTOR_OF_FEW)
        scatter = replace(parameter("scatter", table.label, prior), unit=self.unit_of_y)
        return (slope,) if self.scale_known else (slope, scatter)

    def with_readings(self, changed: Mapping[str, np.ndarray], rows: Any = slice(None)) -> Self:
        """The prior of the intercept stays as wide as the range of the measured readings: a single level has none."""
        return eqx.tree_at(lambda line: line.width, super().with_readings(changed, rows), self.width)

    @property
    def x(self) -> np.ndarray:
        return self.readings[self.x_name]

    @property
    def slope(self) -> Parameter:
        return self.parameters[0]

    @property
    def scatters(self) -> tuple[str | None, ...]:
        return (None,) if self.scale_known else ("scatter",)

    def unstated_errors(self, symbol: str) -> set[str]:
        """The intercept takes up the zeros of both columns."""
        return super().unstated_errors(symbol) - {"zero"}

    @property
    def errors(self) -> str:
        """Error model in words, for the report."""
        if self.scale_known:
            return "errors in both columns, as stated"
        if self.sd_ratio is not None:
            return "errors in both columns, their ratio as stated, their size estimated"
        return "one total scatter about the line (the reading errors of both columns are not stated)"

    def predict(self, theta: ValuesBySymbol, x: Mapping[str, Any]) -> Any:
        return theta[self.symbol] * x[self.x_name]

    def slopes(self, theta: ValuesBySymbol) -> Mapping[str, Any]:
        """The slope of the readings, which the gains of both instruments change."""
        return {self.x_name: self.as_read(theta[self.symbol], self.x_name, theta)}

    def shown(self, theta: ValuesBySymbol, x: Mapping[str, Any]) -> Any:
        """The line through the means of the readings: the intercept stands there, wherever the zeros of both columns are."""
        slope = self.as_read(theta[self.symbol], self.x_name, theta)
        return self.observed.mean() + slope * (x[self.x_name] - self.x.mean())

    def design(self, n: int, xp: ModuleType = jnp) -> Any:
        return self.width * xp.ones((n, 1))

    def misfits(self, theta: ValuesBySymbol, xp: ModuleType = jnp) -> tuple[Misfit, ...]:
        (plain,) = super().misfits(theta, xp)
        if self.scale_known:
            return (replace(plain, scale=0.0, ordinate=(self.sds[self.reading] ** 2, 0.0)),)
        if self.sd_ratio is None:
            return (plain,)
        # Readings scatter in x too. The ratio of both errors must not depend on the scatter: its density would then have
        # no upper limit at 0.
        total = 1.0 + (self.slopes(theta)[self.x_name] / self.sd_ratio) ** 2
        return (replace(plain, scale=xp.sqrt(total), ordinate=(plain.fixed_variance / total, 1.0)),)

    def ordinary_line(self) -> tuple[float, float, float]:
        """Slope, intercept and residual sd of ordinary least squares, the paper's fit; slope 0 at one level of x."""
        x, y = self.x - np.mean(self.x), self.observed - np.mean(self.observed)
        slope = x @ y / (x @ x) if x @ x > 0.0 else 0.0
        intercept = np.mean(self.observed) - slope * np.mean(self.x)
        rest = y - slope * x
        return float(slope), float(intercept), float(np.sqrt(rest @ rest / max(self.n - 2, 1)))

    def starts(self) -> dict[str, Start]:
        slope, _, sd = self.ordinary_line()
        starts = {self.slope.name: Start(abs(slope), 0.4)}
        if not self.scale_known:
            starts[f"scatter[{self.label}]"] = Start(max(sd, 1e-6 * float(np.ptp(self.observed))), 0.3)
        return starts

    def comparisons(self, theta: ValuesBySymbol, draws: list[ValuesBySymbol]) -> tuple[Comparison, ...]:
        (panel,), (slope, intercept, _) = super().comparisons(theta, draws), self.ordinary_line()
        x, columns = panel.curves[0].x, self.table.columns
        paper = intercept + slope * x / columns[self.x_name].to_display
        curve = Curve("the paper's fit", x, paper * columns[self.reading].to_display, role="paper")
        return (replace(panel, curves=(*panel.curves, curve)),)
