"""Maximum-likelihood fits of single decays, with the noise level in closed form, for the ranking of models."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import OptimizeResult, least_squares

from capsule_id.experiments.free_vibration.decay_models import HalfCycles, half_cycles, interpolate
from capsule_id.experiments.free_vibration.readings.blocks import block_mean, block_means
from capsule_id.experiments.free_vibration.readings.noise import ReadingTimes, whiten_by_shape
from capsule_id.experiments.free_vibration.settings import DecayModel
from capsule_id.experiments.free_vibration.starts import first_turning_point
from capsule_id.experiments.linear import LOG_2PI
from capsule_id.interruption import stop_if_interrupted

if TYPE_CHECKING:
    from capsule_id.experiments.free_vibration.experiment import FreeVibration

#: Largest number of evaluations in a fit, and relative step of its difference quotients.
EVALUATIONS, STEP = 40, 1e-5
#: Distance of starts from the bounds, and of the start of a term that a nested model lacks.
INSIDE, ABSENT = 1e-3, 1e-9
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
            first.append(np.clip(self.start(model, best, absent=True)[free], low + ABSENT, high - ABSENT))
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
