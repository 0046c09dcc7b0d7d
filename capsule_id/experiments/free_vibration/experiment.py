"""Free vibration of the rod, motor switched on, capsule at rest (paper, section 2.2): k1 and c, their checks and tables."""

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd
from scipy import ndimage, stats

from capsule_id.experiments.base import LEVEL, Check, Fitted, ValuesBySymbol, refit
from capsule_id.experiments.free_vibration.decrement import equilibrium, viscous_fit
from capsule_id.experiments.free_vibration.hidden_terms import (
    FEWEST_HALF_SWINGS,
    check_changing,
    check_held,
    check_hidden_terms,
    sensitivities,
    zero_jumps,
)
from capsule_id.experiments.free_vibration.readings import EFFECTS, DecayModel, decay_window, default_block_size
from capsule_id.experiments.free_vibration.record import Decay, DecayRecord, drift_by_shape
from capsule_id.experiments.free_vibration.screening import Screening
from capsule_id.experiments.free_vibration.second_fit import SHORTEST, demands_another, second_models
from capsule_id.experiments.statistics import further_columns, weighted_mean
from capsule_id.parameters import parameter
from capsule_id.records.duplicates import reading_step
from capsule_id.records.faults import sampling
from capsule_id.records.tones import SIGNIFICANT, VISIBLE, length_of_motion, other_tone
from capsule_id.rig.filters import median_step, rounded
from capsule_id.views import Facts, Finding, Level, ResultTable, listed

#: Rounding errors are no noise where all noise is below this share of the distance of levels; rounding alone is 0.29 of it.
COARSE = 0.42
#: Above this share rounding adds little to the noise: sizes of residuals then tell of the motion.
FINE = 0.55
#: Intervals of position in each direction of the motion, and fewest readings per interval.
INTERVALS, READINGS_PER_INTERVAL = 12, 5
#: Largest part of a drift that is as fast as the motion, relative to the motion.
FAST_DRIFT = 0.01
#: Largest part of a drift that is as fast as the motion, relative to the residuals left: about half of what white noise gives.
FAST_NOISE = 0.25
#: Smallest ratio of the residuals of the larger half of the amplitudes to those of the smaller half that counts.
LARGER = 1.3
#: Steps of the readings in which a motion is lost, and fewest readings before that.
STEPS, FEWEST_SIZES = 3.0, 30


#: The level of what was seen in one decay of so many.
Graded = Callable[[int], Level]
#: A judge of one decay at its values by symbol: facts, and a level or a p-value; None where it cannot be judged.
Judge = Callable[[Any, ValuesBySymbol], tuple[Facts, Level | Graded | float] | None]


def graded(z: float, matters: bool) -> Graded:
    """Grade a deviation of ``z`` sd: a chance of one in many decays counts as it would in a single one (Bonferroni)."""

    def level(number: int) -> Level:
        alone = stats.norm.isf(min(number * stats.norm.sf(z), 0.5))
        return "ok" if not alone > VISIBLE else "fail" if alone > SIGNIFICANT and matters else "warn"

    return level


def each(code: str, judge: Judge, joined: bool = True) -> Check:
    """Return the check that judges every decay; a p-value below ``LEVEL`` over the number of decays fails.

    Parameters
    ----------
    joined : report those that pass in one finding, where all do, with their labels and their smallest p-value
    """

    def check(decays: Sequence[Decay], fit: Fitted) -> list[Finding]:
        judged = [(e, *found) for e in decays if (found := judge(e, e.local(fit.values))) is not None]
        findings = list[Finding]()
        for e, facts, found in judged:
            level = found(len(judged)) if callable(found) else found
            level = level if isinstance(level, str) else "fail" if level * len(judged) < LEVEL else "ok"
            if level != "ok" or not joined:
                # A doubt that would move a parameter leaves it unjudged.
                doubtful = ("k1", "c", *e.model.symbols) if level == "warn" and facts.get("moved") else ()
                findings.append(Finding(code, level, {"label": e.label, **facts}, e.label, doubtful))
        if judged and not findings:
            least = {"p": min(facts["p"] for _, facts, _ in judged)} if "p" in judged[0][1] else {}
            findings.append(Finding(code, "ok", {"labels": listed(e.label for e, *_ in judged), **least}))
        return findings

    return check


