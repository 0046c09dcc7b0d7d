"""Nonlinear least squares from several starts, with the covariance of the parameters.

Residuals r(x), (d,) -> (n,); cost ½ Σ r²; J = ∂r/∂x, (n, d). At the minimum the covariance of the parameters is
σ² (JᵀJ)⁻¹ with σ² = Σ r² / (n − d) unless it is known (Seber & Wild, *Nonlinear Regression*, 1989, ch. 2).
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from capsule_id.inference.fit.covariance import Covariance, Jacobian, Residuals, all_finite, column_space, covariance
from capsule_id.inference.target.compiling import COMPILE, COMPILE_QUICKLY
from capsule_id.interruption import stop_if_interrupted
from capsule_id.precision import require_float64

require_float64()

Residual = Callable[[jax.Array], jax.Array]
#: A point (d,) -> residuals (n,) and their Jacobian (n, d).
Linearise = Callable[[np.ndarray], tuple[Residuals, Jacobian]]

LEAST_DECREASE, EXPECTED_DECREASE = 0.01, 0.99
"""Parts of the decrease of the cost that the linear model predicts. A step with less than the first is rejected. A step
with more than the second enlarges the trust region (Gould et al., *4OR* 3, 2005, 227)."""

ENLARGED, REDUCED = 3.5, 0.25
"""Factors of the trust region's size after such steps. The damping is the inverse of this size."""

LARGEST_DAMPING = 1.0 / float(np.finfo(float).eps)
"""Damping beside squared column norms of at most about 1, beyond which a step vanishes in rounding."""

FIRST_DAMPING = 1e-6
"""Dimensionless: the first step's damping beside the squared column norms of heavy residuals. Their parameters are
strongly correlated. Heavy damping would stop a start near the minimum as if it had converged."""

SMALLEST_EFFECT = 0.01
"""Dimensionless. Smallest effect of a parameter on the residuals, relative to the strongest parameter, when it changes
by 100 % of its start. Below it the scale is the step with this effect: a start at zero defines no scale."""

LARGEST_OFFSET = 1e-3
"""Largest distance of a converged end from a stationary point, in radii of the joint confidence region, dimensionless
(relative offset; Bates & Watts, *Technometrics* 23, 1981, 179)."""


@dataclass(frozen=True)
class LeastSquaresFit:
    """End point and convergence of each start.

    Attributes
    ----------
    x : (s, d) end points, units of the parameters
    cost : (s,) ½ Σ r², units of the residuals squared
    stalled : (s,) bool, no convergence: too many steps, non-finite values, or vanishing steps away from a stationary
        point
    steps : (s,) solver steps, rejected ones included
    message : (s,) the reason, "" where it converged
    residuals : (s, n) at the end points
    jacobian : (s, n, d) of the residuals at the end points
    """

    x: np.ndarray
    cost: np.ndarray
    stalled: np.ndarray
    steps: np.ndarray
    message: tuple[str, ...]
    residuals: np.ndarray
    jacobian: np.ndarray

    @property
    def best(self) -> int:
        """Index of the start with the smallest finite cost among those that converged, or among all if none did."""
        candidates = self.stalled if self.stalled.all() else ~self.stalled
        return int(np.argmin(np.where(candidates & np.isfinite(self.cost), self.cost, np.inf)))

    def covariance(self, residual_sd: float | None = None, start: int | None = None) -> Covariance:
        """Covariance at the end point of ``start`` (default: the best one); see the function ``covariance``."""
        index = self.best if start is None else start
        return covariance(self.jacobian[index], self.residuals[index], residual_sd)


@dataclass(frozen=True)
class Solver:
    """Settings of the least-squares solver for each start.

    Attributes
    ----------
    tolerance : dimensionless; converged once a step changes every v_j and every divided residual by less than
        tolerance (1 + its size)
    max_steps : solver steps, rejected ones included, after which a start counts as stalled
    heavy : residuals take milliseconds, so the code is optimised and parameters are scaled by effect (Marquardt 1963)
    """

    tolerance: float = 1e-9
    max_steps: int = 1024
    heavy: bool = False


#: Default solver settings.
SOLVER = Solver()


