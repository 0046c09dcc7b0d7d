"""The general capsule's reference cases as lanes: one batch for each kind of drive."""

import json
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from capsule_id.physics.drives import Pulses, RecordedDrive
from capsule_id.physics.model import CapsuleParameters, Excitation

CAPSULE = (
    "m1", "m2", "k1", "k2", "c", "mu", "v_s", "G", "g",
    "k_cubic", "c2", "k2_back", "G_back", "slope", "N0", "mu_back", "ratio", "viscous",
)  # fmt: skip
DRIVES = {"harmonic": Excitation, "pulses": Pulses, "recorded": RecordedDrive}
#: Points of every record: those of the shorter ones go on after the run.
POINTS = 241


class Batch(NamedTuple):
    """Cases of one kind of drive, every leaf (L,): times (L, 11), states (L, 11, 4), closings (L,) of both gaps."""

    raw: list[dict[str, Any]]
    p: CapsuleParameters
    e: Any
    times: np.ndarray
    initial: tuple[np.ndarray, ...]
    states: np.ndarray
    closings: tuple[np.ndarray, np.ndarray]

    @property
    def mean_velocity(self) -> np.ndarray:
        """(L,) m/s over the 5th to the 10th period."""
        return np.array([case["mean_velocity"] for case in self.raw])

    def one(self, i: int) -> "Batch":
        """Case i alone, as a batch."""
        p, e, times, initial, states, closings = jax.tree.map(lambda leaf: leaf[i : i + 1], self[1:])
        return Batch([self.raw[i]], p, e, times, initial, states, closings)


@cache
def read_general_cases(kind: str) -> Batch:
    """The cases of general_cases.json with this kind of drive."""
    text = (Path(__file__).parent / "physics" / "general_cases.json").read_text(encoding="utf-8")
    raw = [case for case in json.loads(text)["cases"] if case["drive"]["kind"] == kind]
    columns = {name: np.array([np.inf if case[name] is None else case[name] for case in raw]) for name in CAPSULE}
    names = [name for name in raw[0]["drive"] if name not in ("kind", "time", "force")]
    drive = {name: np.array([float(case["drive"][name]) for case in raw]) for name in names}
    if kind == "recorded":
        drive["times"], drive["force"] = (np.array(rows) for rows in zip(*map(_record, raw), strict=True))
    period = np.array([case["period"] for case in raw])
    initial = np.array([case["initial"] for case in raw])
    states = np.concatenate([initial[:, None], [case["states"] for case in raw]], axis=1)
    closings = tuple(np.array([case[f"{side}_closings"] for case in raw]) for side in ("front", "back"))
    times = period[:, None] * np.arange(11)
    if kind == "recorded":
        times[:, -1] = [case["drive"]["time"][-1] for case in raw]
    return Batch(raw, CapsuleParameters(**columns), DRIVES[kind](**drive), times, tuple(initial.T), states, closings)


def _record(case: dict[str, Any]) -> tuple[list[float], list[float]]:
    time, force = case["drive"]["time"], case["drive"]["force"]
    more = POINTS - len(time)
    return [*time, *(time[-1] + 1.0 + np.arange(more))], [*force, *[0.0] * more]
