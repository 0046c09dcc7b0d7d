"""Nonlinear least squares from several starts, by derivatives or by differences."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import optimistix as optx

from capsule_id.console import stop_if_interrupted
from capsule_id.inference.curvature import (
    Jacobian,
    Residuals,
    column_space,
)
from capsule_id.inference.target import HEAVY, LogPosterior
from capsule_id.physics.batches import in_batches, pool
from capsule_id.precision import COMPILE, COMPILE_QUICKLY

# least squares: Nonlinear least squares from several starts, with the covariance of the parameters.
#
# Residuals r(x), (d,) -> (n,); cost ½ Σ r²; J = ∂r/∂x, (n, d). At the minimum the covariance of the parameters is
# σ² (JᵀJ)⁻¹ with σ² = Σ r² / (n − d) unless it is known (Seber & Wild, *Nonlinear Regression*, 1989, ch. 2).


#: A point (d,) -> residuals (n,) and their Jacobian (n, d).
Linearise = Callable[[np.ndarray], tuple[Residuals, Jacobian]]

#: Dimensionless. Smallest effect of a parameter on the residuals, relative to the strongest parameter, when it changes
#: by 100 % of its start. Below it the scale is the step with this effect: a start at zero defines no scale.
SMALLEST_EFFECT = 0.01
#: Largest distance of a converged end from a stationary point, in radii of the joint confidence region, dimensionless
#: (relative offset; Bates & Watts, *Technometrics* 23, 1981, 179).
LARGEST_OFFSET = 1e-3


@dataclass(frozen=True)
class LeastSquaresFit:
    """End point and convergence of each start.

    Attributes
    ----------
    x : (s, d) end points, units of the parameters
    cost : (s,) ½ Σ r², units of the residuals squared
    stalled : (s,) bool, no convergence: too many steps, non-finite values, or vanishing steps away from a stationary
        point
    residuals : (n,) at each end point
    jacobian : (n, d) of the residuals at each end point
    """

    x: np.ndarray
    cost: np.ndarray
    stalled: np.ndarray
    residuals: tuple[Any, ...]
    jacobian: tuple[Any, ...]


@dataclass(frozen=True)
class Solver:
    """Settings of the least-squares solver for each start.

    Attributes
    ----------
    tolerance : dimensionless; converged once a step changes every v_j and every divided residual by less than
        tolerance (1 + its size)
    max_steps : solver steps, rejected ones included, after which a start counts as stalled
    heavy : residuals take milliseconds, so the code is optimised and parameters are scaled by effect (Marquardt 1963)
    damping : of the first step beside the squared column norms of heavy residuals, dimensionless. Their parameters are
        strongly correlated: heavy damping would stop a start near the minimum as if it had converged
    """

    tolerance: float = 1e-9
    max_steps: int = 1024
    heavy: bool = False
    damping: float = 1e-6


#: Default solver settings.
SOLVER = Solver()


def least_squares(linearise: Linearise, starts: np.ndarray, solver: Solver = SOLVER) -> LeastSquaresFit:
    """Minimise ½ Σ r(x)² by Levenberg-Marquardt from every start.

    Residuals and Jacobian are one compiled program, and Optimistix' step is another. A program that held both would
    compile the residuals a second time, which takes longer than the fit.

    Damping and tolerance of Levenberg-Marquardt require parameters of comparable size. Each start is therefore solved
    in v_j = x_j / scale_j with scale_j = |start_j| (at zero: ``SMALLEST_EFFECT``). The residuals are divided by the
    largest column norm of the Jacobian in v at the start. The result depends on no units.

    Parameters
    ----------
    linearise : see ``Linearise``; threads call it
    starts : (s, d), units of the parameters
    solver : tolerance and scales of each start

    Raises
    ------
    ValueError
        If ``starts`` is not (s, d) with s ≥ 1, or not finite.
    """
    starts = np.asarray(starts, dtype=float)
    if starts.ndim != 2 or starts.size == 0 or not np.isfinite(starts).all():
        raise ValueError(f"starts must be (s, d) and finite, got shape {starts.shape}: give one row per start")
    descent = partial(_descend, linearise, solver=solver)
    # The first start compiles the programs that all threads then call. Many residuals would take the memory of each.
    first = descent(starts[0])
    ends = [first, *(map if len(first[1]) > HEAVY else pool().map)(descent, starts[1:])]
    x, residuals, jacobian, stalled = zip(*ends, strict=True)
    return LeastSquaresFit(
        np.stack(x), np.array([0.5 * np.sum(r**2) for r in residuals]), np.stack(stalled), residuals, jacobian
    )


def _descend(linearise: Linearise, start: np.ndarray, solver: Solver) -> tuple[np.ndarray, Residuals, Jacobian, bool]:
    """Where one start (d,) ended: x (d,), residuals (n,) and Jacobian (n, d) there, and whether it is no minimum."""
    residuals, jacobian = linearise(start)
    if not (np.isfinite(jacobian).all() and np.isfinite(residuals).all()):
        return start, residuals, jacobian, True
    scale, unit = _effects(jacobian, solver.damping) if solver.heavy else _scales(jacobian, start)
    method = optx.LevenbergMarquardt(rtol=solver.tolerance, atol=solver.tolerance, linear_solver=lx.QR())
    known, v = _Known(residuals / unit, jacobian * scale / unit), jnp.asarray(start / scale)
    state, steps, converged = _FIRST(method, known, v), 0, False
    while not converged and steps < solver.max_steps:
        stop_if_interrupted()
        v, state, trial, converged = _STEP(method, known, v, state)
        steps += 1
        # A move that vanishes in rounding never converges.
        if np.array_equal(trial, v):
            break
        at_trial, slopes = linearise(np.asarray(trial) * scale)
        with np.errstate(over="ignore", invalid="ignore"):
            known = _Known(at_trial / unit, slopes * scale / unit)
        if not (np.isfinite(known.jacobian).all() and np.isfinite(known.residuals).all()):
            # Infinite residuals make the solver reject the trial.
            known = _Known(np.full_like(at_trial, np.inf), np.zeros_like(slopes))
    x = np.asarray(v) * scale
    residuals, jacobian = linearise(x)
    # The solver tests step sizes only, and heavy damping makes steps small far from a minimum.
    short = not converged and steps == solver.max_steps
    return x, residuals, jacobian, short or not _stationary(jacobian, residuals, solver.tolerance * unit)


class _Known(eqx.Module):
    """Residuals (n,) whose value and Jacobian (n, d) are known at the only point where a solver's step asks for them."""

    residuals: Any
    jacobian: Any

    def __call__(self, v: jax.Array, args: None) -> tuple[jax.Array, None]:
        value = jax.custom_jvp(lambda v: self.residuals + jnp.zeros_like(self.residuals, shape=()) * v[0])
        value.defjvp(lambda primals, tangents: (self.residuals, self.jacobian @ tangents[0]))
        return value(v), None


