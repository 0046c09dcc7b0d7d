"""Tables of a fit: parameters, notes on them, notes on runs, and the check of the engine."""

from collections.abc import Mapping, Sequence
from typing import Any, Literal

import jax.numpy as jnp
import numpy as np
import pandas as pd

from capsule_id.experiments.free_vibration.turning_points import TurningPoints
from capsule_id.experiments.friction_model import SurfaceExperiment
from capsule_id.experiments.kind import Registry, paper_estimates
from capsule_id.experiments.point_test import PointTest
from capsule_id.inference.checks.posterior import runs_alone
from capsule_id.inference.checks.verdict import declared, informed, trust_words
from capsule_id.inference.curvature import covariance
from capsule_id.inference.least_squares import linearised, rows_of
from capsule_id.inference.point_stage import SampledFit, Widening
from capsule_id.inference.profiles import identified, profile_tables
from capsule_id.inference.result import PointFit, Posterior
from capsule_id.inference.target import LogPosterior
from capsule_id.parameters import INSTRUMENT_WORDS, QUANTILE_975, Parameter, is_stated, parameter
from capsule_id.physics.smooth.engine import Smoothing
from capsule_id.views import Finding, ResultTable

# run notes: Tables for bench tests and forced runs together: precision gained from the runs, effect of smoothing.


#: Widths of the smoothed engine of a fit, SI.
WIDTHS = {name: getattr(Smoothing(), name) for name in ("velocity", "penetration")}
#: Shifts of a parameter between the two engines, in sd: not small, and no longer tolerable.
SMALL_SHIFT, LARGE_SHIFT = 0.2, 1.0


def precision_gained(s: SampledFit) -> ResultTable:
    """Posterior sd from bench only, runs only, and both; from samples where they exist, else from point fits."""
    target, joint = s.target, s.fit
    shared, known = shared_symbols(target), run_parameters(target)
    alone = runs_alone(target, joint)
    runs = {name: sd * abs(joint.values[name]) if name in known else np.nan for name, (_, sd) in alone.items()}
    rows = {}
    for row in (row for row in target.parameters if row.symbol in shared):
        sds = _sd(s.bench, s.bench_sample, row.name), runs[row.name], _sd(joint, s.posterior, row.name)
        rows[row.name] = [row.unit, *sds]
    frame = pd.DataFrame.from_dict(rows, orient="index", columns=["unit", "bench only", "runs only", "both"])
    frame["bench only / both"] = frame["bench only"] / frame["both"]
    return ResultTable("runs.precision", frame.rename_axis("parameter"))


def run_parameters(target: LogPosterior) -> set[str]:
    """Names of the physical parameters of forced runs, masses included."""
    return {row.name for e in target.experiments if not e.bench for row in e.parameters if row.physical} | {"m1", "m2"}


def shared_symbols(target: LogPosterior) -> set[str]:
    """Symbols of run parameters that a bench test may measure too: those that belong to no single run."""
    runs = {e.label for e in target.experiments if not e.bench}
    known = run_parameters(target)
    return {row.symbol for row in target.parameters if row.name in known and row.of not in runs}


def _sd(fit: PointFit | None, sample: Posterior | None, name: str) -> float:
    if sample is not None and name in sample.names:
        return float(np.std(sample.draws[..., sample.names.index(name)], ddof=1))
    if fit is None or name not in fit.names:
        return float("nan")
    return fit.standard_errors[name]


def smoothing_certificate(target: LogPosterior, fit: PointFit) -> ResultTable:
    """Difference between a fit with the other engine and this fit, in posterior sd.

    One Gauss–Newton step maps the difference of the residuals of both engines through the Jacobian of this fit.
    """
    smooth = target.rig.model.engine == "smooth"
    engines = {"engine": "smoothed", **_other(target)} if smooth else {"engine": "exact", "other": "smoothed"}
    named = zip(target.located, *smoothing_shift(target, fit, None if smooth else Smoothing()), strict=True)
    rows = {target.names[i]: [d, s, d / s] for i, d, s in named if target.parameters[i].physical}
    frame = pd.DataFrame.from_dict(rows, orient="index", columns=["shift of u", "sd of u", "shift / sd"])
    return ResultTable("runs.smoothing", frame.rename_axis("parameter"), {**engines, **WIDTHS})


