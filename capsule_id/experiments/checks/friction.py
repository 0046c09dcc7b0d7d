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
    seen = f"mu = {found.one['mu']:.3f} by tilting, {found.other['mu']:.3f} by sliding (p = {found.p:.2g})"
    if found.p < LEVEL:
        labels = ", ".join(e.label for e in tilts)
        text = (
            f"{labels} and {', '.join(e.label for e in slides)}: expected one surface; {seen}: were they measured on the "
            "same surface, and is the tilt read at break-away?"
        )
        return [Finding("experiments agree", "fail", text, tilts[0].label)]
    return [Finding("experiments agree", "ok", seen)]
