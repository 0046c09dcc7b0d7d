"""Settings of a free vibration, the model that they state, and the window that contains the free decay."""

from dataclasses import dataclass, replace
from typing import Annotated, Literal

import numpy as np

from capsule_id.experiments.free_vibration.readings.blocks import block_size, default_block_size
from capsule_id.experiments.free_vibration.readings.channels import channel_of
from capsule_id.records.faults.release import FreeDecay, find_free_decay
from capsule_id.rig.domains import ANY, NOT_NEGATIVE
from capsule_id.rig.entry import Entry
from capsule_id.rig.model import Quantity, Table
from capsule_id.rig.schema import CountRule, GroundSettings, NameRule, QuantityRule, WordsRule

#: Parameter of every damping term besides the viscous one, and of the cubic spring.
DAMPING = {"dry": "F_dry", "quadratic": "c_q"}

#: Parameters of all forces besides those of the linear model.
FURTHER = (*DAMPING.values(), "k_cubic")
#: What every parameter of a further force stands for, in words.
EFFECTS = {"F_dry": "dry friction", "c_q": "quadratic damping", "k_cubic": "a cubic spring"}
#: Periods of a record that a model with further forces, correlated noise or a Gaussian-process drift is fitted to, at most:
#: its evaluations take milliseconds then.
MOST_PERIODS = 250
_DRIFTS = {"linear": "linear drift", "gp": "Gaussian-process drift"}
_NOISES = {"ar1": "coloured noise (AR(1))", "arma": "white and coloured noise (ARMA)"}


@dataclass(frozen=True, kw_only=True)
class DecaySettings(GroundSettings):
    """Settings of a free vibration, SI.

    Absent words of the model stand for viscous damping, a linear spring, no drift and white noise. Where the record
    contradicts that, a second fit may choose others (``capsule_id.experiments.free_vibration.second_fit.screening``).
    """

    start: Annotated[float | None, QuantityRule("s", ANY)] = None
    stop: Annotated[float | None, QuantityRule("s", ANY)] = None
    capsule: Literal["held", "free"] = "held"
    damping: Annotated[tuple[str, ...] | None, WordsRule(("viscous", *DAMPING))] = None
    stiffness: Literal["linear", "cubic"] | None = None
    drift: Literal["none", "linear", "gp"] | None = None
    noise: Literal["white", "ar1", "arma"] | None = None
    thin: Annotated[int | None, CountRule()] = None
    samples: Literal["record", "turning_points"] = "record"
    smoothing_window: Annotated[float | None, QuantityRule("s")] = None
    spring: Annotated[str | None, NameRule()] = None
    gap: Annotated[Quantity | None, QuantityRule("m", NOT_NEGATIVE, has_sd=True)] = None
    forward: Literal["closed", "capsule"] = "closed"

    @property
    def offers_cubic(self) -> bool:
        """Whether a cubic spring may be fitted where no stiffness is stated: on a slope it is refused."""
        return "slope" not in self.ground


def check_ground(entry: Entry[DecaySettings]) -> None:
    """Refuse a slope that the closed form does not have: of a held capsule it shifts the rest position alone."""
    settings = entry.table.settings
    if settings.forward == "capsule":
        return
    if settings.stiffness == "cubic":
        entry.refuse_ground("slope", "a decay with a cubic spring must be on level ground")
    if settings.capsule == "free":
        for key in ("slope", "N0"):
            entry.refuse_ground(key, f'the closed form of a free capsule has no {key}; forward = "capsule" has')


