"""Force transducer: its reading under known forces, in counts, volts or any other number."""

from dataclasses import dataclass
from typing import Annotated

from capsule_id.experiments.kind import Kind, made_by
from capsule_id.experiments.point_test import LINE_MESSAGES, Line, line_estimates, lint_line, refuse_idle_sd_ratio
from capsule_id.parameters import INSTRUMENT_ERRORS, Parameter, Prior
from capsule_id.rig.model import Settings, Table
from capsule_id.rig.schema import ColumnRule, QuantityRule

# declaration: Force transducer: columns, settings and template. Its readings are counts, volts or any other number.


#: Row of every transducer; the unit of its readings is unknown, so the prior spans ten decades.
SENSITIVITY = Parameter(
    "sensitivity", "1/N", "reading of a force transducer per force", "s", Prior("lognormal", 100.0, 1e5)
)


@dataclass(frozen=True, kw_only=True)
class TransducerSettings(Settings):
    """Settings of a calibration; ``sd_ratio``: reading error of the reading / error of the force, 1/N."""

    sd_ratio: Annotated[float | None, QuantityRule("1/N")] = None


TEMPLATE = """\
#: Reading of a force transducer under known forces: its sensitivity. Columns: reading [1] (counts, volts), force [N].
#: plateaus makes the readings of a time trace of steps, such as weights that are added one by one: a level for each step.
#: sd_ratio as above, in 1/N.
#: reject drops outliers of any record with times: further than n_sd robust sds from the median of the window.
# [[experiment]]
# kind = "transducer"
# file = "load_cell.csv"
# plateaus = { levels = [0, 10, 20, 10, 0], unit = "N", guard = "2 s" }
# reject = { rule = "hampel", window = "1 s", n_sd = 5 }
# columns = { time = { from = 1, unit = "s" }, reading = { from = 2, unit = "1" } }
"""

KIND = Kind(
    name="transducer",
    columns={"reading": ColumnRule("1", varies=True, usual=(1e-9, 1e9)), "force": ColumnRule("N", varies=True)},
    sets=(("reading", "force"),),
    settings=TransducerSettings,
    rules=(refuse_idle_sd_ratio,),
    parameters=(SENSITIVITY,),
    read_by=INSTRUMENT_ERRORS,
    test="level",
    minutes=0.5,
    make=made_by(f"{__name__}:Transducer"),
    template=TEMPLATE,
    informs="sensitivity of that transducer",
    captions={"transducer": "The slope of the line is the sensitivity of the transducer."},
    messages=LINE_MESSAGES,
    lint=(lint_line,),
    paper=line_estimates,
)


# experiment: Force transducer: its reading under known forces; sensitivity = d(reading)/d(force).


class Transducer(Line):
    """Reading against force: r = r0 + sensitivity F."""

    x_name, reading, symbol, unit_of_y = "force", "reading", "sensitivity", "1"

    def slope_of(self, table: Table) -> Parameter:
        return SENSITIVITY.named(table.label)
