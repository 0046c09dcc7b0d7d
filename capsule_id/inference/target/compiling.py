"""XLA options of what is compiled here: a fit takes seconds, and compiling was most of it."""

#: XLA's newer emitters of fused loops take twice as long to compile, and their code runs no faster.
COMPILE = {"xla_cpu_use_fusion_emitters": False}
#: For what runs for milliseconds in all.
COMPILE_QUICKLY = {**COMPILE, "xla_backend_optimization_level": 0}
