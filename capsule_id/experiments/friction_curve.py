"""Eq. (1), the Coulomb–Stribeck coefficient, the slide that follows from it, and the picture of both (Fig. 2)."""

from abc import abstractmethod
from types import ModuleType
from typing import Any, ClassVar, Literal

import jax.numpy as jnp
import numpy as np
from scipy.optimize import curve_fit

from capsule_id.experiments.base import Experiment, ValuesBySymbol, band
from capsule_id.experiments.checks.friction import check_one_surface
from capsule_id.views import Comparison, Curve, Points

#: Gauss–Legendre nodes on (0, 1). 48 give 1e-12 relative up to v = 50 v_s (tests compare with the dilogarithm).
_POINTS, _HALF_WEIGHTS = np.polynomial.legendre.leggauss(48)
_NODES, _WEIGHTS = 0.5 * (_POINTS + 1.0), 0.5 * _HALF_WEIGHTS


def friction_coefficient(speed: Any, mu: Any, v_s: Any, xp: ModuleType = jnp) -> Any:
    """Eq. (1): mu/2 (1 + exp(-|v|/v_s)), dimensionless; ``speed`` m/s."""
    return 0.5 * mu * (1.0 + xp.exp(-xp.abs(speed) / v_s))


def slide_distance(speed: Any, mu: Any, v_s: Any, g: Any, xp: ModuleType = jnp) -> Any:
    """Distance, m, of a slide from ``speed`` (n,) to rest under eq. (1): integral of u du / (g mu_d(u)) from 0 to v."""
    u = speed[:, None] * _NODES
    return speed * ((u / friction_coefficient(u, mu, v_s, xp)) @ _WEIGHTS) / g


def paper_friction_fit(speed: np.ndarray, coefficient: np.ndarray) -> dict[str, float]:
    """The paper's protocol: least squares of eq. (1) on points (speed, coefficient); static points at speed 0.

    Returns mu and, where at least one point slides, v_s; empty where the fit does not converge.
    """
    sliding = speed > 0.0
    if not sliding.any():
        return {"mu": float(np.mean(coefficient))}
    if len(np.unique(speed)) < 2:
        return {}
    start = (float(np.max(coefficient)), float(np.median(speed[sliding])))
    try:
        (mu, v_s), _ = curve_fit(
            lambda v, mu, v_s: friction_coefficient(v, mu, v_s, np),
            speed,
            coefficient,
            p0=start,
            bounds=([0.0, 1e-6], [np.inf, np.inf]),
        )
    except RuntimeError:
        return {}
    return {"mu": float(mu), "v_s": float(v_s)}


class FrictionExperiment(Experiment):
    """An experiment on the surface: it shares eq. (1), the paper's protocol and one panel with the others."""

    role: ClassVar[Literal["static", "dynamic", "sliding"]]
    checks = (check_one_surface,)

    @abstractmethod
    def paper_points(self) -> tuple[np.ndarray, np.ndarray]:
        """Speed, m/s, and coefficient, as the paper reads them, (n,) each."""

    def comparison(self, theta: ValuesBySymbol, draws: list[ValuesBySymbol]) -> Comparison:
        return friction_comparison([self], theta, draws)


def friction_comparison(
    experiments: list[FrictionExperiment], theta: ValuesBySymbol, draws: list[ValuesBySymbol]
) -> Comparison:
    """Friction coefficient against velocity: readings, the paper's curve, ours with its band (paper, Fig. 2)."""
    points = [Points(e.label, *e.paper_points(), role=e.role) for e in experiments]
    top = max(float(np.max(p.x)) for p in points)
    speed = np.linspace(0.0, 1.15 * top if top > 0 else 1.0, 161)

    def curve(values: ValuesBySymbol) -> np.ndarray:
        if "v_s" not in values:
            return np.full(speed.size, float(values["mu"]))
        return friction_coefficient(speed, values["mu"], values["v_s"], np)

    lower, upper = band(np.array([curve(draw) for draw in draws]))
    curves = [Curve("this fit, eq. (1)", speed, curve(theta), lower, upper)]
    paper = paper_friction_fit(np.concatenate([p.x for p in points]), np.concatenate([p.y for p in points]))
    if "v_s" in paper:
        curves.append(Curve("the paper's fit", speed, friction_coefficient(speed, **paper, xp=np), role="paper"))
    if "v_s" in theta and any(p.role == "dynamic" for p in points):
        reading = np.maximum(speed[1:], 1e-3 * speed[-1])
        distance = slide_distance(reading, theta["mu"], theta["v_s"], theta["g"], np)
        expected = reading**2 / (2.0 * theta["g"] * distance)
        curves.append(Curve("this fit, read as v²/(2gd)", reading, expected, role="alternative"))
    return Comparison(
        "friction",
        "friction",
        "Friction coefficient against velocity",
        "velocity [m/s]",
        "friction coefficient [1]",
        tuple(points),
        tuple(curves),
    )
