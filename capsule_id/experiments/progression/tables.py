"""Table of the sessions of a fitted progression: which trials belong to a parameter, and its friction."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

from capsule_id.experiments.checks.context import Fitted
from capsule_id.views import ResultTable

if TYPE_CHECKING:
    from capsule_id.experiments.progression.experiment import Progression


def session_table(experiments: "Sequence[Progression]", fit: Fitted) -> list[ResultTable]:
    """Name the sessions that have parameters by the file's own numbers; [] where there are none.

    The friction is relative to a session with z = 0: of the point fit, with mean and sd where there are draws.
    """
    rows = []
    for e in experiments:
        theta, draws = e.local(fit.values), [e.local(draw) for draw in fit.draws]
        for session in np.flatnonzero(e.parameter >= 0):
            symbol = e.sessions.symbols[e.parameter[session]]
            factors = np.array([np.exp(one["session_sd"] * one[symbol]) for one in draws or [theta]])
            trials = np.flatnonzero(e.session[:, session])
            rows.append(
                {
                    "parameter": f"{symbol}[{e.label}]",
                    # Without this column each block of rows is a session with one setting, which has no parameter.
                    "session": f"{e.table['session'][trials[0]]:.15g}",
                    "settings": int(np.count_nonzero(e.session[:, session] @ e.setting)),
                    "trials": len(trials),
                    "friction": float(np.mean(factors)),
                    "its sd": float(np.std(factors)) if draws else np.nan,
                }
            )
    if not rows:
        return []
    return [ResultTable("progression.sessions", pd.DataFrame(rows).set_index("parameter").round(4))]
