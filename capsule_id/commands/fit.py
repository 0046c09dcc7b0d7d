"""``fit-params DATA``: from one rig folder or several to parameters, posterior and report."""

import argparse
import shlex
import sys
from collections.abc import Sequence
from pathlib import Path

from capsule_id.commands import NO_CACHE, PATH, QUIET, rig_folders
from capsule_id.commands.compilation import prepare_jax
from capsule_id.commands.rigs import fit_many, fit_one
from capsule_id.console import Progress, fit_stages, say
from capsule_id.errors import InputError, check_seed
from capsule_id.experiments.kind import CHOICES, Registry, default_registry
from capsule_id.rig.model import Rig
from capsule_id.rig.read import read_rig
from capsule_id.views import counted

DEFAULT_MAX_STEPS, DEFAULT_ESS = 2500, 1000


OPTIONS = {
    "": (
        ("data", "DATA", "rig folder: rig.toml and the tables that it names (default: this folder)", {"nargs": "*"}),
        ("--out", "DIR", "result directory (default results/<rig name>); of several rigs DIR/<rig name>", PATH),
        (
            "--scheduler",
            "S",
            "Dask for several rigs: threads, processes or an address tcp://... (default: one after the other)",
        ),
        (
            "--seed",
            "N",
            "random seed (default 0); the same seed gives the same numbers",
            {"type": int, "default": 0},
        ),
        ("--experiments", None, "experiments to fit (default all)", {"choices": CHOICES, "default": "all"}),
        ("--resume", "", "continue an interrupted fit"),
        ("--no-sample", "", "point fit only: no posterior, no intervals"),
        (
            "--max-steps",
            "N",
            f"most emcee steps per ensemble (default {DEFAULT_MAX_STEPS})",
            {"type": int, "default": DEFAULT_MAX_STEPS},
        ),
        (
            "--ess",
            "N",
            f"draw so many effectively independent samples of every parameter (default {DEFAULT_ESS})",
            {"type": int, "default": DEFAULT_ESS},
        ),
        ("--profile", "NAMES", "draw profile likelihoods of these parameters, e.g. k1,v_s, in the report"),
        ("--json", "", "print parameters.json instead of the table"),
        (
            "--compare",
            "WORDS",
            "compare models instead of a fit: some of friction,reaction,lag,cubic; needs a progression. With --no-sample "
            "roughly, by the point fits alone",
        ),
        QUIET,
        NO_CACHE,
    )
}


def run(args: argparse.Namespace) -> int:
    """Fit and write; return 0 for a clean verdict, else 3. See ``fit_many`` for several rigs.

    Raises
    ------
    InputError
        If the input is bad; then nothing is written.
    """
    check_seed(args.seed)
    for option, value in (("--max-steps", args.max_steps), ("--ess", args.ess)):
        if value < 1:
            raise InputError(f"{option} must be positive", str(value), "give 1 or more")
    kinds = default_registry()
    rigs = [read_rig(folder, kinds) for folder in rig_folders(args.data)]
    if args.compare is not None:
        return _compare(args, rigs, kinds)
    args.budget = None if args.no_sample else args.max_steps
    args.command = shlex.join([args.program.split()[0], *sys.argv[1:]])
    root = args.out or Path("results")
    if len(rigs) > 1:
        if args.resume or args.json:
            raise InputError(
                "--resume and --json are for one rig",
                counted(len(rigs), "rig"),
                "remove them; a repetition fits all rigs again",
            )
        with Progress(not args.quiet, "rig") as progress:
            return fit_many(rigs, args, root, args.scheduler, kinds, progress)
    if args.scheduler is not None:
        raise InputError("--scheduler is for several rigs", "one rig", "remove it, or name further folders")
    directory = args.out or root / rigs[0].name
    with Progress(not args.quiet, stages=fit_stages(args.budget is not None)) as progress:
        return fit_one(rigs[0], args, directory, kinds, progress)


def _compare(args: argparse.Namespace, rigs: Sequence[Rig], kinds: Registry) -> int:
    """Print the comparison of models; 0."""
    if len(rigs) > 1:
        raise InputError("--compare takes one rig", counted(len(rigs), "rig"), "name one folder")
    unused = {"out": None, "scheduler": None, "profile": None, "json": False, "resume": False}
    unused |= {"experiments": "all", "max_steps": DEFAULT_MAX_STEPS, "ess": DEFAULT_ESS}
    ignored = [f"--{name}" for name, default in unused.items() if getattr(args, name) != default]
    if ignored:
        names = ", ".join(ignored).replace("_", "-")
        raise InputError("--compare prints tables, writes nothing and fits all experiments", names, f"remove {names}")
    prepare_jax(not args.no_cache)
    from capsule_id.inference.compare import compare_models, compare_points

    compare = compare_points if args.no_sample else compare_models
    with Progress(not args.quiet, "step") as progress:
        choice = compare(rigs[0], args.compare.split(","), kinds, args.seed, progress)
    say(choice.text)
    return 0
