"""Small tables of the report: estimator beside estimator, with and without flagged rows, damping models, priors."""

from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd

from capsule_id.experiments.free_vibration.experiment import FreeVibration
from capsule_id.experiments.line import Line
from capsule_id.experiments.linear import LOG_2PI
from capsule_id.experiments.support_spring.experiment import SupportSpring
from capsule_id.inference.checks.experiment_checks import LEVEL, Setting, stiffness_by_record, whiteness
from capsule_id.inference.checks.regression import refit
from capsule_id.inference.fit.point_fit import point_fit
from capsule_id.inference.result import PointFit
from capsule_id.inference.target.log_posterior import LogPosterior
from capsule_id.views import Finding, NoteTable

#: The damping models that are compared when the residuals of a decay are not white.
DAMPING_MODELS = ("viscous", "dry", "quadratic")
_VERDICTS = {
    "viscous": "Neither dry nor quadratic damping describes the decays better than viscous damping alone.",
    "dry": "Dry friction beside the viscous damping fits best: it takes off the same amount every cycle.",
    "quadratic": "Quadratic beside viscous damping fits best: the damping grows with amplitude.",
}


def make_notes(
    setting: Setting, findings: Sequence[Finding], flagged: Mapping[str, list[int]], seed: int
) -> list[NoteTable]:
    """The tables that this fit calls for."""
    records = [e for e in setting.experiments if isinstance(e, FreeVibration) and not e.event_driven]
    lines = [e for e in setting.experiments if isinstance(e, Line)]
    notes = []
    if records:
        notes.append(_decays(records, setting.values))
    labels = {record.label for record in records}
    if any(f.check == "residuals white" and f.level == "fail" and f.experiment in labels for f in findings):
        notes.append(damping_models(setting, records, seed))
    if lines:
        notes.append(_lines(lines, setting.values, flagged))
    notes.append(_priors(setting.target))
    return notes


def _decays(records: Sequence[FreeVibration], values: Mapping[str, float]) -> NoteTable:
    k1, k1_sd, deflection = stiffness_by_record(records, values)
    rows = []
    for i, record in enumerate(records):
        raw, smooth = record.paper_decrement(smooth=False), record.paper_decrement()
        ours = refit(record, record.local(values), [])
        rows.append(
            {
                "record": record.label,
                "largest deflection, m": deflection[i],
                "k1, N/m": k1[i],
                "± k1": k1_sd[i],
                "c, N s/m": ours["c"][0],
                "± c": ours["c"][1],
                "k1 = m1Ω_o²": smooth.k1 if smooth else np.nan,
                "c, smoothed peaks": smooth.c if smooth else np.nan,
                "c, raw peaks": raw.c if raw else np.nan,
            }
        )
    caption = (
        "Each record alone, by least squares on the whole raw record, beside the paper's protocol. The paper's k1 is low "
        "by ζ² (it takes the damped frequency for the natural one); its c depends on how peaks are read out of noise."
    )
    return NoteTable("Free vibration, record by record", caption, pd.DataFrame(rows).set_index("record"))


def damping_models(setting: Setting, records: Sequence[FreeVibration], seed: int) -> NoteTable:
    """The decays alone under each damping model: what each would give, ranked by BIC."""
    rows = []
    for damping in DAMPING_MODELS:
        target = LogPosterior(setting.rig, [record.with_damping(damping) for record in records])
        fit = point_fit(target, seed)
        values = target.mapping(target.theta(fit.u))
        white = all(whiteness(e, values)[1] * len(records) >= LEVEL for e in target.experiments)
        extra = [name for name in ("F_dry", "c_q") if name in fit.values]
        rows.append(
            {
                "damping": damping,
                "k1, N/m": fit.values["k1"],
                "c, N s/m": fit.values["c"],
                "further": ", ".join(
                    f"{name} = {fit.values[name]:.4g} ± {fit.standard_errors[name]:.2g}" for name in extra
                ),
                "noise, m": float(np.mean([fit.values[f"noise_sd[{record.label}]"] for record in records])),
                "BIC": bic(target, fit),
                "residuals white": "yes" if white else "no",
                "starts agree": "yes" if fit.agree else "no",
            }
        )
    frame = pd.DataFrame(rows).set_index("damping")
    frame["BIC"] -= frame["BIC"].min()
    best = str(frame["BIC"].idxmin())
    verdict = _VERDICTS[best]
    if "yes" not in frame["residuals white"].tolist():
        verdict += " None of the three leaves white residuals, so something else is at work beside the damping."
    caption = (
        "The damping model asked for leaves structure in the residuals; here are all three, fitted to the decays alone. BIC "
        f'is relative to the best. {verdict} Ask for a model with damping = "viscous", "dry" or "quadratic".'
    )
    return NoteTable("Damping models compared", caption, frame)


def bic(target: LogPosterior, fit: PointFit) -> float:
    """Schwarz's criterion p log n - 2 log L at the point fit, linear nuisances at their best and counted in p.

    Likelihoods that have integrated out different numbers of nuisances must not be compared by it: each integral
    brings its own Occam factor.
    """
    values = target.mapping(target.theta(fit.u))
    unknowns, readings, deviance = target.dimension, 0, 0.0
    for e in target.experiments:
        theta = e.local(values)
        misfit, rest = e.misfit(theta), np.asarray(e.residuals(theta, np))[: e.n]
        deviance += float(rest @ rest + e.n * LOG_2PI + 2.0 * np.sum(np.log(misfit.sd)))
        unknowns += misfit.design.shape[1]
        readings += e.n
    return unknowns * float(np.log(readings)) + deviance


def _lines(lines: Sequence[Line], values: Mapping[str, float], flagged: Mapping[str, list[int]]) -> NoteTable:
    rows = []
    for e in lines:
        left_out = flagged.get(e.label, [])
        value, sd = refit(e, e.local(values), [])[e.slope.symbol]
        row: dict[str, object] = {
            "table": e.label,
            "slope": f"{e.slope.name}, {e.slope.unit}",
            "all rows": value,
            "±": sd,
            "ordinary line": e.ordinary_line()[0],
        }
        if flagged:
            without = refit(e, e.local(values), left_out)[e.slope.symbol] if left_out else (np.nan, np.nan)
            row |= {"without flagged rows": without[0], "± without": without[1]}
        if isinstance(e, SupportSpring) and e.length is not None:
            row |= {"length, m": e.length.value}
        rows.append(row | {"errors": e.errors})
    caption = (
        "Slopes by generalised least squares; the ordinary line is the paper's. Flagged rows are shown, not dropped."
    )
    return NoteTable("Calibration lines", caption, pd.DataFrame(rows).set_index("table"))


def _priors(target: LogPosterior) -> NoteTable:
    rows = [
        {"parameter": row.name, "unit": row.unit, "meaning": row.meaning, "prior (SI)": row.prior.describe()}
        for row in target.parameters
        if row.prior is not None
    ]
    caption = (
        "Every prior is proper; a factor f holds 95 % within median/f to median×f. Amplitudes, offsets and intercepts have "
        "normal priors ten times as wide as their record and are integrated out in closed form."
    )
    return NoteTable("Priors", caption, pd.DataFrame(rows).set_index("parameter"))
