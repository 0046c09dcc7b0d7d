"""Steady sliding: friction force, or coefficient, at a held speed."""

from capsule_id.experiments.friction import (
    CAPTIONS,
    MASSES_OF_FREE,
    MESSAGES,
    NORMAL_FORCE_COLUMN,
    SCATTER_OF_MU,
    Pulls,
    PullSettings,
    check_load,
    check_normal_force,
    check_scatter,
    friction_estimates,
    friction_panels,
    lint_slides,
    masses_of_pulls,
)
from capsule_id.experiments.kind import Kind, made_by
from capsule_id.parameters import INSTRUMENT_ERRORS, scatter
from capsule_id.rig.schema import ColumnRule, Entry
from capsule_id.rig.toml import POSITIVE

# declaration: Steady sliding: columns and template.


SLIDING_SCATTER = scatter(
    "sliding_scatter", "1", "relative scatter of mu, steady sliding", r"s_\mathrm{sl}", SCATTER_OF_MU
)


def _check_law(entry: Entry[PullSettings]) -> None:
    """Refuse readings without speeds under a law that depends on the speed, and a viscous part beside normal forces of rows.

    Raises
    ------
    InputError
        At the entry.
    """
    columns, model = entry.table.columns, entry.node.document.data.get("model", {})
    law = model if isinstance(model, dict) else {}  # its own reader refuses another type
    if "speed" not in columns and (law.get("friction") != "constant" or "viscous" in law.get("free", [])):
        rule = "sliding readings without a speed need a friction that does not depend on it"
        remedy = 'add the column speed, or write friction = "constant" in [model]'
        raise entry.error("", rule, " ".join(columns), remedy)
    if "normal_force" in columns and "viscous" in law.get("free", []):
        rule = "a column normal_force and a viscous part are not fitted together"
        raise entry.error("", rule, "both", "make an experiment with its own N0 of each load, or remove viscous")


TEMPLATE = """\
#: Steady sliding, a row per point: mu and v_s. Columns: speed [m/s], and force [N] or coefficient [1]; normal_force [N]
#: beside force where it differs from row to row. With friction = "constant" in [model] the speed may be absent.
# [[experiment]]
# kind = "sliding_friction"
# file = "sliding_friction.csv"
# direction = "forward"                               # "backward": it slid away from the support spring
# slope = { value = 0, unit = "deg" }                   # this one alone; default: [rig]
# N0 = { value = 0, unit = "N" }
#: On a slope a stated normal force needs load_is = "weight", or "pressed" for a force without weight.
"""

KIND = Kind(
    name="sliding_friction",
    columns={
        "speed": ColumnRule("m/s", POSITIVE),
        "force": ColumnRule("N", POSITIVE),
        "coefficient": ColumnRule("1", POSITIVE),
        "normal_force": NORMAL_FORCE_COLUMN,
    },
    sets=(("speed", "force"), ("speed", "coefficient"), ("force",), ("coefficient",)),
    optional=("normal_force",),
    settings=PullSettings,
    meant=("sliding", "break-away", "no pull"),
    rules=(check_normal_force, _check_law, check_load),
    masses=masses_of_pulls,
    masses_of_free=MASSES_OF_FREE,
    parameters=(SLIDING_SCATTER,),
    read_by=INSTRUMENT_ERRORS,
    test="slide",
    minutes=2.0,
    set_by="speed",
    make=made_by(f"{__name__}:SlidingFriction"),
    template=TEMPLATE,
    informs="mu, v_s",
    captions=CAPTIONS,
    messages=MESSAGES,
    lint=(lint_slides,),
    check=check_scatter,
    paper=friction_estimates,
    panels=friction_panels,
)


# experiment: Steady sliding: friction force, or coefficient, at a held speed.


class SlidingFriction(Pulls):
    """Steady sliding. Without a speed the friction must not depend on it."""

    role, scatter = "sliding", SLIDING_SCATTER
