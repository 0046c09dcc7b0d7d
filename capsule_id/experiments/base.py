"""Base class of experiments: their interface to inference, to checks and to the report."""

from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from types import ModuleType
from typing import Any, ClassVar, NamedTuple, Protocol, Self

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from scipy import linalg, stats
from scipy.optimize import least_squares

from capsule_id.experiments.misfit import Misfit, Moments, ScaledMisfit
from capsule_id.experiments.statistics import ljung_box
from capsule_id.parameters import ENDS, Parameter, Prior, is_stated, parameter
from capsule_id.physics.smooth.engine import Smoothing
from capsule_id.precision import require_float64
from capsule_id.records.view import RunRecord
from capsule_id.rig.model import NO_DRIFT, Column, Rig, Table
from capsule_id.views import Comparison, Facts, Finding, ResultTable, with_unit

# base: Base class of experiments: their interface to inference and to the report.
#
# An experiment computes the misfit of each reading for given parameters (``misfits``). A misfit consists of the raw
# difference, the dependence of its standard deviation on a scatter, and the design of the linear nuisances.
# The base class derives likelihood, residuals, pointwise densities and the posterior predictive p-value from it.
#
# An experiment is a frozen tree (``equinox.Module``): its leaves are the numbers that the likelihood reads, its static
# fields are strings and flags. ``About`` holds all other data.


require_float64()

#: Terms of a record in the leave-one-out density, and most terms of a table. A stretch of a sixtieth of a record seldom
#: decides a parameter; nor does one of a thousand rows, and each term holds a density for each of a thousand draws.
BLOCKS, MOST_TERMS = 60, 1000

#: Parameter values and constants of one experiment, SI, by *symbol* (``k1``, ``k2``, ``noise_sd``, ``g``, ``m1``).
#: ``Experiment.local`` makes it from values by name (``k2[soft]``, ``noise_sd[decay_1]``).
ValuesBySymbol = Mapping[str, Any]


# context: Interface between a fit and the checks and tables of an experiment.


@dataclass(frozen=True)
class Tension:
    """Likelihood-ratio test that two groups of experiments share their parameters.

    Attributes
    ----------
    p : p-value of twice the increase of the log-posterior where each group has its own parameters, from chi-square with 1
        degree of freedom
    one, other : estimates from each group alone, SI, by name
    """

    p: float
    one: Mapping[str, float]
    other: Mapping[str, float]


class Fitted(Protocol):
    """A finished fit.

    Attributes
    ----------
    values : the point fit and the constants, SI, by name
    flagged : row indices of the outliers, by label
    draws : posterior draws, SI, by name; [] without a sample
    """

    @property
    def values(self) -> Mapping[str, float]: ...

    @property
    def flagged(self) -> Mapping[str, Sequence[int]]: ...

    @property
    def draws(self) -> Sequence[Mapping[str, float]]: ...

    def tension(self, one: Sequence[Any], other: Sequence[Any]) -> Tension:
        """Likelihood-ratio test that two groups of experiments share their parameters."""
        ...

    def correlation(self, names: Sequence[str]) -> np.ndarray:
        """(n, n) correlations of parameters, of the draws or, without a sample, at the maximum."""
        ...


#: A check maps the experiments that declare it, and the fit, to findings; a table function maps them to tables.
Check = Callable[[Sequence[Any], Fitted], list[Finding]]
TableMaker = Callable[[Sequence[Any], Fitted], list[ResultTable]]


# experiment: Its data beside the likelihood, and its methods.


@dataclass(frozen=True)
class Start:
    """Starting value of a parameter: ``centre`` (SI) and dispersion of starts, natural-log units where positive."""

    centre: float
    spread: float


@dataclass(frozen=True)
class About:
    """Inputs of an experiment that no likelihood reads.

    All instances compare as equal. Experiments that differ only in numbers and labels therefore have equal tree
    structures: they can be stacked, and they share compiled programs.

    Attributes
    ----------
    table, rig : the readings as read, with units and row numbers, and the constants of the rig
    parameters : parameters sampled for the experiment, without masses, which belong to the rig
    """

    table: Table = field(compare=False)
    rig: Rig = field(compare=False)
    parameters: tuple[Parameter, ...] = field(compare=False)


@dataclass(frozen=True)
class Unavailable:
    """Takes the place of ``About`` in stacked experiments: one stack serves several tables, so none can be read."""

    def __getattr__(self, name: str) -> Any:
        raise AttributeError(
            f"a likelihood must not read {name} of the table or rig: make the number a field of the experiment, "
            "or the word a field with eqx.field(static=True)"
        )


