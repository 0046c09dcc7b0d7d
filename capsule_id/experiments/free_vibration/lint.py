"""Findings on the readings of a free decay, and their words."""

from collections.abc import Iterable, Sequence
from functools import partial
from typing import Any

import numpy as np

from capsule_id.experiments.free_vibration.decrement import decay_frequency
from capsule_id.experiments.free_vibration.readings import (
    CHANNELS,
    DAMPING,
    EFFECTS,
    MOST_PERIODS,
    DecayModel,
    block_size,
    cut_at_release,
    default_block_size,
    first_periods,
    on_both_sides,
    release_time,
    window_of,
    without_hum,
)
from capsule_id.experiments.lint import (
    ACCELERATIONS,
    PREFIX,
    USUAL_PERIODS,
    Number,
    lint_channel,
    lint_rig_quantities,
    lint_smooth,
    lint_times,
    wrong_prefix,
)
from capsule_id.parameters import parameter
from capsule_id.records.faults import (
    FEWEST_PERIODS,
    OF_DERIVATIVE,
    SIGN_ERRORS,
    aliases,
    derivative_ratio,
    phasor,
    sampling,
)
from capsule_id.records.release import MARGIN, FreeDecay, find_free_decay, find_releases
from capsule_id.records.tones import length_of_motion, other_tone
from capsule_id.rig.filters import loudest_part, median_step, uneven_sampling
from capsule_id.rig.model import Rig, Table
from capsule_id.rig.schema import SHORTEST_RECORD
from capsule_id.rig.units import factor_to_si
from capsule_id.views import Facts, Finding, Level, Message, filled_in, listed

# lint: Findings on the readings of a free decay: release, aliasing, sampling, length, position, and those of any
# record.


#: Smallest number of samples per period; the highest sample is then at most 1 - cos(pi/20) = 1.2 % below the peak.
SAMPLES_PER_PERIOD = 20
#: From so many samples per period on, an alias is less probable than an unusual k1: 1 in 50 aliased
#: records has as many. With so many samples of motion too it is excluded: an alias has a period or more per sample, and
#: one that lasts for 1000 periods has a damping ratio below 5e-4.
SAMPLES_WITHOUT_ALIAS, SAMPLES_OF_MOTION = 100, 1000
#: Usual k1: its middle, N/m, and factor. It is no prior: another default of the fit must not move a check.
USUAL_K1 = (1500.0, 1000.0)
#: Factor of the prior that a finding proposes for k1: it holds no alias of 20 samples per period or more.
PROPOSED_FACTOR = 10
#: Smallest number of periods; with fewer, one peak determines the damping.
WANTED_PERIODS = 2
#: Largest ratio of the frequencies of two decays of one rig; a stiffness that changes with amplitude gives less.
LARGEST_RATIO = 1.3
#: Ratios of units that are mistaken for each other.
RATIOS = (
    ("1000 (s and ms)", PREFIX),
    ("60 (min and s)", factor_to_si("min", "s")),
    ("2 pi (rad and cycles)", 2.0 * np.pi),
)


def lint_decay(table: Table[Any], rig: Rig) -> Iterable[Finding]:
    """Report faults of the record, rest before the release, low sampling rate and short length."""
    used = window_of(table)
    yield from lint_times(table, used)
    if table.settings.samples == "turning_points":
        step, values = median_step(table["time"][used]), table["x_rel"][used]
        period = 2.0 * step if on_both_sides(values) else step
        yield from _scales(table, rig, 1.0 / period, values)
        scales = (f"{table.label}.samples",)
        facts = {"file": table.file, "period": period, "frequency": 1.0 / period, "scales": scales}
        unsaid = period == step and scales[0] not in rig.confirmed
        yield from _held(table, [(unsaid, "decays.one_side", "warn", facts, ("k1",))])
        return
    channels = [name for name in table.columns if name != "time"]
    time = table["time"]
    values = without_hum(time[used], table[channels[0]][used], table.settings.hum)
    decay = find_free_decay(time[used], values, displacement=channels[0] == "x_rel")
    period = np.inf if decay is None else decay.period
    if decay is not None:  # a hold is neither clipped nor frozen
        used = slice(used.start + int(np.searchsorted(time[used], decay.start)), used.stop)
    faults = [found for name in channels for found in lint_channel(table, name, used, period)]
    release = list[Finding]()
    if decay is not None:
        release = [*_release(table, decay, bool(faults))]
        if decay.end is not None:
            kept = max(int(np.searchsorted(time[used], decay.end, side="right")), SHORTEST_RECORD)
            used = slice(used.start, min(used.start + kept, used.stop))
        # The spectrum of a strongly damped decay has no peak at its frequency, and it is smooth over less of a period.
        period = min(period, 1.0 / decay_frequency(time[used], table[channels[0]][used], fastest=True))
        # Dry friction makes an acceleration jump wherever the rod turns; lost samples make one jump that stands alone.
        faults = faults or [
            found for name in channels for found in lint_smooth(table, name, used, period, name == "acceleration")
        ]
        faults = faults or [*_kinematics(table, used, period)]
    yield from _named(table, release, faults)
    window = time[used], table[channels[0]][used]
    yield from _sampling(table, *window)
    if not faults:
        yield from _frequency(table, rig, *window)


