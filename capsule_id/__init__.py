"""capsule-id: system identification for the vibro-impact capsule.

    rig folder -> Rig -> experiments -> log-posterior -> point fit -> emcee -> checks -> report

    rig = capsule_id.read_rig("data/")          # folder -> Rig: SI, checked, hashed
    result = capsule_id.fit(rig, seed=0)        # Rig -> Result: point fit, posterior, findings
    result.write("results/twin")                # Result -> parameters.json, posterior.nc, report.html

The public names are imported on first use, so that ``import capsule_id`` is free of JAX.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    __version__: str
    from capsule_id.api import Fit as Fit
    from capsule_id.api import fit as fit
    from capsule_id.api import read_rig as read_rig
    from capsule_id.errors import InputError as InputError
    from capsule_id.motions.response import Response as Response
    from capsule_id.motions.response import Settling as Settling
    from capsule_id.motions.response import response as response
    from capsule_id.motions.sweep import continuation as continuation
    from capsule_id.motions.sweep import diagram as diagram
    from capsule_id.motions.sweep import motion_map as motion_map
    from capsule_id.physics.model import CapsuleParameters as CapsuleParameters
    from capsule_id.physics.model import Excitation as Excitation
    from capsule_id.physics.model import Status as Status
    from capsule_id.physics.model import Trajectory as Trajectory
    from capsule_id.physics.model import simulate as simulate
    from capsule_id.physics.model import status_message as status_message
    from capsule_id.physics.smooth.engine import Smoothing as Smoothing
    from capsule_id.synthetic import synthesize as synthesize

_HOME = {
    "CapsuleParameters": "capsule_id.physics.model",
    "continuation": "capsule_id.motions.sweep",
    "diagram": "capsule_id.motions.sweep",
    "Excitation": "capsule_id.physics.model",
    "Fit": "capsule_id.api",
    "fit": "capsule_id.api",
    "InputError": "capsule_id.errors",
    "motion_map": "capsule_id.motions.sweep",
    "read_rig": "capsule_id.api",
    "Response": "capsule_id.motions.response",
    "response": "capsule_id.motions.response",
    "Settling": "capsule_id.motions.response",
    "simulate": "capsule_id.physics.model",
    "Smoothing": "capsule_id.physics.smooth.engine",
    "Status": "capsule_id.physics.model",
    "status_message": "capsule_id.physics.model",
    "synthesize": "capsule_id.synthetic",
    "Trajectory": "capsule_id.physics.model",
}


def __getattr__(name: str) -> Any:
    """Import a public name from its module on first use; the version is that of the installed distribution."""
    if name == "__version__":
        from importlib.metadata import version

        return version("capsule-id")
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(_HOME[name]), name)


def __dir__() -> list[str]:
    return sorted([*globals(), *_HOME, "__version__"])
