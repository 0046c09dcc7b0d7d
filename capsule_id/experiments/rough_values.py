"""Rough values of the physical parameters before any fit."""

from functools import cache

from capsule_id.experiments import make_experiments, paper_estimates, select_tables
from capsule_id.experiments.kind import Estimate, Registry, default_registry
from capsule_id.parameters import symbol_of
from capsule_id.rig.model import Rig


def rough_values(rig: Rig, registry: Registry | None = None) -> Estimate:
    """Return a function from parameter name to (rough value, SI; whether it comes from a bench test of ``rig``).

    The sources in order of preference are: the kind's rough value, the paper's estimate, the median of the stated
    prior, that of the default prior. The first call evaluates the bench tests.
    """
    kinds = registry or default_registry()

    @cache
    def known() -> dict[str, float]:
        experiments = make_experiments(rig, "bench", kinds) if select_tables(rig, "bench") else ()
        values = paper_estimates(experiments, kinds)
        for name, kind in kinds.items():
            values |= kind.rough([e for e in experiments if e.kind == name], rig)
        return values

    def estimate(name: str) -> tuple[float, bool]:
        value = known().get(name, 0.0)
        if value > 0.0:
            return value, True
        stated = rig.priors.get(name)
        if stated is not None and stated.kind == "lognormal":
            return stated.location, False
        default = kinds.parameters[symbol_of(name)].prior
        assert default is not None, f"{name} has a default prior"
        return default.location, False

    return estimate
