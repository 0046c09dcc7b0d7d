"""Comparison of models by the predictions of readings that are left out (``--compare``)."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pandas as pd

from capsule_id.console import OnProgress
from capsule_id.errors import InputError
from capsule_id.experiments import make_experiments
from capsule_id.experiments.kind import Registry, default_registry
from capsule_id.experiments.progression.experiment import Progression
from capsule_id.inference.joint_fit import joint_fit
from capsule_id.inference.leave_out import (
    LARGEST_SHAPE,
    LeftOut,
    WeightedDraws,
    leave_setting_out,
    leave_settings_out,
    left_out_predictions,
    log_evidence,
    predictions_text,
    weighted_draws,
)
from capsule_id.inference.marginal import trials_of
from capsule_id.inference.pipeline import check_readings, second_models
from capsule_id.inference.target import LogPosterior
from capsule_id.rig.model import ModelChoices, Rig
from capsule_id.views import counted

# variants: Variants of the model of a rig: one choice of ``[model]`` at a time takes each of its alternatives.


#: Words of ``--compare``.
WORDS = ("friction", "reaction", "lag", "cubic")
#: Parameters of the friction law that may be free.
FRICTION = ("mu_back", "ratio", "viscous")


def variants_of(rig: Rig, words: Sequence[str]) -> dict[str, ModelChoices]:
    """The choices to compare by name: those of the rig first ("as stated"), equal ones once.

    friction: constant, eq. (1), free ratio, and the law of the rig with a viscous part and with a direction;
    reaction: on the ground, on the capsule; lag: none, free; cubic: a linear spring, k_cubic free.

    Raises
    ------
    InputError
        If a word is not one of ``WORDS``.
    """
    unknown = [word for word in words if word not in WORDS]
    if unknown or not words:
        rule = f"--compare takes some of {','.join(WORDS)}"
        raise InputError(rule, ",".join(words) or "nothing", f"write --compare {WORDS[0]}")
    model = rig.model
    others = tuple(symbol for symbol in model.free if symbol not in FRICTION)
    found = {"as stated": model}
    if "friction" in words:
        found["constant friction"] = replace(model, friction="constant", free=others)
        found["eq. (1)"] = replace(model, friction="stribeck", free=others)
        found["free ratio"] = replace(model, friction="stribeck", free=("ratio", *others))
        found["viscous part"] = _with(model, "viscous")
        found["direction"] = _with(model, "mu_back")
    if "reaction" in words:
        found["reaction on the capsule"] = replace(model, reaction="capsule")
        found["reaction on the ground"] = replace(model, reaction="ground")
    for word, symbol, absent, present in (
        ("lag", "lag", "no lag", "free lag"),
        ("cubic", "k_cubic", "linear spring", "cubic spring"),
    ):
        if word in words:
            found[absent] = replace(model, free=tuple(s for s in model.free if s != symbol))
            found[present] = _with(model, symbol)
    unique: dict[tuple[object, ...], str] = {}
    for name, choices in found.items():
        unique.setdefault((choices.friction, frozenset(choices.free), choices.reaction), name)
    return {name: found[name] for name in unique.values()}


def _with(model: ModelChoices, symbol: str) -> ModelChoices:
    return model if symbol in model.free else replace(model, free=(*model.free, symbol))


# compare: Fits nested variants of the model side by side and recommends the simplest one that predicts as well as the
# best.


#: Fewest settings of a progression: two differences of densities determine a standard error badly.
FEWEST_SETTINGS = 3
#: Standard errors by which the best variant must be better for a simpler one to be rejected.
STANDARD_ERRORS = 2.0
#: Difference of log-evidence that rejects a simpler variant where only points are compared: a factor of 20, "strong" (Kass &
#: Raftery 1995).
STRONG = 3.0
#: A variant is hopeless, and has no refits, where it is worse by this much and this many standard errors. Smaller
#: differences mean little (Sivula, Magnusson, Matamoros & Vehtari 2020).
HOPELESS, HOPELESS_ERRORS = 4.0, 5.0


@dataclass(frozen=True)
class PointChoice:
    """Nested variants of the model of a rig, compared by their point fits alone.

    Attributes
    ----------
    table : a row per variant (index ``variant``), the best first: parameters, log_posterior (the maximum), converged,
        log_evidence and its difference from the best
    recommended : the variant with the fewest parameters whose log-evidence is within ``STRONG`` of the best
    choices : the choices of ``[model]`` by variant
    """

    table: pd.DataFrame
    recommended: str
    choices: Mapping[str, ModelChoices]

    @property
    def line(self) -> str:
        """The recommendation in words, with the lines of ``[model]``, and the variants that the readings reject."""
        behind = self.table["difference"]
        said = (
            f"{self.recommended}: the simplest variant within {STRONG:g} of the best log-evidence "
            f"({behind[self.recommended]:.1f}). Write in [model]: {self._model}"
        )
        rejected = [f"{name} ({value:.1f})" for name, value in behind.to_dict().items() if value < -STRONG]
        return f"{said}\nRejected: {', '.join(rejected)}." if rejected else said

    @property
    def _model(self) -> str:
        """The choices of the recommended variant, as in ``[model]``."""
        own = self.choices[self.recommended]
        free = ", ".join(f'"{symbol}"' for symbol in own.free)
        return f'friction = "{own.friction}", reaction = "{own.reaction}", free = [{free}]'

    @property
    def text(self) -> str:
        """The table, the recommendation, and how rough both are."""
        rough = (
            "This comparison is rough: it uses a normal approximation at the best point of each variant. Compare without "
            "--no-sample before you choose."
        )
        return "\n".join([self.table.round(2).to_string(), self.line, rough])


@dataclass(frozen=True)
class Choice(PointChoice):
    """Nested variants of the model of a rig, compared by the predictions of settings left out.

    Attributes
    ----------
    table : a row per variant (index ``variant``), the best first: parameters, elpd, its difference from the best and
        the standard error of the difference, log_evidence and its standard error, shape (largest Pareto shape of the
        densities that enter), refits; none where a variant is far worse than the best
    recommended : the variant with the fewest parameters within two standard errors of the best
    predictions : of the recommended variant, see ``capsule_id.inference.leave_out.left_out_predictions``
    """

    predictions: pd.DataFrame

    @property
    def line(self) -> str:
        """The recommendation in words, with the lines of ``[model]``."""
        row = self.table.loc[self.recommended]
        said = (
            f"{self.recommended}: the simplest variant within {STANDARD_ERRORS:g} standard errors of the best "
            f"(elpd {row['difference']:.1f} ± {row['se']:.1f}). Write in [model]: {self._model}"
        )
        columns = self.table[["shape", "refits"]].itertuples()
        unsure = [(str(name), refits) for name, shape, refits in columns if not shape <= LARGEST_SHAPE]
        left, rough = ([name for name, refits in unsure if (refits == 0) == far] for far in (True, False))
        if left:
            said += f"\nFar behind, and therefore not fitted again without their settings: {', '.join(left)}."
        if rough:
            said += (
                "\nThe elpd of these variants is uncertain, because few draws determine it (shape above "
                f"{LARGEST_SHAPE:g}): {', '.join(rough)}. Measure more settings, or narrow the priors."
            )
        return said

    @property
    def text(self) -> str:
        """Both tables, the recommendation, and how well the recommended variant predicts settings left out."""
        tables = self.table.round(2).to_string(), self.predictions.round(2).to_string()
        return "\n".join([tables[0], self.line, "", tables[1], predictions_text(self.predictions)])


@dataclass(frozen=True)
class _Variant:
    """A fitted variant.

    Attributes
    ----------
    parameters : number of parameters
    draws : weighted draws of its posterior
    left_out : settings left out by progression
    evidence : log-evidence and its standard error
    refits : number of posteriors drawn again without a setting
    """

    parameters: int
    draws: WeightedDraws
    left_out: tuple[tuple[Progression, list[LeftOut]], ...]
    evidence: tuple[float, float]
    refits: int = 0

    @property
    def density(self) -> np.ndarray:
        """Log predictive densities (settings,) of all progressions."""
        return np.array([one.density for _, own in self.left_out for one in own])

    @property
    def elpd(self) -> float:
        return float(np.sum(self.density))

    @property
    def shape(self) -> float:
        """Largest Pareto shape."""
        return max(one.shape for _, own in self.left_out for one in own)

    def refitted(self, seed: int) -> "_Variant":
        """Leave out again, by draws of the posterior without them, the settings whose shape is too large."""
        found, refits = [], 0
        for e, own in self.left_out:
            poor = [k for k, one in enumerate(own) if not one.shape <= LARGEST_SHAPE]
            again = {k: leave_setting_out(self.draws, e, k, seed) for k in poor}
            found.append((e, [again.get(k, one) for k, one in enumerate(own)]))
            refits += len(poor)
        return replace(self, left_out=tuple(found), refits=refits)

    def predictions(self, seed: int) -> pd.DataFrame:
        """Tables of ``left_out_predictions``, named by their progression where there are several."""
        tables = [left_out_predictions(e, own, seed) for e, own in self.left_out]
        return tables[0] if len(tables) == 1 else pd.concat({str(table.index.name): table for table in tables})


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
    words : some of ``capsule_id.inference.compare.WORDS``
    registry : the kinds that read ``rig``, by default the built-in ones and those of installed packages
    progress : called with (steps done, steps, name of the variant): each variant is fitted, then its refits follow

    Raises
    ------
    InputError
        If a word is unknown, or a progression has too few settings or there is none.
    """
    choices, kinds = _variants(rig, words, registry)
    fitted = {}
    for number, (name, model) in enumerate(choices.items()):
        if progress:
            progress(number, 2 * len(choices), name)
        fitted[name] = _fit_variant(replace(rig, model=model), kinds, seed)
    # The best first, so that hopeless variants are known when their turn comes.
    for number, name in enumerate(sorted(fitted, key=lambda name: -fitted[name].elpd)):
        if progress:
            progress(len(choices) + number, 2 * len(choices), name)
        if not _hopeless(fitted[name].shape, *_difference(fitted[name], _best(fitted))):
            fitted[name] = fitted[name].refitted(seed)
    return _choose(fitted, choices, seed)


