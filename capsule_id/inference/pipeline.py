"""Stages from a rig to a result. Each stage returns a frozen value computed from the previous one.

    kinds = default_registry()                                   # kinds of experiments
    rig = read_rig(folder, kinds)                                # folder -> Rig
    seeds = stage_seeds(0)
    before = check_readings(rig, "all", kinds)                   # Rig -> findings on the readings
    stated = make_experiments(rig, "all", kinds)                 # Rig -> experiments as stated
    experiments, second = second_models(stated, before)          # ... -> with the models that they demand
    target = LogPosterior(rig, experiments)                      # experiments -> log-posterior
    point = fit_points(target, kinds, seeds.starts, True)        # log-posterior -> point fit
    sampled = sample_posterior(point, seeds.walkers)             # point fit -> posterior
    checked = check_fit(sampled, (*before, *second))              # posterior -> checks
    result = make_result(checked, kinds, seeds.report, provenance(rig, 0, "all", "eq. (1)"))

``capsule_id.fit`` runs all stages.
"""

import platform
from collections.abc import Mapping, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import NamedTuple, TypeVar

import numpy as np

from capsule_id.console import OnProgress, stop_if_interrupted
from capsule_id.experiments.base import Experiment
from capsule_id.experiments.kind import Choice, Registry, compare, select_tables
from capsule_id.experiments.lint import lint
from capsule_id.inference.checks.posterior import check_agreement, decisive_readings
from capsule_id.inference.checks.verdict import model_errors, run_checks, with_scaled
from capsule_id.inference.marginal import MarginalPosterior, left_out
from capsule_id.inference.point_fit import point_fit_again
from capsule_id.inference.point_stage import SampledFit
from capsule_id.inference.result import PointFit, Pointwise, Posterior, Provenance, Result
from capsule_id.inference.sampling import DEFAULT_BUDGET, DEFAULT_ESS, sample
from capsule_id.inference.tables import check_engine, make_notes, parameter_tables
from capsule_id.inference.target import LogPosterior
from capsule_id.rig.model import Rig
from capsule_id.synthetic import truth_beside
from capsule_id.views import SYMPTOMS, Comparison, Finding

#: Number of posterior draws for bands and predictive p-values, and of prior draws in the saved sample.
BAND_DRAWS, PRIOR_DRAWS = 200, 2000
#: Walkers, and draws of each, at which densities of left-out readings are stored; the largest number of stored replicates.
POINTWISE, REPLICATES = 32, 1_000_000
#: Steps of the stored densities (natural logarithm) and replicates (in sd of a reading): a file packs rounded numbers to
#: a third. The step of a replicate adds 0.002 % to its variance.
DENSITY_STEP, REPLICATE_STEP = 2.0**-16, 2.0**-6
#: Packages whose versions the provenance records.
PACKAGES = ("capsule-id", "numpy", "scipy", "jax", "optimistix", "emcee", "pandas", "matplotlib", "xarray")

AnyResult = TypeVar("AnyResult", bound=Result)


class StageSeeds(NamedTuple):
    """Seeds of each stage: starting points of the point fit, walkers, draws for checks and files."""

    starts: int
    walkers: int
    report: int


def stage_seeds(seed: int) -> StageSeeds:
    """Return the seeds of the stages of a fit with ``seed``."""
    return StageSeeds(*(int(s) for s in np.random.SeedSequence(seed).generate_state(3)))


def check_readings(rig: Rig, experiments: Choice, registry: Registry) -> tuple[Finding, ...]:
    """Return findings on the readings that ``experiments`` selects, before anything is fitted."""
    return lint(rig, registry, select_tables(rig, experiments))


def second_models(
    stated: Sequence[Experiment], readings: Sequence[Finding] = ()
) -> tuple[tuple[Experiment, ...], tuple[Finding, ...]]:
    """Replace models that the readings contradict and the settings leave open; findings name the new models.

    A kind may keep the model of a record for which ``readings``, the findings on the readings, hold a failure.
    """
    chosen, findings = list(stated), list[Finding]()
    for kind in dict.fromkeys(type(e) for e in stated):
        own = [i for i, e in enumerate(stated) if type(e) is kind]
        replaced, found = kind.second_models([stated[i] for i in own], readings)
        findings += found
        for i, experiment in zip(own, replaced, strict=True):
            chosen[i] = experiment
    return tuple(chosen), tuple(findings)


