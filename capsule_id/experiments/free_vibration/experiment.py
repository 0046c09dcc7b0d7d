"""Free vibration of the rod, motor switched on, capsule at rest (paper, section 2.2): k1 and c."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd

from capsule_id.experiments.base import Start
from capsule_id.experiments.checks import LEVEL, ljung_box, refit
from capsule_id.experiments.context import Fitted, TableMaker
from capsule_id.experiments.free_vibration.checks import CHECKS, later_start, stiffness_by_record
from capsule_id.experiments.free_vibration.hidden_terms import check_hidden_terms
from capsule_id.experiments.free_vibration.readings import DecayModel
from capsule_id.experiments.free_vibration.record import Decay, DecayRecord, Screened
from capsule_id.experiments.free_vibration.second_fit import Screening, decay_starts, nested_starts, second_models
from capsule_id.records.tones import other_tone
from capsule_id.views import Facts, Finding, ResultTable

# tables: Views of free decays: estimates by record, and comparison of the stated with the quoted model.


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


def second_fit_table(screened: Callable[[Any, DecayModel], Screened]) -> TableMaker:
    """Return the table of the decays alone under the stated model and under the quoted one; [] where both are the same.

    ``screened`` fits a decay alone under a model.
    """

    def table(decays: Sequence[Decay], fit: Fitted) -> list[ResultTable]:
        del fit
        replaced = [(e, e.about.screened) for e in decays if e.about.screened is not None]
        if not replaced:
            return []
        # Both fits use the same samples, so that their BIC can be compared.
        models = [replace(DecayModel.stated(e.table.settings), thin=e.model.thin) for e, _ in replaced]
        stated = [screened(e, model) for (e, _), model in zip(replaced, models, strict=True)]
        rows = []
        for role, model, fits in (
            ("stated", models[0], stated),
            ("quoted", replaced[0][0].model, [quoted for _, quoted in replaced]),
        ):
            means = {symbol: _weighted_mean(fits, symbol) for symbol in ("k1", "c", *model.symbols)}
            row = {
                "fit": role,
                "model": model.name,
                "parameters": ", ".join(f"{name} = {mean:.5g} ± {sd:.2g}" for name, (mean, sd) in means.items()),
                "noise, SI": float(np.mean([one.noise for one in fits])),
                "BIC": sum(one.bic for one in fits),
            }
            if decays[0].time_series:
                white = all(ljung_box(one.residuals)[1] * len(decays) >= LEVEL for one in fits)
                row["residuals white"] = "yes" if white else "no"
            rows.append(row)
        frame = pd.DataFrame(rows).set_index("fit")
        frame["BIC"] -= frame["BIC"].min()
        return [ResultTable("decays.second_fit", frame, {"lines": replaced[0][0].lines})]

    return table


def _weighted_mean(fits: Sequence[Screened], symbol: str) -> tuple[float, float]:
    """Mean of the estimates of every record, weighted by their standard errors, and its standard error."""
    weight = np.array([one.errors[symbol] for one in fits]) ** -2.0
    return float(np.average([one.values[symbol] for one in fits], weights=weight)), float(np.sum(weight) ** -0.5)


class FreeVibration(DecayRecord):
    """One channel of one raw record, with its checks, tables and starts."""

    checks = (*CHECKS, check_hidden_terms)
    tables = (
        decay_table,
        damping_table,
        second_fit_table(lambda e, model: Screening(e, model.thin).fit(model)[0]),
    )

    @classmethod
    def second_models(
        cls, records: "Sequence[Any]", readings: Sequence[Finding] = ()
    ) -> tuple[list[Any], list[Finding]]:
        return second_models(records, readings)

    def starts(self) -> dict[str, Start]:
        return decay_starts(self)

    def nested_starts(self) -> Sequence[Mapping[str, float]]:
        return nested_starts(self)

    def noise_facts(self) -> Facts:
        facts = {"present": self.model.additions, "second": self.replaced, "lines": self.lines}
        facts |= {"tone": other_tone(self.time, self.values)}
        return {"model": "decay", "stated": self.stated_words, **facts, **self.damping_trend(), **later_start(self)}
