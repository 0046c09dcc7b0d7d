"""Remedies that name [prior]: rig.toml accepts each of them, and none is proposed for what [prior] refuses."""

import re
from dataclasses import replace
from pathlib import Path
from typing import cast

import numpy as np
import pytest

import capsule_id as cid
from capsule_id.api import Fit
from capsule_id.experiments.kind import default_registry, make_experiments
from capsule_id.parameters import Prior, parameter
from capsule_id.report.messages import finding_text, messages_of
from capsule_id.rig.model import Rig
from capsule_id.rig.read import read_rig
from capsule_id.views import Finding
from tests.experiments import bench
from tests.experiments.test_lint_remedies import coarse, found, write

KINDS = default_registry()
CONFLICT = {
    "unit": " N", "prior": "about 1", "experiments": "a", "fitted": 2.0, "p": 1e-9, "z": 6.0, "value": 2.0, "sd": 0.1,
    "informed": 0.9, "signed": False,
}  # fmt: skip


def text(code: str, level: str, facts: dict[str, object]) -> str:
    return finding_text(Finding(code, level, facts), messages_of(KINDS))  # type: ignore[arg-type]


@pytest.mark.parametrize("stated", ["", "scatter"])
@pytest.mark.parametrize("key", ["", "mu", '"k2[hard]"'])
def test_a_conflict_names_prior_only_where_it_can_be_stated(stated: str, key: str) -> None:
    """Before: "state [prior] noise_sd[d] = ..." of a name that [prior] refuses, without quotation marks."""
    words = text("priors.conflict", "fail", {**CONFLICT, "name": "noise_sd[d]", "key": key, "stated": stated})
    assert ("[prior]" in words) == bool(key)
    assert f"in [prior] {key} = {{" in words or not key
    tails = text("priors.tails", "warn", {"names": "noise_sd[d], mu", "keys": key})
    assert ("[prior]" in tails) == bool(key)


def test_the_remedy_of_a_signed_parameter_is_a_normal_prior(tmp_path: Path) -> None:
    """Before: a median and a factor, which [prior] refuses for k_cubic."""
    facts = {
        **CONFLICT,
        "name": "k_cubic",
        "key": "k_cubic",
        "unit": " N/m^3",
        "stated": "",
        "fitted": -1.3e9,
        "signed": True,
    }
    (line,) = re.findall(r"k_cubic = \{.*?\}", text("priors.conflict", "fail", facts))
    time = np.arange(400) / 2000.0
    folder = write(tmp_path, time, bench.released(time, 2e-3), 'stiffness = "cubic"', f"[prior]\n{line}\n")
    assert read_rig(folder, KINDS).priors["k_cubic"] == Prior("normal", 0.0, 2.6e9)


def test_a_prior_without_its_parameter_is_named(tmp_path: Path) -> None:
    """Before: not a word, and the fit had ratio 0.5 beside [prior] ratio."""
    time = np.arange(400) / 2000.0
    ratio = "[prior]\nratio = { median = 0.9, factor = 1.1 }\n"
    folder = write(tmp_path, time, bench.released(time, 2e-3), 'damping = "viscous"', ratio)
    result = cid.fit(folder, budget=None)
    (idle,) = [found for found in result.findings if found.code == "priors.idle"]
    assert "[prior] ratio has no effect" in result.text(idle)
    # An exact mass has no interval without a sample either.
    file = folder / "rig.toml"
    file.write_text(re.sub(r"(m1 = .*?)sd = [^,]*, ", r"\1", file.read_text(encoding="utf-8")), encoding="utf-8")
    result = cid.fit(folder, budget=None)
    assert result.summary.at["m1", "value"] == result.fixed["m1"]
    assert result.summary.loc["m1", ["mean", "median", "lower", "upper"]].isna().all()


