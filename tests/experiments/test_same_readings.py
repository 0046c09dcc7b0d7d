"""Readings without any scatter: refused where nothing bounds their scatter from below."""

import bench
import numpy as np
import pytest

from capsule_id.errors import InputError
from capsule_id.experiments.kind import make_experiments
from capsule_id.rig.model import Table


def tilts(*angles: float, resolution: float | None = None, label: str = "a") -> Table:
    column = bench.column("angle", np.deg2rad(angles), resolution=resolution)
    return bench.table("static_friction", [column], label)


@pytest.mark.parametrize("tables", [(tilts(33.0, 33.0, 33.0),), (tilts(33.0), tilts(33.0, label="b"))])
def test_identical_trials_need_their_reading_step(tables: tuple[Table, ...]) -> None:
    with pytest.raises(InputError, match="state angle_resolution"):
        make_experiments(bench.rig(*tables))


def test_identical_pushes_need_it_too() -> None:
    columns = [bench.column("speed", [0.3, 0.3]), bench.column("distance", [0.0096, 0.0096])]
    with pytest.raises(InputError, match="state distance_resolution"):
        make_experiments(bench.rig(bench.table("dynamic_friction", columns)))


@pytest.mark.parametrize(
    "tables",
    [
        (tilts(33.0),),
        (tilts(33.0, 33.0, resolution=0.01),),
        (tilts(33.0, 33.0), tilts(33.5, label="b")),
        (
            tilts(33.0, 33.0),
            bench.table(
                "static_friction",
                [bench.column("height", [0.1]), bench.column("length", [0.2])],
                "c",
                length_is="board",
            ),
        ),
    ],
)
def test_others_are_taken(tables: tuple[Table, ...]) -> None:
    """The negative control."""
    assert len(make_experiments(bench.rig(*tables))) == len(tables)
