"""The installed ``fit-params data/`` as in README; its files are read back and checked."""

import json
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import arviz
import emcee
import numpy as np
import pytest
from scipy import stats

import capsule_id as cid
from capsule_id.experiments.base import BLOCKS
from capsule_id.synthetic import Truth
from tests.cli_tools import DATA, ROOT, environment

MAX_RHAT, MIN_ESS, MAX_Z = 1.01, 400.0, 3.5
WALKER = ("chain", "draw")


class Job:
    """The finished run and its files."""

    def __init__(self, folder: Path) -> None:
        (folder / "data").symlink_to(DATA)
        words = [str(Path(sys.executable).parent / "fit-params"), "data/", "--experiments", "bench", "--quiet"]
        self.done = subprocess.run(words, cwd=folder, env=environment(), capture_output=True, text=True, check=False)
        self.directory = folder / "results" / "twin"
        self.parameters = json.loads((self.directory / "parameters.json").read_text(encoding="utf-8"))
        self.idata: Any = arviz.from_netcdf(self.directory / "posterior.nc")

    def draws(self, name: str) -> np.ndarray:
        """(ensemble, draw, walker), SI."""
        variable, _, of = name.rstrip("]").partition("[")
        array = self.idata.posterior[variable]
        values = (array.sel(spring=of) if of else array).transpose(*WALKER).to_numpy()
        ensemble = self.idata.posterior["ensemble"].to_numpy()
        return np.stack([values[ensemble == e].T for e in np.unique(ensemble)])


@pytest.fixture(scope="module")
def job(tmp_path_factory: pytest.TempPathFactory) -> Job:
    return Job(tmp_path_factory.mktemp("job"))


def names(job: Job) -> list[str]:
    return list(job.parameters["parameters"])


def test_it_ends_clean_and_quiet(job: Job) -> None:
    assert (job.done.returncode, job.done.stderr) == (0, "")
    assert job.parameters["verdict"]["clean"] is True
    assert "SYNTHETIC" in job.done.stdout.splitlines()[0]
    report, verdict = job.done.stdout.splitlines()[-2:]
    assert report == f"report: {Path('results/twin/report.html')}"
    assert "`results/twin/report.html`" in (ROOT / "README.md").read_text(encoding="utf-8")
    assert verdict == "verdict: trusted; no check failed"
    entries = {path.name for path in job.directory.iterdir()}
    assert entries == {"parameters.json", "parameters.csv", "posterior.nc", "report.html", "figures"}
    assert [path.name for path in job.directory.parent.iterdir()] == ["twin"]


def test_parameters_json_keeps_the_contract(job: Job) -> None:
    content = job.parameters
    assert (content["rig"], content["synthetic"], content["provenance"]["seed"]) == ("twin", True, 0)
    springs = [name for name in Truth() if name.startswith("k2[")]
    assert set(content["parameters"]) == {"m1", "m2", "k1", "c", "mu", "v_s", "K", *springs}
    keys = {
        "unit",
        "value",
        "sd",
        "basis",
        "trust",
        "paper",
        "map",
        "mean",
        "median",
        "ci95",
        "ess",
        "ess_bulk",
        "ess_tail",
        "rhat",
        "informed",
    }
    assert content["trust"] == "trusted"
    for row in content["parameters"].values():
        assert keys <= set(row)
        assert (row["value"], row["basis"], row["trust"]) == (row["median"], "sample", "trusted")
        low, high = row["ci95"]
        assert low < row["median"] < high
    assert set(content["provenance"]["files"]) == {path.name for path in DATA.iterdir()} - {"README.md"}
    units = {name: row["unit"] for name, row in content["parameters"].items()}
    assert units == {
        "m1": "kg", "m2": "kg", "k1": "N/m", "c": "N s/m", "mu": "1", "v_s": "m/s", "K": "N/A", **dict.fromkeys(springs, "N/m")
    }  # fmt: skip


def test_it_is_loaded_as_an_object(job: Job) -> None:
    result = cid.load(job.directory)
    assert (result.trust, list(result.summary.index)) == ("trusted", names(job))
    assert [result.summary.at[name, "value"] for name in names(job)] == [
        job.parameters["parameters"][name]["value"] for name in names(job)
    ]


