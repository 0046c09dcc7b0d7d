"""Fits nested variants of the model side by side and recommends the simplest one that predicts as well as the best."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pandas as pd

from capsule_id.console import OnProgress
from capsule_id.errors import InputError
from capsule_id.experiments import make_experiments
from capsule_id.experiments.base import Experiment
from capsule_id.experiments.progression.experiment import Progression
from capsule_id.experiments.registry import Registry
from capsule_id.inference.choice.leave_out import (
    LARGEST_SHAPE,
    WeightedDraws,
    conditional_densities,
    laplace_draws,
    leave_settings_out,
)
from capsule_id.inference.choice.variants import variants_of
from capsule_id.inference.fit.joint_fit import joint_fit
from capsule_id.inference.result import PointFit
from capsule_id.inference.target.log_posterior import LogPosterior
from capsule_id.rig.model import Column, ModelChoices, Rig, Table

#: Standard errors by which the best variant must be better for a simpler one to be rejected.
STANDARD_ERRORS = 2.0


@dataclass(frozen=True)
class Choice:
    """Nested variants of the model of a rig.

    Attributes
    ----------
    table : a row per variant (index ``variant``), the best first: parameters, log_posterior, elpd, its difference from
        the best and the standard error of the difference, shape (largest Pareto shape), refits
    recommended : the variant with the fewest parameters within two standard errors of the best
    choices : the choices of ``[model]`` by variant
    """

    table: pd.DataFrame
    recommended: str
    choices: Mapping[str, ModelChoices]

    @property
    def line(self) -> str:
        """The recommendation in words, with the lines of ``[model]``."""
        own = self.choices[self.recommended]
        free = ", ".join(f'"{symbol}"' for symbol in own.free)
        lines = f'friction = "{own.friction}", reaction = "{own.reaction}", free = [{free}]'
        row = self.table.loc[self.recommended]
        return (
            f"{self.recommended}: the simplest variant within {STANDARD_ERRORS:g} standard errors of the best "
            f"(elpd {row['difference']:.1f} ± {row['se']:.1f}). Write in [model]: {lines}"
        )


@dataclass(frozen=True)
class _Variant:
    """A fitted variant: its number of parameters, maximum, densities of the settings left out, shapes and refits."""

    parameters: int
    log_posterior: float
    density: np.ndarray
    shape: float
    refits: int


def compare_models(
    rig: Rig, words: Sequence[str], registry: Registry, seed: int = 0, progress: OnProgress | None = None
) -> Choice:
    """Fit every variant that ``words`` name and compare them by leaving out settings of the progressions.

    Parameters
    ----------
    words : some of ``capsule_id.inference.choice.variants.WORDS``
    progress : called with (variants done, variants, name of the variant)

    Raises
    ------
    InputError
        If a word is unknown, or the rig has no progression.
    """
    choices = variants_of(rig, words)
    if not any(isinstance(e, Progression) for e in make_experiments(rig, "all", registry)):
        remedy = "compare friction laws of bench tests in the report of fit-params"
        raise InputError("--compare needs a progression, whose settings are left out", "none", remedy)
    fitted = {}
    for number, (name, model) in enumerate(choices.items()):
        if progress:
            progress(number, len(choices), name)
        fitted[name] = _fit_variant(replace(rig, model=model), registry, seed)
    return _choose(fitted, choices)


def _fit_variant(rig: Rig, registry: Registry, seed: int) -> _Variant:
    target = LogPosterior(rig, make_experiments(rig, "all", registry))
    fit = joint_fit(target, {}, seed)
    draws = laplace_draws(target, fit, seed)
    density, shape, refits = [], [], 0
    for e in target.experiments:
        if not isinstance(e, Progression):
            continue
        found = leave_settings_out(target, e, draws)
        own = found.density.copy()
        for setting in np.flatnonzero(~(found.shape <= LARGEST_SHAPE)):
            own[setting] = _refitted_density(target, e, int(setting), fit, seed)
            refits += 1
        density.append(own)
        shape.append(float(np.max(found.shape)))
    value = float(np.max(fit.log_posterior))
    return _Variant(target.dimension, value, np.concatenate(density), max(shape), refits)


def _refitted_density(target: LogPosterior, e: Progression, setting: int, fit: PointFit, seed: int) -> float:
    """Log-density of the readings of ``setting`` under draws of a fit without them, from the maximum with them."""
    kept = np.flatnonzero(e.setting[:, setting] == 0.0)
    other = Progression(_rows(e.table, kept), e.rig, e.friction)
    experiments: list[Experiment] = [other if each is e else each for each in target.experiments]
    smaller = LogPosterior(target.rig, experiments)
    start = smaller.unconstrain(np.array([fit.values[name] for name in smaller.names]))
    draws = laplace_draws(smaller, joint_fit(smaller, {}, seed, starts=start[None]), seed)
    values = [e.local(target.mapping(theta)) for theta in smaller.theta(draws.u)]
    return _expected(draws, conditional_densities(e, values)[:, setting])


def _expected(draws: WeightedDraws, density: np.ndarray) -> float:
    """Log of the weighted mean of exp(density)."""
    weight = np.where(np.isfinite(draws.log_weight), draws.log_weight, -np.inf)
    finite = np.nan_to_num(density, nan=-1e9, neginf=-1e9)
    return float(np.logaddexp.reduce(weight + finite) - np.logaddexp.reduce(weight))


def _rows(table: Table, rows: np.ndarray) -> Table:
    """The table with some of its rows."""
    columns: dict[str, Column] = {
        name: replace(column, values=column.values[rows]) for name, column in table.columns.items()
    }
    return replace(table, columns=columns, rows=table.rows[rows])


def _choose(fitted: Mapping[str, _Variant], choices: Mapping[str, ModelChoices]) -> Choice:
    """The table, the best variant first, and the recommendation."""
    best = max(fitted.values(), key=lambda variant: float(np.sum(variant.density)))
    rows: dict[str, dict[str, Any]] = {}
    for name, one in sorted(fitted.items(), key=lambda item: -float(np.sum(item[1].density))):
        difference = one.density - best.density
        rows[name] = {
            "parameters": one.parameters,
            "log_posterior": one.log_posterior,
            "elpd": float(np.sum(one.density)),
            "difference": float(np.sum(difference)),
            "se": float(np.sqrt(len(difference) * np.var(difference, ddof=1))),
            "shape": one.shape,
            "refits": one.refits,
        }
    table = pd.DataFrame.from_dict(rows, orient="index").rename_axis("variant")
    close = table[table["difference"] >= -STANDARD_ERRORS * table["se"]]
    recommended = min(close.index, key=lambda name: (fitted[name].parameters, -float(np.sum(fitted[name].density))))
    return Choice(table, recommended, dict(choices))