def least_squares(residual: Residual, starts: np.ndarray, solver: Solver = SOLVER) -> LeastSquaresFit:
    """Minimise ½ Σ r(x)² by Levenberg-Marquardt, forward-mode Jacobian, compiled once for all starts.

    Only residuals and Jacobian are compiled, in one program. The steps are NumPy, because a second program that holds
    the residuals takes as long to compile again.

    Damping and tolerance of Levenberg-Marquardt require parameters of comparable size. Each start is therefore solved
    in v_j = x_j / scale_j with scale_j = |start_j| (at zero: ``SMALLEST_EFFECT``). The residuals are divided by the
    largest column norm of the Jacobian in v at the start. The result depends on no units.

    Parameters
    ----------
    residual : (d,) -> (n,), a JAX function; it may close over arrays. A ``jax.tree_util.Partial`` or ``equinox.Module``
        passes its arrays as arguments: other values of the same shapes then need no new compilation
    starts : (s, d), units of the parameters
    solver : tolerance and linear algebra of each start

    Raises
    ------
    ValueError
        If ``starts`` is not (s, d) with s ≥ 1, or not finite.
    """
    starts = np.asarray(starts, dtype=float)
    if starts.ndim != 2 or starts.size == 0 or not np.isfinite(starts).all():
        raise ValueError(f"starts must be (s, d) and finite, got shape {starts.shape}: give one row per start")
    ends = [_descend(partial(_linearised, residual, solver.heavy), start, solver) for start in starts]
    x, residuals, jacobian, steps, message = zip(*ends, strict=True)
    return LeastSquaresFit(
        x=np.stack(x),
        cost=0.5 * np.sum(np.stack(residuals) ** 2, axis=1),
        stalled=np.array([reason != "" for reason in message]),
        steps=np.array(steps),
        message=message,
        residuals=np.stack(residuals),
        jacobian=np.stack(jacobian),
    )


class _End(NamedTuple):
    """Where one start ended: x (d,), residuals (n,) and Jacobian (n, d) there, steps, reason for no convergence."""

    x: np.ndarray
    residuals: np.ndarray
    jacobian: np.ndarray
    steps: int
    message: str


def _descend(linearise: Linearise, start: np.ndarray, solver: Solver) -> _End:
    """Levenberg-Marquardt from one start (d,)."""
    x, (residuals, jacobian) = start, linearise(start)
    if not all_finite(jacobian, residuals):
        return _End(x, residuals, jacobian, 1, "The residuals or their Jacobian are not finite: try another start.")
    scale, unit = (_effects if solver.heavy else _scales)(jacobian, start)
    damping, steps, converged = 1.0, 1, False
    reduced = _reduced(jacobian * scale / unit, residuals / unit)
    while not converged and steps < solver.max_steps and damping < LARGEST_DAMPING:
        stop_if_interrupted()
        move, predicted = _damped_step(reduced, damping)
        trial = x + move * scale
        at_trial, slopes = linearise(trial)
        steps += 1
        with np.errstate(over="ignore", invalid="ignore"):
            change = 0.5 * float(np.sum((at_trial / unit) ** 2) - np.sum((residuals / unit) ** 2))
        if not (change <= LEAST_DECREASE * predicted and all_finite(slopes, at_trial)):
            damping /= REDUCED
            continue
        damping /= ENLARGED if change < EXPECTED_DECREASE * predicted else 1.0
        converged = _is_small(trial / scale, move, solver) and _is_small(
            at_trial / unit, (at_trial - residuals) / unit, solver
        )
        x, residuals, jacobian = trial, at_trial, slopes
        reduced = _reduced(jacobian * scale / unit, residuals / unit)
    if not converged and steps == solver.max_steps:
        return _End(x, residuals, jacobian, steps, "The maximum number of steps was reached: try another start.")
    # The solver tests step sizes only, and heavy damping makes steps small far from a minimum.
    stationary = _stationary(jacobian, residuals, solver.tolerance * unit)
    reason = "The steps became tiny before the residuals were orthogonal to the Jacobian: try another start."
    return _End(x, residuals, jacobian, steps, "" if stationary else reason)


def _reduced(jacobian: Jacobian, residuals: Residuals) -> np.ndarray:
    """(min(n, d + 1), d + 1) triangle of (J, r): |J v + r| is the same with its columns in the place of J and r."""
    return np.asarray(np.linalg.qr(np.column_stack([jacobian, residuals]), mode="r"))


