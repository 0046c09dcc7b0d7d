"""What would improve a result: the steps that the first screen of the report lists."""

import re
from collections.abc import Iterator

import numpy as np

from capsule_id.inference.result import Result
from capsule_id.parameters import symbol_of
from capsule_id.report.texts.messages import finding_text, messages_of
from capsule_id.views import Finding, counted

#: Weighed constants: more tests do not narrow them.
_WEIGHED = ("m1", "m2")


def next_steps(result: Result) -> list[tuple[str, str]]:
    """Pairs of a heading and a sentence, the most urgent first."""
    return [*_faults(result), *_missing(result), *_widest(result)]


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
        yield (
            "Sample",
            "Run fit-params without --no-sample: only a sample gives intervals and lets checks judge the numbers.",
        )
        return
    names = [str(name) for name in result.summary.index if name not in _WEIGHED]
    for name in names:
        # NaN for an exact constant: nothing is to be measured.
        if f"{result.summary.at[name, 'informed']}" == "False":
            kinds = " or ".join(_kinds(result, name)) or "another test"
            yield f"Measure {name}", f"The data hardly narrow the prior of {name}. Add a table of {kinds}."


def _widest(result: Result) -> Iterator[tuple[str, str]]:
    """The parameter with the largest relative sd and the tests that it rests on."""
    rows = result.summary.drop(index=[name for name in _WEIGHED if name in result.summary.index])
    relative = (rows["sd"].astype(float) / rows["value"].astype(float).abs()).replace([np.inf], np.nan).dropna()
    largest = float(np.max(relative.to_numpy(float), initial=0.0))
    if largest == 0.0:
        return
    name = str(relative.idxmax())
    tables = [table for table in result.rig.tables if table.kind in _kinds(result, name)]
    readings = [f"{table.label} ({counted(len(table.rows), 'row')})" for table in tables]
    source = f" It rests on {', '.join(readings)}." if readings else ""
    sentence = f"{name} has the largest relative sd, {100.0 * largest:.2g} %.{source}"
    yield f"Narrow {name}", f"{sentence} Four times as many independent readings halve the sd."


def _kinds(result: Result, name: str) -> list[str]:
    """Kinds of bench tests that inform a parameter, by the symbols that they list."""
    symbol = re.escape(symbol_of(name))
    return [kind.name for kind in result.registry.kinds if re.search(rf"\b{symbol}\b", kind.informs)]
