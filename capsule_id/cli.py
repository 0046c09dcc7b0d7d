"""Entry points of the two commands ``fit-params`` and ``capsule-id``: parse, call, exit code."""

import argparse
import re
import sys
import warnings
from collections.abc import Callable, Mapping, Sequence
from difflib import get_close_matches
from functools import partial
from importlib import import_module
from importlib.metadata import version
from pathlib import Path
from typing import Any, NoReturn, TextIO

from capsule_id import console
from capsule_id.commands import add_options
from capsule_id.commands.compilation import leave_cache, prepare_jax, use_one_blas_thread
from capsule_id.console import INTERRUPTED, end_interrupted, interruptible
from capsule_id.errors import InputError, OutputError

BAD_INPUT, INTERNAL = 2, 1


class _Parser(argparse.ArgumentParser):
    """Reports wrong usage in one line on standard error, with exit code 2; a mistyped word with the one that it resembles."""

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        # As in Python 3.14: -1e-3 is a value, too.
        self._negative_number_matcher = re.compile(r"-(\d+\.?\d*|\.\d+)(e[+-]?\d+)?$", re.IGNORECASE)

    def error(self, message: str) -> NoReturn:
        if mistyped := re.search(r"invalid choice: '(.*)' \(choose from (.*)\)$", message):
            near = get_close_matches(mistyped[1], re.findall(r"[\w-]+", mistyped[2]), n=1)
            message += f"; did you mean {near[0]}?" if near else ""
        console.complain(" ".join(f"{self.prog}: {message}; see {self.prog} --help".split()))
        raise SystemExit(BAD_INPUT)


def fit_params(arguments: Sequence[str] | None = None) -> int:
    """Entry point of ``fit-params``; returns the exit code."""
    return _run("fit-params", _fit_parser, arguments)


def capsule_id(arguments: Sequence[str] | None = None) -> int:
    """Entry point of ``capsule-id``; returns the exit code."""
    return _run("capsule-id", _capsule_parser, arguments)


def _parser(program: str, text: str, example: str) -> _Parser:
    """A parser with ``--version``. It takes no abbreviated options: a new option must not change an old command."""
    parser = _Parser(prog=program, description=text, epilog=example, allow_abbrev=False)
    parser.add_argument("--version", action="version", version=f"{program} {version('capsule-id')}")
    return parser


def _fit_parser(program: str) -> argparse.ArgumentParser:
    from capsule_id.commands import fit

    text = (
        "Fit the vibro-impact capsule to a folder of rig measurements. Prints value, sd and trust of every parameter, and "
        "writes report.html. capsule-id init makes such a folder, capsule-id check examines it. Exit code 3: a check failed."
    )
    parser = _parser(program, text, "example: %(prog)s my-rig --seed 1")
    add_options(parser, fit.OPTIONS)
    parser.set_defaults(run=fit.run, program=program)
    return parser


#: Help and example of each command.
COMMANDS: Mapping[str, tuple[str, str]] = {
    "init": ("a rig folder with a commented rig.toml, or one that reads given exports", "my-rig --from decay.csv"),
    "import": ("print the entry that reads an export", "decay.csv"),
    "check": ("check a rig folder and list problems before a fit", "my-rig --figures figures"),
    "fit": ("fit a rig folder, as fit-params does", "my-rig --seed 1"),
    "synthesize": ("a rig folder with known truth", "twin --seed 1 --set k1=1500"),
    "simulate": (
        "the capsule model: time histories and phase plane",
        "--k2 18960 --G 0.001 --P_d 4 --Omega 34.56 --out motion.csv",
    ),
    "bifurcate": (
        "the settled motions over one quantity or two: bifurcation diagrams and maps",
        "--over k2 --from 1 --to 55 --unit kN/m",
    ),
    "predict": (
        "displacements of a capsule robot at new settings, from a result",
        "results/robot settings.csv --out predicted.csv",
    ),
    "tune": (
        "the settings of drive and rig with the largest mean velocity, from a result",
        "results/twin --P_d 1 6 --Omega 20 50 --G 0.001 --spring soft --out tuned.csv",
    ),
    "plan": ("what planned tests would show, from the priors, before they are made", "my-rig"),
    "next": (
        "further tests, ranked by the uncertainty that they leave, from a result",
        "results/twin --for c,v_s --minutes 30",
    ),
    "calibrate": ("fit rigs with known truth, and test the ranks of the truth", "calibration --rigs 60"),
    "report": ("the parameter table and findings of a result, or several side by side", "results/rig-a results/rig-b"),
}


