"""Do tilts and slides agree? The p-value on rigs where they do, and on rigs where they do not."""

from pathlib import Path

import numpy as np
import pytest

from capsule_id.experiments.dynamic_friction import DISTANCE_SD, SPEED_SD, pushes
from capsule_id.experiments.kind import default_registry, make_experiments
from capsule_id.experiments.static_friction import tilts
from capsule_id.inference.point_stage import tension
from capsule_id.rig.model import Column, Quantity, Rig, Table
from capsule_id.synthetic import Truth

TRUTH = Truth()


def column(name: str, values: np.ndarray, sd: float | None = None) -> Column:
    return Column(name, "SI", 1.0, values, sd)


def table(kind: str, *columns: Column) -> Table:
    rows = np.arange(2, 2 + len(columns[0].values))
    return Table(kind, kind, f"{kind}.csv", {c.name: c for c in columns}, default_registry()[kind].settings(), rows)


def p_value(seed: int, tilted_mu: float = TRUTH["mu"]) -> float:
    """Of a surface measured by the twin's protocol; the tilts on one of ``tilted_mu``."""
    rng = np.random.default_rng(seed)
    tilted, pushed = tilts(rng, tilted_mu), pushes(rng, TRUTH["mu"], TRUTH["v_s"], TRUTH["g"])
    tables = (
        table("static_friction", column("angle", np.deg2rad(tilted["angle [deg]"]))),
        table(
            "dynamic_friction",
            column("speed", pushed["speed [m/s]"], SPEED_SD),
            column("distance", 1e-3 * pushed["distance [mm]"], DISTANCE_SD),
        ),
    )
    rig = Rig(
        "bench", True, Quantity(TRUTH["m1"]), Quantity(TRUTH["m2"]), Quantity(TRUTH["g"]), {}, tables, {}, Path("bench")
    )
    tilt, push = make_experiments(rig)
    return tension(rig, [tilt], [push]).p


@pytest.mark.full
@pytest.mark.parametrize(("rigs", "apart"), [(12, 6), pytest.param(25, 12, marks=pytest.mark.slow)])
def test_false_alarms_and_power(rigs: int, apart: int) -> None:
    """The p-value is conservative (few readings, priors on the scatters).

    No alarm on ``rigs`` rigs that agree, whose share below 0.2 is at most nominal. Tilts of a surface with 0.25 less mu
    are named in nearly all of ``apart``.
    """
    agreeing = np.array([p_value(seed) for seed in range(rigs)])
    assert np.mean(agreeing < 0.2) < 0.2 + 3.0 * np.sqrt(0.2 * 0.8 / 25)
    assert agreeing.min() > 0.002
    assert np.mean([p_value(seed, TRUTH["mu"] - 0.25) < 0.002 for seed in range(apart)]) > 0.8
