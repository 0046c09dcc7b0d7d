"""What the commands do, as functions: read a rig folder, fit it."""

from dataclasses import dataclass, fields
from pathlib import Path

from capsule_id.experiments import Choice
from capsule_id.experiments.registry import Registry, default_registry
from capsule_id.inference.pipeline import fit_rig
from capsule_id.inference.result import Result
from capsule_id.inference.sampling.ensembles import DEFAULT_BUDGET
from capsule_id.output import check_directory, publish, work_in_progress
from capsule_id.physics.friction import FrictionLaw
from capsule_id.report.write import write_result
from capsule_id.rig import read
from capsule_id.rig.model import Rig


@dataclass(frozen=True)
class Fit(Result):
    """A ``Result`` that can be written."""

    def write(self, directory: str | Path) -> None:
        """Write parameters.json, parameters.csv, posterior.nc, report.html and figures/ into ``directory``.

        Raises
        ------
        InputError
            If it exists and is not a result of this package.
        """
        path = Path(directory)
        check_directory(path)
        with work_in_progress(path, {}, resume=False) as partial:
            write_result(self, partial)
            publish(partial, path)


def read_rig(folder: str | Path, registry: Registry | None = None, friction: type[FrictionLaw] | None = None) -> Rig:
    """Read and check a rig folder.

    Parameters
    ----------
    folder : holds ``rig.toml`` and the tables that it names
    registry : the kinds of experiments that it may have, by default the built-in ones and those of installed packages
    friction : class of a friction law; ``[prior]`` may then state its parameters

    Raises
    ------
    InputError
        At the first fault: file, line and column, the rule, the value found, the remedy.
    """
    return read.read_rig(folder, registry or default_registry(), () if friction is None else friction.parameters)


def fit(
    rig: Rig,
    seed: int = 0,
    experiments: Choice = "all",
    budget: int | None = DEFAULT_BUDGET,
    friction: type[FrictionLaw] | None = None,
) -> Fit:
    """Fit a rig: point estimate, posterior, checks.

    Parameters
    ----------
    rig : from ``read_rig``
    seed : the same seed gives the same numbers
    experiments : "bench", "runs" or "all"
    budget : emcee steps of an ensemble after burn-in; None for the point fit alone
    friction : class of a friction law in place of eq. (1); its parameters are fitted instead of mu and v_s

    Raises
    ------
    InputError
        If the rig holds nothing to fit, ``experiments`` is another word, or ``friction`` cannot be fitted.
    """
    result = fit_rig(rig, seed, experiments, budget, friction=friction)
    return Fit(**{field.name: getattr(result, field.name) for field in fields(result)})
