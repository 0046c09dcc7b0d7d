"""Benches of a laboratory whose instruments and surfaces have errors, by SciPy alone: rig folders with their truth.

Imports nothing of the package: the motions, the friction law and the errors are written here a second time.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from scipy.integrate import quad, solve_ivp

Random = np.random.Generator
G = 9.81
#: Rates of the decays, Hz; noise, m; reading errors of tilts (rad), speeds (m/s), distances (m), forces (N), deflections (m).
RATE, NOISE = 2000.0, 4e-6
ANGLE_SD, SPEED_SD, DISTANCE_SD, FORCE_SD, DEFLECTION_SD = np.deg2rad(0.1), 5e-3, 3e-4, 0.02, 1e-5
#: Relative scatters of mu from tilt to tilt and from push to push.
SCATTER = 0.01


@dataclass
class Bench:
    """Truth (SI), what ``rig.toml`` states beside the masses, and the faults of this bench by name."""

    truth: dict[str, float]
    faults: dict[str, float] = field(default_factory=dict)
    head: str = ""
    settings: dict[str, str] = field(default_factory=dict)

    def __getitem__(self, name: str) -> float:
        return self.faults.get(name, 0.0)


def clean(rng: Random) -> Bench:
    """A bench whose truth differs from seed to seed, without a fault."""
    usual = {
        "k1": (1500.0, 0.2),
        "c": (3.0, 0.3),
        "mu": (0.45, 0.15),
        "v_s": (0.3, 0.2),
        "K": (2.0, 0.3),
        "k2": (2e4, 0.4),
    }
    truth = {name: median * float(np.exp(sd * rng.standard_normal())) for name, (median, sd) in usual.items()}
    return Bench({"m1": 0.11, "m2": 0.53, **truth})


def decay(bench: Bench, rng: Random, number: int) -> tuple[np.ndarray, np.ndarray]:
    """Times (n,), s, and x_rel (n,), m, of one release at rest, as the instruments show them."""
    m1, k1, c = (bench.truth[name] for name in ("m1", "k1", "c"))
    k1 *= 1.0 + bench["mixed_rigs"] * (number == 0) + bench["k_across"] * (number - 1)
    amplitude, rate = rng.uniform(1.5e-3, 3e-3), RATE
    end = np.log(amplitude / (4.0 * NOISE)) * 2.0 * m1 / c
    true = np.arange(int(min(end, 1.2) * rate)) / rate

    def motion(t: float, s: np.ndarray) -> list[float]:
        """Rod, and a base or second mass on a spring of its own."""
        x, v, y, w = s
        stiffness = k1 * (1.0 + bench["k_temp"] * t) * (1.0 + bench["cubic"] * (x / 2e-3) ** 2)
        damping = c * (1.0 + bench["c_temp"] * t) * (1.0 + 4.0 * bench["hand_mass"] * np.exp(-t / 0.05))
        force = stiffness * x + damping * v + bench["dry"] * k1 * 2e-3 * np.tanh(v / 1e-4)
        second = -((2.0 * np.pi * 47.0) ** 2) * y - 20.0 * w - bench["rocking"] * force / m1
        return [v, -force / m1, w, second]

    start = [amplitude, 0.0, 0.5 * amplitude * bench["cross_axis"], 0.0]
    solved = solve_ivp(motion, (0.0, true[-1]), start, method="DOP853", t_eval=true, rtol=1e-10, atol=1e-14)
    x = solved.y[0] + solved.y[2]
    x = x + bench["lvdt_cubic"] * x**3 / 3e-3**2 + bench["lvdt_even"] * x**2 / 3e-3
    if bench["sensor_lag"]:
        corner = np.exp(-1.0 / (rate * bench["sensor_lag"]))
        for i in range(1, len(x)):
            x[i] = corner * x[i - 1] + (1.0 - corner) * x[i]
    x = x + bench["hum"] * 2e-3 * np.sin(2.0 * np.pi * 50.0 * true + rng.uniform(0.0, 6.28))
    x = x + NOISE * (1.0 + 20.0 * bench["noise_mult"] * np.abs(x) / 2e-3) * rng.standard_normal(len(x))
    if bench["clip"]:
        x = np.minimum(x, (1.0 - bench["clip"]) * amplitude)
    if bench["quant"]:
        x = bench["quant"] * np.round(x / bench["quant"])
    time = true * (1.0 - bench["clock_all"] - bench["clock_one"] * (number == 0))
    kept = np.ones(len(x), dtype=bool)
    if bench["missing"]:
        kept = rng.random(len(x)) > bench["missing"]
    if bench["ts_ms"]:
        time = np.round(time / bench["ts_ms"]) * bench["ts_ms"]
    return np.sort(time[kept] + bench["jitter"] / rate * rng.standard_normal(kept.sum())), x[kept]


def friction(bench: Bench, speed: float, mu: float) -> float:
    """Friction coefficient at a speed, eq. (1), with the kinetic ratio of this bench."""
    ratio = 0.5 + bench["ratio"]
    return mu * (ratio + (1.0 - ratio) * np.exp(-speed / bench.truth["v_s"]))


def tilts(bench: Bench, rng: Random) -> list[str]:
    """Ten angles at which the capsule slips."""
    mu = bench.truth["mu"] * (1.0 + SCATTER * rng.standard_normal(10))
    mu = mu * (1.0 + bench["ageing"] * np.log10(rng.uniform(1.0, 100.0, 10)))
    angle = np.arctan(mu) + bench["tilt_late"] + ANGLE_SD * rng.standard_normal(10)
    return ["angle [deg]", *(f"{np.rad2deg(a):.4f}" for a in angle)]


def pushes(bench: Bench, rng: Random) -> list[str]:
    """Twelve slides to rest, by quadrature; +X is uphill on a table off level."""
    lines = ["speed [m/s],distance [mm]"]
    for i, start in enumerate(np.linspace(0.15, 1.0, 12)):
        mu = bench.truth["mu"] * (1.0 + SCATTER * rng.standard_normal() + bench["fric_pos"] * (i / 11.0 - 0.5))
        slope = bench["slope"]

        def inverse(v: float, mu: float = mu, slope: float = slope) -> float:
            return v / (G * (friction(bench, v, mu) * np.cos(slope) + np.sin(slope)))

        slid = quad(inverse, 0.0, start, epsabs=1e-12)[0] + bench["push_held"] * start**2
        if bench["push_stick"]:
            slid -= min(slid, quad(inverse, 0.0, bench["push_stick"], epsabs=1e-12)[0])
        read = start * (1.0 + bench["push_speed_gain"]) + SPEED_SD * rng.standard_normal()
        lines.append(f"{read:.6f},{1e3 * (slid + DISTANCE_SD * rng.standard_normal()):.5f}")
    return lines


def motor(bench: Bench, rng: Random) -> list[str]:
    """Forces of ten currents."""
    current = np.linspace(0.2, 2.0, 10)
    force = bench.truth["K"] * current * (1.0 - bench["motor_sat"] * (current / 2.0) ** 2) + bench["motor_offset"]
    force = force * (1.0 + bench["cell"]) + bench["motor_hyst"] * np.resize([1.0, -1.0], 10)
    force += FORCE_SD * rng.standard_normal(10)
    return ["force [N],current [A]", *(f"{f:.5f},{i:.5f}" for f, i in zip(force, current, strict=True))]


def spring(bench: Bench, rng: Random) -> list[str]:
    """Forces of twelve deflections."""
    true = np.linspace(0.0, 1.0e-3, 12)
    force = bench.truth["k2"] * true * (1.0 + bench["spring_nl"] * (true / 1e-3)) + bench["spring_preload"]
    read = true + force * bench["spring_compliance"] / bench.truth["k2"] + DEFLECTION_SD * rng.standard_normal(12)
    force = force * (1.0 + bench["cell"]) + bench["spring_hyst"] * np.resize([1.0, -1.0], 12)
    force += FORCE_SD * rng.standard_normal(12)
    return ["deflection [mm],force [N]", *(f"{1e3 * x:.6f},{f:.5f}" for x, f in zip(read, force, strict=True))]


#: Kind of a table -> its file.
TABLES: Mapping[str, tuple[str, Callable[[Bench, Random], list[str]]]] = {
    "static_friction": ("tilt.csv", tilts),
    "dynamic_friction": ("push.csv", pushes),
    "motor_current": ("motor.csv", motor),
    "support_spring": ("spring.csv", spring),
}
ERRORS = {
    "static_friction": {"angle": (np.rad2deg(ANGLE_SD), "deg")},
    "dynamic_friction": {"speed": (SPEED_SD, "m/s"), "distance": (1e3 * DISTANCE_SD, "mm")},
    "motor_current": {"force": (FORCE_SD, "N"), "current": (1e-6, "A")},
    "support_spring": {"force": (FORCE_SD, "N"), "deflection": (1e3 * DEFLECTION_SD, "mm")},
}


def write(bench: Bench, rng: Random, folder: Path, kinds: tuple[str, ...] = ("free_vibration", *TABLES)) -> Path:
    """Write the folder of a bench with tables of ``kinds`` (three decays)."""
    folder.mkdir(parents=True)
    text = ["[rig]", 'name = "a"']
    for name in ("m1", "m2"):
        sd = float(bench.settings.get(name, "1e-3")) * bench.truth[name]
        value = bench.truth[name] * (1.0 + bench[name] + 1e-3 * rng.standard_normal())
        text.append(f'{name} = {{ value = {value:.8f}, sd = {sd:.8f}, unit = "kg" }}')
    text += bench.head.splitlines()
    for kind in kinds:
        numbers = range(3) if kind == "free_vibration" else [0]
        for number in numbers:
            if kind == "free_vibration":
                name, (time, x) = f"free_{number}.csv", decay(bench, rng, number)
                lines = ["time [s],x_rel [mm]", *(f"{t:.7f},{1e3 * r:.6f}" for t, r in zip(time, x, strict=True))]
                more = []
            else:
                name, make = TABLES[kind]
                lines = make(bench, rng)
                more = [f'{c}_sd = {{ value = {v}, unit = "{u}" }}' for c, (v, u) in ERRORS[kind].items()]
                more += ['spring = "L60"'] * (kind == "support_spring")
            (folder / name).write_text("\n".join(lines) + "\n", encoding="utf-8")
            more += bench.settings.get(f"{kind}_{number}", bench.settings.get(kind, "")).splitlines()
            text += ["[[experiment]]", f'kind = "{kind}"', f'file = "{name}"', *more]
    (folder / "rig.toml").write_text("\n".join(text) + "\n", encoding="utf-8")
    return folder
