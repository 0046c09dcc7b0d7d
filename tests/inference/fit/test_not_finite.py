"""The error of a joint fit without a finite start says what is not finite."""

from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from capsule_id.inference import joint_fit


@pytest.mark.parametrize("motion", [True, False])
def test_the_parameter_whose_derivative_is_not_finite_is_named(motion: bool) -> None:
    """Before: "check masses, gaps and settings of the runs"."""
    target = cast(Any, SimpleNamespace(names=("k1", "c", "mu"), located=np.array([0, 2])))
    jacobian = np.ones((1, 5, 2))
    jacobian[0, 3, 1] = np.nan
    residuals = np.full((1, 5), 1.0 if motion else np.nan)
    fit = cast(Any, SimpleNamespace(jacobian=jacobian, residuals=residuals))
    error = joint_fit._not_finite(target, fit, 4)
    assert ("its derivative is not: mu" in str(error)) == motion
    # Negative control: without a finite motion the derivative is no cause.
    assert ("check masses, gaps" in str(error)) == (not motion)
