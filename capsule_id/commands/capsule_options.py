"""Parameters and drive as options. A value comes from the option, else from a result, else from the paper."""

import argparse
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from capsule_id.commands import PATH, Option
from capsule_id.console import refusing_damage
from capsule_id.errors import InputError
from capsule_id.parameters import CAPSULE_LEAVES, DRIVES, LEAVES, TABLE_1, by_index

if TYPE_CHECKING:
    from capsule_id.physics.drives import Pulses
    from capsule_id.physics.model import CapsuleParameters, Excitation

Value = TypeVar("Value")
#: Name of the default friction law in the provenance of a result.
EQUATION_1 = "eq. (1)"
# From the paper's Table 1, or the default of the parameter table; other parameters have no default.
DEFAULTS: Mapping[str, float] = {
    **{name: leaf.default for name, leaf in LEAVES.items() if isinstance(leaf.default, float)},
    **{name: TABLE_1[name] for name in LEAVES if name in TABLE_1},
}


def capsule_options(defaults: Mapping[str, float] = DEFAULTS) -> Mapping[str, Sequence[Option]]:
    """An option per parameter, in SI, and the options for fitted values. ``capsule_values`` parses the numbers."""
    rows: list[Option] = [
        ("--drive", None, "force on the rod (default harmonic)", {"choices": tuple(DRIVES), "default": "harmonic"})
    ]
    for name, leaf in LEAVES.items():
        text = "required" if leaf.default is None else f"default {leaf.describe_default()}"
        text = f"default {defaults[name]:g}" if name in defaults else text
        drives = [drive for drive, names in DRIVES.items() if name in names]
        only = f"; {drives[0]} drive" if len(drives) == 1 else ""
        rows.append((f"--{name}", "X", f"{leaf.meaning}, {leaf.unit} ({text}{only})"))
    rows.append(("--result", "DIR", "result directory of fit-params, for its fitted parameters", PATH))
    rows.append(("--spring", "NAME", "support spring of --result"))
    return {"parameters: plain numbers in SI units": rows}


def capsule_values(
    args: argparse.Namespace, defaults: Mapping[str, float] = DEFAULTS, free: frozenset[str] = frozenset()
) -> dict[str, float]:
    """Every parameter of capsule and drive by symbol, SI. Those of ``free`` are optional: their value is the default or 1.

    A parameter that equals another one by default is absent where nothing gives it.

    Raises
    ------
    InputError
        If a value is missing, no number or not admissible, belongs to another drive, or the result cannot be read.
    """
    fitted = leaves_of(fitted_values(args.result), args.spring) if args.result is not None else {}
    known = {**dict.fromkeys(free, 1.0), **defaults, **fitted}
    values = {}
    own = {*CAPSULE_LEAVES, *DRIVES[args.drive]}
    for name, leaf in LEAVES.items():
        text = getattr(args, name)
        if name not in own:
            if text is not None:
                raise InputError(f"the {args.drive} drive has no {name}", f"--{name}", "remove it, or change --drive")
            continue
        value = known.get(name) if text is None else math.inf
        if text is not None and not (text == "inf" and leaf.may_be_infinite):
            value = number(name, text)
        if value is None and isinstance(leaf.default, str):
            continue
        if value is None:
            raise InputError(
                f"{name} ({leaf.meaning}) must be given", "it is missing", f"add --{name} X, in {leaf.unit}"
            )
        if not leaf.admits(value):
            rule, remedy = {
                "positive": ("be positive", "give a value above 0"),
                "not negative": ("not be negative", "give 0 or more"),
                "any": ("be finite", "give a finite value"),
            }[leaf.sign]
            place = f"--{name}" if text is not None else "the value"
            raise InputError(f"{name} must {rule}", f"{place} {value:g}", remedy)
        values[name] = value
    fit = args.result or getattr(args, "posterior", None)
    if args.spring is not None and (fit is None or values["G"] == math.inf):
        raise InputError(
            "--spring needs the result that it is of, and a gap",
            "none",
            "give --result DIR and --G X, in m, or remove --spring",
        )
    return values


def capsule_and_drive(values: Mapping[str, Any], drive: str) -> "tuple[CapsuleParameters, Excitation | Pulses]":
    """The model's parameters and the drive of that name, from values by symbol, SI."""
    from capsule_id.physics.drives import Pulses
    from capsule_id.physics.model import CapsuleParameters, Excitation

    p = CapsuleParameters(**{name: values[name] for name in CAPSULE_LEAVES if name in values})
    own = {name: values[name] for name in DRIVES[drive]}
    return p, Excitation(**own) if drive == "harmonic" else Pulses(**own)


def number(name: str, text: str) -> float:
    """A finite number from the option --name.

    Raises
    ------
    InputError
        If ``text`` is no finite number.
    """
    try:
        value = float(text)
    except ValueError:
        raise InputError(f"--{name} takes a number", repr(text), "give a plain number in SI units") from None
    if not math.isfinite(value):
        raise InputError(f"--{name} must be finite", repr(text), "give a plain number in SI units")
    return value


def whole_number(name: str, text: str, least: int = 0) -> int:
    """A whole number, ``least`` or more, from the option --name.

    Raises
    ------
    InputError
        If ``text`` is none.
    """
    value = number(name, text)
    if value != int(value) or value < least:
        raise InputError(f"--{name} must be a whole number of at least {least}", text, f"give {least} or more")
    return int(value)


def fitted_values(directory: Path) -> dict[str, float]:
    """Fitted values (maximum of the posterior) of DIR/parameters.json by name, SI.

    Raises
    ------
    InputError
        If the file cannot be read.
    """
    file = directory / "parameters.json"
    rule, remedy = "--result takes a result of fit-params", "run fit-params first, or check the path"
    with refusing_damage(rule, remedy, file, lambda error: type(error).__name__):
        saved = json.loads(file.read_text(encoding="utf-8"))
        values = {name: float(row["map"]) for name, row in saved["parameters"].items()}
        law = str(saved.get("provenance", {}).get("friction", EQUATION_1))
    # The fitted values hold the free parameters of eq. (1) too.
    if law.split(",")[0] != EQUATION_1:
        raise InputError(
            "the commands compute with eq. (1), and --result must have been fitted with it",
            law,
            "call capsule_id.simulate(..., friction=law) in Python",
            file,
        )
    return values


def leaves_of(fitted: Mapping[str, Value], spring: str | None, file: str | Path = "") -> dict[str, Value]:
    """Fitted values, or draws, by symbol of a leaf; k2 is that of ``spring``, or of the only one.

    Raises
    ------
    InputError
        If ``spring`` was not fitted.
    """
    leaves = {name: value for name, value in fitted.items() if name in LEAVES}
    springs = by_index("k2", fitted)
    if spring is None and len(springs) == 1:
        spring = next(iter(springs))
    if spring is not None:
        if spring not in springs:
            raise InputError(
                "--spring must be a fitted spring",
                spring,
                f"choose from {', '.join(springs)}" if springs else "give --k2 instead",
                file,
            )
        leaves["k2"] = springs[spring]
    return leaves
