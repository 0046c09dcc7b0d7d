"""What every experiment offers to inference and to the report.

An experiment says, for given parameters, by how much each reading misses (``misfits``): the raw misfit, how its
standard deviation depends on a scatter, and the design of the nuisances that enter linearly. Likelihood, residuals,
pointwise densities and the posterior predictive p-value all follow from that here, once.

An experiment is a frozen tree (``equinox.Module``): its leaves are the numbers that the likelihood reads, its static
fields are words and flags. Whatever no likelihood reads lies in ``About``.
"""

from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field
from types import ModuleType
from typing import TYPE_CHECKING, Any, ClassVar, Self

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from scipy import stats
from scipy.linalg import block_diag

from capsule_id.experiments.checks.context import Check, RunRecord, TableMaker
from capsule_id.experiments.linear import LOG_2PI
from capsule_id.experiments.misfit import Misfit, Moments, ScaledMisfit
from capsule_id.parameters import Parameter
from capsule_id.precision import require_float64
from capsule_id.rig.model import Column, Rig, Table
from capsule_id.views import Comparison, Facts, Finding

if TYPE_CHECKING:
    from capsule_id.experiments.families.friction_model import FrictionModel
    from capsule_id.physics.smooth.engine import Smoothing

require_float64()

#: Parameter values and constants, SI, by *symbol* (``k1``, ``k2``, ``noise_sd``, ``g``, ``m1``): what one experiment
#: sees. ``Experiment.local`` makes it from values by name (``k2[soft]``, ``noise_sd[decay_1]``).
ValuesBySymbol = Mapping[str, Any]


@dataclass(frozen=True)
class Start:
    """Where a fit may start: ``centre`` (SI) and how far starts are dispersed, natural-log units where positive."""

    centre: float
    spread: float


@dataclass(frozen=True)
class About:
    """What an experiment was made of; no likelihood reads it.

    All of these compare as equal. Experiments that differ only in numbers and labels have therefore equal tree
    structures: they can be stacked, and they share compiled programs.

    Attributes
    ----------
    table, rig : the readings as they were read, with units and row numbers, and the constants of the rig
    parameters : those sampled for the experiment (masses are the rig's)
    """

    table: Table = field(compare=False)
    rig: Rig = field(compare=False)
    parameters: tuple[Parameter, ...] = field(compare=False)


