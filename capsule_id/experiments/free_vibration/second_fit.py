"""Choice of the model of free decays where a record contradicts the stated one: starts, noise, hidden forces, ranking."""

import itertools
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from scipy import stats
from scipy.optimize import OptimizeResult, least_squares
from scipy.signal import lsim
from tinygp.kernels.quasisep import Matern32
from tinygp.solvers.quasisep.core import DiagQSM, StrictLowerTriQSM, SymmQSM

from capsule_id.console import stop_if_interrupted
from capsule_id.experiments.base import Start, ValuesBySymbol, stretch
from capsule_id.experiments.checks import LEVEL, ljung_box, refit
from capsule_id.experiments.context import Fitted
from capsule_id.experiments.free_vibration.declaration import DRIFT_RATIO, DRIFT_TIME, NOISE_TIME, WHITE_RATIO
from capsule_id.experiments.free_vibration.models import (
    STRONGEST,
    UNKNOWNS,
    Decrement,
    HalfCycles,
    equilibrium,
    half_cycles,
    interpolate,
    viscous_fit,
    viscous_state,
)
from capsule_id.experiments.free_vibration.readings import (
    DAMPING,
    FURTHER,
    MOST_PERIODS,
    Blocks,
    DecayModel,
    DecaySettings,
    block_mean,
    block_means,
    block_size,
    decay_window,
    first_periods,
)
from capsule_id.experiments.misfit import LOG_2PI
from capsule_id.parameters import Parameter, Prior, parameter
from capsule_id.physics.batches import pool
from capsule_id.records.tones import noise_level
from capsule_id.rig.model import Table
from capsule_id.views import Facts, Finding

if TYPE_CHECKING:
    from capsule_id.experiments.free_vibration.experiment import FreeVibration


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
        if np.ptp(count) == 0.0 and np.ptp(step) <= 0.01 * np.max(step):
            count, step = count[:1], np.mean(step, keepdims=True)
        return cls(blocks.time, blocks.first, blocks.last, count, step, int(np.max(count)))


def noise_parameters(model: DecayModel, time: np.ndarray, period: float, of: str) -> list[Parameter]:
    """Return the shape parameters of noise and drift of the record ``of``, sampled at ``time`` (n,), s.

    The noise's correlation time lies between the sampling step and the record's length, the drift's between the period
    (s) of the decay and the square of the record's length over it.
    """
    length = float(np.ptp(time))
    between = Prior("lognormal", float(length / np.sqrt(len(time))), float(np.sqrt(len(time))))
    slow = Prior("lognormal", 0.3 * length, max(3.0, 0.3 * length / period))
    rows = [NOISE_TIME.named(of, between)] if model.noise != "white" else []
    rows += [WHITE_RATIO.named(of)] if model.noise == "arma" else []
    return rows + ([DRIFT_RATIO.named(of), DRIFT_TIME.named(of, slow)] if model.drift == "gp" else [])


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
    variance = jnp.sum(pairs * decay, axis=1) / times.count**2
    n, reach = times.time.shape[0], jnp.broadcast_to(reach, times.time.shape)
    gap = jnp.concatenate([jnp.ones(1), jnp.exp(-(times.first[1:] - times.last[:-1]) / correlation_time)])
    ends = jnp.concatenate([jnp.ones(1), jnp.exp(-jnp.diff(times.last) / correlation_time)])
    lower = StrictLowerTriQSM(p=(reach * gap)[:, None], q=reach[:, None], a=ends[:, None, None])
    return SymmQSM(diag=DiagQSM(d=jnp.broadcast_to(variance, (n,))), lower=lower)


# starts: Starting points of a fit of free decays.


#: Latest first turning point after the first sample, in half periods.
LATEST_TURNING_POINT = 0.1
#: Log-normal priors of dry friction and quadratic damping: median relative to k1 x and m1/x, and factor.
FURTHER_MEDIAN, FURTHER_FACTOR = 0.05, 100.0
#: Start of a term that a simpler model lacks, relative to its usual start.
ABSENT = 1e-4


def further_parameters(symbols: Sequence[str], k1: float, m1: float, size: float) -> list[Parameter]:
    """Rows of the forces in ``symbols``, SI, with priors relative to what the rod feels at its largest deflection ``size``.

    A prior far below that would prefer the absence of a force that the record does not exclude, and the c beside it.
    """
    priors = {
        "F_dry": Prior("lognormal", FURTHER_MEDIAN * k1 * size, FURTHER_FACTOR),
        "c_q": Prior("lognormal", FURTHER_MEDIAN * m1 / size, FURTHER_FACTOR),
        "k_cubic": Prior("normal", 0.0, k1 / size**2),
    }
    return [parameter(symbol, prior=priors[symbol]) for symbol in symbols]


def decay_starts(e: "FreeVibration") -> dict[str, Start]:
    """Start of every parameter of the record ``e``, from its paper's estimate or the values of a screening.

    A viscous decay without drift starts at its least-squares fit, whose residuals show the noise at any sampling rate.
    """
    rough, noise = e.rough_decrement(), noise_level(e.values)
    if e.about.screened is not None:
        noise = e.about.screened.noise / float(np.mean(e.relative_sd))
    elif e.closed and e.model.drift == "none":
        fit = viscous_fit(e.time, e.values)
        rough, noise = fit.decrement(e.mass), min(noise, float(np.sqrt(np.sum(fit.left**2) / max(e.n - UNKNOWNS, 1))))
    # A phase error of the start over the decay leads the fit to a side lobe, a local maximum.
    ringing = min(e.time[-1], 4.0 * e.mass / rough.c)
    spread = min(0.3, 1.0 / (rough.Omega_o * ringing))
    noise = max(noise, 1e-4 * float(np.ptp(e.values)))
    starts = {
        "k1": Start(rough.k1, spread),
        "c": Start(rough.c, 0.3),
        e.channel.noise.named(e.label).name: Start(noise, 0.2),
    }
    if not e.closed:
        time, peak = first_turning_point(e)
        size = abs(peak)
        forces = {
            "F_dry": Start(0.02 * rough.k1 * size, 0.3),
            "c_q": Start(0.5 * rough.c / (rough.Omega_o * size), 0.3),
            "k_cubic": Start(0.0, 0.01 * rough.k1 / size**2),
        }
        rough_damping = e.rough_damping(e.model.symbols)
        forces |= {
            name: Start(max(rough_damping.get(name, 0.0), 0.2 * forces[name].centre), 0.2) for name in ("F_dry", "c_q")
        }
        starts |= {symbol: forces[symbol] for symbol in e.model.symbols}
        starts["c"] = Start(max(rough_damping.get("c", rough.c), 0.1 * rough.c), 0.2)
        starts[f"amplitude[{e.label}]"] = Start(size, 0.05)
        starts[f"turning_time[{e.label}]"] = Start(time, 0.05 / rough.Omega_o)
    known = {} if e.about.screened is None else e.about.screened.values
    for row in e.parameters:
        if row.symbol in known:
            value = known[row.symbol]
            near = starts.get(row.name, Start(value, 0.1))
            # An absent term is no starting point of a logarithm.
            floor = 1e-3 * near.centre if row.positive else -np.inf
            starts[row.name] = Start(max(value, floor), 0.3 * near.spread)
    return starts