def _damped_step(reduced: np.ndarray, damping: float) -> tuple[np.ndarray, float]:
    """Minimise |J v + r|² + damping |v|²: return v (d,) and the predicted change of ½ |r|²."""
    jacobian, residuals = reduced[:, :-1], reduced[:, -1]
    d = jacobian.shape[1]
    damped = np.concatenate([jacobian, np.sqrt(damping) * np.eye(d)])
    move = -np.linalg.lstsq(damped, np.concatenate([residuals, np.zeros(d)]))[0]
    return move, 0.5 * float(np.sum((jacobian @ move + residuals) ** 2) - np.sum(residuals**2))


def _is_small(values: np.ndarray, change: np.ndarray, solver: Solver) -> bool:
    """Whether every change is below the tolerance times (1 + its value)."""
    return bool(np.all(np.abs(change) < solver.tolerance * (1.0 + np.abs(values))))


def _stationary(jacobian: Jacobian, residuals: Residuals, rounding: float) -> bool:
    """Whether the residuals (n,) projected on the range of J (n, d) are small against the rest or ``rounding``."""
    left = column_space(jacobian)[0]
    tangential = float(np.linalg.norm(left.T @ residuals))
    normal = float(np.linalg.norm(residuals - left @ (left.T @ residuals)))
    freedom = max(len(residuals) - left.shape[1], 1)
    # Bates & Watts divide both parts by their degrees of freedom.
    radius = normal * np.sqrt(max(left.shape[1], 1) / freedom)
    return tangential <= max(LARGEST_OFFSET * radius, rounding)


def linearised(residual: Residual, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Residuals (n,) and Jacobian (n, d) of heavy residuals at x (d,)."""
    return _linearised(residual, True, x)


def _linearised(residual: Residual, heavy: bool, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    residuals, jacobian = _PROGRAMS[heavy](residual, jnp.asarray(x))
    return np.asarray(residuals), np.asarray(jacobian)


def _linearise(residual: Residual, x: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Residuals (n,) and Jacobian (n, d) at x (d,), in one pass."""

    def twice(x: jax.Array) -> tuple[jax.Array, jax.Array]:
        value = residual(x)
        return value, value

    jacobian, value = jax.jacfwd(twice, has_aux=True)(x)
    return value, jacobian


#: Compiled ``_linearise``, indexed by whether the residuals are heavy.
_PROGRAMS: dict[bool, Callable[..., Any]] = {
    # Equinox passes the options to jax.jit, but its annotations omit them.
    heavy: eqx.filter_jit(_linearise, compiler_options=dict(options))  # pyright: ignore[reportCallIssue]
    for heavy, options in ((True, COMPILE), (False, COMPILE_QUICKLY))
}


def _effects(jacobian: Jacobian, start: np.ndarray) -> tuple[np.ndarray, float]:
    """Scale as ``_scales`` does, but give every column of the Jacobian the same norm, the unit of the residuals."""
    column_norm = np.linalg.norm(jacobian, axis=0)
    unit = float(np.max(column_norm)) or 1.0
    scale = np.where(column_norm > 0, unit / np.where(column_norm > 0, column_norm, 1.0), np.ones_like(start))
    # The solver's initial damping is 1. Larger residual units reduce its effect by their square.
    return scale, float(np.sqrt(FIRST_DAMPING)) * unit


def _scales(jacobian: Jacobian, start: np.ndarray) -> tuple[np.ndarray, float]:
    """Scale of each parameter (d,) and unit of the residuals: the largest column norm in the scaled parameters."""
    column_norm, size = np.linalg.norm(jacobian, axis=0), np.abs(start)
    strongest = np.max(column_norm * size)
    # With all starts at zero no scale exists, so every parameter counts as equally strong.
    step = SMALLEST_EFFECT * strongest if strongest > 0 else 1.0
    scale = np.maximum(size, np.divide(step, column_norm, out=np.zeros_like(size), where=column_norm > 0))
    # A parameter with zero start and zero effect does not change: any scale is valid.
    scale = np.where(scale > 0, scale, 1.0)
    unit = float(np.max(column_norm * scale))
    return scale, unit if unit > 0 else 1.0
