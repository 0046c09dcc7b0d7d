"""Progressions: columns, settings, sessions, rules, template and texts."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Annotated, Any, Literal

import numpy as np
from jaxtyping import Float, Int

from capsule_id.experiments.forced_run.declaration import SQUARE, DriveRule, check_drive, lacks, present, stated
from capsule_id.experiments.kind import Kind, made_by
from capsule_id.experiments.lint import USUAL_PERIODS
from capsule_id.parameters import Prior, nuisance, scatter
from capsule_id.rig.model import Column, Quantity, Rig, Table
from capsule_id.rig.schema import ColumnRule, GroundSettings, QuantityRule
from capsule_id.rig.toml import ANY, NOT_NEGATIVE, PERIODS, POSITIVE, SHARE
from capsule_id.views import Finding, Message

# outliers: Outlying trials of a progression with ``tails = "heavy"``: which trial of a setting has the larger scatter.
#
# Each trial has ``TIMES`` the scatter with probability ``SHARE``, independently of the others: a contaminated
# normal distribution (Tukey 1960), here given that a setting has at most one such trial. No outlying trial, or one
# of them: these are the alternatives of a setting, and their densities are added.


#: Probability that a trial is outlying, and its scatter relative to that of the others.
OUTLIER_SHARE, TIMES = 0.05, 10.0
#: Most trials of a setting: among more of them, several would be outlying.
MOST_TRIALS = 12


def alternatives(
    setting: Float[np.ndarray, "n settings"], heavy: bool
) -> tuple[Float[np.ndarray, "alternatives n"], Float[np.ndarray, " alternatives"], Int[np.ndarray, " alternatives"]]:
    """Variance of every trial relative to the usual one, log-probability within the setting, and setting of each.

    The first alternative of a setting has no outlying trial, and is the only one where the tails are not ``heavy``.
    """
    variance, log_share, of = list[np.ndarray](), list[float](), list[int]()
    for b, own in enumerate(setting.T):
        trials = np.flatnonzero(own) if heavy else np.array([], dtype=int)
        odds = np.append(1.0, np.full(len(trials), OUTLIER_SHARE / (1.0 - OUTLIER_SHARE)))
        log_share += np.log(odds / np.sum(odds)).tolist()
        variance += [np.ones(len(setting)), *(np.where(np.arange(len(setting)) == i, TIMES**2, 1.0) for i in trials)]
        of += [b] * (1 + len(trials))
    return np.array(variance), np.array(log_share), np.array(of)


# declaration: Progressions: columns, settings, rules, template and texts.


SESSION_SD = scatter(
    "session_sd", "1", "relative scatter of the friction from session to session", r"\sigma_\mathrm{ses}",
    Prior("halfnormal", 0.0, 0.1),
)  # fmt: skip
TRIAL_SCATTER = scatter(
    "trial_scatter", "1", "relative scatter of the displacement of a trial", r"s_\mathrm{trial}",
    Prior("halfnormal", 0.0, 0.1),
)  # fmt: skip
#: Sessions that are parameters, in the order of the numbers in the column; no table has more of them.
SESSIONS = tuple(
    nuisance(
        f"session_{j}", "1", f"friction of session {j} with several settings: its logarithm over session_sd", f"z_{j}",
        Prior("normal", 0.0, 1.0),
    )
    for j in range(1, 9)
)  # fmt: skip
#: These two have priors from the readings.
TRIAL_SD = scatter("trial_sd", "m", "absolute scatter of the displacement of a trial", r"\sigma_\mathrm{trial}")
DISCREPANCY = scatter("discrepancy", "m/s", "error of the model's mean velocity at a setting", r"\delta_v")

#: Amplitude column of each drive; ``current`` times K is another amplitude of both.
AMPLITUDE = {"pulses": "P_on", "square": "P_on", "harmonic": "P_d"}
#: Fewest settings of a table that show more than their own scatter.
FEWEST_SETTINGS = 6


@dataclass(frozen=True, kw_only=True)
class ProgressionSettings(GroundSettings):
    """Settings of a progression, SI.

    ``P_on``, ``P_d`` and ``lag`` with an sd are fitted, with value and sd as prior; without an sd they are fixed.
    With heavy ``tails`` a trial may be outlying.
    """

    drive: Literal["pulses", "square", "harmonic"] = "pulses"
    P_on: Annotated[Quantity | None, QuantityRule("N", ANY, has_sd=True)] = None
    P_d: Annotated[Quantity | None, QuantityRule("N", ANY, has_sd=True)] = None
    lag: Annotated[Quantity | None, QuantityRule("s", NOT_NEGATIVE, has_sd=True)] = None
    tails: Literal["normal", "heavy"] = "normal"


def _amplitudes(settings: ProgressionSettings, columns: Mapping[str, Column]) -> str:
    """The stated amplitudes of the drive, where there is not exactly one."""
    own = AMPLITUDE[settings.drive]
    stated = [name for name in (own, "current") if name in columns]
    stated += [f"the setting {own}"] if getattr(settings, own) is not None else []
    return "" if len(stated) == 1 else " and ".join(stated) or "none"


def _crowded(settings: ProgressionSettings, columns: Mapping[str, Column]) -> str:
    """The largest number of trials that share a setting, where any of them may be outlying and there are too many."""
    most = int(np.max(np.unique(settings_of(columns, settings)[0], axis=0, return_counts=True)[1]))
    return f"{most} trials" if settings.tails == "heavy" and most > MOST_TRIALS else ""


_DUTY = "pulses need a column duty, and a harmonic drive has none"
#: One amplitude that belongs to the drive, a duty with pulses, and few trials that share a setting with heavy tails.
DRIVE_RULES = (
    *(
        DriveRule(
            (drive,), lambda settings, columns, other=other: getattr(settings, other) is not None or other in columns,
            "drive", f'drive = "{drive}" has the amplitude {own}', other, f"rename {other} to {own}, or correct the drive",
        )
        for drive, own in AMPLITUDE.items()
        for other in {*AMPLITUDE.values()} - {own}
    ),
    DriveRule(("pulses",), lacks("duty"), "drive", _DUTY, "{columns}", "add the column duty"),
    DriveRule(("harmonic",), present("duty"), "drive", _DUTY, "{columns}", "remove the column duty"),
    DriveRule(("harmonic",), stated("lag"), "lag", "a harmonic drive has no lag", "lag", "remove lag", of_key=True),
    *(
        DriveRule(
            (drive,), _amplitudes, "",
            f"a progression must have one amplitude: a column {own} or current, or the setting {own}", "{found}",
            f'state {own} = {{{{ value = ..., sd = ..., unit = "N" }}}} and nothing else',
        )
        for drive, own in AMPLITUDE.items()
    ),
    DriveRule(
        tuple(AMPLITUDE),
        lambda settings, columns: next((f"{name}_sd" for name, c in columns.items() if c.sd and name != "distance"), ""),
        "{found}", "{found} has no effect: the fit takes what drives a trial as exact",
        "{columns}", "remove it; an uncertain amplitude is a setting with an sd, in the place of its column", of_key=True,
    ),
)  # fmt: skip
TAIL_RULE = DriveRule(
    tuple(AMPLITUDE), _crowded, "tails", f"heavy tails need at most {MOST_TRIALS} trials at each setting", "{found}",
    "remove tails; the fit names outlying rows", of_key=True,
)  # fmt: skip


def _lint_settings(table: Table[Any], rig: Rig) -> Iterable[Finding]:
    """Warn where a table has few settings, or more sessions with several settings than there are parameters for."""
    drives = np.delete(settings_of(table.columns, table.settings)[0], 1, axis=1)
    setting = np.unique(drives, axis=0, return_inverse=True)[1]
    settings = 1 + int(np.max(setting))
    if settings < FEWEST_SETTINGS:
        facts = {"settings": settings, "wanted": FEWEST_SETTINGS}
        yield Finding("progression.settings", "warn", facts, table.label)
    if "session" in table.columns:
        pairs = np.unique(np.stack([table["session"], setting], axis=1), axis=0)
        several = int(np.sum(np.unique(pairs[:, 0], return_counts=True)[1] > 1))
        if several > len(SESSIONS):
            yield Finding("progression.sessions", "warn", {"several": several, "most": len(SESSIONS)}, table.label)


TEMPLATE = """\
#: Progression, a row per trial: the displacement of the capsule after a number of drive periods from rest. Columns:
#: period [ms] or f [Hz]; periods [1]; distance [cm]; duty [%] with pulses, and optionally a square wave; session [1]
#: optional. The amplitude is a column P_on [N] (harmonic: P_d [N]) or current [A], or a setting with its prior. It may be
#: negative. lag too.
#: Without a column session every block of consecutive rows with equal settings is a session.
# [[experiment]]
# kind = "progression"
# file = "progression.csv"
# drive = "pulses"                                    # "harmonic", or "square": P_on and -P_on in turn
# P_on = { value = 1.25, sd = 0.5, unit = "N" }
# lag = { value = 5, sd = 2, unit = "ms" }
# tails = "normal"                                    # or "heavy": one trial of a setting may be outlying
# distance_sd = { value = 1, unit = "mm" }
# slope = { value = 0, unit = "deg" }                   # this one alone; default: [rig]
# N0 = { value = 0, unit = "N" }
"""

_SIZES = (
    "the discrepancy of the mean velocity is {size:.2g} mm/s, the scatter of a trial {scatter:.2g} mm/s, "
    "the rms {rms:.2g} mm/s"
)

MESSAGES = {
    "progression.discrepancy": Message(
        "discrepancy of the model",
        ok=_SIZES,
        warn=(
            _SIZES
            + ": the model leaves more than the trials scatter. The intervals and predictions include it; compare other models "
            "with --compare friction,reaction,lag,cubic."
        ),
        fail=(
            _SIZES
            + ". Expected a model that explains most of the motion; its parameters have no meaning here. Check reaction, the "
            "sign and size of the amplitude and the units, or compare models with --compare friction,reaction,lag,cubic."
        ),
    ),
    "progression.sessions": Message(
        "sessions",
        warn="{several:# session} with several settings, and only {most} of them have their friction as a parameter. The "
        "fit takes each remaining session for a new one at every setting, so that intervals are too narrow: write one "
        "table and one entry for each day or location",
        caption=(
            "Sessions with several settings: the parameter of each one, its number in the file, how many settings and trials "
            "it has, and its friction relative to that of an average session."
        ),
    ),
    "progression.settings": Message(
        "settings",
        warn="{settings:# setting} of the drive, and {wanted} or more are wanted to test the model: vary period or duty",
    ),
}

KIND = Kind(
    name="progression",
    columns={
        "period": ColumnRule("s", POSITIVE, usual=USUAL_PERIODS),
        "f": ColumnRule("Hz", POSITIVE),
        "duty": ColumnRule("1", SHARE),
        "P_on": ColumnRule("N"),
        "P_d": ColumnRule("N"),
        "current": ColumnRule("A"),
        "periods": ColumnRule("1", PERIODS, usual=(1.0, 1e4)),
        "distance": ColumnRule("m", usual=(1e-3, 20.0)),
        "session": ColumnRule("1", usual=(1.0, 1e9)),
    },
    sets=(("period", "periods", "distance"), ("f", "periods", "distance")),
    optional=("duty", "P_on", "P_d", "current", "session"),
    settings=ProgressionSettings,
    rules=(partial(check_drive, DRIVE_RULES), partial(check_drive, (TAIL_RULE,))),
    masses=lambda table: ("m1", "m2"),
    parameters=(SESSION_SD, *SESSIONS, TRIAL_SCATTER, TRIAL_SD, DISCREPANCY),
    bench=False,
    test="trial",
    minutes=0.5,
    make=made_by("capsule_id.experiments.progression.experiment:Progression"),
    template=TEMPLATE,
    informs="k1, c, mu, P_on, lag",
    captions={
        "progression": "Mean velocity of the capsule at each setting: trials, the fit, and the 95 % band of a new trial "
        "in a new session."
    },
    messages=MESSAGES,
    lint=(_lint_settings,),
)


# trials: Settings and sessions of the rows of a progression.


def settings_of(columns: Mapping[str, Column], settings: ProgressionSettings) -> tuple[np.ndarray, str]:
    """(n, 4) period, s, number of periods, duty and amplitude of every row; where the amplitude comes from.

    The amplitude is from a "column" (N) or a "current" (A), or from a "setting"; it is 1 in the last case.
    """
    values = {name: column.values for name, column in columns.items()}
    period = values["period"] if "period" in values else 1.0 / values["f"]
    one = np.ones(len(period))
    own = AMPLITUDE[settings.drive]
    source = next((name for name in (own, "current") if name in columns), None)
    kind = {own: "column", "current": "current"}.get(source or "", "setting")
    amplitude = one if source is None else values[source]
    # A square wave has its two signs for equal times where no duty is stated.
    duty = values.get("duty", 0.5 * one if settings.drive == SQUARE else one)
    return np.stack([period, values["periods"], duty, amplitude], axis=1), kind


def sessions_of(table: Table, rows: np.ndarray) -> np.ndarray:
    """(n, sessions) membership: by the column, else blocks of consecutive rows with equal settings."""
    index = (
        np.unique(table["session"], return_inverse=True)[1]
        if "session" in table.columns
        else np.cumsum(np.concatenate([[0], np.any(rows[1:] != rows[:-1], axis=1)]))
    )
    return np.eye(int(np.max(index)) + 1)[index]
