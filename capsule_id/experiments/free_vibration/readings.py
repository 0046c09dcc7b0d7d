"""Readings of free decays: channels, block means, settings, and the window that contains the decay."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any, Literal

import numpy as np

from capsule_id.errors import InputError
from capsule_id.experiments.free_vibration.decrement import decay_frequency, viscous_fit
from capsule_id.parameters import Parameter, Prior, parameter, scatter
from capsule_id.records.release import FreeDecay, find_free_decay, find_releases
from capsule_id.rig.filters import loudest_part, median_step, uneven_sampling
from capsule_id.rig.model import Table
from capsule_id.rig.schema import COUNT, PlainRule, QuantityRule, SupportSettings, WordsRule
from capsule_id.rig.toml import ANY, Node, is_count, shown

# channels: Channels of a free decay: the displacement x_rel, its rate, or the rod's absolute acceleration.
#
# The capsule is at rest, so the rate of x_rel is the rod's velocity, and its second derivative the rod's
# acceleration. A constant part, such as the component of gravity along the sensor's axis, is the offset that every
# fit integrates out.


@dataclass(frozen=True)
class Channel:
    """One recorded quantity: ``order`` of the time derivative of x_rel, and the noise of a sample."""

    order: int
    noise: Parameter

    def deflection(self, omega: float) -> float:
        """x_rel at a turning point over the peak of the channel that belongs to it, at ``omega`` rad/s; SI."""
        return (1.0, 1.0 / omega, -1.0 / omega**2)[self.order]


#: By column, in the order of the derivative, which is the order in which the channels of a file are fitted.
CHANNELS = {
    "x_rel": Channel(0, scatter("noise_sd", "m", "noise of a record", r"\sigma")),
    "velocity": Channel(1, scatter("noise_velocity", "m/s", "noise of a velocity record", r"\sigma_v")),
    "acceleration": Channel(2, scatter("noise_acceleration", "m/s^2", "noise of an acceleration record", r"\sigma_a")),
}


def channel_of(table: Table) -> str:
    """Column of the first channel of ``table``."""
    return next(name for name in CHANNELS if name in table.columns)


# blocks: Block means of a record: few readings that hold nearly all of its information on a decay.
#
# A block of an evenly sampled record is ``size`` consecutive readings. An unevenly sampled record is divided into
# intervals of ``size`` median steps, with any number of readings. The model's block mean is the two-point Gauss
# rule of the reading times themselves, so it is exact for cubics of the time, at any sampling. Its error relative
# to the amplitude is below (omega W)^4/4320 for blocks of duration W, and 0.0026 (omega W)^2 of twice F_dry/k1
# where a rod with dry friction turns inside the block. At ``READINGS_PER_PERIOD`` these are 4e-7 and 1e-4.


#: Block means per period that replace a long record; with more, a decay's parameters gain less than 0.5 % in precision.
READINGS_PER_PERIOD = 32
#: Shorter records, in samples, are used whole; a block has at least two samples. Records of so many periods that more block
#: means are left than this have fewer per period, but at least so many: intervals are then some 3 % wider.
LONGEST_WHOLE, FEWEST_PER_PERIOD = 2000, 8


@dataclass(frozen=True)
class Blocks:
    """Means of N blocks of readings.

    Attributes
    ----------
    time, values : (N,) means of the times, s, and of the readings
    first, last : (N,) times of the first and the last reading of each block, s
    count : (N,) readings of each block
    nodes, weights : (N, q) s and 1: the block mean of a smooth function is the sum of its weighted values at the nodes
    """

    time: np.ndarray
    values: np.ndarray
    first: np.ndarray
    last: np.ndarray
    count: np.ndarray
    nodes: np.ndarray
    weights: np.ndarray


def block_means(time: np.ndarray, values: np.ndarray, size: int, by_sample: bool = False) -> Blocks:
    """Divide a record into blocks of ``size`` samples; 1 leaves it as it is.

    Parameters
    ----------
    time, values : (n,) s, increasing, and readings. The last samples of an even record may not fill a block; they are
        left out
    by_sample : take every sample as a node. A velocity with dry friction has kinks and an acceleration jumps, so two
        nodes do not suffice
    """
    if size == 1:
        one = np.ones((len(time), 1))
        return Blocks(time, values, time, time, one[:, 0], time[:, None], one)
    if is_even(time):
        time, values = (part[: len(part) // size * size] for part in (time, values))
        number = np.arange(len(time)) // size
    else:
        width = size * median_step(time)
        number = np.unique(((time - time[0]) // width).astype(int), return_inverse=True)[1]
    count = np.bincount(number).astype(float)

    def mean(x: np.ndarray) -> np.ndarray:
        return np.bincount(number, weights=x) / count

    middle = mean(time)
    offset = time - middle[number]
    variance = mean(offset**2)
    lone = variance == 0.0
    variance[lone] = 1.0
    skew = np.where(lone, 0.0, mean(offset**3) / variance)
    root = np.sqrt(skew**2 + 4.0 * variance)
    sides = 0.5 * np.stack([skew + root, skew - root], axis=1)
    weights = np.stack([-sides[:, 1], sides[:, 0]], axis=1) / root[:, None]
    sides[lone] = 0.0
    nodes = middle[:, None] + sides
    edges = np.flatnonzero(np.diff(number, prepend=-1, append=number[-1] + 1))
    first, last = time[edges[:-1]], time[edges[1:] - 1]
    if by_sample:
        place = np.arange(int(np.max(count)))[None]
        inside = place < count[:, None]
        nodes = time[np.where(inside, edges[:-1, None] + place, edges[:-1, None])]
        weights = inside / count[:, None]
    return Blocks(middle, mean(values), first, last, count, nodes, weights)


def is_even(time: np.ndarray) -> bool:
    """Whether the record is evenly sampled, as filters require."""
    return uneven_sampling(time) is None


def block_size(time: np.ndarray, values: np.ndarray, per_period: float = READINGS_PER_PERIOD) -> int:
    """Samples per block that leave about ``per_period`` readings a period; 1 for a record that does not oscillate.

    A period that is longer than the record counts as its length, so that some readings are left in any case.
    """
    try:
        period = min(1.0 / decay_frequency(time, values), float(np.ptp(time)))
    except (InputError, ZeroDivisionError):
        return 1
    return max(1, int(period / per_period / median_step(time[loudest_part(values)])))


def default_block_size(time: np.ndarray, values: np.ndarray) -> int:
    """Samples per block where the settings do not state it: 1 for records of at most ``LONGEST_WHOLE`` samples."""
    if len(time) <= LONGEST_WHOLE:
        return 1
    size = block_size(time, values)
    if len(time) <= size * LONGEST_WHOLE:
        return size
    return max(size, min(len(time) // LONGEST_WHOLE, block_size(time, values, FEWEST_PER_PERIOD)))


def block_mean(values: Any, weights: Any, xp: Any) -> Any:
    """Block means (N, ...) of a function from its values (N q, ...) at the nodes, row by row."""
    shape = (*weights.shape, *values.shape[1:])
    return xp.einsum("nq,nq...->n...", weights, xp.reshape(values, shape))


def hum_columns(time: Any, hum: Any, xp: Any) -> Any:
    """(n, 4) cosine and sine of this frequency, Hz, at the times (n,), s, and both times a slope: size and phase may drift."""
    angle = 2.0 * np.pi * hum * time
    tone = xp.stack([xp.cos(angle), xp.sin(angle)], axis=1)
    return xp.concatenate([tone, (time / time[-1] - 0.5)[:, None] * tone], axis=1)


def without_hum(time: np.ndarray, values: np.ndarray, hum: float | None) -> np.ndarray:
    """The values (n,) of a decay without hum of this frequency, Hz, beside a viscous decay: it would be taken for swings."""
    time, tone = time - time[0], np.zeros_like(values)
    for _ in range(2 if hum else 0):
        columns = hum_columns(time, hum, np)
        tone = columns @ np.linalg.lstsq(columns, viscous_fit(time, values - tone).left + tone)[0]
    return values - tone


def on_both_sides(values: np.ndarray) -> bool:
    """Whether turning points (n,) lie on both sides of the rest position in turn; else each is a period after the last."""
    return bool(np.mean(np.diff(np.sign(np.diff(values))) != 0) > 0.5)


# settings: Settings of a free vibration, the model that they state, and the window that contains the free decay.


#: Parameter of every damping term besides the viscous one, and of the cubic spring.
DAMPING = {"dry": "F_dry", "quadratic": "c_q"}

#: Parameters of all forces besides those of the linear model.
FURTHER = (*DAMPING.values(), "k_cubic")
#: What every parameter of a further force stands for, in words.
EFFECTS = {"F_dry": "dry friction", "c_q": "quadratic damping", "k_cubic": "a cubic spring"}
#: Keys of rig.toml that state a model, and median of the log-normal priors of dry friction and quadratic damping, relative
#: to their natural units.
CHOICES = ("damping", "stiffness", "drift", "noise")
FURTHER_MEDIAN = 0.05
#: Factor of a log-normal prior of a quantity of which little is known.
WIDE = 100.0
#: Periods of a record that a model with further forces, correlated noise or a Gaussian-process drift is fitted to, at most:
#: its evaluations take milliseconds then.
MOST_PERIODS = 250
_DRIFTS = {"linear": "linear drift", "gp": "Gaussian-process drift"}
_NOISES = {"ar1": "coloured noise (AR(1))", "arma": "white and coloured noise (ARMA)"}


def natural_units(k1: Any, m1: Any, size: Any) -> dict[str, Any]:
    """For each further force the parameter that makes it as large as the spring force at ``size``, m; SI, by symbol."""
    return {"F_dry": k1 * size, "c_q": m1 / size, "k_cubic": k1 / size**2}


def further_parameters(symbols: Sequence[str], k1: float, m1: float, size: float) -> list[Parameter]:
    """Rows of the forces in ``symbols``, SI, with priors relative to what the rod feels at its largest deflection ``size``.

    A prior far below that would prefer the absence of a force that the record does not exclude, and the c beside it.
    """
    priors = {
        symbol: Prior("lognormal", FURTHER_MEDIAN * unit, WIDE)
        if symbol in DAMPING.values()
        else Prior("normal", 0.0, unit)
        for symbol, unit in natural_units(k1, m1, size).items()
    }
    return [parameter(symbol, prior=priors[symbol]) for symbol in symbols]


#: Which of several releases in one record are fitted.
RELEASES = PlainRule(
    lambda value: value == "all" or (isinstance(value, list) and bool(value) and all(map(is_count, value))),
    'be "all" or a list of numbers, counted from 1',
    'write releases = "all", or releases = [1, 3]',
    {"anyOf": [{"const": "all"}, {"type": "array", "minItems": 1, "items": {"type": "integer", "minimum": 1}}]},
)


@dataclass(frozen=True, kw_only=True)
class DecaySettings(SupportSettings):
    """Settings of a free vibration, SI.

    Absent words of the model stand for viscous damping, a linear spring, no drift and white noise. Where the record
    contradicts that, a second fit may choose others (``capsule_id.experiments.free_vibration.second_fit``).
    """

    start: Annotated[float | None, QuantityRule("s", ANY)] = None
    stop: Annotated[float | None, QuantityRule("s", ANY)] = None
    releases: Annotated[str | list[int] | None, RELEASES] = None
    capsule: Literal["held", "free"] = "held"
    damping: Annotated[tuple[str, ...] | None, WordsRule(("viscous", *DAMPING))] = None
    stiffness: Literal["linear", "cubic"] | None = None
    drift: Literal["none", "linear", "gp"] | None = None
    noise: Literal["white", "ar1", "arma"] | None = None
    hum: Annotated[float | None, QuantityRule("Hz")] = None
    thin: Annotated[int | None, COUNT] = None
    samples: Literal["record", "turning_points"] = "record"
    smoothing_window: Annotated[float | None, QuantityRule("s")] = None
    forward: Literal["closed", "capsule"] = "closed"

    @property
    def choices(self) -> tuple[Any, ...]:
        """What the words of ``CHOICES`` state; None where a second fit may choose."""
        return self.damping, self.stiffness if self.offers_cubic else "linear", self.drift, self.noise

    @property
    def offers_cubic(self) -> bool:
        """Whether a second fit may choose a cubic spring where no stiffness is stated: not on a slope."""
        return "slope" not in self.ground


@dataclass(frozen=True)
class DecayModel:
    """Forces of a free decay besides the viscous damping and the linear spring, drift and noise of its record.

    Attributes
    ----------
    damping : words of ``DAMPING``, in that order
    cubic : whether the spring has a cubic term
    drift, noise : as in ``DecaySettings``
    thin : the likelihood uses means of so many consecutive samples
    hum : frequency of a tone of constant amplitude beside the decay, Hz; 0 without one
    """

    damping: tuple[str, ...] = ()
    cubic: bool = False
    drift: str = "none"
    noise: str = "white"
    thin: int = 1
    hum: float = 0.0

    @classmethod
    def stated(cls, settings: DecaySettings) -> "DecayModel":
        """Return the model that ``settings`` state; without ``thin`` it uses every sample."""
        damping = tuple(word for word in DAMPING if word in (settings.damping or ()))
        return cls(
            damping,
            settings.stiffness == "cubic",
            settings.drift or "none",
            settings.noise or "white",
            settings.thin or 1,
            settings.hum or 0.0,
        )

    def lines(self, *keys: str) -> str:
        """Lines of ``rig.toml`` that state these ``keys`` of the model."""
        words = ", ".join(f'"{word}"' for word in ("viscous", *self.damping))
        values = {
            "damping": f"[{words}]",
            "stiffness": '"cubic"' if self.cubic else '"linear"',
            "drift": f'"{self.drift}"',
            "noise": f'"{self.noise}"',
            "thin": str(self.thin),
            "hum": f'{{ value = {self.hum:.6g}, unit = "Hz" }}',
        }
        return ", ".join(f"{key} = {values[key]}" for key in (*keys, *(["hum"] if self.hum else [])))

    @property
    def symbols(self) -> tuple[str, ...]:
        """Symbols of the parameters besides k1 and c."""
        return (*(DAMPING[word] for word in self.damping), *(("k_cubic",) if self.cubic else ()))

    def with_force(self, symbol: str) -> "DecayModel":
        """Return the model with one further force."""
        words = tuple(word for word, own in DAMPING.items() if own in (*self.symbols, symbol))
        return replace(self, damping=words, cubic=self.cubic or symbol == "k_cubic")

    @property
    def absent(self) -> tuple[str, ...]:
        """Symbols of the forces that the model lacks."""
        return tuple(symbol for symbol in FURTHER if symbol not in self.symbols)

    @property
    def terms(self) -> set[str]:
        """Everything that the model adds to the simplest one; a model contains those whose terms are a part of its own."""
        return {*self.symbols, *self.shapes, *({self.drift} & {"linear"})}

    @property
    def slow(self) -> bool:
        """Whether an evaluation takes a time in proportion to the length of the record."""
        return bool(self.symbols) or self.whitened

    @property
    def whitened(self) -> bool:
        """Whether noise or drift correlate the readings."""
        return self.noise != "white" or self.drift == "gp"

    @property
    def shapes(self) -> tuple[str, ...]:
        """Symbols of the shape parameters of noise and drift."""
        noise = {"white": (), "ar1": ("noise_time",), "arma": ("noise_time", "white_ratio")}[self.noise]
        return (*noise, *(("drift_ratio", "drift_time") if self.drift == "gp" else ()))

    @property
    def name(self) -> str:
        """Words for tables and legends."""
        words = (
            " + ".join(("viscous", *self.damping)) + " damping",
            "cubic spring" if self.cubic else "",
            _DRIFTS.get(self.drift, ""),
            _NOISES.get(self.noise, ""),
            f"hum of {self.hum:.4g} Hz" if self.hum else "",
            f"means of {self.thin} samples" if self.thin > 1 else "",
        )
        return ", ".join(filter(None, words))


def window_of(table: Table) -> slice:
    """The rows from ``start`` to ``stop`` inclusive, which a fit reads; default: all."""
    time, settings = table["time"], table.settings
    first = 0 if settings.start is None else int(np.searchsorted(time, settings.start, side="left"))
    last = len(time) if settings.stop is None else int(np.searchsorted(time, settings.stop, side="right"))
    return slice(first, max(first, last))


def decay_window(table: Table) -> tuple[np.ndarray, np.ndarray]:
    """Return (time, channel) of a free vibration, SI, from ``start`` to ``stop`` inclusive; default: the whole record."""
    inside = window_of(table)
    return table["time"][inside], table[channel_of(table)][inside]


def first_periods(table: Table[DecaySettings]) -> Table[DecaySettings]:
    """Return the table with a stop after ``MOST_PERIODS``, where none is stated and the record is longer."""
    time, values = decay_window(table)
    period = block_size(time, values, 1.0)
    last = MOST_PERIODS * period
    if table.settings.stop is not None or last >= len(time) or period == 1:
        return table
    return replace(table, settings=replace(table.settings, stop=float(time[last])))


def release_time(decay: FreeDecay) -> float:
    """Start of a free decay, s, in hundredths of its period; none of what comes before it is left in."""
    size = 10.0 ** max(0, int(np.ceil(-np.log10(0.01 * decay.period))))
    return float(np.ceil(decay.start * size - 1e-6)) / size


def cut_at_release(table: Table[DecaySettings]) -> Table[DecaySettings]:
    """Return the table with the release found in its record as ``start``, where there is rest before it.

    A stated ``start`` stays, and a table of turning points has no rest.
    """
    settings = table.settings
    if settings.start is not None or settings.samples != "record":
        return table
    time, values = decay_window(table)
    decay = find_free_decay(time, without_hum(time, values, settings.hum), displacement=channel_of(table) == "x_rel")
    if decay is None or decay.rest == 0.0:
        return table
    return replace(table, settings=replace(settings, start=release_time(decay)))


def divide_at_releases(entry: Node, columns: Mapping[str, np.ndarray], settings: DecaySettings) -> np.ndarray | None:
    """The number of the decay, from 0, that each row belongs to, (n,), -1 for none; None where no releases are stated.

    Raises
    ------
    InputError
        Beside settings of a single decay, or where fewer releases are found than stated.
    """
    wanted, channel = settings.releases, next((name for name in CHANNELS if name in columns), None)
    if wanted is None or channel is None:
        return None
    for key in ("start", "stop", "samples"):
        if key in entry:
            rule = f"releases finds each decay of a record by itself, and takes no {key}"
            raise entry[key].error(rule, "both", f"remove {key}, or releases", of_key=True)
    values = without_hum(columns["time"], columns[channel], settings.hum)
    found = find_releases(columns["time"], values, channel == "x_rel")
    if not found:
        rule, remedy = "releases needs a record of several releases", "remove releases: one decay is found without it"
        raise entry["releases"].error(rule, "fewer than two found", remedy)
    chosen = [k + 1 for k in range(len(found))] if isinstance(wanted, str) else wanted
    if max(chosen) > len(found) or len(set(chosen)) < len(chosen):
        rule = f"releases must name some of the {len(found)} releases found, each once"
        raise entry["releases"].error(rule, shown(wanted), 'correct the numbers, or write "all"')
    owners = np.full(len(columns["time"]), -1)
    for k, number in enumerate(sorted(chosen)):
        owners[found[number - 1]] = k
    return owners
