"""``capsule-id predict RESULT SETTINGS``: displacements at new settings, from a result with a progression."""

import argparse
from collections.abc import Callable
from typing import Any

import capsule_id as cid  # imports JAX at the first use of a name
from capsule_id.commands import NO_CACHE, PATH
from capsule_id.console import say
from capsule_id.errors import InputError, refusing
from capsule_id.output import replace_file
from capsule_id.views import counted

OPTIONS = {
    "": (
        ("result", "RESULT", "result directory of fit-params", PATH),
        ("settings", "SETTINGS", "table of a progression without distance", PATH),
        ("--out", "FILE", "table of the predictions, a new file", {**PATH, "required": True}),
        ("--figure", "PNG", "mean velocities against period too, a new file", PATH),
        ("--seed", None, "random seed of the draws (default 0)", {"type": int, "default": 0}),
        NO_CACHE,
    )
}


def run(args: argparse.Namespace) -> int:
    """Write FILE and the figure; 0, or 3 where RESULT is not trusted.

    Raises
    ------
    InputError
        If RESULT is none, holds no sample or no progression, the settings break a rule, or a file exists.
    """
    check_new_files(args)
    from capsule_id.inference.prediction import predict
    from capsule_id.report.figures import fits

    result = cid.load(args.result)
    say_failed(result)
    made = predict(result, args.settings, seed=args.seed)
    table = made.table.to_csv(index=False, float_format="%.6g", lineterminator="\n")
    about = f": {counted(len(made.table), 'setting')}"
    write_new_files(args, table, lambda: fits.side_by_side(made.panels), about=about)
    return 0 if result.clean else 3


def write_new_files(
    args: argparse.Namespace, table: str, draw: Callable[[], Any], synthetic: bool = False, about: str = ""
) -> None:
    """Write ``table`` to ``--out``, then what ``draw`` makes to ``--figure``, and print the names; ``about`` the first.

    synthetic : the figure says that its data are

    Raises
    ------
    InputError
        If a file cannot be written.
    """
    from capsule_id.report.figures import style

    with style.own_style():
        figure = b"" if args.figure is None else style.png(draw(), synthetic)
    for option, file, content in (("--out", args.out, table), ("--figure", args.figure, figure)):
        if file is not None:
            with refusing(f"{option} must be writable", "name another file", file):
                replace_file(file, content)
            say(f"wrote {file}{about if option == '--out' else ''}")


def say_failed(result: "cid.Fit") -> None:
    """Print the failed checks of a result that is not trusted, and its verdict."""
    if result.trust != "trusted":
        failed = [f"fail {found.code}: {result.text(found)}" for found in result.findings if found.level == "fail"]
        say("\n".join([*failed, result.verdict]), coloured=True)


def check_new_files(args: argparse.Namespace) -> None:
    """Refuse ``--out`` and ``--figure`` that are no new files in a directory, and a figure that is no PNG of its own.

    Raises
    ------
    InputError
        At the first fault.
    """
    for option, file in (("--out", args.out), ("--figure", args.figure)):
        if file is None:
            continue
        with refusing(f"{option} must be writable", "name another file", file):
            taken, room = file.exists(), file.parent.is_dir()
        if taken:
            raise InputError(f"{option} must name a new file", "it exists", "choose another name", file)
        if not room:
            raise InputError(f"{option} must stand in a directory", "there is none", f"make {file.parent}", file)
    same = args.figure and args.out and args.figure.resolve() == args.out.resolve()
    if args.figure is not None and (args.figure.suffix.lower() != ".png" or same):
        raise InputError("--figure must name a .png file of its own", args.figure.name, "write NAME.png", args.figure)
