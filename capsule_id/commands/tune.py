"""``capsule-id tune RESULT``: the settings of drive and rig that maximise the mean velocity under the posterior."""

import argparse
import json
from functools import partial
from typing import TYPE_CHECKING

import capsule_id as cid  # imports JAX at the first use of a name
from capsule_id.commands import NO_CACHE, PATH, QUIET
from capsule_id.commands.predict import check_new_files, say_failed, write_new_files
from capsule_id.commands.simulate import number, whole_number
from capsule_id.console import Progress, say
from capsule_id.errors import InputError
from capsule_id.parameters import LEAVES
from capsule_id.views import counted

if TYPE_CHECKING:
    from capsule_id.inference.tuning import Tuning

#: Settled motions that are printed; FILE.json has all.
MOST_MOTIONS = 5

OPTIONS = {
    "": (("result", "RESULT", "result directory of fit-params", PATH),),
    "settings, in SI units: one number fixes a value, two numbers are the bounds of its search": tuple(
        (f"--{name}", "X", f"{leaf.meaning}, {leaf.unit}", {"nargs": "+"}) for name, leaf in LEAVES.items()
    ),
    "search": (
        ("--spring", "NAME", "fitted support spring that gives k2"),
        ("--faster-than", "X", "m/s: maximise the probability of a larger mean velocity, not its mean"),
        ("--draws", "N", "number of draws of the posterior (default 16)", {"default": "16"}),
        ("--seed", None, "random seed of the draws and of the search (default 0)", {"type": int, "default": 0}),
    ),
    "output": (
        ("--out", "FILE", "FILE.csv: the table; FILE.json: all numbers; a new file", {**PATH, "required": True}),
        ("--figure", "PNG", "map of the mean velocity, a new file", PATH),
        QUIET,
        NO_CACHE,
    ),
}


def run(args: argparse.Namespace) -> int:
    """Search, print the best setting, write FILE and the figure; 0, or 3 where a check of RESULT failed.

    Raises
    ------
    InputError
        If RESULT is none or holds no sample, a setting is not admissible or missing, or a file exists.
    """
    check_new_files(args)
    if args.out.suffix not in (".csv", ".json"):
        raise InputError("--out must end in .csv or .json", args.out.name, "change the suffix", args.out)
    bounds, given = dict[str, tuple[float, float]](), dict[str, float]()
    for name in LEAVES:
        values = [number(name, text) for text in getattr(args, name) or ()]
        if len(values) > 2:
            raise InputError(f"--{name} takes one or two numbers", str(len(values)), "give a value, or two bounds")
        if len(values) == 2:
            bounds[name] = values[0], values[1]
        elif values:
            given[name] = values[0]
    faster_than = None if args.faster_than is None else number("faster-than", args.faster_than)
    draws = whole_number("draws", args.draws, 1)
    from capsule_id.report.figures import sweeps

    result = cid.load(args.result)
    say_failed(result)
    with Progress(not args.quiet, unit="setting") as progress:
        found = result.tune(
            bounds,
            given,
            faster_than=faster_than,
            spring=args.spring,
            draws=draws,
            seed=args.seed,
            progress=progress,
        )
    frames = {name: getattr(found, name) for name in ("table", "motions", "sensitivity")}
    saved = {
        **{name: json.loads(frame.to_json(orient="index")) for name, frame in frames.items()},
        "best": found.best,
        "bounds": bounds,
        "given": given,
        "seed": args.seed,
        "draws": draws,
        "failed checks": result.failed,
        "rig": result.rig.name,
        "synthetic": result.rig.synthetic,
    }
    table = found.table.to_csv(float_format="%.6g", lineterminator="\n")
    written = table if args.out.suffix == ".csv" else json.dumps(saved, indent=1) + "\n"
    say(_summary(found))
    title = f"{result.rig.name}, {found.table['trust'].iloc[0]}:"
    draw = partial(sweeps.tuned, found.surface, found.best, found.points, title)
    write_new_files(args, written, draw, result.rig.synthetic)
    return 0 if result.clean else 3


def _summary(found: "Tuning") -> str:
    """The best setting, what to mind about it, and the tables of motions and sensitivities, as text."""
    best, share = found.table.iloc[0], found.motions["share"]
    settings = ", ".join(f"{name} = {value:.4g} {LEAVES[name].unit}" for name, value in found.best.items())
    interval = f"95 %: {best['lower [mm/s]']:.3g} to {best['upper [mm/s]']:.3g}"
    left_out = f"{counted(found.failed, 'setting')} left out: the motion of a draw could not be computed"
    measured = found.table.iloc[1:].sort_values("predicted [mm/s]", ascending=False).iloc[:, :-1]
    points = f"measured operating points, the best prediction first:\n{measured.to_string(float_format='%.4g')}"
    return "\n".join(
        [
            f"best of {counted(found.computed, 'setting')}: {settings}",
            f"mean velocity {best['predicted [mm/s]']:.3g} mm/s ({interval}), {best['trust']}",
            *(f"{name} is best at an end of its range: search a wider one" for name in found.at_bound),
            *([left_out] if found.failed else []),
            f"settled motions of this setting, by share of draws and initial states ({counted(len(share), 'kind')}):",
            found.motions.head(MOST_MOTIONS).to_string(float_format="%.3g"),
            "mean velocity where one parameter or setting changes, mm/s:",
            found.sensitivity.to_string(float_format="%.4g"),
            *([points] if len(measured) else []),
        ]
    )