class Experiment(eqx.Module):
    """One rig test: readings, the paper's estimator, likelihood, checks and part of the report.

    Subclasses set ``about`` and their own fields in ``__init__(table, rig)``.
    """

    about: About = eqx.field(static=True)

    #: Whether the readings form a time series, so that residuals must be white.
    time_series: ClassVar[bool] = False
    #: Whether the forward model is the event-driven capsule: forward-mode derivatives only, and slow (milliseconds).
    event_driven: ClassVar[bool] = False
    #: Whether derivatives of the residuals take seconds to compile, and the residuals do not.
    slow_to_differentiate: ClassVar[bool] = False
    #: Whether an estimate from these readings alone may be negative, as the slope of a falling line is.
    estimates_may_be_negative: ClassVar[bool] = False
    #: Whether the noise model holds a slow drift, so that slow residuals are no misfit.
    explains_trend: ClassVar[bool] = False
    #: Checks of the fitted experiments that declare them, and tables of the report; each is called once.
    checks: ClassVar[tuple[Check, ...]] = ()
    tables: ClassVar[tuple[TableMaker, ...]] = ()

    #: Whether the sd of every misfit is known, so that chi-square tests the fit.
    scale_known: ClassVar[bool] = False
    #: Symbol of the scatter of each of ``misfits``; None where its sd is known.
    scatters: ClassVar[tuple[str | None, ...]] = (None,)
    #: Normal force of every trial, N, and its friction coefficient, (n,) each, where the force is stated row by row.
    loads: ClassVar[tuple[np.ndarray, np.ndarray] | None] = None
    #: Whether readings have several scatters at once; then a point fit takes them from ``profile`` together.
    has_joint_scatters: ClassVar[bool] = False
    #: Names of the parameters of which only the product with a scatter changes the motion, by name of that scatter.
    scaled_by: ClassVar[Mapping[str, tuple[str, ...]]] = {}
    #: Names of positive parameters that the products of ``scaled_by`` multiply, by their exponentials.
    balanced: ClassVar[tuple[str, ...]] = ()
    #: Names of the parameters whose sign is unknown: the point fit tries both.
    mirrored: ClassVar[tuple[str, ...]] = ()
    #: Symbols of the masses that the likelihood reads.
    masses: ClassVar[tuple[str, ...]] = ()
    #: Time of every reading of a channel in periods of the motion, (n,); None without a period.
    cycles: ClassVar[np.ndarray | None] = None

    # Equinox makes every method that is looked up a tree of its own, in 0.1 ms. NumPy code calls methods far more often.
    __getattribute__ = object.__getattribute__

    @classmethod
    def make(cls, table: Table, rig: Rig, friction: Any) -> "tuple[Experiment, ...]":
        """Make the experiments of one table: one, or several parts of a divided record.

        ``friction``, a ``FrictionModel``, is the law that the experiments of a fit share; a kind without a sliding capsule
        ignores it.
        """
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
        """Whether this is a bench test, not a forced run."""
        return self.table.bench

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Parameters sampled for this experiment, without masses, which belong to the rig."""
        return self.about.parameters

    @property
    def n(self) -> int:
        """Number of readings that enter the likelihood."""
        return len(self.observed)

    def unstated_errors(self, symbol: str) -> set[str]:
        """Of the errors ``INSTRUMENT_WORDS``, those that move the parameter ``symbol`` and that rig.toml does not state."""
        drift = self.table.drift != NO_DRIFT and not _counted(self.table)
        stated = drift or _logger(self.table) or "time" not in self.table.columns
        return set() if stated else {"clock"}

    @property
    def work(self) -> int:
        """Time of an evaluation of the likelihood, in units of that of one reading."""
        return self.n

    def alternatives(self, theta: ValuesBySymbol) -> dict[str, np.ndarray]:
        """Effect (n,) on the readings, SI, of what a setting that varies can show beside the law, by name of the setting."""
        return {}

    @property
    def names_by_key(self) -> dict[str, str]:
        """Name of each parameter by the symbol, or the name, by which the likelihood knows its value."""
        return {row.key: row.name for row in self.parameters}

    def local(self, values: Mapping[str, Any]) -> dict[str, Any]:
        """Select values by symbol from values by name."""
        own = {key: values[name] for key, name in self.names_by_key.items()}
        return own | {name: values[name] for name in (*self.masses, "g") if name in values}

    @property
    @abstractmethod
    def observed(self) -> np.ndarray:
        """(n,) readings that enter the likelihood, SI."""

    @abstractmethod
    def misfits(self, theta: ValuesBySymbol, xp: ModuleType = jnp) -> tuple[Misfit, ...]:
        """Misfits of the independent groups of readings, in the order of ``observed``, at any value of their scatters.

        ``theta`` need not hold scatters; ``xp`` is ``jax.numpy`` or ``numpy``.
        """

    def summaries(self, theta: ValuesBySymbol, xp: ModuleType = jnp) -> tuple[Misfit | Moments, ...]:
        """Misfits for the likelihood alone: moments where they are sufficient."""
        return tuple(misfit.summary(xp) for misfit in self.misfits(theta, xp))

    def misfit(self, theta: ValuesBySymbol, xp: ModuleType = np) -> ScaledMisfit:
        """Misfit of all groups together at the scatters of ``theta``."""
        parts = self.scaled(theta, xp)
        diagonal = linalg.block_diag if xp is np else jax.scipy.linalg.block_diag
        return ScaledMisfit(
            xp.concatenate([part.raw for part in parts]),
            xp.concatenate([part.sd for part in parts]),
            diagonal(*(part.design for part in parts)),
            xp.concatenate([part.log_measure for part in parts]),
        )

    def scaled(self, theta: ValuesBySymbol, xp: ModuleType = jnp) -> list[ScaledMisfit]:
        """Misfits of each group at the scatters of ``theta``."""
        pairs = zip(self.misfits(theta, xp), self.scatters, strict=True)
        return [misfit.at(theta[symbol] if symbol else 0.0, xp) for misfit, symbol in pairs]

    def starts(self) -> dict[str, Start]:
        """Starts by name, estimated roughly from its own readings; other parameters start at the medians of their priors."""
        return {}

    def nested_starts(self) -> Sequence[Mapping[str, float]]:
        return ()  # values, SI, by name, of fits of simpler models: further starts

    @abstractmethod
    def comparisons(self, theta: ValuesBySymbol, draws: list[ValuesBySymbol]) -> tuple[Comparison, ...]:
        """Panels of readings and prediction at the point fit ``theta``, with bands from ``draws`` (may be [])."""

    def log_likelihood(self, theta: ValuesBySymbol, xp: ModuleType = jnp) -> Any:
        """Natural, normalised log-density of the readings, linear nuisances integrated out; scalar."""
        pairs = zip(self.summaries(theta, xp), self.scatters, strict=True)
        return sum(part.log_density(theta[symbol] if symbol else 0.0, xp) for part, symbol in pairs)

    def residuals(self, theta: ValuesBySymbol, xp: ModuleType = jnp) -> Any:
        """(n + p,) residuals in units of the noise at the conditional mean of the p linear nuisances, then that mean.

        Half their sum of squares is the parameter-dependent part of -log_likelihood without its log-determinant.
        """
        parts = [part.at_nuisance_mean(xp) for part in self.scaled(theta, xp)]
        return xp.concatenate([rest for rest, _ in parts] + [b for _, b in parts])

    def records(self, theta: ValuesBySymbol) -> list[tuple[str, np.ndarray]]:
        """Residuals of every record of the experiment, (n,) each in units of the noise, by label; NumPy."""
        return [(self.label, np.asarray(self.residuals(theta, np))[: self.n])]

    def nuisance_mean(self, theta: ValuesBySymbol) -> np.ndarray:
        """(p,) conditional mean of the linear nuisances, in units of their priors."""
        return self.misfit(theta).at_nuisance_mean(np)[1]

    def blocks(self, n: int) -> np.ndarray:
        """(blocks,) first of ``n`` readings of every leave-one-out term: a row, of a record or a long table a stretch."""
        count = min(n, BLOCKS if self.time_series else MOST_TERMS)
        return np.arange(count) * n // count

    def left_out(self, theta: ValuesBySymbol, xp: ModuleType = np) -> Any:
        """Log-density (blocks,) of each of ``blocks`` given all other readings; coloured noise: as innovations."""
        misfit = self.misfit(theta, xp)
        return misfit.left_out(self.blocks(len(misfit.raw)), xp)

    def replicate(self, theta: ValuesBySymbol, rng: np.random.Generator) -> np.ndarray:
        """Replicate (n,) of the readings, SI, given one draw of the nuisances; coloured noise: and given the past."""
        misfit = self.misfit(theta)
        return self.observed + misfit.sd * (rng.standard_normal(self.n) - misfit.at_nuisance_draw(rng))

    def predictive_p(self, draws: list[ValuesBySymbol], rng: np.random.Generator) -> float | None:
        """Posterior predictive p-value of the chi-square discrepancy; None without draws.

        Given the parameters the discrepancy of a replicate is exactly chi-square with n degrees of freedom, so no
        replicate is drawn.
        """
        if not draws:
            return None
        squares = [np.sum(self.misfit(theta).at_nuisance_draw(rng) ** 2) for theta in draws]
        return float(np.mean(stats.chi2.sf(squares, self.n)))

    @classmethod
    def second_models(cls, records: Sequence[Any], readings: Sequence[Finding] = ()) -> tuple[list[Any], list[Finding]]:
        """Replace the models that ``records``, all of this class, contradict and that the settings leave open.

        ``readings`` are the findings on the readings.
        """
        return list(records), []

    def predictable_parts(self, theta: ValuesBySymbol) -> "tuple[tuple[Experiment, ...], list[Finding]]":
        """Divide the experiment where one initial state cannot predict all of it at ``theta``; also return findings."""
        return (self,), []

    @property
    def shares_noise(self) -> str:
        """Label of the record whose noise the experiment shares: its own, or that of the record that it is a part of."""
        return self.label

    def with_coloured_noise(self, theta: ValuesBySymbol) -> tuple[Self, dict[str, float]] | None:
        """Replace white noise that is not stated by coloured noise; also return its starts, SI, by name. None: it stays."""

    def corrected_start(self, theta: ValuesBySymbol) -> tuple[Self, dict[str, float]] | None:
        """Replace the kind of initial state where the readings contradict that of ``theta``.

        Return the new experiment and the values, SI, by name, from which a fit continues. None: no contradiction.
        """

    def profile(self, theta: ValuesBySymbol) -> Callable[[ValuesBySymbol], float]:
        """The log-likelihood as a function of its scatters by symbol, all other values held at ``theta``."""
        return lambda scatters: float(self.log_likelihood({**theta, **scatters}, np))

    def excess_noise(self, theta: ValuesBySymbol) -> float:
        """Largest ratio of a noise level of ``theta`` to its estimate from the record alone; 0 without an estimate."""
        return 0.0

    def with_smoothing(self, widths: Smoothing | None) -> Self:
        """Return the same readings with the smoothed capsule model of ``widths``; unchanged without a capsule model."""
        return self

    def noise_facts(self) -> Facts:
        """Facts for the report's advice where residuals are not white: ``model``, and drifting quantities."""
        return {}

    def record_view(self, theta: ValuesBySymbol) -> RunRecord | None:
        """Record for comparison with the figures of the paper; None where there is none."""