def compare_points(
    rig: Rig,
    words: Sequence[str],
    registry: Registry | None = None,
    seed: int = 0,
    progress: OnProgress | None = None,
) -> PointChoice:
    """Compare the variants of ``compare_models`` by their point fits alone, which takes a small part of the time.

    The log-evidence is that of a normal approximation at the best point (Laplace), with the scatters as independent of
    all other parameters.

    Raises
    ------
    InputError
        If a word is unknown, or a progression has too few settings or there is none.
    """
    choices, kinds = _variants(rig, words, registry)
    rows: dict[str, dict[str, Any]] = {}
    for number, (name, model) in enumerate(choices.items()):
        if progress:
            progress(number, len(choices), name)
        target = _target(replace(rig, model=model), kinds)
        fit = joint_fit(target, {}, seed)
        best = float(np.max(fit.log_posterior))
        volume = 0.5 * (target.dimension * np.log(2.0 * np.pi) + np.linalg.slogdet(fit.covariance)[1])
        evidence = best + float(volume) if np.isfinite(volume) else -np.inf
        rows[name] = {
            "parameters": target.dimension,
            "log_posterior": best,
            "converged": not fit.stalled[np.argmax(fit.log_posterior)],
            "log_evidence": evidence,
        }
    order = sorted(rows, key=lambda name: -rows[name]["log_evidence"])
    for row in rows.values():
        row["difference"] = row["log_evidence"] - rows[order[0]]["log_evidence"]
    table = pd.DataFrame.from_dict({name: rows[name] for name in order}, orient="index").rename_axis("variant")
    close = [name for name in order if rows[name]["difference"] >= -STRONG]
    return PointChoice(table, min(close, key=lambda name: rows[name]["parameters"]), choices)


