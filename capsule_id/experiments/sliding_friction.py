"""Steady sliding: friction force, or coefficient, at a held speed."""

from collections.abc import Mapping
from dataclasses import replace
from types import ModuleType
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from capsule_id.experiments.base import About, Start, ValuesBySymbol, no_design
from capsule_id.experiments.friction import (
    CAPTIONS,
    MASSES_OF_FREE,
    MESSAGES,
    NORMAL_FORCE_COLUMN,
    PullSettings,
    check_load,
    check_normal_force,
    check_scatter,
    friction_estimates,
    friction_panels,
    ground_of,
    ground_parameters,
    lint_slides,
)
from capsule_id.experiments.friction_experiment import LoadedExperiment, stated_normal_forces
from capsule_id.experiments.friction_model import EQUATION_1, FrictionModel
from capsule_id.experiments.kind import Kind, made_by
from capsule_id.experiments.misfit import Misfit
from capsule_id.parameters import Prior, scatter
from capsule_id.physics.friction import FrictionLaw
from capsule_id.rig.model import Rig, Table
from capsule_id.rig.schema import ColumnRule
from capsule_id.rig.tables import Entry
from capsule_id.rig.toml import POSITIVE

# declaration: Steady sliding: columns and template.


SLIDING_SCATTER = scatter(
    "sliding_scatter", "1", "relative scatter of mu, steady sliding", r"s_\mathrm{sl}", Prior("halfnormal", 0.0, 0.05)
)


def _masses(table: Table[PullSettings]) -> tuple[str, ...]:
    # The force overcomes the weight along the slope too.
    weighed = "normal_force" not in table.columns or table.settings.load_is == "pressed"
    return ("m1", "m2") if "force" in table.columns and weighed else ()


def _stated_law(entry: Entry[PullSettings]) -> Mapping[str, Any]:
    """The keys of ``[model]``; none where it is no table, which its own reader refuses."""
    model = entry.node.document.data.get("model", {})
    return model if isinstance(model, dict) else {}


def _check_speed(entry: Entry[PullSettings]) -> None:
    """Refuse readings without speeds under a law that depends on the speed.

    Raises
    ------
    InputError
        At the entry.
    """
    law = _stated_law(entry)
    if "speed" in entry.table.columns or (law.get("friction") == "constant" and "viscous" not in law.get("free", [])):
        return
    rule = "sliding readings without a speed need a friction that does not depend on it"
    remedy = 'add the column speed, or write friction = "constant" in [model]'
    raise entry.error("", rule, " ".join(entry.table.columns), remedy)


def _check_viscous(entry: Entry[PullSettings]) -> None:
    """Refuse a viscous part beside normal forces of every row.

    Raises
    ------
    InputError
        At the entry.
    """
    if "normal_force" in entry.table.columns and "viscous" in _stated_law(entry).get("free", []):
        rule = "a column normal_force and a viscous part are not fitted together"
        raise entry.error("", rule, "both", "make an experiment with its own N0 of each load, or remove viscous")


TEMPLATE = """\
#: Steady sliding, a row per point: mu and v_s. Columns: speed [m/s], and force [N] or coefficient [1]; normal_force [N]
#: beside force where it differs from row to row. With friction = "constant" in [model] the speed may be absent.
# [[experiment]]
# kind = "sliding_friction"
# file = "sliding_friction.csv"
# direction = "forward"                               # "backward": it slid away from the support spring
# slope = { value = 0, unit = "deg" }                   # this one alone; default: [rig]
# N0 = { value = 0, unit = "N" }
#: On a slope a stated normal force needs load_is = "weight", or "pressed" for a force without weight.
"""

KIND = Kind(
    name="sliding_friction",
    columns={
        "speed": ColumnRule("m/s", POSITIVE),
        "force": ColumnRule("N", POSITIVE),
        "coefficient": ColumnRule("1", POSITIVE),
        "normal_force": NORMAL_FORCE_COLUMN,
    },
    sets=(("speed", "force"), ("speed", "coefficient"), ("force",), ("coefficient",)),
    optional=("normal_force",),
    settings=PullSettings,
    meant=("sliding", "break-away", "no pull"),
    rules=(check_normal_force, _check_speed, _check_viscous, check_load),
    masses=_masses,
    masses_of_free=MASSES_OF_FREE,
    parameters=(SLIDING_SCATTER,),
    make=made_by("capsule_id.experiments.sliding_friction:SlidingFriction"),
    template=TEMPLATE,
    informs="mu, v_s",
    captions=CAPTIONS,
    messages=MESSAGES,
    lint=(lint_slides,),
    check=check_scatter,
    paper=friction_estimates,
    panels=friction_panels,
)


