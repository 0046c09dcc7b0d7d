"""Choice of the model of free decays where the record contradicts the stated one.

A record demands another model where its residuals are not white, or where they correlate with the response to dry
friction, quadratic damping, a cubic spring or a drift. Every sum of the terms that the settings leave open is then fitted
to the record by maximum likelihood, with the noise level in closed form, and ranked by BIC.
"""

import itertools
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy import stats
from scipy.optimize import least_squares
from scipy.signal import lsim

from capsule_id.experiments.checks.refit import refit
from capsule_id.experiments.checks.series import LEVEL, ljung_box
from capsule_id.experiments.free_vibration.decay_models import decay, viscous_basis
from capsule_id.experiments.free_vibration.noise import whiten_by_shape
from capsule_id.experiments.free_vibration.settings import DAMPING, DecayModel
from capsule_id.experiments.linear import LOG_2PI
from capsule_id.records.noise import noise_level
from capsule_id.views import Finding

if TYPE_CHECKING:
    from capsule_id.experiments.free_vibration.experiment import FreeVibration

#: Records are thinned to this many samples per period before their models are ranked; points per period of the responses.
SAMPLES_PER_PERIOD, RESPONSE_POINTS = 16, 60
#: Fewest samples per period of a thinned record, and largest number of samples of a second fit.
FEWEST_SAMPLES_PER_PERIOD, LONGEST = 8, 6000
#: Shorter records, in samples, keep their model.
SHORTEST = 40
#: Residuals with a larger p-value of the Ljung–Box test count as white here; the check after the fit is more lenient.
WHITENESS = 0.01
#: Largest number of evaluations in a fit, and relative step of its difference quotients.
EVALUATIONS, STEP = 40, 1e-5
#: White over correlated noise that stands for white noise.
WHITE = 1e3
#: Unknowns of a fit, and bounds of their scaled values. Masses, forces and times are logarithms, or fractions of the
#: linear spring's force at the first turning point.
BOUNDS: Mapping[str, tuple[float, float]] = {
    "k1": (-0.3, 0.3),
    "c": (-8.0, 3.0),
    "F_dry": (0.0, 1.0),
    "c_q": (0.0, 20.0),
    "k_cubic": (-1.0, 3.0),
    "amplitude": (-1.0, 1.0),
    "turning_time": (-1.5, 1.5),
    "noise_time": (-7.0, 7.0),
    "white_ratio": (-5.0, 5.0),
    "drift_ratio": (-5.0, 9.0),
    "drift_time": (0.0, 5.0),
}
NAMES = tuple(BOUNDS)


@dataclass(frozen=True)
class Screened:
    """A fit of one thinned record: its BIC, values by symbol, SI, and whitened residuals (n,)."""

    bic: float
    values: Mapping[str, float]
    residuals: np.ndarray


def free_symbols(model: DecayModel) -> list[str]:
    """Unknowns of ``model`` among ``NAMES``."""
    absent = {"F_dry", "c_q", "k_cubic"} - set(model.symbols)
    absent |= {"white_ratio"} if model.noise != "arma" else set()
    absent |= {"noise_time"} if model.noise == "white" else set()
    absent |= {"drift_ratio", "drift_time"} if model.drift != "gp" else set()
    return [name for name in NAMES if name not in absent]


@partial(jax.jit, static_argnames="number")
def _residuals(time: Any, values: Any, theta: Mapping[str, Any], sloped: Any, side: Any, number: int) -> Any:
    """(n,) whitened residuals at the best offset and, where ``sloped`` is 1, the best slope."""
    forces = {name: theta[name] for name in ("k1", "c", "m1", "F_dry", "c_q", "k_cubic")}
    raw = values - side * decay(time, forces, theta["amplitude"], theta["turning_time"], number).x_rel
    slope = sloped * (time - jnp.mean(time)) / (time[-1] - time[0])
    shape = {name: theta[name] for name in ("noise_time", "white_ratio", "drift_ratio", "drift_time")}
    white = whiten_by_shape(time, jnp.stack([raw, jnp.ones_like(raw), slope], axis=1), "arma", shape)
    design = white[:, 1:]
    normal = design.T @ design + 1e-9 * jnp.eye(2)
    return white[:, 0] - design @ jnp.linalg.solve(normal, design.T @ white[:, 0])


