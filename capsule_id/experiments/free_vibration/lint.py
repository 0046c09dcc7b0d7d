"""Findings on the readings of a free decay: release, aliasing, sampling, length, position, and those of any record."""

from collections.abc import Iterable
from typing import Any

import numpy as np

from capsule_id.errors import InputError
from capsule_id.experiments.free_vibration.kinematics import lint_kinematics
from capsule_id.experiments.free_vibration.readings.blocks import block_size, default_block_size
from capsule_id.experiments.free_vibration.settings import (
    DAMPING,
    EFFECTS,
    DecaySettings,
    decay_window,
    release_time,
    window_of,
)
from capsule_id.experiments.lint_records import lint_channel, lint_smooth, lint_times
from capsule_id.parameters import TABLE, parameter
from capsule_id.records.faults.aliasing import aliases
from capsule_id.records.faults.magnitudes import USUAL, unit_meant
from capsule_id.records.faults.release import FreeDecay, find_free_decay
from capsule_id.rig.entry import Entry
from capsule_id.rig.filters import dominant_frequency, loudest_part, median_step, sampling_step
from capsule_id.rig.model import Rig, Table
from capsule_id.rig.schema import SHORTEST_RECORD
from capsule_id.views import Facts, Finding, Message, counted

#: Smallest number of samples per period; the highest sample is then at most 1 - cos(pi/20) = 1.2 % below the peak.
SAMPLES_PER_PERIOD = 20
#: From so many samples per period on, an alias is less probable than a k1 outside its default prior: 1 in 50 aliased
#: records has as many.
SAMPLES_WITHOUT_ALIAS = 100
#: Factor of the prior that a finding proposes for k1: it holds no alias of 20 samples per period or more.
PROPOSED_FACTOR = 10
#: Smallest number of periods; with fewer, one peak determines the damping.
FEWEST_PERIODS = 2
#: Fewest block means in a period.
FEWEST_MEANS = 4
#: Number of readings whose fit takes minutes, and block means in a period that are proposed for it.
MANY_READINGS, COARSE_MEANS = 6000, 8
#: Largest ratio of the frequencies of two decays of one rig; a stiffness that changes with amplitude gives less.
LARGEST_RATIO = 1.3
#: Ratios of units that are mistaken for each other.
RATIOS = (("1000 (s and ms)", 1000.0), ("60 (min and s)", 60.0), ("2 pi (rad and cycles)", 2.0 * np.pi))


def lint_decay(table: Table[Any], rig: Rig) -> Iterable[Finding]:
    """Report faults of the record, rest before the release, low sampling rate and short length."""
    used = window_of(table)
    yield from lint_times(table, used)
    if table.settings.samples == "turning_points":
        return
    channels = [name for name in table.columns if name != "time"]
    time = table["time"]
    decay = find_free_decay(time[used], table[channels[0]][used], displacement=channels[0] == "x_rel")
    period = np.inf if decay is None else decay.period
    faults = [found for name in channels for found in lint_channel(table, name, used, period)]
    if decay is not None:
        yield from _release(table, decay, bool(faults))
        inside = time[used]
        ends = decay.stop is not None and decay.stop > decay.start
        last = int(np.searchsorted(inside, decay.stop, side="right")) if ends else len(inside)
        used = slice(used.start + int(np.searchsorted(inside, decay.start)), used.start + last)
        # Dry friction makes an acceleration jump wherever the rod turns; lost samples make one jump that stands alone.
        faults = faults or [
            found for name in channels for found in lint_smooth(table, name, used, period, name == "acceleration")
        ]
        faults = faults or [*lint_kinematics(table, used, period)]
    yield from faults
    window = time[used], table[channels[0]][used]
    yield from _thinned(table, *window)
    yield from _sampling(table, *window)
    if not faults:
        yield from _frequency(table, rig, *window)


def _dominant(time: np.ndarray, values: np.ndarray) -> float:
    """Dominant frequency of a record that may be sampled unevenly, Hz."""
    part = loudest_part(values)
    even = np.linspace(time[part][0], time[part][-1], len(time[part]))
    return dominant_frequency(even, np.interp(even, time[part], values[part]))


