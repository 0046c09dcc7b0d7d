"""Forced runs through the whole fit: rigs with random truths, and rigs with something wrong planted in them."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import cast

import numpy as np
import pandas as pd

import capsule_id as cid
from capsule_id.api import read_rig
from capsule_id.experiments.kind import default_registry, make_experiments
from capsule_id.inference.checks.posterior import check_agreement
from capsule_id.inference.point_stage import SampledFit, fit_points
from capsule_id.inference.result import Posterior
from capsule_id.inference.target import LogPosterior
from capsule_id.synthetic import Truth, synthesize
from tests.inference.calibration import normal_score

#: Every parameter is off the paper's Table 1 by a factor between these two, or by its inverse.
NEAREST, FARTHEST = 1.1, 1.5
VARIED = ("k1", "c", "mu", "v_s", "K", "k2[soft]", "k2[medium]", "k2[stiff]", "k2[hard]")
#: What is wrong: the static test of a spring reads its force too high by this factor, the tilts are of another surface.
SPRING_FACTOR, SURFACE = 1.15, 0.1


@dataclass(frozen=True)
class Recovery:
    """One rig: z = Φ⁻¹(posterior CDF at the truth) of every physical parameter, failed checks, split R-hat and steps."""

    z: dict[str, float]
    failed: tuple[tuple[str, str], ...]
    rhat: float
    ess: float


def random_truth(rng: np.random.Generator) -> Truth:
    """Table 1 with every parameter of ``VARIED`` moved by 10 to 50 %, up or down."""
    table = Truth().with_kinds([default_registry()["forced_run"]])
    size = rng.uniform(np.log(NEAREST), np.log(FARTHEST), len(VARIED))
    factors = np.exp(size * rng.choice([-1.0, 1.0], len(VARIED)))
    return table.with_values({name: table[name] * f for name, f in zip(VARIED, factors, strict=True)})


def recover(folder: Path, seed: int, budget: int) -> Recovery:
    """Synthesize the rig of ``seed`` in ``folder`` and fit it, bench and runs."""
    truth = random_truth(np.random.default_rng([seed, 4]))
    synthesize(folder, seed, truth, runs=True)
    result = cid.fit(read_rig(folder), seed, budget=budget)
    known, posterior = truth, cast(Posterior, result.posterior)
    z = {name: normal_score(posterior, name, known[name]) for name in result.summary.index if name in known}
    failed = tuple((f.code, result.text(f)) for f in result.findings if f.level == "fail")
    return Recovery(z, failed, float(np.max(posterior.rhat)), float(np.min(posterior.ess)))


def plant_spring(folder: Path, spring: str) -> None:
    """The static test of ``spring`` reads its force too high."""
    _edit(
        folder / f"support_spring_{spring}.csv",
        lambda table: table.assign(**{"force [N]": SPRING_FACTOR * table["force [N]"]}),
    )


def plant_surface(folder: Path) -> None:
    """The tilts were made on another surface."""

    def other(table: pd.DataFrame) -> pd.DataFrame:
        mu = np.tan(np.deg2rad(table["angle [deg]"])) + SURFACE
        return table.assign(**{"angle [deg]": np.rad2deg(np.arctan(mu))})

    _edit(folder / "static_friction.csv", other)


def _edit(file: Path, change: Callable[[pd.DataFrame], pd.DataFrame]) -> None:
    change(pd.read_csv(file)).to_csv(file, index=False)


def named_by(stage: SampledFit) -> str:
    """The parameter that the check of bench against runs names; "" where it passes."""
    found = check_agreement(stage)[0]
    if found.level == "ok":
        return ""
    return found.facts["distances"][0][0]


def disagreement_of(folder: Path, seed: int, runs: Sequence[str] = ()) -> SampledFit:
    """The rig in ``folder`` fitted, bench and runs; of its ``runs`` only these, where named."""
    rig = read_rig(folder)
    kept = tuple(t for t in rig.tables if t.kind != "forced_run" or not runs or t.label in runs)
    rig = replace(rig, tables=kept)
    return fit_points(LogPosterior(rig, make_experiments(rig)), default_registry(), seed, sampled=True)
