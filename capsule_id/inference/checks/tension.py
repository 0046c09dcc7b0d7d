"""Likelihood-ratio test of a parameter that two groups of experiments share (friction: tilts and slides)."""

from collections.abc import Sequence

import numpy as np
from scipy import stats
from scipy.optimize import minimize

from capsule_id.experiments.base import Experiment
from capsule_id.experiments.checks.context import Tension
from capsule_id.inference.target.log_posterior import LogPosterior
from capsule_id.rig.model import Rig


def tension(rig: Rig, one: Sequence[Experiment], other: Sequence[Experiment]) -> Tension:
    """Likelihood-ratio test that two groups of experiments share their parameters (one shared parameter: mu).

    Priors regularise both fits (a scatter from four trials needs one). They enter without their normalisation, so that
    a second copy of a vague prior does not change the statistic.
    """
    joint, *apart = (_maximum(LogPosterior(rig, group)) for group in ([*one, *other], one, other))
    statistic = max(2.0 * (apart[0][0] + apart[1][0] - joint[0]), 0.0)
    return Tension(statistic, float(stats.chi2.sf(statistic, 1)), apart[0][1], apart[1][1])


def _maximum(target: LogPosterior) -> tuple[float, dict[str, float]]:
    """Largest penalised log-likelihood and its parameters, by name; NumPy suffices for a few readings."""
    proposed = target.starts()
    start = target.unconstrain(np.array([proposed[name].centre for name in target.names]))
    # The masses change only a steady force here, so they keep their measured values.
    free = np.array([row.symbol not in ("m1", "m2") for row in target.parameters])

    def objective(v: np.ndarray) -> float:
        u = start.copy()
        u[free] = v
        values = target.mapping(target.theta(u))
        likelihood = sum(float(e.log_likelihood(e.local(values), np)) for e in target.experiments)
        penalty = 0.5 * float(np.sum(target.prior_residuals(u)[free] ** 2))
        return penalty - likelihood

    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        best = minimize(objective, start[free], method="BFGS", options={"gtol": 1e-6})
    u = start.copy()
    u[free] = best.x
    return -float(best.fun), target.mapping(target.theta(u))
