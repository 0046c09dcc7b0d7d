"""Checks of the friction law: comparison with other laws, order of the residuals in speed."""

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

from capsule_id.experiments.checks.context import Fitted
from capsule_id.experiments.checks.series import LEVEL
from capsule_id.experiments.families.friction_variants import FACTOR, TELLING, Points, candidates, fit_variant
from capsule_id.physics.friction import CoulombStribeck
from capsule_id.views import Finding, ResultTable

if TYPE_CHECKING:
    from capsule_id.experiments.families.friction_experiment import FrictionExperiment

#: Smallest number of sliding readings for a comparison of laws, and seed of its sampler.
FEWEST_SLIDES, SEED = 3, 0


def check_variants(experiments: "Sequence[FrictionExperiment]", fit: Fitted) -> list[Finding]:
    """Compare the friction law in use with other laws, and recommend the simplest that the readings allow.

    The law in use fails where another one has a marginal likelihood ``FACTOR`` times larger, or where its residuals are
    ordered by speed.
    """
    del fit
    experiments = [e for e in experiments if e.speeds_known]
    if not experiments:
        return []
    in_use = replace(experiments[0].friction, direction="both")
    if in_use.law is not CoulombStribeck or sum(e.n for e in experiments if e.role != "static") < FEWEST_SLIDES:
        return []
    points = Points(experiments)
    variants = [fit_variant(points, model, SEED) for model in candidates(experiments)]
    highest = max(variant.evidence for variant in variants)
    used = next(variant for variant in variants if variant.model == in_use)
    simplest = next(variant for variant in variants if highest - variant.evidence < np.log(TELLING))
    facts = {
        "name": in_use.name,
        "labels": ", ".join(e.label for e in experiments),
        "count": len(variants),
        "factor": float(np.exp(min(highest - used.evidence, 700.0))),
        "simplest": simplest.model.name,
        "line": simplest.line,
        "p": used.lack_of_fit,
        "variants": tuple(variants),
    }
    names = tuple(row.name for row in in_use.parameters)
    rejected, ordered = facts["factor"] > FACTOR, used.lack_of_fit < LEVEL
    return [
        Finding("friction.variants", "fail" if rejected else "ok", facts, parameters=names),
        Finding("friction.order", "fail" if ordered else "ok", facts, parameters=names),
    ]


def variant_table(experiments: "Sequence[FrictionExperiment]", fit: Fitted) -> list[ResultTable]:
    """Show the laws of ``check_variants`` side by side."""
    del experiments
    variants = next((f.facts["variants"] for f in fit.findings if f.code == "friction.variants"), ())
    if not variants:
        return []
    rows = [
        {
            "law": variant.model.name,
            "parameters": "; ".join(
                f"{name} = {value:.4g} ± {variant.sds[name]:.2g}" for name, value in variant.values.items()
            ),
            "log-likelihood": variant.log_likelihood,
            "BIC": variant.bic - min(other.bic for other in variants),
            "log marginal likelihood": variant.evidence - max(other.evidence for other in variants),
            "order of residuals, p": variant.lack_of_fit,
            "[model]": variant.line,
        }
        for variant in variants
    ]
    return [ResultTable("friction.variants", pd.DataFrame(rows).set_index("law"))]
