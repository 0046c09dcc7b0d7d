"""Misfit between readings and model, with linear nuisances integrated out in closed form."""

from dataclasses import dataclass
from types import ModuleType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

# linear: Integration of linear nuisances of a Gaussian likelihood in closed form.
#
# Model, in units of the noise: y = A b + e, e ~ N(0, I), b ~ N(0, I) (the prior's widths are absorbed in A). Then
# y ~ N(0, I + A A'), and only the moments y'y, A'y, A'A are needed (matrix inversion and determinant lemmas).


#: sd of the normal prior of a linear nuisance relative to the range of its record, dimensionless; wide but proper.
NUISANCE_WIDTH = 10.0
#: From this number of nuisances on they are eliminated in a loop, not step by step.
MANY_NUISANCES = 8
#: Largest number of readings that are summed one by one at every scatter; variances that stand for those of more readings;
#: smallest ratio of two of them.
MANY_READINGS, VARIANCES, LEAST_RATIO = 256, 24, 1e-8
#: log(2 pi), from the normalisation of a normal density.
LOG_2PI = float(np.log(2.0 * np.pi))


def marginal_log_density(yy: Any, ay: Any, aa: Any, n: Any, xp: ModuleType = jnp) -> Any:
    """log N(y; 0, I + A A') from the moments, (...).

    Explicit elimination is efficient for few nuisances and works for any number of leading axes.

    Parameters
    ----------
    yy : (...) y'y
    ay : (..., p) A'y
    aa : (..., p, p) A'A
    n : length of y, (...) or one for all
    """
    if aa.shape[-1] > MANY_NUISANCES:
        mean, log_det = conditional_mean(ay, aa, xp)
        return -0.5 * (n * LOG_2PI + log_det + yy - xp.sum(ay * mean, axis=-1))
    rest, rows, log_det = yy, xp.broadcast_to(xp.eye(aa.shape[-1]), aa.shape) + aa, 0.0
    while rows.shape[-1]:
        # Every pivot is 1 or more; of readings without noise, rounding may leave less.
        pivot, first = xp.where(rows[..., 0, 0] < 1.0, 1.0, rows[..., 0, 0]), rows[..., 0, 1:]
        log_det, rest = log_det + xp.log(pivot), rest - ay[..., 0] ** 2 / pivot
        ratio = first / pivot[..., None]
        ay = ay[..., 1:] - ratio * ay[..., :1]
        rows = rows[..., 1:, 1:] - ratio[..., :, None] * first[..., None, :]
    return -0.5 * (n * LOG_2PI + log_det + rest)


def conditional_mean(ay: Any, aa: Any, xp: ModuleType = jnp) -> tuple[Any, Any]:
    """Mean of b given y, (I + A'A)^-1 A'y (..., p), and log det (I + A'A) (...), by elimination in a loop.

    XLA's calls of LAPACK from two threads at once may wait for each other for ever (JAX 0.11, compiled loops).
    """
    size, matrix = aa.shape[-1], xp.broadcast_to(xp.eye(aa.shape[-1]), aa.shape) + aa
    if xp is np:
        try:
            return np.linalg.solve(matrix, ay[..., None])[..., 0], np.linalg.slogdet(matrix)[1]
        except np.linalg.LinAlgError:  # readings without noise: rounding takes the identity, the pivots below keep it
            mean, log_det = conditional_mean(jnp.asarray(ay), jnp.asarray(aa))
            return np.asarray(mean), np.asarray(log_det)

    def eliminate(k: Any, carry: tuple[Any, Any]) -> tuple[Any, Any]:
        rows, log_det = carry
        row, column = (jax.lax.dynamic_index_in_dim(rows, k, axis=axis, keepdims=True) for axis in (-2, -1))
        # Every pivot is 1 or more; of readings without noise, rounding may leave less.
        pivot = jnp.maximum(jax.lax.dynamic_index_in_dim(row, k, axis=-1, keepdims=True), 1.0)
        own = jnp.reshape(jnp.arange(size) == k, (*(1,) * (rows.ndim - 2), size, 1))
        rows = jnp.where(own, row / pivot, rows - column * (row / pivot))
        return rows, log_det + jnp.log(pivot[..., 0, 0])

    start = jnp.concatenate([matrix, ay[..., None]], axis=-1), jnp.zeros(ay.shape[:-1])
    rows, log_det = jax.lax.fori_loop(0, size, eliminate, start)
    return rows[..., -1], log_det


