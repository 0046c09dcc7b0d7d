"""Nonlinear least squares from several starts, with the covariance of the parameters.

Residuals r(x), (d,) -> (n,); cost ½ Σ r²; J = ∂r/∂x, (n, d). At the minimum the covariance of the parameters is
σ² (JᵀJ)⁻¹ with σ² = Σ r² / (n − d) unless it is known (Seber & Wild, *Nonlinear Regression*, 1989, ch. 2).
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import optimistix as optx

from capsule_id.inference.fit.covariance import Covariance, Jacobian, Residuals, all_finite, column_space, covariance
from capsule_id.inference.target.compiling import COMPILE, COMPILE_QUICKLY
from capsule_id.precision import require_float64

require_float64()

Residual = Callable[[jax.Array], jax.Array]
#: Points (s, d) -> residuals (s, n) and their Jacobians (s, n, d).
Linearise = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]

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
    normal_equations : solve each step by Cholesky of J'J instead of QR of J: half the digits, but a hundred times as
        fast for thousands of residuals
    heavy : residuals take milliseconds, so the code is optimised and parameters are scaled by effect (Marquardt 1963)
    """

    tolerance: float = 1e-9
    max_steps: int = 1024
    normal_equations: bool = False
    heavy: bool = False


#: Default solver settings.
SOLVER = Solver()


def least_squares(
    residual: Residual, starts: np.ndarray, solver: Solver = SOLVER, linearise: Linearise | None = None
) -> LeastSquaresFit:
    """Minimise ½ Σ r(x)² by Levenberg-Marquardt, forward-mode Jacobian, compiled once for all starts.

    Damping and tolerance of Levenberg-Marquardt require parameters of comparable size. Each start is therefore solved
    in v_j = x_j / scale_j with scale_j = |start_j| (at zero: ``SMALLEST_EFFECT``). The residuals are divided by the
    largest column norm of the Jacobian in v at the start. The result depends on no units.

    Parameters
    ----------
    residual : (d,) -> (n,), a JAX function; it may close over arrays. A ``jax.tree_util.Partial`` or ``equinox.Module``
        passes its arrays as arguments: other values of the same shapes then need no new compilation
    starts : (s, d), units of the parameters
    solver : tolerance and linear algebra of each start
    linearise : residuals and Jacobians for scaling the starts and testing convergence; None compiles forward-mode
        differentiation for them

    Raises
    ------
    ValueError
        If ``starts`` is not (s, d) with s ≥ 1, or not finite.
    """
    starts = np.asarray(starts, dtype=float)
    if starts.ndim != 2 or starts.size == 0 or not np.isfinite(starts).all():
        raise ValueError(f"starts must be (s, d) and finite, got shape {starts.shape}: give one row per start")
    linearise = linearise or partial(_forward_mode, residual, solver.heavy)
    scale, unit = zip(*map(_effects if solver.heavy else _scales, linearise(starts)[1], starts), strict=True)
    solve = partial(_PROGRAMS[solver.heavy][1], residual, solver)
    # A batched solver takes twice as long to compile and saves only milliseconds, so starts run one by one.
    arguments = (map(jnp.asarray, one) for one in zip(starts, scale, unit, strict=True))
    ends, steps, results = zip(*(solve(*one) for one in arguments), strict=True)
    x, steps = np.stack(ends), np.array(steps, dtype=int)
    residuals, jacobian = linearise(x)
    rounding = [solver.tolerance * one for one in unit]
    message = [_reason(*one) for one in zip(results, jacobian, residuals, rounding, strict=True)]
    return LeastSquaresFit(
        x=x,
        cost=0.5 * np.sum(residuals**2, axis=1),
        stalled=np.array([reason != "" for reason in message]),
        steps=steps,
        message=tuple(message),
        residuals=residuals,
        jacobian=jacobian,
    )


def _reason(result: optx.RESULTS, jacobian: Jacobian, residuals: Residuals, rounding: float) -> str:
    """Reason why an end point is not a minimum; "" where it is one."""
    reason = optx.RESULTS[result]
    if not all_finite(jacobian, residuals):
        return "The residuals or their Jacobian are not finite where this start ended: try another start."
    # The solver tests step sizes only, and heavy damping makes steps small far from a minimum.
    if not reason and not _stationary(jacobian, residuals, rounding):
        return "The steps became tiny before the residuals were orthogonal to the Jacobian: try another start."
    return reason


def _stationary(jacobian: Jacobian, residuals: Residuals, rounding: float) -> bool:
    """Whether the residuals (n,) projected on the range of J (n, d) are small against the rest or ``rounding``."""
    left = column_space(jacobian)[0]
    tangential = float(np.linalg.norm(left.T @ residuals))
    normal = float(np.linalg.norm(residuals - left @ (left.T @ residuals)))
    freedom = max(len(residuals) - left.shape[1], 1)
    # Bates & Watts divide both parts by their degrees of freedom.
    radius = normal * np.sqrt(max(left.shape[1], 1) / freedom)
    return tangential <= max(LARGEST_OFFSET * radius, rounding)


