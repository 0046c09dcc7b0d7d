"""Rig tests built in memory, without files: tables, rigs, and the decays that records are made of."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from capsule_id.experiments.kind import default_registry
from capsule_id.parameters import Prior
from capsule_id.rig.model import Column, Quantity, Rig, Table

G = 9.81
M1, M2 = 0.110, 0.530
K1, C = 1420.0, 3.89
ROD, CAPSULE = Quantity(M1), Quantity(M2)


def column(name: str, values: ArrayLike, sd: float | None = None, resolution: float | None = None) -> Column:
    """A column in SI; ``sd`` and ``resolution`` are None where not stated."""
    return Column(name, "SI", 1.0, np.asarray(values, dtype=float), sd, resolution)


def table(kind: str, columns: Sequence[Column], label: str = "", **settings: object) -> Table:
    """An ``[[experiment]]`` of these columns."""
    rows = np.arange(2, 2 + len(columns[0].values))
    rule = default_registry()[kind]
    own, named = rule.settings(**settings), {c.name: c for c in columns}
    return Table(kind, label or kind, f"{label or kind}.csv", named, own, rows, rule.bench)


def rig(
    *tables: Table,
    m1: Quantity = ROD,
    m2: Quantity = CAPSULE,
    priors: Mapping[str, Prior] | None = None,
) -> Rig:
    """A rig of these tables; masses are exact unless stated otherwise."""
    return Rig("bench", True, m1, m2, Quantity(G), priors or {}, tables, {}, Path("bench"))


def released(time: np.ndarray, release: float, k1: float = K1, c: float = C, m1: float = M1) -> np.ndarray:
    """(n,) x_rel, m, of a viscous decay released at rest: the textbook solution."""
    gamma = c / (2.0 * m1)
    omega = np.sqrt(k1 / m1 - gamma**2)
    return release * np.exp(-gamma * time) * (np.cos(omega * time) + gamma / omega * np.sin(omega * time))