def _other_frequency(table: Table[Any], rig: Rig, frequency: float) -> Iterable[Finding]:
    """Report a frequency that differs from that of the first decay of the rig, whose k1 and m1 are the same."""
    first = next((other for other in rig.tables if other.kind == table.kind), table)
    channel = next(name for name in first.columns if name != "time")
    if first.label == table.label or channel not in table.columns:
        return
    used = window_of(first)
    ratio = frequency / _dominant(first["time"][used], first[channel][used])
    if not 1.0 / LARGEST_RATIO < ratio < LARGEST_RATIO:
        near = next(
            (f" The ratio is near {words}." for words, r in RATIOS if abs(abs(np.log(ratio)) - np.log(r)) < 0.1), ""
        )
        facts = {"file": table.file, "first": first.file, "ratio": ratio, "near": near}
        yield Finding("decays.frequency", "fail", facts, table.label)


def _frequency(table: Table[Any], rig: Rig, time: np.ndarray, values: np.ndarray) -> Iterable[Finding]:
    """Report an unusual frequency, and frequencies that the sampling cannot tell from that of the record."""
    frequency = _dominant(time, values)
    low, high = USUAL["Hz"]
    if not low <= frequency <= high:
        facts = {"name": f"the frequency of {table.file}", "value": frequency, "unit": "Hz", "low": low, "high": high}
        meant = unit_meant(1.0 / frequency, table.columns["time"].to_display, "s", (1.0 / high, 1.0 / low))
        remedy = f" If the times are in {meant}, write that unit." if meant else ""
        yield Finding("decays.magnitude", "warn", {**facts, "remedy": remedy}, table.label)
    yield from _other_frequency(table, rig, frequency)
    if rig.m1 is None:
        return
    stated, default = rig.priors.get("k1"), TABLE["k1"].prior
    assert default is not None, "k1 has a default prior"
    median, factor = default.location, default.spread
    if stated is not None and stated.median is not None and stated.factor is not None:
        median, factor = stated.median, stated.factor
    k1 = rig.m1.value * (2.0 * np.pi * frequency) ** 2
    # Of aliased records one in ten seems to have more samples per period: 18 Hz sampled at 17 Hz shows sixteen.
    per_period = 1.0 / (median_step(time) * frequency)
    coarse = per_period < SAMPLES_PER_PERIOD
    inside = median / factor <= k1 <= median * factor
    # A sampling that cannot show the usual frequency shows another one instead.
    blind = 0.5 / median_step(time) < np.sqrt(default.location / rig.m1.value) / (2.0 * np.pi)
    if not coarse and (inside or (stated is None and per_period >= SAMPLES_WITHOUT_ALIAS and not blind)):
        return
    part = loudest_part(values)
    others = aliases(time[part], values[part], frequency)
    stiffnesses = rig.m1.value * (2.0 * np.pi * others) ** 2
    possible = (stiffnesses >= median / factor) & (stiffnesses <= median * factor)
    if possible.any():
        facts = {
            "file": table.file,
            "frequency": frequency,
            "others": ", ".join(dict.fromkeys(f"{f:.4g}" for f in others[possible][:3])),
            "k1": k1,
            "k1s": ", ".join(dict.fromkeys(f"{k:.4g}" for k in stiffnesses[possible][:3])),
            "range": (median / factor, median * factor),
            "factor": PROPOSED_FACTOR,
        }
        # The default prior is no measurement: small rigs and pendulums have a k1 outside it.
        certain = coarse or stated is not None
        yield Finding("decays.alias", "fail" if certain else "warn", facts, table.label, () if certain else ("k1",))


def _release(table: Table[Any], decay: FreeDecay, faulty: bool) -> Iterable[Finding]:
    """Report rest before the release, and a second excitation; a ``faulty`` record may feign the latter."""
    start, stop = release_time(decay), decay.stop
    if decay.rest > 0.0:
        before = "slow approach to the first turning point" if decay.pushed else "rest or excitation"
        longer = "" if decay.pushed else ". To keep a longer part, state an earlier start."
        facts = {"file": table.file, "rest": decay.rest, "start": start, "found": decay.start, "before": before}
        facts |= {"longer": longer}
        yield Finding("decays.release", "warn" if table.settings.start is None else "fail", facts, table.label)
    if stop is not None and not faulty:
        digits = max(0, int(np.ceil(-np.log10(0.01 * decay.period))))
        facts = {"file": table.file, "stop": round(stop, digits), "found": stop}
        yield Finding("decays.second", "fail", facts, table.label)


