"""Uncertainty budget of a point fit: how much every table and every prior contributes to the sd of a parameter.

At the maximum an error e of the residuals moves the estimate by C Jᵀ e, with C = (Jᵀ J)⁻¹ and unit variance of every
entry of e. The entries of one input, rows i of J, therefore contribute diag(C J_iᵀ J_i C) to the variance diag(C), and
the contributions of all inputs add up to it (JCGM 100:2008, *Guide to the expression of uncertainty*, 5.1.2).
"""

from collections.abc import Sequence

import numpy as np

from capsule_id.experiments.base import Experiment
from capsule_id.inference.fit.covariance import Jacobian, covariance
from capsule_id.inference.result import STATED
from capsule_id.inference.target.log_posterior import LogPosterior
from capsule_id.inference.target.priors import prior_of
from capsule_id.parameters import is_stated


def variance_shares(
    target: LogPosterior, jacobian: Jacobian, owners: Sequence[Experiment | None]
) -> dict[str, dict[str, float]]:
    """Share of every input in the variance of every located parameter; {} where the Jacobian is rank deficient.

    Parameters
    ----------
    jacobian : (n, located) of the standardised residuals, priors last
    owners : (n,) experiment of every residual; None: a prior

    Returns
    -------
    By parameter, then by input: the label of a table, ``prior of c``, ``stated value of m1``.
    """
    found = covariance(jacobian, np.zeros(len(jacobian)), residual_sd=1.0)
    if found.rank_deficient:
        return {}
    effect = (jacobian @ found.matrix) ** 2 / np.diag(found.matrix)
    inputs = [e.table.label for e in owners if e is not None]
    stated = [is_stated(row.name) or prior_of(row).kind == "positive_normal" for row in target.parameters]
    inputs += [f"{STATED if own else 'prior of '}{name}" for name, own in zip(target.names, stated, strict=True)]
    names = list(dict.fromkeys(inputs))
    number = np.array([names.index(name) for name in inputs])
    shares = np.stack([np.bincount(number, column, len(names)) for column in effect.T])
    located = [target.names[i] for i in target.located]
    return {
        name: dict(zip(names, (float(s) for s in row), strict=True)) for name, row in zip(located, shares, strict=True)
    }