def scatter_prior(size: float) -> Prior:
    """Default prior of a standard deviation that only the readings show; ``size`` is their range."""
    return Prior("lognormal", 0.01 * size, 100.0)


def axis_label(column: Column) -> str:
    """Return the axis label ``name, unit``."""
    return with_unit(column.name, column.unit)


def band(values: np.ndarray) -> tuple[np.ndarray | None, np.ndarray | None]:
    """Equal-tailed 95 % band over the first axis of ``values`` (m, n); (None, None) where m is 0."""
    if len(values) == 0:
        return None, None
    lower, upper = np.quantile(values, ENDS, axis=0)
    return lower, upper


def stacked(draws: Sequence[ValuesBySymbol], axes: int = 0) -> dict[str, np.ndarray]:
    """Draws of the parameters by symbol, (draws,), with so many further ``axes`` of length 1."""
    return {name: np.array([draw[name] for draw in draws]).reshape(-1, *(1,) * axes) for name in draws[0]}


# clock: The clock of a record: where rig.toml states the sd of its drift, the drift is a parameter of the fit.
#
# An error of the drift stretches the record. k1 follows it twice, c once; a record of many excitation periods runs
# out of step with its drive. An error of the offset changes nothing, because each record has its own initial state
# and phase.


def clock_parameters(table: Table[Any], rig: Rig) -> tuple[Parameter, ...]:
    """The drift of the table's clock where its sd is stated; tables of one logger, or with equal statements, share it."""
    stated = table.drift
    if stated.sd == 0.0:
        return ()
    logger = _logger(table) or (table.label if _counted(table) else "")
    same = (other.label for other in rig.tables if other.drift == stated and not _logger(other))
    return (parameter("clock_drift", logger or next(same, table.label), Prior("normal", stated.value, stated.sd)),)


