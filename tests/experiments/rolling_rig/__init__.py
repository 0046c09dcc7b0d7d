"""A package that adds a kind of experiment, with parameters of its own, to capsule-id; ``test_plugin.py`` installs it."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Annotated

import numpy as np

from capsule_id.experiments.kind import Kind, made_by
from capsule_id.parameters import Parameter, Prior, scatter
from capsule_id.rig.model import Rig, Settings, Table
from capsule_id.rig.schema import ColumnRule, NameRule
from capsule_id.rig.toml import POSITIVE
from capsule_id.views import Finding, Message

C_RR = Parameter("c_rr", "1", "rolling resistance coefficient", r"c_\mathrm{rr}", Prior("lognormal", 0.01, 100.0))
SCATTER = scatter(
    "rolling_scatter", "N", "scatter of the rolling resistance", r"s_\mathrm{rr}", Prior("halfnormal", 0.0, 0.01)
)


@dataclass(frozen=True, kw_only=True)
class RollingSettings(Settings):
    """The wheel's name."""

    wheel: Annotated[str, NameRule()]


def _masses(table: Table[RollingSettings]) -> tuple[str, ...]:
    del table
    return "m1", "m2"


def _lint(table: Table[RollingSettings], rig: Rig) -> Iterable[Finding]:
    del rig
    if len(np.unique(table["speed"])) < 6:
        yield Finding("rolling.few", "warn", experiment=table.label)


KIND = Kind(
    name="rolling_resistance",
    columns={"speed": ColumnRule("m/s", POSITIVE), "force": ColumnRule("N", POSITIVE)},
    sets=(("speed", "force"),),
    settings=RollingSettings,
    masses=_masses,
    parameters=(C_RR, SCATTER),
    make=made_by("rolling_rig.experiment:RollingResistance"),
    template="""\
#: Rolling resistance: c_rr. Columns: speed [m/s], force [N].
# [[experiment]]
# kind = "rolling_resistance"
# file = "rolling_resistance.csv"
# wheel = "W1"
""",
    informs="c_rr",
    captions={"rolling_resistance": "Rolling resistance: the force at each speed, and the fitted one."},
    messages={
        "rolling.speeds": Message(
            "rolling at all speeds",
            ok="the force is the same at all {speeds} speeds",
            warn="expected the same force at all {speeds} speeds; it changes by {slope:.2g} N s/m. Roll on a harder floor.",
        ),
        "rolling.few": Message("speeds", warn="fewer than 6 speeds. Measure more."),
        "rolling.range": Message("Speeds of the wheel", caption="Where c_rr = {c_rr:.3f} was measured."),
    },
    lint=(_lint,),
)