def test_groups_and_dimensions(job: Job) -> None:
    groups = set(job.idata.groups())
    assert {"posterior", "sample_stats", "observed_data", "log_likelihood", "prior"} <= {g.strip("/") for g in groups}
    posterior = job.idata.posterior
    for name in ("k1", "c", "mu", "v_s", "K", "m1", "m2"):
        assert posterior[name].dims == WALKER
        assert posterior[name].attrs["units"] == job.parameters["parameters"][name]["unit"]
    assert posterior["k2"].dims == (*WALKER, "spring")
    assert posterior["k2"]["spring"].to_numpy().tolist() == ["soft", "medium", "stiff"]
    assert posterior["ensemble"].dims == ("chain",)
    ensembles, walkers = np.unique(posterior["ensemble"], return_counts=True)
    assert len(ensembles) >= 4
    assert len(set(walkers)) == 1
    assert job.idata.sample_stats["lp"].dims == WALKER
    assert np.all((job.idata.sample_stats["acceptance"] > 0.0) & (job.idata.sample_stats["acceptance"] <= 1.0))
    for label, data in job.idata.observed_data.data_vars.items():
        assert job.idata.posterior_predictive[label].shape[-1] == data.size
        own = job.idata.log_likelihood["experiment"] == data.attrs["experiment"]
        assert int(np.sum(own)) == (
            BLOCKS if data.size > BLOCKS else data.size
        )  # stretches of a record, rows of a table


def split_rhat(chains: np.ndarray) -> float:
    """Gelman et al., Bayesian Data Analysis, 3rd edition, eq. (11.4), halves of (chain, n) as chains of their own."""
    half = chains.shape[1] // 2
    parts = [part for chain in chains for part in (chain[:half], chain[-half:])]
    within = np.mean([np.var(part, ddof=1) for part in parts])
    between = half * np.var([np.mean(part) for part in parts], ddof=1)
    return float(np.sqrt(((half - 1) / half * within + between / half) / within))


def test_convergence_recomputed(job: Job) -> None:
    for name in names(job):
        draws, row = job.draws(name), job.parameters["parameters"][name]
        rhat = split_rhat(draws.reshape(len(draws), -1))
        times = [float(emcee.autocorr.integrated_time(chain[..., None], quiet=True)[0]) for chain in draws]
        ess = sum(chain.size / max(tau, 1.0) for chain, tau in zip(draws, times, strict=True))
        assert rhat == pytest.approx(row["rhat"], abs=1e-6)
        assert ess == pytest.approx(row["ess"], rel=1e-6)
        assert rhat <= MAX_RHAT
        assert ess >= MIN_ESS


def test_a_shifted_ensemble_would_be_seen(job: Job) -> None:
    draws = job.draws("k1").copy()
    draws[0] += 0.5 * np.std(draws)
    assert split_rhat(draws.reshape(len(draws), -1)) > MAX_RHAT


def test_summaries_recomputed(job: Job) -> None:
    for name in names(job):
        draws, row = job.draws(name).ravel(), job.parameters["parameters"][name]
        recomputed = [np.mean(draws), np.std(draws, ddof=1), *np.quantile(draws, [0.5, 0.025, 0.975])]
        assert [row["mean"], row["sd"], row["median"], *row["ci95"]] == pytest.approx(recomputed, rel=1e-12)


def test_the_truth_is_found(job: Job) -> None:
    """z = Phi^-1(posterior CDF at the truth); the paper's own estimates of k1 and v_s, for contrast, are far off."""
    truth = Truth()
    z = {name: stats.norm.ppf(np.mean(job.draws(name) < truth[name])) for name in names(job)}
    assert max(abs(value) for value in z.values()) <= MAX_Z, z
    for name in ("k1", "v_s"):
        row = job.parameters["parameters"][name]
        assert abs(row["paper"] - truth[name]) > MAX_Z * row["sd"]


def test_readme_shows_these_numbers(job: Job) -> None:
    """Rounded as printed; another processor may change the last digit."""
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    printed = re.findall(r"^(\w+) +(\S+(?: s/m)?) +(\S+) ± (\S+) +(trusted)$", text, re.MULTILINE)
    assert len(printed) >= 3
    for name, unit, value, sd, trust in printed:
        row = job.parameters["parameters"][name]
        assert (unit, trust) == (row["unit"], row["trust"])
        assert float(value) == pytest.approx(row["value"], abs=0.1 * row["sd"])
        assert float(sd) == pytest.approx(row["sd"], rel=0.1)
    (header,) = re.findall(r"^ +unit +value ± sd +trust$", text, re.MULTILINE)
    assert job.done.stdout.splitlines()[1].startswith(header)
