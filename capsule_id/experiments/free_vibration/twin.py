"""Synthetic free decays."""

import numpy as np

from capsule_id.experiments.kind import Twin, TwinTable, Values

#: Release amplitudes of the paper's protocol, m, and noise sd relative to the release.
RELEASES = (1.5e-3, 2.0e-3, 2.5e-3)
DECAY_NOISE = 0.01


def measure(values: Values, rng: np.random.Generator, seed: int) -> Twin:
    """Simulate one record per release amplitude."""
    del seed
    decays = [decay(rng, values["k1"], values["c"], values["m1"], release, DECAY_NOISE) for release in RELEASES]
    return Twin(tuple(TwinTable(f"free_vibration_{n}.csv", columns) for n, columns in enumerate(decays, start=1)))


def decay(
    rng: np.random.Generator,
    k1: float,
    c: float,
    m1: float,
    release: float,
    relative_sd: float,
    duration: float = 0.5,
    rate: float = 2000.0,
) -> dict[str, np.ndarray]:
    """Simulate a decay from rest at ``release`` m at time 0; the noise sd is ``relative_sd`` of the release."""
    from capsule_id.experiments.free_vibration.decay_models import viscous_basis

    time = np.arange(round(duration * rate)) / rate
    x = release * viscous_basis(time, k1, c, m1, np)[:, 0]
    return {"time [s]": time, "x_rel [mm]": 1e3 * (x + relative_sd * release * rng.standard_normal(time.size))}
