"""The readings of a free decay under one model: their noise, their likelihood, and the paper's estimate from them."""

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from types import ModuleType
from typing import Any, ClassVar, Self

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from tinygp.kernels.quasisep import Matern32
from tinygp.solvers.quasisep.core import DiagQSM, StrictLowerTriQSM, SymmQSM

from capsule_id.experiments.base import (
    About,
    Start,
    ValuesBySymbol,
    axis_label,
    band,
    clock_parameters,
    scatter_prior,
    stated_rate,
    stretch,
)
from capsule_id.experiments.free_vibration.declaration import (
    AMPLITUDE,
    DRIFT_RATIO,
    DRIFT_TIME,
    NOISE_TIME,
    TURNING_TIME,
    WHITE_RATIO,
)
from capsule_id.experiments.free_vibration.decrement import (
    UNKNOWNS,
    Decrement,
    damping_of_peaks,
    equilibrium,
    logarithmic_decrement,
    viscous_basis,
    viscous_fit,
)
from capsule_id.experiments.free_vibration.models import (
    decay,
    decay_moments,
    fold,
    most_half_cycles,
    rates,
    steps_of,
    uniform_step,
)
from capsule_id.experiments.free_vibration.readings import (
    CHANNELS,
    CHOICES,
    FURTHER,
    Blocks,
    Channel,
    DecayModel,
    block_mean,
    block_means,
    channel_of,
    decay_window,
    default_block_size,
    further_parameters,
    hum_columns,
    is_even,
    without_hum,
)
from capsule_id.experiments.friction_model import EQUATION_1, FrictionModel, SurfaceExperiment
from capsule_id.experiments.misfit import NUISANCE_WIDTH, Misfit, Moments
from capsule_id.experiments.statistics import autocorrelation
from capsule_id.parameters import STEP_SD, Parameter, Prior, parameter
from capsule_id.records.release import shortened
from capsule_id.records.tones import VISIBLE, noise_level
from capsule_id.records.view import FILTER_ORDER
from capsule_id.rig.filters import TIMING_TOLERANCE, choose_window, savitzky_golay
from capsule_id.rig.model import Column, Rig, Table
from capsule_id.views import Comparison, Curve, Points

# noise: Coloured noise and drift of a record, at any sampling, whitened in linear time.
#
# The noise is a continuous-time process: an Ornstein–Uhlenbeck process, alone or with white noise. Sampled evenly
# the first is AR(1) and the sum is ARMA(1, 1). A drift is a Matérn-3/2 process. tinygp factorises the covariance of
# such sums in linear time (quasiseparable matrices: D. Foreman-Mackey et al., AJ 154, 220 (2017)).
#
# Block means of the first process have exactly such a covariance again, where the readings of a block are evenly
# spaced.
# A drift changes little within a block, so its value at the middle stands for its mean.


class ReadingTimes(eqx.Module):
    """Times of the readings of N blocks.

    Attributes
    ----------
    time, first, last : (N,) s, as in ``Blocks``
    count : (1,) readings of every block, or (N,)
    step : (1,) or (N,) s between the readings of a block
    longest : largest count
    """

    time: Any
    first: Any
    last: Any
    count: Any
    step: Any
    longest: int = eqx.field(static=True)

    @classmethod
    def of(cls, blocks: Blocks) -> "ReadingTimes":
        """Times of the readings of ``blocks``; equal blocks share count and step."""
        count, step = blocks.count, (blocks.last - blocks.first) / np.maximum(blocks.count - 1.0, 1.0)
        if np.ptp(count) == 0.0 and np.ptp(step) <= TIMING_TOLERANCE * np.max(step):
            count, step = count[:1], np.mean(step, keepdims=True)
        return cls(blocks.time, blocks.first, blocks.last, count, step, int(np.max(count)))


def whiten(times: ReadingTimes, columns: Any, model: DecayModel, theta: ValuesBySymbol) -> Any:
    """Map columns (n, q) to the coordinates where noise and drift are white with the noise's innovation sd; (n, q).

    The map has determinant 1: the density of the readings is that of the whitened readings.
    """
    shape = {symbol: theta[symbol] for symbol in model.shapes}
    return whiten_by_shape(times, jnp.asarray(columns), model.noise, shape)