def _kinematics(table: Table[Any], used: slice, period: float) -> Iterable[Finding]:
    """Report channels that contradict each other at the frequency 1/``period`` of the decay, Hz."""
    first, *others = [name for name in CHANNELS if name in table.columns]
    time, Omega = table["time"][used], 2.0 * np.pi / period
    if table.settings.capsule != "held" or time[-1] - time[0] < FEWEST_PERIODS * period:
        return
    lower = phasor(time, table[first][used], Omega)
    for name in others:
        higher = phasor(time, table[name][used], Omega)
        order = CHANNELS[name].order - CHANNELS[first].order
        ratio = derivative_ratio(lower, higher, Omega, order).real
        seen = all(abs(one.value) > SIGN_ERRORS * one.sd for one in (lower, higher))
        if seen and not OF_DERIVATIVE[0] <= ratio <= OF_DERIVATIVE[1]:
            facts = {"file": table.file, "name": name, "first": first, "order": order, "ratio": ratio}
            yield Finding("decays.kinematics", "fail", facts, table.label)


def _named(table: Table[Any], release: Sequence[Finding], faults: Sequence[Finding]) -> Iterable[Finding]:
    """The faults of a record; where another oscillation or wrong samples feign a release or a jump, those alone."""
    blamed = [found for found in (*release, *faults) if found.code not in ("readings.clipped", "readings.frozen")]
    channel, used = next(name for name in table.columns if name != "time"), window_of(table)
    quiet = without_hum(table["time"][used], table[channel][used], table.settings.hum)
    tone = other_tone(table["time"][used], quiet) if blamed else None
    if tone is not None:
        open_words = None in table.settings.choices and table.settings.hum is None
        facts = {"file": table.file, "column": channel, "tone": tone}
        yield Finding("decays.tone", "warn" if open_words else "fail", facts, table.label)
        return
    feigned = any(found.code in ("readings.spike", "readings.dropouts", "readings.clipped") for found in faults)
    yield from (*(() if feigned else release), *faults)


def _other_frequency(table: Table[Any], rig: Rig, frequency: float) -> Iterable[Finding]:
    """Report a frequency that differs from that of the first decay of the rig, whose k1 and m1 are the same."""
    records = (other for other in rig.tables if other.kind == table.kind and other.settings.samples == "record")
    first = next(records, table)
    channel = next(name for name in first.columns if name != "time")
    if first.label == table.label or channel not in table.columns:
        return
    used = window_of(cut_at_release(first))
    ratio = frequency / decay_frequency(first["time"][used], first[channel][used])
    if not 1.0 / LARGEST_RATIO < ratio < LARGEST_RATIO:
        near = next(
            (f" The ratio is near {words}." for words, r in RATIOS if abs(abs(np.log(ratio)) - np.log(r)) < 0.1), ""
        )
        facts = {"file": table.file, "first": first.file, "ratio": ratio, "near": near}
        yield Finding("decays.frequency", "fail", facts, table.label)


def _scales(table: Table[Any], rig: Rig, frequency: float, values: np.ndarray) -> Iterable[Finding]:
    """Report an unusual period, and an unusual acceleration of the rod at its start."""
    column, label, period = table.columns["time"], table.label, f"the period of {table.file}"
    channel = next(name for name in table.columns if name != "time")
    scales, written = (
        (f"{label}.time", f"{label}.{channel}"),
        (label, column.unit, column.to_display, "decays.magnitude"),
    )
    yield from Number(period, 1.0 / frequency, "s", USUAL_PERIODS, scales[:1], *written).unusual(rig)
    size = 0.5 * float(np.ptp(values)) * (2.0 * np.pi * frequency) ** (2 - CHANNELS[channel].order)
    yield from Number(f"the acceleration in {table.file}", size, "m/s^2", ACCELERATIONS, scales, label).unusual(rig)


