"""The fit of one rig: result directory, table, verdict."""

import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from capsule_id.commands.compilation import keep_programs, set_xla_options
from capsule_id.console import OnProgress, Progress, say
from capsule_id.errors import InputError
from capsule_id.experiments import Choice, make_experiments
from capsule_id.experiments.registry import Registry
from capsule_id.output import CHAINS, check_directory, publish, work_in_progress
from capsule_id.rig.model import Rig

if TYPE_CHECKING:
    from capsule_id.api import Fit


@dataclass(frozen=True)
class Options:
    """Options of a fit.

    Attributes
    ----------
    seed, experiments, budget, ess : see ``capsule_id.api.fit``
    cached : whether compiled programs are kept in the user's cache
    command : the command line, for the report
    """

    seed: int
    experiments: Choice
    budget: int | None
    ess: float
    cached: bool
    command: str


def check_output(directory: Path, options: Options) -> None:
    """Refuse a result directory that the fit must not replace.

    Raises
    ------
    InputError
        If it is no result, or holds a sample and the fit makes none.
    """
    check_directory(directory)
    if options.budget is None and (directory / "posterior.nc").exists():
        rule, remedy = "--no-sample must not replace a result with a sample", "choose another --out, or move it away"
        raise InputError(rule, "it holds posterior.nc", remedy, directory)


def prepare_jax(options: Options, has_runs: bool) -> None:
    """Set the options of XLA, before JAX loads, the heap, and the cache of programs."""
    set_xla_options(loop=options.experiments != "bench" and has_runs)
    if options.cached:
        keep_programs()


def fingerprint_of(rig: Rig, options: Options, kinds: Registry) -> Mapping[str, object]:
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


def write_fit(
    rig: Rig,
    options: Options,
    folder: Path,
    kinds: Registry,
    progress: OnProgress,
    preliminary: Callable[["Fit"], None] | None = None,
) -> "Fit":
    """Fit, and write the result and the saved chains to ``folder``. ``preliminary`` as in ``capsule_id.fit``."""
    from capsule_id.api import fit
    from capsule_id.report.write import write_result

    store = folder / CHAINS
    result = fit(
        rig,
        options.seed,
        options.experiments,
        options.budget,
        store,
        progress,
        kinds,
        ess=options.ess,
        preliminary=preliminary,
    )
    made = result.provenance.made[0], options.command
    result = replace(result, provenance=replace(result.provenance, made=made))
    progress(0, 1, "report")
    write_result(result, folder)
    return result


def fit_one(
    rig: Rig,
    options: Options,
    directory: Path,
    kinds: Registry,
    progress: Progress,
    *,
    resume: bool = False,
    as_json: bool = False,
) -> int:
    """Fit, write ``directory``, print the table; 0 for a clean verdict, else 3. As many parameters as the command has.

    Raises
    ------
    InputError
        If the input is bad; then nothing is written.
    """
    check_output(directory, options)
    prepare_jax(options, rig.has_runs)
    # JAX loads only now, so that a faulty folder is reported at once.
    from capsule_id.report.console_table import table_text, wrapped
    from capsule_id.report.texts.messages import messages_of
    from capsule_id.report.write import write_report

    make_experiments(rig, options.experiments, kinds)
    messages_of(kinds)  # refuses conflicting messages before the fit
    with work_in_progress(directory, fingerprint_of(rig, options, kinds), resume) as partial:

        def show_point(first: "Fit") -> None:
            write_report(first, partial)
            table = [table_text(first.summary, synthetic=rig.synthetic), *wrapped(first.remarks)]
            progress.note("\n".join([f"point fit, before the sample; report: {partial / 'report.html'}", *table]))

        # A fit of bench tests ends as soon.
        preliminary = show_point if rig.has_runs and options.experiments != "bench" else None
        result = write_fit(rig, options, partial, kinds, progress, preliminary)
        publish(partial, directory)
    report = directory / "report.html"
    if as_json:
        say((directory / "parameters.json").read_text(encoding="utf-8").rstrip())
    else:
        table = table_text(result.summary, synthetic=rig.synthetic)
        changes = wrapped(result.remarks)
        say("\n".join([table, *changes, f"report: {report}", result.verdict]))
    if result.clean:
        return 0
    print(f"fit-params: verdict not clean: {', '.join(result.failed)}; see {report}", file=sys.stderr)
    return 3
