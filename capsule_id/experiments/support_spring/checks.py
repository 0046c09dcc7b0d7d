"""Check of the cantilever law for support springs of stated length."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from scipy import stats

from capsule_id.experiments.checks.context import Fitted
from capsule_id.experiments.checks.refit import refit
from capsule_id.experiments.checks.series import LEVEL
from capsule_id.views import Finding

if TYPE_CHECKING:
    from capsule_id.experiments.support_spring.experiment import SupportSpring


def cantilever_exponent(
    length: np.ndarray, length_sd: np.ndarray, k2: np.ndarray, log_k2_sd: np.ndarray
) -> tuple[float, float, float]:
    """Estimate the exponent of k2 ~ L^p by weighted least squares on logarithms, its sd, and the p-value of p = -3.

    A cantilever has p = -3 (Euler–Bernoulli; clamped end, tip load). Arrays are (springs,). The error of the length
    is propagated with the exponent -3 of the hypothesis.
    """
    weight = 1.0 / (log_k2_sd**2 + (3.0 * length_sd / length) ** 2)
    x = np.log(length) - np.average(np.log(length), weights=weight)
    exponent = float(np.sum(weight * x * np.log(k2)) / np.sum(weight * x**2))
    sd = float(1.0 / np.sqrt(np.sum(weight * x**2)))
    return exponent, sd, float(2.0 * stats.norm.sf(abs(exponent + 3.0) / sd))


def check_cantilever(springs: "Sequence[SupportSpring]", fit: Fitted) -> list[Finding]:
    """Check k2 ~ L^-3 over the springs, where lengths are stated."""
    pairs = [(e, e.length) for e in springs if e.length is not None]
    if len({e.slope.name for e, _ in pairs}) < 2:
        return []
    estimates = [refit(e, e.local(fit.values), fit.flagged.get(e.label, []))["k2"] for e, _ in pairs]
    k2, sd = (np.array(column) for column in zip(*estimates, strict=True))
    length, length_sd = np.array([(quantity.value, quantity.sd) for _, quantity in pairs]).T
    exponent, error, p = cantilever_exponent(length, length_sd, k2, sd / k2)
    facts = {"exponent": exponent, "sd": error, "p": p}
    if p >= LEVEL or exponent <= 0.0:
        return [Finding("springs.cantilever", "warn" if p < LEVEL else "ok", facts)]
    order = [pairs[i][0] for i in np.argsort(length)]
    facts |= {"shortest": order[0].label, "longest": order[-1].label}
    names = dict.fromkeys(e.slope.name for e in order)
    return [Finding("springs.cantilever", "fail", facts, parameters=tuple(names))]