def nested_starts(e: "FreeVibration") -> list[dict[str, float]]:
    """Values by name, SI, of the fits of simpler models of the record ``e``; an absent term is far below its usual start."""
    if e.about.screened is None:
        return []
    usual = {name: start.centre for name, start in decay_starts(e).items()}
    return [
        {
            row.name: max(values[row.symbol], ABSENT * usual[row.name]) if row.positive else values[row.symbol]
            for row in e.parameters
            if row.symbol in values and row.name in usual
        }
        for values in e.about.screened.nested
    ]


def first_turning_point(e: "FreeVibration") -> tuple[float, float]:
    """Rough time, s, and signed x_rel, m, of the last turning point before the record, or at its first samples."""
    rough = e.rough_decrement()
    half_period = np.pi / rough.Omega_o
    # A velocity peaks a quarter of a period before the turning point.
    first = float(rough.times[0]) + (0.5 * half_period if e.order == 1 else 0.0)
    back = int(np.ceil(first / half_period - LATEST_TURNING_POINT))
    growth = rough.first_ratio**back
    peak = e.channel.deflection(rough.Omega_o) * float(rough.peaks[0])
    return first - back * half_period, peak * (-1.0) ** back * growth


def starts_of_motion(e: "FreeVibration", rough: Decrement) -> dict[str, Start]:
    """Starts of x_rel and its rate at the first sample."""
    size = abs(float(rough.peaks[0]))
    rate = np.polyfit(e.time[:5], e.values[:5], 1)[0]
    return {
        f"x_start[{e.label}]": Start(float(e.values[0] - equilibrium(e.values)), 0.02 * size),
        f"y_start[{e.label}]": Start(float(rate), 0.05 * rough.Omega_o * size),
    }


# sensitivities: Effects of the parameters on the readings of a decay, and of forces that the fitted model lacks.


#: Step of difference quotients, in natural units of each parameter.
SENSITIVITY_STEP = 1e-5
#: Points per period, and fewest points, of the responses to further forces.
RESPONSE_POINTS, FEWEST_POINTS = 60, 200


def whitened(e: "FreeVibration", theta: Mapping[str, float], columns: np.ndarray) -> np.ndarray:
    """Columns (n,) or (n, q) in the coordinates where noise and drift of ``e`` are white."""
    table = np.reshape(columns, (e.n, -1))
    if e.model.whitened:
        table = np.asarray(whiten(e.times, table, e.model, theta))
    else:
        table = table / np.reshape(e.relative_sd, (-1, 1))
    return np.reshape(table, columns.shape)


def sensitivities(
    e: "FreeVibration", theta: Mapping[str, float]
) -> tuple[np.ndarray, np.ndarray, dict[str, np.ndarray]]:
    """Residuals (n,), design of the linear nuisances (n, p), and derivatives of the residuals by symbol, (n,) each."""
    raw, design = e.unwhitened(theta, np)
    nuisances = np.linalg.lstsq(whitened(e, theta, design), whitened(e, theta, raw), rcond=None)[0]
    left, units, moved = raw - design @ nuisances, _units(e, theta), {}
    for name in ("k1", "c", *e.model.symbols, *(() if e.closed else ("amplitude", "turning_time"))):
        other, basis = e.unwhitened({**theta, name: theta[name] + SENSITIVITY_STEP * units[name]}, np)
        moved[name] = (other - basis @ nuisances - left) / (SENSITIVITY_STEP * units[name])
    return left, design, moved


def further_sensitivities(e: "FreeVibration", theta: Mapping[str, float]) -> dict[str, np.ndarray]:
    """Derivatives (n,) of the residuals with respect to the forces that the model of ``e`` lacks, at zero force."""
    if e.closed:
        return {name: -response for name, response in force_responses(e, theta).items()}
    full = e.with_model(replace(e.model, damping=tuple(DAMPING), cubic=True))
    names = e.model.absent
    known = {**theta, **dict.fromkeys(names, 0.0)}
    raw, units = full.unwhitened(known, np)[0], _units(e, theta)
    return {
        name: (full.unwhitened({**known, name: SENSITIVITY_STEP * units[name]}, np)[0] - raw)
        / (SENSITIVITY_STEP * units[name])
        for name in names
    }


def force_responses(e: "FreeVibration", theta: Mapping[str, float]) -> dict[str, np.ndarray]:
    """Responses (n,) of the readings of a viscous decay to F_dry, c_q and k_cubic of unit size, SI, by symbol.

    They are linear, for small forces, and start at rest: the nuisances of the decay contain any other start.
    """
    raw, design = e.unwhitened(theta, np)
    parts = np.linalg.lstsq(whitened(e, theta, design), whitened(e, theta, raw), rcond=None)[0]
    m1, k1, c = theta["m1"], theta["k1"], theta["c"]
    time = e.time * stretch(e.clock_rate, theta)
    length = float(time[-1])
    points = max(FEWEST_POINTS, int(RESPONSE_POINTS * length * np.sqrt(k1 / m1) / (2.0 * np.pi)))
    grid = np.linspace(0.0, length, points)
    x, rate = viscous_state(grid, theta, parts, e.order)
    system = ([1.0 / m1], [1.0, c / m1, k1 / m1])
    found = {}
    for name, force in zip(FURTHER, (np.sign(rate), rate * np.abs(rate), x**3), strict=True):
        response = -lsim(system, force, grid)[1]
        for _ in range(e.order):
            response = np.gradient(response, grid[1])
        found[name] = np.interp(time, grid, response)
    return found


def _units(e: "FreeVibration", theta: Mapping[str, float]) -> dict[str, float]:
    """Natural units of the parameters of a decay, SI."""
    size, k1, m1 = e.largest_deflection, theta["k1"], theta["m1"]
    units = {"k1": k1, "c": theta["c"], "F_dry": k1 * size, "c_q": m1 / size, "k_cubic": k1 / size**2}
    return units | {"amplitude": size, "turning_time": float(np.sqrt(m1 / k1))}