def smoothing_shift(target: LogPosterior, fit: PointFit, widths: Smoothing | None) -> tuple[np.ndarray, np.ndarray]:
    """Change of u, (d_located,), if this fit used the engine of ``widths`` (None: exact), by one step; and the sd of u."""
    own, jacobian = linearised(target, fit.u)
    normal = jacobian.T @ jacobian
    step = -np.linalg.solve(normal, jacobian.T @ (_residuals(_by_engine(target, widths), fit) - own))
    return step, np.sqrt(np.diag(np.linalg.inv(normal)))


def _other(target: LogPosterior) -> dict[str, str]:
    """The model that a fit with the smoothed engine is compared with, and what to do where they differ."""
    moved = [e for e in target.experiments if isinstance(e, SurfaceExperiment) and e.event_driven]
    if any(e.friction.contact is not None for e in moved):
        return {"other": "smoothed (a quarter of the widths)", "remedy": "do not quote them"}
    return {"other": "exact", "remedy": 'fit with engine = "exact" in [model] of rig.toml'}


def _by_engine(target: LogPosterior, widths: Smoothing | None) -> LogPosterior:
    return LogPosterior(target.rig, [e.with_smoothing(widths) for e in target.experiments])


def _residuals(target: LogPosterior, fit: PointFit) -> np.ndarray:
    """(n,) residuals at the point fit, in units of the noise."""
    return np.asarray(rows_of(target, jnp.asarray(fit.u[None])))[0]


def check_engine(sampled: SampledFit) -> list[Finding]:
    """Certificate of a fit with the smoothed engine: the largest shift of a parameter that the exact one would cause, sd.

    Where residuals have kinks, derivatives say little. The norm of the difference of the residuals bounds every shift.
    """
    target, fit = sampled.target, sampled.fit
    moved = [e for e in target.experiments if e.event_driven]
    if target.rig.model.engine == "exact" or not moved:
        return []
    if target.kinked:
        bound = np.linalg.norm(_residuals(_by_engine(target, None), fit) - _residuals(target, fit))
        shifts = {row.name: float(bound) for e in moved for row in e.parameters if row.physical}
    else:
        named = zip(target.located, *smoothing_shift(target, fit, None), strict=True)
        shifts = {target.names[i]: float(abs(d) / s) for i, d, s in named if target.parameters[i].physical}
    # A shift that is not finite fails.
    names = tuple(name for name, s in shifts.items() if not s <= SMALL_SHIFT)
    level = "ok" if not names else "warn" if all(s <= LARGE_SHIFT for s in shifts.values()) else "fail"
    found = {
        "largest": np.max(list(shifts.values())),
        "names": ", ".join(names),
        "wanted": SMALL_SHIFT,
    }
    return [Finding("model.engine", level, {**WIDTHS, **_other(target), **found}, parameters=names)]


# notes: Tables of the report: those of the experiments and those of the whole fit.


def make_notes(
    sampled: SampledFit, predictive: Mapping[str, float | None], profiled: Sequence[str] = ()
) -> list[ResultTable]:
    """Return all tables; a finding whose facts hold rows of ``alternatives``, models of the same readings, has one too.

    Tables that compare bench tests and runs need runs, and derivatives, which say little where residuals have kinks.

    Parameters
    ----------
    predictive : posterior predictive p-values by label; without a sample there is no such table
    profiled : names of the parameters whose profile likelihoods are computed
    """
    target, fit = sampled.target, sampled.fit
    of_runs, of_bench = (
        [table for maker in declared(sampled.experiments, "tables", bench) for table in maker(sampled)]
        for bench in (False, True)
    )
    compared = [
        ResultTable(found.code, pd.DataFrame(rows).set_index(next(iter(rows[0]))), found.facts)
        for found in sampled.findings
        if (rows := found.facts.get("alternatives"))
    ]
    kinked = target.kinked
    if any(not e.bench for e in sampled.experiments) and not kinked:
        gained = precision_gained(sampled)
        of_runs = [gained, *of_runs, smoothing_certificate(target, fit)]
    priors = [
        {"parameter": row.name, "unit": row.unit, "meaning": row.meaning, "prior (SI)": row.prior.describe()}
        for row in target.parameters
        if row.prior is not None
    ]
    tables = [*of_runs, *of_bench, *compared, *([] if kinked else share_table(target, fit))]
    tables += [*identified(target, fit), *profile_tables(target, fit, profiled)]
    tables.append(ResultTable("parameters.priors", pd.DataFrame(priors).set_index("parameter")))
    if sampled.draws:
        # Experiments on the shared friction panel have a p-value too.
        rows = {e.label: (e.kind, e.n, predictive[e.label]) for e in sampled.experiments}
        frame = pd.DataFrame.from_dict(rows, orient="index", columns=["kind", "readings", "p"])
        tables.append(ResultTable("readings.predictive", frame.rename_axis("experiment")))
    return tables


