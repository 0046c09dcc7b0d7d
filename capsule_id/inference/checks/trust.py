"""Which numbers of a fit may be quoted, from its findings.

A failed check makes the parameters that its experiment informs not trusted. Without a sample, where the data do not
inform a parameter, where a warning names it, and where every table that informs it has too few rows to show its
scatter, its number is not judged: no check can tell.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from capsule_id.experiments.base import Experiment
from capsule_id.inference.checks.sampled_fit import SampledFit
from capsule_id.parameters import is_stated
from capsule_id.views import Finding, Trust


def concerned(finding: Finding, experiments: Sequence[Experiment]) -> frozenset[str] | None:
    """Names of the parameters that ``finding`` is about; None for all."""
    if finding.parameters:
        return frozenset(finding.parameters)
    named = [e for e in experiments if finding.experiment in (e.label, e.table.label)]
    return frozenset(row.name for e in named for row in e.parameters) if named else None


def with_scaled(finding: Finding, experiments: Sequence[Experiment]) -> Finding:
    """``finding`` with the parameters that its scales multiply: those of the tables and masses that it names."""
    scales = finding.facts.get("scales", ())
    masses, labels = {"m1", "m2"}.intersection(scales), {name.rpartition(".")[0] for name in scales} - {""}
    others = {"g", "slope", "N0"}.intersection(scales)  # all friction depends on them
    read = [e for e in experiments if others or masses & {*e.masses} or labels & {e.label, e.table.label}]
    names = dict.fromkeys([*sorted(masses), *(row.name for e in read for row in e.parameters)])
    return replace(finding, parameters=tuple(names)) if scales else finding


def trust_words(sampled: SampledFit, informed: np.ndarray) -> dict[str, Trust]:
    """Word of every sampled parameter, by name.

    Parameters
    ----------
    informed : (d,) whether the data narrow the prior of each parameter
    """
    failed = [concerned(f, sampled.experiments) for f in sampled.findings if f.level == "fail"]
    doubtful = {name for f in sampled.findings if f.level == "warn" for name in f.parameters}
    few = {f.experiment for f in sampled.findings if f.code == "readings.few"}
    sizes: dict[str, list[bool]] = {}
    for e in sampled.experiments:
        for row in e.parameters:
            sizes.setdefault(row.name, []).append(e.table.label in few)
    doubtful |= {name for name, are_few in sizes.items() if all(are_few) and not is_stated(name)}
    words: dict[str, Trust] = {}
    for row, known in zip(sampled.target.parameters, informed, strict=True):
        judged = sampled.posterior is not None and (known or is_stated(row.name)) and row.name not in doubtful
        words[row.name] = "trusted" if judged else "not judged"
        if any(names is None or row.name in names for names in failed):
            words[row.name] = "not trusted"
    return words
