"""The part of a free-vibration record that is free decay."""

import numpy as np

from capsule_id.rig.model import Table


def decay_window(table: Table) -> tuple[np.ndarray, np.ndarray]:
    """(time, x_rel) of a free vibration, SI, from ``start`` to ``stop``, both included; by default the whole record."""
    time = table["time"]
    start, stop = table.settings.get("start", time[0]), table.settings.get("stop", time[-1])
    inside = (time >= start) & (time <= stop)
    return time[inside], table["x_rel"][inside]