def _variants(rig: Rig, words: Sequence[str], registry: Registry | None) -> tuple[dict[str, ModelChoices], Registry]:
    """Variants by name, and the kinds that read ``rig``; an ``InputError`` where its progressions do not suffice."""
    choices, kinds = variants_of(rig, words), registry or default_registry()
    made = [e for e in make_experiments(rig, "all", kinds) if isinstance(e, Progression)]
    if not made:
        remedy = "compare friction laws of bench tests in the report of fit-params"
        raise InputError("--compare needs a progression", "none", remedy)
    for e in made:
        if len(e.settings) < FEWEST_SETTINGS:
            rule = f"--compare needs {FEWEST_SETTINGS} settings or more in {e.label}"
            raise InputError(rule, counted(len(e.settings), "setting"), "measure further settings")
    return choices, kinds


def _target(rig: Rig, registry: Registry) -> LogPosterior:
    # Decays get the models that their readings demand, as in a fit.
    experiments, _ = second_models(make_experiments(rig, "all", registry), check_readings(rig, "all", registry))
    return LogPosterior(rig, experiments)


def _fit_variant(rig: Rig, registry: Registry, seed: int) -> _Variant:
    target = _target(rig, registry)
    draws = weighted_draws(target, joint_fit(target, {}, seed), seed)
    rng = np.random.default_rng(seed)
    evidence, errors = np.array([log_evidence(block, rng) for block in draws.log_weight.T]).T
    evidence, errors = evidence + draws.log_normalisation[0], np.hypot(errors, draws.log_normalisation[1])
    return _Variant(
        target.dimension,
        draws,
        tuple((e, leave_settings_out(e, draws)) for e in trials_of(target)),
        (float(np.sum(evidence)), float(np.linalg.norm(errors))),
    )


