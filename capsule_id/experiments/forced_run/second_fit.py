"""Second fits of a run, where the residuals of the first one are correlated: starts of coloured noise, and tables.

A real sensor filters, and no model is exact, so that residuals of dense samples are hardly ever white. White noise then
gives intervals that are far too short.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

from capsule_id.experiments.base import ValuesBySymbol
from capsule_id.experiments.checks.context import Fitted
from capsule_id.experiments.checks.series import autocorrelation
from capsule_id.views import ResultTable

if TYPE_CHECKING:
    from capsule_id.experiments.forced_run.experiment import ForcedRun

#: Largest lag-1 correlation of the noise at which a fit starts.
LARGEST_CORRELATION = 0.99


def coloured_starts(run: "ForcedRun", theta: ValuesBySymbol) -> dict[str, float]:
    """Starts of the AR(1) noise of ``run`` by name, SI, from the residuals of a fit with white noise."""
    values = {}
    for name, (_, residuals) in zip(run.channels, run.records(theta), strict=True):
        rho = float(np.clip(autocorrelation(residuals, 1)[0], 0.0, LARGEST_CORRELATION))
        values[f"ar1_{name}[{run.about.record}]"] = float(np.arctanh(rho))
        values[f"noise_{name}[{run.about.record}]"] = theta[f"noise_{name}"] * float(np.sqrt(1.0 - rho**2))
    return values


def second_fit_table(runs: "Sequence[ForcedRun]", fit: Fitted) -> list[ResultTable]:
    """Tables of the second fits of runs: coloured noise, and other friction laws; [] without one."""
    del runs
    found = {finding.code: finding.facts for finding in fit.findings}
    tables = {"runs.second_fit": "fits", "runs.laws": "laws"}
    return [
        ResultTable(code, pd.DataFrame(found[code][rows]).set_index("fit"))
        for code, rows in tables.items()
        if code in found
    ]