@partial(jax.jit, static_argnames="noise")
def whiten_by_shape(times: ReadingTimes, columns: Any, noise: str, shape: ValuesBySymbol) -> Any:
    """Whiten as ``whiten``, with the shape parameters of ``noise`` and, where it has some, of the drift."""
    factor = _covariance(times, noise, shape)[0].cholesky()
    return factor.solve(columns) * jnp.exp(jnp.mean(jnp.log(factor.diag.d)))


@partial(jax.jit, static_argnames="noise")
def drift_by_shape(times: ReadingTimes, residuals: Any, noise: str, shape: ValuesBySymbol) -> Any:
    """Expectation (n,) of a Gaussian-process drift, given the ``residuals`` (n,) that it is a part of."""
    total, drift = _covariance(times, noise, shape)
    factor = total.cholesky()
    return drift @ factor.transpose().solve(factor.solve(residuals[:, None]))[:, 0]


def _covariance(times: ReadingTimes, noise: str, shape: ValuesBySymbol) -> tuple[Any, Any]:
    """Covariances of all noise with the drift, and of the drift alone; of unit innovation variance."""
    parts: list[Any] = [averaged_process(times, shape["noise_time"])] if noise != "white" else []
    if "drift_time" in shape:
        parts.append(Matern32(scale=shape["drift_time"], sigma=shape["drift_ratio"]).to_symm_qsm(times.time))
    white = {"white": 1.0, "ar1": 0.0, "arma": shape.get("white_ratio", 0.0) ** 2}[noise] / times.count
    correlated: Any = sum(parts[1:], parts[0])
    return correlated + DiagQSM(d=jnp.broadcast_to(white, times.time.shape)), parts[-1]


def averaged_process(times: ReadingTimes, correlation_time: Any) -> SymmQSM:
    """Covariance of the block means of an Ornstein–Uhlenbeck process of unit variance; (N, N).

    The mean of a block is its readings' mean decay from their first or to their last one. Between two blocks the
    process decays over the time between the nearest readings.
    """
    lags = jnp.arange(times.longest)[None]
    count = times.count[:, None]
    decay = jnp.exp(-lags * times.step[:, None] / correlation_time)
    inside = lags < count
    reach = jnp.sum(decay * inside, axis=1) / times.count
    pairs = jnp.where(inside, jnp.where(lags == 0, 1.0, 2.0) * (count - lags), 0.0)
    variance = jnp.sum(pairs * decay, axis=1) / times.count**2  # pyright: ignore[reportArgumentType]
    n, reach = times.time.shape[0], jnp.broadcast_to(reach, times.time.shape)
    gap = jnp.concatenate([jnp.ones(1), jnp.exp(-(times.first[1:] - times.last[:-1]) / correlation_time)])
    ends = jnp.concatenate([jnp.ones(1), jnp.exp(-jnp.diff(times.last) / correlation_time)])
    lower = StrictLowerTriQSM(p=(reach * gap)[:, None], q=reach[:, None], a=ends[:, None, None])
    return SymmQSM(diag=DiagQSM(d=jnp.broadcast_to(variance, (n,))), lower=lower)


# decay: What the records and the turning points of a decay have in common, and one record.


#: Twice the damping ratio up to which an even record is summed in closed form.
UNIFORM = 0.6
#: Latest first turning point after the first sample, in half periods.
LATEST_TURNING_POINT = 0.1
#: Smallest sd of a reading with white noise, where none is stated, relative to ``width``: that of steps of 18 bits, which
#: good converters resolve. Without noise k1/m1 would have more digits than covariances and sums of squares hold.
FINEST = 2.0**-18 * STEP_SD / NUISANCE_WIDTH


@dataclass(frozen=True)
class Screened:
    """A fit of one thinned record.

    Attributes
    ----------
    values, errors : estimates and standard errors of the free unknowns by symbol, SI; all values, fixed ones included
    noise : innovation sd of the noise, m
    residuals : (n,) whitened
    nested : values of the fits of models that this one contains
    """

    bic: float
    values: Mapping[str, float]
    errors: Mapping[str, float]
    noise: float
    residuals: np.ndarray
    nested: tuple[Mapping[str, float], ...] = ()


