"""Settings of a forced run as numbers."""

import numpy as np

from capsule_id.rig.model import Quantity, Table


def stated_Omega(table: Table) -> float:
    """The stated frequency of the drive, rad/s, from ``Omega`` or ``f``."""
    if "Omega" in table.settings:
        return _number(table.settings["Omega"])
    return 2.0 * np.pi * _number(table.settings["f"])


def stated_gap(table: Table) -> Quantity:
    """The stated gap, m."""
    gap = table.settings["gap"]
    assert isinstance(gap, Quantity)  # the schema has seen to it
    return gap


def _number(value: object) -> float:
    assert isinstance(value, float)  # the schema has seen to it
    return value
