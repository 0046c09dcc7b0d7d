"""Covariance of the parameters at a minimum of least squares, from the singular values of the Jacobian."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from capsule_id.errors import InputError
from capsule_id.views import counted

#: Derivatives of n residuals with respect to d parameters.
Jacobian = Float[np.ndarray, "n d"]
#: n residuals.
Residuals = Float[np.ndarray, " n"]


@dataclass(frozen=True)
class Covariance:
    """Covariance of the parameters at a minimum, and the rank of their Jacobian.

    Attributes
    ----------
    matrix : (d, d), units of the parameters; every entry is inf where the Jacobian is rank deficient
    rank : numerical rank of the Jacobian, its columns scaled to unit length; 0 where it is not finite
    residual_sd : σ that scales the matrix, units of the residuals
    """

    matrix: np.ndarray
    rank: int
    residual_sd: float

    @property
    def rank_deficient(self) -> bool:
        """Whether some combination of the parameters leaves the residuals unchanged: no standard error exists."""
        return self.rank < self.matrix.shape[0]

    @property
    def standard_errors(self) -> np.ndarray:
        """(d,) square roots of the diagonal, units of the parameters; inf where rank deficient."""
        return np.sqrt(np.diag(self.matrix))


def covariance(jacobian: Jacobian, residuals: Residuals, residual_sd: float | None = None) -> Covariance:
    """σ² (JᵀJ)⁻¹ from the singular values of J, infinite where J is rank deficient.

    A pseudo-inverse would give a direction without data zero variance.

    The columns are scaled to unit length first, so that the rank does not depend on the units of the parameters.

    Parameters
    ----------
    jacobian : (n, d) of the residuals at the minimum
    residuals : (n,) at the minimum
    residual_sd : σ where it is known (1 for standardised residuals); None estimates it from the residuals

    Raises
    ------
    InputError
        If σ is None and there are not more residuals than parameters.
    """
    count, parameters = jacobian.shape
    if residual_sd is None:
        if count <= parameters:
            raise InputError(
                "the residual sd can be estimated only from more residuals than parameters",
                f"{counted(count, 'residual')} for {counted(parameters, 'parameter')}",
                "give the sd of the measurements or more measurements",
            )
        residual_sd = float(np.sqrt(residuals @ residuals / (count - parameters)))
    no_answer = np.full((parameters, parameters), np.inf)
    if not all_finite(jacobian, residuals):
        return Covariance(no_answer, 0, residual_sd)
    _, singular, right, column_norm = column_space(jacobian)
    if len(singular) < parameters:
        return Covariance(no_answer, len(singular), residual_sd)
    root = residual_sd * right.T / singular / column_norm[:, None]
    return Covariance(root @ root.T, parameters, residual_sd)


def all_finite(jacobian: Jacobian, residuals: Residuals) -> bool:
    """Whether every entry of both is finite."""
    return bool(np.isfinite(jacobian).all() and np.isfinite(residuals).all())


def column_space(
    jacobian: Jacobian,
) -> tuple[
    Float[np.ndarray, "n rank"], Float[np.ndarray, " rank"], Float[np.ndarray, "rank d"], Float[np.ndarray, " d"]
]:
    """Singular vectors and values above rounding of J with unit columns, and the column norms of J."""
    column_norm = np.linalg.norm(jacobian, axis=0)
    left, singular, right = np.linalg.svd(jacobian / np.where(column_norm > 0, column_norm, 1.0), full_matrices=False)
    rank = int(np.sum(singular > singular[0] * max(jacobian.shape) * np.finfo(float).eps))
    return left[:, :rank], singular[:rank], right[:rank], column_norm
