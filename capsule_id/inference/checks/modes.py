"""Maximum of the posterior against its sample: distance, several modes, starts that ended at other maxima.

Residual checks and curves are those of the maximum, the quoted number is the median of the sample. Both must describe
the same part of the posterior.
"""

from itertools import pairwise

import numpy as np
from scipy.ndimage import gaussian_filter1d

from capsule_id.inference.checks.sampled_fit import SampledFit
from capsule_id.inference.result import PointFit, Posterior
from capsule_id.inference.target.log_posterior import LogPosterior
from capsule_id.views import Finding

#: Largest distance of the maximum from the median, in standard deviations of u (68 % quantiles). The mode of an
#: exponential density is 0.8 from its median.
FARTHEST_MAXIMUM = 3.0
#: Smallest weight of a mode, and largest density of the valley between two modes relative to the lower one.
SMALLEST_MODE, DEEPEST_VALLEY = 0.05, 0.5
#: Number of bins of a marginal density, over its central 99.9 %.
BINS = 256
#: A maximum this far below the best one in log-posterior holds negligible mass, with a converged sample and without.
NEGLIGIBLE, NEGLIGIBLE_UNSAMPLED = 4.0, 20.0


def check_maximum(s: SampledFit) -> list[Finding]:
    """Check that the sample of every physical parameter has one mode, at the maximum of the posterior."""
    if s.posterior is None:
        return []
    findings = []
    u = s.target.unconstrain(s.posterior.draws.reshape(-1, len(s.posterior.names)))
    for i, row in enumerate(s.target.parameters):
        if not row.physical:
            continue
        facts = {"name": row.name, "key": row.prior_key, "unit": row.unit, "maximum": s.values[row.name]}
        low, median, high = np.quantile(u[:, i], [0.15865, 0.5, 0.84135])
        # A weighed constant with an sd of rounding size has no spread to compare with.
        distance = float(abs(s.fit.u[i] - median) / max(0.5 * (high - low), 1e-12))
        found = modes(u[:, i], float(s.posterior.ess[i]))
        if len(found) > 1:
            centres = np.exp([c for c, _ in found]) if row.positive else np.array([c for c, _ in found])
            facts |= {"modes": list(zip(centres.tolist(), (w for _, w in found), strict=True))}
            findings.append(Finding("sample.modes", "fail", facts, parameters=_block(s, i)))
        elif distance > FARTHEST_MAXIMUM:
            values = s.posterior.draws[..., i]
            facts |= {"median": np.median(values), "sd": np.std(values), "distance": distance}
            findings.append(Finding("sample.maximum", "fail", facts, parameters=_block(s, i)))
    return findings or [Finding("sample.maximum", "ok")]


def _block(s: SampledFit, i: int) -> tuple[str, ...]:
    """Names of the parameters that share data with parameter ``i``, itself first."""
    (block,) = [block for block in s.target.blocks if i in block]
    return (s.target.names[i], *(s.target.names[j] for j in block if j != i and s.target.parameters[j].physical))


def modes(u: np.ndarray, size: float) -> list[tuple[float, float]]:
    """Centre and weight of every mode of draws ``u`` (n,) with effective sample ``size``, in ascending order.

    A kernel estimate of the density is divided at its valleys (Silverman 1986, section 3.4, bandwidth). Two modes
    count as one where the valley is shallower than ``DEEPEST_VALLEY`` or one of them is lighter than ``SMALLEST_MODE``.
    """
    low, high = np.quantile(u, [0.0005, 0.9995])
    if not high > low:
        return [(float(np.median(u)), 1.0)]
    count, edges = np.histogram(u, BINS, (low, high))
    spread = min(float(np.std(u)), float(np.subtract(*np.quantile(u, [0.75, 0.25]))) / 1.34)
    # The size is NaN where a walker never moved; the bandwidth is then that of few draws.
    bandwidth = 0.9 * spread * max(10.0, size) ** -0.2 / (edges[1] - edges[0])
    density = gaussian_filter1d(count.astype(float), max(bandwidth, 1.0), mode="constant")
    # Each mode is a range of bins; ranges merge until every valley is deep and every mode has weight.
    inner = np.flatnonzero((density[1:-1] <= density[:-2]) & (density[1:-1] < density[2:])) + 1
    cuts = [0, *inner.tolist(), BINS]
    while len(cuts) > 2:
        parts = [slice(a, b) for a, b in pairwise(cuts)]
        weight = np.array([np.sum(count[part]) for part in parts]) / np.sum(count)
        peak = np.array([np.max(density[part]) for part in parts])
        # A range without draws has no peak; it merges because it has no weight.
        depth = density[cuts[1:-1]] / np.maximum(np.minimum(peak[:-1], peak[1:]), np.finfo(float).tiny)
        light = np.minimum(weight[:-1], weight[1:]) < SMALLEST_MODE
        worst = int(np.argmax(np.where(light, 2.0, depth)))
        if not light[worst] and depth[worst] < DEEPEST_VALLEY:
            break
        del cuts[worst + 1]
    found = []
    for a, b in pairwise(cuts):
        inside = (u >= (edges[a] if a else -np.inf)) & (u < (edges[b] if b < BINS else np.inf))
        found.append((float(np.median(u[inside])), float(np.mean(inside))))
    return found


def check_starts(fit: PointFit, target: LogPosterior | None = None, sample: Posterior | None = None) -> list[Finding]:
    """Check that every start of the point fit ends at the same maximum, or at one with negligible mass.

    A start that stalls at the maximum that another one found counts as agreeing: rounding stops the solver there.

    Parameters
    ----------
    target, sample : a converged sample shows the mass of other maxima
    """
    facts = {"starts": len(fit.starts), "stalled": int(fit.stalled.sum()), "elsewhere": int(fit.at_other_maximum.sum())}
    if fit.agree:
        return [Finding("starts.agree", "fail" if fit.stalled.all() else "ok", facts)]
    distance = np.abs(fit.ends - fit.u) / np.sqrt(np.diag(fit.covariance))
    away = np.where(np.isfinite(distance), distance, np.inf).max(axis=1)
    worst = int(np.argmax(np.where(fit.at_other_maximum, away, -np.inf)))
    below = np.max(fit.log_posterior) - np.where(np.isfinite(fit.log_posterior), fit.log_posterior, -np.inf)
    facts |= {"distance": away[worst], "name": fit.names[int(np.argmax(distance[worst]))]}
    facts |= {"below": float(np.min(below[fit.at_other_maximum]))}
    if target is not None and sample is not None and sample.converged:
        u = target.unconstrain(sample.draws.reshape(-1, len(sample.names)))
        low, high = np.min(u, axis=0), np.max(u, axis=0)
        seen = np.all((fit.ends >= low) & (fit.ends <= high), axis=1)
        harmless = bool(np.all((seen | (below > NEGLIGIBLE))[fit.at_other_maximum]))
    else:
        # A local maximum far below the best one in log-posterior holds no posterior mass.
        harmless = bool(np.all(below[fit.at_other_maximum] > NEGLIGIBLE_UNSAMPLED))
        harmless = harmless and np.sum(~fit.at_other_maximum) >= 2
    return [Finding("starts.agree", "warn" if harmless else "fail", facts)]
