"""What a further test would add: expected standard deviations of parameters, from Fisher information at draws.

A candidate is a number of tests of one kind that fit into the time. Its information at a draw of the parameters, with what
only the new readings have integrated out, is added to the precision of the draws (Chaloner & Verdinelli, *Statistical
Science* 10, 1995, 273). The expected sd is the mean over draws: nobody knows yet what the new readings will be.
"""

import json
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from itertools import combinations, product
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from scipy.linalg import block_diag

from capsule_id.console import OnProgress
from capsule_id.errors import InputError
from capsule_id.experiments.base import Experiment
from capsule_id.experiments.forced_run.experiment import CapsuleRun
from capsule_id.experiments.free_vibration.record import DecayRecord
from capsule_id.experiments.kind import Kind, Registry, Values, make_experiments
from capsule_id.experiments.point_test import Line, PointTest
from capsule_id.inference.curvature import jacobian
from capsule_id.inference.least_squares import linearised
from capsule_id.inference.pipeline import check_readings, second_models
from capsule_id.inference.prediction import random_draws
from capsule_id.inference.profiles import words_of
from capsule_id.inference.result import Result
from capsule_id.inference.target import LogPosterior, prior_sd
from capsule_id.parameters import QUANTILE_975, by_index, is_stated, refuse_another_law, symbol_of
from capsule_id.rig.model import Quantity, Rig
from capsule_id.rig.read import read_rig
from capsule_id.rig.schema import GroundSettings, QuantityRule
from capsule_id.synthetic import PAPER, Truth, synthesize
from capsule_id.views import counted

#: Draws at which the information is computed, the time for the tests, min, and the largest planned number of one test.
DRAWS, MINUTES, MOST_TESTS = 8, 30.0, 1000
#: Step of the differences of the residuals, natural-log units or parts of a prior's sd.
STEP = 1e-4
#: Most rows of a table whose information is computed; more tests multiply it.
MOST_ROWS = 60
#: Settings of a further test in parts of the smallest and the largest measured one; amplitudes in parts of the record's.
BEYOND, AMPLITUDES = (0.5, 1.5), (0.5, 1.0, 2.0)
#: Drive, frequency and gap of a further run in parts of those of a recorded one.
DRIVES, FREQUENCIES, GAPS = (0.7, 1.0, 1.4), (0.8, 1.0, 1.25), (0.5, 2.0)
#: Reading, in parts of the largest one, below which a setting is printed as 0.
ZERO = 0.01
#: Least mean decrease of the logarithm of an sd with which tests share the time with others.
LEAST = 0.01
#: Largest part of the information by which its differences with steps of 1 and 2 may differ: the motion changes its kind.
SMOOTH = 0.2

#: Largest factor about the median of a prior within which a plan draws truths: farther away the synthetic tests do not fit.
FACTOR = 1.5


