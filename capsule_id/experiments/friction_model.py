"""Friction law of a fit: its sampled parameters, and the law at given values."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Literal, cast

import equinox as eqx
import jax
import numpy as np

from capsule_id.errors import InputError
from capsule_id.experiments.base import Experiment, ValuesBySymbol
from capsule_id.parameters import CONSTANT, INSTRUMENT_ERRORS, SAME, Name, Parameter, Prior, parameter
from capsule_id.physics.forces import CoulombStribeck, Force, FrictionLaw, normal_force, scaled
from capsule_id.rig.model import ModelChoices, Quantity, Rig, Table

# friction model: Friction law of a fit: its sampled parameters, and the law at given values.


#: Symbols of the leaves that hold the normal force, N, and the gap of a contact, m.
NORMAL_FORCE, GAP = "N", "G"
#: Prior draws at which a parameter may change the break-away force.
PRIOR_DRAWS = 64


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Reversed:
    """A law with its directions exchanged: readings of backward sliding, taken as forward ones."""

    law: FrictionLaw

    parameters: ClassVar[tuple[Parameter, ...]] = ()

    def forward(self, speed: Any) -> Any:
        """Resistance of a capsule that slides towards negative X2, N."""
        return self.law.backward(speed)

    def backward(self, speed: Any) -> Any:
        """Resistance of a capsule that slides towards positive X2, N."""
        return self.law.forward(speed)


@dataclass(frozen=True)
class FrictionModel:
    """One friction law for all experiments of a fit, as a function of the parameter values.

    The leaves of the law are its sampled parameters. A leaf ``N`` is not sampled: it holds the weight (m1 + m2) g.

    Attributes
    ----------
    law : its class; eq. (1) by default
    free : symbols of the optional parameters that are sampled; the others keep their defaults
    constant : eq. (1) with ratio 1: the same friction at every speed, without v_s
    direction : of the sliding that an experiment records. "backward" exchanges the directions of the law
    contact : class of a force in place of the support spring of runs and decays. Its leaf ``G`` holds the gap, m

    Raises
    ------
    InputError
        If ``law`` is no class of friction laws, or ``contact`` none of forces with a gap; if one has a leaf other than N or
        G that is not sampled, or a sampled one without a default prior; or if N or G is sampled.
    """

    law: type[FrictionLaw] = CoulombStribeck
    free: tuple[str, ...] = ()
    constant: bool = False
    direction: Literal["both", "forward", "backward"] = "both"
    contact: type[Force] | None = None

    def __post_init__(self) -> None:
        law, contact, wanted = self.law, self.contact, ("parameters", "forward", "backward")
        if not isinstance(law, type) or not all(hasattr(law, name) for name in wanted):
            raise InputError(
                "friction must be a class with parameters, forward(speed) and backward(speed)",
                repr(law),
                "give the class itself; see capsule_id.physics.forces.FrictionLaw",
            )
        _check_leaves(f"the friction law {law.__name__}", law, NORMAL_FORCE, "the weight, N", lambda: self._at({}, 1.0))
        if contact is None:
            return
        if not (isinstance(contact, type) and issubclass(contact, Force)) or GAP not in {
            row.symbol for row in contact.parameters
        }:
            raise InputError(
                "contact must be a class of forces with a row of parameters for its gap G",
                repr(contact),
                "give the class itself; see capsule_id.physics.forces.Force",
            )
        medians = {row.symbol: row.prior.median for row in contact.parameters if row.prior is not None}
        role = f"the contact {contact.__name__}"
        _check_leaves(role, contact, GAP, "the gap, m", lambda: cast(Any, contact)(**{**medians, GAP: 1.0}))

    @property
    def replaced(self) -> set[str]:
        """Symbols of eq. (1) and of the support spring that these laws do not have."""
        eq_1, own = ({row.symbol for row in law.parameters} for law in (CoulombStribeck, self.law))
        return (eq_1 - own) | (set() if self.contact is None else {"k2"})

    def support(self, spring: str | None) -> list[Parameter]:
        """The sampled parameters of a support: k2 of the ``spring``, or the leaves of ``contact``; None: no support."""
        if spring is None:
            return []
        rows = () if self.contact is None else self.contact.parameters
        return [row for row in rows if row.symbol != GAP] or [parameter("k2", spring)]

    def support_at(self, theta: ValuesBySymbol, gap: Any) -> dict[str, Any]:
        """k2, G and forces of ``CapsuleParameters`` at ``theta``, which has k2 or the leaves of ``contact``, or none."""
        own = {} if self.contact is None else {row.symbol: theta.get(row.symbol) for row in self.support("")}
        if self.contact is None or any(value is None for value in own.values()):
            return {"k2": theta.get("k2", 0.0), "G": gap}
        return {"k2": 0.0, "G": gap, "forces": (cast(Any, self.contact)(**own, **{GAP: gap}),)}

    @property
    def name(self) -> str:
        """Name for legends."""
        words = [self.law.__name__] if self.law is not CoulombStribeck else []
        words = words or [
            "constant friction" if self.constant else "eq. (1)",
            *(f"free {symbol}" for symbol in self.free),
        ]
        return ", ".join(words if self.contact is None else [*words, f"contact {self.contact.__name__}"])

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """The sampled parameters."""
        unseen = {"forward": "mu_back", "backward": "mu"}.get(self.direction) if "mu_back" in self.free else None
        return tuple(row for row in self._varied if row.symbol != unseen)

    @property
    def _varied(self) -> list[Parameter]:
        """The parameters of the law whose values are neither the normal force nor fixed."""
        fixed = {NORMAL_FORCE, *(CONSTANT if self.constant else ())}
        rows = (row for row in self.law.parameters if row.symbol not in fixed)
        return [row for row in rows if not row.optional or row.symbol in self.free]

    @property
    def parameters_at_rest(self) -> tuple[Parameter, ...]:
        """Parameters that change the break-away force at some prior draw: mu alone in eq. (1)."""
        rng = np.random.default_rng(0)
        draws = {row.symbol: cast(Prior, row.prior).sample(rng, PRIOR_DRAWS) for row in self.parameters}
        still = np.zeros(PRIOR_DRAWS)
        force = np.asarray(self._at(draws, 1.0).forward(still))

        def matters(row: Parameter) -> bool:
            other = self._at({**draws, row.symbol: np.roll(draws[row.symbol], 1)}, 1.0)
            change = np.abs(np.asarray(other.forward(still)) - force)
            # A force that is not finite does not show that the parameter has no effect.
            return not bool(np.all(change <= SAME * np.abs(force)))

        return tuple(row for row in self.parameters if matters(row))

    @property
    def masses(self) -> tuple[str, ...]:
        """Symbols of the masses that the coefficient depends on: none where the law is proportional to the normal force."""
        return () if self.law is CoulombStribeck and "viscous" not in self.free else ("m1", "m2")

    @property
    def source(self) -> str:
        """Name of the law in provenance: module and class; "eq. (1)" for the paper's, with its free parameters."""
        own = [law for law in (self.law, self.contact) if law not in (CoulombStribeck, None)]
        return ", ".join(f"{law.__module__}.{law.__qualname__}" for law in own if law is not None) or self.name

    def check(self, known: Mapping[str, Parameter]) -> None:
        """Reject a law or a contact that has the symbol of a different parameter in ``known`` (package and kinds).

        Raises
        ------
        InputError
            At the first such parameter.
        """
        clashes = [(self.law, known[row.symbol]) for row in self.parameters if known.get(row.symbol, row) != row]
        taken = {**known, **{row.symbol: row for row in self.parameters}}
        own = [] if self.contact is None else self.support("")
        clashes += [(cast(type, self.contact), taken[row.symbol]) for row in own if row.symbol in taken]
        for law, other in clashes:
            raise InputError(
                f"a parameter of {law.__name__} must have a symbol of its own",
                f"{other.symbol}: {other.meaning}",
                "rename it",
            )

    def force(self, theta: ValuesBySymbol) -> FrictionLaw:
        """The law at ``theta``, N; theta has m1, m2, g and, off level ground, slope and N0; or N."""
        return self._at(theta, _weight(theta))

    def coefficient(self, theta: ValuesBySymbol) -> FrictionLaw:
        """Resistance per weight (m1 + m2) g at ``theta``, 1; theta has ``masses`` and g."""
        # Without masses only the break-away coefficient is read, and nothing viscous acts at rest.
        if not self.masses or (self.law is CoulombStribeck and not {"m1", "m2"} <= set(theta)):
            return self._at(theta, 1.0)
        return scaled(self.force(theta), 1.0 / _weight(theta))

    def _at(self, theta: ValuesBySymbol, N: Any) -> FrictionLaw:
        # Parameters that tilts do not sample have no effect at rest, so any value is valid there.
        known = {row.symbol: theta.get(row.symbol, cast(Prior, row.prior).median) for row in self._varied}
        constant = {row.symbol: N for row in self.law.parameters if row.symbol == NORMAL_FORCE}
        law = cast(Any, self.law)(**known, **constant, **(CONSTANT if self.constant else {}))
        return Reversed(law) if self.direction == "backward" else law


