"""The reference cases as data: made by another program, checked against SciPy to 2e-12 m."""

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import jax
import numpy as np

from capsule_id.physics.model import CapsuleParameters, Excitation, Trajectory
from capsule_id.precision import COMPILE_QUICKLY

PARAMETERS = ("m1", "m2", "k1", "k2", "c", "mu", "v_s", "G", "g")


@dataclass(frozen=True)
class Cases:
    """The reference cases as one batch: states (25, 11, 4) at the ends of the first ten periods."""

    raw: list[dict]
    p: CapsuleParameters
    e: Excitation
    T: np.ndarray
    states: np.ndarray
    contacts: np.ndarray

    @property
    def times(self) -> np.ndarray:
        return self.T[:, None] * np.arange(11)

    def one(self, name: str) -> tuple[CapsuleParameters, Excitation, float]:
        """A case by its name: (p, e, T), unbatched."""
        i = [case["name"] for case in self.raw].index(name)
        return *jax.tree.map(lambda leaf: float(leaf[i]), (self.p, self.e)), float(self.T[i])


def read_cases() -> Cases:
    """The cases of exact_cases.json."""
    raw = json.loads((Path(__file__).parent / "physics" / "exact_cases.json").read_text())["cases"]
    column = {key: np.array([case[key] for case in raw]) for key in (*PARAMETERS, "P_d", "Omega")}
    capsule = CapsuleParameters(**{key: column[key] for key in PARAMETERS})
    p, e = jax.tree.map(
        lambda leaf: np.broadcast_to(leaf, len(raw)), (capsule, Excitation(column["P_d"], column["Omega"]))
    )
    return Cases(
        raw,
        p,
        e,
        2.0 * np.pi / column["Omega"],
        np.array([case["states_at_period_ends"] for case in raw]),
        np.array([case["contacts_in_10_periods"] for case in raw]),
    )


def jit_quickly(function: Callable) -> Callable:
    """``jax.jit`` without optimisation: for derivatives of short runs, which compile for longer than they run."""
    return jax.jit(function, compiler_options=dict(COMPILE_QUICKLY))


def states_of(t: Trajectory) -> np.ndarray:
    """(..., n, 4): X1, Y1, X2, Y2."""
    return np.stack([np.asarray(x) for x in (t.X1, t.Y1, t.X2, t.Y2)], axis=-1)


def assert_both_ways_as_scipy(t: Trajectory, expected: np.ndarray, contacts: int) -> None:
    """Assert that lane 0 follows the states (n, 4) of SciPy, and that they slide in both directions."""
    error = np.abs(states_of(t)[0] - expected).max(axis=0)
    assert error[[0, 2]].max() < 1e-9
    assert error[[1, 3]].max() < 1e-7
    assert int(t.contacts[0]) == contacts
    # Both directions of sliding are in the run, so both sides of the law are.
    assert expected[:, 3].min() < -1e-3
    assert expected[:, 3].max() > 1e-3
