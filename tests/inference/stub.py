"""Targets without readings: experiments that name parameters only, and known densities to sample from."""

from collections.abc import Hashable, Mapping, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

import jax.numpy as jnp
import numpy as np

from capsule_id.experiments.base import Experiment, Start, Theta, no_design
from capsule_id.experiments.misfit import Misfit
from capsule_id.inference.result import PointFit
from capsule_id.parameters import Parameter
from capsule_id.rig.model import PriorOverride, Quantity, Rig, Table
from capsule_id.views import Comparison


def rig_without_tables(priors: Mapping[str, PriorOverride] | None = None) -> Rig:
    return Rig("bench", True, None, None, Quantity(9.81), priors or {}, (), {}, Path("bench"))


class Nothing(Experiment):
    """Names parameters and holds no reading: its posterior is the prior."""

    def __init__(self, rows: Sequence[Parameter]) -> None:
        empty = Table("nothing", "nothing", "nothing.csv", {}, {}, np.zeros(0, dtype=int))
        super().__init__(empty, rig_without_tables())
        self.rows = tuple(rows)

    @property
    def signature(self) -> Hashable:
        return type(self), self.rows

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return self.rows

    @property
    def observed(self) -> np.ndarray:
        return np.zeros(0)

    def misfits(self, theta: Theta, xp: ModuleType = jnp) -> tuple[Misfit]:
        return (Misfit(xp.zeros(0), 1.0, 0.0, no_design(0, xp)),)

    def starts(self) -> dict[str, Start]:
        return {}

    def comparison(self, theta: Theta, draws: list[Theta]) -> Comparison:
        raise NotImplementedError


class Gaussian:
    """A known normal density in the place of a ``LogPosterior``: what the sampler asks of one, and no more."""

    def __init__(self, mean: np.ndarray, covariance: np.ndarray) -> None:
        self.mean, self.covariance = mean, covariance
        self.precision = np.linalg.inv(covariance)
        self.names = tuple(f"x{i}" for i in range(len(mean)))
        self.dimension = len(mean)
        self.blocks = [np.arange(len(mean))]

    def batch(self, u: Any) -> np.ndarray:
        """(w, d) -> (w,)."""
        d = np.asarray(u) - self.mean
        return -0.5 * np.einsum("wi,ij,wj->w", d, self.precision, d)

    def theta(self, u: np.ndarray) -> np.ndarray:
        return u

    def fit(self, off: float = 0.5, wide: float = 1.3) -> PointFit:
        """A Laplace approximation that is ``off`` sds off and ``wide`` times too wide."""
        sd = np.sqrt(np.diag(self.covariance))
        u = self.mean + off * sd
        none = np.zeros((1, self.dimension))
        return PointFit(
            self.names, u, {}, wide**2 * self.covariance, {}, none, none, np.zeros(1), True, np.zeros(1, dtype=bool)
        )