@dataclass(frozen=True)
class Candidate:
    """Tests of one kind: ``template`` is one of their records, or a table of at most ``MOST_ROWS`` of their rows.

    Attributes
    ----------
    words : what to do, such as "as decay_1, 2 x its amplitude"
    tests, minutes : number of tests, and what all of them take
    strength : information of all of them over that of the template
    known : starts of a fit, for parameters of which a result knows nothing
    changed : factors of symbols in the template, such as 1.4 of ``P_d``
    """

    template: Experiment
    words: str
    tests: int
    minutes: float
    strength: float
    known: Values
    changed: Values

    def information(self, draws: Sequence[Values], names: Sequence[str]) -> np.ndarray:
        """(draws, d, d) information on the parameters ``names`` in the coordinates of a fit; NaN where it has none."""
        e, target = self.template, LogPosterior(self.template.rig, [self.template])
        located = target.located
        rows = [target.parameters[i] for i in located]
        # What belongs to the run of a part is new in a new run too.
        own_names = {e.label, e.shares_noise, *(f"{e.shares_noise}_{column}" for column in e.table.columns)}
        # A spring may have the name of a run.
        anew = [row.of in own_names and row.symbol != "k2" for row in rows]
        kept = [not own or (row.physical and isinstance(e, PointTest)) for own, row in zip(anew, rows, strict=True)]
        shared = np.array([row.name in names and keep for row, keep in zip(rows, kept, strict=True)])
        place = [names.index(row.name) for row, keep in zip(rows, shared, strict=True) if keep]
        found = np.zeros((len(draws), len(names), len(names)))
        slopes = (self._of_run if isinstance(e, CapsuleRun) else self._of_readings)(target, draws)
        for wide, slope in zip(found, slopes, strict=True):
            # Further columns are linear nuisances of the new readings alone, each with a standard normal prior.
            held = np.append(shared, np.zeros(slope.shape[1] - len(rows), dtype=bool))
            prior = np.append(1.0 / target.prior_sd[located] ** 2, np.ones(slope.shape[1] - len(rows)))
            whole = slope.T @ slope + np.diag(np.where(held, 0.0, prior))
            own, cross = whole[~held][:, ~held], whole[~held][:, held]
            wide[np.ix_(place, place)] = whole[held][:, held] - cross.T @ np.linalg.solve(own, cross)
        return self.strength * found

    def _values(self, target: LogPosterior, draw: Values) -> dict[str, float]:
        """Values of all parameters of the template at a draw, constants included."""
        known = {**target.fixed, **{name: float(draw.get(name, self.known[name])) for name in target.names}}
        return {name: x * self.changed.get(symbol_of(name), 1.0) for name, x in known.items()}

    def _of_readings(self, target: LogPosterior, draws: Sequence[Values]) -> Iterator[np.ndarray]:
        """Jacobian of the residuals with respect to the located parameters, at each draw."""
        located, step = target.located, STEP * np.minimum(target.prior_sd, 1.0)
        for draw in draws:
            values = self._values(target, draw)
            u = target.unconstrain(np.array([values[name] for name in target.names]))
            if self.template.event_driven:
                yield linearised(target, u)[1][: -target.dimension]
                continue
            e = _as_predicted(self.template, values)

            def residuals(v: np.ndarray, e: Experiment = e, u: np.ndarray = u) -> np.ndarray:
                at = u.copy()
                at[located] = v
                return np.asarray(e.residuals(e.local(target.mapping(target.theta(at))), np))

            yield jacobian(residuals, u[located], step[located])

    def _of_run(self, target: LogPosterior, draws: Sequence[Values]) -> Iterator[np.ndarray]:
        """The same for a run: motions at all draws and steps are one batch. Offsets, gains and delays are further columns."""
        e: Any = self.template
        located, step = target.located, STEP * np.minimum(target.prior_sd, 1.0)
        at = [self._values(target, draw) for draw in draws]
        u = np.stack([target.unconstrain(np.array([values[name] for name in target.names])) for values in at])
        moves = np.concatenate([size * np.diag(step)[located] for size in (1.0, -1.0, 2.0, -2.0)])
        theta = target.theta((u[:, None] + moves).reshape(-1, target.dimension))
        constants = {name: np.full(len(theta), x) for name, x in target.fixed.items()}
        values = e.local({**constants, **dict(zip(target.names, theta.T, strict=True))})
        seen = [
            np.reshape(e.instrument(name, values)[0], (-1, 1)) * np.asarray(channel)
            for name, channel in zip(e.names, e.predict(values, np), strict=True)
        ]
        for k, own in enumerate(at):
            part, near, wide, nuisances = slice(k * len(moves), (k + 1) * len(moves)), [], [], []
            for channel, shown in zip(e.channels, seen, strict=True):
                sd = np.hypot(own[f"noise_{channel.name}[{e.shares_noise}]"], np.sqrt(channel.reading_variance))
                ahead, behind, far, further = np.split(shown[part] / sd, 4)
                near.append((ahead - behind).T / (2.0 * step[located]))
                wide.append((far - further).T / (4.0 * step[located]))
                nuisances.append(channel.misfit(0.5 * (ahead + behind)[0] * sd, e.time, None, np).design / sd)
            smooth = np.linalg.norm(np.vstack(near) - np.vstack(wide)) <= SMOOTH * np.linalg.norm(np.vstack(near))
            found = np.hstack([np.vstack(near), np.asarray(block_diag(*nuisances))])
            yield found if smooth else np.full_like(found, np.nan)


