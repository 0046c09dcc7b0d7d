"""The force that keeps a wheeled capsule rolling: F = c_rr (m1 + m2) g, with a scatter."""

from collections.abc import Sequence
from types import ModuleType

import jax.numpy as jnp
import numpy as np
import pandas as pd

from capsule_id.experiments.base import About, Experiment, Fitted, Start, ValuesBySymbol, axis_label
from capsule_id.experiments.misfit import Misfit
from capsule_id.rig.model import Rig, Table
from capsule_id.views import Comparison, Curve, Finding, Points, ResultTable
from rolling_rig import C_RR, SCATTER


def check_speeds(tables: "Sequence[RollingResistance]", fit: Fitted) -> list[Finding]:
    """Expected: a force that does not depend on the speed."""
    findings = []
    for e in tables:
        rest = e.misfit(e.local(fit.values)).raw
        slope = float(np.polyfit(e.speed, rest, 1)[0])
        level = "ok" if abs(np.corrcoef(e.speed, rest)[0, 1]) < 0.9 else "warn"
        findings.append(Finding("rolling.speeds", level, {"speeds": e.n, "slope": slope}, e.label))
    return findings


def speed_table(tables: "Sequence[RollingResistance]", fit: Fitted) -> list[ResultTable]:
    """The range of the speeds."""
    frame = pd.DataFrame({"slowest, m/s": [e.speed.min() for e in tables]}, index=[e.label for e in tables])
    return [ResultTable("rolling.range", frame, {"c_rr": fit.values["c_rr"]})]


class RollingResistance(Experiment):
    """Forces at several speeds, independent of the speed."""

    speed: np.ndarray
    force: np.ndarray
    reading_sd: float

    checks = (check_speeds,)
    tables = (speed_table,)

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
        return (Misfit(self.force - predicted, self.reading_sd**2, 1.0, xp.zeros((self.n, 0))),)

    def starts(self) -> dict[str, Start]:
        weight = (self.rig.mass("m1") + self.rig.mass("m2")) * self.rig.g.value
        return {
            "c_rr": Start(float(np.mean(self.force)) / weight, 0.3),
            "rolling_scatter": Start(float(np.std(self.force)), 0.3),
        }

    def comparisons(self, theta: ValuesBySymbol, draws: list[ValuesBySymbol]) -> tuple[Comparison, ...]:
        del draws
        speed, force = (self.table.columns[name] for name in ("speed", "force"))
        level = theta["c_rr"] * (theta["m1"] + theta["m2"]) * theta["g"] * force.to_display
        x = self.speed * speed.to_display
        panel = Comparison(
            self.kind,
            self.label,
            f"{self.label}: rolling resistance",
            axis_label(speed),
            axis_label(force),
            (Points(self.label, x, self.force * force.to_display),),
            (Curve("this fit", x, np.full(self.n, level)),),
        )
        return (panel,)
