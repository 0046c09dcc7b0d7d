"""XLA options that shorten compilation, which takes most of the time of a short fit."""

from importlib.metadata import version

#: Whether XLA has the option below. XLA refuses options that it does not know; jaxlib 0.11 and later are not tried.
HAS_EMITTER_OPTION = tuple(int(part) for part in version("jaxlib").split(".")[:2]) < (0, 11)
#: Disable XLA's newer emitters of fused loops: they compile twice as long, and their code runs no faster.
COMPILE: dict[str, bool | int] = {"xla_cpu_use_fusion_emitters": False} if HAS_EMITTER_OPTION else {}
#: Options for code that runs for milliseconds in total, where compilation time dominates.
COMPILE_QUICKLY = {**COMPILE, "xla_backend_optimization_level": 0}