@dataclass(frozen=True)
class DecayAbout(About):
    """Further inputs of a decay.

    Attributes
    ----------
    screened : a fit of the record by a screening of models; it gives the starting point of a fit
    rough : the paper's estimate, or that of a least-squares fit where there are too few peaks
    """

    screened: Screened | None = field(default=None, compare=False)
    rough: Any = field(default=None, compare=False)


class Decay(SurfaceExperiment):
    """The readings of a decay, with a model of its forces.

    ``time`` (n,), s, and ``values`` (n,), SI, of its first channel; ``reading_sd``, SI, of its readings, stated or least.
    """

    time: np.ndarray
    values: np.ndarray
    reading_sd: float
    clock_rate: float | None
    about: DecayAbout = eqx.field(static=True)
    model: DecayModel = eqx.field(static=True)

    #: Words of the title of its panel.
    title: ClassVar[str]
    masses = ("m1",)

    @abstractmethod
    def unwhitened(self, theta: ValuesBySymbol, xp: ModuleType = jnp) -> tuple[Any, Any]:
        """Measured minus predicted (m,), SI, and its design (m, p) of the linear nuisances."""

    @abstractmethod
    def whitened(self, theta: Mapping[str, float], columns: np.ndarray) -> np.ndarray:
        """Columns (m,) or (m, q) in the coordinates where the noise, and a drift, are white."""

    def with_model(self, model: DecayModel, screened: Screened | None = None, table: Table | None = None) -> Self:
        """Return the same readings, or other ones, with a model; its fit ``screened`` gives the starting point."""
        return type(self)(table or self.table, self.rig, self.friction, model, screened)  # type: ignore[call-arg]  # pyright: ignore

    def unstated_errors(self, symbol: str) -> set[str]:
        """A gain changes the further forces alone: amplitude and zero are free."""
        return super().unstated_errors(symbol) | ({"gain"} if symbol in FURTHER else set())

    @property
    @abstractmethod
    def moved(self) -> np.ndarray:
        """Distances from the rest position, m; of another channel its largest distances to both sides."""

    @property
    def largest_deflection(self) -> float:
        """Largest distance from the rest position, m."""
        return float(np.max(np.abs(self.moved)))

    @property
    def rough(self) -> Decrement:
        """The paper's estimate, or that of a least-squares fit where there are too few peaks."""
        return self.about.rough

    @property
    def own_symbols(self) -> tuple[str, ...]:
        """Symbols of the unknowns of the motion besides its forces."""
        return ("amplitude",)

    @property
    def mass(self) -> float:
        """Measured mass of the rod, kg."""
        return self.rig.mass("m1")

    @property
    def column(self) -> Column:
        return self.table.columns[channel_of(self.table)]

    @property
    def model_name(self) -> str:
        """Name for the legend."""
        return self.model.name

    @property
    def lines(self) -> str:
        """Lines of ``rig.toml`` that state the model."""
        return self.model.lines(*CHOICES, "thin")

    @property
    def replaced(self) -> bool:
        """Whether a second fit has chosen the model."""
        return self.about.screened is not None

    @property
    def stated_words(self) -> tuple[str, ...]:
        """Keys of the model that the entry states; a second fit leaves them as they are."""
        return tuple(word for word in CHOICES if getattr(self.table.settings, word) is not None)

    def comparisons(self, theta: ValuesBySymbol, draws: list[ValuesBySymbol]) -> tuple[Comparison, ...]:
        def curve(values: ValuesBySymbol) -> np.ndarray:
            raw, design = self.unwhitened(values, np)
            return (self.observed - raw + design @ self.nuisance_mean(values))[: len(self.time)]

        unit, time = self.column.to_display, self.time + float(decay_window(self.table)[0][0])
        lower, upper = band(np.array([curve(draw) for draw in draws[:50]]) * unit)
        residuals = np.asarray(self.residuals(theta, np))[: len(time)]
        return (
            Comparison(
                self.kind,
                self.label,
                f"{self.label}: {self.title}",
                "time, s",
                axis_label(self.column),
                (Points(self.label, time, self.values * unit),),
                (Curve(f"this fit, {self.model_name}", time, curve(theta) * unit, lower, upper),),
                residuals,
                autocorrelation(residuals) if self.time_series else None,
            ),
        )


