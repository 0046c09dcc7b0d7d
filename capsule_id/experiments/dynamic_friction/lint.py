"""Findings on the readings of pushes: the distance grows with the speed."""

from collections.abc import Iterable
from typing import Any

import numpy as np

from capsule_id.rig.model import Rig, Table
from capsule_id.views import Finding, Message

#: Smallest power of the speed in the distance; constant friction gives 2, swapped columns 1/2.
SMALLEST_POWER = 1.0
#: Standard errors by which the power must lie below; smallest ratio of the speeds, and fewest pushes, that show it.
STANDARD_ERRORS, SPEED_RATIO, FEWEST_PUSHES = 3.0, 1.5, 3


def lint_pushes(table: Table[Any], rig: Rig) -> Iterable[Finding]:
    """Report distances that do not grow with the speed as those of a sliding body do."""
    del rig
    speed, distance = np.log(table["speed"]), np.log(table["distance"])
    if len(speed) < FEWEST_PUSHES or np.ptp(speed) < np.log(SPEED_RATIO):
        return
    centred = speed - np.mean(speed)
    power = float(centred @ distance / (centred @ centred))
    rest = distance - np.mean(distance) - power * centred
    error = float(np.sqrt(rest @ rest / (len(speed) - 2) / (centred @ centred)))
    if power + STANDARD_ERRORS * error < SMALLEST_POWER:
        facts = {"file": table.file, "power": power, "error": error}
        yield Finding("pushes.power", "fail", facts, table.label)


MESSAGES = {
    "pushes.power": Message(
        "columns of pushes",
        fail=(
            "{file}: the distance of a push grows about as the square of its speed; found the power {power:.2g} ± "
            "{error:.1g}. Check that speed and distance are not swapped."
        ),
    )
}
