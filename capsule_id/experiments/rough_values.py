"""Rough values of the physical parameters before any fit, and the feasibility of forced runs at them."""

from collections.abc import Callable

import numpy as np

from capsule_id.experiments import make_experiments, paper_estimates
from capsule_id.experiments.forced_run.feasibility import feasibility
from capsule_id.experiments.free_vibration.experiment import FreeVibration
from capsule_id.parameters import parameter, symbol_of
from capsule_id.rig.model import Rig
from capsule_id.views import Finding


def lint_runs(rig: Rig) -> list[Finding]:
    """Feasibility of every forced run of a rig, at the rough values that its own bench tests give.

    k1 and c are the paper's without its bias: m1 (Omega_o^2 + gamma^2) and 2 m1 gamma, gamma = delta Omega_o / 2 pi.
    mu, K and k2 are the paper's. What no bench test gives is the prior's median, and the finding says so.
    """
    estimate = rough_values(rig)
    findings = []
    for table in rig.tables:
        if table.kind == "forced_run":
            names = {symbol: symbol for symbol in ("k1", "c", "mu", "K")} | {"k2": f"k2[{table.settings['spring']}]"}
            if "P_d" in table.settings:
                del names["K"]
            values = {symbol: estimate(name) for symbol, name in names.items()}
            guessed = [names[symbol] for symbol, (_, measured) in values.items() if not measured]
            note = f" (by the prior's median, not measured here: {', '.join(guessed)})" if guessed else ""
            theta = _masses(rig) | {symbol: value for symbol, (value, _) in values.items()}
            findings += feasibility(table, theta, note)
    return findings


def _masses(rig: Rig) -> dict[str, float]:
    assert rig.m1 is not None, "the schema asks for both masses beside a forced run"
    assert rig.m2 is not None, "the schema asks for both masses beside a forced run"
    return {"m1": rig.m1.value, "m2": rig.m2.value, "g": rig.g.value}


def rough_values(rig: Rig) -> Callable[[str], tuple[float, bool]]:
    """A function of a parameter's name: (rough value, SI; whether a bench test of ``rig`` gave it)."""
    bench = [t for t in rig.tables if t.kind != "forced_run"]
    experiments = make_experiments(rig, "bench") if bench else ()
    known = paper_estimates(experiments)
    decays = [e.paper_decrement() for e in experiments if isinstance(e, FreeVibration)]
    found = [(d.Omega_o, d.delta * d.Omega_o / (2.0 * np.pi)) for d in decays if d is not None and d.delta > 0.0]
    if found and rig.m1 is not None:
        known["k1"] = float(np.mean([rig.m1.value * (Omega_o**2 + gamma**2) for Omega_o, gamma in found]))
        known["c"] = float(np.mean([2.0 * rig.m1.value * gamma for _, gamma in found]))

    def estimate(name: str) -> tuple[float, bool]:
        if known.get(name, 0.0) > 0.0:
            return known[name], True
        stated = rig.priors.get(name)
        if stated is not None and stated.median is not None:
            return stated.median, False
        default = parameter(symbol_of(name)).prior
        assert default is not None, "k1, c, mu, K and k2 have default priors"
        return default.location, False

    return estimate
