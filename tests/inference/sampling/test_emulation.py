"""Delayed acceptance: the exact density is sampled although the emulator is wrong; emulators of a progression."""

from pathlib import Path
from typing import cast

import numpy as np
import pytest

from capsule_id.api import read_rig
from capsule_id.experiments import make_experiments
from capsule_id.experiments.emulator import Emulator
from capsule_id.experiments.progression.experiment import Progression
from capsule_id.experiments.progression.twin import ROBOT, RobotDesign, synthesize_robot
from capsule_id.inference.result import Posterior
from capsule_id.inference.sampling import ensembles, moves
from capsule_id.inference.sampling.ensembles import DELAYED, sample
from tests.inference.sampling.test_sampling import LIMIT, scores
from tests.inference.stub import Gaussian

MEAN, SIGMA = np.array([1.0, -2.0, 0.5]), np.array([[1.0, 0.6, 0.0], [0.6, 2.0, 0.0], [0.0, 0.0, 0.5]])
BLOCKS = [np.array([0, 1]), np.array([2])]


class Emulable(Gaussian):
    """A known density whose emulator is half an sd off, and a tenth too narrow."""

    can_be_emulated = True

    def emulated(self, v: np.ndarray, motions: list[np.ndarray]) -> Gaussian:
        assert len(v) == len(motions[0])
        return Gaussian(self.mean + 0.5 * np.sqrt(np.diag(self.sigma)), 0.81 * self.sigma, self.blocks)


def draw() -> Posterior:
    return sample(Emulable(MEAN, SIGMA, BLOCKS), 2, 20_000)


def test_a_wrong_emulator_does_not_change_the_posterior(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ensembles, "DELAYED_STEPS", 3)
    found = draw()
    assert found.converged
    assert next(iter(found.moves)) == DELAYED
    assert np.max(np.abs(scores(found.draws, Gaussian(MEAN, SIGMA)))) < LIMIT

    # Negative control: proposals are accepted without regard to the density that they come from.
    accept = moves.accept
    monkeypatch.setattr(moves, "accept", lambda *args: accept(*args[:3], np.zeros_like(args[3]), args[4]))
    assert np.max(np.abs(scores(draw().draws, Gaussian(MEAN, SIGMA)))) > LIMIT


def test_an_emulator_follows_a_function_and_leaves_out_what_is_not_known() -> None:
    rng = np.random.default_rng(0)

    def motions(draws: list[dict[str, float]]) -> np.ndarray:
        k, p = (np.array([draw[name] for draw in draws]) for name in ("k", "p"))
        return np.stack([np.sin(np.log(k) + p), np.log(k) * p], axis=1)

    draws = [{"k": float(np.exp(a)), "p": float(b)} for a, b in rng.standard_normal((600, 2))]
    known = motions(draws)
    known[:50] = np.nan
    emulator = Emulator({"k": True, "p": False}, draws, known)
    new = [{"k": float(np.exp(a)), "p": float(b)} for a, b in 0.7 * rng.standard_normal((40, 2))]
    found = np.array([emulator(one) for one in new])
    errors = np.std(found - motions(new), axis=0) / np.std(motions(new), axis=0)
    assert np.all(errors < 0.04)


def test_a_progression_is_emulated_near_its_draws(tmp_path: Path) -> None:
    """Motions of new draws within a tenth of their sd; parameters of the scatters have no part in it."""
    design = RobotDesign(1e-3 * np.array([60.0, 100.0]), np.full(2, 0.3), sessions=2)
    synthesize_robot(tmp_path / "rig", 1, design)
    e = cast(Progression, make_experiments(read_rig(tmp_path / "rig"))[0])
    rng = np.random.default_rng(0)
    scatters = {"g": 9.81, "session_sd": 0.05, "trial_scatter": 0.04, "trial_sd": 1e-3, "discrepancy": 2e-4}
    varied = ("k1", "c", "mu", "P_on")
    draws = [
        {**ROBOT, **scatters, **{name: ROBOT[name] * np.exp(0.02 * rng.standard_normal()) for name in varied}}
        for _ in range(240)
    ]
    motions = e.motions_of_draws(draws)
    emulated = e.with_emulator(draws[:200], motions[:200])
    assert e.emulator is None
    assert emulated.emulator is not None
    assert not {"trial_scatter", "trial_sd", "discrepancy"} & set(emulated.emulator.symbols)
    found = np.array([np.concatenate(emulated.responses(draw)) for draw in draws[200:]])
    errors = np.std(found - motions[200:], axis=0) / np.std(motions, axis=0)
    assert np.all(errors[:2] < 0.1)
