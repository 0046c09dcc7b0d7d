"""``capsule-id bifurcate``: which motions the model has over a quantity, or over two, as NetCDF and as a picture."""

import argparse
import sys
from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from capsule_id.commands.capsule_options import (
    DEFAULTS,
    add_capsule_arguments,
    capsule_values,
    fitted_values,
    number,
    prefer_whole_loops,
)
from capsule_id.commands.progress import Progress
from capsule_id.commands.sweep_output import publish_pair, remove_store, take_store
from capsule_id.console import say
from capsule_id.errors import InputError
from capsule_id.experiments.registry import default_registry
from capsule_id.parameters import CAPSULE_LEAVES, DRIVE_LEAVES, LEAVES, SWEPT
from capsule_id.rig.model import Rig
from capsule_id.rig.read import read_rig
from capsule_id.rig.units import UnitError, factor_to_si

if TYPE_CHECKING:
    import numpy as np
    import xarray as xr
    from matplotlib.figure import Figure

    from capsule_id.report.figures.sweeps import MeasuredPoint

# The setting of the paper's Fig. 6, unless the options say otherwise.
DRIVEN = {**DEFAULTS, "G": 1e-3, "P_d": 4.0, "Omega": 34.56}
METHODS = ("rest", "states", "forward", "backward", "both")
MOST_POINTS = 10_000_000


@dataclass(frozen=True)
class Axis:
    """A quantity that is varied: values from begin to end in ``unit``, SI = value * factor."""

    name: str
    begin: float
    end: float
    points: int
    unit: str
    factor: float

    def values(self) -> "np.ndarray":
        """(points,), SI (f in Hz)."""
        import numpy as np

        return np.linspace(self.begin, self.end, self.points) * self.factor


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """DATA, what is varied, how, and where to write; all numbers are read in ``run``."""
    parser.add_argument(
        "data", metavar="DATA", nargs="?", help="rig folder that has been fitted: its values (else Table 1's)"
    )
    group = parser.add_argument_group("what is varied")
    group.add_argument("--over", metavar="NAME", required=True, choices=tuple(SWEPT), help=", ".join(SWEPT))
    group.add_argument("--from", dest="begin", metavar="X", required=True, help="first value")
    group.add_argument("--to", dest="end", metavar="X", required=True, help="last value")
    group.add_argument("--unit", metavar="U", help="of --from and --to, e.g. kN/m (default SI)")
    group.add_argument("--points", metavar="N", help="number of values (default 500; 200 in a map)")
    group.add_argument("--with", dest="second", metavar="NAME", choices=tuple(SWEPT), help="a second quantity: a map")
    for word in ("from", "to", "unit", "points"):
        group.add_argument(f"--with-{word}", metavar="X", help=f"--{word} of the second quantity")
    group = parser.add_argument_group("motions")
    text = "every value from rest (default), from many states, or from where the last one ended"
    group.add_argument("--method", choices=METHODS, default="rest", help=text)
    group.add_argument("--states", metavar="N", default="16", help="initial states of --method states (default 16)")
    group.add_argument("--seed", metavar="N", default="0", help="of the initial states and of --draws (default 0)")
    group.add_argument("--dropped", metavar="N", default="300", help="excitation periods left out (default 300)")
    group.add_argument("--observed", metavar="N", default="48", help="excitation periods looked at (default 48)")
    text = "s; contacts parted by less count as one (default 0: off)"
    group.add_argument("--merge-contacts", metavar="X", default="0", help=text)
    group.add_argument("--posterior", metavar="FILE", type=Path, help="posterior.nc: probabilities and bands instead")
    group.add_argument("--draws", metavar="N", help="with --posterior: how many draws (default 100)")
    add_capsule_arguments(parser, DRIVEN)
    group = parser.add_argument_group("work")
    group.add_argument(
        "--scheduler", metavar="S", help="Dask for maps and bands: threads, processes or an address tcp://..."
    )
    group.add_argument("--resume", action="store_true", help="take up the finished blocks of an interrupted map")
    group.add_argument("--quiet", action="store_true", help="no progress on standard error")
    text = "FILE.nc, and FILE.png beside it (default results/<rig>-<quantity>.nc)"
    group.add_argument("--out", metavar="FILE", type=Path, help=text)


