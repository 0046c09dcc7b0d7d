"""Choice of the model of free decays where the record contradicts the stated one.

A record demands another model where its residuals are not white, or where they correlate with the response to dry
friction, quadratic damping, a cubic spring or a drift. Every sum of the terms that the settings leave open is then fitted
to the record by maximum likelihood and ranked by BIC.
"""

import itertools
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy import stats

from capsule_id.experiments.checks.refit import refit
from capsule_id.experiments.checks.series import LEVEL, ljung_box
from capsule_id.experiments.free_vibration.decay_models import STRONGEST
from capsule_id.experiments.free_vibration.decrement import viscous_fit
from capsule_id.experiments.free_vibration.readings.blocks import block_size
from capsule_id.experiments.free_vibration.second_fit.fits import Screened, Screening
from capsule_id.experiments.free_vibration.second_fit.sensitivities import force_responses
from capsule_id.experiments.free_vibration.settings import DAMPING, MOST_PERIODS, DecayModel, first_periods
from capsule_id.physics.batches import pool
from capsule_id.records.noise import noise_level
from capsule_id.views import Finding

if TYPE_CHECKING:
    from capsule_id.experiments.free_vibration.experiment import FreeVibration

#: Records are thinned to this many readings per period before their models are ranked.
READINGS_PER_PERIOD = 16
#: Fewest readings per period of a thinned record.
FEWEST_PER_PERIOD = 8
#: Largest number of samples of a record that is no free decay.
LONGEST_UNCUT = 1000
#: Of forces whose BIC differs by less, the fewest are chosen: with seven alternatives, noise alone often gains this much.
BIC_MARGIN = 4.0
#: Shorter records, in samples, keep their model.
SHORTEST = 40
#: Residuals with a larger p-value of the Ljung–Box test count as white here; the check after the fit is more lenient.
WHITENESS = 0.01


def open_models(record: "FreeVibration") -> tuple[list[DecayModel], list[DecayModel]]:
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


def demands_another(record: "FreeVibration", level: float) -> bool:
    """Whether ``record`` contradicts its model at this false-alarm rate: residuals, or responses to further forces.

    A decay beyond ``STRONGEST`` damping keeps its model, because no other one is offered.
    """
    rough = record.rough_decrement()
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


def response_p(record: "FreeVibration", theta: Mapping[str, float]) -> float:
    """p-value of the F test for the responses of the rod to further forces and for a drift, at a viscous fit."""
    raw, design = record.unwhitened(theta, np)
    parts = np.linalg.lstsq(design, raw, rcond=None)[0]
    columns = force_responses(record, theta).values()
    relative = record.time / record.time[-1] - 0.5
    extra = np.column_stack([*columns, relative, relative**2])
    moved = [record.unwhitened({**theta, name: 1.001 * theta[name]}, np)[1] @ parts for name in ("k1", "c")]
    known = np.column_stack([design, *(column - design @ parts for column in moved)])
    both = np.concatenate([known, extra], axis=1)
    freedom = record.n - both.shape[1]
    if freedom < 1:
        return 1.0
    own, further = (
        # A column of zeros is no effect: quadratic damping of a record that stays where it is.
        float(np.sum((raw - a @ np.linalg.lstsq(a, raw, rcond=None)[0]) ** 2))
        for a in (x / np.maximum(np.linalg.norm(x, axis=0), np.finfo(float).tiny) for x in (known, both))
    )
    return float(stats.f.sf((own - further) / extra.shape[1] * freedom / further, extra.shape[1], freedom))


def thinning(record: "FreeVibration", per_period: float) -> int:
    """Return the block size that leaves about ``per_period`` readings; no less than that of the record."""
    return max(record.model.thin, block_size(*record.whole, per_period))


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
        nested = [one for one in done if one.model.nested_in(model)]
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
    for _, same_size in itertools.groupby(sorted(models, key=lambda one: one.size), lambda one: one.size):
        first, *level = same_size
        done += [*([] if done else [fitted(first)]), *pool().map(fitted, [first, *level] if done else level)]
    return sorted(done, key=lambda one: one.bic)


def simplest(ranked: Sequence[Ranking]) -> Ranking:
    """Return the model with the fewest forces whose BIC is within ``BIC_MARGIN`` of the best one, the first."""
    near = [one for one in ranked if one.bic <= ranked[0].bic + BIC_MARGIN]
    return min(near, key=lambda one: len(one.model.symbols))


