"""Support spring: static force against deflection (paper, section 2.2)."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from scipy import stats

from capsule_id.experiments.base import LEVEL, Fitted, refit
from capsule_id.experiments.kind import Kind, Twin, TwinTable, Values, made_by
from capsule_id.experiments.point_test import LINE_MESSAGES, Line, line_estimates, lint_line, refuse_idle_sd_ratio
from capsule_id.parameters import INSTRUMENT_ERRORS, SPRINGS, by_index
from capsule_id.rig.model import Quantity, Settings
from capsule_id.rig.schema import ColumnRule, NameRule, QuantityRule
from capsule_id.views import Finding, Message

# declaration: Support spring: columns, settings, template and twin.


#: Deflections of the twin and their reading error, m, and noise of the force relative to full scale.
DEFLECTIONS, DEFLECTION_SD = np.linspace(0.0, 1e-3, 11), 1e-6
SPRING_NOISE = 0.002
#: Length of the medium spring, m, for the cantilever law of the twin; sd of a measured length, m.
LENGTH, LENGTH_SD = 60e-3, 0.1e-3


@dataclass(frozen=True, kw_only=True)
class SpringSettings(Settings):
    """Settings of a spring: name; free length, m; reading error of force / reading error of deflection, N/m."""

    spring: Annotated[str, NameRule()]
    length: Annotated[Quantity | None, QuantityRule("m", has_sd=True)] = None
    sd_ratio: Annotated[float | None, QuantityRule("N/m")] = None


def _measure(values: Values, rng: np.random.Generator, seed: int) -> Twin:
    tables = []
    # A generator of their own: the readings of the other tests do not depend on these errors.
    errors = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(2**21,)))
    for spring, k2 in by_index("k2", values).items():
        length = LENGTH * (SPRINGS["medium"] / k2) ** (1.0 / 3.0) + LENGTH_SD * rng.standard_normal()
        force = k2 * DEFLECTIONS
        columns = {
            "deflection [mm]": 1e3 * DEFLECTIONS + 1e3 * DEFLECTION_SD * errors.standard_normal(DEFLECTIONS.size),
            "force [N]": force + SPRING_NOISE * force[-1] * rng.standard_normal(DEFLECTIONS.size),
        }
        settings = (
            f'spring = "{spring}"',
            f'length = {{ value = {1e3 * length:.2f}, sd = {1e3 * LENGTH_SD:g}, unit = "mm" }}',
            f'deflection_sd = {{ value = {1e6 * DEFLECTION_SD:g}, unit = "um" }}',
            f'force_sd = {{ value = {1e3 * SPRING_NOISE * k2 * DEFLECTIONS[-1]:.3g}, unit = "mN" }}',
        )
        tables.append(TwinTable(f"support_spring_{spring}.csv", columns, settings))
    return Twin(tuple(tables))


TEMPLATE = """\
#: Force of a support spring against its deflection: its k2. Columns: deflection [mm], force [N]; a file per spring.
#: sd_ratio as above, in N/m.
# [[experiment]]
# kind = "support_spring"
# file = "support_spring_L60.csv"
# spring = "L60"
# length = { value = 60, sd = 0.5, unit = "mm" }
"""

CANTILEVER = Message(
    "cantilever law",
    ok="k2 ~ L^({exponent:.3f} ± {sd:.3f}), {p:p} for the -3 of a cantilever",
    warn=(
        "expected k2 ~ L^-3, as a cantilever has; found L^({exponent:.3f} ± {sd:.3f}), {p:p}. Check the clamp and the "
        "stated lengths; k2 of each spring stays a parameter of its own."
    ),
    fail=(
        "k2 must fall with the length, as L^-3, but it rises from {shortest} to {longest}: k2 ~ L^({exponent:.3f} ± {sd:.3f}), "
        "{p:p} for the exponent -3. Check whether files or lengths are exchanged."
    ),
)

KIND = Kind(
    name="support_spring",
    columns={"deflection": ColumnRule("m", varies=True), "force": ColumnRule("N", varies=True)},
    sets=(("deflection", "force"),),
    settings=SpringSettings,
    rules=(refuse_idle_sd_ratio,),
    read_by=INSTRUMENT_ERRORS,
    test="deflection",
    minutes=0.5,
    make=made_by(f"{__name__}:SupportSpring"),
    template=TEMPLATE,
    informs="k2 of that spring",
    captions={"support_spring": "The slope of the line is the stiffness of the support spring."},
    messages={**LINE_MESSAGES, "springs.cantilever": CANTILEVER},
    lint=(lint_line,),
    paper=line_estimates,
    twin=_measure,
)


# checks: Check of the cantilever law for support springs of stated length.


def cantilever_exponent(
    length: np.ndarray, length_sd: np.ndarray, k2: np.ndarray, log_k2_sd: np.ndarray
) -> tuple[float, float, float]:
    """Estimate the exponent of k2 ~ L^p by weighted least squares on logarithms, its sd, and the p-value of p = -3.

    A cantilever has p = -3 (Euler–Bernoulli; clamped end, tip load). Arrays are (springs,). The error of the length
    is propagated with the exponent -3 of the hypothesis.
    """
    weight = 1.0 / (log_k2_sd**2 + (3.0 * length_sd / length) ** 2)
    x = np.log(length) - np.average(np.log(length), weights=weight)
    exponent = float(np.sum(weight * x * np.log(k2)) / np.sum(weight * x**2))
    sd = float(1.0 / np.sqrt(np.sum(weight * x**2)))
    return exponent, sd, float(2.0 * stats.norm.sf(abs(exponent + 3.0) / sd))


#: Smallest range of the lengths that shows their law, in sd of a length.
RESOLVED = 3.0


def check_cantilever(springs: "Sequence[SupportSpring]", fit: Fitted) -> list[Finding]:
    """Check k2 ~ L^-3 over the springs, where lengths are stated."""
    pairs = [(e, e.table.settings.length) for e in springs if e.table.settings.length is not None]
    if len({e.slope.name for e, _ in pairs}) < 2:
        return []
    estimates = [refit(e, e.local(fit.values), fit.flagged.get(e.label, []))["k2"] for e, _ in pairs]
    k2, sd = (np.array(column) for column in zip(*estimates, strict=True))
    length, length_sd = np.array([(quantity.value, quantity.sd) for _, quantity in pairs]).T
    if np.ptp(length) <= RESOLVED * float(np.max(length_sd)):  # lengths that are equal show no law
        return []
    exponent, error, p = cantilever_exponent(length, length_sd, k2, sd / k2)
    facts = {"exponent": exponent, "sd": error, "p": p}
    if p >= LEVEL or exponent <= 0.0:
        return [Finding("springs.cantilever", "warn" if p < LEVEL else "ok", facts)]
    order = [pairs[i][0] for i in np.argsort(length)]
    facts |= {"shortest": order[0].label, "longest": order[-1].label}
    names = dict.fromkeys(e.slope.name for e in order)
    return [Finding("springs.cantilever", "fail", facts, parameters=tuple(names))]


# experiment: Support spring: static force against deflection (paper, section 2.2).


class SupportSpring(Line):
    """F = F0 + k2[spring] x."""

    x_name, reading, symbol = "deflection", "force", "k2"
    checks = (*Line.checks, check_cantilever)
