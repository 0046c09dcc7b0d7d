"""Synthetic progressions of a capsule robot with known truth: pulses of a coil inside the capsule, no support spring."""

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from capsule_id.errors import InputError
from capsule_id.parameters import TABLE
from capsule_id.physics.displacement import displacement
from capsule_id.physics.drives import Pulses
from capsule_id.physics.friction import friction_law, scaled
from capsule_id.physics.model import CapsuleParameters

#: Values of the robot's twin, SI; its coil pushes towards -x.
ROBOT: Mapping[str, float] = {
    "m1": 0.074, "m2": 0.193, "k1": 250.0, "c": 0.4, "mu": 0.28, "v_s": 0.1, "ratio": 0.8, "mu_back": 0.28,
    "P_on": -1.2, "lag": 0.008, "reaction": 1.0,
}  # fmt: skip
#: Relative sd of the stated masses, and sd of the prior of P_on, N, which does not know the sign.
MASS_SD, P_ON_SD = 0.01, 2.0
#: Number of trials at each setting.
TRIALS = 3
#: A trial lasts about this long, s.
DURATION = 4.0


@dataclass(frozen=True)
class RobotDesign:
    """Settings and errors of a synthetic progression.

    Attributes
    ----------
    period, duty : (settings,) s and 1
    sessions : number of sessions, each with an equal share of the settings
    session_sd, trial_scatter, trial_sd, reading_sd : relative, relative, m, m
    """

    period: np.ndarray = field(default_factory=lambda: 1e-3 * np.arange(35.0, 160.0, 5.0))
    duty: np.ndarray = field(default_factory=lambda: np.full(25, 0.3))
    sessions: int = 2
    session_sd: float = 0.05
    trial_scatter: float = 0.04
    trial_sd: float = 0.0
    reading_sd: float = 5e-4


def robot_progression(seed: int, design: RobotDesign, values: Mapping[str, float] = ROBOT) -> dict[str, np.ndarray]:
    """Columns of a table by header cell; ``TRIALS`` rows per setting, sessions one after the other.

    Raises
    ------
    InputError
        If the model cannot complete a trial with these values.
    """
    rng = np.random.default_rng(seed)
    session = np.arange(len(design.period)) % design.sessions
    order = np.argsort(session, kind="stable")
    period, duty, session = design.period[order], design.duty[order], session[order]
    count = np.maximum(np.round(DURATION / period), 1.0)
    s = design.session_sd * rng.standard_normal(design.sessions)
    own: dict[str, Any] = {
        name: value for name, value in values.items() if name in TABLE and TABLE[name].leaf == "capsule"
    }
    p = CapsuleParameters(**{"k2": 0.0, "G": np.inf, **own})
    drive = Pulses(values["P_on"], period, duty, lag=values["lag"], reaction=values["reaction"])
    X2 = np.asarray(displacement(p, drive, scaled(friction_law(p), np.exp(s[session])), period, count).X2)
    if not np.isfinite(X2).all():
        raise InputError("every trial must be complete", "a trial was given up", "choose other values")
    rows = np.repeat(np.arange(len(period)), TRIALS)
    sd = np.hypot(design.trial_sd, design.reading_sd)
    distance = X2[rows] * (1.0 + design.trial_scatter * rng.standard_normal(len(rows)))
    distance = distance + sd * rng.standard_normal(len(rows))
    return {
        "period [ms]": np.round(1e3 * period[rows], 6),
        "duty [%]": 100.0 * duty[rows],
        "periods [1]": count[rows],
        "distance [mm]": np.round(1e3 * distance, 3),
        "session [1]": session[rows] + 1.0,
    }


def synthesize_robot(
    folder: Path,
    seed: int,
    design: RobotDesign | None = None,
    values: Mapping[str, float] | None = None,
    model: str = "",
) -> None:
    """Write the rig folder of a synthetic robot and, beside it, ``<folder>.truth.json``.

    Parameters
    ----------
    folder : new or empty
    design, values : default ``RobotDesign()`` and ``ROBOT``; a partial mapping changes the values that it names
    model : lines of ``[model]``; default: reaction on the capsule, free ratio and lag

    Raises
    ------
    InputError
        If ``folder`` is not empty, or the model cannot complete a trial.
    """
    design, truth = design or RobotDesign(), {**ROBOT, **(values or {})}
    if values and "mu" in values and "mu_back" not in values:
        truth["mu_back"] = truth["mu"]
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise InputError("a synthetic rig needs a new folder", "it exists and is not empty", "choose another", folder)
    columns = robot_progression(seed, design, truth)
    folder.mkdir(parents=True, exist_ok=True)
    lines = [",".join(columns), *(",".join(f"{x:.9g}" for x in row) for row in zip(*columns.values(), strict=True))]
    (folder / "progression.csv").write_text("\n".join(lines) + "\n", encoding="utf-8", newline="\n")
    rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(1,)))
    masses = {name: truth[name] * (1.0 + MASS_SD * rng.standard_normal()) for name in ("m1", "m2")}
    stated = "\n".join(
        f'{name} = {{ value = {1e3 * mass:.3f}, sd = {1e3 * MASS_SD * mass:.3f}, unit = "g" }}'
        for name, mass in masses.items()
    )
    text = RIG.format(
        seed=seed,
        name=folder.resolve().name,
        masses=stated,
        model=model or 'reaction = "capsule"\nfree = ["ratio", "lag"]',
        P_on_sd=P_ON_SD,
        reading=1e3 * design.reading_sd,
    )
    (folder / "rig.toml").write_text(text, encoding="utf-8", newline="\n")
    beside = folder.resolve().with_name(folder.resolve().name + ".truth.json")
    known = {"seed": seed, "parameters": {**truth, "session_sd": design.session_sd}}
    beside.write_text(json.dumps(known, indent=1) + "\n", encoding="utf-8", newline="\n")


RIG = """\
# SYNTHETIC: computed with known parameters (seed {seed}), not measured.
[rig]
name = "{name}"
synthetic = true
{masses}

[model]
{model}

[[experiment]]
kind = "progression"
file = "progression.csv"
drive = "pulses"
P_on = {{ value = 0, sd = {P_on_sd:g}, unit = "N" }}
distance_sd = {{ value = {reading:g}, unit = "mm" }}
"""
