"""The files of a result: strict JSON in the agreed shape, a table, pictures, a netCDF file that ArviZ opens."""

import contextlib
import dataclasses
import io
import json
import warnings
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any, cast

import dask
import numpy as np
import pandas as pd
import pytest
import xarray as xr

from capsule_id.commands.bifurcate import client_of
from capsule_id.errors import InputError, OutputError
from capsule_id.inference.result import Pointwise, Posterior, Result
from capsule_id.parameters import symbol_of
from capsule_id.report import columns
from capsule_id.report.columns import table_text
from capsule_id.report.html import Picture
from capsule_id.report.write import (
    data_tree,
    load_fields,
    netcdf_bytes,
    parameters_json,
    read_draws,
    read_sample,
    result_files,
    write_result,
)
from capsule_id.rig.model import ModelChoices
from capsule_id.views import Finding
from tests.report.conftest import COLOURED

#: Columns of numbers that the tests compare to the last digit.
NUMBERS = ("paper", "map", "standard_error", "mean", "sd", "lower", "upper", "ess", "rhat")


@pytest.fixture(scope="module")
def arviz() -> ModuleType:
    with warnings.catch_warnings():
        # The import announces ArviZ's own reorganisation; nothing here depends on it.
        warnings.simplefilter("ignore", FutureWarning)
        import arviz

        return arviz


