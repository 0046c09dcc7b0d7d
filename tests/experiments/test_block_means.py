"""Block means of long records: their covariance and prediction, and the same posterior as the whole record's."""

import re
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest

import capsule_id
from capsule_id.errors import InputError
from capsule_id.experiments.base import refit
from capsule_id.experiments.free_vibration.decrement import Decrement
from capsule_id.experiments.free_vibration.experiment import FreeVibration
from capsule_id.experiments.free_vibration.lint import lint_decay
from capsule_id.experiments.free_vibration.models import half_cycles, interpolate
from capsule_id.experiments.free_vibration.readings import (
    Blocks,
    DecayModel,
    block_mean,
    block_means,
    default_block_size,
    is_even,
)
from capsule_id.experiments.free_vibration.record import ReadingTimes, averaged_process, whiten_by_shape
from capsule_id.experiments.free_vibration.screening import Screening
from capsule_id.experiments.kind import make_experiments
from capsule_id.records import release
from tests.capsule_cases import jit_quickly
from tests.experiments import bench

#: s; 4000 samples of 0.5 s, about 9 periods of 440 samples each.
TIME = np.arange(4000) / 8000.0
RELEASE, NOISE, C, SIZE = 2e-3, 2e-5, 1.0, 13
#: s, correlation time of the AR(1) noise: 20 samples.
NOISE_TIME = 20.0 / 8000.0
RNG = np.random.default_rng(6)
#: Uneven sampling with bursts and a gap.
UNEVEN = np.cumsum(RNG.exponential(1.0, 3000) ** 2 + 0.01)
UNEVEN = UNEVEN / UNEVEN[-1] * 0.4 + np.where(np.arange(3000) > 1700, 0.1, 0.0)


def averaging(time: np.ndarray, blocks: Blocks) -> np.ndarray:
    """(N, n) matrix of the block means."""
    inside = (time[None] >= blocks.first[:, None]) & (time[None] <= blocks.last[:, None])
    return inside / np.sum(inside, axis=1, keepdims=True)


@pytest.mark.parametrize("time", [TIME, UNEVEN], ids=["even", "uneven"])
def test_nodes_and_weights_average_cubics_exactly(time: np.ndarray) -> None:
    for power in range(5):
        values = (time / 0.5 - 0.3) ** power
        blocks = block_means(time, values, 200)
        found = block_mean((blocks.nodes.ravel() / 0.5 - 0.3) ** power, blocks.weights, np)
        error = np.max(np.abs(found - blocks.values))
        assert (error < 1e-13) if power < 4 else (error > 1e-13)  # the fourth power is the negative control
    np.testing.assert_allclose(averaging(time, blocks) @ time[: averaging(time, blocks).shape[1]], blocks.time)


def test_every_reading_of_an_uneven_record_counts_once() -> None:
    blocks = block_means(UNEVEN, UNEVEN, SIZE)
    assert blocks.count.sum() == len(UNEVEN)
    assert np.max(blocks.last - blocks.first) <= SIZE * np.median(np.diff(UNEVEN))


def test_one_sample_a_block_is_the_record() -> None:
    blocks = block_means(TIME, TIME**2, 1)
    np.testing.assert_array_equal(blocks.values, TIME**2)
    np.testing.assert_array_equal(blocks.nodes[:, 0], TIME)


@pytest.mark.parametrize("correlation_time", [1e-5, 1e-3, 1.0])
def test_covariance_of_the_means_is_that_of_the_averaged_process(correlation_time: float) -> None:
    time = TIME[:400]
    blocks = block_means(time, time, SIZE)
    a = averaging(time, blocks)
    expected = a @ np.exp(-np.abs(time[:, None] - time[None]) / correlation_time) @ a.T
    found = np.asarray(averaged_process(ReadingTimes.of(blocks), correlation_time).to_dense())
    np.testing.assert_allclose(found, expected, atol=1e-9)
    # Negative control: sampled at the middles, the process has another covariance.
    sampled = np.exp(-np.abs(blocks.time[:, None] - blocks.time[None]) / correlation_time)
    assert np.max(np.abs(sampled - expected)) > 1e-6


def test_whitened_means_have_the_density_of_the_averaged_noise() -> None:
    """White noise beside the correlated one, against a dense Cholesky factor."""
    time, ratio, tau = TIME[:400], 0.7, 2e-3
    values = np.random.default_rng(1).standard_normal(400)
    blocks = block_means(time, values, SIZE)
    a = averaging(time, blocks)
    covariance = np.exp(-np.abs(time[:, None] - time[None]) / tau) + ratio**2 * np.eye(400)
    factor = np.linalg.cholesky(a @ covariance @ a.T)
    expected = np.linalg.solve(factor, blocks.values) * np.exp(np.mean(np.log(np.diag(factor))))
    shape = {"noise_time": tau, "white_ratio": ratio}
    found = whiten_by_shape(ReadingTimes.of(blocks), blocks.values[:, None], "arma", shape)
    np.testing.assert_allclose(np.asarray(found)[:, 0], expected, rtol=1e-9)


