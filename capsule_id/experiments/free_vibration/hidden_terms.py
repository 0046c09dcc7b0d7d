"""What the fitted model of a decay lacks: further forces, changes with time, a hold before the release, jumps of the zero."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Any

import numpy as np
from scipy import optimize, signal, special, stats

from capsule_id.experiments.base import LEVEL, Fitted, ValuesBySymbol, refit, stretch
from capsule_id.experiments.free_vibration.decrement import PEAKLESS, STRONGEST, UNKNOWNS, viscous_fit, viscous_state
from capsule_id.experiments.free_vibration.readings import (
    DAMPING,
    FURTHER,
    block_mean,
    block_size,
    decay_window,
    natural_units,
)
from capsule_id.experiments.free_vibration.record import FINEST, Decay, DecayRecord
from capsule_id.experiments.friction_variants import DOUBTFUL, FACTOR
from capsule_id.experiments.statistics import without
from capsule_id.parameters import QUANTILE_975, parameter
from capsule_id.records.release import EVIDENCE
from capsule_id.records.tones import VISIBLE
from capsule_id.views import Facts, Finding, Level, listed

# sensitivities: Effects of the parameters on the readings of a decay, and of forces that the fitted model lacks.


#: Step of difference quotients, in natural units of each parameter; smallest unit of c, relative to sqrt(k1 m1).
SENSITIVITY_STEP, SMALLEST_C = 1e-5, 0.01
#: Responses and speeds that are smaller than this, relative to the largest ones, are rounding.
ROUNDING = 1e-6
#: Points per period, and fewest and most points, of the responses to further forces.
RESPONSE_POINTS, FEWEST_POINTS, MOST_POINTS = 60, 200, 1_000_000


def sensitivities(
    e: Decay, theta: Mapping[str, float], names: Sequence[str] = ()
) -> tuple[np.ndarray, np.ndarray, dict[str, np.ndarray]]:
    """Residuals (n,), design of the linear nuisances (n, p), and derivatives of the residuals by symbol, (n,) each.

    ``names`` of the parameters that are moved; default: those of the motion.
    """
    raw, design = e.unwhitened(theta, np)
    nuisances = np.linalg.lstsq(e.whitened(theta, design), e.whitened(theta, raw), rcond=None)[0]
    left, size, k1, m1 = raw - design @ nuisances, e.largest_deflection, theta["k1"], theta["m1"]
    # Natural units of the parameters, SI.
    units = {
        "k1": k1,
        "c": max(theta["c"], SMALLEST_C * float(np.sqrt(k1 * m1))),
        **natural_units(k1, m1, size),
        "amplitude": size,
        "turning_time": float(np.sqrt(m1 / k1)),
    }
    moved = {}
    for name in names or ("k1", "c", *e.model.symbols, *e.own_symbols):
        other, basis = e.unwhitened({**theta, name: theta[name] + SENSITIVITY_STEP * units[name]}, np)
        moved[name] = (other - basis @ nuisances - left) / (SENSITIVITY_STEP * units[name])
    return left, design, moved


def further_sensitivities(e: Decay, theta: Mapping[str, float]) -> dict[str, np.ndarray]:
    """Derivatives (n,) of the residuals with respect to the forces that the model of ``e`` lacks, at zero force."""
    if isinstance(e, DecayRecord) and e.closed:
        return {name: -response for name, response in force_responses(e, theta).items()}
    full = e.with_model(replace(e.model, damping=tuple(DAMPING), cubic=True))
    return sensitivities(full, {**theta, **dict.fromkeys(e.model.absent, 0.0)}, e.model.absent)[2]


def force_responses(e: DecayRecord, theta: Mapping[str, float]) -> dict[str, np.ndarray]:
    """Responses (n,) of the readings of a viscous decay to F_dry, c_q and k_cubic of unit size, SI, by symbol.

    They are linear, for small forces, and start at rest: the nuisances of the decay contain any other start.
    """
    raw, design = e.unwhitened(theta, np)
    parts = e.width * np.linalg.lstsq(e.whitened(theta, design), e.whitened(theta, raw), rcond=None)[0]
    m1, k1, c = theta["m1"], theta["k1"], theta["c"]
    time = e.time * stretch(e.clock_rate, theta)
    length = float(time[-1])
    points = RESPONSE_POINTS * length * np.sqrt(k1 / m1) / (2.0 * np.pi)
    if not points < MOST_POINTS:  # a fit that failed: the rod would swing thousands of times between two readings
        return dict.fromkeys(FURTHER, np.zeros(len(time)))
    grid = np.linspace(0.0, length, max(FEWEST_POINTS, int(points)))
    x, rate = viscous_state(grid, theta, parts, e.order)
    system = ([1.0 / m1], [1.0, c / m1, k1 / m1])
    found = {}
    for name, force in zip(FURTHER, (np.sign(rate), rate * np.abs(rate), x**3), strict=True):
        response = -signal.lsim(system, force, grid)[1]
        for _ in range(e.order):
            response = np.gradient(response, grid[1])
        found[name] = np.interp(time, grid, response)
    return found


# zero: A zero of the sensor that jumps where the rod turns, as of an encoder that loses counts or of a loose sensor.


#: Half swings that are looked at, from the release on, and fewest of a record that is judged.
MOST_HALF_SWINGS, FEWEST_HALF_SWINGS = 60, 8
#: Most and fewest readings, or means of readings, per half swing, and fewest of all, without those near turning points.
MOST_READINGS, FEWEST_READINGS, FEWEST_OF_ALL = 64, 6, 200
#: Readings nearer to a turning point than this part of a half swing are left out: a zero may jump a little later.
NEAR = 0.1
#: Largest sum of squares of zeros that jump where the rod turns, relative to that of zeros that move slowly.
#: White and correlated noise, walks and steps of the readings leave 0.83 or more, hysteresis of 5 % 0.77 or more.
JUMPING = 0.75


def zero_jumps(e: DecayRecord, theta: ValuesBySymbol) -> tuple[Facts, Level] | None:
    """Judge whether the zero of the sensor jumps where the rod turns; None for too few readings, and without displacements.

    ``jump`` is the rms change of the zero from one half swing to the next, without what alternates. ``ratio`` is the sum of
    squares of the residuals that zeros of half swings leave, relative to that of a zero that moves in straight lines from the
    middle of each half swing to that of the next. Both have the same number of parameters.

    Three things are projected out of both descriptions: what the fitted parameters can take up, a zero for each direction
    of the motion (as of dry friction or hysteresis), and one in proportion to the amplitude.
    """
    time, values = e.whole
    half = np.pi / e.rough.Omega_o
    end = MOST_HALF_SWINGS * half
    if e.order > 0 or np.count_nonzero(time <= end) < FEWEST_OF_ALL:
        return None
    thin = block_size(time[time <= end], values[time <= end], 2.0 * MOST_READINGS)
    model = replace(e.model, thin=thin, noise="white", drift="none")
    part = e.between(0.0, float(min(end, time[-1])), model)
    left, design, moved = sensitivities(part, theta)
    curve = part.values - left
    rate = np.gradient(curve, part.time)
    # A rod that has stopped turns no more; the sign of its rate is that of rounding errors.
    moving = np.arange(len(rate)) <= np.flatnonzero(np.abs(rate) >= ROUNDING * np.max(np.abs(rate)))[-1]
    turns = np.flatnonzero(np.diff(rate[moving] > 0.0))
    turned = 0.5 * (part.time[turns] + part.time[turns + 1])
    if len(turns) < FEWEST_HALF_SWINGS - 1:
        return None
    kept = moving & (np.min(np.abs(part.time[:, None] - turned), axis=1) > NEAR * half)
    number = np.unique(np.searchsorted(turned, part.time[kept]), return_inverse=True)[1]
    count = np.bincount(number)
    if len(count) < FEWEST_HALF_SWINGS or np.median(count) < FEWEST_READINGS or len(number) < FEWEST_OF_ALL:
        return None
    middle = np.bincount(number, weights=part.time[kept]) / count
    own = np.eye(len(count))
    lines = np.stack([np.interp(part.time[kept], middle, zero) for zero in own], axis=1)
    ahead = np.where(rate > 0.0, 1.0, -1.0)
    amplitude = np.interp(part.time, turned[:-1], 0.5 * np.abs(np.diff(curve[turns])))
    known = np.column_stack([design, ahead, ahead * amplitude, *moved.values()])[kept]
    jumping, zeros = _least_squares(known, own[number], left[kept])
    # What a zero for each direction could take up is shared between both at will: it is left out of the jumps.
    shared = np.stack([np.bincount(number, weights=x[kept]) / count for x in (ahead, ahead * amplitude)], axis=1)
    zeros = zeros - shared @ np.linalg.lstsq(shared, zeros)[0]
    moving_slowly, _ = _least_squares(known, lines, left[kept])
    ratio = jumping / moving_slowly if moving_slowly > 0.0 else 1.0
    size = float(np.sqrt(np.mean(np.diff(zeros) ** 2))) * e.column.to_display
    facts = {"jump": size, "unit": e.column.unit, "ratio": ratio, "half_swings": len(count)}
    return facts, "fail" if ratio < JUMPING else "ok"


def _least_squares(known: np.ndarray, columns: np.ndarray, values: np.ndarray) -> tuple[float, np.ndarray]:
    """Sum of squares that ``known`` (n, p) and ``columns`` (n, q) leave of ``values``, and the coefficients (q,)."""
    size = np.linalg.norm(known, axis=0)
    table = np.hstack([known[:, size > 0.0] / size[size > 0.0], columns])
    found = np.linalg.lstsq(table, values)[0]
    return float(np.sum((values - table @ found) ** 2)), found[-columns.shape[1] :]


# hidden terms: Forces that the fitted model lacks, that the records cannot exclude, and that would change the quoted
# values.
#
# A short record of a decay fits viscous damping as well as its sum with dry friction, and the two give different
# values of c. The fit is linear in a small further force, so one least-squares step gives the largest force that
# the records allow, and the values beside it.


#: Changes of c and of k1 by a force at its limit that matter, relative to the value, where they are ``VISIBLE`` too.
CHANGES: Mapping[str, float] = {"c": 0.2, "k1": 0.05}
#: Estimates further below zero, in standard errors, count as this one.
LOWEST = -30.0


@dataclass(frozen=True)
class Hidden:
    """A further force, and its effect on the parameters of the model without it.

    Attributes
    ----------
    estimate, sd : of its parameter, SI; the estimate of a force that damps may be negative
    slopes : change of each parameter by unit of it, SI
    errors : standard errors of the parameters without it, SI
    """

    estimate: float
    sd: float
    slopes: Mapping[str, float]
    errors: Mapping[str, float]

    def limits(self, signed: bool) -> tuple[float, float]:
        """Ends of the 95 % interval, SI; of one that is not ``signed``, 0 and the 97.5 % quantile."""
        if signed:
            return self.estimate - QUANTILE_975 * self.sd, self.estimate + QUANTILE_975 * self.sd
        # Far below zero the posterior above zero is exponential: its limit goes to 0.
        ratio = max(self.estimate / self.sd, LOWEST)
        beyond = float(stats.norm.sf(QUANTILE_975) * stats.norm.cdf(ratio))
        return 0.0, self.sd * (ratio + float(stats.norm.isf(beyond)))


def check_hidden_terms(records: Sequence[Decay], fit: Fitted) -> list[Finding]:
    """Check that viscous records exclude further forces that would change c or k1 by much, where the settings allow them."""
    groups: dict[Any, list[Decay]] = {}
    for e in records:
        # A record that demands a further damping seldom excludes another one as well.
        if not e.model.damping and (symbols := open_forces(e)):
            groups.setdefault((symbols, e.model.cubic, e.table.settings.offers_cubic), []).append(e)
    findings, compared = [], []
    for (offered, _, offers_cubic), members in groups.items():
        terms = hidden_terms(members, fit.values)
        offered = tuple(symbol for symbol in offered if symbol in terms)
        theta = members[0].local(fit.values)
        # A decay that does not swing seldom excludes these forces: the quoted interval holds what they change.
        swings = theta["c"] < 2.0 * STRONGEST * np.sqrt(theta["k1"] * theta["m1"])
        facts = {"labels": [e.label for e in members], "offers_cubic": offers_cubic, "swings": swings}
        compared += facts["labels"]
        for name in CHANGES:
            changed = _change(name, fit.values[name], {symbol: terms[symbol] for symbol in offered}, swings)
            if changed:
                level: Level = "warn" if changed["low"] > 0.0 and not swings else "fail"
                own = (name,) if level == "fail" else ()
                findings.append(Finding("decays.hidden", level, {**facts, **changed}, parameters=own))
    if compared and not findings:
        findings.append(Finding("decays.hidden", "ok", {"labels": listed(compared)}))
    return findings


def open_forces(e: Decay) -> tuple[str, ...]:
    """Symbols of the forces that the model of ``e`` lacks and whose words the settings leave open."""
    settings = e.table.settings
    return tuple(
        symbol for symbol in e.model.absent if (settings.stiffness if symbol == "k_cubic" else settings.damping) is None
    )


def _change(name: str, value: float, terms: Mapping[str, Hidden], swings: bool) -> Facts:
    """Forces that change the parameter ``name`` by too much, and its limits beside them, SI; empty without one.

    In a decay that does not swing a standard error is too much.
    """
    ends, symbols, largest = [value], [], []
    for symbol, term in terms.items():
        changes = [term.slopes[name] * end for end in term.limits(symbol == "k_cubic")]
        error = term.errors[name]
        if max(np.abs(changes)) > (max(CHANGES[name] * value, VISIBLE * error) if swings else error):
            ends += [value + change + side * QUANTILE_975 * error for change in changes for side in (-1.0, 1.0)]
            symbols.append(symbol)
            largest.append(max(np.abs(term.limits(symbol == "k_cubic"))))
    if not symbols:
        return {}
    return {
        "name": name,
        "unit": parameter(name).unit,
        "value": value,
        "low": max(0.0, min(ends)),
        "high": max(ends),
        "symbols": symbols,
        "largest": largest,
    }


def hidden_terms(records: Sequence[Decay], values: Mapping[str, float]) -> dict[str, Hidden]:
    """Every force that the common model of ``records`` lacks, by symbol; ``values`` of the fit, SI."""
    blocks = [reduced(e, e.local(values)) for e in records]
    known, further, left = (np.concatenate(part) for part in zip(*blocks, strict=True))
    model = records[0].model
    names = ("k1", "c", *model.symbols)
    inverse = inverse_of(known)
    errors = dict(zip(names, np.linalg.norm(inverse, axis=1), strict=True))
    found = {}
    for symbol, column in zip(model.absent, further.T, strict=True):
        change = inverse @ column
        own = column - known @ change
        if not column.any():
            continue
        power = max(float(own @ own), np.finfo(float).tiny)
        slopes = dict(zip(names, -change, strict=True))
        found[symbol] = Hidden(-float(own @ left) / power, power**-0.5, slopes, errors)
    return found


def inverse_of(known: np.ndarray) -> np.ndarray:
    """Pseudo-inverse (p, n) of derivatives (n, p) in units of the noise; the lengths of its rows are standard errors."""
    size = np.linalg.norm(known, axis=0)
    size = np.where(size > 0.0, size, 1.0)
    return np.linalg.pinv(known / size) / size[:, None]


def reduced(e: Decay, theta: Mapping[str, float], beside: bool = True) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Derivatives (n, p) and (n, q), and residuals (n,), in units of the noise, without the nuisances of ``e`` alone.

    Derivatives with respect to k1, c and ``model.symbols``, and, unless ``beside`` is false, to the forces that the model
    lacks.
    """
    left, design, moved = sensitivities(e, theta)
    further = further_sensitivities(e, theta) if beside else {}
    shared = np.column_stack([moved.pop(name) for name in ("k1", "c", *e.model.symbols)])
    own = e.whitened(theta, np.column_stack([design, *moved.values()]))
    absent = np.column_stack([left[:, None][:, :0], *(further[s] for s in e.model.absent if beside)])
    parts = [e.whitened(theta, part) for part in (shared, absent, left[:, None])]
    known, others, residuals = without(own, *parts)
    # The offset takes up dry friction in a decay that does not swing: only rounding is left of it.
    others[:, np.linalg.norm(others, axis=0) <= ROUNDING * np.linalg.norm(parts[1], axis=0)] = 0.0
    misfit = residuals - known @ np.linalg.lstsq(known, residuals, rcond=None)[0]
    noise = np.sqrt(np.sum(misfit**2) / max(e.n - own.shape[1] - known.shape[1], 1))
    return known / noise, others / noise, residuals[:, 0] / noise


