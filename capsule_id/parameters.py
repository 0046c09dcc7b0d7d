"""The parameter table: symbol, unit, meaning, LaTeX label, default prior, sign, and which field of the capsule or
of a drive it is.

Priors, engines, command options, sweeps, axes, report and guide read it. A kind of experiment declares parameters of
its own (``capsule_id.experiments``). The *name* of a parameter is its symbol; a bracket names the spring or record, as
in ``k2[soft]`` or ``noise_sd[free_vibration_1]``. Positive parameters are sampled through their logarithm.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import NormalDist
from typing import Any, Literal, NamedTuple, TypeVar

import numpy as np

from capsule_id.errors import InputError

Value = TypeVar("Value")

#: Ends of the intervals that are quoted: a log-normal prior holds 95 % of its mass within median/factor .. median*factor.
ENDS = (0.025, 0.975)
QUANTILE_975 = NormalDist().inv_cdf(ENDS[1])
#: Standard deviation of the rounding error of a reading, in steps.
STEP_SD = float(1.0 / np.sqrt(12.0))
#: Factor of the prior of a parameter of which nothing is known.
VAGUE = 1000.0
#: Relative difference below which numbers of two programs are the same, and largest rounding error of a computed number.
SAME, ROUNDING = 1e-9, 1e-12
#: Longest period of a motion that is looked for, excitation periods, and largest advance of a standing capsule in one, m.
LONGEST_PERIOD, STANDING = 16, 1e-7
#: Gap and drive of the paper's Fig. 6, and k2 of its springs, SI.
FIG_6: Mapping[str, float] = {"G": 1e-3, "P_d": 4.0, "Omega": 34.56}
SPRINGS: Mapping[str, float] = {"soft": 2420.0, "medium": 18960.0, "stiff": 56410.0}


@dataclass(frozen=True)
class Prior:
    """A proper prior density.

    ``lognormal``: ``location`` the median, ``spread`` the factor. ``halfnormal``: ``spread`` the scale.
    ``positive_normal``: a weighing, mean and sd, restricted to positive values. ``normal``: mean and sd.
    """

    kind: Literal["lognormal", "halfnormal", "positive_normal", "normal"]
    location: float
    spread: float

    @property
    def median(self) -> float:
        """SI; of a weighing without its restriction to positive values."""
        return self.spread * NormalDist().inv_cdf(0.75) if self.kind == "halfnormal" else self.location

    def sample(self, rng: np.random.Generator, size: int) -> np.ndarray:
        """Draw ``size`` independent values, SI."""
        if self.kind == "lognormal":
            return self.location * np.exp(np.log(self.spread) / QUANTILE_975 * rng.standard_normal(size))
        if self.kind == "halfnormal":
            return np.abs(self.spread * rng.standard_normal(size))
        if self.kind == "positive_normal":
            from scipy import stats

            low = -self.location / self.spread
            return self.location + self.spread * stats.truncnorm(low, np.inf).rvs(size, random_state=rng)
        return self.location + self.spread * rng.standard_normal(size)

    def describe(self) -> str:
        """One phrase for tables, SI."""
        return {
            "lognormal": f"log-normal, median {self.location:g}, factor {self.spread:g}",
            "halfnormal": f"half-normal, scale {self.spread:g}",
            "positive_normal": f"weighed: {self.location:g} ± {self.spread:g}",
            "normal": f"normal, {self.location:g} ± {self.spread:g}",
        }[self.kind]


class Name(NamedTuple):
    """Name of a parameter in its parts, ``k2[soft]`` as text; ``of`` is the spring or record, "" for one of the rig."""

    symbol: str
    of: str = ""

    def __str__(self) -> str:
        return f"{self.symbol}[{self.of}]" if self.of else self.symbol

    @classmethod
    def parse(cls, text: str) -> "Name":
        """``k2[soft]`` -> ``Name("k2", "soft")``."""
        symbol, _, of = text.partition("[")
        return cls(symbol, of.removesuffix("]"))


def by_index(symbol: str, values: Mapping[str, Value]) -> dict[str, Value]:
    """Values of one symbol by spring or record: {"soft": 2420.0} of {"k2[soft]": 2420.0, "mu": 0.66}."""
    names = {name: Name.parse(name) for name in values}
    return {own.of: values[name] for name, own in names.items() if own.symbol == symbol and own.of}


@dataclass(frozen=True)
class Parameter:
    """One row of the table.

    Attributes
    ----------
    prior : the default; None if the experiment or the weighing supplies it
    physical : a property of the rig; otherwise a nuisance of one record or table
    of : name of the spring or record, or ""
    leaf : a field of ``CapsuleParameters`` ("capsule") or of a drive ("drive")
    sign : the sign that the model admits
    scatter : a standard deviation, absolute or relative; it scales residuals and changes no prediction
    sampled : False for constants, which a fit never samples
    may_be_infinite : True where infinity is a value: a gap that is never closed
    default : value of the model where none is given, SI, or the symbol of the parameter that it equals then; None: a
        value must be given. A fit samples a row with a default and a prior where ``[model] free`` names it
    table_1 : the paper's value (Table 1), SI
    """

    symbol: str
    unit: str
    meaning: str
    latex: str
    prior: Prior | None = None
    physical: bool = True
    of: str = ""
    leaf: Literal["capsule", "drive"] | None = None
    sign: Literal["positive", "not negative", "any"] = "positive"
    scatter: bool = False
    sampled: bool = True
    table_1: float | None = None
    default: float | str | None = None
    may_be_infinite: bool = False

    @property
    def name(self) -> str:
        return str(Name(self.symbol, self.of))

    @property
    def key(self) -> str:
        """How an experiment knows its value: by symbol, or by name where it may have several of this symbol."""
        return self.name if self.symbol in INSTRUMENT_ERRORS else self.symbol

    @property
    def label(self) -> str:
        """LaTeX label with the bracket as a subscript text."""
        return f"${self.latex}$ [{self.of}]" if self.of else f"${self.latex}$"

    def named(self, of: str, prior: Prior | None = None) -> "Parameter":
        """The row for one spring or record, with another prior if given."""
        return replace(self, of=of, prior=prior if prior is not None else self.prior)

    @property
    def positive(self) -> bool:
        """Whether it is sampled through its logarithm."""
        return self.prior is None or self.prior.kind != "normal"

    @property
    def prior_can_be_stated(self) -> bool:
        """Whether ``[prior]`` in rig.toml may override the default prior."""
        kind = None if self.prior is None else self.prior.kind
        return kind in ("lognormal", "halfnormal") or (kind == "normal" and self.physical)

    @property
    def prior_key(self) -> str:
        """Its key in ``[prior]``, as TOML; "" where no prior can be stated. Of bracketed names only k2 has one."""
        if not self.prior_can_be_stated or (self.of and self.symbol != "k2"):
            return ""
        return f'"{self.name}"' if self.of else self.name

    @property
    def optional(self) -> bool:
        """Whether a fit samples it only where ``[model] free`` names it."""
        return self.default is not None and self.prior is not None

    def describe_default(self) -> str:
        """The default in one phrase, SI."""
        return f"as {self.default}" if isinstance(self.default, str) else f"{self.default:g}"

    def admits(self, value: Any) -> Any:
        """Whether ``value`` is finite and has an admissible sign, elementwise; number, NumPy or JAX array."""
        bound = {"positive": value > 0.0, "not negative": value >= 0.0, "any": value > -np.inf}[self.sign]
        return bound if self.may_be_infinite else (abs(value) < np.inf) & bound


def _lognormal(median: float, factor: float = VAGUE) -> Prior:
    return Prior("lognormal", median, factor)


def nuisance(symbol: str, unit: str, meaning: str, latex: str, prior: Prior | None = None) -> Parameter:
    """A row for a nuisance of either sign; without ``prior`` the experiment supplies it."""
    return Parameter(symbol, unit, meaning, latex, prior, physical=False, sign="any")


def scatter(symbol: str, unit: str, meaning: str, latex: str, prior: Prior | None = None) -> Parameter:
    """A row for a standard deviation, absolute or relative; without ``prior`` the experiment supplies it."""
    return Parameter(symbol, unit, meaning, latex, prior, physical=False, scatter=True)


#: Prior of a coefficient of static friction, in either direction.
MU = _lognormal(0.4, 5.0)
TABLE: Mapping[str, Parameter] = {
    row.symbol: row
    for row in (
        Parameter("m1", "kg", "mass of the rod", "m_1", leaf="capsule", table_1=0.110),
        Parameter("m2", "kg", "mass of the capsule", "m_2", leaf="capsule", table_1=0.530),
        Parameter(
            "k1", "N/m", "stiffness between rod and capsule", "k_1", _lognormal(1500.0),
            leaf="capsule", sign="not negative", table_1=1420.0,
        ),
        Parameter(
            "k2", "N/m", "stiffness of the support spring", "k_2", _lognormal(20e3),
            leaf="capsule", sign="not negative",
        ),
        Parameter(
            "c", "N s/m", "viscous damping between rod and capsule", "c", _lognormal(4.0),
            leaf="capsule", sign="not negative", table_1=3.89,
        ),
        Parameter(
            "mu", "1", "static friction coefficient, eq. (1)", r"\mu", MU,
            leaf="capsule", sign="not negative", table_1=0.66,
        ),
        Parameter(
            "v_s", "m/s", "Stribeck velocity, eq. (1)", "v_s", _lognormal(0.3, 10.0), leaf="capsule", table_1=0.30
        ),
        Parameter(
            "mu_back", "1", "static friction coefficient of backward sliding", r"\mu_-", MU,
            leaf="capsule", sign="not negative", default="mu",
        ),
        Parameter(
            "ratio", "1", "kinetic over static friction", r"\rho", _lognormal(0.7, 2.0),
            leaf="capsule", sign="not negative", default=0.5,
        ),
        Parameter(
            "viscous", "N s/m", "viscous friction of the ground", r"b_\mathrm{g}", _lognormal(1.0, 100.0),
            leaf="capsule", sign="not negative", default=0.0,
        ),
        Parameter(
            "G", "m", "gap between rod and support spring where x_rel = 0; negative: the spring reaches beyond", "G",
            leaf="capsule", sign="any", may_be_infinite=True,
        ),
        Parameter(
            "g", "m/s^2", "acceleration of gravity", "g",
            leaf="capsule", sign="not negative", sampled=False, table_1=9.81,
        ),
        Parameter(
            "k_cubic", "N/m^3", "cubic stiffness between rod and capsule", r"k_\mathrm{cubic}",
            Prior("normal", 0.0, 1e7), leaf="capsule", sign="any", default=0.0,
        ),
        Parameter(
            "c2", "N s/m", "damping of the closed contact", "c_2", _lognormal(1.0, 100.0),
            leaf="capsule", sign="not negative", default=0.0,
        ),
        Parameter(
            "k2_back", "N/m", "stiffness of the back spring", r"k_{2,-}",
            leaf="capsule", sign="not negative", default=0.0,
        ),
        Parameter(
            "G_back", "m", "gap between rod and back spring where x_rel = 0; negative: as of G", "G_-",
            leaf="capsule", sign="any", default=np.inf, may_be_infinite=True,
        ),
        Parameter(
            "slope", "rad", "slope of the ground, +X uphill", r"\alpha",
            leaf="capsule", sign="any", default=0.0,
        ),
        Parameter(
            "N0", "N", "force that presses the capsule down besides the weight", "N_0",
            leaf="capsule", sign="any", default=0.0,
        ),
        Parameter("P_d", "N", "amplitude of the drive", "P_d", leaf="drive", sign="any"),
        Parameter(
            "Omega", "rad/s", "angular frequency of the drive", r"\Omega", leaf="drive", sign="any", sampled=False
        ),
        Parameter("phase", "rad", "phase of the drive", r"\varphi", physical=False, leaf="drive", sign="any", default=0.0),
        Parameter(
            "reaction", "1", "share of the drive's force that pushes the capsule back", r"\rho_\mathrm{D}",
            physical=False, leaf="drive", sign="any", sampled=False, default=0.0,
        ),
        Parameter("P_on", "N", "force of a pulse", r"P_\mathrm{on}", leaf="drive", sign="any"),
        Parameter("P_off", "N", "force between pulses", r"P_\mathrm{off}", leaf="drive", sign="any", default=0.0),
        Parameter("period", "s", "period of the pulses", "T", leaf="drive", sampled=False),
        Parameter(
            "duty", "1", "share of the period in which the pulse is on", r"\delta",
            leaf="drive", sign="any", sampled=False,
        ),
        Parameter(
            "lag", "s", "lag of the force of pulses", r"\tau", _lognormal(0.01, 10.0),
            leaf="drive", sign="not negative", default=0.0,
        ),
        Parameter("K", "N/A", "force per motor current", "K", _lognormal(2.0), table_1=2.0),
        Parameter("F_dry", "N", "dry friction between rod and capsule", r"F_\mathrm{dry}", _lognormal(0.1)),
        Parameter("c_q", "N s^2/m^2", "quadratic damping between rod and capsule", "c_q", _lognormal(10.0)),
        nuisance("x_start", "m", "x_rel at the start of a record", "x_0"),
        nuisance("y_start", "m/s", "rate of x_rel at the start of a record", "y_0"),
        nuisance("clock_drift", "1", "drift of the clock of a record", r"\delta_\mathrm{clock}"),
        nuisance("gain", "1", "relative error of the gain of an instrument", r"\gamma"),
        nuisance("offset", "by the column", "reading of an instrument at 0", "o"),
        scatter("scatter", "N", "scatter about a calibration line", "s"),
    )
}  # fmt: skip

#: Symbols of the errors of instruments. An experiment may read several instruments: it knows their errors by name.
INSTRUMENT_ERRORS = ("gain", "offset")
#: The errors of instruments that an sd may not contain, in words.
INSTRUMENT_WORDS = ("clock", "gain", "zero")
#: The drives that a command can be given, and the leaves of each.
DRIVES: Mapping[str, tuple[str, ...]] = {
    "harmonic": ("P_d", "Omega", "phase", "reaction"),
    "pulses": ("P_on", "period", "duty", "P_off", "phase", "lag", "reaction"),
}


def refuse_another_law(law: str, file: str | Path = "") -> None:
    """Refuse a result whose friction ``law``, as in its provenance, is neither eq. (1) nor that with ratio 1.

    Raises
    ------
    InputError
        Of another law, of which files hold the name alone.
    """
    if law.split(",")[0] not in ("eq. (1)", "constant friction"):
        rule = "this computes with eq. (1), and the result must have been fitted with it or with constant friction"
        raise InputError(rule, law, "call capsule_id.simulate(..., friction=law) in Python", file)


#: Values of eq. (1) at which the friction is the same at every speed; v_s is then any positive number.
CONSTANT = {"ratio": 1.0, "v_s": 1.0}

#: The leaves of the model: fields of ``CapsuleParameters``, and those with the fields of the drives.
CAPSULE_LEAVES: Mapping[str, Parameter] = {s: row for s, row in TABLE.items() if row.leaf == "capsule"}
LEAVES: Mapping[str, Parameter] = {s: row for s, row in TABLE.items() if row.leaf is not None}
#: Quantities of a sweep: every leaf, and the frequency of the drive in Hz, also in the place of the period of pulses (a
#: diagram's ``period`` is that of the motion).
SWEPT: Mapping[str, Parameter] = {
    **{symbol: row for symbol, row in LEAVES.items() if symbol != "period"},
    "f": Parameter("f", "Hz", "frequency of the drive", "f", leaf="drive", sign="any", sampled=False),
}
#: The values of the paper's Table 1, SI.
TABLE_1: Mapping[str, float] = {s: row.table_1 for s, row in TABLE.items() if row.table_1 is not None}


def parameter(symbol: str, of: str = "", prior: Prior | None = None) -> Parameter:
    """The table's row for ``symbol``, for one spring or record, with another prior if given."""
    return TABLE[symbol].named(of, prior)


def symbol_of(name: str) -> str:
    """``k2[soft]`` -> ``k2``."""
    return Name.parse(name).symbol


def is_stated(name: str) -> bool:
    """Whether rig.toml states the parameter: its prior is a reading, and tests are not meant to narrow it."""
    return symbol_of(name) in ("m1", "m2", "slope", "N0", "clock_drift", *INSTRUMENT_ERRORS)
