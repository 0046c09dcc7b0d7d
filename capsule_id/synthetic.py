"""Writes rig folders with known truth: a twin of the paper's rig (Table 1), measured by the paper's protocol."""

import json
import re
from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np
import pandas as pd

from capsule_id.errors import InputError
from capsule_id.experiments.kind import Kind, Registry, default_registry
from capsule_id.parameters import TABLE_1
from capsule_id.rig.model import Rig
from capsule_id.rig.toml import NAME_PATTERN

#: Table 1 and three springs of the paper, SI by name.
PAPER: Mapping[str, float] = {
    **{name: TABLE_1[name] for name in ("m1", "m2", "k1", "c", "mu", "v_s", "K", "g")},
    **{"k2[soft]": 2420.0, "k2[medium]": 18960.0, "k2[stiff]": 56410.0},
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

    Raises
    ------
    InputError
        If ``folder`` exists and is not empty; nothing is overwritten.
    """
    known_kinds = (registry or default_registry()).values()
    kinds = [kind for kind in known_kinds if kind.bench or runs]
    truth = (truth or Truth()).with_kinds(kinds)
    folder = Path(folder)
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise InputError("synthesize writes a new folder", "it exists and is not empty", "choose another name", folder)
    name = name or folder.resolve().name
    if not re.fullmatch(NAME_PATTERN, name):
        raise InputError(f"the name of a rig matches {NAME_PATTERN}", name, "choose another with --name")
    rng = np.random.default_rng(seed)
    of_runs = {name for kind in known_kinds if not kind.bench for name in kind.truth}
    on_bench = {name: value for name, value in truth.items() if name not in of_runs}
    twins = [(k, k.twin(on_bench if k.bench else dict(truth), rng, seed)) for k in kinds if k.twin is not None]
    masses = {symbol: truth[symbol] + sd * rng.standard_normal() for symbol, sd in MASS_SD.items()}
    entries = [
        "\n".join(["[[experiment]]", f'kind = "{kind.name}"', f'file = "{table.file}"', *table.settings, ""])
        for kind, twin in twins
        for table in twin.tables
    ]
    priors = [line for _, twin in twins for line in twin.priors]
    behind = {label: known for _, twin in twins for label, known in twin.truth.items()}
    folder.mkdir(parents=True, exist_ok=True)
    for table in (table for _, twin in twins for table in twin.tables):
        rows = pd.DataFrame(table.columns)
        rows.to_csv(folder / table.file, index=False, float_format="%.9g", na_rep="nan", lineterminator="\n")
    (folder / "rig.toml").write_text(
        _rig_toml(name, seed, truth["g"], masses, priors, entries), encoding="utf-8", newline="\n"
    )
    beside = _truth_file(folder)
    known = {"seed": seed, "parameters": truth, **({"runs": behind} if behind else {})}
    beside.write_text(json.dumps(known, indent=1) + "\n", encoding="utf-8", newline="\n")
    return truth


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
