"""The tables of the report: those that the experiments declare, and those about the fit as a whole."""

import pandas as pd

from capsule_id.inference.checks.setting import Setting
from capsule_id.inference.checks.verdict import declared
from capsule_id.inference.fit.point_stage import BenchFit
from capsule_id.inference.tables.run_notes import precision_gained, smoothing_certificate
from capsule_id.inference.target.log_posterior import LogPosterior
from capsule_id.views import NoteTable


def make_notes(setting: Setting, bench_fit: BenchFit) -> list[NoteTable]:
    """All tables; those about bench and runs together where there are runs."""
    target, fit = setting.target, setting.fit
    of_runs, of_bench = (
        [table for maker in declared(setting.experiments, "tables", bench) for table in maker(setting)]
        for bench in (False, True)
    )
    if any(not e.bench for e in setting.experiments):
        gained = precision_gained(target, fit, setting.posterior, bench_fit)
        of_runs = [gained, *of_runs, smoothing_certificate(target, fit)]
    return [*of_runs, *of_bench, prior_table(target)]


def prior_table(target: LogPosterior) -> NoteTable:
    """Every parameter with its prior, SI."""
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
