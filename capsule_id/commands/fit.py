"""``fit-params DATA``: from one rig folder or several to parameters, posterior and report."""

import shlex
import sys
import time
from argparse import Namespace
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import capsule_id as cid  # imports JAX at the first use of a name
from capsule_id.commands import NO_CACHE, PATH, QUIET, rig_folders
from capsule_id.commands.bifurcate import client_of
from capsule_id.commands.compilation import prepare_jax
from capsule_id.console import (
    OnProgress,
    Progress,
    complain,
    fit_stages,
    one_line,
    save_traceback,
    saved,
    say,
    stop_if_interrupted,
)
from capsule_id.errors import InputError
from capsule_id.experiments.kind import CHOICES, Registry, default_registry, make_experiments
from capsule_id.output import CHAINS, check_directory, publish, work_in_progress, write_file
from capsule_id.report.messages import messages_of
from capsule_id.rig.model import Rig
from capsule_id.rig.read import read_rig
from capsule_id.views import counted

if TYPE_CHECKING:
    from distributed import Client

# rigs: Fits of one rig or of several: result directory, table, verdict; one after the other, or on a Dask cluster.
#
# ``options`` are those of ``fit-params`` as parsed, with ``budget`` (see ``capsule_id.api.fit``) and the ``command`` line.

#: Exit codes: a rig that cannot be fitted, a failed check, none of them.
FAILED, NOT_CLEAN, CLEAN = 1, 3, 0


def check_output(directory: Path, options: Namespace) -> None:
    """Refuse a result directory that the fit must not replace.

    Raises
    ------
    InputError
        If it is no result, or holds a sample and the fit makes none.
    """
    check_directory(directory)
    if options.budget is None and (directory / "posterior.nc").exists():
        raise InputError(
            "--no-sample must not replace a result with a sample",
            "it holds posterior.nc",
            "choose another --out, or move it away",
            directory,
        )


def fingerprint_of(rig: Rig, options: Namespace, kinds: Registry) -> Mapping[str, object]:
    """What an interrupted fit must have in common with the one that resumes it."""
    from capsule_id.inference.pipeline import PACKAGES, package_versions

    return {
        "data": dict(rig.files),
        "seed": options.seed,
        "experiments": options.experiments,
        "max-steps": options.budget,
        "ess": options.ess,
        "versions": {**package_versions(PACKAGES), **kinds.packages},
    }


def make_fit(
    rig: Rig | Path,
    options: Namespace,
    kinds: Registry,
    store: Path | None = None,
    progress: OnProgress | None = None,
    preliminary: Callable[["cid.Fit"], None] | None = None,
) -> "cid.Fit":
    """The fit that the options ask for; ``store``, ``progress`` and ``preliminary`` as in ``capsule_id.fit``."""
    words = options.seed, options.experiments, options.budget, store, progress, kinds
    profile = [name.strip() for name in (options.profile or "").split(",") if name.strip()]
    result = cid.fit(rig, *words, ess=options.ess, preliminary=preliminary, profile=profile)
    made = result.provenance.made[0], options.command
    return replace(result, provenance=replace(result.provenance, made=made))


def fit_one(rig: Rig, options: Namespace, directory: Path, kinds: Registry, progress: Progress) -> int:
    """Fit, write ``directory``, print the table; 0 for a clean verdict, else 3.

    Raises
    ------
    InputError
        If the input is bad; then nothing is written.
    """
    check_output(directory, options)
    # JAX loads only now, so that a faulty folder is reported at once.
    from capsule_id.report import html, write

    make_experiments(rig, options.experiments, kinds)
    messages_of(kinds)  # refuses conflicting messages before the fit
    with work_in_progress(directory, fingerprint_of(rig, options, kinds), options.resume) as unfinished:
        saved.set()

        def show_point(first: "cid.Fit") -> None:
            write_file(unfinished / "report.html", html.render(first, ()))
            progress.note(
                f"point fit, before the sample; report: {unfinished / 'report.html'}\n{first.parameter_table}"
            )

        # A fit of bench tests ends as soon.
        preliminary = show_point if rig.has_runs and options.experiments != "bench" else None
        result = make_fit(rig, options, kinds, unfinished / CHAINS, progress, preliminary)
        write.write_result(write.result_files(result), unfinished)
        publish(unfinished, directory)
    saved.clear()
    report = directory / "report.html"
    if options.json:
        say((directory / "parameters.json").read_text(encoding="utf-8").rstrip())
    else:
        say(f"{result.parameter_table}\nreport: {report}\n{result.verdict}", coloured=True)
    if not result.clean:
        complain(f"{options.program}: verdict not clean: {', '.join(result.failed)}; see {report}")
    return CLEAN if result.clean else NOT_CLEAN


#: Time between two looks at the tasks of a cluster, s.
POLL = 0.1


#: What comes from a worker: the content of the files of a result by path, the line about it, whether it is clean.
FittedRig = tuple[Mapping[str, bytes], str, bool]


