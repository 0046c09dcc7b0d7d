"""``capsule-id plan``: what planned tests would show of every parameter, from the priors, before they are made."""

import argparse

from capsule_id.commands import NO_CACHE
from capsule_id.commands.simulate import whole_number
from capsule_id.console import say
from capsule_id.parameters import is_stated
from capsule_id.views import counted

OPTIONS = {
    "": (
        ("data", "DATA", "rig folder with [plan] tests (default: the working folder)", {"nargs": "?", "default": "."}),
        ("--draws", "N", "number of draws of the priors (default 8)", {"default": "8"}),
        ("--seed", None, "random seed (default 0)", {"type": int, "default": 0}),
        NO_CACHE,
    )
}


def run(args: argparse.Namespace) -> int:
    """Print a row per parameter, and the minutes that the tests take; 0.

    Raises
    ------
    InputError
        If rig.toml breaks a rule or plans nothing.
    """
    draws = whole_number("draws", args.draws, 1)
    from capsule_id.experiments.kind import default_registry
    from capsule_id.inference.planning import planned

    frame, minutes = planned(args.data, default_registry(), draws, args.seed)
    frame["with"] = frame["with"].where(frame["correlation"].abs() >= 0.5, "")
    own = frame.round({"correlation": 2})[[not is_stated(str(name)) for name in frame.index]].rename_axis(None)
    say(own.to_string(float_format="%.2g", na_rep=""))
    say(f"{minutes:g} min of tests; sd / value: expected, in the mean over {counted(draws, 'draw')} of the priors")
    return 0
