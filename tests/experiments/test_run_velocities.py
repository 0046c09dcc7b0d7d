"""Mean velocities of the table of predicted motion, for records of the model itself."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import capsule_id as cid
from capsule_id.experiments.forced_run.drives import ForcedRun, predicted_motion
from capsule_id.experiments.kind import make_experiments
from capsule_id.records.motion import measured_motion
from capsule_id.synthetic import truth_beside

#: Reading error of x_capsule, m.
NOISE = 20e-6


@pytest.mark.full
def test_the_record_lies_within_the_band_of_its_own_model(tmp_path: Path) -> None:
    """The band is the estimator's error alone; the record is the number that ``check`` prints.

    Negative control: with two per cent more drive the model's velocity leaves the band of most records.
    """
    cid.synthesize(tmp_path / "rig", 4, runs=True)
    rig = cid.read_rig(tmp_path / "rig")
    runs = make_experiments(rig, "runs")
    starts = {name: start.centre for run in runs for name, start in run.starts().items()}
    truth = {**starts, **truth_beside(rig), "g": rig.g.value}
    rng = np.random.default_rng(0)

    def record_of(run: ForcedRun) -> SimpleNamespace:
        """The run with the model's own motion and a reading error as its x_capsule."""
        place = np.asarray(run.motion(run.local(truth), np).X2) + NOISE * rng.standard_normal(run.time.size)
        column = replace(run.table.columns["x_capsule"], values=place)
        table = replace(run.table, columns={**run.table.columns, "x_capsule": column})
        return SimpleNamespace(label=run.label, time=run.time, table=table, motion=run.motion, local=run.local)

    exact = [record_of(run) for run in runs]

    def inside(values: dict[str, float]) -> list[bool]:
        fit = SimpleNamespace(values=values, draws=[values] * 4, findings=(), flagged={})
        (table,) = predicted_motion(exact, fit)  # pyright: ignore[reportArgumentType]
        found = []
        for run in exact:
            row = table.frame.loc[run.label]
            low, high = (float(end) for end in str(row["95 % band, mm/s"]).split(" to "))
            record = float(str(row["mean velocity, record, mm/s"]).split(" ± ")[0])
            assert record == pytest.approx(1e3 * measured_motion(run.table).mean_velocity, rel=1e-3, abs=1e-3)
            found.append(low <= record <= high)
        return found

    right, wrong = inside(truth), inside({**truth, "K": 1.02 * truth["K"]})
    assert len(right) >= 4
    assert np.mean(right) >= 0.75
    assert sum(wrong) < sum(right)
