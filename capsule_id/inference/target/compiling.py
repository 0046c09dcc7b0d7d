"""XLA options that shorten compilation, which takes most of the time of a short fit; the memory that it leaves."""

import ctypes
from contextlib import suppress
from importlib.metadata import version

#: Whether XLA has the option below. XLA refuses options that it does not know; jaxlib 0.11 and later are not tried.
HAS_EMITTER_OPTION = tuple(int(part) for part in version("jaxlib").split(".")[:2]) < (0, 11)
#: Disable XLA's newer emitters of fused loops: they compile twice as long, and their code runs no faster.
COMPILE: dict[str, bool | int] = {"xla_cpu_use_fusion_emitters": False} if HAS_EMITTER_OPTION else {}
#: Options for code that runs for milliseconds in total, where compilation time dominates.
COMPILE_QUICKLY = {**COMPILE, "xla_backend_optimization_level": 0}

#: Parameter of glibc's ``mallopt``: the number of heaps.
_HEAPS = -8


def use_one_heap() -> None:
    """Let all threads share one heap, where the C library is glibc: a heap of each keeps what its compilations freed."""
    with suppress(AttributeError, OSError, TypeError):  # another C library
        ctypes.CDLL(None).mallopt(_HEAPS, 1)


def release_memory() -> None:
    """Give back what compilations have freed, where the C library is glibc: it keeps the memory for later by itself."""
    with suppress(AttributeError, OSError, TypeError):
        ctypes.CDLL(None).malloc_trim(0)
