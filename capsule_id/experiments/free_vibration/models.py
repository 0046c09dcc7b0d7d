"""Forward models of free decays with viscous, dry and quadratic damping in any sum, and a linear or cubic spring."""

from collections.abc import Mapping
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.integrate import RK45

from capsule_id.parameters import ROUNDING, SAME
from capsule_id.rig.filters import largest_offset

# m1 x'' + c x' + F_dry sign(x') + c_q x'|x'| + k1 x + k_cubic x^3 = 0, capsule at rest, x = x_rel about its
# equilibrium.
# With viscous damping and a linear spring the solution is closed at every damping: gamma = c/(2 m1), omega_0^2 = k1/m1,
# omega^2 = omega_0^2 - gamma^2, negative beyond critical damping. Other forces need an underdamped decay.
#
# Moments of a uniformly sampled underdamped one take O(sqrt(n)) transcendental functions and equal sums up to
# rounding: the solutions at t_j = j h are the real and the imaginary part of z^j, z = exp((-gamma + i omega) h).
# Their sums and products are geometric series. The polynomial sum_j y_j z^j is evaluated with j = B a + b (baby-
# step giant-step). This needs one matrix product instead of n complex exponentials.


#: Steps of SciPy's Runge–Kutta formula (Dormand and Prince, order 5) per half cycle, and of a decay that may have more
#: half cycles than ``LONG``, each of which changes it little. Errors relative to the amplitude (tested): x_rel 1e-8,
#: velocity 1e-7 omega, acceleration 5e-6 omega^2; of a long decay x_rel 2e-6. A formula of higher order would not lower
#: them: the polynomials between the nodes set them.
STEPS, FEWER_STEPS, LONG = 24, 8, 100
#: Slows the phase's velocity where quadratic damping takes most of the amplitude in a half cycle, dimensionless.
STRETCH = 0.35
#: Newton steps for the rest position of a half cycle. A linear spring needs none.
NEWTON_STEPS = 3


class Motion(NamedTuple):
    """x_rel, m, its rate, m/s, and its acceleration, m/s^2; (n,) each."""

    x_rel: Any
    velocity: Any
    acceleration: Any


def rates(k1: Any, c: Any, m1: Any) -> tuple[Any, Any]:
    """Decay rate gamma, 1/s, and frequency omega, rad/s (NaN where overdamped)."""
    gamma = c / (2.0 * m1)
    return gamma, jnp.sqrt(k1 / m1 - gamma**2)


class HalfCycles(NamedTuple):
    """Turning points and nodes of a decay; half cycle j moves away from turning point j.

    Positions are positive on the side of the half cycle's turning point.

    Attributes
    ----------
    times, amplitudes : (half_cycles,) s and m, of the turning points
    node_times, positions, velocities, accelerations : (half_cycles, steps + 1), both ends of the half cycle included
    """

    times: Any
    amplitudes: Any
    node_times: Any
    positions: Any
    velocities: Any
    accelerations: Any


def most_half_cycles(duration: float, omega: float) -> int:
    """Bound on the half cycles of a decay: a quarter more than at its rough frequency ``omega``, rad/s, and at most 50 more."""
    number = omega * duration / np.pi
    return int(number + min(0.25 * number, 50.0)) + 5


def steps_of(number: int) -> int:
    """Runge–Kutta steps in each of so many half cycles."""
    return FEWER_STEPS if number > LONG else STEPS


