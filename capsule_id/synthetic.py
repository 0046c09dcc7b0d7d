"""Writes rig folders with known truth: a twin of the paper's rig, measured by its protocol, and a capsule robot."""

import json
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from capsule_id.errors import InputError
from capsule_id.experiments.kind import Kind, Registry, default_registry
from capsule_id.output import replace_files
from capsule_id.parameters import SPRINGS, TABLE, TABLE_1, Prior, symbol_of
from capsule_id.physics.drives import Pulses
from capsule_id.physics.forces import friction_law, scaled
from capsule_id.physics.model import CapsuleParameters
from capsule_id.physics.simulation import displacement
from capsule_id.rig.model import Rig
from capsule_id.rig.toml import NAME_PATTERN, PRIOR_KEYS

#: Table 1 and three springs of the paper, SI by name.
PAPER: Mapping[str, float] = {
    **{name: TABLE_1[name] for name in ("m1", "m2", "k1", "c", "mu", "v_s", "K", "g")},
    **{f"k2[{spring}]": k2 for spring, k2 in SPRINGS.items()},
}


class Truth(dict[str, float]):
    """The true parameters of a synthetic rig by name (``k1``, ``k2[soft]``), SI; by default those of the paper."""

    def __init__(self, values: Mapping[str, float] = PAPER) -> None:
        super().__init__(values)

    def with_values(self, values: Mapping[str, float]) -> "Truth":
        """A copy with other values.

        Raises
        ------
        InputError
            If a name is not a parameter of the twin, or a value is not positive.
        """
        for name, value in values.items():
            if name not in self:
                raise InputError("--set takes a parameter of the twin", name, f"choose from {', '.join(self)}")
            if not (np.isfinite(value) and value > 0.0):
                raise InputError(f"{name} must be positive and finite", f"{value:g}", "give an SI value above 0")
        return Truth({**self, **values})

    def with_kinds(self, kinds: Iterable[Kind]) -> "Truth":
        """A copy with the additional values of ``kinds``; present values stay."""
        others = {name: value for kind in kinds for name, value in kind.truth.items() if name not in self}
        return Truth({**self, **others})


#: Standard deviations of the weighings, kg.
MASS_SD = {"m1": 0.2e-3, "m2": 0.5e-3}


def synthesize(
    folder: Path,
    seed: int,
    truth: Truth | None = None,
    name: str | None = None,
    runs: bool = False,
    registry: Registry | None = None,
    priors: Mapping[str, Prior] | None = None,
) -> Truth:
    """Write a rig folder computed from ``truth`` and, beside it, ``<folder>.truth.json``.

    Parameters
    ----------
    folder : new or empty
    seed : of all reading errors; the bench readings do not depend on ``runs``
    truth : true parameters (default: the paper's)
    name : of the rig (default: the name of the folder)
    runs : add forced runs of the exact model, with their additional springs
    registry : the kinds to measure (default: all with a twin)
    priors : those of all masses and of ``[prior]``, SI. Default: masses scatter about the truth

    Raises
    ------
    InputError
        If ``folder`` exists and is not empty; nothing is overwritten.
    """
    known_kinds = (registry or default_registry()).values()
    kinds = [kind for kind in known_kinds if kind.bench or runs]
    truth = (truth or Truth()).with_kinds(kinds)
    folder = Path(folder)
    _check_new(folder)
    name = name or folder.resolve().name
    if not re.fullmatch(NAME_PATTERN, name):
        raise InputError(f"the name of a rig matches {NAME_PATTERN}", name, "choose another with --name")
    rng = np.random.default_rng(seed)
    of_runs = {name for kind in known_kinds if not kind.bench for name in kind.truth}
    on_bench = {name: value for name, value in truth.items() if name not in of_runs}
    twins = [(k, k.twin(on_bench if k.bench else dict(truth), rng, seed)) for k in kinds if k.twin is not None]
    masses = {
        symbol: truth[symbol] + sd * rng.standard_normal() if priors is None else priors[symbol].location
        for symbol, sd in MASS_SD.items()
    }
    entries = [
        "\n".join(["[[experiment]]", f'kind = "{kind.name}"', f'file = "{table.file}"', *table.settings, ""])
        for kind, twin in twins
        for table in twin.tables
    ]
    stated = [line for _, twin in twins for line in twin.priors] if priors is None else _prior_lines(priors)
    behind = {label: known for _, twin in twins for label, known in twin.truth.items()}
    tables = {table.file: table.columns for _, twin in twins for table in twin.tables}
    known = {"seed": seed, "parameters": truth, **({"runs": behind} if behind else {})}
    head = [f'g = {{ value = {truth["g"]:g}, unit = "m/s^2" }}', "", *(["[prior]", *stated, ""] if stated else [])]
    _write(folder, tables, _rig_toml(name, seed, masses, MASS_SD, [*head, *entries]), known)
    return truth


