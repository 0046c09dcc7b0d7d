"""Standard streams, the progress of long computations, and interruptions by Ctrl-C or SIGTERM."""

import errno
import io
import logging
import math
import os
import re
import shutil
import signal
import socket
import sys
import tempfile
import threading
import time
import traceback
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, chdir, contextmanager, suppress
from importlib import import_module
from pathlib import Path
from types import MappingProxyType
from typing import Any

from capsule_id.errors import InputError, OutputError, printable

# interruption: Interruptions by Ctrl-C or SIGTERM: the handler sets a flag, long computations read it between their
# steps.
#
# The handler raises nothing, so that no callback can swallow the interruption. A step may be long (a compilation).
# Therefore a thread, woken by the signal itself, ends the process if the main thread has not ended in time.


#: Exit code of an interrupted command.
INTERRUPTED = 130
#: Time that the process has to end by itself after a signal, s.
GRACE = 4.0
_SIGNALS = frozenset({signal.SIGINT, signal.SIGTERM})
_flag = threading.Event()
#: ``left``: the event of the ``threads`` block that this thread works for.
_worker = threading.local()
_arrivals: list[float] = []
#: Set while ``--resume`` can continue what this command does.
saved = threading.Event()


def ending(message: str) -> str:
    """``message`` of a command that ends early, and whether ``--resume`` continues."""
    return f"{message}{'; --resume continues from the saved state' if saved.is_set() else ''}"


def stop_if_interrupted() -> None:
    """Raise ``KeyboardInterrupt`` if a signal has arrived in an ``interruptible`` block; call this between steps.

    Also in a worker of ``threads`` whose block was left by an error.
    """
    left: threading.Event | None = getattr(_worker, "left", None)
    if _flag.is_set() or (left is not None and left.is_set()):
        raise KeyboardInterrupt


@contextmanager
def threads(number: int) -> Iterator[ThreadPoolExecutor]:
    """Worker threads. Where the block is left by an error, as by Ctrl-C in Python, their work ends at its next step."""
    left = threading.Event()
    with ThreadPoolExecutor(number, initializer=setattr, initargs=(_worker, "left", left)) as workers:
        try:
            yield workers
        except BaseException:
            left.set()
            workers.shutdown(wait=False, cancel_futures=True)
            raise


@contextmanager
def interruptible(message: str) -> Iterator[None]:
    """In the block SIGINT and SIGTERM set the flag of ``stop_if_interrupted``; ``GRACE`` seconds later the process ends.

    Signals that the process ignores stay ignored. Outside the main thread the block changes nothing.

    Parameters
    ----------
    message : line on standard error where the process is ended with exit code ``INTERRUPTED``
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    receiver, sender = socket.socketpair()
    sender.setblocking(False)
    # None: installed outside Python, cannot be restored.
    before = {n: h for n in _SIGNALS if (h := signal.getsignal(n)) not in (signal.SIG_IGN, None)}
    ended = threading.Event()
    _arrivals.clear()
    watchdog = threading.Thread(target=_watch, args=(receiver, ended, message), name="watchdog", daemon=True)
    watchdog.start()
    wakeup = signal.set_wakeup_fd(sender.fileno(), warn_on_full_buffer=False)
    for number in before:
        signal.signal(number, lambda *_: _flag.set())
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        signal.set_wakeup_fd(wakeup)
        ended.set()
        sender.close()
        watchdog.join()
        receiver.close()
        _flag.clear()


def end_interrupted(code: int) -> None:
    """End the process at once with ``code`` if a signal has arrived in the last ``interruptible`` block.

    Python's own end waits for worker threads and compilations, and stops the threads that could end the process in time.
    """
    if not _arrivals and code != INTERRUPTED:
        return
    # A full pipe blocks the flush.
    left = GRACE - (time.monotonic() - _arrivals[0]) if _arrivals else GRACE
    timer = threading.Timer(max(left, 0.0), os._exit, [code])
    timer.daemon = True
    timer.start()
    for stream in (sys.stdout, sys.stderr):
        with suppress(OSError, ValueError):
            stream.flush()
    os._exit(code)


def _watch(receiver: socket.socket, ended: threading.Event, message: str) -> None:
    """Wait for a signal, then for the end of the block; end the process if that takes longer than ``GRACE``."""
    while arrived := receiver.recv(64):
        if _SIGNALS & set(arrived):
            # The handler would be late: Python calls it after a compilation.
            _arrivals.append(time.monotonic())
            if not ended.wait(GRACE):
                os.write(2, f"{ending(message)}\n".encode())  # sys.stderr may be locked by the main thread
                os._exit(INTERRUPTED)
            return


# console: Standard streams that may be closed or have another encoding; the progress of long computations.


#: Called with (number of draws or points done, total number, name of the stage).
OnProgress = Callable[[int, int, str], None]
#: Seconds between two updates of the progress, on a terminal and in a file.
TERMINAL_INTERVAL, FILE_INTERVAL = 0.1, 10.0
#: Colours of terminals: green, yellow, red. The words are those of ``views.Level`` and ``views.Trust``.
_COLOURS = {"ok": 32, "trusted": 32, "warn": 33, "not judged": 33, "fail": 31, "not trusted": 31}
_COLOURED = re.compile(r"^(?:ok|warn|fail)(?=[ :])|\b(?:not trusted|not judged|trusted)\b", re.MULTILINE)
#: Longest message of an exception in an error line, characters.
LONGEST_MESSAGE = 300
#: Width of a line in a notebook, and of the longest bar, characters; least share of the work that gives a time left.
NOTEBOOK_WIDTH, LONGEST_BAR, LEAST_SHARE = 100, 30, 0.1
#: Stages of a fit with a sample, and the share of the time that each takes on ``data/``.
FIT_STAGES = {"readings": 0.02, "point fit": 0.45, "burn-in": 0.08, "sampling": 0.1, "report": 0.35}


def prepare() -> None:
    """Open missing standard streams, make standard output accept any character, and keep it free of libraries' remarks."""
    # The null device takes the number of a closed stream, so no data file gets this number.
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, mode, encoding="utf-8"))  # noqa: PTH123, SIM115
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="replace")
    if not logging.getLogger().handlers:  # else a library's log goes to standard error, as on a matplotlibrc
        logging.getLogger().addHandler(logging.NullHandler())
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")  # XLA's, as on a slow compilation
    saved.clear()
    if "matplotlib" not in sys.modules:  # its figures have a style and a backend of their own
        os.environ |= {"MPLBACKEND": "agg", "MATPLOTLIBRC": os.devnull}
        if Path("matplotlibrc").is_file():  # matplotlib reads it first, and ends where it is no UTF-8
            with chdir(Path(__file__).parent):
                import_module("matplotlib")