def _capsule_parser(program: str) -> argparse.ArgumentParser:
    example = "example: %(prog)s check my-rig; each COMMAND has its own --help"
    parser = _parser(program, "Make, check, fit, simulate and report.", example)
    parser.set_defaults(run=lambda args: console.say(parser.format_help()) or 0)
    commands = parser.add_subparsers(metavar="COMMAND", parser_class=_Parser)
    for name, (text, example) in COMMANDS.items():
        module = import_module(f"capsule_id.commands.{'import_file' if name == 'import' else name}")
        example = f"example: %(prog)s {example}"
        sub = commands.add_parser(name, help=text, description=text, epilog=example, allow_abbrev=False)
        add_options(sub, module.OPTIONS)
        sub.set_defaults(run=module.run, program=sub.prog)
    return parser


def _run(program: str, make_parser: Callable[[str], argparse.ArgumentParser], arguments: Sequence[str] | None) -> int:
    """Parse and act. Every end gives an exit code; on standard error a line for each fault of the input, or else one."""
    try:
        code = _act(program, make_parser, arguments)
    except OutputError as error:
        console.complain(console.ending(f"{program}: {error}"))
        code = INTERNAL
    if arguments is None:  # the process ends with this command
        end_interrupted(code)
    return code


def _act(program: str, make_parser: Callable[[str], argparse.ArgumentParser], arguments: Sequence[str] | None) -> int:
    """Parse and act.

    Raises
    ------
    OutputError
        If standard output takes no more text.
    """
    console.prepare()
    use_one_blas_thread()
    interrupted = f"{program}: interrupted"
    try:
        # The parsers load NumPy: an interruption must count from before that.
        with warnings.catch_warnings(), interruptible(interrupted):
            args = make_parser(program).parse_args(arguments)
            warnings.showwarning = partial(_show_warning, program)
            if "no_cache" in args:  # a command that computes with JAX, which nothing has imported yet
                prepare_jax(not args.no_cache)
            # bifurcate reads its seed as it reads the other numbers of a sweep.
            if isinstance(getattr(args, "seed", None), int) and args.seed < 0:
                raise InputError("--seed must not be negative", str(args.seed), "give 0 or more")
            return args.run(args)
    except OutputError:
        raise
    except SystemExit as stop:  # of the parser
        console.finish()
        return int(stop.code or 0)
    except InputError as error:
        console.complain(error.shown if sys.stderr.isatty() else error)
        return BAD_INPUT
    except KeyboardInterrupt:
        console.complain(console.ending(interrupted))
        return INTERRUPTED
    except Exception as error:
        console.complain(f"{program}: internal failure: {console.one_line(error)}; {console.save_traceback(error)}")
        return INTERNAL


def _show_warning(
    program: str,
    message: Warning | str,
    category: type[Warning],
    filename: str,
    lineno: int,
    file: TextIO | None = None,
    line: str | None = None,
) -> None:
    """Print a warning in one line on standard error. The signature is that of ``warnings.showwarning``."""
    place = f"{Path(filename).name}:{lineno}"
    text = leave_cache(str(message))
    if text == str(message):
        text = f"{category.__name__}: {message} ({place})"
    console.complain(" ".join(f"{program}: warning: {text}".split()))
