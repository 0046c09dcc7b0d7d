"""capsule-id: system identification for the vibro-impact capsule.

    rig folder -> Rig -> experiments -> log-posterior -> point fit -> emcee -> checks -> report

The public names are imported on first use, so that ``import capsule_id`` is free of JAX.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from capsule_id.capsule.model import CapsuleParameters as CapsuleParameters
    from capsule_id.capsule.model import Excitation as Excitation
    from capsule_id.capsule.model import Status as Status
    from capsule_id.capsule.model import Trajectory as Trajectory
    from capsule_id.capsule.model import simulate as simulate
    from capsule_id.capsule.model import status_message as status_message
    from capsule_id.capsule.response import Response as Response
    from capsule_id.capsule.response import response as response
    from capsule_id.capsule.smooth import Smoothing as Smoothing

_ROOMS = {
    "CapsuleParameters": "capsule_id.capsule.model",
    "Excitation": "capsule_id.capsule.model",
    "Response": "capsule_id.capsule.response",
    "Smoothing": "capsule_id.capsule.smooth",
    "Status": "capsule_id.capsule.model",
    "Trajectory": "capsule_id.capsule.model",
    "response": "capsule_id.capsule.response",
    "simulate": "capsule_id.capsule.model",
    "status_message": "capsule_id.capsule.model",
}


def __getattr__(name: str) -> Any:  # noqa: ANN401
    if name not in _ROOMS:
        raise AttributeError(f"module 'capsule_id' has no attribute '{name}'")
    return getattr(import_module(_ROOMS[name]), name)


def __dir__() -> list[str]:
    return sorted([*globals(), *_ROOMS])
