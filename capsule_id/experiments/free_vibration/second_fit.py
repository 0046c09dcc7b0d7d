"""Choice of the model of free decays where a record contradicts the stated one: starts, noise, hidden forces, ranking."""

import itertools
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import OptimizeResult, least_squares

from capsule_id.console import stop_if_interrupted
from capsule_id.experiments.base import LEVEL, Start, refit
from capsule_id.experiments.free_vibration.decrement import REFINED, STRONGEST, UNKNOWNS, Decrement, viscous_fit
from capsule_id.experiments.free_vibration.hidden_terms import SENSITIVITY_STEP, force_responses, sensitivities
from capsule_id.experiments.free_vibration.models import (
    STEPS,
    HalfCycles,
    half_cycles,
    interpolate,
    most_half_cycles,
    steps_of,
)
from capsule_id.experiments.free_vibration.readings import (
    DAMPING,
    FEWEST_PER_PERIOD,
    MOST_PERIODS,
    READINGS_PER_PERIOD,
    DecayModel,
    block_mean,
    block_means,
    first_periods,
    hum_columns,
    is_even,
    natural_units,
)
from capsule_id.experiments.free_vibration.record import DecayRecord, ReadingTimes, Screened, whiten_by_shape
from capsule_id.experiments.misfit import LOG_2PI
from capsule_id.experiments.statistics import further_columns, ljung_box, weighted_mean
from capsule_id.parameters import ROUNDING, SAME
from capsule_id.physics.batches import pool
from capsule_id.physics.exact.engine import as_one_function
from capsule_id.records.tones import NEAR, lasting_tone, noise_level
from capsule_id.rig.filters import median_step
from capsule_id.views import Facts, Finding

# starts: Starting points of a fit of free decays.


#: Start of a term that a simpler model lacks, relative to its usual start.
ABSENT = 1e-4


def force_starts(rough: Decrement, c: float, size: float) -> dict[str, Start]:
    """Rough starts of the further forces of a decay whose first turning point is ``size`` m, by symbol."""
    return {
        "F_dry": Start(0.02 * rough.k1 * size, 0.3),
        "c_q": Start(0.5 * c / (rough.Omega_o * size), 0.3),
        "k_cubic": Start(0.0, 0.01 * rough.k1 / size**2),
    }


def decay_starts(e: DecayRecord) -> dict[str, Start]:
    """Start of every parameter of the record ``e``, from its paper's estimate or the values of a screening.

    A viscous decay without drift starts at its least-squares fit, whose residuals show the noise at any sampling rate.
    """
    rough, noise = e.rough, noise_level(e.values)
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
        time, peak = e.first_turning_point()
        size = abs(peak)
        forces = force_starts(rough, rough.c, size)
        rough_damping = e.rough_damping(e.model.symbols)
        forces |= {
            name: Start(max(rough_damping.get(name, 0.0), 0.2 * forces[name].centre), 0.2) for name in ("F_dry", "c_q")
        }
        starts |= {symbol: forces[symbol] for symbol in e.model.symbols} | {
            "c": Start(max(rough_damping.get("c", rough.c), 0.1 * rough.c), 0.2),
            f"amplitude[{e.label}]": Start(size, 0.05),
            f"turning_time[{e.label}]": Start(time, 0.05 / rough.Omega_o),
        }
    known = {} if e.about.screened is None else e.about.screened.values
    for row in e.parameters:
        if row.symbol in known:
            value = known[row.symbol]
            near = starts.get(row.name, Start(value, 0.1))
            # An absent term is no starting point of a logarithm.
            floor = 1e-3 * near.centre if row.positive else -np.inf
            starts[row.name] = Start(max(value, floor), 0.3 * near.spread)
    return starts


def nested_starts(e: DecayRecord) -> list[dict[str, float]]:
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


# fits: Maximum-likelihood fits of single decays, with the noise level in closed form, for the ranking of models.


