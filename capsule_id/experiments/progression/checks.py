"""Check of a fitted progression: how much of the motion the model leaves unexplained."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from capsule_id.experiments.checks.context import Fitted
from capsule_id.views import Finding

if TYPE_CHECKING:
    from capsule_id.experiments.progression.experiment import Progression

#: Largest discrepancy of a model that explains the motion, relative to the rms of the measured mean velocities.
LARGEST_DISCREPANCY = 0.3


def check_discrepancy(experiments: "Sequence[Progression]", fit: Fitted) -> list[Finding]:
    """Compare the discrepancy with the scatter of the trials and with the measured velocities."""
    findings = []
    for e in experiments:
        theta = e.local(fit.values)
        sizes = [e.local(draw)["discrepancy"] for draw in fit.draws] or [theta["discrepancy"]]
        size, time = float(np.median(sizes)), e.setting @ e.time
        velocity = e.distance / time
        variance = e.reading_variance + theta["trial_sd"] ** 2 + (theta["trial_scatter"] * e.distance) ** 2
        rms = float(np.sqrt(np.mean(velocity**2)))
        facts = {"size": 1e3 * size, "scatter": 1e3 * float(np.sqrt(np.mean(variance / time**2))), "rms": 1e3 * rms}
        within = "ok" if facts["size"] <= facts["scatter"] else "warn"
        level = "fail" if size > LARGEST_DISCREPANCY * rms else within
        findings.append(Finding("progression.discrepancy", level, facts, e.label))
    return findings
