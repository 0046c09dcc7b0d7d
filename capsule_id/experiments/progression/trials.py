"""Settings and sessions of the rows of a progression."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from capsule_id.experiments.progression.declaration import AMPLITUDE, ProgressionSettings
from capsule_id.rig.model import Table


def settings_of(columns: Mapping[str, Any], settings: ProgressionSettings) -> tuple[np.ndarray, str]:
    """(n, 4) period, s, number of periods, duty and amplitude of every row; where the amplitude comes from.

    ``columns`` hold values (n,) SI by name. The amplitude is from a "column" (N) or a "current" (A), or a parameter with
    a "prior", or "exact"; it is 1 in the last two cases.
    """
    period = columns["period"] if "period" in columns else 1.0 / columns["f"]
    one = np.ones(len(period))
    own = AMPLITUDE[settings.drive]
    source = next((name for name in (own, "current") if name in columns), None)
    stated = getattr(settings, own)
    kind = {own: "column", "current": "current"}.get(source or "", "prior" if stated and stated.sd > 0.0 else "exact")
    parts = (period, columns["periods"], columns.get("duty", one))
    return np.stack([*parts, one if source is None else columns[source]], axis=1), kind


def sessions_of(table: Table, rows: np.ndarray) -> np.ndarray:
    """(n, sessions) membership: by the column, else blocks of consecutive rows with equal settings."""
    if "session" in table.columns:
        index = np.unique(table["session"], return_inverse=True)[1]
    else:
        index = np.cumsum(np.concatenate([[0], np.any(rows[1:] != rows[:-1], axis=1)]))
    return np.eye(int(np.max(index)) + 1)[index]


def name_of(setting: np.ndarray, drive: str, amplitude_from: str) -> str:
    """Name of one row of ``settings_of``: period, duty and amplitude where they may differ, number of periods."""
    period, periods, duty, amplitude = setting
    parts = [f"{1e3 * period:g} ms"]
    parts += [f"duty {100.0 * duty:g} %"] if drive == "pulses" else []
    parts += {"column": [f"{amplitude:g} N"], "current": [f"{amplitude:g} A"]}.get(amplitude_from, [])
    return ", ".join([*parts, f"{periods:g} periods"])
