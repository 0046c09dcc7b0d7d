"""Settings of a forced run as numbers."""

import numpy as np

from capsule_id.rig.filters import dominant_frequency
from capsule_id.rig.model import Quantity, Table


def stated_Omega(table: Table) -> float:
    """The frequency of the drive, rad/s, from ``Omega`` or ``f``; else the strongest one of the recorded base.

    Raises
    ------
    InputError
        If no frequency is stated and the record is sampled unevenly.
    """
    settings = table.settings
    if settings.Omega is None and settings.f is None:
        return 2.0 * np.pi * dominant_frequency(table["time"], table["x_base"])
    return settings.angular_frequency


def stated_gap(table: Table) -> Quantity:
    """The stated gap, m; infinite without a support spring."""
    return table.settings.gap or Quantity(float("inf"))


def relative_position(table: Table) -> tuple[np.ndarray, float] | None:
    """x_rel of a record, m, and its reading error: recorded, or x_base - x_capsule; None without either."""
    columns = table.columns
    if "x_rel" in columns:
        return table["x_rel"], columns["x_rel"].reading_sd
    if "x_base" not in columns or "x_capsule" not in columns:
        return None
    error = np.hypot(columns["x_base"].reading_sd, columns["x_capsule"].reading_sd)
    return table["x_base"] - table["x_capsule"], float(error)
