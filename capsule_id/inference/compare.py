"""Comparison of models by the predictions of readings that are left out (``--compare``)."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pandas as pd

from capsule_id.console import OnProgress
from capsule_id.errors import InputError
from capsule_id.experiments.kind import Registry, default_registry, make_experiments
from capsule_id.experiments.progression.experiment import Progression
from capsule_id.inference.joint_fit import joint_fit
from capsule_id.inference.marginal import trials_of
from capsule_id.inference.pipeline import check_readings, second_models
from capsule_id.inference.point_stage import ERRORS, STRONG, error_of_sum
from capsule_id.inference.prediction import (
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
from capsule_id.inference.target import LogPosterior
from capsule_id.rig.model import ModelChoices, Rig
from capsule_id.views import counted

# variants: Variants of the model of a rig: one choice of ``[model]`` at a time takes each of its alternatives.


#: Parameters of the friction law that may be free.
FRICTION = ("mu_back", "ratio", "viscous")
#: Alternatives by the word of ``--compare``: name, other choices, and the free symbols that go and come.
ALTERNATIVES: Mapping[str, Sequence[tuple[str, Mapping[str, Any], Sequence[str], Sequence[str]]]] = {
    "friction": (
        ("constant friction", {"friction": "constant"}, FRICTION, ()),
        ("eq. (1)", {"friction": "stribeck"}, FRICTION, ()),
        ("free ratio", {"friction": "stribeck"}, FRICTION, ("ratio",)),
        ("viscous part", {}, (), ("viscous",)),
        ("direction", {}, (), ("mu_back",)),
    ),
    "reaction": (
        ("reaction on the capsule", {"reaction": "capsule"}, (), ()),
        ("reaction on the ground", {"reaction": "ground"}, (), ()),
    ),
    "lag": (("no lag", {}, ("lag",), ()), ("free lag", {}, (), ("lag",))),
    "cubic": (("linear spring", {}, ("k_cubic",), ()), ("cubic spring", {}, (), ("k_cubic",))),
}
#: Words of ``--compare``.
WORDS = tuple(ALTERNATIVES)


def variants_of(rig: Rig, words: Sequence[str]) -> dict[str, ModelChoices]:
    """The choices to compare by name: those of the rig first ("as stated"), then ``ALTERNATIVES``, equal ones once.

    Raises
    ------
    InputError
        If a word is not one of ``WORDS``.
    """
    unknown = [word for word in words if word not in WORDS]
    if unknown or not words:
        raise InputError(
            f"--compare takes some of {','.join(WORDS)}",
            ",".join(words) or "nothing",
            f"write --compare {WORDS[0]}",
        )
    found = {"as stated": rig.model}
    for name, other, gone, free in (row for word, rows in ALTERNATIVES.items() if word in words for row in rows):
        kept = [symbol for symbol in rig.model.free if symbol not in (*gone, *free)]
        model = replace(rig.model, **other, free=(*kept, *free))
        if all(replace(model, free=one.free) != one or {*model.free} != {*one.free} for one in found.values()):
            found[name] = model
    return found


# compare: Fits nested variants of the model side by side and recommends the simplest one that predicts as well as the
# best.


#: Fewest settings of a progression: two differences of densities determine a standard error badly.
FEWEST_SETTINGS = 3
#: A variant is hopeless, and has no refits, where it is worse by this much and this many standard errors. Smaller
#: differences mean little (Sivula, Magnusson, Matamoros & Vehtari 2020).
HOPELESS, HOPELESS_ERRORS = 4.0, 5.0
#: Last line of a comparison of point fits.
ROUGH = (
    "This comparison is rough: it uses a normal approximation at the best point of each variant. Compare without "
    "--no-sample before you choose."
)


@dataclass(frozen=True)
class Choice:
    """Nested variants of the model of a rig, compared by the predictions of settings left out, or by their point fits.

    Attributes
    ----------
    table : a row per variant (index ``variant``), the best first: parameters, difference from the best, log_evidence; of
        predictions also elpd, the standard errors se and of log_evidence, shape (largest Pareto shape of the densities
        that enter), and refits, none where a variant is far worse than the best; of point fits log_posterior (the
        maximum) and converged
    recommended : the variant with the fewest parameters within ``ERRORS`` of the best, of point fits within
        ``STRONG``
    line : the recommendation in words, with the lines of ``[model]``, and what is uncertain
    predictions : of the recommended variant, see ``capsule_id.inference.prediction.left_out_predictions``; None for point
        fits
    """

    table: pd.DataFrame
    recommended: str
    line: str
    predictions: pd.DataFrame | None = None

    @property
    def text(self) -> str:
        """The tables, the recommendation, and how well the recommended variant predicts or how rough a comparison is."""
        first = [self.table.round(2).to_string(), self.line]
        if self.predictions is None:
            return "\n".join([*first, ROUGH])
        return "\n".join([*first, "", self.predictions.round(2).to_string(), predictions_text(self.predictions)])


def _recommendation(name: str, model: ModelChoices, criterion: str) -> str:
    """The recommended variant in words, with the lines of ``[model]``."""
    free = ", ".join(f'"{symbol}"' for symbol in model.free)
    lines = f'friction = "{model.friction}", reaction = "{model.reaction}", free = [{free}]'
    return f"{name}: the simplest variant within {criterion}. Write in [model]: {lines}"


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
    report = progress or (lambda done, steps, name: None)
    fitted = {}
    for number, (name, model) in enumerate(choices.items()):
        report(number, 2 * len(choices), name)
        fitted[name] = _fit_variant(replace(rig, model=model), kinds, seed)
    # The best first, so that hopeless variants are known when their turn comes.
    for number, name in enumerate(sorted(fitted, key=lambda name: -fitted[name].elpd)):
        report(len(choices) + number, 2 * len(choices), name)
        difference, error = _difference(fitted[name], _best(fitted))
        # Weights with a large shape mostly overrate a variant; an infinite one hides the density of a setting.
        hopeless = np.isfinite(fitted[name].shape) and difference < -(HOPELESS + HOPELESS_ERRORS * error)
        fitted[name] = fitted[name] if hopeless else fitted[name].refitted(seed)
    return _choose(fitted, choices, seed)


def compare_points(
    rig: Rig,
    words: Sequence[str],
    registry: Registry | None = None,
    seed: int = 0,
    progress: OnProgress | None = None,
) -> Choice:
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
    highest = max(row["log_evidence"] for row in rows.values())
    table = _table(
        {name: {**row, "difference": row["log_evidence"] - highest} for name, row in rows.items()}, "log_evidence"
    )
    behind = dict(zip(map(str, table.index), table["difference"].tolist(), strict=True))
    close = [name for name, difference in behind.items() if difference >= -STRONG]
    recommended = min(close, key=lambda name: rows[name]["parameters"])
    said = _recommendation(
        recommended, choices[recommended], f"{STRONG:g} of the best log-evidence ({behind[recommended]:.1f})"
    )
    rejected = [f"{name} ({value:.1f})" for name, value in behind.items() if value < -STRONG]
    return Choice(table, recommended, f"{said}\nRejected: {', '.join(rejected)}." if rejected else said)


def _table(rows: dict[str, dict[str, Any]], criterion: str) -> pd.DataFrame:
    """Table of the variants, that with the highest ``criterion`` first."""
    frame = pd.DataFrame.from_dict(rows, orient="index").rename_axis("variant")
    return frame.sort_values(criterion, ascending=False, kind="stable")


def _variants(rig: Rig, words: Sequence[str], registry: Registry | None) -> tuple[dict[str, ModelChoices], Registry]:
    """Variants by name, and the kinds that read ``rig``; an ``InputError`` where its progressions do not suffice."""
    kinds = registry or default_registry()
    read = make_experiments(rig, "all", kinds)
    slides = [set(e.table.columns) for e in read if getattr(e, "role", "") == "sliding"]
    choices = {
        name: model
        for name, model in variants_of(rig, words).items()
        if (model == rig.model or _can_be_read(replace(rig, model=model), kinds))
        # As the rules of sliding friction for rig.toml.
        and not ("viscous" in model.free and any("normal_force" in own or "speed" not in own for own in slides))
        and (model.friction == "constant" or all("speed" in own for own in slides))
    }
    if len(choices) == 1:
        remedy = "compare other words: lag needs pulses, and friction another law than the stated one"
        raise InputError("--compare needs a variant that the rig can show", ",".join(words), remedy)
    made = [e for e in read if isinstance(e, Progression)]
    if not made:
        raise InputError(
            "--compare needs a progression", "none", "compare friction laws of bench tests in the report of fit-params"
        )
    for e in made:
        if len(e.settings) < FEWEST_SETTINGS:
            raise InputError(
                f"--compare needs {FEWEST_SETTINGS} settings or more in {e.label}",
                counted(len(e.settings), "setting"),
                "measure further settings",
            )
    return choices, kinds


def _can_be_read(rig: Rig, kinds: Registry) -> bool:
    """Whether the experiments measure what the model sets free."""
    try:
        return bool(make_experiments(rig, "all", kinds))
    except InputError:
        return False


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
        return float(np.sum(each)), error_of_sum(each)


def _choose(fitted: Mapping[str, _Variant], choices: Mapping[str, ModelChoices], seed: int) -> Choice:
    """The table, the best variant first, and the recommendation."""
    best = _best(fitted)
    rows: dict[str, dict[str, Any]] = {}
    for name, one in fitted.items():
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
    close = [name for name, row in rows.items() if fitted[name] is best or row["difference"] >= -ERRORS * row["se"]]
    chosen = min(close, key=lambda name: (fitted[name].parameters, -fitted[name].elpd))
    own, table = rows[chosen], _table(rows, "elpd")
    standing = f"elpd {own['difference']:.1f} ± {own['se']:.1f}"
    said = _recommendation(chosen, choices[chosen], f"{ERRORS:g} standard errors of the best ({standing})")
    unsure = [name for name in map(str, table.index) if not fitted[name].shape <= LARGEST_SHAPE]
    left, rough = ([name for name in unsure if (fitted[name].refits == 0) == far] for far in (True, False))
    if left:
        said += f"\nFar behind, and therefore not fitted again without their settings: {', '.join(left)}."
    if rough:
        said += (
            "\nThe elpd of these variants is uncertain, because few draws determine it (shape above "
            f"{LARGEST_SHAPE:g}): {', '.join(rough)}. Measure more settings, or narrow the priors."
        )
    return Choice(table, chosen, said, fitted[chosen].predictions(seed))
