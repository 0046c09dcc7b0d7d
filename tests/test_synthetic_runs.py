"""Forced runs of a synthetic rig: the bench tables do not change, and the truth file gives every channel."""

import json
import re
from pathlib import Path

import numpy as np
import pytest

from capsule_id.api import read_rig
from capsule_id.errors import InputError
from capsule_id.experiments.forced_run.twin import NOISE_SD, RUNS
from capsule_id.experiments.kind import default_registry, make_experiments
from capsule_id.physics.model import CapsuleParameters, Excitation
from capsule_id.physics.simulation import simulate
from capsule_id.rig.model import Table
from capsule_id.synthetic import Truth, synthesize
from tests.cli_tools import ROOT

SEED = 3


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A rig with runs, with true values other than the paper's."""
    folder = tmp_path_factory.mktemp("rigs") / "runs"
    truth = (
        Truth().with_kinds([default_registry()["forced_run"]]).with_values({"k1": 1500.0, "K": 2.2, "k2[hard]": 50e3})
    )
    synthesize(folder, SEED, truth, name="rig", runs=True)
    return folder


def known(folder: Path) -> dict:
    return json.loads(folder.with_name(f"{folder.name}.truth.json").read_text())


def runs_of(folder: Path) -> list[Table]:
    return [table for table in read_rig(folder).tables if table.kind == "forced_run"]


@pytest.mark.full
def test_the_bench_is_the_same_with_and_without_runs(folder: Path, tmp_path: Path) -> None:
    synthesize(tmp_path / "bench", SEED, Truth().with_values({"k1": 1500.0, "K": 2.2}), name="rig")
    for file in (tmp_path / "bench").glob("*.csv"):
        assert file.read_bytes() == (folder / file.name).read_bytes()
    added = {file.name for file in folder.iterdir()} - {file.name for file in (tmp_path / "bench").iterdir()}
    assert added == {f"run_{number}.csv" for number in range(1, len(RUNS) + 1)}
    toml = (folder / "rig.toml").read_text()
    without_runs = re.sub(r"(?s)\[prior\]\n.*?\n\n", "", toml[: toml.index('\n[[experiment]]\nkind = "forced_run"')])
    assert without_runs == (tmp_path / "bench" / "rig.toml").read_text()


def test_the_channels_follow_from_the_truth(folder: Path) -> None:
    """Independent check: simulate from the state at the first sample; the residuals are the stated white noise."""
    truth = known(folder)
    parameters = truth["parameters"]
    shared = {name: parameters[name] for name in ("m1", "m2", "k1", "c", "mu", "v_s", "g")}
    for table in runs_of(folder):
        run = truth["runs"][table.label]
        p = CapsuleParameters(**shared, k2=parameters[f"k2[{run['spring']}]"], G=run["G"])
        e = Excitation(run["P_d"], run["Omega"], run["phase"])
        time = table["time"]
        between = np.stack([time - 1e-5, time + 1e-5])[:, 1:].ravel(order="F")
        both = np.sort(np.concatenate([time, between]))
        t = simulate(p, e, both, (run["x_rel"], run["Y1"], 0.0, run["Y2"]))
        at = np.searchsorted(both, time)
        Y1 = np.asarray(t.Y1)
        acceleration = (Y1[at[1:] + 1] - Y1[at[1:] - 1]) / 2e-5
        exact = {
            "x_rel": np.asarray(t.x_rel)[at],
            "x_capsule": np.asarray(t.X2)[at],
            "acceleration_rod": np.concatenate([[0.0], acceleration]),  # the first is left out below
            "current": run["P_d"] / parameters["K"] * np.cos(run["Omega"] * time + run["phase"]),
        }
        assert run["current_amplitude"] * parameters["K"] == pytest.approx(run["P_d"])
        for name, values in exact.items():
            rest = (table[name] - values - run["offsets"].get(name, 0.0))[1:]
            # 2649 samples or more: standard errors at most 0.019 and 0.014; contacts cut the derivative by less than 0.1
            assert abs(rest.mean()) < 0.1 * NOISE_SD[name], (table.label, name)
            assert np.std(rest) == pytest.approx(NOISE_SD[name], rel=0.07), (table.label, name)
        off = np.std(table["x_rel"] - np.roll(exact["x_rel"], round(1e-3 / time[1])))
        assert off > 2.0 * NOISE_SD["x_rel"]  # a millisecond late, and it would show


def test_runs_are_in_full_motion_at_random_phases(folder: Path) -> None:
    runs = known(folder)["runs"]
    assert [run["spring"] for run in runs.values()] == ["medium", "stiff", "hard", "hard"]
    assert len({round(run["phase"], 3) for run in runs.values()}) == len(runs)
    for table in runs_of(folder):
        gap = table.settings.gap
        assert 0.0 < abs(gap.value - runs[table.label]["G"]) < 5.0 * gap.sd
        assert len(table["time"]) == RUNS[int(table.label[-1]) - 1].samples
        assert abs(table["x_capsule"][0]) < 5.0 * NOISE_SD["x_capsule"]  # X2 counts from here
        half = len(table["time"]) // 2
        first, second = (np.ptp(part) for part in (table["x_rel"][:half], table["x_rel"][half:]))
        assert first == pytest.approx(second, rel=0.05)  # nothing is still building up


def test_the_seed_makes_the_runs(folder: Path, tmp_path: Path) -> None:
    truth = Truth().with_values({"k1": 1500.0, "K": 2.2})
    for seed in (SEED, SEED + 1):
        synthesize(tmp_path / str(seed), seed, truth, runs=True)
    same, other = ((tmp_path / str(seed) / "run_1.csv").read_bytes() for seed in (SEED, SEED + 1))
    assert same == (folder / "run_1.csv").read_bytes()  # the hard spring has nothing to do with run 1
    assert other != same


@pytest.mark.full
def test_the_bench_can_be_fitted_with_runs_in_the_folder(folder: Path) -> None:
    rig = read_rig(folder)
    assert {e.kind for e in make_experiments(rig, "bench")}.isdisjoint({"forced_run"})
    assert "k2[hard]" in rig.priors
    truth = known(folder)["parameters"]["k2[hard]"]
    assert abs(np.log(rig.priors["k2[hard]"].median / truth)) < 3.0 * np.log(1.5) / 1.96  # type: ignore[operator]


def test_a_spring_of_runs_alone_is_unknown_without_them() -> None:
    with pytest.raises(InputError, match="parameter of the twin"):
        Truth().with_values({"k2[hard]": 5e4})


def test_data_is_what_the_command_writes(tmp_path: Path) -> None:
    """``data/`` is the output of the command in data/README.md."""
    text = (ROOT / "data" / "README.md").read_text(encoding="utf-8")
    runs = "--runs" in text
    synthesize(tmp_path / "data", 0, name="twin", runs=runs)
    for file in (tmp_path / "data").iterdir():
        kept = ROOT / "data" / file.name
        if file.name.startswith("run_"):
            # the engine's last bits are the processor's; the last digit written is 1e-5 mm, 1e-3 m/s^2, 1e-5 A
            both = [np.loadtxt(path, delimiter=",", skiprows=1) for path in (file, kept)]
            assert np.all(np.abs(both[0] - both[1]) <= [0.0, 2e-5, 2e-5, 2e-3, 2e-5]), file.name
        else:
            assert file.read_bytes() == kept.read_bytes(), file.name
