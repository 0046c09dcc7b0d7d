"""Tables of free decays: estimates by record, and comparison of the stated with the quoted model."""

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

from capsule_id.experiments.checks.context import Fitted
from capsule_id.experiments.checks.refit import refit
from capsule_id.experiments.checks.series import LEVEL, ljung_box
from capsule_id.experiments.free_vibration.checks import stiffness_by_record
from capsule_id.experiments.free_vibration.settings import DecayModel
from capsule_id.views import ResultTable

if TYPE_CHECKING:
    from capsule_id.experiments.free_vibration.experiment import FreeVibration


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


def second_fit_table(records: "Sequence[FreeVibration]", fit: Fitted) -> list[ResultTable]:
    """Compare the decays alone under the stated model and under the quoted one; [] where both are the same."""
    replaced = [record for record in records if record.replaced]
    if not replaced:
        return []
    rows = []
    # Both fits use the same samples, so that their BIC can be compared.
    for role, members in (
        ("stated", [r.with_model(replace(DecayModel.stated(r.table.settings), every=r.model.every)) for r in replaced]),
        ("quoted", replaced),
    ):
        found = fit.refit(members)
        residuals = [series for e in members for _, series in e.records(e.local(found.values))]
        white = all(ljung_box(series)[1] * len(records) >= LEVEL for series in residuals)
        symbols = ("k1", "c", *members[0].model.symbols)
        rows.append(
            {
                "fit": role,
                "model": members[0].model.name,
                "parameters": ", ".join(
                    f"{name} = {found.values[name]:.5g} ± {found.standard_errors[name]:.2g}" for name in symbols
                ),
                "noise, m": float(np.mean([found.values[f"noise_sd[{e.label}]"] for e in members])),
                "BIC": found.bic,
                "residuals white": "yes" if white else "no",
                "starts agree": "yes" if found.agree else "no",
            }
        )
    frame = pd.DataFrame(rows).set_index("fit")
    frame["BIC"] -= frame["BIC"].min()
    return [ResultTable("decays.second_fit", frame, {"lines": replaced[0].model.lines})]
