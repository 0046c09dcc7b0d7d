"""Starting points of the point fit of a progression, from the readings alone."""

from typing import TYPE_CHECKING, cast

import numpy as np

from capsule_id.experiments.base import Start
from capsule_id.parameters import Prior

if TYPE_CHECKING:
    from capsule_id.experiments.progression.experiment import Progression

#: Damping ratio and friction coefficient of the centre of the starting points, dimensionless.
DAMPING_RATIO, FRICTION = 0.1, 0.3


def starts_of(e: "Progression") -> dict[str, Start]:
    """Start of every parameter by name."""
    m1, m2 = e.rig.mass("m1"), e.rig.mass("m2")
    k1 = m1 * (2.0 * np.pi / float(np.median(e.settings[:, 0]))) ** 2
    largest = float(np.max(np.abs(e.distance)))
    priors = {row.symbol: cast(Prior, row.prior) for row in e.parameters if row.prior}
    starts = {
        "k1": Start(k1, 0.7),
        "c": Start(2.0 * DAMPING_RATIO * float(np.sqrt(k1 * m1)), 1.0),
        "mu": Start(FRICTION, 0.5),
        "mu_back": Start(FRICTION, 0.5),
        "v_s": Start(0.3, 1.0),
        "ratio": Start(0.7, 0.3),
        "lag": Start(0.05 * float(np.median(e.settings[:, 0])), 1.0),
        "session_sd": Start(0.05, 0.3),
        **{f"{symbol}[{e.label}]": Start(0.0, 1.0) for symbol in e.sessions.symbols},
        "trial_scatter": Start(0.05, 0.3),
        f"trial_sd[{e.label}]": Start(max(0.01 * largest, float(np.sqrt(e.reading_variance))), 0.3),
        f"discrepancy[{e.label}]": Start(0.5 * priors["discrepancy"].spread, 0.3),
    }
    for name in e.mirrored:
        prior = priors[name]
        friction = FRICTION * (m1 + m2) * e.rig.g.value
        starts[name] = Start(prior.location if abs(prior.location) > prior.spread else friction, 0.5 * prior.spread)
    known = {row.name for row in e.parameters}
    return {name: start for name, start in starts.items() if name in known}
