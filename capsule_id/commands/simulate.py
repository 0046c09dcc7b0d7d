"""``capsule-id simulate``: one motion of the capsule as a table and as a figure; parameters and drive as options."""

import argparse
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TypeVar

import numpy as np

import capsule_id as cid  # imports JAX at the first use of a name
from capsule_id.commands import NO_CACHE, PATH, Option
from capsule_id.console import complain, refusing_damage, say
from capsule_id.errors import InputError, refusing
from capsule_id.output import replace_file
from capsule_id.parameters import CAPSULE_LEAVES, CONSTANT, DRIVES, LEAVES, TABLE_1, by_index, refuse_another_law
from capsule_id.views import counted

# options: Parameters of the capsule and its drive as options, and their values from a result.

Value = TypeVar("Value")
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
    return {
        "parameters: plain numbers in SI units": [
            *rows,
            ("--result", "DIR", "result directory of fit-params, for its fitted parameters", PATH),
            ("--spring", "NAME", "support spring of --result"),
        ]
    }


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
    # What the folder does not decide must be given, but for what is varied.
    fitted = {name: x for name, x in fitted.items() if x is not None or name not in free}
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
    if args.spring is not None and args.k2 is not None:
        raise InputError("--spring chooses k2", "--k2 is given, too", "remove one of them")
    return values


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


def fitted_values(directory: Path, warn: bool = True) -> dict[str, float | None]:
    """Fitted values (maximum of the posterior) of DIR/parameters.json by name, SI, and those that its folder states.

    None: the folder states several. ``warn``: say on standard error what these values are not.

    Raises
    ------
    InputError
        If the file cannot be read.
    """
    file = directory / "parameters.json"
    rule, remedy = "--result takes a result of fit-params", "run fit-params first, or check the path"
    with refusing_damage(rule, remedy, file, lambda error: type(error).__name__):
        saved = json.loads(file.read_text(encoding="utf-8"))
        values = saved.get("fixed", {}) | {name: float(row["map"]) for name, row in saved["parameters"].items()}
        law, trust = str(saved.get("provenance", {}).get("friction", "eq. (1)")), saved.get("trust")
    # The fitted values hold the free parameters of eq. (1) too.
    refuse_another_law(law, file)
    values = (CONSTANT if law.startswith("constant") else {}) | values
    lost = [name for name in ("F_dry", "c_q") if name in values]
    if warn and lost:
        complain(f"{file}: the capsule has no {' and no '.join(lost)}: its rod is damped by c alone")
    if warn and trust == "not trusted":
        complain(f"{file}: not trusted; look at the failed checks of its report before you use these values")
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


WIDTHS = {"velocity": "m/s", "penetration": "m", "rounding": "fraction of the break-away force", "tolerance": "1"}
PICTURE_SAMPLES = 20_000
#: Most samples, and most periods of the drive, of a run.
MOST_SAMPLES = 10_000_000
#: Unit and meaning of the columns of a motion, the state first.
COLUMNS = {
    "X1": ("m", "displacement of the rod"),
    "Y1": ("m/s", "velocity of the rod"),
    "X2": ("m", "displacement of the capsule"),
    "Y2": ("m/s", "velocity of the capsule"),
    "x_rel": ("m", "X1 - X2, positive towards the support spring"),
}
STATE = tuple(COLUMNS)[:4]


OPTIONS = {
    **capsule_options(),
    "run": (
        ("--periods", "N", "length in excitation periods (default 20)"),
        ("--duration", "X", "length in s, instead of --periods"),
        ("--samples", "N", "number of samples (default 2000)", {"default": "2000"}),
        ("--initial", STATE, "state at the start, m and m/s (default: rest)", {"nargs": 4}),
    ),
    "model": (
        ("--model", None, "event-driven or smoothed", {"choices": ["exact", "smooth"], "default": "exact"}),
        ("--semantics", None, "eq2: smooth only", {"choices": ["stick-slip", "eq2"], "default": "stick-slip"}),
        *((f"--{name}", "X", f"of the smoothed model, {unit} (default: certified)") for name, unit in WIDTHS.items()),
    ),
    "output": (
        ("--out", "FILE", "table: FILE.csv or FILE.nc (NetCDF)", {**PATH, "required": True}),
        ("--figure", "FILE", "figure: FILE.png", PATH),
        NO_CACHE,
    ),
}


