"""Fits nested variants of the model side by side and recommends the simplest one that predicts as well as the best."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pandas as pd

from capsule_id.console import OnProgress
from capsule_id.errors import InputError
from capsule_id.experiments import make_experiments
from capsule_id.experiments.families.trials_experiment import TrialsExperiment
from capsule_id.experiments.registry import Registry, default_registry
from capsule_id.inference.choice.evidence import log_evidence
from capsule_id.inference.choice.leave_out import (
    LARGEST_SHAPE,
    LeftOut,
    leave_setting_out,
    leave_settings_out,
    weighted_draws,
)
from capsule_id.inference.choice.predictions import left_out_predictions, predictions_text
from capsule_id.inference.choice.variants import variants_of
from capsule_id.inference.fit.joint_fit import joint_fit
from capsule_id.inference.target.log_posterior import LogPosterior
from capsule_id.rig.model import ModelChoices, Rig

#: Standard errors by which the best variant must be better for a simpler one to be rejected.
STANDARD_ERRORS = 2.0


@dataclass(frozen=True)
class Choice:
    """Nested variants of the model of a rig.

    Attributes
    ----------
    table : a row per variant (index ``variant``), the best first: parameters, elpd, its difference from the best and
        the standard error of the difference, log_evidence and its standard error, shape (largest Pareto shape of the
        densities that enter), refits
    recommended : the variant with the fewest parameters within two standard errors of the best
    choices : the choices of ``[model]`` by variant
    predictions : of the recommended variant, see ``capsule_id.inference.choice.predictions.left_out_predictions``
    """

    table: pd.DataFrame
    recommended: str
    choices: Mapping[str, ModelChoices]
    predictions: pd.DataFrame

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

    @property
    def text(self) -> str:
        """Both tables, the recommendation, and how well the recommended variant predicts settings left out."""
        tables = self.table.round(2).to_string(), self.predictions.round(2).to_string()
        return "\n".join([tables[0], self.line, "", tables[1], predictions_text(self.predictions)])


@dataclass(frozen=True)
class _Variant:
    """A fitted variant: parameters, densities of the settings left out, evidence and its error, shape, refits."""

    parameters: int
    density: np.ndarray
    evidence: tuple[float, float]
    shape: float
    refits: int
    predictions: pd.DataFrame


def compare_models(
    rig: Rig,
    words: Sequence[str],
    registry: Registry | None = None,
    seed: int = 0,
    progress: OnProgress | None = None,
) -> Choice:
    """Fit every variant that ``words`` name and compare them by leaving out settings of the progressions.

    Parameters
    ----------
    words : some of ``capsule_id.inference.choice.variants.WORDS``
    registry : the kinds that read ``rig``, by default the built-in ones and those of installed packages
    progress : called with (variants done, variants, name of the variant)

    Raises
    ------
    InputError
        If a word is unknown, or the rig has no progression.
    """
    choices, kinds = variants_of(rig, words), registry or default_registry()
    if not any(isinstance(e, TrialsExperiment) for e in make_experiments(rig, "all", kinds)):
        remedy = "compare friction laws of bench tests in the report of fit-params"
        raise InputError("--compare needs a progression, whose settings are left out", "none", remedy)
    fitted = {}
    for number, (name, model) in enumerate(choices.items()):
        if progress:
            progress(number, len(choices), name)
        fitted[name] = _fit_variant(replace(rig, model=model), kinds, seed)
    return _choose(fitted, choices)


def _fit_variant(rig: Rig, registry: Registry, seed: int) -> _Variant:
    target = LogPosterior(rig, make_experiments(rig, "all", registry))
    fit = joint_fit(target, {}, seed)
    draws = weighted_draws(target, fit, seed)
    found, tables, refits = list[LeftOut](), list[pd.DataFrame](), 0
    for e in target.experiments:
        if not isinstance(e, TrialsExperiment):
            continue
        own = leave_settings_out(e, draws)
        for setting in [k for k, one in enumerate(own) if not one.shape <= LARGEST_SHAPE]:
            own[setting] = leave_setting_out(draws, e, setting, seed)
            refits += 1
        tables.append(left_out_predictions(e, own, seed))
        found += own
    rng = np.random.default_rng(seed)
    evidence, errors = np.array([log_evidence(block, rng) for block in draws.log_weight.T]).T
    return _Variant(
        target.dimension,
        np.array([one.density for one in found]),
        (float(np.sum(evidence)), float(np.linalg.norm(errors))),
        max(one.shape for one in found),
        refits,
        pd.concat(tables),
    )


def _choose(fitted: Mapping[str, _Variant], choices: Mapping[str, ModelChoices]) -> Choice:
    """The table, the best variant first, and the recommendation."""
    best = max(fitted.values(), key=lambda variant: float(np.sum(variant.density)))
    rows: dict[str, dict[str, Any]] = {}
    for name, one in sorted(fitted.items(), key=lambda item: -float(np.sum(item[1].density))):
        difference = one.density - best.density
        rows[name] = {
            "parameters": one.parameters,
            "elpd": float(np.sum(one.density)),
            "difference": float(np.sum(difference)),
            "se": float(np.sqrt(len(difference) * np.var(difference, ddof=1))),
            "log_evidence": one.evidence[0],
            "± log_evidence": one.evidence[1],
            "shape": one.shape,
            "refits": one.refits,
        }
    table = pd.DataFrame.from_dict(rows, orient="index").rename_axis("variant")
    close = table[table["difference"] >= -STANDARD_ERRORS * table["se"]]
    recommended = min(close.index, key=lambda name: (fitted[name].parameters, -float(np.sum(fitted[name].density))))
    return Choice(table, recommended, dict(choices), fitted[recommended].predictions)
