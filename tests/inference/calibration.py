"""Calibration in the small: synthetic rigs with random truths through the whole code, and what came out of each."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import cast

import numpy as np
from scipy import stats

import capsule_id as cid
from capsule_id.api import read_rig
from capsule_id.inference.result import Posterior, Result
from capsule_id.inference.sampling import DEFAULT_BUDGET
from capsule_id.synthetic import Truth, synthesize

#: Truths are log-uniform within this factor of the paper's Table 1.
RANGE = 1.3
VARIED = ("k1", "c", "mu", "v_s", "K", "k2[soft]", "k2[medium]", "k2[stiff]")


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


def random_truth(rng: np.random.Generator) -> Truth:
    """Table 1 with every parameter of ``VARIED`` moved by a factor, log-uniform in 1/RANGE .. RANGE."""
    table = Truth()
    factors = np.exp(np.log(RANGE) * rng.uniform(-1.0, 1.0, len(VARIED)))
    return Truth().with_values({name: table[name] * f for name, f in zip(VARIED, factors, strict=True)})


def normal_score(posterior: Posterior, name: str, truth: float) -> float:
    """Φ⁻¹ of the posterior's CDF at ``truth``; half a draw from the ends, so that it stays finite."""
    draws = posterior.draws[..., posterior.names.index(name)].ravel()
    below = (np.count_nonzero(draws < truth) + 0.5) / (draws.size + 1.0)
    return float(stats.norm.ppf(below))


def outcome_of(result: Result, truth: Truth) -> Outcome:
    """Scores of all physical parameters that were sampled, and the checks that failed."""
    known, posterior = truth, cast(Posterior, result.posterior)
    z = {name: normal_score(posterior, name, known[name]) for name in result.summary.index}
    return Outcome(z, tuple((f.code, f.experiment) for f in result.findings if f.level == "fail"))


def study(folder: Path, seeds: Sequence[int], budget: int = DEFAULT_BUDGET) -> Iterator[Outcome]:
    """One rig per seed: its truth, its readings and its chains all follow from that seed."""
    for seed in seeds:
        truth = random_truth(np.random.default_rng([seed, 0]))
        rig = folder / f"rig_{seed}"
        synthesize(rig, seed, truth)
        yield outcome_of(cid.fit(read_rig(rig), seed, budget=budget), truth)


def summarise(outcomes: Sequence[Outcome]) -> Calibration:
    """Figures over all rigs and all parameters."""
    z = np.array([value for outcome in outcomes for value in outcome.z.values()])
    inside = np.abs(z) < stats.norm.ppf(0.975)
    clean = np.mean([outcome.clean for outcome in outcomes])
    return Calibration(float(np.mean(inside)), float(np.std(z)), float(np.mean(z)), float(clean), z.size)