def _logger(table: Table[Any]) -> str:
    """Name of the instrument that read the times; "" where it is not stated."""
    instrument = table.columns["time"].instrument if "time" in table.columns else None
    return "" if instrument is None else instrument.name


def _counted(table: Table[Any]) -> bool:
    """Whether the rate of a record was found from the ticks of its clock: an error of its own, beside that of the clock."""
    return any(found.code == "times.ticks" for found in table.findings)


def stated_rate(table: Table[Any]) -> float | None:
    """1 + the stated drift, with which the times of ``table`` were read; None where the drift is exact."""
    return 1.0 + table.drift.value if table.drift.sd else None


def stretch(rate: float | None, theta: ValuesBySymbol) -> Any:
    """True time per time as read; ``rate`` from ``stated_rate``. Rough fits of one record have no drift in ``theta``."""
    return 1.0 if rate is None else (1.0 + theta.get("clock_drift", rate - 1.0)) / rate


# whiteness: Records whose residuals are correlated.


#: Family-wise false-alarm rate of a check over its experiments, dimensionless.
LEVEL = 0.002


class Whiteness(NamedTuple):
    """Ljung–Box test of the residuals of one record of an experiment; see ``ljung_box``."""

    experiment: "Experiment"
    record: str
    Q: float
    p: float
    lags: int