class Experiment(eqx.Module):
    """One rig test: its readings, the paper's estimator, its likelihood, its checks, its part of the report.

    Subclasses set ``about`` and their own fields in ``__init__(table, rig)``.
    """

    about: About = eqx.field(static=True)

    #: Readings follow each other in time: residuals must be white.
    time_series: ClassVar[bool] = False
    #: The forward model is the event-driven capsule: differentiable in forward mode only, and slow (milliseconds).
    event_driven: ClassVar[bool] = False
    #: An estimate from these readings alone may be negative, as the slope of a falling line is.
    estimates_may_be_negative: ClassVar[bool] = False
    #: Checks of the fitted experiments that declare them, and tables of the report; each is called once.
    checks: ClassVar[tuple[Check, ...]] = ()
    tables: ClassVar[tuple[TableMaker, ...]] = ()

    @classmethod
    def make(cls, table: Table, rig: Rig, friction: "FrictionModel") -> "tuple[Experiment, ...]":
        """The experiments of one table: one, or the parts of a record that is to be cut.

        ``friction`` is the law that the experiments of a fit share; a kind without a sliding capsule has no use for it.
        """
        del friction
        return (cls(table, rig),)  # type: ignore[call-arg, arg-type]  # pyright: ignore

    @property
    def table(self) -> Table:
        return self.about.table

    @property
    def rig(self) -> Rig:
        return self.about.rig

    @property
    def label(self) -> str:
        return self.table.label

    @property
    def kind(self) -> str:
        return self.table.kind

    @property
    def bench(self) -> bool:
        """A test on the bench, as against a recorded run of the capsule."""
        return self.table.bench

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Those sampled for this experiment (masses are the rig's)."""
        return self.about.parameters

    @property
    def n(self) -> int:
        """Number of readings that enter the likelihood."""
        return self.observed.shape[0]

    @property
    def scale_known(self) -> bool:
        """The sd of every misfit is known beforehand: chi-square has a meaning of its own."""
        return False

    @property
    def scatters(self) -> tuple[str | None, ...]:
        """Symbol of the scatter of each of ``misfits``; None where its sd is known."""
        return (None,)

    @property
    def masses(self) -> tuple[str, ...]:
        """Symbols of the masses that the likelihood reads."""
        return ()

    def local(self, values: Mapping[str, Any]) -> dict[str, Any]:
        """Values by symbol out of values by name."""
        own = {row.symbol: values[row.name] for row in self.parameters}
        return own | {name: values[name] for name in (*self.masses, "g") if name in values}

    @property
    @abstractmethod
    def observed(self) -> np.ndarray:
        """(n,) the readings that the likelihood is a density of, SI."""

    @abstractmethod
    def misfits(self, theta: ValuesBySymbol, xp: ModuleType = jnp) -> tuple[Misfit, ...]:
        """Misfits of the independent groups of readings, in the order of ``observed``, at any value of their scatters.

        ``theta`` need not hold scatters; ``xp`` is ``jax.numpy`` or ``numpy``.
        """

    def summaries(self, theta: ValuesBySymbol, xp: ModuleType = jnp) -> tuple[Misfit | Moments, ...]:
        """The same for the likelihood alone: moments where they say it all."""
        return tuple(misfit.summary() for misfit in self.misfits(theta, xp))

    def misfit(self, theta: ValuesBySymbol) -> ScaledMisfit:
        """All groups together at the scatters of ``theta``, NumPy."""
        parts = self.scaled(theta, np)
        return ScaledMisfit(
            np.concatenate([part.raw for part in parts]),
            np.concatenate([part.sd for part in parts]),
            block_diag(*(part.design for part in parts)),
            np.concatenate([part.log_measure for part in parts]),
        )

    def scaled(self, theta: ValuesBySymbol, xp: ModuleType = jnp) -> list[ScaledMisfit]:
        """The misfits at the scatters of ``theta``."""
        pairs = zip(self.misfits(theta, xp), self.scatters, strict=True)
        return [misfit.at(theta[symbol] if symbol else 0.0, xp) for misfit, symbol in pairs]

    @abstractmethod
    def starts(self) -> dict[str, Start]:
        """A start for every parameter of this experiment, by name, from rough estimates out of its own readings."""

    @abstractmethod
    def comparison(self, theta: ValuesBySymbol, draws: list[ValuesBySymbol]) -> Comparison:
        """Measured beside predicted at the point fit ``theta``, with a band from posterior ``draws`` (may be [])."""

    def comparisons(self, theta: ValuesBySymbol, draws: list[ValuesBySymbol]) -> tuple[Comparison, ...]:
        """All panels of the experiment."""
        return (self.comparison(theta, draws),)

    # -- likelihood -------------------------------------------------------------------------------------------------

    def log_likelihood(self, theta: ValuesBySymbol, xp: ModuleType = jnp) -> Any:
        """Natural, normalised log-density of the readings, linear nuisances integrated out; scalar."""
        pairs = zip(self.summaries(theta, xp), self.scatters, strict=True)
        return sum(part.log_density(theta[symbol] if symbol else 0.0, xp) for part, symbol in pairs)

    def residuals(self, theta: ValuesBySymbol, xp: ModuleType = jnp) -> Any:
        """(n + p,) residuals in units of the noise at the conditional mean of the p linear nuisances, then those.

        Half their sum of squares is the parameter-dependent part of -log_likelihood but for its log-determinant.
        """
        parts = [part.at_nuisance_mean(xp) for part in self.scaled(theta, xp)]
        return xp.concatenate([rest for rest, _ in parts] + [b for _, b in parts])

    def records(self, theta: ValuesBySymbol) -> list[tuple[str, np.ndarray]]:
        """Residuals of every record of the experiment, (n,) each in units of the noise, by label; NumPy."""
        return [(self.label, np.asarray(self.residuals(theta, np))[: self.n])]

    def nuisance_mean(self, theta: ValuesBySymbol) -> np.ndarray:
        """(p,) conditional mean of the linear nuisances, in units of their priors."""
        return self.misfit(theta).at_nuisance_mean(np)[1]

    def pointwise(self, theta: ValuesBySymbol, rng: np.random.Generator) -> np.ndarray:
        """(n,) log-density of each reading, conditional on one draw of the linear nuisances."""
        misfit = self.misfit(theta)
        scaled = misfit.at_nuisance_draw(rng)
        return -0.5 * scaled**2 - np.log(misfit.sd) - 0.5 * LOG_2PI + misfit.log_measure

    def predictive_p(self, draws: list[ValuesBySymbol], rng: np.random.Generator) -> float | None:
        """Posterior predictive p-value of the chi-square discrepancy; None without draws.

        Given the parameters the discrepancy of a replicate is chi-square with n degrees of freedom exactly, so no
        replicate needs to be drawn.
        """
        if not draws:
            return None
        squares = [np.sum(self.misfit(theta).at_nuisance_draw(rng) ** 2) for theta in draws]
        return float(np.mean(stats.chi2.sf(squares, self.n)))

    # -- what a kind may offer beside its likelihood ----------------------------------------------------------------

    def predictable_parts(self, theta: ValuesBySymbol) -> "tuple[tuple[Experiment, ...], list[Finding]]":
        """The experiment in parts, where one initial state cannot predict all of it at ``theta``; and what was done."""
        del theta
        return (self,), []

    def corrected_start(self, theta: ValuesBySymbol) -> tuple[Self, dict[str, float]] | None:
        """The experiment with another kind of initial state, where the readings contradict that of ``theta``.

        Also the values, SI, by name, from which a fit continues. None: the initial state stands.
        """
        del theta

    def excess_noise(self, theta: ValuesBySymbol) -> float:
        """Largest ratio of a noise level of ``theta`` to the one that the record itself shows; 0 where it shows none."""
        del theta
        return 0.0

    def with_smoothing(self, widths: "Smoothing | None") -> Self:
        """The same readings with the smoothed capsule model of these ``widths``; the same where no capsule is modelled."""
        del widths
        return self

    def noise_facts(self) -> Facts:
        """What the report's advice needs where the residuals are not white: ``model``, and what drifts in the record."""
        return {}

    def record_view(self, theta: ValuesBySymbol) -> RunRecord | None:
        """The record as the paper looks at it; None where there is no such view."""
        del theta


def no_design(n: int, xp: ModuleType = jnp) -> Any:
    """Design of an experiment without linear nuisances, (n, 0)."""
    return xp.zeros((n, 0))


def axis_label(column: Column, symbol: str = "") -> str:
    """``name, unit`` for an axis."""
    return f"{symbol or column.name} [{column.unit}]"


def band(values: np.ndarray) -> tuple[np.ndarray | None, np.ndarray | None]:
    """Equal-tailed 95 % band over the first axis of ``values`` (m, n); (None, None) where m is 0."""
    if len(values) == 0:
        return None, None
    lower, upper = np.quantile(values, [0.025, 0.975], axis=0)
    return lower, upper
