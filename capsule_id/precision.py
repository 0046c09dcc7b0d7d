"""Switches JAX to double precision; every module that computes with JAX calls it."""

import jax
import jax.numpy as jnp


def require_float64() -> None:
    """Switch JAX to float64 and check the effect.

    Raises
    ------
    RuntimeError
        If JAX still computes in float32, for instance inside ``jax.enable_x64(False)``.
    """
    jax.config.update("jax_enable_x64", True)
    dtype = jnp.zeros(()).dtype
    if dtype != jnp.float64:
        raise RuntimeError(
            f"float64 is needed, JAX computes in {dtype}: leave the enclosing jax.enable_x64(False) block, "
            "or unset JAX_ENABLE_X64 = 0, before using capsule_id"
        )
