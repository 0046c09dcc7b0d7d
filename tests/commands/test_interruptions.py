"""Interruptions of a fit at random times, some during a compilation: it ends in time, and ``--resume`` repeats it."""

import hashlib
import os
import shutil
import signal
import subprocess
import threading
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from capsule_id import console
from capsule_id.console import GRACE, interruptible, stop_if_interrupted
from tests.cli_tools import DATA, argv, environment, same_result, small_rig

#: Longest time between a signal and the end of the process, s.
LONGEST = 5.0
#: A fit of a few seconds that saves its chains after every draw.
SHORT = "from capsule_id.inference import moves, sampling\nmoves.SAVE_EVERY = 0.0\n"
SHORT += "sampling.FIRST_CHECK, sampling.CHECK_EVERY, sampling.PILOT_STEPS = 15, 15, 60\n"
#: The step that starts the first ensemble hangs; the time until the process is ended is short.
HANGING = "import time\nfrom capsule_id import console\nfrom capsule_id.inference import sampling\n"
HANGING += "console.GRACE = 0.5\nsampling.pilot = lambda *_: open('hanging', 'w').close() or time.sleep(60)\n"

#: The step that starts the first ensemble waits for an interruption, while a worker thread computes for a minute.
WORKING = "import time\nfrom concurrent.futures import ThreadPoolExecutor\nfrom capsule_id import console\n"
WORKING += "from capsule_id.inference import sampling\nconsole.GRACE = 1.0\n"
WORKING += "def step(*_):\n    ThreadPoolExecutor(1).submit(time.sleep, 60)\n    open('working', 'w').close()\n"
WORKING += "    while True:\n        console.stop_if_interrupted()\n        time.sleep(0.01)\nsampling.pilot = step\n"
#: The last step of the command takes half a second, while a worker thread computes for a minute.
LAST = "import time\nfrom concurrent.futures import ThreadPoolExecutor\nfrom capsule_id import console\n"
LAST += "from capsule_id.commands import fit\nconsole.GRACE = 1.0\nrun = fit.run\ndef last(args):\n"
LAST += "    code = run(args)\n    ThreadPoolExecutor(1).submit(time.sleep, 60)\n    open('last', 'w').close()\n"
LAST += "    time.sleep(0.5)\n    return code\nfit.run = last\n"


def start(folder: Path, *words: str, before: str = "", cache: bool = False) -> subprocess.Popen[str]:
    """Start ``fit-params``, by default without compiled programs from disk; ``folder/log`` shows every compilation."""
    before = f"import logging\nlogging.basicConfig()\n{before}"  # libraries' logs are shown where a program wants them
    env = environment(JAX_ENABLE_COMPILATION_CACHE=str(int(cache)), JAX_LOG_COMPILES="1")
    with (folder / "log").open("w", encoding="utf-8") as log:
        return subprocess.Popen(
            argv(*words, before=before), cwd=folder, env=env, stdout=subprocess.DEVNULL, stderr=log, text=True
        )


def compilations(folder: Path) -> int:
    """Number of compilations that the log shows."""
    return (folder / "log").read_text(encoding="utf-8").count("with global shapes")


def wait_until(condition: Callable[[], bool], fit: subprocess.Popen[str]) -> None:
    """Wait until ``condition`` holds or the process has ended."""
    while not condition() and fit.poll() is None:
        time.sleep(0.005)


def interrupt(fit: subprocess.Popen[str], number: signal.Signals) -> float:
    """Send a signal; return the time until the process has ended, s. A process that has finished keeps its code."""
    sent = time.monotonic()
    fit.send_signal(number)
    fit.wait(timeout=60)
    return time.monotonic() - sent


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_is_read_at_the_next_step(number: signal.Signals, request: pytest.FixtureRequest) -> None:
    # A shell lets its background jobs ignore SIGINT; a handler that ignores stays.
    request.addfinalizer(partial(signal.signal, number, signal.getsignal(number)))
    before = signal.default_int_handler
    signal.signal(number, before)
    with interruptible("ended"):
        stop_if_interrupted()
        signal.raise_signal(number)  # raises nothing: a callback cannot swallow it
        with pytest.raises(KeyboardInterrupt):
            stop_if_interrupted()
    stop_if_interrupted()  # the flag ends with the block
    assert signal.getsignal(number) is before


def test_the_time_counts_from_the_signal_and_not_from_its_handler() -> None:
    """Python calls the handler after a long call into C, and the process then had the whole time once more."""
    before = time.monotonic()
    with interruptible("ended"):
        threading.Timer(0.05, os.kill, [os.getpid(), signal.SIGTERM]).start()
        hashlib.pbkdf2_hmac("sha256", b"", b"", 2_000_000)
        after = time.monotonic()
        with pytest.raises(KeyboardInterrupt):
            stop_if_interrupted()
    (arrival,) = console._arrivals
    assert before < arrival < before + 0.5 * (after - before)


