"""Experiments whose forward model is the capsule model: mixin, trials, and bench tests with ``forward = "capsule"``."""

from collections.abc import Mapping
from dataclasses import replace
from types import ModuleType
from typing import Any, Literal, Self

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from capsule_id.experiments.base import Experiment, Start, ValuesBySymbol, clock_parameters, scatter_prior, stretch
from capsule_id.experiments.dynamic_friction import DynamicFriction
from capsule_id.experiments.forced_run.declaration import SWITCHED
from capsule_id.experiments.free_vibration.declaration import NOISE_SD
from capsule_id.experiments.free_vibration.decrement import equilibrium
from capsule_id.experiments.free_vibration.readings import DecayModel
from capsule_id.experiments.free_vibration.record import DecayRecord
from capsule_id.experiments.friction_model import (
    EQUATION_1,
    NORMAL_FORCE,
    FrictionModel,
    GroundExperiment,
    ground_of,
    ground_parameters,
    other_laws,
)
from capsule_id.experiments.point_test import PointTest
from capsule_id.parameters import Name, Parameter, Prior, parameter
from capsule_id.physics.forces import FrictionLaw
from capsule_id.physics.model import CapsuleParameters, Drive, Excitation, Trajectory
from capsule_id.physics.simulation import simulate
from capsule_id.physics.smooth.engine import Smoothing
from capsule_id.rig.model import Quantity, Rig, Table
from capsule_id.views import Facts

# capsule experiment: Mixin for experiments whose forward model is the capsule model, exact or smoothed.


#: Sds from 0 within which a gap may be negative.
OPEN = 4.0


def stated_parameters(
    symbol: str,
    stated: Quantity | None,
    of: str = "",
    kind: Literal["normal", "positive_normal"] = "positive_normal",
) -> list[Parameter]:
    """The parameter with the prior of a stated quantity; [] where nothing is stated, or an exact value.

    About 0, a prior of positive values is half-normal.
    """
    if stated is None or stated.sd == 0.0:
        return []
    about_0 = "halfnormal" if stated.value == 0.0 and kind == "positive_normal" else kind
    return [parameter(symbol, of, Prior("normal" if _is_open(symbol, stated) else about_0, stated.value, stated.sd))]


def free_parameters(rig: Rig, *, damped: bool) -> list[Parameter]:
    """k_cubic and, of a support spring, c2, where [model] sets them free."""
    return [parameter(name) for name in ("k_cubic", "c2")[: 1 + damped] if name in rig.model.free]


def _is_open(symbol: str, stated: Quantity) -> bool:
    """Whether ``stated`` is a gap that may be negative: then the spring reaches beyond x_rel = 0."""
    return symbol in ("G", "G_back") and stated.value < OPEN * stated.sd


def support_parameters(table: Table, friction: FrictionModel, of: str) -> list[Parameter]:
    """The parameters of the springs in front of the rod and behind it, and of their gaps of the record ``of``."""
    s = table.settings
    back = [] if s.spring_back in (None, s.spring) else [parameter("k2", s.spring_back)]
    return [
        *friction.support(s.spring),
        *back,
        *stated_parameters("G", s.gap, of),
        *stated_parameters("G_back", s.gap_back, of),
    ]


def lag_parameters(table: Table, rig: Rig) -> list[Parameter]:
    """The parameter lag of a drive, with its stated prior or, where [model] sets it free, the default one; or []."""
    lag, is_free = table.settings.lag, table.settings.drive in SWITCHED and "lag" in rig.model.free
    return [parameter("lag")] if lag is None and is_free else stated_parameters("lag", lag)


#: Settings that hold a number of the motion, by symbol.
STATED = {
    "G": "gap",
    "G_back": "gap_back",
    "P_d": "P_d",
    "P_on": "P_on",
    "lag": "lag",
    "duty": "duty",
    NORMAL_FORCE: "normal_force",
}


def exact_values(table: Table) -> dict[str, float]:
    """The numbers of the motion that the settings of ``table`` state without an sd, SI, by symbol."""
    stated = {symbol: getattr(table.settings, key, None) for symbol, key in STATED.items()}
    quantities = {name: q if isinstance(q, Quantity) else Quantity(q) for name, q in stated.items() if q is not None}
    return {name: q.value for name, q in quantities.items() if q.sd == 0.0}


