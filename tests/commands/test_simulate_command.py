"""``capsule-id simulate``: tables, figure, errors."""

import argparse
import csv
import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import xarray as xr
from PIL import Image

from capsule_id.cli import capsule_id
from capsule_id.commands import add_options
from capsule_id.commands import simulate as command
from capsule_id.errors import InputError
from capsule_id.physics.model import CapsuleParameters, Excitation
from capsule_id.physics.simulation import simulate

DRIVE = ["--k2", "18960", "--G", "1e-3", "--P_d", "4", "--Omega", "34.56"]


def _run(*arguments: str) -> int:
    parser = argparse.ArgumentParser()
    add_options(parser, command.OPTIONS)
    return command.run(parser.parse_args(arguments))


def _table(path: Path) -> tuple[list[str], np.ndarray]:
    with path.open(encoding="utf-8") as file:
        header, *rows = csv.reader(file)
    return header, np.array(rows, float)


def test_table_is_the_simulated_motion(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out, figure = tmp_path / "run.csv", tmp_path / "run.png"
    assert _run(*DRIVE, "--periods", "2", "--samples", "50", "--out", str(out), "--figure", str(figure)) == 0
    assert "50 samples" in capsys.readouterr().out
    header, rows = _table(out)
    assert header == ["time [s]", "X1 [m]", "Y1 [m/s]", "X2 [m]", "Y2 [m/s]", "x_rel [m]"]
    p = CapsuleParameters(0.11, 0.53, 1420.0, 18960.0, 3.89, 0.66, 0.3, 1e-3)
    t = simulate(p, Excitation(4.0, 34.56), np.linspace(0.0, 4.0 * np.pi / 34.56, 50))
    expected = np.stack([t.times, t.X1, t.Y1, t.X2, t.Y2, t.x_rel], axis=1)
    np.testing.assert_allclose(rows, expected, rtol=0.0, atol=1e-12)
    with Image.open(figure) as picture:
        assert picture.size == (1500, 720)


@pytest.mark.full
def test_netcdf_carries_units_and_parameters(tmp_path: Path) -> None:
    out = tmp_path / "run.nc"
    start = ["--initial", "1e-3", "0", "0.5", "0.1"]
    assert _run(*DRIVE, *start, "--duration", "0.05", "--samples", "20", "--model", "smooth", "--out", str(out)) == 0
    with xr.open_dataset(out, engine="h5netcdf") as data:
        assert data.sizes == {"time": 20}
        assert data.X2.attrs["units"] == "m"
        assert data.attrs["k2"] == 18960.0
        assert data.attrs["model"] == "smooth"
        assert float(data.X2[0]) == 0.5
        assert float(data.Y2[0]) == 0.1


def test_parameters_of_a_result(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rows = {"k1": {"map": 1500.0, "median": None}, "k2[L60]": {"map": 2e4}, "K": {"map": 20.0}}
    (tmp_path / "parameters.json").write_text(json.dumps({"parameters": rows}), encoding="utf-8")
    parser = argparse.ArgumentParser()
    add_options(parser, command.OPTIONS)
    drive = ["--G", "1e-3", "--P_d", "4", "--Omega", "30", "--out", "x.csv", "--result", str(tmp_path)]
    values = command.capsule_values(parser.parse_args([*drive, "--c", "5"]))
    assert (values["k1"], values["k2"], values["c"], values["m1"]) == (1500.0, 2e4, 5.0, 0.11)
    with pytest.raises(InputError, match="choose from L60"):
        command.capsule_values(parser.parse_args([*drive, "--spring", "L70"]))
    # Before: no contact, and not a word.
    for words in ([*drive, "--G", "inf"], [word for word in drive if word not in ("--result", str(tmp_path))]):
        with pytest.raises(InputError, match="--spring needs the result that it is of, and a gap"):
            command.capsule_values(parser.parse_args([*words, "--k2", "2e4", "--spring", "L60"]))
    with pytest.raises(InputError, match="--spring chooses k2, --k2 is given, too"):
        command.capsule_values(parser.parse_args([*drive, "--k2", "2e4", "--spring", "L60"]))
    # What the folder states is held. Before: level ground, and a drive that reacts on the ground.
    held = {"reaction": 1.0, "slope": 0.05, "lag": 0.006, "P_off": None}
    (tmp_path / "parameters.json").write_text(json.dumps({"parameters": rows, "fixed": held}), encoding="utf-8")
    values = command.capsule_values(parser.parse_args([*drive, "--c", "5"]))
    assert (values["reaction"], values["slope"], values["k1"]) == (1.0, 0.05, 1500.0)
    assert command.capsule_values(parser.parse_args([*drive, "--reaction", "0"]))["reaction"] == 0.0
    pulses = ["--drive", "pulses", "--G", "inf", "--P_on", "1", "--period", "0.1", "--duty", "0.5", *drive[-4:]]
    with pytest.raises(InputError, match=r"P_off .* must be given"):
        command.capsule_values(parser.parse_args(pulses))
    # What is varied needs no value.
    assert command.capsule_values(parser.parse_args(pulses), free=frozenset({"P_off"}))["P_off"] == 0.0
    values = command.capsule_values(parser.parse_args([*pulses, "--P_off", "-1"]))
    assert (values["lag"], values["P_off"]) == (0.006, -1.0)
    # Constant friction is eq. (1) with ratio 1. Before: refused, with a remedy that needs a law.
    constant = {"parameters": {**rows, "F_dry": {"map": 0.1}}, "provenance": {"friction": "constant friction"}}
    constant |= {"fixed": {"ratio": 1.0, "v_s": 1.0}, "trust": "not trusted"}
    (tmp_path / "parameters.json").write_text(json.dumps(constant), encoding="utf-8")
    capsys.readouterr()
    assert command.capsule_values(parser.parse_args([*drive, "--c", "5"]))["ratio"] == 1.0
    said = capsys.readouterr().err
    (tmp_path / "parameters.json").write_text(json.dumps({**constant, "fixed": {}}), encoding="utf-8")
    assert command.capsule_values(parser.parse_args([*drive, "--c", "5"]))["ratio"] == 1.0
    assert "the capsule has no F_dry: its rod is damped by c alone" in said
    assert "not trusted; look at the failed checks" in said
    other = {"parameters": rows, "provenance": {"friction": "mine.Law"}}
    (tmp_path / "parameters.json").write_text(json.dumps(other), encoding="utf-8")
    with pytest.raises(InputError, match=r"computes with eq. \(1\).*mine.Law"):
        command.capsule_values(parser.parse_args(drive))
    (tmp_path / "parameters.json").write_text("[]", encoding="utf-8")
    with pytest.raises(InputError, match="takes a result"):
        command.capsule_values(parser.parse_args(drive))


def test_a_gap_far_beyond_the_motion_is_a_warning_in_mm(tmp_path: Path) -> None:
    """1 mm is meant. Before: 0 contacts, and not a word."""
    out = ["--periods", "1", "--samples", "50", "--out", str(tmp_path / "run.csv")]
    with pytest.warns(UserWarning, match=r"the gap is 1000 mm and the largest \|x_rel\| 3\.\d+ mm: no contact"):
        _run(*DRIVE, "--G", "1", *out)
    # Negative controls: filterwarnings makes a warning an error.
    assert _run(*DRIVE, "--G", "inf", *out) == 0
    assert _run(*DRIVE, "--G", "0.05", *out) == 0


def test_a_negative_number_may_have_an_exponent(tmp_path: Path) -> None:
    """Before: "expected one argument"."""
    start = ["--initial", "-1e-3", "0", "0", "-2.5E-2", "--slope", "-1e-2"]
    run = ["simulate", *DRIVE, *start, "--periods", "1", "--samples", "5", "--out", str(tmp_path / "run.csv")]
    assert capsule_id(run) == 0
    assert pd.read_csv(tmp_path / "run.csv")["X1 [m]"][0] == -1e-3


@pytest.mark.parametrize(
    ("arguments", "rule"),
    [
        (["--k2", "18960"], "must be given"),
        ([*DRIVE, "--k1", "stiff"], "--k1 takes a number"),
        ([*DRIVE, "--k1", "nan"], "--k1 must be finite"),
        ([*DRIVE, "--velocity", "1e-3"], "exact model has no widths"),
        ([*DRIVE, "--semantics", "eq2"], "stick-slip semantics only"),
        ([*DRIVE, "--samples", "1"], "at least 2"),
        ([*DRIVE, "--samples", "1e12"], "at most 10000000 samples and periods"),
        ([*DRIVE, "--periods", "1e9"], "at most 10000000 samples and periods"),
        ([*DRIVE, "--model", "smooth", "--velocity", "0"], "--velocity must be positive"),
        ([*DRIVE, "--periods", "-1"], "length must be positive"),
        (
            [*DRIVE, "--periods", "1", "--duration", "1"],
            "a run has one length, --periods and --duration, remove one of them",
        ),
        ([*DRIVE, "--Omega", "0"], "--periods needs Omega above 0, Omega = 0, give --duration"),
        ([*DRIVE, "--m1", "-1"], "m1 must be positive"),
    ],
)
def test_errors_are_one_line_and_write_nothing(tmp_path: Path, arguments: list[str], rule: str) -> None:
    out = tmp_path / "run.csv"
    with pytest.raises(InputError, match=rule) as caught:
        _run(*arguments, "--out", str(out))
    assert "\n" not in str(caught.value)
    assert not out.exists()


def test_outputs_must_have_a_known_suffix_and_a_folder(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"must end in \.csv or \.nc"):
        _run(*DRIVE, "--out", str(tmp_path / "run.txt"))
    with pytest.raises(InputError, match="folder of the output must exist"):
        _run(*DRIVE, "--out", str(tmp_path / "missing" / "run.csv"))
