"""Whether tilts and slides were measured on one surface."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

from capsule_id.experiments.checks.context import Fitted
from capsule_id.experiments.checks.series import LEVEL
from capsule_id.views import Finding

if TYPE_CHECKING:
    from capsule_id.experiments.friction_curve import FrictionExperiment


def check_one_surface(experiments: "Sequence[FrictionExperiment]", fit: Fitted) -> list[Finding]:
    """Expected: tilts and slides agree on mu."""
    tilts = [e for e in experiments if e.role == "static"]
    slides = [e for e in experiments if e.role != "static"]
    if not tilts or not slides:
        return []
    found = fit.tension(tilts, slides)
    facts = {
        "tilts": ", ".join(e.label for e in tilts),
        "slides": ", ".join(e.label for e in slides),
        "mu_tilts": found.one["mu"],
        "mu_slides": found.other["mu"],
        "p": found.p,
    }
    if found.p < LEVEL:
        return [Finding("friction.one_surface", "fail", facts, tilts[0].label)]
    return [Finding("friction.one_surface", "ok", facts)]