def _state(method: optx.LevenbergMarquardt, known: _Known, v: jax.Array) -> Any:
    """First state of the solver: arrays, and descriptions of functions that are new in every trace."""
    return method.init(known, v, None, {}, jax.eval_shape(lambda: known.residuals), None, frozenset())


def _first(method: optx.LevenbergMarquardt, known: _Known, v: jax.Array) -> list[jax.Array]:
    """Arrays of the first state."""
    return jax.tree.leaves(eqx.filter(_state(method, known, v), eqx.is_array))


def _step(
    method: optx.LevenbergMarquardt, known: _Known, v: jax.Array, state: list[jax.Array]
) -> tuple[jax.Array, list[jax.Array], jax.Array, jax.Array]:
    """One step: return v, the arrays of the state, the next trial and whether v is the minimum."""
    arrays, rest = eqx.partition(_state(method, known, v), eqx.is_array)
    whole = eqx.combine(jax.tree.unflatten(jax.tree.structure(arrays), state), rest)
    v, whole, _ = method.step(known, v, None, {}, whole, frozenset())
    converged, _ = method.terminate(known, v, None, {}, whole, frozenset())
    return v, jax.tree.leaves(eqx.filter(whole, eqx.is_array)), whole.y_eval, converged


def _stationary(jacobian: Jacobian, residuals: Residuals, rounding: float) -> bool:
    """Whether the residuals (n,) projected on the range of J (n, d) are small against the rest or ``rounding``."""
    if not np.isfinite(jacobian).all():
        return False
    left = column_space(jacobian)[0]
    tangential = float(np.linalg.norm(left.T @ residuals))
    normal = float(np.linalg.norm(residuals - left @ (left.T @ residuals)))
    freedom = max(len(residuals) - left.shape[1], 1)
    # Bates & Watts divide both parts by their degrees of freedom.
    radius = normal * np.sqrt(max(left.shape[1], 1) / freedom)
    return tangential <= max(LARGEST_OFFSET * radius, rounding)