# changes: A c or a k1 that changes linearly with time, as of a damper or a spring that warms up.
#
# A c that grows damps small motions more than large ones, as dry friction does; one that falls, as quadratic damping
# does. A k1 that changes shifts the frequency with the amplitude, as a cubic spring does. The comparison is by BIC at the
# maxima of both models.


#: Smallest omega^2 of a decay whose c changes, relative to k1/m1: its frequency stays real.
SMALLEST_SQUARE = 0.01
#: What may change with time, and the setting whose words exclude it.
CHANGING = {"c": "damping", "k1": "stiffness"}
#: Points of the Gauss rule for the phase: exact up to rounding for a c that grows by 40 %, up to a damping ratio of 0.5.
PHASE_POINTS = 12
#: Bounds of the logarithms of k1 and c from their fitted values, and of the growth relative to the value in the middle.
WIDEST_CHANGE = (0.1, 1.0, 1.9)


def changing_motions(
    time: np.ndarray, theta: Mapping[str, float], growth: Mapping[str, float], length: float, order: int
) -> np.ndarray:
    """(n, 2) decays, or their derivatives of this ``order``, whose c or k1 has this relative ``growth`` in ``length`` s.

    ``theta`` holds the values at half that time. With x = exp(-int gamma) y, y'' + (omega_0^2 - gamma^2 - gamma') y = 0 has
    no damping. Its frequency changes slowly, so y is its phase's cosine and sine over the root of the frequency (Liouville
    and Green).
    """
    middle, square = theta["c"] / (2.0 * theta["m1"]), theta["k1"] / theta["m1"]
    rate, stiffening = middle * growth.get("c", 0.0) / length, square * growth.get("k1", 0.0) / length
    points, weights = np.polynomial.legendre.leggauss(PHASE_POINTS)

    def gamma(t: np.ndarray) -> np.ndarray:
        return middle + rate * (t - 0.5 * length)

    def spring(t: np.ndarray) -> np.ndarray:
        return square + stiffening * (t - 0.5 * length)

    def omega(t: np.ndarray) -> np.ndarray:
        return np.sqrt(np.maximum(spring(t) - gamma(t) ** 2 - rate, SMALLEST_SQUARE * square))

    own, phase = omega(time), 0.5 * time * (omega(0.5 * time[:, None] * (1.0 + points)) @ weights)
    x = np.exp(-time * gamma(0.5 * time) + 1j * phase) / np.sqrt(own)
    velocity = x * (-gamma(time) + 1j * own + (0.5 * gamma(time) * rate - 0.25 * stiffening) / own**2)
    found = (x, velocity, -2.0 * gamma(time) * velocity - spring(time) * x)[order]
    return np.stack([found.real, found.imag], axis=1)


