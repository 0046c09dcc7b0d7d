"""Which capsule model an event-driven experiment predicts with: the exact one, or the smoothed one of some widths."""

from typing import Any, Literal

import numpy as np

from capsule_id.capsule.smooth import Smoothing

Model = Literal["exact", "smooth"]


def forward_model(widths: Smoothing | None) -> tuple[Model, np.ndarray]:
    """Model and its numbers (4,), as an experiment keeps them; None: the exact one."""
    if widths is None:
        return "exact", np.zeros(4)
    numbers = (widths.velocity, widths.penetration, widths.rounding, widths.tolerance)
    return "smooth", np.array([float(x) for x in numbers])


def widths_of(model: Model, numbers: Any) -> Smoothing | None:
    """The inverse: what ``simulate`` takes."""
    return None if model == "exact" else Smoothing(*(numbers[i] for i in range(4)))