@partial(jax.jit, static_argnames="number")
def _batch(time: Any, values: Any, thetas: Mapping[str, Any], sloped: Any, side: Any, number: int) -> Any:
    return jax.vmap(lambda theta: _residuals(time, values, theta, sloped, side, number))(thetas)


class Screening:
    """Maximum-likelihood fits of one record, of which every n-th sample is used."""

    def __init__(self, record: "FreeVibration", every: int = 1) -> None:
        rough = record.rough_decrement()
        self.turning_time, peak = record.first_turning_point()
        self.side, self.size = float(np.sign(peak)), abs(peak)
        self.m1, self.k1, self.c, self.omega = record.mass, rough.k1, rough.c, rough.Omega_o
        period, length = 2.0 * np.pi / self.omega, float(record.time[-1])
        self.time, self.values = record.time[::every], record.values[::every]
        self.number = int(3.0 * length / period) + 5
        self.noise_time, self.drift_time = 0.1 * period, period

    def theta(self, z: np.ndarray) -> dict[str, Any]:
        """Values by symbol, SI, of scaled unknowns (..., names)."""
        own = dict(zip(NAMES, np.moveaxis(z, -1, 0), strict=True))
        k1 = self.k1 * np.exp(own["k1"])
        return {
            "m1": np.broadcast_to(self.m1, k1.shape),
            "k1": k1,
            "c": self.c * np.exp(own["c"]),
            "F_dry": self.k1 * self.size * own["F_dry"],
            "c_q": self.m1 / self.size * own["c_q"],
            "k_cubic": self.k1 / self.size**2 * own["k_cubic"],
            "amplitude": self.size * np.exp(own["amplitude"]),
            "turning_time": self.turning_time + own["turning_time"] / self.omega,
            "noise_time": self.noise_time * np.exp(own["noise_time"]),
            "white_ratio": np.where(own["white_ratio"] < BOUNDS["white_ratio"][0], 0.0, np.exp(own["white_ratio"])),
            "drift_ratio": np.where(own["drift_ratio"] < BOUNDS["drift_ratio"][0], 0.0, np.exp(own["drift_ratio"])),
            "drift_time": self.drift_time * np.exp(own["drift_time"]),
        }

    def start(self, model: DecayModel, near: np.ndarray | None) -> np.ndarray:
        """(names,) scaled starting values; absent terms are switched off."""
        z = np.zeros(len(NAMES)) if near is None else near.copy()
        free = free_symbols(model)
        for name, value in (("F_dry", 0.02), ("c_q", 0.05), ("k_cubic", 0.0), ("drift_time", 1.0)):
            i = NAMES.index(name)
            z[i] = (z[i] or value) if name in free else 0.0
        off = -1e3
        for name, value, absent in (
            ("white_ratio", 0.0, off if model.noise == "ar1" else np.log(WHITE)),
            ("drift_ratio", np.log(3.0), off),
        ):
            i = NAMES.index(name)
            inside = BOUNDS[name][0] < z[i] < BOUNDS[name][1]
            z[i] = (z[i] if inside and near is not None else value) if name in free else absent
        return z

    def fit(self, model: DecayModel, near: np.ndarray | None = None) -> tuple[Screened, np.ndarray]:
        """Fit ``model`` from the scaled values ``near``; return also the scaled values found."""
        start, free = self.start(model, near), [NAMES.index(name) for name in free_symbols(model)]
        sloped = float(model.drift == "linear")

        def rows(z: np.ndarray) -> np.ndarray:
            """(m, n) residuals at (m, free), always evaluated in one batch of fixed size."""
            whole = np.tile(start, (len(NAMES) + 1, 1))
            whole[: len(z), free] = z
            thetas = {name: jnp.asarray(value) for name, value in self.theta(whole).items()}
            return np.asarray(_batch(self.time, self.values, thetas, sloped, self.side, self.number))[: len(z)]

        def jacobian(z: np.ndarray) -> np.ndarray:
            sign = np.where(z > high - 2.0 * STEP, -1.0, 1.0)
            points = rows(np.concatenate([z[None], z + STEP * np.diag(sign)]))
            return (points[1:] - points[:1]).T / (STEP * sign)

        low, high = np.array([BOUNDS[NAMES[i]] for i in free]).T
        first = np.clip(start[free], low + 1e-3, high - 1e-3)
        unit = float(np.std(self.values))
        found = least_squares(
            lambda z: rows(z[None])[0] / unit,
            first,
            jac=lambda z: jacobian(z) / unit,  # type: ignore[arg-type]  # pyright: ignore[reportArgumentType]
            bounds=(low, high),
            x_scale="jac",
            max_nfev=EVALUATIONS,
        )
        z = start.copy()
        z[free] = found.x
        n, unknowns = len(self.time), len(free) + 2 + int(sloped)
        deviance = n * (np.log(2.0 * found.cost * unit**2 / n) + 1.0 + LOG_2PI)
        values = {name: float(value) for name, value in self.theta(z).items()}
        return Screened(float(deviance + unknowns * np.log(n)), values, found.fun), z


