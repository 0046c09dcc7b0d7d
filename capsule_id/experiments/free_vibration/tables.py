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
from capsule_id.experiments.free_vibration.second_fit.fits import Screened, Screening
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


def damping_table(records: "Sequence[FreeVibration]", fit: Fitted) -> list[ResultTable]:
    """Correlations of the damping parameters; [] where all damping is viscous."""
    symbols = dict.fromkeys(symbol for record in records for symbol in record.model.symbols if symbol != "k_cubic")
    if not symbols:
        return []
    names = ["c", *symbols]
    frame = pd.DataFrame(fit.correlation(names), index=pd.Index(names, name="correlation"), columns=names)
    return [ResultTable("decays.damping", frame)]


def second_fit_table(records: "Sequence[FreeVibration]", fit: Fitted) -> list[ResultTable]:
    """Compare the decays alone under the stated model and under the quoted one; [] where both are the same."""
    del fit
    replaced = [(record, record.about.screened) for record in records if record.about.screened is not None]
    if not replaced:
        return []
    # Both fits use the same samples, so that their BIC can be compared.
    thins = [replace(DecayModel.stated(record.table.settings), thin=record.model.thin) for record, _ in replaced]
    stated = [Screening(record, model.thin).fit(model)[0] for (record, _), model in zip(replaced, thins, strict=True)]
    rows = []
    for role, model, fits in (
        ("stated", thins[0], stated),
        ("quoted", replaced[0][0].model, [screened for _, screened in replaced]),
    ):
        means = {symbol: _weighted_mean(fits, symbol) for symbol in ("k1", "c", *model.symbols)}
        white = all(ljung_box(one.residuals)[1] * len(records) >= LEVEL for one in fits)
        rows.append(
            {
                "fit": role,
                "model": model.name,
                "parameters": ", ".join(f"{name} = {mean:.5g} ± {sd:.2g}" for name, (mean, sd) in means.items()),
                "noise, SI": float(np.mean([one.noise for one in fits])),
                "BIC": sum(one.bic for one in fits),
                "residuals white": "yes" if white else "no",
            }
        )
    frame = pd.DataFrame(rows).set_index("fit")
    frame["BIC"] -= frame["BIC"].min()
    return [ResultTable("decays.second_fit", frame, {"lines": replaced[0][0].model.lines})]


def _weighted_mean(fits: "Sequence[Screened]", symbol: str) -> tuple[float, float]:
    """Mean of the estimates of every record, weighted by their standard errors, and its standard error."""
    weight = np.array([one.errors[symbol] for one in fits]) ** -2.0
    return float(np.average([one.values[symbol] for one in fits], weights=weight)), float(np.sum(weight) ** -0.5)