def _frequency(table: Table[Any], rig: Rig, time: np.ndarray, values: np.ndarray) -> Iterable[Finding]:
    """Report an unusual frequency, and frequencies that the sampling cannot tell from that of the record."""
    frequency = decay_frequency(time, values)
    unusual = [*_scales(table, rig, frequency, values)]
    yield from unusual
    yield from _other_frequency(table, rig, frequency)
    if rig.m1 is None:
        return
    stated = rig.priors.get("k1")
    middle, factor = USUAL_K1 if stated is None else (stated.location, stated.spread)
    low, high = middle / factor, middle * factor
    k1 = rig.m1.value * (2.0 * np.pi * frequency) ** 2
    # Of aliased records one in ten seems to have more samples per period: 18 Hz sampled at 17 Hz shows sixteen.
    per_period = 1.0 / (median_step(time) * frequency)
    coarse = per_period < SAMPLES_PER_PERIOD
    # A sampling that cannot show the usual frequency shows another one instead.
    blind = np.pi / median_step(time) < np.sqrt(middle / rig.m1.value)
    known = low <= k1 <= high or (stated is None and per_period >= SAMPLES_WITHOUT_ALIAS and not blind)
    part, highest = loudest_part(values), float(np.sqrt(high / rig.m1.value)) / (2.0 * np.pi)
    others = aliases(time[part], values[part], frequency, highest)
    if not len(others):
        return
    # Uneven times may fit another frequency better: then this one does not fit as well as that.
    back = aliases(time[part], values[part], float(others[0]), highest)
    refuted = not np.any(np.abs(back - frequency) < 1.0 / np.ptp(time[part]))
    stiffnesses = rig.m1.value * (2.0 * np.pi * others) ** 2
    possible = (stiffnesses >= low) & (stiffnesses <= high)
    if refuted or (coarse and (stated is None or possible.any())) or (possible.any() and not known):
        shown = possible if possible.any() else np.ones(len(others), dtype=bool)
        facts = {
            "file": table.file,
            "frequency": frequency,
            "others": ", ".join(dict.fromkeys(f"{f:.4g}" for f in others[shown][:3])),
            "k1": k1,
            "k1s": ", ".join(dict.fromkeys(f"{k:.4g}" for k in stiffnesses[shown][:3])),
            "range": (low, high),
            "factor": PROPOSED_FACTOR,
            # As wide as the other frequencies allow: the record itself may know k1 less well.
            "alone": min(PROPOSED_FACTOR, float(np.exp(0.5 * np.min(np.abs(np.log(stiffnesses / k1)))))),
            "refuted": refuted,
            # A prior would hide a wrong unit.
            "unit": bool(unusual)
            or any(f.facts["scales"] == ("m1",) for f in lint_rig_quantities(rig))
            or (stated is not None and wrong_prefix(k1 / middle)),
        }
        # What is usual is no measurement: small rigs and pendulums have another k1.
        certain = coarse or refuted or stated is not None
        yield Finding("decays.alias", "fail" if certain else "warn", facts, table.label, () if certain else ("k1",))
    elif possible.any() and (per_period < SAMPLES_WITHOUT_ALIAS or length_of_motion(values) < SAMPLES_OF_MOTION):
        other = (
            ": even samples have aliases, and the prior of k1 includes one. Or, where another measurement gives about this k1, "
            f'write k1 = {{ median = {k1:.2g}, factor = {PROPOSED_FACTOR}, unit = "N/m" }} in [prior]'
        )
        facts = {"samples": per_period, "wanted": 1.0 + np.sqrt(high / k1), "other": other}
        yield Finding("decays.sampling", "warn", facts, table.label, ("k1",))


#: A finding that may hold: whether it does, its code, level and facts, and its parameters.
Row = tuple[Any, str, Level, Facts, tuple[str, ...]]


def _held(table: Table[Any], rows: Iterable[Row]) -> Iterable[Finding]:
    """The findings of the ``rows`` that hold."""
    yield from (Finding(code, level, facts, table.label, own) for holds, code, level, facts, own in rows if holds)


#: What a release means where the capsule may move.
EXACT_RELEASE = (
    ". Put the instant at which the rod was let go in the place of this number: the capsule may slip from there on, and the "
    "model begins with both at rest, so k1 and c are not judged without that line"
)


