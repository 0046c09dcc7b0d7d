"""Tables about forced runs: what they buy, scaled groups, what the model predicts of them, what smoothing would do."""

from collections.abc import Mapping, Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pandas as pd

from capsule_id.errors import InputError
from capsule_id.experiments.base import Theta
from capsule_id.experiments.forced_run.experiment import ForcedRun
from capsule_id.experiments.forward import CapsuleForward
from capsule_id.inference.checks.run_checks import runs_alone
from capsule_id.inference.fit.least_squares import linearised
from capsule_id.inference.fit.point_stage import BenchFit
from capsule_id.inference.result import PointFit, Posterior, RunRecord
from capsule_id.inference.target.density import HeldResiduals
from capsule_id.inference.target.log_posterior import LogPosterior
from capsule_id.physics.friction import normal_force
from capsule_id.physics.smooth.engine import Smoothing
from capsule_id.records.label import measured_motion
from capsule_id.records.view import view_record
from capsule_id.views import NoteTable

#: Parameters that bench and runs may share.
SHARED = ("m1", "m2", "k1", "c", "mu", "v_s", "K", "k2")


def run_notes(
    target: LogPosterior, fit: PointFit, sample: Posterior | None, bench: BenchFit, draws: Sequence[Mapping[str, float]]
) -> list[NoteTable]:
    """All tables about forced runs; [] without runs."""
    runs = [e for e in target.experiments if isinstance(e, ForcedRun)]
    if not runs:
        return []
    values = target.mapping(target.theta(fit.u))
    notes = [bought(target, fit, sample, bench), predicted_motion(runs, values, draws)]
    if draws:
        notes.append(scaled_groups(runs, draws))
    return [*notes, smoothing_certificate(target, fit)]


def run_records(target: LogPosterior, fit: PointFit) -> tuple[RunRecord, ...]:
    """Every run that can be looked at through the filter: those with x_rel, sampled evenly."""
    values, found = target.mapping(target.theta(fit.u)), []
    for run in target.experiments:
        if not isinstance(run, ForcedRun):
            continue
        theta = run.local(values)
        _, e = run.capsule(theta)
        try:
            view = view_record(run.table, K=theta["K"] if run.driven_by_current else None)
        except InputError:
            continue
        force = np.asarray(e.force(run.time))
        found.append(RunRecord(run.label, view, force))
    return tuple(found)


def bought(target: LogPosterior, joint: PointFit, sample: Posterior | None, bench: BenchFit) -> NoteTable:
    """Posterior sd with bench only, runs only, both; from samples where there are any, else from point fits."""
    known = {row.name for e in target.experiments if isinstance(e, ForcedRun) for row in e.parameters} | {"m1", "m2"}
    alone = runs_alone(target, joint)
    sds = dict(zip(alone.names, np.sqrt(np.diag(alone.covariance)), strict=True))
    runs = {name: float(sd * abs(joint.values[name])) if name in known else np.nan for name, sd in sds.items()}
    rows = {}
    for i, name in enumerate(target.names):
        if target.parameters[i].symbol not in SHARED:
            continue
        rows[name] = [_sd(bench.fit, bench.sample, name), runs[name], _sd(joint, sample, name)]
    frame = pd.DataFrame.from_dict(rows, orient="index", columns=["bench only", "runs only", "both"])
    frame["bench only / both"] = frame["bench only"] / frame["both"]
    caption = (
        "Posterior standard deviation, SI. Runs only: from the curvature of their likelihood and the priors at the joint "
        "point fit; bench and both: from the samples, where they were drawn."
    )
    return NoteTable("What the runs buy", caption, frame.rename_axis("parameter"))


def _sd(fit: PointFit | None, sample: Posterior | None, name: str) -> float:
    if sample is not None and name in sample.names:
        return float(np.std(sample.draws[..., sample.names.index(name)], ddof=1))
    if fit is None or name not in fit.names:
        return float("nan")
    i = fit.names.index(name)
    return float(np.sqrt(fit.covariance[i, i]) * abs(fit.values[name]))


def scaled_groups(runs: Sequence[ForcedRun], draws: Sequence[Mapping[str, float]]) -> NoteTable:
    """The paper's nondimensional groups, mean and sd over posterior ``draws`` by name.

    Lengths are scaled by F_b/k1, forces by F_b, times by 1/Omega0, with Omega0 = sqrt(k1/m1) and F_b = mu (m1 + m2) g.
    """
    columns: dict[str, list[float]] = {}
    for values in draws:
        for run in runs:
            for name, value in _groups(run, run.local(values)).items():
                columns.setdefault(name, []).append(value)
    rows = {name: [np.mean(column), np.std(column, ddof=1)] for name, column in columns.items()}
    frame = pd.DataFrame.from_dict(rows, orient="index", columns=["mean", "sd"]).rename_axis("group")
    caption = (
        "Groups that carry the rig over to a prototype of another size: equal groups, equal motion. Omega0 = √(k1/m1), "
        "zeta = c/(2 m1 Omega0), F_b = mu (m1 + m2) g; a shared group is listed once."
    )
    return NoteTable("Nondimensional groups", caption, frame)