def stated_starts(of: str, **quantities: Quantity | None) -> dict[str, Start]:
    """Starts of ``stated_parameters`` by name."""
    uncertain = {symbol: q for symbol, q in quantities.items() if q is not None and q.sd > 0.0}
    scales = {symbol: 1.0 if _is_open(symbol, q) else q.value for symbol, q in uncertain.items()}
    return {f"{symbol}[{of}]": Start(q.value, 0.5 * q.sd / scales[symbol]) for symbol, q in uncertain.items()}


#: Widths a quarter of the certified ones.
NARROW = Smoothing(*(0.25 * width for width in jax.tree.leaves(Smoothing())))


class CapsuleForward(GroundExperiment):
    """An experiment that the capsule model predicts.

    Attributes
    ----------
    exact : numbers of the motion that are no parameters, see ``exact_values``
    smoothing : widths of the smoothed model; None: the exact model
    reaction : share of the drive's force that pushes the capsule back, 1
    """

    exact: dict[str, float]
    smoothing: Smoothing | None
    reaction: float = eqx.field(static=True)

    event_driven = True
    slow_to_differentiate = True
    masses = ("m1", "m2")

    def set_model(self, table: Table, rig: Rig, friction: FrictionModel) -> None:
        """Set friction law, ground, exact numbers, engine and reaction, as [model] and the table state them."""
        self.friction, self.ground, self.exact = friction, ground_of(table), exact_values(table)
        self.read_instruments(table)
        self.smoothing = Smoothing() if rig.model.engine == "smooth" else None
        self.reaction = rig.model.share_of_reaction

    def with_smoothing(self, widths: Smoothing | None) -> Self:
        """Return the same readings with the smoothed model of ``widths``; None: the exact model, or ``NARROW`` widths.

        A contact of one's own has these widths where [model] chooses the smoothed engine: the exact one need not take it.
        """
        if widths is None and self.smoothing is not None and self.friction.contact is not None:
            widths = NARROW
        return eqx.tree_at(lambda e: e.smoothing, self, widths, is_leaf=lambda x: x is None)

    def law(self, theta: ValuesBySymbol) -> FrictionLaw:
        return super().law({**self.exact, **theta})

    @property
    def names_by_key(self) -> dict[str, str]:
        """k2 is that of the spring in front of the rod, k2_back that of the spring behind it, which may be the same."""
        settings, own = self.table.settings, super().names_by_key
        behind = getattr(settings, "spring_back", None)
        if behind is None:
            return own
        front = {} if settings.spring is None else {"k2": str(Name("k2", settings.spring))}
        return {k: name for k, name in own.items() if k != "k2"} | front | {"k2_back": str(Name("k2", behind))}

    def parameters_of(self, theta: ValuesBySymbol) -> CapsuleParameters:
        """Capsule parameters at ``theta``; mu and v_s are placeholders where another friction law replaces them.

        Stiffnesses are 0, and gaps infinite, where there is no spring.
        """
        known = {**self.exact, **theta}
        return CapsuleParameters(
            m1=theta["m1"],
            m2=theta["m2"],
            k1=theta["k1"],
            c=theta["c"],
            mu=theta.get("mu", 0.0),
            v_s=theta.get("v_s", 1.0),
            g=theta["g"],
            k_cubic=theta.get("k_cubic", 0.0),
            c2=theta.get("c2", 0.0),
            **self.friction.support_at(theta, known.get("G", np.inf)),
            k2_back=theta.get("k2_back", 0.0),
            G_back=known.get("G_back", np.inf),
            **self.ground_at(theta),
        )

    def simulated(
        self, theta: ValuesBySymbol, p: CapsuleParameters, e: Drive, times: ArrayLike, initial: Any = None
    ) -> Trajectory:
        """Call ``simulate`` with this experiment's model and the friction law at ``theta``."""
        model = "exact" if self.smoothing is None else "smooth"
        return simulate(p, e, times, initial, model=model, smoothing=self.smoothing, friction=self.law(theta))

    def noise_facts(self) -> Facts:
        return {"model": "capsule", "law": self.friction.name, "other_laws": other_laws(self.friction)}


# capsule bench: Bench tests with the capsule model as their forward model (``forward = "capsule"`` in rig.toml).
#
# The closed forms hold where the capsule stays at rest, and where the rod is locked to it. A rod released from farther
# away than F_b/k1 moves its capsule. An unlocked rod oscillates on k1 and c while the capsule slides. In both cases the
# closed form is biased. The capsule model of the forced runs, with the drive off, is not.


