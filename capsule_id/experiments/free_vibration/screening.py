"""Fits of single free decays: maximum likelihood with the noise level in closed form."""

from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import OptimizeResult, least_squares

from capsule_id.console import stop_if_interrupted
from capsule_id.experiments.free_vibration.decrement import REFINED, viscous_fit
from capsule_id.experiments.free_vibration.hidden_terms import SENSITIVITY_STEP
from capsule_id.experiments.free_vibration.models import (
    STEPS,
    HalfCycles,
    half_cycles,
    interpolate,
    most_half_cycles,
    steps_of,
)
from capsule_id.experiments.free_vibration.readings import (
    DecayModel,
    block_mean,
    block_means,
    hum_columns,
    is_even,
    natural_units,
)
from capsule_id.experiments.free_vibration.record import DecayRecord, ReadingTimes, Screened, whiten_by_shape
from capsule_id.experiments.misfit import LOG_2PI
from capsule_id.parameters import ROUNDING, SAME
from capsule_id.physics.exact.engine import as_one_function
from capsule_id.records.tones import NEAR, lasting_tone

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
