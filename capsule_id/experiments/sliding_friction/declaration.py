"""Steady sliding: columns and template."""

from functools import partial

from capsule_id.experiments.families.friction import (
    CAPTIONS,
    MASSES_OF_FREE,
    MESSAGES,
    SurfaceSettings,
    check_scatter,
    friction_estimates,
    friction_panels,
)
from capsule_id.experiments.kind import Kind, made_by
from capsule_id.experiments.lint import lint_rows
from capsule_id.parameters import Prior, scatter
from capsule_id.rig.domains import POSITIVE
from capsule_id.rig.schema import ColumnRule

SLIDING_SCATTER = scatter(
    "sliding_scatter", "1", "relative scatter of mu, steady sliding", r"s_\mathrm{sl}", Prior("halfnormal", 0.0, 0.05)
)


TEMPLATE = """\
#: Steady sliding, a row per point: mu and v_s. Columns: speed [m/s], and force [N] or coefficient [1].
# [[experiment]]
# kind = "sliding_friction"
# file = "sliding_friction.csv"
# direction = "forward"                               # "backward": it slid away from the support spring
# slope = { value = 0, unit = "deg" }                   # this one alone; default: [rig]
# N0 = { value = 0, unit = "N" }
"""

KIND = Kind(
    name="sliding_friction",
    columns={
        "speed": ColumnRule("m/s", POSITIVE),
        "force": ColumnRule("N", POSITIVE),
        "coefficient": ColumnRule("1", POSITIVE),
    },
    sets=(("speed", "force"), ("speed", "coefficient")),
    settings=SurfaceSettings,
    masses=lambda table: ("m1", "m2") if "force" in table.columns else (),
    masses_of_free=MASSES_OF_FREE,
    parameters=(SLIDING_SCATTER,),
    make=made_by("capsule_id.experiments.sliding_friction.experiment:SlidingFriction"),
    template=TEMPLATE,
    informs="mu, v_s",
    captions=CAPTIONS,
    messages=MESSAGES,
    lint=(partial(lint_rows, fewest=5),),
    check=check_scatter,
    paper=friction_estimates,
    panels=friction_panels,
)