def correlated_records(experiments: Sequence["Experiment"], values: Mapping[str, float]) -> tuple[list[Whiteness], int]:
    """Records whose residuals at ``values`` are not white, with a family-wise false-alarm rate of ``LEVEL``.

    Also return the number of all records.
    """
    tests = [
        Whiteness(e, label, *ljung_box(residuals))
        for e in experiments
        if e.time_series
        for label, residuals in e.records(e.local(values))
    ]
    return [one for one in tests if one.p * len(tests) < LEVEL], len(tests)


# refit: Estimates from one experiment alone, with or without some of its readings.


#: Residuals, in units of the noise, where the model has no solution.
UNFIT = 1e9


def refit(experiment: Experiment, theta: ValuesBySymbol, left_out: Sequence[int]) -> dict[str, tuple[float, float]]:
    """Estimate and standard error of the experiment's physical parameters without some readings, SI, by symbol.

    Parameters that rig.toml states stay at the point fit: one experiment alone may not determine them. Scatters stay
    there too when nothing is left out, and are rescaled by the remaining misfit otherwise.
    SciPy's Levenberg-Marquardt on NumPy residuals takes 1 to 8 ms; compiling JAX residuals takes a second.

    Parameters
    ----------
    theta : the point fit
    left_out : row indices
    """
    symbols = [row.symbol for row in experiment.parameters if row.physical and not is_stated(row.name)]
    keep = np.setdiff1d(np.arange(experiment.n), left_out)
    signed = experiment.estimates_may_be_negative
    at = np.array([float(theta[s]) for s in symbols])

    def values_of(w: np.ndarray) -> np.ndarray:
        with np.errstate(over="ignore"):  # of a parameter without information; its step is then shortened
            return at * w if signed else at * np.exp(w)

    def residuals(w: np.ndarray) -> np.ndarray:
        moved = {**theta, **dict(zip(symbols, values_of(w), strict=True))}
        with np.errstate(invalid="ignore"):
            misfit = experiment.misfit(moved)
        sd = misfit.sd[keep]
        y = misfit.raw[keep] / sd
        a = misfit.design[keep] / sd[:, None]
        if not np.all(np.isfinite(a)):
            # An overdamped decay has no solution; the solver then shortens its step.
            return np.full(len(y), UNFIT)
        return y - a @ np.linalg.lstsq(a, y, rcond=None)[0] if a.shape[1] else y

    start = np.ones(len(at)) if signed else np.zeros(len(at))
    solution = least_squares(residuals, start, method="lm", x_scale="jac")
    nuisances = experiment.misfit(theta).design.shape[1]
    freedom = max(len(keep) - len(symbols) - nuisances, 1)
    # A model that is not finite (an overdamped decay) determines nothing.
    jacobian = solution.jac if np.isfinite(solution.jac).all() else np.zeros_like(solution.jac)
    # In columns of unit length: a pseudo-inverse gives no variance to a parameter of little effect beside another.
    unit = np.maximum(np.linalg.norm(jacobian, axis=0), np.finfo(float).tiny)
    variances = np.diag(np.linalg.pinv((jacobian / unit).T @ (jacobian / unit)))
    values = values_of(solution.x)
    # Rounding may leave a variance of no positive value, where two parameters have the same effect.
    sd = np.sqrt(np.where(variances > 0.0, variances, np.inf)) / unit
    scale = 1.0 if experiment.scale_known else np.sqrt(2.0 * solution.cost / freedom)
    errors = scale * np.where(np.isfinite(sd), np.abs(at if signed else values), 1.0) * sd
    return {s: (float(v), float(e)) for s, v, e in zip(symbols, values, errors, strict=True)}
