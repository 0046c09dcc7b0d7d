"""THE parameter table: symbol, unit, meaning, LaTeX label, default prior. Priors, axes, report and README read it.

A parameter's *name* is its symbol, with a bracket where there is one per spring or per record: ``k2[soft]``,
``noise_sd[free_vibration_1]``. Positive parameters are sampled through their logarithm, the others as they are.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from scipy import stats

#: A log-normal prior holds 95 % of its mass within median/factor .. median*factor.
QUANTILE_975 = float(stats.norm.ppf(0.975))


#: Symbols of standard deviations.
SCATTERS = frozenset(
    {
        "noise_sd", "tilt_sd", "push_scatter", "sliding_scatter", "scatter",
        "noise_x_rel", "noise_x_capsule", "noise_acceleration", "noise_current",
    }
)  # fmt: skip


@dataclass(frozen=True)
class Prior:
    """A proper prior density that can be evaluated and sampled.

    ``lognormal``: ``location`` the median, ``spread`` the factor. ``halfnormal``: ``spread`` the scale.
    ``positive_normal``: a weighing, mean and sd, restricted to positive values. ``normal``: mean and sd.
    """

    kind: Literal["lognormal", "halfnormal", "positive_normal", "normal"]
    location: float
    spread: float

    def sample(self, rng: np.random.Generator, size: int) -> np.ndarray:
        """Draw ``size`` independent values, SI."""
        if self.kind == "lognormal":
            return self.location * np.exp(np.log(self.spread) / QUANTILE_975 * rng.standard_normal(size))
        if self.kind == "halfnormal":
            return np.abs(self.spread * rng.standard_normal(size))
        if self.kind == "positive_normal":
            low = -self.location / self.spread
            return self.location + self.spread * stats.truncnorm(low, np.inf).rvs(size, random_state=rng)
        return self.location + self.spread * rng.standard_normal(size)

    def describe(self) -> str:
        """One phrase for tables, SI."""
        if self.kind == "lognormal":
            return f"log-normal, median {self.location:g}, factor {self.spread:g}"
        if self.kind == "halfnormal":
            return f"half-normal, scale {self.spread:g}"
        if self.kind == "positive_normal":
            return f"weighed: {self.location:g} ± {self.spread:g}"
        return f"normal, {self.location:g} ± {self.spread:g}"


@dataclass(frozen=True)
class Parameter:
    """One row of the table; ``of`` is the spring's or the record's name, "" where there is none."""

    symbol: str
    unit: str
    meaning: str
    latex: str
    prior: Prior | None
    physical: bool = True
    of: str = ""

    @property
    def name(self) -> str:
        return f"{self.symbol}[{self.of}]" if self.of else self.symbol

    @property
    def label(self) -> str:
        """LaTeX label with the bracket as a subscript text."""
        return f"${self.latex}$ [{self.of}]" if self.of else f"${self.latex}$"

    @property
    def scatter(self) -> bool:
        """A standard deviation, absolute or relative: it scales residuals, it moves no prediction."""
        return self.symbol in SCATTERS

    @property
    def positive(self) -> bool:
        """Sampled through its logarithm."""
        return self.prior is None or self.prior.kind != "normal"


def _lognormal(median: float, factor: float) -> Prior:
    return Prior("lognormal", median, factor)


def _halfnormal(scale: float) -> Prior:
    return Prior("halfnormal", 0.0, scale)


#: Prior ``None``: there is no default, the experiment or the weighing supplies it.
TABLE: Mapping[str, Parameter] = {
    row.symbol: row
    for row in (
        Parameter("m1", "kg", "mass of the rod", "m_1", None),
        Parameter("m2", "kg", "mass of the capsule", "m_2", None),
        Parameter("k1", "N/m", "stiffness between rod and capsule", "k_1", _lognormal(1500.0, 1000.0)),
        Parameter("c", "N s/m", "viscous damping between rod and capsule", "c", _lognormal(4.0, 1000.0)),
        Parameter("mu", "1", "static friction coefficient, eq. (1)", r"\mu", _lognormal(0.4, 5.0)),
        Parameter("v_s", "m/s", "Stribeck velocity, eq. (1)", "v_s", _lognormal(0.3, 10.0)),
        Parameter("k2", "N/m", "stiffness of the support spring", "k_2", _lognormal(20e3, 1000.0)),
        Parameter("K", "N/A", "force per motor current", "K", _lognormal(2.0, 1000.0)),
        Parameter("F_dry", "N", "dry friction between rod and capsule", r"F_\mathrm{dry}", _lognormal(0.1, 1000.0)),
        Parameter("c_q", "N s^2/m^2", "quadratic damping between rod and capsule", "c_q", _lognormal(10.0, 1000.0)),
        Parameter("G", "m", "gap between rod and support spring in a run", "G", None),
        Parameter("P_d", "N", "amplitude of the drive in a run", "P_d", None),
        Parameter("I_d", "A", "amplitude of the current in a run", "I_d", None, physical=False),
        Parameter("phase", "rad", "phase of the drive in a run", r"\varphi", None, physical=False),
        Parameter("noise_sd", "m", "noise of a record", r"\sigma", None, physical=False),
        Parameter("noise_x_rel", "m", "noise of x_rel in a run", r"\sigma_{x}", None, physical=False),
        Parameter("noise_x_capsule", "m", "noise of x_capsule in a run", r"\sigma_{X2}", None, physical=False),
        Parameter("noise_acceleration", "m/s^2", "noise of the acceleration in a run", r"\sigma_{a}", None, False),
        Parameter("noise_current", "A", "noise of the current in a run", r"\sigma_{I}", None, physical=False),
        Parameter("amplitude", "m", "first turning point of a decay", "a_0", None, physical=False),
        Parameter("turning_time", "s", "time of the first turning point of a decay", "t_0", None, physical=False),
        Parameter("x_start", "m", "x_rel at the start of a record", "x_0", None, physical=False),
        Parameter("y_start", "m/s", "rate of x_rel at the start of a record", "y_0", None, physical=False),
        *(
            Parameter(
                f"ar1_{name}",
                "1",
                f"atanh of the noise's lag-1 correlation, {name} of a run",
                r"\alpha",
                Prior("normal", 0.0, 1.0),
                False,
            )
            for name in ("x_rel", "x_capsule", "acceleration_rod", "current")
        ),
        Parameter("capsule_start", "m/s", "speed of the capsule at the start of a run", "v_0", None, physical=False),
        Parameter(
            "tilt_sd", "rad", "scatter of the tilt angle", r"\sigma_\mathrm{tilt}", _halfnormal(np.deg2rad(1.0)), False
        ),
        Parameter(
            "push_scatter",
            "1",
            "relative scatter of mu from push to push",
            r"s_\mathrm{push}",
            _halfnormal(0.05),
            False,
        ),
        Parameter(
            "sliding_scatter", "1", "relative scatter of mu, steady sliding", r"s_\mathrm{sl}", _halfnormal(0.05), False
        ),
        Parameter("scatter", "N", "scatter about a calibration line", "s", None, physical=False),
    )
}


def parameter(symbol: str, of: str = "", prior: Prior | None = None) -> Parameter:
    """The table's row for ``symbol``, for one spring or record, with another prior if given."""
    row = TABLE[symbol]
    return replace(row, of=of, prior=prior if prior is not None else row.prior)


def symbol_of(name: str) -> str:
    """``k2[soft]`` -> ``k2``."""
    return name.split("[", 1)[0]
