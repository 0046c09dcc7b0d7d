"""Support spring: static force against deflection (paper, section 2.2), and the cantilever law between springs."""

import numpy as np
from scipy import stats

from capsule_id.experiments.line import Line
from capsule_id.parameters import parameter
from capsule_id.rig.model import Quantity, Rig, Table


class SupportSpring(Line):
    """F = F0 + k2[spring] x."""

    def __init__(self, table: Table, rig: Rig) -> None:
        self.spring = table.settings.spring
        super().__init__(table, rig, "deflection", "force", parameter("k2", self.spring))

    @property
    def length(self) -> Quantity | None:
        """Free length of the cantilever, m, where stated."""
        return self.table.settings.length


def cantilever_exponent(
    length: np.ndarray, length_sd: np.ndarray, k2: np.ndarray, log_k2_sd: np.ndarray
) -> tuple[float, float, float]:
    """Exponent of k2 ~ L^p by weighted least squares on logarithms, its sd, and the p-value of p = -3.

    A cantilever has p = -3 (Euler–Bernoulli; clamped end, tip load). Arrays are (springs,); the error of the length
    counts with the exponent -3 of the hypothesis.
    """
    weight = 1.0 / (log_k2_sd**2 + (3.0 * length_sd / length) ** 2)
    x = np.log(length) - np.average(np.log(length), weights=weight)
    exponent = float(np.sum(weight * x * np.log(k2)) / np.sum(weight * x**2))
    sd = float(1.0 / np.sqrt(np.sum(weight * x**2)))
    return exponent, sd, float(2.0 * stats.norm.sf(abs(exponent + 3.0) / sd))
