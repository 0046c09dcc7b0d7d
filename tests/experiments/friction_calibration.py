"""Calibration of friction tests under misfit: another ratio of kinetic to static friction, and trials in sessions.

Run as a script for a study: ``python -m tests.experiments.friction_calibration NUMBER [FIRST_SEED]``.
"""

from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

import capsule_id as cid
from tests.experiments.misfit_study import study
from tests.measured.folders import Entry, make_rig

#: Misfits: kinetic over static friction 0.8, with the default law and with the free ratio; trials in sessions, of
#: session sd 10 %.
MISFITS = ("ratio, eq. (1)", "ratio, free", "sessions")
MU, V_S, RATIO, SCATTER = 0.66, 0.3, 0.8, 0.03
SPEED = np.geomspace(5e-3, 2.0, 30)


@dataclass(frozen=True)
class Outcome:
    """Result of one twin: errors of the logarithms in units of their sd, whether no check failed, and the sd of mu."""

    misfit: str
    seed: int
    z: tuple[float, ...]
    clean: bool
    sd: float


def entry(misfit: str, seed: int) -> Entry:
    """The table of one twin."""
    rng = np.random.default_rng([seed, MISFITS.index(misfit) > 1])
    if misfit == "sessions":
        mu = MU * np.exp(0.1 * np.repeat(rng.standard_normal(6), 5) + SCATTER * rng.standard_normal(30))
        return Entry("static_friction", "t", {"angle [deg]": np.rad2deg(np.arctan(mu))})
    coefficient = (
        MU * (RATIO + (1.0 - RATIO) * np.exp(-SPEED / V_S)) * np.exp(SCATTER * rng.standard_normal(len(SPEED)))
    )
    return Entry("sliding_friction", "t", {"speed [m/s]": SPEED, "coefficient [1]": coefficient})


def outcome(misfit: str, seed: int) -> Outcome:
    """Fit the twin without a sample."""
    with TemporaryDirectory() as name:
        rig = make_rig(Path(name), entry(misfit, seed))
        if misfit == "ratio, free":
            toml = Path(name) / "rig.toml"
            toml.write_text(toml.read_text(encoding="utf-8") + '\n[model]\nfree = ["ratio"]\n', encoding="utf-8")
            rig = cid.read_rig(name)
        result = cid.fit(rig, budget=None)
    truth = {"mu": MU, **({} if misfit == "sessions" else {"v_s": V_S})}
    rows = result.summary.loc[list(truth)]
    # Both are sampled through their logarithms, in which the posterior is nearly normal.
    z = np.log(rows["value"] / list(truth.values())) / (rows["sd"] / rows["value"])
    return Outcome(misfit, seed, tuple(float(one) for one in z), result.clean, float(rows.at["mu", "sd"]))


if __name__ == "__main__":
    study(MISFITS, outcome)