# zero: A zero of the sensor that jumps where the rod turns, as of an encoder that loses counts or of a loose sensor.


#: Half swings that are looked at, from the release on, and fewest of them.
MOST_HALF_SWINGS, FEWEST_HALF_SWINGS = 60, 8
#: Most and fewest readings, or means of readings, per half swing, and fewest of all, without those near turning points.
MOST_READINGS, FEWEST_READINGS, FEWEST_OF_ALL = 64, 6, 200
#: Readings nearer to a turning point than this part of a half swing are left out: a zero may jump a little later.
NEAR = 0.1
#: A rod moves where it is faster than this part of its largest speed.
MOVING = 1e-6


class Jumps(NamedTuple):
    """Zeros of half swings.

    Attributes
    ----------
    size : rms change of the zero from one half swing to the next, SI, without what alternates
    ratio : sum of squares of the residuals that zeros of half swings leave, relative to that of a zero that moves in straight
        lines from the middle of each half swing to that of the next. Both have the same number of parameters
    half_swings : number of zeros
    """

    size: float
    ratio: float
    half_swings: int


def zero_jumps(e: "FreeVibration", theta: ValuesBySymbol) -> Jumps | None:
    """Zeros of the half swings of a record; None for too few readings, and where the readings are no displacement.

    Three things are projected out of both descriptions: what the fitted parameters can take up, a zero for each direction
    of the motion (as of dry friction or hysteresis), and one in proportion to the amplitude.
    """
    time, values = e.whole
    half = np.pi / e.rough_decrement().Omega_o
    end = MOST_HALF_SWINGS * half
    if e.order > 0 or np.count_nonzero(time <= end) < FEWEST_OF_ALL:
        return None
    begin = float(decay_window(e.table)[0][0])
    settings = replace(e.table.settings, start=begin, stop=begin + float(min(end, time[-1])))
    thin = block_size(time[time <= end], values[time <= end], 2.0 * MOST_READINGS)
    model = replace(e.model, thin=thin, noise="white", drift="none")
    part = type(e)(replace(e.table, settings=settings), e.rig, e.friction, model)
    left, design, moved = sensitivities(part, theta)
    curve = part.values - left
    rate = np.gradient(curve, part.time)
    # A rod that has stopped turns no more; the sign of its rate is that of rounding errors.
    moving = np.arange(len(rate)) <= np.flatnonzero(np.abs(rate) >= MOVING * np.max(np.abs(rate)))[-1]
    turns = np.flatnonzero(np.diff(rate[moving] > 0.0))
    turned = 0.5 * (part.time[turns] + part.time[turns + 1])
    if len(turns) < FEWEST_HALF_SWINGS - 1:
        return None
    kept = moving & (np.min(np.abs(part.time[:, None] - turned), axis=1) > NEAR * half)
    number = np.unique(np.searchsorted(turned, part.time[kept]), return_inverse=True)[1]
    count = np.bincount(number)
    if len(count) < FEWEST_HALF_SWINGS or np.median(count) < FEWEST_READINGS or len(number) < FEWEST_OF_ALL:
        return None
    middle = np.bincount(number, weights=part.time[kept]) / count
    own = np.eye(len(count))
    lines = np.stack([np.interp(part.time[kept], middle, zero) for zero in own], axis=1)
    ahead = np.where(rate > 0.0, 1.0, -1.0)
    amplitude = np.interp(part.time, turned[:-1], 0.5 * np.abs(np.diff(curve[turns])))
    known = np.column_stack([design, ahead, ahead * amplitude, *moved.values()])[kept]
    jumping, zeros = _least_squares(known, own[number], left[kept])
    # What a zero for each direction could take up is shared between both at will: it is left out of the jumps.
    shared = np.stack([np.bincount(number, weights=x[kept]) / count for x in (ahead, ahead * amplitude)], axis=1)
    zeros = zeros - shared @ np.linalg.lstsq(shared, zeros)[0]
    moving_slowly, _ = _least_squares(known, lines, left[kept])
    ratio = jumping / moving_slowly if moving_slowly > 0.0 else 1.0
    return Jumps(float(np.sqrt(np.mean(np.diff(zeros) ** 2))), ratio, len(count))


def _least_squares(known: np.ndarray, columns: np.ndarray, values: np.ndarray) -> tuple[float, np.ndarray]:
    """Sum of squares that ``known`` (n, p) and ``columns`` (n, q) leave of ``values``, and the coefficients (q,)."""
    size = np.linalg.norm(known, axis=0)
    table = np.hstack([known[:, size > 0.0] / size[size > 0.0], columns])
    found = np.linalg.lstsq(table, values)[0]
    return float(np.sum((values - table @ found) ** 2)), found[-columns.shape[1] :]


# hidden terms: Forces that the fitted model lacks, that the records cannot exclude, and that would change the quoted
# values.
#
# A short record of a decay fits viscous damping as well as its sum with dry friction, and the two give different
# values of c. The fit is linear in a small further force, so one least-squares step gives the largest force that
# the records allow, and the values beside it.


#: Probability that a further force is below its limit.
LIMIT = 0.975
#: Changes of c and of k1 by a force at its limit that matter: relative to the value, and in standard errors.
CHANGES: Mapping[str, float] = {"c": 0.2, "k1": 0.05}
CHANGE_IN_ERRORS = 3.0
#: Responses to a force that are shorter than this beside the nuisances, relative to their length, are rounding.
UNSEEN = 1e-6
#: Estimates further below zero, in standard errors, count as this one.
LOWEST = -30.0


@dataclass(frozen=True)
class Hidden:
    """A further force, and its effect on the parameters of the model without it.

    Attributes
    ----------
    estimate, sd : of its parameter, SI; the estimate of a force that damps may be negative
    slopes : change of each parameter by unit of it, SI
    errors : standard errors of the parameters without it, SI
    """

    estimate: float
    sd: float
    slopes: Mapping[str, float]
    errors: Mapping[str, float]

    def limits(self, signed: bool) -> tuple[float, float]:
        """Smallest and largest value, SI, at the level ``LIMIT``; of one that is not ``signed`` the smallest is 0."""
        if signed:
            width = self.sd * float(stats.norm.isf(1.0 - LIMIT))
            return self.estimate - width, self.estimate + width
        # Far below zero the posterior above zero is exponential: its limit goes to 0.
        ratio = max(self.estimate / self.sd, LOWEST)
        beyond = (1.0 - LIMIT) * float(stats.norm.cdf(ratio))
        return 0.0, self.sd * (ratio + float(stats.norm.isf(beyond)))


