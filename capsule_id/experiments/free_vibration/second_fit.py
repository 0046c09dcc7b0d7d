"""Choice of the model of free decays where a record contradicts the stated one: hidden forces, drift, noise, ranking."""

import itertools
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from capsule_id.experiments.base import LEVEL, refit
from capsule_id.experiments.free_vibration.decrement import STRONGEST, viscous_fit
from capsule_id.experiments.free_vibration.hidden_terms import force_responses, sensitivities
from capsule_id.experiments.free_vibration.readings import (
    DAMPING,
    FEWEST_PER_PERIOD,
    MOST_PERIODS,
    READINGS_PER_PERIOD,
    DecayModel,
    first_periods,
)
from capsule_id.experiments.free_vibration.record import DecayRecord, Screened
from capsule_id.experiments.free_vibration.screening import (
    Screening,
    hum_of,
)
from capsule_id.experiments.statistics import further_columns, ljung_box, weighted_mean
from capsule_id.physics.batches import pool
from capsule_id.records.tones import noise_level
from capsule_id.rig.filters import median_step
from capsule_id.views import Facts, Finding

# screening: Choice of the model of free decays where the record contradicts the stated one.
#
# A record demands another model where its residuals are not white, or where they correlate with the response to dry
# friction, quadratic damping, a cubic spring or a drift. Every sum of the terms that the settings leave open is
# then fitted to the record by maximum likelihood and ranked by BIC.


#: Largest number of samples of a record that is no free decay.
LONGEST_UNCUT = 1000
#: Of forces whose BIC differs by less, the fewest are chosen: with seven alternatives, noise alone often gains this much.
BIC_MARGIN = 4.0
#: Shorter records, in samples, keep their model, and shorter halves of a record are not fitted. A thinned record has twice
#: as many readings.
SHORTEST = 40
#: Residuals with a larger p-value of the Ljung–Box test count as white here; the check after the fit is more lenient.
WHITENESS = 0.01


def open_models(record: DecayRecord) -> tuple[list[DecayModel], list[DecayModel]]:
    """Return the sums of forces that the settings leave open, and the pairs of drift and noise."""
    settings, stated = record.table.settings, record.model
    damping = [
        tuple(word for word, on in zip(DAMPING, switches, strict=True) if on)
        for switches in itertools.product((False, True), repeat=len(DAMPING))
    ]
    forces = [
        replace(stated, damping=words, cubic=cubic)
        for words in (damping if settings.damping is None else [stated.damping])
        for cubic in ((False, True) if settings.stiffness is None and settings.offers_cubic else (stated.cubic,))
    ]
    others = [
        replace(stated, drift=drift, noise=noise)
        for noise in (("white", "ar1", "arma") if settings.noise is None else (stated.noise,))
        for drift in (("none", "linear", "gp") if settings.drift is None else (stated.drift,))
    ]
    return forces, others


def demands_another(record: DecayRecord, level: float) -> bool:
    """Whether ``record`` contradicts its model at this false-alarm rate: residuals, or responses to further forces.

    A decay beyond ``STRONGEST`` damping keeps its model, because no other one is offered.
    """
    rough = record.rough
    if rough.c > 2.0 * STRONGEST * np.sqrt(rough.k1 * record.mass):
        return False
    if not record.closed or record.model.whitened:
        return ljung_box(Screening(record).fit(record.model)[0].residuals)[1] < level
    rough = viscous_fit(record.time, record.values).decrement(record.mass)
    noise = max(noise_level(record.values), 1e-6 * float(np.ptp(record.values)))
    theta = {"m1": record.mass, "k1": rough.k1, "c": rough.c, record.scatters[0]: noise}
    theta |= {symbol: value for symbol, (value, _) in refit(record, theta, []).items()}
    residuals = np.asarray(record.residuals(theta, np))[: record.n]
    return ljung_box(residuals)[1] < level or response_p(record, theta) < level


