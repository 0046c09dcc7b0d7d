"""Experiments and log-posteriors are frozen trees of numbers: they stack, and those of one structure share programs."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest

from capsule_id.api import read_rig
from capsule_id.experiments.base import About, Experiment, Fitted, Start, ValuesBySymbol
from capsule_id.experiments.free_vibration.experiment import FreeVibration
from capsule_id.experiments.free_vibration.readings import DecayModel
from capsule_id.experiments.kind import make_experiments
from capsule_id.experiments.misfit import Misfit
from capsule_id.inference.checks.verdict import run_checks
from capsule_id.inference.marginal import conditional, density_of
from capsule_id.inference.point_fit import point_fit
from capsule_id.inference.point_stage import SampledFit
from capsule_id.inference.tables import make_notes
from capsule_id.inference.target import LogPosterior
from capsule_id.parameters import Parameter, Prior
from capsule_id.rig.model import Rig, Table
from capsule_id.synthetic import synthesize
from capsule_id.views import Comparison, Finding, ResultTable
from tests.capsule_cases import jit_quickly
from tests.experiments import bench
from tests.forced_runs import make, theta

TIME = np.arange(300) / 1000.0
VALUES = {"k1": bench.K1, "c": bench.C, "m1": bench.M1, "g": bench.G, "noise_sd": 2e-5}


def decay(seed: int, **settings: object) -> FreeVibration:
    x = bench.released(TIME, 2e-3) + 2e-5 * np.random.default_rng(seed).standard_normal(len(TIME))
    columns = [bench.column("time", TIME), bench.column("x_rel", x)]
    table = bench.table("free_vibration", columns, f"decay_{seed}", **settings)
    return FreeVibration(table, bench.rig(table))


def stacked(experiments: Sequence[Experiment]) -> Any:
    return jax.tree.map(lambda *leaves: jnp.stack([jnp.asarray(leaf) for leaf in leaves]), *experiments)


@pytest.mark.full
def test_experiments_that_differ_in_numbers_and_label_are_computed_together() -> None:
    for members, values in (([decay(1), decay(2)], VALUES), ([make(2), make(3)], theta(2))):
        together = jit_quickly(jax.vmap(lambda e, values=values: e.log_likelihood(values)))(stacked(members))
        alone = [float(e.log_likelihood(values, np)) for e in members]
        np.testing.assert_allclose(together, alone, rtol=1e-10)
        assert members[0].label != members[1].label
        assert abs(alone[0] - alone[1]) > 1.0


def test_they_share_a_compiled_program_and_others_do_not() -> None:
    traced = []

    @jax.jit
    def likelihood(e: Experiment) -> Any:
        traced.append(e.kind)
        return e.log_likelihood(VALUES | {"F_dry": 0.05, "amplitude": 2e-3, "turning_time": 0.0})

    assert float(likelihood(decay(1))) != float(likelihood(decay(2)))
    assert len(traced) == 1
    likelihood(decay(2).with_model(DecayModel(("dry",))))
    assert len(traced) == 2


@pytest.mark.parametrize("experiment", [decay(1), make(0)], ids=["decay", "run"])
def test_an_experiment_is_frozen_and_its_leaves_are_numbers(experiment: Experiment) -> None:
    assert all(np.asarray(leaf).dtype == float for leaf in jax.tree.leaves(experiment))
    with pytest.raises(dataclasses.FrozenInstanceError):
        experiment.values = np.zeros(3)  # type: ignore[attr-defined]


@pytest.mark.full
def test_every_kind_has_numbers_alone_as_leaves(tmp_path: Path) -> None:
    synthesize(tmp_path / "rig", 3)
    for e in make_experiments(read_rig(tmp_path / "rig")):
        assert all(np.asarray(leaf).dtype == float for leaf in jax.tree.leaves(e)), e.kind


def test_another_start_or_part_of_a_run_leaves_the_run_as_it_was() -> None:
    run = make(0, samples=600)
    before = [np.copy(leaf) for leaf in jax.tree.leaves(run)]
    assert run.remade(run.table, capsule_rate=0.0).moves == 0.0
    assert [part.time[0] for part in run.parts(0.3)][1:] != [run.time[0]]
    for old, new in zip(before, jax.tree.leaves(run), strict=True):
        np.testing.assert_array_equal(old, new)


@pytest.mark.full
def test_log_posteriors_of_many_rigs_share_one_program(tmp_path: Path) -> None:
    sizes, values = [], []
    for seed in (1, 2, 3):
        synthesize(tmp_path / f"rig{seed}", seed)
        rig = read_rig(tmp_path / f"rig{seed}")
        target = LogPosterior(rig, make_experiments(rig))
        start = target.starts()
        u = target.unconstrain(np.array([start[name].centre for name in target.names]))
        values.append(float(density_of(target)(u[None])[0]))
        sizes.append(conditional._cache_size())
    assert sizes[0] == sizes[1] == sizes[2]
    assert len(set(values)) == 3
    # Negative control: another damping model is another structure.
    others = [e.with_model(DecayModel(("dry",))) if isinstance(e, FreeVibration) else e for e in make_experiments(rig)]
    other = LogPosterior(rig, others)
    density_of(other)(np.zeros((1, other.dimension)))
    assert conditional._cache_size() == sizes[0] + 1


def check_balance(members: Sequence["Weighing"], fit: Fitted) -> list[Finding]:
    return [Finding("balance", "ok", {"members": len(members), "load": fit.values["load"]})]


def weighing_table(members: Sequence["Weighing"], fit: Fitted) -> list[ResultTable]:
    frame = pd.DataFrame({"kg": [fit.values["load"]]}, index=[e.label for e in members][:1])
    return [ResultTable("weighings", frame)]


class Weighing(Experiment):
    """A kind that the package does not know, with a parameter of its own: readings of one load."""

    values: np.ndarray
    sd: float

    checks = (check_balance,)
    tables = (weighing_table,)

    def __init__(self, table: Table, rig: Rig) -> None:
        row = Parameter("load", "kg", "load on the balance", "M", Prior("lognormal", 1.0, 100.0))
        self.about, self.values, self.sd = About(table, rig, (row,)), table["load"], 0.01

    @property
    def observed(self) -> np.ndarray:
        return self.values

    def misfits(self, theta: ValuesBySymbol, xp: ModuleType = jnp) -> tuple[Misfit]:
        return (Misfit(self.values - theta["load"], self.sd**2, 0.0, xp.zeros((self.n, 0))),)

    def starts(self) -> dict[str, Start]:
        return {"load": Start(float(np.mean(self.values)), 0.1)}

    def comparisons(self, theta: ValuesBySymbol, draws: list[ValuesBySymbol]) -> tuple[Comparison, ...]:
        raise NotImplementedError


@pytest.mark.full
def test_a_kind_from_elsewhere_is_fitted_checked_and_tabulated() -> None:
    """Beside a decay: inference reads only what the class itself declares."""
    columns = [bench.column("load", [0.49, 0.5, 0.52, 0.51])]
    rows = np.arange(2, 6)
    tables = [Table("weighing", f"w{i}", f"w{i}.csv", {"load": columns[0]}, {}, rows) for i in (1, 2)]
    own = [Weighing(table, bench.rig()) for table in tables]
    target = LogPosterior(bench.rig(), [decay(1), *own])
    assert [group.members for group in target.groups] == [(0,), (1, 2)]
    fit = point_fit(target, 0)
    fitted = run_checks(SampledFit(target, fit, None, target.mapping(target.theta(fit.u))))
    assert fit.values["load"] == pytest.approx(0.505, abs=1e-4)
    assert fit.standard_errors["load"] == pytest.approx(0.01 / np.sqrt(8.0), rel=1e-3)
    (balance,) = [f for f in fitted.findings if f.code == "balance"]
    assert balance.facts == {"members": 2, "load": fit.values["load"]}
    assert "weighings" in [note.code for note in make_notes(fitted, {})]


class ReadsItsTable(FreeVibration):
    """A kind from another package whose likelihood reads the table; a stack would give every member the first table."""

    def summaries(self, theta: ValuesBySymbol, xp: ModuleType = jnp) -> Any:
        assert self.table.label
        return super().summaries(theta, xp)


def test_a_likelihood_cannot_read_the_table_of_one_member() -> None:
    first = decay(1)
    target = LogPosterior(first.rig, [ReadsItsTable(first.table, first.rig)])
    with pytest.raises(AttributeError, match="a likelihood must not read table"):
        density_of(target)(np.zeros((1, target.dimension)))


def test_a_leaf_that_is_no_number_is_named() -> None:
    class Worded(FreeVibration):
        word: str

        def __init__(self, table: Table, rig: Rig) -> None:
            super().__init__(table, rig)
            self.word = "not static"

    first = decay(1)
    with pytest.raises(TypeError, match=r"Worded\.word must be a number, found 'not static'"):
        LogPosterior(first.rig, [Worded(first.table, first.rig)])
