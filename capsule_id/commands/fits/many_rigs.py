"""Fits of several rigs: one after the other, or on a Dask cluster whose workers may die and come back."""

import sys
import tempfile
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from capsule_id.commands.cluster import client_of
from capsule_id.commands.fits.one_rig import (
    Options,
    check_output,
    failed_checks,
    fingerprint_of,
    prepare_jax,
    write_fit,
)
from capsule_id.console import OnProgress, say
from capsule_id.errors import InputError
from capsule_id.experiments import make_experiments
from capsule_id.experiments.registry import Registry, default_registry
from capsule_id.interruption import stop_if_interrupted
from capsule_id.output import WORK_FILES, publish, work_in_progress
from capsule_id.rig.model import Rig
from capsule_id.views import counted

if TYPE_CHECKING:
    from distributed import Client

#: Exit codes: a rig that cannot be fitted, a failed check, none of them.
FAILED, NOT_CLEAN, CLEAN = 1, 3, 0


@dataclass(frozen=True)
class FittedRig:
    """A result as it comes from a worker: the content of its files by path, and the verdict."""

    files: Mapping[str, bytes]
    verdict: str
    clean: bool


def fit_many(
    rigs: Sequence[Rig], options: Options, root: Path, scheduler: str | None, kinds: Registry, progress: OnProgress
) -> int:
    """Fit every rig, write ``root``/<rig name> as soon as it is fitted, and print its verdict.

    Returns
    -------
    0 where all verdicts are clean, 3 where a check failed, 1 where a rig could not be fitted; the others are fitted
    all the same.

    Raises
    ------
    InputError
        If two rigs have one name, or one of them is bad; then nothing is written.
    """
    twice = [name for name, number in Counter(rig.name for rig in rigs).items() if number > 1]
    if twice:
        raise InputError("rigs that are fitted together must have different names", twice[0], "change name in rig.toml")
    for rig in rigs:
        check_output(root / rig.name, options)
    prepare_jax(options, any(rig.has_runs for rig in rigs))
    from capsule_id.report.texts.messages import messages_of

    messages_of(kinds)
    for rig in rigs:
        make_experiments(rig, options.experiments, kinds)
    failures, unclean = list[str](), list[str]()
    with client_of(scheduler) as client:
        outcomes = _in_process(rigs, options, kinds) if client is None else _on_cluster(client, rigs, options)
        progress(0, len(rigs), "rigs")
        for done, (rig, found) in enumerate(outcomes, start=1):
            stop_if_interrupted()
            if isinstance(found, FittedRig):
                _write(found, root / rig.name, fingerprint_of(rig, options, kinds))
                say(f"{rig.name}: {found.verdict}; report: {root / rig.name / 'report.html'}")
                if not found.clean:
                    unclean.append(rig.name)
            else:
                failures.append(f"{rig.name} ({' '.join(f'{type(found).__name__}: {found}'.split())})")
            progress(done, len(rigs), "rigs")
    if not failures and not unclean:
        return CLEAN
    parts = [f"verdict not clean: {', '.join(unclean)}"] * bool(unclean)
    parts += [f"{counted(len(failures), 'rig')} not fitted: {'; '.join(failures)}"] * bool(failures)
    print(f"fit-params: {'; '.join(parts)}", file=sys.stderr)
    return FAILED if failures else NOT_CLEAN


def fitted_rig(rig: Rig, options: Options, kinds: Registry | None = None) -> FittedRig:
    """Fit one rig in a folder of its own; on a worker with the kinds installed there."""
    prepare_jax(options, rig.has_runs)
    from capsule_id.report.console_table import verdict_text

    kinds = kinds or default_registry()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        result = write_fit(rig, options, folder, kinds, lambda *_: None)
        files = {
            path.relative_to(folder).as_posix(): path.read_bytes()
            for path in folder.rglob("*")
            if path.is_file() and path.name not in WORK_FILES
        }
    return FittedRig(files, verdict_text(result.trust, failed_checks(result, kinds)), result.clean)


def _in_process(
    rigs: Sequence[Rig], options: Options, kinds: Registry
) -> Iterator[tuple[Rig, FittedRig | BaseException]]:
    for rig in rigs:
        try:
            yield rig, fitted_rig(rig, options, kinds)
        except Exception as error:  # the other rigs are fitted all the same
            yield rig, error


def _on_cluster(
    client: "Client", rigs: Sequence[Rig], options: Options
) -> Iterator[tuple[Rig, FittedRig | BaseException]]:
    """Results as they arrive. The scheduler gives the rig of a worker that dies to another one."""
    from distributed import as_completed

    tasks = {client.submit(fitted_rig, rig, options, pure=False): rig for rig in rigs}
    for task in as_completed(list(tasks)):
        error = task.exception()
        yield tasks[task], task.result() if error is None else error


def _write(found: FittedRig, directory: Path, fingerprint: Mapping[str, object]) -> None:
    with work_in_progress(directory, fingerprint, resume=False) as partial:
        for name, content in found.files.items():
            (partial / name).parent.mkdir(exist_ok=True)
            (partial / name).write_bytes(content)
        publish(partial, directory)
