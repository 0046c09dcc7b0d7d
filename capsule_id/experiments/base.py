"""What every experiment offers to inference and to the report.

An experiment says, for given parameters, by how much each reading misses (``misfits``): the raw misfit, how its
standard deviation depends on a scatter, and the design of the nuisances that enter linearly. Likelihood, residuals,
pointwise densities and the posterior predictive p-value all follow from that here, once.
"""

from abc import ABC, abstractmethod
from collections.abc import Hashable, Mapping
from copy import copy
from dataclasses import dataclass
from types import ModuleType
from typing import Any, Self

import jax.numpy as jnp
import numpy as np
from scipy import stats
from scipy.linalg import block_diag

from capsule_id.experiments.linear import LOG_2PI
from capsule_id.experiments.misfit import Misfit, Moments, ScaledMisfit
from capsule_id.parameters import Parameter
from capsule_id.precision import require_float64
from capsule_id.rig.model import Column, Rig, Table
from capsule_id.views import Comparison, Finding

require_float64()

#: Parameter values, SI, by *symbol* (``k1``, ``k2``, ``noise_sd``, and the constants ``g``, ``m1``, ``m2``): what one
#: experiment sees. ``Experiment.local`` makes it from values by name (``k2[soft]``, ``noise_sd[decay_1]``).
Theta = Mapping[str, Any]


@dataclass(frozen=True)
class Start:
    """Where a fit may start: ``centre`` (SI) and how far starts are dispersed, natural-log units where positive."""

    centre: float
    spread: float


