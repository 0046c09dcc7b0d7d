"""Prior densities of all parameters as arrays, so that their density is one expression."""

from collections.abc import Sequence
from types import ModuleType
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from scipy import stats

from capsule_id.errors import InputError
from capsule_id.experiments.linear import LOG_2PI
from capsule_id.parameters import QUANTILE_975, Parameter, Prior
from capsule_id.rig.model import PriorOverride


class Priors(eqx.Module):
    """Normal densities of z = (value - centre)/width, one per parameter; every array is (d,).

    Attributes
    ----------
    lognormal : whether the value is u = log(theta); else it is theta
    centre, width : of the normal density
    constant : log of the normalisation factor of a truncated density
    jacobian : whether theta is sampled through its logarithm and has a prior density in theta: log |d theta/du| = u
    """

    lognormal: Any
    centre: Any
    width: Any
    constant: Any
    jacobian: Any

    def __init__(self, parameters: Sequence[Parameter]) -> None:
        priors = [prior_of(row) for row in parameters]
        kinds = np.array([prior.kind for prior in priors])
        location = np.array([prior.location for prior in priors])
        spread = np.array([prior.spread for prior in priors])
        lognormal = kinds == "lognormal"
        with np.errstate(divide="ignore", invalid="ignore"):
            # The log-normal is a normal density of u; the others are normal densities of theta.
            centre = np.where(lognormal, np.log(location), location)
            width = np.where(lognormal, np.log(spread) / QUANTILE_975, spread)
        mass = np.where(kinds == "positive_normal", location / spread, 0.0)
        constant = np.where(kinds == "halfnormal", np.log(2.0), 0.0)
        self.lognormal, self.centre, self.width = jnp.asarray(lognormal), jnp.asarray(centre), jnp.asarray(width)
        self.constant = jnp.asarray(constant - np.where(kinds == "positive_normal", stats.norm.logcdf(mass), 0.0))
        self.jacobian = jnp.asarray(np.array([row.positive for row in parameters]) & ~lognormal)

    def at(self, index: Any, xp: ModuleType = jnp) -> "Priors":
        """Return the priors at ``index``: arrays of the shape of ``index``, of ``xp``."""
        return jax.tree.map(lambda array: xp.asarray(array)[index], self)

    def terms(self, u: Any, value: Any, xp: ModuleType = jnp) -> Any:
        """Log-density of u for each parameter, Jacobian included; ``value`` is the constrained u."""
        z = self.residuals(u, value, xp)
        density = -0.5 * (z**2 + LOG_2PI) - xp.log(self.width) + self.constant
        return density + xp.where(self.jacobian, u, 0.0)

    def residuals(self, u: Any, value: Any, xp: ModuleType = jnp) -> Any:
        """(value - centre)/width for each parameter."""
        return (xp.where(self.lognormal, u, value) - self.centre) / self.width

    def rates(self, value_rates: Any, xp: ModuleType = jnp) -> Any:
        """Derivative of each of ``residuals`` with respect to u, from those of the values."""
        return xp.where(self.lognormal, 1.0, value_rates) / self.width


def prior_of(row: Parameter) -> Prior:
    """Return the prior of ``row``.

    Raises
    ------
    ValueError
        If the row has no prior.
    """
    if row.prior is None:
        raise ValueError(f"parameter {row.name} has no prior: the experiment that names it must supply one")
    return row.prior


def prior_sd(row: Parameter) -> float:
    """Standard deviation of u under the row's prior (half-normal: pi/sqrt(8), that of its logarithm)."""
    prior = prior_of(row)
    if prior.kind == "lognormal":
        return float(np.log(prior.spread) / QUANTILE_975)
    if prior.kind == "halfnormal":
        return float(np.pi / np.sqrt(8.0))
    if prior.kind == "positive_normal":
        return prior.spread / prior.location
    return prior.spread


def override(row: Parameter, stated: PriorOverride | None) -> Parameter:
    """Return the row with the prior of ``rig.toml``, where one is stated."""
    return row if stated is None else row.named(row.of, stated.prior)


def covering_prior(name: str, priors: Sequence[Prior]) -> Prior:
    """Return the prior of a parameter that several experiments share, whatever their order.

    Log-normal priors: the narrowest one whose central 95 % contain those of all. Normal priors about one mean: the widest.

    Raises
    ------
    InputError
        If experiments state other priors that differ.
    """
    kinds, locations = {prior.kind for prior in priors}, {prior.location for prior in priors}
    if len(set(priors)) == 1:
        return priors[0]
    if kinds == {"lognormal"}:
        low = min(np.log(prior.location) - np.log(prior.spread) for prior in priors)
        high = max(np.log(prior.location) + np.log(prior.spread) for prior in priors)
        return Prior("lognormal", float(np.exp(0.5 * (low + high))), float(np.exp(0.5 * (high - low))))
    if kinds == {"normal"} and len(locations) == 1:
        return max(priors, key=lambda prior: prior.spread)
    stated = " and ".join(dict.fromkeys(f"{prior.kind} {prior.location:g}, {prior.spread:g}" for prior in priors))
    rule = f"experiments that share {name} must state one prior for it"
    raise InputError(rule, f"{stated} (SI)", f"state the same in each of them, or state {name} in [prior]")
