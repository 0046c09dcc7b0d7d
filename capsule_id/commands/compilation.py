"""Options of XLA and BLAS for a command, and the cache of compiled programs between commands.

Those of XLA act before its first computation, those of BLAS before NumPy is imported.
"""

import hashlib
import os
import platform
import re
import shutil
import sys
from contextlib import suppress
from importlib.metadata import version
from pathlib import Path

from platformdirs import user_cache_path

from capsule_id.precision import prepare_xla

#: Variable with the number of threads of OpenBLAS, which NumPy and SciPy bring.
BLAS_THREADS = "OPENBLAS_NUM_THREADS"
#: Variables of JAX, unless the user has set them: largest size of the cache, bytes, beyond which it removes the programs that
#: were not used for the longest time; programs that take longer than this to compile are kept, s.
CACHE_SETTINGS = {"JAX_COMPILATION_CACHE_MAX_SIZE": 256 * 2**20, "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": 0.3}
#: Variable of JAX with the directory of the cache, and how JAX's warnings about the cache begin.
DIRECTORY = "JAX_COMPILATION_CACHE_DIR"
CACHE_ERRORS = tuple(f"Error {doing} persistent compilation cache entry" for doing in ("reading", "writing"))


def use_one_blas_thread() -> None:
    """Let BLAS run in the thread that calls it, unless NumPy is imported or the user has set another number.

    The matrices of a fit have few columns, and its own threads occupy the cores: those of BLAS would wait for them. One
    thread also sums in the same order on any number of cores.
    """
    if "numpy" not in sys.modules:
        os.environ.setdefault(BLAS_THREADS, "1")


def prepare_jax(cached: bool) -> None:
    """Set the options of XLA for this process, see ``prepare_xla``.

    cached : keep compiled programs in the user's cache directory too; JAX's own variables, where set, have precedence.
        Processes share the cache under a file lock. Nothing is kept where the directory cannot be written
    """
    if not prepare_xla() or not cached or DIRECTORY in os.environ:
        return
    directory = cache_directory()
    with suppress(OSError):
        directory.mkdir(parents=True, exist_ok=True)
    if os.access(directory, os.W_OK | os.X_OK):
        settings = {DIRECTORY: str(directory), **CACHE_SETTINGS, **os.environ}
        os.environ.update({name: str(settings[name]) for name in (DIRECTORY, *CACHE_SETTINGS)})
        if "jax" in sys.modules:  # the kinds of experiments import it, and it has read its variables then
            from jax import config

            config.update(DIRECTORY.lower(), str(directory))
            for name, value in CACHE_SETTINGS.items():
                config.update(name.lower(), type(value)(os.environ[name]))


def cache_directory() -> Path:
    """Directory of the cache: a compiled program serves one version of JAX on one model of processor."""
    try:
        information = Path("/proc/cpuinfo").read_text(encoding="utf-8").split("\n\n")[0]
        processor = "".join(line for line in information.splitlines() if line.startswith(("flags", "model name")))
    except OSError:
        processor = platform.processor()
    key = hashlib.sha256(f"{platform.machine()} {processor}".encode()).hexdigest()[:12]
    return user_cache_path("capsule-id", appauthor=False) / f"jax-{version('jax')}-{version('jaxlib')}-{key}"


def leave_cache(message: str) -> str:
    """The text to print of ``message``, a warning; one of JAX about its cache ends the use of what is faulty.

    A damaged cache is removed, and a cache that the operating system refuses is not used any more.
    """
    if not message.startswith(CACHE_ERRORS) or DIRECTORY not in os.environ:
        return message
    refused = re.search(r"\[Errno|NotImplementedError|Timeout", message) is not None  # or the folder has no locks
    own = Path(os.environ[DIRECTORY]) == cache_directory()
    if own and not (refused and message.startswith(CACHE_ERRORS[0])):  # a full disk leaves a part of a program
        shutil.rmtree(cache_directory(), ignore_errors=True)
    if refused:
        from jax import config
        from jax.experimental.compilation_cache import compilation_cache

        config.update("jax_enable_compilation_cache", val=False)
        compilation_cache.reset_cache()
        reason = message.partition("': ")[2]
        return f"the cache of compiled programs cannot be used ({reason}); this command compiles them anew"
    return "the cache of compiled programs was damaged and is removed" if own else message