#: Tests that share the time, and the ratios of the sds of the targets after and before them.
Option = tuple[tuple[Candidate, ...], np.ndarray]


@dataclass(frozen=True)
class Plan:
    """Candidates in the order of their use.

    Attributes
    ----------
    table : a row per candidate, best first: kind, what to do, number, minutes, and for every target the expected sd
        (``sd of c``, SI) and its ratio to the present one (``c, ratio``)
    today : sd of every target, SI, by name
    options : the tests of every row of the table; those of two kinds share the time
    left_out : tests that take longer than the time, and runs whose motion changes its kind near the setting
    """

    table: pd.DataFrame
    today: Values
    options: tuple[tuple[Candidate, ...], ...]
    left_out: tuple[str, ...]
    registry: Registry

    def lines(self, rank: int = 1) -> str:
        """Lines of rig.toml that read the tests of that row of the table."""
        own = (lines_of(one.template, self.registry[one.template.kind]) for one in self.options[rank - 1])
        return "\n\n".join(own)


def _as_predicted(e: Experiment, values: Values) -> Experiment:
    """A table of trials with the readings that ``values`` predict; other experiments as they are."""
    reading = getattr(e, "reading", "")
    if not isinstance(e, PointTest) or reading not in e.table.columns:
        return e
    return e.with_readings({reading: e.observed - np.asarray(e.misfit(e.local(values)).raw)})


def _repeated(
    e: PointTest, number: float, rows: np.ndarray, changed: Mapping[str, np.ndarray]
) -> tuple[Experiment, float]:
    """The test with so many trials, at most ``MOST_ROWS``, that repeat ``rows``; also the trials that each stands for."""
    n = min(int(number), MOST_ROWS)
    spread = rows if n >= len(rows) else rows[np.linspace(0, len(rows) - 1, n).round().astype(int)]
    return e.with_readings(changed, np.resize(spread, n)), number / n


def _designs(e: PointTest, kind: Kind) -> Iterator[tuple[str, Mapping[str, np.ndarray], np.ndarray]]:
    """Which rows of its table, and with what settings, further trials may have: words, changed columns, rows."""
    column = next((c for c in e.table.columns.values() if c.name != e.reading), None)
    if column is None or e.reading not in e.table.columns or np.ptp(column.values) == 0.0:
        yield "", {}, np.arange(e.n)
        return
    order = np.argsort(column.values, kind="stable")
    low, high = (float(column.values[i]) for i in order[[0, -1]])

    def words(*values: float) -> str:
        # A reading of a zero is no setting.
        shown = (x * column.to_display if abs(x) > ZERO * abs(high) else 0.0 for x in values)
        return f", {column.name} {' and '.join(f'{x:.3g}' for x in shown)} {column.unit}"

    yield "", {}, order
    yield words(low, high), {}, order[[0, -1]]
    if not kind.columns[column.name].varies:
        for below, above in ((1.0, 1.0), BEYOND) if kind.set_by == column.name else ((1.0, 1.0),):
            yield words(below * low), {column.name: below * column.values}, order[:1]
            yield words(above * high), {column.name: above * column.values}, order[-1:]


def _runs(e: CapsuleRun) -> Iterator[tuple[str, Experiment, Values]]:
    """Settled runs at other settings, and as recorded: words, the run, factors of its drive and gap."""
    settings = e.table.settings
    if settings.drive != "harmonic":
        yield "", e, {}
        return
    gaps = [] if settings.gap is None else [(1.0, 1.0, gap) for gap in GAPS]
    for drive, rate, gap in (*product(DRIVES, FREQUENCIES, (1.0,)), *gaps):
        own: dict[str, Any] = {"start": "settled", "Omega": rate * e.Omega, "f": None}
        own["gap"] = settings.gap and Quantity(gap * settings.gap.value, settings.gap.sd)
        own["P_d"] = settings.P_d and Quantity(drive * settings.P_d.value, drive * settings.P_d.sd)
        parts = {"x its drive": drive, "x its frequency": rate, "x its gap": gap}
        words = "".join(f", {x:g} {word}" for word, x in parts.items() if x != 1.0)
        changed = {"I_d": drive, "P_d": drive, "G": gap}
        yield words, e.remade(replace(e.table, settings=replace(settings, **own)), leads=True), changed


