"""Settings of JAX for all processes of a test run (workers, commands, kernels of notebooks), and fixtures.

Compiled programs are kept in one cache. Arrays of different ranks are not broadcast against each other implicitly.
The shapes and types that ``CHECKED`` modules annotate hold for every call.
"""

import gc
import os
import shutil
import signal
import tempfile
from collections.abc import Iterator
from pathlib import Path

import jax
import pytest
from jaxtyping import install_import_hook

from capsule_id.precision import XLA_EMITTER_OPTION
from tests.capsule_cases import Cases, read_cases

#: Programs that take longer than this to compile, s, are kept.
WORTH_KEEPING = "0.3"

#: A program in one part costs a tenth less CPU time to compile than one that is compiled by several threads.
XLA_ONE_PART = "--xla_cpu_parallel_codegen_split_count=1"

#: Files that take longest, first: the workers then end at the same time.
FIRST = ("test_project.py", "test_notebooks.py", "test_notebooks_even.py", "test_foreign_law.py", "test_smooth.py")

#: Files that compile large programs and run them for milliseconds: their programs are not optimised. Numbers of the
#: commands, fits, maps and reference cases come from optimised programs.
NOT_OPTIMISED = {
    "test_base_run.py",
    "test_bifurcate_command.py",
    "test_block_means.py",
    "test_blocks.py",
    "test_capsule_bench.py",
    "test_choice.py",
    "test_clock_drift.py",
    "test_coloured_runs.py",
    "test_culprits.py",
    "test_decay_calibration.py",
    "test_decay_channels.py",
    "test_decays.py",
    "test_displacement.py",
    "test_exact_derivatives.py",
    "test_exact_truths.py",
    "test_feasibility.py",
    "test_forced_run.py",
    "test_forces.py",
    "test_foreign_law.py",
    "test_friction_against_load.py",
    "test_friction_family.py",
    "test_friction_laws.py",
    "test_general_derivatives.py",
    "test_general_faults.py",
    "test_general_reference.py",
    "test_heavy_tails.py",
    "test_hidden_terms.py",
    "test_likelihoods.py",
    "test_measured_runs.py",
    "test_misfit.py",
    "test_point_stage.py",
    "test_predictability.py",
    "test_progression.py",
    "test_run_parts.py",
    "test_simulate.py",
    "test_simulate_command.py",
    "test_single_run.py",
    "test_slope.py",
    "test_smooth.py",
    "test_smooth_derivatives.py",
    "test_stated_ground.py",
    "test_turning_points.py",
}

#: Modules whose annotations are checked at run time; the hook must stand before their first import.
CHECKED = (
    "capsule_id.inference.curvature",
    "capsule_id.inference.moves",
    "capsule_id.inference.marginal",
    "capsule_id.records",
    "capsule_id.rig.filters",
)
install_import_hook(CHECKED, "beartype.beartype")
# Imports make no garbage, see pytest_collection_finish.
gc.disable()

# The variable reaches the processes that tests start; this process has imported JAX already.
os.environ["JAX_NUMPY_RANK_PROMOTION"] = "raise"
# JAX has set 1, with which a command on some processors prints XLA's remarks on programs of the cache (openxla/xla 44565).
os.environ["TF_CPP_MIN_LOG_LEVEL"] = "3"
jax.config.update("jax_numpy_rank_promotion", "raise")


def pytest_configure(config: pytest.Config) -> None:
    if hasattr(config, "workerinput"):
        return
    # The workers occupy the cores. More threads of BLAS wait for each other and take up to fifty times the CPU time.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    # As the commands do; benchmarks time the options that their caller sets.
    if config.getoption("markexpr") != "benchmark":
        os.environ.setdefault("XLA_FLAGS", f"{XLA_EMITTER_OPTION} {XLA_ONE_PART}")
    if "JAX_COMPILATION_CACHE_DIR" in os.environ:
        return
    folder = tempfile.mkdtemp(prefix="capsule-id-compiled-")
    os.environ["JAX_COMPILATION_CACHE_DIR"] = folder
    os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = WORTH_KEEPING
    config.add_cleanup(lambda: shutil.rmtree(folder, ignore_errors=True))


def is_optimised(path: Path) -> bool:
    """Whether the programs that a file of tests compiles are optimised."""
    return path.name not in NOT_OPTIMISED


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    first = {name: at for at, name in enumerate(FIRST)}
    items.sort(key=lambda item: (first.get(item.path.name, len(FIRST)), is_optimised(item.path)))


def pytest_collection_finish() -> None:
    """Collect garbage again, less often, and not what was imported: each pass walks all modules and traces.

    XLA reads its options now: a fit sets them as for a command where nothing has been computed.
    """
    jax.devices()
    gc.enable()
    gc.freeze()
    gc.set_threshold(50_000, 20, 20)


@pytest.fixture(scope="module", autouse=True)
def _optimisation(request: pytest.FixtureRequest) -> None:
    optimised = is_optimised(request.path)
    if optimised and jax.config.read("jax_disable_most_optimizations"):
        # A compiled program in memory serves later files too, whatever the option says then.
        jax.clear_caches()
    jax.config.update("jax_disable_most_optimizations", not optimised)


@pytest.fixture(scope="session")
def cases() -> Cases:
    """The 25 reference cases as one batch."""
    return read_cases()


@pytest.fixture
def interrupts() -> Iterator[None]:
    """SIGINT arrives: a shell without job control lets the processes that it starts in the background ignore it."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)