@pytest.mark.full
def test_predicted_means_of_a_rod_with_dry_friction() -> None:
    """Within the bounds of the module, which depend on the block's duration W; the rod turns inside some blocks."""
    forces = {"k1": bench.K1, "c": C, "m1": bench.M1, "F_dry": 0.1}
    x_rel = jit_quickly(lambda time: interpolate(half_cycles(forces, RELEASE, -1e-3, 30), time).x_rel)
    exact = np.asarray(x_rel(TIME))
    for size in (13, 52):
        blocks = block_means(TIME, exact, size)
        found = block_mean(np.asarray(x_rel(blocks.nodes.ravel())), blocks.weights, np)
        angle = np.sqrt(bench.K1 / bench.M1) * size / 8000.0
        bound = RELEASE * angle**4 / 4320.0 + 0.0026 * angle**2 * 2.0 * 0.1 / bench.K1
        error = np.max(np.abs(found - blocks.values))
        # Negative control: the values at the middles miss the bound by far.
        assert error < bound < 0.1 * np.max(np.abs(np.asarray(x_rel(blocks.time)) - blocks.values))


def noise(kind: str, n: int) -> np.ndarray:
    """(n,) noise of unit sd: white, or AR(1) with a correlation time of 20 samples."""
    e = np.random.default_rng(11).standard_normal(n)
    if kind == "ar1":
        rho = np.exp(-1.0 / 20.0)
        for i in range(1, n):
            e[i] = rho * e[i - 1] + np.sqrt(1.0 - rho**2) * e[i]
    return e


def fitted(time: np.ndarray, values: np.ndarray, forces: dict[str, float], **settings: Any) -> np.ndarray:
    """(2, 2) estimates of k1 and c, and their standard errors, at the true noise."""
    columns = [bench.column("time", time), bench.column("x_rel", values)]
    table = bench.table("free_vibration", columns, "decay", **settings)
    own = FreeVibration(table, bench.rig(table))
    nuisances = {"amplitude": RELEASE, "turning_time": -1e-3, "noise_sd": NOISE, "noise_time": NOISE_TIME}
    found = refit(own, forces | nuisances, [])
    return np.array([found[name] for name in ("k1", "c")]).T


@pytest.mark.parametrize(
    ("time", "kind", "words"),
    [
        (TIME, "white", {}),
        (UNEVEN, "white", {}),
        (TIME, "ar1", {"noise": "ar1"}),
    ],
    ids=["white", "uneven", "ar1"],
)
def test_the_fit_of_the_means_is_that_of_the_record(time: np.ndarray, kind: str, words: dict[str, Any]) -> None:
    forces = {"k1": bench.K1, "c": C, "m1": bench.M1}
    x = bench.released(time + 1e-3, RELEASE, c=C) + NOISE * noise(kind, len(time))
    whole, whole_sd = fitted(time, x, forces, thin=1, **words)
    means, means_sd = fitted(time, x, forces, thin=SIZE, **words)
    # The sds contain the rms of the residuals, which 307 means determine to 4 %.
    np.testing.assert_allclose(means_sd, whole_sd, rtol=0.12)
    # The means of 32 per period lose 0.3 % of the information, so both estimates differ by 0.06 sd or so.
    assert np.max(np.abs(means - whole) / whole_sd) < 0.3
    assert np.max(np.abs(means - [bench.K1, C]) / means_sd) < 4.0
    if words:
        # Negative control: as white noise the same means seem far more precise.
        assert np.all(fitted(time, x, forces, thin=SIZE)[1] < 0.8 * whole_sd)


def test_long_records_are_thinned_and_the_finding_says_so() -> None:
    columns = [
        bench.column("time", TIME),
        bench.column("x_rel", bench.released(TIME, RELEASE, c=C) + NOISE * noise("white", 4000)),
    ]
    table = bench.table("free_vibration", columns, "decay")
    record = FreeVibration(table, bench.rig(table))
    (finding,) = [f for f in lint_decay(table, bench.rig(table)) if f.code == "decays.thinned"]
    assert (finding.level, finding.facts["thin"], finding.facts["means"]) == ("ok", record.model.thin, record.n)
    assert 30.0 < record.n / (0.5 * np.sqrt(bench.K1 / bench.M1) / (2.0 * np.pi)) < 36.0
    whole = bench.table("free_vibration", columns, "decay", thin=1)
    assert FreeVibration(whole, bench.rig(whole)).model == DecayModel()
    assert [f for f in lint_decay(whole, bench.rig(whole)) if f.code == "decays.thinned"] == []
    assert default_block_size(TIME[:2000], columns[1].values[:2000]) == 1


