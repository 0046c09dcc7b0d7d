"""Tables of free decays: estimates by record, and comparison of damping models."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

from capsule_id.experiments.checks.context import Fitted
from capsule_id.experiments.checks.refit import refit
from capsule_id.experiments.checks.series import LEVEL, ljung_box
from capsule_id.experiments.free_vibration.checks import stiffness_by_record
from capsule_id.experiments.free_vibration.settings import DAMPING, DecayModel
from capsule_id.views import ResultTable

if TYPE_CHECKING:
    from capsule_id.experiments.free_vibration.experiment import FreeVibration

#: Damping models for comparison when the residuals of a decay are not white.
DAMPING_MODELS = ("viscous", "dry", "quadratic")


def decay_table(records: "Sequence[FreeVibration]", fit: Fitted) -> list[ResultTable]:
    """Compare k1 and c of every record alone with the paper's protocol."""
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
    return [ResultTable("decays.records", pd.DataFrame(rows).set_index("record"))]


def damping_table(records: "Sequence[FreeVibration]", fit: Fitted) -> list[ResultTable]:
    """Fit the decays alone with each damping model and rank by BIC; [] where their residuals are white."""
    labels = {record.label for record in records}
    if not any(f.code == "residuals.white" and f.level == "fail" and f.experiment in labels for f in fit.findings):
        return []
    rows = []
    for damping in DAMPING_MODELS:
        others = [record.with_model(DecayModel((damping,) if damping in DAMPING else ())) for record in records]
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
    facts = {"best": str(frame["BIC"].idxmin()), "any_white": "yes" in frame["residuals white"].tolist()}
    return [ResultTable("decays.damping", frame, facts)]