# experiment: Steady sliding: friction force, or coefficient, at a held speed.


class SlidingFriction(LoadedExperiment):
    """Steady sliding, y = mu_d(v) for a coefficient. A force is N mu_d(v) and the weight along the slope.

    N is that of the weight, or stated for every row. Without a speed the friction must not depend on it.

    The variance has reading errors of y, of v (through the slope of the friction law) and of N (through the
    coefficient), and relative scatter of mu.
    """

    speed: np.ndarray
    values: np.ndarray
    speed_sd: float
    values_sd: float
    quantity: str = eqx.field(static=True)

    role = "sliding"

    def __init__(self, table: Table, rig: Rig, friction: FrictionModel = EQUATION_1) -> None:
        self.friction = friction = replace(friction, direction=table.settings.direction)
        self.about = About(table, rig, (*friction.parameters, SLIDING_SCATTER, *ground_parameters(table, rig)))
        self.ground = ground_of(table)
        self.quantity = "force" if "force" in table.columns else "coefficient"
        self.values = table[self.quantity]
        self.speed = table["speed"] if self.speeds_known else np.zeros(len(self.values))
        self.speed_sd = table.columns["speed"].reading_sd if self.speeds_known else 0.0
        self.normal_force, self.normal_force_sd = stated_normal_forces(table)
        self.of_weights = table.settings.load_is == "weight"
        self.values_sd = table.columns[self.quantity].reading_sd
        if self.quantity == "force":
            self.refuse_weight_along(self.values)

    @property
    def speeds_known(self) -> bool:
        return "speed" in self.table.columns

    @property
    def scatters(self) -> tuple[str]:
        return ("sliding_scatter",)

    @property
    def masses(self) -> tuple[str, ...]:
        return ("m1", "m2") if self.quantity == "force" and self.weighed else super().masses

    @property
    def observed(self) -> np.ndarray:
        return self.values

    def misfits(self, theta: ValuesBySymbol, xp: ModuleType = jnp) -> tuple[Misfit]:
        theta = {**theta, **self.ground_at(theta)}
        of_weight = self.quantity == "force" and self.normal_force is None
        law = self.friction.force(theta) if of_weight else self.friction.coefficient(theta)
        normal = 1.0 if self.normal_force is None else self.normal_force
        value, slope = (xp.asarray(values) for values in _value_and_slope(law, self.speed))
        predicted = normal * value
        along = self.along(theta) if self.quantity == "force" else 0.0
        of_normal = self.of_normal_force(value, along) * self.normal_force_sd
        variance = self.values_sd**2 + (normal * slope * self.speed_sd) ** 2 + of_normal**2
        raw = self.values - predicted - along
        return (Misfit(raw, variance, predicted, no_design(self.n, xp)),)

    def paper_points(self) -> tuple[np.ndarray, np.ndarray]:
        """Measured points (speed, coefficient)."""
        if self.quantity == "coefficient":
            return self.speed, self.values
        normal = self.stated_normal_force if self.normal_force is None else self.normal_force
        return self.speed, (self.values - self.stated_along) / normal

    def point_errors(self) -> tuple[np.ndarray, float]:
        """The reading error of the speed is left out: it enters through the slope of the law."""
        if self.quantity == "coefficient":
            return self.values_sd / self.values, 1.0
        return self.relative_errors(self.values, self.values_sd), 1.0

    def starts(self) -> dict[str, Start]:
        return {**self.rough_starts(), "sliding_scatter": Start(0.02, 0.3)}


@jax.jit
def _value_and_slope(law: FrictionLaw, speed: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Resistance and its derivative with respect to the speed, (n,) each."""
    return jax.jvp(law.forward, (speed,), (jnp.ones_like(speed),))
