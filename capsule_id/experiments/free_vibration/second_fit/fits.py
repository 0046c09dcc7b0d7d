"""Maximum-likelihood fits of single decays, with the noise level in closed form, for the ranking of models."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import least_squares

from capsule_id.experiments.free_vibration.decay_models import HalfCycles, half_cycles, interpolate
from capsule_id.experiments.free_vibration.readings.blocks import block_mean, block_means
from capsule_id.experiments.free_vibration.readings.noise import ReadingTimes, whiten_by_shape
from capsule_id.experiments.free_vibration.settings import DecayModel
from capsule_id.experiments.linear import LOG_2PI

if TYPE_CHECKING:
    from capsule_id.experiments.free_vibration.experiment import FreeVibration

#: Largest number of evaluations in a fit, and relative step of its difference quotients.
EVALUATIONS, STEP = 40, 1e-5
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
    """

    bic: float
    values: Mapping[str, float]
    errors: Mapping[str, float]
    noise: float
    residuals: np.ndarray


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


@jax.jit
def _positions(paths: HalfCycles, nodes: Any, weights: Any) -> Any:
    """(batch, n) block means of x_rel, m."""
    return jax.vmap(lambda path: block_mean(interpolate(path, nodes.ravel()).x_rel, weights, jnp))(paths)


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
    """Maximum-likelihood fits of one record, by means of ``thin`` samples (default: as the record)."""

    def __init__(self, record: "FreeVibration", thin: int | None = None) -> None:
        rough = record.rough_decrement()
        self.turning_time, peak = record.first_turning_point()
        self.side, self.size = float(np.sign(peak)), abs(peak)
        self.m1, self.k1, self.c, self.omega = record.mass, rough.k1, rough.c, rough.Omega_o
        period, length = 2.0 * np.pi / self.omega, float(record.time[-1])
        blocks = block_means(*record.whole, thin or record.model.thin)
        self.values, self.nodes, self.weights = blocks.values, blocks.nodes, blocks.weights
        self.times = ReadingTimes.of(blocks)
        # The margin allows for a frequency 1.25 times the rough estimate.
        self.number = int(2.5 * length / period) + 5
        self.noise_time, self.drift_time = 0.1 * period, period

    def theta(self, z: np.ndarray) -> dict[str, Any]:
        """Values by symbol, SI, of scaled unknowns (..., names)."""
        own = dict(zip(NAMES, np.moveaxis(z, -1, 0), strict=True))
        k1 = self.k1 * np.exp(own["k1"])
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
            "drift_ratio": np.where(own["drift_ratio"] < BOUNDS["drift_ratio"][0], 0.0, np.exp(own["drift_ratio"])),
            "drift_time": self.drift_time * np.exp(own["drift_time"]),
        }

    def start(self, model: DecayModel, near: np.ndarray | None) -> np.ndarray:
        """(names,) scaled starting values; absent terms are switched off."""
        z = np.zeros(len(NAMES)) if near is None else near.copy()
        free = free_symbols(model)
        for name, value in (("F_dry", 0.02), ("c_q", 0.05), ("k_cubic", 0.0), ("drift_time", 1.0)):
            i = NAMES.index(name)
            z[i] = (z[i] or value) if name in free else 0.0
        off = -1e3
        for name, value, absent in (
            ("white_ratio", 0.0, off if model.noise == "ar1" else np.log(WHITE)),
            ("drift_ratio", np.log(3.0), off),
        ):
            i = NAMES.index(name)
            inside = BOUNDS[name][0] < z[i] < BOUNDS[name][1]
            z[i] = (z[i] if inside and near is not None else value) if name in free else absent
        return z

    def fit(self, model: DecayModel, near: np.ndarray | None = None) -> tuple[Screened, np.ndarray]:
        """Fit ``model`` from the scaled values ``near``; return also the scaled values found."""
        start, free = self.start(model, near), [NAMES.index(name) for name in free_symbols(model)]
        sloped = float(model.drift == "linear")

        jacobians: dict[bytes, np.ndarray] = {}

        def residuals(z: np.ndarray) -> np.ndarray:
            """(n,) residuals at (free,); one batch of fixed size also gives the Jacobian, which is kept for its turn."""
            sign = np.where(z > high - 2.0 * STEP, -1.0, 1.0)
            whole = np.tile(start, (len(NAMES) + 1, 1))
            whole[: len(free) + 1, free] = np.concatenate([z[None], z + STEP * np.diag(sign)])
            thetas = {name: jnp.asarray(value) for name, value in self.theta(whole).items()}
            raw = self.values[None] - self.side * _positions(_paths(thetas, self.number), self.nodes, self.weights)
            points = np.asarray(_whitened(self.times, raw, thetas, sloped))[: len(free) + 1] / unit
            jacobians[z.tobytes()] = (points[1:] - points[:1]).T / (STEP * sign)
            return points[0]

        low, high = np.array([BOUNDS[NAMES[i]] for i in free]).T
        first = np.clip(start[free], low + 1e-3, high - 1e-3)
        unit = float(np.std(self.values))
        found = least_squares(
            residuals,
            first,
            jac=lambda z: jacobians[z.tobytes()],  # type: ignore[arg-type]  # pyright: ignore[reportArgumentType]
            bounds=(low, high),
            x_scale="jac",
            max_nfev=EVALUATIONS,
        )
        z = start.copy()
        z[free] = found.x
        n, unknowns = len(self.values), len(free) + 2 + int(sloped)
        deviance = n * (np.log(2.0 * found.cost * unit**2 / n) + 1.0 + LOG_2PI)
        values = {name: float(value) for name, value in self.theta(z).items()}
        variances = np.maximum(np.diag(np.linalg.pinv(found.jac.T @ found.jac, hermitian=True)), 0.0)
        sd = np.sqrt(variances * 2.0 * found.cost / max(n - unknowns, 1))
        moved = {name: self.theta(z + STEP * np.eye(len(NAMES))[NAMES.index(name)]) for name in free_symbols(model)}
        errors = {
            name: float(abs(moved[name][name] - values[name]) / STEP * own) for name, own in zip(moved, sd, strict=True)
        }
        noise = float(np.sqrt(2.0 * found.cost / n)) * unit
        return Screened(float(deviance + unknowns * np.log(n)), values, errors, noise, found.fun), z
