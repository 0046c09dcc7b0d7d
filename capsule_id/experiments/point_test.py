"""Common form of lines and friction tests: a row per trial, its reading, and what parameters and other columns predict.

Linear nuisances and the scatter are integrated out, and errors of the other columns are carried over to the reading
to first order. Lines add a prior along the line, and friction tests share a panel. A kind of another package needs
little more than ``predict``.
"""

from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import replace
from types import ModuleType
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from capsule_id.experiments.base import About, Start, ValuesBySymbol, axis_label, band, no_design
from capsule_id.experiments.friction_model import (
    EQUATION_1,
    FrictionModel,
    GroundExperiment,
    ground_of,
    ground_parameters,
    instrument_parameters,
)
from capsule_id.experiments.misfit import Misfit
from capsule_id.parameters import Parameter, parameter
from capsule_id.rig.model import Column, Rig, Table
from capsule_id.rig.schema import GroundSettings
from capsule_id.views import Comparison, Curve, Points

#: Name of the friction law of the fit in ``PointTest.reads``.
FRICTION = "friction"
#: Part of the range of the abscissa that a curve goes on beyond the readings, and its points.
MARGIN, CURVE = 0.04, 60


class PointTest(GroundExperiment):
    """Trials of one table; subclasses name the reading, its scatter and the parameters, and predict it.

    Attributes
    ----------
    readings : by column, SI: (n,), or () where all rows have one value
    sds : their reading errors, () or (n,), by column
    uncertain : columns other than the reading that have errors
    """

    readings: dict[str, np.ndarray]
    sds: dict[str, Any]
    uncertain: tuple[str, ...] = eqx.field(static=True)

    #: Column that is predicted.
    reading: ClassVar[str]
    #: Row of the scatter, and whether it is relative to the prediction.
    scatter: ClassVar[Parameter]
    relative: ClassVar[bool] = True
    #: What the prediction reads: rows, names of the package's parameters, or ``FRICTION``, the law of the fit.
    reads: ClassVar[tuple[str | Parameter, ...]] = ()
    #: Whether slope and N0 of the settings act.
    on_track: ClassVar[bool] = True

    def __init__(self, table: Table, rig: Rig, friction: FrictionModel = EQUATION_1) -> None:
        on_track = self.on_track and isinstance(table.settings, GroundSettings)
        self.friction = replace(friction, direction=getattr(table.settings, "direction", friction.direction))
        self.ground = ground_of(table) if on_track else {}
        self.readings, self.sds = self.read(table)
        others = (name for name in self.sds if name != self.reading)
        self.uncertain = tuple(name for name in others if np.any(np.asarray(self.sds[name]) > 0.0))
        ground = ground_parameters(table, rig) if on_track else ()
        self.read_instruments(table)
        self.about = About(table, rig, (*self.own_parameters(table), *ground, *instrument_parameters(table)))

    def read(self, table: Table) -> tuple[dict[str, Any], dict[str, Any]]:
        """``readings`` and ``sds`` of a table."""
        columns = table.columns.items()
        return {name: c.values for name, c in columns}, {name: c.reading_sd for name, c in columns}

    def own_parameters(self, table: Table) -> tuple[Parameter, ...]:
        """The rows that ``reads`` names, and the scatter."""
        rows: list[Parameter] = []
        for one in self.reads:
            rows += self.friction.parameters if one == FRICTION else [parameter(one) if isinstance(one, str) else one]
        return (*rows, self.scatter)

    @abstractmethod
    def predict(self, theta: ValuesBySymbol, x: Mapping[str, Any]) -> Any:
        """The reading, SI, () or (n,), at ``theta`` and the columns ``x``; NumPy and JAX."""

    def unstated_errors(self, symbol: str) -> set[str]:
        """See ``Experiment``."""
        errors = [column.instrument.errors if column.instrument else {} for column in self.table.columns.values()]
        words = {"gain": "gain", "offset": "zero"}
        return {word for error, word in words.items() if not all(error in stated for stated in errors)}

    def as_read(self, slope: Any, column: str, theta: ValuesBySymbol) -> Any:
        """A derivative of the true reading by a true column, as the readings of both instruments show it."""
        return slope * self.instrument(self.reading, theta)[0] / self.instrument(column, theta)[0]

    def true(self, column: str, values: Any, theta: ValuesBySymbol) -> Any:
        """What a column would read without the errors of its instrument at ``theta``."""
        factor, offset = self.instrument(column, theta)
        return (values - offset) / factor

    def shown(self, theta: ValuesBySymbol, x: Mapping[str, Any]) -> Any:
        """What its instrument reads where the reading is as predicted at the readings ``x`` of the other columns."""
        if not self.instruments:
            return self.predict(theta, x)
        factor, offset = self.instrument(self.reading, theta)
        return offset + factor * self.predict(
            theta, {name: self.true(name, values, theta) for name, values in x.items()}
        )

    def slopes(self, theta: ValuesBySymbol) -> Mapping[str, Any]:
        """Derivative of what is shown by each column of ``uncertain``, by name; () or (n,)."""
        return _slopes(self, theta) if self.uncertain else {}

    def change(self, theta: ValuesBySymbol) -> Any:
        """Change of the reading with its scatter, () or (n,)."""
        return self.predict(theta, self.readings) if self.relative else 1.0

    def design(self, n: int, xp: ModuleType = jnp) -> Any:
        """Effect (n, p) of linear nuisances on the readings, SI, each scaled to a standard normal prior."""
        return no_design(n, xp)

    @property
    def masses(self) -> tuple[str, ...]:  # type: ignore[override]  # pyright: ignore
        return self.friction.masses if FRICTION in self.reads else ()

    @property
    def observed(self) -> np.ndarray:
        return self.readings[self.reading]

    @property
    def scatters(self) -> tuple[str | None, ...]:
        return (self.scatter.symbol,)

    def misfits(self, theta: ValuesBySymbol, xp: ModuleType = jnp) -> tuple[Misfit, ...]:
        raw = self.observed - xp.asarray(self.shown(theta, self.readings))
        carried = ((slope * self.sds[name]) ** 2 for name, slope in self.slopes(theta).items())
        variance = sum(carried, self.sds[self.reading] ** 2)
        size = self.instrument(self.reading, theta)[0] if self.relative else 1.0
        return (Misfit(raw, variance, size * self.change(theta), self.design(self.n, xp)),)

    def starts(self) -> dict[str, Start]:
        """None: parameters start at the medians of their priors."""
        return {}

    def comparison(self, theta: ValuesBySymbol, draws: list[ValuesBySymbol]) -> Comparison:
        """Readings against the first other column, or in order; curves hold the further columns at their means."""
        y, others = self.table.columns[self.reading], (c for c in self.table.columns.values() if c.name != self.reading)
        column = next(others, Column("trial", "1", 1.0, np.arange(1.0, self.n + 1.0)))
        x = column.values
        margin = MARGIN * np.ptp(x)
        along = np.linspace(np.min(x) - margin, np.max(x) + margin, CURVE)
        held = {name: np.mean(values) for name, values in self.readings.items()}

        def curve(values: ValuesBySymbol) -> np.ndarray:
            nuisances = self.design(CURVE, np) @ self.nuisance_mean(values)
            return (np.asarray(self.shown(values, {**held, column.name: along})) + nuisances) * y.to_display

        lower, upper = band(np.array([curve(draw) for draw in draws]))
        return Comparison(
            self.kind,
            self.label,
            f"{self.label}: {y.name} against {column.name}",
            axis_label(column),
            axis_label(y),
            (
                Points(
                    self.label,
                    x * column.to_display,
                    self.observed * y.to_display,
                    np.full(self.n, y.sd * y.to_display) if y.sd else None,
                ),
            ),
            (Curve("this fit", along * column.to_display, curve(theta), lower, upper),),
            x * column.to_display,
            self.residuals(theta, np)[: self.n],
        )


@jax.jit
def _slopes(test: PointTest, theta: ValuesBySymbol) -> dict[str, jax.Array]:
    """See ``PointTest.slopes``."""

    def slope(name: str) -> jax.Array:
        x = test.readings[name]
        return jax.jvp(lambda x: test.shown(theta, {**test.readings, name: x}), (x,), (jnp.ones_like(x),))[1]

    return {name: slope(name) for name in test.uncertain}