def share_table(target: LogPosterior, fit: PointFit) -> list[ResultTable]:
    """The two largest inputs of the variance of every physical parameter; [] for a fit without shares."""
    rows = {}
    for name in (row.name for row in target.parameters if row.physical and row.name in fit.shares):
        (first, share), (second, other), *_ = sorted(fit.shares[name].items(), key=lambda item: -item[1])
        rows[name] = [first, share, second, other]
    frame = pd.DataFrame.from_dict(
        rows, orient="index", columns=["largest input", "share", "second input", "share of it"]
    )
    return [ResultTable("parameters.shares", frame.round(3).rename_axis("parameter"))] * bool(rows)


# parameter table: The parameter table and the nuisance table of a result.


SUMMARY_COLUMNS = (
    "unit", "meaning", "value", "sd", "quote", "basis", "trust", "paper", "map", "standard_error", "mean", "median", "lower",
    "upper", "ess", "ess_bulk", "ess_tail", "rhat", "informed", "widening", "sd_unwidened", "lower_unwidened",
    "upper_unwidened", "not_in_sd", "largest_error",
)  # fmt: skip
#: Ratio of the arms of a 95 % interval about the median above which value ± sd does not describe it. A log-normal
#: distribution has it at a relative sd of 0.35.
LARGEST_SKEW = 2.0
#: Of a positive parameter whose 95 % interval ends differ by more than this factor, the readings give an upper limit alone:
#: the lower end is that of the prior, which cannot reach 0. An undamped record gives c such an interval.
UPPER_LIMIT = 30.0
#: Change of k1 and c of free decays by a clock that is wrong by 1 %, in per cent: k1 follows the square of the rate.
CLOCK = {"k1": 2.0, "c": 1.0}
#: Words for the errors of the instruments of bench tables, and the smallest change that is said, in per cent.
ERROR_WORDS, SMALLEST_EFFECT = {"gain": "gain", "offset": "zero"}, 0.05
#: Nodes of the average over a scatter: the inverse hyperbolic sine of their distance from the fit, in u, is even. Tables
#: with more rows show their scatter.
NODES, REACH = 400, 4.0


