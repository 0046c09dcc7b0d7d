"""Fits of one rig or of several: result directory, table, verdict; one after the other, or on a Dask cluster.

``options`` are those of ``fit-params`` as parsed, with ``budget`` (see ``capsule_id.api.fit``) and the ``command`` line.
"""

import time
from argparse import Namespace
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from capsule_id.commands.bifurcate import client_of
from capsule_id.commands.compilation import prepare_jax
from capsule_id.console import OnProgress, Progress, complain, one_line, save_traceback, saved, say, stop_if_interrupted
from capsule_id.errors import InputError
from capsule_id.experiments.kind import Registry, default_registry, make_experiments
from capsule_id.output import CHAINS, check_directory, publish, work_in_progress, write_file
from capsule_id.rig.model import Rig
from capsule_id.views import counted

if TYPE_CHECKING:
    from distributed import Client

    from capsule_id.api import Fit

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
    rig: Rig,
    options: Namespace,
    kinds: Registry,
    store: Path | None = None,
    progress: OnProgress | None = None,
    preliminary: Callable[["Fit"], None] | None = None,
) -> "Fit":
    """The fit that the options ask for; ``store``, ``progress`` and ``preliminary`` as in ``capsule_id.fit``."""
    from capsule_id.api import fit

    words = options.seed, options.experiments, options.budget, store, progress, kinds
    profile = [name.strip() for name in (options.profile or "").split(",") if name.strip()]
    result = fit(rig, *words, ess=options.ess, preliminary=preliminary, profile=profile)
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
    prepare_jax(not options.no_cache)
    # JAX loads only now, so that a faulty folder is reported at once.
    from capsule_id.report.html import render
    from capsule_id.report.messages import messages_of
    from capsule_id.report.write import result_files, write_result

    make_experiments(rig, options.experiments, kinds)
    messages_of(kinds)  # refuses conflicting messages before the fit
    with work_in_progress(directory, fingerprint_of(rig, options, kinds), options.resume) as unfinished:
        saved.set()

        def show_point(first: "Fit") -> None:
            write_file(unfinished / "report.html", render(first, ()))
            progress.note(
                f"point fit, before the sample; report: {unfinished / 'report.html'}\n{first.parameter_table}"
            )

        # A fit of bench tests ends as soon.
        preliminary = show_point if rig.has_runs and options.experiments != "bench" else None
        result = make_fit(rig, options, kinds, unfinished / CHAINS, progress, preliminary)
        write_result(result_files(result), unfinished)
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
    prepare_jax(not options.no_cache)
    from capsule_id.report.messages import messages_of

    messages_of(kinds)
    for rig in rigs:
        make_experiments(rig, options.experiments, kinds)
    failures, unclean = list[str](), list[str]()
    with client_of(scheduler) as client:
        fits = ((rig, partial(fitted_rig, rig, options, root, kinds)) for rig in rigs)
        progress(0, len(rigs), "rigs")
        for done, (rig, fitted) in enumerate(
            fits if client is None else _on_cluster(client, rigs, options, root), start=1
        ):
            try:
                files, line, clean = fitted()
                stop_if_interrupted()
                _write(files, root / rig.name, fingerprint_of(rig, options, kinds))
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


def fitted_rig(rig: Rig, options: Namespace, root: Path, kinds: Registry | None = None) -> FittedRig:
    """Fit one rig, which is written to ``root``/<rig name>; on a worker with the kinds installed there.

    Raises
    ------
    RuntimeError
        If the fit is interrupted: a thread of a worker must not end by ``KeyboardInterrupt``.
    """
    prepare_jax(not options.no_cache)
    from capsule_id.report.columns import wrapped
    from capsule_id.report.write import result_files

    try:
        result = make_fit(rig, options, kinds or default_registry(), None, lambda *_: None)
    except KeyboardInterrupt:
        raise RuntimeError("interrupted") from None
    changes = "".join(f"\n{line}" for line in wrapped(result.remarks))
    line = f"{rig.name}: {result.verdict}; report: {root / rig.name / 'report.html'}{changes}"
    return result_files(result), line, result.clean


def _on_cluster(
    client: "Client", rigs: Sequence[Rig], options: Namespace, root: Path
) -> Iterator[tuple[Rig, Callable[[], FittedRig]]]:
    """Results as they arrive. The scheduler gives the rig of a worker that dies to another one."""
    tasks = {client.submit(fitted_rig, rig, options, root, pure=False): rig for rig in rigs}
    while tasks:
        # A wait for the next result would not notice an interruption.
        stop_if_interrupted()
        for task in [task for task in tasks if task.done()]:
            yield tasks.pop(task), task.result
        time.sleep(POLL)


def _write(files: Mapping[str, bytes], directory: Path, fingerprint: Mapping[str, object]) -> None:
    from capsule_id.report.write import write_result

    with work_in_progress(directory, fingerprint, resume=False) as unfinished:
        write_result(files, unfinished)
        publish(unfinished, directory)
