"""What a paper or a thesis takes over from a result: methods paragraph, BibTeX entries, LaTeX table."""

import re

from capsule_id.experiments import select_tables
from capsule_id.inference.result import Result
from capsule_id.parameters import symbol_of
from capsule_id.report.columns import skewed_names, table_rows
from capsule_id.report.typography import MISSING

#: The paper whose model and rig this package fits.
AUTHORS = ("Yang Liu", "Ekaterina Pavlovskaia", "Marian Wiercigroch")
TITLE = "Experimental verification of the vibro-impact capsule model"
JOURNAL, VOLUME, YEAR, PAGES = "Nonlinear Dynamics", 83, 2016, (1029, 1041)
PUBLISHED = f"{JOURNAL} {VOLUME} ({YEAR}) {PAGES[0]}–{PAGES[1]}"
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
        f"{data}The parameters of the vibro-impact capsule model of {_names()} ({TITLE}, {PUBLISHED}) were "
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


def _names() -> str:
    return f"{', '.join(AUTHORS[:-1])} and {AUTHORS[-1]}"


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
        known = result.registry.parameters.get(symbol_of(row.name))
        label = row.name.partition("[")[2].removesuffix("]").translate(_ESCAPES)
        symbol = f"${known.latex}$" if known else row.name.partition("[")[0].translate(_ESCAPES)
        number = row.quoted.replace(MISSING, "-")
        number = re.sub(r"[-+.e\d]*\d", r"$\g<0>$", number) if row.skewed else f"${number}$".replace("±", r"\pm")
        unit = row.unit.replace("µ", r"\textmu ").replace("²", "$^2$").replace("^2", "$^2$")
        lines.append(rf"{symbol}{f' ({label})' if label else ''} & {unit} & {number} & {row.values['trust']} \\")
    return "\n".join([*lines, r"\end{tabular}"])
