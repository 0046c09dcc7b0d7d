"""The whole path from a rig to a result: experiments, log-posterior, point fit, sample, checks."""

import platform
from collections.abc import Mapping, Sequence
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path

import numpy as np
import pandas as pd

from capsule_id.console import OnProgress
from capsule_id.experiments import compare, make_experiments, paper_estimates
from capsule_id.experiments.base import Experiment
from capsule_id.experiments.forced_run.experiment import ForcedRun
from capsule_id.inference.checks.experiment_checks import Setting
from capsule_id.inference.checks.run_checks import check_agreement, check_runs
from capsule_id.inference.checks.verdict import informed, run_checks
from capsule_id.inference.fit.point_stage import BenchFit, fit_points
from capsule_id.inference.result import PointFit, Posterior, Result
from capsule_id.inference.sampling.ensembles import DEFAULT_BUDGET, sample
from capsule_id.inference.tables.notes import make_notes
from capsule_id.inference.tables.run_notes import run_notes, run_records
from capsule_id.inference.target.log_posterior import LogPosterior
from capsule_id.inference.target.marginal import MarginalPosterior
from capsule_id.parameters import Parameter, parameter
from capsule_id.rig.model import Rig
from capsule_id.views import Comparison, Finding, NoteTable

#: Posterior draws behind bands and predictive p-values, and behind the pointwise log-likelihood.
BAND_DRAWS = 200
PRIOR_DRAWS = 2000
#: Pointwise log-likelihoods kept: of every walker's last draw, or of fewer walkers where there are many readings.
POINTWISE_SIZE = 2_000_000
PACKAGES = ("capsule-id", "numpy", "scipy", "jax", "optimistix", "emcee", "pandas", "matplotlib", "xarray")


def fit_rig(
    rig: Rig,
    seed: int = 0,
    which: str = "all",
    budget: int | None = DEFAULT_BUDGET,
    store: Path | None = None,
    progress: OnProgress | None = None,
) -> Result:
    """Fit ``rig``.

    Parameters
    ----------
    seed : every random number follows from it
    which : "bench", "runs" or "all" experiments
    budget : emcee steps of an ensemble; None draws no sample
    store : HDF5 file for the chains while they run; the draws in its saved copy are taken up
    progress : see ``capsule_id.inference.sampling.ensembles.sample``

    Raises
    ------
    InputError
        If the rig holds nothing to fit.
    """
    seeds = [int(s) for s in np.random.SeedSequence(seed).generate_state(3)]
    if progress:
        progress(0, 1, "point fit")
    stage = fit_points(rig, make_experiments(rig, which), seeds[0], sampled=budget is not None)
    target, point, bench = stage.target, stage.fit, stage.bench
    experiments = target.experiments
    posterior = None
    if budget is not None:
        posterior = sample(MarginalPosterior(target, point), seeds[1], budget, store, progress)
    values = {**target.fixed, **point.values}
    setting = Setting(rig, experiments, target, point, posterior, values)
    findings, flagged = run_checks(setting)
    findings += [*stage.findings, *_check_together(setting, bench)]
    rng = np.random.default_rng(seeds[2])
    draws = _draws(target, posterior)
    p_values = {e.label: e.predictive_p([e.local(d) for d in draws], rng) for e in experiments}
    tables = _tables(rig, target, point, posterior, experiments)
    return Result(
        rig=rig,
        summary=tables["physical"],
        nuisances=tables["nuisance"],
        point_fit=point,
        posterior=posterior,
        findings=tuple(findings),
        comparisons=_comparisons(experiments, values, draws, flagged, p_values),
        notes=(
            *run_notes(target, point, posterior, bench, draws),
            *make_notes(setting, findings, flagged, seeds[0]),
            *_predictive(experiments, p_values),
        ),
        provenance=_provenance(rig, seed, which),
        groups=_groups(target, experiments, posterior, rng),
        records=run_records(target, point),
    )


def _check_together(s: Setting, bench: BenchFit) -> list[Finding]:
    """Findings on forced runs, and on runs and bench together; [] without runs."""
    runs = [e for e in s.experiments if isinstance(e, ForcedRun)]
    if not runs:
        return []
    return [*check_agreement(s.target, s.fit, bench.fit, bench.sample), *check_runs(runs, s.values)]


def _provenance(rig: Rig, seed: int, which: str) -> dict[str, object]:
    return {"seed": seed, "experiments": which, "versions": package_versions(PACKAGES), "files": dict(rig.files)}


def package_versions(packages: Sequence[str]) -> dict[str, str]:
    """Versions of Python and of ``packages``, as installed."""
    return {"python": platform.python_version(), **{name: version(name) for name in packages}}


def _draws(target: LogPosterior, posterior: Posterior | None) -> list[dict[str, float]]:
    """``BAND_DRAWS`` draws, evenly spaced over the sample, by parameter name."""
    if posterior is None:
        return []
    flat = posterior.draws.reshape(-1, len(posterior.names))
    return [target.mapping(flat[i]) for i in np.linspace(0, len(flat) - 1, BAND_DRAWS).astype(int)]


