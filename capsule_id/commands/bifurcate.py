"""``capsule-id bifurcate``: the settled motions over one quantity or two, as NetCDF and as a figure."""

import argparse
import logging
import re
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

import capsule_id as cid  # imports JAX at the first use of a name
from capsule_id.commands import NO_CACHE, PATH, QUIET
from capsule_id.commands.simulate import (
    DEFAULTS,
    capsule_options,
    capsule_values,
    fitted_values,
    leaves_of,
    number,
    whole_number,
)
from capsule_id.console import Progress, complain, saved, say
from capsule_id.errors import InputError, refusing
from capsule_id.experiments.forced_run.declaration import RunSettings
from capsule_id.experiments.kind import default_registry, rough_values
from capsule_id.output import NEW, PARTIAL, check_parents, replace_files
from capsule_id.parameters import CAPSULE_LEAVES, DRIVES, FIG_6, LEAVES, SWEPT
from capsule_id.records.motion import measured_motion
from capsule_id.records.tones import VISIBLE, recorded_drive, stated_gap, stated_Omega
from capsule_id.rig.model import Quantity, Rig, Table
from capsule_id.rig.read import read_rig
from capsule_id.rig.units import UnitError, factor_to_si
from capsule_id.views import counted

if TYPE_CHECKING:
    import xarray as xr
    from distributed import Client
    from matplotlib.figure import Figure

    from capsule_id.report.figures.sweeps import MeasuredPoint


# sweep output: Writes a sweep: FILE.nc and FILE.png, each complete or absent; FILE.nc.partial holds finished blocks.


STORE_FILE = "points.json"  # in every store, see motions/sweep.py
# A kill may leave a store without it, or a new file of any name.
_STORED = re.compile(rf"(block_[0-9]+\.npz|{re.escape(STORE_FILE)})({re.escape(NEW)})?")


def prepare_store(out: Path, resume: bool) -> Path:
    """The folder for finished blocks, ``FILE.nc.partial``. Blocks of an earlier run are kept (``resume``) or removed.

    Raises
    ------
    InputError
        If the name does not end in .nc, the folder cannot be written, is a result or belongs to something else, or
        ``resume`` finds no blocks.
    """
    if out.suffix != ".nc":
        raise InputError("the output must end in .nc", str(out), "change the suffix")
    if out.is_dir() or out.with_suffix(".png").is_dir():
        raise InputError("the output must be a file", f"{out} is a folder", "choose another --out")
    check_parents(out.absolute(), "the folder of the output must be writable", "")
    if (out.parent / "parameters.json").exists():
        raise InputError(
            "the output must not lie in a result of fit-params", f"{out.parent} is one", "choose another --out", out
        )
    store = out.with_name(out.name + PARTIAL)
    if resume and not (store / STORE_FILE).is_file():
        raise InputError("--resume needs an interrupted run", "there is none", "run without --resume", store)
    if store.exists() and not resume:
        if not store.is_dir() or not all(_STORED.fullmatch(path.name) for path in store.iterdir()):
            raise InputError(
                "FILE.nc.partial must be unfinished work", "it is something else", "choose another --out", store
            )
        with refusing("FILE.nc.partial must be writable", "choose another --out", store):
            shutil.rmtree(store)
    return store


# cluster: A Dask cluster for the blocks of a map or for rigs: threads or processes of this machine, or a running
# cluster.


#: Longest wait for a scheduler at an address, s.
CONNECT_TIMEOUT = 10.0


@contextmanager
def client_of(scheduler: str | None) -> "Iterator[Client | None]":
    """A Dask client, or None to compute in this process.

    scheduler : "threads" or "processes" for a local cluster, which ends with the client, or the address of a scheduler

    Raises
    ------
    InputError
        If Dask is not installed, or no scheduler answers at the address.
    """
    if scheduler is None:
        yield None
        return
    try:
        from dask import config
        from distributed import Client, LocalCluster
    except ImportError:
        raise InputError(
            "--scheduler needs Dask", "distributed is not installed", "install capsule-id[maps], or remove --scheduler"
        ) from None
    # Each process computes with as many threads as there are cores; see physics/batches.py.
    processes = scheduler == "processes"
    local = {
        "processes": processes,
        "threads_per_worker": 1 if processes else None,
        "dashboard_address": "127.0.0.1:0",  # any free port: another cluster may hold the default one
        "silence_logs": logging.CRITICAL,
    }
    with ExitStack() as opened:
        # A client that no scheduler answers does not restore the setting of Dask, and nothing could be computed later.
        opened.enter_context(config.set(scheduler=config.get("scheduler", None)))
        if processes or scheduler == "threads":
            yield opened.enter_context(Client(opened.enter_context(LocalCluster(**local))))
            return
        try:
            client = Client(scheduler, timeout=CONNECT_TIMEOUT)
        except (OSError, ValueError) as error:
            raise InputError(
                "--scheduler is threads, processes or the address of a Dask scheduler",
                f"{scheduler}: {type(error).__name__}",
                "start the scheduler, or check the address",
            ) from None
        yield opened.enter_context(client)


