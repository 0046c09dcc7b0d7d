"""Motor current: a known force on the rod balanced by the motor (paper, Fig. 3); K = dF/dI."""

from capsule_id.experiments.families.line_experiment import Line
from capsule_id.parameters import parameter
from capsule_id.rig.model import Rig, Table


class MotorCurrent(Line):
    """Force against current: F = F0 + K I."""

    def __init__(self, table: Table, rig: Rig) -> None:
        super().__init__(table, rig, "current", "force", parameter("K"), table.settings.sd_ratio)
