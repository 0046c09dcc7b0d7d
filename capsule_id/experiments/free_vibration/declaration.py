"""Free vibration: columns, settings, rules, template, lint, the paper's estimates and the twin."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from capsule_id.errors import InputError
from capsule_id.experiments.free_vibration.decrement import (
    SLOWEST,
    STRONGEST,
    likelihood_gain,
    swings_enough,
    viscous_basis,
    viscous_fit,
)
from capsule_id.experiments.free_vibration.lint import MESSAGES, lint_decay
from capsule_id.experiments.free_vibration.readings import (
    CHANNELS,
    WIDE,
    DecayModel,
    DecaySettings,
    block_size,
    channel_of,
    cut_at_release,
    decay_window,
    divide_at_releases,
    first_periods,
)
from capsule_id.experiments.kind import Kind, Twin, TwinTable, Values, made_by
from capsule_id.parameters import Parameter, Prior, nuisance, scatter
from capsule_id.records.release import shortened
from capsule_id.records.tones import FEWEST_IN_PERIOD
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
    decays = [decay(rng, values["k1"], values["c"], values["m1"], release, DECAY_NOISE) for release in RELEASES]
    return Twin(tuple(TwinTable(f"free_vibration_{n}.csv", columns) for n, columns in enumerate(decays, start=1)))


def decay(
    rng: np.random.Generator, k1: float, c: float, m1: float, release: float, relative_sd: float
) -> dict[str, np.ndarray]:
    """Simulate 0.5 s of a decay from rest at ``release`` m, at 2 kHz; the noise sd is ``relative_sd`` of the release."""
    time = np.arange(1000) / 2000.0
    x = release * viscous_basis(time, k1, c, m1, np)[:, 0]
    return {"time [s]": time, "x_rel [mm]": 1e3 * (x + relative_sd * release * rng.standard_normal(time.size))}


# declaration: Free vibration: columns, settings, rules, template, lint and the paper's estimates.


#: Twice the log-likelihood ratio beyond which one description of a stroke is better than another. A stroke that friction
#: ends gained 6.5 or more in 120 records of such rods, with noise of 0.1 to 3 %, and at most 0.5 in 99 % of 301 viscous ones
#: (the largest: 6.3).
BETTER = 6.0
NOISE_SD = CHANNELS["x_rel"].noise
TIME_SD = scatter("time_sd", "s", "noise of the times of turning points", r"\sigma_t")
AMPLITUDE = nuisance("amplitude", "m", "first turning point of a decay", "a_0")
NOISE_TIME = Parameter("noise_time", "s", "correlation time of a record's noise", r"\tau", physical=False)
WHITE_RATIO = Parameter(
    "white_ratio", "1", "white noise over correlated noise", "w", Prior("lognormal", 1.0, WIDE), physical=False
)
DRIFT_RATIO = Parameter(
    "drift_ratio", "1", "drift over noise of a record", "d", Prior("lognormal", 3.0, WIDE), physical=False
)
DRIFT_TIME = Parameter("drift_time", "s", "correlation time of a record's drift", r"\tau_d", physical=False)
TURNING_TIME = nuisance("turning_time", "s", "time of the first turning point of a decay", "t_0")


def _faults(entry: Entry[DecaySettings]) -> Iterator[tuple[Any, ...]]:
    """Rows of what settings and channels must not state: whether they do, and the arguments of ``Entry.error``.

    A row is made when those before it hold no fault.
    """
    table, settings, model = entry.table, entry.table.settings, DecayModel.stated(entry.table.settings)
    names = " ".join(sorted(set(CHANNELS).intersection(table.columns)))
    capsule, points = settings.forward == "capsule", settings.samples == "turning_points"
    yield from (
        (stated and names != "x_rel", key, f"{key} = {words} needs x_rel and no other channel", names, "map x_rel only")
        for key, stated, words in (("samples", points, '"turning_points"'), ("forward", capsule, '"capsule"'))
    )
    entry.check_length()
    time = table["time"]
    step = median_step(time)  # the stated duration of n samples is often n steps, one more than the record has
    stated = {key: value for key in ("start", "stop") if (value := getattr(settings, key)) is not None}
    span = f"write a time from {time[0]:g} to {time[-1]:g} s"
    yield from (
        (not time[0] - step <= value <= time[-1] + step, key, f"{key} must lie inside the record", f"{value:g} s", span)
        for key, value in stated.items()
    )
    start, stop = ({"start": time[0], "stop": time[-1]} | stated).values()
    place, inside = "start" if settings.stop is None else "stop", len(decay_window(table)[0])
    rule = f"at least {SHORTEST_RECORD} samples must lie between start and stop"
    yield from (
        (start >= stop, place, "start must be before stop", f"{start:g} s and {stop:g} s", "correct one of them"),
        (inside < SHORTEST_RECORD, place, rule, counted(inside, "sample"), "widen the window"),
        (
            capsule and settings.capsule == "held",
            "forward",
            "forward capsule needs a capsule that is free to move",
            "held",
            'add capsule = "free", or write forward = "closed" where the capsule was held',
        ),
        (
            capsule and (model != DecayModel() or points),
            "forward",
            "forward capsule has viscous damping, a linear spring and white noise only",
            model.name,
            'write forward = "closed", or remove damping, stiffness, drift, noise, hum and thin',
        ),
        *(
            (
                points and getattr(settings, key) not in (None, default),
                key,
                "turning points have white noise and no drift or hum, and each of them counts",
                str(getattr(settings, key)),
                f"remove {key}, or samples",
                True,
            )
            for key, default in (("drift", "none"), ("noise", "white"), ("thin", 1), ("hum", None))
        ),
    )
    thin = settings.thin or 1
    if thin > 1:
        size = block_size(*decay_window(table), FEWEST_IN_PERIOD)
        most = min(inside // SHORTEST_RECORD, max(size, 2))
        rule = f"thin must leave {SHORTEST_RECORD} means of the record and {FEWEST_IN_PERIOD} means in a period"
        remedy = f"write thin = {most} or less" if most > 1 else "remove thin"
        yield thin > most, "thin", rule, f"{thin} of {counted(inside, 'sample')}", remedy


def _check_settings(entry: Entry[DecaySettings]) -> None:
    """Refuse a slope that the closed form does not have, and the first of ``_faults``.

    A slope of a held capsule shifts the rest position alone.
    """
    settings = entry.table.settings
    for stated, key, rule in (
        (settings.stiffness == "cubic", "slope", "a decay with a cubic spring must be on level ground"),
        *(
            (
                settings.capsule == "free",
                key,
                f'the closed form of a free capsule has no {key}; forward = "capsule" has',
            )
            for key in ("slope", "N0")
        ),
    ):
        if stated and settings.forward == "closed":
            entry.refuse_ground(key, rule)
    for stated, *words in _faults(entry):
        if stated:
            raise entry.error(*words)


#: Largest distance of an interval between turning points from a multiple of the median one, relative to that.
UNEQUAL = 0.25


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
        if likelihood_gain(fit, viscous_fit(time, values, 3, CHANNELS[channel].order)) > BETTER:
            value = f"one stroke of {len(values)} samples: dry friction holds the rod, or its release was slow"
            raise InputError(
                rule, value, "release it at once, from a larger deflection, or reduce the friction", *place
            )
        alone = likelihood_gain(viscous_fit(time, values, 1), fit) < 2.0 * BETTER
        if alone or fit.omega * np.ptp(time) < SLOWEST:
            remedy = (
                'where each row is a turning point, state samples = "turning_points"; else record from the release on, with '
                "at least 10 samples before the rod is at half its deflection"
            )
            shown = "one exponential in {}, which gives c/k1 alone" if alone else "no return to rest in {}"
            raise InputError(rule, shown.format(f"{len(values)} samples"), remedy, *place)
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
    record = table.settings.samples == "record"
    make = made_by(
        f"capsule_id.experiments.free_vibration.{'experiment:FreeVibration' if record else 'turning_points:TurningPoints'}",
        capsule="capsule_id.experiments.capsule_experiment:CapsuleDecay",
    )
    table = cut_at_release(table)
    if DecayModel.stated(table.settings).slow and record:
        table = first_periods(table)
    # The fit of each channel has initial conditions of its own, which loses little.
    parts = [
        replace(
            table,
            columns={own: table.columns[own] for own in ("time", name)},
            label=table.label if name == channel_of(table) else f"{table.label}_{name}",
        )
        for name in CHANNELS
        if name in table.columns
    ]
    return tuple(e for part in parts for e in make(part, rig, friction))


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
#: in place of start and stop: releases = "all" or numbers such as [1, 3]: each of several releases in one record
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
#: frequency of hum of constant amplitude beside the decay, integrated out; default: found in the record
# hum = { value = 50, unit = "Hz" }
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
#: a support spring within reach: both of spring = "L60" and gap = { value = 1.0, sd = 0.02, unit = "mm" }; one behind the
#: rod: spring_back and gap_back
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
    divide=divide_at_releases,
    rules=(
        Entry.check_springs_with_gaps,
        _check_settings,
    ),
    # The rod, and the capsule where it may move.
    masses=lambda table: (
        ("m1", "m2") if table.settings.capsule == "free" or table.settings.forward == "capsule" else ("m1",)
    ),
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
    test="free_vibration",
    minutes=3.0,
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