class Decay(Protocol):
    """A record or the turning points of a decay."""

    model: DecayModel

    @property
    def label(self) -> str: ...

    @property
    def table(self) -> Table[DecaySettings]: ...

    def local(self, values: Mapping[str, float]) -> dict[str, float]:
        """Select values by symbol from values by name."""
        ...

    def reduced(self, theta: Mapping[str, float]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Derivatives (n, p) and (n, q), and residuals (n,), in units of the noise, without own nuisances.

        Derivatives with respect to k1, c and ``model.symbols``, and to the forces that the model lacks.
        """
        ...


def check_hidden_terms(records: Sequence[Decay], fit: Fitted) -> list[Finding]:
    """Check that viscous records exclude further forces that would change c or k1 by much, where the settings allow them."""
    groups: dict[Any, list[Decay]] = {}
    for e in records:
        # A record that demands a further damping seldom excludes another one as well.
        if not e.model.damping and (symbols := open_forces(e)):
            groups.setdefault((symbols, e.model.cubic, e.table.settings.offers_cubic), []).append(e)
    findings, compared = [], []
    for (offered, _, offers_cubic), members in groups.items():
        terms = hidden_terms(members, fit.values)
        offered = tuple(symbol for symbol in offered if symbol in terms)
        theta = members[0].local(fit.values)
        # No record of a decay that does not swing excludes these forces, so the stated model is believed.
        swings = theta["c"] < 2.0 * STRONGEST * np.sqrt(theta["k1"] * theta["m1"])
        facts = {"labels": [e.label for e in members], "offers_cubic": offers_cubic, "swings": swings}
        compared += facts["labels"]
        findings += [
            Finding("decays.hidden", "fail", {**facts, **changed}, parameters=(name,))
            if swings
            else Finding("decays.hidden", "warn", {**facts, **changed})
            for name in CHANGES
            if (changed := _change(name, fit.values[name], {symbol: terms[symbol] for symbol in offered}))
        ]
    if compared and not findings:
        findings.append(Finding("decays.hidden", "ok", {"labels": ", ".join(compared)}))
    return findings


def open_forces(e: Decay) -> tuple[str, ...]:
    """Symbols of the forces that the model of ``e`` lacks and whose words the settings leave open."""
    settings = e.table.settings
    return tuple(
        symbol for symbol in e.model.absent if (settings.stiffness if symbol == "k_cubic" else settings.damping) is None
    )


def _change(name: str, value: float, terms: Mapping[str, Hidden]) -> Facts:
    """Forces that change the parameter ``name`` by too much, and its limits beside them, SI; empty without one."""
    ends, symbols, largest = [value], [], []
    for symbol, term in terms.items():
        changes = [term.slopes[name] * end for end in term.limits(symbol == "k_cubic")]
        error = term.errors[name]
        if max(np.abs(changes)) > max(CHANGES[name] * value, CHANGE_IN_ERRORS * error):
            ends += [value + change + side * 1.96 * error for change in changes for side in (-1.0, 1.0)]
            symbols.append(symbol)
            largest.append(max(np.abs(term.limits(symbol == "k_cubic"))))
    if not symbols:
        return {}
    facts = {"name": name, "unit": parameter(name).unit, "value": value, "low": max(0.0, min(ends)), "high": max(ends)}
    return {**facts, "symbols": symbols, "largest": largest}


def hidden_terms(records: Sequence[Decay], values: Mapping[str, float]) -> dict[str, Hidden]:
    """Every force that the common model of ``records`` lacks, by symbol; ``values`` of the fit, SI."""
    blocks = [e.reduced(e.local(values)) for e in records]
    known, further, left = (np.concatenate(part) for part in zip(*blocks, strict=True))
    model = records[0].model
    names = ("k1", "c", *model.symbols)
    size = np.linalg.norm(known, axis=0)
    size = np.where(size > 0.0, size, 1.0)
    inverse = np.linalg.pinv(known / size) / size[:, None]
    errors = dict(zip(names, np.linalg.norm(inverse, axis=1), strict=True))
    found = {}
    for symbol, column in zip(model.absent, further.T, strict=True):
        change = inverse @ column
        own = column - known @ change
        if not column.any():
            continue
        power = max(float(own @ own), np.finfo(float).tiny)
        slopes = dict(zip(names, -change, strict=True))
        found[symbol] = Hidden(-float(own @ left) / power, power**-0.5, slopes, errors)
    return found


def reduced_record(e: "FreeVibration", theta: Mapping[str, float]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """``Decay.reduced`` of a record."""
    left, design, moved = sensitivities(e, theta)
    further = further_sensitivities(e, theta)
    shared = np.column_stack([moved.pop(name) for name in ("k1", "c", *e.model.symbols)])
    own = whitened(e, theta, np.column_stack([design, *moved.values()]))
    own = np.linalg.qr(own / np.linalg.norm(own, axis=0))[0]
    parts = [
        whitened(e, theta, part)
        for part in (shared, np.column_stack([further[s] for s in e.model.absent]), left[:, None])
    ]
    known, others, residuals = (part - own @ (own.T @ part) for part in parts)
    # The offset takes up dry friction in a decay that does not swing: only rounding is left of it.
    others[:, np.linalg.norm(others, axis=0) <= UNSEEN * np.linalg.norm(parts[1], axis=0)] = 0.0
    misfit = residuals - known @ np.linalg.lstsq(known, residuals, rcond=None)[0]
    noise = np.sqrt(np.sum(misfit**2) / max(e.n - own.shape[1] - known.shape[1], 1))
    return known / noise, others / noise, residuals[:, 0] / noise


# fits: Maximum-likelihood fits of single decays, with the noise level in closed form, for the ranking of models.


#: Largest number of evaluations in a fit, and relative step of its difference quotients.
EVALUATIONS, STEP = 40, 1e-5
#: Distance of starts from the bounds, and of the start of a term that a nested model lacks.
INSIDE, ABSENT_TERM = 1e-3, 1e-9
#: Replaces the effect of an unknown that the record does not depend on.
UNKNOWN = 1e-12
#: Replaces residuals, relative to the scatter of the readings, where the model has no motion.
UNFIT = 1e3
#: Starts of a fit with dry friction: rounds of one batch each, standard deviations of their scaled unknowns (F_dry:
#: logarithm) after the first round, and number of starts that are fitted.
DRY_ROUNDS, DRY_FITS = 8, 3
DRY_SPREADS: Mapping[str, float] = {"F_dry": 0.15, "c": 0.3, "k1": 0.01, "amplitude": 0.04}
#: White over correlated noise that stands for white noise.
WHITE = 1e3
#: Unknowns of a fit, and bounds of their scaled values. Masses, forces and times are logarithms, or fractions of the
#: linear spring's force at the first turning point.
BOUNDS: Mapping[str, tuple[float, float]] = {
    "k1": (-0.3, 0.3),
    "c": (-8.0, 3.0),
    "F_dry": (0.0, 1.0),
    "c_q": (0.0, 20.0),
    "k_cubic": (-1.0, 3.0),
    "amplitude": (-1.0, 1.0),
    "turning_time": (-1.5, 1.5),
    "noise_time": (-7.0, 7.0),
    "white_ratio": (-5.0, 5.0),
    "drift_ratio": (-5.0, 9.0),
    "drift_time": (0.0, 5.0),
}
NAMES = tuple(BOUNDS)


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


def free_symbols(model: DecayModel) -> list[str]:
    """Unknowns of ``model`` among ``NAMES``."""
    absent = {"F_dry", "c_q", "k_cubic"} - set(model.symbols)
    absent |= {"white_ratio"} if model.noise != "arma" else set()
    absent |= {"noise_time"} if model.noise == "white" else set()
    absent |= {"drift_ratio", "drift_time"} if model.drift != "gp" else set()
    return [name for name in NAMES if name not in absent]


# Three programs compile faster than one, and the first serves records of every length.
@partial(jax.jit, static_argnames="number")
def _paths(thetas: Mapping[str, Any], number: int) -> HalfCycles:
    """Half cycles of a batch of parameters."""
    forces = {name: thetas[name] for name in ("k1", "c", "m1", "F_dry", "c_q", "k_cubic")}
    return jax.vmap(partial(half_cycles, number=number))(forces, thetas["amplitude"], thetas["turning_time"])


@partial(jax.jit, static_argnames="order")
def _readings(paths: HalfCycles, nodes: Any, weights: Any, order: int) -> Any:
    """(batch, n) block means of x_rel or of its derivative of this order, SI."""
    return jax.vmap(lambda path: block_mean(interpolate(path, nodes.ravel())[order], weights, jnp))(paths)


@jax.jit
def _whitened(times: ReadingTimes, raw: Any, thetas: Mapping[str, Any], sloped: Any) -> Any:
    """(batch, n) whitened residuals at the best offset and, where ``sloped`` is 1, the best slope."""
    time = times.time
    slope = sloped * (time - jnp.mean(time)) / (time[-1] - time[0])

    def one(raw: Any, shape: Mapping[str, Any]) -> Any:
        white = whiten_by_shape(times, jnp.stack([raw, jnp.ones_like(raw), slope], axis=1), "arma", shape)
        own, design = white[:, 0], white[:, 1:]
        normal, moment = design.T @ design, design.T @ own
        a, b, d = normal[0, 0], normal[0, 1], normal[1, 1] + 1e-9
        offset = jnp.stack([d * moment[0] - b * moment[1], a * moment[1] - b * moment[0]]) / (a * d - b**2)
        return own - design @ offset

    return jax.vmap(one)(
        raw, {name: thetas[name] for name in ("noise_time", "white_ratio", "drift_ratio", "drift_time")}
    )


class Screening:
    """Maximum-likelihood fits of one record, by means of ``thin`` samples (default: as the record).

    ``k1`` is what the bounds of k1 lie about (default: a rough estimate, which few swings with dry friction mislead).
    """

    def __init__(self, record: "FreeVibration", thin: int | None = None, k1: float | None = None) -> None:
        rough = record.rough_decrement()
        self.turning_time, peak = first_turning_point(record)
        self.side, self.size = float(np.sign(peak)), abs(peak)
        self.m1, self.k1, self.c, self.omega = record.mass, k1 or rough.k1, rough.c, rough.Omega_o
        period, length = 2.0 * np.pi / self.omega, float(record.time[-1])
        self.order = record.order
        blocks = block_means(*record.whole, thin or record.model.thin, by_sample=record.order > 0)
        self.values, self.nodes, self.weights = blocks.values, blocks.nodes, blocks.weights
        self.times = ReadingTimes.of(blocks)
        # The margin allows for a frequency 1.25 times the rough estimate.
        self.number = int(2.5 * length / period) + 5
        self.noise_time, self.drift_time = 0.1 * period, period
        self.rough_damping, self.mean_peak = (
            record.rough_damping,
            record.deflection * float(np.mean(np.abs(rough.peaks))),
        )

    def theta(self, z: np.ndarray) -> dict[str, Any]:
        """Values by symbol, SI, of scaled unknowns (..., names)."""
        own = dict(zip(NAMES, np.moveaxis(z, -1, 0), strict=True))
        k1 = self.k1 * np.exp(own["k1"])
        # A drift counts in units of the noise, which is white where the ratio is beyond its bounds.
        unit = np.where(own["white_ratio"] > BOUNDS["white_ratio"][1], WHITE, 1.0)
        return {
            "m1": np.broadcast_to(self.m1, k1.shape),
            "k1": k1,
            "c": self.c * np.exp(own["c"]),
            "F_dry": self.k1 * self.size * own["F_dry"],
            "c_q": self.m1 / self.size * own["c_q"],
            "k_cubic": self.k1 / self.size**2 * own["k_cubic"],
            "amplitude": self.size * np.exp(own["amplitude"]),
            "turning_time": self.turning_time + own["turning_time"] / self.omega,
            "noise_time": self.noise_time * np.exp(own["noise_time"]),
            "white_ratio": np.where(own["white_ratio"] < BOUNDS["white_ratio"][0], 0.0, np.exp(own["white_ratio"])),
            "drift_ratio": np.where(
                own["drift_ratio"] < BOUNDS["drift_ratio"][0], 0.0, unit * np.exp(own["drift_ratio"])
            ),
            "drift_time": self.drift_time * np.exp(own["drift_time"]),
        }

    def scaled(self, values: Mapping[str, float]) -> np.ndarray:
        """(names,) scaled unknowns at values by symbol, SI, of another fit; amplitude and time of this record's own."""
        z = np.zeros(len(NAMES))
        units = {"F_dry": self.k1 * self.size, "c_q": self.m1 / self.size, "k_cubic": self.k1 / self.size**2}
        logarithms = {"k1": self.k1, "c": self.c, "noise_time": self.noise_time, "drift_time": self.drift_time}
        for name, unit in units.items():
            z[NAMES.index(name)] = values.get(name, 0.0) / unit
        for name, unit in {**logarithms, "white_ratio": 1.0, "drift_ratio": 1.0}.items():
            if values.get(name, 0.0) > 0.0:
                z[NAMES.index(name)] = np.log(values[name] / unit)
        return z

    def start(self, model: DecayModel, near: np.ndarray | None, absent: bool = False) -> np.ndarray:
        """(names,) scaled starting values; terms that the model lacks are switched off, ``absent`` those ``near`` lacks too."""
        z = self.scaled(self.rough_damping(model.symbols)) if near is None else near.copy()
        free = free_symbols(model)
        for name, value in (("F_dry", 0.02), ("c_q", 0.05), ("k_cubic", 0.0), ("drift_time", 1.0)):
            i = NAMES.index(name)
            z[i] = (z[i] or value * (not absent)) if name in free else 0.0
        off = -1e3
        white = near is None or near[NAMES.index("white_ratio")] > BOUNDS["white_ratio"][1]
        if absent and white:
            z[NAMES.index("noise_time")] = BOUNDS["noise_time"][0]
        for name, value, unused in (
            ("white_ratio", 0.0, off if model.noise == "ar1" else np.log(WHITE)),
            ("drift_ratio", np.log(3.0), off),
        ):
            i = NAMES.index(name)
            known = near is not None and BOUNDS[name][0] < z[i] < BOUNDS[name][1]
            z[i] = (z[i] if known else BOUNDS[name][0] if absent else value) if name in free else unused
        return z

    def dry_starts(self, start: np.ndarray) -> np.ndarray:
        """(starts, names) starts of different dry friction, where the peaks lose about as much in all of them.

        The rod sticks after a whole number of half cycles, so the likelihood of dry friction has many maxima.
        """
        i, j = NAMES.index("F_dry"), NAMES.index("c")
        found = self.theta(start)
        known = "F_dry" in self.rough_damping(("F_dry",))
        grid = found["F_dry"] * np.geomspace(0.5, 2.0, len(NAMES) + 1)
        if not known:
            grid = self.k1 * self.size * np.geomspace(0.003, 0.45, len(NAMES) + 1)
        lost = (found["F_dry"] if known else 0.0) - grid
        c = np.maximum(found["c"] + lost * 4.0 / (np.pi * self.omega * self.mean_peak), 0.02 * self.c)
        starts = np.tile(start, (len(grid), 1))
        starts[:, i], starts[:, j] = grid / (self.k1 * self.size), np.log(c / self.c)
        moved = np.repeat(starts[None], DRY_ROUNDS, axis=0)
        rng = np.random.default_rng(0)
        for name, spread in DRY_SPREADS.items():
            z = spread * rng.standard_normal(moved.shape[:2])
            place = NAMES.index(name)
            moved[1:, :, place] = (
                (moved[1:, :, place] * np.exp(z[1:])) if name == "F_dry" else moved[1:, :, place] + z[1:]
            )
        return moved.reshape(-1, len(NAMES))

    def fit(
        self,
        model: DecayModel,
        near: np.ndarray | None = None,
        nested: Sequence[tuple[Screened, np.ndarray]] = (),
    ) -> tuple[Screened, np.ndarray]:
        """Fit ``model`` from the scaled values ``near`` and from the best of ``nested``, fits of models that it contains.

        Return also the scaled values found. Where the model has no motion at ``near``, as beyond critical damping, the fit
        starts from rough estimates.
        """
        start, free = self.start(model, near), [NAMES.index(name) for name in free_symbols(model)]
        sloped = float(model.drift == "linear")

        jacobians: dict[bytes, np.ndarray] = {}
        unit = float(np.std(self.values))

        def whitened(whole: np.ndarray) -> np.ndarray:
            """(names + 1, n) residuals at as many scaled unknowns."""
            thetas, motion = self.motions(whole)
            return np.asarray(_whitened(self.times, self.values - motion, thetas, sloped)) / unit

        def residuals(z: np.ndarray) -> np.ndarray:
            """(n,) residuals at (free,); one batch of fixed size also gives the Jacobian, which is kept for its turn."""
            stop_if_interrupted()
            sign = np.where(z > high - 2.0 * STEP, -1.0, 1.0)
            whole = np.tile(start, (len(NAMES) + 1, 1))
            whole[: len(free) + 1, free] = np.concatenate([z[None], z + STEP * np.diag(sign)])
            points = whitened(whole)[: len(free) + 1]
            points = np.where(np.isfinite(points), points, UNFIT)
            jacobians[z.tobytes()] = (points[1:] - points[:1]).T / (STEP * sign)
            return points[0]

        low, high = np.array([BOUNDS[NAMES[i]] for i in free]).T
        inside = low + INSIDE, high - INSIDE
        if near is not None and (residuals(np.clip(start[free], *inside)) == UNFIT).any():
            return self.fit(model, None, nested)
        starts = start[None]
        if near is None and "dry" in model.damping:
            starts = self.dry_starts(start)
            parts = starts.reshape(-1, len(NAMES) + 1, len(NAMES))
            costs = np.concatenate([np.sum(whitened(part) ** 2, axis=1) for part in parts])
            starts = starts[np.argsort(np.where(np.isfinite(costs), costs, np.inf))[:DRY_FITS]]
        first = list(np.clip(starts[:, free], *inside))
        if nested:
            best = min(nested, key=lambda one: one[0].noise)[1]
            first.append(np.clip(self.start(model, best, absent=True)[free], low + ABSENT_TERM, high - ABSENT_TERM))
        options: Any = {"jac": lambda z: jacobians[z.tobytes()], "bounds": (low, high), "x_scale": "jac"}
        ends = [least_squares(residuals, one, max_nfev=EVALUATIONS, **options) for one in first]
        found = min(ends, key=lambda end: end.cost)
        start[free] = found.x
        return self._summary(model, start, found, unit, tuple(one.values for one, _ in nested)), start

    def motions(self, whole: np.ndarray) -> tuple[dict[str, Any], np.ndarray]:
        """Values by symbol and predicted readings (names + 1, n), SI, at as many scaled unknowns."""
        thetas = {name: jnp.asarray(value) for name, value in self.theta(whole).items()}
        readings = _readings(_paths(thetas, self.number), self.nodes, self.weights, self.order)
        return thetas, self.side * np.asarray(readings)

    def drowned(self, z: np.ndarray) -> bool:
        """Whether drift and noise at scaled unknowns (names,) are larger than the motion."""
        motion = self.motions(np.tile(z, (len(NAMES) + 1, 1)))[1][0]
        return not np.std(self.values - motion) <= np.std(motion)

    def drift(self, z: np.ndarray) -> float:
        """Range of the mean over one period of measured minus predicted readings, SI, at scaled unknowns (names,)."""
        raw = self.values - self.motions(np.tile(z, (len(NAMES) + 1, 1)))[1][0]
        time = self.times.time
        window = 2.0 * np.pi / self.omega
        first, last = np.searchsorted(time, time - 0.5 * window), np.searchsorted(time, time + 0.5 * window)
        total = np.concatenate([[0.0], np.cumsum(raw)])
        means = (total[last] - total[first]) / (last - first)
        whole = means[(time > 0.5 * window) & (time < time[-1] - 0.5 * window)]
        return float(np.ptp(whole)) if len(whole) else 0.0

    def _summary(
        self,
        model: DecayModel,
        z: np.ndarray,
        found: OptimizeResult,
        unit: float,
        nested: tuple[Mapping[str, float], ...],
    ) -> Screened:
        """Estimates at the end ``found`` of a fit, at the scaled unknowns ``z`` (names,); ``unit`` of its residuals."""
        free = free_symbols(model)
        n, unknowns = len(self.values), len(free) + 2 + int(model.drift == "linear")
        deviance = n * (np.log(2.0 * found.cost * unit**2 / n) + 1.0 + LOG_2PI)
        values = {name: float(value) for name, value in self.theta(z).items()}
        norms = np.linalg.norm(found.jac, axis=0)
        norms = np.where(norms > 0.0, norms, UNKNOWN)
        scaled = found.jac / norms
        variances = np.maximum(np.diag(np.linalg.pinv(scaled.T @ scaled, hermitian=True)), UNKNOWN) / norms**2
        sd = np.sqrt(variances * 2.0 * found.cost / max(n - unknowns, 1))
        moved = {name: self.theta(z + STEP * np.eye(len(NAMES))[NAMES.index(name)]) for name in free}
        errors = {
            name: float(abs(moved[name][name] - values[name]) / STEP * own) for name, own in zip(moved, sd, strict=True)
        }
        if model.noise == "white":
            for each in (values, errors):
                if "drift_ratio" in each:
                    each["drift_ratio"] /= WHITE
        noise = float(np.sqrt(2.0 * found.cost / n)) * unit
        return Screened(float(deviance + unknowns * np.log(n)), values, errors, noise, found.fun, nested)


# screening: Choice of the model of free decays where the record contradicts the stated one.
#
# A record demands another model where its residuals are not white, or where they correlate with the response to dry
# friction, quadratic damping, a cubic spring or a drift. Every sum of the terms that the settings leave open is
# then fitted to the record by maximum likelihood and ranked by BIC.


#: Records are thinned to this many readings per period before their models are ranked.
READINGS_PER_PERIOD = 16
#: Fewest readings per period of a thinned record.
FEWEST_PER_PERIOD = 8
#: Largest number of samples of a record that is no free decay.
LONGEST_UNCUT = 1000
#: Of forces whose BIC differs by less, the fewest are chosen: with seven alternatives, noise alone often gains this much.
BIC_MARGIN = 4.0
#: Shorter records, in samples, keep their model.
SHORTEST = 40
#: Residuals with a larger p-value of the Ljung–Box test count as white here; the check after the fit is more lenient.
WHITENESS = 0.01


def open_models(record: "FreeVibration") -> tuple[list[DecayModel], list[DecayModel]]:
    """Return the sums of forces that the settings leave open, and the pairs of drift and noise."""
    settings, stated = record.table.settings, record.model
    damping = [
        tuple(word for word, on in zip(DAMPING, switches, strict=True) if on)
        for switches in itertools.product((False, True), repeat=len(DAMPING))
    ]
    forces = [
        replace(stated, damping=words, cubic=cubic)
        for words in (damping if settings.damping is None else [stated.damping])
        for cubic in ((False, True) if settings.stiffness is None and settings.offers_cubic else (stated.cubic,))
    ]
    others = [
        replace(stated, drift=drift, noise=noise)
        for noise in (("white", "ar1", "arma") if settings.noise is None else (stated.noise,))
        for drift in (("none", "linear", "gp") if settings.drift is None else (stated.drift,))
    ]
    return forces, others


def demands_another(record: "FreeVibration", level: float) -> bool:
    """Whether ``record`` contradicts its model at this false-alarm rate: residuals, or responses to further forces.

    A decay beyond ``STRONGEST`` damping keeps its model, because no other one is offered.
    """
    rough = record.rough_decrement()
    if rough.c > 2.0 * STRONGEST * np.sqrt(rough.k1 * record.mass):
        return False
    if not record.closed or record.model.whitened:
        return ljung_box(Screening(record).fit(record.model)[0].residuals)[1] < level
    rough = viscous_fit(record.time, record.values).decrement(record.mass)
    noise = max(noise_level(record.values), 1e-6 * float(np.ptp(record.values)))
    theta = {"m1": record.mass, "k1": rough.k1, "c": rough.c, record.scatters[0]: noise}
    theta |= {symbol: value for symbol, (value, _) in refit(record, theta, []).items()}
    residuals = np.asarray(record.residuals(theta, np))[: record.n]
    return ljung_box(residuals)[1] < level or response_p(record, theta) < level


def response_p(record: "FreeVibration", theta: Mapping[str, float]) -> float:
    """p-value of the F test for the responses of the rod to further forces and for a drift, at a viscous fit."""
    raw, design = record.unwhitened(theta, np)
    parts = np.linalg.lstsq(design, raw, rcond=None)[0]
    columns = force_responses(record, theta).values()
    relative = record.time / record.time[-1] - 0.5
    extra = np.column_stack([*columns, relative, relative**2])
    moved = [record.unwhitened({**theta, name: 1.001 * theta[name]}, np)[1] @ parts for name in ("k1", "c")]
    known = np.column_stack([design, *(column - design @ parts for column in moved)])
    both = np.concatenate([known, extra], axis=1)
    freedom = record.n - both.shape[1]
    if freedom < 1:
        return 1.0
    own, further = (
        # A column of zeros is no effect: quadratic damping of a record that stays where it is.
        float(np.sum((raw - a @ np.linalg.lstsq(a, raw, rcond=None)[0]) ** 2))
        for a in (x / np.maximum(np.linalg.norm(x, axis=0), np.finfo(float).tiny) for x in (known, both))
    )
    return float(stats.f.sf((own - further) / extra.shape[1] * freedom / further, extra.shape[1], freedom))


def thinning(record: "FreeVibration", per_period: float) -> int:
    """Return the block size that leaves about ``per_period`` readings; no less than that of the record."""
    return max(record.model.thin, block_size(*record.whole, per_period))


@dataclass(frozen=True)
class Ranking:
    """The best of some models for some records together: total BIC, and fit and scaled values of each record."""

    model: DecayModel
    bic: float
    fits: tuple[tuple[Screened, np.ndarray], ...]

    @property
    def white(self) -> bool:
        """Whether the residuals of all records are white."""
        return all(ljung_box(one.residuals)[1] * len(self.fits) > WHITENESS for one, _ in self.fits)


def rank(screenings: Sequence[Screening], models: Iterable[DecayModel], near: Ranking | None = None) -> list[Ranking]:
    """Fit every model to all records, from the values of ``near`` and from the best nested model; lowest BIC first.

    So no model has a lower likelihood than one that it contains.
    """
    starts = [None] * len(screenings) if near is None else [z for _, z in near.fits]
    done: list[Ranking] = []

    def fitted(model: DecayModel) -> Ranking:
        nested = [one for one in done if one.model.nested_in(model)]
        fits = tuple(
            screening.fit(model, start, [one.fits[i] for one in nested])
            for i, (screening, start) in enumerate(zip(screenings, starts, strict=True))
        )
        # A drift larger than the motion would take the motion itself for a drift, and an alias for the motion.
        drowned = model.drift != "none" and any(
            screening.drowned(z) for screening, (_, z) in zip(screenings, fits, strict=True)
        )
        return Ranking(model, np.inf if drowned else sum(screened.bic for screened, _ in fits), fits)

    # The first model compiles the programs that all threads then call.
    for _, same_size in itertools.groupby(sorted(models, key=lambda one: one.size), lambda one: one.size):
        first, *level = same_size
        done += [*([] if done else [fitted(first)]), *pool().map(fitted, [first, *level] if done else level)]
    return sorted(done, key=lambda one: one.bic)


def simplest(ranked: Sequence[Ranking]) -> Ranking:
    """Return the model with the fewest forces whose BIC is within ``BIC_MARGIN`` of the best one, the first."""
    near = [one for one in ranked if one.bic <= ranked[0].bic + BIC_MARGIN]
    return min(near, key=lambda one: len(one.model.symbols))


def demanded_model(records: Sequence["FreeVibration"]) -> Ranking:
    """Return the model with the lowest BIC of all ``records`` together, thinned until its residuals are white.

    The forces are chosen first on thinned records, with the richest noise that the settings leave open, then drift and
    noise. The fits of fewer forces become starts of the quoted fit.
    """
    forces, others = open_models(records[0])
    coarse = thinning(records[0], READINGS_PER_PERIOD)
    thinned = [Screening(record, coarse) for record in records]
    by_forces = rank(thinned, [replace(model, noise=others[-1].noise) for model in forces])
    best = simplest(by_forces)
    others = [replace(model, damping=best.model.damping, cubic=best.model.cubic) for model in others]
    chosen = _with_noise(records, rank(thinned, others, best), others, coarse)
    simpler = [one.fits for one in by_forces if set(one.model.symbols) < set(chosen.model.symbols)]
    fits = [
        (replace(screened, nested=(*screened.nested, *(each[i][0].values for each in simpler))), z)
        for i, (screened, z) in enumerate(chosen.fits)
    ]
    return replace(chosen, fits=tuple(fits))


def _with_noise(
    records: Sequence["FreeVibration"], ranked: list[Ranking], others: Sequence[DecayModel], coarse: int
) -> Ranking:
    """Choose drift and noise, from the ranking of all of them on records thinned by ``coarse``.

    At high sampling rates no offered noise may be white. Fewer samples then lose little, because they are correlated.
    """
    best = ranked[0]
    if records[0].table.settings.thin is not None:
        return best
    fewest = max(coarse, thinning(records[0], FEWEST_PER_PERIOD))
    # More samples of the same record show the same misfit with more certainty.
    offered = any(one.white for one in ranked)
    thin = records[0].model.thin if offered else fewest
    while thin <= fewest:
        screenings = [Screening(record, thin) for record in records]
        rich = rank(screenings, [replace(best.model, noise=others[-1].noise)], best)[0]
        if rich.white:
            ranked = rank(screenings, others, rich)
            return next((replace(one, model=replace(one.model, thin=thin)) for one in ranked if one.white), rich)
        thin *= 2
    return replace(best, model=replace(best.model, thin=coarse))


def second_models(
    records: Sequence["FreeVibration"], readings: Sequence[Finding] = ()
) -> tuple[list["FreeVibration"], list[Finding]]:
    """Return ``records`` under the model that they demand, and findings that name it.

    Records with more than a free decay according to ``readings``, the findings on the readings, keep their model. Their
    fit fails in any case, so long ones are thinned.
    """
    level = LEVEL / len(records)
    chosen, findings = list(records), list[Finding]()
    groups: dict[Any, list[int]] = {}
    no_decay = {f.experiment for f in readings if f.level == "fail" and f.code in ("decays.release", "decays.second")}
    for i, record in enumerate(records):
        settings = record.table.settings
        stiffness = settings.stiffness if settings.offers_cubic else "linear"
        stated = settings.damping, stiffness, settings.drift, settings.noise
        if record.label not in no_decay:
            groups.setdefault(stated, []).append(i)
        elif None in stated:
            thin = settings.thin or max(1, len(record.whole[0]) // LONGEST_UNCUT)
            chosen[i] = record.with_model(replace(record.model, thin=thin))
            findings.append(Finding("decays.first_fit", "warn", {"record": record.label, "thin": thin}, record.label))
    for stated, members in groups.items():
        own = [records[i] for i in members]
        if None not in stated:
            continue
        contradicting = [e.label for e in own if e.n >= SHORTEST and demands_another(e, level)]
        if not contradicting:
            continue
        own = [e.with_table(first_periods(e.table)) for e in own]
        ranking = demanded_model(own)
        model = ranking.model
        if model != own[0].model:
            facts = {"labels": contradicting, "first": own[0].model.name, "second": model.name, "lines": model.lines}
            facts["drift"] = _drift_text(own, ranking)
            if model.slow and any(part.n < records[i].n for i, part in zip(members, own, strict=True)):
                facts["drift"] += f" The second fit uses the first {MOST_PERIODS} periods of each record."
            findings.append(Finding("decays.second_fit", "warn", facts, contradicting[0]))
            for i, part, (screened, _) in zip(members, own, ranking.fits, strict=True):
                chosen[i] = (part if model.slow else records[i]).with_model(model, screened)
    return chosen, findings


def _drift_text(records: Sequence["FreeVibration"], ranking: Ranking) -> str:
    """A sentence on the size of the drift in every record; "" without a drift."""
    if ranking.model.drift == "none":
        return ""
    sizes = []
    for record, (_, z) in zip(records, ranking.fits, strict=True):
        size = Screening(record, ranking.model.thin).drift(z) * record.column.to_display
        sizes.append(f"{size:.2g} {record.column.unit} in {record.label}")
    return f" The zero drifts by {', '.join(sizes)}."