def response_p(record: DecayRecord, theta: Mapping[str, float]) -> float:
    """p-value of the F test for the responses of the rod to further forces and for a drift, at a viscous fit."""
    left, design, moved = sensitivities(record, theta, ("k1", "c"))
    relative = record.time / record.time[-1] - 0.5
    extra = np.column_stack([*force_responses(record, theta).values(), relative, relative**2])
    # A column of zeros is no effect: quadratic damping of a record that stays where it is.
    extra = extra / np.maximum(np.linalg.norm(extra, axis=0), np.finfo(float).tiny)
    p = further_columns(np.column_stack([design, *moved.values()]), extra, left)[1]
    return 1.0 if np.isnan(p) else p


def thinning(record: DecayRecord, per_period: float) -> int:
    """Return the block size that leaves about ``per_period`` readings, and not too few; no less than that of the record."""
    time = record.whole[0]
    step = 2.0 * np.pi / (record.rough.Omega_o * per_period * median_step(time))
    return max(record.model.thin, min(int(step), len(time) // (2 * SHORTEST)))


@dataclass(frozen=True)
class Ranking:
    """The best of some models for some records together: total BIC, and fit and scaled values of each record."""

    model: DecayModel
    bic: float
    fits: tuple[tuple[Screened, np.ndarray], ...]

    @property
    def white(self) -> bool:
        """Whether the residuals of all records are white."""
        return all(ljung_box(one.residuals)[1] * len(self.fits) > WHITENESS for one, _ in self.fits)


def rank(screenings: Sequence[Screening], models: Iterable[DecayModel], near: Ranking | None = None) -> list[Ranking]:
    """Fit every model to all records, from the values of ``near`` and from the best nested model; lowest BIC first.

    So no model has a lower likelihood than one that it contains.
    """
    starts = [None] * len(screenings) if near is None else [z for _, z in near.fits]
    done: list[Ranking] = []

    def fitted(model: DecayModel) -> Ranking:
        nested = [one for one in done if one.model.terms < model.terms]
        fits = tuple(
            screening.fit(model, start, [one.fits[i] for one in nested])
            for i, (screening, start) in enumerate(zip(screenings, starts, strict=True))
        )
        # A drift larger than the motion would take the motion itself for a drift, and an alias for the motion.
        drowned = model.drift != "none" and any(
            screening.drowned(z) for screening, (_, z) in zip(screenings, fits, strict=True)
        )
        return Ranking(model, np.inf if drowned else sum(screened.bic for screened, _ in fits), fits)

    # The first model compiles the programs that all threads then call.
    for _, same_size in itertools.groupby(sorted(models, key=lambda one: len(one.terms)), lambda one: len(one.terms)):
        first, *level = same_size
        done += [*([] if done else [fitted(first)]), *pool().map(fitted, [first, *level] if done else level)]
    return sorted(done, key=lambda one: one.bic)


def simplest(ranked: Sequence[Ranking]) -> Ranking:
    """Return the model with the fewest forces whose BIC is within ``BIC_MARGIN`` of the best one, the first."""
    near = [one for one in ranked if one.bic <= ranked[0].bic + BIC_MARGIN]
    return min(near, key=lambda one: len(one.model.symbols))


def demanded_model(records: Sequence[DecayRecord]) -> Ranking:
    """Return the model with the lowest BIC of all ``records`` together, thinned where its noise is coloured.

    The forces are chosen first on thinned records, with the richest noise that the settings leave open, then drift and
    noise. The fits of fewer forces become starts of the quoted fit.
    """
    forces, others = open_models(records[0])
    # Half of the readings that a quoted fit has rank the models as well.
    coarse = min(thinning(record, 0.5 * READINGS_PER_PERIOD) for record in records)
    thinned = [Screening(record, coarse) for record in records]
    by_forces = rank(thinned, [replace(model, noise=others[-1].noise) for model in forces])
    best = simplest(by_forces)
    others = [replace(model, damping=best.model.damping, cubic=best.model.cubic) for model in others]
    chosen = _with_noise(records, rank(thinned, others, best), others, coarse)
    simpler = [one.fits for one in by_forces if set(one.model.symbols) < set(chosen.model.symbols)]
    fits = [
        (replace(screened, nested=(*screened.nested, *(each[i][0].values for each in simpler))), z)
        for i, (screened, z) in enumerate(chosen.fits)
    ]
    return replace(chosen, fits=tuple(fits))


def _with_noise(
    records: Sequence[DecayRecord], ranked: list[Ranking], others: Sequence[DecayModel], coarse: int
) -> Ranking:
    """Choose drift and noise, from the ranking of all of them on records thinned by ``coarse``.

    Coloured noise is quoted from these: finer readings cost time and hardly tell more. White noise is quoted from all
    readings where it is white there. Where no offered noise is white, still fewer readings may be.
    """
    best = ranked[0]
    if records[0].table.settings.thin is not None:
        return rank([Screening(record) for record in records], [best.model], best)[0]
    thin, fewest = coarse, max(coarse, min(thinning(record, FEWEST_PER_PERIOD) for record in records))
    if not any(one.white for one in ranked) and fewest > coarse:
        thin, ranked = fewest, rank([Screening(record, fewest) for record in records], others, best)
    chosen = next((one for one in ranked if one.white), None)
    if chosen is None:
        return replace(best, model=replace(best.model, thin=coarse))
    if not chosen.model.whitened:
        whole = rank([Screening(record, chosen.model.thin) for record in records], [chosen.model], chosen)[0]
        if whole.white:
            return whole
    return replace(chosen, model=replace(chosen.model, thin=thin))


#: What some decays demand: labels of those that contradict their model, all of them under the new one, and facts.
Demanded = tuple[Sequence[str], Sequence[Any], Facts]


def replaced(
    decays: Sequence[Any],
    judged: Iterable[int],
    demanded: Callable[[list[Any]], Demanded],
    screened: Callable[[Any, DecayModel], Screened],
) -> tuple[list[Any], list[Finding]]:
    """Return ``decays`` under the models that they demand, and findings that name these models.

    Decays with the same stated words share their parameters, and so their model.

    Parameters
    ----------
    judged : indices of the decays that may have another model
    demanded : what the decays of one group demand
    screened : fit of a decay alone under a model
    """
    chosen, findings = list(decays), list[Finding]()
    groups: dict[Any, list[int]] = {}
    for i in judged:
        stated = decays[i].table.settings.choices
        if None in stated:
            groups.setdefault(stated, []).append(i)
    for members in groups.values():
        labels, others, facts = demanded([decays[i] for i in members])
        first, second = decays[members[0]].model, others[0].model
        if labels and second != first:
            facts = {"labels": labels, "first": first.name, "second": second.name, "drift": "", **facts}
            facts["alternatives"] = _both_fits(others, screened)
            findings.append(Finding("decays.second_fit", "warn", {"lines": others[0].lines, **facts}, labels[0]))
            for i, other in zip(members, others, strict=True):
                chosen[i] = other
    return chosen, findings


def _both_fits(decays: Sequence[Any], screened: Callable[[Any, DecayModel], Screened]) -> list[dict[str, object]]:
    """Rows of a table of the decays alone under the stated model and under the quoted one, on the same readings."""
    quoted = decays[0].model
    stated = replace(DecayModel.stated(decays[0].table.settings), thin=quoted.thin)
    pairs = ((stated, [screened(e, stated) for e in decays]), (quoted, [e.about.screened for e in decays]))
    rows = []
    for role, (model, fits) in zip(("stated", "quoted"), pairs, strict=True):
        means = {
            symbol: weighted_mean([one.values[symbol] for one in fits], [one.errors[symbol] for one in fits])
            for symbol in ("k1", "c", *model.symbols)
        }
        row = {
            "fit": role,
            "model": model.name,
            "parameters": ", ".join(f"{name} = {mean:.5g} ± {sd:.2g}" for name, (mean, sd, _) in means.items()),
            "noise, SI": float(np.mean([one.noise for one in fits])),
            "BIC": sum(one.bic for one in fits) - min(sum(one.bic for one in each) for _, each in pairs),
        }
        if decays[0].time_series:
            white = all(ljung_box(one.residuals)[1] * len(decays) >= LEVEL for one in fits)
            row["residuals white"] = "yes" if white else "no"
        rows.append(row)
    return rows


def second_models(
    records: Sequence[DecayRecord], readings: Sequence[Finding] = ()
) -> tuple[list[DecayRecord], list[Finding]]:
    """Return ``records`` under the model that they demand, and findings that name it.

    Records with more than a free decay according to ``readings``, the findings on the readings, keep their model. Their
    fit fails in any case, so long ones are thinned.
    """
    kept, findings = list(records), list[Finding]()
    no_decay = {f.experiment for f in readings if f.level == "fail" and f.code in ("decays.release", "decays.second")}
    for i, record in enumerate(records):
        settings = record.table.settings
        if record.label in no_decay and None in settings.choices:
            thin = settings.thin or max(1, len(record.whole[0]) // LONGEST_UNCUT)
            kept[i] = record.with_model(replace(record.model, thin=thin))
            findings.append(Finding("decays.first_fit", "warn", {"record": record.label, "thin": thin}, record.label))
    judged = (i for i, record in enumerate(records) if record.label not in no_decay)
    demanded = partial(_demanded, level=LEVEL / len(records))
    chosen, named = replaced(kept, judged, demanded, lambda e, model: Screening(e.with_model(model)).fit(model)[0])
    return chosen, findings + named


def _demanded(records: list[DecayRecord], level: float) -> Demanded:
    """What ``records`` demand: they share the model with the lowest BIC where one of them contradicts the stated one."""
    contradicting = [e.label for e in records if e.n >= SHORTEST and demands_another(e, level)]
    if not contradicting:
        return (), records, {}
    records = [e.with_model(replace(e.model, hum=hum_of(e))) if e.n >= SHORTEST else e for e in records]
    own = [e.with_model(e.model, table=first_periods(e.table)) for e in records]
    humming = [e for e in own if e.model.hum]
    # Where hum is the cause, no further force is needed.
    hum_alone = humming and not any(demands_another(e, level) for e in own if e.n >= SHORTEST)
    ranking = rank([*map(Screening, own)], [humming[0].model])[0] if hum_alone else demanded_model(own)
    text = _drift_text(own, ranking)
    if ranking.model.slow and any(part.n < whole.n for part, whole in zip(own, records, strict=True)):
        text += f" The second fit uses the first {MOST_PERIODS} periods of each record."
    kept = own if ranking.model.slow else records
    others = [
        e.with_model(replace(ranking.model, hum=e.model.hum), fit)
        for e, (fit, _) in zip(kept, ranking.fits, strict=True)
    ]
    if humming and len(others) > 1:
        tones = ", ".join(f"{e.model.hum:.6g} Hz in {e.label}" for e in humming)
        text += f" Each record has its own hum: {tones}."
    return contradicting, others, {"drift": text}


def _drift_text(records: Sequence[DecayRecord], ranking: Ranking) -> str:
    """A sentence on the size of the drift in every record; "" without a drift."""
    if ranking.model.drift == "none":
        return ""
    fitted = [(e, Screening(e, ranking.model.thin), z) for e, (_, z) in zip(records, ranking.fits, strict=True)]
    sizes = (f"{s.drift(z) * e.column.to_display:.2g} {e.column.unit} in {e.label}" for e, s, z in fitted)
    return f" The zero drifts by {', '.join(sizes)}."