# bifurcate: ``capsule-id bifurcate``: the settled motions over one quantity or two, as NetCDF and as a figure.


# Defaults of the options: Table 1, with gap and drive of the paper's Fig. 6.
FIG_6_DEFAULTS = {**DEFAULTS, **FIG_6}
MOST_POINTS = 10_000_000


@dataclass(frozen=True)
class Axis:
    """A varied quantity: ``values`` (points,) in SI (f in Hz), and the unit that they are drawn in, of ``factor`` SI."""

    name: str
    values: np.ndarray
    unit: str
    factor: float


_OVER = {"choices": tuple(SWEPT)}
OPTIONS = {
    "": (("data", "DATA", "fitted rig folder, for its parameters (default: Table 1)", {"nargs": "?"}),),
    "varied quantities": (
        ("--over", "NAME", ", ".join(SWEPT), {**_OVER, "required": True}),
        ("--from", "X", "first value", {"dest": "begin", "required": True}),
        ("--to", "X", "last value", {"dest": "end", "required": True}),
        ("--unit", "U", "of --from and --to, e.g. kN/m (default SI)"),
        ("--points", "N", "number of values (default 500; 200 in a map)"),
        ("--with", "NAME", "a second quantity: a map", {**_OVER, "dest": "second"}),
        *((f"--with-{word}", "X", f"--{word} of the second quantity") for word in ("from", "to", "unit", "points")),
    ),
    "motions": (
        (
            "--method",
            None,
            "initial state: rest (default), many states, or the last state at the previous value",
            {"choices": ("rest", "states", "forward", "backward", "both"), "default": "rest"},
        ),
        ("--states", "N", "initial states of --method states (default 16)", {}),
        ("--seed", "N", "random seed of the initial states and of --draws (default 0)", {}),
        ("--dropped", "N", "excitation periods dropped (default 300)", {"default": "300"}),
        ("--observed", "N", "excitation periods observed (default 48)", {"default": "48"}),
        ("--merge-contacts", "X", "s; contacts separated by less count as one (default 0: off)", {"default": "0"}),
        ("--posterior", "FILE", "posterior.nc: compute probabilities and bands", PATH),
        ("--draws", "N", "number of draws with --posterior (default 100)"),
    ),
    **capsule_options(FIG_6_DEFAULTS),
    "execution and output": (
        ("--scheduler", "S", "Dask for maps and bands: threads, processes or an address tcp://..."),
        ("--resume", "", "reuse the finished blocks of an interrupted map"),
        QUIET,
        ("--out", "FILE", "FILE.nc; the figure is FILE.png (default results/<rig>-<quantity>.nc)", PATH),
        NO_CACHE,
    ),
}


