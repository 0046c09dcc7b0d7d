"""The capsule as a forward model: the exact one, or the smoothed one of some widths. Mixed into the experiments it predicts."""

from copy import copy
from typing import Any, Literal, Self

import numpy as np
from numpy.typing import ArrayLike

from capsule_id.physics.model import CapsuleParameters, Excitation, Trajectory, simulate
from capsule_id.physics.smooth.engine import Smoothing


class CapsuleForward:
    """An experiment that the capsule model predicts; ``smoothing`` (4,) are the smoothed model's widths, else zeros."""

    event_driven = True
    model: Literal["exact", "smooth"] = "exact"
    smoothing: Any = np.zeros(4)

    def with_smoothing(self, widths: Smoothing | None) -> Self:
        """The same readings with the smoothed model of these ``widths`` as forward model; None: the exact one."""
        other = copy(self)
        other.model, other.smoothing = "exact", np.zeros(4)
        if widths is not None:
            numbers = (widths.velocity, widths.penetration, widths.rounding, widths.tolerance)
            other.model, other.smoothing = "smooth", np.array([float(x) for x in numbers])
        return other

    def simulated(self, p: CapsuleParameters, e: Excitation, times: ArrayLike, initial: Any = None) -> Trajectory:
        """``simulate`` by this experiment's model."""
        widths = None if self.model == "exact" else Smoothing(*(self.smoothing[i] for i in range(4)))
        return simulate(p, e, times, initial, model=self.model, smoothing=widths)
