"""Checks of single experiments and of experiments against each other, at the point fit.

Every check that can fail has a family-wise false-alarm rate of ``LEVEL`` over its experiments (Bonferroni).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy import stats

from capsule_id.experiments.base import Experiment
from capsule_id.experiments.dynamic_friction.experiment import DynamicFriction
from capsule_id.experiments.free_vibration.experiment import FreeVibration, autocorrelation
from capsule_id.experiments.line import Line
from capsule_id.experiments.sliding_friction.experiment import SlidingFriction
from capsule_id.experiments.static_friction.experiment import StaticFriction
from capsule_id.experiments.support_spring.experiment import SupportSpring, cantilever_exponent
from capsule_id.inference.checks.regression import MOST_FLAGGED, curvature_test, outliers, refit
from capsule_id.inference.checks.tension import tension
from capsule_id.inference.result import PointFit, Posterior
from capsule_id.inference.target.log_posterior import LogPosterior
from capsule_id.rig.model import Rig
from capsule_id.views import Finding

#: Family-wise false-alarm rate of each check.
LEVEL = 0.002
#: Lags of the whiteness test.
LAGS = 20


@dataclass(frozen=True)
class Setting:
    """What the checks look at, in one place."""

    rig: Rig
    experiments: Sequence[Experiment]
    target: LogPosterior
    fit: PointFit
    posterior: Posterior | None
    values: Mapping[str, float] = field(default_factory=dict)


def _or_ok(findings: list[Finding], check: str, text: str) -> list[Finding]:
    return findings or [Finding(check, "ok", text)]


def check_whiteness(s: Setting) -> list[Finding]:
    """Expected: residuals of every record white (Ljung–Box)."""
    records = [
        (e, label, residuals)
        for e in s.experiments
        if e.time_series
        for label, residuals in e.records(e.local(s.values))
    ]
    findings = []
    for e, label, residuals in records:
        lags = min(LAGS, len(residuals) // 5)
        q, p = ljung_box(residuals, lags)
        if p * len(records) < LEVEL:
            text = (
                f"{label}: expected white residuals; Ljung–Box Q = {q:.0f} over {lags} lags (p = {p:.1g}), so the model "
                f"misses something or the noise is coloured, and the intervals are not to be trusted{_advice(e)}"
            )
            findings.append(Finding("residuals white", "fail", text, e.label))
    if not records:
        return []
    return _or_ok(
        findings, "residuals white", f"residuals of {len(records)} records are white (Ljung–Box, {LAGS} lags)"
    )


def _advice(experiment: Experiment) -> str:
    """What a coloured record calls for."""
    if isinstance(experiment, FreeVibration) and not experiment.event_driven:
        drift = experiment.damping_trend()
        remedy = "compare the damping models below, cut the record to free decay with start/stop"
        return f"{'; ' + drift if drift else ''}: {remedy}"
    remedy = 'check spring, gap and friction law, or state noise = "ar1" where the sensor filters'
    return f": look at its residuals and phase portrait, {remedy}"


def whiteness(experiment: Experiment, values: Mapping[str, float]) -> tuple[float, float, int]:
    """Ljung–Box Q of the residuals of a single record at ``values`` by name, its p-value, and the number of lags."""
    ((_, residuals),) = experiment.records(experiment.local(values))
    lags = min(LAGS, len(residuals) // 5)
    return *ljung_box(residuals, lags), lags


def ljung_box(residuals: np.ndarray, lags: int) -> tuple[float, float]:
    """Ljung–Box Q over ``lags`` and its p-value (Ljung & Box 1978), residuals (n,)."""
    n = len(residuals)
    rho = autocorrelation(residuals, lags)
    q = n * (n + 2.0) * float(np.sum(rho**2 / (n - np.arange(1, lags + 1))))
    return q, float(stats.chi2.sf(q, lags))


def check_outliers(s: Setting, flagged: dict[str, list[int]]) -> list[Finding]:
    """Expected: no reading far from the rest of its table; fills ``flagged``, rows by label."""
    tables = [e for e in s.experiments if not e.time_series]
    findings = []
    for e in tables:
        theta = e.local(s.values)
        found = outliers(e, theta, LEVEL / len(tables))
        if not found:
            continue
        rows = [o.row for o in found]
        flagged[e.label] = rows
        several, most = len(found) > 1, len(found) == MOST_FLAGGED
        numbers = [str(line) for line in sorted(int(e.table.rows[o.row]) for o in found)]
        lines = (
            f"lines {', '.join(numbers[:-1])} and {numbers[-1]} stand up to" if several else f"line {numbers[0]} stands"
        )
        more = (
            f" (no more than {MOST_FLAGGED} rows are named: if more stand off, look at the whole table)" if most else ""
        )
        physical = [row for row in e.parameters if row.physical]
        without = refit(e, theta, rows)
        change = "; ".join(
            f"{row.name} = {s.values[row.name]:.5g} {row.unit} with {'them' if several else 'it'}, "
            f"{without[row.symbol][0]:.5g} without"
            for row in physical
        )
        text = (
            f"{e.label}: {e.table.file} {lines} {abs(found[0].score):.3g} studentised residuals off the others "
            f"(p = {found[0].p:.1g}){more}; {change}. Nothing was dropped: check the reading, correct or remove it yourself"
        )
        findings.append(Finding("outliers", "fail", text, e.label))
    return _or_ok(findings, "outliers", "no reading stands apart from the others of its table") if tables else []


def check_linearity(s: Setting, flagged: Mapping[str, list[int]]) -> list[Finding]:
    """Expected: calibration lines that rise and are straight, flagged rows left out."""
    lines = [e for e in s.experiments if isinstance(e, Line)]
    findings = []
    for e in lines:
        # A single wild reading can tilt the whole line: that is the outlier's finding, not this one's.
        slope = refit(e, e.local(s.values), flagged.get(e.label, []))[e.slope.symbol][0]
        if slope <= 0.0:
            text = (
                f"{e.label}: {e.slope.name} is positive, the line falls ({slope:.3g} {e.slope.unit}): check the signs of "
                f"{e.x_column.name} and {e.y_column.name}"
            )
            findings.append(Finding("linearity", "fail", text, e.label))
            continue
        bend, p = curvature_test(e, e.local(s.values), flagged.get(e.label, []))
        if p * len(lines) < LEVEL:
            text = (
                f"{e.label}: expected a straight line; a parabola departs from it by {100 * bend:.1f} % of the range at "
                f"mid range (p = {p:.1g}), so {e.slope.name} depends on where it is read: use the part of the range "
                "that the runs use"
            )
            findings.append(Finding("linearity", "fail", text, e.label))
    return _or_ok(findings, "linearity", f"{len(lines)} calibration lines are straight") if lines else []


def check_stated_errors(s: Setting, flagged: Mapping[str, list[int]]) -> list[Finding]:
    """Expected: where reading errors are stated, they explain the scatter (chi-square)."""
    known = [e for e in s.experiments if e.scale_known and e.label not in flagged]
    findings = []
    for e in known:
        square = float(np.sum(np.asarray(e.residuals(e.local(s.values), np))[: e.n] ** 2))
        freedom = e.n - 2
        p = float(stats.chi2.sf(square, freedom)) if freedom > 0 else 1.0
        if p * len(known) < LEVEL:
            text = (
                f"{e.label}: the stated reading errors explain a chi-square of about {freedom}; {square:.0f} was seen "
                f"(p = {p:.1g}): the errors are larger than stated, or the line is not straight"
            )
            findings.append(Finding("stated errors", "fail", text, e.label))
    return _or_ok(findings, "stated errors", "stated reading errors explain the scatter") if known else []


def check_stiffness(s: Setting) -> list[Finding]:
    """The paper's "linear near the working point": k1 of single records against release amplitude."""
    # The capsule model says by itself what a larger release does.
    records = [e for e in s.experiments if isinstance(e, FreeVibration) and not e.event_driven]
    if len(records) < 2:
        return []
    k1, sd, _ = stiffness_by_record(records, s.values)
    weight = sd**-2.0
    mean = np.average(k1, weights=weight)
    q = float(np.sum(weight * (k1 - mean) ** 2))
    p = float(stats.chi2.sf(q, len(records) - 1))
    if p < LEVEL:
        text = (
            f"expected one k1 for all releases (linear near the working point); the records give {k1.min():.5g} to "
            f"{k1.max():.5g} N/m (chi-square {q:.1f} for {len(records) - 1} d.f., p = {p:.1g}): release from smaller "
            "deflections, or treat k1 as valid at one amplitude only"
        )
        return [Finding("stiffness against amplitude", "fail", text)]
    return [Finding("stiffness against amplitude", "ok", f"k1 is the same in all {len(records)} records (p = {p:.2g})")]