def open_models(record: "FreeVibration") -> tuple[list[DecayModel], list[DecayModel]]:
    """Return the sums of forces that the settings leave open, and the pairs of drift and noise."""
    settings, stated = record.table.settings, record.model
    damping = [
        tuple(word for word, on in zip(DAMPING, switches, strict=True) if on)
        for switches in itertools.product((False, True), repeat=len(DAMPING))
    ]
    forces = [
        replace(stated, damping=words, cubic=cubic)
        for words in (damping if settings.damping is None else [stated.damping])
        for cubic in ((False, True) if settings.stiffness is None else (stated.cubic,))
    ]
    others = [
        replace(stated, drift=drift, noise=noise)
        for noise in (("white", "ar1", "arma") if settings.noise is None else (stated.noise,))
        for drift in (("none", "linear", "gp") if settings.drift is None else (stated.drift,))
    ]
    return forces, others


def demands_another(record: "FreeVibration", level: float) -> bool:
    """Whether ``record`` contradicts its model at this false-alarm rate: residuals, or responses to further forces."""
    if not record.closed or record.model.whitened:
        return ljung_box(Screening(record).fit(record.model)[0].residuals)[1] < level
    rough = record.rough_decrement()
    noise = max(noise_level(record.values), 1e-6 * float(np.ptp(record.values)))
    # Steps of the fit must not start from an overdamped decay.
    c = min(rough.c, float(np.sqrt(rough.k1 * record.mass)))
    theta = {"m1": record.mass, "k1": rough.k1, "c": c, "noise_sd": noise}
    theta |= {symbol: value for symbol, (value, _) in refit(record, theta, []).items()}
    residuals = np.asarray(record.residuals(theta, np))[: record.n]
    return ljung_box(residuals)[1] < level or response_p(record, theta) < level


def response_p(record: "FreeVibration", theta: Mapping[str, float]) -> float:
    """p-value of the F test for the responses of the rod to further forces and for a drift, at a viscous fit."""
    raw, design = record.unwhitened(theta, np)
    parts = np.linalg.lstsq(design, raw, rcond=None)[0]
    m1, k1, c = theta["m1"], theta["k1"], theta["c"]
    length = float(record.time[-1])
    points = max(200, int(RESPONSE_POINTS * length * np.sqrt(k1 / m1) / (2.0 * np.pi)))
    grid = np.linspace(0.0, length, points)
    x = viscous_basis(grid, k1, c, m1, np) @ parts[:2]
    rate = np.gradient(x, grid[1])
    system = ([1.0 / m1], [1.0, c / m1, k1 / m1])
    forces = [force / np.max(np.abs(force)) for force in (np.sign(rate), rate * np.abs(rate), x**3)]
    columns = [np.interp(record.time, grid, lsim(system, force, grid)[1]) for force in forces]
    relative = record.time / length - 0.5
    extra = np.column_stack([*columns, relative, relative**2])
    moved = [record.unwhitened({**theta, name: 1.001 * theta[name]}, np)[1] @ parts for name in ("k1", "c")]
    known = np.column_stack([design, *(column - design @ parts for column in moved)])
    both = np.concatenate([known, extra], axis=1)
    own, further = (
        float(np.sum((raw - a @ np.linalg.lstsq(a, raw, rcond=None)[0]) ** 2))
        for a in (known / np.linalg.norm(known, axis=0), both / np.linalg.norm(both, axis=0))
    )
    freedom = record.n - both.shape[1]
    if freedom < 1:
        return 1.0
    return float(stats.f.sf((own - further) / extra.shape[1] * freedom / further, extra.shape[1], freedom))


