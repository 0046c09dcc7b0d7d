"""Settings of JAX: double precision, and options of XLA that shorten compilation and runs."""

import os
import sys

#: Disable XLA's newer emitters of fused loops: they compile twice as long, and their code runs no faster.
COMPILE: dict[str, bool | int] = {"xla_cpu_use_fusion_emitters": False}
#: Options for code that runs for milliseconds in total, where compilation time dominates.
COMPILE_QUICKLY = {**COMPILE, "xla_backend_optimization_level": 0}
#: For a whole process. XLA then compiles each loop as one function: fits and batches take a third of the time. CPU only.
XLA_LOOP_OPTION = "--xla_backend_extra_options=xla_cpu_small_while_loop_byte_threshold=1000000000"
#: ``COMPILE`` for a whole process. CPU only.
XLA_EMITTER_OPTION = "--xla_cpu_use_fusion_emitters=false"


def prepare_xla() -> bool:
    """Set the options of XLA for this process; False where JAX has computed something. Those that the user has set stay."""
    bridge = sys.modules.get("jax._src.xla_bridge")
    if bridge is not None and getattr(bridge, "backends_are_initialized", lambda: True)():
        return False
    flags = os.environ.get("XLA_FLAGS", "")
    own = (option for option in (XLA_EMITTER_OPTION, XLA_LOOP_OPTION) if option.partition("=")[0] not in flags)
    os.environ["XLA_FLAGS"] = " ".join([flags, *own]).strip()
    return True


def require_float64() -> None:
    """Switch JAX to float64 and check the effect.

    Raises
    ------
    RuntimeError
        If JAX still computes in float32, for instance inside ``jax.enable_x64(False)``.
    """
    import jax  # the options above are read by commands that load no JAX

    jax.config.update("jax_enable_x64", True)
    # Not by an array: the commands set XLA's options after this module's imports and before the first computation.
    dtype = jax.dtypes.canonicalize_dtype(float)
    if dtype != jax.numpy.float64:
        raise RuntimeError(
            f"float64 is needed, JAX computes in {dtype}: leave the enclosing jax.enable_x64(False) block, "
            "or unset JAX_ENABLE_X64 = 0, before using capsule_id"
        )
