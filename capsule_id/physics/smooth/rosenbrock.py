"""One step of RODAS3, the solver of the smoothed model: state, linear algebra, error estimate, step control.

Why this method. The smoothed friction relaxes at the rate F_b / (m2 velocity): 8e3 to 8e5 1/s against 1e2 1/s of the
rod, so an explicit step is limited by stability while the capsule rests. A Rosenbrock method needs no Newton iteration
(whose stopping rule would also be differentiated), its Jacobian is exact (forward mode through the field), and after
X1 and X2 are eliminated by hand each stage solves two equations. Measured on the reference cases at equal bias of the
mean velocity, steps x field evaluations: RODAS3 2100 x 3, ROS2 3700 x 2, ROS4 2700 x 3, RODAS4 2000 x 6.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp

StateArray = jax.Array  # (4, L): X1, Y1, X2, Y2 of L lanes, m and m/s
# (t, r, Y1, Y2) -> (Y1', X2', Y2'): the field depends on the positions through r = X1 - X2 alone, and X1' = Y1.
Field = Callable[[jax.Array, jax.Array, jax.Array, jax.Array], tuple[jax.Array, jax.Array, jax.Array]]

# RODAS3: order of the method, and the coefficient of the Jacobian in each stage.
_METHOD_ORDER, _GAMMA = 3, 0.5
# Step control, the usual constants: aim 10 % below the tolerance; no change beyond these factors.
_SAFETY, _SHRINK, _GROW = 0.9, 0.2, 5.0


def derivative(field: Field, t: jax.Array, y: StateArray) -> StateArray:
    """dy/dt, (4, L)."""
    Y1_rate, X2_rate, Y2_rate = field(t, y[0] - y[2], y[1], y[3])
    return jnp.stack([y[1], Y1_rate, X2_rate, Y2_rate])


def _stage_solver(
    field: Field, t: jax.Array, y: StateArray, h: jax.Array
) -> tuple[Callable[[StateArray], StateArray], StateArray]:
    """Solver of (1 / (gamma h) - J) u = b with the exact Jacobian J at (t, y), and the partial derivative in time."""
    at = (t, y[0] - y[2], y[1], y[3])
    directions = tuple(jnp.broadcast_to(row[:, None], (4, *t.shape)) for row in jnp.eye(4))
    a, q, b = jax.vmap(lambda *d: jax.jvp(field, at, d)[1])(*directions)
    (a_t, a_r, a_1, a_2), (q_t, q_r, q_1, q_2), (b_t, b_r, b_1, b_2) = a, q, b
    d = 1.0 / (_GAMMA * h)
    # u_r = u_X1 - u_X2 from its own row, then two equations for (u_Y1, u_Y2).
    r_inverse = 1.0 / (d + q_r)
    r_1, r_2 = (1.0 - q_1) * r_inverse, -q_2 * r_inverse
    m11, m12 = d - a_1 - a_r * r_1, -a_2 - a_r * r_2
    m21, m22 = -b_1 - b_r * r_1, d - b_2 - b_r * r_2
    determinant = m11 * m22 - m12 * m21

    def solve(b: StateArray) -> StateArray:
        r_0 = (b[0] - b[2]) * r_inverse
        c1, c2 = b[1] + a_r * r_0, b[3] + b_r * r_0
        u1, u2 = (m22 * c1 - m12 * c2) / determinant, (m11 * c2 - m21 * c1) / determinant
        r = r_0 + r_1 * u1 + r_2 * u2
        return jnp.stack([(b[0] + u1) / d, u1, (b[2] + q_r * r + q_1 * u1 + q_2 * u2) / d, u2])

    return solve, jnp.stack([jnp.zeros_like(t), a_t, q_t, b_t])


def step(field: Field, t: jax.Array, y: StateArray, h: jax.Array) -> tuple[StateArray, StateArray]:
    """State at t + h and its error estimate, (4, L) each.

    RODAS3 (Sandu et al. 1997, "Benchmarking stiff ODE solvers for atmospheric chemistry problems II"): four stages,
    three evaluations of the field, order 3 with an embedded method of order 2, both stiffly accurate and L-stable:
    what relaxes faster than a step is damped to nothing, not reflected.
    """
    solve, f_t = _stage_solver(field, t, y, h)
    f = derivative(field, t, y)
    per_state = h[None]
    i = 1.0 / per_state
    u1 = solve(f + 0.5 * per_state * f_t)
    u2 = solve(f + 1.5 * per_state * f_t + 4.0 * i * u1)
    y3 = y + 2.0 * u1
    u3 = solve(derivative(field, t + h, y3) + i * (u1 - u2))
    y4 = y3 + u3
    u4 = solve(derivative(field, t + h, y4) + i * (u1 - u2 - (8.0 / 3.0) * u3))
    return y4 + u4, u4


def step_factor(error: jax.Array) -> jax.Array:
    """By what the step length changes after a step of this error in units of the tolerance; not finite: shrink."""
    factor = _SAFETY * jnp.maximum(error, (_SAFETY / _GROW) ** _METHOD_ORDER) ** (-1.0 / _METHOD_ORDER)
    return jnp.where(jnp.isfinite(error), jnp.maximum(factor, _SHRINK), _SHRINK)