def _comparisons(
    experiments: Sequence[Experiment],
    values: Mapping[str, float],
    draws: list[dict[str, float]],
    flagged: Mapping[str, list[int]],
    p_values: Mapping[str, float | None],
) -> tuple[Comparison, ...]:
    """Panels with flagged rows marked and predictive p-values filled in."""
    panels = []
    for panel in compare(experiments, values, draws):
        points = []
        for part in panel.points:
            mask = np.zeros(len(part.x), dtype=bool)
            mask[flagged.get(part.label, [])] = True
            points.append(replace(part, flagged=mask))
        panels.append(replace(panel, points=tuple(points), predictive_p=p_values.get(panel.label)))
    return tuple(panels)


def _predictive(experiments: Sequence[Experiment], p_values: Mapping[str, float | None]) -> list[NoteTable]:
    """Posterior predictive p-value of every experiment, those on the shared friction panel included; [] without draws."""
    rows = {e.label: (e.kind, e.n, p_values[e.label]) for e in experiments if p_values[e.label] is not None}
    if not rows:
        return []
    frame = pd.DataFrame.from_dict(rows, orient="index", columns=["kind", "readings", "p"]).rename_axis("experiment")
    caption = (
        "Chance that a replicate would miss the model by more than the readings do (chi-square discrepancy). Near 0: the "
        "readings scatter more than the fit allows; where the scatter itself is estimated, it is near 0.5 by construction."
    )
    return [NoteTable("Posterior predictive checks", caption, frame)]


def _tables(
    rig: Rig, target: LogPosterior, point: PointFit, posterior: Posterior | None, experiments: Sequence[Experiment]
) -> dict[str, pd.DataFrame]:
    """The parameter table and the nuisance table; see ``Result``."""
    paper = paper_estimates(experiments)
    paper |= {name: mass.value for name, mass in (("m1", rig.m1), ("m2", rig.m2)) if mass is not None}
    known = informed(target, posterior, point)
    rows: list[tuple[Parameter, dict[str, object]]] = []
    for i, row in enumerate(target.parameters):
        entry: dict[str, object] = {
            "unit": row.unit,
            "meaning": row.meaning,
            "paper": paper.get(row.name, np.nan),
            "map": point.values[row.name],
            "standard_error": point.standard_errors[row.name],
            "informed": bool(known[i]),
        }
        if posterior is not None:
            entry |= _sample_columns(posterior, i)
        rows.append((row, entry))
    for symbol in ("m1", "m2"):
        if symbol in target.fixed:
            value = target.fixed[symbol]
            exact = {"paper": value, "map": value, "standard_error": 0.0, "mean": value, "sd": 0.0, "median": value}
            row = parameter(symbol)
            entry = {"unit": row.unit, "meaning": f"{row.meaning} (exact)", "informed": True, **exact}
            rows.append((row, entry | {"lower": value, "upper": value}))
    tables = {}
    for role in ("physical", "nuisance"):
        chosen = {row.name: entry for row, entry in rows if row.physical == (role == "physical")}
        columns = [
            "unit", "meaning", "paper", "map", "standard_error", "mean", "sd", "median", "lower", "upper", "ess", "rhat",
            "informed",
        ]  # fmt: skip
        frame = pd.DataFrame.from_dict(chosen, orient="index").reindex(columns=columns)
        tables[role] = frame.rename_axis("name")
    return tables


def _sample_columns(posterior: Posterior, i: int) -> dict[str, object]:
    draws = posterior.draws[..., i].ravel()
    lower, median, upper = np.quantile(draws, [0.025, 0.5, 0.975])
    return {
        "mean": np.mean(draws),
        "sd": np.std(draws, ddof=1),
        "median": median,
        "lower": lower,
        "upper": upper,
        "ess": posterior.ess[i],
        "rhat": posterior.rhat[i],
    }


def _groups(
    target: LogPosterior, experiments: Sequence[Experiment], posterior: Posterior | None, rng: np.random.Generator
) -> dict[str, object]:
    """What goes into posterior.nc beside the draws. The pointwise densities are those of every walker's last draw."""
    fixed = {name: value for name, value in target.fixed.items() if name != "g"}
    groups: dict[str, object] = {"fixed": fixed, "observed": {e.label: e.observed for e in experiments}}
    groups["prior"] = target.sample_prior(rng, PRIOR_DRAWS)
    if posterior is not None:
        ensembles, draws, walkers, _ = posterior.draws.shape
        every = max(1, ensembles * walkers * sum(e.n for e in experiments) // POINTWISE_SIZE)
        chains = np.arange(0, ensembles * walkers, every)
        last = posterior.draws[:, -1].reshape(ensembles * walkers, -1)[chains]
        values = [target.mapping(theta) for theta in last]
        groups["log_likelihood"] = {
            e.label: np.stack([e.pointwise(e.local(v), rng) for v in values])[:, None] for e in experiments
        }
        groups["log_likelihood_chain"] = chains
        groups["log_likelihood_draw"] = np.array([draws - 1])
    return groups
