"""Free vibration of the rod, motor switched on, capsule at rest (paper, section 2.2): k1 and c."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from capsule_id.experiments.base import Start
from capsule_id.experiments.checks import refit
from capsule_id.experiments.context import Fitted
from capsule_id.experiments.free_vibration.checks import CHECKS, later_start, stiffness_by_record
from capsule_id.experiments.free_vibration.hidden_terms import check_hidden_terms
from capsule_id.experiments.free_vibration.record import DecayRecord
from capsule_id.experiments.free_vibration.second_fit import decay_starts, nested_starts, second_models
from capsule_id.records.tones import other_tone
from capsule_id.views import Facts, Finding, ResultTable

# tables: Views of free decays: estimates by record, and correlations of the damping.


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


class FreeVibration(DecayRecord):
    """One channel of one raw record, with its checks, tables and starts."""

    checks = (*CHECKS, check_hidden_terms)
    tables = (decay_table, damping_table)

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