def left_by(e: DecayRecord, theta: Mapping[str, float], growth: Mapping[str, float] | None = None) -> np.ndarray:
    """Whitened residuals (n,) beside the linear nuisances; of a viscous decay whose c or k1 has this ``growth``, if any."""
    raw, design = e.unwhitened(theta, np)
    if growth is not None:
        nodes = np.ravel(e.nodes) * stretch(e.clock_rate, theta)
        motions = changing_motions(nodes, theta, growth, float(e.time[-1]), e.order)
        raw, design = e.values, np.column_stack([block_mean(motions, e.weights, np), design[:, 2 * e.closed :]])
    return without(e.whitened(theta, design), e.whitened(theta, raw))[0]


def check_changing(records: Sequence[DecayRecord], fit: Fitted) -> list[Finding]:
    """Check that c and k1 do not change with time where that explains the decays about as well as their model, or better.

    Stated words count as known, until the change is ``FACTOR`` times as probable.
    """
    groups, findings = dict[Any, list[DecayRecord]](), list[Finding]()
    for e in records:
        if fit.values["c"] < 2.0 * STRONGEST * np.sqrt(fit.values["k1"] * e.mass):
            stated = {symbol: getattr(e.table.settings, key) for symbol, key in CHANGING.items()}
            groups.setdefault((e.model.symbols, *stated.items()), []).append(e)
    for ((symbols, *stated), members), symbol in product(groups.items(), CHANGING):
        facts = changing(members, fit.values, symbol)
        decided = facts["factor"] > FACTOR
        # A viscous decay is the case without growth: chance alone often gives a little.
        shown = bool(symbols) or facts["p"] < LEVEL
        if facts["shift"] > DOUBTFUL and (decided or (shown and dict(stated)[symbol] is None)):
            words = members[0].model.lines(CHANGING[symbol])
            facts |= {"decided": decided, "limit": FACTOR, "symbols": symbols, "words": words}
            labels = [e.label for e in members]
            names = (symbol, *symbols)
            findings.append(Finding("decays.changing", "warn", {**facts, "labels": labels}, labels[0], names))
    return findings


