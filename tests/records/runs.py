"""Recorded runs with known labels: the reference cases and motions of longer period, with synthetic noise."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache, cached_property

import numpy as np

from capsule_id.experiments.forced_run.declaration import RunSettings
from capsule_id.experiments.forced_run.twin import GAP_SD, NOISE_SD, RunSetup, SyntheticRun, make_runs
from capsule_id.physics.model import CapsuleParameters, Excitation
from capsule_id.physics.simulation import simulate
from capsule_id.records.motion import MeasuredMotion, measured_motion
from capsule_id.rig.model import Column, Quantity, Table
from tests.capsule_cases import read_cases

#: (k2, mu, G, P_d, Omega) with Table 1's masses and k1, c = 1 N s/m, v_s = 0.3 m/s, and the model's label (``response``;
#: a slow test compares).
LONGER = {
    (56410.0, 0.4, 1.107e-3, 5.718, 79.77): "P-2-B-2",
    (56410.0, 0.376, 0.387e-3, 5.417, 136.35): "P-2-F-1",
    (56410.0, 0.527, 0.405e-3, 4.584, 86.05): "P-2-F-2",
    (56410.0, 0.656, 1.395e-3, 2.232, 68.09): "P-2-F-2",
    (18960.0, 0.532, 0.52e-3, 5.878, 127.89): "P-2-F-1",
    (56410.0, 0.185, 0.505e-3, 2.146, 124.11): "P-2-F-1",
    (18960.0, 0.646, 0.453e-3, 4.356, 116.78): "P-2-F-3/2",
    (18960.0, 0.358, 0.413e-3, 5.442, 77.7): "P-4-B-5/2",
    (56410.0, 0.697, 1.023e-3, 1.12, 65.79): "aperiodic",
    (56410.0, 0.646, 1.145e-3, 5.69, 118.14): "aperiodic",
    (18960.0, 0.262, 0.808e-3, 4.888, 113.74): "aperiodic",
}

#: (m1, m2, k1, k2, c, mu, G, P_d, Omega) with v_s = 0.3 m/s and the period of the model (``response``), 0: aperiodic.
#: Drawn at random, and not looked at while the settings of ``find_period`` were chosen. (The last one had P_d = 4.94 N:
#: its chaos is a transient, whose end, with period 2, moves by hundreds of cycles with the last digits.)
FRESH = {
    (0.1885, 0.3013, 2809.0, 10700.0, 1.948, 0.4032, 1.465e-3, 1.411, 188.2): 1,
    (0.09933, 0.4282, 1184.0, 88960.0, 2.098, 0.6784, 0.95e-3, 1.766, 98.38): 1,
    (0.1075, 0.664, 1572.0, 98180.0, 1.582, 0.6421, 0.832e-3, 2.88, 51.65): 2,
    (0.1629, 0.8475, 815.0, 77790.0, 1.209, 0.4532, 0.3322e-3, 4.162, 85.47): 2,
    (0.1364, 0.4148, 964.2, 89770.0, 0.483, 0.3928, 1.945e-3, 1.496, 51.58): 3,
    (0.1293, 0.6084, 1384.0, 98780.0, 0.4685, 0.2333, 0.5152e-3, 3.603, 59.98): 3,
    (0.1735, 0.7072, 1040.0, 41160.0, 1.474, 0.5633, 0.7197e-3, 6.439, 84.29): 4,
    (0.1364, 0.447, 2050.0, 27230.0, 1.681, 0.6066, 1.846e-3, 7.129, 46.78): 4,
    (0.1275, 0.7567, 1364.0, 38610.0, 0.9807, 0.4618, 0.8471e-3, 4.086, 36.37): 6,
    (0.1066, 0.3045, 1539.0, 16380.0, 0.8254, 0.2647, 0.5522e-3, 1.518, 59.74): 6,
    (0.1733, 0.495, 2567.0, 51210.0, 0.4841, 0.6629, 1.557e-3, 1.228, 106.1): 0,
    (0.1432, 0.6281, 1016.0, 16570.0, 0.5399, 0.5469, 0.2677e-3, 7.05, 36.71): 0,
    (0.1857, 0.7636, 1316.0, 42940.0, 0.8235, 0.553, 0.3951e-3, 5.2, 30.8): 0,
}


@dataclass(frozen=True)
class Known:
    """A run as measured, its model's label and mean velocity (m/s, NaN where not known)."""

    name: str
    label: str
    mean_velocity: float
    run: SyntheticRun

    @cached_property
    def nominal(self) -> MeasuredMotion:
        """The measured motion of the whole record."""
        return self.motion()

    def motion(self, factor: float = 1.0, **changes: object) -> MeasuredMotion:
        """The measured motion with ``factor`` times the rig's noise, a shorter record, or other settings."""
        return measured_motion(table_of(noisier(self.run, factor, len(self.name)), **changes))  # type: ignore[arg-type]


def noisier(run: SyntheticRun, factor: float, seed: int) -> dict[str, np.ndarray]:
    """The channels with more noise, ``factor`` times its sd in all."""
    rng = np.random.default_rng(seed)
    more = np.sqrt(factor**2 - 1.0)
    channels = {
        name: values + more * NOISE_SD[name] * rng.standard_normal(len(values)) for name, values in run.channels.items()
    }
    settings = {"spring": "s", "gap": Quantity(run.stated_gap, GAP_SD), "Omega": run.truth.Omega}
    return {"time": run.time, **channels, "settings": settings}  # type: ignore[dict-item]


