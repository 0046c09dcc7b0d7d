"""Settings of a free vibration, the model that they state, and the window that contains the free decay."""

from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np

from capsule_id.rig.domains import ANY, NOT_NEGATIVE
from capsule_id.rig.model import Quantity, Settings, Table
from capsule_id.rig.schema import NameRule, QuantityRule, WordsRule

#: Parameter of every damping term besides the viscous one, and of the cubic spring.
DAMPING = {"dry": "F_dry", "quadratic": "c_q"}

_DRIFTS = {"linear": "linear drift", "gp": "Gaussian-process drift"}
_NOISES = {"ar1": "AR(1) noise", "arma": "ARMA noise"}


@dataclass(frozen=True, kw_only=True)
class DecaySettings(Settings):
    """Settings of a free vibration, SI."""

    start: Annotated[float | None, QuantityRule("s", ANY)] = None
    stop: Annotated[float | None, QuantityRule("s", ANY)] = None
    capsule: Literal["held", "free"] = "held"
    damping: Annotated[tuple[str, ...], WordsRule(("viscous", *DAMPING))] = ("viscous",)
    stiffness: Literal["linear", "cubic"] = "linear"
    drift: Literal["none", "linear", "gp"] = "none"
    noise: Literal["white", "ar1", "arma"] = "white"
    smoothing_window: Annotated[float | None, QuantityRule("s")] = None
    spring: Annotated[str | None, NameRule()] = None
    gap: Annotated[Quantity | None, QuantityRule("m", NOT_NEGATIVE, has_sd=True)] = None
    forward: Literal["closed", "capsule"] = "closed"


@dataclass(frozen=True)
class DecayModel:
    """Forces of a free decay besides the viscous damping and the linear spring, drift and noise of its record.

    Attributes
    ----------
    damping : words of ``DAMPING``, in that order
    cubic : whether the spring has a cubic term
    drift, noise : as in ``DecaySettings``
    """

    damping: tuple[str, ...] = ()
    cubic: bool = False
    drift: str = "none"
    noise: str = "white"

    @classmethod
    def stated(cls, settings: DecaySettings) -> "DecayModel":
        """Return the model that ``settings`` state."""
        damping = tuple(word for word in DAMPING if word in settings.damping)
        return cls(damping, settings.stiffness == "cubic", settings.drift, settings.noise)

    @property
    def symbols(self) -> tuple[str, ...]:
        """Symbols of the parameters besides k1 and c."""
        return (*(DAMPING[word] for word in self.damping), *(("k_cubic",) if self.cubic else ()))

    @property
    def whitened(self) -> bool:
        """Whether noise or drift correlate the readings."""
        return self.noise != "white" or self.drift == "gp"

    @property
    def name(self) -> str:
        """Words for tables and legends."""
        words = [" + ".join(("viscous", *self.damping)) + " damping"]
        words += ["cubic spring"] if self.cubic else []
        words += [_DRIFTS[self.drift]] if self.drift != "none" else []
        words += [_NOISES[self.noise]] if self.noise != "white" else []
        return ", ".join(words)


def rows_in_window(table: Table) -> np.ndarray:
    """(n,) bool: the rows from ``start`` to ``stop`` inclusive, which a fit reads; default: all."""
    time, settings = table["time"], table.settings
    start = time[0] if settings.start is None else settings.start
    stop = time[-1] if settings.stop is None else settings.stop
    return (time >= start) & (time <= stop)


def decay_window(table: Table) -> tuple[np.ndarray, np.ndarray]:
    """Return (time, x_rel) of a free vibration, SI, from ``start`` to ``stop`` inclusive; default: the whole record."""
    inside = rows_in_window(table)
    return table["time"][inside], table["x_rel"][inside]
