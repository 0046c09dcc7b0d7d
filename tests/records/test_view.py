"""The view of a record: filter, Poincaré points, force; figures; the lines of ``capsule-id check``."""

import re
from dataclasses import replace
from pathlib import Path
from typing import cast

import numpy as np
import pytest

from capsule_id.errors import InputError
from capsule_id.experiments.kind import default_registry
from capsule_id.records.tones import Harmonic, recorded_drive
from capsule_id.records.view import SMALLEST_RATE_GAIN, Gains, RecordView, RunRecord, describe_run, view_record
from capsule_id.report.figures.fits import channel_history, force_on_rod, overview, overview_size, phase_plane
from capsule_id.report.figures.style import new_axes, new_figure, png
from capsule_id.report.messages import finding_text, messages_of
from capsule_id.rig.filters import filter_gain
from capsule_id.rig.model import Quantity
from tests.experiments import bench
from tests.records.runs import Known, noisier, reference, table_of

STEP = 1e-3
KINDS = default_registry()


@pytest.fixture(scope="module")
def case() -> Known:
    (one,) = reference(only="fig11_Pd_1.2")
    return one


@pytest.fixture(scope="module")
def view(case: Known) -> RecordView:
    return view_record(table_of(noisier(case.run, 1.0, 0)), case.nominal, K=2.0)


def test_the_window_is_the_longest_that_leaves_contacts_alone(view: RecordView) -> None:
    at_contact = cast(Gains, view.at_contact)
    assert at_contact.rate >= SMALLEST_RATE_GAIN > filter_gain(at_contact.f * STEP, view.samples + 2, 3, 1)
    assert view.at_drive.rate > 0.999
    # Half a period of the frequency of the contacts is a contact: 4.5 ms by the model's k2 and masses
    m = 0.11 * 0.53 / 0.64
    assert 0.5 / view.at_contact.f == pytest.approx(np.pi * np.sqrt(m / 56410.0), rel=0.25)


def test_without_contacts_the_drive_sets_the_window() -> None:
    quiet = next(case for case in reference() if case.name == "fig11_Pd_0.8")
    view = view_record(table_of(noisier(quiet.run, 1.0, 0)))
    assert view.at_contact is None
    assert view.label == "P-1-S-0"
    assert view.force is None  # without K


def test_rate_is_the_derivative_of_x_rel(view: RecordView) -> None:
    inside = slice(10, -10)
    central = np.gradient(view.x_rel, STEP)
    scale = np.std(view.rate)
    assert np.std((central - view.rate)[inside]) < 0.1 * scale
    assert np.std((central + view.rate)[inside]) > scale  # the sign


def test_poincare_points_stand_at_the_drives_phase(view: RecordView, case: Known) -> None:
    periods = 2.0 * case.run.truth.Omega / (2.0 * np.pi)
    assert periods - 2.0 < len(view.section_x_rel) <= periods + 1.0
    # period 1: one point, but for the filtered noise
    assert np.std(view.section_x_rel) < 1.2 * 10e-6
    # where the current is largest
    near = np.argsort(view.channels["current"])[-10:]
    assert np.abs(view.x_rel[near] - view.section_x_rel.mean()).max() < 0.25 * np.ptp(view.x_rel)


def test_force_is_K_times_the_current_without_its_zero_error(view: RecordView, case: Known) -> None:
    force = cast(np.ndarray, view.force)
    truth = case.run.truth
    exact = truth.P_d * np.cos(truth.Omega * view.time + truth.phase)
    assert np.std(force - exact) == pytest.approx(2.0 * 5e-3, rel=0.1)
    assert abs(np.mean(force - exact)) < 1e-3


def test_a_view_needs_x_rel(case: Known) -> None:
    with pytest.raises(InputError, match="a phase plane needs x_rel"):
        view_record(table_of(noisier(case.run, 1.0, 0), only=("current",)))


