"""Interruptions by Ctrl-C or SIGTERM: the handler sets a flag, long computations read it between their steps.

The handler raises nothing, so that no callback can swallow the interruption. A step may be long (a compilation).
Therefore a thread, woken by the signal itself, ends the process if the main thread has not ended in time.
"""

import os
import signal
import socket
import sys
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from types import FrameType

#: Exit code of an interrupted command.
INTERRUPTED = 130
#: Time that the process has to end by itself after a signal, s.
GRACE = 4.0
_SIGNALS = frozenset({signal.SIGINT, signal.SIGTERM})
_flag = threading.Event()
#: ``left``: the event of the ``threads`` block that this thread works for.
_worker = threading.local()
_arrivals: list[float] = []


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
    """SIGINT and SIGTERM set the flag of ``stop_if_interrupted``; after ``GRACE`` seconds they end the process.

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
        signal.signal(number, _set_flag)
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


def _set_flag(number: int, frame: FrameType | None) -> None:
    del number, frame
    _flag.set()


def _watch(receiver: socket.socket, ended: threading.Event, message: str) -> None:
    """Wait for a signal, then for the end of the block; end the process if that takes longer than ``GRACE``."""
    while arrived := receiver.recv(64):
        if _SIGNALS & set(arrived):
            # The handler would be late: Python calls it after a compilation.
            _arrivals.append(time.monotonic())
            if not ended.wait(GRACE):
                os.write(2, f"{message}\n".encode())  # sys.stderr may be locked by the main thread
                os._exit(INTERRUPTED)
            return
