"""Views of free decays: estimates by record, comparison of the stated with the quoted model, and the fitted curve."""

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

from capsule_id.experiments.base import ValuesBySymbol, axis_label, band
from capsule_id.experiments.checks.context import Fitted
from capsule_id.experiments.checks.refit import refit
from capsule_id.experiments.checks.series import LEVEL, autocorrelation, ljung_box
from capsule_id.experiments.free_vibration.checks import stiffness_by_record
from capsule_id.experiments.free_vibration.second_fit.fits import Screened, Screening
from capsule_id.experiments.free_vibration.settings import DecayModel, decay_window
from capsule_id.views import Comparison, Curve, Points, ResultTable

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


def decay_comparison(e: "FreeVibration", theta: ValuesBySymbol, draws: list[ValuesBySymbol]) -> Comparison:
    """Return the readings, the curve at ``theta``, the band of at most 50 ``draws``, and the residuals of one record."""

    def curve(values: ValuesBySymbol) -> np.ndarray:
        raw, design = e.unwhitened(values, np)
        return e.values - raw + e.width * design @ e.nuisance_mean(values)

    unit, time = e.column.to_display, e.time + float(decay_window(e.table)[0][0])
    lower, upper = band(np.array([curve(draw) for draw in draws[:50]]) * unit)
    residuals = np.asarray(e.residuals(theta, np))[: e.n]
    return Comparison(
        e.kind,
        e.label,
        f"{e.label}: free decay",
        "time [s]",
        axis_label(e.column),
        (Points(e.label, time, e.values * unit),),
        (Curve(f"this fit, {e.model_name}", time, curve(theta) * unit, lower, upper),),
        time,
        residuals,
        autocorrelation(residuals, min(60, e.n // 4)),
        1.96 / float(np.sqrt(e.n)),
    )