@pytest.mark.full
def test_a_very_long_record_is_named_and_the_remedy_works() -> None:
    """400 periods of a model that takes dry friction are fitted by the first 250; a stated stop confirms another part."""
    rate, n = np.sqrt(bench.K1 / bench.M1), 24_000
    time = np.arange(n) * (2.0 * np.pi / rate / 60.0)
    x = RELEASE * np.exp(-0.001 * rate * time) * np.cos(rate * time) + NOISE * noise("white", n)
    columns = [bench.column("time", time), bench.column("x_rel", x)]
    free = {"damping": ("viscous", "dry"), "stiffness": "linear", "drift": "none", "noise": "white"}
    table = bench.table("free_vibration", columns, "decay", **free)
    (found,) = [f for f in lint_decay(table, bench.rig(table)) if f.code == "decays.long"]
    assert found.facts["stop"] == pytest.approx(250 * 2.0 * np.pi / rate, rel=0.02)  # whole samples in a period
    record = cast(FreeVibration, make_experiments(bench.rig(table))[0])
    assert record.time[-1] == pytest.approx(found.facts["stop"], abs=0.02)
    stated = bench.table("free_vibration", columns, "decay", stop=found.facts["stop"], **free)
    assert [f for f in lint_decay(stated, bench.rig(stated)) if f.code == "decays.long"] == []
    light = bench.table("free_vibration", columns, "decay", **{**free, "damping": ("viscous",)})
    assert [f for f in lint_decay(light, bench.rig(light)) if f.code == "decays.long"] == []


def test_the_estimate_of_a_long_record_is_that_of_its_means(monkeypatch: pytest.MonkeyPatch) -> None:
    values = bench.released(TIME, RELEASE, c=C) + 0.1 * NOISE * noise("white", 4000)
    table = bench.table("free_vibration", [bench.column("time", TIME), bench.column("x_rel", values)], "decay")
    record = FreeVibration(table, bench.rig(table))
    whole = cast(Decrement, record.paper_decrement())
    monkeypatch.setattr(release, "PIECE", 1000)
    means = cast(Decrement, record.paper_decrement())
    assert len(record.condensed[0]) == 1000
    # The second fit takes its readings from every sample, as the record does.
    assert len(record.whole[0]) == 4000
    assert len(Screening(record).values) == record.n
    assert is_even(record.condensed[0])
    assert means.k1 != whole.k1
    assert means.k1 == pytest.approx(whole.k1, rel=2e-3)
    assert means.c == pytest.approx(whole.c, rel=1e-2)
    # Negative control: with four means a period the estimate is off.
    every = "capsule_id.experiments.free_vibration.record.shortened"
    monkeypatch.setattr(every, lambda time, x: (time[::110], x[::110]))
    coarse = record.paper_decrement()
    assert coarse is None or abs(coarse.k1 / whole.k1 - 1.0) > 2e-3


def test_blocks_that_lose_the_oscillation_are_refused(tmp_path: Path) -> None:
    """The remedy is applied: the largest block that it names is accepted, one more is not."""
    time = np.arange(600) * 5e-4
    values = 2.5 * np.exp(-12.0 * time) * np.cos(113.0 * time)
    rows = "".join(f"{t:.4f},{x:.4f}\n" for t, x in zip(time, values, strict=True))
    (tmp_path / "decay.csv").write_text(f"time [s],x_rel [mm]\n{rows}", encoding="utf-8")

    def read(thin: int) -> None:
        entry = '[[experiment]]\nkind = "free_vibration"\nfile = "decay.csv"\n'
        text = f'[rig]\nname = "thin"\nm1 = {{ value = 110, sd = 1, unit = "g" }}\n{entry}thin = {thin}\n'
        (tmp_path / "rig.toml").write_text(text, encoding="utf-8")
        capsule_id.read_rig(tmp_path)

    for thin in (100_000, 300):
        with pytest.raises(InputError, match="means of the record and 4 means in a period") as caught:
            read(thin)
    (most,) = (int(number) for number in re.findall(r"write thin = (\d+) or less", str(caught.value)))
    assert abs(most - 2.0 * np.pi / 113.0 / 5e-4 / 4.0) < 2.0
    read(most)
    with pytest.raises(InputError, match="4 means in a period"):
        read(most + 1)
