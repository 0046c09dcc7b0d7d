"""Options of XLA, the cache of compiled programs and freed memory: a faster second run, no effect on any number."""

import os
from pathlib import Path
from types import SimpleNamespace

import pytest

import capsule_id as cid
from capsule_id import precision
from capsule_id.commands import compilation
from tests.cli_tools import environment, run

MOTION = ("simulate", "--k2", "18960", "--P_d", "4", "--Omega", "34.56", "--G", "1e-3", "--periods", "1")


@pytest.mark.full
def test_users_xla_options_are_left_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(precision, "sys", SimpleNamespace(modules={}))
    emitter, loop = precision.XLA_EMITTER_OPTION, precision.XLA_LOOP_OPTION
    for before, after in (
        ("", f"{emitter} {loop}"),
        ("--xla_a=1", f"--xla_a=1 {emitter} {loop}"),
        ("--xla_backend_extra_options=other", f"--xla_backend_extra_options=other {emitter}"),
        ("--xla_cpu_use_fusion_emitters=true", f"--xla_cpu_use_fusion_emitters=true {loop}"),
    ):
        monkeypatch.setenv("XLA_FLAGS", before)
        compilation.prepare_jax(cached=False)
        assert compilation.os.environ["XLA_FLAGS"].split() == after.split()
    # JAX that has computed something has read its options; JAX that is only imported has not.
    monkeypatch.setenv("XLA_FLAGS", "")
    for computed, after in ((True, ""), (False, f"{emitter} {loop}")):
        bridge = SimpleNamespace(backends_are_initialized=lambda computed=computed: computed)
        modules = {"jax": None, "jax._src.xla_bridge": bridge}
        monkeypatch.setattr(precision, "sys", SimpleNamespace(modules=modules))
        compilation.prepare_jax(cached=False)
        assert compilation.os.environ["XLA_FLAGS"].split() == after.split()


def test_a_fit_from_python_sets_the_options_of_xla(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """(Before: the commands alone did, and a fit of a long decay from Python took twice as long.)"""
    monkeypatch.setattr(precision, "sys", SimpleNamespace(modules={}))
    monkeypatch.setenv("XLA_FLAGS", "")
    with pytest.raises(cid.InputError):
        cid.fit(tmp_path / "none")
    assert os.environ["XLA_FLAGS"].split() == [precision.XLA_EMITTER_OPTION, precision.XLA_LOOP_OPTION]


def test_blas_takes_one_thread(tmp_path: Path) -> None:
    """The variable is set before NumPy is imported, which reads it then; the user's own value stays."""
    name = compilation.BLAS_THREADS
    before = "import atexit, os, sys\nfrom capsule_id import cli\nassert 'numpy' not in sys.modules\n"
    before += f"atexit.register(lambda: print(os.environ['{name}']))\n"
    for own, expected in ((None, "1"), ("3", "3")):
        done = run("--version", cwd=tmp_path, before=before, env=environment(**{name: own}))
        assert done.stdout.split()[-1] == expected, done.stderr


def simulated(folder: Path, cache: Path, *options: str) -> tuple[bytes, str]:
    """The table that ``simulate`` writes with a cache in ``cache``, and its standard error."""
    variables = dict.fromkeys((name for name in os.environ if name.startswith("JAX_")), None)
    out = folder / "run.csv"
    words = (*MOTION, "--out", str(out), *options)
    done = run(*words, cwd=folder, name="capsule_id", env=environment(**variables, XDG_CACHE_HOME=str(cache)))
    assert done.returncode == 0, done.stderr
    return out.read_bytes(), done.stderr


@pytest.mark.full
def test_programs_are_kept_and_a_damaged_cache_is_replaced(tmp_path: Path) -> None:
    cache = tmp_path / "cache"
    plain = simulated(tmp_path, cache, "--no-cache")
    assert not cache.exists()
    assert simulated(tmp_path, cache) == plain
    damaged = {program: program.read_bytes()[:-100] for program in cache.glob("capsule-id/*/*-cache")}
    assert damaged
    for program, content in damaged.items():
        program.write_bytes(content)
    found, said = simulated(tmp_path, cache)
    assert found == plain[0]
    assert "the cache of compiled programs was damaged and is removed" in said
    assert not any(program.exists() and program.read_bytes() == content for program, content in damaged.items())


@pytest.fixture
def variables(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> dict[str, str]:
    """The environment of a process that has not imported JAX; the user's cache directory is ``tmp_path``."""
    environ = {"XDG_CACHE_HOME": str(tmp_path), "HOME": str(tmp_path)}
    monkeypatch.setattr(compilation.os, "environ", environ)
    monkeypatch.setattr(compilation, "sys", SimpleNamespace(modules={}))
    monkeypatch.setattr(precision, "sys", SimpleNamespace(modules={}))
    return environ


def test_a_cache_that_cannot_be_written_is_left_out(variables: dict[str, str], tmp_path: Path) -> None:
    (tmp_path / "capsule-id").write_text("")
    compilation.prepare_jax(cached=True)
    assert compilation.DIRECTORY not in variables
    (tmp_path / "capsule-id").unlink()
    compilation.prepare_jax(cached=True)  # negative control
    assert Path(variables[compilation.DIRECTORY]).parent == tmp_path / "capsule-id"


def test_the_users_own_cache_is_left_alone(variables: dict[str, str], tmp_path: Path) -> None:
    own = tmp_path / "own"
    own.mkdir()
    variables[compilation.DIRECTORY] = str(own)
    compilation.prepare_jax(cached=True)
    assert variables[compilation.DIRECTORY] == str(own)
    damaged = f"{compilation.CACHE_ERRORS[0]} for 'x': ValueError: x"
    assert compilation.leave_cache(damaged) == damaged
    assert own.exists()


def test_kinds_of_experiments_leave_the_options_of_xla_open(tmp_path: Path) -> None:
    """They import JAX before a command sets its options: these act until JAX computes, and the cache is in use then."""
    before = (
        "import sys\nfrom capsule_id.experiments.kind import default_registry\ndefault_registry()\n"
        "from capsule_id.commands import compilation\nfrom capsule_id.precision import XLA_LOOP_OPTION\n"
        "compilation.prepare_jax(cached=True)\nimport jax, os\n"
        "used = jax.config.jax_compilation_cache_dir\n"
        "assert used == os.environ[compilation.DIRECTORY] == str(compilation.cache_directory())\n"
        "assert XLA_LOOP_OPTION in os.environ['XLA_FLAGS']\n"
        "assert jax.config.jax_persistent_cache_min_compile_time_secs == 0.3\n"
    )
    own = dict.fromkeys((name for name in os.environ if name.startswith(("JAX_", "XLA_"))), None)
    done = run("--version", cwd=tmp_path, before=before, env=environment(**own, XDG_CACHE_HOME=str(tmp_path / "cache")))
    assert done.returncode == 0, done.stderr
