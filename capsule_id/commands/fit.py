"""``fit-params DATA``: from a rig folder to parameters, posterior and report."""

import argparse
import sys
import time
from pathlib import Path

from capsule_id.errors import InputError
from capsule_id.rig.read import read_rig

DEFAULT_MAX_STEPS = 20_000


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """DATA and the options of INTERFACE."""
    parser.add_argument("data", metavar="DATA", help="rig folder, with its rig.toml")
    parser.add_argument("--out", type=Path, metavar="DIR", help="where to write (default results/<rig name>)")
    parser.add_argument("--seed", type=int, default=0, metavar="N", help="the same seed gives the same numbers")
    parser.add_argument("--experiments", choices=("bench", "runs", "all"), default="all", help="which to fit")
    parser.add_argument("--resume", action="store_true", help="go on from an interrupted run")
    parser.add_argument("--no-sample", action="store_true", help="point fit only: no posterior, no intervals")
    parser.add_argument(
        "--max-steps", type=int, default=DEFAULT_MAX_STEPS, metavar="N", help="emcee steps of an ensemble at most"
    )
    parser.add_argument("--quiet", action="store_true", help="no progress on standard error")


def run(args: argparse.Namespace) -> int:
    """Fit and write; 0 where the verdict is clean, 3 where it is not.

    Raises
    ------
    InputError
        Bad input: nothing has been written then.
    """
    if args.seed < 0:
        raise InputError("--seed must not be negative", str(args.seed), "give 0 or more")
    if args.max_steps < 1:
        raise InputError("--max-steps must be positive", str(args.max_steps), "give 1 or more")
    rig = read_rig(args.data)
    directory = args.out if args.out is not None else Path("results") / rig.name
    # Heavy rooms only now: a wrong folder is answered at once.
    from capsule_id.experiments import make_experiments
    from capsule_id.inference.fit import PACKAGES, fit_rig, package_versions
    from capsule_id.output import CHAINS, check_directory, open_partial, publish
    from capsule_id.report.text import table_text

    check_directory(directory)
    make_experiments(rig, args.experiments)
    fingerprint = {
        "data": dict(rig.files),
        "seed": args.seed,
        "experiments": args.experiments,
        "versions": package_versions(PACKAGES),
    }
    partial = open_partial(directory, fingerprint, args.resume)
    progress = ProgressBar(enabled=not args.quiet)
    budget = None if args.no_sample else args.max_steps
    try:
        result = fit_rig(rig, args.seed, args.experiments, budget, partial / CHAINS, progress)
    finally:
        progress.close()
    publish(result, directory)
    print(table_text(result.summary, synthetic=rig.synthetic, clean=result.clean))
    print(f"report: {directory / 'report.html'}")
    if result.clean:
        return 0
    failed = sorted({finding.check for finding in result.findings if finding.level == "fail"})
    print(f"fit-params: verdict not clean: {', '.join(failed)}; see {directory / 'report.html'}", file=sys.stderr)
    return 3


class ProgressBar:
    """Stage, rate and time left on standard error."""

    def __init__(self, enabled: bool) -> None:
        self._enabled = enabled
        self._bar = None
        self._stage = ""
        self._shown = 0.0

    def __call__(self, done: int, total: int, stage: str) -> None:
        """``done`` of ``total`` draws in ``stage``."""
        if not self._enabled:
            return
        from tqdm import tqdm

        if stage != self._stage:
            self.close()
            self._stage = stage
            unit = "draw" if total > 1 else "stage"
            self._bar = tqdm(total=total, desc=stage, unit=unit, file=sys.stderr, dynamic_ncols=True, initial=done)
        now = time.monotonic()
        if self._bar is not None and (done != self._bar.n or total != self._bar.total) and now - self._shown > 0.05:
            self._shown = now
            self._bar.total = total
            self._bar.n = done
            self._bar.refresh()

    def close(self) -> None:
        """Leave the last line standing."""
        if self._bar is not None:
            if self._bar.total == 1:
                self._bar.n = 1
            self._bar.close()
            self._bar = None
