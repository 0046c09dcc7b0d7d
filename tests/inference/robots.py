"""Synthetic robots with random truths: what their intervals cover, and which wrong laws a comparison finds."""

import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple, cast

import numpy as np

import capsule_id as cid
from capsule_id.api import read_rig
from capsule_id.inference.compare import Choice, compare_points
from capsule_id.inference.result import Posterior
from capsule_id.inference.sampling import DEFAULT_BUDGET
from capsule_id.synthetic import ROBOT, RobotDesign
from tests.inference.calibration import Outcome, normal_score

#: Truths are log-uniform within this factor of the robot's twin.
RANGE = 1.3
VARIED = ("k1", "c", "mu", "v_s", "P_on", "lag")
#: Scale of the half-normal prior of ``session_sd``, and the twin's scatter, m.
SESSION_PRIOR, TRIAL_SD = 0.1, 5e-4


class WrongLaw(NamedTuple):
    """Lines of ``[model]`` that are wrong for the twin, words that compare them with others, and the right variant."""

    model: str
    words: tuple[str, ...]
    right: str


WRONG_LAWS = {
    "asymmetry": WrongLaw('reaction = "capsule"\nfree = ["ratio", "lag"]', ("friction",), "direction"),
    "lag": WrongLaw('reaction = "capsule"\nfree = ["ratio"]', ("lag",), "free lag"),
    "reaction": WrongLaw('reaction = "ground"\nfree = ["ratio", "lag"]', ("reaction",), "reaction on the capsule"),
}
#: Friction backwards over friction forwards of a robot with asymmetry, or its inverse.
ASYMMETRY = 1.15


def random_robot(rng: np.random.Generator, periods: np.ndarray) -> tuple[RobotDesign, dict[str, float]]:
    """Design with two sessions whose sd is a draw of its prior, and parameters; the coil pushes either way first."""
    factors = np.exp(np.log(RANGE) * rng.uniform(-1.0, 1.0, len(VARIED)))
    values = {name: ROBOT[name] * f for name, f in zip(VARIED, factors, strict=True)}
    values["P_on"] *= rng.choice([-1.0, 1.0])
    session_sd = abs(rng.normal(0.0, SESSION_PRIOR))
    return RobotDesign(periods, np.full(len(periods), 0.3), session_sd=session_sd, trial_sd=TRIAL_SD), values


def study(
    folder: Path, seeds: Sequence[int], periods: np.ndarray, budget: int = DEFAULT_BUDGET, ess: float = 400.0
) -> Iterator[Outcome]:
    """One robot per seed: its truth, its readings and its chains all follow from that seed.

    The discrepancy of a twin is 0, the end of its prior, which no central interval holds: it has no score.
    """
    for seed in seeds:
        design, values = random_robot(np.random.default_rng([seed, 0]), periods)
        rig = folder / f"robot_{seed}"
        cid.synthesize_robot(rig, seed, design, values)
        truth = json.loads((folder / f"robot_{seed}.truth.json").read_text(encoding="utf-8"))["parameters"]
        truth |= {"trial_scatter": design.trial_scatter, "trial_sd[progression]": TRIAL_SD}
        result = cid.fit(read_rig(rig), seed, budget=budget, ess=ess)
        posterior = cast(Posterior, result.posterior)
        z = {name: normal_score(posterior, name, truth[name]) for name in posterior.names if name in truth}
        yield Outcome(z, tuple((f.code, f.experiment) for f in result.findings if f.level == "fail"))


def found_by_points(folder: Path, law: str, seed: int, periods: np.ndarray) -> tuple[Choice, dict[str, float]]:
    """Comparison of the variants of a wrong law by point fits, on a random robot, and its true values."""
    rng = np.random.default_rng([seed, 0])
    design, values = random_robot(rng, periods)
    if law == "asymmetry":
        values["mu_back"] = values["mu"] * (ASYMMETRY if rng.uniform() < 0.5 else 1.0 / ASYMMETRY)
    if law == "lag":
        values["lag"] = ROBOT["lag"]
    rig, wrong = folder / f"{law}_{seed}", WRONG_LAWS[law]
    cid.synthesize_robot(rig, seed, design, values, model=wrong.model)
    return compare_points(read_rig(rig), wrong.words, seed=seed), {**ROBOT, **values}