def _release(table: Table[Any], decay: FreeDecay, faulty: bool) -> Iterable[Finding]:
    """Report rest before the release, and a second excitation; a ``faulty`` record may feign the latter."""
    start, stop = release_time(decay), decay.stop
    earlier, settings = stop is not None and decay.end is None, table.settings
    alone = (settings.start, settings.stop, settings.releases) == (None, None, None)
    channel = next(name for name in table.columns if name != "time")
    values = without_hum(table["time"], table[channel], settings.hum)
    several = find_releases(table["time"], values, channel == "x_rel") if alone and (stop or decay.rest) else []
    add = f' Or fit all of its {len(several)} releases: add releases = "all" instead.' if several else ""
    rest: Facts = {
        "file": table.file,
        "rest": decay.rest,
        "start": start,
        "before": "slow approach to the first turning point" if decay.pushed else "rest or excitation",
        "longer": ("" if decay.pushed else ". To keep a longer part, state an earlier start.") + add,
    }
    digits = max(0, int(np.ceil(-np.log10(0.01 * decay.period))))
    other = " For the part after that, add instead: " + line_of("start").format(start=start) if earlier else ""
    other += add
    ended = round(stop or 0.0, digits)
    second: Facts = {"file": table.file, "stop": ended, "found": ended, "other": other}
    stated, doubtful = table.settings.start is not None, ()
    if settings.forward == "capsule" and not stated:
        # The capsule moves soon after the release, and the model begins with a capsule at rest.
        rest |= {
            "start": round(decay.start - MARGIN * decay.period * (not decay.pushed), digits),
            "longer": EXACT_RELEASE,
        }
        doubtful = ("k1", "c")
    rows: tuple[Row, ...] = (
        (decay.rest > 0.0 and not earlier, "decays.release", "fail" if stated else "warn", rest, doubtful),
        (stop is not None and not faulty, "decays.second", "fail", second, ()),
    )
    yield from _held(table, rows)


def _sampling(table: Table[Any], time: np.ndarray, values: np.ndarray) -> Iterable[Finding]:
    """Report block means in place of the samples, uneven sampling, and too few samples per period or periods."""
    settings, thin, cut = table.settings, default_block_size(time, values), first_periods(table).settings.stop
    frequency, (rate, even) = decay_frequency(time, values), sampling(time)
    periods, per_period = (time[-1] - time[0]) * frequency, rate / frequency
    fault = uneven_sampling(time)
    uneven = {} if fault is None else {"rule": fault.rule, "value": fault.value}
    means: Facts = {
        "file": table.file,
        "samples": len(time),
        "thin": thin,
        "means": len(time) // thin,
        "wider": "less than 0.5 %" if thin <= block_size(time, values) else "some 3 %",
    }
    by_means = settings.thin is None and settings.forward == "closed" and thin > 1
    longer = DecayModel.stated(settings).slow and cut != settings.stop
    few: Facts = {"samples": per_period, "wanted": SAMPLES_PER_PERIOD, "other": ""}
    short: Facts = {"periods": periods, "wanted": WANTED_PERIODS}
    counted = even or not uneven
    rows: tuple[Row, ...] = (
        (by_means, "decays.thinned", "ok", means, ()),
        (longer, "decays.long", "warn", {"file": table.file, "stop": cut, "periods": MOST_PERIODS}, ()),
        (bool(uneven), "decays.uneven", "warn", uneven, ()),
        (counted and per_period < SAMPLES_PER_PERIOD, "decays.sampling", "warn", few, ("k1",) if even else ()),
        (counted and periods < WANTED_PERIODS, "decays.length", "warn", short, ()),
    )
    yield from _held(table, rows)


def line_of(key: str) -> str:
    """A line of rig.toml that states ``key`` of the facts."""
    return f'{key} = {{{{ value = {{{key}:.15g}}, unit = "s" }}}}'


_UNIT = " Check first the unit of the times and of m1. If they are right, sample faster."
_REFUTED = (
    "{file}: the uneven times contradict {frequency:.4g} Hz (k1 = {k1:.4g} N/m); they fit {others} Hz (k1 = {k1s} N/m) "
    "better."
)
_ALIAS = (
    "{file}: the sampling cannot tell {frequency:.4g} Hz (k1 = {k1:.4g} N/m) from {others} Hz (k1 = {k1s} N/m).",
    " Sample faster. If {frequency:.4g} Hz is right, state a prior that holds it alone, such as "
    'k1 = {{ median = {k1:.2g}, factor = {alone:.2g}, unit = "N/m" }} in [prior].',
)
_OUTSIDE = (
    "{file}: k1 = {k1:.4g} N/m lies outside its usual range, {range[0]:.3g} to {range[1]:.3g} N/m. An "
    "oscillation of {others} Hz (k1 = {k1s} N/m) has the same samples.",
    " If k1 is near {k1:.2g} N/m, state that: "
    'k1 = {{ median = {k1:.2g}, factor = {factor}, unit = "N/m" }} in [prior]. Else sample faster.',
)