def run(args: argparse.Namespace) -> int:
    """Sweep, write FILE.nc and FILE.png; 0.

    Raises
    ------
    InputError
        If a number, unit or combination is not admissible, DATA has no result, or the output cannot be written.
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
    # What a posterior does not hold is that of its fit, not of Table 1.
    if args.posterior is not None and (args.posterior.parent / "parameters.json").is_file() and args.result is None:
        args.result = args.posterior.parent
    free = frozenset(_frequency_leaf(args) if axis.name == "f" else axis.name for axis in axes)
    # The posterior supplies k2.
    values = capsule_values(args, FIG_6_DEFAULTS, free | ({"k2"} if args.posterior is not None else set()))
    names = "-".join(axis.name for axis in axes)
    default = Path(f"bifurcation-{names}.nc") if rig is None else Path("results") / f"{rig.name}-{names}.nc"
    out = default if args.out is None else args.out
    store = prepare_store(out, args.resume)
    from capsule_id.physics.forces import warn_of_far_gap
    from capsule_id.report.figures.style import own_style, png
    from capsule_id.report.write import netcdf_bytes

    with Progress(not args.quiet, unit="point") as progress, client_of(args.scheduler) as client:
        data = _dataset(args, axes, values, {"store": store, "client": client, "progress": progress})
        if "x_rel" in data and all(axis.name != "G" for axis in axes):
            warn_of_far_gap(values["G"], data["x_rel"])
        data.attrs["rig"] = rig.name if rig is not None else ""
        measured: Sequence[MeasuredPoint] = ()
        diagram = len(axes) == 1 and args.posterior is None and args.drive == "harmonic"
        if rig is not None and rig.has_runs and diagram:
            by_name, fitted = args.spring if args.k2 is None else None, fitted_values(args.result, warn=False)
            measured, sentence = overlay(rig, axes[0].name, axes[0].values, values, fitted, by_name)
            complain(sentence)
        with own_style():
            figure = png(draw(data, axes, measured), synthetic=rig is not None and rig.synthetic)
        with refusing("the output must be writable", "choose another --out", out):
            out.parent.mkdir(parents=True, exist_ok=True)
            replace_files({out: netcdf_bytes(data), out.with_suffix(".png"): figure})
    saved.clear()
    shutil.rmtree(store, ignore_errors=True)
    say(_summary_text(data, axes, out))
    return 0


def draw(data: "xr.Dataset", axes: Sequence[Axis], measured: "Sequence[MeasuredPoint]" = ()) -> "Figure":
    """The figure of a computed Dataset. A diagram also shows measured runs, each with its own label."""
    from capsule_id.report.figures import sweeps

    drawn = sweeps.in_units(data, {axis.name: (axis.unit, axis.factor) for axis in axes})
    title = str(data.attrs["rig"])
    if "probability" in data:
        return sweeps.bands(drawn, title)
    if len(axes) == 2:
        return sweeps.motion_map(drawn, title)
    return sweeps.bifurcation(drawn, measured, title)


def _dataset(
    args: argparse.Namespace, axes: Sequence[Axis], values: dict[str, float], work: dict[str, Any]
) -> "xr.Dataset":
    """The Dataset for the options."""
    from capsule_id.motions import sweep
    from capsule_id.physics.drives import capsule_and_drive
    from capsule_id.report.write import read_draws

    settling = cid.Settling(
        dropped=whole_number("dropped", args.dropped),
        observed=whole_number("observed", args.observed),
        merge_contacts=number("merge-contacts", args.merge_contacts),
    )
    leaves: dict[str, Any] = dict(values)
    if args.posterior is not None:
        needs_k2 = args.k2 is None and all(axis.name != "k2" for axis in axes)
        count, seed = whole_number("draws", args.draws or "100"), whole_number("seed", args.seed or "0")
        drawn = read_draws(args.posterior, count, seed)
        draws = leaves_of(drawn, args.spring if needs_k2 else None, args.posterior)
        if "k2" not in draws and needs_k2:
            raise InputError("k2 must be given", "the posterior has several springs or none", "add --spring or --k2")
        given = {name for name in LEAVES if getattr(args, name) is not None}
        leaves |= {name: column for name, column in draws.items() if name not in given}
    p, e = capsule_and_drive(leaves, args.drive)
    x = {axis.name: axis.values for axis in axes}
    (over, grid), *_ = x.items()
    if args.posterior is not None:
        return sweep.bands(sweep.draws_diagram(p, e, over, grid, settling=settling, **work))
    if len(axes) == 2:
        return sweep.motion_map(p, e, x, settling=settling, **work)
    plain = {"settling": settling, "progress": work["progress"]}
    if args.method == "rest":
        return sweep.diagram(p, e, over, grid, **plain)
    if args.method == "states":
        starts = sweep.spread_starts(
            p, e, whole_number("states", args.states or "16"), whole_number("seed", args.seed or "0")
        )
        return sweep.diagram(p, e, over, grid, starts=starts, **plain)
    directions = ("forward", "backward") if args.method == "both" else (args.method,)
    return sweep.continuation(p, e, over, grid, directions=directions, **plain)


def _axes(args: argparse.Namespace) -> tuple[Axis, ...]:
    """The varied quantities, one or two."""
    many = "500" if args.second is None else "200"
    first = _axis("", args.over, args.begin, args.end, args.unit, args.points or many)
    if args.second is None:
        for word in ("from", "to", "unit", "points"):
            if getattr(args, f"with_{word}") is not None:
                raise InputError(f"--with-{word} needs a second quantity", "there is none", "add --with NAME")
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
    n = whole_number(f"{prefix}points", points)
    sign, begins = "positive" if name in ("Omega", "f") else SWEPT[name].sign, f"--{prefix}from {low:g}"
    for holds, rule, value, remedy in (
        (2 <= n <= MOST_POINTS, f"--{prefix}points must lie between 2 and {MOST_POINTS}", points, "give e.g. 500"),
        (sign != "positive" or low > 0.0, f"{name} must be positive", begins, "begin above 0"),
        (sign != "not negative" or low >= 0.0, f"{name} must not be negative", begins, "begin at 0 or above"),
    ):
        if not holds:
            raise InputError(rule, value, remedy)
    return Axis(name, np.linspace(low, high, n) * factor, si if unit is None else unit, factor)


def _check_combination(args: argparse.Namespace, axes: Sequence[Axis]) -> None:
    """Refuse options that do not apply together."""
    names = {axis.name for axis in axes}
    for name in sorted(names - {"f", *CAPSULE_LEAVES, *DRIVES[args.drive]}):
        raise InputError(f"the {args.drive} drive has no {name}", f"--over or --with {name}", "change --drive")
    if len(names) < len(axes) or names == {"f", _frequency_leaf(args)}:
        raise InputError("a map needs two different quantities", f"{args.over} and {args.second}", "name another one")
    bands = args.posterior is not None
    blocks = len(axes) == 2 or bands
    alone, method, many = "one quantity", f"--method {args.method}", args.method == "states"
    for wrong, rule, value, remedy in (
        (bands and len(axes) == 2, "--posterior takes one quantity", "--with", "remove --posterior or --with"),
        (
            blocks and args.method != "rest",
            "maps and bands start from rest",
            method,
            "remove --method",
        ),
        (
            args.scheduler is not None and not blocks,
            "--scheduler is for maps and bands",
            alone,
            "remove it, or add --with or --posterior",
        ),
        (args.resume and not blocks, "--resume is for maps and bands", alone, "remove --resume"),
        (args.spring is not None and "k2" in names, "--spring chooses k2", "k2 is varied", "remove --spring"),
        (args.states is not None and not many, "--states needs --method states", method, "remove --states"),
        (args.seed is not None and not (many or bands), "--seed needs random states or draws", "none", "remove --seed"),
        (args.draws is not None and not bands, "--draws needs --posterior", "there is none", "add --posterior FILE"),
    ):
        if wrong:
            raise InputError(rule, value, remedy)
    for name in sorted(names | ({_frequency_leaf(args)} if "f" in names else set())):
        if getattr(args, name, None) is not None:
            raise InputError(f"a varied {name} has no fixed value", f"--{name} is given", f"remove --{name}")


def _frequency_leaf(args: argparse.Namespace) -> str:
    """The leaf that the frequency f stands for."""
    return "Omega" if args.drive == "harmonic" else "period"


def _summary_text(data: "xr.Dataset", axes: Sequence[Axis], out: Path) -> str:
    """The result in one line or two."""
    wrote = f"wrote {out} and {out.with_suffix('.png')}"
    if "probability" in data:
        axis, (low, middle, high) = axes[0], data["chosen_mean_velocity_quantiles"].to_numpy() * 1e3
        best = float(data["chosen"]) / axis.factor
        found = f"best in the mean of {data.attrs['draws']} draws: {axis.name} = {best:.4g} {axis.unit}, "
        return f"{found}{middle:.3g} mm/s (95 %: {low:.3g} to {high:.3g})\n{wrote}"
    label = data["label"].to_numpy().ravel()
    failed, kinds = int((label == "failed").sum()), len(set(label.tolist()) - {"failed"})
    failures = f", {counted(failed, 'run')} failed (see status)" if failed else ""
    return f"{counted(label.size, 'motion')} of {counted(kinds, 'kind')}{failures}\n{wrote}"


# measured runs: Selects the measured forced runs of a rig for a diagram of the model: those with the settings of the diagram.

#: A setting agrees with the diagram within this relative difference, or within ``VISIBLE`` of its own sds.
RELATIVE_TOLERANCE: Mapping[str, float] = dict.fromkeys(("k2", "G", "P_d"), 0.05) | {"Omega": 0.005}


def overlay(
    rig: Rig,
    over: str,
    x: Sequence[float] | np.ndarray,
    values: Mapping[str, float],
    fitted: Mapping[str, float | None],
    spring: str | None = None,
) -> "tuple[list[MeasuredPoint], str]":
    """Runs of ``rig`` with the settings of a diagram, as its points; and a text: how many, and why others are left out.

    Parameters
    ----------
    over, x : the swept quantity by symbol, and its values from the smallest to the largest one, SI (f in Hz)
    values : of the diagram by symbol, SI; that of the swept quantity is ignored
    fitted : fitted values by name (K, k2[<spring>]); defaults are the paper's estimate, then the median of the prior
    spring : its name, if the k2 of the diagram was chosen by name; None compares stiffnesses

    A run agrees if k2, G, P_d and Omega lie within ``RELATIVE_TOLERANCE`` or ``VISIBLE`` sds; the swept one is free.
    P_d is the stated one, else K times the amplitude of the current.
    """
    estimate = rough_values(rig)

    def known(name: str) -> Quantity:
        """The fitted value, the paper's estimate, or the stated prior: VISIBLE sds are its 95 % range."""
        seen = fitted.get(name)
        value, measured = estimate(name) if seen is None else (seen, True)
        prior = rig.priors.get(name)
        if measured or prior is None or prior.kind != "lognormal":
            # A default prior (factor 1000) is too broad for a comparison.
            return Quantity(value if measured else np.nan)
        return Quantity(value, value * float(np.log(prior.spread)) / VISIBLE)

    motions, left_out = [], []
    for table in rig.tables:
        if not isinstance(table.settings, RunSettings):
            continue
        s = table.settings
        ground = [(s.ground.get(name, Quantity(0.0)), values.get(name, 0.0)) for name in ("slope", "N0")]
        if s.normal_force is not None or any(abs(own.value - x) > VISIBLE * own.sd for own, x in ground):
            found = "another slope, pressing force or load"
        elif s.drive != "harmonic" or s.spring is None or s.spring_back is not None:
            found = "no harmonic force, no support spring, or a spring behind the rod"
        else:
            found = _point_or_reason(table, _settings(table, known), over, x, values, spring)
        if isinstance(found, str):
            left_out.append(f"{table.label} ({found})")
        else:
            motions.append(found)
    said = f"{len(motions)} of {counted(len(motions) + len(left_out), 'measured run')} overlaid"
    return motions, f"{said}; omitted: {'; '.join(left_out)}" if left_out else said


