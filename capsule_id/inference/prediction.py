"""Displacement of a capsule robot at new settings, from a fit with progressions."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd

from capsule_id.errors import InputError
from capsule_id.experiments import make_experiments
from capsule_id.experiments.progression.experiment import Progression
from capsule_id.inference.result import Result
from capsule_id.rig.model import Column, Table
from capsule_id.rig.tables import read_settings
from capsule_id.views import Comparison

#: Draws of the posterior; the ends of the 95 % interval then have a standard error of a tenth of its sd.
DRAWS = 1000
#: The reading that is predicted.
READING = "distance"


@dataclass(frozen=True)
class Prediction:
    """Predicted displacements as a table, and panels of mean velocity against period with the trials of the fit."""

    table: pd.DataFrame
    panels: tuple[Comparison, ...]


def predict(result: Result, settings: str | Path, draws: int = DRAWS, seed: int = 0) -> Prediction:
    """Predict a new trial in a new session at each row of a table of settings.

    Parameters
    ----------
    result : of a fit with a progression, sampled; the first one gives reading error and drive
    settings : a file with the columns of that progression, without ``distance``
    draws : draws of the posterior, at most those of the sample
    seed : of the choice of draws, and of sessions and trials

    Returns
    -------
    Its ``table`` has a row per row of ``settings``: ``distance [mm]`` (median), ``distance_lower [mm]`` and
    ``distance_upper [mm]`` (central 95 %, all scatter included), ``mean_velocity [mm/s]`` (of the median).

    Raises
    ------
    InputError
        If nothing was sampled, no progression was fitted, ``draws`` is out of range, or the settings break a rule.
    """
    made = make_experiments(result.rig, "all", result.registry)
    experiment = next((e for e in made if isinstance(e, Progression) and e.label in result.observed), None)
    if experiment is None:
        raise InputError("a prediction needs a fit with a progression", "none", "add one to the rig and fit again")
    if result.posterior is None:
        raise InputError("a prediction needs a sample", "the point fit alone", "fit without --no-sample (budget=None)")
    flat = result.posterior.draws.reshape(-1, len(result.posterior.names))
    if not 1 <= draws <= len(flat):
        raise InputError("draws must lie between 1 and the sample's", str(draws), f"give at most {len(flat)}")
    columns = read_settings(Path(settings), result.registry[experiment.kind], READING)
    _check_settings(experiment.table, columns, Path(settings))
    rng = np.random.default_rng(seed)
    chosen = flat[rng.choice(len(flat), draws, replace=False)]
    constants = {**result.fixed, "g": result.rig.g.value}
    values = [
        experiment.local({**constants, **dict(zip(result.posterior.names, theta, strict=True))}) for theta in chosen
    ]
    rows, time = experiment.settings_of(columns)
    trials = 1e3 * experiment.new_trials(values, rows, rng)
    lower, median, upper = np.quantile(trials, [0.025, 0.5, 0.975], axis=0)
    table = pd.DataFrame(
        {
            "distance [mm]": median,
            "distance_lower [mm]": lower,
            "distance_upper [mm]": upper,
            "mean_velocity [mm/s]": median / time,
        }
    )
    label = "predicted, 95 % band of a new trial"
    return Prediction(table, experiment.speed_panels(rows, median / time, (lower / time, upper / time), label))


def _check_settings(fitted: Table, columns: dict[str, Column], path: Path) -> None:
    """Require the drive columns of the fitted progression."""
    drive = {"duty", "P_on", "P_d", "current"}
    wanted, given = drive & set(fitted.columns), drive & set(columns)
    if wanted != given:
        rule = f"the settings must have the drive columns of {fitted.label}: {' '.join(sorted(wanted)) or 'none'}"
        raise InputError(rule, " ".join(sorted(given)) or "none", "add or remove columns", path, 1, 1)
