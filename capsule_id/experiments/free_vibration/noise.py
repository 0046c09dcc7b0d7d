"""Coloured noise and drift of a record, at any sampling, whitened in linear time."""

from functools import partial
from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from tinygp.kernels.quasisep import Matern32
from tinygp.solvers.quasisep.core import DiagQSM, StrictLowerTriQSM, SymmQSM

from capsule_id.experiments.base import ValuesBySymbol
from capsule_id.experiments.free_vibration.declaration import DRIFT_RATIO, DRIFT_TIME, NOISE_TIME, WHITE_RATIO
from capsule_id.experiments.free_vibration.readings import (
    Blocks,
    DecayModel,
)
from capsule_id.parameters import Parameter, Prior

if TYPE_CHECKING:
    pass


# noise: Coloured noise and drift of a record, at any sampling, whitened in linear time.
#
# The noise is a continuous-time process: an Ornstein–Uhlenbeck process, alone or with white noise. Sampled evenly
# the first is AR(1) and the sum is ARMA(1, 1). A drift is a Matérn-3/2 process. tinygp factorises the covariance of
# such sums in linear time (quasiseparable matrices: D. Foreman-Mackey et al., AJ 154, 220 (2017)).
#
# Block means of the first process have exactly such a covariance again, where the readings of a block are evenly
# spaced.
# A drift changes little within a block, so its value at the middle stands for its mean.


class ReadingTimes(eqx.Module):
    """Times of the readings of N blocks.

    Attributes
    ----------
    time, first, last : (N,) s, as in ``Blocks``
    count : (1,) readings of every block, or (N,)
    step : (1,) or (N,) s between the readings of a block
    longest : largest count
    """

    time: Any
    first: Any
    last: Any
    count: Any
    step: Any
    longest: int = eqx.field(static=True)

    @classmethod
    def of(cls, blocks: Blocks) -> "ReadingTimes":
        """Times of the readings of ``blocks``; equal blocks share count and step."""
        count, step = blocks.count, (blocks.last - blocks.first) / np.maximum(blocks.count - 1.0, 1.0)
        if np.ptp(count) == 0.0 and np.ptp(step) <= 0.01 * np.max(step):
            count, step = count[:1], np.mean(step, keepdims=True)
        return cls(blocks.time, blocks.first, blocks.last, count, step, int(np.max(count)))


def noise_parameters(model: DecayModel, time: np.ndarray, period: float, of: str) -> list[Parameter]:
    """Return the shape parameters of noise and drift of the record ``of``, sampled at ``time`` (n,), s.

    The noise's correlation time lies between the sampling step and the record's length, the drift's between the period
    (s) of the decay and the square of the record's length over it.
    """
    length = float(np.ptp(time))
    between = Prior("lognormal", float(length / np.sqrt(len(time))), float(np.sqrt(len(time))))
    slow = Prior("lognormal", 0.3 * length, max(3.0, 0.3 * length / period))
    rows = [NOISE_TIME.named(of, between)] if model.noise != "white" else []
    rows += [WHITE_RATIO.named(of)] if model.noise == "arma" else []
    return rows + ([DRIFT_RATIO.named(of), DRIFT_TIME.named(of, slow)] if model.drift == "gp" else [])


def whiten(times: ReadingTimes, columns: Any, model: DecayModel, theta: ValuesBySymbol) -> Any:
    """Map columns (n, q) to the coordinates where noise and drift are white with the noise's innovation sd; (n, q).

    The map has determinant 1: the density of the readings is that of the whitened readings.
    """
    shape = {symbol: theta[symbol] for symbol in model.shapes}
    return whiten_by_shape(times, jnp.asarray(columns), model.noise, shape)


@partial(jax.jit, static_argnames="noise")
def whiten_by_shape(times: ReadingTimes, columns: Any, noise: str, shape: ValuesBySymbol) -> Any:
    """Whiten as ``whiten``, with the shape parameters of ``noise`` and, where it has some, of the drift."""
    factor = _covariance(times, noise, shape)[0].cholesky()
    return factor.solve(columns) * jnp.exp(jnp.mean(jnp.log(factor.diag.d)))


@partial(jax.jit, static_argnames="noise")
def drift_by_shape(times: ReadingTimes, residuals: Any, noise: str, shape: ValuesBySymbol) -> Any:
    """Expectation (n,) of a Gaussian-process drift, given the ``residuals`` (n,) that it is a part of."""
    total, drift = _covariance(times, noise, shape)
    factor = total.cholesky()
    return drift @ factor.transpose().solve(factor.solve(residuals[:, None]))[:, 0]


def _covariance(times: ReadingTimes, noise: str, shape: ValuesBySymbol) -> tuple[Any, Any]:
    """Covariances of all noise with the drift, and of the drift alone; of unit innovation variance."""
    parts: list[Any] = [averaged_process(times, shape["noise_time"])] if noise != "white" else []
    if "drift_time" in shape:
        parts.append(Matern32(scale=shape["drift_time"], sigma=shape["drift_ratio"]).to_symm_qsm(times.time))
    white = {"white": 1.0, "ar1": 0.0, "arma": shape.get("white_ratio", 0.0) ** 2}[noise] / times.count
    correlated: Any = sum(parts[1:], parts[0])
    return correlated + DiagQSM(d=jnp.broadcast_to(white, times.time.shape)), parts[-1]


def averaged_process(times: ReadingTimes, correlation_time: Any) -> SymmQSM:
    """Covariance of the block means of an Ornstein–Uhlenbeck process of unit variance; (N, N).

    The mean of a block is its readings' mean decay from their first or to their last one. Between two blocks the
    process decays over the time between the nearest readings.
    """
    lags = jnp.arange(times.longest)[None]
    count = times.count[:, None]
    decay = jnp.exp(-lags * times.step[:, None] / correlation_time)
    inside = lags < count
    reach = jnp.sum(decay * inside, axis=1) / times.count
    pairs = jnp.where(inside, jnp.where(lags == 0, 1.0, 2.0) * (count - lags), 0.0)
    variance = jnp.sum(pairs * decay, axis=1) / times.count**2
    n, reach = times.time.shape[0], jnp.broadcast_to(reach, times.time.shape)
    gap = jnp.concatenate([jnp.ones(1), jnp.exp(-(times.first[1:] - times.last[:-1]) / correlation_time)])
    ends = jnp.concatenate([jnp.ones(1), jnp.exp(-jnp.diff(times.last) / correlation_time)])
    lower = StrictLowerTriQSM(p=(reach * gap)[:, None], q=reach[:, None], a=ends[:, None, None])
    return SymmQSM(diag=DiagQSM(d=jnp.broadcast_to(variance, (n,))), lower=lower)
