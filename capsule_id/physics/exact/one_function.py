"""A program that XLA compiles as one function on a CPU."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax.experimental.xla_metadata import set_xla_metadata

#: XLA emits a call with these attributes as one function, as it does itself with loops that need little memory. Its
#: runtime dispatches the parts of all other loops one by one in every step, which takes several times as long.
ONE_FUNCTION = {"xla_cpu_small_call": "true", "inlineable": "false"}


def as_one_function(run: Callable[..., Any]) -> Callable[..., tuple[Any, jax.Array]]:
    """``run``, jitted, on a CPU as one function. It takes concrete arguments, no empty arrays, and also returns a number.

    XLA cannot emit every operation this way: scatter, sort and calls of libraries are errors.
    """

    @jax.jit
    def call(*args: Any) -> tuple[Any, jax.Array]:
        with set_xla_metadata(**dict.fromkeys(ONE_FUNCTION)):
            # XLA ends the process where such a call leaves an argument without use: each one enters the number.
            return run(*args), sum((jnp.ravel(x)[0].astype(float) for x in jax.tree.leaves(args)), jnp.zeros(()))

    @jax.jit
    def program(*args: Any) -> tuple[Any, jax.Array]:
        with set_xla_metadata(**(ONE_FUNCTION if jax.default_backend() == "cpu" else {})):
            return call(*args)

    return program