def test_a_command_that_has_finished_keeps_its_code_and_ends_in_time(tmp_path: Path) -> None:
    """The signal arrives in the last step; a worker thread would keep the process for a minute."""
    small_rig(tmp_path / "rig")
    fit = start(tmp_path, "rig", "--no-sample", "--out", "out", "--quiet", before=LAST, cache=True)
    wait_until((tmp_path / "last").exists, fit)
    assert interrupt(fit, signal.SIGTERM) < 1.0 + LONGEST - GRACE
    assert fit.returncode in (0, 3)


def test_a_step_that_does_not_end_is_ended(tmp_path: Path) -> None:
    small_rig(tmp_path / "rig")
    fit = start(tmp_path, "rig", "--out", "out", "--quiet", before=HANGING, cache=True)
    wait_until((tmp_path / "hanging").exists, fit)
    assert 0.5 <= interrupt(fit, signal.SIGTERM) < 0.5 + LONGEST - GRACE
    assert fit.returncode == 130
    assert (tmp_path / "log").read_text(encoding="utf-8").splitlines()[
        -1
    ] == "fit-params: interrupted; --resume continues from the saved state"


@pytest.mark.full
def test_a_worker_thread_that_does_not_end_is_ended(tmp_path: Path) -> None:
    """The main thread ends at once; Python would then wait for the worker."""
    small_rig(tmp_path / "rig")
    fit = start(tmp_path, "rig", "--out", "out", "--quiet", before=WORKING, cache=True)
    wait_until((tmp_path / "working").exists, fit)
    assert interrupt(fit, signal.SIGTERM) < 1.0 + LONGEST - GRACE
    assert fit.returncode == 130


@pytest.mark.full
def test_interrupted_in_a_compilation_and_in_the_sample(tmp_path: Path) -> None:
    small_rig(tmp_path / "rig")
    words = ("rig", "--quiet", "--max-steps", "60", "--ess", "100000")
    first = start(tmp_path, *words, "--out", "out", before=SHORT)
    wait_until(lambda: compilations(tmp_path) >= 2, first)
    assert interrupt(first, signal.SIGTERM) < LONGEST
    assert first.returncode == 130
    second = start(tmp_path, *words, "--out", "out", "--resume", before=SHORT, cache=True)
    wait_until((tmp_path / "out.partial" / "chains.saved").exists, second)
    assert interrupt(second, signal.SIGINT) < LONGEST
    assert second.returncode == 130
    assert start(tmp_path, *words, "--out", "out", "--resume", before=SHORT, cache=True).wait() == 0
    assert start(tmp_path, *words, "--out", "whole", before=SHORT, cache=True).wait() == 0
    same_result(tmp_path / "out", tmp_path / "whole")


@pytest.mark.slow
@pytest.mark.parametrize(("experiments", "trials", "compiling"), [("bench", 150, 30), ("all", 20, 6)])
def test_many_interruptions(tmp_path: Path, experiments: str, trials: int, compiling: int) -> None:
    """Signals at random times of a fit of ``data/``; ``compiling`` of them at the beginning of a compilation.

    Those at a compilation find no compiled programs on disk, the others find them as a user does.
    """
    words = (str(DATA), "--experiments", experiments, "--quiet", "--max-steps", "300")
    code = start(tmp_path, *words, "--out", "whole").wait()
    compiled = compilations(tmp_path)
    began = time.monotonic()
    assert start(tmp_path, *words, "--out", "again", cache=True).wait() == code
    length = time.monotonic() - began
    random = np.random.default_rng(11)
    ends = []
    for trial in range(trials):
        fit = start(tmp_path, *words, "--out", "out", cache=trial >= compiling)
        if trial < compiling:
            number = int(random.integers(1, compiled + 1))
            wait_until(lambda number=number: compilations(tmp_path) >= number, fit)
        else:
            time.sleep(random.uniform(0.3, length))
        if fit.poll() is None:
            ends.append(interrupt(fit, (signal.SIGINT, signal.SIGTERM)[trial % 2]))
            print(f"{experiments} {trial}: exit {fit.returncode} after {ends[-1]:.2f} s", flush=True)
            assert ends[-1] < LONGEST
        if fit.returncode == 130:
            assert not (tmp_path / "out").exists()
            resume = ["--resume"] if (tmp_path / "out.partial").exists() else []
            assert start(tmp_path, *words, "--out", "out", *resume, cache=True).wait() == code
        else:
            assert fit.returncode == code
        same_result(tmp_path / "out", tmp_path / "whole")
        shutil.rmtree(tmp_path / "out")
    print(
        f"{experiments}: {len(ends)} interrupted, longest {max(ends):.2f} s, fit {length:.0f} s, {compiled} compilations"
    )
    assert len(ends) > trials // 2
