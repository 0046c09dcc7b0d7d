"""Data of a finished fit that checks and tables read."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from capsule_id.experiments.base import Experiment
from capsule_id.experiments.checks.context import Tension
from capsule_id.inference.checks.tension import tension
from capsule_id.inference.fit.point_stage import BenchFit
from capsule_id.inference.result import PointFit, Posterior
from capsule_id.inference.target.log_posterior import LogPosterior
from capsule_id.rig.model import Rig
from capsule_id.views import Finding

if TYPE_CHECKING:
    from capsule_id.inference.checks.model_error.widening import Widening


@dataclass(frozen=True)
class SampledFit:
    """A point fit, its sample (None where nothing was sampled) and its findings so far.

    See ``capsule_id.experiments.checks.context.Fitted``.

    Attributes
    ----------
    bench : fit of the bench tests alone, where runs were fitted too
    seed : seed of the starting points of further point fits
    widened : error of the model by name of the parameter, where a check failed
    """

    target: LogPosterior
    fit: PointFit
    posterior: Posterior | None
    values: Mapping[str, float]
    draws: Sequence[Mapping[str, float]] = ()
    seed: int = 0
    flagged: Mapping[str, Sequence[int]] = field(default_factory=dict)
    findings: Sequence[Finding] = ()
    bench: BenchFit = field(default_factory=BenchFit)
    widened: Mapping[str, "Widening"] = field(default_factory=dict)

    @property
    def rig(self) -> Rig:
        return self.target.rig

    @property
    def experiments(self) -> tuple[Experiment, ...]:
        return self.target.experiments

    def tension(self, one: Sequence[Experiment], other: Sequence[Experiment]) -> Tension:
        return tension(self.rig, one, other)

    def correlation(self, names: Sequence[str]) -> np.ndarray:
        if self.draws:
            return np.atleast_2d(np.corrcoef([[draw[name] for draw in self.draws] for name in names]))
        chosen = [self.target.names.index(name) for name in names]
        sd = np.sqrt(np.diag(self.fit.covariance))[chosen]
        return self.fit.covariance[np.ix_(chosen, chosen)] / np.outer(sd, sd)
