"""Test whether the residuals of a run repeat with the excitation.

Noise does not know the phase of the drive. An error of the model, such as a wrong friction law, repeats with every
period of a periodic motion. Coloured noise can hide it from a test of whiteness: it is slow beside the samples.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float
from scipy import stats

from capsule_id.experiments.checks.context import Fitted
from capsule_id.experiments.checks.series import LEVEL
from capsule_id.views import Finding

if TYPE_CHECKING:
    from capsule_id.experiments.forced_run.experiment import ForcedRun

#: Largest number of harmonics of the excitation; fewest samples of a period for each of them.
HARMONICS, SAMPLES_PER_HARMONIC = 10, 4
#: Fewest whole periods of a record: in fewer ones a slow error of the noise looks like a repeated one.
FEWEST_PERIODS = 4


def check_repeated(runs: "Sequence[ForcedRun]", fit: Fitted) -> list[Finding]:
    """Check that the residuals of no record repeat with the excitation."""
    tests = [
        (run, label, *found)
        for run in runs
        for label, residuals in run.records(run.local(fit.values))
        if (found := repetition(run, residuals)) is not None
    ]
    findings = []
    for run, label, F, p in tests:
        if p * len(tests) < LEVEL:
            facts = {"record": label, "F": F, "p": p, **run.noise_facts()}
            findings.append(Finding("runs.repeated", "fail", facts, run.label))
    if findings or not tests:
        return findings
    return [Finding("runs.repeated", "ok", {"p": min(p for *_, p in tests)})]


def repetition(run: "ForcedRun", residuals: Float[np.ndarray, " n"]) -> tuple[float, float] | None:
    """F statistic of the harmonics of the excitation in ``residuals``, and its p-value; None for a short record."""
    assert run.cycles is not None, "a run has an excitation"
    cycles = run.cycles
    periods = float(cycles[-1] - cycles[0])
    number = min(HARMONICS, int(len(cycles) / periods / SAMPLES_PER_HARMONIC))
    freedom = len(cycles) - 2 * number - 1
    if periods < FEWEST_PERIODS or number < 1 or freedom < 1:
        return None
    angle = 2.0 * np.pi * np.outer(cycles, np.arange(1, number + 1))
    design = np.column_stack([np.ones(len(cycles)), np.cos(angle), np.sin(angle)])
    rest = residuals - design @ np.linalg.lstsq(design, residuals, rcond=None)[0]
    own, whole = float(np.sum(rest**2)), float(np.sum((residuals - np.mean(residuals)) ** 2))
    F = (whole - own) / (2 * number) / max(own / freedom, np.finfo(float).tiny)
    return F, float(stats.f.sf(F, 2 * number, freedom))