def changing(members: Sequence[DecayRecord], values: Mapping[str, float], symbol: str) -> dict[str, Any]:
    """Compare the quoted model with a viscous decay whose c or k1, ``symbol``, changes with time, for records of one model."""
    thetas = [e.local(values) for e in members]
    rms = [float(np.sqrt(np.mean(left_by(e, theta) ** 2))) for e, theta in zip(members, thetas, strict=True)]
    # Rounding errors of records without noise decide nothing.
    least = FINEST * np.array([e.width for e in members])
    noise = np.maximum(rms, least)

    def left(z: np.ndarray) -> np.ndarray:
        moved = {"k1": values["k1"] * np.exp(z[0]), "c": values["c"] * np.exp(z[1])}
        parts = zip(members, thetas, noise, strict=True)
        return np.concatenate([left_by(e, {**theta, **moved}, {symbol: z[2]}) / sd for e, theta, sd in parts])

    widest = np.array(WIDEST_CHANGE)
    found = optimize.least_squares(left, np.zeros(3), bounds=(-widest, widest), x_scale="jac")
    ends = np.cumsum([e.n for e in members])
    parts = zip(np.split(found.fun, ends[:-1]), least / noise, strict=True)
    gain = -sum(len(part) * np.log(max(np.mean(part**2), share**2)) for part, share in parts)
    symbols, rig = members[0].model.symbols, members[0].rig
    weight = special.expit(0.5 * (gain + (len(symbols) - 1) * np.log(ends[-1])))
    known = np.concatenate([reduced(e, theta, beside=False)[0] for e, theta in zip(members, thetas, strict=True)])
    relative = 0.0 if rig.m1 is None else rig.m1.sd / rig.m1.value
    place = ("k1", "c").index(symbol)
    sd = np.hypot(np.linalg.norm(inverse_of(known)[place]), values[symbol] * relative)
    middle = float(values[symbol] * np.exp(found.x[place]))
    return {
        "symbol": symbol,
        "growth": float(found.x[2]),
        "error": float(np.linalg.norm(inverse_of(found.jac)[2])),
        "middle": middle,
        "value": values[symbol],
        "model": members[0].model.name,
        "factor": float(weight / max(1.0 - weight, np.finfo(float).tiny)),
        "p": float(stats.chi2.sf(gain, 1)),
        "shift": float(weight * abs(middle - values[symbol]) / sd),
    }


