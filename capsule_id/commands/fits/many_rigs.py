"""Fits of several rigs: one after the other, or on a Dask cluster whose workers may die and come back."""

import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from capsule_id.commands.cluster import client_of
from capsule_id.commands.fits.one_rig import (
    Options,
    check_output,
    fingerprint_of,
    prepare_jax,
    write_fit,
)
from capsule_id.console import OnProgress, one_line, save_traceback, say
from capsule_id.errors import InputError
from capsule_id.experiments import make_experiments
from capsule_id.experiments.registry import Registry, default_registry
from capsule_id.interruption import stop_if_interrupted
from capsule_id.output import WORK_FILES, check_unfinished, publish, work_in_progress
from capsule_id.rig.model import Rig
from capsule_id.views import counted

if TYPE_CHECKING:
    from distributed import Client

#: Exit codes: a rig that cannot be fitted, a failed check, none of them.
FAILED, NOT_CLEAN, CLEAN = 1, 3, 0
#: Time between two looks at the tasks of a cluster, s.
POLL = 0.1


@dataclass(frozen=True)
class FittedRig:
    """A result as it comes from a worker: the content of its files by path, changes of the model, and the verdict."""

    files: Mapping[str, bytes]
    changes: str
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
        If two rigs have one name, one of them is bad, or an output directory cannot be; then nothing is written.
    """
    twice = [name for name, number in Counter(rig.name.casefold() for rig in rigs).items() if number > 1]
    if twice:
        rule, remedy = "rigs that are fitted together must have different names", "change one name in rig.toml"
        raise InputError(rule, twice[0], f"{remedy}, or name each folder once")
    if (root / "parameters.json").exists():
        rule = "the output directory of several rigs must be none of a result"
        raise InputError(rule, "it holds parameters.json", "choose another --out", root)
    for rig in rigs:
        check_output(root / rig.name, options)
        check_unfinished(root / rig.name)
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
            try:
                if isinstance(found, Exception):
                    raise found
                _write(found, root / rig.name, fingerprint_of(rig, options, kinds))
            except (InputError, OSError) as error:
                failures.append(f"{rig.name} ({one_line(error)})")
            except Exception as error:  # the other rigs are fitted all the same
                failures.append(f"{rig.name} ({one_line(error)}; {save_traceback(error)})")
            else:
                say(f"{rig.name}: {found.verdict}; report: {root / rig.name / 'report.html'}{found.changes}")
                unclean += [rig.name] * (not found.clean)
            progress(done, len(rigs), "rigs")
    if not failures and not unclean:
        return CLEAN
    parts = [f"verdict not clean: {', '.join(unclean)}"] * bool(unclean)
    parts += [f"{counted(len(failures), 'rig')} not fitted: {'; '.join(failures)}"] * bool(failures)
    print(f"fit-params: {'; '.join(parts)}", file=sys.stderr)
    return FAILED if failures else NOT_CLEAN


def fitted_rig(rig: Rig, options: Options, kinds: Registry | None = None) -> FittedRig:
    """Fit one rig in a folder of its own; on a worker with the kinds installed there.

    Raises
    ------
    RuntimeError
        If the fit is interrupted: a thread of a worker must not end by ``KeyboardInterrupt``.
    """
    prepare_jax(options, rig.has_runs)
    from capsule_id.report.console_table import wrapped

    kinds = kinds or default_registry()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        try:
            result = write_fit(rig, options, folder, kinds, lambda *_: None)
        except KeyboardInterrupt:
            raise RuntimeError("interrupted") from None
        files = {
            path.relative_to(folder).as_posix(): path.read_bytes()
            for path in folder.rglob("*")
            if path.is_file() and path.name not in WORK_FILES
        }
    changes = "".join(f"\n{line}" for line in wrapped(result.remarks))
    return FittedRig(files, changes, result.verdict, result.clean)


def _in_process(rigs: Sequence[Rig], options: Options, kinds: Registry) -> Iterator[tuple[Rig, FittedRig | Exception]]:
    for rig in rigs:
        yield rig, _outcome(lambda rig=rig: fitted_rig(rig, options, kinds))


def _on_cluster(client: "Client", rigs: Sequence[Rig], options: Options) -> Iterator[tuple[Rig, FittedRig | Exception]]:
    """Results as they arrive. The scheduler gives the rig of a worker that dies to another one."""
    tasks = {client.submit(fitted_rig, rig, options, pure=False): rig for rig in rigs}
    while tasks:
        # A wait for the next result would not notice an interruption.
        stop_if_interrupted()
        for task in [task for task in tasks if task.done()]:
            yield tasks.pop(task), _outcome(task.result)
        time.sleep(POLL)


def _outcome(result: Callable[[], FittedRig]) -> FittedRig | Exception:
    try:
        return result()
    except Exception as error:
        return error


def _write(found: FittedRig, directory: Path, fingerprint: Mapping[str, object]) -> None:
    with work_in_progress(directory, fingerprint, resume=False) as partial:
        for name, content in found.files.items():
            (partial / name).parent.mkdir(exist_ok=True)
            (partial / name).write_bytes(content)
        publish(partial, directory)