def _contradiction(facts: Facts) -> str:
    """The ratio of the two columns, and what to check."""
    check, second = "Check the units of both columns.", "second " * (facts["order"] == 2)
    low, high = OF_DERIVATIVE
    if -high <= facts["ratio"] <= -low:
        check = "One of them has the wrong sign: map it with scale = -1."
    return (
        f"{facts['file']}: {facts['name']} must be the {second}derivative of {facts['first']}; at the frequency of the "
        f"decay it is {facts['ratio']:.3g} times that ({low:g} to {high:g} allowed). {check} Or leave one of "
        f"them out."
    )


def _alias(texts: tuple[str, str], facts: Facts) -> str:
    """The frequencies of the same samples, and the remedy: no prior where a unit is in doubt."""
    remedy = " Sample faster." if facts["refuted"] else texts[1]
    return filled_in((_REFUTED if facts["refuted"] else texts[0]) + (_UNIT if facts["unit"] else remedy), facts)


#: Remedy of an oscillation that no key describes; a later start or stop does not remove it.
TONE = (
    "An oscillation of {tone:.4g} Hz lies beside that of the rod, as hum of the mains (50 or 60 Hz) or another mode of the "
    "structure does."
)

LINT_MESSAGES = {
    "decays.tone": Message(
        "further oscillations",
        warn="{file}: {column} must show one decaying oscillation. "
        + TONE
        + " The fit takes it for hum where its amplitude is constant. Otherwise remove its source, and record again.",
        fail="{file}: {column} must show one decaying oscillation. " + TONE + " Remove its source, or state it as hum.",
    ),
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
    "decays.thinned": Message(
        "length of a decay",
        ok=(
            "{file}: the fit uses {means} means of {thin} consecutive samples each instead of {samples} samples. That widens "
            "intervals by {wider} and saves time. To fit every sample, add thin = 1 to the experiment in rig.toml."
        ),
    ),
    "decays.one_side": Message(
        "turning points of one side",
        warn=(
            "{file}: the positions do not change sides, so each row is read as the maximum one period after the last: "
            "{period:.4g} s, {frequency:.4g} Hz. Where the rows are |x_rel| of both sides, write the sign of each; k1 is "
            "four times too large without it, so it is not judged. Where they are maxima of successive periods, write this "
            "line in [rig] of rig.toml: {line}"
        ),
    ),
    "decays.long": Message(
        "length of a decay",
        warn=(
            "{file}: the fit uses the first {periods} periods, because the stated model is slow. To confirm that, or to choose "
            "another part, add a line to the experiment in rig.toml: " + line_of("stop")
        ),
    ),
    "decays.second": Message(
        "end of a decay",
        fail=(
            "the energy of a free decay must not grow; it grows after {found:.15g} s. Add this line to the experiment in "
            "rig.toml: " + line_of("stop") + "{other}"
        ),
    ),
    "decays.frequency": Message(
        "magnitudes",
        fail=(
            "{file}: all decays have the same k1 and m1, so nearly the same frequency; it is {ratio:.4g} times that of {first}."
            "{near} Check the unit of the times, the sampling rate, and that both records show the same rig."
        ),
    ),
    "decays.alias": Message(
        "aliasing",
        ok=(
            "{labels}: samples at equal intervals do not exclude a second frequency, {other:.4g} Hz (k1 = {k1:.4g} N/m). Make "
            "sure that k1 cannot have this value"
        ),
        warn=partial(_alias, _OUTSIDE),
        fail=partial(_alias, _ALIAS),
    ),
    "decays.uneven": Message(
        "sampling of a decay",
        warn=(
            "{rule}; found {value}. The paper's estimate is left out; the fit uses the times as recorded. Resample the "
            "record evenly to have both."
        ),
    ),
    "decays.sampling": Message(
        "sampling of a decay",
        warn="{samples:.1f} samples per period; {wanted:.0f} or more are wanted. Sample faster{other}.",
    ),
    "decays.length": Message(
        "length of a decay", warn="{periods:.1f} periods; {wanted} or more are wanted. Record for longer."
    ),
}


# messages: What the checks of free decays say, and captions of their tables.