def say(text: str, coloured: bool = False) -> None:
    """Print to standard output and flush; a closed pipe (``| head``) is no error.

    coloured : words of trust, and levels at the begin of a line, have a colour on a terminal, unless NO_COLOR is set
    """
    text = printable(text)
    if coloured and sys.stdout.isatty() and not os.environ.get("NO_COLOR") and os.environ.get("TERM") != "dumb":
        text = _COLOURED.sub(lambda word: f"\x1b[{_COLOURS[word[0]]}m{word[0]}\x1b[0m", text)
    try:
        print(text, flush=True)
    except OSError as error:
        _discard(error)


def complain(text: object) -> None:
    """Print to standard error and flush; a stream that takes no more is no error."""
    with suppress(OSError):
        print(printable(str(text)), file=sys.stderr, flush=True)


def finish() -> None:
    """Flush standard output; otherwise the interpreter reports a failed flush at exit."""
    try:
        sys.stdout.flush()
    except OSError as error:
        _discard(error)


def _discard(error: OSError) -> None:
    """Discard what follows; a closed pipe, which Windows calls an invalid argument, is no error.

    Raises
    ------
    OutputError
        For any other error.
    """
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    if error.errno not in (errno.EPIPE, errno.EINVAL):
        raise OutputError(f"standard output cannot be written: {error.strerror}; direct it elsewhere") from error


def one_line(error: BaseException) -> str:
    """Type and message of an exception, at most ``LONGEST_MESSAGE`` characters."""
    return " ".join(f"{type(error).__name__}: {error}".split())[:LONGEST_MESSAGE]


@contextmanager
def refusing_damage(rule: str, remedy: str, path: Path, shown: Callable[[Exception], str] = one_line) -> Iterator[None]:
    """Turn every exception of the body about a damaged file into an error line.

    Libraries document no list of exceptions for damaged files, and fuzzing finds most of Python's.

    Raises
    ------
    InputError
        Where the body raises an exception; an ``InputError`` passes unchanged.
    """
    try:
        yield
    except InputError:
        raise
    except Exception as error:
        raise InputError(rule, shown(error), remedy, path) from error


def save_traceback(error: BaseException) -> str:
    """Save the traceback of an exception and return a text with its place."""
    try:
        with tempfile.NamedTemporaryFile(
            "w", prefix="capsule-id-", suffix=".txt", delete=False, encoding="utf-8", errors="backslashreplace"
        ) as file:
            traceback.print_exception(error, file=file)
    except OSError as unwritable:
        return f"its traceback could not be saved: {one_line(unwritable)}"
    return f"traceback in {file.name}"


