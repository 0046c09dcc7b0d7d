"""Sentences about a whole result: what would improve it, and what a paper takes over from it."""

import re
from collections.abc import Iterator

import numpy as np

from capsule_id.experiments import select_tables
from capsule_id.inference.result import STATED, Result
from capsule_id.parameters import Name, is_stated, symbol_of
from capsule_id.report.columns import MISSING, skewed_names, table_rows
from capsule_id.report.messages import finding_text, messages_of

# advice: What would improve a result: the steps that the first screen of the report lists.


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
                place = f"experiment {finding.experiment}" if finding.experiment else ", ".join(finding.parameters)
                yield f"{heading} {place or 'the whole fit'}", finding_text(finding, messages)


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
            # Kinds of bench tests that inform it, by the symbols that they list.
            symbol = re.compile(rf"\b{re.escape(symbol_of(name))}\b")
            kinds = [kind.name for kind in result.registry.kinds if symbol.search(kind.informs)] or ["another test"]
            yield f"Measure {name}", f"The data hardly narrow the prior of {name}. Add a table of {' or '.join(kinds)}."


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


# citation: What a paper or a thesis takes over from a result: methods paragraph, BibTeX entries, LaTeX table.


#: The paper whose model and rig this package fits.
AUTHORS = ("Yang Liu", "Ekaterina Pavlovskaia", "Marian Wiercigroch")
TITLE = "Experimental verification of the vibro-impact capsule model"
JOURNAL, VOLUME, YEAR, PAGES = "Nonlinear Dynamics", 83, 2016, (1029, 1041)
PUBLISHED = f"{JOURNAL} {VOLUME} ({YEAR}) {PAGES[0]}–{PAGES[1]}"
NAMES = f"{', '.join(AUTHORS[:-1])} and {AUTHORS[-1]}"
_ESCAPES = str.maketrans({"_": r"\_", "%": r"\%", "&": r"\&", "#": r"\#", "$": r"\$", "{": r"\{", "}": r"\}"})


def methods_paragraph(result: Result) -> str:
    """The method in sentences, with the numbers of this fit."""
    version = result.provenance.versions.get("capsule-id", "")
    kinds: dict[str, int] = {}
    for table in select_tables(result.rig, result.provenance.experiments):
        kinds[table.kind.replace("_", " ")] = kinds.get(table.kind.replace("_", " "), 0) + 1
    tests = ", ".join(f"{number} x {kind}" for kind, number in kinds.items()) or "the experiments listed in this report"
    data = "Synthetic data were used. " if result.rig.synthetic else ""
    sentences = [
        f"{data}The parameters of the vibro-impact capsule model of {NAMES} ({TITLE}, {PUBLISHED}) were "
        f"identified with capsule-id {version} from {tests}.",
        "All experiments share one set of parameters, with proper priors, and one likelihood of the raw readings.",
    ]
    if result.posterior is None:
        sentences.append("Values are the maximum of the posterior with its standard error; nothing was sampled.")
    else:
        ensembles, draws, walkers, _ = result.posterior.draws.shape
        sentences.append(
            f"The posterior was sampled by {ensembles} independent ensembles of {walkers} walkers (emcee; {draws} stored draws "
            f"each, largest split R-hat {max(result.posterior.rhat):.3f}). Values are posterior medians and sds"
            + ("; of skewed posteriors, medians and central 95 % intervals." if skewed_names(result.summary) else ".")
        )
    verdict = (
        "No check of the data failed." if result.clean else "At least one check of the data failed; see the findings."
    )
    return " ".join([*sentences, verdict])


def bibtex(result: Result) -> str:
    """Entries of the paper and of this software."""
    version = result.provenance.versions.get("capsule-id", "")
    authors = " and ".join(f"{name.rpartition(' ')[2]}, {name.rpartition(' ')[0]}" for name in AUTHORS)
    return (
        f"@article{{liu_capsule,\n  author = {{{authors}}},\n  title = {{{TITLE}}},\n  journal = {{{JOURNAL}}},\n"
        f"  volume = {{{VOLUME}}},\n  year = {{{YEAR}}},\n  pages = {{{PAGES[0]}--{PAGES[1]}}}\n}}\n\n"
        "@software{capsule_id,\n  author = {{The capsule-id developers}},\n"
        "  title = {capsule-id: system identification for the vibro-impact capsule},\n"
        f"  version = {{{version}}}\n}}"
    )


def latex_table(result: Result) -> str:
    """A tabular of symbol, unit, value and sd, and trust; needs no package."""
    lines = [r"\begin{tabular}{llll}", r"parameter & unit & value $\pm$ sd & trust \\", r"\hline"]
    for row in table_rows(result.summary):
        base, of = Name.parse(row.name)
        known, label = result.registry.parameters.get(base), of.translate(_ESCAPES)
        symbol = f"${known.latex}$" if known else base.translate(_ESCAPES)
        number = row.quoted.replace(MISSING, "-")
        number = re.sub(r"[-+.e\d]*\d", r"$\g<0>$", number) if row.skewed else f"${number}$".replace("±", r"\pm")
        unit = row.unit.replace("µ", r"\textmu ").replace("²", "$^2$").replace("^2", "$^2$")
        lines.append(rf"{symbol}{f' ({label})' if label else ''} & {unit} & {number} & {row.values['trust']} \\")
    return "\n".join([*lines, r"\end{tabular}"])