def _second_fit(facts: Facts) -> str:
    """The records that contradict the stated model, the quoted model and the lines that state it."""
    return (
        f"{', '.join(facts['labels'])}: the record contradicts the first model ({facts['first']}). The quoted values are those "
        f"of a second fit: {facts['second']}.{facts['drift']} To state it, add these lines to its entry: "
        f"{facts['lines']}. To keep the first model, state its words."
    )


def _halves(facts: Facts) -> str:
    """The parameter whose halves disagree most, the effect that this indicates, and remedies."""
    damping = facts["name"] in ("c", *DAMPING.values())
    key = "damping" if damping else "stiffness"
    leave = f"Remove {key} from its entry, or state" if key in facts["stated"] else "State"
    values = f"the first half gives {facts['first']:.4g}, the second {facts['second']:.4g} {facts['unit']}"
    cause = (
        f"The {key} depends on the amplitude or on the time in a way that the fitted model lacks ({facts['model']}). {leave} "
        "start and stop for the amplitudes of interest."
    )
    if facts["name"] == "k1" and "cubic" in facts["model"]:
        cause = (
            f"The stiffness changes with the time: the fitted model ({facts['model']}) holds a dependence on the amplitude "
            "already. Find what warms up, works loose or moves during the record, and record again."
        )
    return (
        f"{facts['label']}: expected the same {facts['name']} in both halves of the record; {values} ({facts['z']:.1f} joint "
        f"sd apart). {cause}"
    )


def _forces(facts: Facts) -> str:
    """The force that explains the turning points better, and the line that states it."""
    unit = "" if facts["unit"] == "1" else f" {facts['unit']}"
    if not facts["line"]:
        return (
            f"{facts['label']}: expected amplitudes that are counted from the rest position; a rest position at "
            f"{facts['value']:.3g}{unit} explains them better ({facts['z']:.1f} sd from 0), and changes c. Subtract it "
            "(offset of x_rel in columns), or give turning points of both sides."
        )
    side = (
        " Amplitudes must be counted from the rest position: subtract it, or give both sides."
        if facts["one_side"]
        else ""
    )
    return (
        f"{facts['label']}: expected turning points that the fitted model explains ({facts['model']}); {facts['name']} = "
        f"{facts['value']:.3g}{unit} explains them better ({facts['z']:.1f} sd from 0). Write {facts['line']} in its entry."
        f"{side}"
    )


def _with_smaller(text: str, facts: Facts) -> str:
    """``text`` with how to leave out the large amplitudes of a record in the place of ``{smaller}``."""
    smaller = "record again from smaller deflections"
    if facts["start"] is not None:
        line = filled_in(line_of("start"), facts)
        smaller = f"leave out the larger half of the amplitudes: add {line} to the experiment in rig.toml"
    return filled_in(text, {**facts, "smaller": smaller})


def _with_slow(text: str, facts: Facts) -> str:
    """``text`` with the doubt in a release, and what to do, in the place of ``{slow}``."""
    remedy = "Release the rod at once and record again"
    if facts["start"] is not None:
        line = filled_in(line_of("start"), facts)
        remedy = (
            "Add this line to the experiment in rig.toml, with the time from which on the rod is free (here after a period): "
        ) + line
    slow = "A slow release, or a hand that still touches the rod, looks like a further force or noise. " + remedy
    return filled_in(text, {**facts, "slow": slow})


def _drift(facts: Facts) -> str:
    """What the drift of the zero hides: the motion, or an error of the model."""
    seen = (
        "{label}: a drift of the zero must be slower than the motion, but the fitted one has {share:.1%} of the motion at its "
        "frequency. It hides an error of the model. Where dry friction ends the motion, state an earlier stop; else {smaller}."
    )
    if facts["larger"]:
        seen = (
            "{label}: the fitted drift of the zero is larger than the motion, so the motion may be part of it. State the "
            "start and stop of the free decay."
        )
    return _with_smaller(seen, facts)


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
    remedies = ["Record more periods with less noise"] if facts["swings"] else ["Release from smaller deflections"]
    if "k_cubic" in facts["symbols"] and not facts["offers_cubic"]:
        free.remove('stiffness = "cubic"')
        remedies.append("release from smaller deflections")
    if free:
        remedies.append(f"write {' and '.join(free)} in the experiment for an interval that includes this")
    held = "" if facts["swings"] or facts["low"] == 0.0 else " The quoted interval holds that."
    return (
        f"{', '.join(facts['labels'])}: expected records that exclude {effects}; they do not. {found} (the fit without: "
        f"{facts['value']:.3g}).{held} {', or '.join(remedies)}. If another measurement excludes {effects}, write "
        f"{' and '.join(known)}."
    )


