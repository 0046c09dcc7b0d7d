"""Experiments whose forward model is the capsule model: mixin, trials, and bench tests with ``forward = "capsule"``."""

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import replace
from types import ModuleType
from typing import Any, Self

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from capsule_id.experiments.base import About, Experiment, Start, ValuesBySymbol, clock_parameters, no_design, stretch
from capsule_id.experiments.dynamic_friction import DynamicFriction
from capsule_id.experiments.free_vibration.declaration import NOISE_SD
from capsule_id.experiments.free_vibration.experiment import FreeVibration
from capsule_id.experiments.free_vibration.readings import DecayModel
from capsule_id.experiments.free_vibration.record import DecayRecord
from capsule_id.experiments.free_vibration.second_fit import starts_of_motion
from capsule_id.experiments.friction import ground_of, ground_parameters
from capsule_id.experiments.friction_model import EQUATION_1, FrictionModel, GroundExperiment, other_laws
from capsule_id.experiments.misfit import Misfit, Moments
from capsule_id.parameters import Prior, parameter
from capsule_id.physics.drive import Drive, Excitation
from capsule_id.physics.friction import FrictionLaw
from capsule_id.physics.model import CapsuleParameters, Trajectory, simulate
from capsule_id.physics.smooth.engine import Smoothing
from capsule_id.rig.model import Column, Rig, Table
from capsule_id.views import Comparison, Facts, Finding

# capsule experiment: Mixin for experiments whose forward model is the capsule model, exact or smoothed.


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


# trials experiment: Base of experiments whose rows are trials at settings of the drive: a setting can be left out,
# and new ones predicted.


class TrialsExperiment(CapsuleForward):
    """Trials of one table.

    Attributes
    ----------
    distance : (n,) displacement of the capsule, m
    settings : (settings, p) numbers of the drive, in an order of the kind's own
    setting : (n, settings) 1 where a row belongs to a setting
    time : (settings,) duration of a trial, s
    """

    distance: np.ndarray
    settings: np.ndarray
    setting: np.ndarray
    time: np.ndarray

    @abstractmethod
    def settings_of(
        self, columns: Mapping[str, Column]
    ) -> tuple[Float[np.ndarray, "rows p"], Float[np.ndarray, " rows"]]:
        """Settings in the rows of a table, and the durations of their trials, s."""

    @abstractmethod
    def setting_names(self) -> list[str]:
        """A short name for every setting, with units."""

    @abstractmethod
    def new_trials(
        self, draws: Sequence[ValuesBySymbol], settings: Float[np.ndarray, "rows p"], rng: np.random.Generator
    ) -> Float[np.ndarray, "draws rows"]:
        """Displacement, m, of a new trial in a new session at each draw of the parameters and each of ``settings``."""

    @abstractmethod
    def speed_panels(
        self,
        settings: Float[np.ndarray, "rows p"],
        centre: Float[np.ndarray, " rows"],
        limits: tuple[Float[np.ndarray, " rows"] | None, Float[np.ndarray, " rows"] | None],
        label: str,
    ) -> tuple[Comparison, ...]:
        """Panels of mean velocities: ``centre`` and ``limits`` of its band, mm/s, at ``settings``, and the trials."""

    @abstractmethod
    def densities_of_settings(self, draws: Sequence[ValuesBySymbol]) -> Float[np.ndarray, "draws settings"]:
        """Log-density of the readings of each setting given the parameters and all others; not finite where none."""

    @abstractmethod
    def motions_of_draws(self, draws: Sequence[ValuesBySymbol]) -> Float[np.ndarray, "draws k"]:
        """The numbers of every draw for which the likelihood runs the capsule; not finite where a run fails."""

    @abstractmethod
    def with_emulator(self, draws: Sequence[ValuesBySymbol], motions: Float[np.ndarray, "draws k"]) -> Self:
        """Return the same trials with an emulator of the motions, fitted to ``motions_of_draws`` of ``draws``."""

    @abstractmethod
    def without(self, setting: int) -> Self:
        """Return the experiment without the trials of one setting."""

    @abstractmethod
    def motions_without(self, motions: Float[np.ndarray, "draws k"], setting: int) -> Float[np.ndarray, "draws m"]:
        """Those of ``motions_of_draws`` that the experiment without one setting has."""


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
#: Gap of a support spring out of reach, m.
FAR = 1e3


