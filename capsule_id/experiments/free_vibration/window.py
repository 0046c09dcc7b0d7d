"""Window of a free-vibration record that contains the free decay."""

import numpy as np

from capsule_id.rig.model import Table


def decay_window(table: Table) -> tuple[np.ndarray, np.ndarray]:
    """Return (time, x_rel) of a free vibration, SI, from ``start`` to ``stop`` inclusive; default: the whole record."""
    time, settings = table["time"], table.settings
    start = time[0] if settings.start is None else settings.start
    stop = time[-1] if settings.stop is None else settings.stop
    inside = (time >= start) & (time <= stop)
    return time[inside], table["x_rel"][inside]
