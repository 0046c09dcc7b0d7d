"""Tables of the report: those of the experiments and those of the whole fit."""

from collections.abc import Mapping

import pandas as pd

from capsule_id.inference.checks.sampled_fit import SampledFit
from capsule_id.inference.checks.verdict import declared
from capsule_id.inference.result import PointFit
from capsule_id.inference.tables.run_notes import precision_gained, smoothing_certificate
from capsule_id.inference.target.log_posterior import LogPosterior
from capsule_id.views import ResultTable


def make_notes(sampled: SampledFit, predictive: Mapping[str, float | None]) -> list[ResultTable]:
    """Return all tables; those that compare bench tests and runs only where there are runs.

    They need derivatives, which say little where residuals have kinks: then they are left out.

    Parameters
    ----------
    predictive : posterior predictive p-values by label; without a sample there is no such table
    """
    target, fit = sampled.target, sampled.fit
    of_runs, of_bench = (
        [table for maker in declared(sampled.experiments, "tables", bench) for table in maker(sampled)]
        for bench in (False, True)
    )
    kinked = any(e.has_joint_scatters for e in sampled.experiments)
    if any(not e.bench for e in sampled.experiments) and not kinked:
        gained = precision_gained(target, fit, sampled.posterior, sampled.bench)
        of_runs = [gained, *of_runs, smoothing_certificate(target, fit)]
    tables = [*of_runs, *of_bench, *([] if kinked else share_table(target, fit)), prior_table(target)]
    return [*tables, predictive_table(sampled, predictive)] if sampled.draws else tables


def share_table(target: LogPosterior, fit: PointFit) -> list[ResultTable]:
    """The two largest inputs of the variance of every physical parameter; [] for a fit without shares."""
    rows = {}
    for name in (row.name for row in target.parameters if row.physical and row.name in fit.shares):
        (first, share), (second, other), *_ = sorted(fit.shares[name].items(), key=lambda item: -item[1])
        rows[name] = [first, share, second, other]
    frame = pd.DataFrame.from_dict(
        rows, orient="index", columns=["largest input", "share", "second input", "share of it"]
    )
    return [ResultTable("parameters.shares", frame.round(3).rename_axis("parameter"))] * bool(rows)


def prior_table(target: LogPosterior) -> ResultTable:
    """Every parameter with its prior, SI."""
    rows = [
        {"parameter": row.name, "unit": row.unit, "meaning": row.meaning, "prior (SI)": row.prior.describe()}
        for row in target.parameters
        if row.prior is not None
    ]
    return ResultTable("parameters.priors", pd.DataFrame(rows).set_index("parameter"))


def predictive_table(sampled: SampledFit, predictive: Mapping[str, float | None]) -> ResultTable:
    """Posterior predictive p-value of every experiment, those on the shared friction panel included."""
    rows = {e.label: (e.kind, e.n, predictive[e.label]) for e in sampled.experiments}
    frame = pd.DataFrame.from_dict(rows, orient="index", columns=["kind", "readings", "p"])
    return ResultTable("readings.predictive", frame.rename_axis("experiment"))