@dataclass(frozen=True)
class DecayModel:
    """Forces of a free decay besides the viscous damping and the linear spring, drift and noise of its record.

    Attributes
    ----------
    damping : words of ``DAMPING``, in that order
    cubic : whether the spring has a cubic term
    drift, noise : as in ``DecaySettings``
    thin : the likelihood uses means of so many consecutive samples
    """

    damping: tuple[str, ...] = ()
    cubic: bool = False
    drift: str = "none"
    noise: str = "white"
    thin: int = 1

    @classmethod
    def stated(cls, settings: DecaySettings) -> "DecayModel":
        """Return the model that ``settings`` state; without ``thin`` it uses every sample."""
        damping = tuple(word for word in DAMPING if word in (settings.damping or ()))
        return cls(
            damping,
            settings.stiffness == "cubic",
            settings.drift or "none",
            settings.noise or "white",
            settings.thin or 1,
        )

    @property
    def lines(self) -> str:
        """Lines of ``rig.toml`` that state the model."""
        return f'{self.force_lines}, drift = "{self.drift}", noise = "{self.noise}", thin = {self.thin}'

    @property
    def force_lines(self) -> str:
        """Lines of ``rig.toml`` that state the forces."""
        return f"{self.damping_line}, {self.stiffness_line}"

    @property
    def damping_line(self) -> str:
        """Line of ``rig.toml`` that states the damping."""
        words = ", ".join(f'"{word}"' for word in ("viscous", *self.damping))
        return f"damping = [{words}]"

    @property
    def stiffness_line(self) -> str:
        """Line of ``rig.toml`` that states the spring."""
        word = "cubic" if self.cubic else "linear"
        return f'stiffness = "{word}"'

    @property
    def symbols(self) -> tuple[str, ...]:
        """Symbols of the parameters besides k1 and c."""
        return (*(DAMPING[word] for word in self.damping), *(("k_cubic",) if self.cubic else ()))

    @property
    def absent(self) -> tuple[str, ...]:
        """Symbols of the forces that the model lacks."""
        return tuple(symbol for symbol in FURTHER if symbol not in self.symbols)

    @property
    def _terms(self) -> set[str]:
        """Everything that the model adds to the simplest one."""
        noise = {"white": (), "ar1": ("ar1",), "arma": ("ar1", "white")}[self.noise]
        return {*self.symbols, *noise, *(() if self.drift == "none" else (self.drift,))}

    @property
    def size(self) -> int:
        """Number of terms that it adds to the simplest model; a model contains only smaller ones."""
        return len(self._terms)

    def nested_in(self, other: "DecayModel") -> bool:
        """Whether ``other`` contains this model."""
        return self._terms < other._terms

    @property
    def slow(self) -> bool:
        """Whether an evaluation takes a time in proportion to the length of the record."""
        return bool(self.symbols) or self.whitened

    @property
    def whitened(self) -> bool:
        """Whether noise or drift correlate the readings."""
        return self.noise != "white" or self.drift == "gp"

    @property
    def shapes(self) -> tuple[str, ...]:
        """Symbols of the shape parameters of noise and drift."""
        noise = {"white": (), "ar1": ("noise_time",), "arma": ("noise_time", "white_ratio")}[self.noise]
        return (*noise, *(("drift_ratio", "drift_time") if self.drift == "gp" else ()))

    @property
    def additions(self) -> list[str]:
        """Effects of the model that the default lacks, in words."""
        words = [EFFECTS[symbol] for symbol in self.symbols]
        return words + (["drift of the zero"] if self.drift != "none" else [])

    @property
    def name(self) -> str:
        """Words for tables and legends."""
        words = [" + ".join(("viscous", *self.damping)) + " damping"]
        words += ["cubic spring"] if self.cubic else []
        words += [_DRIFTS[self.drift]] if self.drift != "none" else []
        words += [_NOISES[self.noise]] if self.noise != "white" else []
        words += [f"means of {self.thin} samples"] if self.thin > 1 else []
        return ", ".join(words)


def window_of(table: Table) -> slice:
    """The rows from ``start`` to ``stop`` inclusive, which a fit reads; default: all."""
    time, settings = table["time"], table.settings
    first = 0 if settings.start is None else int(np.searchsorted(time, settings.start, side="left"))
    last = len(time) if settings.stop is None else int(np.searchsorted(time, settings.stop, side="right"))
    return slice(first, max(first, last))


def decay_window(table: Table) -> tuple[np.ndarray, np.ndarray]:
    """Return (time, channel) of a free vibration, SI, from ``start`` to ``stop`` inclusive; default: the whole record."""
    inside = window_of(table)
    return table["time"][inside], table[channel_of(table)][inside]


def stated_model(table: Table) -> DecayModel:
    """Return the model that the settings of ``table`` state; a long record is thinned where they leave that open."""
    model = DecayModel.stated(table.settings)
    if table.settings.thin is not None:
        return model
    return replace(model, thin=default_block_size(*decay_window(table)))


def first_periods(table: Table[DecaySettings]) -> Table[DecaySettings]:
    """Return the table with a stop after ``MOST_PERIODS``, where none is stated and the record is longer."""
    time, values = decay_window(table)
    last = MOST_PERIODS * block_size(time, values, 1.0)
    if table.settings.stop is not None or last >= len(time) or block_size(time, values, 1.0) == 1:
        return table
    return replace(table, settings=replace(table.settings, stop=float(time[last])))


def release_time(decay: FreeDecay) -> float:
    """Start of a free decay, s, in hundredths of its period; none of what comes before it is left in."""
    size = 10.0 ** max(0, int(np.ceil(-np.log10(0.01 * decay.period))))
    return float(np.ceil(decay.start * size - 1e-6)) / size


def cut_at_release(table: Table[DecaySettings]) -> Table[DecaySettings]:
    """Return the table with the release found in its record as ``start``, where there is rest before it.

    A stated ``start`` stays, and a table of turning points has no rest.
    """
    settings = table.settings
    if settings.start is not None or settings.samples != "record":
        return table
    decay = find_free_decay(*decay_window(table), displacement=channel_of(table) == "x_rel")
    if decay is None or decay.rest == 0.0:
        return table
    return replace(table, settings=replace(settings, start=release_time(decay)))