def _check_leaves(role: str, law: type, held: str, holds: str, make: Callable[[], Any]) -> None:
    """Refuse a class whose leaves are not its sampled ``parameters`` and ``held``, which holds a number of the rig."""
    rows = cast(Any, law).parameters
    for row in rows:
        if row.symbol == held and (row.prior is not None or row.sampled):
            raise InputError(
                f"a leaf {held} of {role} holds {holds}, and is not sampled",
                row.meaning,
                "give the row no prior and sampled=False, or rename the leaf",
            )
        if row.symbol != held and (row.prior is None or not row.sampled):
            raise InputError(
                f"every parameter of {role} must have a default prior",
                f"{row.symbol} has none",
                f"give Parameter({row.symbol!r}, ...) a prior",
            )
    try:
        leaves = jax.tree.leaves(make())
    except TypeError as error:
        raise InputError(
            f"{role} must have one row of parameters per field",
            str(error),
            "give every field a row with the field's name as its symbol",
        ) from None
    if len(leaves) != len(rows) or any(isinstance(leaf, law) for leaf in leaves):
        raise InputError(
            f"{role} must be a pytree whose leaves are its parameters",
            f"leaves: {len(leaves)}",
            "add @jax.tree_util.register_dataclass above @dataclass",
        )


def _weight(theta: ValuesBySymbol) -> Any:
    """Normal force, N: as stated, else that of the weight on the slope, and N0."""
    if NORMAL_FORCE in theta:
        return theta[NORMAL_FORCE]
    return normal_force(theta["m1"], theta["m2"], theta["g"], theta.get("slope"), theta.get("N0"))


