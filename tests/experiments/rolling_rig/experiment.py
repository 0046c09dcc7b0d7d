"""The force that keeps a wheeled capsule rolling: F = c_rr (m1 + m2) g, with a scatter."""

from types import ModuleType

import jax.numpy as jnp
import numpy as np

from capsule_id.experiments.base import About, Experiment, Start, ValuesBySymbol, axis_label, no_design
from capsule_id.experiments.misfit import Misfit
from capsule_id.rig.model import Rig, Table
from capsule_id.views import Comparison, Curve, Points
from rolling_rig import C_RR, SCATTER


class RollingResistance(Experiment):
    """Forces at several speeds, independent of the speed."""

    speed: np.ndarray
    force: np.ndarray
    reading_sd: float

    def __init__(self, table: Table, rig: Rig) -> None:
        self.about = About(table, rig, (C_RR, SCATTER))
        self.speed, self.force = table["speed"], table["force"]
        self.reading_sd = table.columns["force"].reading_sd

    @property
    def masses(self) -> tuple[str, ...]:
        return "m1", "m2"

    @property
    def scatters(self) -> tuple[str, ...]:
        return ("rolling_scatter",)

    @property
    def observed(self) -> np.ndarray:
        return self.force

    def misfits(self, theta: ValuesBySymbol, xp: ModuleType = jnp) -> tuple[Misfit]:
        predicted = theta["c_rr"] * (theta["m1"] + theta["m2"]) * theta["g"]
        return (Misfit(self.force - predicted, self.reading_sd**2, 1.0, no_design(self.n, xp)),)

    def starts(self) -> dict[str, Start]:
        assert self.rig.m1 is not None
        assert self.rig.m2 is not None
        weight = (self.rig.m1.value + self.rig.m2.value) * self.rig.g.value
        return {
            "c_rr": Start(float(np.mean(self.force)) / weight, 0.3),
            "rolling_scatter": Start(float(np.std(self.force)), 0.3),
        }

    def comparison(self, theta: ValuesBySymbol, draws: list[ValuesBySymbol]) -> Comparison:
        del draws
        speed, force = (self.table.columns[name] for name in ("speed", "force"))
        level = theta["c_rr"] * (theta["m1"] + theta["m2"]) * theta["g"] * force.to_display
        x = self.speed * speed.to_display
        return Comparison(
            self.kind,
            self.label,
            f"{self.label}: rolling resistance",
            axis_label(speed),
            axis_label(force),
            (Points(self.label, x, self.force * force.to_display),),
            (Curve("this fit", x, np.full(self.n, level)),),
        )