def run(args: argparse.Namespace) -> int:
    """Sweep, write FILE.nc and FILE.png; 0.

    Raises
    ------
    InputError
        A number, unit or combination that is not admissible, a folder without a result, a file that is in the way.
    """
    axes = _axes(args)
    _check_combination(args, axes)
    rig = read_rig(args.data, default_registry()) if args.data is not None else None
    if rig is not None and args.result is None:
        args.result = Path("results") / rig.name
        if not (args.result / "parameters.json").is_file():
            raise InputError(
                "DATA must have been fitted", f"no {args.result}", "run fit-params on it, or give --result"
            )
    free = frozenset("Omega" if axis.name == "f" else axis.name for axis in axes)
    values = capsule_values(args, DRIVEN, free | _drawn(args))
    out = args.out if args.out is not None else _default_out(rig.name if rig is not None else None, axes)
    store = take_store(out, args.resume)
    prefer_whole_loops()
    with Progress(not args.quiet, unit="point") as progress, _client(args.scheduler) as client:
        data = _computed(args, axes, values, {"store": store, "client": client, "progress": progress})
        data.attrs["rig"] = rig.name if rig is not None else ""
        measured = _measured(args, rig, axes, values) if rig is not None else ()
        publish_pair(out, data, draw(data, axes, measured, synthetic=rig is not None and rig.synthetic))
    remove_store(store)
    say(_sentence(data, axes, out))
    return 0


def draw(
    data: "xr.Dataset", axes: Sequence[Axis], measured: "Sequence[MeasuredPoint]" = (), synthetic: bool = False
) -> "Figure":
    """The picture of what ``run`` has computed; measured runs are laid over a diagram, each with its own label."""
    from capsule_id.report.figures import bands as figures_bands
    from capsule_id.report.figures import maps as figures_map
    from capsule_id.report.figures import sweeps as figures_sweep
    from capsule_id.report.figures.style import mark

    units = {axis.name: figures_sweep.AxisUnit(axis.unit, axis.factor) for axis in axes}
    title = str(data.attrs["rig"])
    if "probability" in data:
        figure = figures_bands.bands(data, units, title)
    elif len(axes) == 2:
        figure = figures_map.motion_map(data, units, title)
    else:
        figure = figures_sweep.bifurcation(data, units, measured, title)
    if synthetic:
        mark(figure, "synthetic data")
    return figure


def _computed(
    args: argparse.Namespace, axes: Sequence[Axis], values: dict[str, float], work: dict[str, Any]
) -> "xr.Dataset":
    """The Dataset that the options ask for."""
    from capsule_id.motions import operating, sweep
    from capsule_id.motions.response import Settling
    from capsule_id.physics.model import CapsuleParameters, Excitation
    from capsule_id.report.posterior_file import read_draws

    settling = Settling(
        dropped=_whole("dropped", args.dropped),
        observed=_whole("observed", args.observed),
        merge_contacts=number("merge-contacts", args.merge_contacts),
    )
    leaves: dict[str, Any] = dict(values)
    if args.posterior is not None:
        spring = None if any(axis.name == "k2" for axis in axes) or args.k2 is not None else args.spring
        draws = read_draws(args.posterior, _whole("draws", args.draws or "100"), _whole("seed", args.seed), spring)
        if "k2" not in draws and args.k2 is None and all(axis.name != "k2" for axis in axes):
            raise InputError("k2 must be given", "the posterior has several springs or none", "add --spring or --k2")
        given = {name for name in LEAVES if getattr(args, name) is not None}
        leaves |= {name: column for name, column in draws.items() if name not in given}
    p = CapsuleParameters(**{name: leaves[name] for name in CAPSULE_LEAVES})
    e = Excitation(**{name: leaves[name] for name in DRIVE_LEAVES})
    x = {axis.name: axis.values() for axis in axes}
    (over, grid), *_ = x.items()
    if args.posterior is not None:
        return operating.bands(operating.draws_diagram(p, e, over, grid, settling=settling, **work))
    if len(axes) == 2:
        return sweep.motion_map(p, e, x, settling=settling, **work)
    plain = {"settling": settling, "progress": work["progress"]}
    if args.method in ("rest", "states"):
        many = args.method == "states"
        starts = sweep.spread_starts(p, e, _whole("states", args.states), _whole("seed", args.seed)) if many else None
        return sweep.diagram(p, e, over, grid, starts=starts, **plain)
    both = ("forward", "backward")
    return sweep.continuation(p, e, over, grid, directions=both if args.method == "both" else (args.method,), **plain)


def _measured(
    args: argparse.Namespace, rig: Rig, axes: Sequence[Axis], values: dict[str, float]
) -> "tuple[MeasuredPoint, ...]":
    """The rig's forced runs with the settings of a diagram; what was left out is told on standard error."""
    from capsule_id.commands.measured_runs import Span, overlay

    diagram = len(axes) == 1 and args.posterior is None
    if not diagram or not rig.has_runs:
        return ()
    x = axes[0].values()
    by_name = args.spring if args.k2 is None else None
    found = overlay(rig, Span(axes[0].name, x[0], x[-1]), values, fitted_values(args.result), by_name)
    print(found.sentence(), file=sys.stderr, flush=True)
    return found.motions


