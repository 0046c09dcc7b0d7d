"""``capsule-id simulate``: one motion of the capsule as a table and as a picture."""

import argparse
import json
import math
import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from capsule_id.errors import InputError

if TYPE_CHECKING:
    import numpy as np

    from capsule_id.capsule.model import Trajectory

# name: (default or None where it must be given, unit, meaning); defaults from the paper's Table 1
PARAMETERS: dict[str, tuple[float | None, str, str]] = {
    "m1": (0.11, "kg", "mass of the rod"),
    "m2": (0.53, "kg", "mass of the capsule"),
    "k1": (1420.0, "N/m", "stiffness of the rod's spring"),
    "k2": (None, "N/m", "stiffness of the support spring"),
    "c": (3.89, "N s/m", "damping of the rod"),
    "mu": (0.66, "1", "static friction coefficient"),
    "v_s": (0.3, "m/s", "Stribeck velocity"),
    "G": (None, "m", "gap to the support spring"),
    "g": (9.81, "m/s^2", "gravity"),
}
EXCITATION: dict[str, tuple[float | None, str, str]] = {
    "P_d": (None, "N", "amplitude of the drive"),
    "Omega": (None, "rad/s", "angular frequency of the drive"),
    "phase": (0.0, "rad", "phase of the drive"),
}
WIDTHS = {"velocity": "m/s", "penetration": "m", "rounding": "fraction of the break-away force", "tolerance": "1"}
PICTURE_SAMPLES = 20_000
STATE = {"X1": "m", "Y1": "m/s", "X2": "m", "Y2": "m/s"}

# Compiles the engines' loops as one function each, several times faster for a single run (internal to XLA's CPU part).
WHOLE_LOOPS = "--xla_backend_extra_options=xla_cpu_small_while_loop_byte_threshold=1000000000"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Parameters, drive, run, model, output; all numbers are read in ``run``, so that errors name rule and remedy."""
    group = parser.add_argument_group("parameters", "plain numbers in SI units")
    for name, (default, unit, meaning) in (PARAMETERS | EXCITATION).items():
        text = f"{meaning}, {unit} ({'required' if default is None else f'default {default:g}'})"
        group.add_argument(f"--{name}", metavar="X", help=text)
    group.add_argument(
        "--result", metavar="DIR", type=Path, help="take the fitted parameters of a result of fit-params"
    )
    group.add_argument("--spring", metavar="NAME", help="with --result: which support spring")
    group = parser.add_argument_group("run")
    group.add_argument("--periods", metavar="N", help="length in periods of the drive (default 20)")
    group.add_argument("--duration", metavar="X", help="length in s, instead of --periods")
    group.add_argument("--samples", metavar="N", default="2000", help="number of samples (default 2000)")
    group.add_argument("--initial", nargs=4, metavar=tuple(STATE), help="state at the start, m and m/s (default: rest)")
    group = parser.add_argument_group("model")
    group.add_argument("--model", choices=["exact", "smooth"], default="exact", help="event-driven or smoothed")
    group.add_argument("--semantics", choices=["stick-slip", "eq2"], default="stick-slip", help="eq2: smooth only")
    for name, unit in WIDTHS.items():
        group.add_argument(f"--{name}", metavar="X", help=f"of the smoothed model, {unit} (default: certified)")
    group = parser.add_argument_group("output")
    group.add_argument("--out", metavar="FILE", type=Path, required=True, help="table: FILE.csv or FILE.nc (NetCDF)")
    group.add_argument("--figure", metavar="FILE", type=Path, help="picture: FILE.png")


def run(args: argparse.Namespace) -> int:
    """Simulate, write the table and the picture; 0.

    Raises
    ------
    InputError
        A number that is missing, malformed or not admissible, a suffix that is not known, a file that cannot be
        written, a run that cannot be completed.
    """
    _check_suffix(args.out, (".csv", ".nc"))
    if args.figure is not None:
        _check_suffix(args.figure, (".png",))
    values = _values(args)
    end, samples = _length(args, values["Omega"])
    X1, Y1, X2, Y2 = (_number(name, text) for name, text in zip(STATE, args.initial or ["0"] * 4, strict=True))
    widths = {name: _number(name, getattr(args, name)) for name in WIDTHS if getattr(args, name) is not None}
    if widths and args.model == "exact":
        raise InputError("the exact model has no widths", f"--{next(iter(widths))}", "leave it out, or --model smooth")
    _prefer_whole_loops()
    import numpy as np

    from capsule_id.capsule.model import CapsuleParameters, Excitation, Status, simulate, status_message
    from capsule_id.capsule.smooth import Smoothing
    from capsule_id.report.motion_files import write_motion

    p = CapsuleParameters(**{name: values[name] for name in PARAMETERS})
    e = Excitation(**{name: values[name] for name in EXCITATION})
    grid = np.linspace(0.0, end, samples)
    section = _section(values["Omega"], end)
    # Impacts are short: a picture needs more samples than a table may want.
    drawn = np.linspace(0.0, end, PICTURE_SAMPLES) if args.figure is not None else section
    times = np.union1d(np.union1d(grid, section), drawn)
    smoothing = Smoothing(**widths) if args.model == "smooth" else None
    t = simulate(p, e, times, (X1, Y1, X2, Y2), model=args.model, semantics=args.semantics, smoothing=smoothing)
    status = Status(int(t.status))
    if not status.usable:
        raise InputError("the run must be complete", status.name, status_message(t.status))
    if status is not Status.OK:
        print(f"capsule-id simulate: {status_message(t.status)}", file=sys.stderr)
    held = np.isin(times, grid)
    columns = {"time": times[held]} | {name: np.asarray(getattr(t, name))[held] for name in (*STATE, "x_rel")}
    try:
        write_motion(args.out, columns, values | {"model": args.model, "semantics": args.semantics})
        if args.figure is not None:
            _draw(args.figure, t, np.isin(times, section), values["G"])
    except OSError as error:
        raise InputError("the output must be writable", str(error), "choose another name") from None
    print(f"wrote {args.out}: {samples} samples of {end:g} s, {int(t.contacts)} contacts, {int(t.events)} events")
    return 0


def _values(args: argparse.Namespace) -> dict[str, float]:
    """Every parameter: the option, else the fitted value, else the paper's."""
    fitted = _fitted(args.result, args.spring) if args.result is not None else {}
    values = {}
    for name, (default, unit, meaning) in (PARAMETERS | EXCITATION).items():
        text = getattr(args, name)
        value = _number(name, text) if text is not None else fitted.get(name, default)
        if value is None:
            raise InputError(f"{name} ({meaning}) must be given", "it is missing", f"add --{name} X, in {unit}")
        values[name] = value
    return values