def run(args: argparse.Namespace) -> int:
    """Simulate, write the table and the figure; 0.

    Raises
    ------
    InputError
        If a number is missing, malformed or not admissible, a suffix is unknown, a file cannot be written, or the run
        cannot be completed.
    """
    _check_suffix(args.out, (".csv", ".nc"))
    if args.figure is not None:
        _check_suffix(args.figure, (".png",))
    values = capsule_values(args)
    # A force that does not repeat has no period.
    period = values.get("period", 2.0 * math.pi / values["Omega"] if values.get("Omega", 0.0) > 0.0 else None)
    end, samples = _length(args, period)
    X1, Y1, X2, Y2 = (number(name, text) for name, text in zip(STATE, args.initial or ["0"] * 4, strict=True))
    widths = {name: number(name, getattr(args, name)) for name in WIDTHS if getattr(args, name) is not None}
    if widths and args.model == "exact":
        raise InputError("the exact model has no widths", f"--{next(iter(widths))}", "remove it, or add --model smooth")
    for name in (name for name, width in widths.items() if width <= 0.0):
        raise InputError(f"--{name} must be positive", getattr(args, name), "give a width above 0")
    from capsule_id.physics.drives import capsule_and_drive
    from capsule_id.physics.forces import warn_of_far_gap

    p, e = capsule_and_drive(values, args.drive)
    grid = np.linspace(0.0, end, samples)
    # Times at which the drive has its initial phase.
    section = np.zeros(0) if period is None else period * np.arange(np.floor(end / period) + 1.0)
    # Impacts are short: the figure needs more samples than the table.
    drawn = np.linspace(0.0, end, PICTURE_SAMPLES) if args.figure is not None else section
    times = np.union1d(np.union1d(grid, section), drawn)
    smoothing = cid.Smoothing(**widths) if args.model == "smooth" else None
    t = cid.simulate(p, e, times, (X1, Y1, X2, Y2), model=args.model, semantics=args.semantics, smoothing=smoothing)
    status = cid.Status(int(t.status))
    if not status.usable:
        raise InputError("the run must be complete", status.name, cid.status_message(t.status))
    if status is not cid.Status.OK:
        complain(f"capsule-id simulate: {cid.status_message(t.status)}")
    warn_of_far_gap(p.G, t.x_rel)
    held = np.isin(times, grid)
    columns = {name: np.asarray(getattr(t, name))[held] for name in COLUMNS}
    with refusing("the output must be writable", "choose another name", args.out):
        _write(args.out, times[held], columns, values | {"model": args.model, "semantics": args.semantics})
    if args.figure is not None:
        with refusing("the output must be writable", "choose another name", args.figure):
            _draw(args.figure, t, np.isin(times, section), values["G"])
    events = f"{counted(int(t.contacts), 'contact')}, {counted(int(t.events), 'event')}"
    say(f"wrote {args.out}: {counted(samples, 'sample')} of {end:g} s, {events}")
    return 0


def _length(args: argparse.Namespace, period: float | None) -> tuple[float, int]:
    """End of the run in s and number of samples."""
    if args.periods is not None and args.duration is not None:
        raise InputError("a run has one length", "--periods and --duration", "remove one of them")
    samples = whole_number("samples", args.samples, least=2)
    if args.duration is not None:
        end, text = number("duration", args.duration), f"--duration {args.duration}"
    elif period is not None:
        periods = args.periods or "20"
        end, text = period * number("periods", periods), f"--periods {periods}"
    else:
        raise InputError("--periods needs Omega above 0", f"Omega = {float(args.Omega):g}", "give --duration")
    if not end > 0.0:
        raise InputError("the length must be positive", text, "give a positive number")
    if samples > MOST_SAMPLES or (period is not None and end / period > MOST_SAMPLES):
        rule = f"a run has at most {MOST_SAMPLES} samples and periods"
        raise InputError(rule, f"--samples {samples}, {text}", "simulate a shorter part")
    return end, samples


def _write(
    path: Path, time: np.ndarray, columns: Mapping[str, np.ndarray], provenance: Mapping[str, float | str]
) -> None:
    """Write the motion, (n,) SI, as CSV with ``name [unit]`` headers or as NetCDF; numbers keep all their digits.

    provenance : parameters and model; attributes of the NetCDF file (a CSV file holds the table alone)
    """
    import pandas as pd
    import xarray as xr

    if path.suffix == ".csv":
        table = {"time [s]": time} | {f"{name} [{COLUMNS[name][0]}]": values for name, values in columns.items()}
        replace_file(path, pd.DataFrame(table).to_csv(index=False, lineterminator="\n"))
        return
    from capsule_id.report.write import netcdf_bytes  # with Matplotlib

    about = {name: {"units": unit, "long_name": meaning} for name, (unit, meaning) in COLUMNS.items()}
    data = {name: ("time", values, about[name]) for name, values in columns.items()}
    replace_file(path, netcdf_bytes(xr.Dataset(data, {"time": ("time", time, {"units": "s"})}, dict(provenance))))


def _draw(path: Path, t: "cid.Trajectory", section: np.ndarray, G: float) -> None:
    """Draw time histories and phase plane. ``section`` marks the samples at the initial phase of the drive."""
    from capsule_id.records.view import MotionView
    from capsule_id.report.figures import fits, style

    x_rel, rate = np.asarray(t.x_rel), np.asarray(t.Y1 - t.Y2)
    channels = {"x_capsule": np.asarray(t.X2), "x_rel": x_rel}
    view = MotionView(np.asarray(t.times), channels, x_rel, rate, x_rel[section], rate[section], G)
    with style.own_style():
        fits.overview(view, figure := style.new_figure(10.0, 4.8))
        replace_file(path, style.png(figure))


def _check_suffix(path: Path, suffixes: tuple[str, ...]) -> None:
    if path.suffix not in suffixes:
        raise InputError(f"the file must end in {' or '.join(suffixes)}", str(path), "change the suffix")
    if not path.parent.is_dir():
        raise InputError("the folder of the output must exist", str(path.parent), "make the folder first")
