"""XLA options that shorten compilation, which takes most of the time of a short fit."""

#: Disable XLA's newer emitters of fused loops: they compile twice as long, and their code runs no faster.
COMPILE = {"xla_cpu_use_fusion_emitters": False}
#: Options for code that runs for milliseconds in total, where compilation time dominates.
COMPILE_QUICKLY = {**COMPILE, "xla_backend_optimization_level": 0}
