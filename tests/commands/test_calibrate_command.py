"""``capsule-id calibrate``: ranks, resuming, refusals, and planted errors; most tests have a known posterior as the fit."""

import json
import re
import signal
from argparse import Namespace
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
import pytest

from capsule_id.cli import capsule_id
from capsule_id.commands import calibrate
from capsule_id.inference import target
from capsule_id.parameters import QUANTILE_975, Prior
from capsule_id.rig.read import read_rig
from capsule_id.synthetic import MASS_SD
from tests.cli_tools import listing, message

#: Draws of the known posterior, and sd of its reading of each parameter, in sds of the prior.
DRAWS, NOISE = 2000, 0.7
TABLES = ("calibration.csv", "ranks.csv")


@dataclass
class KnownFit:
    """The exact posterior of one reading of every parameter, z + N(0, ``NOISE``²), z in sds of the prior; or a wrong one."""

    error: str = ""
    fitted: list[str] = field(default_factory=list)
    stop: Callable[[str], None] = lambda name: None

    def __call__(self, folder: Path, options: Namespace) -> Any:
        self.stop(folder.name)
        self.fitted.append(folder.name)
        truth = json.loads(folder.with_name(f"{folder.name}.truth.json").read_text())["parameters"]
        priors = calibrate.priors_of(Namespace(runs=False, set=[]))
        random = np.random.default_rng([options.seed, 1])
        draws = {name: self.draws(prior, truth[name], random) for name, prior in priors.items()}
        ends = pd.DataFrame({name: np.quantile(own, [0.025, 0.975]) for name, own in draws.items()}).T
        sample = np.stack([*draws.values()], axis=-1).reshape(2, DRAWS // 40, 20, -1)
        posterior = SimpleNamespace(names=tuple(draws), draws=sample, ess_bulk=np.full(len(draws), 1000.0))
        frame = ends.set_axis(["lower", "upper"], axis=1)
        return SimpleNamespace(posterior=posterior, to_dataframe=lambda: frame, trust="trusted", findings=())

    def draws(self, prior: Prior, truth: float, random: np.random.Generator) -> np.ndarray:
        """(DRAWS,) values of one parameter, SI."""
        positive, lognormal = prior.kind == "halfnormal", prior.kind == "lognormal"
        log_spread = np.log(prior.spread) / QUANTILE_975
        z = np.log(truth / prior.location) / log_spread if lognormal else (truth - prior.location) / prior.spread
        reading = z + NOISE * random.standard_normal()
        noise = NOISE / (2.0 if self.error == "halved noise" else 1.0)
        shrink = 1.0 if self.error == "forgotten prior" else 1.0 / (1.0 + noise**2)
        wide = shrink * reading + np.sqrt(shrink) * noise * random.standard_normal(20 * DRAWS if positive else DRAWS)
        if positive:
            wide = wide[wide > 0.0]
            weight = 1.0 / wide if self.error == "wrong Jacobian" else np.ones(wide.size)
            wide = random.choice(wide, DRAWS, p=weight / np.sum(weight))
        return prior.location * np.exp(log_spread * wide) if lognormal else prior.location + prior.spread * wide


@pytest.fixture
def known(monkeypatch: pytest.MonkeyPatch) -> KnownFit:
    fit = KnownFit()
    monkeypatch.setattr(calibrate, "fit_by_worker", fit)
    return fit


def run(directory: Path, rigs: int, *words: str) -> int:
    return capsule_id(["calibrate", str(directory), "--rigs", str(rigs), "--quiet", *words])


def tables(directory: Path) -> list[bytes]:
    return [(directory / name).read_bytes() for name in TABLES]


def test_ranks_of_the_exact_posterior_are_uniform(
    known: KnownFit, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(tmp_path / "study", 60) == 0
    out, err = capsys.readouterr()
    assert err == ""
    assert "fitted 60 of 60 rigs, 60 trusted" in out
    table = pd.read_csv(tmp_path / "study" / "calibration.csv", index_col="parameter")
    assert list(table.index) == [*calibrate.priors_of(Namespace(runs=False, set=[])), calibrate.LOG_PRIOR]
    assert f"smallest p x number of parameters: {table['p x parameters'].min():.2g}" in out
    assert table["p x parameters"].min() >= 0.01
    assert table["inside 95 %"].drop(calibrate.LOG_PRIOR).between(0.85, 1.0).all()
    ranks = pd.read_csv(tmp_path / "study" / "ranks.csv")
    assert len(ranks) == 60 * len(table)
    assert ranks["rank"].between(0, 255).all()
    assert set(ranks["draws"]) == {255}


@pytest.mark.parametrize("error", ["wrong Jacobian", "forgotten prior", "halved noise"])
def test_a_planted_error_is_found(
    known: KnownFit, tmp_path: Path, capsys: pytest.CaptureFixture[str], error: str
) -> None:
    known.error = error
    assert run(tmp_path / "study", 60) == 3
    line = capsys.readouterr().err
    assert line.startswith("capsule-id calibrate: ranks not uniform: ")
    assert line.count("\n") == 1
    table = pd.read_csv(tmp_path / "study" / "calibration.csv", index_col="parameter")
    assert table["p x parameters"].min() < 0.001


def test_the_truth_comes_from_the_priors_of_rig_toml(known: KnownFit, tmp_path: Path) -> None:
    """Each prior of a study stands in rig.toml to the last digit, and the masses are stated with the study's centre."""
    assert run(tmp_path / "study", 1, "--set", "k1=1500") == 0
    priors = calibrate.priors_of(Namespace(runs=False, set=["k1=1500"]))
    rig = read_rig(tmp_path / "study" / "rigs" / "rig_0", calibrate.default_registry())
    stated = {name: prior for name, prior in priors.items() if name not in MASS_SD}
    assert priors["k1"] == Prior("lognormal", 1500.0, 1.3)
    assert dict(rig.priors) == stated
    assert rig.m1 is not None
    assert (rig.m1.value, rig.m1.sd) == pytest.approx((priors["m1"].location, MASS_SD["m1"]))


@pytest.mark.usefixtures("interrupts")
@pytest.mark.parametrize("scheduler", [(), ("--scheduler", "threads")], ids=["in turn", "threads"])
def test_an_interrupted_study_continues_to_the_same_tables(
    known: KnownFit, tmp_path: Path, capfd: pytest.CaptureFixture[str], scheduler: tuple[str, ...]
) -> None:
    assert run(tmp_path / "whole", 3) == 0

    def interrupt(name: str) -> None:
        if len(known.fitted) == 4 and not scheduler:
            signal.raise_signal(signal.SIGINT)
            raise KeyboardInterrupt

    known.stop = interrupt
    if not scheduler:
        assert run(tmp_path / "study", 3) == 130
        assert capfd.readouterr().err == "capsule-id: interrupted\n"
        assert len((tmp_path / "study" / "rigs.jsonl").read_text().splitlines()) == 2
        (tmp_path / "study" / "rigs" / "rig_1" / "rig.toml").unlink()  # a folder that was being written
    known.stop = lambda name: None
    known.fitted.clear()
    assert run(tmp_path / "study", 3, *scheduler) == 0
    assert sorted(known.fitted) == (["rig_0", "rig_1", "rig_2"] if scheduler else ["rig_1", "rig_2"])
    assert tables(tmp_path / "study") == tables(tmp_path / "whole")


def test_more_rigs_continue_a_study(known: KnownFit, tmp_path: Path) -> None:
    assert run(tmp_path / "whole", 3) == 0
    assert run(tmp_path / "study", 1) == 0
    assert run(tmp_path / "study", 3) == 0
    assert known.fitted == ["rig_0", "rig_1", "rig_2"] * 2
    assert tables(tmp_path / "study") == tables(tmp_path / "whole")


def test_a_rig_that_cannot_be_fitted_is_counted(
    known: KnownFit, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def fail(name: str) -> None:
        if name == "rig_1":
            raise RuntimeError("no finite log-posterior")

    known.stop = fail
    assert run(tmp_path / "study", 3) == 0
    out = capsys.readouterr().out
    assert "rig 1 not fitted: RuntimeError: no finite log-posterior" in out
    assert "fitted 2 of 3 rigs" in out


def test_a_study_without_a_fitted_rig_fails(
    known: KnownFit, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def fail(name: str) -> None:
        raise RuntimeError("no memory")

    known.stop = fail
    assert run(tmp_path / "study", 2) == 1
    assert capsys.readouterr().err == f"capsule-id calibrate: no rig fitted; see {tmp_path / 'study'}\n"


@pytest.mark.parametrize(
    ("directory", "words", "named"),
    [
        ("study", ("--seed", "1"), "a begun study continues with the same options and versions, seed was 0, repeat"),
        ("study", ("--runs",), "runs was False"),
        ("study", ("--set", "k1=1500"), "priors was {"),
        ("damaged", (), "DIR must be a new folder, or one that calibrate began"),
        ("other", (), "DIR must be a new folder, or one that calibrate began"),
        ("file", (), "DIR must be a new folder, or one that calibrate began"),
        ("new", ("--rigs", "0"), "--rigs must be positive, 0, give 1 or more"),
        ("new", ("--seed", "-1"), "--seed must not be negative"),
        ("new", ("--set", "g=9.8"), "--set takes a parameter of the twin, g, choose from m1, m2, k1"),
        ("new", ("--set", "k1=-1"), "k1 must be positive and finite"),
        ("new", ("--scheduler", "nowhere:1:2"), "the address of a Dask scheduler"),
    ],
)
def test_bad_input_is_named_and_nothing_is_written(
    known: KnownFit,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    directory: str,
    words: tuple[str, ...],
    named: str,
) -> None:
    assert run(tmp_path / "study", 1) == 0
    for folder, file in (("damaged", "rigs.jsonl"), ("other", "notes.txt")):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / file).write_text("{")
    (tmp_path / "file").write_text("kept")
    before = listing(tmp_path)
    capsys.readouterr()
    assert run(tmp_path / directory, 1, *words) == 2
    err = message(capsys.readouterr().err)
    assert named in err
    assert err.count("\n") == 1
    assert listing(tmp_path) == before


@pytest.mark.full
def test_the_shipped_fit_gives_the_same_tables_when_it_is_continued(tmp_path: Path) -> None:
    assert run(tmp_path / "whole", 2) in (0, 3)
    assert run(tmp_path / "study", 1) in (0, 3)
    assert run(tmp_path / "study", 2) in (0, 3)
    assert tables(tmp_path / "study") == tables(tmp_path / "whole")
    outcome = json.loads((tmp_path / "study" / "rigs.jsonl").read_text().splitlines()[1])
    assert outcome["trust"] in ("trusted", "not judged", "not trusted")
    assert outcome["seconds"] > 0.0
    assert set(outcome["ranks"]) == {*outcome["truth"], calibrate.LOG_PRIOR}


def change_priors(monkeypatch: pytest.MonkeyPatch, name: str, change: Callable[[np.ndarray], np.ndarray]) -> None:
    """Let every fit change one field of its priors."""
    begin = target.Priors.__init__

    def changed(self: Any, parameters: Any) -> None:
        begin(self, parameters)
        object.__setattr__(self, name, change(np.asarray(getattr(self, name))))

    monkeypatch.setattr(target.Priors, "__init__", changed)


def plant(error: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Plant an error into the fit: no Jacobian, log-normal priors of hundredfold width, or half the stated sds."""
    if error == "wrong Jacobian":
        change_priors(monkeypatch, "jacobian", np.zeros_like)
    if error == "forgotten prior":
        # Relative sds of the masses are below 0.005, and the widths of noise levels too are in SI.
        change_priors(monkeypatch, "width", lambda width: np.where(width > 0.03, 100.0 * width, width))
    if error == "halved noise":
        fit = calibrate.fit_by_worker

        def with_half_the_noise(folder: Path, options: Namespace) -> Any:
            text = (folder / "rig.toml").read_text()
            stated = r"(?m)^(\w+_sd = \{ value = )([^,]+)"
            (folder / "rig.toml").write_text(re.sub(stated, lambda one: f"{one[1]}{0.5 * float(one[2])!r}", text))
            return fit(folder, options)

        monkeypatch.setattr(calibrate, "fit_by_worker", with_half_the_noise)


@pytest.mark.slow
@pytest.mark.parametrize("error", ["wrong Jacobian", "forgotten prior", "halved noise"])
def test_a_planted_error_of_the_shipped_fit_is_found(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: str
) -> None:
    plant(error, monkeypatch)
    assert run(tmp_path / "study", 60) == 3
    table = pd.read_csv(tmp_path / "study" / "calibration.csv", index_col="parameter")
    print(table)
    assert table["p x parameters"].min() < 0.001


@pytest.mark.slow
@pytest.mark.parametrize(("rigs", "words"), [(200, ()), (30, ("--runs",))], ids=["bench", "runs"])
def test_a_study_of_the_shipped_fit(tmp_path: Path, rigs: int, words: tuple[str, ...]) -> None:
    """The studies of a release: guide, benchmarks."""
    assert run(tmp_path / "study", rigs, "--scheduler", "processes", *words) == 0
    table = pd.read_csv(tmp_path / "study" / "calibration.csv", index_col="parameter")
    print(table)
    assert table["rigs"].min() >= 0.97 * rigs
    assert table["p x parameters"].min() > 0.01