def fit_stages(sampled: bool) -> dict[str, float]:
    """Stages of a fit and their shares of its duration, as measured on ``data/``."""
    return {name: share for name, share in FIT_STAGES.items() if sampled or name not in ("burn-in", "sampling")}


class Progress(AbstractContextManager["Progress"]):
    """Stage, share done and time left: a bar on a terminal or in a notebook, a line every ``FILE_INTERVAL`` in a file.

    The share never falls and the time left never rises while one bar lasts.

    enabled : None: on a terminal and in a notebook
    unit : what is counted where ``stages`` is empty
    stages : names and shares of the stages that one bar covers; else a bar lasts until a new stage counts from below
    """

    def __init__(
        self, enabled: bool | None = None, unit: str = "draw", stages: Mapping[str, float] = MappingProxyType({})
    ) -> None:
        # A kernel's streams take no escape codes: there the bar is an output that is replaced.
        self._notebook = type(sys.stderr).__module__.startswith("ipykernel.")
        self._terminal = sys.stderr.isatty() or self._notebook
        self._enabled, self._unit, self._stages = self._terminal if enabled is None else enabled, unit, dict(stages)
        self._stage, self._began, self._shown = "", 0.0, 0.0
        self._first, self._share, self._left = 0.0, 2.0, math.inf
        self._open = self._displayed = False

    def __exit__(self, *_: object) -> None:
        self._end_line()

    def __call__(self, done: int, total: int, stage: str) -> None:
        """Show ``done`` of ``total`` draws (or points) in ``stage``; a stage without a count has total 1."""
        if not self._enabled:
            return
        now, share, known = time.monotonic(), done / max(total, 1), list(self._stages)
        if stage in known:
            before = sum(self._stages[name] for name in known[: known.index(stage)])
            share = (before + share * self._stages[stage]) / sum(self._stages.values())
        fresh = stage != self._stage
        if self._share > 1.0 or (fresh and stage not in known and share < self._share):
            self._end_line()
            self._began, self._first, self._share, self._left = now, share, share, math.inf
        elif not fresh and now - self._shown < (TERMINAL_INTERVAL if self._terminal else FILE_INTERVAL):
            return
        self._stage, self._shown, self._share = stage, now, max(self._share, share)
        if (passed := self._share - self._first) > LEAST_SHARE:
            self._left = min(self._left, (now - self._began) * (1.0 - self._share) / passed)
        self._show(self._line(done, total, now - self._began))

    def note(self, text: str) -> None:
        """Show lines of text that stay."""
        if self._enabled:
            self._end_line()
            self._stage = ""
            self._show(text)
            self._end_line()

    def _line(self, done: int, total: int, elapsed: float) -> str:
        known, words = list(self._stages), self._stage
        if words in known:
            words = f"{known.index(words) + 1} of {len(known)}: {words}{_compiling() if words == 'point fit' else ''}"
        elif total > 1:
            rate = f", {(self._share - self._first) * total / elapsed:.3g} {self._unit}s/s" if elapsed > 0.0 else ""
            words = f"{words}: {done}/{total}{rate}"
        else:
            return f"{words} ..."
        left = "" if math.isinf(self._left) else f", {_clock(self._left)} left"
        end = f" {math.floor(100.0 * self._share)} %, {_clock(elapsed)}{left}"
        width = NOTEBOOK_WIDTH if self._notebook else shutil.get_terminal_size().columns - 1
        room = min(width - len(words) - len(end) - 3, LONGEST_BAR) if self._terminal else 0
        full = int(room * self._share)
        return f"{words} [{'#' * full}{'.' * (room - full)}]{end}" if room > 0 else f"{words}{end}"

    def _show(self, line: str) -> None:
        line = printable(line)
        if self._notebook:
            place: dict[str, Any] = {"display_id": f"progress {id(self)}", "update": self._displayed}
            import_module("IPython.display").display({"text/plain": line}, raw=True, **place)
            self._displayed = True
            return
        try:
            sys.stderr.write(f"\r\x1b[K{line}" if self._terminal else f"{line}\n")
            sys.stderr.flush()
        except OSError:
            self._enabled = False  # the stream is closed
        self._open = self._terminal

    def _end_line(self) -> None:
        if self._open and self._enabled:
            with suppress(OSError):
                sys.stderr.write("\n")
            self._open = False


def _clock(seconds: float) -> str:
    """A duration as minutes and seconds, rounded up."""
    return "{:02d}:{:02d}".format(*divmod(math.ceil(seconds), 60))


def _compiling() -> str:
    """Words for a point fit that compiles its programs, "" where a cache holds programs of an earlier one."""
    with suppress(OSError, KeyError):
        cache = Path(os.environ["JAX_COMPILATION_CACHE_DIR"])
        return "" if any(cache.iterdir()) else ", compiling (once per machine)"
    return ", compiling"
