"""What a rig folder may say: every kind of experiment with its columns and settings, as data.

One reader (``read.py``, ``tables.py``) interprets these declarations; a new kind
needs an entry here, and in ``rules.py`` what ties its settings together.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from math import inf, pi

import numpy as np

from capsule_id.parameters import TABLE

NAME_PATTERN = r"[A-Za-z0-9._-]+"
SHORTEST_RECORD = 8  # samples: six unknowns of a free decay (k1, c, amplitude, phase, offset, noise) and two to spare


@dataclass(frozen=True)
class Domain:
    """An interval that SI values must lie in; ``text`` continues "<name> must ..."."""

    text: str
    low: float = -inf
    high: float = inf
    low_allowed: bool = False

    def holds(self, values: np.ndarray | float) -> np.ndarray:
        """Elementwise: inside?"""
        values = np.asarray(values)
        return ((values >= self.low) if self.low_allowed else (values > self.low)) & (values < self.high)


ANY = Domain("be a finite number")
POSITIVE = Domain("be greater than 0", low=0.0)
NOT_NEGATIVE = Domain("be 0 or greater", low=0.0, low_allowed=True)
ABOVE_ONE = Domain("be greater than 1", low=1.0)
SLOPE_ANGLE = Domain("lie between 0 and 90 deg", low=0.0, high=pi / 2)


@dataclass(frozen=True)
class ColumnRule:
    """A column: its SI unit, its domain, and whether it must increase row by row or at least vary."""

    si: str
    domain: Domain = ANY
    increasing: bool = False
    varies: bool = False


@dataclass(frozen=True)
class QuantityRule:
    """A setting ``{ value = ..., unit = ... }``; with ``has_sd`` it takes ``sd`` too and becomes a ``Quantity``."""

    si: str
    domain: Domain = POSITIVE
    has_sd: bool = False


@dataclass(frozen=True)
class ChoiceRule:
    """A setting that is one of a few words; the first is the default where ``has_default``."""

    choices: tuple[str, ...]
    has_default: bool = True


@dataclass(frozen=True)
class NameRule:
    """A setting that is a name: letters, digits, dot, underscore, hyphen."""


SettingRule = QuantityRule | ChoiceRule | NameRule


@dataclass(frozen=True)
class KindRule:
    """One kind of experiment.

    Attributes
    ----------
    columns : every column that the file may have
    sets : the file must have exactly one of these sets of columns (and any of ``channels``)
    channels : of these at least one, where there are any
    settings : every setting that the entry may have
    required : settings that it must have
    """

    columns: Mapping[str, ColumnRule]
    sets: tuple[tuple[str, ...], ...]
    channels: tuple[str, ...] = ()
    settings: Mapping[str, SettingRule] = field(default_factory=dict)
    required: tuple[str, ...] = ()


_TIME = ColumnRule("s", increasing=True)
_FORWARD = ChoiceRule(("closed", "capsule"))
_CHANNELS = ("x_rel", "x_capsule", "acceleration_rod", "current")
_GAP = QuantityRule("m", NOT_NEGATIVE, has_sd=True)

KINDS: Mapping[str, KindRule] = {
    "free_vibration": KindRule(
        columns={"time": _TIME, "x_rel": ColumnRule("m", varies=True)},
        sets=(("time", "x_rel"),),
        settings={
            "start": QuantityRule("s", ANY),
            "stop": QuantityRule("s", ANY),
            "capsule": ChoiceRule(("held", "free")),
            "damping": ChoiceRule(("viscous", "dry", "quadratic")),
            "smoothing_window": QuantityRule("s"),
            "spring": NameRule(),
            "gap": _GAP,
            "forward": _FORWARD,
        },
    ),
    "static_friction": KindRule(
        columns={
            "angle": ColumnRule("rad", SLOPE_ANGLE),
            "height": ColumnRule("m", POSITIVE),
            "length": ColumnRule("m", POSITIVE),
        },
        sets=(("angle",), ("height", "length")),
        settings={"length_is": ChoiceRule(("board", "base"), has_default=False)},
    ),
    "dynamic_friction": KindRule(
        columns={"speed": ColumnRule("m/s", POSITIVE), "distance": ColumnRule("m", POSITIVE)},
        sets=(("speed", "distance"),),
        settings={"forward": _FORWARD},
    ),
    "sliding_friction": KindRule(
        columns={
            "speed": ColumnRule("m/s", POSITIVE),
            "force": ColumnRule("N", POSITIVE),
            "coefficient": ColumnRule("1", POSITIVE),
        },
        sets=(("speed", "force"), ("speed", "coefficient")),
    ),
    "motor_current": KindRule(
        columns={"force": ColumnRule("N", varies=True), "current": ColumnRule("A", varies=True)},
        sets=(("force", "current"),),
        settings={"sd_ratio": QuantityRule("N/A")},
    ),
    "support_spring": KindRule(
        columns={"deflection": ColumnRule("m", varies=True), "force": ColumnRule("N", varies=True)},
        sets=(("deflection", "force"),),
        settings={"spring": NameRule(), "length": QuantityRule("m", has_sd=True), "sd_ratio": QuantityRule("N/m")},
        required=("spring",),
    ),
    "forced_run": KindRule(
        columns={
            "time": _TIME,
            "x_rel": ColumnRule("m", varies=True),
            "x_capsule": ColumnRule("m"),  # may be constant: a capsule that never leaves its place is a result
            "acceleration_rod": ColumnRule("m/s^2", varies=True),
            "current": ColumnRule("A", varies=True),
        },
        sets=(("time",),),
        channels=_CHANNELS,
        settings={
            "spring": NameRule(),
            "gap": _GAP,
            "Omega": QuantityRule("rad/s"),
            "f": QuantityRule("Hz"),
            "P_d": QuantityRule("N", has_sd=True),
            "start": ChoiceRule(("auto", "stuck", "moving", "settled")),
            "noise": ChoiceRule(("white", "ar1")),
            "segment": QuantityRule("s"),
            **{f"{name}_gain_sd": QuantityRule("1") for name in _CHANNELS},
            **{f"{name}_delay_sd": QuantityRule("s") for name in _CHANNELS},
        },
        required=("spring", "gap"),
    ),
}

# [rig]: quantities by key
RIG_QUANTITIES: Mapping[str, QuantityRule] = {
    "m1": QuantityRule("kg", has_sd=True),
    "m2": QuantityRule("kg", has_sd=True),
    "g": QuantityRule("m/s^2", has_sd=True),
}

# [prior]: SI unit by key; "k2[<spring>]" has the unit of "k2"
_STATED = [row for row in TABLE.values() if row.prior_can_be_stated]
LOG_NORMAL_PRIORS: Mapping[str, str] = {row.symbol: row.unit for row in _STATED if not row.scatter}
HALF_NORMAL_PRIORS: Mapping[str, str] = {row.symbol: row.unit for row in _STATED if row.scatter}
