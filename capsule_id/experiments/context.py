"""Interface between a fit and the checks and tables of an experiment."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from capsule_id.records.view import RecordView
from capsule_id.views import Finding, ResultTable


@dataclass(frozen=True)
class Tension:
    """Likelihood-ratio test that two groups of experiments share their parameters.

    Attributes
    ----------
    p : p-value of twice the increase of the log-posterior where each group has its own parameters, from chi-square with 1
        degree of freedom
    one, other : estimates from each group alone, SI, by name
    """

    p: float
    one: Mapping[str, float]
    other: Mapping[str, float]


@dataclass(frozen=True)
class RunRecord:
    """A recorded run as in the figures of the paper; ``force`` (n,) is the fitted drive at its samples, N."""

    name: str
    view: RecordView
    force: np.ndarray


class Fitted(Protocol):
    """A finished fit.

    Attributes
    ----------
    values : the point fit and the constants, SI, by name
    flagged : row indices of the outliers, by label
    draws : posterior draws, SI, by name; [] without a sample
    findings : findings of the checks so far
    """

    @property
    def values(self) -> Mapping[str, float]: ...

    @property
    def flagged(self) -> Mapping[str, Sequence[int]]: ...

    @property
    def draws(self) -> Sequence[Mapping[str, float]]: ...

    @property
    def findings(self) -> Sequence[Finding]: ...

    def tension(self, one: Sequence[Any], other: Sequence[Any]) -> Tension:
        """Likelihood-ratio test that two groups of experiments share their parameters."""
        ...

    def correlation(self, names: Sequence[str]) -> np.ndarray:
        """(n, n) correlations of parameters, of the draws or, without a sample, at the maximum."""
        ...


#: A check maps the experiments that declare it, and the fit, to findings; a table function maps them to tables.
Check = Callable[[Sequence[Any], Fitted], list[Finding]]
TableMaker = Callable[[Sequence[Any], Fitted], list[ResultTable]]