def fit_many(
    rigs: Sequence[Rig], options: Namespace, root: Path, scheduler: str | None, kinds: Registry, progress: OnProgress
) -> int:
    """Fit every rig, write ``root``/<rig name> as soon as it is fitted, and print its verdict.

    Returns
    -------
    0 where all verdicts are clean, 3 where a check failed, 1 where a rig could not be fitted; the others are fitted
    all the same.

    Raises
    ------
    InputError
        If two rigs have one name, one of them is bad, or an output directory cannot be; then nothing is written.
    """
    twice = [name for name, number in Counter(rig.name.casefold() for rig in rigs).items() if number > 1]
    if twice:
        rule, remedy = "rigs that are fitted together must have different names", "change one name in rig.toml"
        raise InputError(rule, twice[0], f"{remedy}, or name each folder once")
    if (root / "parameters.json").exists():
        raise InputError(
            "the output directory of several rigs must be none of a result",
            "it holds parameters.json",
            "choose another --out",
            root,
        )
    for rig in rigs:
        check_output(root / rig.name, options)
    from capsule_id.report.write import replace_result

    messages_of(kinds)
    for rig in rigs:
        make_experiments(rig, options.experiments, kinds)
    failures, unclean = list[str](), list[str]()
    with client_of(scheduler) as client:
        progress(0, len(rigs), "rigs")
        for done, (rig, fitted) in enumerate(
            # A worker has the kinds that are installed there.
            each_result(
                client, partial(fitted_rig, options=options, root=root, kinds=kinds if client is None else None), rigs
            ),
            start=1,
        ):
            try:
                files, line, clean = fitted()
                stop_if_interrupted()
                replace_result(files, root / rig.name, fingerprint_of(rig, options, kinds))
            except Exception as error:  # the other rigs are fitted all the same
                stop_if_interrupted()
                traceback = "" if isinstance(error, InputError | OSError) else f"; {save_traceback(error)}"
                failures.append(f"{rig.name} ({one_line(error)}{traceback})")
            else:
                say(line, coloured=True)
                unclean += [rig.name] * (not clean)
            progress(done, len(rigs), "rigs")
    parts = [f"verdict not clean: {', '.join(unclean)}"] * bool(unclean)
    parts += [f"{counted(len(failures), 'rig')} not fitted: {'; '.join(failures)}"] * bool(failures)
    if parts:
        complain(f"{options.program}: {'; '.join(parts)}")
    return FAILED if failures else NOT_CLEAN if unclean else CLEAN


def fit_by_worker(rig: Rig | Path, options: Namespace, kinds: Registry | None = None) -> "cid.Fit":
    """``make_fit`` without progress, on a worker with the kinds installed there.

    Raises
    ------
    RuntimeError
        If the fit is interrupted: a thread of a worker must not end by ``KeyboardInterrupt``.
    """
    prepare_jax(not options.no_cache)
    try:
        return make_fit(rig, options, kinds or default_registry(), None, lambda *_: None)
    except KeyboardInterrupt:
        raise RuntimeError("interrupted") from None


def fitted_rig(rig: Rig, options: Namespace, root: Path, kinds: Registry | None = None) -> FittedRig:
    """Fit one rig, which is written to ``root``/<rig name>."""
    result = fit_by_worker(rig, options, kinds)
    from capsule_id.report import columns, write

    line = f"{rig.name}: {result.verdict}; report: {root / rig.name / 'report.html'}"
    return write.result_files(result), "\n".join([line, *columns.wrapped(result.remarks)]), result.clean


def each_result(
    client: "Client | None", work: Callable[[Any], Any], items: Iterable[Any]
) -> Iterator[tuple[Any, Callable[[], Any]]]:
    """Each item with the function that returns what ``work`` makes of it: in turn, or from a cluster as they arrive.

    The scheduler gives the item of a worker that dies to another one.
    """
    if client is None:
        yield from ((item, partial(work, item)) for item in items)
    tasks = {client.submit(work, item, pure=False): item for item in items} if client is not None else {}
    while tasks:
        # A wait for the next result would not notice an interruption.
        stop_if_interrupted()
        for task in [task for task in tasks if task.done()]:
            yield tasks.pop(task), task.result
        time.sleep(POLL)


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


def run(args: Namespace) -> int:
    """Fit and write; return 0 for a clean verdict, else 3. See ``fit_many`` for several rigs.

    Raises
    ------
    InputError
        If the input is bad; then nothing is written.
    """
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


def _compare(args: Namespace, rigs: Sequence[Rig], kinds: Registry) -> int:
    """Print the comparison of models; 0."""
    if len(rigs) > 1:
        raise InputError("--compare takes one rig", counted(len(rigs), "rig"), "name one folder")
    unused = {
        "out": None,
        "scheduler": None,
        "profile": None,
        "json": False,
        "resume": False,
        "experiments": "all",
        "max_steps": DEFAULT_MAX_STEPS,
        "ess": DEFAULT_ESS,
    }
    ignored = [f"--{name}" for name, default in unused.items() if getattr(args, name) != default]
    if ignored:
        names = ", ".join(ignored).replace("_", "-")
        raise InputError("--compare prints tables, writes nothing and fits all experiments", names, f"remove {names}")
    compare = cid.compare_points if args.no_sample else cid.compare_models
    with Progress(not args.quiet, "step") as progress:
        choice = compare(rigs[0], [word.strip() for word in args.compare.split(",")], kinds, args.seed, progress)
    say(choice.text)
    return 0