def linearised(target: LogPosterior, u: np.ndarray, x: np.ndarray | None = None) -> tuple[Residuals, Jacobian]:
    """Residuals (n,) of ``target`` at u (d,) and their Jacobian (n, l) with respect to its located entries.

    x : (l,) located entries in the place of those of u

    Where residuals have kinks, the derivatives are differences.
    """
    moved, located = u.copy(), target.located
    if x is not None:
        moved[located] = x
    if target.kinked:
        step = DIFFERENCE * np.where(target.positive, 1.0, target.prior_sd)[located]
        points = np.repeat(moved[None], len(located) + 1, axis=0)
        points[1:, located] += np.diag(step)
        residuals = in_batches(partial(rows_of, target), points, ROWS)
        return residuals[0], (residuals[1:] - residuals[0]).T / step
    # Where an evaluation takes long, it takes five times as long without XLA's optimisation.
    heavy = target.work >= HEAVY or any(e.event_driven for e in target.experiments)
    residuals, jacobian = _PROGRAMS[heavy](target, jnp.asarray(moved))
    return np.asarray(residuals), np.asarray(jacobian)


#: Compiled first state and step of the solver.
_FIRST, _STEP = (
    eqx.filter_jit(function, compiler_options=dict(COMPILE_QUICKLY))  # pyright: ignore[reportCallIssue]
    for function in (_first, _step)
)
#: Compiled ``LogPosterior.linearised``, indexed by whether the residuals are heavy.
_PROGRAMS: dict[bool, Callable[..., Any]] = {
    heavy: jax.jit(LogPosterior.linearised, compiler_options=dict(options))
    for heavy, options in ((True, COMPILE), (False, COMPILE_QUICKLY))
}


def _effects(jacobian: Jacobian, damping: float) -> tuple[np.ndarray, float]:
    """Scale as ``_scales`` does, but give every column of the Jacobian the same norm, the unit of the residuals."""
    column_norm = np.linalg.norm(jacobian, axis=0)
    unit = float(np.max(column_norm)) or 1.0
    scale = np.where(column_norm > 0, unit / np.where(column_norm > 0, column_norm, 1.0), 1.0)
    # The solver's initial damping is 1. Larger residual units reduce its effect by their square.
    return scale, float(np.sqrt(damping)) * unit


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


# Residuals with kinks: derivatives at a point say little about a motion that sticks a step later on its other side.
# Differences over a finite step smooth the kinks, and a batch computes the residuals of all of them.


#: Rows of a batch of residuals.
ROWS = 8
#: Step of the differences: relative, or part of the prior's sd where u is not a logarithm.
DIFFERENCE = 2e-3
#: Solver settings. Where derivatives change within a step, a light first damping leads to a wrong maximum.
KINKED = Solver(tolerance=3e-3, max_steps=20, heavy=True, damping=1e-3)


@partial(jax.jit, compiler_options=COMPILE)
def rows_of(target: LogPosterior, u: jax.Array) -> jax.Array:
    """(m, n) residuals at u (m, d)."""
    return jax.vmap(target.residuals)(u)
