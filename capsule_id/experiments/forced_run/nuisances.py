"""Parameters of a forced run with their priors and starting values."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from capsule_id.experiments.base import Start
from capsule_id.experiments.clock import clock_parameters
from capsule_id.experiments.families.inclined import ground_parameters
from capsule_id.experiments.forced_run.declaration import CAPSULE_START, CORRELATION, CURRENT_AMPLITUDE, NOISE
from capsule_id.experiments.linear import NUISANCE_WIDTH
from capsule_id.parameters import Parameter, Prior, parameter

if TYPE_CHECKING:
    from capsule_id.experiments.forced_run.experiment import ForcedRun

#: Default prior of a channel's noise, without reading error: log-normal, median 1 % of its range, factor 100.
NOISE_MEDIAN, NOISE_FACTOR = 0.01, 100.0
#: Default prior of the current's amplitude: log-normal about half its range.
AMPLITUDE_FACTOR = 3.0
#: sd of the normal prior of the drive's phase, rad; wide but proper.
PHASE_WIDTH = np.pi


def run_parameters(run: "ForcedRun", ranges: np.ndarray) -> tuple[Parameter, ...]:
    """Return the parameters sampled for ``run``; ``ranges`` (channels,) of its readings, SI."""
    of, whole, settings = run.label, run.about.record, run.table.settings
    rows = [parameter("k1"), parameter("c"), *run.friction.parameters, *ground_parameters(run.table, run.rig)]
    free = ("k_cubic",) if run.spring is None else ("k_cubic", "c2")
    rows += [parameter(symbol) for symbol in free if symbol in run.rig.model.free]
    rows += clock_parameters(run.table, run.rig)
    if run.spring is not None:
        rows.append(parameter("k2", run.spring))
    if not run.gap_known:
        rows.append(parameter("G", whole, Prior("positive_normal", settings.gap.value, settings.gap.sd)))
    if run.driven_by_current:
        amplitude = 0.5 * float(np.ptp(run.table["current"]))
        rows += [parameter("K"), CURRENT_AMPLITUDE.named(whole, Prior("lognormal", amplitude, AMPLITUDE_FACTOR))]
    elif not run.drive_known:
        rows.append(parameter("P_d", whole, Prior("positive_normal", run.drive, run.drive_sd)))
    if "current" in run.inputs:
        rows.append(parameter("K"))
    if settings.P_on is not None and settings.P_on.sd > 0.0:
        rows.append(parameter("P_on", prior=Prior("normal", settings.P_on.value, settings.P_on.sd)))
    if settings.lag is not None and settings.lag.sd > 0.0:
        rows.append(parameter("lag", prior=Prior("positive_normal", settings.lag.value, settings.lag.sd)))
    elif settings.drive == "pulses" and settings.lag is None and "lag" in run.rig.model.free:
        rows.append(parameter("lag"))
    if run.has_phase and not run.prescribed:
        rows.append(parameter("phase", whole, Prior("normal", 0.0, PHASE_WIDTH)))
    length = NUISANCE_WIDTH * run.rough.length
    if not run.settled:
        rows.append(parameter("x_start", of, Prior("normal", 0.0, length)))
        if not run.prescribed:
            rows.append(parameter("y_start", of, Prior("normal", 0.0, run.Omega * length)))
    if run.moves:
        rows.append(CAPSULE_START.named(of, Prior("normal", 0.0, run.Omega * length)))
    for name, scale in zip(run.channels, ranges.tolist(), strict=True):
        rows.append(NOISE[name].named(whole, Prior("lognormal", NOISE_MEDIAN * scale, NOISE_FACTOR)))
    if run.coloured:
        rows += [CORRELATION[name].named(whole) for name in run.channels]
    return tuple(rows)


def run_starts(run: "ForcedRun") -> dict[str, Start]:
    """Starts of the nuisances from the record; other parameters start at bench estimates or prior centres."""
    rough, of = run.rough, run.label
    starts = _starts_of_record(run) if run.about.leads else {}
    if not run.settled:
        starts[f"x_start[{of}]"] = Start(rough.x_rel, 0.03 * rough.length)
        starts[f"y_start[{of}]"] = Start(rough.rate, 0.03 * run.Omega * rough.length)
    if run.moves:
        starts[f"capsule_start[{of}]"] = Start(rough.capsule_rate, 0.03 * run.Omega * rough.length)
    return starts


def _starts_of_record(run: "ForcedRun") -> dict[str, Start]:
    rough, of = run.rough, run.about.record
    starts = {f"phase[{of}]": Start(rough.phase, 0.02)}
    if not run.gap_known:
        starts[f"G[{of}]"] = Start(run.gap, 0.5 * run.table.settings.gap.sd / run.gap)
    if run.driven_by_current:
        starts[f"I_d[{of}]"] = Start(rough.amplitude, 0.005)
    elif not run.drive_known:
        starts[f"P_d[{of}]"] = Start(run.drive, 0.5 * run.drive_sd / run.drive)
    for name, noise in rough.noise.items():
        starts[f"noise_{name}[{of}]"] = Start(noise, 0.1)
    if run.coloured:
        starts |= {f"ar1_{name}[{of}]": Start(0.0, 0.1) for name in run.channels}
    return starts


def stated_sds(settings: Any, channels: Sequence[str], nuisance: str) -> tuple[np.ndarray, tuple[bool, ...]]:
    """Stated sd of a gain or delay by channel, and whether it is stated."""
    sds = [getattr(settings, f"{name}_{nuisance}_sd") for name in channels]
    return np.array([sd or 0.0 for sd in sds]), tuple(sd is not None for sd in sds)
