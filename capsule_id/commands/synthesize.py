"""``capsule-id synthesize``: writes a rig folder with known truth."""

import argparse

from capsule_id.commands import PATH
from capsule_id.console import say
from capsule_id.errors import InputError, refusing

OPTIONS = {
    "": (
        ("directory", "DIR", "new or empty folder", PATH),
        ("--seed", None, "random seed of the reading errors (default 0)", {"type": int, "default": 0}),
        ("--name", None, "name of the rig (default: the folder's)"),
        ("--robot", "", "a capsule robot with a progression instead of a bench rig"),
        ("--runs", "", "add forced runs, computed with the exact model"),
        ("--set", "NAME=VALUE", "true values, SI: k1=1500 'k2[soft]=2500'", {"nargs": "+", "default": []}),
    )
}


def run(args: argparse.Namespace) -> int:
    """Write the folder and ``DIR.truth.json`` beside it; 0.

    Raises
    ------
    InputError
        If DIR is not empty, or a value cannot be set.
    """
    from capsule_id.experiments.kind import default_registry
    from capsule_id.synthetic import ROBOT, Truth, synthesize, synthesize_robot

    values, beside = dict(assignment(text) for text in args.set), ""
    if args.robot and (unknown := sorted(set(values) - set(ROBOT))):
        raise InputError("--set takes a parameter of the robot", unknown[0], f"choose from {', '.join(ROBOT)}")
    with refusing("DIR must be writable", "name another one", args.directory):
        if args.robot:
            synthesize_robot(args.directory, args.seed, None, values)
        else:
            kinds = (kind for kind in default_registry().values() if kind.bench or args.runs)
            truth = Truth().with_kinds(kinds).with_values(values)
            synthesize(args.directory, args.seed, truth, args.name, args.runs)
            beside = f" and {args.directory.resolve().name}.truth.json beside it"
    say(f"wrote {args.directory} (SYNTHETIC, seed {args.seed}){beside}")
    return 0


def assignment(text: str) -> tuple[str, float]:
    """Name and value of ``NAME=VALUE``."""
    name, _, value = text.partition("=")
    try:
        return name, float(value)
    except ValueError:
        raise InputError("--set takes NAME=VALUE", text, "give a number in SI units, e.g. k1=1500") from None
