"""Motor current: a known force on the rod balanced by the motor (paper, Fig. 3); K = dF/dI."""

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from capsule_id.experiments.kind import Kind, Twin, TwinTable, Values, made_by
from capsule_id.experiments.point_test import LINE_MESSAGES, Line, line_estimates, lint_line, refuse_idle_sd_ratio
from capsule_id.parameters import INSTRUMENT_ERRORS
from capsule_id.rig.model import Settings
from capsule_id.rig.schema import ColumnRule, QuantityRule

# declaration: Motor current: columns, settings, template and twin.


#: The twin's currents, A, and its reading errors, N and A.
CURRENTS = np.linspace(0.25, 2.0, 8)
FORCE_SD, CURRENT_SD = 0.03, 0.01


@dataclass(frozen=True, kw_only=True)
class MotorSettings(Settings):
    """Settings of a motor calibration; ``sd_ratio``: reading error of force / reading error of current, N/A."""

    sd_ratio: Annotated[float | None, QuantityRule("N/A")] = None


def _measure(values: Values, rng: np.random.Generator, seed: int) -> Twin:
    errors = (
        f'force_sd = {{ value = {FORCE_SD:g}, unit = "N" }}',
        f'current_sd = {{ value = {CURRENT_SD:g}, unit = "A" }}',
    )
    columns = {
        "force [N]": values["K"] * CURRENTS + FORCE_SD * rng.standard_normal(len(CURRENTS)),
        "current [A]": CURRENTS + CURRENT_SD * rng.standard_normal(len(CURRENTS)),
    }
    return Twin((TwinTable("motor_current.csv", columns, errors),))


TEMPLATE = """\
#: Force of the motor against its current: K. Columns: force [N], current [A].
#: sd_ratio = { value = ..., unit = "N/A" }: reading error of the force per that of the current, if only this is known.
# [[experiment]]
# kind = "motor_current"
# file = "motor_current.csv"
# force_sd = { value = 0.03, unit = "N" }
# current_sd = { value = 0.01, unit = "A" }
"""

KIND = Kind(
    name="motor_current",
    columns={"force": ColumnRule("N", varies=True), "current": ColumnRule("A", varies=True)},
    sets=(("force", "current"),),
    settings=MotorSettings,
    rules=(refuse_idle_sd_ratio,),
    read_by=INSTRUMENT_ERRORS,
    test="current",
    minutes=0.5,
    make=made_by(f"{__name__}:MotorCurrent"),
    template=TEMPLATE,
    informs="K",
    captions={"motor_current": "Counterpart of the paper's Fig. 3: the slope of the line is K."},
    messages=LINE_MESSAGES,
    lint=(lint_line,),
    paper=line_estimates,
    twin=_measure,
)


# experiment: Motor current: a known force on the rod balanced by the motor (paper, Fig. 3); K = dF/dI.


class MotorCurrent(Line):
    """Force against current: F = F0 + K I."""

    x_name, reading, symbol = "current", "force", "K"
    from_origin = True
