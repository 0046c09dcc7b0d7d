"""One cache of compiled programs for all processes of a test run (workers, commands, kernels of notebooks); fixtures."""

import os
import shutil
import tempfile

import pytest

from tests.capsule_cases import Cases, read_cases

#: Programs that take longer than this to compile, s, are kept.
WORTH_KEEPING = "0.3"


def pytest_configure(config: pytest.Config) -> None:
    if hasattr(config, "workerinput") or "JAX_COMPILATION_CACHE_DIR" in os.environ:
        return
    folder = tempfile.mkdtemp(prefix="capsule-id-compiled-")
    os.environ["JAX_COMPILATION_CACHE_DIR"] = folder
    os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = WORTH_KEEPING
    config.add_cleanup(lambda: shutil.rmtree(folder, ignore_errors=True))


@pytest.fixture(scope="session")
def cases() -> Cases:
    """The 25 reference cases as one batch."""
    return read_cases()