def candidates(
    made: Sequence[Experiment], rig: Rig, registry: Registry, minutes: float
) -> tuple[list[Candidate], list[str]]:
    """What may be measured in the time like the experiments ``made``, the first of each kind and spring.

    Also return what takes longer than that.
    """
    found, left_out, seen = list[Candidate](), list[str](), set[tuple[Any, ...]]()
    own_labels = {table.label for table in rig.tables}
    for e in made:
        kind, own = (
            registry[e.kind],
            (e.kind, getattr(e.table.settings, "spring", None) if e.bench else None, *e.table.columns),
        )
        each = rig.plan.get("minutes", {}).get(kind.test or kind.name, kind.minutes)
        number = int(minutes / each)
        if own in seen or not number:
            left_out += [f"{e.label} ({each:g} min)"] if own not in seen else []
            continue
        seen.add(own)
        starts = {name: start.centre for name, start in LogPosterior(e.rig, [e]).starts().items()}
        about = (number, number * each)
        name = f"as {e.label}" if e.shares_noise in own_labels else f"{e.label} as in the synthetic rig"
        if isinstance(e, PointTest):
            for words, changed, rows in _designs(e, kind) if number > isinstance(e, Line) else ():
                template, strength = _repeated(e, number, rows, changed)
                found.append(Candidate(template, f"{name}{words}", *about, strength, starts, {}))
        elif isinstance(e, CapsuleRun):
            found += [Candidate(run, f"{name}{words}", *about, number, starts, own) for words, run, own in _runs(e)]
        else:
            strength = number if e.time_series else number / e.n
            for part in AMPLITUDES if isinstance(e, DecayRecord) and not e.model.symbols else (1.0,):
                words = name + (f", {part:g} x its amplitude" if part != 1.0 else "")
                found.append(Candidate(e, words, *about, strength * part**2, starts, {}))
    return found, left_out


def twins(known: Values, rig: Rig, kinds: Sequence[Kind], registry: Registry, seed: int) -> list[Experiment]:
    """Experiments of ``kinds`` as the synthetic rig has them, at values by name, SI, with masses and priors of ``rig``."""
    if not kinds:
        return []
    truth = Truth(
        {name: x for name, x in PAPER.items() if not (by_index("k2", known) and symbol_of(name) == "k2")} | dict(known)
    )
    with tempfile.TemporaryDirectory() as folder:
        synthesize(Path(folder) / "next", seed, truth, "next", registry=Registry(tuple(kinds)))
        read = read_rig(Path(folder) / "next", registry)
    ground = {"slope": rig.slope, "N0": rig.N0}
    tables = tuple(
        replace(table, settings=replace(table.settings, **ground))
        if isinstance(table.settings, GroundSettings) and "angle" not in table.columns
        else table
        for table in read.tables
    )
    own = {
        "tables": tables,
        "m1": rig.m1 or read.m1,
        "m2": rig.m2 or read.m2,
        "g": rig.g,
        "model": rig.model,
        "priors": rig.priors,
        "plan": rig.plan,
    }
    return list(make_experiments(replace(read, **own), "bench", registry))


