"""capsule-id: system identification for the vibro-impact capsule.

    rig folder -> Rig -> experiments -> log-posterior -> point fit -> emcee -> checks -> report

    rig = capsule_id.read_rig("data/")          # folder -> Rig: SI, checked, hashed
    result = capsule_id.fit(rig, seed=0)        # Rig -> Result: point fit, posterior, findings
    result.write("results/twin")                # Result -> parameters.json, posterior.nc, report.html

The public names are imported on first use, so that ``import capsule_id`` is free of JAX.
"""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from capsule_id.api import Fit as Fit
    from capsule_id.api import fit as fit
    from capsule_id.errors import InputError as InputError
    from capsule_id.rig.read import read_rig as read_rig
    from capsule_id.synthetic import synthesize as synthesize

_HOME = {
    "Fit": "capsule_id.api",
    "fit": "capsule_id.api",
    "InputError": "capsule_id.errors",
    "read_rig": "capsule_id.rig.read",
    "synthesize": "capsule_id.synthetic",
}


def __getattr__(name: str) -> object:
    """Import a public name from its room when it is first asked for."""
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(_HOME[name]), name)


def __dir__() -> list[str]:
    return sorted([*globals(), *_HOME])
