"""Forces that the fitted model lacks, that the records cannot exclude, and that would change the quoted values.

A short record of a decay fits viscous damping as well as its sum with dry friction, and the two give different values of
c. The fit is linear in a small further force, so one least-squares step gives the largest force that the records allow,
and the values beside it.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from scipy import stats

from capsule_id.experiments.checks.context import Fitted
from capsule_id.experiments.free_vibration.decay_models import STRONGEST
from capsule_id.experiments.free_vibration.second_fit.sensitivities import (
    further_sensitivities,
    sensitivities,
    whitened,
)
from capsule_id.experiments.free_vibration.settings import DecayModel, DecaySettings
from capsule_id.parameters import parameter
from capsule_id.rig.model import Table
from capsule_id.views import Facts, Finding

if TYPE_CHECKING:
    from capsule_id.experiments.free_vibration.experiment import FreeVibration

#: Probability that a further force is below its limit.
LIMIT = 0.975
#: Changes of c and of k1 by a force at its limit that matter: relative to the value, and in standard errors.
CHANGES: Mapping[str, float] = {"c": 0.2, "k1": 0.05}
CHANGE_IN_ERRORS = 3.0
#: Responses to a force that are shorter than this beside the nuisances, relative to their length, are rounding.
UNSEEN = 1e-6
#: Estimates further below zero, in standard errors, count as this one.
LOWEST = -30.0


@dataclass(frozen=True)
class Hidden:
    """A further force, and its effect on the parameters of the model without it.

    Attributes
    ----------
    estimate, sd : of its parameter, SI; the estimate of a force that damps may be negative
    slopes : change of each parameter by unit of it, SI
    errors : standard errors of the parameters without it, SI
    """

    estimate: float
    sd: float
    slopes: Mapping[str, float]
    errors: Mapping[str, float]

    def limits(self, signed: bool) -> tuple[float, float]:
        """Smallest and largest value, SI, at the level ``LIMIT``; of one that is not ``signed`` the smallest is 0."""
        if signed:
            width = self.sd * float(stats.norm.isf(1.0 - LIMIT))
            return self.estimate - width, self.estimate + width
        # Far below zero the posterior above zero is exponential: its limit goes to 0.
        ratio = max(self.estimate / self.sd, LOWEST)
        beyond = (1.0 - LIMIT) * float(stats.norm.cdf(ratio))
        return 0.0, self.sd * (ratio + float(stats.norm.isf(beyond)))


class Decay(Protocol):
    """A record or the turning points of a decay."""

    model: DecayModel

    @property
    def label(self) -> str: ...

    @property
    def table(self) -> Table[DecaySettings]: ...

    def local(self, values: Mapping[str, float]) -> dict[str, float]:
        """Select values by symbol from values by name."""
        ...

    def reduced(self, theta: Mapping[str, float]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Derivatives (n, p) and (n, q), and residuals (n,), in units of the noise, without own nuisances.

        Derivatives with respect to k1, c and ``model.symbols``, and to the forces that the model lacks.
        """
        ...


def check_hidden_terms(records: Sequence[Decay], fit: Fitted) -> list[Finding]:
    """Check that viscous records exclude further forces that would change c or k1 by much, where the settings allow them."""
    groups: dict[Any, list[Decay]] = {}
    for e in records:
        # A record that demands a further damping seldom excludes another one as well.
        if not e.model.damping and (symbols := open_forces(e)):
            groups.setdefault((symbols, e.model.cubic, e.table.settings.offers_cubic), []).append(e)
    findings, compared = [], []
    for (offered, _, offers_cubic), members in groups.items():
        terms = hidden_terms(members, fit.values)
        offered = tuple(symbol for symbol in offered if symbol in terms)
        theta = members[0].local(fit.values)
        # No record of a decay that does not swing excludes these forces, so the stated model is believed.
        swings = theta["c"] < 2.0 * STRONGEST * np.sqrt(theta["k1"] * theta["m1"])
        facts = {"labels": [e.label for e in members], "offers_cubic": offers_cubic, "swings": swings}
        compared += facts["labels"]
        findings += [
            Finding("decays.hidden", "fail", {**facts, **changed}, parameters=(name,))
            if swings
            else Finding("decays.hidden", "warn", {**facts, **changed})
            for name in CHANGES
            if (changed := _change(name, fit.values[name], {symbol: terms[symbol] for symbol in offered}))
        ]
    if compared and not findings:
        findings.append(Finding("decays.hidden", "ok", {"labels": ", ".join(compared)}))
    return findings


