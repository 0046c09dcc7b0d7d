"""Error of the model, from the scatter of a parameter between parts of the data.

Where a check of an experiment fails, its readings and those of its kind that inform the same parameters are divided
into parts of consecutive rows. Each part gives an estimate with its own sd. Their weighted chi-square over its degrees
of freedom is the squared factor of the sd (Birge 1932), and Student's t gives the interval.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import stats

from capsule_id.errors import InputError
from capsule_id.experiments.base import Experiment
from capsule_id.experiments.checks.refit import refit
from capsule_id.experiments.families.friction_model import EQUATION_1
from capsule_id.inference.checks.sampled_fit import SampledFit
from capsule_id.rig.model import Table

#: Fewest parts of the data, and most parts of one table.
FEWEST_PARTS, MOST_PARTS = 4, 8
#: Fewest rows of a part, relative to the number of unknowns of its experiment.
ROWS_PER_UNKNOWN = 2
#: Largest sd of a part that determines a parameter, relative to its value.
LARGEST_RELATIVE_SD = 0.5
#: Part of the energy of a record that its rows for the division hold.
ENERGY = 0.99


@dataclass(frozen=True)
class Widening:
    """Error of the model of one parameter.

    Attributes
    ----------
    factor : of its sd, at least 1
    quantile : Student's t quantile over the normal one, for the ends of the 95 % interval
    parts : number of parts of the data
    """

    factor: float
    quantile: float
    parts: int

    @property
    def stretch(self) -> float:
        """Factor of the half-length of the 95 % interval."""
        return self.factor * self.quantile


def widenings(s: SampledFit) -> dict[str, Widening]:
    """Error of the model of every physical parameter that a failed check of its bench test concerns, by name."""
    failed = {f.experiment for f in s.findings if f.level == "fail" and f.experiment}
    kinds = {e.kind for e in s.experiments if e.label in failed or e.table.label in failed}
    by_load = {f.experiment for f in s.findings if f.code == "trials.loads" and f.level == "fail"}
    estimates: dict[str, list[tuple[float, float]]] = {}
    for e in s.experiments:
        # The parts of a run, or of a record with an amplitude of its own, have other nuisances than the whole.
        local = any(not (row.physical or row.scatter) for row in e.parameters)
        if e.kind in kinds and e.bench and not e.event_driven and not local:
            for name, pair in estimates_of_parts(e, s.values, by_load=e.label in by_load):
                estimates.setdefault(name, []).append(pair)
    found = {name: widening(pairs) for name, pairs in estimates.items() if len(pairs) >= FEWEST_PARTS}
    return {name: one for name, one in found.items() if one.factor > 1.0}


def widening(pairs: Sequence[tuple[float, float]]) -> Widening:
    """Factor and quantile from estimates and standard errors of parts."""
    value, sd = np.array(pairs).T
    weight = sd**-2.0
    chi_square = float(np.sum(weight * (value - np.average(value, weights=weight)) ** 2))
    freedom = len(pairs) - 1
    quantile = float(stats.t.ppf(0.975, freedom) / stats.norm.ppf(0.975))
    return Widening(max(1.0, float(np.sqrt(chi_square / freedom))), quantile, len(pairs))


def estimates_of_parts(
    e: Experiment, values: Mapping[str, float], by_load: bool = False
) -> Iterator[tuple[str, tuple[float, float]]]:
    """Name, estimate and standard error of every physical parameter from every part of ``e`` that can be fitted.

    Parameters
    ----------
    by_load : whether a part holds the rows of one load, of similar loads where there are many, not consecutive rows
    """
    unknowns = sum(not row.scatter for row in e.parameters) + e.misfit(e.local(values)).design.shape[1]
    rows = informative_rows(e)
    number = min(MOST_PARTS, len(rows) // max(ROWS_PER_UNKNOWN * unknowns, 3))
    if number < 2:
        return
    chosen_rows = np.array_split(rows, number)
    if e.loads is not None and by_load:
        levels, index = np.unique(e.loads[0], return_inverse=True)
        chosen_rows = np.array_split(np.argsort(e.loads[0], kind="stable"), number)
        if FEWEST_PARTS <= len(levels) <= MOST_PARTS:
            chosen_rows = [np.flatnonzero(index == level) for level in range(len(levels))]
    for chosen in chosen_rows:
        try:
            (part,) = type(e).make(rows_of(e.table, chosen), e.rig, getattr(e, "friction", EQUATION_1))
            with np.errstate(all="ignore"):
                found = refit(part, part.local(values), [])
        except (InputError, ValueError, np.linalg.LinAlgError, IndexError, ArithmeticError):
            continue  # a part without motion or with one level of x determines nothing
        for row in part.parameters:
            value, sd = found.get(row.symbol, (np.nan, np.nan))
            if 0.0 < sd < LARGEST_RELATIVE_SD * abs(value):
                yield row.name, (value, sd)


def informative_rows(e: Experiment) -> np.ndarray:
    """Indices of the rows of the table of ``e``; of a record those with most of its energy, before it is all noise."""
    rows = np.arange(len(e.table.rows))
    if not e.time_series or e.n != len(rows):
        return rows
    energy = np.cumsum((e.observed - np.mean(e.observed)) ** 2)
    return rows[: int(np.searchsorted(energy, ENERGY * energy[-1])) + 1]


def rows_of(table: Table, rows: np.ndarray) -> Table:
    """The table with some of its rows."""
    columns = {name: replace(column, values=column.values[rows]) for name, column in table.columns.items()}
    return replace(table, columns=columns, rows=table.rows[rows])
