"""The words of the report for the checks and tables of a fit, by code; kinds of experiments declare those of their own."""

from collections.abc import Mapping
from typing import Literal

from capsule_id.errors import InputError
from capsule_id.experiments.free_vibration.lint import TONE
from capsule_id.experiments.registry import Registry
from capsule_id.report.texts.posterior import POSTERIOR_MESSAGES
from capsule_id.report.texts.readings import DATA_MESSAGES
from capsule_id.views import Facts, Finding, Level, Message, ResultTable, counted, filled_in, stated_p

#: Errors of a text that does not match its facts.
TEXT_ERRORS = (LookupError, ValueError, TypeError, AttributeError, ArithmeticError)


def messages_of(registry: Registry) -> Mapping[str, Message]:
    """The words of every code: those of the fit, of the readings, and those that the kinds of ``registry`` declare.

    Raises
    ------
    InputError
        If a kind declares a code of the fit as a whole.
    """
    for kind in registry.kinds:
        if own := sorted((FIT_MESSAGES.keys() | DATA_MESSAGES.keys()) & kind.messages.keys()):
            rule = f"the kind {kind.name} must not declare messages of the whole fit"
            raise InputError(rule, ", ".join(own), "rename these codes in the kind's messages")
    return {**FIT_MESSAGES, **DATA_MESSAGES, **registry.messages}


def title_of(code: str, messages: Mapping[str, Message]) -> str:
    """The title of a check or a table; the code itself where no kind declares words for it."""
    return messages[code].title if code in messages else code


def finding_text(finding: Finding, messages: Mapping[str, Message]) -> str:
    """The text of a finding, with its experiment in front where the text does not name it itself.

    A finding whose code has no words, or faulty ones, is given by its facts.
    """
    if finding.code in messages:
        text = _filled_in(finding.code, finding.level, finding.facts, messages)
    else:
        text = _listed(finding.facts)
    if not finding.experiment or finding.experiment in text:
        return text
    return f"{finding.experiment}: {text}"


def caption_of(table: ResultTable, messages: Mapping[str, Message]) -> str:
    """The caption of a table; its facts where the caption is faulty, "" where no kind declares words for it."""
    return _filled_in(table.code, "caption", table.facts, messages) if table.code in messages else ""


def _filled_in(code: str, part: Level | Literal["caption"], facts: Facts, messages: Mapping[str, Message]) -> str:
    """The text of a code; where the text is faulty, the error and the facts. A faulty text must not end a fit."""
    try:
        return messages[code].text(part, facts)
    except TEXT_ERRORS as error:
        return (
            f"the words of {code} are faulty ({type(error).__name__}: {error}); the facts: {_listed(facts) or 'none'}"
        )


def _listed(facts: Facts) -> str:
    return ", ".join(f"{name} = {value}" for name, value in facts.items())


def _coloured_residuals(facts: Facts) -> str:
    """The statistic, what drifts in the record, and the remedy of the model that predicts it."""
    seen = (
        f"{facts['record']}: expected residuals without correlation in time (white); found Ljung–Box "
        f"Q = {facts['Q']:.0f} over {facts['lags']} lags "
        f"({stated_p(facts['p'])}). The model lacks an effect or the noise is coloured, and the intervals are not to be "
        "trusted."
    )
    remedy = {"capsule": _capsule_remedy(facts), "decay": _decay_remedy(facts)}.get(
        facts.get("model", ""), "Look at the residuals."
    )
    return " ".join(filter(None, [seen, _drift(facts), remedy]))


def _capsule_remedy(facts: Facts) -> str:
    """What to compare: the friction law, of which the fit knows one alone, and the noise."""
    advice = "Look at the residuals and the phase portrait."
    if facts.get("spring"):
        advice += " Check the support spring and the gap."
    if laws := facts.get("other_laws", ()):
        advice += f" The fit has {facts['law']}; compare it with {' or '.join(laws)} in [model]."
    if facts.get("noise") == "white":
        advice += (
            ' Where the sensor filters, remove noise = "white" from the entry: a second fit then has coloured noise.'
        )
    return advice


def _decay_remedy(facts: Facts) -> str:
    """What the fitted model of a free decay contains, and what is left to do."""
    if facts.get("model") != "decay":
        return ""
    present = f"Present in the fitted model: {', '.join(facts['present'])}. " if facts["present"] else ""
    if facts.get("tone"):
        return present + filled_in(TONE, facts)
    cut = "Cut the record to free decay with start and stop"
    if (start := facts.get("start")) is not None:
        cut = f'Leave out the larger half of the amplitudes: write start = {{ value = {start:.10g}, unit = "s" }} in its entry'
    if facts["second"]:
        return f"{present}No model that a second fit offers passes. {cut}, or record again with less disturbance."
    if not facts.get("stated"):
        return f"{present}{cut}, or record again with less disturbance."
    words = facts["stated"]
    listed = " and ".join(filter(None, [", ".join(words[:-1]), words[-1]]))
    them = "them" if len(words) > 1 else "it"
    return f"{present}{cut}, or remove {listed} from its entry: a second fit then chooses {them}."


