"""Settings of a free vibration, the model that they state, and the window that contains the free decay."""

from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np

from capsule_id.rig.domains import ANY, NOT_NEGATIVE
from capsule_id.rig.model import Quantity, Settings, Table
from capsule_id.rig.schema import NameRule, QuantityRule, WordsRule

#: Parameter of every damping term besides the viscous one, and of the cubic spring.
DAMPING = {"dry": "F_dry", "quadratic": "c_q"}


@dataclass(frozen=True, kw_only=True)
class DecaySettings(Settings):
    """Settings of a free vibration, SI."""

    start: Annotated[float | None, QuantityRule("s", ANY)] = None
    stop: Annotated[float | None, QuantityRule("s", ANY)] = None
    capsule: Literal["held", "free"] = "held"
    damping: Annotated[tuple[str, ...], WordsRule(("viscous", *DAMPING))] = ("viscous",)
    stiffness: Literal["linear", "cubic"] = "linear"
    smoothing_window: Annotated[float | None, QuantityRule("s")] = None
    spring: Annotated[str | None, NameRule()] = None
    gap: Annotated[Quantity | None, QuantityRule("m", NOT_NEGATIVE, has_sd=True)] = None
    forward: Literal["closed", "capsule"] = "closed"


@dataclass(frozen=True)
class DecayModel:
    """Forces of a free decay besides the viscous damping and the linear spring.

    Attributes
    ----------
    damping : words of ``DAMPING``, in that order
    cubic : whether the spring has a cubic term
    """

    damping: tuple[str, ...] = ()
    cubic: bool = False

    @classmethod
    def stated(cls, settings: DecaySettings) -> "DecayModel":
        """Return the model that ``settings`` state."""
        return cls(tuple(word for word in DAMPING if word in settings.damping), settings.stiffness == "cubic")

    @property
    def symbols(self) -> tuple[str, ...]:
        """Symbols of the parameters besides k1 and c."""
        return (*(DAMPING[word] for word in self.damping), *(("k_cubic",) if self.cubic else ()))

    @property
    def name(self) -> str:
        """Words for tables and legends."""
        return " + ".join(("viscous", *self.damping)) + (" damping, cubic spring" if self.cubic else " damping")


def decay_window(table: Table) -> tuple[np.ndarray, np.ndarray]:
    """Return (time, x_rel) of a free vibration, SI, from ``start`` to ``stop`` inclusive; default: the whole record."""
    time, settings = table["time"], table.settings
    start = time[0] if settings.start is None else settings.start
    stop = time[-1] if settings.stop is None else settings.stop
    inside = (time >= start) & (time <= stop)
    return time[inside], table["x_rel"][inside]
