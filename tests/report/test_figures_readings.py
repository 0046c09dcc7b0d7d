"""Figures of ``capsule-id check``: each experiment, its units, and what was found in it."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from capsule_id.commands import check
from capsule_id.errors import InputError
from capsule_id.experiments.kind import default_registry
from capsule_id.experiments.lint import lint
from capsule_id.report.figures.fits import readings_figure
from capsule_id.report.figures.style import png
from capsule_id.rig.model import Table
from tests.cli_tools import small_rig
from tests.commands.test_rig_commands import call
from tests.experiments import bench

KINDS = default_registry()
TIME = np.arange(1000) / 2000.0


def drawn(table: Table) -> dict[str, int]:
    """Labels of the legend of the first panel, with the number of points of each."""
    rig = bench.rig(table)
    figure = readings_figure(table, lint(rig, KINDS, rig.tables))
    assert png(figure).startswith(b"\x89PNG")
    (ax,) = figure.axes
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("time, s", "x_rel, mm")
    handles, labels = ax.get_legend_handles_labels()
    return {label: len(getattr(handle, "get_xdata", list)()) for handle, label in zip(handles, labels, strict=True)}


def decay(values: np.ndarray, time: np.ndarray, **settings: object) -> Table:
    x_rel = replace(bench.column("x_rel", values), unit="mm", to_display=1e3)
    return bench.table("free_vibration", [replace(bench.column("time", time), unit="s"), x_rel], **settings)


@pytest.mark.full
def test_what_was_found_is_drawn() -> None:
    noise = 1e-5 * np.random.default_rng(0).standard_normal(2000)
    values = bench.released(TIME, 2e-3) + noise[:1000]
    assert list(drawn(decay(values, TIME))) == ["readings"]
    limit = 0.9 * np.min(values)  # a flat first top is a hold
    clipped = drawn(decay(np.maximum(values, limit), TIME))
    assert clipped["clipped"] == np.sum(values <= limit)
    kept = np.delete(np.arange(1000), slice(300, 320))
    assert "gap" in drawn(decay(values[kept], TIME[kept]))
    rested = np.concatenate([noise[:1000], values])
    time = np.arange(2000) / 2000.0
    assert drawn(decay(rested, time))["release found"] == 2
    assert list(drawn(decay(rested, time, start=0.51, stop=0.9))) == ["readings"]


def test_check_writes_a_figure_for_each_experiment(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    rig = small_rig(tmp_path / "rig", tables=("motor_current", "static_friction"))
    assert call(check, str(rig), "--figures", str(tmp_path / "figures")) == 0
    assert f"figures: 2 in {tmp_path / 'figures'}" in capsys.readouterr().out
    written = sorted((tmp_path / "figures").iterdir())
    assert [path.name for path in written] == ["motor_current.png", "static_friction.png"]
    assert all(path.read_bytes().startswith(b"\x89PNG") for path in written)
    with pytest.raises(InputError, match="DIR must be writable"):
        call(check, str(rig), "--figures", str(rig / "rig.toml"))