def check_thin(entry: Entry[DecaySettings]) -> None:
    """Require block means that leave a record, and that follow its oscillation.

    Raises
    ------
    InputError
        At ``thin``.
    """
    thin = entry.table.settings.thin
    if thin is None or thin == 1:
        return
    time, values = decay_window(entry.table)
    most = min(len(time) // SHORTEST_RECORD, max(block_size(time, values, FEWEST_MEANS), 2))
    if thin > most:
        rule = f"thin must leave {SHORTEST_RECORD} means of the record and {FEWEST_MEANS} means in a period"
        remedy = f"write thin = {most} or less" if most > 1 else "remove thin"
        raise entry.error("thin", rule, f"{thin} of {counted(len(time), 'sample')}", remedy)


def _thinned(table: Table[Any], time: np.ndarray, values: np.ndarray) -> Iterable[Finding]:
    """Report that a long record is fitted by block means, where the settings leave that open."""
    thin = default_block_size(time, values)
    if table.settings.thin is None and table.settings.forward == "closed" and thin > 1:
        facts = {"file": table.file, "samples": len(time), "thin": thin, "means": len(time) // thin}
        yield Finding("decays.thinned", "ok", facts, table.label)
    readings = len(time) // (table.settings.thin or thin)
    if readings > MANY_READINGS:
        size = block_size(time, values, COARSE_MEANS)
        late = " A stop ends the record earlier, which saves more." if len(time) // size > MANY_READINGS else ""
        facts = {"file": table.file, "readings": readings, "thin": size, "means": COARSE_MEANS, "late": late}
        yield Finding("decays.long", "warn", facts, table.label)


def _sampling(table: Table[Any], time: np.ndarray, values: np.ndarray) -> Iterable[Finding]:
    """Report uneven sampling, and too few samples per period or periods."""
    try:
        period = 1.0 / dominant_frequency(time, values)
        step = sampling_step(time)
    except InputError as error:
        yield Finding("decays.uneven", "warn", {"rule": error.rule, "value": error.value}, table.label)
        return
    if period / step < SAMPLES_PER_PERIOD:
        facts = {"samples": period / step, "wanted": SAMPLES_PER_PERIOD}
        yield Finding("decays.sampling", "warn", facts, table.label)
    if (time[-1] - time[0]) / period < FEWEST_PERIODS:
        facts = {"periods": (time[-1] - time[0]) / period, "wanted": FEWEST_PERIODS}
        yield Finding("decays.length", "warn", facts, table.label)


def line_of(key: str) -> str:
    """A line of rig.toml that states ``key`` of the facts."""
    return f'{key} = {{{{ value = {{{key}:.10g}}, unit = "s" }}}}'


_ALIAS = (
    "{file}: the sampling cannot tell {frequency:.4g} Hz (k1 = {k1:.4g} N/m) from {others} Hz (k1 = {k1s} N/m). Sample "
    "faster. If {frequency:.4g} Hz is right, state a prior that holds it alone, such as "
    'k1 = {{ median = {k1:.4g}, factor = 1.2, unit = "N/m" }} in [prior].'
)
_DEFAULT_PRIOR = (
    "{file}: k1 = {k1:.4g} N/m lies outside the range of its default prior, {range[0]:.3g} to {range[1]:.3g} N/m. An "
    "oscillation of {others} Hz (k1 = {k1s} N/m) has the same samples. If k1 is near {k1:.2g} N/m, state that: "
    'k1 = {{ median = {k1:.2g}, factor = {factor}, unit = "N/m" }} in [prior]. Else sample faster.'
)


def _hidden(facts: Facts) -> str:
    """The forces that the records allow, the limits of the parameter beside them, and remedies."""
    name, unit, words = facts["name"], facts["unit"], [word for word, own in DAMPING.items() if own in facts["symbols"]]
    effects = " or ".join(EFFECTS[symbol] for symbol in facts["symbols"])
    allowed = ", ".join(
        f"{symbol} up to {size:.2g} {parameter(symbol).unit}"
        for symbol, size in zip(facts["symbols"], facts["largest"], strict=True)
    )
    found = (
        f"With {allowed} they fit as well, and {name} lies between {facts['low']:.3g} and {facts['high']:.3g} {unit}"
    )
    all_words = ", ".join(f'"{word}"' for word in ("viscous", *words))
    lines = [(f"damping = [{all_words}]", 'damping = ["viscous"]')] if words else []
    lines += [('stiffness = "cubic"', 'stiffness = "linear"')] if "k_cubic" in facts["symbols"] else []
    free, known = ([line[i] for line in lines] for i in (0, 1))
    remedies = ["Record more periods with less noise"]
    if "k_cubic" in facts["symbols"] and not facts["offers_cubic"]:
        free.remove('stiffness = "cubic"')
        remedies.append("release from smaller deflections")
    if free:
        remedies.append(f"write {' and '.join(free)} in the experiment for an interval that includes this")
    return (
        f"{', '.join(facts['labels'])}: expected records that exclude {effects}; they do not. {found} (the fit without: "
        f"{facts['value']:.3g}). {', or '.join(remedies)}. If another measurement excludes {effects}, write "
        f"{' and '.join(known)}."
    )


MESSAGES = {
    "decays.release": Message(
        "release of a decay",
        warn=(
            "a free decay must begin with its release; found {rest:.4g} s of {before} before it. The fit leaves "
            "that out. To confirm that, add this line to the experiment in rig.toml: " + line_of("start") + "{longer}"
        ),
        fail=(
            "a free decay must begin with its release; found {rest:.4g} s of {before} after the stated start. "
            "Write this line in the experiment in rig.toml: " + line_of("start")
        ),
    ),
    "decays.hidden": Message(
        "further forces of a decay",
        ok="{labels}: no further force that the records allow changes c or k1 by much",
        fail=_hidden,
    ),
    "decays.thinned": Message(
        "length of a decay",
        ok=(
            "{file}: the fit uses {means} means of {thin} consecutive samples each instead of {samples} samples. That widens "
            "intervals by less than 0.5 % and saves time. To fit every sample, add thin = 1 to the experiment in rig.toml."
        ),
    ),
    "decays.long": Message(
        "length of a decay",
        warn=(
            "{file}: the fit uses {readings} readings, and takes minutes. {means} means in a period widen the intervals by "
            "some 3 %: add thin = {thin} to the experiment in rig.toml.{late}"
        ),
    ),
    "decays.second": Message(
        "end of a decay",
        fail=(
            "the energy of a free decay must not grow; it grows after {found:.5g} s. Add this line to the experiment in "
            "rig.toml: " + line_of("stop")
        ),
    ),
    "decays.magnitude": Message(
        "magnitudes",
        warn="{name} is {value:.4g} {unit}; {low:g} to {high:g} {unit} is usual. Check the unit of the times.{remedy}",
    ),
    "decays.frequency": Message(
        "magnitudes",
        fail=(
            "{file}: all decays have the same k1 and m1, so nearly the same frequency; it is {ratio:.4g} times that of {first}."
            "{near} Check the unit of the times, the sampling rate, and that both records show the same rig."
        ),
    ),
    "decays.alias": Message("aliasing", fail=_ALIAS, warn=_DEFAULT_PRIOR),
    "decays.uneven": Message(
        "sampling of a decay",
        warn=(
            "{rule}; found {value}. The paper's estimate is left out; the fit uses the times as recorded. Resample the "
            "record evenly to have both."
        ),
    ),
    "decays.sampling": Message(
        "sampling of a decay", warn="{samples:.1f} samples per period; {wanted} or more are wanted. Sample faster."
    ),
    "decays.length": Message(
        "length of a decay", warn="{periods:.1f} periods; {wanted} or more are wanted. Record for longer."
    ),
}