def scattered(run: SyntheticRun, seed: int, scatter: float = 0.01, drift: float = 0.02) -> dict[str, np.ndarray]:
    """The channels with a motion whose size changes from cycle to cycle by ``scatter``, and slowly by ``drift`` in all."""
    cycle = run.time * run.truth.Omega / (2.0 * np.pi)
    z = np.random.default_rng(seed).standard_normal(int(cycle[-1]) + 2)
    size = 1.0 + scatter * np.interp(cycle, np.arange(len(z)) - 0.5, z) + drift * (run.time / run.time[-1] - 0.5)
    record = noisier(run, 1.0, seed)
    for name in ("x_rel", "acceleration_rod"):
        mean = np.mean(record[name])
        record[name] = mean + size * (record[name] - mean)
    place = record["x_capsule"]
    record["x_capsule"] = place[0] + np.concatenate([[0.0], np.cumsum(0.5 * (size[1:] + size[:-1]) * np.diff(place))])
    return record


def table_of(
    record: Mapping[str, np.ndarray], samples: int | None = None, only: tuple[str, ...] = (), **settings: object
) -> Table:
    """A ``forced_run``: the first ``samples`` rows, ``only`` these channels, some settings changed."""
    channels = {k: v for k, v in record.items() if k != "settings" and (not only or k in (*only, "time"))}
    columns = {name: Column(name, "", 1.0, values[:samples]) for name, values in channels.items()}
    stated = RunSettings(**(dict(record["settings"]) | settings))  # type: ignore[call-overload]
    return Table("forced_run", "run", "run.csv", columns, stated, np.arange(len(columns["time"].values)) + 2, False)


@cache
def settled() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Time and x_rel (motions, samples) of ``FRESH`` at rates and lengths of their own, and excitation periods; exact."""
    rng, n = np.random.default_rng(0), len(FRESH)
    m1, m2, k1, k2, c, mu, G, P_d, Omega = np.array(list(FRESH)).T
    T = 2.0 * np.pi / Omega
    time = np.arange(1500) * (T / rng.uniform(25.0, 75.0, n))[:, None]
    start = (300.0 + rng.uniform(size=n))[:, None] * T[:, None]
    p = CapsuleParameters(m1=m1, m2=m2, k1=k1, k2=k2, c=c, mu=mu, v_s=np.full(n, 0.3), G=G)
    t = simulate(p, Excitation(P_d, Omega), np.concatenate([np.zeros((n, 1)), start + time], axis=1))
    return time, np.asarray(t.X1 - t.X2)[:, 1:], T


def fresh(seed: int) -> list[tuple[np.ndarray, np.ndarray, float, int]]:
    """Time, x_rel, excitation period and true period of ``FRESH``.

    Each record has a scatter of 0.3 to 1.5 %, a drift of up to 3 %, and 10 um of noise.
    """
    rng, found = np.random.default_rng(seed), []
    for time, x, T, period in zip(*settled(), FRESH.values(), strict=True):
        z = rng.standard_normal(63)
        size = 1.0 + rng.uniform(0.003, 0.015) * np.interp(time / T, np.arange(63) - 0.5, z)
        size += rng.uniform(0.0, 0.03) * (time / time[-1] - 0.5)
        seen = np.mean(x) + size * (x - np.mean(x)) + 1e-5 * rng.standard_normal(len(x))
        found.append((time, seen, float(T), period))
    return found


def reference(repeated: bool = False, only: str = "") -> tuple[Known, ...]:
    """The 25 reference cases, each as one record, made once.

    repeated : with a whole number of samples in an excitation period
    only : the name of one case
    """
    return _reference(repeated, only)


@cache
def _reference(repeated: bool, only: str) -> tuple[Known, ...]:
    known = []
    for seed, case in enumerate(read_cases().raw):
        if only not in ("", case["name"]):
            continue
        parameters = {name: case[name] for name in ("m1", "m2", "k1", "c", "mu", "v_s", "g")}
        T = 2.0 * np.pi / case["Omega"]
        step = T / round(T / 1e-3) if repeated else 1e-3
        settings = RunSetup("s", case["Omega"], case["P_d"], case["G"], 2000, step)
        run = make_runs({**parameters, "K": 2.0, "k2[s]": case["k2"]}, 100 + seed, (settings,))[0]
        known.append(Known(case["name"], case["label"], 1e-3 * case["mean_velocity_mm_per_s"], run))
    return tuple(known)


@cache
def longer() -> tuple[Known, ...]:
    """Motions of longer period."""
    known = []
    for seed, ((k2, mu, G, P_d, Omega), label) in enumerate(LONGER.items()):
        parameters = {"m1": 0.11, "m2": 0.53, "k1": 1420.0, "c": 1.0, "mu": mu, "v_s": 0.3, "g": 9.81, "K": 2.0}
        run = make_runs({**parameters, "k2[s]": k2}, 200 + seed, (RunSetup("s", Omega, P_d, G, 2000, 1e-3),))[0]
        known.append(Known(f"{k2:g} N/m, {Omega:g} rad/s", label, float("nan"), run))
    return tuple(known)
