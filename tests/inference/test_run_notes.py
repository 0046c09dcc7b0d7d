"""Which parameters the table of gained precision has: those of runs that a bench test may measure too."""

from types import SimpleNamespace
from typing import cast

from capsule_id.inference.tables import shared_symbols
from capsule_id.inference.target import LogPosterior
from capsule_id.parameters import Parameter, Prior, parameter, scatter

PRIOR = Prior("lognormal", 1.0, 10.0)
C_RR = Parameter("c_rr", "1", "rolling resistance coefficient", "c", PRIOR)


def target_of(*runs_have: Parameter) -> LogPosterior:
    """Two springs and a wheel on the bench, and a run with ``runs_have``."""
    bench = [parameter("k2", "soft"), parameter("k2", "stiff"), C_RR]
    members = [
        SimpleNamespace(label="bench", bench=True, parameters=bench),
        SimpleNamespace(label="run_1", bench=False, parameters=runs_have),
    ]
    rows = {row.name: row for row in (parameter("m1"), *bench, *runs_have)}
    return cast("LogPosterior", SimpleNamespace(experiments=members, parameters=tuple(rows.values())))


def test_parameters_of_runs_that_belong_to_no_single_run_are_shared() -> None:
    gap, noise = parameter("G", "run_1", PRIOR), scatter("noise_x_rel", "m", "noise", "s").named("run_1", PRIOR)
    of_run = (parameter("k1"), parameter("k2", "stiff"), gap, noise)
    assert shared_symbols(target_of(*of_run)) == {"m1", "k1", "k2"}
    # A parameter that another package declares, once a run has it too.
    assert shared_symbols(target_of(*of_run, C_RR)) == {"m1", "k1", "k2", "c_rr"}
