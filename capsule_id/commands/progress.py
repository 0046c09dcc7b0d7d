"""Shows the progress of long computations on standard error."""

import shutil
import sys
import time

#: Seconds between two updates of the progress, on a terminal and in a file.
TERMINAL_INTERVAL, FILE_INTERVAL = 0.1, 10.0


class Progress:
    """Stage, rate and time left: a bar on a terminal, a line every ``FILE_INTERVAL`` in a file."""

    def __init__(self, enabled: bool, unit: str = "draw") -> None:
        self._enabled, self._unit = enabled, unit
        self._terminal = sys.stderr.isatty()
        self._stage, self._began, self._first, self._shown = "", 0.0, 0, 0.0
        self._open = False

    def __enter__(self) -> "Progress":
        return self

    def __exit__(self, *_: object) -> None:
        self._end_line()

    def __call__(self, done: int, total: int, stage: str) -> None:
        """Show ``done`` of ``total`` draws (or points) in ``stage``; a stage without a count has total 1."""
        if not self._enabled:
            return
        now = time.monotonic()
        if stage != self._stage:
            self._end_line()
            self._stage, self._began, self._first = stage, now, done
        elif now - self._shown < (TERMINAL_INTERVAL if self._terminal else FILE_INTERVAL):
            return
        self._shown = now
        self._show(self._line(done, total, now - self._began))

    def _line(self, done: int, total: int, elapsed: float) -> str:
        if total <= 1:
            return f"{self._stage} ..."
        from tqdm import tqdm

        width = shutil.get_terminal_size().columns - 1 if self._terminal else None
        plain = not self._terminal
        return tqdm.format_meter(done, total, elapsed, width, self._stage, plain, self._unit, initial=self._first)

    def _show(self, line: str) -> None:
        try:
            sys.stderr.write(f"\r\x1b[K{line}" if self._terminal else f"{line}\n")
            sys.stderr.flush()
        except OSError:
            self._enabled = False  # the stream is closed
        self._open = self._terminal

    def _end_line(self) -> None:
        if self._open and self._enabled:
            sys.stderr.write("\n")
            self._open = False