def lines_of(e: Experiment, kind: Kind) -> str:
    """The entry of rig.toml that reads tests like ``e``: its settings and reading errors, in SI units."""
    columns, own = e.table.columns.values(), fields(e.table.settings)
    stated = {one.name: (one.default, getattr(e.table.settings, one.name)) for one in own}
    # What belongs to the old record alone, and what [rig] states for every table.
    of_rig = {key for key in ("slope", "N0") if key in stated and stated[key][1] == getattr(e.rig, key)}
    of_record = {"releases", *(key for key in ("start", "stop") if not isinstance(stated.get(key, ("", ""))[1], str))}
    stated = {key: pair for key, pair in stated.items() if key not in of_rig | of_record}
    shown = {
        "kind": json.dumps(kind.name),
        "file": json.dumps(f"{kind.name}_next.csv"),
        **{key: _text(x, kind.setting_rules[key]) for key, (default, x) in stated.items() if x not in (default, None)},
    }
    for column in columns:
        rule = QuantityRule("s" if column.name == "time" else kind.columns[column.name].si)
        errors = {"sd": column.sd, "resolution": column.resolution}
        shown |= {f"{column.name}_{key}": _text(x, rule) for key, x in errors.items() if x is not None}
        if column.instrument and column.instrument.name == f"{e.shares_noise}_{column.name}":  # of the parts of a run
            shown[f"{column.name}_gain_sd"] = _text(column.instrument.errors["gain"].sd, QuantityRule("1"))
        elif column.instrument:
            shown[f"{column.name}_instrument"] = json.dumps(column.instrument.name)
    header = ", ".join(f"{column.name} [{column.unit}]" for column in columns)
    return "\n".join(["[[experiment]]", *(f"{key} = {text}" for key, text in shown.items()), f"# columns: {header}"])


def _text(value: Any, rule: object) -> str:
    """A setting as TOML; a quantity in its SI unit."""
    if not isinstance(rule, QuantityRule):
        return json.dumps(value)
    own = value if isinstance(value, Quantity) else Quantity(value)
    return f'{{ value = {own.value:.6g}{f", sd = {own.sd:.6g}" if own.sd else ""}, unit = "{rule.si}" }}'