def check_stiffness(records: Sequence[DecayRecord], fit: Fitted) -> list[Finding]:
    """Check that k1 of single records does not depend on amplitude (the paper's "linear near the working point")."""
    if len(records) < 2:
        return []
    k1, sd = zip(*(refit(e, e.local(fit.values), [])["k1"] for e in records), strict=True)
    q = weighted_mean(k1, sd)[2]
    p = float(stats.chi2.sf(q, len(records) - 1))
    facts = {"records": len(records), "low": min(k1), "high": max(k1), "chi_square": q, "p": p}
    return [Finding("decays.stiffness", "fail" if p < LEVEL else "ok", facts)]


def check_free_decay(decays: Sequence[Decay], fit: Fitted) -> list[Finding]:
    """Check that a free capsule does not slip and that the rod does not touch the support spring.

    A capsule counts as held unless stated: where it would slip if it were not, further forces that no setting states are
    in doubt, since the slip looks like one. A free one slips unseen where no experiment determines the friction.
    """
    findings, theta = [], fit.values
    for e in decays:
        needed = {"m2", *(row.symbol for row in e.friction.parameters_at_rest)}
        free, found = e.table.settings.capsule == "free", e.model.symbols if e.replaced else ()
        known = needed <= set(theta)
        if free or (found and known):
            force = theta["k1"] * e.largest_deflection
            if isinstance(e, DecayRecord) and e.order == 0:  # f = k1 x_rel + c d(x_rel)/dt
                x = e.smoothed() - equilibrium(e.values)
                force = float(np.max(np.abs(theta["k1"] * x + theta["c"] * np.gradient(x, e.condensed[0]))))
            threshold = float(e.friction.force(theta).forward(0.0)) if known else None
            if threshold is None or force > threshold:
                weight = (e.rig.mass("m1") + e.rig.mass("m2")) * e.rig.g.value
                facts: Facts = {"force": force, "F_b": threshold, "label": e.label, "mu": force / weight}
                sure, doubtful = free and known, ("c", *found) if known else ("k1", "c", *e.model.symbols)
                findings.append(
                    Finding("decays.slip", "fail" if sure else "warn", facts, e.label, () if sure else doubtful)
                )
        for gap, side in ((e.table.settings.gap, 1.0), (e.table.settings.gap_back, -1.0)):
            reach = float(np.max(side * e.moved))
            if gap is not None and reach >= gap.value:
                findings.append(
                    Finding("decays.contact", "fail", {"reach": side * reach, "gap": side * gap.value}, e.label)
                )
    return findings


#: Value of each parameter in both halves, their difference over its sd, and whether that matters; {} for a short decay.
Changes = Callable[[Any, ValuesBySymbol], Mapping[str, tuple[float, float, float, bool]]]


def halves(changes: Changes) -> Check:
    """Return the check that both halves of every decay give the same parameters, where it is long enough."""

    def judge(e: Decay, theta: ValuesBySymbol) -> tuple[Facts, Graded] | None:
        found = changes(e, theta)
        if not found:
            return None
        name = max(found, key=lambda name: abs(found[name][2]))
        first, second, z, matters = found[name]
        return {
            "moved": matters,
            "name": name,
            "first": first,
            "second": second,
            "z": abs(z),
            "unit": parameter(name).unit,
            "model": e.model_name,
            "stated": e.stated_words,
        }, graded(abs(z), matters)

    return each("decays.halves", judge)