def parameter_tables(sampled: SampledFit, registry: Registry) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Return the tables of physical parameters and of nuisances; see ``Result``."""
    target, point, posterior = sampled.target, sampled.fit, sampled.posterior
    masses = {"m1": sampled.rig.m1, "m2": sampled.rig.m2}
    at_point = errors_over_scatters(target, point) if posterior is None else point.standard_errors
    paper = paper_estimates(target.experiments, registry)
    paper |= {name: mass.value for name, mass in masses.items() if mass is not None}
    known = informed(target, posterior, point)
    words, effects = trust_words(sampled, known), largest_errors(target, point)
    rows: list[tuple[Parameter, dict[str, object]]] = []
    for i, row in enumerate(target.parameters):
        entry: dict[str, Any] = {
            "unit": row.unit,
            "meaning": row.meaning,
            "paper": paper.get(row.name, np.nan),
            "value": point.values[row.name],
            "sd": at_point[row.name],
            "basis": "point",
            "trust": words[row.name],
            "map": point.values[row.name],
            "standard_error": at_point[row.name],
            "informed": bool(known[i]),
            "not_in_sd": " ".join(unstated_errors(target, row)),
            "largest_error": effects.get(row.name, ""),
        }
        if posterior is not None:
            draws = posterior.draws[..., i].ravel()
            lower, median, upper = np.quantile(draws, [0.025, 0.5, 0.975])
            entry |= {"value": median, "sd": np.std(draws, ddof=1), "basis": "sample"}
            entry |= {"mean": np.mean(draws), "median": median, "lower": lower, "upper": upper}
            entry |= {name: getattr(posterior, name)[i] for name in ("ess", "ess_bulk", "ess_tail", "rhat")}
        entry |= _widened(entry, sampled.widened.get(row.name), row.positive)
        entry |= _limited(entry) if row.positive else {}
        rows.append((row, {**entry, "quote": quote(entry, row.positive)}))
    for symbol in (symbol for symbol in masses if symbol in target.fixed):
        row, value = parameter(symbol), target.fixed[symbol]
        exact = {
            **dict.fromkeys(("value", "paper", "map"), value),
            **dict.fromkeys(("mean", "median", "lower", "upper") if posterior else (), value),
            "standard_error": 0.0,
            "sd": 0.0,
            "basis": "point" if posterior is None else "sample",
            "quote": "sd",
            "trust": "not judged" if posterior is None else "trusted",
            "unit": row.unit,
            "meaning": f"{row.meaning} (exact)",
            "informed": True,
            "not_in_sd": "",
            "largest_error": "",
        }
        rows.append((row, exact))
    physical, nuisances = (
        pd.DataFrame.from_dict({row.name: entry for row, entry in rows if row.physical == chosen}, orient="index")
        .reindex(columns=list(SUMMARY_COLUMNS))
        .rename_axis("name")
        for chosen in (True, False)
    )
    return physical, nuisances


def unstated_errors(target: LogPosterior, row: Parameter) -> list[str]:
    """Errors of instruments that move a physical parameter and that its sd does not contain."""
    measured = row.physical and not is_stated(row.name)
    own = [e for e in target.experiments if measured and any(other.name == row.name for other in e.parameters)]
    found = {word for e in own for word in e.unstated_errors(row.symbol)}
    return [word for word in INSTRUMENT_WORDS if word in found]


def largest_errors(target: LogPosterior, fit: PointFit) -> dict[str, str]:
    """The unstated error of 1 % of one instrument that moves each parameter most, and by how much, by name.

    One instrument reads the columns of one name in all bench tables and turning points. Its gain is wrong by 1 %, or its
    zero by 1 % of its largest reading. The change is one Gauss-Newton step from the fit, of parameters that these readings
    alone inform. The clock of decays counts too.
    """
    values, end, steps = target.mapping(target.theta(fit.u)), 0, dict[str, np.ndarray]()
    jacobian = linearised(target, fit.u)[1]
    inverse = np.nan_to_num(covariance(jacobian), posinf=0.0)  # without a covariance there is no step
    for e in target.experiments:
        own = e.local(values)
        before = np.asarray(e.residuals(own, np))
        rows, end = slice(end, end + len(before)), end + len(before)
        columns = e.table.columns.values() if isinstance(e, PointTest | TurningPoints) else ()
        for column in (column for column in columns if column.name != "time"):
            shifts = {"gain": column.values, "offset": np.full_like(column.values, np.max(np.abs(column.values)))}
            stated = column.instrument.errors if column.instrument else {}
            for error in (error for error in shifts if error not in stated):
                moved = e.with_readings({column.name: column.values + 0.01 * shifts[error]})
                step = 100.0 * inverse @ (jacobian[rows].T @ (np.asarray(moved.residuals(own, np)) - before))
                of_column = f"{ERROR_WORDS[error]} of {column.name}"
                steps[of_column] = steps.get(of_column, 0.0) + step
    words = dict[str, str]()
    for row in (row for row in target.parameters if row.physical and row.positive and not is_stated(row.name)):
        readers = [e for e in target.experiments if any(other.name == row.name for other in e.parameters)]
        index = target.located.tolist().index(target.names.index(row.name))
        known = all(isinstance(e, PointTest | TurningPoints) for e in readers)
        sizes = {error: abs(float(step[index])) for error, step in steps.items() if known}
        if row.symbol in CLOCK and "clock" in unstated_errors(target, row):
            sizes["clock"] = CLOCK[row.symbol]
        largest = max(sizes, key=lambda error: np.round(sizes[error], 6), default="")
        if largest and SMALLEST_EFFECT < sizes[largest] < np.inf:
            size = f"{sizes[largest]:.2g}" if sizes[largest] < 100.0 else "more than 100"
            words[row.name] = f"{size} %: {largest}"
    return words


def errors_over_scatters(target: LogPosterior, fit: PointFit) -> Mapping[str, float]:
    """Standard errors of ``fit``, with the variance of the rows of every table averaged over the posterior of its scatter.

    The most probable scatter of a few rows is too small: one row alone has none. Beside the likelihood at the fit, its
    posterior counts the degrees of freedom that the located parameters take: the trace of the table's hat matrix.
    """
    located, theta, end = target.located, target.theta(fit.u), 0
    # A copy: arrays of JAX cannot be changed.
    jacobian, x = linearised(target, fit.u)[1].copy(), np.linspace(-REACH, REACH, NODES)
    hat = np.sum(np.linalg.qr(jacobian)[0] ** 2, axis=1)
    for e in target.experiments:
        own = e.local(target.mapping(theta))
        rows, end = slice(end, end + e.n), end + np.size(e.residuals(own, np))
        symbol, *further = e.scatters
        if e.time_series or further or symbol is None or e.n > NODES:
            continue
        (misfit,) = e.misfits(own, np)
        index = target.names.index(next(row.name for row in e.parameters if row.symbol == symbol))
        u = fit.u[index] + np.sinh(x)
        variance = misfit.fixed_variance + (misfit.scale * np.exp(u)[:, None]) ** 2 * np.ones(e.n)
        density = misfit.log_density(np.exp(u), np) + target.priors.at(index, np).terms(u, np.exp(u), np)
        density += np.log(np.cosh(x)) + np.mean(0.5 * np.log(variance), axis=1) * np.sum(hat[rows])
        weight = np.exp(density - np.max(density))
        jacobian[rows] *= (misfit.at(own[symbol], np).sd / np.sqrt(weight @ variance / np.sum(weight)))[:, None]
    errors = np.sqrt(np.diag(covariance(jacobian))) * np.where(target.positive, theta, 1.0)[located]
    return {**fit.standard_errors, **{target.names[i]: float(sd) for i, sd in zip(located, errors, strict=True)}}


def _widened(entry: Mapping[str, Any], widening: Widening | None, positive: bool) -> dict[str, object]:
    """Columns with the error of the model; the ends of an interval move in u, so that they keep their sign."""
    if widening is None:
        return {}
    if widening.no_number:
        return {"widening": widening.factor, **dict.fromkeys(("value", "sd", "lower", "upper"), np.nan)}
    factor, value, stretch = widening.factor, entry["value"], widening.stretch
    moved = {
        end: value * (entry[end] / value) ** stretch if positive else value + stretch * (entry[end] - value)
        for end in ("lower", "upper")
        if end in entry
    }
    if widening.limits is not None:
        low, high = widening.limits
        factor = max(factor, (high - low) / (2.0 * QUANTILE_975 * entry["sd"]))
        if moved:
            moved = {"lower": min(low, moved["lower"]), "upper": max(high, moved["upper"])}
    before = {f"{key}_unwidened": entry[key] for key in ("sd", *moved)}
    return {"widening": factor, "sd": factor * entry["sd"], **before, **moved}


def _limited(entry: Mapping[str, Any]) -> dict[str, object]:
    """The lower end 0 where the readings give an upper limit alone."""
    return {"lower": 0.0} if "lower" in entry and entry["lower"] * UPPER_LIMIT < entry["upper"] else {}


def quote(entry: Mapping[str, Any], positive: bool) -> Literal["sd", "interval"]:
    """What describes a value beside it: its sd, or the 95 % interval of a skewed posterior.

    ± describes no posterior where 2 sd below a positive value are not positive, or where one arm of the interval is
    more than ``LARGEST_SKEW`` times as long as the other. Without a sample there is no interval to quote.
    """
    if "lower" not in entry or not np.isfinite(entry["value"]):
        return "sd"
    short, long = sorted((entry["value"] - entry["lower"], entry["upper"] - entry["value"]))
    outside = positive and entry["value"] <= 2.0 * entry["sd"]
    return "interval" if outside or long > LARGEST_SKEW * short else "sd"
