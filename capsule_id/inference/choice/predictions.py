"""Predicted mean velocities of settings that were left out of the fit, beside the measured ones."""

from collections.abc import Sequence

import numpy as np
import pandas as pd

from capsule_id.experiments.families.trials_experiment import TrialsExperiment
from capsule_id.inference.choice.leave_out import LeftOut
from capsule_id.views import counted

#: Smallest mean velocity whose direction counts, mm/s.
SLOW = 0.5


def left_out_predictions(e: TrialsExperiment, left_out: Sequence[LeftOut], seed: int) -> pd.DataFrame:
    """Compare every setting with its prediction by all other settings.

    Returns
    -------
    DataFrame with a row per setting: ``measured [mm/s]``, the mean of its trials; ``predicted [mm/s]``, the median of a
    new trial in a new session; ``lower [mm/s]`` and ``upper [mm/s]``, its central 95 %; ``trials``, ``inside``, the
    number of its trials and of those in that interval; ``score [mm/s]``, the mean interval score of its trials
    (Gneiting & Raftery 2007); ``shape``, the Pareto shape of the weights.
    """
    rng = np.random.default_rng(seed)
    trials = dict[int, np.ndarray]()
    for draws in dict.fromkeys(one.draws for one in left_out):
        own = [k for k, one in enumerate(left_out) if one.draws is draws]
        drawn = e.new_trials([e.local(values) for values in draws.values], e.settings[own], rng)
        trials.update(zip(own, drawn.T, strict=True))
    rows = list[dict[str, float]]()
    for k, one in enumerate(left_out):
        speed = 1e3 / e.time[k]
        used = np.isfinite(one.log_weight)
        drawn, weights = speed * trials[k][used], np.exp(one.log_weight[used])
        lower, median, upper = (
            np.quantile(drawn, [0.025, 0.5, 0.975], weights=weights, method="inverted_cdf")
            if used.any()
            else np.full(3, np.nan)
        )
        measured = speed * e.distance[e.setting[:, k] > 0.0]
        beyond = np.maximum(lower - measured, 0.0) + np.maximum(measured - upper, 0.0)
        rows.append(
            {
                "measured [mm/s]": float(np.mean(measured)),
                "predicted [mm/s]": median,
                "lower [mm/s]": lower,
                "upper [mm/s]": upper,
                "trials": len(measured),
                "inside": int(np.sum(beyond == 0.0)),
                "score [mm/s]": float(upper - lower + 2.0 / 0.05 * np.mean(beyond)),
                "shape": one.shape,
            }
        )
    return pd.DataFrame(rows, index=pd.Index(e.setting_names(), name=e.label))


def predictions_text(table: pd.DataFrame) -> str:
    """Number of settings whose direction is right, and share of trials in the band."""
    measured, predicted = (table[f"{name} [mm/s]"].to_numpy() for name in ("measured", "predicted"))
    moving = np.abs(measured) > SLOW
    right = np.sum(np.sign(measured[moving]) == np.sign(predicted[moving]))
    inside, trials = (int(np.sum(table[name].to_numpy())) for name in ("inside", "trials"))
    return (
        f"Each setting is predicted by all others: the direction is right in {right} of "
        f"{counted(int(np.sum(moving)), 'setting')} above {SLOW:g} mm/s, and the 95 % band holds {inside} of "
        f"{counted(trials, 'trial')}."
    )