def _changing(facts: Facts) -> str:
    """How c or k1 would change with time, how probable that is, and remedies."""
    symbol = facts["symbol"]
    unit, part = {"c": ("N s/m", "damper"), "k1": ("N/m", "spring")}[symbol]
    names = f"{' and '.join((symbol, *facts['symbols']))} {'are' if facts['symbols'] else 'is'}"
    factor = f"more than {facts['limit']:.0f}" if facts["decided"] else f"{facts['factor']:.2g}"
    found = (
        f"A {symbol} that {'grows' if facts['growth'] > 0.0 else 'falls'} by {100.0 * abs(facts['growth']):.0f} ± "
        f"{100.0 * facts['error']:.1f} % within the record is {factor} times as probable as {facts['model']}. {symbol} is "
        f"then {facts['middle']:.5g} {unit} in the middle of the record (the fit: {facts['value']:.5g}), so {names} not judged."
    )
    if facts["decided"]:
        return (
            f"{listed(facts['labels'])}: {symbol} changes with time, as of a {part} that warms up. {found} No fit corrects "
            "it. Let the rig reach a steady temperature, and record again."
        )
    effects = " or ".join(EFFECTS[symbol] for symbol in facts["symbols"]) or f"a constant {symbol}"
    return (
        f"{listed(facts['labels'])}: expected records that tell {effects} from a {symbol} that changes with time; they do not. "
        f"{found} Add records of 3 times this amplitude: a force changes its effect with the amplitude, a change with time "
        f"does not. Where another measurement excludes a change with time, write {facts['words']} in the experiment."
    )


def _slip(facts: Facts) -> str:
    """What a capsule that may slip means for the numbers, with the friction known or not."""
    text = (
        "{label}: the rod pushes with {force:.3g} N, more than friction holds, F_b = {F_b:.3g} N. A capsule that is not "
        "held slips then, and that looks like the further force found here. If it was held, state the words of damping "
        "and stiffness that the second fit names; else hold it, or release from a smaller deflection."
    )
    if facts["F_b"] is None:
        text = (
            "{label}: the rod pushes with {force:.3g} N, and no experiment tells whether friction then holds a free capsule, "
            "so these numbers are not judged (a coefficient of {mu:.2g} or more holds it). Add a test of static friction, or "
            'hold the capsule and remove capsule = "free".'
        )
    return filled_in(text, facts)


_HELD = (
    "{label}: the readings do not tell the release from one up to a quarter of a period later. {name} then lies between "
    "{low:.3g} and {high:.3g} {unit} (the fit: {value:.3g})."
)
_FREE = "If the rod is free from the first reading of the fit on, add this line to the experiment in rig.toml: "
_FREE += line_of("start")