def _number(name: str, text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        raise InputError(f"--{name} takes a number", repr(text), "give a plain number in SI units") from None
    if not math.isfinite(value):
        raise InputError(f"--{name} must be finite", repr(text), "give a plain number in SI units")
    return value


def _length(args: argparse.Namespace, Omega: float) -> tuple[float, int]:
    """End of the run in s and number of samples."""
    if args.periods is not None and args.duration is not None:
        raise InputError("the length is given once", "--periods and --duration", "leave one out")
    samples = _number("samples", args.samples)
    if samples != int(samples) or samples < 2:
        raise InputError("--samples must be a whole number of at least 2", args.samples, "give e.g. 2000")
    if args.duration is not None:
        end, text = _number("duration", args.duration), f"--duration {args.duration}"
    elif Omega > 0.0:
        periods = args.periods or "20"
        end, text = 2.0 * math.pi / Omega * _number("periods", periods), f"--periods {periods}"
    else:
        raise InputError("without a drive frequency there is no period", f"Omega = {Omega:g}", "give --duration")
    if not end > 0.0:
        raise InputError("the length must be positive", text, "give a positive number")
    return end, int(samples)


def _fitted(directory: Path, spring: str | None) -> dict[str, float]:
    """Fitted values (the most probable set) of DIR/parameters.json by symbol."""
    file = directory / "parameters.json"
    try:
        table = json.loads(file.read_text(encoding="utf-8"))["parameters"]
        values = {name: float(row["map"]) for name, row in table.items()}
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError("--result takes a result of fit-params", type(error).__name__, "check DIR", file) from None
    springs = [name[3:-1] for name in values if name.startswith("k2[")]
    if spring is None and len(springs) == 1:
        spring = springs[0]
    if spring is not None:
        if spring not in springs:
            raise InputError("--spring must be a fitted one", spring, f"choose from {', '.join(springs) or 'none'}")
        values["k2"] = values[f"k2[{spring}]"]
    return {name: value for name, value in values.items() if name in PARAMETERS}


def _section(Omega: float, end: float) -> "np.ndarray":
    """Times at which the drive passes its phase at the start, within the run."""
    import numpy as np

    if Omega <= 0.0:
        return np.zeros(0)
    T = 2.0 * np.pi / Omega
    return T * np.arange(np.floor(end / T) + 1.0)


def _draw(path: Path, t: "Trajectory", section: "np.ndarray", G: float) -> None:
    """Time histories and phase plane; section: which samples stand at the drive's phase."""
    import numpy as np

    from capsule_id.report.figures_capsule import MotionView, motion
    from capsule_id.report.style import png

    x_rel, rate = np.asarray(t.x_rel), np.asarray(t.Y1 - t.Y2)
    view = MotionView(np.asarray(t.times), x_rel, np.asarray(t.X2), rate, x_rel[section], rate[section], G)
    path.write_bytes(png(motion(view)))


def _check_suffix(path: Path, suffixes: tuple[str, ...]) -> None:
    if path.suffix not in suffixes:
        raise InputError(f"the file must end in {' or '.join(suffixes)}", str(path), "change its name")
    if not path.parent.is_dir():
        raise InputError("the folder of the output must exist", str(path.parent), "make it first")


def _prefer_whole_loops() -> None:
    """Set XLA's option for this process, unless JAX already runs or the user has set options of that kind."""
    flags = os.environ.get("XLA_FLAGS", "")
    if "jax" not in sys.modules and "xla_backend_extra_options" not in flags:
        os.environ["XLA_FLAGS"] = f"{flags} {WHOLE_LOOPS}".strip()
