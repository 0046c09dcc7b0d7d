"""Runs that cannot be predicted are cut, and it is said; others are left alone."""

from typing import cast

import pytest

from capsule_id.experiments.base import Experiment
from capsule_id.experiments.forced_run.declaration import MESSAGES
from capsule_id.experiments.forced_run.drives import ForcedRun
from capsule_id.experiments.forced_run.twin import RunSetup, make_runs
from capsule_id.inference import point_stage
from capsule_id.inference.point_stage import cut_unpredictable
from capsule_id.inference.target import LogPosterior
from capsule_id.rig.model import Quantity, Table
from tests.experiments import bench
from tests.forced_runs import TRUTH, make


def chaotic() -> tuple[Table, dict[str, float]]:
    """Two seconds of the chaotic motion of tests/capsule/test_lyapunov.py, and its true parameters."""
    truth = TRUTH | {"m2": 0.3, "c": 0.5, "mu": 0.2}
    run = make_runs(truth, 0, (RunSetup("stiff", 34.56, 8.0, 0.5e-3, 2000, 1e-3),))[0]
    columns = [bench.column("time", run.time), *(bench.column(name, y) for name, y in run.channels.items())]
    settings = {"spring": "stiff", "gap": Quantity(run.stated_gap, 2e-5), "Omega": run.truth.Omega}
    return bench.table("forced_run", columns, "wild", **settings), truth


def test_a_chaotic_record_is_cut_and_a_tame_one_is_not() -> None:
    table, truth = chaotic()
    rig = bench.rig(table, m2=Quantity(0.3))
    target, findings = cut_unpredictable(LogPosterior(rig, [ForcedRun(table, rig)]), truth)
    parts = target.experiments
    assert len(parts) >= 3
    assert [(finding.level, finding.experiment) for finding in findings] == [("warn", "wild")]
    assert (findings[0].code, findings[0].facts["parts"]) == ("runs.cut", len(parts))
    assert f"cut into {len(parts)} parts" in MESSAGES["runs.cut"].text("warn", findings[0].facts)
    run = make(1, samples=1000)
    tame = LogPosterior(run.rig, [run])
    kept, findings = cut_unpredictable(tame, TRUTH)
    assert kept is tame
    assert findings == []


def test_a_start_that_wavers_is_said_and_the_fit_is_that_of_its_target(monkeypatch: pytest.MonkeyPatch) -> None:
    """The last fit belongs to the experiments that come back with it, whatever would have been tried next."""
    run, fitted = make(2, samples=120), []

    def joint_fit(target: LogPosterior, *_: object) -> LogPosterior:
        fitted.append(target)
        return target

    def other_kind(target: LogPosterior, *_: object) -> tuple[list[Experiment], dict[str, float]]:
        (own,) = cast(list[ForcedRun], target.experiments)
        return [own.remade(own.table, capsule_rate=0.0 if own.moves else 1e-2)], {}

    monkeypatch.setattr(point_stage, "joint_fit", joint_fit)
    monkeypatch.setattr(point_stage, "correct_starts", other_kind)
    target, fit, findings = point_stage._fit_with_right_starts(LogPosterior(run.rig, [run]), {}, 0)
    assert len(fitted) == point_stage.STAGE_ROUNDS
    assert target is fit is fitted[-1]
    assert [(finding.level, finding.experiment) for finding in findings] == [("fail", "run_3")]
    monkeypatch.setattr(point_stage, "correct_starts", lambda *_: None)
    *_, findings = point_stage._fit_with_right_starts(LogPosterior(run.rig, [run]), {}, 0)
    assert findings == []