def stiffness_by_record(
    records: Sequence[FreeVibration], values: Mapping[str, float]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """k1, its standard error and the largest deflection of every record, (records,) SI."""
    estimates = [refit(e, e.local(values), [])["k1"] for e in records]
    k1, sd = (np.array(column) for column in zip(*estimates, strict=True))
    return k1, sd, np.array([e.largest_deflection for e in records])


def check_friction(s: Setting) -> list[Finding]:
    """Expected: tilts and slides tell of one surface."""
    tilts = [e for e in s.experiments if isinstance(e, StaticFriction)]
    # A push with the capsule model tells of k1 and c too: by itself it is no friction test.
    slides = [e for e in s.experiments if isinstance(e, DynamicFriction | SlidingFriction) and not e.event_driven]
    if not tilts or not slides:
        return []
    found = tension(s.rig, tilts, slides)
    seen = f"mu = {found.one['mu']:.3f} by tilting, {found.other['mu']:.3f} by sliding (p = {found.p:.2g})"
    if found.p < LEVEL:
        labels = ", ".join(e.label for e in tilts)
        text = (
            f"{labels} and {', '.join(e.label for e in slides)}: expected one surface; {seen}: were they measured on the "
            "same surface, and is the tilt read at break-away?"
        )
        return [Finding("experiments agree", "fail", text, tilts[0].label)]
    return [Finding("experiments agree", "ok", seen)]


def check_cantilever(s: Setting, flagged: Mapping[str, list[int]]) -> list[Finding]:
    """Expected, where lengths are stated: k2 ~ L^-3 over the springs."""
    springs = [e for e in s.experiments if isinstance(e, SupportSpring) and e.length is not None]
    if len({e.spring for e in springs}) < 2:
        return []
    estimates = [refit(e, e.local(s.values), flagged.get(e.label, []))["k2"] for e in springs]
    k2, sd = (np.array(column) for column in zip(*estimates, strict=True))
    lengths = [e.length for e in springs if e.length is not None]
    exponent, error, p = cantilever_exponent(
        np.array([q.value for q in lengths]), np.array([q.sd for q in lengths]), k2, sd / k2
    )
    seen = f"k2 ~ L^({exponent:.3f} ± {error:.3f}), p = {p:.2g} for the cantilever's -3"
    if p < LEVEL:
        text = f"{seen}: the clamp yields, or a length is misread; k2 of each spring is its own parameter all the same"
        return [Finding("cantilever law", "warn", text)]
    return [Finding("cantilever law", "ok", seen)]