def thinning(record: "FreeVibration", samples_per_period: float) -> int:
    """Return n such that every n-th sample leaves about ``samples_per_period``."""
    period = 2.0 * np.pi / record.rough_decrement().Omega_o
    return max(1, int(record.n * period / float(record.time[-1]) / samples_per_period))


@dataclass(frozen=True)
class Ranking:
    """The best of some models for some records together: total BIC, and fit and scaled values of each record."""

    model: DecayModel
    bic: float
    fits: tuple[tuple[Screened, np.ndarray], ...]

    @property
    def white(self) -> bool:
        """Whether the residuals of all records are white."""
        return all(ljung_box(one.residuals)[1] * len(self.fits) > WHITENESS for one, _ in self.fits)


def rank(screenings: Sequence[Screening], models: Iterable[DecayModel], near: Ranking | None = None) -> list[Ranking]:
    """Fit every model to all records, from the values of ``near``; lowest BIC first."""
    found = []
    for model in models:
        starts = [None] * len(screenings) if near is None else [z for _, z in near.fits]
        fits = tuple(one.fit(model, start) for one, start in zip(screenings, starts, strict=True))
        found.append(Ranking(model, sum(screened.bic for screened, _ in fits), fits))
    return sorted(found, key=lambda one: one.bic)


def demanded_model(records: Sequence["FreeVibration"]) -> Ranking:
    """Return the model with the lowest BIC of all ``records`` together, thinned until its residuals are white.

    The forces are chosen first on thinned records, with the richest noise that the settings leave open, then drift and
    noise. At high sampling rates no offered noise may be white. Fewer samples then lose little, because they are
    correlated.
    """
    forces, others = open_models(records[0])
    coarse = thinning(records[0], SAMPLES_PER_PERIOD)
    thinned = [Screening(record, coarse) for record in records]
    best = rank(thinned, [replace(model, noise=others[-1].noise) for model in forces])[0]
    others = [replace(model, damping=best.model.damping, cubic=best.model.cubic) for model in others]
    best = rank(thinned, others, best)[0]
    if records[0].table.settings.every is not None:
        return best
    every = max(1, max(record.n for record in records) // LONGEST)
    fewest = max(coarse, thinning(records[0], FEWEST_SAMPLES_PER_PERIOD))
    while every <= fewest:
        screenings = [Screening(record, every) for record in records]
        rich = rank(screenings, [replace(best.model, noise=others[-1].noise)], best)[0]
        if rich.white:
            ranked = rank(screenings, others, rich)
            return next((replace(one, model=replace(one.model, every=every)) for one in ranked if one.white), rich)
        every *= 2
    return replace(best, model=replace(best.model, every=coarse))


def second_models(
    records: Sequence["FreeVibration"],
) -> tuple[list["FreeVibration"], list[Finding]]:
    """Return ``records`` under the model that they demand, and findings that name it."""
    level = LEVEL / len(records)
    chosen, findings = list(records), []
    groups: dict[Any, list[int]] = {}
    for i, record in enumerate(records):
        settings = record.table.settings
        stated = settings.damping, settings.stiffness, settings.drift, settings.noise
        groups.setdefault(stated, []).append(i)
    for stated, members in groups.items():
        own = [records[i] for i in members]
        if None not in stated:
            continue
        contradicting = [e.label for e in own if e.n >= SHORTEST and demands_another(e, level)]
        if not contradicting:
            continue
        ranking = demanded_model(own)
        model = ranking.model
        if model != own[0].model:
            facts = {"labels": contradicting, "first": own[0].model.name, "second": model.name, "lines": model.lines}
            findings.append(Finding("decays.second_fit", "warn", facts, contradicting[0]))
            for i, (known, _) in zip(members, ranking.fits, strict=True):
                chosen[i] = records[i].with_model(model, known.values)
    return chosen, findings
