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
    psislw,
    weighted_draws,
)
from capsule_id.inference.choice.predictions import left_out_predictions, predictions_text
from capsule_id.inference.choice.variants import variants_of
from capsule_id.inference.fit.joint_fit import joint_fit
from capsule_id.inference.pipeline import check_readings, second_models
from capsule_id.inference.target.log_posterior import LogPosterior
from capsule_id.rig.model import ModelChoices, Rig
from capsule_id.views import counted

#: Fewest settings of a progression: two differences of densities determine a standard error badly.
FEWEST_SETTINGS = 3
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
        said = (
            f"{self.recommended}: the simplest variant within {STANDARD_ERRORS:g} standard errors of the best "
            f"(elpd {row['difference']:.1f} ± {row['se']:.1f}). Write in [model]: {lines}"
        )
        rough = [name for name in self.table.index if not self.table.loc[name, "shape"] <= LARGEST_SHAPE]
        if not rough:
            return said
        return (
            f"{said}\nThe elpd of these variants is uncertain, because few draws determine it (shape above "
            f"{LARGEST_SHAPE:g}): {', '.join(rough)}. Measure more settings, or narrow the priors."
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
        If a word is unknown, ArviZ is not installed, or a progression has too few settings or there is none.
    """
    psislw()
    choices, kinds = variants_of(rig, words), registry or default_registry()
    made = [e for e in make_experiments(rig, "all", kinds) if isinstance(e, TrialsExperiment)]
    if not made:
        remedy = "compare friction laws of bench tests in the report of fit-params"
        raise InputError("--compare needs a progression, whose settings are left out", "none", remedy)
    for e in made:
        if len(e.settings) < FEWEST_SETTINGS:
            rule = f"--compare needs {FEWEST_SETTINGS} settings or more in {e.label}, to leave each one out"
            raise InputError(rule, counted(len(e.settings), "setting"), "measure further settings")
    fitted = {}
    for number, (name, model) in enumerate(choices.items()):
        if progress:
            progress(number, len(choices), name)
        fitted[name] = _fit_variant(replace(rig, model=model), kinds, seed)
    return _choose(fitted, choices)


def _fit_variant(rig: Rig, registry: Registry, seed: int) -> _Variant:
    # Decays get the models that their readings demand, as in a fit.
    experiments, _ = second_models(make_experiments(rig, "all", registry), check_readings(rig, "all", registry))
    target = LogPosterior(rig, experiments)
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
        pd.concat(tables) if len(tables) == 1 else pd.concat({str(table.index.name): table for table in tables}),
    )


def _choose(fitted: Mapping[str, _Variant], choices: Mapping[str, ModelChoices]) -> Choice:
    """The table, the best variant first, and the recommendation."""
    best = max(fitted.values(), key=lambda variant: float(np.sum(variant.density)))
    rows: dict[str, dict[str, Any]] = {}
    for name, one in sorted(fitted.items(), key=lambda item: -float(np.sum(item[1].density))):
        with np.errstate(invalid="ignore"):
            # A setting without a density gives -inf.
            difference = one.density - best.density
            error = float(np.sqrt(len(difference) * np.var(difference, ddof=1)))
        rows[name] = {
            "parameters": one.parameters,
            "elpd": float(np.sum(one.density)),
            "difference": float(np.sum(difference)),
            "se": error,
            "log_evidence": one.evidence[0],
            "± log_evidence": one.evidence[1],
            "shape": one.shape,
            "refits": one.refits,
        }
    table = pd.DataFrame.from_dict(rows, orient="index").rename_axis("variant")
    close = [name for name in table.index if fitted[name] is best or _close(table.loc[name])]
    recommended = min(close, key=lambda name: (fitted[name].parameters, -float(np.sum(fitted[name].density))))
    return Choice(table, recommended, dict(choices), fitted[recommended].predictions)


def _close(row: pd.Series) -> bool:
    """Whether a variant predicts nearly as well as the best one."""
    return bool(row["difference"] >= -STANDARD_ERRORS * row["se"])
