"""The whole path from a rig to a result: experiments, log-posterior, point fit, sample, checks."""

import platform
from collections.abc import Mapping, Sequence
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path

import numpy as np
import pandas as pd

from capsule_id.console import OnProgress
from capsule_id.experiments import Choice, compare, make_experiments, paper_estimates
from capsule_id.inference.checks.agreement import check_agreement
from capsule_id.inference.checks.setting import Setting
from capsule_id.inference.checks.verdict import informed, run_checks
from capsule_id.inference.fit.point_stage import fit_points
from capsule_id.inference.result import PointFit, Posterior, Result, RunRecord
from capsule_id.inference.sampling.ensembles import DEFAULT_BUDGET, sample
from capsule_id.inference.tables.notes import make_notes
from capsule_id.inference.target.log_posterior import LogPosterior
from capsule_id.inference.target.marginal import MarginalPosterior
from capsule_id.parameters import Parameter, parameter
from capsule_id.physics.friction import FrictionLaw
from capsule_id.rig.model import Rig
from capsule_id.views import Comparison, NoteTable

#: Posterior draws behind bands and predictive p-values, and behind the pointwise log-likelihood.
BAND_DRAWS = 200
PRIOR_DRAWS = 2000
#: Pointwise log-likelihoods kept: of every walker's last draw, or of fewer walkers where there are many readings.
POINTWISE_SIZE = 2_000_000
PACKAGES = ("capsule-id", "numpy", "scipy", "jax", "optimistix", "emcee", "pandas", "matplotlib", "xarray")


def fit_rig(
    rig: Rig,
    seed: int = 0,
    experiments: Choice = "all",
    budget: int | None = DEFAULT_BUDGET,
    store: Path | None = None,
    progress: OnProgress | None = None,
    friction: type[FrictionLaw] | None = None,
) -> Result:
    """Fit ``rig``.

    Parameters
    ----------
    seed : every random number follows from it
    experiments : "bench", "runs" or "all"
    budget : emcee steps of an ensemble; None draws no sample
    store : HDF5 file for the chains while they run; the draws in its saved copy are taken up
    progress : see ``capsule_id.inference.sampling.ensembles.sample``
    friction : class of a friction law in place of eq. (1); the seventh choice, so there are more than six parameters

    Raises
    ------
    InputError
        If the rig holds nothing to fit.
    """
    seeds = [int(s) for s in np.random.SeedSequence(seed).generate_state(3)]
    if progress:
        progress(0, 1, "point fit")
    stage = fit_points(rig, make_experiments(rig, experiments, friction=friction), seeds[0], sampled=budget is not None)
    target, point = stage.target, stage.fit
    posterior = None
    if budget is not None:
        posterior = sample(MarginalPosterior(target, point), seeds[1], budget, store, progress)
    rng = np.random.default_rng(seeds[2])
    values, draws = {**target.fixed, **point.values}, _draws(target, posterior)
    setting = run_checks(Setting(target, point, posterior, values, draws, seeds[0]))
    findings = (
        *setting.findings,
        *stage.findings,
        *check_agreement(target, point, stage.bench.fit, stage.bench.sample),
    )
    tables = _tables(rig, target, point, posterior)
    predictive = {e.label: e.predictive_p([e.local(d) for d in draws], rng) for e in target.experiments}
    return Result(
        rig=rig,
        summary=tables["physical"],
        nuisances=tables["nuisance"],
        point_fit=point,
        posterior=posterior,
        findings=findings,
        comparisons=_comparisons(setting, predictive),
        notes=(*make_notes(setting, stage.bench), *_predictive(setting, predictive)),
        provenance=_provenance(rig, seed, experiments),
        groups=_groups(target, posterior, rng),
        records=_records(setting),
    )


def _records(s: Setting) -> tuple[RunRecord, ...]:
    """Every record that can be looked at through the filter."""
    views = (e.record_view(e.local(s.values)) for e in s.experiments)
    return tuple(view for view in views if view is not None)


def _provenance(rig: Rig, seed: int, experiments: str) -> dict[str, object]:
    return {"seed": seed, "experiments": experiments, "versions": package_versions(PACKAGES), "files": dict(rig.files)}


def package_versions(packages: Sequence[str]) -> dict[str, str]:
    """Versions of Python and of ``packages``, as installed."""
    return {"python": platform.python_version(), **{name: version(name) for name in packages}}


def _draws(target: LogPosterior, posterior: Posterior | None) -> list[dict[str, float]]:
    """``BAND_DRAWS`` draws, evenly spaced over the sample, by parameter name."""
    if posterior is None:
        return []
    flat = posterior.draws.reshape(-1, len(posterior.names))
    return [target.mapping(flat[i]) for i in np.linspace(0, len(flat) - 1, BAND_DRAWS).astype(int)]


def _comparisons(s: Setting, predictive: Mapping[str, float | None]) -> tuple[Comparison, ...]:
    """Panels with flagged rows marked and predictive p-values filled in."""
    panels = []
    for panel in compare(s.experiments, s.values, s.draws):
        points = []
        for part in panel.points:
            mask = np.zeros(len(part.x), dtype=bool)
            mask[s.flagged.get(part.label, [])] = True
            points.append(replace(part, flagged=mask))
        panels.append(replace(panel, points=tuple(points), predictive_p=predictive.get(panel.label)))
    return tuple(panels)


def _predictive(s: Setting, predictive: Mapping[str, float | None]) -> list[NoteTable]:
    """Posterior predictive p-value of every experiment, those on the shared friction panel included."""
    if not s.draws:
        return []
    rows = {e.label: (e.kind, e.n, predictive[e.label]) for e in s.experiments}
    frame = pd.DataFrame.from_dict(rows, orient="index", columns=["kind", "readings", "p"]).rename_axis("experiment")
    caption = (
        "Chance that a replicate would miss the model by more than the readings do (chi-square discrepancy). Near 0: the "
        "readings scatter more than the fit allows; where the scatter itself is estimated, it is near 0.5 by construction."
    )
    return [NoteTable("Posterior predictive checks", caption, frame)]


def _tables(rig: Rig, target: LogPosterior, point: PointFit, posterior: Posterior | None) -> dict[str, pd.DataFrame]:
    """The parameter table and the nuisance table; see ``Result``."""
    paper = paper_estimates(target.experiments)
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


def _groups(target: LogPosterior, posterior: Posterior | None, rng: np.random.Generator) -> dict[str, object]:
    """What goes into posterior.nc beside the draws. The pointwise densities are those of every walker's last draw."""
    experiments = target.experiments
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
