"""Calibration of decays under misfit: twins whose record contradicts the default model, and their fits.

Run as a script for a study: ``python -m tests.experiments.decay_calibration NUMBER [FIRST_SEED]``.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

import capsule_id as cid
from capsule_id.experiments.free_vibration.models import decay
from tests.experiments import bench
from tests.experiments.misfit_study import study

#: Misfits: AR(1) noise, drift of the zero, cubic spring, dry friction.
MISFITS = ("noise", "drift", "cubic", "dry")
TIME = np.arange(250) / 500.0
#: m, m and N s/m; the record holds about eight periods.
RELEASE, NOISE, C = 2e-3, 2e-5, 1.0


@dataclass(frozen=True)
class Outcome:
    """Result of one twin.

    Attributes
    ----------
    z : errors of k1 and c in units of their sd
    clean : whether no check failed
    model : words of the quoted model
    """

    misfit: str
    seed: int
    z: tuple[float, float]
    clean: bool
    model: str


def twin(misfit: str, seed: int) -> np.ndarray:
    """x_rel (n,), m, of a decay with this misfit, whose size is random within the range of the study."""
    rng = np.random.default_rng([seed, MISFITS.index(misfit)])
    n, forces = len(TIME), {"k1": bench.K1, "c": C, "m1": bench.M1}
    noise = rng.standard_normal(n)
    if misfit == "noise":
        rho = rng.uniform(0.5, 0.98)
        for i in range(1, n):
            noise[i] = rho * noise[i - 1] + np.sqrt(1.0 - rho**2) * noise[i]
    if misfit == "drift":
        size, cycles, phase = rng.uniform(3.0, 30.0), rng.uniform(0.3, 1.0), rng.uniform(0.0, 2.0 * np.pi)
        noise += size * np.sin(2.0 * np.pi * cycles * TIME / TIME[-1] + phase)
    if misfit == "cubic":
        forces["k_cubic"] = 0.03 * bench.K1 / RELEASE**2
    if misfit == "dry":
        forces["F_dry"] = rng.uniform(0.02, 0.2) * bench.K1 * RELEASE
    return np.asarray(decay(TIME, forces, RELEASE, 0.0, 30).x_rel) + NOISE * noise


def outcome(misfit: str, seed: int, **settings: Any) -> Outcome:
    """Fit the twin with these settings and without a sample; a refused twin is not clean, and its errors are infinite."""
    columns = [bench.column("time", TIME), bench.column("x_rel", twin(misfit, seed))]
    try:
        result = cid.fit(bench.rig(bench.table("free_vibration", columns, "decay", **settings)), budget=None)
    except cid.InputError:
        return Outcome(misfit, seed, (np.inf, np.inf), False, "refused")
    rows = result.summary.loc[["k1", "c"]]
    z = (rows["value"] - [bench.K1, C]) / rows["sd"]
    models = [f.facts["second"] for f in result.findings if f.code == "decays.second_fit"]
    return Outcome(misfit, seed, (float(z["k1"]), float(z["c"])), result.clean, models[0] if models else "stated")


if __name__ == "__main__":
    study(MISFITS, outcome)
