"""Checks of residuals against settings and order, outliers, and parameters that two groups share."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
from scipy import optimize, stats

from capsule_id.experiments.base import Experiment, ValuesBySymbol, refit
from capsule_id.experiments.friction import varies
from capsule_id.experiments.statistics import autocorrelation, basis_of, judged, of_neighbours, permutation_p
from capsule_id.inference.curvature import jacobian
from capsule_id.inference.least_squares import linearised
from capsule_id.inference.point_stage import SampledFit
from capsule_id.parameters import INSTRUMENT_ERRORS, is_stated
from capsule_id.views import Facts, Finding

# regression: Outliers by local regression diagnostics of one experiment at the point fit.
#
# The model is linearised at the point fit: r is the vector of residuals in units of the noise. J is its Jacobian with
# respect to the experiment's own parameters and linear nuisances. The hat matrix J (J'J)^-1 J' gives the leverage of
# each reading (Cook & Weisberg 1982, section 2.2).


#: Relative step of difference quotients, dimensionless.
DIFFERENCE = 1e-5
#: Largest number of flagged rows per experiment. More outliers indicate a wrong model, not wrong rows.
MOST_FLAGGED = 3


@dataclass(frozen=True)
class Outlier:
    """An outlying reading: ``row`` index, ``score`` (studentised residual), corrected p-value ``p``."""

    row: int
    score: float
    p: float


def design(experiment: Experiment, theta: ValuesBySymbol) -> tuple[np.ndarray, np.ndarray]:
    """Residuals (n,) in units of the noise at the conditional mean of the nuisances, and J (n, p)."""
    by_name = {row.name: row for row in experiment.parameters if not row.scatter}
    keys = [key for key, name in experiment.names_by_key.items() if name in by_name]
    rows = [by_name[experiment.names_by_key[key]] for key in keys]
    # The errors of instruments are near 0, and their sds are their sizes.
    sizes = [row.prior.spread if row.prior and row.symbol in INSTRUMENT_ERRORS else 1e-12 for row in rows]

    def residuals(v: np.ndarray) -> np.ndarray:
        return experiment.misfit({**theta, **dict(zip(keys, v, strict=True))}).raw

    misfit = experiment.misfit(theta)
    sd, at = misfit.sd, np.array([float(theta[s]) for s in keys])
    raw = jacobian(residuals, at, DIFFERENCE * np.maximum(np.abs(at), sizes)) / sd[:, None]
    columns = np.concatenate([raw, misfit.design / sd[:, None]], axis=1)
    size = np.linalg.norm(columns, axis=0)
    columns = columns[:, size > 0.0] / size[size > 0.0]
    return np.asarray(experiment.residuals(theta, np))[: experiment.n], columns


def outliers(experiment: Experiment, theta: ValuesBySymbol, level: float) -> list[Outlier]:
    """Readings whose externally studentised residual is too large at family-wise ``level`` (Bonferroni over rows).

    The largest is removed and the test repeats, up to ``MOST_FLAGGED`` rows. The score is standard normal where the
    noise is known. Otherwise it follows Student's t with n - p - 1 degrees of freedom, the reading left out.
    """
    r, columns = design(experiment, theta)
    known = None if experiment.scale_known else _known_share(experiment, theta)
    keep = np.arange(len(r))
    found: list[Outlier] = []
    while len(found) < MOST_FLAGGED and len(keep) > (basis := basis_of(columns[keep])).shape[1] + 2:
        score, freedom = _studentised(r[keep], basis, None if known is None else known[keep])
        worst = int(np.argmax(np.abs(score)))
        tail = stats.norm.sf(abs(score[worst])) if freedom is None else stats.t.sf(abs(score[worst]), freedom)
        p = min(1.0, 2.0 * float(tail) * len(keep))
        if p > level:
            break
        found.append(Outlier(int(keep[worst]), float(score[worst]), p))
        keep = np.delete(keep, worst)
    return found


def _known_share(experiment: Experiment, theta: ValuesBySymbol) -> np.ndarray:
    """(n,) variance of the stated errors, or of the step of the digits, in units of the noise of each reading."""
    parts = [np.broadcast_to(one.fixed_variance, one.raw.shape) for one in experiment.misfits(theta, np)]
    column = experiment.table.columns.get(getattr(experiment, "reading", ""))
    rounding = 0.0 if column is None else column.rounding_sd**2
    return np.maximum(np.concatenate(parts), rounding) / experiment.misfit(theta).sd ** 2


def _studentised(r: np.ndarray, q: np.ndarray, known: np.ndarray | None) -> tuple[np.ndarray, int | None]:
    """Studentised residuals about the local fit with the orthonormal columns q, and degrees of freedom (None: normal).

    The scale of the noise is estimated where ``known`` (n,) is stated, and no less than it; else it is 1.
    """
    rest = r - q @ (q.T @ r)
    free = np.maximum(1.0 - np.sum(q**2, axis=1), 1e-9)
    if known is None:
        return rest / np.sqrt(free), None
    freedom = len(r) - q.shape[1] - 1
    variance = np.maximum((rest @ rest - rest**2 / free) / freedom, np.maximum(known, 1e-300))
    return rest / np.sqrt(variance * free), freedom


# order: Order of the trials: neighbouring rows, rows of one table or of one load whose residuals are alike are not
# independent.


#: Family-wise false-alarm rate over the tables, and smallest correlation that counts: it widens the sd by a fifth.
ORDER_LEVEL, SMALLEST_CORRELATION = 0.005, 0.2
#: Number of permutations; above so many rows the correlation is normal with variance 1/n.
PERMUTATIONS, MANY_ROWS = 10_000, 200
#: Fewest rows that can be judged: 6 rows have 720 orders.
FEWEST_ROWS = 6
#: Share of cases in which a check of a setting sees an error, and the largest error, in sd, that it may need for that: a
#: constant force beside pulls at loads from 1 to 4 needs 32 of four rows and 11 of eight, another ratio of friction beside
#: 4 tilts and 5 pushes up to 33. Smaller errors than ``LEAST_SHIFT`` are none. Level from which a load leaves doubt.
POWER, LARGEST_UNSEEN, LEAST_SHIFT, DOUBTFUL_LEVEL = 0.8, 40.0, 1e-3, 0.05
#: Residuals below this share of the noise, rms, are rounding, and their order means nothing.
SMALLEST_SCATTER = 0.02
#: Smallest factor of the sd by which tables of one kind disagree that counts, and fewest rows of a table.
SMALLEST_FACTOR, FEWEST_TRIALS = 1.2, 2
#: Rows of a load, on average, from which their own mean is taken.
ROWS_OF_A_LOAD = 3


def check_trials(s: SampledFit) -> list[Finding]:
    """Check that residuals of trials depend neither on the load, nor on the order, nor on the table."""
    settings = check_settings(s)
    return [*check_order(s, {f.experiment for f in settings if f.level == "fail"}), *check_tables(s), *settings]


def check_order(s: SampledFit, by_load: Collection[str] = ()) -> list[Finding]:
    """Check that residuals of neighbouring rows are uncorrelated (permutation test of the lag-1 correlation).

    Parameters
    ----------
    by_load : tables whose residuals depend on the load: the order within a load is judged
    """
    cases = []
    for e in s.experiments:
        if e.time_series:
            continue
        residuals, columns = _unflagged(s, e)
        # An outlier shifts the fit; without it the residuals are those of the local fit to the other rows.
        if s.flagged.get(e.label):
            residuals = residuals - columns @ np.linalg.lstsq(columns, residuals, rcond=None)[0]
        if e.label in by_load:
            residuals = _within_loads(residuals, _loads(s, e)[0])
        if len(residuals) >= FEWEST_ROWS and np.std(residuals) > SMALLEST_SCATTER:
            correlation, p = lag_1(residuals)
            factor = float(np.sqrt((1.0 + correlation) / (1.0 - correlation)))
            facts = {"correlation": correlation, "rows": len(residuals), "p": p, "factor": factor}
            cases.append((e.label, p if correlation > SMALLEST_CORRELATION else 1.0, facts))
    return judged("trials.order", cases, ORDER_LEVEL, {"number": len(cases)})


def lag_1(residuals: np.ndarray) -> tuple[float, float]:
    """Lag-1 correlation of residuals (n,) and the probability that a random order gives as large a one."""
    correlation = float(autocorrelation(residuals, 1)[0])
    n = len(residuals)
    if n > MANY_ROWS:
        return correlation, float(stats.norm.sf(correlation * np.sqrt(n)))
    return correlation, permutation_p(residuals - np.mean(residuals), of_neighbours, PERMUTATIONS)


def check_tables(s: SampledFit) -> list[Finding]:
    """Check that tables with the same parameters agree: by their mean residuals, or, with offsets, by their slopes."""
    findings, number = list[Finding](), 0
    for groups in (_tables_by_mean(s), _tables_by_slope(s)):
        number += sum(len(members) for members, _ in groups)
        for members, (factor, p) in groups:
            if factor > SMALLEST_FACTOR and p * len(groups) < ORDER_LEVEL:
                row = next(row for row in members[0].parameters if row.physical)
                fits = [refit(e, e.local(s.values), list(s.flagged.get(e.label, []))) for e in members]
                estimates = [(e.label, own[row.symbol][0]) for e, own in zip(members, fits, strict=True)]
                facts = {"name": row.name, "estimates": estimates, "unit": row.unit, "p": p, "factor": factor}
                findings.append(Finding("trials.tables", "fail", facts, members[0].label))
    return findings or [Finding("trials.tables", "ok", {"number": number})] * bool(number)


#: Tables that share their parameters, with the factor by which they disagree and its probability.
Groups = list[tuple[list[Experiment], tuple[float, float]]]


def _tables_by_slope(s: SampledFit) -> Groups:
    """Tables that each have an offset, such as calibrations of one spring.

    The test is that of Alexander and Govern (1994): each table has its own scatter and degrees of freedom.
    """
    alike: dict[tuple[str, ...], list[tuple[Experiment, float]]] = {}
    for e in s.experiments:
        own = [row.name for row in e.parameters if row.physical and not is_stated(row.name)]
        nuisances = e.misfit(e.local(s.values)).design.shape[1]
        # Two rows of a line show nothing of their scatter.
        freedom = np.inf if e.scale_known else e.n - len(s.flagged.get(e.label, [])) - len(own) - nuisances
        if e.bench and not e.time_series and own and nuisances and freedom > 0:
            alike.setdefault((e.kind, *own), []).append((e, freedom))
    groups = []
    for members, freedom in (zip(*pairs, strict=True) for pairs in alike.values() if len(pairs) > 1):
        symbol = next(row.symbol for row in members[0].parameters if row.physical)
        fits = [refit(e, e.local(s.values), list(s.flagged.get(e.label, []))) for e in members]
        groups.append((list(members), heterogeneity([one[symbol] for one in fits], freedom)))
    return groups


def heterogeneity(pairs: Sequence[tuple[float, float]], freedom: Sequence[float]) -> tuple[float, float]:
    """Factor by which estimates scatter more than their standard errors say (Birge), and its probability.

    The t statistic of each estimate is converted to a normal one with its own degrees of freedom.
    """
    value, sd = np.array(pairs).T
    sd = np.maximum(sd, 1e-12 * np.abs(value))
    t = (value - np.average(value, weights=sd**-2.0)) / sd
    z = stats.norm.isf(np.maximum(stats.t.sf(np.abs(t), freedom), 1e-300))
    chi_square, more = float(np.sum(z**2)), len(value) - 1
    return float(np.sqrt(chi_square / more)), float(stats.chi2.sf(chi_square, more))


def _tables_by_mean(s: SampledFit) -> Groups:
    """Tables of several trials without offset and with one scatter: an error of the parameters shifts their mean residual.

    A permutation test of the scatter between tables. Their common scatter otherwise absorbs what differs between them.
    """
    alike: dict[tuple[str, ...], list[tuple[Experiment, np.ndarray]]] = {}
    for e in s.experiments:
        if e.bench and not e.time_series and any(row.scatter for row in e.parameters):
            residuals, offsets = _unflagged(s, e)[0], e.misfit(e.local(s.values)).design.shape[1]
            if offsets == 0 and len(residuals) >= FEWEST_TRIALS:
                alike.setdefault((e.kind, *(row.name for row in e.parameters)), []).append((e, residuals))
    several = [tuple(zip(*pairs, strict=True)) for pairs in alike.values() if len(pairs) > 1]
    return [(list(m), between(r)) for m, r in several if np.std(np.concatenate(r)) > SMALLEST_SCATTER]


def check_settings(s: SampledFit) -> list[Finding]:
    """Check what settings that vary can show beside the law: the loads of a table, the speeds of all friction tables.

    A parameter is not judged where an error of more than ``LARGEST_UNSEEN`` sd may go unseen.
    """
    end, findings = 0, []
    keep = np.ones(len(s.target.residual_owners(s.fit.u)), dtype=bool)
    effects = dict[tuple[str, str], np.ndarray]()
    for e in s.experiments:
        theta = e.local(s.values)
        rows, end = np.arange(end, end + e.n), end + len(e.residuals(theta, np))
        keep[rows[list(s.flagged.get(e.label, []))]] = False
        for setting, raw in e.alternatives(theta).items():
            effect = effects.setdefault((setting, e.label * (setting == "loads")), np.full(len(keep), np.nan))
            effect[rows] = raw / e.misfit(theta).sd
    varied = {key: effect[keep] for key, effect in effects.items() if np.nansum(np.abs(effect)) > 0.0}
    physical = {row.name for row in s.target.parameters if row.physical and not is_stated(row.name)}
    residuals, jacobian = (part[keep] for part in linearised(s.target, s.fit.u)) if varied else (keep, keep)
    for (setting, label), effect in varied.items():
        p, errors = added_effect(residuals, jacobian, effect)
        pairs = zip(np.array(s.target.names)[s.target.located].tolist(), errors.tolist(), strict=True)
        unseen = {name: error for name, error in pairs if name in physical and error > LEAST_SHIFT}
        facts = {"rows": int(np.sum(~np.isnan(effect))), "unseen": unseen, "p": p}
        if setting == "loads":
            facts |= _of_loads(s, next(e for e in s.experiments if e.label == label), p)
        p = facts["p"] * len(varied)
        found = p < (DOUBTFUL_LEVEL if setting == "loads" else ORDER_LEVEL)
        # Loads that hardly differ are one load, and mu is the coefficient there.
        wide = setting == "speeds" or varies(np.abs(effect[~np.isnan(effect)]))
        doubtful = tuple(name for name, error in unseen.items() if found or (wide and error > LARGEST_UNSEEN))
        level = "fail" if setting == "loads" and p < ORDER_LEVEL else "warn" if doubtful else "ok"
        findings.append(Finding(f"trials.{setting}", level, facts, label, doubtful * (level == "warn")))
    return findings


def added_effect(residuals: np.ndarray, columns: np.ndarray, effect: np.ndarray) -> tuple[float, np.ndarray]:
    """t test of an ``effect`` (n,) on residuals beside ``columns`` (n, p) of the parameters; NaN: rows of other tables.

    Return its p-value, and the shift of every parameter, in sd, by the smallest effect that the test finds in ``POWER``
    of all cases; 1 and inf where too few rows are free.
    """
    q, r = np.linalg.qr(columns / np.linalg.norm(columns, axis=0))
    used, effect = ~np.isnan(effect), np.nan_to_num(effect)
    shift = np.abs(np.linalg.solve(r, q.T @ effect)) / np.linalg.norm(np.linalg.inv(r), axis=1)
    rest, residuals = (x - q @ (q.T @ x) for x in (effect, residuals))
    length, freedom = float(np.linalg.norm(rest)), float(np.sum(used) - np.sum(q[used] ** 2)) - 1.0
    if not (freedom >= 1.0 and length >= SMALLEST_SCATTER * np.linalg.norm(effect)):
        return 1.0, np.where(shift > LEAST_SHIFT * np.max(shift), np.inf, 0.0)
    size = float(rest @ residuals) / length
    left = max(float(np.sum((residuals - size / length * rest)[used] ** 2)) / freedom, SMALLEST_SCATTER**2)
    p = 2.0 * float(stats.t.sf(abs(size) / np.sqrt(left), freedom))
    critical = float(stats.t.isf(ORDER_LEVEL / 2.0, freedom))
    seen = optimize.brentq(lambda x: float(stats.nct.sf(critical, freedom, x)) - POWER, 0.0, 60.0 * critical)
    return p, shift * seen / length


def _of_loads(s: SampledFit, e: Experiment, p: float) -> Facts:
    """Coefficient at every load, and the probability of what three tests find, one of them with this ``p``.

    The others are permutation tests of the scatter between loads, and of the correlation with the logarithm of the load.
    """
    residuals, (load, coefficient) = _unflagged(s, e)[0], _loads(s, e)
    pairs = zip(np.unique(load), at_each_load(coefficient, load), strict=True)
    means = [(float(one), float(np.mean(own))) for one, own in pairs]
    if len(residuals) >= FEWEST_ROWS:
        levels = _of_levels(at_each_load(residuals, load))
        p = 3.0 * min(p, levels, trend(_standardised(residuals, load), load))
    return {"means": means, "p": p, "instrument": e.table.columns["force"].instrument is not None}


def at_each_load(values: np.ndarray, load: np.ndarray) -> list[np.ndarray]:
    """Values (n,) of the rows at each load, the lowest first, in the order of the rows; in one pass over the rows."""
    order = np.argsort(load, kind="stable")
    return np.split(values[order], np.unique(load[order], return_index=True)[1][1:])


def _of_levels(groups: Sequence[np.ndarray]) -> float:
    """Probability of as large a scatter between the loads; 1 where it is small.

    Each load may have a scatter of its own (Alexander and Govern 1994). With few rows a test by permutations cannot reach
    a small probability.
    """
    if sum(map(len, groups)) == len(groups) or between(groups)[0] <= SMALLEST_FACTOR:
        return 1.0
    scatters = [float(np.ptp(group)) for group in groups]
    if min(map(len, groups)) < ROWS_OF_A_LOAD or max(scatters) == 0.0:
        return between(groups)[1]
    # Equal readings at one load give it no variance of its own to test with.
    return float((stats.alexandergovern if min(scatters) > 0.0 else stats.f_oneway)(*groups).pvalue)


def trend(residuals: np.ndarray, load: np.ndarray) -> float:
    """Probability that a random order of residuals (n,) has as large a correlation with the logarithm of ``load`` (n,)."""
    x, r = np.log(load) - np.mean(np.log(load)), residuals - np.mean(residuals)
    return permutation_p(r, lambda orders: np.abs(orders @ x), PERMUTATIONS)


def _within_loads(residuals: np.ndarray, load: np.ndarray) -> np.ndarray:
    """Residuals (n,) without their mean at each load, or, where loads have few rows, without a line in its logarithm."""
    levels = pd.Series(residuals).groupby(load)
    if len(load) >= ROWS_OF_A_LOAD * levels.ngroups:
        return residuals - levels.transform("mean").to_numpy()
    return residuals - np.polyval(np.polyfit(np.log(load), residuals, 1), np.log(load))


def _standardised(residuals: np.ndarray, load: np.ndarray) -> np.ndarray:
    """Residuals (n,) over their sd at each load, where every load has enough rows."""
    levels = pd.Series(residuals).groupby(load)
    if np.min(levels.size().to_numpy()) < ROWS_OF_A_LOAD:
        return residuals
    return residuals / np.maximum(levels.transform("std").to_numpy(), SMALLEST_SCATTER)


def _loads(s: SampledFit, e: Experiment) -> list[np.ndarray]:
    """Load, N, and coefficient of every row without the flagged ones."""
    assert e.loads is not None, "the table has loads"
    return _unflagged(s, e, e.loads)


def _unflagged(s: SampledFit, e: Experiment, parts: Sequence[np.ndarray] | None = None) -> list[np.ndarray]:
    """Residuals in units of the noise and their Jacobian, or other ``parts``, without the flagged rows."""
    flagged = list(s.flagged.get(e.label, []))
    return [np.delete(x, flagged, axis=0) for x in parts or design(e, e.local(s.values))]


def between(residuals: Sequence[np.ndarray]) -> tuple[float, float]:
    """Factor of the sd by which tables disagree beyond their scatter, and the probability of as large a disagreement.

    The factor is that of the design effect: sqrt(1 + (rows - 1) r), r the correlation of trials of one table.

    Parameters
    ----------
    residuals : of each table (n_i,), with one scatter
    """
    sizes = np.array([len(each) for each in residuals])
    values = np.concatenate(residuals)
    values = values - np.mean(values)
    starts = np.concatenate([[0], np.cumsum(sizes)[:-1]])

    def sum_between(r: np.ndarray) -> np.ndarray:
        return np.sum(np.add.reduceat(r, starts, axis=-1) ** 2 / sizes, axis=-1)

    total, found = float(values @ values), float(sum_between(values))
    within = (total - found) / max(len(values) - len(sizes), 1)
    # Mean number of rows for the variance between tables (Searle, Casella & McCulloch 1992, section 3.6).
    rows = (len(values) - float(np.sum(sizes**2)) / len(values)) / (len(sizes) - 1)
    variance = max(0.0, (found / (len(sizes) - 1) - within) / rows)
    correlation = variance / (variance + within) if variance > 0.0 else 0.0
    return float(np.sqrt(1.0 + (rows - 1.0) * correlation)), permutation_p(values, sum_between, PERMUTATIONS)
