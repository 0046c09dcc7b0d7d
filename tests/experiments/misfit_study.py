"""Studies of calibration under misfit: shares of clean and of covered results, twin by twin on the command line."""

import sys
from collections.abc import Callable, Sequence
from typing import Protocol, TypeVar

import numpy as np


class Outcome(Protocol):
    """Result of one twin: its misfit, errors in units of their sd, and whether no check failed."""

    @property
    def misfit(self) -> str: ...

    @property
    def z(self) -> tuple[float, ...]: ...

    @property
    def clean(self) -> bool: ...


AnyOutcome = TypeVar("AnyOutcome", bound=Outcome)


def coverage(outcomes: Sequence[Outcome]) -> tuple[float, float, float]:
    """Share of clean results; of those, shares of parameters within 1.96 sd and beyond 4 sd (NaN without any)."""
    z = np.abs([one for each in outcomes if each.clean for one in each.z])
    shares = (float(np.mean(z < 1.96)), float(np.mean(z > 4.0))) if len(z) else (np.nan, np.nan)
    return float(np.mean([each.clean for each in outcomes])), *shares


def study(misfits: Sequence[str], outcome: Callable[[str, int], AnyOutcome]) -> None:
    """Print the outcomes of NUMBER twins of each misfit and their coverage; arguments NUMBER [FIRST_SEED]."""
    number, first = int(sys.argv[1]), int(sys.argv[2]) if len(sys.argv) > 2 else 0
    found = []
    for seed in range(first, first + number):
        for misfit in misfits:
            found.append(outcome(misfit, seed))
            print(found[-1], flush=True)
    for misfit in misfits:
        print(misfit, coverage([each for each in found if each.misfit == misfit]))
    print("all", coverage(found))
