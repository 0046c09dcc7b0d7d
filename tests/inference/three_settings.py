"""A small robot with a progression of three settings, and values of its parameters."""

from pathlib import Path

import numpy as np

from capsule_id.api import read_rig
from capsule_id.rig.model import Rig
from capsule_id.synthetic import ROBOT, RobotDesign, synthesize_robot

PERIODS = 1e-3 * np.array([60.0, 80.0, 100.0])
#: Values of the parameters of the progression by symbol.
THETA = {
    **ROBOT, "g": 9.81, "session_sd": 0.05, "session_1": 0.5, "trial_scatter": 0.04, "trial_sd": 1e-3, "discrepancy": 2e-4,
}  # fmt: skip


def three_settings(folder: Path) -> Rig:
    """Write a twin to ``folder`` and read it."""
    synthesize_robot(folder, 1, RobotDesign(PERIODS, np.full(3, 0.3), sessions=2))
    return read_rig(folder)