def _forward_mode(residual: Residual, heavy: bool, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Residuals (s, n) and Jacobians (s, n, d) at points (s, d)."""
    parts = [_PROGRAMS[heavy][0](residual, point) for point in jnp.asarray(points)]
    residuals, jacobians = (np.stack(part) for part in zip(*parts, strict=True))
    return residuals, jacobians


def linearised(residual: Residual, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Residuals (n,) and Jacobian (n, d) of heavy residuals at x (d,)."""
    residuals, jacobians = _forward_mode(residual, True, x[None])
    return residuals[0], jacobians[0]


def _linearise(residual: Residual, x: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Residuals (n,) and Jacobian (n, d) at x (d,), in one pass."""

    def twice(x: jax.Array) -> tuple[jax.Array, jax.Array]:
        value = residual(x)
        return value, value

    jacobian, value = jax.jacfwd(twice, has_aux=True)(x)
    return value, jacobian


def _solve(
    residual: Residual, solver: Solver, start: jax.Array, scale: jax.Array, unit: jax.Array
) -> tuple[jax.Array, jax.Array, optx.RESULTS]:
    """Solve from one start (d,): return x (d,), steps and result code."""
    function = _with_jacobian(lambda v: residual(v * scale) / unit)
    solution = optx.least_squares(
        lambda v, _: function(v),
        optx.LevenbergMarquardt(
            rtol=solver.tolerance,
            atol=solver.tolerance,
            linear_solver=lx.Normal(lx.Cholesky()) if solver.normal_equations else lx.QR(),
        ),
        start / scale,
        max_steps=solver.max_steps,
        throw=False,
    )
    return solution.value * scale, solution.stats["num_steps"], solution.result


def _with_jacobian(function: Residual) -> Residual:
    """Return ``function`` with a tangent rule that computes value and full Jacobian in one pass.

    The solver linearises and then evaluates every column. This rule compiles a third faster than transposition.
    An event-driven run is a loop of unknown length and cannot be transposed.
    """
    wrapped = jax.custom_jvp(function)

    @wrapped.defjvp
    def _(primals: tuple[jax.Array], tangents: tuple[jax.Array]) -> tuple[jax.Array, jax.Array]:
        value, jacobian = _linearise(function, *primals)
        return value, jacobian @ tangents[0]

    return wrapped


def _compiled(function: Callable[..., Any], options: Mapping[str, object]) -> Callable[..., Any]:
    # Equinox passes the options to jax.jit, but its annotations omit them.
    return eqx.filter_jit(function, compiler_options=dict(options))  # pyright: ignore[reportCallIssue]


#: Compiled (linearise, solve), indexed by whether the residuals are heavy.
_PROGRAMS = {
    heavy: tuple(_compiled(function, COMPILE if heavy else COMPILE_QUICKLY) for function in (_linearise, _solve))
    for heavy in (False, True)
}


def _effects(jacobian: Jacobian, start: np.ndarray) -> tuple[np.ndarray, float]:
    """Scale as ``_scales`` does, but give every column of the Jacobian the same norm, the unit of the residuals."""
    column_norm = np.linalg.norm(jacobian, axis=0)
    column_norm = np.where(np.isfinite(column_norm), column_norm, 0.0)
    unit = float(np.max(column_norm)) or 1.0
    scale = np.where(column_norm > 0, unit / np.where(column_norm > 0, column_norm, 1.0), np.ones_like(start))
    # The solver's initial damping is 1. Larger residual units reduce its effect by their square.
    return scale, float(np.sqrt(FIRST_DAMPING)) * unit


def _scales(jacobian: Jacobian, start: np.ndarray) -> tuple[np.ndarray, float]:
    """Scale of each parameter (d,) and unit of the residuals: the largest column norm in the scaled parameters."""
    column_norm, size = np.linalg.norm(jacobian, axis=0), np.abs(start)
    # The solver reports values that are not finite.
    column_norm = np.where(np.isfinite(column_norm), column_norm, 0.0)
    strongest = np.max(column_norm * size)
    # With all starts at zero no scale exists, so every parameter counts as equally strong.
    step = SMALLEST_EFFECT * strongest if strongest > 0 else 1.0
    scale = np.maximum(size, np.divide(step, column_norm, out=np.zeros_like(size), where=column_norm > 0))
    # A parameter with zero start and zero effect does not change: any scale is valid.
    scale = np.where(scale > 0, scale, 1.0)
    unit = float(np.max(column_norm * scale))
    return scale, unit if unit > 0 else 1.0