def _axes(args: argparse.Namespace) -> tuple[Axis, ...]:
    """One quantity or two."""
    many = "500" if args.second is None else "200"
    first = _axis("", args.over, args.begin, args.end, args.unit, args.points or many)
    if args.second is None:
        for word in ("from", "to", "unit", "points"):
            if getattr(args, f"with_{word}") is not None:
                raise InputError(f"--with-{word} belongs to a second quantity", "there is none", "add --with NAME")
        return (first,)
    if args.with_from is None or args.with_to is None:
        raise InputError("a second quantity needs its range", args.second, "add --with-from X --with-to X")
    points = args.with_points or many
    return first, _axis("with-", args.second, args.with_from, args.with_to, args.with_unit, points)


def _axis(prefix: str, name: str, begin: str, end: str, unit: str | None, points: str) -> Axis:
    si = SWEPT[name].unit
    try:
        factor = factor_to_si(unit, si.replace(" ", "*")) if unit is not None else 1.0
    except UnitError as error:
        raise InputError(error.rule, f"--{prefix}unit {unit}", error.remedy) from None
    low, high = number(f"{prefix}from", begin), number(f"{prefix}to", end)
    if not low < high:
        raise InputError(f"--{prefix}from must be less than --{prefix}to", f"{low:g} and {high:g}", "swap them")
    n = _whole(f"{prefix}points", points)
    if not 2 <= n <= MOST_POINTS:
        raise InputError(f"--{prefix}points must lie between 2 and {MOST_POINTS}", points, "give e.g. 500")
    if name in ("Omega", "f", "m1", "m2", "v_s") and not low > 0.0:
        raise InputError(f"{name} must be positive", f"--{prefix}from {low:g}", "begin above 0")
    if name not in ("phase", "P_d") and low < 0.0:
        raise InputError(f"{name} must not be negative", f"--{prefix}from {low:g}", "begin at 0 or above")
    return Axis(name, low, high, n, unit if unit is not None else si, factor)


def _check_combination(args: argparse.Namespace, axes: Sequence[Axis]) -> None:
    """Options that mean nothing together are told, not ignored."""
    names = {axis.name for axis in axes}
    if len(names) < len(axes) or names == {"f", "Omega"}:
        raise InputError("a map needs two different quantities", f"{args.over} and {args.second}", "name another one")
    blocks = len(axes) == 2 or args.posterior is not None
    if args.posterior is not None and len(axes) == 2:
        raise InputError("--posterior takes one quantity", "--with", "leave one out")
    if blocks and args.method != "rest":
        raise InputError("maps and bands start from rest", f"--method {args.method}", "leave it out")
    if args.scheduler is not None and not blocks:
        raise InputError("--scheduler is for maps and bands", "one quantity", "leave it out, or add --with")
    if args.resume and not blocks:
        raise InputError("--resume is for maps and bands", "one quantity", "leave it out")
    if args.draws is not None and args.posterior is None:
        raise InputError("--draws belongs to --posterior", "there is none", "add --posterior FILE")
    for name in sorted(names | ({"Omega"} if "f" in names else set())):
        if getattr(args, name, None) is not None:
            raise InputError(f"{name} is varied", f"--{name} is given too", "leave one out")


def _drawn(args: argparse.Namespace) -> frozenset[str]:
    """What a posterior supplies need not be an option (k2 of a spring, which is looked up with it)."""
    return frozenset({"k2"}) if args.posterior is not None else frozenset()


def _whole(name: str, text: str) -> int:
    value = number(name, text)
    if value != int(value) or value < 0:
        raise InputError(f"--{name} must be a whole number", text, "give 0 or more")
    return int(value)


def _client(scheduler: str | None) -> Any:
    """A context that holds a Dask client, or None where the work stays in this process."""
    if scheduler is None:
        return nullcontext()
    from capsule_id.commands.cluster import cluster

    return cluster(scheduler)


def _default_out(rig: str | None, axes: Sequence[Axis]) -> Path:
    names = "-".join(axis.name for axis in axes)
    return Path("results") / f"{rig}-{names}.nc" if rig is not None else Path(f"bifurcation-{names}.nc")


def _sentence(data: "xr.Dataset", axes: Sequence[Axis], out: Path) -> str:
    """What was found, in a line or two."""
    if "probability" in data:
        axis, (low, middle, high) = axes[0], data["chosen_mean_velocity_quantiles"].to_numpy() * 1e3
        best = float(data["chosen"]) / axis.factor
        found = f"best in the mean of {data.attrs['draws']} draws: {axis.name} = {best:.4g} {axis.unit}, "
        return f"{found}{middle:.3g} mm/s (95 %: {low:.3g} to {high:.3g})\nwrote {out} and {out.with_suffix('.png')}"
    label = data["label"].to_numpy().ravel()
    failed, kinds = int((label == "failed").sum()), len(set(label.tolist()) - {"failed"})
    told = f", {failed} runs given up (see status)" if failed else ""
    return f"{label.size} motions of {kinds} kinds{told}\nwrote {out} and {out.with_suffix('.png')}"
