"""Support spring: static force against deflection (paper, section 2.2)."""

from capsule_id.experiments.families.line_experiment import Line
from capsule_id.experiments.support_spring.checks import check_cantilever
from capsule_id.parameters import parameter
from capsule_id.rig.model import Quantity, Rig, Table


class SupportSpring(Line):
    """F = F0 + k2[spring] x."""

    checks = (*Line.checks, check_cantilever)

    def __init__(self, table: Table, rig: Rig) -> None:
        slope = parameter("k2", table.settings.spring)
        super().__init__(table, rig, "deflection", "force", slope, table.settings.sd_ratio)

    @property
    def spring(self) -> str:
        return self.table.settings.spring

    @property
    def length(self) -> Quantity | None:
        """Free length of the cantilever, m, where stated."""
        return self.table.settings.length

    def table_extras(self) -> dict[str, float]:
        return {} if self.length is None else {"length, m": self.length.value}