def demanded_model(records: Sequence["FreeVibration"]) -> Ranking:
    """Return the model with the lowest BIC of all ``records`` together, thinned until its residuals are white.

    The forces are chosen first on thinned records, with the richest noise that the settings leave open, then drift and
    noise. The fits of fewer forces become starts of the quoted fit.
    """
    forces, others = open_models(records[0])
    coarse = thinning(records[0], READINGS_PER_PERIOD)
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
    records: Sequence["FreeVibration"], ranked: list[Ranking], others: Sequence[DecayModel], coarse: int
) -> Ranking:
    """Choose drift and noise, from the ranking of all of them on records thinned by ``coarse``.

    At high sampling rates no offered noise may be white. Fewer samples then lose little, because they are correlated.
    """
    best = ranked[0]
    if records[0].table.settings.thin is not None:
        return best
    fewest = max(coarse, thinning(records[0], FEWEST_PER_PERIOD))
    # More samples of the same record show the same misfit with more certainty.
    offered = any(one.white for one in ranked)
    thin = records[0].model.thin if offered else fewest
    while thin <= fewest:
        screenings = [Screening(record, thin) for record in records]
        rich = rank(screenings, [replace(best.model, noise=others[-1].noise)], best)[0]
        if rich.white:
            ranked = rank(screenings, others, rich)
            return next((replace(one, model=replace(one.model, thin=thin)) for one in ranked if one.white), rich)
        thin *= 2
    return replace(best, model=replace(best.model, thin=coarse))


def second_models(
    records: Sequence["FreeVibration"], readings: Sequence[Finding] = ()
) -> tuple[list["FreeVibration"], list[Finding]]:
    """Return ``records`` under the model that they demand, and findings that name it.

    Records with more than a free decay according to ``readings``, the findings on the readings, keep their model. Their
    fit fails in any case, so long ones are thinned.
    """
    level = LEVEL / len(records)
    chosen, findings = list(records), list[Finding]()
    groups: dict[Any, list[int]] = {}
    no_decay = {f.experiment for f in readings if f.level == "fail" and f.code in ("decays.release", "decays.second")}
    for i, record in enumerate(records):
        settings = record.table.settings
        stiffness = settings.stiffness if settings.offers_cubic else "linear"
        stated = settings.damping, stiffness, settings.drift, settings.noise
        if record.label not in no_decay:
            groups.setdefault(stated, []).append(i)
        elif None in stated:
            thin = settings.thin or max(1, len(record.whole[0]) // LONGEST_UNCUT)
            chosen[i] = record.with_model(replace(record.model, thin=thin))
            findings.append(Finding("decays.first_fit", "warn", {"record": record.label, "thin": thin}, record.label))
    for stated, members in groups.items():
        own = [records[i] for i in members]
        if None not in stated:
            continue
        contradicting = [e.label for e in own if e.n >= SHORTEST and demands_another(e, level)]
        if not contradicting:
            continue
        own = [e.with_table(first_periods(e.table)) for e in own]
        ranking = demanded_model(own)
        model = ranking.model
        if model != own[0].model:
            facts = {"labels": contradicting, "first": own[0].model.name, "second": model.name, "lines": model.lines}
            facts["drift"] = _drift_text(own, ranking)
            if model.slow and any(part.n < records[i].n for i, part in zip(members, own, strict=True)):
                facts["drift"] += f" The second fit uses the first {MOST_PERIODS} periods of each record."
            findings.append(Finding("decays.second_fit", "warn", facts, contradicting[0]))
            for i, part, (screened, _) in zip(members, own, ranking.fits, strict=True):
                chosen[i] = (part if model.slow else records[i]).with_model(model, screened)
    return chosen, findings


def _drift_text(records: Sequence["FreeVibration"], ranking: Ranking) -> str:
    """A sentence on the size of the drift in every record; "" without a drift."""
    if ranking.model.drift == "none":
        return ""
    sizes = []
    for record, (_, z) in zip(records, ranking.fits, strict=True):
        size = Screening(record, ranking.model.thin).drift(z) * record.column.to_display
        sizes.append(f"{size:.2g} {record.column.unit} in {record.label}")
    return f" The zero drifts by {', '.join(sizes)}."
