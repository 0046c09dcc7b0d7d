"""``capsule-id predict RESULT SETTINGS``: displacements at new settings, from a result with a progression."""

import argparse
from pathlib import Path

from capsule_id.commands.compilation import add_cache_argument, keep_programs, set_xla_options
from capsule_id.console import say
from capsule_id.errors import InputError
from capsule_id.views import counted


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add RESULT, SETTINGS and the options."""
    parser.add_argument("result", metavar="RESULT", type=Path, help="result directory of fit-params")
    parser.add_argument("settings", metavar="SETTINGS", type=Path, help="table of a progression without distance")
    parser.add_argument("--out", metavar="FILE", type=Path, required=True, help="table of the predictions, a new file")
    parser.add_argument("--seed", type=int, default=0, help="random seed of the draws (default 0)")
    add_cache_argument(parser)


def run(args: argparse.Namespace) -> int:
    """Write FILE; 0.

    Raises
    ------
    InputError
        If RESULT is none, holds no sample or no progression, the settings break a rule, or FILE exists.
    """
    if args.seed < 0:
        raise InputError("--seed must not be negative", str(args.seed), "give 0 or more")
    if args.out.exists():
        raise InputError("--out must name a new file", "it exists", "choose another name", args.out)
    set_xla_options()
    if not args.no_cache:
        keep_programs()
    from capsule_id.api import load

    table = load(args.result).predict(args.settings, seed=args.seed)
    try:
        table.to_csv(args.out, index=False, float_format="%.6g", lineterminator="\n")
    except OSError as error:
        raise InputError("--out must be writable", str(error.strerror), "name another file", args.out) from None
    say(f"wrote {args.out}: {counted(len(table), 'setting')}")
    return 0
