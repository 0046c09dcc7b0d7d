"""What would improve a result: the steps that the first screen of the report lists."""

import re
from collections.abc import Iterator

import numpy as np

from capsule_id.inference.result import STATED, Result
from capsule_id.parameters import is_stated, symbol_of
from capsule_id.report.texts.messages import finding_text, messages_of
from capsule_id.views import Finding

#: Share of a variance above which one input decides the sd.
DECISIVE = 0.5
#: Share below which an input is not named.
SMALL = 0.05


def next_steps(result: Result) -> list[tuple[str, str]]:
    """Pairs of a heading and a sentence, the most urgent first."""
    return [*_faults(result), *_missing(result), *_inputs(result), *_widest(result)]


def _faults(result: Result) -> Iterator[tuple[str, str]]:
    """Failed checks, then warnings that leave a parameter unjudged; the finding says what to do."""
    messages = messages_of(result.registry)
    for level, heading in (("fail", "Correct"), ("warn", "Look at")):
        for finding in result.findings:
            if finding.level == level and (level == "fail" or finding.parameters):
                yield f"{heading} {_place(finding)}", finding_text(finding, messages)


def _place(finding: Finding) -> str:
    if finding.experiment:
        return f"experiment {finding.experiment}"
    return ", ".join(finding.parameters) or "the whole fit"


def _missing(result: Result) -> Iterator[tuple[str, str]]:
    if result.posterior is None:
        # A fit that goes on shows its point fit first.
        unfinished = any(finding.code == "sample.unfinished" for finding in result.findings)
        how = "Wait for the end of fit-params" if unfinished else "Run fit-params without --no-sample"
        yield "Sample", f"{how}: only a sample gives intervals and lets checks judge the numbers."
        return
    names = [str(name) for name in result.summary.index if not is_stated(name)]
    for name in names:
        # NaN for an exact constant: nothing is to be measured.
        if f"{result.summary.at[name, 'informed']}" == "False":
            kinds = " or ".join(_kinds(result, name)) or "another test"
            yield f"Measure {name}", f"The data hardly narrow the prior of {name}. Add a table of {kinds}."


def _inputs(result: Result) -> Iterator[tuple[str, str]]:
    """Stated values whose sd decides that of other parameters: more readings do not narrow these."""
    gains: dict[str, dict[str, str]] = {}
    for name in _quotable(result):
        source, share = _largest_input(result, name)
        if source.startswith(STATED) and source != f"{STATED}{name}" and share > DECISIVE:
            gains.setdefault(source.removeprefix(STATED), {})[name] = _factor(1.0 - share)
    for stated, factors in gains.items():
        verb = "Weigh" if stated in ("m1", "m2") else "Measure"
        yield (
            f"{verb} {stated} more precisely",
            f"The sd of {', '.join(factors)} comes mainly from the stated sd of {stated}. With an exact {stated} it would be "
            f"at least {', '.join(factors.values())} times smaller; more readings of the tests help little.",
        )


def _widest(result: Result) -> Iterator[tuple[str, str]]:
    """The parameter with the largest relative sd among those that readings decide, and the tables that decide it."""
    rows = result.summary.loc[_quotable(result)]
    relative = (rows["sd"].astype(float) / rows["value"].astype(float).abs()).replace([np.inf], np.nan).dropna()
    tables = {table.label: table for table in result.rig.tables}
    decided = [str(name) for name in relative.index if _largest_input(result, str(name))[0] in tables]
    if not decided:
        return
    name = str(relative[decided].idxmax())
    first = tables[_largest_input(result, name)[0]]
    shares = result.point_fit.shares[name]
    alike = [table for table in tables.values() if table.kind == first.kind and shares.get(table.label, 0.0) > SMALL]
    factor = _factor(1.0 - 0.75 * sum(shares[table.label] for table in alike))
    labels = ", ".join(table.label for table in alike)
    number = sum(len(table.rows) for table in alike)
    more = "such records" if "time" in first.columns else f"such rows (now {number})"
    sentence = f"{name} has the largest relative sd, {100.0 * relative[name]:.2g} %, mainly from {labels}."
    yield f"Narrow {name}", f"{sentence} With four times as many {more} it would be at least {factor} times smaller."


def _quotable(result: Result) -> list[str]:
    """Names of the parameters that a better measurement can narrow: not stated, and not contradicted by a check."""
    words = result.summary["trust"].to_dict()
    return [str(name) for name, word in words.items() if not is_stated(name) and word != "not trusted"]


def _largest_input(result: Result, name: str) -> tuple[str, float]:
    """The input with the largest share in the variance of a parameter, and its share; ("", 0.0) where it is unknown."""
    shares = result.point_fit.shares.get(name, {})
    return max(shares.items(), key=lambda item: item[1], default=("", 0.0))


def _factor(remaining: float) -> str:
    """By how much the sd falls where this part of the variance remains: a lower bound, since weights would adapt."""
    return f"{max(remaining, 1e-4) ** -0.5:.2g}"


def _kinds(result: Result, name: str) -> list[str]:
    """Kinds of bench tests that inform a parameter, by the symbols that they list."""
    symbol = re.escape(symbol_of(name))
    return [kind.name for kind in result.registry.kinds if re.search(rf"\b{symbol}\b", kind.informs)]