@pytest.fixture(scope="module")
def folder(files: dict[str, bytes], tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("results")
    write_result(files, path)
    return path


def test_the_result_has_the_names_units_and_meanings_of_the_parameter_table(result: Result) -> None:
    for frame, physical in ((result.summary, True), (result.nuisances, False)):
        for name, row in frame.iterrows():
            known = result.registry.parameters[symbol_of(str(name))]
            assert (row["unit"], row["meaning"], physical) == (known.unit, known.meaning, known.physical), name


def _strict(text: str) -> dict:
    def refuse(word: str) -> float:
        raise AssertionError(f"{word} is not JSON")

    return json.loads(text, parse_constant=refuse)


@pytest.mark.full
def test_files(folder: Path, result: Result) -> None:
    names = {path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()}
    figures = {name for name in names if name.startswith("figures/")}
    assert names - figures == {"parameters.json", "parameters.csv", "posterior.nc", "report.html"}
    figures.remove("figures/data.npz")
    labels = {"friction", "motor_current", "corner", "traces", "point_fit_starts"}
    labels |= {f"support_spring_{s}" for s in ("soft", "medium", "stiff")} | {f"free_vibration_{i}" for i in (1, 2, 3)}
    assert figures == {f"figures/{label}.png" for label in labels}


def test_figures_are_those_of_the_page_at_150_dpi(folder: Path, drawn: tuple[Picture, ...]) -> None:
    from base64 import b64encode

    from PIL import Image

    page = (folder / "report.html").read_text(encoding="utf-8")
    for path in (folder / "figures").glob("*.png"):
        shown = next(picture for picture in drawn if picture.name == path.stem)
        assert b64encode(shown.svg or path.read_bytes()).decode() in page
        with Image.open(path) as image:
            assert image.info["dpi"] == pytest.approx((150, 150), abs=0.1)
            assert image.convert("RGB").getpixel((1, image.height - 2)) == (255, 255, 255)


def test_parameters_json_has_the_agreed_shape(folder: Path, result: Result) -> None:
    content = _strict((folder / "parameters.json").read_text(encoding="utf-8"))
    assert list(content) == [
        "rig",
        "synthetic",
        "trust",
        "not_in_sd",
        "parameters",
        "fixed",
        "verdict",
        "records",
        "provenance",
    ]
    assert content["rig"] == "twin"
    assert content["synthetic"] is True
    assert list(content["parameters"]) == list(result.summary.index)
    assert content["trust"] == "trusted"
    keys = [
        "unit", "value", "sd", "sd_unwidened", "widening", "quote", "basis", "trust", "ci95", "paper", "map", "mean", "median",
        "ci95_unwidened", "ess", "ess_bulk", "ess_tail", "rhat", "informed", "not_in_sd",
    ]  # fmt: skip
    for name, entry in content["parameters"].items():
        row = result.summary.loc[name]
        assert list(entry) == keys
        for key in ("value", "sd", "quote", "basis", "trust", "map", "mean", "median", "ess", "rhat"):
            assert entry[key] == row[key]  # not one digit is lost
        assert entry["ci95"] == [row["lower"], row["upper"]]
        assert entry["unit"] == row["unit"]
        assert entry["informed"] is bool(row["informed"])
        assert entry["paper"] == (None if np.isnan(row["paper"]) else row["paper"])
    assert content["verdict"]["clean"] is True
    keys = ["check", "level", "text", "code", "experiment", "parameters"]
    assert all(list(finding) == keys for finding in content["verdict"]["findings"])
    assert content["records"] == {}  # no forced run
    assert content["provenance"]["files"] == dict(result.rig.files)
    assert content["provenance"]["seed"] == 0
    assert content["provenance"]["versions"] == dict(result.provenance.versions)
    assert content["provenance"]["experiments"] == "bench"


def test_findings_in_json_name_their_experiment(result: Result) -> None:
    findings = (
        Finding("decays.slip", "fail", {"force": 4.0, "F_b": 3.0}, "run_1"),
        Finding("residuals.white", "fail", {**COLOURED, "record": "run_1"}, "run_1"),
        Finding("errors.stated", "ok"),
    )
    content = parameters_json(dataclasses.replace(result, findings=findings))
    verdict = cast(dict[str, Any], content["verdict"])
    assert verdict["clean"] is False
    slip, white, errors = verdict["findings"]
    assert (slip["check"], slip["code"], slip["level"]) == ("free decay", "decays.slip", "fail")
    assert slip["text"].startswith("run_1: expected a free capsule at rest, |f| <= F_b = 3 N; the record reaches 4 N")
    assert white["text"].startswith("run_1: expected residuals without correlation in time (white)")
    assert white["text"].count("run_1") == 1
    assert errors["text"] == "stated reading errors explain the scatter"


def test_a_finding_without_words_is_given_by_its_facts(result: Result) -> None:
    content = parameters_json(dataclasses.replace(result, findings=(Finding("balance", "ok", {"kg": 2.5}, "run_1"),)))
    verdict = cast(dict[str, Any], content["verdict"])
    said = {"check": "balance", "level": "ok", "text": "run_1: kg = 2.5", "code": "balance"}
    assert verdict["findings"] == [{**said, "experiment": "run_1", "parameters": []}]


def test_a_column_declared_once_is_in_every_output(
    result: Result, drawn: tuple[Picture, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Negative control: without the declaration it is in none."""
    monkeypatch.setattr("capsule_id.report.write.pictures", lambda _: drawn)  # a picture has no column
    shrinkage = columns.OutputColumn(
        "z_paper",
        "z of the paper",
        lambda row: f"{row.values['paper'] - row.values['mean']:+.9f}",
        lambda values: values["paper"] - values["mean"],
    )
    row = result.summary.loc["k1"]
    for declared, times in (((), 0), ((shrinkage,), 1)):
        monkeypatch.setattr(columns, "COLUMNS", (*columns.COLUMNS, *declared))
        folder = tmp_path / str(times)
        folder.mkdir()
        write_result(result_files(result), folder)
        entry = json.loads((folder / "parameters.json").read_text(encoding="utf-8"))["parameters"]["k1"]
        table = pd.read_csv(folder / "parameters.csv", index_col="name")
        page = (folder / "report.html").read_text(encoding="utf-8")
        console = table_text(result.summary, synthetic=False, width=200)
        number = f"{row['paper'] - row['mean']:+.9f}"
        assert ("z_paper" in entry) == ("z_paper" in table) == bool(times)
        # The page has a table of physical parameters and one of nuisances, and the paper estimates no nuisance.
        assert page.count(number) == console.count(number) == times
        assert ("z of the paper" in page) == ("z of the paper" in console) == bool(times)
        if times:
            assert entry["z_paper"] == pytest.approx(row["paper"] - row["mean"], rel=1e-12)
            assert table.loc["k1", "z_paper"] == pytest.approx(row["paper"] - row["mean"], rel=1e-12)


@pytest.mark.full
def test_point_fit_only_is_null_and_has_no_posterior(unsampled: Result, tmp_path: Path) -> None:
    write_result(result_files(unsampled), tmp_path)
    assert not (tmp_path / "posterior.nc").exists()
    entry = _strict((tmp_path / "parameters.json").read_text(encoding="utf-8"))["parameters"]["k1"]
    assert entry["map"] == 1421.3
    assert entry["paper"] == 1386.0
    assert [entry[key] for key in ("value", "sd", "basis", "trust")] == [1421.3, 0.97 * 3.1, "point", "not judged"]
    assert [entry[key] for key in ("mean", "median", "ci95", "ess", "rhat", "informed")] == [None] * 6


def test_infinite_numbers_become_null(result: Result) -> None:
    summary = result.summary.copy()
    summary.loc["k1", "rhat"] = np.inf
    summary.loc["k1", "lower"] = -np.inf
    content = parameters_json(dataclasses.replace(result, summary=summary))
    entry = _strict(json.dumps(content, allow_nan=False))["parameters"]["k1"]
    assert entry["rhat"] is None
    assert entry["ci95"] is None


def test_csv_reads_back(folder: Path, result: Result) -> None:
    # As text: pandas 2 reads numbers with an error in the last digits.
    table = pd.read_csv(folder / "parameters.csv", index_col="name", dtype=dict.fromkeys(NUMBERS, str))
    assert list(table.index) == [*result.summary.index, *result.nuisances.index]
    assert list(table["role"]) == ["physical"] * len(result.summary) + ["nuisance"] * len(result.nuisances)
    assert table["synthetic"].all()
    both = pd.concat([result.summary, result.nuisances])
    for column in NUMBERS:
        np.testing.assert_array_equal(table[column].to_numpy(float), both[column].to_numpy(float))


def test_directory_must_exist(files: dict[str, bytes], tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="No such file or directory; make this folder"):
        write_result(files, tmp_path / "absent")
    assert not (tmp_path / "absent").exists()


def test_same_result_same_bytes(
    folder: Path,
    drawn: tuple[Picture, ...],
    maker: Callable[..., Result],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    write_result(result_files(maker()), tmp_path)
    for path in (p for p in folder.rglob("*") if p.is_file()):
        assert (tmp_path / path.relative_to(folder)).read_bytes() == path.read_bytes(), path.name
    # Negative control: the numbers alone, beside the pictures of the first result, give other bytes.
    monkeypatch.setattr("capsule_id.report.write.pictures", lambda _: drawn)
    other = tmp_path / "other"
    other.mkdir()
    write_result(result_files(maker(seed=1)), other)
    assert (other / "posterior.nc").read_bytes() != (folder / "posterior.nc").read_bytes()
    assert (other / "report.html").read_bytes() != (folder / "report.html").read_bytes()


def _groups(data: Any) -> set[str]:
    """Names of the groups, ArviZ 0.2x or 1."""
    return set(data.groups() if callable(data.groups) else data.children)


def test_arviz_opens_every_group(folder: Path, result: Result, arviz: ModuleType) -> None:
    data = arviz.from_netcdf(str(folder / "posterior.nc"))
    read = {"posterior", "sample_stats", "observed_data", "log_likelihood", "posterior_predictive", "prior"}
    assert _groups(data) == read
    posterior = cast(Posterior, result.posterior)
    ensembles, draws, walkers, _ = posterior.draws.shape
    assert dict(data.posterior.sizes) == {
        "chain": ensembles * walkers, "draw": draws, "spring": 3, "noise_sd_of": 3, "scatter_of": 4,
    }  # fmt: skip
    np.testing.assert_array_equal(data.posterior["ensemble"], np.arange(ensembles * walkers) // walkers)
    assert all(variable.dtype == np.float64 for variable in data.posterior.data_vars.values())
    summary = arviz.summary(data, var_names=["k1", "k2"], kind="stats")
    assert summary.loc["k2[stiff]", "mean"] == pytest.approx(posterior.draws[..., 9].mean(), rel=1e-3)
    assert list(data.log_likelihood.chain.values) == [0, 2, 4, 6]
    assert list(data.log_likelihood.draw.values) == [0, 4, 8, 12, 16]
    assert list(data.posterior_predictive.chain.values) == [0, 4]
    assert list(data.posterior_predictive.draw.values) == [0, 8, 16]


def test_every_draw_is_in_its_place(folder: Path, result: Result) -> None:
    posterior = cast(Posterior, result.posterior)
    walkers = posterior.draws.shape[2]
    with xr.open_dataset(folder / "posterior.nc", group="posterior", engine="h5netcdf") as data:
        for e, draw, walker in ((0, 0, 0), (2, 5, 3), (3, 59, 7)):
            chain = data.isel(chain=e * walkers + walker, draw=draw)
            here = dict(zip(posterior.names, posterior.draws[e, draw, walker], strict=True))
            assert float(chain["k1"]) == here["k1"]
            assert float(chain["k2"].sel(spring="medium")) == here["k2[medium]"]
            assert float(chain["scatter"].sel(scatter_of="motor_current")) == here["scatter[motor_current]"]
            assert float(chain["g"]) == 9.81
        assert data["g"].attrs == {"units": "m/s^2", "fixed": 1}
        assert "fixed" not in data["m1"].attrs
        assert data["k2"].dims == ("chain", "draw", "spring")
        assert list(data["spring"].values) == ["soft", "medium", "stiff"]
        assert data["k2"].attrs["units"] == "N/m"
        assert data["noise_sd"].attrs["units"] == "m"
        assert data["scatter"].attrs["units"] == "N"
    with xr.open_dataset(folder / "posterior.nc", group="sample_stats", engine="h5netcdf") as stats:
        assert float(stats["lp"].isel(chain=2 * walkers + 3, draw=5)) == posterior.lp[2, 5, 3]
        assert float(stats["acceptance"].isel(chain=walkers)) == posterior.acceptance[1, 0]
        assert stats["acceptance"].dims == ("chain",)


def test_the_other_groups_hold_what_was_given(folder: Path, result: Result) -> None:
    for group in ("observed_data", "log_likelihood", "posterior_predictive", "prior"):
        with xr.open_dataset(folder / "posterior.nc", group=group, engine="h5netcdf") as data:
            assert all(len(variable.attrs["units"]) > 0 for variable in data.data_vars.values())
            if group == "prior":
                np.testing.assert_array_equal(data["k2"].sel(spring="stiff")[0], result.prior["k2[stiff]"])
                continue
            pointwise = cast(Pointwise, result.pointwise)
            if group == "log_likelihood":
                for label, values in pointwise.log_likelihood.items():
                    np.testing.assert_array_equal(data["readings"][..., data["experiment"] == label], values)
                continue
            given = result.observed if group == "observed_data" else pointwise.replicates
            assert [variable.attrs["experiment"] for variable in data.data_vars.values()] == list(given)
            for i, (label, values) in enumerate(given.items(), 1):
                np.testing.assert_array_equal(data[f"y{i}_{label}"], values)
                assert data[f"y{i}_{label}"].dims[-1] == f"row_{i}"


def _labels() -> list[str]:
    """200 labels: names that ArviZ and this file use, pairs with a suffix, other alphabets, dots, 255 bytes."""
    rng = np.random.default_rng(0)
    words = [
        "chain", "draw", "ensemble", "experiment", "row", "reading", "readings", "lp", "acceptance", "spring", "y1", "row_1",
        "posterior", "observed_data", "k1", "x", "x_row", "a", "a_row", "Größe", "振动", "полёт", "🙂", "a.b", "a..b", "-",
        "a b ", " a", "a]b[c", "y1_a", "L" * 300, "é" * 127, "L" * 299 + "M",
    ]  # fmt: skip
    letters = [*"abxyAB_.-[]éж振 ", "_row", "draw", "chain"]
    while len(words) < 200:
        word = "".join(rng.choice(letters, size=rng.integers(1, 12)))
        words += [word] if word not in words else []
    return words


@pytest.mark.full
def test_every_label_keeps_its_readings(result: Result, tmp_path: Path) -> None:
    """Before, ``draw`` made a file that no one could load, and ``a_row`` lost its readings beside ``a``."""
    labels, rng = _labels(), np.random.default_rng(1)
    sizes = dict(zip(labels, rng.integers(2, 5, size=len(labels)), strict=True))
    density, replicates = (
        {label: rng.normal(size=(*grid, n)) for label, n in sizes.items()} for grid in ((4, 5), (2, 3))
    )
    rows = {label: np.arange(n) for label, n in sizes.items()}
    pointwise = Pointwise(density, rows, replicates, np.arange(0, 8, 2), np.arange(0, 20, 4), 2)
    observed = {label: rng.normal(size=n) for label, n in sizes.items()}
    prior = {f"noise_sd[{label}]": rng.normal(size=7) for label in labels}
    (tmp_path / "x.nc").write_bytes(
        netcdf_bytes(data_tree(dataclasses.replace(result, observed=observed, pointwise=pointwise, prior=prior)))
    )
    _, read_prior, found = read_sample(tmp_path / "x.nc", cast(Posterior, result.posterior))
    read = cast(Pointwise, found)
    assert list(read.log_likelihood) == list(read.replicates) == labels
    for label in labels:
        np.testing.assert_array_equal(read.log_likelihood[label], density[label])
        np.testing.assert_array_equal(read.rows[label], rows[label])
        np.testing.assert_array_equal(read.replicates[label], replicates[label])
        np.testing.assert_array_equal(read_prior[f"noise_sd[{label}]"], prior[f"noise_sd[{label}]"])


@pytest.mark.full
def test_a_long_label_does_not_make_a_long_file_name(result: Result, tmp_path: Path) -> None:
    long = [
        dataclasses.replace(item, label=letter * 300) for item, letter in zip(result.comparisons, "aab", strict=False)
    ]
    write_result(result_files(dataclasses.replace(result, comparisons=tuple(long))), tmp_path)
    assert len([path for path in (tmp_path / "figures").glob("*.png") if len(path.stem) >= 80]) == 3


def test_without_arrays_only_the_sample_is_written(result: Result, tmp_path: Path, arviz: ModuleType) -> None:
    bare = dataclasses.replace(result, fixed={}, observed={}, prior={}, pointwise=None)
    (tmp_path / "x.nc").write_bytes(netcdf_bytes(data_tree(bare)))
    assert _groups(arviz.from_netcdf(str(tmp_path / "x.nc"))) == {"posterior", "sample_stats"}


def test_exact_members_join_their_family(result: Result, tmp_path: Path) -> None:
    fixed = {"k2[rigid]": 1e6}
    (tmp_path / "x.nc").write_bytes(netcdf_bytes(data_tree(dataclasses.replace(result, fixed=fixed))))
    with xr.open_dataset(tmp_path / "x.nc", group="posterior", engine="h5netcdf") as data:
        assert list(data["spring"].values) == ["soft", "medium", "stiff", "rigid"]
        assert np.all(data["k2"].sel(spring="rigid") == 1e6)
        assert "fixed" not in data["k2"].attrs


def test_netcdf_refusals(result: Result, unsampled: Result) -> None:
    with pytest.raises(ValueError, match="nothing was sampled"):
        data_tree(unsampled)


def test_draws_of_a_fit_hold_its_law(result: Result, tmp_path: Path) -> None:
    """Before: a diagram of constant friction had ratio 0.5, and one of another law had eq. (1) of the paper, not a word."""
    names = [name for name in result.posterior.names if name != "v_s"] if result.posterior else []
    assert result.posterior is not None
    kept = [result.posterior.names.index(name) for name in names]
    sample = dataclasses.replace(result.posterior, names=tuple(names), draws=result.posterior.draws[..., kept])
    rig = dataclasses.replace(result.rig, model=ModelChoices(friction="constant"))
    for law, refused in (("constant friction", False), ("mine.Law", True)):
        own = dataclasses.replace(result.provenance, friction=law)
        fit = dataclasses.replace(result, rig=rig, posterior=sample, provenance=own)
        (tmp_path / "x.nc").write_bytes(netcdf_bytes(data_tree(fit)))
        with pytest.raises(InputError, match=r"mine\.Law") if refused else contextlib.nullcontext():
            draws = read_draws(tmp_path / "x.nc", 3, 0)
            assert (draws["ratio"].tolist(), draws["v_s"].tolist()) == ([1.0] * 3, [1.0] * 3)


def test_a_name_alone_joins_the_family(result: Result, tmp_path: Path) -> None:
    """The slope of the rig and that of one table are both sampled where both have an sd."""
    (tmp_path / "x.nc").write_bytes(netcdf_bytes(data_tree(dataclasses.replace(result, fixed={"k2": 1.0}))))
    draws = read_draws(tmp_path / "x.nc", 3, 0)
    assert draws["k2"].tolist() == [1.0, 1.0, 1.0]
    assert {"k2[soft]", "k2[medium]", "k2[stiff]"} < set(draws)


@pytest.mark.benchmark
def test_writing_is_quick(maker: Callable[..., Result], tmp_path: Path) -> None:
    from time import process_time

    result = maker(draws=250, walkers=64)
    (tmp_path / "warm.nc").write_bytes(netcdf_bytes(data_tree(result)))
    start = process_time()
    (tmp_path / "x.nc").write_bytes(netcdf_bytes(data_tree(result)))
    assert process_time() - start < 1.0
    start = process_time()
    write_result(result_files(result), tmp_path)
    assert process_time() - start < 3.0
    start = process_time()
    load_fields(tmp_path, result.registry)
    assert process_time() - start < 1.0


@pytest.mark.full
def test_netcdf_is_written_beside_a_cluster() -> None:
    """Before: a map and the fits of several rigs ended with "Semaphore or Lock not known" for --scheduler processes."""
    data = xr.Dataset({"x": ("time", np.arange(3.0))})
    with client_of("threads"), client_of("processes"):  # a second cluster takes another port
        written = netcdf_bytes(data)
    assert dask.config.get("scheduler", None) is None
    assert xr.load_dataset(io.BytesIO(written)).identical(data)
