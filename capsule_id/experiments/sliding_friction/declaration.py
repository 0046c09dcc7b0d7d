"""Steady sliding: columns and template."""

from functools import partial
from typing import TYPE_CHECKING

from capsule_id.experiments.families.friction import (
    CAPTIONS,
    MESSAGES,
    check_scatter,
    friction_estimates,
    friction_panels,
)
from capsule_id.experiments.kind import Kind
from capsule_id.experiments.lint import lint_rows
from capsule_id.parameters import Prior, scatter
from capsule_id.rig.domains import POSITIVE
from capsule_id.rig.model import Rig, Table
from capsule_id.rig.schema import ColumnRule

if TYPE_CHECKING:
    from capsule_id.experiments.sliding_friction.experiment import SlidingFriction

SLIDING_SCATTER = scatter(
    "sliding_scatter", "1", "relative scatter of mu, steady sliding", r"s_\mathrm{sl}", Prior("halfnormal", 0.0, 0.05)
)


def _masses(table: Table) -> tuple[str, ...]:
    """A force is divided by the weight."""
    return ("m1", "m2") if "force" in table.columns else ()


def _make(table: Table, rig: Rig) -> tuple["SlidingFriction"]:
    from capsule_id.experiments.sliding_friction.experiment import SlidingFriction

    return (SlidingFriction(table, rig),)


TEMPLATE = """\
#: Steady sliding, a row per point: mu and v_s. Columns: speed [m/s], and force [N] or coefficient [1].
# [[experiment]]
# kind = "sliding_friction"
# file = "sliding_friction.csv"
"""

KIND = Kind(
    name="sliding_friction",
    columns={
        "speed": ColumnRule("m/s", POSITIVE),
        "force": ColumnRule("N", POSITIVE),
        "coefficient": ColumnRule("1", POSITIVE),
    },
    sets=(("speed", "force"), ("speed", "coefficient")),
    masses=_masses,
    parameters=(SLIDING_SCATTER,),
    make=_make,
    template=TEMPLATE,
    informs="mu, v_s",
    captions=CAPTIONS,
    messages=MESSAGES,
    lint=(partial(lint_rows, fewest=5),),
    check=check_scatter,
    paper=friction_estimates,
    panels=friction_panels,
)
