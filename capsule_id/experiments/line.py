"""A calibration line y = y0 + slope x: motor current and support spring share it.

Errors in both columns where both reading errors are stated, or their ratio; otherwise one total scatter about the line
(the reading errors that are stated come on top of it). The true point of a reading is integrated out along the line
with a prior that is flat in its length, measured in units of the reading errors: then neither column is preferred, and
the slope is that of orthogonal (Deming) regression (Hogg, Bovy & Lang 2010, section 7; Fuller 1987, section 1.3). A
prior flat in x instead would draw the slope to that of ordinary least squares, low by (sd_x / sd of the x's)^2. The
intercept is integrated out under a wide normal prior.
"""

from types import ModuleType

import jax.numpy as jnp
import numpy as np

from capsule_id.experiments.base import Experiment, Start, Theta, axis_label, band
from capsule_id.experiments.linear import NUISANCE_WIDTH
from capsule_id.experiments.misfit import Misfit
from capsule_id.parameters import Parameter, Prior, parameter
from capsule_id.rig.model import Rig, Table
from capsule_id.views import Comparison, Curve, Points

#: Default prior of a scatter: log-normal, median 1 % of the range of y, factor 100.
SCATTER_MEDIAN, SCATTER_FACTOR = 0.01, 100.0


class Line(Experiment):
    """y against x; subclasses name the columns and the slope."""

    ARRAYS = ("x", "y", "x_sd", "y_sd", "width")
    STATIC = ("scale_known", "sd_ratio")

    def __init__(self, table: Table, rig: Rig, x: str, y: str, slope: Parameter) -> None:
        super().__init__(table, rig)
        self.x_column, self.y_column, self.slope = table.columns[x], table.columns[y], slope
        self.x, self.y = self.x_column.values, self.y_column.values
        self.x_sd, self.y_sd = self.x_column.reading_sd, self.y_column.reading_sd
        self.width = NUISANCE_WIDTH * float(np.ptp(self.y))
        self.sd_ratio = table.settings.sd_ratio
        self.scale_known = self.x_column.sd is not None and self.y_column.sd is not None
        self.scatters = (None,) if self.scale_known else ("scatter",)

    @property
    def errors(self) -> str:
        """How the errors are modelled, in words for the report."""
        if self.scale_known:
            return "errors in both columns, as stated"
        if self.sd_ratio is not None:
            return "errors in both columns, their ratio as stated, their size estimated"
        return "one total scatter about the line (the reading errors of both columns are not stated)"

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        if self.scale_known:
            return (self.slope,)
        prior = Prior("lognormal", SCATTER_MEDIAN * float(np.ptp(self.y)), SCATTER_FACTOR)
        return self.slope, parameter("scatter", self.label, prior)

    @property
    def observed(self) -> np.ndarray:
        return self.y

    def misfits(self, theta: Theta, xp: ModuleType = jnp) -> tuple[Misfit]:
        slope, design = theta[self.slope.symbol], self.width * xp.ones((self.n, 1))
        # Readings scatter in y, and in x where the ratio of both errors is stated.
        across = 0.0 if self.sd_ratio is None else (slope / self.sd_ratio) ** 2
        estimated = 0.0 if self.scale_known else 1.0
        fixed, scale = self.y_sd**2 + slope**2 * self.x_sd**2, estimated * xp.sqrt(1.0 + across)
        return (Misfit(self.y - slope * self.x, fixed, scale, design, (self.y_sd**2, estimated)),)

    def intercept(self, theta: Theta) -> float:
        """Conditional mean of y0, SI."""
        return float(self.nuisance_mean(theta)[0] * self.width)

    def ordinary_line(self) -> tuple[float, float, float]:
        """Slope, intercept and residual sd of ordinary least squares: the paper's linear fit."""
        slope, intercept = np.polyfit(self.x, self.y, 1)
        rest = self.y - slope * self.x - intercept
        return float(slope), float(intercept), float(np.sqrt(rest @ rest / max(self.n - 2, 1)))

    def starts(self) -> dict[str, Start]:
        slope, _, sd = self.ordinary_line()
        starts = {self.slope.name: Start(abs(slope), 0.4)}
        if not self.scale_known:
            starts[f"scatter[{self.label}]"] = Start(max(sd, 1e-6 * float(np.ptp(self.y))), 0.3)
        return starts

    def comparison(self, theta: Theta, draws: list[Theta]) -> Comparison:
        x_unit, y_unit = self.x_column.to_display, self.y_column.to_display
        low, high = np.min(self.x), np.max(self.x)
        x = np.linspace(low - 0.04 * (high - low), high + 0.04 * (high - low), 60)

        def line(values: Theta) -> np.ndarray:
            return (self.intercept(values) + values[self.slope.symbol] * x) * y_unit

        lower, upper = band(np.array([line(draw) for draw in draws]))
        slope, intercept, _ = self.ordinary_line()
        curves = (
            Curve("this fit", x * x_unit, line(theta), lower, upper),
            Curve("the paper's fit", x * x_unit, (intercept + slope * x) * y_unit, role="paper"),
        )
        y_error = np.full(self.n, self.y_column.sd * y_unit) if self.y_column.sd else None
        return Comparison(
            self.kind,
            self.label,
            f"{self.label}: {self.y_column.name} against {self.x_column.name}",
            axis_label(self.x_column),
            axis_label(self.y_column),
            (Points(self.label, self.x * x_unit, self.y * y_unit, y_error),),
            curves,
            self.x * x_unit,
            self.residuals(theta, np)[: self.n],
        )
