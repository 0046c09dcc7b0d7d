"""Runs that cannot be predicted are cut, and it is said; others are left alone."""

from capsule_id.experiments.forced_run import ForcedRun
from capsule_id.inference.point_stage import cut_unpredictable
from capsule_id.rig.model import Quantity, Table
from capsule_id.synthetic_runs import RunSettings, make_runs
from tests.experiments import bench
from tests.forced_runs import TRUTH, make


def chaotic() -> tuple[Table, dict[str, float]]:
    """Two seconds of the chaotic motion of tests/capsule/test_lyapunov.py, and its true parameters."""
    truth = TRUTH | {"m2": 0.3, "c": 0.5, "mu": 0.2}
    run = make_runs(truth, 0, (RunSettings("stiff", 34.56, 8.0, 0.5e-3),))[0]
    columns = [bench.column("time", run.time), *(bench.column(name, y) for name, y in run.channels.items())]
    settings = {"spring": "stiff", "gap": Quantity(run.stated_gap, 2e-5), "Omega": run.truth.Omega}
    return bench.table("forced_run", columns, "wild", **settings), truth


def test_a_chaotic_record_is_cut_and_a_tame_one_is_not() -> None:
    table, truth = chaotic()
    rig = bench.rig(table, m2=Quantity(0.3))
    parts, findings = cut_unpredictable(rig, [ForcedRun(table, rig)], truth)
    assert len(parts) >= 3
    assert [(finding.level, finding.experiment) for finding in findings] == [("warn", "wild")]
    assert f"cut into {len(parts)} parts" in findings[0].text
    tame = make(1, samples=1000)
    kept, findings = cut_unpredictable(tame.rig, [tame], TRUTH)
    assert kept == [tame]
    assert findings == []