#: Largest number of evaluations in a fit.
EVALUATIONS = 40
#: Distance of starts from the bounds; that of a term that a nested model lacks is ``SAME``.
INSIDE = 1e-3
#: Replaces residuals, relative to the scatter of the readings, where the model has no motion.
UNFIT = 1e3
#: Starts of a fit with dry friction: rounds of one batch each, and standard deviations of their scaled unknowns (F_dry:
#: logarithm) after the first round.
DRY_ROUNDS = 8
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
#: Those that are no logarithms, and those of which every record has its own values.
LINEAR, OWN = ("F_dry", "c_q", "k_cubic", "turning_time"), ("amplitude", "turning_time")
#: Motions that are computed together: one, and another for each unknown of a motion, which stand before those of the noise.
ROWS = NAMES.index("noise_time") + 1


def free_symbols(model: DecayModel) -> list[str]:
    """Unknowns of ``model`` among ``NAMES``."""
    known = ("k1", "c", "amplitude", "turning_time", *model.symbols, *model.shapes)
    return [name for name in NAMES if name in known]


# Three programs compile faster than one, and the first serves records of every length.
@lru_cache(maxsize=32)
def _paths(number: int) -> Callable[[Mapping[str, Any]], tuple[HalfCycles, Any]]:
    """Program for half cycles of a batch of parameters; it also returns a number without meaning."""
    # With half of the steps x_rel is wrong by up to 5e-6 of the amplitude, which decides no ranking.
    path = jax.vmap(partial(half_cycles, number=number, steps=min(STEPS // 2, steps_of(number))))
    forces = ("k1", "c", "m1", "F_dry", "c_q", "k_cubic")
    return as_one_function(
        lambda theta: path({name: theta[name] for name in forces}, theta["amplitude"], theta["turning_time"])
    )


@partial(jax.jit, static_argnames="order")
def _readings(paths: HalfCycles, nodes: Any, weights: Any, order: int) -> Any:
    """(batch, n) block means of x_rel or of its derivative of this order, SI."""
    return jax.vmap(lambda path: block_mean(interpolate(path, nodes.ravel())[order], weights, jnp))(paths)


@as_one_function
def _whitened(times: ReadingTimes, raw: Any, thetas: Mapping[str, Any], design: Any) -> Any:
    """(batch, n) whitened residuals beside the best sum of the columns of ``design`` (n, q), which may be 0."""
    # A drift counts in units of the noise, which is white where the ratio is beyond its bounds.
    drift = thetas["drift_ratio"] * jnp.where(thetas["white_ratio"] > np.exp(BOUNDS["white_ratio"][1]), WHITE, 1.0)

    def one(raw: Any, shape: Mapping[str, Any]) -> Any:
        white = whiten_by_shape(times, jnp.concatenate([raw[:, None], design], axis=1), "arma", shape)
        for j in range(design.shape[1]):  # Gram and Schmidt: LAPACK cannot be called from here
            column = white[:, j + 1]
            white = white - jnp.outer(column, column @ white / (column @ column + 1e-9))
        return white[:, 0]

    shapes = {name: thetas[name] for name in ("noise_time", "white_ratio", "drift_time")}
    return jax.vmap(one)(raw, {**shapes, "drift_ratio": drift})


def hum_of(record: DecayRecord) -> float:
    """Frequency of the hum of a record, Hz: stated, or that of a lasting tone beside its viscous fit; 0 without one."""
    time, values = record.whole
    if record.model.hum or not is_even(time):
        return record.model.hum
    fit, peaks = viscous_fit(time, values), record.rough.Omega_o / (2.0 * np.pi)
    tone = lasting_tone(time, fit.left, fit.omega / (2.0 * np.pi))
    # Where the fit misses the motion, as behind lost samples, its residuals hold that motion.
    return tone if abs(tone - peaks) > NEAR * peaks else 0.0


class Screening:
    """Maximum-likelihood fits of one record, by means of ``thin`` samples (default: as the record).

    ``k1`` is what the bounds of k1 lie about (default: a rough estimate, which few swings with dry friction mislead).
    """

    def __init__(self, record: DecayRecord, thin: int | None = None, k1: float | None = None) -> None:
        self.record, self.c, self.omega = record, record.rough.c, record.rough.Omega_o
        self.turning_time, peak = record.first_turning_point()
        self.side, self.period = float(np.sign(peak)), 2.0 * np.pi / self.omega
        self.blocks = block_means(*record.whole, thin or record.model.thin, by_sample=record.order > 0)
        self.values, self.times = self.blocks.values, ReadingTimes.of(self.blocks)
        self.number = most_half_cycles(float(record.time[-1]), self.omega)
        time, hum = self.times.time, record.model.hum
        linear = np.column_stack([np.ones(len(time)), (time - np.mean(time)) / np.ptp(time)])
        tone = (
            block_mean(hum_columns(self.blocks.nodes.ravel(), hum, np), self.blocks.weights, np)
            if hum
            else linear[:, :0]
        )
        #: (n, q) offset, drift, and hum.
        self.design = np.column_stack([linear, tone])
        k1 = k1 or record.rough.k1
        self.units = natural_units(k1, record.mass, abs(peak)) | {
            "k1": k1,
            "c": self.c,
            "amplitude": abs(peak),
            "turning_time": 1.0 / self.omega,
            "noise_time": 0.1 * self.period,
            "white_ratio": 1.0,
            "drift_ratio": 1.0,
            "drift_time": self.period,
        }

    def theta(self, z: np.ndarray) -> dict[str, Any]:
        """Values by symbol, SI, of scaled unknowns (..., names)."""
        own = dict(zip(NAMES, np.moveaxis(z, -1, 0), strict=True))
        values = {name: self.units[name] * (x if name in LINEAR else np.exp(x)) for name, x in own.items()}
        values["turning_time"] = self.turning_time + values["turning_time"]
        for name in ("white_ratio", "drift_ratio"):
            values[name] = np.where(own[name] < BOUNDS[name][0], 0.0, values[name])
        return {"m1": np.broadcast_to(self.record.mass, values["k1"].shape), **values}

    def scaled(self, values: Mapping[str, float]) -> np.ndarray:
        """(names,) scaled unknowns at values by symbol, SI, of another fit; amplitude and time of this record's own."""
        known = {name: 0.0 if name in OWN else values.get(name, 0.0) / self.units[name] for name in NAMES}
        return np.array([x if name in LINEAR or x <= 0.0 else np.log(x) for name, x in known.items()])

    def start(self, model: DecayModel, near: np.ndarray | None, absent: bool = False) -> np.ndarray:
        """(names,) scaled starting values; terms that the model lacks are switched off, ``absent`` those ``near`` lacks too."""
        z = self.scaled(self.record.rough_damping(model.symbols)) if near is None else near.copy()
        free = free_symbols(model)
        for name, value in (("F_dry", 0.02), ("c_q", 0.05), ("k_cubic", 0.0), ("drift_time", 1.0)):
            i = NAMES.index(name)
            z[i] = (z[i] or value * (not absent)) if name in free else 0.0
        white = near is None or near[NAMES.index("white_ratio")] > BOUNDS["white_ratio"][1]
        if absent and white:
            z[NAMES.index("noise_time")] = BOUNDS["noise_time"][0]
        for name, value, unused in (
            ("white_ratio", 0.0, -1e3 if model.noise == "ar1" else np.log(WHITE)),
            ("drift_ratio", np.log(3.0), -1e3),
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
        known = "F_dry" in self.record.rough_damping(("F_dry",))
        size, low, high = (found["F_dry"], 0.5, 2.0) if known else (self.units["F_dry"], 0.003, 0.45)
        grid = size * np.geomspace(low, high, len(NAMES) + 1)
        lost = (found["F_dry"] if known else 0.0) - grid
        peak = self.record.deflection * float(np.mean(np.abs(self.record.rough.peaks)))
        c = np.maximum(found["c"] + lost * 4.0 / (np.pi * self.omega * peak), 0.02 * self.c)
        starts = np.tile(start, (len(grid), 1))
        starts[:, i], starts[:, j] = grid / self.units["F_dry"], np.log(c / self.c)
        moved = np.repeat(starts[None], DRY_ROUNDS, axis=0)
        rng = np.random.default_rng(0)
        for name, spread in DRY_SPREADS.items():
            z, place = spread * rng.standard_normal(moved.shape[:2])[1:], NAMES.index(name)
            moved[1:, :, place] = moved[1:, :, place] * np.exp(z) if name == "F_dry" else moved[1:, :, place] + z
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
        jacobians: dict[bytes, np.ndarray] = {}
        unit = float(np.std(self.values))
        design = self.design * np.where(np.arange(self.design.shape[1]) == 1, model.drift == "linear", 1.0)

        def whitened(whole: np.ndarray) -> np.ndarray:
            """(names + 1, n) residuals at as many scaled unknowns."""
            thetas, motion = self.motions(whole)
            return np.asarray(_whitened(self.times, self.values - motion, thetas, design)[0]) / unit

        def residuals(z: np.ndarray) -> np.ndarray:
            """(n,) residuals at (free,); one batch of fixed size also gives the Jacobian, which is kept for its turn."""
            stop_if_interrupted()
            sign = np.where(z > high - 2.0 * SENSITIVITY_STEP, -1.0, 1.0)
            whole = np.tile(start, (len(NAMES) + 1, 1))
            whole[: len(free) + 1, free] = np.concatenate([z[None], z + SENSITIVITY_STEP * np.diag(sign)])
            points = whitened(whole)[: len(free) + 1]
            points = np.where(np.isfinite(points), points, UNFIT)
            jacobians[z.tobytes()] = (points[1:] - points[:1]).T / (SENSITIVITY_STEP * sign)
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
            starts = starts[np.argsort(np.where(np.isfinite(costs), costs, np.inf))[:REFINED]]
        first = list(np.clip(starts[:, free], *inside))
        if nested:
            best = min(nested, key=lambda one: one[0].noise)[1]
            first.append(np.clip(self.start(model, best, absent=True)[free], low + SAME, high - SAME))
        options: Any = {"jac": lambda z: jacobians[z.tobytes()], "bounds": (low, high), "x_scale": "jac"}
        ends = [least_squares(residuals, one, max_nfev=EVALUATIONS, **options) for one in first]
        found = min(ends, key=lambda end: end.cost)
        start[free] = found.x
        return self._summary(model, start, found, unit, tuple(one.values for one, _ in nested)), start

    def motions(self, whole: np.ndarray) -> tuple[dict[str, Any], np.ndarray]:
        """Values by symbol and predicted readings (batch, n), SI, at scaled unknowns (batch, names)."""
        thetas = self.theta(whole)
        # Points that differ in noise or drift alone have one motion.
        _, first, place = np.unique(whole[:, : ROWS - 1], axis=0, return_index=True, return_inverse=True)
        parts = np.resize(first, (-(-len(first) // ROWS), ROWS))
        paths = (_paths(self.number)({name: x[part] for name, x in thetas.items()})[0] for part in parts)
        readings = [_readings(path, self.blocks.nodes, self.blocks.weights, self.record.order) for path in paths]
        return thetas, self.side * np.concatenate(readings)[np.ravel(place)]

    def drowned(self, z: np.ndarray) -> bool:
        """Whether drift and noise at scaled unknowns (names,) are larger than the motion."""
        motion = self.motions(z[None])[1][0]
        return not np.std(self.values - motion) <= np.std(motion)

    def drift(self, z: np.ndarray) -> float:
        """Range of the mean over one period of measured minus predicted readings, SI, at scaled unknowns (names,)."""
        raw = self.values - self.motions(z[None])[1][0]
        time = self.times.time
        half = 0.5 * self.period
        first, last = np.searchsorted(time, time - half), np.searchsorted(time, time + half)
        total = np.concatenate([[0.0], np.cumsum(raw)])
        means = (total[last] - total[first]) / (last - first)
        whole = means[(time > half) & (time < time[-1] - half)]
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
        n, unknowns = len(self.values), len(free) + self.design.shape[1] + int(model.drift == "linear")
        deviance = n * (np.log(2.0 * found.cost * unit**2 / n) + 1.0 + LOG_2PI)
        values = {name: float(value) for name, value in self.theta(z).items()}
        norms = np.linalg.norm(found.jac, axis=0)
        norms = np.where(norms > 0.0, norms, ROUNDING)  # of an unknown that the record does not depend on
        scaled = found.jac / norms
        variances = np.maximum(np.diag(np.linalg.pinv(scaled.T @ scaled, hermitian=True)), ROUNDING) / norms**2
        sd = np.sqrt(variances * 2.0 * found.cost / max(n - unknowns, 1))
        units = {name: self.units[name] if name in LINEAR else values[name] for name in free}
        errors = {name: float(units[name] * own) for name, own in zip(free, sd, strict=True)}
        noise = float(np.sqrt(2.0 * found.cost / n)) * unit
        return Screened(float(deviance + unknowns * np.log(n)), values, errors, noise, found.fun, nested)


# screening: Choice of the model of free decays where the record contradicts the stated one.
#
# A record demands another model where its residuals are not white, or where they correlate with the response to dry
# friction, quadratic damping, a cubic spring or a drift. Every sum of the terms that the settings leave open is
# then fitted to the record by maximum likelihood and ranked by BIC.


#: Largest number of samples of a record that is no free decay.
LONGEST_UNCUT = 1000
#: Of forces whose BIC differs by less, the fewest are chosen: with seven alternatives, noise alone often gains this much.
BIC_MARGIN = 4.0
#: Shorter records, in samples, keep their model, and shorter halves of a record are not fitted. A thinned record has twice
#: as many readings.
SHORTEST = 40
#: Residuals with a larger p-value of the Ljung–Box test count as white here; the check after the fit is more lenient.
WHITENESS = 0.01


def open_models(record: DecayRecord) -> tuple[list[DecayModel], list[DecayModel]]:
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


def demands_another(record: DecayRecord, level: float) -> bool:
    """Whether ``record`` contradicts its model at this false-alarm rate: residuals, or responses to further forces.

    A decay beyond ``STRONGEST`` damping keeps its model, because no other one is offered.
    """
    rough = record.rough
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


def response_p(record: DecayRecord, theta: Mapping[str, float]) -> float:
    """p-value of the F test for the responses of the rod to further forces and for a drift, at a viscous fit."""
    left, design, moved = sensitivities(record, theta, ("k1", "c"))
    relative = record.time / record.time[-1] - 0.5
    extra = np.column_stack([*force_responses(record, theta).values(), relative, relative**2])
    # A column of zeros is no effect: quadratic damping of a record that stays where it is.
    extra = extra / np.maximum(np.linalg.norm(extra, axis=0), np.finfo(float).tiny)
    p = further_columns(np.column_stack([design, *moved.values()]), extra, left)[1]
    return 1.0 if np.isnan(p) else p


def thinning(record: DecayRecord, per_period: float) -> int:
    """Return the block size that leaves about ``per_period`` readings, and not too few; no less than that of the record."""
    time = record.whole[0]
    step = 2.0 * np.pi / (record.rough.Omega_o * per_period * median_step(time))
    return max(record.model.thin, min(int(step), len(time) // (2 * SHORTEST)))


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
        nested = [one for one in done if one.model.terms < model.terms]
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
    for _, same_size in itertools.groupby(sorted(models, key=lambda one: len(one.terms)), lambda one: len(one.terms)):
        first, *level = same_size
        done += [*([] if done else [fitted(first)]), *pool().map(fitted, [first, *level] if done else level)]
    return sorted(done, key=lambda one: one.bic)


def simplest(ranked: Sequence[Ranking]) -> Ranking:
    """Return the model with the fewest forces whose BIC is within ``BIC_MARGIN`` of the best one, the first."""
    near = [one for one in ranked if one.bic <= ranked[0].bic + BIC_MARGIN]
    return min(near, key=lambda one: len(one.model.symbols))


def demanded_model(records: Sequence[DecayRecord]) -> Ranking:
    """Return the model with the lowest BIC of all ``records`` together, thinned where its noise is coloured.

    The forces are chosen first on thinned records, with the richest noise that the settings leave open, then drift and
    noise. The fits of fewer forces become starts of the quoted fit.
    """
    forces, others = open_models(records[0])
    # Half of the readings that a quoted fit has rank the models as well.
    coarse = min(thinning(record, 0.5 * READINGS_PER_PERIOD) for record in records)
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
    records: Sequence[DecayRecord], ranked: list[Ranking], others: Sequence[DecayModel], coarse: int
) -> Ranking:
    """Choose drift and noise, from the ranking of all of them on records thinned by ``coarse``.

    Coloured noise is quoted from these: finer readings cost time and hardly tell more. White noise is quoted from all
    readings where it is white there. Where no offered noise is white, still fewer readings may be.
    """
    best = ranked[0]
    if records[0].table.settings.thin is not None:
        return rank([Screening(record) for record in records], [best.model], best)[0]
    thin, fewest = coarse, max(coarse, min(thinning(record, FEWEST_PER_PERIOD) for record in records))
    if not any(one.white for one in ranked) and fewest > coarse:
        thin, ranked = fewest, rank([Screening(record, fewest) for record in records], others, best)
    chosen = next((one for one in ranked if one.white), None)
    if chosen is None:
        return replace(best, model=replace(best.model, thin=coarse))
    if not chosen.model.whitened:
        whole = rank([Screening(record, chosen.model.thin) for record in records], [chosen.model], chosen)[0]
        if whole.white:
            return whole
    return replace(chosen, model=replace(chosen.model, thin=thin))


#: What some decays demand: labels of those that contradict their model, all of them under the new one, and facts.
Demanded = tuple[Sequence[str], Sequence[Any], Facts]


def replaced(
    decays: Sequence[Any],
    judged: Iterable[int],
    demanded: Callable[[list[Any]], Demanded],
    screened: Callable[[Any, DecayModel], Screened],
) -> tuple[list[Any], list[Finding]]:
    """Return ``decays`` under the models that they demand, and findings that name these models.

    Decays with the same stated words share their parameters, and so their model.

    Parameters
    ----------
    judged : indices of the decays that may have another model
    demanded : what the decays of one group demand
    screened : fit of a decay alone under a model
    """
    chosen, findings = list(decays), list[Finding]()
    groups: dict[Any, list[int]] = {}
    for i in judged:
        stated = decays[i].table.settings.choices
        if None in stated:
            groups.setdefault(stated, []).append(i)
    for members in groups.values():
        labels, others, facts = demanded([decays[i] for i in members])
        first, second = decays[members[0]].model, others[0].model
        if labels and second != first:
            facts = {"labels": labels, "first": first.name, "second": second.name, "drift": "", **facts}
            facts["alternatives"] = _both_fits(others, screened)
            findings.append(Finding("decays.second_fit", "warn", {"lines": others[0].lines, **facts}, labels[0]))
            for i, other in zip(members, others, strict=True):
                chosen[i] = other
    return chosen, findings


def _both_fits(decays: Sequence[Any], screened: Callable[[Any, DecayModel], Screened]) -> list[dict[str, object]]:
    """Rows of a table of the decays alone under the stated model and under the quoted one, on the same readings."""
    quoted = decays[0].model
    stated = replace(DecayModel.stated(decays[0].table.settings), thin=quoted.thin)
    pairs = ((stated, [screened(e, stated) for e in decays]), (quoted, [e.about.screened for e in decays]))
    rows = []
    for role, (model, fits) in zip(("stated", "quoted"), pairs, strict=True):
        means = {
            symbol: weighted_mean([one.values[symbol] for one in fits], [one.errors[symbol] for one in fits])
            for symbol in ("k1", "c", *model.symbols)
        }
        row = {
            "fit": role,
            "model": model.name,
            "parameters": ", ".join(f"{name} = {mean:.5g} ± {sd:.2g}" for name, (mean, sd, _) in means.items()),
            "noise, SI": float(np.mean([one.noise for one in fits])),
            "BIC": sum(one.bic for one in fits) - min(sum(one.bic for one in each) for _, each in pairs),
        }
        if decays[0].time_series:
            white = all(ljung_box(one.residuals)[1] * len(decays) >= LEVEL for one in fits)
            row["residuals white"] = "yes" if white else "no"
        rows.append(row)
    return rows


def second_models(
    records: Sequence[DecayRecord], readings: Sequence[Finding] = ()
) -> tuple[list[DecayRecord], list[Finding]]:
    """Return ``records`` under the model that they demand, and findings that name it.

    Records with more than a free decay according to ``readings``, the findings on the readings, keep their model. Their
    fit fails in any case, so long ones are thinned.
    """
    kept, findings = list(records), list[Finding]()
    no_decay = {f.experiment for f in readings if f.level == "fail" and f.code in ("decays.release", "decays.second")}
    for i, record in enumerate(records):
        settings = record.table.settings
        if record.label in no_decay and None in settings.choices:
            thin = settings.thin or max(1, len(record.whole[0]) // LONGEST_UNCUT)
            kept[i] = record.with_model(replace(record.model, thin=thin))
            findings.append(Finding("decays.first_fit", "warn", {"record": record.label, "thin": thin}, record.label))
    judged = (i for i, record in enumerate(records) if record.label not in no_decay)
    demanded = partial(_demanded, level=LEVEL / len(records))
    chosen, named = replaced(kept, judged, demanded, lambda e, model: Screening(e, model.thin).fit(model)[0])
    return chosen, findings + named


def _demanded(records: list[DecayRecord], level: float) -> Demanded:
    """What ``records`` demand: they share the model with the lowest BIC where one of them contradicts the stated one."""
    contradicting = [e.label for e in records if e.n >= SHORTEST and demands_another(e, level)]
    if not contradicting:
        return (), records, {}
    records = [e.with_model(replace(e.model, hum=hum_of(e))) if e.n >= SHORTEST else e for e in records]
    own = [e.with_model(e.model, table=first_periods(e.table)) for e in records]
    humming = [e for e in own if e.model.hum]
    # Where hum is the cause, no further force is needed.
    if humming and not any(demands_another(e, level) for e in own if e.n >= SHORTEST):
        ranking = rank([*map(Screening, own)], [humming[0].model])[0]
    else:
        ranking = demanded_model(own)
    text = _drift_text(own, ranking)
    if ranking.model.slow and any(part.n < whole.n for part, whole in zip(own, records, strict=True)):
        text += f" The second fit uses the first {MOST_PERIODS} periods of each record."
    kept = own if ranking.model.slow else records
    others = [
        e.with_model(replace(ranking.model, hum=e.model.hum), fit)
        for e, (fit, _) in zip(kept, ranking.fits, strict=True)
    ]
    if humming and len(others) > 1:
        tones = ", ".join(f"{e.model.hum:.6g} Hz in {e.label}" for e in humming)
        text += f" Each record has its own hum: {tones}."
    return contradicting, others, {"drift": text}


def _drift_text(records: Sequence[DecayRecord], ranking: Ranking) -> str:
    """A sentence on the size of the drift in every record; "" without a drift."""
    if ranking.model.drift == "none":
        return ""
    fitted = [(e, Screening(e, ranking.model.thin), z) for e, (_, z) in zip(records, ranking.fits, strict=True)]
    sizes = (f"{s.drift(z) * e.column.to_display:.2g} {e.column.unit} in {e.label}" for e, s, z in fitted)
    return f" The zero drifts by {', '.join(sizes)}."