def changes_of_second_half(e: DecayRecord, theta: ValuesBySymbol) -> dict[str, tuple[float, float, float, bool]]:
    """See ``Changes``: fits of both halves of a record."""
    decrement = e.decrement()
    # The acceleration jumps where the rod turns, so difference quotients give no standard errors.
    jumps = e.order == 2 and "dry" in e.model.damping
    if decrement is None or len(decrement.times) < FEWEST_HALF_SWINGS or jumps:
        return {}
    # Behind the last peak there is noise alone.
    time = e.whole[0][e.whole[0] <= decrement.times[-1]]
    if len(time) < 2 * SHORTEST * e.model.thin:
        return {}
    middle, end = float(time[len(time) // 2]), float(time[-1])
    first, second = (_estimates(e.between(*ends), theta) for ends in ((0.0, middle), (middle, end)))
    pairs = {name: (*first[name], *second[name]) for name in first}
    return {name: (a, b, float((b - a) / np.hypot(sd_a, sd_b)), True) for name, (a, sd_a, b, sd_b) in pairs.items()}


def check_aliases(records: Sequence[DecayRecord], fit: Fitted) -> list[Finding]:
    """State the lowest alias of the records with even samples, and which of them have it."""
    found = ((e.label, *sampling(decay_window(e.table)[0])) for e in records)
    rates = {label: rate for label, rate, even in found if even}
    if not rates or "m1" not in fit.values:
        return []
    lowest = min(rates.values())
    k1 = (2.0 * np.pi * lowest * np.sqrt(fit.values["m1"]) - np.sqrt(fit.values["k1"])) ** 2
    labels = (label for label, rate in rates.items() if np.isclose(rate, lowest))
    facts = {"labels": listed(labels), "other": float(np.sqrt(k1 / fit.values["m1"])) / (2.0 * np.pi), "k1": k1}
    return [Finding("decays.alias", "ok", facts)]


def check_found_forces(records: Sequence[DecayRecord], fit: Fitted) -> list[Finding]:
    """Check further forces: one that no setting states is far from 0 in the sample; none stems from coarse levels."""
    having = {symbol: e for e in records for symbol in e.model.symbols}
    found = {symbol: e for symbol, e in having.items() if e.replaced and fit.draws}
    draws = {symbol: np.array([draw[symbol] for draw in fit.draws]) for symbol in found}
    z = {symbol: float(abs(np.mean(values)) / np.std(values)) for symbol, values in draws.items()}
    return [
        Finding(
            "decays.found",
            "warn",
            {"label": e.label, "name": symbol, "z": z[symbol], "effect": EFFECTS[symbol]},
            e.label,
            (symbol,),
        )
        for symbol, e in found.items()
        if z[symbol] < VISIBLE
    ] + [
        Finding("decays.coarse", "warn", {"label": e.label, "name": symbol, **facts}, e.label, (symbol, "c"))
        for symbol, e in having.items()
        if (facts := coarse_levels(e))["share"] < COARSE
    ]


def coarse_levels(e: DecayRecord) -> Facts:
    """Distance of the levels of a record, and its noise as a share of that, rounding included; inf where none repeat."""
    (time, values), column = e.whole, e.column
    step, noise = reading_step(values), float(np.std(viscous_fit(time, values).left))
    return {"step": step * column.to_display, "unit": column.unit, "share": noise / step if step > 0.0 else np.inf}


def drift(e: DecayRecord, theta: ValuesBySymbol) -> tuple[Facts, Level] | None:
    """Judge whether a Gaussian-process drift is slower and smaller than the motion, else it hides errors of the model."""
    if e.model.drift != "gp":
        return None
    half = np.pi * np.sqrt(theta["m1"] / theta["k1"])
    residuals = sensitivities(e, theta)[0]
    shape = {symbol: theta[symbol] for symbol in e.model.shapes}
    slow = np.asarray(drift_by_shape(e.times, residuals, e.model.noise, shape))
    curve = e.values - residuals
    fast, motion = fast_rms(e.time, slow, half), fast_rms(e.time, curve, half)
    if fast is None or motion is None:
        return None
    noise, larger = FAST_NOISE * float(np.std(residuals - slow)), bool(np.std(slow) > np.std(curve))
    level = "fail" if larger or fast > max(FAST_DRIFT * motion, noise) else "ok"
    return {"larger": larger, "share": fast / max(motion, noise), **later_start(e)}, level


def size_of_residuals(e: DecayRecord, theta: ValuesBySymbol) -> tuple[Facts, float] | None:
    """Judge whether the residuals are larger where the motion is larger: fitted noise then holds an error of the model.

    Spearman's rank correlation of their sizes with the amplitude of the fitted motion, before that is lost in the steps of
    the readings. (Readings at rest are residuals themselves.)
    """
    left = sensitivities(e, theta)[0]
    curve = _without_last_digits(e.values, left)
    size = np.abs(curve - equilibrium(curve))
    moving = np.flatnonzero(size >= STEPS * reading_step(e.whole[1]))
    n = int(moving[-1]) + 1 if len(moving) else 0
    if n < FEWEST_SIZES:
        return None
    residuals = np.abs(np.asarray(e.residuals(theta, np))[:n])
    period = 2.0 * np.pi / e.rough.Omega_o / median_step(e.time)
    amplitude = ndimage.maximum_filter1d(size[:n], max(3, round(period)))
    if np.ptp(amplitude) == 0.0 or np.ptp(residuals) == 0.0:
        return None
    # Those of the larger half of the motion, which a long rest may follow.
    seen = amplitude[amplitude > np.std(left)]
    large = amplitude > np.median(seen if len(seen) else amplitude)
    large = large if large.any() else amplitude == np.max(amplitude)
    ratio = float(np.sqrt(np.mean(residuals[large] ** 2) / np.mean(residuals[~large] ** 2)))
    trend = stats.spearmanr(amplitude, residuals, alternative="greater")
    p = float(trend.pvalue)  # pyright: ignore[reportAttributeAccessIssue]  (SciPy types the result as a tuple)
    return {"ratio": ratio, "p": p, **later_start(e)}, p if ratio > LARGER else 1.0


def _without_last_digits(values: np.ndarray, left: np.ndarray) -> np.ndarray:
    """The fitted motion (n,): ``values`` minus residuals ``left``. At rest its last digits would depend on the residuals."""
    return np.round((values - left) / np.ptp(values), 9) * np.ptp(values)


def later_start(e: DecayRecord) -> Facts:
    """Time from which the amplitudes are below half the largest one: ``start``, s, None where too few swings are left."""
    size = np.abs(e.values - equilibrium(e.values))
    begin = int(np.flatnonzero(size > 0.5 * np.max(size))[-1]) + 1
    left = e.time[begin:][: length_of_motion(e.values[begin:])] if begin < len(e.time) else e.time[:0]
    # Half of what a record needs whose halves are compared.
    few = len(left) == 0 or np.ptp(left) * e.rough.Omega_o / np.pi < FEWEST_HALF_SWINGS // 2
    # Beyond half of critical damping one exponential is left of a decay.
    if few or e.rough.c * e.rough.Omega_o > e.rough.k1 or e.table.settings.releases:
        return {"start": None}
    return {"start": rounded(decay_window(e.table)[0][0] + e.time[begin], e.time)}


def fast_rms(time: np.ndarray, values: np.ndarray, half: float) -> float | None:
    """Rms of the part of ``values`` that turns its sign every ``half`` seconds.

    A filter with gain 1 there and 0 for a straight line reads one period to each side of a sample. None where the samples
    with both sides cover less than one period.
    """
    inside = (time > time[0] + 2.0 * half) & (time < time[-1] - 2.0 * half)
    if not inside.any() or np.ptp(time[inside]) < 2.0 * half:
        return None
    for _ in range(2):
        before, after = (np.interp(time + shift, time, values) for shift in (-half, half))
        values = 0.5 * (values - 0.5 * (before + after))
    return float(np.sqrt(np.mean(values[inside] ** 2)))


def position(e: DecayRecord, theta: ValuesBySymbol) -> tuple[Facts, float] | None:
    """Judge whether the residuals depend on the position of the rod and the direction of its motion.

    The F test for offsets of the readings by interval of position and direction; the interval with the largest offset is
    stated. None for too few readings.
    """
    # The acceleration jumps where the rod turns.
    if e.n < 2 * READINGS_PER_INTERVAL or (e.order == 2 and "dry" in e.model.damping):
        return None
    left, design, moved = sensitivities(e, theta)
    curve = _without_last_digits(e.values, left)
    offsets, limits = [], []
    number = min(INTERVALS, len(curve) // (2 * READINGS_PER_INTERVAL))
    for ahead in (np.gradient(curve, e.time) > 0.0, np.gradient(curve, e.time) <= 0.0):
        if not ahead.any():
            continue
        edges = np.quantile(curve[ahead], np.linspace(0.0, 1.0, number + 1))
        place = np.clip(np.searchsorted(edges, curve, side="right") - 1, 0, number - 1)
        offsets += [ahead & (place == i) for i in range(number)]
        limits += list(itertools.pairwise(edges))
    known = np.column_stack([design, *moved.values()])
    _, p, effects = further_columns(*(e.whitened(theta, x) for x in (known, np.stack(offsets, axis=1), left)))
    if np.isnan(p):
        return None
    low, high = np.array(limits[np.argmax(np.abs(effects))]) * e.column.to_display
    return {"p": p, "low": float(low), "high": float(high), "unit": e.column.unit, **later_start(e)}, p


def onset(e: DecayRecord, theta: ValuesBySymbol) -> tuple[Facts, float] | None:
    """Compare a decay with its readings after the first half period, which a release shapes.

    Return facts, and the p-value of equal parameters and of residuals that are not larger before. By one linear step from the
    fit: dry friction has many maxima, and a fit of the later readings may end at another one.
    """
    if e.order == 2 and "dry" in e.model.damping:
        return None
    left, design, moved = sensitivities(e, theta)
    half = float(np.pi / e.rough.Omega_o)
    later = e.time > e.time[0] + half
    known = np.asarray(e.whitened(theta, np.column_stack([left, *moved.values(), design])))
    freedom = np.count_nonzero(later) - known.shape[1] + 1
    if freedom < SHORTEST or not np.isfinite(known).all():
        return None
    unit = np.maximum(np.linalg.norm(known[:, 1:], axis=0), np.finfo(float).tiny)
    step, part = (np.linalg.lstsq(rows[:, 1:] / unit, -rows[:, 0], rcond=None)[0] for rows in (known, known[later]))
    scaled = known[later, 1:] / unit
    noise = float(np.sum((known[later, 0] + scaled @ part) ** 2)) / freedom
    names = [name for name in moved if name in ("k1", "c", *e.model.symbols)]
    at = [list(moved).index(name) for name in names]
    covariance = noise * np.linalg.pinv(scaled.T @ scaled)[np.ix_(at, at)]
    change, sd = (part - step)[at], np.sqrt(np.maximum(np.diag(covariance), np.finfo(float).tiny))
    # The estimate from all readings shares the later ones, so the covariance of the change is at most this one.
    equal = stats.chi2.sf(change @ np.linalg.pinv(covariance) @ change, len(names))
    # Ranks: one wrong reading there is no release.
    louder: Any = stats.mannwhitneyu(np.abs(known[~later, 0]), np.abs(known[later, 0]), alternative="greater")
    # Coarse digits are noise where the rod moves alone.
    fine = coarse_levels(e)["share"] > FINE
    both = np.maximum([equal, louder.pvalue] if fine else [equal], np.finfo(float).tiny)
    p = float(stats.chi2.sf(-2.0 * np.sum(np.log(both)), 2 * len(both)))  # Fisher's sum
    i = int(np.argmax(np.abs(change) / sd))
    whole, changed = theta[names[i]], theta[names[i]] + float(change[i] / unit[at[i]])
    facts = {"label": e.label, "name": names[i], "whole": whole, "later": changed, "unit": parameter(names[i]).unit}
    # After half a period a part of an exponential release is left; after a period nothing of a strongly damped decay.
    light = theta["c"] < np.sqrt(theta["k1"] * theta["m1"])
    free = e.time[light & (e.time > e.time[0] + 2.0 * half)]
    kept = len(free) > SHORTEST and not e.table.settings.releases
    start = rounded(decay_window(e.table)[0][0] + free[0], e.time) if kept else None
    return {**facts, "p": p, "start": start, "half": half}, p


def check_onset(records: Sequence[DecayRecord], fit: Fitted) -> list[Finding]:
    """Check that the numbers do not stem from the first half period, and that what a second fit found is seen later."""
    judged = [(e, *found) for e in records if (found := onset(e, e.local(fit.values))) is not None]
    findings = [Finding("decays.onset", "fail", facts, e.label) for e, facts, p in judged if p * len(judged) < LEVEL]
    later = list[tuple[DecayRecord, Facts, DecayRecord]]()
    for e, facts, _ in judged:
        thin = e.table.settings.thin or default_block_size(*decay_window(e.table))
        first = replace(DecayModel.stated(e.table.settings), thin=thin)
        if e.replaced and e.model != first:
            later.append((e, facts, e.between(facts["half"], float(e.time[-1]), first)))
    # Records share the second model: one whose later readings contradict the first one supports it for all.
    if later and not findings and not any(demands_another(part, LEVEL / len(later)) for *_, part in later):
        findings = [
            Finding("decays.onset", "warn", facts, e.label, ("k1", "c", *e.model.symbols)) for e, facts, _ in later
        ]
    return findings or [Finding("decays.onset", "ok", {"labels": listed(e.label for e, *_ in judged)})] * bool(judged)


def _estimates(half: DecayRecord, theta: Mapping[str, float]) -> dict[str, tuple[float, float]]:
    """Estimate and standard error of each physical parameter from one half, from the values ``theta`` of the whole."""
    if half.closed and not half.model.whitened:
        return refit(half, theta, [])
    screening = Screening(half, k1=theta["k1"])
    found, _ = screening.fit(half.model, screening.scaled(theta))
    return {name: (found.values[name], found.errors[name]) for name in ("k1", "c", *half.model.symbols)}


check_halves = halves(changes_of_second_half)
check_positions = each("decays.position", position)
check_drift = each("decays.drift", drift, joined=False)
check_zero = each("decays.zero", zero_jumps)


# tables: Views of free decays: estimates by record, and correlations of the damping.


def decay_table(records: "Sequence[FreeVibration]", fit: Fitted) -> list[ResultTable]:
    """Compare k1 and c of every record alone with the paper's protocol."""
    rows = []
    for record in records:
        raw, smooth = record.paper_decrement(smooth=False), record.paper_decrement()
        ours = refit(record, record.local(fit.values), [])
        rows.append(
            {
                "record": record.label,
                "largest deflection, m": record.largest_deflection,
                "k1, N/m": ours["k1"][0],
                "± k1": ours["k1"][1],
                "c, N s/m": ours["c"][0],
                "± c": ours["c"][1],
                "k1 = m1Ω_o²": smooth.k1 if smooth else np.nan,
                "c, smoothed peaks": smooth.c if smooth else np.nan,
                "c, raw peaks": raw.c if raw else np.nan,
            }
        )
    return [ResultTable("decays.records", pd.DataFrame(rows).set_index("record"))]


def damping_table(records: "Sequence[FreeVibration]", fit: Fitted) -> list[ResultTable]:
    """Correlations of the damping parameters; [] where all damping is viscous."""
    symbols = dict.fromkeys(symbol for record in records for symbol in record.model.symbols if symbol != "k_cubic")
    if not symbols:
        return []
    names = ["c", *symbols]
    frame = pd.DataFrame(fit.correlation(names), index=pd.Index(names, name="correlation"), columns=names)
    return [ResultTable("decays.damping", frame)]


class FreeVibration(DecayRecord):
    """One channel of one raw record, with its checks, tables and starts."""

    checks = (
        check_stiffness,
        check_free_decay,
        check_halves,
        check_onset,
        check_aliases,
        check_positions,
        each("decays.residuals", size_of_residuals),
        check_found_forces,
        check_drift,
        check_zero,
        check_hidden_terms,
        check_changing,
        check_held,
    )
    tables = (decay_table, damping_table)

    @classmethod
    def second_models(cls, records: Sequence[Any], readings: Sequence[Finding] = ()) -> tuple[list[Any], list[Finding]]:
        return second_models(records, readings)

    def noise_facts(self) -> Facts:
        return {
            "model": "decay",
            "present": [
                *(EFFECTS[symbol] for symbol in self.model.symbols),
                *["drift of the zero"] * (self.model.drift != "none"),
                *["hum"] * bool(self.model.hum),
            ],
            "second": self.replaced,
            "tone": None if self.model.hum else other_tone(self.time, self.values),
            "stated": self.stated_words,
            **later_start(self),
        }
