"""Planted faults are named in at least 95 of 100 rigs; at most 5 % of clean rigs raise any finding."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from capsule_id.report.messages import finding_text, messages_of
from tests.experiments.planted import (
    KINDS,
    Fault,
    clip,
    duplicate,
    lose,
    mislabelled,
    named,
    rest,
    rig_of,
    run_rig,
    with_table,
    with_values,
    wrong_unit,
)

#: Fault -> codes that name it.
FAULTS: dict[Fault, tuple[str, ...]] = {
    duplicate: ("readings.repeated",),
    clip: ("readings.clipped",),
    rest: ("decays.release",),
    lose: ("readings.gaps", "readings.jump"),
    wrong_unit: ("readings.magnitude", "decays.magnitude"),
    mislabelled: ("runs.kinematics", "runs.power", "pushes.power"),
}


def share_named(folder: Path, fault: Fault, rigs: int) -> float:
    """Share of ``rigs`` rigs with ``fault`` whose findings name it."""
    hits = 0
    for seed in range(rigs):
        rig = run_rig(folder, seed) if fault is mislabelled else rig_of(folder, seed)
        faulty = fault(rig, np.random.default_rng(1000 + seed))
        hits += any(found.code in FAULTS[fault] for found in named(faulty))
    return hits / rigs


@pytest.mark.full
@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: fault.__name__)
def test_planted_faults_are_named(tmp_path: Path, fault: Fault) -> None:
    assert share_named(tmp_path, fault, 6) == 1.0


@pytest.mark.parametrize("fault", [duplicate, clip, rest, wrong_unit], ids=lambda fault: fault.__name__)
def test_a_planted_fault_is_named(tmp_path: Path, fault: Fault) -> None:
    assert share_named(tmp_path, fault, 1) == 1.0


def test_a_jump_is_named_where_the_noise_looks_larger_by_chance(tmp_path: Path) -> None:
    """Before: the differences of 40 samples gave 1.6 times the noise of the record, and no finding."""
    found = named(lose(rig_of(tmp_path, 6), np.random.default_rng(1006)))
    assert "readings.jump" in [one.code for one in found]


@pytest.mark.full
def test_clean_rigs_raise_nothing(tmp_path: Path) -> None:
    assert [found for seed in range(6) for found in named(rig_of(tmp_path, seed))] == []
    assert named(run_rig(tmp_path, 0)) == ()


@pytest.mark.slow
@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: fault.__name__)
def test_planted_faults_are_named_in_95_of_100_rigs(tmp_path: Path, fault: Fault) -> None:
    assert share_named(tmp_path, fault, 100) >= 0.95


@pytest.mark.slow
def test_at_most_5_percent_of_clean_rigs_raise_a_finding(tmp_path: Path) -> None:
    assert np.mean([bool(named(rig_of(tmp_path, 500 + seed))) for seed in range(200)]) <= 0.05
    assert np.mean([bool(named(run_rig(tmp_path, 500 + seed))) for seed in range(40)]) <= 0.05


@pytest.mark.full
def test_a_turned_sign_of_x_rel_is_called_a_sign(tmp_path: Path) -> None:
    rig = run_rig(tmp_path, 0)
    for index, table in enumerate(rig.tables):
        if table.kind == "forced_run":
            (found,) = named(
                with_table(rig, index, with_values(table, x_rel=-table["x_rel"], x_capsule=-table["x_capsule"]))
            )
            assert "wrong sign" in finding_text(found, messages_of(KINDS))
            columns = {name: column for name, column in table.columns.items() if name != "acceleration_rod"}
            without = replace(table, columns=columns)
            assert named(with_table(rig, index, without)) == ()
            (found,) = named(
                with_table(rig, index, with_values(without, x_rel=-table["x_rel"], x_capsule=-table["x_capsule"]))
            )
            assert found.code == "runs.power"
