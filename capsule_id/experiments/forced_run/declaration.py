"""Forced runs: columns, settings, rules of the drive, template, lint and description of a record."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, make_dataclass
from functools import partial
from pkgutil import resolve_name
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np

from capsule_id.errors import InputError
from capsule_id.experiments.kind import Kind, made_by
from capsule_id.experiments.lint import USUAL, lint_channel, lint_smooth, lint_times
from capsule_id.parameters import Prior, nuisance, scatter
from capsule_id.records.faults import FEWEST_PERIODS, OF_DERIVATIVE, SIGN_ERRORS, derivative_ratio, drive_power, phasor
from capsule_id.records.tones import FEWEST_IN_PERIOD, SIGNIFICANT, recorded_drive, stated_Omega
from capsule_id.records.view import describe_run
from capsule_id.rig.filters import median_step, uneven_sampling
from capsule_id.rig.model import Column, Quantity, Rig, Table
from capsule_id.rig.schema import ColumnRule, Entry, QuantityRule, SupportSettings
from capsule_id.rig.toml import ANY, NOT_NEGATIVE, PART
from capsule_id.views import Facts, Finding, Message, filled_in, stated_p

# rules: Rules on the drive of a forced run: what each kind of drive needs, and what it does not have.


#: Drives of a run: a harmonic force, a prescribed motion of the rod, pulses, a force of one size that changes its sign, K
#: times the recorded current.
HARMONIC, BASE, PULSES, SQUARE, RECORDED = DRIVES = ("harmonic", "base", "pulses", "square", "recorded")
FORCES, SWITCHED = (HARMONIC, PULSES, SQUARE, RECORDED), (PULSES, SQUARE)


class DriveRule(NamedTuple):
    """A rule on the settings and columns of an entry with one of ``drives``.

    Attributes
    ----------
    found : from settings and columns; "" where the rule holds
    place, rule, value, remedy : of the error; {drive}, {columns} and {found} are filled in
    of_key : the place is the key, not its value
    """

    drives: tuple[str, ...]
    found: Callable[[Any, Mapping[str, Column]], object]
    place: str
    rule: str
    value: str
    remedy: str
    of_key: bool = False


def check_drive(rules: Sequence[DriveRule], entry: Entry[Any]) -> None:
    """Raise the error of the first of ``rules`` that the entry breaks."""
    settings, columns = entry.table.settings, entry.table.columns
    for rule in (rule for rule in rules if settings.drive in rule.drives):
        if found := rule.found(settings, columns):
            facts = {"drive": settings.drive, "columns": f"columns {' '.join(columns)}", "found": found}
            place, text, value, remedy = (part.format(**facts) for part in rule[2:6])
            raise entry.error(place, text, value, remedy, of_key=rule.of_key)


def _frequencies(settings: Any, columns: Mapping[str, Column]) -> str:
    """The stated frequencies, where there are both or none that is needed."""
    known = [key for key in ("Omega", "f") if getattr(settings, key) is not None]
    return "" if len(known) == 1 or (settings.drive == BASE and not known) else " and ".join(known) or "none"


def _uneven_base(settings: Any, columns: Mapping[str, Column]) -> str:
    """What is uneven in the times of a base without a stated frequency."""
    unstated = settings.Omega is None and settings.f is None
    fault = uneven_sampling(columns["time"].values) if unstated else None
    return "" if fault is None else fault.value


def _unread(settings: Any, columns: Mapping[str, Column]) -> str:
    """The first stated error of a channel that no reading of the run has: it would have no effect."""
    inputs = {BASE: "x_base", RECORDED: "current"}
    read = [name for name, *_ in _CHANNELS if name in columns and name != inputs.get(settings.drive)]
    errors = (f"{name}_{error}_sd" for name, *_ in _CHANNELS if name not in read for error in ("gain", "delay"))
    idle = [f"{name}_sd" for name, column in columns.items() if name not in read and column.sd is not None]
    return next(iter([*(key for key in errors if getattr(settings, key) is not None), *idle]), "")


def present(*names: str) -> Callable[[Any, Mapping[str, Column]], str]:
    """Finds the columns of ``names`` that the entry has."""
    return lambda settings, columns: " and ".join(name for name in names if name in columns)


def stated(key: str) -> Callable[[Any, Mapping[str, Column]], bool]:
    """Finds whether a setting is stated."""
    return lambda settings, columns: getattr(settings, key) is not None


def lacks(column: str, fewest: int = 0) -> Callable[[Any, Mapping[str, Column]], bool]:
    """Finds whether the entry lacks ``column``, or has fewer columns than ``fewest``."""
    return lambda settings, columns: column not in columns or len(columns) < fewest


#: The rules on the drive of a forced run, in the order in which they are applied.
DRIVE_RULES = (
    DriveRule(
        FORCES, present("x_base"), "", "x_base prescribes the motion of the rod", "a force",
        'add drive = "base", or remove the column',
    ),
    DriveRule((BASE,), lacks("x_base"), "drive", 'drive = "base" needs a column x_base', "{columns}", "add it"),
    DriveRule(
        (BASE,), present("acceleration_rod", "current"), "drive",
        "a run with a prescribed rod has x_capsule, x_rel or both, and no other channel", "{columns}", "remove {found}",
    ),
    DriveRule((BASE,), stated("P_d"), "P_d", 'drive = "base" has no force P_d', "P_d", "remove P_d", of_key=True),
    DriveRule(
        (BASE,), _uneven_base, "", "the frequency of a base sampled unevenly must be stated", "{found}",
        'add f = {{ value = ..., unit = "Hz" }}',
    ),
    DriveRule(
        DRIVES, lambda *entry: _frequencies(*entry) == "none", "", "forced_run must have Omega (rad/s) or f (Hz), not both",
        "none", "state one of them",
    ),
    DriveRule(
        DRIVES, _frequencies, "f", "forced_run must have Omega (rad/s) or f (Hz), not both", "{found}", "state one of them"
    ),
    *(
        DriveRule(
            (HARMONIC, RECORDED), stated(key), key, f"only pulses and square waves have {key}", key, f"remove {key}",
            of_key=True,
        )
        for key in ("duty", "P_on", "lag")
    ),
    DriveRule(
        (*SWITCHED, RECORDED), stated("P_d"), "P_d", 'drive = "{drive}" has no amplitude P_d', "P_d", "remove P_d", of_key=True
    ),
    DriveRule(
        (BASE, *SWITCHED, RECORDED), lambda settings, columns: settings.start == "settled", "start",
        'start = "settled" needs a harmonic force', 'drive = "{drive}"', 'write start = "auto"',
    ),
    DriveRule(
        (RECORDED,), lacks("current", 3), "drive",
        'drive = "recorded" needs the column current and another channel', "{columns}", "add it",
    ),
    DriveRule(
        DRIVES, _unread, "{found}", "{found} needs a channel that the motion predicts", "{columns}",
        "remove it; the gain of a current that drives the run belongs to K, an error of the times to clock", of_key=True,
    ),
    DriveRule(
        SWITCHED, present("current"), "drive", 'drive = "{drive}" has no column current', "{columns}",
        'write drive = "recorded", or remove the column',
    ),
    *(
        DriveRule(
            drives, lambda settings, columns, key=key: getattr(settings, key) is None, "drive",
            f'drive = "{{drive}}" needs {key}', "none", f"add {key} = {{{{ value = ..., unit = ... }}}}",
        )
        for key, drives in (("duty", (PULSES,)), ("P_on", SWITCHED))
    ),
    DriveRule(
        (HARMONIC,), lambda settings, columns: settings.P_d is None and "current" not in columns, "",
        "forced_run must have P_d where current is not recorded", "{columns}",
        'add P_d = {{ value = ..., sd = ..., unit = "N" }}',
    ),
    DriveRule(
        (HARMONIC,), lambda settings, columns: "current" in columns and settings.P_d and settings.P_d.sd == 0.0, "P_d",
        "P_d beside a recorded current is a second reading of the same amplitude and must have an sd", "none",
        "add sd = ... to it, or leave P_d out",
    ),
)  # fmt: skip


# lint: Findings on the readings of a forced run: its frequency, mislabelled columns, and those of any record.


#: Harmonics of the drive that are compared, and the smallest share of the acceleration's standard deviation there.
HARMONICS, STRONG = range(1, 6), 0.15
#: A change from sample to sample, relative to the range, by which a current is switched.
SWITCH = 0.3
#: Admissible ratio of the recorded acceleration to that of x_rel alone: the motion of the capsule is unknown.
RATIO_OF_X_REL = (0.1, 10.0)


def lint_run(table: Table[Any], rig: Rig) -> Iterable[Finding]:
    """Report faults of the record, a stated frequency that differs from that of the current, and wrong columns."""
    used = slice(0, len(table.rows))
    yield from lint_times(table, used)
    time, period = table["time"], 2.0 * np.pi / stated_Omega(table)
    faults = list[Finding]()
    samples, periods = period / median_step(time), float(time[-1] - time[0]) / period
    # The record holds no period of the stated frequency, or its sampling cannot follow it.
    if samples < FEWEST_IN_PERIOD or periods < 1.0:
        facts = {"file": table.file, "periods": periods, "samples": samples}
        faults.append(Finding("runs.time_scale", "fail", facts, table.label))
    # A current that is switched in every period rests at its limits, and jumps.
    current = table["current"] if table.settings.drive == RECORDED else np.zeros(2)
    switched = bool(np.sum(np.abs(np.diff(current)) > SWITCH * np.ptp(current)) >= max(periods, 1.0))
    for name in table.columns:
        # A capsule may rest at an extreme position, which is no clipping.
        if name not in ("time", "x_capsule"):
            faults += lint_channel(table, name, used, period, switched and name == "current")
    faults = faults or [*_columns(table)]
    if "current" in table.columns and not (faults or switched):
        faults += lint_smooth(table, "current", used, period)
    yield from faults
    try:
        drive = recorded_drive(table)
    except InputError:
        return
    off = 0.0 if drive is None else drive.Omega / drive.stated_Omega - 1.0
    # The drift that would explain it, of the clock as it is without the one that is stated.
    drift = (1.0 + table.drift.value) * (1.0 + off) - 1.0
    # A fit with a stated sd of the clock measures the clock by the frequency of the drive.
    if drive is not None and drive.disagrees and abs(off) > SIGNIFICANT * table.drift.sd:
        facts = {"stated": drive.stated_Omega, "Omega": drive.Omega, "sd": drive.Omega_sd, "ppm": 1e6 * drift}
        yield Finding("runs.frequency", "warn", facts, table.label)


def _columns(table: Table[Any]) -> Iterable[Finding]:
    """Report columns that contradict kinematics or the sign of the power of the drive."""
    time, Omega = table["time"], stated_Omega(table)
    if "x_rel" not in table.columns or (time[-1] - time[0]) * Omega < FEWEST_PERIODS * 2.0 * np.pi:
        return
    whole = {name: table[name] for name in table.columns if name != "time"}
    position = whole["x_rel"] + whole.get("x_capsule", 0.0)
    first = phasor(time, position, Omega)
    if abs(first.value) < SIGN_ERRORS * first.sd:
        return
    if "acceleration_rod" in whole:
        low, high = OF_DERIVATIVE if "x_capsule" in whole else RATIO_OF_X_REL
        for harmonic in HARMONICS if "x_capsule" in whole else HARMONICS[:1]:
            frequency = harmonic * Omega
            order = (harmonic, *HARMONICS)
            moves, accelerates = (phasor(time, x, Omega, order) for x in (position, whole["acceleration_rod"]))
            expected = frequency**2 * abs(moves.value)
            strong = max(expected, abs(accelerates.value)) > STRONG * float(np.std(whole["acceleration_rod"]))
            ratio = derivative_ratio(moves, accelerates, frequency, 2)
            if strong and abs(moves.value) > SIGN_ERRORS * moves.sd and not low <= ratio.real <= high:
                facts = {
                    "file": table.file,
                    "position": "x_rel + x_capsule" if "x_capsule" in whole else "x_rel",
                    "ratio": ratio.real,
                    "low": low,
                    "high": high,
                    "harmonic": harmonic,
                }
                yield Finding("runs.kinematics", "fail", facts, table.label)
                return
    if "current" in whole:
        power, error = drive_power(phasor(time, whole["current"], Omega), first, Omega)
        if power < -SIGN_ERRORS * error:
            yield Finding("runs.power", "fail", {"file": table.file}, table.label)


def _contradiction(facts: Facts) -> str:
    """The ratio of the two columns, and what to check."""
    check = "Check the names and units of these columns."
    if -facts["high"] <= facts["ratio"] <= -facts["low"]:
        check = "One of them has the wrong sign: x_rel is positive towards the spring, and so is the acceleration."
    return (
        f"{facts['file']}: acceleration_rod must be the second derivative of {facts['position']}; at {facts['harmonic']} times "
        f"the drive's frequency it is {facts['ratio']:.3g} times that ({facts['low']:g} to {facts['high']:g} allowed). {check}"
    )


#: Largest error of a clock that is one, 1e-6: 1 %. Beyond, the frequency is another one.
LARGEST_PPM = 1e4
_CLOCK = (
    "; or, where the generator is known to be right, the clock of the logger is off by {ppm:.0f} ppm, in the decays too: "
    'state its drift, clock = {{ drift = {{ value = {ppm:.0f}, sd = ..., unit = "ppm" }} }}.'
)
LINT_MESSAGES = {
    "runs.frequency": Message(
        "frequency of the drive",
        warn=lambda facts: filled_in(
            "the stated Omega must be that of the current; stated {stated:g} rad/s, the current has {Omega:.6g} ± {sd:.2g} "
            "rad/s on the clock of the record. Correct Omega" + (_CLOCK if abs(facts["ppm"]) < LARGEST_PPM else "."),
            facts,
        ),
    ),
    "runs.time_scale": Message(
        "time scale of a run",
        fail=(
            "{file}: the record holds {periods:.3g} periods of the stated drive with {samples:.3g} samples each. Check the "
            "unit of time (s or ms) and that of the frequency (rad/s or Hz)."
        ),
    ),
    "runs.kinematics": Message("columns of a run", fail=_contradiction),
    "runs.power": Message(
        "columns of a run",
        fail=(
            "{file}: the drive must supply energy; by current and x_rel it takes energy away. Check the signs of x_rel "
            "(positive towards the spring) and current (positive pushes towards it)."
        ),
    ),
}


# declaration: Forced runs: columns, settings, rules, template, lint and description of a record.


#: Recorded channels: name, unit, LaTeX subscript.
_CHANNELS = (("x_rel", "m", "x"), ("x_capsule", "m", "X2"), ("acceleration_rod", "m/s^2", "a"), ("current", "A", "I"))

CURRENT_AMPLITUDE = nuisance("I_d", "A", "amplitude of the current in a run", "I_d")
CAPSULE_START = nuisance("capsule_start", "m/s", "speed of the capsule at the start of a run", "v_0")
#: Parameters of each channel: noise level and atanh of the noise correlation.
NOISE = {
    name: scatter(f"noise_{name}", unit, f"noise of {name} in a run", rf"\sigma_{{{index}}}")
    for name, unit, index in _CHANNELS
}
CORRELATION = {
    name: nuisance(
        f"ar1_{name}", "1", f"atanh of the noise's lag-1 correlation, {name} of a run", r"\alpha",
        Prior("normal", 0.0, 1.0),
    )
    for name, _, _ in _CHANNELS
}  # fmt: skip

#: Settings of the gains and delays of channels: ``<channel>_gain_sd`` and ``<channel>_delay_sd``, 1 and s.
ChannelSettings: Any = make_dataclass(
    "ChannelSettings",
    [
        (f"{name}_{error}_sd", Annotated[float | None, QuantityRule(unit)], None)
        for error, unit in (("gain", "1"), ("delay", "s"))
        for name, *_ in _CHANNELS
    ],
    bases=(SupportSettings,),
    frozen=True,
    kw_only=True,
)
#: Excitation periods from rest after which the motion counts as periodic (start = "settled").
SETTLING_PERIODS = 40
#: Stiffness of the hard spring of the paper's Fig. 10, N/m; it has no static test.
RUN_SPRINGS = {"hard": 59410.0}


#: Module with the classes of runs and of their twin, and the class of each drive.
PLACE = "capsule_id.experiments.forced_run"
RUNS_OF_DRIVES = {
    HARMONIC: "ForcedRun",
    BASE: "BaseRun",
    PULSES: "PulseRun",
    SQUARE: "PulseRun",
    RECORDED: "RecordedRun",
}


@dataclass(frozen=True, kw_only=True)
class RunSettings(ChannelSettings):
    """Settings of a forced run, SI; see ``ChannelSettings`` for sds of gain and delay."""

    drive: Literal["harmonic", "base", "pulses", "square", "recorded"] = "harmonic"
    Omega: Annotated[float | None, QuantityRule("rad/s")] = None
    f: Annotated[float | None, QuantityRule("Hz")] = None
    P_d: Annotated[Quantity | None, QuantityRule("N", has_sd=True)] = None
    duty: Annotated[float | None, QuantityRule("1", PART)] = None
    P_on: Annotated[Quantity | None, QuantityRule("N", ANY, has_sd=True)] = None
    lag: Annotated[Quantity | None, QuantityRule("s", NOT_NEGATIVE, has_sd=True)] = None
    normal_force: Annotated[float | None, QuantityRule("N")] = None
    start: Literal["auto", "stuck", "moving", "settled"] = "auto"
    noise: Literal["white", "ar1"] | None = None
    segment: Annotated[float | None, QuantityRule("s")] = None


def _second_fit(facts: Facts) -> str:
    """The records whose noise is coloured, and how to state either noise."""
    return (
        f"{', '.join(facts['records'])}: the residuals of the first fit are correlated, so white noise is not right. The "
        'quoted values are those of a second fit with coloured noise, AR(1). To state it, write noise = "ar1" in the entry '
        'of the run. To keep the first fit, write noise = "white".'
    )


def _laws(facts: Facts) -> str:
    """The friction law that explains the runs best, or as well with fewer parameters; its line, and what it changes."""
    moved = ", ".join(f"{name} from {old:.4g} to {new:.4g}" for name, old, new in facts["moved"])
    how = f"as well as {facts['own']}, with fewer parameters"
    if facts["better"]:
        how = f"better than {facts['own']} (penalised log-posterior {facts['gain']:+.0f})"
    return (
        f'the friction law "{facts["law"]}" explains the runs {how}. It moves {moved}, in SI units. To use it, write in '
        f"[model] of rig.toml: {facts['line']}"
    )


def _repeated(facts: Facts) -> str:
    """The record whose residuals repeat, and the friction laws to compare."""
    laws = facts["other_laws"]
    compare = f"The fit has {facts['law']}; compare it with {' or '.join(laws)} in [model]. " if laws else ""
    check = "the support spring, the gap and the frequency" if facts.get("spring") else "the frequency"
    return (
        f"{facts['record']}: expected residuals that do not repeat with every excitation period, but they do (F = "
        f"{facts['F']:.3g}, {stated_p(facts['p'])}). An error that repeats is no noise: the model lacks a force, or a sensor "
        f"has an error. {compare}Check {check} of the drive."
    )


TEMPLATE = """\
#: Forced run. Columns: time [s], and any of x_rel [mm], x_capsule [mm], acceleration_rod [m/s^2], current [A].
#: State Omega in rad/s or f in Hz. P_d is needed where current is not recorded.
# [[experiment]]
# kind = "forced_run"
# file = "run_01.csv"
# spring = "L60"
# gap = { value = 1.0, sd = 0.02, unit = "mm" }
#: a spring behind the rod. A gap counts from x_rel = 0; it is negative where the spring reaches beyond
# spring_back = "L60"
# gap_back = { value = 2.0, sd = 0.02, unit = "mm" }
# Omega = { value = 34.56, unit = "rad/s" }
# P_d = { value = 4.0, sd = 0.1, unit = "N" }
#: "harmonic" (default): P_d cos(Omega t + phase); "base": a column x_base [mm] prescribes the motion of the rod. Then
#: x_capsule or x_rel is needed, P_d and m1 are not, and the frequency is that of x_base. spring and gap: optional
#: "pulses": duty = { value = 30, unit = "%" }, P_on = { value = 1.2, sd = 0.3, unit = "N" } and optionally lag;
#: "square": P_on and -P_on in turn, half a period each where no duty is stated;
#: "recorded": K times the column current is the force, whatever its form
# drive = "harmonic"
#: normal force on the ground where it is not (m1 + m2) g
# normal_force = { value = 6.28, unit = "N" }
# slope = { value = 0, unit = "deg" }                   # this one alone; default: [rig]
# N0 = { value = 0, unit = "N" }
#: state of the capsule at the first sample: "auto" (default, from the record), "stuck", "moving" or "settled"
# start = "auto"
#: "white", or "ar1": coloured noise, its correlation is estimated. Default: white, and ar1 where the residuals demand it
# noise = "white"
#: sd of a channel's gain; also x_capsule_gain_sd acceleration_rod_gain_sd current_gain_sd
# x_rel_gain_sd = { value = 0.01, unit = "1" }
#: sd of a delay below one sample; also x_capsule_delay_sd acceleration_rod_delay_sd current_delay_sd
# x_rel_delay_sd = { value = 0.1, unit = "ms" }
#: length of the parts, each with initial conditions of its own, into which a chaotic record is cut
# segment = { value = 0.3, unit = "s" }
"""

MESSAGES = {
    **LINT_MESSAGES,
    "runs.rough": Message(
        "feasible",
        warn=(
            "the findings on its settings take the prior's median of {names}: no bench test of the folder measures them. "
            "Add these tests."
        ),
    ),
    "runs.contact": Message(
        "feasible",
        warn=(
            "at Omega = {Omega:.4g} rad/s the rod reaches the gap of {gap_mm:.3g} mm from P_d = {needed:.3g} N on, the run has "
            "{P_d:.3g} N: no lasting contact from rest, so the run does not determine k2; check P_d, gap and Omega, drive "
            "harder, or narrow the gap"
        ),
    ),
    "runs.slip": Message(
        "feasible",
        warn=(
            "the rod pushes a capsule at rest with {force:.3g} N at most, the break-away force is {F_b:.3g} N: the capsule "
            "cannot set off, so the run does not determine the friction law; drive harder, or nearer to resonance"
        ),
    ),
    "runs.sampling": Message(
        "feasible",
        warn=(
            "a contact lasts about {contact_ms:.2g} ms, which is {samples:.2g} samples; {wanted} or more are wanted. Sample "
            "at {rate:.0f} Hz or more"
        ),
    ),
    "runs.length": Message(
        "feasible",
        warn=(
            "{periods:.2g} excitation periods are left after the start has died out ({decay:.2g} s), {wanted} or more are "
            "wanted; record for {seconds:.2g} s or more"
        ),
    ),
    "runs.predictable": Message(
        "runs predictable",
        ok="an error of the initial state grows less than {limit:g} times in {number:# run}",
        fail=(
            "expected a motion that forgets its start; an error of the initial state grows {growth:.2g} times over the record, "
            "so one initial state cannot predict it. State segment, or record less of it."
        ),
    ),
    "runs.cut": Message(
        "runs predictable",
        warn=(
            "an error of the initial state grows {growth:.2g} times over the record where the fit starts, so the record was "
            "cut into {parts} parts of {seconds:.2g} s, each with an initial state of its own; "
            'segment = {{ value = ..., unit = "s" }} states another length'
        ),
    ),
    "runs.grazing": Message(
        "runs predictable",
        warn="{status} Its covariance at the point fit may be wrong; the sample does not use it.",
    ),
    "runs.start": Message(
        "start of a run",
        fail=(
            "{labels}: expected one kind of start to fit; the kind of start did not settle after {rounds} fits. State "
            'start = "stuck" or "moving", or cut the record where the capsule is clearly at rest.'
        ),
    ),
    "runs.second_fit": Message(
        "coloured noise",
        warn=_second_fit,
        caption=(
            "Both fits of the readings: the first, with white noise, and the quoted one, with AR(1) noise. ± is the standard "
            "error without the error of the model. Natural logarithm of the posterior density."
        ),
        on_console=True,
    ),
    "runs.laws": Message(
        "friction law of runs",
        ok="{own} explains the runs as well as the other friction laws in the table, although residuals are correlated",
        warn=_laws,
        caption=(
            "The runs fitted with other friction laws; ± of a parameter is the standard error without the error of the model. "
            "Behind the best: difference of log-posteriors, less ln(readings)/2 per parameter (Schwarz 1978); where the best "
            "law leaves correlated residuals, with its standard error from parts of the record."
        ),
    ),
    "runs.repeated": Message(
        "repeated misfit",
        ok="the residuals of no run repeat with the excitation (smallest {p:p})",
        fail=_repeated,
    ),
    "runs.groups": Message(
        "Nondimensional groups",
        caption=(
            "A prototype of another size with equal groups has an equal motion. Omega0 = √(k1/m1), zeta = c/(2 m1 Omega0), "
            "F_b: break-away force, by eq. (1) on level ground mu (m1 + m2) g. A shared group is listed once."
        ),
    ),
    "runs.motion": Message(
        "Motion predicted and observed",
        caption=(
            "Over the record. Model and record go through the same estimator of the mean velocity. The band is that of a "
            "new record, its error included."
        ),
    ),
}

KIND = Kind(
    name="forced_run",
    columns={
        "time": ColumnRule("s", increasing=True),
        "x_rel": ColumnRule("m", varies=True),
        # A capsule that never moves is a valid result, so its displacement has no smallest size.
        "x_capsule": ColumnRule("m", usual=(0.0, USUAL["m"][1])),
        "acceleration_rod": ColumnRule("m/s^2", varies=True),
        "current": ColumnRule("A", varies=True),
        "x_base": ColumnRule("m", varies=True),
    },
    sets=(("time",),),
    optional=("x_base",),
    channels=tuple(NOISE),
    settings=RunSettings,
    rules=(Entry.check_springs_with_gaps, Entry.check_length, partial(check_drive, DRIVE_RULES)),
    masses=lambda table: ("m2",) if table.settings.drive == "base" else ("m1", "m2"),  # a prescribed rod needs no mass
    parameters=(CURRENT_AMPLITUDE, *NOISE.values(), *CORRELATION.values(), CAPSULE_START),
    read_by=("gain",),
    test="run",
    minutes=5.0,
    make=lambda table, *rig: made_by(f"{PLACE}.drives:{RUNS_OF_DRIVES[table.settings.drive]}")(table, *rig),
    template=TEMPLATE,
    informs="all of them together, and the gap",
    captions={
        "forced_run": "Forced run: one recorded channel, its residuals at the point fit, and their autocorrelation.",
        "phase_portrait": "Phase plane as in the paper: record and model through one Savitzky–Golay filter; impact line.",
    },
    messages=MESSAGES,
    bench=False,
    lint=(lint_run,),
    lint_rig=lambda *of_table: resolve_name(f"{PLACE}.drives:lint_feasibility")(*of_table),
    describe=describe_run,
    twin=lambda values, rng, seed: resolve_name(f"{PLACE}.twin:measure")(values, seed),
    truth={f"k2[{name}]": k2 for name, k2 in RUN_SPRINGS.items()},
)