def _drift(facts: Facts) -> str:
    """What drifts while a decay dies away."""
    parts = []
    if "decrement" in facts:
        first, last = facts["decrement"]
        law = "the damping grows with amplitude" if first > last else "the damping grows as the amplitude falls"
        parts.append(f"its logarithmic decrement goes from {first:.3g} to {last:.3g} ({law})")
    if "frequency" in facts:
        first, last = facts["frequency"]
        law = "the stiffness falls with amplitude" if first < last else "the stiffness grows with amplitude"
        parts.append(f"its frequency goes from {first:.4g} to {last:.4g} rad/s ({law})")
    if not parts:
        return ""
    large, small = facts["amplitude"]
    return f"While the amplitude falls from {large:.2g} to {small:.2g} m, {' and '.join(parts)}."


def _after_number(unit: str) -> str:
    """A unit behind a number; nothing for a number without unit."""
    return "" if unit == "1" else f" {unit}"


def _outliers(facts: Facts) -> str:
    """The lines of the file, how far they stand off, and what they do to the estimates."""
    lines = [str(line) for line in facts["lines"]]
    several = len(lines) > 1
    where = f"lines {', '.join(lines[:-1])} and {lines[-1]} stand up to" if several else f"line {lines[0]} stands"
    more = f" At most {facts['most']} rows are named: look at the whole table." if len(lines) == facts["most"] else ""
    change = "; ".join(
        f"{name} = {value:.5g}{_after_number(unit)} with {'them' if several else 'it'}, {without:.5g} without"
        for name, unit, value, without in facts["estimates"]
    )
    return (
        f"{facts['file']} {where} {facts['score']:.3g} standard deviations off the others ({stated_p(facts['p'])}).{more} "
        f"{change}. Nothing was dropped: check the reading, then correct it or remove it yourself."
    )


def _tables_disagree(facts: Facts) -> str:
    """The estimate of each table, and what to do."""
    unit = _after_number(facts["unit"])
    estimates = ", ".join(f"{value:.4g}{unit} by {label}" for label, value in facts["estimates"])
    return (
        f"expected tables that agree; found {facts['name']} = {estimates} ({stated_p(facts['p'])}). It depends on "
        f"what differs between them, such as load, day or speed; an sd of independent trials is too small by a factor of about "
        f"{facts['factor']:.1f}. Find the cause, or fit each table in a folder of its own."
    )


