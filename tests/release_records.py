"""Records of free decays with what hands do before the release, by SciPy: independent of the package."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.integrate import solve_ivp

Motion = tuple[np.ndarray, np.ndarray, np.ndarray]


@dataclass(frozen=True)
class Released:
    """A record and the truth.

    Attributes
    ----------
    time, values : (n,) s and displacements, m; the mass is 1 kg
    release : time of the release, s; the first sample where the record begins after it
    T : 2 pi sqrt(m1/k1), s
    zeta : damping ratio of the viscous damping
    step : mean sampling step, s
    k1, c : N/m and N s/m
    """

    time: np.ndarray
    values: np.ndarray
    release: float
    T: float
    zeta: float
    step: float

    @property
    def k1(self) -> float:
        return (2.0 * np.pi / self.T) ** 2

    @property
    def c(self) -> float:
        return 2.0 * self.zeta * 2.0 * np.pi / self.T


def free(time: np.ndarray, x: float, v: float, zeta: float, **more: float) -> np.ndarray:
    """Displacement (n,) from the state (x, v) at time 0 on, in units of the period: k1 = 4 pi^2 and m1 = 1.

    ``dry``, ``quadratic`` and ``cubic``: further forces, as fractions of the spring force at a displacement of 1.
    """
    w, out = 2.0 * np.pi, np.full(len(time), np.nan)
    dry, quadratic, cubic = (w**2 * more.get(name, 0.0) for name in ("dry", "quadratic", "cubic"))
    begin, end = 0.0, float(time[-1]) + 1e-9
    while begin < end:
        spring = w**2 * x + cubic * x**3
        if abs(v) < 1e-12 and abs(spring) <= dry:
            break
        side = np.sign(v) if abs(v) > 1e-12 else -np.sign(spring)

        def rate(_: float, s: np.ndarray, side: float = side) -> list[float]:
            force = w**2 * s[0] + cubic * s[0] ** 3 + 2.0 * zeta * w * s[1] + dry * side
            return [s[1], -force - quadratic / w**2 * s[1] * abs(s[1])]

        def turns(t: float, s: np.ndarray, first: float = begin, side: float = side) -> float:
            return float(s[1]) if t > first + 1e-6 else float(side)

        turns.terminal = dry > 0.0  # type: ignore[attr-defined]
        part = solve_ivp(rate, (begin, end), [x, v], "DOP853", rtol=1e-9, atol=1e-12, events=turns, dense_output=True)
        inside = (time >= begin) & (time <= part.t[-1])
        out[inside] = part.sol(time[inside])[0] if inside.any() else 0.0
        begin, x, v = float(part.t[-1]), float(part.y[0, -1]), 0.0
    out[np.isnan(out)] = x
    return out


def smooth(u: np.ndarray) -> np.ndarray:
    """A rise from 0 to 1 within 0 <= u <= 1, without a jump of the velocity."""
    return 0.5 - 0.5 * np.cos(np.pi * np.clip(u, 0.0, 1.0))


# What comes before the release: displacement (n,) at times t <= 0, in periods, and the state at the release.
Before = Callable[[np.random.Generator, np.ndarray, float], tuple[np.ndarray, float, float]]


def blow(rng: np.random.Generator, t: np.ndarray, zeta: float) -> tuple[np.ndarray, float, float]:
    """Rest, and a blow."""
    return np.zeros_like(t), 0.0, 2.0 * np.pi * rng.choice([-1.0, 1.0]) * (1.0 + 3.0 * zeta)


def hold(rng: np.random.Generator, t: np.ndarray, zeta: float) -> tuple[np.ndarray, float, float]:
    """A hold, also that before a step of the force."""
    return np.full_like(t, 1.0), 1.0, 0.0


def pull_and_hold(rng: np.random.Generator, t: np.ndarray, zeta: float) -> tuple[np.ndarray, float, float]:
    """Rest, a pull of 0.5 to 5 periods, and a hold of up to 5."""
    end, length = -rng.uniform(0.05, 5.0), rng.uniform(0.5, 5.0)
    return smooth((t - end + length) / length), 1.0, 0.0


def slow_pull(rng: np.random.Generator, t: np.ndarray, zeta: float) -> tuple[np.ndarray, float, float]:
    """Rest, and a pull that ends with the release."""
    length, stop = rng.uniform(1.0, 8.0), rng.choice([0.5, 1.0])
    scale = float(smooth(np.array([stop]))[0])
    speed = 0.5 * np.pi * np.sin(np.pi * stop) / length / scale
    return smooth(stop + t / length) / scale, 1.0, speed


def wobble(rng: np.random.Generator, t: np.ndarray, zeta: float) -> tuple[np.ndarray, float, float]:
    """Rest, a pull, and a hold that wobbles more slowly than the period."""
    size, period, phase = rng.uniform(0.05, 0.5), rng.uniform(1.2, 8.0), rng.uniform(0.0, 2.0 * np.pi)
    end, length = -rng.uniform(1.0, 10.0), rng.uniform(0.5, 5.0)
    rate = 2.0 * np.pi / period
    hand = 1.0 + size * np.sin(rate * t + phase)
    return hand * smooth((t - end + length) / length), 1.0 + size * np.sin(phase), size * rate * np.cos(phase)


def short_wobble(rng: np.random.Generator, t: np.ndarray, zeta: float) -> tuple[np.ndarray, float, float]:
    """A record that begins in a hold that wobbles."""
    size, period, phase = rng.uniform(0.05, 0.5), rng.uniform(1.2, 8.0), rng.uniform(0.0, 2.0 * np.pi)
    rate = 2.0 * np.pi / period
    return 1.0 + size * np.sin(rate * t + phase), 1.0 + size * np.sin(phase), size * rate * np.cos(phase)


def bounce(rng: np.random.Generator, t: np.ndarray, zeta: float) -> tuple[np.ndarray, float, float]:
    """A hold, and one to four bounces on the hand, each shorter than the one before it in time."""
    lengths = rng.uniform(0.1, 0.4) * rng.uniform(1.1, 1.6) ** np.arange(rng.integers(1, 5))
    x, begin = np.full_like(t, 1.0), 0.0
    for length in lengths:
        u = (t - begin + length) / length
        x -= 8.0 * 0.5 * np.pi**2 * 0.25 * length**2 * np.where((u > 0.0) & (u < 1.0), u * (1.0 - u), 0.0)
        begin -= length
    return x, 1.0, 0.0


def second_grip(rng: np.random.Generator, t: np.ndarray, zeta: float) -> tuple[np.ndarray, float, float]:
    """A hold, a first release, a grip that moves the rod to another hold, and that hold."""
    held, moved, swung = rng.uniform(0.05, 2.0), rng.uniform(0.3, 1.5), rng.uniform(0.2, 4.0)
    grip = -held - moved
    first = rng.uniform(0.5, 1.5)
    since = np.clip(t - grip + swung, 0.0, None)
    order = np.argsort(since, kind="stable")
    swing = np.empty_like(t)
    swing[order] = free(since[order], first, 0.0, zeta) if len(t) else swing
    at_grip = free(np.array([0.0, swung]), first, 0.0, zeta)[-1]
    u = smooth((t - grip) / moved)
    return np.where(t < grip, swing, (1.0 - u) * at_grip + u), 1.0, 0.0


def stop(rng: np.random.Generator, t: np.ndarray, zeta: float) -> tuple[np.ndarray, float, float]:
    """A hold, a first release, and a rebound from a stop, which is gone then."""
    swung = rng.uniform(0.1, 0.4)
    fine = np.linspace(0.0, swung, 2001)
    path = free(fine, 1.0, 0.0, zeta)
    speed = (path[-1] - path[-2]) / (fine[1] - fine[0])
    since = np.clip(t + swung, 0.0, None)
    return np.interp(since, fine, path), float(path[-1]), -float(rng.uniform(0.5, 0.9) * speed)


#: Form -> motion before the release, longest and shortest duration of it in periods (0: two samples), level after it,
#: further forces.
FORMS: dict[str, tuple[Before, float, float]] = {
    "blow": (blow, 0.0, 10.0),
    "short hold": (hold, 0.0, 0.0),
    "hold": (hold, 0.0, 1.0),
    "long hold": (hold, 1.0, 10.0),
    "pull and hold": (pull_and_hold, 2.0, 15.0),
    "slow pull": (slow_pull, 0.5, 12.0),
    "wobble": (wobble, 2.0, 18.0),
    "short wobble": (short_wobble, 0.0, 4.0),
    "bounce": (bounce, 0.1, 3.0),
    "second grip": (second_grip, 0.5, 8.0),
    "stop": (stop, 0.3, 2.0),
    "force step": (hold, 0.0, 5.0),
    "dry": (hold, 0.0, 3.0),
    "quadratic": (wobble, 0.0, 10.0),
    "cubic": (pull_and_hold, 0.0, 10.0),
}


def further_forces(form: str, rng: np.random.Generator) -> dict[str, float]:
    """Further forces of a form, as fractions of the spring force."""
    ranges = {"dry": (0.01, 0.15), "quadratic": (0.02, 0.5), "cubic": (-0.3, 0.5)}
    return {form: float(rng.uniform(*ranges[form]))} if form in ranges else {}


def draw(form: str, seed: int, coarse: bool = False, after_release: bool = False) -> Released:
    """A record of a form; ``coarse``: noise of 2 % and 10 samples in a period; it may begin after the release.

    Otherwise the noise is at most 0.5 % and a period has 40 to 400 samples.
    """
    rng = np.random.default_rng([seed, sorted(FORMS).index(form), int(coarse)])
    before, shortest, longest = FORMS[form]
    forces = further_forces(form, rng)
    zeta = float(np.exp(rng.uniform(np.log(0.01), np.log(0.15 if forces else 2.0))))
    per_period = rng.uniform(10.0, 14.0) if coarse else np.exp(rng.uniform(np.log(40.0), np.log(400.0)))
    noise = 0.02 if coarse else np.exp(rng.uniform(np.log(2e-4), np.log(5e-3)))
    lead = np.exp(rng.uniform(np.log(max(shortest, 3.0 / per_period)), np.log(max(longest, 9.0 / per_period))))
    length = rng.uniform(1.5, 20.0)
    count = int((lead + length) * per_period)
    t = (np.arange(count) - rng.uniform()) / per_period - lead
    if rng.random() < 0.4:
        t += rng.uniform(0.1, 0.9) / per_period * (rng.random(count) - 0.5)
    x, free_from = np.empty(count), int(np.searchsorted(t, 0.0))
    x[:free_from], place, speed = before(rng, t[:free_from], zeta)
    x[free_from:] = free(t[free_from:], place, speed, zeta, **forces)
    size = float(np.max(np.abs(x[free_from:])))
    x = (x + rng.choice([0.0, -1.0, rng.uniform(-1.0, 1.0)])) / size + noise * rng.standard_normal(count)
    T = float(np.exp(rng.uniform(np.log(0.02), np.log(5.0))))
    scale = 2e-3 * rng.choice([-1.0, 1.0])
    first = free_from + int(rng.uniform(0.0, 1.0) * per_period) if after_release else 0
    time, release = T * (t - t[0]), T * (0.0 - t[0])
    time, x = time[first:], scale * x[first:]
    return Released(time, x, max(release, float(time[0])), T, zeta, T / per_period)