def open_forces(e: Decay) -> tuple[str, ...]:
    """Symbols of the forces that the model of ``e`` lacks and whose words the settings leave open."""
    settings = e.table.settings
    return tuple(
        symbol for symbol in e.model.absent if (settings.stiffness if symbol == "k_cubic" else settings.damping) is None
    )


def _change(name: str, value: float, terms: Mapping[str, Hidden]) -> Facts:
    """Forces that change the parameter ``name`` by too much, and its limits beside them, SI; empty without one."""
    ends, symbols, largest = [value], [], []
    for symbol, term in terms.items():
        changes = [term.slopes[name] * end for end in term.limits(symbol == "k_cubic")]
        error = term.errors[name]
        if max(np.abs(changes)) > max(CHANGES[name] * value, CHANGE_IN_ERRORS * error):
            ends += [value + change + side * 1.96 * error for change in changes for side in (-1.0, 1.0)]
            symbols.append(symbol)
            largest.append(max(np.abs(term.limits(symbol == "k_cubic"))))
    if not symbols:
        return {}
    facts = {"name": name, "unit": parameter(name).unit, "value": value, "low": max(0.0, min(ends)), "high": max(ends)}
    return {**facts, "symbols": symbols, "largest": largest}


def hidden_terms(records: Sequence[Decay], values: Mapping[str, float]) -> dict[str, Hidden]:
    """Every force that the common model of ``records`` lacks, by symbol; ``values`` of the fit, SI."""
    blocks = [e.reduced(e.local(values)) for e in records]
    known, further, left = (np.concatenate(part) for part in zip(*blocks, strict=True))
    model = records[0].model
    names = ("k1", "c", *model.symbols)
    size = np.linalg.norm(known, axis=0)
    size = np.where(size > 0.0, size, 1.0)
    inverse = np.linalg.pinv(known / size) / size[:, None]
    errors = dict(zip(names, np.linalg.norm(inverse, axis=1), strict=True))
    found = {}
    for symbol, column in zip(model.absent, further.T, strict=True):
        change = inverse @ column
        own = column - known @ change
        if not column.any():
            continue
        power = max(float(own @ own), np.finfo(float).tiny)
        slopes = dict(zip(names, -change, strict=True))
        found[symbol] = Hidden(-float(own @ left) / power, power**-0.5, slopes, errors)
    return found


def reduced_record(e: "FreeVibration", theta: Mapping[str, float]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """``Decay.reduced`` of a record."""
    left, design, moved = sensitivities(e, theta)
    further = further_sensitivities(e, theta)
    shared = np.column_stack([moved.pop(name) for name in ("k1", "c", *e.model.symbols)])
    own = whitened(e, theta, np.column_stack([design, *moved.values()]))
    own = np.linalg.qr(own / np.linalg.norm(own, axis=0))[0]
    parts = [
        whitened(e, theta, part)
        for part in (shared, np.column_stack([further[s] for s in e.model.absent]), left[:, None])
    ]
    known, others, residuals = (part - own @ (own.T @ part) for part in parts)
    # The offset takes up dry friction in a decay that does not swing: only rounding is left of it.
    others[:, np.linalg.norm(others, axis=0) <= UNSEEN * np.linalg.norm(parts[1], axis=0)] = 0.0
    misfit = residuals - known @ np.linalg.lstsq(known, residuals, rcond=None)[0]
    noise = np.sqrt(np.sum(misfit**2) / max(e.n - own.shape[1] - known.shape[1], 1))
    return known / noise, others / noise, residuals[:, 0] / noise
