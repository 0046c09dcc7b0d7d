"""Random free decays of any damping, length and noise, damaged as records of benches are; SciPy makes the motion."""

from pathlib import Path
from typing import cast

import numpy as np
from scipy.integrate import OdeSolution, solve_ivp

#: Ways to damage a record, and their share.
DAMAGES = (
    "none", "hold", "rest", "blow", "spikes", "steps", "int", "clipped", "rounded stamps", "jitter", "lost block", "drift",
    "hum", "second mode", "units", "dry", "cubic", "beyond the barrier", "coloured", "stops early",
)  # fmt: skip


def motion(rng: np.random.Generator, time: np.ndarray, ratio: float, omega: float, damage: str) -> np.ndarray:
    """(n,) x_rel of unit release at ``time`` (n,), s, from time 0; with a further force where the damage is one."""
    dry = rng.uniform(0.01, 0.6) if damage == "dry" else 0.0
    cubic = {"cubic": rng.uniform(-0.5, 2.0), "beyond the barrier": -0.99}.get(damage, 0.0)

    def rate(t: float, s: np.ndarray) -> list[float]:
        del t
        friction = dry * np.tanh(s[1] / (1e-3 * omega))
        return [s[1], -2.0 * ratio * omega * s[1] - omega**2 * (s[0] + cubic * s[0] ** 3 + friction)]

    velocity = rng.choice([0.0, rng.uniform(-1.0, 1.0)]) * omega
    if cubic < 0.0:  # it would leave the barrier behind
        velocity = 0.0
    solution = solve_ivp(
        rate, (0.0, time[-1] + 1e-9), [1.0, velocity], "LSODA", rtol=1e-7, atol=1e-10, dense_output=True
    )
    return np.asarray(cast(OdeSolution, solution.sol)(time)[0])


def record(seed: int) -> tuple[np.ndarray, np.ndarray, str]:
    """Time, s, and x_rel, m, of the record ``seed``, with the name of its damage.

    3 to 3000 samples, damping ratio 0 to 2, 1 to 300 periods, noise of 0 to 50 %, mass of the rod 0.1 kg.
    """
    rng = np.random.default_rng(seed)
    damage = DAMAGES[seed % len(DAMAGES)]
    n = int(10 ** rng.uniform(np.log10(3), np.log10(3000)))
    ratio = rng.choice([0.0, 10 ** rng.uniform(-3.0, 0.3)])
    omega = 2.0 * np.pi * 10 ** rng.uniform(-1.0, 2.0)
    periods = min(10 ** rng.uniform(0.0, 2.48), 0.5 * n, 300.0)
    time = np.linspace(0.0, periods * 2.0 * np.pi / omega, n)
    if damage == "jitter":
        time = np.sort(time + 0.3 * time[1] * rng.uniform(-1.0, 1.0, n))
        time -= time[0]
    x = motion(rng, time, ratio, omega, damage)
    size = 10 ** rng.uniform(-4.0, -0.5)
    noise = rng.choice([0.0, 10 ** rng.uniform(-4.0, np.log10(0.5))])
    error = rng.standard_normal(n)
    if damage == "coloured":
        for i in range(1, n):
            error[i] = 0.9 * error[i - 1] + 0.44 * error[i]
    before = int(rng.integers(2, max(3, n // 3)))
    step = time[1] - time[0]
    if damage in ("hold", "rest", "blow"):
        first = {"hold": x[0], "rest": 0.0, "blow": 0.0}[damage]
        time, x = (
            np.concatenate(parts) for parts in ((step * np.arange(before), time + step * before), ([first] * before, x))
        )
        error = np.concatenate([rng.standard_normal(before), error])
    x = size * (x + noise * error)
    relative = np.linspace(0.0, 1.0, len(x))
    if damage == "drift":
        x += size * rng.uniform(-1.0, 1.0) * relative
    if damage in ("hum", "second mode"):
        x += 0.1 * size * np.sin(rng.uniform(1.5, 8.0) * omega * time) * np.exp(-relative * rng.choice([0.0, 3.0]))
    if damage == "spikes":
        x[rng.integers(0, len(x), 4)] += size * rng.choice([-3.0, 3.0], 4)
    if damage in ("steps", "int"):
        quantum = size * 10 ** rng.uniform(-2.0, -0.5)
        x = quantum * (np.round(x / quantum) if damage == "steps" else np.trunc(x / quantum))
    if damage == "clipped":
        x = np.clip(x, -0.6 * size, 0.6 * size)
    if damage == "rounded stamps":
        time = np.array([float(f"{t:.{int(rng.integers(3, 7))}g}") for t in time])
    if damage == "units":
        x = x * rng.choice([1e-3, 1e3])
    keep = np.ones(len(x), dtype=bool)
    if damage == "lost block":
        keep[before : before + max(1, n // 5)] = False
    if damage == "stops early":
        keep = time <= max(0.7 * 2.0 * np.pi / omega, time[min(2, len(time) - 1)])
    return time[keep], x[keep], damage


def write(folder: Path, seed: int) -> Path:
    """Write the record ``seed`` as a rig folder; half of the rigs have an exact mass."""
    time, x, damage = record(seed)
    folder.mkdir(parents=True, exist_ok=True)
    sd = "" if seed % 2 else ", sd = 0.0001"
    (folder / "rig.toml").write_text(
        f'# {damage}\n[rig]\nname = "random"\nm1 = {{ value = 0.1{sd}, unit = "kg" }}\n'
        '[[experiment]]\nkind = "free_vibration"\nfile = "d.csv"\n'
    )
    rows = (f"{t:.9g},{1e3 * value:.9g}\n" for t, value in zip(time, x, strict=True))
    (folder / "d.csv").write_text("time [s],x_rel [mm]\n" + "".join(rows))
    return folder
