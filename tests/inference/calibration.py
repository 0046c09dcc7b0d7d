"""Scores of fits of synthetic rigs, and what they say of intervals and verdicts; bench rigs: ``capsule-id calibrate``."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats

from capsule_id.inference.result import Posterior


@dataclass(frozen=True)
class Outcome:
    """One rig: z = Φ⁻¹(posterior CDF at the truth) of every physical parameter; code and experiment of failed checks."""

    z: dict[str, float]
    failed: tuple[tuple[str, str], ...]

    @property
    def clean(self) -> bool:
        return not self.failed


@dataclass(frozen=True)
class Calibration:
    """What a study says of the intervals and of the verdict."""

    coverage: float
    sd: float
    mean: float
    clean: float
    numbers: int

    def describe(self) -> str:
        """One line of figures."""
        return (
            f"{self.numbers} numbers: 95 % intervals cover {100 * self.coverage:.1f} %, z has mean {self.mean:+.3f} and "
            f"sd {self.sd:.3f}; clean verdict in {100 * self.clean:.0f} %"
        )


def normal_score(posterior: Posterior, name: str, truth: float) -> float:
    """Φ⁻¹ of the posterior's CDF at ``truth``; half a draw from the ends, so that it stays finite."""
    draws = posterior.draws[..., posterior.names.index(name)].ravel()
    below = (np.count_nonzero(draws < truth) + 0.5) / (draws.size + 1.0)
    return float(stats.norm.ppf(below))


def summarise(outcomes: Sequence[Outcome]) -> Calibration:
    """Figures over all rigs and all parameters."""
    z = np.array([value for outcome in outcomes for value in outcome.z.values()])
    inside = np.abs(z) < stats.norm.ppf(0.975)
    clean = np.mean([outcome.clean for outcome in outcomes])
    return Calibration(float(np.mean(inside)), float(np.std(z)), float(np.mean(z)), float(clean), z.size)
