"""Coloured noise and drift of a record, at any sampling, whitened in linear time.

The noise is a continuous-time process: an Ornstein–Uhlenbeck process, alone or with white noise. Sampled evenly the first
is AR(1) and the sum is ARMA(1, 1). A drift is a Matérn-3/2 process. tinygp factorises the covariance of such sums in
linear time (quasiseparable matrices: D. Foreman-Mackey et al., AJ 154, 220 (2017)).
"""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from tinygp.kernels.quasisep import Exp, Matern32
from tinygp.solvers.quasisep.core import DiagQSM

from capsule_id.experiments.base import ValuesBySymbol
from capsule_id.experiments.free_vibration.declaration import DRIFT_RATIO, DRIFT_TIME, NOISE_TIME, WHITE_RATIO
from capsule_id.experiments.free_vibration.settings import DecayModel
from capsule_id.parameters import Parameter, Prior


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


def whiten(time: np.ndarray, columns: Any, model: DecayModel, theta: ValuesBySymbol) -> Any:
    """Map columns (n, q) to the coordinates where noise and drift are white with the noise's innovation sd; (n, q).

    The map has determinant 1: the density of the readings is that of the whitened readings.
    """
    shape = {symbol: theta[symbol] for symbol in model.shapes}
    return whiten_by_shape(jnp.asarray(time), jnp.asarray(columns), model.noise, shape)


@partial(jax.jit, static_argnames="noise")
def whiten_by_shape(time: Any, columns: Any, noise: str, shape: ValuesBySymbol) -> Any:
    """Whiten as ``whiten``, with the shape parameters of ``noise`` and, where it has some, of the drift."""
    kernels: list[Any] = [Exp(scale=shape["noise_time"])] if noise != "white" else []
    if "drift_time" in shape:
        kernels.append(Matern32(scale=shape["drift_time"], sigma=shape["drift_ratio"]))
    covariance: Any = sum((kernel.to_symm_qsm(time) for kernel in kernels[1:]), kernels[0].to_symm_qsm(time))
    white = {"white": 1.0, "ar1": 0.0, "arma": shape.get("white_ratio", 0.0) ** 2}[noise]
    factor = (covariance + DiagQSM(d=jnp.full(time.shape[0], white))).cholesky()
    return factor.solve(columns) * jnp.exp(jnp.mean(jnp.log(factor.diag.d)))