def test_pictures_draw_what_they_are_given(view: RecordView) -> None:
    phase_plane(view, ax := new_axes())
    path, gap, seen, section = ax.lines
    assert len(path.get_xdata()) == len(view.time) - 2 * (view.samples // 2)  # pyright: ignore
    assert [gap.get_xdata()[0], seen.get_xdata()[0]] == [1e3 * view.gap, 1e3 * view.gap_seen]  # type: ignore
    np.testing.assert_allclose(section.get_ydata(), view.section_rate)
    force_on_rod(RunRecord("run", view, view.time), force := new_axes())
    assert [line.get_label() for line in force.lines] == ["K times current", "model"]
    channel_history(view, "acceleration_rod", history := new_axes())
    assert history.get_ylabel().endswith("m/s²")
    overview(view, figure := new_figure(*overview_size(view)))
    assert png(figure).startswith(b"\x89PNG")
    fewer = replace(view, channels={"x_rel": view.channels["x_rel"]}, gap_seen=None, force=None)
    overview(fewer, figure := new_figure(*overview_size(fewer)))
    assert len(figure.axes) == 2
    with pytest.raises(ValueError, match="no force"):
        force_on_rod(RunRecord("run", fewer, view.time), new_axes())


def test_check_says_it_in_a_few_lines(case: Known) -> None:
    table = table_of(noisier(case.run, 1.0, 0))
    motion, drive, filtered = describe_run(table)
    assert motion.startswith("motion P-1-F-1, probability 1 (23.4 periods of the drive, noise of x_rel 9.")
    assert "contacts by spikes 1/1/1, by crossings 1/1/1/1/1/1, same count in 22 of 22 single periods" in motion
    assert drive.startswith("drive Omega 73.5")
    assert "(stated 73.58), current 0.6" in drive
    assert filtered.startswith("Savitzky-Golay over 7 samples, order 3: gain 1.000 (rate 1.000) at 11.7 Hz, drive, 0.9")
    (lint_run,) = KINDS["forced_run"].lint
    assert list(lint_run(table, bench.rig())) == []
    (wrong,) = lint_run(table_of(noisier(case.run, 1.0, 0), Omega=80.0), bench.rig())
    assert wrong.level == "warn"
    text = finding_text(wrong, messages_of(KINDS))
    assert "stated 80 rad/s, the current has 73.5" in text
    assert text.endswith("Correct Omega.")
    # Off by 0.2 %. With a stated error of the clock the fit measures the clock by it; before, "correct Omega" hid that.
    near = table_of(noisier(case.run, 1.0, 0), Omega=73.5)
    off = cast(Harmonic, recorded_drive(near)).Omega / 73.5 - 1.0
    own = table_of(noisier(case.run, 1.0, 0), Omega=73.5 * (1.0 + off) / 1.002)
    (named,) = lint_run(own, bench.rig())
    text = finding_text(named, messages_of(KINDS))
    assert re.search(r"clock = \{ drift = \{ value = (199\d|200\d), sd = \.\.\., unit = \"ppm\" \} \}", text)
    assert "Correct Omega; or" in text
    # A drift that is stated already counts: the sum is the drift to state.
    (named,) = lint_run(replace(own, drift=Quantity(-0.001)), bench.rig())
    assert named.facts["ppm"] == pytest.approx(999.0, abs=6.0)
    assert list(lint_run(replace(own, drift=Quantity(0.0, 1e-3)), bench.rig())) == []
    assert list(lint_run(replace(own, drift=Quantity(0.0, 1e-5)), bench.rig())) != []


def test_check_says_why_it_cannot_tell(case: Known) -> None:
    lines = describe_run(table_of(noisier(case.run, 1.0, 0), only=("current",)))
    assert lines[:2] == ["motion undecided", "undecided: x_rel was not recorded"]
    assert [line[:5] for line in lines[2:]] == ["drive"]


def test_records_know_no_model() -> None:
    for file in (Path(__file__).parents[2] / "capsule_id" / "records").glob("*.py"):
        assert "capsule_id.physics" not in file.read_text(encoding="utf-8"), file.name