# held: A hold that may be left in front of the release.
#
# Held, then released, a strongly damped rod moves nearly as one that was released at the beginning of the hold and is
# softer, or meets further forces.


#: Part of a period after the first reading in which the hold may end, and instants of it that are tried.
LATEST_RELEASE, RELEASES = 0.25, 16
#: Largest change of the logarithms of frequency and damping ratio from those of the readings after the last instant.
WIDEST = 3.0


def check_held(records: Sequence[DecayRecord], fit: Fitted) -> list[Finding]:
    """Check that k1 and c stay the same if the rod was held a little longer than its record was found to begin.

    A record with a stated start is not judged.
    """
    tables = (table for e in records for table in e.rig.tables if getattr(table.settings, "start", None) is not None)
    stated = {(table.entry, table.file) for table in tables}
    judged = [e for e in records if (e.table.entry, e.table.file) not in stated]
    allowed = [_releases(e, e.local(fit.values)) for e in judged]
    matters = any(map(len, allowed))
    alone = [refit(e, e.local(fit.values), []) for e in judged] if matters else []
    findings = list[Finding]()
    for k, name in enumerate(("k1", "c") if matters else ()):
        value = fit.values[name]
        errors = np.array([own[name][1] for own in alone])
        if not np.all((errors > 0.0) & np.isfinite(errors)):
            continue  # a record that does not determine it, or whose errors are lost in rounding
        error = float(np.sum(errors**-2.0) ** -0.5)
        for e, others, weight in zip(judged, allowed, (error / errors) ** 2, strict=True):
            # The other records keep what they tell.
            changes = weight * (others[:, k, None] + QUANTILE_975 * others[:, 2 + k, None] * [[-1.0, 1.0]] - value)
            low, high = np.min(changes, initial=0.0), np.max(changes, initial=0.0)
            if max(high, -low) > (1.0 + QUANTILE_975) * error:
                facts = {
                    "name": name,
                    "unit": parameter(name).unit,
                    "value": value,
                    "label": e.label,
                    "low": max(value + low, 0.0),
                    "high": value + high,
                    "start": float(decay_window(e.table)[0][0]),
                }
                level: Level = "warn" if value + low > 0.0 else "fail"
                findings.append(Finding("decays.held", level, facts, e.label, (name,) if level == "fail" else ()))
    return findings or [Finding("decays.held", "ok", {"labels": listed(e.label for e in judged)})] * bool(judged)