def _check_new(folder: Path) -> None:
    """Refuse a folder with files in it."""
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise InputError("synthesize writes a new folder", "it exists and is not empty", "choose another name", folder)


def _write(folder: Path, tables: Mapping[str, Mapping[str, Any]], rig: str, known: Mapping[str, Any]) -> None:
    """Write tables by file name, the text of ``rig.toml`` and, beside the folder, what is known; on a full disk no file."""
    folder.mkdir(parents=True, exist_ok=True)
    contents = {
        folder / file: pd.DataFrame(columns).to_csv(index=False, float_format="%.9g", na_rep="nan", lineterminator="\n")
        for file, columns in tables.items()
    }
    replace_files({**contents, folder / "rig.toml": rig, _truth_file(folder): json.dumps(known, indent=1) + "\n"})


def truth_beside(rig: Rig) -> dict[str, float]:
    """True values of a synthetic rig by parameter name, SI, from the file that ``synthesize`` wrote; {} without one."""
    if not rig.synthetic:
        return {}
    try:
        known = json.loads(_truth_file(rig.folder).read_text(encoding="utf-8"))["parameters"]
        return {str(name): float(value) for name, value in known.items() if np.isfinite(value)}
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return {}


def _truth_file(folder: Path) -> Path:
    return folder.resolve().with_name(folder.resolve().name + ".truth.json")


def _prior_lines(priors: Mapping[str, Prior]) -> list[str]:
    """Lines of ``[prior]``, SI, without the masses."""
    return [
        " ".join(
            [
                f'"{name}" = {{',
                *(
                    f"{key} = {prior.location if key == 'median' else prior.spread!r},"
                    for key in PRIOR_KEYS[prior.kind]
                ),
                f'unit = "{default_registry().parameters[symbol_of(name)].unit}" }}',
            ]
        )
        for name, prior in priors.items()
        if name not in MASS_SD
    ]


def _rig_toml(name: str, seed: int, masses: Mapping[str, float], sds: Mapping[str, float], lines: Iterable[str]) -> str:
    """The text of ``rig.toml``; ``masses`` and their ``sds`` in kg, ``lines`` behind them."""
    head = [
        f"# SYNTHETIC: computed with known parameters (seed {seed}), not measured.",
        "[rig]",
        f'name = "{name}"',
        "synthetic = true",
        *(
            f'{symbol} = {{ value = {1e3 * value:.3f}, sd = {1e3 * sds[symbol]:g}, unit = "g" }}'
            for symbol, value in masses.items()
        ),
    ]
    return "\n".join([*head, *lines])


# robot: Synthetic progressions of a capsule robot: pulses of a coil inside the capsule, no support spring.


#: Values of the robot's twin, SI; its coil pushes towards -x.
ROBOT: Mapping[str, float] = {
    "m1": 0.074, "m2": 0.193, "k1": 250.0, "c": 0.4, "mu": 0.28, "v_s": 0.1, "ratio": 0.8, "mu_back": 0.28,
    "P_on": -1.2, "lag": 0.008, "reaction": 1.0,
}  # fmt: skip
#: Relative sd of the stated masses, and sd of the prior of P_on, N, which does not know the sign.
MASS_SHARE, P_ON_SD = 0.01, 2.0
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
    design, values = design or RobotDesign(), values or {}
    truth = {**ROBOT, "mu_back": values.get("mu", ROBOT["mu"]), **values}
    _check_new(folder)
    columns = robot_progression(seed, design, truth)
    rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(1,)))
    masses = {name: truth[name] * (1.0 + MASS_SHARE * rng.standard_normal()) for name in ("m1", "m2")}
    lines = (
        "",
        "[model]",
        model or 'reaction = "capsule"\nfree = ["ratio", "lag"]',
        "",
        "[[experiment]]",
        'kind = "progression"',
        'file = "progression.csv"',
        'drive = "pulses"',
        f'P_on = {{ value = 0, sd = {P_ON_SD:g}, unit = "N" }}',
        f'distance_sd = {{ value = {1e3 * design.reading_sd:g}, unit = "mm" }}',
        "",
    )
    sds = {name: round(MASS_SHARE * mass, 6) for name, mass in masses.items()}
    text = _rig_toml(folder.resolve().name, seed, masses, sds, lines)
    known = {"seed": seed, "parameters": {**truth, "session_sd": design.session_sd}}
    _write(folder, {"progression.csv": columns}, text, known)