def other_laws(friction: FrictionModel) -> tuple[str, ...]:
    """Lines of ``[model]`` that state simple laws other than ``friction``; () for a law of a user's own."""
    if friction.law is not CoulombStribeck:
        return ()
    constant = () if friction.constant else ('friction = "constant"',)
    ratio = () if friction.constant or "ratio" in friction.free else ('free = ["ratio"]',)
    return (*constant, *ratio)


#: Of a rig without ``[model]``.
DEFAULT_CHOICES = ModelChoices()


def model_lines(model: FrictionModel, stated: ModelChoices = DEFAULT_CHOICES) -> str:
    """What ``[model]`` must say for the law ``model`` where ``stated`` is what it says now; other free symbols are kept."""
    kept = (symbol for symbol in stated.free if symbol not in OF_FRICTION)
    free = ", ".join(f'"{symbol}"' for symbol in (*model.free, *kept))
    lines = ['friction = "constant"'] if model.constant else []
    if not model.constant and (stated.friction != DEFAULT_CHOICES.friction or not (free or stated.free)):
        lines = ['friction = "stribeck"']
    lines += [f"free = [{free}]"] * bool(free or stated.free)
    replaced = " (in place of the lines that begin so)" * bool(
        stated.free or stated.friction != DEFAULT_CHOICES.friction
    )
    return ", and on the next line ".join(lines) + replaced


#: Symbols of the friction law of the paper, those that may be free included.
OF_FRICTION = frozenset(row.symbol for row in CoulombStribeck.parameters)
#: Default friction law: eq. (1) of the paper.
EQUATION_1 = FrictionModel()


def friction_of(rig: Rig, law: type[FrictionLaw] | None = None, contact: type[Force] | None = None) -> FrictionModel:
    """Return the laws of a fit: the class ``law``, by default eq. (1) with the choices of ``[model]``, and the ``contact``.

    Raises
    ------
    InputError
        If both ``law`` and ``[model]`` choose the friction, or ``law`` cannot be fitted.
    """
    free = tuple(symbol for symbol in rig.model.free if symbol in OF_FRICTION)
    if law is None:
        return FrictionModel(free=free, constant=rig.model.friction == "constant", contact=contact)
    if free or rig.model.friction != DEFAULT_CHOICES.friction:
        raise InputError(
            "a friction law of its own replaces [model]",
            f"both {law.__name__} and [model]",
            "remove friction and free from [model]",
            rig.folder / "rig.toml",
        )
    return FrictionModel(law, contact=contact)


# ground: Slope of the track, and a force that presses the capsule down besides the weight.


def has_stated_load(table: Table[Any]) -> bool:
    """Whether a test states its normal force, which then holds N0 too."""
    return "normal_force" in table.columns or getattr(table.settings, "normal_force", None) is not None


def _acting_ground(table: Table[Any]) -> dict[str, Quantity]:
    """Stated slope and N0 that act on the readings."""
    stated, held = getattr(table.settings, "ground", {}), has_stated_load(table)
    return {name: quantity for name, quantity in stated.items() if name != "N0" or not held}


