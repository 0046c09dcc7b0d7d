"""Channels of a free decay: the displacement x_rel, its rate, or the rod's absolute acceleration.

The capsule is at rest, so the rate of x_rel is the rod's velocity, and its second derivative the rod's acceleration. A
constant part, such as the component of gravity along the sensor's axis, is the offset that every fit integrates out.
"""

from dataclasses import dataclass

from capsule_id.parameters import Parameter, scatter
from capsule_id.rig.model import Table


@dataclass(frozen=True)
class Channel:
    """One recorded quantity: ``order`` of the time derivative of x_rel, and the noise of a sample."""

    order: int
    noise: Parameter

    def deflection(self, omega: float) -> float:
        """x_rel at a turning point over the peak of the channel that belongs to it, at ``omega`` rad/s; SI."""
        return (1.0, 1.0 / omega, -1.0 / omega**2)[self.order]


#: By column, in the order of the derivative, which is the order in which the channels of a file are fitted.
CHANNELS = {
    "x_rel": Channel(0, scatter("noise_sd", "m", "noise of a record", r"\sigma")),
    "velocity": Channel(1, scatter("noise_velocity", "m/s", "noise of a velocity record", r"\sigma_v")),
    "acceleration": Channel(2, scatter("noise_acceleration", "m/s^2", "noise of an acceleration record", r"\sigma_a")),
}


def channel_of(table: Table) -> str:
    """Column of the first channel of ``table``."""
    return next(name for name in CHANNELS if name in table.columns)
