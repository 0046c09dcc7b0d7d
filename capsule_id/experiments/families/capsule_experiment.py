"""Mixin for experiments whose forward model is the capsule model, exact or smoothed."""

from typing import Any, Self

import equinox as eqx
import numpy as np
from numpy.typing import ArrayLike

from capsule_id.experiments.base import ValuesBySymbol
from capsule_id.experiments.families.friction_model import GroundExperiment, other_laws
from capsule_id.physics.drive import Drive
from capsule_id.physics.friction import FrictionLaw
from capsule_id.physics.model import CapsuleParameters, Trajectory, simulate
from capsule_id.physics.smooth.engine import Smoothing
from capsule_id.views import Facts


class CapsuleForward(GroundExperiment):
    """An experiment that the capsule model predicts.

    Attributes
    ----------
    smoothing : widths of the smoothed model; None: the exact model
    """

    smoothing: Smoothing | None

    event_driven = True

    @property
    def excitation_period(self) -> float | None:
        """s; None where nothing excites the capsule periodically."""
        return None

    @property
    def cycles(self) -> np.ndarray | None:
        period = self.excitation_period
        return None if period is None else self.table["time"] / period

    @property
    def masses(self) -> tuple[str, ...]:
        return ("m1", "m2")

    def with_smoothing(self, widths: Smoothing | None) -> Self:
        """Return the same readings with the smoothed model of ``widths``; None: the exact model."""
        return eqx.tree_at(lambda e: e.smoothing, self, widths, is_leaf=lambda x: x is None)

    def parameters_of(self, theta: ValuesBySymbol, k2: Any, gap: Any) -> CapsuleParameters:
        """Capsule parameters at ``theta``; mu and v_s are placeholders where another friction law replaces them."""
        return CapsuleParameters(
            m1=theta["m1"],
            m2=theta["m2"],
            k1=theta["k1"],
            k2=k2,
            c=theta["c"],
            mu=theta.get("mu", 0.0),
            v_s=theta.get("v_s", 1.0),
            G=gap,
            g=theta["g"],
            k_cubic=theta.get("k_cubic", 0.0),
            c2=theta.get("c2", 0.0),
            **self.ground_at(theta),
        )

    def simulated(
        self, theta: ValuesBySymbol, p: CapsuleParameters, e: Drive, times: ArrayLike, initial: Any = None
    ) -> Trajectory:
        """Call ``simulate`` with this experiment's model and the friction law at ``theta``."""
        model = "exact" if self.smoothing is None else "smooth"
        return simulate(p, e, times, initial, model=model, smoothing=self.smoothing, friction=self.law(theta))

    def law(self, theta: ValuesBySymbol) -> FrictionLaw:
        """The friction law at ``theta``, N."""
        return self.friction.force({**theta, **self.ground_at(theta)})

    def noise_facts(self) -> Facts:
        return {"model": "capsule", "law": self.friction.name, "other_laws": other_laws(self.friction)}