#: Zero drive; its frequency has no effect.
OFF = Excitation(0.0, 1.0)
#: Simulated duration of a push relative to the duration of a slide over the recorded distance, before the rod's decay.
#: A surface with this much less friction than the readings imply is far outside the posterior.
SLIDES, REST = 6.0, 0.5


class CapsuleDecay(CapsuleForward, DecayRecord):
    """x_rel(t) of a rod released at the first sample, drive off, with the capsule at rest there and free to slip.

    Initial conditions and offset belong to the record. With ``spring`` and ``gap`` the rod may hit the support spring.
    """

    model_name = "capsule model"  # pyright: ignore[reportAssignmentType]
    #: The capsule takes energy when it slips, so that no period repeats.
    cycles = None  # pyright: ignore[reportAssignmentType]
    summaries = Experiment.summaries

    def __init__(self, table: Table, rig: Rig, friction: FrictionModel = EQUATION_1) -> None:
        DecayRecord.__init__(self, table, rig, friction, DecayModel())
        self.set_model(table, rig, friction)
        rows = [parameter("k1"), parameter("c"), *friction.parameters]
        rows += free_parameters(rig, damped=table.settings.spring is not None and friction.contact is None)
        rows += support_parameters(table, friction, table.label)
        rows.append(parameter("x_start", table.label, Prior("normal", 0.0, self.width)))
        rows.append(parameter("y_start", table.label, Prior("normal", 0.0, self.width * self.rough.Omega_o)))
        rows += [NOISE_SD.named(table.label, scatter_prior(float(np.ptp(self.values)))), *ground_parameters(table, rig)]
        rows += clock_parameters(table, rig)
        self.about = replace(self.about, parameters=tuple(rows))

    def unwhitened(self, theta: ValuesBySymbol, xp: ModuleType = jnp) -> tuple[Any, Any]:
        initial = (theta["x_start"], theta["y_start"], 0.0, 0.0)
        times = jnp.multiply.outer(stretch(self.clock_rate, theta), self.time)
        t = self.simulated(theta, self.parameters_of(theta), OFF, times, initial)
        return self.values - xp.asarray(t.X1 - t.X2), self.width * xp.ones((self.n, 1))

    def unstated_errors(self, symbol: str) -> set[str]:
        """Its friction forces do not grow with the amplitude, so that a gain moves every parameter."""
        return super().unstated_errors(symbol) | {"gain"}

    def starts(self) -> dict[str, Start]:
        size, rate = abs(float(self.rough.peaks[0])), np.polyfit(self.time[:5], self.values[:5], 1)[0]
        return {
            **DecayRecord.starts(self),
            f"x_start[{self.label}]": Start(float(self.values[0] - equilibrium(self.values)), 0.02 * size),
            f"y_start[{self.label}]": Start(float(rate), 0.05 * self.rough.Omega_o * size),
            **stated_starts(self.label, G=self.table.settings.gap, G_back=self.table.settings.gap_back),
        }


class CapsulePushes(CapsuleForward, DynamicFriction):
    """Pushes with the rod free on k1 and c: both masses start at speed v, and the capsule's final distance is recorded.

    Variances are those of the locked rod (first order in reading errors and scatter).
    """

    #: (n,) time at which each push is at rest, s.
    horizon: np.ndarray

    # A push with the capsule model depends on k1 and c too, so it is no friction test alone.
    checks = ()

    def __init__(self, table: Table, rig: Rig, friction: FrictionModel = EQUATION_1) -> None:
        self.set_model(table, rig, friction)
        PointTest.__init__(self, table, rig, friction)
        free = free_parameters(rig, damped=False)
        self.about = replace(self.about, parameters=(*free, *self.about.parameters))
        self.horizon = SLIDES * 2.0 * self.observed / self.readings["speed"] + REST

    def own_parameters(self, table: Table) -> tuple[Parameter, ...]:
        return (parameter("k1"), parameter("c"), *DynamicFriction.own_parameters(self, table))

    def predict(self, theta: ValuesBySymbol, x: Mapping[str, Any]) -> Any:
        """(n,) slide distance of the capsule, m."""
        v = jnp.asarray(x["speed"])
        still, end = jnp.zeros_like(v), jnp.asarray(self.horizon)
        times = jnp.stack([still, end], axis=1)
        t = self.simulated(theta, self.parameters_of(theta), OFF, times, (still, v, still, v))
        return t.X2[:, -1]
