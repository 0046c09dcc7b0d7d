"""``capsule-id next RESULT``: further tests, ranked by the standard deviations that they leave."""

import argparse
from typing import TYPE_CHECKING

import capsule_id as cid  # imports JAX at the first use of a name
from capsule_id.commands import NO_CACHE, PATH, QUIET
from capsule_id.commands.predict import check_new_files, say_failed, write_new_files
from capsule_id.commands.simulate import number, whole_number
from capsule_id.console import Progress, say
from capsule_id.errors import InputError
from capsule_id.views import counted

if TYPE_CHECKING:
    from capsule_id.inference.planning import Plan

#: Rows that are printed; FILE.csv has all.
MOST_ROWS = 8

OPTIONS = {
    "": (
        ("result", "RESULT", "result directory of fit-params", PATH),
        ("--for", "NAMES", "parameters to know better, e.g. c,v_s (default: all)", {"dest": "targets", "default": ""}),
        ("--minutes", "M", "time for the tests (default 30)", {"default": "30"}),
        ("--draws", "N", "number of draws of the posterior (default 8)", {"default": "8"}),
        ("--seed", None, "random seed of the choice of draws (default 0)", {"type": int, "default": 0}),
        ("--out", "FILE", "the whole table as CSV, a new file", PATH),
        ("--figure", "PNG", "the expected sds as bars, a new file", PATH),
        QUIET,
        NO_CACHE,
    )
}


def run(args: argparse.Namespace) -> int:
    """Rank the tests, print the best and the lines of rig.toml that read them; 0, or 3 where a check of RESULT failed.

    Raises
    ------
    InputError
        If RESULT is none or holds no sample, a parameter is unknown, the time is too short, or a file exists.
    """
    check_new_files(args)
    minutes, draws = number("minutes", args.minutes), whole_number("draws", args.draws, 1)
    if minutes <= 0.0:
        raise InputError("--minutes must be positive", args.minutes, "give the time for the tests")
    from capsule_id.report.figures import fits

    result = cid.load(args.result)
    say_failed(result)
    targets = [name.strip() for name in args.targets.split(",") if name.strip()]
    with Progress(not args.quiet, unit="test") as progress:
        found = result.next_tests(targets, minutes=minutes, draws=draws, seed=args.seed, progress=progress)
    say(_summary(found, {name: result[name].unit for name in found.today}))
    table, title = found.table, f"{result.rig.name}, {result.trust}: {minutes:g} min"
    written = table.to_csv(float_format="%.6g", lineterminator="\n")
    write_new_files(args, written, lambda: fits.expected_sds(table, list(found.today), title), result.rig.synthetic)
    return 0 if result.clean else 3


def _summary(found: "Plan", units: dict[str, str]) -> str:
    """The present sds, the best tests, and the lines that read the first ones, as text."""
    best = found.table.head(MOST_ROWS)
    shown = best[["tests", "what"]].copy()
    for name in found.today:
        pairs = zip(best[f"sd of {name}"], best[f"{name}, ratio"], strict=True)
        shown[f"sd of {name}, {units[name]}"] = [f"{sd:.3g} (x {ratio:.2f})" for sd, ratio in pairs]
    more = len(found.table) - len(best)
    return "\n".join(
        [
            "sd today: " + ", ".join(f"{name} {sd:.3g} {units[name]}" for name, sd in found.today.items()),
            "expected sd, and its ratio to that of today, after:",
            shown.to_string(),
            *([f"{counted(more, 'further choice')}: --out FILE.csv has all"] if more else []),
            *(f"left out: {text}" for text in found.left_out),
            f"lines of rig.toml for the first row:\n\n{found.lines()}",
        ]
    )