def _groups(run: ForcedRun, theta: Theta) -> dict[str, float]:
    p, e = run.capsule(theta)
    m1, m2, k1, k2, c, mu, v_s, G, g = (
        float(getattr(p, name)) for name in ("m1", "m2", "k1", "k2", "c", "mu", "v_s", "G", "g")
    )
    Omega0, F_b = np.sqrt(k1 / m1), mu * normal_force(m1, m2, g)
    length, of = F_b / k1, run.label
    return {
        "Omega0, rad/s": Omega0,
        "zeta": c / (2.0 * m1 * Omega0),
        "m2/m1": m2 / m1,
        "v_s / (Omega0 F_b/k1)": v_s / (Omega0 * length),
        f"k2/k1 [{run.spring}]": k2 / k1,
        f"Omega/Omega0 [{of}]": run.Omega / Omega0,
        f"P_d/F_b [{of}]": float(e.P_d) / F_b,  # pyright: ignore[reportArgumentType]
        f"G k1/F_b [{of}]": G / length,
    }


def predicted_motion(
    runs: Sequence[ForcedRun], values: Mapping[str, float], draws: Sequence[Mapping[str, float]]
) -> NoteTable:
    """Contacts and mean velocity of the capsule over the record: observed, at the point fit, 95 % band over ``draws``."""
    rows = {}
    for run in runs:
        fit = run.motion(run.local(values), np)
        span = run.time[-1] - run.time[0]
        local = [run.local(draw) for draw in draws]
        stacked = {name: np.array([theta[name] for theta in local]) for name in (local[0] if local else {})}
        sample = run.motion(stacked, np) if local else None
        seen = measured_motion(run.table)
        row: dict[str, object] = {"motion of the record": seen.label, "contacts, model": int(fit.contacts)}
        if sample is not None:
            low, high = int(np.min(sample.contacts)), int(np.max(sample.contacts))
            row["contacts, draws"] = f"{low}" if low == high else f"{low} to {high}"
        row["mean velocity, model, mm/s"] = 1e3 * float(fit.X2[-1]) / span
        if sample is not None:
            band = np.quantile(1e3 * np.asarray(sample.X2)[:, -1] / span, [0.025, 0.975])
            row["95 % band, mm/s"] = f"{band[0]:.4g} to {band[1]:.4g}"
        if "x_capsule" in run.channels:
            place = run.values[run.channels.index("x_capsule")]
            row["mean velocity, record, mm/s"] = 1e3 * float(np.mean(place[-5:]) - np.mean(place[:5])) / span
        rows[run.label] = row
    caption = (
        "Over the record, from its first sample to its last; the record's velocity from five samples at either end."
    )
    return NoteTable(
        "Motion predicted and observed", caption, pd.DataFrame.from_dict(rows, orient="index").rename_axis("run")
    )


def smoothing_certificate(target: LogPosterior, fit: PointFit, widths: Smoothing | None = None) -> NoteTable:
    """By how much a fit of the smoothed model would differ from this one, in posterior sd, at ``widths``.

    One Gauss–Newton step: the difference of the residuals of both models, through the exact model's Jacobian. ``widths``
    None: the certified ones.
    """
    widths = widths or Smoothing()
    shift, sd = smoothing_shift(target, fit, widths)
    located = np.flatnonzero(~target.scatter)
    rows = {target.names[i]: [d, s, d / s] for i, d, s in zip(located, shift, sd, strict=True)}
    frame = pd.DataFrame.from_dict(rows, orient="index", columns=["shift of u", "sd of u", "shift / sd"])
    frame = frame.loc[[name for name in frame.index if target.parameters[target.names.index(name)].physical]]
    caption = (
        f"The posterior is the exact model's. Had the smoothed model been fitted (velocity {widths.velocity:g} m/s, "
        f"penetration {widths.penetration:g} m), the estimates would have moved by this much (u: logarithm)."
    )
    return NoteTable("What smoothing would do", caption, frame.rename_axis("parameter"))


@eqx.filter_jit
def _evaluate(residual: HeldResiduals, v: Any) -> Any:
    return residual(v)


def smoothing_shift(target: LogPosterior, fit: PointFit, widths: Smoothing) -> tuple[np.ndarray, np.ndarray]:
    """(d_located,) shift of u between a fit with the smoothed model of ``widths`` and the exact one, and the sd of u."""
    located = np.flatnonzero(~target.scatter)
    smoothed = [e.with_smoothing(widths) if isinstance(e, CapsuleForward) else e for e in target.experiments]
    free, centre = tuple(int(i) for i in located), jnp.asarray(fit.u)
    other = LogPosterior(target.rig, smoothed)
    misses = _evaluate(HeldResiduals(other.structure, free, other.numbers, centre), centre[located])
    exact, jacobian = linearised(HeldResiduals(target.structure, free, target.numbers, centre), fit.u[located])
    normal = jacobian.T @ jacobian
    step = -np.linalg.solve(normal, jacobian.T @ (np.asarray(misses) - exact))
    return step, np.sqrt(np.diag(np.linalg.inv(normal)))
