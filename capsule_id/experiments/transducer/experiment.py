"""Force transducer: its reading under known forces; sensitivity = d(reading)/d(force)."""

from capsule_id.experiments.families.line_experiment import Line
from capsule_id.experiments.transducer.declaration import SENSITIVITY
from capsule_id.rig.model import Rig, Table


class Transducer(Line):
    """Reading against force: r = r0 + sensitivity F."""

    unit_of_y = "1"

    def __init__(self, table: Table, rig: Rig) -> None:
        row = SENSITIVITY.named(table.label)
        super().__init__(table, rig, "force", "reading", row, table.settings.sd_ratio)
