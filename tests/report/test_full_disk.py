"""A full disk ends a command with one line that names the folder, and exit code 1; ``--resume`` gives the same numbers."""

import errno
import os
import shutil
import subprocess
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from capsule_id.cli import capsule_id, fit_params
from capsule_id.commands import compilation
from capsule_id.errors import OutputError
from capsule_id.inference.moves import ChainStore
from capsule_id.motions import sweep
from capsule_id.report.write import write_result
from tests.cli_tools import Killed, argv, environment, failing, listing, same_result, small_rig

resource = pytest.importorskip("resource", reason="limits of files are those of POSIX")
#: Sizes of the largest file that the disk takes: 16 kB to 64 MB.
SIZES = [2**power for power in range(14, 27)]
WORDS = ("rig", "--quiet", "--max-steps", "60")


@contextmanager
def limited(size: int) -> Iterator[None]:
    """Files of at most ``size`` bytes, in this process."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def test_a_result_needs_what_is_said(files: dict[str, bytes], tmp_path: Path) -> None:
    refused = 0
    largest = max(map(len, files.values()))
    for size in SIZES:
        text = ""
        with limited(size):
            try:
                write_result(files, tmp_path)
            except OutputError as error:
                text = str(error)
        if size < largest:
            refused += 1
            assert text.startswith(f"{tmp_path}")
            assert "cannot be written: File too large; at least " in text
            needed = float(text.partition("at least ")[2].partition(" MB")[0])
            assert size < 1e6 * needed <= sum(map(len, files.values())) + 5e3
        else:
            assert text == ""
    assert 0 < refused < len(SIZES)


def test_the_last_copy_of_the_chains_stays(tmp_path: Path) -> None:
    """HDF5 itself ends the process where it cannot write; the file that emcee writes is in memory."""
    store = tmp_path / "chains.saved"
    with ChainStore(store, "one") as chains:
        chains.save()
        before = listing(tmp_path)
        chains._file["draws"] = np.random.default_rng(0).normal(size=100_000)
        with limited(2**16), pytest.raises(OutputError, match=r"at least \d.\d\d MB are needed; .* MB are left"):
            chains.save()
        assert listing(tmp_path) == before
        chains.save()
    with ChainStore(store, "one") as chains:
        assert "draws" in chains._file


def test_a_block_of_a_map_is_saved_whole_or_not_at_all(tmp_path: Path) -> None:
    part = {"status": np.zeros(20_000)}
    sweep._save_block(tmp_path, 0, {"status": np.ones(3)}, 1)
    with limited(2**16), pytest.raises(OutputError, match=r"at least 0\.48 MB are needed"):
        sweep._save_block(tmp_path, 0, part, 3)
    assert [path.name for path in tmp_path.iterdir()] == [sweep._file(tmp_path, 0).name]
    assert (sweep._saved_block(tmp_path, 0) or {})["status"].size == 3


def test_a_cache_that_is_full_is_left(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """It is removed where a part of a program may be in it, and used no more; the user's own stays."""
    import jax

    monkeypatch.setattr(compilation, "cache_directory", lambda: tmp_path / "cache")
    monkeypatch.setattr(jax.config, "update", lambda *words, **options: switched.append((words, options)))
    for doing, named, kept in (("writing", "cache", False), ("reading", "cache", True), ("writing", "own", True)):
        switched: list[object] = []
        (tmp_path / "cache").mkdir(exist_ok=True)
        monkeypatch.setenv(compilation.DIRECTORY, str(tmp_path / named))
        message = f"Error {doing} persistent compilation cache entry for 'jit_x': OSError: [Errno 28] No space left"
        text = compilation.leave_cache(message)
        assert text.startswith("the cache of compiled programs cannot be used (OSError: [Errno 28] No space left); ")
        assert (len(switched), (tmp_path / "cache").exists()) == (1, kept)