def _best(fitted: Mapping[str, _Variant]) -> _Variant:
    return max(fitted.values(), key=lambda variant: variant.elpd)


def _difference(one: _Variant, best: _Variant) -> tuple[float, float]:
    """Difference of the elpd, and its standard error from the settings; a setting without a density gives -inf, NaN."""
    with np.errstate(invalid="ignore"):
        each = one.density - best.density
        return float(np.sum(each)), float(np.sqrt(len(each) * np.var(each, ddof=1)))


def _hopeless(shape: float, difference: float, error: float) -> bool:
    """Whether a variant is too far behind for refits. Weights with a large shape mostly overrate a variant.

    Where the shape is infinite, the density of a setting is unknown and a refit is needed.
    """
    return bool(np.isfinite(shape)) and difference < -(HOPELESS + HOPELESS_ERRORS * error)


def _choose(fitted: Mapping[str, _Variant], choices: Mapping[str, ModelChoices], seed: int) -> Choice:
    """The table, the best variant first, and the recommendation."""
    best = _best(fitted)
    rows: dict[str, dict[str, Any]] = {}
    for name, one in sorted(fitted.items(), key=lambda item: -item[1].elpd):
        difference, error = _difference(one, best)
        rows[name] = {
            "parameters": one.parameters,
            "elpd": one.elpd,
            "difference": difference,
            "se": error,
            "log_evidence": one.evidence[0],
            "± log_evidence": one.evidence[1],
            "shape": one.shape,
            "refits": one.refits,
        }
    table = pd.DataFrame.from_dict(rows, orient="index").rename_axis("variant")
    close = [name for name in table.index if fitted[name] is best or _close(table.loc[name])]
    recommended = min(close, key=lambda name: (fitted[name].parameters, -fitted[name].elpd))
    return Choice(table, recommended, dict(choices), fitted[recommended].predictions(seed))


def _close(row: pd.Series) -> bool:
    """Whether a variant predicts nearly as well as the best one."""
    return bool(row["difference"] >= -STANDARD_ERRORS * row["se"])