def test_keys_of_priors_are_those_that_rig_toml_accepts(tmp_path: Path) -> None:
    """Every parameter of a decay: its key is read, and a parameter without a key is refused."""
    time = np.arange(400) / 2000.0
    values = bench.released(time, 2e-3)
    settings = 'damping = ["viscous", "dry"]\nstiffness = "cubic"\nnoise = "arma"\ndrift = "gp"'
    rig = read_rig(write(tmp_path / "rig", time, values, settings), KINDS)
    keys = {row.prior_key for e in make_experiments(rig) for row in e.parameters if row.prior_key}
    assert {"k1", "c", "F_dry", "k_cubic"} <= keys
    for e in make_experiments(rig):
        for row in e.parameters:
            kind = "scale = 1" if row.prior is not None and row.prior.kind == "halfnormal" else "median = 1, factor = 2"
            kind = "mean = 0, sd = 1" if row.prior is not None and row.prior.kind == "normal" else kind
            prior = f'[prior]\n"{row.name}" = {{ {kind}, unit = "{row.unit}" }}\n'
            folder = write(tmp_path / "own", time, values, settings, prior)
            if row.prior_key:
                assert row.name in read_rig(folder, KINDS).priors
            else:
                with pytest.raises(cid.InputError, match="unknown key"):
                    read_rig(folder, KINDS)
    assert parameter("k2", "hard").prior_key == '"k2[hard]"'


@pytest.mark.parametrize("rate", [25.0, 17.0])
def test_the_prior_that_the_text_of_an_aliased_decay_proposes_ends_the_finding(rate: float) -> None:
    """Before: "narrow enough to hold one of them only", which only the frequency found can be."""
    (finding,) = found(bench.rig(coarse(rate)), "decays.alias")
    ((median, factor),) = re.findall(
        r"k1 = \{ median = ([0-9.e+]+), factor = ([0-9.]+),", text("decays.alias", "fail", dict(finding.facts))
    )
    stated = {"k1": Prior("lognormal", float(median), float(factor))}
    assert found(bench.rig(coarse(rate), priors=stated), "decays.alias") == []


@pytest.mark.full
def test_a_sampling_that_cannot_show_the_usual_frequency_is_named() -> None:
    """An oscillation of 18.08 Hz sampled at 18.2 Hz has 150 samples per apparent period. Before: k1 = 0.065, trusted."""

    def decay_at(rate: float) -> list[Finding]:
        time = np.arange(0.0, 20.0, 1.0 / rate)
        columns = [bench.column("time", time), bench.column("x_rel", bench.released(time, 2e-3, c=0.05))]
        return found(bench.rig(bench.table("free_vibration", columns)), "decays.alias")

    (finding,) = decay_at(18.2)
    assert (finding.level, finding.parameters) == ("warn", ("k1",))
    others = finding.facts["others"].split(", ")
    assert "18.08" in others
    assert len(set(others)) == len(others)
    assert decay_at(400.0) == []


@pytest.mark.full
def test_a_held_rod_before_the_release_is_left_out_of_the_rules_too(tmp_path: Path) -> None:
    """Before: "must pass its rest position at least 2 times, 1 in 8800 samples" of a record that check accepts."""
    rng, time = np.random.default_rng(0), np.arange(8800) / 2000.0
    held = np.full(8000, 2e-3)
    values = np.concatenate([held, bench.released(time[:800], 2e-3)]) + 2e-6 * rng.standard_normal(8800)
    rig = read_rig(write(tmp_path / "rig", time, values), KINDS)
    assert [f.level for f in found(rig, "decays.release")] == ["warn"]
    (kind,) = [kind for kind in KINDS.kinds if kind.name == "free_vibration"]
    kind.check(rig.tables)
    # Negative control: a slow push is no swing.
    columns = [bench.column("time", time[:800]), bench.column("x_rel", np.linspace(0.0, 2e-3, 800))]
    with pytest.raises(cid.InputError, match="rest position"):
        kind.check([bench.table("free_vibration", columns)])


@pytest.mark.full
def test_the_console_names_a_mass_that_is_probably_in_another_unit() -> None:
    """110 kg for 110 g: the frequency is right, so no check of the fit sees it. Before: in the report only."""
    facts = {"name": "m1 of [rig]", "value": 110.0, "unit": "kg", "low": 0.002, "high": 50.0, "meant": "g"}
    unusual = Finding("readings.magnitude", "warn", facts)
    fit = cast(Fit, replace(cid.fit(bench_rig(), budget=None, experiments="bench"), findings=(unusual, unusual)))
    (remark,) = fit.remarks
    assert "If the number is in g, write that unit." in remark
    assert replace(fit, findings=()).remarks == []


def bench_rig() -> Rig:
    """One small decay."""
    time = np.arange(200) / 500.0
    values = bench.released(time, 2e-3) + 2e-5 * np.random.default_rng(1).standard_normal(200)
    return bench.rig(bench.table("free_vibration", [bench.column("time", time), bench.column("x_rel", values)]))