#: Start of a term that a simpler model lacks, relative to its usual start.
ABSENT = 1e-4


def force_starts(rough: Decrement, c: float, size: float) -> dict[str, Start]:
    """Rough starts of the further forces of a decay whose first turning point is ``size`` m, by symbol."""
    return {
        "F_dry": Start(0.02 * rough.k1 * size, 0.3),
        "c_q": Start(0.5 * c / (rough.Omega_o * size), 0.3),
        "k_cubic": Start(0.0, 0.01 * rough.k1 / size**2),
    }


class DecayRecord(Decay):
    """One channel of one raw record; all records share k1, c and the parameters of further forces.

    For viscous damping and a linear spring the two solutions enter linearly and are integrated out. Any other decay
    starts at its last turning point before the record, which is sampled. Offset and linear drift are integrated out.

    The readings are block means of the record (``capsule_id.experiments.free_vibration.readings``), at ``time``
    (n,); ``relative_sd`` is the sd of one over that of a sample, () or (n,).
    """

    times: ReadingTimes
    nodes: np.ndarray
    weights: np.ndarray
    relative_sd: np.ndarray
    width: float
    side: float
    folded: np.ndarray
    step: float
    half_cycles: int = eqx.field(static=True)
    #: Order of the time derivative of x_rel that the readings are.
    order: int = eqx.field(static=True)

    time_series = True
    title = "free decay"

    def __init__(
        self,
        table: Table,
        rig: Rig,
        friction: FrictionModel = EQUATION_1,
        model: DecayModel | None = None,
        screened: Screened | None = None,
    ) -> None:
        """Make one record; ``model`` None: as stated in the settings; ``screened`` gives starts."""
        self.friction = friction
        self.order = CHANNELS[channel_of(table)].order
        time, values = decay_window(table)
        if model is None:  # a long record is thinned where its settings leave that open
            stated = DecayModel.stated(table.settings)
            model = replace(stated, thin=table.settings.thin or default_block_size(time, values))
        self.model = model
        blocks = block_means(time - float(time[0]), values, self.model.thin, by_sample=self.order > 0)
        self.time, self.values, self.nodes, self.weights = blocks.time, blocks.values, blocks.nodes, blocks.weights
        self.times = ReadingTimes.of(blocks)
        self.relative_sd = np.squeeze(1.0 / np.sqrt(self.times.count))
        self.width = NUISANCE_WIDTH * float(np.ptp(self.values))
        self.reading_sd = table.columns[channel_of(table)].reading_sd or FINEST * self.width
        self.about = DecayAbout(table, rig, (), screened)
        self.about = replace(self.about, rough=self._rough())
        step = uniform_step(self.time)
        linear = self.model == DecayModel(thin=self.model.thin) and self.relative_sd.ndim == 0
        # The sums over an even record have no values at critical damping and beyond.
        uniform = step is not None and linear and self.rough.c < UNIFORM * np.sqrt(self.rough.k1 * self.mass)
        self.step, self.folded = step or 0.0, fold(self.values) if uniform else np.zeros((0, 0))
        if uniform:
            # Means of equal blocks of a viscous decay are such a decay, sampled at their middles.
            self.nodes, self.weights = self.time[:, None], np.ones((len(self.time), 1))
        self.side = float(np.sign(self.first_turning_point()[1]))
        self.half_cycles = 0 if self.closed else most_half_cycles(float(self.time[-1]), self.rough.Omega_o)
        self.clock_rate = stated_rate(table)
        self.about = replace(self.about, parameters=(*self._rows(), *clock_parameters(table, rig)))

    def _rows(self) -> list[Parameter]:
        """Its parameters, without the drift of its clock.

        The noise's correlation time lies between the sampling step and the record's length, the drift's between the
        period of the decay and the square of the record's length over it.
        """
        label, length, root = self.table.label, float(np.ptp(self.time)), float(np.sqrt(len(self.time)))
        periods = length * self.rough.Omega_o / (2.0 * np.pi)
        rows = [
            parameter("k1"),
            parameter("c"),
            self.channel.noise.named(label, scatter_prior(float(np.ptp(self.values)))),
        ]
        shapes = {
            "noise_time": NOISE_TIME.named(label, Prior("lognormal", length / root, root)),
            "white_ratio": WHITE_RATIO.named(label),
            "drift_ratio": DRIFT_RATIO.named(label),
            "drift_time": DRIFT_TIME.named(label, Prior("lognormal", 0.3 * length, max(3.0, 0.3 * periods))),
        }
        rows += [shapes[symbol] for symbol in self.model.shapes]
        if not self.closed:
            size = self.deflection * float(np.ptp(self.values))
            rows += [
                *further_parameters(self.model.symbols, self.rough.k1, self.mass, self.largest_deflection),
                AMPLITUDE.named(label, Prior("lognormal", size, NUISANCE_WIDTH)),
                TURNING_TIME.named(label, Prior("normal", 0.0, float(self.time[-1]))),
            ]
        return rows

    @property
    def explains_trend(self) -> bool:
        return self.model.drift == "gp"

    @property
    def closed(self) -> bool:
        """Whether the solution is closed and linear in its initial conditions."""
        return not self.model.symbols

    @property
    def slow_to_differentiate(self) -> bool:
        return not self.closed

    @property
    def own_symbols(self) -> tuple[str, ...]:
        return () if self.closed else ("amplitude", "turning_time")

    @property
    def scatters(self) -> tuple[str]:
        return (self.channel.noise.symbol,)

    @property
    def channel(self) -> Channel:
        """The recorded quantity."""
        return tuple(CHANNELS.values())[self.order]

    @property
    def deflection(self) -> float:
        """x_rel over the magnitude of the channel, at the rough frequency; SI."""
        return 1.0 if self.order == 0 else abs(self.channel.deflection(self.rough.Omega_o))

    @property
    def observed(self) -> np.ndarray:
        return self.values

    @property
    def work(self) -> int:
        # A step of a half cycle takes as long as twelve readings, correlated noise of a reading as three.
        steps = 0 if self.closed else self.half_cycles * steps_of(self.half_cycles)
        return self.n * (4 if self.model.whitened else 1) + 12 * steps

    def unwhitened(self, theta: ValuesBySymbol, xp: ModuleType = jnp) -> tuple[Any, Any]:
        slope = [xp.asarray(self.time) / self.time[-1] - 0.5] if self.model.drift == "linear" else []
        trend = xp.stack([xp.ones(self.n), *slope], axis=1)
        if self.model.hum:
            tone = hum_columns(xp.asarray(self.nodes).ravel(), self.model.hum, xp)
            trend = xp.concatenate([trend, block_mean(tone, self.weights, xp)], axis=1)
        nodes = xp.asarray(self.nodes).ravel() * stretch(self.clock_rate, theta)
        if self.closed:
            basis = viscous_basis(nodes, theta["k1"], theta["c"], theta["m1"], xp)
            basis = block_mean(basis, self.weights, xp)
            return self.values, self.width * xp.concatenate([basis, trend], axis=1)
        forces = {symbol: theta[symbol] for symbol in ("k1", "c", "m1", *self.model.symbols)}
        motion = decay(nodes, forces, theta["amplitude"], theta["turning_time"], self.half_cycles)
        predicted = self.side * block_mean(xp.asarray(motion[self.order]), self.weights, xp)
        return self.values - predicted, self.width * trend

    def whitened(self, theta: Mapping[str, float], columns: np.ndarray) -> np.ndarray:
        table = np.reshape(columns, (self.n, -1))
        white = (
            np.asarray(whiten(self.times, table, self.model, theta))
            if self.model.whitened
            else table / np.reshape(self.relative_sd, (-1, 1))
        )
        return np.reshape(white, columns.shape)

    def misfits(self, theta: ValuesBySymbol, xp: ModuleType = jnp) -> tuple[Misfit]:
        raw, design = self.unwhitened(theta, xp)
        if not self.model.whitened:
            return (Misfit(raw, (self.reading_sd * self.relative_sd) ** 2, self.relative_sd, design),)
        columns = xp.concatenate([xp.reshape(raw, (-1, 1)), design], axis=1)
        white = xp.asarray(whiten(self.times, columns, self.model, theta))
        return (Misfit(white[:, 0], 0.0, 1.0, white[:, 1:]),)

    def summaries(self, theta: ValuesBySymbol, xp: ModuleType = jnp) -> tuple[Misfit | Moments, ...]:
        if not self.folded.size or xp is np:
            return super().summaries(theta, xp)
        gamma, omega = (rate * stretch(self.clock_rate, theta) for rate in rates(theta["k1"], theta["c"], theta["m1"]))
        yy, ay, aa = decay_moments(self.folded, self.n, self.step, gamma, omega)
        variance = (self.reading_sd * self.relative_sd) ** 2
        return (Moments(yy, self.width * ay, self.width**2 * aa, self.n, variance, self.relative_sd),)

    # -- the paper's estimator and starts ---------------------------------------------------------------------------

    @property
    def whole(self) -> tuple[np.ndarray, np.ndarray]:
        """Time, s from the first sample, and the channel, SI, of every sample, thinned or not."""
        time, values = decay_window(self.table)
        return time - time[0], values

    def between(self, first: float, last: float, model: DecayModel | None = None) -> Self:
        """The readings between two times since the first one, s, with a model (default: that of all readings)."""
        begin = float(decay_window(self.table)[0][0])
        settings = replace(self.table.settings, start=begin + first, stop=begin + last)
        return self.with_model(model or self.model, table=replace(self.table, settings=settings))

    @property
    def condensed(self) -> tuple[np.ndarray, np.ndarray]:
        """As ``whole``; of a long record block means, for the paper's estimate. Their times start at the first mean.

        Hum of the model is taken off.
        """
        time, values = shortened(*decay_window(self.table))
        return time - time[0], without_hum(time, values, self.model.hum)

    def smoothed(self) -> np.ndarray:
        """The condensed record after Savitzky–Golay, m; raw for a record sampled unevenly, which the filter rejects."""
        time, values = self.condensed
        if not is_even(time):
            return values
        window = self.table.settings.smoothing_window or choose_window(time, values, FILTER_ORDER)
        return savitzky_golay(time, values, window, FILTER_ORDER)

    def decrement(self, smooth: bool = True) -> Decrement | None:
        """Return peaks and logarithmic decrement, from the smoothed or the raw record; None with too few peaks."""
        (time, values), smoothed = self.condensed, self.smoothed()
        return logarithmic_decrement(time, smoothed if smooth else values, self.mass, smoothed, jumps=self.order == 2)

    def paper_decrement(self, smooth: bool = True) -> Decrement | None:
        """Estimate k1 and c of this record as in the paper; None also for a record sampled unevenly."""
        return self.decrement(smooth) if is_even(self.condensed[0]) else None

    def _rough(self) -> Decrement:
        if len(self.values) < UNKNOWNS:  # of a part of a record; of a whole one the kind demands more
            raise ValueError("a decay has more unknowns than these readings")
        decrement = self.decrement()
        if decrement is not None and decrement.delta > 0.0:
            return decrement
        found = viscous_fit(self.time, self.values)
        if self.order == 0 and np.std(found.left) > VISIBLE * noise_level(self.values):  # it misses a force
            # Dry friction is a constant force up to the first turning point, where the rest of the record misleads.
            period = int(np.sum(self.time - self.time[0] < 2.0 * np.pi / found.omega))
            turn = int(np.argmax(np.abs(self.values[:period] - self.values[0])))
            if turn >= 2 * UNKNOWNS:
                found = viscous_fit(self.time[:turn], self.values[:turn])
                found = found._replace(gamma=max(found.gamma, 0.01 * found.omega))  # a stroke tells little of it
        return found.decrement(self.mass)

    def rough_damping(self, symbols: Sequence[str]) -> dict[str, float]:
        """Rough c, and those of F_dry and c_q in ``symbols``, SI, from the peaks; {} with too few of them."""
        decrement = self.decrement()
        return {} if decrement is None else damping_of_peaks(decrement, self.mass, self.deflection, symbols)

    def first_turning_point(self) -> tuple[float, float]:
        """Rough time, s, and signed x_rel, m, of the last turning point before the record, or at its first samples."""
        half_period = np.pi / self.rough.Omega_o
        # A velocity peaks a quarter of a period before the turning point.
        first = float(self.rough.times[0]) + (0.5 * half_period if self.order == 1 else 0.0)
        back = int(np.ceil(first / half_period - LATEST_TURNING_POINT))
        growth = self.rough.first_ratio**back
        peak = self.channel.deflection(self.rough.Omega_o) * float(self.rough.peaks[0])
        return first - back * half_period, peak * (-1.0) ** back * growth

    @property
    def moved(self) -> np.ndarray:
        moved = self.values - equilibrium(self.values)
        return moved if self.order == 0 else self.deflection * float(np.max(np.abs(moved))) * np.array([1.0, -1.0])

    @property
    def cycles(self) -> np.ndarray:
        return self.time * self.rough.Omega_o / (2.0 * np.pi)

    def starts(self) -> dict[str, Start]:
        """Start of every parameter, from the paper's estimate or the values of a screening.

        A viscous decay without drift starts at its least-squares fit, whose residuals show the noise at any sampling rate.
        """
        rough, noise = self.rough, noise_level(self.values)
        if self.about.screened is not None:
            noise = self.about.screened.noise / float(np.mean(self.relative_sd))
        elif self.closed and self.model.drift == "none":
            fit = viscous_fit(self.time, self.values)
            rough, noise = (
                fit.decrement(self.mass),
                min(noise, float(np.sqrt(np.sum(fit.left**2) / max(self.n - UNKNOWNS, 1)))),
            )
        # A phase error of the start over the decay leads the fit to a side lobe, a local maximum.
        ringing = min(self.time[-1], 4.0 * self.mass / rough.c)
        spread = min(0.3, 1.0 / (rough.Omega_o * ringing))
        noise = max(noise, 1e-4 * float(np.ptp(self.values)))
        starts = {
            "k1": Start(rough.k1, spread),
            "c": Start(rough.c, 0.3),
            self.channel.noise.named(self.label).name: Start(noise, 0.2),
        }
        if not self.closed:
            time, peak = self.first_turning_point()
            size = abs(peak)
            forces = force_starts(rough, rough.c, size)
            rough_damping = self.rough_damping(self.model.symbols)
            forces |= {
                name: Start(max(rough_damping.get(name, 0.0), 0.2 * forces[name].centre), 0.2)
                for name in ("F_dry", "c_q")
            }
            starts |= {symbol: forces[symbol] for symbol in self.model.symbols} | {
                "c": Start(max(rough_damping.get("c", rough.c), 0.1 * rough.c), 0.2),
                f"amplitude[{self.label}]": Start(size, 0.05),
                f"turning_time[{self.label}]": Start(time, 0.05 / rough.Omega_o),
            }
        known = {} if self.about.screened is None else self.about.screened.values
        for row in self.parameters:
            if row.symbol in known:
                value = known[row.symbol]
                near = starts.get(row.name, Start(value, 0.1))
                # An absent term is no starting point of a logarithm.
                floor = 1e-3 * near.centre if row.positive else -np.inf
                starts[row.name] = Start(max(value, floor), 0.3 * near.spread)
        return starts

    def nested_starts(self) -> list[dict[str, float]]:
        """Values by name, SI, of the fits of simpler models; an absent term is far below its usual start."""
        if self.about.screened is None:
            return []
        usual = {name: start.centre for name, start in self.starts().items()}
        return [
            {
                row.name: max(values[row.symbol], ABSENT * usual[row.name]) if row.positive else values[row.symbol]
                for row in self.parameters
                if row.symbol in values and row.name in usual
            }
            for values in self.about.screened.nested
        ]