def conditional_draw(ay: np.ndarray, aa: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """One draw of b given y, (p,)."""
    precision = np.eye(len(aa)) + aa
    normal = rng.standard_normal(len(aa))
    try:
        return np.linalg.solve(precision, ay) + np.linalg.solve(np.linalg.cholesky(precision).T, normal)
    except np.linalg.LinAlgError:  # readings without noise: rounding hides that every eigenvalue is 1 or more
        values, vectors = np.linalg.eigh(precision)
        values = np.maximum(values, 1.0)
        return vectors @ ((vectors.T @ ay) / values + normal / np.sqrt(values))


# misfit: Misfit between readings and model, and the density of readings as a function of one scatter.
#
# The forward model is evaluated once, because a scatter only changes standard deviations. The density at many values of
# the scatter therefore takes little more time than at one.


@dataclass(frozen=True)
class ScaledMisfit:
    """A misfit at one value of its scatter, or at several, (...).

    Attributes
    ----------
    raw : (..., n) measured minus predicted
    sd : (..., n) its standard deviation
    design : (n, p) effect of the linear nuisances, each scaled to a standard normal prior
    log_measure : (..., n) contribution of an integrated true abscissa to the log-density of each reading
    """

    raw: Any
    sd: Any
    design: Any
    log_measure: Any

    def moments(self) -> tuple[Any, Any, Any]:
        """Moments y'y, A'y, A'A in units of the noise, (...), (..., p), (..., p, p)."""
        y, a = self.raw / self.sd, self.design[(None,) * (self.sd.ndim - 1)] / self.sd[..., None]
        return (y**2).sum(-1), (y[..., None] * a).sum(-2), a.swapaxes(-1, -2) @ a

    def log_density(self, xp: ModuleType = jnp) -> Any:
        """Natural, normalised log-density of the readings, nuisances integrated out; (...)."""
        measure = xp.sum(self.log_measure - xp.log(self.sd), axis=-1)
        return marginal_log_density(*self.moments(), self.sd.shape[-1], xp) + measure

    def at_nuisance_mean(self, xp: ModuleType = jnp) -> tuple[Any, Any]:
        """Residuals (n,) in units of the noise at the conditional mean of the nuisances, and that mean (p,)."""
        if self.design.shape[1] == 0:
            return self.raw / self.sd, xp.zeros(0)
        _, ay, aa = self.moments()
        b, _ = conditional_mean(ay, aa, xp)
        return (self.raw - self.design @ b) / self.sd, b

    def at_nuisance_draw(self, rng: np.random.Generator) -> np.ndarray:
        """Residuals (n,) in units of the noise at one draw of the nuisances given the readings."""
        _, ay, aa = self.moments()
        return (self.raw - self.design @ conditional_draw(ay, aa, rng)) / self.sd

    def left_out(self, first: np.ndarray, xp: ModuleType = jnp) -> Any:
        """(blocks,) log-density of each block of readings given all others, nuisances integrated out.

        ``first`` (blocks,) holds the first reading of every block. The terms of ``arviz.loo`` (P.-C. Bürkner, J. Gabry,
        A. Vehtari, *Efficient leave-one-out cross-validation for Bayesian non-factorized normal and Student-t models*,
        Computational Statistics 36, 2021, 1243).
        """
        rows = xp.concatenate([self.raw[:, None], self.design], axis=1) / self.sd[:, None]
        size = np.diff(np.append(first, len(rows)))
        within = np.arange(np.max(size)) < size[:, None]

        def by_block(terms: Any) -> Any:
            """(blocks, longest, ...) of (n, ...); zeros behind the end of a block."""
            index = xp.minimum(first[:, None] + xp.arange(within.shape[1])[None], len(terms) - 1)
            return xp.where(within.reshape(*within.shape, *(1,) * (terms.ndim - 1)), terms[index], 0.0)

        y, a = (part := by_block(rows))[..., 0], part[..., 1:]
        yy, ay, aa = (y**2).sum(-1), (y[..., None] * a).sum(-2), a.swapaxes(-1, -2) @ a
        whole = marginal_log_density(xp.sum(yy), xp.sum(ay, axis=0), xp.sum(aa, axis=0), len(rows), xp)
        other_yy, other_ay, other_aa = (_sum_of_others(part, xp) for part in (yy, ay, aa))
        rest = marginal_log_density(other_yy, other_ay, other_aa, len(rows) - size, xp)
        return whole - rest + xp.sum(by_block(self.log_measure - xp.log(self.sd)), axis=1)


@dataclass(frozen=True)
class Moments:
    """Sufficient moments of readings of g variances, ``fixed_variance + (scale scatter)^2``; () for (g,) where g is 1.

    Attributes
    ----------
    yy, ay, aa : (g,), (g, p), (g, p, p) y'y, A'y, A'A, not divided by the noise
    n : number of readings
    fixed_variance, share : (g,); the part of the readings that has each variance
    scale : ()
    ordinate : () and (), see ``Misfit``
    log_scale : sum of the logarithms of the units that the readings were divided by
    """

    yy: Any
    ay: Any
    aa: Any
    n: int
    fixed_variance: Any
    scale: Any = 1.0
    ordinate: tuple[Any, Any] | None = None
    share: Any = 1.0
    log_scale: Any = 0.0

    def log_density(self, scatter: Any, xp: ModuleType = jnp) -> Any:
        """Natural, normalised log-density of the readings at ``scatter`` (...), nuisances integrated out; (...)."""
        scatter, p = xp.asarray(scatter)[..., None], self.ay.shape[-1]

        def wide(x: Any, *own: int) -> Any:
            return xp.reshape(x, (*(1,) * (scatter.ndim - 1), np.size(self.fixed_variance), *own))

        v = _variance(wide(self.fixed_variance), self.scale, scatter)
        own = v if self.ordinate is None else _variance(*self.ordinate, scatter)
        ay, aa = (wide(self.ay, p) / v[..., None]).sum(-2), (wide(self.aa, p, p) / v[..., None, None]).sum(-3)
        measure = self.n * (wide(self.share) * xp.log(own)).sum(-1)
        return marginal_log_density((wide(self.yy) / v).sum(-1), ay, aa, self.n, xp) - 0.5 * measure - self.log_scale


@dataclass(frozen=True)
class Misfit:
    """Difference between the readings of one group and a model, at any value of their scatter.

    Variance of a reading: fixed_variance + (scale scatter)^2.

    Attributes
    ----------
    raw : (n,) measured minus predicted
    fixed_variance, scale : () or (n,); both () where all readings have one variance
    design : (n, p) effect of the linear nuisances, each scaled to a standard normal prior
    ordinate : fixed variance and scale of the readings' own error where true abscissas are integrated out along the
        model; they normalise the density (see ``capsule_id.experiments.point_test``)
    """

    raw: Any
    fixed_variance: Any
    scale: Any
    design: Any
    ordinate: tuple[Any, Any] | None = None

    def at(self, scatter: Any, xp: ModuleType = jnp) -> ScaledMisfit:
        """Return the misfit at values of the scatter, (...)."""
        scatter, n = xp.asarray(scatter)[..., None], self.raw.shape[0]

        def wide(x: Any) -> Any:
            return xp.broadcast_to(x, (*(1,) * (scatter.ndim - 1), n))

        variance = _variance(wide(self.fixed_variance), wide(self.scale), scatter)
        own = variance if self.ordinate is None else _variance(wide(self.ordinate[0]), wide(self.ordinate[1]), scatter)
        return ScaledMisfit(wide(self.raw), xp.sqrt(variance), self.design, 0.5 * xp.log(variance / own))

    def summary(self, xp: ModuleType = jnp) -> "Misfit | Moments":
        """Return the moments where all readings have one variance, or there are many; else the misfit."""
        y, a, numbers = self.raw, self.design, (self.fixed_variance, self.scale, *(self.ordinate or ()))
        if not any(np.ndim(number) for number in numbers):
            return Moments(y @ y, a.T @ y, a.T @ a, y.shape[0], self.fixed_variance, self.scale, self.ordinate)
        return self if y.shape[0] <= MANY_READINGS or self.ordinate is not None else self._interpolated(xp)

    def _interpolated(self, xp: ModuleType) -> Moments:
        """Moments at Chebyshev nodes in the logarithm of r = fixed_variance/scale^2: what is summed over the readings,
        log(r + scatter^2) and 1/(r + scatter^2), is smooth in it, whatever the scatter.
        """
        n = self.raw.shape[0]
        unit = xp.broadcast_to(self.scale, (n,))
        r = self.fixed_variance / unit**2
        r = xp.log(xp.maximum(r, LEAST_RATIO * xp.max(r) + np.finfo(float).tiny))
        middle, half = 0.5 * (xp.max(r) + xp.min(r)), 0.5 * (xp.max(r) - xp.min(r))
        x, y, a = (r - middle) / xp.where(half > 0.0, half, 1.0), self.raw / unit, self.design / unit[:, None]
        angle = np.pi * (np.arange(VARIANCES) + 0.5) / VARIANCES
        sums, before, now = [], x, xp.ones(n)
        for _ in angle:
            sums.append((xp.sum(now), y @ (now * y), a.T @ (now * y), a.T @ (now[:, None] * a)))
            before, now = now, 2.0 * x * now - before
        at_nodes = np.cos(np.arange(VARIANCES) * angle[:, None]) * np.where(np.arange(VARIANCES), 2.0, 1.0) / VARIANCES
        number, yy, ay, aa = (xp.tensordot(at_nodes, xp.stack(parts), 1) for parts in zip(*sums, strict=True))
        variances = xp.exp(middle + half * np.cos(angle))
        return Moments(yy, ay, aa, n, variances, 1.0, None, number / n, xp.sum(xp.log(unit)))

    def log_density(self, scatter: Any, xp: ModuleType = jnp) -> Any:
        """Natural, normalised log-density of the readings at ``scatter`` (...), nuisances integrated out; (...)."""
        return self.at(scatter, xp).log_density(xp)


def _sum_of_others(parts: Any, xp: ModuleType) -> Any:
    """Sum over the first axis of ``parts`` (m, ...) without each part in turn; a difference would lose digits."""
    nothing = xp.zeros_like(parts[:1])
    before = xp.concatenate([nothing, xp.cumsum(parts[:-1], axis=0)])
    return before + xp.concatenate([xp.cumsum(parts[:0:-1], axis=0)[::-1], nothing])


def _variance(fixed: Any, scale: Any, scatter: Any) -> Any:
    return fixed + (scale * scatter) ** 2


def innovations(raw: Any, variance: Any, design: Any, rho: Any, xp: ModuleType) -> Misfit:
    """Transform readings with stationary AR(1) noise e_t = rho e_(t-1) + N(0, variance + scatter^2) to innovations."""

    def whiten(y: Any) -> Any:
        return xp.concatenate([y[:1], y[1:] - rho * y[:-1]])

    first = 1.0 / xp.sqrt(1.0 - rho**2)
    scale = xp.concatenate([xp.reshape(first, (1,)), xp.ones(raw.shape[0] - 1)])
    return Misfit(whiten(raw), variance * scale**2, scale, whiten(design))