def _releases(e: DecayRecord, theta: ValuesBySymbol) -> np.ndarray:
    """k1, c and their standard errors, (r, 4), SI, of viscous decays that the record allows with r later releases."""
    time, m1, period = e.time - e.time[0], e.mass, 2.0 * np.pi * float(np.sqrt(theta["m1"] / theta["k1"]))
    later = int(np.searchsorted(time, LATEST_RELEASE * period))
    if len(time) < later + 2 * UNKNOWNS:
        return np.zeros((0, 4))
    free = viscous_fit(time[later:], e.values[later:], rough=PEAKLESS)
    if free.ratio < PEAKLESS:  # a quarter of a period tells little of a light decay
        return np.zeros((0, 4))
    known, ones = (e.whitened(theta, part) for part in (np.column_stack(e.unwhitened(theta, np)), np.ones((e.n, 1))))
    sd = float(np.sqrt(np.sum(without(known[:, 1:], known[:, 0])[0] ** 2) / max(e.n - UNKNOWNS, 1)))
    if not 0.0 < sd < np.inf:
        return np.zeros((0, 4))

    def values(z: np.ndarray) -> dict[str, float]:
        omega, ratio = np.exp(z)
        return {"k1": m1 * omega**2, "c": 2.0 * ratio * omega * m1, "m1": m1}

    def left(z: np.ndarray, release: float) -> np.ndarray:
        """Residuals of a rod that is held until ``release``, (n,), in units of the noise."""
        own, held = values(z), time < release
        x, rate = viscous_state(np.where(held, 0.0, time - release), own, np.array([1.0, 0.0]), 0)
        motion = (x, rate, -(own["c"] * rate + own["k1"] * x) / m1)[e.order]
        moved = np.column_stack([np.where(held, float(e.order == 0), motion), e.values])
        moved, observed = np.asarray(e.whitened(theta, moved)).T
        return without(np.column_stack([moved, ones]), observed)[0] / sd

    z, tried = np.log([free.omega, free.ratio]), []
    bounds = z - WIDEST, z + WIDEST
    for release in np.linspace(LATEST_RELEASE * period, 0.0, RELEASES + 1):
        found = optimize.least_squares(left, z, args=(release,), bounds=bounds, x_scale=0.1, max_nfev=30)
        z, k1, c = found.x, *(values(found.x)[name] for name in ("k1", "c"))
        inverse = np.linalg.pinv(found.jac.T @ found.jac)
        errors = [2.0 * k1 * np.sqrt(inverse[0, 0]), c * np.sqrt(np.sum(inverse))]
        tried.append((2.0 * float(found.cost), k1, c, *errors))
    table = np.array(tried)
    # A second fit has more forces, which take up a hold.
    excess = EVIDENCE if e.replaced else QUANTILE_975**2
    return table[table[:, 0] - min(max(e.n - UNKNOWNS, 1), np.min(table[:, 0])) < excess, 1:]