def _point_or_reason(
    table: Table[RunSettings],
    settings: Mapping[str, Quantity],
    over: str,
    x: Sequence[float] | np.ndarray,
    values: Mapping[str, float],
    spring: str | None,
) -> "MeasuredPoint | str":
    """The run as a point of the diagram, or the reason for its omission."""
    swept = "Omega" if over == "f" else over
    if swept not in settings:
        return f"{swept} is not a setting of a run"
    by_name = spring is not None and swept != "k2"
    if by_name and table.settings.spring != spring:
        return f"spring {table.settings.spring}, not {spring}"
    for name, quantity in settings.items():
        if name == "k2" and by_name:
            continue
        if np.isnan(quantity.value):
            return f"{name} is neither fitted nor stated"
        allowed = max(RELATIVE_TOLERANCE[name] * abs(values[name]), VISIBLE * quantity.sd)
        if name != swept and abs(quantity.value - values[name]) > allowed:
            return f"{name} = {quantity.value:.4g}, not {values[name]:.4g} {SWEPT[name].unit}"
    value = settings[swept].value / (2.0 * np.pi if over == "f" else 1.0)
    if not x[0] <= value <= x[-1]:
        return f"{over} = {value:.4g} {SWEPT[over].unit} is outside the diagram"
    from capsule_id.report.figures.sweeps import MeasuredPoint

    motion = measured_motion(table)
    if not np.isfinite(motion.mean_velocity):
        return "x_capsule was not recorded"
    return MeasuredPoint(value, motion.label, motion.mean_velocity)


def _settings(table: Table[RunSettings], known: Callable[[str], Quantity]) -> dict[str, Quantity]:
    """k2, G, P_d and Omega of a run, SI; NaN for an unknown value."""
    P_d = table.settings.P_d
    if P_d is None:
        drive = recorded_drive(table)
        assert drive is not None, "the reader requires P_d or the current"
        K = known("K")
        P_d = Quantity(K.value * drive.amplitude, K.sd * drive.amplitude)
    k2 = known(f"k2[{table.settings.spring}]")
    return {"k2": k2, "G": stated_gap(table), "P_d": P_d, "Omega": Quantity(stated_Omega(table))}