@partial(jax.jit, static_argnames=("number", "steps"))
def half_cycles(
    theta: Mapping[str, Any], amplitude: Any, turning_time: Any, number: int, steps: int | None = None
) -> HalfCycles:
    """Integrate ``number`` half cycles from the turning point ``amplitude`` (m, positive) at ``turning_time`` (s).

    Each takes ``steps`` steps (default: ``steps_of``). Within it dry friction is constant, so the motion is smooth. With
    x = rest + r cos(phi) and x' = -stretch omega r sin(phi) the half cycle is phi = 0 .. pi exactly. r and the time are
    integrated over phi, so no turning point is searched for. The stretch keeps phi increasing under strong quadratic
    damping. NaN where phi turns back (overdamped).
    """
    k1, c, m1 = theta["k1"], theta["c"], theta["m1"]
    F_dry, c_q, k_cubic = (theta.get(name, 0.0) for name in ("F_dry", "c_q", "k_cubic"))
    omega, rest = jnp.sqrt(k1 / m1), F_dry / k1
    for _ in range(NEWTON_STEPS if "k_cubic" in theta else 0):
        rest = rest - (k1 * rest + k_cubic * rest**3 - F_dry) / (k1 + 3.0 * k_cubic * rest**2)
    steps = steps or steps_of(number)
    width = np.pi / steps

    def slope(r: Any, cosine: Any, sine: Any, stretch: Any) -> tuple[Any, Any]:
        # Acceleration besides that of the linear spring, over stretch omega r.
        extra = k_cubic * cosine * (3.0 * rest * (rest + r * cosine) + (r * cosine) ** 2) / (m1 * stretch * omega)
        extra = extra - sine * (c + c_q * stretch * omega * r * sine) / m1
        rate = omega * (stretch * sine**2 + cosine**2 / stretch) + extra * cosine
        rate = jnp.where(rate > 0.0, rate, jnp.nan)
        return r * sine * ((1.0 / stretch - stretch) * omega * cosine + extra) / rate, 1.0 / rate  # pyright: ignore[reportOperatorIssue]

    def step(state: tuple[Any, Any, Any], at: Any) -> tuple[tuple[Any, Any, Any], tuple[Any, Any]]:
        r, t, stretch = state
        slopes: list[tuple[Any, Any]] = []
        for weights, cosine, sine in zip(RK45.A, *at, strict=True):
            moved = r + width * sum(w * own for w, (own, _) in zip(weights, slopes, strict=False) if w)
            slopes.append(slope(moved, cosine, sine, stretch))
        r, t = (
            z + width * sum(w * own for w, own in zip(RK45.B, each, strict=True))
            for z, each in zip((r, t), zip(*slopes, strict=True), strict=True)
        )
        return (r, t, stretch), (r, t)

    stages = width * (np.arange(steps)[:, None] + RK45.C)
    trigonometry = jnp.asarray(np.cos(stages)), jnp.asarray(np.sin(stages))

    def half(state: tuple[Any, Any], _: None) -> tuple[tuple[Any, Any], tuple[Any, ...]]:
        start, a = state
        moves = a > rest
        r = jnp.where(moves, a - rest, amplitude)
        first = r, start, 1.0 / jnp.sqrt(1.0 + (STRETCH * c_q * r / m1) ** 2)
        r, t = jax.lax.scan(step, first, trigonometry)[1]
        r, t = jnp.append(first[0], r), jnp.append(start, t)
        t = jnp.where(moves, t, start + np.pi / omega * np.linspace(0.0, 1.0, steps + 1))
        # A stuck rod keeps its position; the next half cycle counts it from the other side.
        end = jnp.where(moves, r[-1] - rest, -a)
        return (t[-1], end), (start, a, jnp.where(moves, r, 0.0), t, first[2])

    release = jnp.asarray(turning_time, dtype=float), jnp.asarray(amplitude, dtype=float)
    _, (times, amplitudes, r, t, stretch) = jax.lax.scan(half, release, None, length=number)
    nodes = width * np.arange(steps + 1)[None]
    x = jnp.where(r > 0.0, rest + r * np.cos(nodes), amplitudes[:, None])
    y = -stretch[:, None] * omega * r * np.sin(nodes)
    pull = k1 * x + k_cubic * x**3 - F_dry + c * y - c_q * y**2
    return HalfCycles(times, amplitudes, t, x, y, jnp.where(r > 0.0, -pull / m1, 0.0))


@partial(jax.jit, static_argnames="number")
def decay(time: Any, theta: Mapping[str, Any], amplitude: Any, turning_time: Any, number: int) -> Motion:
    """Decay from a turning point, at the sample times.

    Parameters
    ----------
    time : (n,) s; samples before ``turning_time`` continue the first polynomial
    theta : k1, c, m1 and, where they act, F_dry, c_q, k_cubic; SI
    amplitude : x_rel at the turning point at ``turning_time``, m, positive
    number : bound on the half cycles covered by ``time``
    """
    return interpolate(half_cycles(theta, amplitude, turning_time, number), time)