class Experiment(ABC):
    """One rig test: its readings, the paper's estimator, its likelihood, what the report shows of it."""

    #: The unit of the misfit is known beforehand (no scatter is estimated): chi-square has a meaning of its own.
    scale_known = False
    #: Readings follow each other in time: residuals must be white.
    time_series = False
    #: The forward model is the event-driven capsule: differentiable in forward mode, and worth milliseconds.
    event_driven = False
    #: Numeric attributes, and the others, that the likelihood reads: experiments of one class that agree in the shapes
    #: of the former and in the values of the latter are evaluated together, in one batch (see ``signature``).
    ARRAYS: tuple[str, ...] = ()
    STATIC: tuple[str, ...] = ()
    #: Symbol of the scatter of each of ``misfits``; None where its sd is known.
    scatters: tuple[str | None, ...] = (None,)
    #: Masses that the likelihood reads.
    masses: tuple[str, ...] = ()

    def __init__(self, table: Table, rig: Rig) -> None:
        self.table = table
        self.rig = rig

    @property
    def label(self) -> str:
        return self.table.label

    @property
    def kind(self) -> str:
        return self.table.kind

    @property
    def n(self) -> int:
        """Number of readings that enter the likelihood."""
        return self.observed.shape[0]

    @property
    def signature(self) -> Hashable:
        """Equal for experiments that differ only in numbers."""
        shapes = tuple(np.shape(getattr(self, name)) for name in self.ARRAYS)
        return type(self), self.n, shapes, tuple(getattr(self, name) for name in self.STATIC)

    def with_arrays(self, arrays: Mapping[str, Any]) -> Self:
        """The same experiment with other (traced) numbers in place of ``ARRAYS``."""
        clone = copy(self)
        vars(clone).update(arrays)
        return clone

    def local(self, values: Mapping[str, Any]) -> dict[str, Any]:
        """Values by symbol out of values by name."""
        own = {row.symbol: values[row.name] for row in self.parameters}
        return own | {name: values[name] for name in (*self.masses, "g") if name in values}

    @property
    @abstractmethod
    def parameters(self) -> tuple[Parameter, ...]:
        """Those sampled for this experiment (masses are the rig's)."""

    @property
    @abstractmethod
    def observed(self) -> np.ndarray:
        """(n,) the readings that the likelihood is a density of, SI."""

    @abstractmethod
    def misfits(self, theta: Theta, xp: ModuleType = jnp) -> tuple[Misfit, ...]:
        """Misfits of the independent groups of readings, in the order of ``observed``, at any value of their scatters.

        ``theta`` need not hold scatters; ``xp`` is ``jax.numpy`` or ``numpy``.
        """

    def summaries(self, theta: Theta, xp: ModuleType = jnp) -> tuple[Misfit | Moments, ...]:
        """The same for the likelihood alone: moments where they say it all."""
        return tuple(misfit.summary() for misfit in self.misfits(theta, xp))

    def misfit(self, theta: Theta) -> ScaledMisfit:
        """All groups together at the scatters of ``theta``, NumPy."""
        parts = self._scaled(theta, np)
        return ScaledMisfit(
            np.concatenate([part.raw for part in parts]),
            np.concatenate([part.sd for part in parts]),
            block_diag(*(part.design for part in parts)),
            np.concatenate([part.log_measure for part in parts]),
        )

    def _scaled(self, theta: Theta, xp: ModuleType) -> list[ScaledMisfit]:
        pairs = zip(self.misfits(theta, xp), self.scatters, strict=True)
        return [misfit.at(theta[symbol] if symbol else 0.0, xp) for misfit, symbol in pairs]

    @abstractmethod
    def starts(self) -> dict[str, Start]:
        """A start for every parameter of this experiment, from rough estimates out of its own readings."""

    @abstractmethod
    def comparison(self, theta: Theta, draws: list[Theta]) -> Comparison:
        """Measured beside predicted at the point fit ``theta``, with a band from posterior ``draws`` (may be [])."""

    def comparisons(self, theta: Theta, draws: list[Theta]) -> tuple[Comparison, ...]:
        """All panels of the experiment."""
        return (self.comparison(theta, draws),)

    def lint(self, theta: Theta) -> list[Finding]:
        """What the settings themselves say against the experiment, at the point fit."""
        del theta
        return []

    def log_likelihood(self, theta: Theta, xp: ModuleType = jnp) -> Any:
        """Natural, normalised log-density of the readings, linear nuisances integrated out; scalar."""
        pairs = zip(self.summaries(theta, xp), self.scatters, strict=True)
        return sum(part.log_density(theta[symbol] if symbol else 0.0, xp) for part, symbol in pairs)

    def residuals(self, theta: Theta, xp: ModuleType = jnp) -> Any:
        """(n + p,) residuals in units of the noise at the conditional mean of the p linear nuisances, then those.

        Half their sum of squares is the parameter-dependent part of -log_likelihood but for its log-determinant.
        """
        parts = [part.at_nuisance_mean(xp) for part in self._scaled(theta, xp)]
        return xp.concatenate([rest for rest, _ in parts] + [b for _, b in parts])

    def records(self, theta: Theta) -> list[tuple[str, np.ndarray]]:
        """Residuals of every record of the experiment, (n,) each in units of the noise, by label; NumPy."""
        return [(self.label, np.asarray(self.residuals(theta, np))[: self.n])]

    def nuisance_mean(self, theta: Theta) -> np.ndarray:
        """(p,) conditional mean of the linear nuisances, in units of their priors."""
        return self.misfit(theta).at_nuisance_mean(np)[1]

    def pointwise(self, theta: Theta, rng: np.random.Generator) -> np.ndarray:
        """(n,) log-density of each reading, conditional on one draw of the linear nuisances."""
        misfit = self.misfit(theta)
        scaled = misfit.at_nuisance_draw(rng)
        return -0.5 * scaled**2 - np.log(misfit.sd) - 0.5 * LOG_2PI + misfit.log_measure

    def predictive_p(self, draws: list[Theta], rng: np.random.Generator) -> float | None:
        """Posterior predictive p-value of the chi-square discrepancy; None without draws.

        Given the parameters the discrepancy of a replicate is chi-square with n degrees of freedom exactly, so no
        replicate needs to be drawn.
        """
        if not draws:
            return None
        squares = [np.sum(self.misfit(theta).at_nuisance_draw(rng) ** 2) for theta in draws]
        return float(np.mean(stats.chi2.sf(squares, self.n)))


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
