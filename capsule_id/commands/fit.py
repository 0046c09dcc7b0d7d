"""``fit-params DATA``: from a rig folder to parameters, posterior and report."""

import argparse
import shlex
import sys
from dataclasses import replace
from pathlib import Path

from capsule_id.commands.compilation import add_cache_argument, keep_programs, set_xla_options
from capsule_id.console import Progress, say
from capsule_id.errors import InputError
from capsule_id.experiments import CHOICES, make_experiments
from capsule_id.experiments.registry import Registry, default_registry
from capsule_id.output import CHAINS, check_directory, publish, work_in_progress
from capsule_id.rig.model import Rig
from capsule_id.rig.read import read_rig

DEFAULT_MAX_STEPS, DEFAULT_ESS = 20_000, 4000


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add DATA and the options."""
    parser.add_argument("data", metavar="DATA", help="rig folder: rig.toml and the tables that it names")
    parser.add_argument("--out", type=Path, metavar="DIR", help="result directory (default results/<rig name>)")
    parser.add_argument(
        "--seed", type=int, default=0, metavar="N", help="random seed (default 0); the same seed gives the same numbers"
    )
    parser.add_argument("--experiments", choices=CHOICES, default="all", help="experiments to fit (default all)")
    parser.add_argument("--resume", action="store_true", help="continue an interrupted fit")
    parser.add_argument("--no-sample", action="store_true", help="point fit only: no posterior, no intervals")
    parser.add_argument(
        "--max-steps",
        type=int,
        default=DEFAULT_MAX_STEPS,
        metavar="N",
        help=f"most emcee steps per ensemble (default {DEFAULT_MAX_STEPS})",
    )
    parser.add_argument(
        "--ess",
        type=int,
        default=DEFAULT_ESS,
        metavar="N",
        help=f"draw so many effectively independent samples of every parameter (default {DEFAULT_ESS})",
    )
    parser.add_argument("--json", action="store_true", help="print parameters.json instead of the table")
    parser.add_argument(
        "--compare",
        metavar="WORDS",
        help="compare models instead of a fit: some of friction,reaction,lag,cubic; needs a progression",
    )
    parser.add_argument("--quiet", action="store_true", help="no progress on standard error")
    add_cache_argument(parser)


def run(args: argparse.Namespace) -> int:
    """Fit and write; return 0 for a clean verdict, else 3.

    Raises
    ------
    InputError
        If the input is bad; then nothing is written.
    """
    _check_numbers(args)
    kinds = default_registry()
    rig = read_rig(args.data, kinds)
    if args.compare is not None:
        return _compare(args, rig, kinds)
    directory = args.out if args.out is not None else Path("results") / rig.name
    check_directory(directory)
    if args.no_sample and (directory / "posterior.nc").exists():
        rule, remedy = "--no-sample must not replace a result with a sample", "choose another --out, or move it away"
        raise InputError(rule, "it holds posterior.nc", remedy, directory)
    set_xla_options(loop=args.experiments != "bench" and rig.has_runs)
    if not args.no_cache:
        keep_programs()
    # JAX loads only now, so that a faulty folder is reported at once.
    from capsule_id.api import fit
    from capsule_id.inference.pipeline import PACKAGES, package_versions
    from capsule_id.report.console_table import table_text, verdict_text
    from capsule_id.report.texts.messages import messages_of, title_of
    from capsule_id.report.write import write_result

    make_experiments(rig, args.experiments, kinds)
    messages = messages_of(kinds)  # refuses conflicting messages before the fit
    budget = None if args.no_sample else args.max_steps
    fingerprint = {
        "data": dict(rig.files),
        "seed": args.seed,
        "experiments": args.experiments,
        "max-steps": budget,
        "ess": args.ess,
        "versions": {**package_versions(PACKAGES), **kinds.packages},
    }
    with work_in_progress(directory, fingerprint, args.resume) as partial, Progress(not args.quiet) as progress:
        result = fit(rig, args.seed, args.experiments, budget, partial / CHAINS, progress, kinds, ess=args.ess)
        made = result.provenance.made[0], shlex.join(["fit-params", *sys.argv[1:]])
        result = replace(result, provenance=replace(result.provenance, made=made))
        progress(0, 1, "report")
        write_result(result, partial)
        publish(partial, directory)
    report = directory / "report.html"
    failed = sorted({title_of(finding.code, messages) for finding in result.findings if finding.level == "fail"})
    if args.json:
        say((directory / "parameters.json").read_text(encoding="utf-8").rstrip())
    else:
        table = table_text(result.summary, synthetic=rig.synthetic)
        say("\n".join([table, f"report: {report}", verdict_text(result.trust, failed)]))
    if result.clean:
        return 0
    print(f"fit-params: verdict not clean: {', '.join(failed)}; see {report}", file=sys.stderr)
    return 3


def _check_numbers(args: argparse.Namespace) -> None:
    """Refuse numbers that no fit has."""
    if args.seed < 0:
        raise InputError("--seed must not be negative", str(args.seed), "give 0 or more")
    if args.max_steps < 1:
        raise InputError("--max-steps must be positive", str(args.max_steps), "give 1 or more")
    if args.ess < 1:
        raise InputError("--ess must be positive", str(args.ess), "give 1 or more")


def _compare(args: argparse.Namespace, rig: Rig, kinds: Registry) -> int:
    """Print the comparison of models; 0."""
    unused = {"out": None, "json": False, "no_sample": False, "resume": False}
    unused |= {"experiments": "all", "max_steps": DEFAULT_MAX_STEPS, "ess": DEFAULT_ESS}
    ignored = [f"--{name}" for name, default in unused.items() if getattr(args, name) != default]
    if ignored:
        names = ", ".join(ignored).replace("_", "-")
        raise InputError("--compare prints tables, writes nothing and fits all experiments", names, f"remove {names}")
    set_xla_options()
    if not args.no_cache:
        keep_programs()
    from capsule_id.inference.choice.compare import compare_models

    with Progress(not args.quiet, "variant") as progress:
        choice = compare_models(rig, args.compare.split(","), kinds, args.seed, progress)
    say(choice.text)
    return 0
