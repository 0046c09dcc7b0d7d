"""Free vibration: columns, settings, rules, template, lint, the paper's estimates and the twin."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from capsule_id.errors import InputError
from capsule_id.experiments.free_vibration.decrement import (
    STRONGEST,
    exponential_fit,
    likelihood_gain,
    swings_enough,
    viscous_fit,
)
from capsule_id.experiments.free_vibration.lint import MESSAGES, check_thin, lint_decay
from capsule_id.experiments.free_vibration.readings import (
    CHANNELS,
    DecayModel,
    DecaySettings,
    channel_of,
    check_ground,
    cut_at_release,
    decay_window,
    first_periods,
)
from capsule_id.experiments.kind import Kind, Twin, TwinTable, Values, made_by
from capsule_id.parameters import Parameter, Prior, nuisance, scatter
from capsule_id.records.release import shortened
from capsule_id.rig.filters import median_step
from capsule_id.rig.model import Rig, Table
from capsule_id.rig.schema import SHORTEST_RECORD, ColumnRule, Entry
from capsule_id.views import counted

# twin: Synthetic free decays.


#: Release amplitudes of the paper's protocol, m, and noise sd relative to the release.
RELEASES = (1.5e-3, 2.0e-3, 2.5e-3)
DECAY_NOISE = 0.01


def measure(values: Values, rng: np.random.Generator, seed: int) -> Twin:
    """Simulate one record per release amplitude."""
    del seed
    decays = [decay(rng, values["k1"], values["c"], values["m1"], release, DECAY_NOISE) for release in RELEASES]
    return Twin(tuple(TwinTable(f"free_vibration_{n}.csv", columns) for n, columns in enumerate(decays, start=1)))


def decay(
    rng: np.random.Generator,
    k1: float,
    c: float,
    m1: float,
    release: float,
    relative_sd: float,
    duration: float = 0.5,
    rate: float = 2000.0,
) -> dict[str, np.ndarray]:
    """Simulate a decay from rest at ``release`` m at time 0; the noise sd is ``relative_sd`` of the release."""
    from capsule_id.experiments.free_vibration.decrement import viscous_basis

    time = np.arange(round(duration * rate)) / rate
    x = release * viscous_basis(time, k1, c, m1, np)[:, 0]
    return {"time [s]": time, "x_rel [mm]": 1e3 * (x + relative_sd * release * rng.standard_normal(time.size))}


# declaration: Free vibration: columns, settings, rules, template, lint and the paper's estimates.


#: Twice the log-likelihood ratio beyond which one description of a stroke is better than another. A stroke that friction
#: ends gained 6.5 or more in 20 records of such rods, with noise of 0.1 to 3 %, and -3.6 or less in 20 viscous ones.
BETTER = 6.0
NOISE_SD = CHANNELS["x_rel"].noise
TIME_SD = scatter("time_sd", "s", "noise of the times of turning points", r"\sigma_t")
AMPLITUDE = nuisance("amplitude", "m", "first turning point of a decay", "a_0")
NOISE_TIME = Parameter("noise_time", "s", "correlation time of a record's noise", r"\tau", physical=False)
WHITE_RATIO = Parameter(
    "white_ratio", "1", "white noise over correlated noise", "w", Prior("lognormal", 1.0, 100.0), physical=False
)
DRIFT_RATIO = Parameter(
    "drift_ratio", "1", "drift over noise of a record", "d", Prior("lognormal", 3.0, 100.0), physical=False
)
DRIFT_TIME = Parameter("drift_time", "s", "correlation time of a record's drift", r"\tau_d", physical=False)
TURNING_TIME = nuisance("turning_time", "s", "time of the first turning point of a decay", "t_0")


def _check_window(entry: Entry[DecaySettings]) -> None:
    """Require start < stop, both inside the record to one sampling step, and enough samples between them."""
    entry.check_length()
    time, settings = entry.table["time"], entry.table.settings
    step = median_step(time)  # the stated duration of n samples is often n steps, one more than the record has
    edges = {"start": float(time[0]), "stop": float(time[-1])}
    for key, value in (("start", settings.start), ("stop", settings.stop)):
        if value is None:
            continue
        if not time[0] - step <= value <= time[-1] + step:
            span = f"a time from {time[0]:g} to {time[-1]:g} s"
            raise entry.error(key, f"{key} must lie inside the record", f"{value:g} s", f"write {span}")
        edges[key] = value
    place = "start" if settings.stop is None else "stop"
    if edges["start"] >= edges["stop"]:
        value = f"{edges['start']:g} s and {edges['stop']:g} s"
        raise entry.error(place, "start must be before stop", value, "correct one of them")
    inside = len(decay_window(entry.table)[0])
    if inside < SHORTEST_RECORD:
        rule = f"at least {SHORTEST_RECORD} samples must lie between start and stop"
        raise entry.error(place, rule, counted(inside, "sample"), "widen the window")


def _check_forward(entry: Entry[DecaySettings]) -> None:
    """Require a free capsule and the default model of the decay for the capsule model."""
    settings = entry.table.settings
    if settings.forward != "capsule":
        return
    if settings.capsule == "held":
        remedy = 'add capsule = "free", or write forward = "closed" where the capsule was held'
        raise entry.error("forward", "forward capsule needs a capsule that is free to move", "held", remedy)
    model = DecayModel.stated(settings)
    if model != DecayModel() or settings.samples != "record":
        rule = "forward capsule has viscous damping, a linear spring and white noise only"
        remedy = 'write forward = "closed", or remove damping, stiffness, drift and noise'
        raise entry.error("forward", rule, model.name, remedy)


def _check_channels(entry: Entry[DecaySettings]) -> None:
    """Require x_rel alone for turning points and for the capsule model."""
    settings, names = entry.table.settings, set(CHANNELS).intersection(entry.table.columns)
    for key, value, needs in (
        ("samples", settings.samples, "turning_points"),
        ("forward", settings.forward, "capsule"),
    ):
        if value == needs and names != {"x_rel"}:
            found = " ".join(sorted(names))
            raise entry.error(key, f'{key} = "{needs}" needs x_rel and no other channel', found, "map x_rel only")


#: Largest distance of an interval between turning points from a multiple of the median one, relative to that.
UNEQUAL = 0.25


def _check_turning_points(entry: Entry[DecaySettings]) -> None:
    """Refuse drift, coloured noise and thinning of turning points."""
    settings = entry.table.settings
    if settings.samples == "record":
        return
    for key, default in (("drift", "none"), ("noise", "white"), ("thin", 1)):
        value = getattr(settings, key)
        if value not in (None, default):
            rule = "turning points have white noise and no drift, and each of them counts"
            raise entry.error(key, rule, str(value), f"remove {key}, or samples", of_key=True)


def _check_swings(tables: Sequence[Table[DecaySettings]]) -> None:
    """Refuse a record of one stroke that friction ends, and further forces in one that hardly swings.

    Raises
    ------
    InputError
        At the first such table.
    """
    # The fit leaves out rest before the release; so does this rule.
    for table in map(cut_at_release, tables):
        if table.settings.samples == "turning_points":
            _check_turns(table)
            continue
        time, values = shortened(*decay_window(table))
        if swings_enough(values):
            continue
        place, channel = (Path(table.file), int(table.rows[0])), channel_of(table)
        rule = f"{channel} must pass its rest position, or show how it comes to rest there by damping"
        fit = viscous_fit(time, values)
        if likelihood_gain(fit, viscous_fit(time, values, held=CHANNELS[channel].order)) > BETTER:
            value = f"one stroke of {len(values)} samples, after which dry friction holds the rod"
            raise InputError(rule, value, "release it from a larger deflection, or reduce the friction", *place)
        if likelihood_gain(exponential_fit(time, values), fit) < 2.0 * BETTER:
            remedy = (
                'where each row is a turning point, state samples = "turning_points"; else record from the release on, with '
                "at least 10 samples before the rod is at half its deflection"
            )
            raise InputError(rule, f"one exponential in {len(values)} samples, which gives c/k1 alone", remedy, *place)
        if fit.ratio > STRONGEST and DecayModel.stated(table.settings).symbols:
            rule = f"further forces need a damping ratio below {STRONGEST:g}"
            remedy = 'write damping = "viscous" and stiffness = "linear"'
            raise InputError(rule, f"{fit.ratio:.2g} in {channel}", remedy, *place)


def _check_turns(table: Table[DecaySettings]) -> None:
    """Refuse turning points whose intervals are no multiples of one time.

    Raises
    ------
    InputError
        At the first such interval.
    """
    step = np.diff(decay_window(table)[0])
    multiple = step / np.median(step)
    wrong = np.flatnonzero(np.abs(multiple - np.maximum(np.rint(multiple), 1.0)) > UNEQUAL)
    if len(wrong):
        raise InputError(
            "turning points must follow each other by one time, half a period or a period, or a multiple of it",
            f"intervals of {np.median(step):.4g} s, and {step[wrong[0]]:.4g} s before this row",
            "correct the time of this row; where the rows are of several decays, give each of them an entry of its own",
            Path(table.file),
            int(table.rows[wrong[0] + 1]),
        )


def _make(table: Table[DecaySettings], rig: Rig, friction: Any) -> tuple[Any, ...]:
    """Make the experiment of the class that the settings demand; its record begins with the release."""
    make = made_by(
        "capsule_id.experiments.free_vibration.experiment:FreeVibration",
        capsule="capsule_id.experiments.capsule_experiment:CapsuleDecay",
    )
    if table.settings.samples == "turning_points":
        make = made_by("capsule_id.experiments.free_vibration.turning_points:TurningPoints")
    table = cut_at_release(table)
    if DecayModel.stated(table.settings).slow and table.settings.samples == "record":
        table = first_periods(table)
    return tuple(e for one in _channel_tables(table) for e in make(one, rig, friction))


def _channel_tables(table: Table[DecaySettings]) -> list[Table[DecaySettings]]:
    """Return a table for each channel; its fit has initial conditions of its own, which loses little."""
    first, *others = [name for name in CHANNELS if name in table.columns]
    tables = [replace(table, columns={name: table.columns[name] for name in ("time", first)})]
    for name in others:
        columns = {own: table.columns[own] for own in ("time", name)}
        tables.append(replace(table, columns=columns, label=f"{table.label}_{name}"))
    return tables


def _masses(table: Table[DecaySettings]) -> tuple[str, ...]:
    """Symbols of the required masses: the rod, and the capsule where it may move."""
    moves = table.settings.capsule == "free" or table.settings.forward == "capsule"
    return ("m1", "m2") if moves else ("m1",)


def _paper(experiments: Sequence[Any]) -> Values:
    """Estimate k1 = m1 Omega_o^2 and c by logarithmic decrement after Savitzky–Golay, as in the paper; record means."""
    found = [d for d in (e.paper_decrement() for e in experiments) if d is not None]
    return {"k1": float(np.mean([d.k1 for d in found])), "c": float(np.mean([d.c for d in found]))} if found else {}


def _rough(experiments: Sequence[Any], rig: Rig) -> Values:
    """Estimate k1 = m1 (Omega_o^2 + gamma^2) and c = 2 m1 gamma without bias; gamma = delta Omega_o / 2 pi."""
    decays = [e.paper_decrement() for e in experiments]
    found = [(d.Omega_o, d.delta * d.Omega_o / (2.0 * np.pi)) for d in decays if d is not None and d.delta > 0.0]
    if not found or rig.m1 is None:
        return {}
    return {
        "k1": float(np.mean([rig.m1.value * (Omega_o**2 + gamma**2) for Omega_o, gamma in found])),
        "c": float(np.mean([2.0 * rig.m1.value * gamma for _, gamma in found])),
    }


TEMPLATE = """\
#: Free vibration of the rod on its spring: k1 and c. Columns: time [s], and x_rel [mm] (positive towards the support
#: spring), velocity [m/s] or acceleration [m/s^2] (g_n: standard gravity) of the rod, or several of them.
# [[experiment]]
# kind = "free_vibration"
# file = "free_vibration_1.csv"
#: the part of the record that is free decay; default: from the release, where rest before it is found, to the end
# start = { value = 0.0, unit = "s" }
# stop = { value = 0.5, unit = "s" }
#: "held" (default) or "free"
# capsule = "held"
#: "viscous" (default); "dry", "quadratic" or a list of them add to the viscous damping: F_dry, c_q
# damping = ["viscous", "dry"]
#: "linear" (default) or "cubic": force k1 x_rel + k_cubic x_rel^3
# stiffness = "linear"
#: drift of the zero: "none" (default), "linear", or "gp", a slow Gaussian process; both are integrated out
# drift = "none"
#: "white" (default), "ar1" (correlated, one correlation time) or "arma" (correlated and white). The last two include
#: stated reading errors
# noise = "white"
#: fit means of so many consecutive samples; default: 1 for records of up to 2000 samples, longer ones keep about 32
#: means per period
# thin = 1
#: "record" (default), or "turning_points": a row per turning point. Those of one side are amplitudes about the rest
#: position
# samples = "record"
#: "closed" form (default), or the "capsule" model: a free capsule may slip, and the rod may hit the support spring
# forward = "closed"
# slope = { value = 0, unit = "deg" }                   # and N0: default those of [rig]
# N0 = { value = 0, unit = "N" }
#: window of the Savitzky-Golay filter for the paper's estimate; default: chosen from the record
# smoothing_window = { value = 10, unit = "ms" }
# x_rel_sd = { value = 0.02, unit = "mm" }
#: a support spring within reach: both of spring = "L60" and gap = { value = 1.0, sd = 0.02, unit = "mm" }
"""


KIND = Kind(
    name="free_vibration",
    columns={
        "time": ColumnRule("s", increasing=True),
        "x_rel": ColumnRule("m", varies=True),
        "velocity": ColumnRule("m/s", varies=True),
        "acceleration": ColumnRule("m/s^2", varies=True),
    },
    sets=(("time",),),
    channels=tuple(CHANNELS),
    settings=DecaySettings,
    rules=(
        Entry.check_spring_with_gap,
        check_ground,
        _check_channels,
        _check_window,
        _check_forward,
        _check_turning_points,
        check_thin,
    ),
    masses=_masses,
    parameters=(
        *(channel.noise for channel in CHANNELS.values()),
        TIME_SD,
        AMPLITUDE,
        TURNING_TIME,
        NOISE_TIME,
        WHITE_RATIO,
        DRIFT_RATIO,
        DRIFT_TIME,
    ),
    make=_make,
    check=_check_swings,
    template=TEMPLATE,
    informs="k1, c",
    captions={"free_vibration": "Free decay: the record, its residuals at the point fit, and their autocorrelation."},
    messages=MESSAGES,
    lint=(lint_decay,),
    paper=_paper,
    rough=_rough,
    twin=measure,
)