def ground_of(table: Table[Any]) -> dict[str, float | None]:
    """Slope, rad, and N0, N, where they differ from level ground and the weight alone; None: sampled, with its sd."""
    return {name: None if stated.sd else stated.value for name, stated in _acting_ground(table).items()}


def ground_parameters(table: Table[Any], rig: Rig) -> tuple[Parameter, ...]:
    """Parameters for slope and N0 where an sd is stated, with a normal prior.

    Equal statements of several experiments are one quantity; that of [rig] has no bracket.
    """
    rows = []
    for name, stated in _acting_ground(table).items():
        if stated.sd:
            same = (other.label for other in rig.tables if getattr(other.settings, name, None) == stated)
            of = "" if stated == getattr(rig, name) else next(same, table.label)
            rows.append(parameter(name, of, Prior("normal", stated.value, stated.sd)))
    return tuple(rows)


def instrument_parameters(table: Table[Any]) -> tuple[Parameter, ...]:
    """Parameters for the errors of the instruments of a table of which an sd is stated, with normal priors."""
    rows: dict[str, Parameter] = {}
    for one in (column.instrument for column in table.columns.values() if column.instrument is not None):
        for symbol, stated in one.errors.items():
            if stated.sd:
                row = parameter(symbol, one.name, Prior("normal", stated.value, stated.sd))
                rows[row.name] = replace(row, unit=one.unit) if symbol == "offset" else row
    return tuple(rows.values())


class SurfaceExperiment(Experiment):
    """An experiment with a sliding capsule; its constructor takes a friction law in addition to table and rig.

    Attributes
    ----------
    friction : the law that all experiments of the fit share
    """

    friction: FrictionModel = eqx.field(static=True)

    @classmethod
    def make(cls, table: Table, rig: Rig, friction: FrictionModel) -> "tuple[SurfaceExperiment, ...]":
        return (cls(table, rig, friction),)  # type: ignore[call-arg, arg-type]  # pyright: ignore

    def with_friction(self, friction: FrictionModel) -> "SurfaceExperiment":
        """Return the same readings with another friction law."""
        return type(self)(self.table, self.rig, friction)  # type: ignore[call-arg, arg-type]  # pyright: ignore


class GroundExperiment(SurfaceExperiment):
    """An experiment whose capsule slides on a track that may have a slope, with a force besides the weight.

    Attributes
    ----------
    ground : slope, rad, and N0, N, where they are not 0; None: a parameter, because an sd is stated
    instruments : names of the instruments that read the columns, by column
    stated_errors : of these instruments, SI, by name (``gain[lvdt]``)
    """

    ground: dict[str, float | None]
    instruments: tuple[tuple[str, str], ...] = eqx.field(static=True)
    stated_errors: dict[str, float]

    def read_instruments(self, table: Table[Any]) -> None:
        """Set ``instruments`` and ``stated_errors``."""
        read_by = {name: column.instrument for name, column in table.columns.items() if column.instrument is not None}
        self.instruments = tuple((name, one.name) for name, one in read_by.items())
        self.stated_errors = {str(Name(s, i.name)): q.value for i in read_by.values() for s, q in i.errors.items()}

    def instrument(self, column: str, theta: ValuesBySymbol) -> tuple[Any, Any]:
        """Factor and offset, SI, of ``readings`` of a column over the truth at ``theta``: the stated errors are taken off."""
        name = dict(self.instruments).get(column, "")
        gain, offset = (str(Name(symbol, name)) for symbol in INSTRUMENT_ERRORS)
        stated_gain, stated_offset = (self.stated_errors.get(error, 0.0) for error in (gain, offset))
        # A fit of one table has no errors of instruments in theta.
        factor = (1.0 + theta.get(gain, stated_gain)) / (1.0 + stated_gain)
        return factor, (theta.get(offset, stated_offset) - stated_offset) / (1.0 + stated_gain)

    def ground_at(self, theta: ValuesBySymbol) -> dict[str, Any]:
        """Slope, rad, and N0, N, at ``theta``, where they are not 0."""
        return {name: theta[name] if value is None else value for name, value in self.ground.items()}

    def law(self, theta: ValuesBySymbol) -> FrictionLaw:
        """The friction law at ``theta``, N."""
        return self.friction.force({**theta, **self.ground_at(theta)})

    @property
    def stated_ground(self) -> dict[str, float]:
        """``ground_at`` at the stated values."""
        return {name: self.table.settings.ground[name].value for name in self.ground}
