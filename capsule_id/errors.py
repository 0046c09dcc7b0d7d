"""The exception for bad input; it names place, rule, value and remedy."""

from pathlib import Path


class InputError(ValueError):
    """Bad input. A command prints it in one line and returns exit code 2.

    Parameters
    ----------
    rule : what must hold, e.g. "angle must lie between 0 and 90 deg"
    value : what was found instead, e.g. "95"
    remedy : what to do, e.g. "give the tilt angle at sliding"
    file, line, column : the place, 1-based, as far as known
    """

    def __init__(
        self,
        rule: str,
        value: str,
        remedy: str,
        file: str | Path = "",
        line: int | None = None,
        column: int | None = None,
    ) -> None:
        self.rule, self.value, self.remedy = rule, value, remedy
        self.file, self.line, self.column = str(file), line, column
        place = ":".join(str(part) for part in (self.file, line, column) if part not in ("", None))
        message = f"{rule}, {value}, {remedy}"
        super().__init__(" ".join((f"{place}: {message}" if place else message).split()))
