"""A rig folder with known truth: a twin of the paper's rig (Table 1), measured by the paper's own protocol."""

import json
import re
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import numpy as np

from capsule_id.errors import InputError
from capsule_id.experiments.dynamic_friction import experiment as dynamic_friction
from capsule_id.experiments.free_vibration import experiment as free_vibration
from capsule_id.experiments.motor_current import experiment as motor_current
from capsule_id.experiments.static_friction import experiment as static_friction
from capsule_id.experiments.support_spring import experiment as support_spring
from capsule_id.parameters import TABLE_1
from capsule_id.rig.schema import NAME_PATTERN
from capsule_id.synthetic_runs import RUN_SPRINGS, make_runs, spring_priors, truths


@dataclass(frozen=True)
class Truth:
    """The parameters behind a synthetic rig, SI; the defaults are the paper's Table 1 and three of its springs."""

    m1: float = TABLE_1["m1"]
    m2: float = TABLE_1["m2"]
    k1: float = TABLE_1["k1"]
    c: float = TABLE_1["c"]
    mu: float = TABLE_1["mu"]
    v_s: float = TABLE_1["v_s"]
    K: float = TABLE_1["K"]
    g: float = TABLE_1["g"]
    k2: Mapping[str, float] = field(default_factory=lambda: {"soft": 2420.0, "medium": 18960.0, "stiff": 56410.0})

    def with_values(self, values: Mapping[str, float]) -> "Truth":
        """The same with some parameters changed, by name (``k1``, ``k2[soft]``).

        Raises
        ------
        InputError
            If a name is no parameter of the twin, or a value is not positive.
        """
        truth = self
        for name, value in values.items():
            spring = name[3:-1] if name.startswith("k2[") and name.endswith("]") else None
            known = [n for n in asdict(self) if n != "k2"] + [f"k2[{s}]" for s in self.k2]
            if name not in known:
                raise InputError("--set takes a parameter of the twin", name, f"one of {', '.join(known)}")
            if not (np.isfinite(value) and value > 0.0):
                raise InputError(f"{name} must be positive and finite", f"{value:g}", "give an SI value above 0")
            truth = replace(truth, k2={**truth.k2, spring: value}) if spring else replace(truth, **{name: value})
        return truth

    def with_runs(self) -> "Truth":
        """The same with the springs that only forced runs meet."""
        return replace(self, k2={**self.k2, **{name: k2 for name, k2 in RUN_SPRINGS.items() if name not in self.k2}})

    def flat(self) -> dict[str, float]:
        """Values by parameter name."""
        values = asdict(self)
        springs = values.pop("k2")
        return {**values, **{f"k2[{name}]": value for name, value in springs.items()}}


#: The protocol of the paper's section 2.2 with the reading errors of a careful bench.
TILTS, TILT_SD = 4, np.deg2rad(0.5)
PUSH_SPEEDS = np.array([0.15, 0.3, 0.5, 0.75, 1.0])
PUSH_SPEED_SD, PUSH_DISTANCE_SD, PUSH_SCATTER = 5e-3, 0.3e-3, 0.015
CURRENTS = np.linspace(0.25, 2.0, 8)
FORCE_SD, CURRENT_SD = 0.03, 0.01
RELEASES = (1.5e-3, 2.0e-3, 2.5e-3)
DECAY_NOISE = 0.01
DEFLECTIONS = np.linspace(0.0, 1e-3, 11)
SPRING_NOISE = 0.002
MASS_SD = {"m1": 0.2e-3, "m2": 0.5e-3}
#: Lengths follow the cantilever law from this one, which belongs to k2 = 18.96 kN/m; read with this sd.
LENGTH, LENGTH_OF, LENGTH_SD = 60e-3, 18960.0, 0.1e-3


