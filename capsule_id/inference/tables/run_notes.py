"""Tables for bench tests and forced runs together: precision gained from the runs, effect of smoothing."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pandas as pd

from capsule_id.inference.checks.agreement import runs_alone
from capsule_id.inference.fit.least_squares import linearised
from capsule_id.inference.fit.point_stage import BenchFit
from capsule_id.inference.result import PointFit, Posterior
from capsule_id.inference.target.log_posterior import HeldResiduals, LogPosterior
from capsule_id.physics.smooth.engine import Smoothing
from capsule_id.views import ResultTable


def precision_gained(target: LogPosterior, joint: PointFit, sample: Posterior | None, bench: BenchFit) -> ResultTable:
    """Posterior sd from bench only, runs only, and both; from samples where they exist, else from point fits."""
    shared, known = shared_symbols(target), run_parameters(target)
    alone = runs_alone(target, joint)
    sds = dict(zip(alone.names, np.sqrt(np.diag(alone.covariance)), strict=True))
    runs = {name: float(sd * abs(joint.values[name])) if name in known else np.nan for name, sd in sds.items()}
    rows = {}
    for name in (row.name for row in target.parameters if row.symbol in shared):
        rows[name] = [_sd(bench.fit, bench.sample, name), runs[name], _sd(joint, sample, name)]
    frame = pd.DataFrame.from_dict(rows, orient="index", columns=["bench only", "runs only", "both"])
    frame["bench only / both"] = frame["bench only"] / frame["both"]
    return ResultTable("runs.precision", frame.rename_axis("parameter"))


def run_parameters(target: LogPosterior) -> set[str]:
    """Names of the physical parameters of forced runs, masses included."""
    return {row.name for e in target.experiments if not e.bench for row in e.parameters if row.physical} | {"m1", "m2"}


def shared_symbols(target: LogPosterior) -> set[str]:
    """Symbols of run parameters that a bench test may measure too: those that belong to no single run."""
    runs = {e.label for e in target.experiments if not e.bench}
    known = run_parameters(target)
    return {row.symbol for row in target.parameters if row.name in known and row.of not in runs}


def _sd(fit: PointFit | None, sample: Posterior | None, name: str) -> float:
    if sample is not None and name in sample.names:
        return float(np.std(sample.draws[..., sample.names.index(name)], ddof=1))
    if fit is None or name not in fit.names:
        return float("nan")
    return fit.standard_errors[name]


def smoothing_certificate(target: LogPosterior, fit: PointFit, widths: Smoothing | None = None) -> ResultTable:
    """Difference between a fit of the smoothed model with ``widths`` and this fit, in posterior sd.

    One Gauss–Newton step maps the difference of the residuals of both models through the exact model's Jacobian.
    ``widths`` None: the certified ones.
    """
    widths = widths or Smoothing()
    shift, sd = smoothing_shift(target, fit, widths)
    located = target.located
    rows = {target.names[i]: [d, s, d / s] for i, d, s in zip(located, shift, sd, strict=True)}
    frame = pd.DataFrame.from_dict(rows, orient="index", columns=["shift of u", "sd of u", "shift / sd"])
    frame = frame.loc[[name for name in frame.index if target.parameters[target.names.index(name)].physical]]
    facts = {"velocity": widths.velocity, "penetration": widths.penetration}
    return ResultTable("runs.smoothing", frame.rename_axis("parameter"), facts)


@eqx.filter_jit
def _evaluate(residual: HeldResiduals, v: Any) -> Any:
    return residual(v)


def smoothing_shift(target: LogPosterior, fit: PointFit, widths: Smoothing) -> tuple[np.ndarray, np.ndarray]:
    """(d_located,) shift of u between a fit with the smoothed model of ``widths`` and the exact one, and the sd of u."""
    located = target.located
    smoothed = [e.with_smoothing(widths) for e in target.experiments]
    centre = jnp.asarray(fit.u)
    misses = _evaluate(HeldResiduals(LogPosterior(target.rig, smoothed), centre), centre[located])
    exact, jacobian = linearised(HeldResiduals(target, centre), fit.u[located])
    normal = jacobian.T @ jacobian
    step = -np.linalg.solve(normal, jacobian.T @ (np.asarray(misses) - exact))
    return step, np.sqrt(np.diag(np.linalg.inv(normal)))