def sample_posterior(
    point: SampledFit,
    seed: int,
    budget: int | None = DEFAULT_BUDGET,
    store: Path | None = None,
    progress: OnProgress | None = None,
    ess: float = DEFAULT_ESS,
) -> SampledFit:
    """Sample the posterior; return the point fit with its sample and ``BAND_DRAWS`` draws, evenly spaced, without checks.

    Parameters
    ----------
    budget : emcee steps of an ensemble after burn-in; None draws no sample
    store : file for a copy of the chains every few seconds; sampling resumes from the draws in it
    progress, ess : see ``capsule_id.inference.sampling.sample``
    """
    if budget is None:
        return point
    target = point.target
    posterior = sample(MarginalPosterior(target, point.fit), seed, budget, store, progress, ess)
    fit = higher_maximum(point, posterior)
    flat = posterior.draws.reshape(-1, target.dimension)
    draws = [target.mapping(flat[i]) for i in np.linspace(0, len(flat) - 1, BAND_DRAWS).astype(int)]
    return replace(point, fit=fit, posterior=posterior, values={**target.fixed, **fit.values}, draws=draws)


def higher_maximum(point: SampledFit, posterior: Posterior) -> PointFit:
    """Go on with the point fit from the best draw where the sample has found a higher point than its starts did.

    Fits of forced runs stay as they are: they take minutes, and ``check_maximum`` reports the difference.
    """
    best = np.unravel_index(np.argmax(posterior.lp), posterior.lp.shape)
    if posterior.lp[best] <= np.max(point.fit.log_posterior) or any(e.event_driven for e in point.target.experiments):
        return point.fit
    again = point_fit_again(point.target, point.fit, point.target.unconstrain(posterior.draws[best]))
    return again if np.max(again.log_posterior) > np.max(point.fit.log_posterior) else point.fit


def check_fit(sampled: SampledFit, before: Sequence[Finding] = ()) -> SampledFit:
    """Run all checks: return ``sampled`` with all findings and flagged outliers.

    The findings include those of the point fit and ``before``, those on the readings.
    """
    stop_if_interrupted()
    before = [with_scaled(finding, sampled.experiments) for finding in before]
    checked = run_checks(replace(sampled, findings=before))
    findings = [*before, *checked.findings, *sampled.findings, *check_agreement(sampled), *check_engine(sampled)]
    widened = model_errors(replace(checked, findings=findings))
    for lost in (False, True):
        factors = [
            (name, one.factor, one.parts) for name, one in widened.items() if one.parts and one.no_number == lost
        ]
        if factors:
            names = tuple(name for name, *_ in factors) if lost else ()
            findings.append(Finding("model.error", "fail" if lost else "warn", {"factors": factors}, parameters=names))
    # Causes first, and of these what the readings show by themselves.
    # Of what fails without a named cause the most telling comes first.
    told = {code: place for place, code in enumerate(SYMPTOMS)}
    findings.sort(
        key=lambda found: (
            not found.cause,
            found.cause and found.level == "warn",
            told.get(found.code, len(told)) if found.level == "fail" else len(told),
        )
    )
    return replace(checked, widened=widened, findings=tuple(findings))


def unfinished(point: SampledFit, before: Sequence[Finding] = ()) -> SampledFit:
    """Check the point fit alone, while the sample is still to be drawn; ``before`` as in ``check_fit``."""
    checked = check_fit(point, before)
    findings = [Finding("sample.unfinished", "warn") if f.code == "chains.converged" else f for f in checked.findings]
    return replace(checked, findings=tuple(findings))


