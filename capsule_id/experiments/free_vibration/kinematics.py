"""Finding on the columns of a free decay: each further channel must be a derivative of the first one."""

from collections.abc import Iterable
from typing import Any

import numpy as np

from capsule_id.experiments.free_vibration.readings.channels import CHANNELS
from capsule_id.records.faults.channels import FEWEST_PERIODS, SIGN_ERRORS, derivative_ratio, phasor
from capsule_id.rig.model import Table
from capsule_id.views import Facts, Finding, Message

#: Admissible ratio of a channel to the derivative of the first one, at the frequency of the decay.
LOWEST, HIGHEST = 0.5, 2.0
#: Name of a derivative by its order.
DERIVATIVES = {1: "derivative", 2: "second derivative"}


def lint_kinematics(table: Table[Any], used: slice, period: float) -> Iterable[Finding]:
    """Report channels that contradict each other at the frequency 1/``period`` of the decay, Hz."""
    first, *others = [name for name in CHANNELS if name in table.columns]
    time, Omega = table["time"][used], 2.0 * np.pi / period
    if table.settings.capsule != "held" or time[-1] - time[0] < FEWEST_PERIODS * period:
        return
    lower = phasor(time, table[first][used], Omega)
    for name in others:
        higher = phasor(time, table[name][used], Omega)
        order = CHANNELS[name].order - CHANNELS[first].order
        ratio = derivative_ratio(lower, higher, Omega, order).real
        seen = all(abs(one.value) > SIGN_ERRORS * one.sd for one in (lower, higher))
        if seen and not LOWEST <= ratio <= HIGHEST:
            facts = {"file": table.file, "name": name, "first": first, "order": order, "ratio": ratio}
            yield Finding("decays.kinematics", "fail", facts, table.label)


def _contradiction(facts: Facts) -> str:
    """The ratio of the two columns, and what to check."""
    check = "Check the units of both columns."
    if -HIGHEST <= facts["ratio"] <= -LOWEST:
        check = "One of them has the wrong sign: map it with scale = -1."
    return (
        f"{facts['file']}: {facts['name']} must be the {DERIVATIVES[facts['order']]} of {facts['first']}; at the frequency "
        f"of the decay it is {facts['ratio']:.3g} times that ({LOWEST:g} to {HIGHEST:g} allowed). {check} Or leave one of "
        f"them out."
    )


MESSAGES = {"decays.kinematics": Message("columns of a decay", fail=_contradiction)}
