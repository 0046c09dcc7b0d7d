"""Records in parts, delays of channels, and starts that the whole record corrects."""

from dataclasses import replace

import numpy as np
import pytest

from capsule_id.experiments.forced_run.drives import ForcedRun
from capsule_id.experiments.forced_run.experiment import better_start
from capsule_id.experiments.forced_run.start_state import parts_of
from capsule_id.experiments.kind import make_experiments
from capsule_id.inference.target import LogPosterior
from capsule_id.parameters import Prior
from capsule_id.physics.simulation import simulate
from capsule_id.rig.model import Quantity, Table
from capsule_id.views import Finding
from tests.experiments import bench
from tests.forced_runs import make, recorded, table, theta


def test_parts_are_the_record_and_share_what_is_the_records() -> None:
    whole = table(0, samples=600, segment=0.2, P_d=Quantity(4.0, 0.1))
    runs = [e for e in make_experiments(bench.rig(whole)) if isinstance(e, ForcedRun)]
    assert [e.label for e in runs] == ["run_1~1", "run_1~2", "run_1~3"]
    np.testing.assert_array_equal(np.concatenate([e.table["x_rel"] for e in runs]), whole["x_rel"])
    np.testing.assert_array_equal(np.concatenate([e.table.rows for e in runs]), whole.rows)
    names = [{row.name for row in e.parameters} for e in runs]
    shared = set.intersection(*names)
    assert {"k1", "K", "G[run_1]", "I_d[run_1]", "phase[run_1]", "noise_x_rel[run_1]"} <= shared
    assert {"x_start[run_1~2]", "y_start[run_1~2]"} <= names[1] - shared
    assert [e.about.leads for e in runs] == [True, False, False]
    assert {e.about.record for e in runs} == {"run_1"}
    # The second reading of the drive's amplitude is counted once.
    assert [e.second_reading is not None for e in runs] == [True, False, False]
    # Only the first part proposes where what they share may start: phases must not be averaged.
    assert "phase[run_1]" not in runs[1].starts()
    assert set(LogPosterior(bench.rig(whole), runs).starts()) == set.union(*names)


def test_parts_have_one_gain_and_one_clock() -> None:
    """Before: both were drawn anew in each part, so that in nine parts their mean had a third of the stated sd."""
    ticks = (Finding("times.ticks", "ok", {}, "run_1"),)
    whole = replace(table(0, samples=600, segment=0.2, x_rel_gain_sd=0.02), findings=ticks, drift=Quantity(0.0, 1e-4))
    runs = [e for e in make_experiments(bench.rig(whole)) if isinstance(e, ForcedRun)]
    assert len(runs) == 3
    for e in runs:
        rows = {row.name: row.prior for row in e.parameters}
        assert rows["gain[run_1_x_rel]"] == Prior("normal", 0.0, 0.02)
        assert rows["clock_drift[run_1]"] == Prior("normal", 0.0, 1e-4)
        assert e.channels[e.names.index("x_rel")].gain_sd is None
        known = {**theta(), "gain[run_1_x_rel]": 0.05}
        assert e.instrument("x_rel", known)[0] == 1.05
    # A record in one part integrates its gain out.
    (one,) = make_experiments(bench.rig(replace(whole, settings=replace(whole.settings, segment=None))))
    assert not any(row.symbol == "gain" for row in one.parameters)


def test_parts_of_a_part_belong_to_the_record() -> None:
    """A part that is cut again shares gap, drive and noise with the whole record; one initial state each."""
    (whole,) = ForcedRun.make(table(0, samples=600, P_d=Quantity(4.0, 0.1)), bench.rig())
    parts = [again for part in whole.parts(0.3) for again in part.parts(0.15)]
    assert len(parts) == 4
    assert {e.about.record for e in parts} == {"run_1"}
    assert (
        [e.about.leads for e in parts] == [e.second_reading is not None for e in parts] == [True, False, False, False]
    )
    names = [{row.name for row in e.parameters} for e in parts]
    assert {"G[run_1]", "noise_x_rel[run_1]"} <= set.intersection(*names)
    assert len({name for own in names for name in own if name.startswith("x_start[")}) == 4


def test_a_record_shorter_than_a_part_stays_whole() -> None:
    whole = table(0, samples=100)
    assert parts_of(whole, 0.2) == [whole]


def test_cuts_fall_where_the_motion_is_smooth() -> None:
    """No contact begins or ends within the reach of the parabola that the start is read from, but at its very end."""
    whole = table(0, samples=1200)
    truth = recorded()[0].truth
    for part in parts_of(whole, 0.2)[1:]:
        assert np.count_nonzero(part["x_rel"][:9] > truth.G) in (0, 1, 8, 9)


def delayed(seconds: float, **settings: object) -> ForcedRun:
    """The twin's first run with an x_rel that is ``seconds`` late, without noise."""
    own, run, values = table(0, samples=300, **settings), recorded()[0], theta(0)
    blank = ForcedRun(own, bench.rig(own))
    p, e = blank.capsule(values)
    late = np.unique(np.concatenate([[0.0], run.time[1:300] - seconds]))
    t = simulate(p, e, late, (run.truth.x_rel, run.truth.Y1, 0.0, run.truth.Y2))
    x = np.asarray(t.x_rel)
    columns = {**own.columns, "x_rel": replace(own.columns["x_rel"], values=x)}
    changed: Table = replace(own, columns=columns, settings=replace(own.settings, start="moving"))
    return ForcedRun(changed, bench.rig(changed))


def test_a_delay_is_integrated_out_and_found() -> None:
    seconds, sd = 1e-4, 2e-4
    with_delay, without = (delayed(seconds, **setting) for setting in ({"x_rel_delay_sd": sd}, {}))
    own = with_delay.scaled(theta(0), np)[0]
    rest, nuisances = own.at_nuisance_mean(np)
    assert sd * nuisances[-1] == pytest.approx(seconds, rel=0.03)
    plain = without.scaled(theta(0), np)[0].at_nuisance_mean(np)[0]
    assert np.sum(np.square(rest)) < 0.05 * np.sum(np.square(plain))


@pytest.mark.full
def test_a_creeping_start_is_told_from_rest_by_the_whole_record() -> None:
    moving = theta(0)
    assert abs(moving["capsule_start"]) > 1e-3  # this run starts in motion
    run = make(0, samples=600)
    run = run.remade(run.table, capsule_rate=0.0)
    assert not run.moves
    wrong = moving | {"y_start": moving["y_start"] + moving["capsule_start"], "capsule_start": 0.0}
    found = better_start(run, wrong) or {}
    # On a grid of speeds, each a half above the one before.
    assert found["capsule_start"] == pytest.approx(moving["capsule_start"], rel=0.3)
    assert found["x_start"] == pytest.approx(moving["x_start"], abs=5e-5)


@pytest.mark.full
def test_a_start_that_fits_stands() -> None:
    moving, stuck = (make(number, samples=600) for number in (0, 2))
    assert better_start(moving.remade(moving.table, capsule_rate=theta(0)["capsule_start"]), theta(0)) is None
    assert not stuck.moves
    assert better_start(stuck, theta(2)) is None