class CapsuleDecay(CapsuleForward, FreeVibration):
    """x_rel(t) of a rod released at the first sample, drive off, with the capsule at rest there and free to slip.

    Initial conditions and offset belong to the record. With ``spring`` and ``gap`` the rod may hit the support spring.
    """

    gap: float
    within_reach: bool = eqx.field(static=True)
    gap_known: bool = eqx.field(static=True)

    checks = ()
    tables = ()

    def __init__(self, table: Table, rig: Rig, friction: FrictionModel = EQUATION_1) -> None:
        DecayRecord.__init__(self, table, rig, friction, DecayModel())
        self.smoothing, self.ground = None, ground_of(table)
        gap = table.settings.gap
        self.within_reach = gap is not None
        self.gap = FAR if gap is None else gap.value
        self.gap_known = gap is None or gap.sd == 0.0
        rows = [parameter("k1"), parameter("c"), *friction.parameters]
        if gap is not None:
            rows.append(parameter("k2", table.settings.spring))
            if gap.sd > 0.0:
                rows.append(parameter("G", table.label, Prior("positive_normal", gap.value, gap.sd)))
        rows.append(parameter("x_start", table.label, Prior("normal", 0.0, self.width)))
        rows.append(parameter("y_start", table.label, Prior("normal", 0.0, self.width * self.rough.Omega_o)))
        rows += [NOISE_SD.named(table.label, self.noise_prior()), *ground_parameters(table, rig)]
        rows += clock_parameters(table, rig)
        self.about = replace(self.about, parameters=tuple(rows))

    @classmethod
    def second_models(cls, records: Sequence[Any], readings: Sequence[Finding] = ()) -> tuple[list[Any], list[Finding]]:
        return Experiment.second_models(records, readings)

    @property
    def model_name(self) -> str:
        return "capsule model"

    def motion_of(self, theta: ValuesBySymbol) -> Any:
        """(n,) x_rel of the model, m."""
        p = self.parameters_of(theta, theta.get("k2", 0.0), self.gap if self.gap_known else theta["G"])
        initial = (theta["x_start"], theta["y_start"], 0.0, 0.0)
        times = jnp.multiply.outer(stretch(self.clock_rate, theta), self.time)
        t = self.simulated(theta, p, OFF, times, initial)
        return t.X1 - t.X2

    def unwhitened(self, theta: ValuesBySymbol, xp: ModuleType = jnp) -> tuple[Any, Any]:
        return self.values - xp.asarray(self.motion_of(theta)), self.width * xp.ones((len(self.time), 1))

    def summaries(self, theta: ValuesBySymbol, xp: ModuleType = jnp) -> tuple[Misfit | Moments, ...]:
        return Experiment.summaries(self, theta, xp)

    def starts(self) -> dict[str, Start]:
        starts = super().starts() | starts_of_motion(self, self.rough)
        if not self.gap_known:
            starts[f"G[{self.label}]"] = Start(self.gap, 0.5 * self.table.settings.gap.sd / self.gap)
        return starts


class CapsulePushes(CapsuleForward, DynamicFriction):
    """Pushes with the rod free on k1 and c: both masses start at speed v, and the capsule's final distance is recorded.

    Variances are those of the locked rod (first order in reading errors and scatter).
    """

    #: (n,) time at which each push is at rest, s.
    horizon: np.ndarray

    # A push with the capsule model depends on k1 and c too, so it is no friction test alone.
    checks = ()

    def __init__(self, table: Table, rig: Rig, friction: FrictionModel = EQUATION_1) -> None:
        DynamicFriction.__init__(self, table, rig, friction)
        self.smoothing = None
        self.horizon = SLIDES * 2.0 * self.distance / self.speed + REST
        self.about = About(table, rig, (parameter("k1"), parameter("c"), *self.parameters))

    def slide(self, theta: ValuesBySymbol, xp: ModuleType = jnp) -> Any:
        """(n,) slide distance of the capsule, m."""
        still, v = xp.zeros(self.n), xp.asarray(self.speed)
        times = xp.stack([xp.zeros(self.n), xp.asarray(self.horizon)], axis=1)
        t = self.simulated(theta, self.parameters_of(theta, 0.0, FAR), OFF, times, (still, v, still, v))
        return xp.asarray(t.X2)[:, -1]

    def misfits(self, theta: ValuesBySymbol, xp: ModuleType = jnp) -> tuple[Misfit]:
        _, variance, change = self.locked_slide(theta)
        return (Misfit(self.distance - self.slide(theta, xp), variance, change, no_design(self.n, xp)),)