def make_result(
    checked: SampledFit,
    registry: Registry,
    seed: int,
    made_from: Provenance,
    kind: type[AnyResult] = Result,
    *,
    panels: bool = True,
    profiled: Sequence[str] = (),
) -> AnyResult:
    """Assemble the result: tables, panels, records, and the arrays that are saved with the sample.

    The versions in its provenance include those of the packages in ``registry``.

    Parameters
    ----------
    kind : class of the result; the interface passes a subclass with a method that writes it
    panels : False leaves out panels, notes and records, which take most of the time
    profiled : names of the parameters whose profile likelihoods are computed
    """
    stop_if_interrupted()
    target, posterior = checked.target, checked.posterior
    rng = np.random.default_rng(seed)
    predictive = {e.label: e.predictive_p([e.local(d) for d in checked.draws], rng) for e in target.experiments}
    summary, nuisances = parameter_tables(checked, registry)
    pointwise, findings = None, tuple(checked.findings)
    if posterior is not None:
        pointwise = _pointwise(target, posterior, rng)
        findings = (*findings, decisive_readings(pointwise, posterior.draws))
    views = (e.record_view(e.local(checked.values)) for e in target.experiments if panels)
    return kind(
        rig=target.rig,
        registry=registry,
        summary=summary,
        nuisances=nuisances,
        point_fit=checked.fit,
        posterior=posterior,
        findings=findings,
        comparisons=_comparisons(checked, predictive, registry) if panels else (),
        notes=tuple(make_notes(checked, predictive, profiled)) if panels else (),
        records=tuple(view for view in views if view is not None),
        fixed={name: value for name, value in target.fixed.items() if name != "g"},
        observed={e.label: e.observed for e in target.experiments},
        prior=target.sample_prior(rng, PRIOR_DRAWS),
        pointwise=pointwise,
        provenance=replace(made_from, versions={**made_from.versions, **registry.packages}),
        truth=truth_beside(target.rig),
    )


def provenance(rig: Rig, seed: int, experiments: Choice, friction: str) -> Provenance:
    """Return the provenance of a fit of ``rig`` with ``seed`` and these ``experiments``, made now by ``capsule_id.fit``."""
    rejected = {table.label: table.rejected for table in rig.tables if table.rejected}
    made = datetime.now(UTC).isoformat(timespec="seconds"), "capsule_id.fit"
    versions = package_versions(PACKAGES)
    return Provenance(seed, experiments, friction, versions, dict(rig.files), rejected, rig.model.engine, made)


def package_versions(packages: Sequence[str]) -> dict[str, str]:
    """Versions of Python and of ``packages``, as installed."""
    return {"python": platform.python_version(), **{name: version(name) for name in packages}}


def _comparisons(
    checked: SampledFit, predictive: Mapping[str, float | None], registry: Registry
) -> tuple[Comparison, ...]:
    """Return the panels, with flagged rows and predictive p-values."""
    panels = []
    for panel in compare(checked.experiments, checked.values, checked.draws, registry):
        points = tuple(
            replace(part, flagged=np.isin(np.arange(len(part.x)), checked.flagged.get(part.label, [])))
            for part in panel.points
        )
        panels.append(replace(panel, points=points, predictive_p=predictive.get(panel.label)))
    return tuple(panels)


def _pointwise(target: LogPosterior, posterior: Posterior, rng: np.random.Generator) -> Pointwise:
    """Densities of left-out readings on an even grid of walkers and stored draws, replicates on a coarser one."""
    ensembles, draws, walkers, d = posterior.draws.shape
    draw = np.unique(np.linspace(0, draws - 1, POINTWISE).astype(int))
    # A short run has fewer draws, but more walkers.
    chain = np.unique(np.linspace(0, ensembles * walkers - 1, -(-(POINTWISE**2) // len(draw))).astype(int))
    readings = sum(e.n for e in target.experiments)
    thin = max(2, round((len(chain) * len(draw) * readings / REPLICATES) ** 0.5))
    by_chain = posterior.draws.transpose(0, 2, 1, 3).reshape(ensembles * walkers, draws, d)[np.ix_(chain, draw)]
    some = [target.mapping(theta) for theta in by_chain[::thin, ::thin].reshape(-1, d)]
    coarse = by_chain[::thin, ::thin].shape[:2]
    density, replicates = {}, {}
    for e, terms in zip(target.experiments, left_out(target, by_chain.reshape(-1, d)), strict=True):
        stop_if_interrupted()
        density[e.label] = _rounded(np.reshape(terms, (len(chain), len(draw), -1)), DENSITY_STEP)
        made = np.reshape([e.replicate(e.local(v), rng) for v in some], (*coarse, e.n))
        sd = np.std(made, axis=(0, 1))
        # A reading that never varies, as of a single replicate, stays.
        replicates[e.label] = np.where(sd > 0.0, _rounded(made, REPLICATE_STEP * np.where(sd > 0.0, sd, 1.0)), made)
    return Pointwise(density, {e.label: e.blocks(e.n) for e in target.experiments}, replicates, chain, draw, thin)


def _rounded(values: np.ndarray, step: float | np.ndarray) -> np.ndarray:
    """``values`` in whole steps, each a power of two and at most ``step``: the last bits of their numbers are 0."""
    step = np.exp2(np.floor(np.log2(step)))
    return step * np.round(values / step)