def test_other_outputs_of_commands(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    motion = (
        "simulate",
        "--k2",
        "18960",
        "--P_d",
        "4",
        "--Omega",
        "34.56",
        "--G",
        "1e-3",
        "--periods",
        "1",
        "--no-cache",
    )
    for words, named in (
        ((*motion, "--out", str(tmp_path / "a.csv")), "a.csv"),
        ((*motion, "--out", str(tmp_path / "a.nc")), "a.nc"),
        (("synthesize", str(tmp_path / "rig")), "rig"),
        (("synthesize", str(tmp_path / "robot"), "--robot"), "robot"),
        (("init", str(tmp_path / "new")), "new"),
    ):
        (tmp_path / named).write_text("old") if "." in named else None
        # The limit is that of the outputs: the programs are compiled before, into the cache of the tests.
        assert (
            capsule_id([str(word).replace(str(tmp_path / named), str(tmp_path / f"first_{named}")) for word in words])
            == 0
        )
        capsys.readouterr()
        with limited(64):
            assert capsule_id(list(words)) == 1, words
        (line,) = capsys.readouterr().err.splitlines()
        assert "cannot be written: File too large; " in line
        assert str(tmp_path) in line
        assert "." not in named or (tmp_path / named).read_text() == "old"
    # Nothing is left of the cut files: the same command works when there is space.
    for words in (["init", "new"], ["synthesize", "rig"], ["synthesize", "robot", "--robot"]):
        assert capsule_id([words[0], str(tmp_path / words[1]), *words[2:]]) == 0


@pytest.mark.full
@pytest.mark.parametrize("every", [3, pytest.param(1, marks=pytest.mark.slow)])
def test_every_size_of_disk(tmp_path: Path, every: int) -> None:
    """A real process; no traceback and no end by a signal. The old result stays; a resumed run gives the same numbers."""
    small_rig(tmp_path / "rig")
    # A cache of its own: what a full disk leaves of a program would warn in other tests.
    env = environment(XDG_CACHE_HOME=str(tmp_path / "cache"), TMPDIR=str(tmp_path), JAX_COMPILATION_CACHE_DIR=None)
    ends = []
    for size in (None, *SIZES[::every], None):
        out = "whole" if size is None and not ends else "out"
        before = listing(tmp_path / out) if (tmp_path / out).exists() else {}
        limit = f"ulimit -f {size // 512}; " if size else ""  # in blocks of 512 bytes
        command = ["sh", "-c", f'{limit}exec "$@"', "sh", *argv(*WORDS, "--out", out)]
        done = subprocess.run(command, cwd=tmp_path, env=env, capture_output=True, text=True, check=False)
        ends.append((size, done.returncode))
        assert done.returncode in (0, 1), done.stderr
        if done.returncode:
            lines = [line for line in done.stderr.splitlines() if "warning: the cache" not in line]
            assert len(lines) == 1
            assert "out.partial cannot be written: File too large; at least" in lines[0]
            assert lines[0].endswith("; --resume continues from the saved state")
            assert (listing(tmp_path / out) if before else {}) == before
            assert fit_params_in(tmp_path, *WORDS, "--out", out, "--resume") == 0
        same_result(tmp_path / "whole", tmp_path / out)
        assert not list(tmp_path.glob("capsule-id-*"))
    assert 3 // every <= [code for _, code in ends].count(1) < len(ends) - 3 // every, ends


def fit_params_in(folder: Path, *words: str) -> int:
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        return fit_params(list(words))


@pytest.mark.full
@pytest.mark.parametrize("every", [12, pytest.param(1, marks=pytest.mark.slow)])
def test_a_fault_at_every_operation_of_a_fit(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], every: int
) -> None:
    """At every twelfth one, and at all of them in the study."""
    small_rig(tmp_path / "rig")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("capsule_id.inference.moves.SAVE_EVERY", np.inf)  # the operations are then the same
    # A short chain and few densities of readings: the files are the same ones, and every moment takes a fit or two.
    monkeypatch.setattr("capsule_id.inference.pipeline.POINTWISE", 4)
    short = ("rig", "--quiet", "--max-steps", "4", "--no-cache", "--out")
    words = (*short, "out")
    assert fit_params([*short, "whole"]) == 0
    moment, refused = 0, 0
    while True:
        capsys.readouterr()
        full = partial(OSError, errno.ENOSPC, os.strerror(errno.ENOSPC))
        with failing(full, moment, moment + 1) as operations:
            code = fit_params(list(words))
        if code:
            refused += 1
            error = capsys.readouterr().err
            assert (code, error.count("\n")) == (1, 1), operations[moment]
            assert " cannot be written: No space left on device; " in error, operations[moment]
            resume = ["--resume"] * ("--resume" in error)
            assert fit_params([*words, *resume]) == 0
        same_result(tmp_path / "whole", tmp_path / "out")
        shutil.rmtree(tmp_path / "out")
        if len(operations) <= moment:
            break
        moment += every
    assert refused >= 15 // every


#: A map of four points in four blocks.
MAP = ("bifurcate", "--over", "k2", "--from", "5e3", "--to", "5e4", "--points", "2", "--with", "f", "--with-from", "3")
MAP += ("--with-to", "6", "--with-points", "2", "--dropped", "20", "--observed", "6", "--quiet", "--no-cache")


@pytest.mark.full
@pytest.mark.parametrize("every", [3, pytest.param(1, marks=pytest.mark.slow)])
@pytest.mark.parametrize("error", [Killed, partial(OSError, errno.ENOSPC, os.strerror(errno.ENOSPC))])
def test_a_fault_at_every_operation_of_a_map(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    error: Callable[[], BaseException],
    every: int,
) -> None:
    """Both files are the old or the new ones; the next run ends, with the blocks that are saved or without."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sweep.compute, "__kwdefaults__", {**sweep.compute.__kwdefaults__, "block": 1})
    monkeypatch.setattr(sweep.motion_map, "__kwdefaults__", {**sweep.motion_map.__kwdefaults__, "block": 1})
    assert capsule_id([*MAP, "--out", "a.nc"]) == 0
    old, store = listing(tmp_path), tmp_path / "a.nc.partial"
    moment = 0
    while True:
        capsys.readouterr()
        code = None
        with failing(error, moment, None if error is Killed else moment + 1) as operations, suppress(Killed):
            code = capsule_id([*MAP, "--out", "a.nc"])
        if code:
            text = capsys.readouterr().err
            assert (code, text.count("\n")) == (1, 1), operations[moment]
            assert " cannot be written: No space left on device; " in text, operations[moment]
            assert listing(tmp_path)["a.nc"] == old["a.nc"]
        resume = ["--resume"] * ((store / sweep.FINGERPRINT).exists() and moment % 2)
        assert capsule_id([*MAP, "--out", "a.nc", *resume]) == 0, operations[moment]
        assert listing(tmp_path) == old
        if len(operations) <= moment:
            break
        moment += every
    assert moment >= 18
