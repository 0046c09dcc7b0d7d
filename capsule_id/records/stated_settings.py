"""Settings of a forced run as numbers."""

from capsule_id.rig.model import Quantity, Table


def stated_Omega(table: Table) -> float:
    """The stated frequency of the drive, rad/s, from ``Omega`` or ``f``."""
    return table.settings.angular_frequency


def stated_gap(table: Table) -> Quantity:
    """The stated gap, m."""
    return table.settings.gap
