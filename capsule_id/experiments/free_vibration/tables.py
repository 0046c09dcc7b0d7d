"""Tables of free decays: record by record, and the damping models side by side."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

from capsule_id.experiments.checks.context import Fitted
from capsule_id.experiments.checks.refit import refit
from capsule_id.experiments.checks.series import LEVEL, ljung_box
from capsule_id.experiments.free_vibration.checks import stiffness_by_record
from capsule_id.views import NoteTable

if TYPE_CHECKING:
    from capsule_id.experiments.free_vibration.experiment import FreeVibration

#: The damping models that are compared when the residuals of a decay are not white.
DAMPING_MODELS = ("viscous", "dry", "quadratic")
_VERDICTS = {
    "viscous": "Neither dry nor quadratic damping describes the decays better than viscous damping alone.",
    "dry": "Dry friction beside the viscous damping fits best: it takes off the same amount every cycle.",
    "quadratic": "Quadratic beside viscous damping fits best: the damping grows with amplitude.",
}


def decay_table(records: "Sequence[FreeVibration]", fit: Fitted) -> list[NoteTable]:
    """k1 and c of every record alone, beside the paper's protocol."""
    k1, k1_sd, deflection = stiffness_by_record(records, fit.values)
    rows = []
    for i, record in enumerate(records):
        raw, smooth = record.paper_decrement(smooth=False), record.paper_decrement()
        ours = refit(record, record.local(fit.values), [])
        rows.append(
            {
                "record": record.label,
                "largest deflection, m": deflection[i],
                "k1, N/m": k1[i],
                "± k1": k1_sd[i],
                "c, N s/m": ours["c"][0],
                "± c": ours["c"][1],
                "k1 = m1Ω_o²": smooth.k1 if smooth else np.nan,
                "c, smoothed peaks": smooth.c if smooth else np.nan,
                "c, raw peaks": raw.c if raw else np.nan,
            }
        )
    caption = (
        "Each record alone, by least squares on the whole raw record, beside the paper's protocol. The paper's k1 is low "
        "by ζ² (it takes the damped frequency for the natural one); its c depends on how peaks are read out of noise."
    )
    return [NoteTable("Free vibration, record by record", caption, pd.DataFrame(rows).set_index("record"))]


def damping_table(records: "Sequence[FreeVibration]", fit: Fitted) -> list[NoteTable]:
    """The decays alone under each damping model, ranked by BIC; [] where their residuals are white."""
    labels = {record.label for record in records}
    if not any(f.check == "residuals white" and f.level == "fail" and f.experiment in labels for f in fit.findings):
        return []
    rows = []
    for damping in DAMPING_MODELS:
        others = [record.with_damping(damping) for record in records]
        found = fit.refit(others)
        residuals = [series for e in others for _, series in e.records(e.local(found.values))]
        white = all(ljung_box(series)[1] * len(records) >= LEVEL for series in residuals)
        extra = [name for name in ("F_dry", "c_q") if name in found.values]
        rows.append(
            {
                "damping": damping,
                "k1, N/m": found.values["k1"],
                "c, N s/m": found.values["c"],
                "further": ", ".join(
                    f"{name} = {found.values[name]:.4g} ± {found.standard_errors[name]:.2g}" for name in extra
                ),
                "noise, m": float(np.mean([found.values[f"noise_sd[{record.label}]"] for record in records])),
                "BIC": found.bic,
                "residuals white": "yes" if white else "no",
                "starts agree": "yes" if found.agree else "no",
            }
        )
    frame = pd.DataFrame(rows).set_index("damping")
    frame["BIC"] -= frame["BIC"].min()
    best = str(frame["BIC"].idxmin())
    verdict = _VERDICTS[best]
    if "yes" not in frame["residuals white"].tolist():
        verdict += " None of the three leaves white residuals, so something else is at work beside the damping."
    caption = (
        "The damping model asked for leaves structure in the residuals; here are all three, fitted to the decays alone. BIC "
        f'is relative to the best. {verdict} Ask for a model with damping = "viscous", "dry" or "quadratic".'
    )
    return [NoteTable("Damping models compared", caption, frame)]
