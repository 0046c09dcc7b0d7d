"""The parameter table and the nuisance table of a result."""

from collections.abc import Mapping
from typing import Any, Literal

import numpy as np
import pandas as pd

from capsule_id.experiments import paper_estimates
from capsule_id.experiments.registry import Registry
from capsule_id.inference.checks.model_error.widening import Widening
from capsule_id.inference.checks.sampled_fit import SampledFit
from capsule_id.inference.checks.trust import trust_words
from capsule_id.inference.checks.verdict import informed
from capsule_id.inference.fit.covariance import covariance
from capsule_id.inference.fit.point_fit import residual_jacobian
from capsule_id.inference.result import PointFit, Posterior
from capsule_id.inference.target.log_posterior import LogPosterior
from capsule_id.parameters import Parameter, parameter

SUMMARY_COLUMNS = (
    "unit", "meaning", "value", "sd", "quote", "basis", "trust", "paper", "map", "standard_error", "mean", "median", "lower",
    "upper", "ess", "ess_bulk", "ess_tail", "rhat", "informed", "widening", "sd_unwidened", "lower_unwidened",
    "upper_unwidened",
)  # fmt: skip
#: Ratio of the arms of a 95 % interval about the median above which value ± sd does not describe it. A log-normal
#: distribution has it at a relative sd of 0.35.
LARGEST_SKEW = 2.0
#: Of a positive parameter whose 95 % interval ends differ by more than this factor, the readings give an upper limit alone:
#: the lower end is that of the prior, which cannot reach 0. An undamped record gives c such an interval.
UPPER_LIMIT = 30.0
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
    words = trust_words(sampled, known)
    rows: list[tuple[Parameter, dict[str, object]]] = []
    for i, row in enumerate(target.parameters):
        entry: dict[str, object] = {
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
        }
        entry |= {} if posterior is None else _sample_columns(posterior, i)
        entry |= _widened(entry, sampled.widened.get(row.name), row.positive)
        entry |= _limited(entry) if row.positive else {}
        rows.append((row, {**entry, "quote": quote(entry, row.positive)}))
    for symbol in (symbol for symbol in masses if symbol in target.fixed):
        row, value = parameter(symbol), target.fixed[symbol]
        exact = dict.fromkeys(("value", "paper", "map", "mean", "median", "lower", "upper"), value)
        errors = {"standard_error": 0.0, "sd": 0.0}
        said = {
            "basis": "point" if posterior is None else "sample",
            "quote": "sd",
            "trust": "not judged" if posterior is None else "trusted",
        }
        entry = {"unit": row.unit, "meaning": f"{row.meaning} (exact)", "informed": True, **exact, **errors, **said}
        rows.append((row, entry))
    physical, nuisances = (
        pd.DataFrame.from_dict({row.name: entry for row, entry in rows if row.physical == chosen}, orient="index")
        .reindex(columns=list(SUMMARY_COLUMNS))
        .rename_axis("name")
        for chosen in (True, False)
    )
    return physical, nuisances


def errors_over_scatters(target: LogPosterior, fit: PointFit) -> Mapping[str, float]:
    """Standard errors of ``fit``, with the variance of the rows of every table averaged over the posterior of its scatter.

    The most probable scatter of a few rows is too small: one row alone has none. Beside the likelihood at the fit, its
    posterior counts the degrees of freedom that the located parameters take: the trace of the table's hat matrix.
    """
    located, theta, end = target.located, target.theta(fit.u), 0
    jacobian, x = residual_jacobian(target, fit.u)[:, located], np.linspace(-REACH, REACH, NODES)
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
    matrix = covariance(jacobian, np.zeros(len(jacobian)), residual_sd=1.0)
    errors = matrix.standard_errors * np.where(target.positive, theta, 1.0)[located]
    return {**fit.standard_errors, **{target.names[i]: float(sd) for i, sd in zip(located, errors, strict=True)}}


def _widened(entry: Mapping[str, Any], widening: Widening | None, positive: bool) -> dict[str, object]:
    """Columns with the error of the model; the ends of an interval move in u, so that they keep their sign."""
    if widening is None:
        return {}
    if widening.no_number:
        return {"widening": widening.factor, **dict.fromkeys(("value", "sd", "lower", "upper"), np.nan)}
    found: dict[str, object] = {
        "widening": widening.factor,
        "sd": widening.factor * entry["sd"],
        "sd_unwidened": entry["sd"],
    }
    for end in ("lower", "upper"):
        if end in entry:
            value, limit, stretch = entry["value"], entry[end], widening.stretch
            moved = value * (limit / value) ** stretch if positive else value + stretch * (limit - value)
            found |= {end: moved, f"{end}_unwidened": limit}
    return found


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


def _sample_columns(posterior: Posterior, i: int) -> dict[str, object]:
    draws = posterior.draws[..., i].ravel()
    lower, median, upper = np.quantile(draws, [0.025, 0.5, 0.975])
    return {
        "value": median,
        "sd": np.std(draws, ddof=1),
        "basis": "sample",
        "mean": np.mean(draws),
        "median": median,
        "lower": lower,
        "upper": upper,
        "ess": posterior.ess[i],
        "ess_bulk": posterior.ess_bulk[i],
        "ess_tail": posterior.ess_tail[i],
        "rhat": posterior.rhat[i],
    }
