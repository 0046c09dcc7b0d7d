"""Tables of forced runs: nondimensional groups and predicted motion."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

from capsule_id.experiments.base import ValuesBySymbol
from capsule_id.experiments.checks.context import Fitted
from capsule_id.records.label import MeasuredMotion, measured_motion
from capsule_id.records.mean_velocity import fit_mean_velocity
from capsule_id.views import ResultTable

if TYPE_CHECKING:
    from capsule_id.experiments.forced_run.experiment import ForcedRun

#: Draws at which velocities are computed, and errors of a record's velocity drawn for each.
VELOCITY_DRAWS, ERRORS = 50, 200


def scaled_groups(runs: "Sequence[ForcedRun]", fit: Fitted) -> list[ResultTable]:
    """Return the paper's nondimensional groups, mean and sd over the posterior draws; [] without a sample.

    Lengths are scaled by F_b/k1, forces by F_b, times by 1/Omega0. Omega0 = sqrt(k1/m1); F_b is the break-away force.
    """
    if not fit.draws:
        return []
    columns: dict[str, list[float]] = {}
    for values in fit.draws:
        for run in runs:
            for name, value in _groups(run, run.local(values)).items():
                columns.setdefault(name, []).append(value)
    rows = {name: [np.mean(column), np.std(column, ddof=1)] for name, column in columns.items()}
    frame = pd.DataFrame.from_dict(rows, orient="index", columns=["mean", "sd"]).rename_axis("group")
    return [ResultTable("runs.groups", frame)]


def _groups(run: "ForcedRun", theta: ValuesBySymbol) -> dict[str, float]:
    p, e = run.capsule(theta)
    m1, m2, k1, k2, c, G = (float(leaf) for leaf in (p.m1, p.m2, p.k1, p.k2, p.c, p.G))  # pyright: ignore[reportArgumentType]
    Omega0, F_b = np.sqrt(k1 / m1), float(run.law(theta).forward(0.0))
    length, of = F_b / k1, run.label
    scales = {"N": ("F_b", F_b), "m/s": ("(Omega0 F_b/k1)", Omega0 * length)}
    own = [(row.symbol, *scales[row.unit]) for row in run.friction.parameters if row.unit in scales]
    return {
        "Omega0, rad/s": Omega0,
        "zeta": c / (2.0 * m1 * Omega0),
        "m2/m1": m2 / m1,
        **{f"{symbol} / {scale}": theta[symbol] / value for symbol, scale, value in own},
        f"Omega/Omega0 [{of}]": run.Omega / Omega0,
        f"P_d/F_b [{of}]": float(e.P_d) / F_b,  # pyright: ignore
        **({f"k2/k1 [{run.spring}]": k2 / k1, f"G k1/F_b [{of}]": G / length} if run.spring is not None else {}),
    }


def predicted_motion(runs: "Sequence[ForcedRun]", fit: Fitted) -> list[ResultTable]:
    """Contacts and mean velocity of the capsule over the record: observed, point fit, 95 % interval of a new record.

    Both velocities come from the estimator of ``capsule_id.records.mean_velocity``, the model's at the sample times.
    """
    rows = {}
    for run in runs:
        best = run.motion(run.local(fit.values), np)
        local = [run.local(draw) for draw in fit.draws[:VELOCITY_DRAWS]]
        stacked = {name: np.array([theta[name] for theta in local]) for name in (local[0] if local else {})}
        sample = run.motion(stacked, np) if local else None
        seen = measured_motion(run.table)
        row: dict[str, object] = {
            "motion of the record": seen.label,
            "probability": seen.probability,
            "contacts, model": int(best.contacts),
        }
        if sample is not None:
            low, high = int(np.min(sample.contacts)), int(np.max(sample.contacts))
            row["contacts, draws"] = f"{low}" if low == high else f"{low} to {high}"
        row |= _velocities(run, seen, np.asarray(best.X2), None if sample is None else np.asarray(sample.X2))
        rows[run.label] = row
    frame = pd.DataFrame.from_dict(rows, orient="index").rename_axis("run")
    return [ResultTable("runs.motion", frame)]


def _velocities(
    run: "ForcedRun", seen: MeasuredMotion, best: np.ndarray, sample: np.ndarray | None
) -> dict[str, object]:
    """Mean velocity of the model, band of a new record, and the record's own with its standard error.

    Parameters
    ----------
    best, sample : X2 of the point fit (n,) and of the draws (draws, n), m
    """
    evidence = seen.evidence
    period = evidence.repeat.period if evidence.repeat else None

    def velocity(place: np.ndarray) -> float:
        return 1e3 * fit_mean_velocity(run.time, place, 2.0 * np.pi / evidence.Omega, period).velocity

    found = evidence.mean_velocity
    sd = 0.0 if found is None or not np.isfinite(found.velocity_sd) else 1e3 * found.velocity_sd
    row: dict[str, object] = {"mean velocity, model, mm/s": velocity(best)}
    if sample is not None:
        error = sd * np.random.default_rng(0).standard_normal((ERRORS, 1))
        low, high = np.quantile(error + np.array([velocity(place) for place in sample]), [0.025, 0.975])
        row["95 % band, mm/s"] = f"{low:.4g} to {high:.4g}"
    if found is not None:
        row["mean velocity, record, mm/s"] = f"{1e3 * found.velocity:.4g} ± {sd:.2g}"
    return row
