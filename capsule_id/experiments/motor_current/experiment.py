"""Motor current: a known force on the rod balanced by the motor (paper, Fig. 3); K = dF/dI."""

import numpy as np

from capsule_id.experiments.line import Line
from capsule_id.parameters import parameter
from capsule_id.rig.model import Rig, Table


class MotorCurrent(Line):
    """Force against current: F = F0 + K I."""

    def __init__(self, table: Table, rig: Rig) -> None:
        super().__init__(table, rig, "current", "force", parameter("K"), table.settings.sd_ratio)


def twin(
    rng: np.random.Generator, K: float, currents: np.ndarray, force_sd: float, current_sd: float
) -> dict[str, np.ndarray]:
    """A synthetic calibration at ``currents`` (n,) A, both columns read with errors, N and A."""
    n = len(currents)
    return {
        "force [N]": K * currents + force_sd * rng.standard_normal(n),
        "current [A]": currents + current_sd * rng.standard_normal(n),
    }
