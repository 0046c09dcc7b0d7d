"""A sensor that loses counts where the rod turns is named; drift, hysteresis and dry friction are not taken for that.

Twin of a measured pendulum, whose encoder of 2.6 mrad a count loses or gains counts at turning points.
"""

from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from capsule_id.experiments.base import refit
from capsule_id.experiments.free_vibration.experiment import FreeVibration, check_zero
from capsule_id.experiments.kind import make_experiments
from capsule_id.views import Finding
from tests.experiments import bench
from tests.scipy_decay import scipy_decay

RELEASE, NOISE, COUNT = 2e-3, 2e-6, 2e-5
VISCOUS = {"k1": bench.K1, "m1": bench.M1, "c": 0.4}
DAMPED = {**VISCOUS, "c": 0.8}
PERIOD = 2.0 * np.pi * float(np.sqrt(bench.M1 / bench.K1))
TIME = np.linspace(0.0, 12.0 * PERIOD, 1200)
TURNING_TIME = -0.25 * PERIOD
#: Number of the half swing of every sample, and a random walk of the zero, m, one step of a count per half swing.
HALF_SWING = np.round(2.0 * TIME / PERIOD).astype(int)
ZERO = COUNT * np.cumsum(np.random.default_rng(4).choice([-1.0, 0.0, 1.0], HALF_SWING[-1] + 1))


def finding(zero: np.ndarray | float, forces: dict[str, float], step: float = 0.0, **settings: object) -> list[Finding]:
    """What the check says of a record with this zero, m, read in steps, after a fit of viscous damping.

    Where the damping is stated, the values are the true ones.
    """
    noise = NOISE * np.random.default_rng(2).standard_normal(len(TIME))
    x = scipy_decay(TIME, forces, RELEASE, TURNING_TIME)[0] + noise
    x = (step * np.round(x / step) if step else x) + zero
    columns = [bench.column("time", TIME), bench.column("x_rel", x)]
    table = bench.table("free_vibration", columns, "decay", **settings)
    record = cast(FreeVibration, make_experiments(bench.rig(table))[0])
    own = {"noise_sd": NOISE, "amplitude": RELEASE, "turning_time": TURNING_TIME}
    values = {**forces, **{f"{name}[{record.label}]": value for name, value in own.items()}}
    if "damping" not in settings:
        start = {**VISCOUS, record.scatters[0]: NOISE}
        values |= {name: value for name, (value, _) in refit(record, start, []).items()}
    return check_zero([record], SimpleNamespace(values=values))  # type: ignore[arg-type]  # pyright: ignore


@pytest.mark.full
@pytest.mark.parametrize("thin", [1, 3])
def test_jumps_at_turning_points_are_named(thin: int) -> None:
    (found,) = finding(ZERO[HALF_SWING], VISCOUS, thin=thin)
    assert (found.code, found.level, found.experiment) == ("decays.zero", "fail", "decay")
    assert found.facts["jump"] == pytest.approx(np.sqrt(np.mean(np.diff(ZERO) ** 2)), rel=0.15)


def test_one_count_lost_in_two_swings_is_named() -> None:
    rare = COUNT * (np.arange(len(ZERO)) // 4)
    assert finding(rare[HALF_SWING], VISCOUS)[0].level == "fail"


@pytest.mark.full
def test_jumps_a_little_after_the_turning_point_are_named() -> None:
    later = np.round(2.0 * TIME / PERIOD - 0.09).astype(int)
    assert finding(ZERO[later], VISCOUS)[0].level == "fail"


@pytest.mark.full
def test_single_counts_of_an_encoder_are_named() -> None:
    """The jumps are as large as the step of the readings."""
    found = finding(ZERO[HALF_SWING], VISCOUS, step=COUNT)
    assert found[0].level == "fail"
    assert finding(0.0, VISCOUS, step=COUNT)[0].level == "ok"


@pytest.mark.full
def test_a_rod_that_has_stopped_turns_no_more() -> None:
    """Dry friction stops it after five periods: its rate is that of rounding errors then."""
    forces = {**VISCOUS, "F_dry": 0.04 * bench.K1 * RELEASE}
    (found,) = finding(ZERO[HALF_SWING], forces, damping=("viscous", "dry"))
    assert (found.level, 8 <= found.facts["half_swings"] <= 13) == ("fail", True)


@pytest.mark.full
@pytest.mark.parametrize(
    "what", ["clean", "slow drift", "dry friction", "hysteresis", "falling hysteresis", "jumps between turning points"]
)
def test_other_errors_are_not_taken_for_jumps(what: str) -> None:
    middles = 0.5 * PERIOD * np.arange(len(ZERO))
    zero, forces = {
        "clean": (0.0, VISCOUS),
        "slow drift": (np.interp(TIME, middles, ZERO), VISCOUS),
        "dry friction": (0.0, {**VISCOUS, "F_dry": 0.02 * bench.K1 * RELEASE}),
        "hysteresis": (COUNT * (-1.0) ** HALF_SWING, VISCOUS),
        # 2 % of the amplitude
        "falling hysteresis": (
            2.0 * COUNT * np.exp(-0.5 * DAMPED["c"] / bench.M1 * TIME) * (-1.0) ** HALF_SWING,
            DAMPED,
        ),
        "jumps between turning points": (ZERO[np.minimum((2.0 * TIME / PERIOD).astype(int), len(ZERO) - 1)], VISCOUS),
    }[what]
    (found,) = finding(zero, forces)
    assert (found.code, found.level) == ("decays.zero", "ok")


def test_short_records_are_not_judged() -> None:
    time = TIME[:300]
    x = scipy_decay(time, VISCOUS, RELEASE, TURNING_TIME)[0]
    table = bench.table("free_vibration", [bench.column("time", time), bench.column("x_rel", x)], "decay")
    record = cast(FreeVibration, make_experiments(bench.rig(table))[0])
    values = {**VISCOUS, f"noise_sd[{record.label}]": NOISE}
    assert check_zero([record], SimpleNamespace(values=values)) == []  # type: ignore[arg-type]  # pyright: ignore