def _loads_differ(facts: Facts) -> str:
    """The coefficient at the loads, the lowest and the highest where there are many."""
    means = facts["means"]
    shown = means if len(means) <= 6 else [means[0], means[len(means) // 2], means[-1]]
    values = ", ".join(f"{coefficient:.3g} at {load:.3g} N" for load, coefficient in shown)
    return (
        f"expected friction in proportion to the normal force; found a coefficient of {values} ({stated_p(facts['p'])}). One "
        "coefficient does not hold for all loads. Fit the rows of similar loads in a folder of their own, and use the load "
        "that is nearest to the weight of the capsule. Where the speed changes with the load, look first at the friction law."
    )


def _unseen(facts: Facts) -> str:
    """The smallest error that a check of a setting sees in 8 of 10 cases, by parameter."""
    errors = ", ".join(f"{name} by {sd:.3g} sd" for name, sd in facts["unseen"].items() if sd < float("inf"))
    return f"the check sees it in 8 of 10 cases where it shifts {errors}" if errors else "too few rows to see it"


#: What a statistic of the residuals that is too large means.
_STATISTICS: Mapping[str, str] = {
    "sign runs": "too many neighbours have the same sign",
    "largest": "one of them is too large",
    "trend": "they change slowly from the first reading to the last",
}


def _unlike_noise(facts: Facts) -> str:
    return (
        f"expected residuals like random noise; {_STATISTICS[facts['statistic']]} ({stated_p(facts['p'])}). A larger scatter "
        "does not explain this. Look at the residuals: a bend, a wrong model or a wrong reading."
    )


def _largest_disagreement(facts: Facts) -> str:
    (name, sd, p), *_ = facts["distances"]
    judge = " by the bench's sample" if facts["sampled"] else ""
    return (
        f"largest disagreement in {name} ({sd:+.1f} sd of the curvature, {stated_p(p)}{judge} over "
        f"{counted(facts['shared'], 'shared parameter')})"
    )


def _inconsistent(facts: Facts) -> str:
    (name, *_), *others = facts["distances"]
    further = "".join(f", then {other} ({sd:+.1f} sd, {stated_p(p)})" for other, sd, p in others)
    return (
        f"bench tests and forced runs are inconsistent: {_largest_disagreement(facts)}{further}. The bench's {name} does "
        f"not fit the recorded motion. Check units, clock and calibration of {facts['tests'] or 'its bench test'} and repeat "
        "it, or find what differs in the runs."
    )


FIT_MESSAGES: Mapping[str, Message] = {
    **POSTERIOR_MESSAGES,
    "residuals.white": Message(
        "residuals white",
        ok="residuals of {records:# record} are white (Ljung–Box, {lags} lags)",
        fail=_coloured_residuals,
    ),
    "trials.order": Message(
        "order of trials",
        ok="residuals of neighbouring rows are uncorrelated in {number:# table}",
        fail=(
            "expected residuals without order; those of neighbouring rows have correlation {correlation:.2f} over {rows} rows "
            "({p:p}). The trials drift or come in sessions: an sd of independent trials is too small by a factor "
            "of about {factor:.1f}. Repeat the trials in random order, with the test set up anew between them."
        ),
    ),
    "trials.tables": Message(
        "agreement of tables",
        ok="{number:# table} of equal tests agree within their scatter",
        fail=_tables_disagree,
    ),
    "trials.loads": Message(
        "friction against load",
        ok=lambda facts: f"no constant force beside the friction; {_unseen(facts)}",
        warn=lambda facts: (
            f"{counted(facts['rows'], 'row')} cannot show whether friction is in proportion to the normal force: a constant "
            f"force beside it may be there, and {_unseen(facts)}. Repeat the trials, at loads further apart, or fit the rows "
            "of one load in a folder of their own."
        ),
        fail=_loads_differ,
    ),
    "trials.speeds": Message(
        "friction against speed",
        ok=lambda facts: f"no other fall of the friction with the speed; {_unseen(facts)}",
        warn=lambda facts: (
            f"expected friction that falls with the speed as the law says; another fall, as with a constant force, has "
            f"{stated_p(facts['p'])} in {counted(facts['rows'], 'row')}, and {_unseen(facts)}. Repeat the trials, at speeds "
            "further apart, or compare the friction laws in the report."
        ),
    ),
    "residuals.statistics": Message(
        "residuals like noise",
        ok="signs, largest residual and trend of {number:# bench test} are those of random noise",
        warn=_unlike_noise,
        fail=_unlike_noise,
    ),
    "model.error": Message(
        "model error",
        warn=lambda facts: (
            "estimates from parts of the data scatter more than their sds say, so the quoted sd is multiplied by "
            + ", ".join(f"{factor:.3g} for {name} ({parts} parts)" for name, factor, parts in facts["factors"])
            + ". It is an estimate of the model's error; find its cause before you use the number."
        ),
        fail=lambda facts: (
            "parts of the data contradict each other, so there is no number for "
            + ", ".join(f"{name} (its sd would be multiplied by {factor:.3g})" for name, factor, _ in facts["factors"])
            + ". The model does not describe these readings: find the cause that the other failed checks name."
        ),
    ),
    "outliers": Message("outliers", ok="no reading stands apart from the others of its table", fail=_outliers),
    "errors.stated": Message(
        "stated errors",
        ok="stated reading errors explain the scatter",
        fail=(
            "expected a chi-square of about {freedom} from the stated reading errors; found {chi_square:.0f} "
            "({p:p}). The errors are larger than stated, or the line is not straight."
        ),
    ),
    "bench_and_runs.agree": Message(
        "bench and runs agree", ok=_largest_disagreement, warn=_inconsistent, fail=_inconsistent
    ),
    "bench_and_runs.estimates": Message(
        "bench and runs agree",
        warn=lambda facts: (
            f"expected finite estimates of {counted(facts['shared'], 'shared parameter')} from bench and runs; "
            f"there is none of {', '.join(facts['missing'])}, so nothing was compared. "
            "Look at what the records and tests determine."
        ),
    ),
    "runs.precision": Message(
        "Precision gained from forced runs",
        caption=(
            "Posterior standard deviation, SI. Runs only: from the curvature of their likelihood and the priors at the joint "
            "point fit. Bench and both: from the samples, where they were drawn."
        ),
    ),
    "runs.smoothing": Message(
        "Effect of smoothing",
        caption=(
            "The posterior is that of the exact model. A fit of the smoothed model (velocity {velocity:g} m/s, penetration "
            "{penetration:g} m) would shift the estimates by this much (u: logarithm)."
        ),
    ),
    "parameters.shares": Message(
        "Where the sd comes from",
        caption=(
            "Share of the two largest inputs in the variance of each parameter, from the curvature at the maximum: a table, a "
            "stated value with its sd (a weighing), or a prior."
        ),
    ),
    "parameters.priors": Message(
        "Priors",
        caption=(
            "Every prior is proper; a factor f holds 95 % within median/f to median×f. Amplitudes, offsets and intercepts "
            "have normal priors ten times as wide as their record and are integrated out in closed form."
        ),
    ),
    "readings.predictive": Message(
        "Posterior predictive checks",
        caption=(
            "Probability that a replicate misses the model by more than the readings do (chi-square discrepancy). Near 0: "
            "the readings scatter more than the fit allows. Where the scatter itself is estimated, it is near 0.5 by "
            "construction."
        ),
    ),
}