MESSAGES = {
    **LINT_MESSAGES,
    "decays.kinematics": Message("columns of a decay", fail=_contradiction),
    "decays.hidden": Message(
        "further forces of a decay",
        ok="{labels}: no further force that the records allow changes c or k1 by much",
        warn=_hidden,
        fail=_hidden,
    ),
    "decays.changing": Message("damping and stiffness against time", on_console=True, warn=_changing),
    "decays.held": Message(
        "release of a decay",
        ok="{labels}: k1 and c do not depend on the instant of the release",
        warn=_HELD + " The quoted interval holds that. " + _FREE,
        fail=_HELD + " " + _FREE,
    ),
    "decays.onset": Message(
        "first half period of a decay",
        ok="{labels}: the readings after the first half period give the same parameters",
        warn=partial(
            _with_slow,
            "{label}: the readings after the first half period agree with the first model, so the second fit rests on that "
            "half period alone. {slow}. If the rod was free at once, state the words that the second fit names.",
        ),
        fail=partial(
            _with_slow,
            "{label}: expected the same {name} without the first half period; all readings give {whole:.4g}, the later ones "
            "{later:.4g} {unit} ({p:p} for all parameters and larger residuals before). {slow}",
        ),
    ),
    "decays.stiffness": Message(
        "stiffness against amplitude",
        ok="k1 is the same in all {records} records ({p:p})",
        fail=(
            "expected one k1 for all releases (linear near the working point); the {records} records give {low:.5g} to "
            "{high:.5g} N/m (chi-square {chi_square:.1f}, {p:p}). Release from smaller deflections, or fit records of one "
            "amplitude only."
        ),
    ),
    "decays.slip": Message(
        "free decay",
        warn=_slip,
        fail=(
            "expected a free capsule at rest, |f| <= F_b = {F_b:.3g} N; the record reaches {force:.3g} N, so the capsule "
            "slips and this is no free decay. Hold the capsule, or release from a smaller deflection."
        ),
    ),
    "decays.contact": Message(
        "free decay",
        fail=(
            "x_rel reaches {reach:.3g} m and the support spring stands at {gap:.3g} m, so the rod hits it and this is no "
            "free decay. Move the spring away, or start the window later."
        ),
    ),
    "decays.records": Message(
        "Free vibration, record by record",
        caption=(
            "Each record alone, by least squares on the whole raw record, beside the paper's protocol. The paper's k1 is low "
            "by ζ², because it takes the damped frequency for the natural one. Its c depends on how peaks are read out of "
            "noise."
        ),
    ),
    "decays.forces": Message(
        "forces of a decay",
        ok="{labels}: no further force explains the turning points better",
        warn=_forces,
        fail=_forces,
    ),
    "decays.step": Message(
        "noise of turning points",
        warn=(
            "{label}: the noise of {column} is below the rounding error of its digits (step {step:g} {unit}), so the sd of "
            "{name} follows from that step. State {column}_resolution or {column}_sd."
        ),
    ),
    "decays.position": Message(
        "position of a decay",
        ok="{labels}: the residuals do not depend on position and direction ({p:p})",
        fail=partial(
            _with_smaller,
            "{label}: the residuals must not depend on the position of the rod, but they do ({p:p}), most from {low:.4g} to "
            "{high:.4g} {unit}. The sensor has an error there, or the model lacks a force. Calibrate the sensor, or "
            "{smaller}.",
        ),
    ),
    "decays.residuals": Message(
        "residuals and amplitude of a decay",
        ok="{labels}: the residuals do not grow with the amplitude ({p:p})",
        fail=partial(
            _with_smaller,
            "{label}: the residuals must not be larger where the motion is larger, but they are, {ratio:.1f} times ({p:p}). "
            "What was fitted as noise is an error of the model there, such as a stiffness or a damping that depends on the "
            "amplitude, or an error of the sensor in proportion to the motion. To find the cause, {smaller}, and compare the "
            "results.",
        ),
    ),
    "decays.drift": Message(
        "drift of a decay",
        ok="{label}: the fitted drift of the zero is slower than the motion ({share:.1%} of it at its frequency)",
        fail=_drift,
    ),
    "decays.found": Message(
        "further forces of a decay",
        warn=(
            "{label}: the second fit contains {effect}, but {name} is only {z:.1f} sd from 0, so this number is not judged. "
            "Record more periods with less noise, or state the damping and the stiffness in its entry."
        ),
    ),
    "decays.coarse": Message(
        "further forces of a decay",
        warn=(
            "{label}: readings stand on levels {step:.3g} {unit} apart, and all noise is {share:.2f} of that. Rounding errors "
            "can then look like a force, so {name} and c are not judged. Record with a finer range, or a larger release."
        ),
    ),
    "decays.zero": Message(
        "zero of a decay",
        ok="{labels}: no jump of the sensor's zero stands out where the rod turns",
        fail=(
            "{label}: the zero of the sensor must stay the same, but it jumps where the rod turns; the rms change from a half "
            "swing to the next is {jump:.2g} {unit}. A zero that jumps at each turn ({half_swings:# half swing}) leaves "
            "{ratio:.0%} of the squared residuals that a continuous zero leaves. A loose sensor can cause this, or an "
            "encoder that loses counts. No fit corrects it. Fasten the sensor or replace it, and record again."
        ),
    ),
    "decays.halves": Message(
        "halves of a decay",
        ok="{labels}: the estimates of both halves of each record agree",
        warn=_halves,
        fail=_halves,
    ),
    "decays.damping": Message(
        "Damping parameters",
        caption=(
            "Correlations of the damping parameters. Near -1 or 1 the record determines a combination of two parameters better "
            "than each of them. A record over a wider range of amplitudes separates them."
        ),
    ),
    "decays.first_fit": Message(
        "second fit of free decays",
        warn=(
            "{record}: no second fit, because the record is not one free decay. A mean of the fit holds {thin:# sample}. "
            "Add the line that the finding on the readings states."
        ),
    ),
    "decays.second_fit": Message(
        "second fit of free decays",
        on_console=True,
        warn=_second_fit,
        caption=(
            "Free decays alone, under the stated model and under the model of the quoted values, both by maximum likelihood on "
            "the readings of the latter; records weighted by their errors. BIC: difference from the lower one of both. "
            "Lines of rig.toml that state the quoted model: {lines}."
        ),
    ),
}
