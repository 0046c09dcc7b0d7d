"""Conflict of a stated prior, a weighing or a default prior with the rest of the data.

Without the prior N(c, w²) of a parameter x with posterior N(x, S) the remaining data give the estimate
c + (x - c)/(1 - S/w²) with variance S/(1 - S/w²). Its distance from the prior is z = (x - c)/sqrt(w² - S), standard
normal where prior and data agree (Evans & Moshonov 2006). x is the logarithm where the prior is log-normal.
"""

import math
from dataclasses import asdict, dataclass

import numpy as np
from scipy import stats

from capsule_id.experiments.checks.series import LEVEL
from capsule_id.experiments.lint_magnitudes import WRONG_PREFIX
from capsule_id.inference.checks.sampled_fit import SampledFit
from capsule_id.inference.target.priors import prior_of
from capsule_id.parameters import Parameter, is_stated
from capsule_id.views import Finding

#: Smallest part of a prior's variance that the data count as removing: below, rounding of the sample decides.
SMALLEST_REDUCTION = 0.2
#: A parameter this many widths from the centre of its prior is pulled by it. A scatter is then too small, and so is every
#: sd that it gives.
PRIOR_PULL = 2.5


@dataclass(frozen=True)
class Conflict:
    """Distance of a prior from the rest of the data.

    Attributes
    ----------
    z : distance in sd, standard normal where both agree
    value, sd : estimate from the rest of the data, SI
    informed : fraction of the prior's variance that the data remove; near 0 the estimate is unreliable
    """

    z: float
    value: float
    sd: float
    informed: float


def conflicts(s: SampledFit) -> dict[str, Conflict]:
    """Distance of the priors of physical parameters and scatters, and of every stated one, by name.

    A scatter far above its prior is one by which the fit explains what its law does not; one below is harmless.
    """
    centre, sd = _location(s)
    found = {}
    for i, row in enumerate(s.target.parameters):
        if not (row.physical or row.scatter or row.name in s.rig.priors):
            continue
        prior = s.target.priors.at(i, np)
        middle, width = float(prior.centre), float(prior.width)
        informed = max(1.0 - float(sd[i] / width) ** 2, SMALLEST_REDUCTION)
        alone, alone_sd = middle + (centre[i] - middle) / informed, sd[i] / np.sqrt(informed)
        value, scale = (np.exp(alone), np.exp(alone)) if prior.lognormal else (alone, 1.0)
        z = (centre[i] - middle) / (width * np.sqrt(informed))
        if default_scatter(s, row):
            z = max(z, 0.0)
        found[row.name] = Conflict(float(z), float(value), float(scale * alone_sd), informed)
    return found


def default_scatter(s: SampledFit, row: Parameter) -> bool:
    """Whether ``row`` is a scatter without a stated prior."""
    return row.scatter and row.name not in s.rig.priors


def in_doubt(s: SampledFit) -> set[str]:
    """Names of the parameters with an unusual scale: a wrong unit explains them, so no other prior is proposed."""
    return {name for finding in s.findings if "scales" in finding.facts for name in finding.parameters}


def check_priors(s: SampledFit) -> list[Finding]:
    """Check every stated prior, weighing and default prior of a physical parameter against the rest of the data."""
    findings = []
    found = conflicts(s)
    scatters = {row.name for row in s.target.parameters if default_scatter(s, row)}
    for name, conflict in found.items():
        p = float(2.0 * stats.norm.sf(abs(conflict.z)))
        if p * len(found) < LEVEL or (name in scatters and conflict.z > PRIOR_PULL):
            findings.append(_finding(s, name, conflict, p))
    return findings or [Finding("priors.conflict", "ok", {"number": len(found)})]


def _location(s: SampledFit) -> tuple[np.ndarray, np.ndarray]:
    """(d,) posterior location and sd of every parameter, in the variable of its prior."""
    lognormal = np.asarray(s.target.priors.lognormal)
    if s.posterior is None:
        value, sd = s.target.theta(s.fit.u), np.sqrt(np.diag(s.fit.covariance))
        return np.where(lognormal, s.fit.u, value), sd * np.where(lognormal | ~s.target.positive, 1.0, value)
    draws = s.posterior.draws.reshape(-1, len(s.posterior.names))
    x = np.where(lognormal, s.target.unconstrain(draws), draws)
    return np.median(x, axis=0), np.std(x, axis=0)


def _finding(s: SampledFit, name: str, conflict: Conflict, p: float) -> Finding:
    """The conflict of parameter ``name``; it concerns all parameters of the experiments that read it."""
    (row,) = [row for row in s.target.parameters if row.name == name]
    readers = [e for e in s.experiments if name in e.masses or name in {own.name for own in e.parameters}]
    prior = prior_of(row)
    unit = (
        name in s.rig.priors
        and prior.kind == "lognormal"
        and abs(abs(math.log10(conflict.value / prior.median)) - 3.0) < WRONG_PREFIX
    )
    facts = {
        "name": name,
        "key": "" if is_stated(name) or unit or name in in_doubt(s) else row.prior_key,
        "is_unit": unit,
        "unit": "" if row.unit == "1" else f" {row.unit}",
        "prior": prior.describe(),
        "stated": "rig" if is_stated(name) else "prior" if name in s.rig.priors else "scatter" if row.scatter else "",
        "experiments": ", ".join(dict.fromkeys(e.table.label for e in readers)),
        "fitted": s.values[name],
        "p": p,
        **asdict(conflict),
    }
    names = dict.fromkeys([name, *(own.name for e in readers for own in e.parameters)])
    return Finding("priors.conflict", "fail", facts, parameters=tuple(names))
