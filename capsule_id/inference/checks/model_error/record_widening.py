"""Error of the model in runs and decays, from the scores of parts of their records.

residuals and Jacobian at the fit -> derivative with respect to one parameter, the others refitted
    -> step of that parameter from every part -> chi-square between the parts (``widening``)

A run, or a decay with an amplitude, a drift or noise of its own, determines some parameters only as a whole, so its
parts are not fitted. Each part gives a Gauss-Newton step of one parameter and its sd. A record is divided into
successive whole periods, that of a run also by phase of the excitation. A misfit that repeats with every period shows
between phases only. The widest interval counts.
"""

from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Float, Int

from capsule_id.experiments.base import Experiment
from capsule_id.inference.checks.model_error.widening import (
    FEWEST_PARTS,
    LARGEST_RELATIVE_SD,
    MOST_PARTS,
    Widening,
    has_own_nuisances,
    widening,
)
from capsule_id.inference.checks.sampled_fit import SampledFit
from capsule_id.inference.fit.point_fit import residual_jacobian
from capsule_id.parameters import is_stated
from capsule_id.records.noise import length_of_motion

#: Parts of an excitation period. They are long beside most waves of a misfit, so that their steps are independent.
PHASES = 6
#: Number of the priors, which every part meets. Without them the step of a parameter that the data leave open has no end.
PRIORS = -2
#: Numbers of the parts of the n samples of a record; None where it cannot be divided in this way.
Division = Callable[[Experiment], Int[np.ndarray, " n"] | None]


def record_widenings(s: SampledFit) -> dict[str, Widening]:
    """Error of the model of every physical parameter of a run or a decay with a failed check, by name."""
    failed = {f.experiment for f in s.findings if f.level == "fail" and f.experiment}
    records = [e for e in s.experiments if {e.label, e.table.label} & failed and has_own_nuisances(e)]
    if not any(e.cycles is not None for e in records):
        return {}
    # Stated values are no estimates from the parts: ``beside_stated`` adds their share of the sd.
    located = np.array([i for i in s.target.located if not is_stated(s.target.names[i])])
    jacobian, residuals = residual_jacobian(s.target, s.fit.u)[:, located], s.target.plain_residuals(s.fit.u)
    informed = {row.name for e in records for row in e.parameters if row.physical}
    found = {}
    for division in (by_time, by_phase):
        part = parts_of_residuals(s, records, division)
        for k, i in enumerate(located.tolist()):
            name, largest_sd = s.target.names[i], LARGEST_RELATIVE_SD
            if name not in informed:
                continue
            largest_sd *= 1.0 if s.target.positive[i] else abs(s.fit.u[i])
            pairs = [pair for pair in steps_of_parts(jacobian, residuals, k, part) if pair[1] < largest_sd]
            one = widening(pairs) if len(pairs) >= FEWEST_PARTS else None
            if one and one.factor > 1.0 and (name not in found or one.stretch > found[name].stretch):
                found[name] = one
    return found


def by_time(record: Experiment) -> Int[np.ndarray, " n"] | None:
    """Successive parts of whole periods, about equally long; -1: the end of a decay, which is all noise."""
    if record.cycles is None:
        return None
    cycle = (record.cycles - record.cycles[0]).astype(int)
    end = len(cycle) if record.event_driven else length_of_motion(record.observed)
    number = int(cycle[end - 1]) + 1
    return np.where(np.arange(len(cycle)) < end, cycle * min(number, MOST_PARTS) // number, -1)


def by_phase(record: Experiment) -> Int[np.ndarray, " n"] | None:
    """The same parts of every excitation period; None of a decay, whose period is not exactly known."""
    if record.cycles is None or not record.event_driven:
        return None
    return (record.cycles % 1.0 * PHASES).astype(int) % PHASES


def parts_of_residuals(s: SampledFit, records: Sequence[Experiment], division: Division) -> Int[np.ndarray, " m"]:
    """Part of each of ``LogPosterior.plain_residuals``; -1, one more part, for other experiments; ``PRIORS`` for priors."""
    parts, used = [], 0
    for e in s.experiments:
        own = np.full(len(e.residuals(e.local(s.values), np)), -1)
        numbers = next((division(one) for one in records if one is e), None)
        if numbers is not None:
            channels = e.n // len(numbers)
            own[: channels * len(numbers)] = np.tile(np.where(numbers < 0, -1, used + numbers), channels)
            used += int(np.max(numbers)) + 1
        parts.append(own)
    return np.concatenate([*parts, np.full(s.target.dimension, PRIORS)])


def steps_of_parts(
    jacobian: Float[np.ndarray, "m d"], residuals: Float[np.ndarray, " m"], k: int, part: Int[np.ndarray, " m"]
) -> list[tuple[float, float]]:
    """Gauss-Newton step of parameter k and its sd from every part that informs it.

    A part meets the other parameters as the rest of the data gives them: the fit to all of the data has adapted them
    to the misfit of the part itself. A part without which the fit has no solution, or one less certain than the part, gives
    no step: the first period of a strong decay holds most of what the record tells.
    """
    scale = np.maximum(np.linalg.norm(jacobian, axis=0), np.finfo(float).tiny)
    jacobian = jacobian / scale
    others = np.linalg.qr(np.delete(jacobian, k, axis=1))[0]
    own = jacobian[:, k] - others @ (others.T @ jacobian[:, k])
    pairs = []
    for number in np.unique(part[part != PRIORS]):
        rows, rest = part == number, part != number
        information = float(np.sum(own[rows] ** 2))
        if information == 0.0 or np.linalg.matrix_rank(jacobian[rest]) < jacobian.shape[1]:
            continue
        effect = -own[rows] @ jacobian[rows] / information
        effect[k] += 1.0
        if effect @ np.linalg.solve(jacobian[rest].T @ jacobian[rest], effect) > 1.0 / information:
            continue
        step = np.linalg.lstsq(jacobian[rest], -residuals[rest], rcond=None)[0]
        beyond = residuals[rows] + jacobian[rows] @ step
        value = step[k] - float(own[rows] @ beyond) / information
        pairs.append((value / scale[k], information**-0.5 / scale[k]))
    return pairs