def next_tests(
    result: Result,
    targets: Sequence[str] = (),
    *,
    minutes: float = MINUTES,
    draws: int = DRAWS,
    seed: int = 0,
    progress: OnProgress | None = None,
) -> Plan:
    """Rank further tests by the sd that they leave: the geometric mean over the targets of expected over present sd.

    Tests of two kinds that share the time stand beside those of one kind.

    Parameters
    ----------
    result : of a sampled fit
    targets : names of parameters; () for all that are not stated
    minutes : time for the tests; what one of them takes stands in [plan] of rig.toml, or is the default of its kind
    draws, seed : number of draws of the posterior, and the seed of their choice

    Raises
    ------
    InputError
        If nothing was sampled or another friction law was fitted, a target is not a physical parameter of the fit, or the
        time is too short for any test.
    """
    refuse_another_law(result.provenance.friction)
    chosen = random_draws(result, draws, np.random.default_rng(seed))
    assert result.posterior is not None, "draws were taken"
    targets = _targets(result, targets)
    made, found, left_out = _candidates_of(result, minutes, seed)
    names, precision = list(chosen), _precision(result.posterior.draws, LogPosterior(result.rig, made), list(chosen))
    values = [dict(zip(names, row, strict=True)) for row in zip(*chosen.values(), strict=True)]
    place = [names.index(name) for name in targets]

    def sds(information: np.ndarray) -> np.ndarray:
        return np.sqrt(np.diagonal(np.linalg.inv(precision + information), axis1=1, axis2=2)[:, place]).mean(axis=0)

    options, best = list[Option](), dict[str, tuple[float, Candidate, np.ndarray]]()
    before = sds(np.zeros((1, *precision.shape)))
    for done, one in enumerate(found):
        if progress:
            progress(done, len(found), "test")
        information = one.information(values, names)
        if not np.isfinite(information).all():
            left_out.append(f"{one.words} (its motion changes its kind near the setting)")
            continue
        options.append(((one,), sds(information) / before))
        worth = _worth(options[-1])
        if worth < best.get(one.template.kind, (-LEAST,))[0]:
            best[one.template.kind] = worth, one, information
    for (_, one, own), (_, other, further) in combinations(best.values(), 2):
        if one.tests > 1 and other.tests > 1:
            both = own * (one.tests // 2) / one.tests + further * (other.tests // 2) / other.tests
            options.append(((one, other), sds(both) / before))
    return _plan(result, targets, options, left_out)


def _plan(result: Result, targets: Sequence[str], options: Sequence[Option], left_out: list[str]) -> Plan:
    """The options in order, without those that change nothing."""
    useful = [option for option in options if _worth(option) < -LEAST]
    if not useful:
        rule = "a further test must change the sd of a target by 1 % or more"
        raise InputError(rule, f"{counted(len(options), 'choice')} below that", "give more minutes, or other targets")
    if len(useful) < len(options):
        left_out.append(f"{counted(len(options) - len(useful), 'choice')} that change these sds by less than 1 %")
    options = sorted(useful, key=_worth)
    # Where a check left no number, the tests still narrow its random part.
    sds = result.summary["sd"].fillna(result.summary["sd_unwidened"])[targets]
    today = {name: float(sd) for name, sd in zip(targets, sds, strict=True)}
    rows = [_row(members, today, ratios) for members, ratios in options]
    table = pd.DataFrame(rows, index=pd.RangeIndex(1, len(rows) + 1))
    return Plan(table, today, tuple(members for members, _ in options), tuple(left_out), result.registry)


def _targets(result: Result, wanted: Sequence[str]) -> list[str]:
    """The parameters to know better: those ``wanted``, or all that are not stated."""
    known = [str(name) for name in result.summary.index if not is_stated(str(name))]
    for name in wanted:
        if name not in known:
            raise InputError("a target must be a parameter of the fit", name, f"choose from {', '.join(known)}")
    return list(dict.fromkeys(wanted)) or known


def _candidates_of(
    result: Result, minutes: float, seed: int
) -> tuple[tuple[Experiment, ...], list[Candidate], list[str]]:
    """The experiments of a fit, what may be measured besides, and what takes too long."""
    rig, registry, choice = result.rig, result.registry, result.provenance.experiments
    made, _ = second_models(make_experiments(rig, choice, registry), check_readings(rig, choice, registry))
    measured = {e.kind for e in made}
    lacking = [kind for kind in registry.kinds if kind.bench and kind.twin and kind.name not in measured]
    values = {str(name): float(x) for name, x in zip(result.summary.index, result.summary["value"], strict=True)}
    medians = {name: x for name, x in values.items() if name in PAPER or symbol_of(name) == "k2"}
    found, left_out = candidates([*made, *twins(medians, rig, lacking, registry, seed)], rig, registry, minutes)
    if not found:
        raise InputError("a test must fit into the time", f"{minutes:g} min", "give more minutes")
    return made, found, left_out


def _precision(draws: np.ndarray, target: LogPosterior, names: Sequence[str]) -> np.ndarray:
    """(d, d) inverse covariance of draws (..., d) of ``names``, in the coordinates of ``target``."""
    positive = np.isin(names, [name for name, sign in zip(target.names, target.positive, strict=True) if sign])
    sample = draws.reshape(-1, len(names))
    return np.linalg.inv(np.cov(np.where(positive, np.log(np.where(positive, sample, 1.0)), sample).T))


def _worth(option: Option) -> float:
    """Mean logarithm of the ratios: the smaller, the better."""
    return float(np.mean(np.log(option[1])))


def _row(members: Sequence[Candidate], today: Values, ratios: np.ndarray) -> dict[str, Any]:
    """The row of ``Plan.table`` for tests that share the time."""
    pairs = list(zip(today.items(), ratios.tolist(), strict=True))
    return {
        "kind": " + ".join(one.template.kind for one in members),
        "tests": " + ".join(str(one.tests // len(members)) for one in members),
        "what": "; ".join(one.words for one in members),
        "minutes": sum(one.minutes / one.tests * (one.tests // len(members)) for one in members),
        **{f"sd of {name}": sd * ratio for (name, sd), ratio in pairs},
        **{f"{name}, ratio": ratio for (name, _), ratio in pairs},
    }


def planned(folder: str | Path, registry: Registry, draws: int = DRAWS, seed: int = 0) -> tuple[pd.DataFrame, float]:
    """What the tests of [plan] would show of every parameter, before any of them is made, and the minutes that they take.

    Truths are drawn from the priors, within a factor of ``FACTOR`` of their medians. The tests are those of the synthetic rig,
    with its reading errors.

    Parameters
    ----------
    folder : holds ``rig.toml`` with the masses, [plan] tests = { push = 10, free_vibration = 3 }, and perhaps [prior]; the
        files of its experiments need not exist

    Returns
    -------
    A row per parameter: ``known`` in the words of ``identified``, sd over prior sd, and sd over value where it is positive.

    Raises
    ------
    InputError
        If rig.toml breaks a rule, states no tests or no mass, or plans what the synthetic rig does not have.
    """
    rig = read_rig(folder, registry, planned=True)
    by_word = {kind.test or kind.name: kind for kind in registry.kinds}
    tests = _planned_tests(rig, [word for word, kind in by_word.items() if kind.bench and kind.twin])
    rng, kinds = np.random.default_rng(seed), [by_word[word] for word in tests]
    covariances, shown = list[np.ndarray](), list[Any]()
    for i in range(draws):
        made = twins(_drawn(rig, registry, rng), rig, kinds, registry, seed + i)
        target = LogPosterior(rig, made)
        shown = [row for row in target.parameters if row.physical and not row.scatter]
        names = [row.name for row in shown]
        precision = np.diag(1.0 / np.array([prior_sd(row) for row in shown]) ** 2)
        values = {name: start.centre for name, start in target.starts().items()}
        for e in made:
            number = tests[registry[e.kind].test or e.kind] / sum(other.kind == e.kind for other in made)
            if number < 2 and isinstance(e, Line):
                continue
            rows = np.arange(e.n)
            template, strength = _repeated(e, max(number, 1), rows, {}) if isinstance(e, PointTest) else (e, number)
            own = Candidate(template, "", 1, 1.0, strength, values, {})
            precision = precision + own.information([values], names)[0]
        covariances.append(np.linalg.inv(precision))
    sds, prior = np.sqrt([np.diag(each) for each in covariances]), np.array([prior_sd(row) for row in shown])
    frame = words_of([row.name for row in shown], np.mean(covariances, axis=0), np.mean(sds, axis=0) / prior)
    frame["sd / value"] = [float(np.mean(sds[:, i])) if row.positive else np.nan for i, row in enumerate(shown)]
    stated = rig.plan.get("minutes", {})
    return frame, sum(number * stated.get(word, by_word[word].minutes) for word, number in tests.items())


def _planned_tests(rig: Rig, known: Sequence[str]) -> Mapping[str, float]:
    """Numbers of tests by the ``known`` words, from [plan]."""
    place, tests = rig.folder / "rig.toml", rig.plan.get("tests", {})
    if wrong := [word for word, n in tests.items() if word not in known or n % 1.0 or n > MOST_TESTS]:
        rule = f"[plan] tests must be whole numbers up to {MOST_TESTS} of bench tests that the synthetic rig has"
        raise InputError(rule, f"{wrong[0]} = {tests[wrong[0]]:g}", f"choose from {', '.join(known)}", place)
    lines = {f'[rig] {name} = {{ value = 0.1, unit = "kg" }}': getattr(rig, name) for name in ("m1", "m2")}
    lines |= {"[plan] tests = { push = 10, free_vibration = 3 }": tests}
    if missing := [line for line, stated in lines.items() if not stated]:
        rule = "a plan needs m1 and m2 in [rig], and tests in [plan]"
        table, name, rest = missing[0].split(" ", 2)
        raise InputError(rule, f"no {name}", f"add e.g. {name} {rest} to {table}", place)
    return tests


def _drawn(rig: Rig, registry: Registry, rng: np.random.Generator) -> dict[str, float]:
    """Truths of a planned rig by name, SI; the masses are the stated ones."""
    springs = [name for name in rig.priors if symbol_of(name) == "k2"] or [
        name for name in PAPER if symbol_of(name) == "k2"
    ]
    drawn = {"m1": rig.mass("m1"), "m2": rig.mass("m2"), "g": rig.g.value}
    for name in ("k1", "c", "mu", "v_s", "K", *springs):
        prior = rig.priors.get(name) or registry.parameters[symbol_of(name)].prior
        assert prior is not None, "it has a default prior"
        width = np.log(min(prior.spread, FACTOR)) / QUANTILE_975
        drawn[name] = float(
            prior.location * np.exp(width * np.clip(rng.standard_normal(), -QUANTILE_975, QUANTILE_975))
        )
    return drawn
