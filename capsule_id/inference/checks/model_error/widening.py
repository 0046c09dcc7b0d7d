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
from capsule_id.experiments.checks.refit import estimate
from capsule_id.experiments.families.friction_model import EQUATION_1
from capsule_id.inference.checks.sampled_fit import SampledFit
from capsule_id.parameters import is_stated
from capsule_id.records.noise import length_of_motion
from capsule_id.rig.model import Table

#: Fewest parts of the data, and most parts of one table.
FEWEST_PARTS, MOST_PARTS = 4, 8
#: Fewest rows of a part, relative to the number of unknowns of its experiment.
ROWS_PER_UNKNOWN = 2
#: Largest sd of a part that determines a parameter, relative to its value.
LARGEST_RELATIVE_SD = 0.5
#: Smallest factor of an sd that counts, and largest one beside which the fit still gives a number.
SMALLEST_FACTOR, LARGEST_FACTOR = 1.01, 30.0


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

    @property
    def no_number(self) -> bool:
        """Whether the parts contradict each other so far that the fit gives no number."""
        return not self.factor <= LARGEST_FACTOR


def widenings(s: SampledFit) -> dict[str, Widening]:
    """Error of the model of every physical parameter that a failed check of its bench test concerns, by name."""
    failed = {f.experiment for f in s.findings if f.level == "fail" and f.experiment}
    kinds = {e.kind for e in s.experiments if e.label in failed or e.table.label in failed}
    by_load = {f.experiment for f in s.findings if f.code == "trials.loads" and f.level == "fail"}
    tests = [e for e in s.experiments if e.kind in kinds and e.bench and not has_own_nuisances(e)]
    found: dict[str, Widening] = {}
    # Long parts show slow errors, many parts show them more surely. The widest interval counts.
    for number in (FEWEST_PARTS, MOST_PARTS):
        estimates: dict[str, list[tuple[float, float]]] = {}
        for e in tests:
            for name, pair in estimates_of_parts(e, s.values, number, by_load=e.label in by_load):
                estimates.setdefault(name, []).append(pair)
        for name, pairs in estimates.items():
            one = widening(pairs) if len(pairs) >= FEWEST_PARTS else None
            if one and one.factor > 1.0 and (name not in found or one.stretch > found[name].stretch):
                found[name] = one
    return found


def beside_stated(s: SampledFit, found: Mapping[str, Widening]) -> dict[str, Widening]:
    """Widen only that part of every variance which the readings give, not that of stated masses and slopes.

    The parts share the stated values, so their scatter says nothing of them. The share of the readings is the variance
    with the stated values held, from the covariance at the maximum.
    """
    stated = [i for i, name in enumerate(s.target.names) if is_stated(name)]
    result = {}
    for name, one in found.items():
        i = s.target.names.index(name)
        variance, with_stated = s.fit.covariance[i, i], s.fit.covariance[np.ix_(stated, [i])]
        given = float((with_stated.T @ np.linalg.pinv(s.fit.covariance[np.ix_(stated, stated)]) @ with_stated).item())
        share = float(np.clip(1.0 - given / variance, 0.0, 1.0))
        factor, stretch = (float(np.sqrt(1.0 - share + share * size**2)) for size in (one.factor, one.stretch))
        if factor >= SMALLEST_FACTOR:
            result[name] = Widening(factor, stretch / factor, one.parts)
    return result


def has_own_nuisances(e: Experiment) -> bool:
    """Whether ``e`` is a run, or a record with an amplitude of its own: its parts have other nuisances than the whole."""
    return e.event_driven or any(not (row.physical or row.scatter) for row in e.parameters)


def widening(pairs: Sequence[tuple[float, float]]) -> Widening:
    """Factor and quantile from estimates and standard errors of parts."""
    value, sd = np.array(pairs).T
    weight = sd**-2.0
    chi_square = float(np.sum(weight * (value - np.average(value, weights=weight)) ** 2))
    freedom = len(pairs) - 1
    quantile = float(stats.t.ppf(0.975, freedom) / stats.norm.ppf(0.975))
    return Widening(max(1.0, float(np.sqrt(chi_square / freedom))), quantile, len(pairs))


def estimates_of_parts(
    e: Experiment, values: Mapping[str, float], number: int, by_load: bool = False
) -> Iterator[tuple[str, tuple[float, float]]]:
    """Name, estimate and standard error of every physical parameter from every part of ``e`` that can be fitted.

    The parts share one noise level, from all of their misfits: those of a few rows are too uncertain to weight them.

    Parameters
    ----------
    number : of parts, fewer where they would have too few rows
    by_load : whether a part holds the rows of one load, of similar loads where there are many, not consecutive rows
    """
    parts = []
    for rows in rows_of_parts(e, values, number, by_load):
        try:
            (part,) = type(e).make(rows_of(e.table, rows), e.rig, getattr(e, "friction", EQUATION_1))
            with np.errstate(all="ignore"):
                parts.append((part, estimate(part, part.local(values), [])))
        except (InputError, ValueError, np.linalg.LinAlgError, IndexError, ArithmeticError):
            continue  # a part without motion or with one level of x determines nothing
    if not parts:
        return
    freedom = [one.freedom for _, one in parts]
    scale = float(np.average([one.scale for _, one in parts], weights=freedom))
    for part, one in parts:
        found = one.scaled(scale)
        for row in part.parameters:
            value, sd = found.get(row.symbol, (np.nan, np.nan))
            if 0.0 < sd < LARGEST_RELATIVE_SD * abs(value):
                yield row.name, (value, sd)


def rows_of_parts(e: Experiment, values: Mapping[str, float], number: int, by_load: bool) -> list[np.ndarray]:
    """Rows of the parts of ``e``; parameters as in ``estimates_of_parts``; [] for a table that is too short."""
    unknowns = sum(not row.scatter for row in e.parameters) + e.misfit(e.local(values)).design.shape[1]
    rows = informative_rows(e)
    number = min(number, len(rows) // max(ROWS_PER_UNKNOWN * unknowns, 3))
    if number < 2:
        return []
    if e.loads is None or not by_load:
        return np.array_split(rows, number)
    levels, index = np.unique(e.loads[0], return_inverse=True)
    if FEWEST_PARTS <= len(levels) <= MOST_PARTS:
        return [np.flatnonzero(index == level) for level in range(len(levels))]
    return np.array_split(np.argsort(e.loads[0], kind="stable"), number)


def informative_rows(e: Experiment) -> np.ndarray:
    """Indices of the rows of the table of ``e``; of a record those with most of its energy, before it is all noise."""
    rows = np.arange(len(e.table.rows))
    if not e.time_series or e.n != len(rows):
        return rows
    return rows[: length_of_motion(e.observed)]


def rows_of(table: Table, rows: np.ndarray) -> Table:
    """The table with some of its rows."""
    columns = {name: replace(column, values=column.values[rows]) for name, column in table.columns.items()}
    return replace(table, columns=columns, rows=table.rows[rows])