def synthesize(
    folder: Path, seed: int, truth: Truth | None = None, name: str | None = None, runs: bool = False
) -> Truth:
    """Write a rig folder measured on ``truth`` and, beside it, ``<folder>.truth.json``.

    Parameters
    ----------
    folder : new or empty
    seed : of every reading error; the bench's readings are the same with and without runs
    truth : true parameters, by default the paper's
    name : of the rig, by default the folder's
    runs : add forced runs of the exact model, with the springs that only they meet

    Raises
    ------
    InputError
        If ``folder`` exists and is not empty: nothing is overwritten.
    """
    truth = truth or Truth()
    truth = truth.with_runs() if runs else truth
    folder = Path(folder)
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise InputError("synthesize writes a new folder", "it exists and is not empty", "choose another name", folder)
    name = name or folder.resolve().name
    if not re.fullmatch(NAME_PATTERN, name):
        raise InputError(f"the name of a rig matches {NAME_PATTERN}", name, "choose another with --name")
    rng = np.random.default_rng(seed)
    tables, entries = _measure(rng, truth)
    masses = {symbol: getattr(truth, symbol) + sd * rng.standard_normal() for symbol, sd in MASS_SD.items()}
    known: dict[str, object] = {"seed": seed, "parameters": truth.flat()}
    priors: list[str] = []
    if runs:
        measured = make_runs(truth.flat(), seed)
        files = {f"run_{number}.csv": run for number, run in enumerate(measured, start=1)}
        tables |= {file: run.table() for file, run in files.items()}
        entries += [run.entry(file) for file, run in files.items()]
        priors = spring_priors(truth.flat(), seed)
        known["runs"] = truths(measured)
    folder.mkdir(parents=True, exist_ok=True)
    for file, columns in tables.items():
        _write_csv(folder / file, columns)
    (folder / "rig.toml").write_text(_rig_toml(name, seed, truth.g, masses, priors, entries), encoding="utf-8")
    beside = folder.resolve().with_name(folder.resolve().name + ".truth.json")
    beside.write_text(json.dumps(known, indent=1) + "\n", encoding="utf-8")
    return truth


def _measure(rng: np.random.Generator, truth: Truth) -> tuple[dict[str, dict[str, np.ndarray]], list[str]]:
    """Tables by file name, and the entries of ``rig.toml`` that name them."""
    tables: dict[str, dict[str, np.ndarray]] = {}
    entries: list[str] = []

    def add(kind: str, file: str, columns: dict[str, np.ndarray], *settings: str) -> None:
        tables[file] = columns
        entries.append("\n".join(["[[experiment]]", f'kind = "{kind}"', f'file = "{file}"', *settings, ""]))

    for number, release in enumerate(RELEASES, start=1):
        decay = free_vibration.twin(rng, truth.k1, truth.c, truth.m1, release, DECAY_NOISE)
        add("free_vibration", f"free_vibration_{number}.csv", decay)
    add("static_friction", "static_friction.csv", static_friction.twin(rng, truth.mu, TILTS, TILT_SD))
    pushes = dynamic_friction.twin(
        rng, truth.mu, truth.v_s, truth.g, PUSH_SPEEDS, PUSH_SPEED_SD, PUSH_DISTANCE_SD, PUSH_SCATTER
    )
    add(
        "dynamic_friction",
        "dynamic_friction.csv",
        pushes,
        f'speed_sd = {{ value = {1e3 * PUSH_SPEED_SD:g}, unit = "mm/s" }}',
        f'distance_sd = {{ value = {1e3 * PUSH_DISTANCE_SD:g}, unit = "mm" }}',
    )
    add(
        "motor_current",
        "motor_current.csv",
        motor_current.twin(rng, truth.K, CURRENTS, FORCE_SD, CURRENT_SD),
        f'force_sd = {{ value = {FORCE_SD:g}, unit = "N" }}',
        f'current_sd = {{ value = {CURRENT_SD:g}, unit = "A" }}',
    )
    for spring, k2 in truth.k2.items():
        if spring in RUN_SPRINGS:
            continue
        length = LENGTH * (LENGTH_OF / k2) ** (1.0 / 3.0) + LENGTH_SD * rng.standard_normal()
        add(
            "support_spring",
            f"support_spring_{spring}.csv",
            support_spring.twin(rng, k2, DEFLECTIONS, SPRING_NOISE),
            f'spring = "{spring}"',
            f'length = {{ value = {1e3 * length:.2f}, sd = {1e3 * LENGTH_SD:g}, unit = "mm" }}',
        )
    return tables, entries


def _write_csv(path: Path, columns: dict[str, np.ndarray]) -> None:
    rows = zip(*columns.values(), strict=True)
    lines = [",".join(columns), *(",".join(f"{value:.9g}" for value in row) for row in rows)]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def _rig_toml(name: str, seed: int, g: float, masses: dict[str, float], priors: list[str], entries: list[str]) -> str:
    """The text of ``rig.toml``."""
    head = [
        f"# SYNTHETIC: computed with known parameters (seed {seed}), not measured.",
        "[rig]",
        f'name = "{name}"',
        "synthetic = true",
        *(
            f'{symbol} = {{ value = {1e3 * value:.3f}, sd = {1e3 * MASS_SD[symbol]:g}, unit = "g" }}'
            for symbol, value in masses.items()
        ),
        f'g = {{ value = {g:g}, unit = "m/s^2" }}',
        "",
        *(["[prior]", *priors, ""] if priors else []),
    ]
    return "\n".join([*head, *entries])
