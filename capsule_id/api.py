"""What the commands do, as functions: read a rig folder, fit it, load the result."""

from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path

from capsule_id.console import OnProgress, Progress
from capsule_id.errors import InputError
from capsule_id.experiments import Choice, make_experiments
from capsule_id.experiments.families.friction_model import friction_of
from capsule_id.experiments.registry import Registry, default_registry
from capsule_id.fitted import Fit as Fit
from capsule_id.fitted import compare as compare
from capsule_id.inference.fit.point_stage import fit_points
from capsule_id.inference.pipeline import (
    check_fit,
    check_readings,
    make_result,
    provenance,
    sample_posterior,
    second_models,
    stage_seeds,
    unfinished,
)
from capsule_id.inference.sampling.ensembles import DEFAULT_BUDGET, DEFAULT_ESS
from capsule_id.inference.target.log_posterior import LogPosterior
from capsule_id.physics.friction import FrictionLaw
from capsule_id.report.saved import load as load_fields
from capsule_id.rig import read
from capsule_id.rig.model import Rig


def read_rig(folder: str | Path, registry: Registry | None = None, friction: type[FrictionLaw] | None = None) -> Rig:
    """Read and check a rig folder.

    Parameters
    ----------
    folder : holds ``rig.toml`` and the tables that it names; or the path of ``rig.toml``
    registry : the kinds of experiments that it may have, by default the built-in ones and those of installed packages
    friction : class of a friction law; ``[prior]`` may then state its parameters

    Raises
    ------
    InputError
        At the first fault: file, line and column, the rule, the value found, the remedy.
    """
    if not isinstance(folder, str | Path):
        raise InputError("the rig must be a path (str or Path)", type(folder).__name__, "name a folder with a rig.toml")
    return read.read_rig(folder, registry or default_registry(), () if friction is None else friction.parameters)


def fit(
    rig: Rig | str | Path,
    seed: int = 0,
    experiments: Choice = "all",
    budget: int | None = DEFAULT_BUDGET,
    store: Path | None = None,
    progress: OnProgress | bool | None = None,
    registry: Registry | None = None,
    friction: type[FrictionLaw] | None = None,
    ess: float = DEFAULT_ESS,
    preliminary: Callable[[Fit], None] | None = None,
) -> Fit:
    """Fit a rig: point estimate, posterior, checks. The command ``fit-params`` chooses every one of the parameters.

    Parameters
    ----------
    rig : from ``read_rig``, or what ``read_rig`` reads
    seed : the same seed gives the same numbers
    experiments : "bench", "runs" or "all"
    budget : emcee steps of an ensemble after burn-in; None for the point fit alone
    store : HDF5 file for the chains while they run; the draws in its saved copy are taken up
    progress : called with (draws done, draws until the next check, the stage); True or False: shown or not, by default
        on a terminal and in a notebook
    registry : the kinds that read ``rig``, by default the built-in ones and those of installed packages
    friction : class of a friction law in place of eq. (1); its parameters are fitted instead of mu and v_s
    ess : sampling stops at this bulk and tail effective sample size of every parameter
    preliminary : called before the sampling with the point fit: a result without intervals, panels, notes and records

    Raises
    ------
    InputError
        If ``rig`` cannot be read or holds nothing to fit, ``experiments`` is another word, ``seed``, ``budget`` or
        ``ess`` is out of range, or ``friction`` cannot be fitted.
    """
    rig = rig if isinstance(rig, Rig) else read_rig(rig, registry, friction)
    if not isinstance(seed, int) or seed < 0:
        raise InputError("seed must be a whole number, not negative", repr(seed), "give 0 or more")
    if budget is not None and budget < 1:
        raise InputError(
            "budget must be positive", str(budget), "give 1 or more steps, or None for the point fit alone"
        )
    if not 0 < ess < float("inf"):
        raise InputError("ess must be positive and finite", str(ess), f"give {DEFAULT_ESS:.0f}, the default")
    law = friction_of(rig, friction)
    kinds, seeds = registry or default_registry(), stage_seeds(seed)
    made_from = provenance(rig, seed, experiments, law.source)
    with Progress(progress) if isinstance(progress, bool | None) else nullcontext(progress) as show:
        show(0, 1, "point fit")
        readings = check_readings(rig, experiments, kinds)
        made, second = second_models(make_experiments(rig, experiments, kinds, friction), readings)
        target = LogPosterior(rig, made)
        point = fit_points(target, kinds, seeds.starts, sampled=budget is not None)
        before = (*readings, *second)
        if preliminary is not None and budget is not None:
            first = unfinished(point, before)
            preliminary(make_result(first, kinds, seeds.report, made_from, Fit, panels=False))
        checked = check_fit(sample_posterior(point, seeds.walkers, budget, store, show, ess), before)
        return make_result(checked, kinds, seeds.report, made_from, Fit)


def load(directory: str | Path, registry: Registry | None = None) -> Fit:
    """The result that ``fit-params`` or ``Fit.write`` wrote into ``directory``, equal to the one that ``fit`` returned.

    Parameters
    ----------
    registry : the kinds of the fit, by default the built-in ones and those of installed packages

    Raises
    ------
    InputError
        If ``directory`` holds no result, or one that another version wrote.
    """
    return Fit(**load_fields(Path(directory), registry or default_registry()))