def interpolate(path: HalfCycles, time: Any) -> Motion:
    """Motion at the sample times (n,), s.

    Between nodes x_rel is the polynomial of degree 5 with position, velocity and acceleration of both nodes. Samples
    before the first turning point continue the first polynomial.
    """
    number = path.times.shape[0]
    steps = path.node_times.shape[1] - 1
    node = jnp.clip(jnp.searchsorted(path.node_times[:, :-1].ravel(), time, side="right") - 1, 0, number * steps - 1)
    half, left = node // steps, node % steps
    t, t_next, x, x_next, y, y_next, a, a_next = (values[half, at] for values in path[2:] for at in (left, left + 1))
    h = t_next - t
    s = (time - t) / h
    y, y_next, a, a_next = h * y, h * y_next, h**2 * a, h**2 * a_next
    # Remainders of the left node's parabola at the right node fix the terms of degree 3 to 5.
    p, q, w = x_next - x - y - 0.5 * a, y_next - y - a, a_next - a
    d, e, f = 10.0 * p - 4.0 * q + 0.5 * w, -15.0 * p + 7.0 * q - w, 6.0 * p - 3.0 * q + 0.5 * w
    position = x + s * (y + s * (0.5 * a + s * (d + s * (e + s * f))))
    velocity = (y + s * (a + s * (3.0 * d + s * (4.0 * e + s * 5.0 * f)))) / h
    acceleration = (a + s * (6.0 * d + s * (12.0 * e + s * 20.0 * f))) / h**2
    side = jnp.where(half % 2 == 0, 1.0, -1.0)
    return Motion(side * position, side * velocity, side * acceleration)


def fold(values: np.ndarray) -> np.ndarray:
    """Reshape the record (n,) to (giant, baby), rows of about sqrt(n); the last row is padded with zeros."""
    baby = max(int(np.sqrt(len(values))), 1)
    giant = -(-len(values) // baby)
    return np.pad(values, (0, baby * giant - len(values))).reshape(giant, baby)


def decay_moments(folded: Any, n: int, step: Any, gamma: Any, omega: Any) -> tuple[Any, Any, Any]:
    """Moments y'y (), A'y (3,) and A'A (3, 3) for A = [``viscous_basis``, 1] at t_j = j h, j = 0 .. n-1.

    Parameters
    ----------
    folded : (giant, baby) of ``fold``
    step : h, s
    gamma, omega : 1/s and rad/s
    """
    giant, baby = folded.shape
    rate = (-gamma + 1j * omega) * step
    inner = jnp.exp(rate * jnp.arange(baby))
    outer = jnp.exp(rate * baby * jnp.arange(giant))
    rows = folded @ jnp.stack([inner.real, inner.imag], axis=-1)
    projection = jnp.sum(outer * (rows[:, 0] + 1j * rows[:, 1]))
    # Sums of exp(q j) over j = 0 .. n-1.
    plain, squared, modulus = (jnp.expm1(q * n) / jnp.expm1(q) for q in (rate, 2.0 * rate, -2.0 * gamma * step))
    cc, ss, cs = 0.5 * (modulus + squared.real), 0.5 * (modulus - squared.real), 0.5 * squared.imag
    aa = jnp.array([[cc, cs, plain.real], [cs, ss, plain.imag], [plain.real, plain.imag, n]])
    ay = jnp.array([projection.real, projection.imag, jnp.sum(folded)])
    struck = jnp.sqrt(gamma**2 + omega**2) / omega
    basis = jnp.array([[1.0, 0.0, 0.0], [gamma / omega, struck, 0.0], [0.0, 0.0, 1.0]])
    return jnp.sum(folded**2), ay @ basis, basis.T @ aa @ basis


def uniform_step(time: np.ndarray) -> float | None:
    """Sampling step, s, where every sample lies on the grid up to rounding of its own and of the file; else None."""
    step = float((time[-1] - time[0]) / (len(time) - 1))
    return step if largest_offset(time, step) < SAME * step + ROUNDING else None
