"""The capsule as a forward model: the exact one, or the smoothed one. Mixed into the experiments that it predicts."""

from typing import Any, Self

import equinox as eqx
from numpy.typing import ArrayLike

from capsule_id.experiments.base import Experiment
from capsule_id.physics.model import CapsuleParameters, Excitation, Trajectory, simulate
from capsule_id.physics.smooth.engine import Smoothing
from capsule_id.views import Facts


class CapsuleForward(Experiment):
    """An experiment that the capsule model predicts.

    Attributes
    ----------
    smoothing : widths of the smoothed model; None: the exact model
    """

    smoothing: Smoothing | None

    event_driven = True

    @property
    def masses(self) -> tuple[str, ...]:
        return ("m1", "m2")

    def with_smoothing(self, widths: Smoothing | None) -> Self:
        """The same readings with the smoothed model of these ``widths`` as forward model; None: the exact one."""
        return eqx.tree_at(lambda e: e.smoothing, self, widths, is_leaf=lambda x: x is None)

    def simulated(self, p: CapsuleParameters, e: Excitation, times: ArrayLike, initial: Any = None) -> Trajectory:
        """``simulate`` by this experiment's model."""
        model = "exact" if self.smoothing is None else "smooth"
        return simulate(p, e, times, initial, model=model, smoothing=self.smoothing)

    def noise_facts(self) -> Facts:
        return {"model": "capsule"}
