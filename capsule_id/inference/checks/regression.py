"""Outliers by local regression diagnostics of one experiment at the point fit.

The model is linearised at the point fit: r is the vector of residuals in units of the noise. J is its Jacobian with
respect to the experiment's own parameters and linear nuisances. The hat matrix J (J'J)^-1 J' gives the leverage of
each reading (Cook & Weisberg 1982, section 2.2).
"""

from dataclasses import dataclass

import numpy as np
from scipy import stats

from capsule_id.experiments.base import Experiment, ValuesBySymbol
from capsule_id.inference.fit.curvature import jacobian

#: Relative step of difference quotients, dimensionless.
DIFFERENCE = 1e-5
#: Singular values below this part of the largest one are those of columns that depend on each other.
DEPENDENT = 1e-8
#: Largest number of flagged rows per experiment. More outliers indicate a wrong model, not wrong rows.
MOST_FLAGGED = 3


@dataclass(frozen=True)
class Outlier:
    """An outlying reading: ``row`` index, ``score`` (studentised residual), corrected p-value ``p``."""

    row: int
    score: float
    p: float


def moving_symbols(experiment: Experiment) -> list[str]:
    """Symbols of the parameters that change the experiment's prediction (scatters do not)."""
    return [row.symbol for row in experiment.parameters if not row.scatter]


def design(experiment: Experiment, theta: ValuesBySymbol) -> tuple[np.ndarray, np.ndarray]:
    """Residuals (n,) in units of the noise at the conditional mean of the nuisances, and J (n, p)."""
    symbols = moving_symbols(experiment)

    def residuals(v: np.ndarray) -> np.ndarray:
        moved = {**theta, **dict(zip(symbols, v, strict=True))}
        return experiment.misfit(moved).raw

    misfit = experiment.misfit(theta)
    sd, at = misfit.sd, np.array([float(theta[s]) for s in symbols])
    raw = jacobian(residuals, at, DIFFERENCE * np.maximum(np.abs(at), 1e-12)) / sd[:, None]
    columns = np.concatenate([raw, misfit.design / sd[:, None]], axis=1)
    size = np.linalg.norm(columns, axis=0)
    columns = columns[:, size > 0.0] / size[size > 0.0]
    return np.asarray(experiment.residuals(theta, np))[: experiment.n], columns


def outliers(experiment: Experiment, theta: ValuesBySymbol, level: float) -> list[Outlier]:
    """Readings whose externally studentised residual is too large at family-wise ``level`` (Bonferroni over rows).

    The largest is removed and the test repeats, up to ``MOST_FLAGGED`` rows. The score is standard normal where the
    noise is known. Otherwise it follows Student's t with n - p - 1 degrees of freedom, the reading left out.
    """
    r, columns = design(experiment, theta)
    known = None if experiment.scale_known else _known_share(experiment, theta)
    keep = np.arange(len(r))
    found: list[Outlier] = []
    while len(found) < MOST_FLAGGED and len(keep) > (basis := _basis(columns[keep])).shape[1] + 2:
        score, freedom = _studentised(r[keep], basis, None if known is None else known[keep])
        worst = int(np.argmax(np.abs(score)))
        tail = stats.norm.sf(abs(score[worst])) if freedom is None else stats.t.sf(abs(score[worst]), freedom)
        p = min(1.0, 2.0 * float(tail) * len(keep))
        if p > level:
            break
        found.append(Outlier(int(keep[worst]), float(score[worst]), p))
        keep = np.delete(keep, worst)
    return found


def _basis(columns: np.ndarray) -> np.ndarray:
    """(n, rank) orthonormal columns with the span of ``columns`` (n, p).

    Columns of nuisances may span those of parameters, as discrepancies do that all trials of a setting share.
    """
    u, size, _ = np.linalg.svd(columns, full_matrices=False)
    return u[:, size > DEPENDENT * np.max(size, initial=0.0)]


def _known_share(experiment: Experiment, theta: ValuesBySymbol) -> np.ndarray:
    """(n,) variance of the stated errors, or of the step of the digits, in units of the noise of each reading."""
    parts = [np.broadcast_to(one.fixed_variance, one.raw.shape) for one in experiment.misfits(theta, np)]
    return np.concatenate(parts) / experiment.misfit(theta).sd ** 2


def _studentised(r: np.ndarray, q: np.ndarray, known: np.ndarray | None) -> tuple[np.ndarray, int | None]:
    """Studentised residuals about the local fit with the orthonormal columns q, and degrees of freedom (None: normal).

    The scale of the noise is estimated where ``known`` (n,) is stated, and no less than it; else it is 1.
    """
    rest = r - q @ (q.T @ r)
    free = np.maximum(1.0 - np.sum(q**2, axis=1), 1e-9)
    if known is None:
        return rest / np.sqrt(free), None
    freedom = len(r) - q.shape[1] - 1
    variance = np.maximum((rest @ rest - rest**2 / free) / freedom, np.maximum(known, 1e-300))
    return rest / np.sqrt(variance * free), freedom
