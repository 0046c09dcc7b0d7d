"""Settings of drive and rig that maximise the mean velocity of the capsule, averaged over draws of the posterior."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr
from scipy.optimize import differential_evolution

from capsule_id.console import OnProgress
from capsule_id.errors import InputError
from capsule_id.experiments.forced_run.declaration import RunSettings
from capsule_id.experiments.friction_model import ground_parameters
from capsule_id.experiments.progression.declaration import AMPLITUDE, ProgressionSettings, settings_of
from capsule_id.inference.prediction import random_draws
from capsule_id.inference.result import Result, held_leaves
from capsule_id.motions.response import REST, Settling
from capsule_id.motions.sweep import QUANTILES, MotionColumns, SweepPoints, compute, spread_starts
from capsule_id.parameters import CAPSULE_LEAVES, DRIVES, LEAVES, by_index, refuse_another_law
from capsule_id.physics.batches import lanes_of
from capsule_id.physics.drives import capsule_and_drive
from capsule_id.physics.model import Initial, without_absent
from capsule_id.records.motion import measured_motion
from capsule_id.records.tones import recorded_drive, stated_gap, stated_Omega
from capsule_id.rig.model import Quantity, Table

#: Draws of the posterior at which every setting is computed.
DRAWS = 16
#: Members of a generation for each searched setting (rounded up to a power of 2), and generations after the first one.
MEMBERS, GENERATIONS = 16, 16
#: Periods dropped and observed in the search and on the map, and at the settings that the search has found.
SEARCH, FINAL = Settling(80, 24, exponent_periods=0), Settling(exponent_periods=0)
#: Best members of the last generation that are computed with ``FINAL`` periods.
FINALISTS = 4
#: Values of each axis of the map, and of the only axis of a curve.
MAP_POINTS, CURVE_POINTS = 15, 61
#: Initial states from which other settled motions are searched for.
STARTS = 16
#: Change of a searched setting in the table of sensitivities, in parts of the range of the search.
STEP = 0.05
#: A best setting this near to an end of its range, in parts of the range, lies at that end.
AT_END = 0.01
#: Mean velocities of this size, m/s, order settings of equal probability.
VELOCITY_SCALE = 1e-3
MM_PER_M = 1e3

Values = Mapping[str, Any]  # by symbol, SI


@dataclass(frozen=True)
class Tuning:
    """The best setting and what is near it; velocities in mm/s, settings in SI.

    Attributes
    ----------
    best : the chosen settings by symbol
    table : row "best", then a row per measured operating point of this drive: settings, ``predicted [mm/s]`` (mean over
        the draws) with ``lower`` and ``upper`` (95 %), ``probability`` of a mean velocity above the threshold or above 0,
        ``measured [mm/s]``, ``trust``: "trusted", or "not judged" where the result is not trusted
    motions : settled motions from ``STARTS`` initial states at the best setting: label, share of draws and states, velocity
    sensitivity : by parameter: its sd, or the step of a setting, and the predicted velocity one step below and above
    surface : mean velocity (m/s) over the first one or two searched settings, the others at their best
    at_bound : searched settings whose best value lies at an end of their range
    computed, failed : number of settings of the search, and of those where the motion of a draw could not be computed
    """

    best: Mapping[str, float]
    table: pd.DataFrame
    motions: pd.DataFrame
    sensitivity: pd.DataFrame
    surface: xr.Dataset
    at_bound: tuple[str, ...]
    computed: int
    failed: int

    @property
    def points(self) -> list[tuple[str, dict[str, float], float]]:
        """The measured operating points: label, settings by symbol, SI, and measured mean velocity, mm/s."""
        symbols = {f"{name} [{leaf.unit}]": name for name, leaf in LEAVES.items()}
        return [
            (str(label), {symbols[key]: x for key, x in row.items() if key in symbols}, row["measured [mm/s]"])
            for label, row in self.table.iloc[1:].to_dict("index").items()
        ]


@dataclass(frozen=True)
class _Model:
    """The capsule at draws of the posterior: ``leaves`` by symbol, () or (draws,), and the name of the drive."""

    leaves: Values
    drive: str
    draws: int

    def motions(self, settings: Values, settling: Settling, initial: Initial = REST) -> MotionColumns:
        """Columns (n, draws) of the settled motions at ``settings``, each (n,) or (n, draws), from ``initial``, each (n,)."""
        n = max((len(x) for x in settings.values()), default=1)
        lanes = {
            name: np.broadcast_to(np.reshape(x, (-1, 1) if np.ndim(x) == 1 else (-1, self.draws)), (n, self.draws))
            for name, x in settings.items()
        }
        lanes = {name: np.broadcast_to(x, (n, self.draws)) for name, x in self.leaves.items()} | lanes
        p, e = without_absent(*capsule_and_drive({name: x.ravel() for name, x in lanes.items()}, self.drive))
        begin: Any = tuple(np.repeat(np.broadcast_to(x, n), self.draws) for x in initial)
        points = SweepPoints(*lanes_of((p, e, begin), np.zeros(1))[0])
        seen = compute(points, settling, ("mean_velocity", "label"))
        return {name: column.reshape(n, self.draws) for name, column in seen.items()}

    def velocity(self, settings: Values, settling: Settling) -> np.ndarray:
        """(n, draws) mean velocities, m/s; NaN where a run is given up."""
        return self.motions(settings, settling)["mean_velocity"]


def score(velocity: np.ndarray, faster_than: float | None) -> np.ndarray:
    """(n,) what is maximised, from velocities (n, draws): their mean, or the share above a threshold; -inf after a failure.

    Draws are few. The mean velocity orders settings with equal shares, and never outweighs a draw.
    """
    goal = velocity.mean(axis=1)
    if faster_than is not None:
        share = (velocity > faster_than).mean(axis=1)
        goal = share + np.arctan(goal / VELOCITY_SCALE) / (np.pi * velocity.shape[1])
    return np.where(np.isfinite(goal), goal, -np.inf)


def tune(
    result: Result,
    bounds: Mapping[str, tuple[float, float]],
    given: Mapping[str, float] | None = None,
    *,
    faster_than: float | None = None,
    spring: str | None = None,
    draws: int = DRAWS,
    seed: int = 0,
    progress: OnProgress | None = None,
) -> Tuning:
    """Search the settings that maximise the mean velocity of the settled motion from rest, in the mean over draws.

    Differential evolution (Storn & Price 1997) from Sobol points; each generation is one batch of setting x draw.

    Parameters
    ----------
    result : of a sampled fit with eq. (1)
    bounds : symbol of a leaf (P_d, Omega, G, k2, period, duty ...) -> the two ends of its search, SI
    given : fixed leaves by symbol, SI, in the place of fitted values and defaults
    faster_than : m/s, 0 or more: maximise the probability of a larger mean velocity instead
    spring : name of the fitted support spring that gives k2, where there are several
    draws, seed : number of draws, and the seed of their choice and of the search

    Raises
    ------
    InputError
        If nothing was sampled, the fit has another friction law, bounds or values are not admissible, or one is missing.
    """
    given = dict(given or {})
    rng = np.random.default_rng(seed)
    chosen = random_draws(result, draws, rng)
    drive = "pulses" if {*bounds, *given} & ({*DRIVES["pulses"]} - {*DRIVES["harmonic"]}) else "harmonic"
    _check_search(result, bounds, given, drive, faster_than)
    model = _Model(_leaves(result, chosen, drive, {*bounds}, given, spring), drive, draws)
    found, computed, failed = _search(model, bounds, faster_than, seed, progress)
    surface = _surface(model, bounds, dict(zip(bounds, found[0], strict=True)))
    # The best point of the map may stand on a summit that the search has missed.
    highest = surface["mean_velocity"].fillna(-np.inf).argmax(...)
    on_map = {name: float(surface[name][int(at)]) for name, at in highest.items()}
    last = np.array([on_map.get(str(name), x) for name, x in zip(bounds, found[0], strict=True)])
    finalists = dict(zip(bounds, np.vstack([found, last]).T, strict=True))
    goal = score(model.velocity(finalists, FINAL), faster_than)
    if not np.isfinite(goal).any():
        rule = "a setting needs a motion that can be computed for every draw"
        raise InputError(rule, f"none of {computed} settings", "search a smaller range")
    best = {name: float(x[np.argmax(goal)]) for name, x in finalists.items()}
    place = {name: (best[name] - low) / (high - low) for name, (low, high) in bounds.items()}
    return Tuning(
        best,
        _table(
            model, best, operating_points(result, chosen, drive), _fitted(result, chosen), faster_than, result.trust
        ),
        _other_motions(model, best, seed),
        _sensitivity(model, best, bounds),
        surface,
        tuple(name for name, x in place.items() if not AT_END < x < 1.0 - AT_END),
        computed,
        failed,
    )


def _search(
    model: _Model, bounds: Values, faster_than: float | None, seed: int, progress: OnProgress | None
) -> tuple[np.ndarray, int, int]:
    """The best members of the last generation (FINALISTS, d), the best first; numbers of computed and failed settings."""
    computed = failed = 0

    def cost(x: np.ndarray) -> np.ndarray:
        """(n,) of the settings x (d, n)."""
        nonlocal computed, failed
        goal = score(model.velocity(dict(zip(bounds, x, strict=True)), SEARCH), faster_than)
        computed, failed = computed + len(goal), failed + int(np.isneginf(goal).sum())
        if progress is not None:
            progress(computed, (1 + GENERATIONS) * len(goal), "settings")
        return -goal

    words: dict[str, Any] = {"init": "sobol", "popsize": MEMBERS, "maxiter": GENERATIONS, "polish": False, "rng": seed}
    found: Any = differential_evolution(cost, list(bounds.values()), vectorized=True, updating="deferred", **words)
    return found.population[np.argsort(found.population_energies)[:FINALISTS]], computed, failed


def _check_search(result: Result, bounds: Values, given: Values, drive: str, faster_than: float | None) -> None:
    """Refuse what cannot be searched."""
    refuse_another_law(result.provenance.friction)
    if not bounds:
        raise InputError(
            "a search needs the bounds of a setting", "none", "give two values of P_d, Omega, G or another"
        )
    if faster_than is not None and not 0.0 <= faster_than < np.inf:
        raise InputError("the velocity to exceed must be finite and not negative", f"{faster_than:g} m/s", "give m/s")
    known = {*CAPSULE_LEAVES, *DRIVES[drive]}
    for name, values in ({name: (x,) for name, x in given.items()} | dict(bounds)).items():
        if name not in known:
            raise InputError(f"the {drive} drive has no {name}", name, "remove it, or the settings of the other drive")
        low, high = values[0], values[-1]
        if len(values) == 2 and not -np.inf < low < high < np.inf:
            raise InputError(f"the bounds of {name} must be finite and increase", f"{low:g} and {high:g}", "swap them")
        positive = name in ("Omega", "period")
        if not all(LEAVES[name].admits(x) and (x > 0.0 or not positive) for x in values):
            unit = LEAVES[name].unit
            raise InputError(
                f"{name} must be admissible", f"{low:g} to {high:g} {unit}", "give finite, positive values"
            )
        if name == "duty" and not 0.0 < low <= high < 1.0:
            raise InputError("duty must lie between 0 and 1", f"{low:g} to {high:g}", "give shares of the period")


def _leaves(
    result: Result, chosen: Mapping[str, np.ndarray], drive: str, searched: set[str], given: Values, spring: str | None
) -> dict[str, Any]:
    """Leaves of model and drive by symbol, () or (draws,): defaults, then stated, fitted and given values.

    Raises
    ------
    InputError
        If the spring was not fitted, or a value is missing.
    """
    rig, springs = result.rig, by_index("k2", chosen)
    of_runs = [table for table in rig.tables if isinstance(table.settings, RunSettings)]
    runs = [table.settings for table in of_runs]
    front = [name for name in springs if name not in {run.spring_back for run in runs} - {run.spring for run in runs}]
    spring = front[0] if spring is None and len(front) == 1 else spring
    if spring is not None and spring not in springs:
        raise InputError("spring must be a fitted one", spring, f"choose from {', '.join(springs) or 'none'}")
    own = {*CAPSULE_LEAVES, *DRIVES[drive]}
    values: dict[str, Any] = {name: LEAVES[name].default for name in DRIVES[drive]} | _fitted(result, {})
    # Without a support spring the rod moves freely.
    values |= {"k2": 0.0, "G": np.inf} if not front and not {"k2", "G"} & {*given, *searched} else {}
    progressions = [table.settings for table in rig.tables if isinstance(table.settings, ProgressionSettings)]
    # Friction under a load of a run's own is not that under the weight.
    values |= {"N0": None} if any(run.normal_force is not None for run in runs) else {}
    stated = {quantity.value for one in progressions if (quantity := getattr(one, AMPLITUDE[drive])) is not None}
    values |= {AMPLITUDE[drive]: stated.pop()} if len(stated) == 1 else {}
    differ = len({(run.spring_back, run.gap_back) for run in runs}) > 1
    if differ and given.get("k2_back") != 0.0 and not {"k2_back", "G_back"} <= {*given, *searched}:
        rule = "tune needs k2_back and G_back where the runs do not have the same spring behind the rod"
        raise InputError(rule, "none", "give both, in N/m and m; k2_back = 0: none")
    values |= {"k2_back": 0.0, "G_back": np.inf} if differ else _behind(of_runs[0], chosen) if runs else {}
    values |= {**result.fixed, **chosen} | ({} if spring is None else {"k2": springs[spring]}) | dict(given)
    needed = {name for name in own if LEAVES[name].default is None or values.get(name, 0.0) is None} - searched
    for name in sorted(needed):
        if values.get(name) is None:
            leaf = LEAVES[name]
            remedy = f"give {name}: one value, or the two bounds of its search, in {leaf.unit}"
            several = f"; or choose the spring from {', '.join(springs)}" if name == "k2" and springs else ""
            raise InputError(f"tune needs {name} ({leaf.meaning})", "the fit has none", remedy + several)
    return {name: x for name, x in values.items() if name in own and x is not None and name not in searched}


def _fitted(result: Result, chosen: Mapping[str, np.ndarray]) -> dict[str, Any]:
    """Leaves of model and drive as stated in [rig] and [model], and as fitted, () or (draws,), by symbol."""
    values = {**held_leaves(result.rig), **result.fixed, **chosen}
    return {name: x for name, x in values.items() if name in LEAVES}


def _value(chosen: Mapping[str, np.ndarray], symbol: str, table: Table[Any], stated: Quantity) -> Any:
    """The fitted value of a setting of a run, (draws,); the ``stated`` one where it is exact or was not fitted."""
    return (
        stated.value if stated.sd == 0.0 else chosen.get(f"{symbol}[{table.label}]", chosen.get(symbol, stated.value))
    )


def _behind(table: Table[Any], chosen: Mapping[str, np.ndarray]) -> dict[str, Any]:
    """k2_back, (draws,) N/m, and G_back, m, of a run with a spring behind the rod; {} without one."""
    k2, gap = chosen.get(f"k2[{table.settings.spring_back}]"), table.settings.gap_back
    return {} if gap is None or k2 is None else {"k2_back": k2, "G_back": _value(chosen, "G_back", table, gap)}


def operating_points(result: Result, chosen: Mapping[str, np.ndarray], drive: str) -> list[tuple[str, Values, float]]:
    """Measured operating points of this drive: label, settings by symbol, () or (draws,), and mean velocity, m/s.

    Those of forced runs with a fitted spring or none, and of the settings of progressions (mean over the trials); no square
    waves.
    """
    found = list[tuple[str, Values, float]]()
    for table in result.rig.tables:
        settings = table.settings
        if not isinstance(settings, RunSettings | ProgressionSettings) or settings.drive != drive:
            continue
        # Equal statements of several runs have the name of the first; a stated 0 differs from [rig] too.
        names = {row.symbol: row.name for row in ground_parameters(table, result.rig)}
        ground = {name: 0.0 for name in ("slope", "N0") if getattr(settings, name) is not None}
        ground |= {name: chosen.get(names.get(name, ""), stated.value) for name, stated in settings.ground.items()}
        ground |= {} if settings.lag is None else {"lag": _value(chosen, "lag", table, settings.lag)}
        if isinstance(settings, ProgressionSettings):
            rows, source = settings_of(table.columns, settings)
            speed = table["distance"] / (rows[:, 0] * rows[:, 1])
            for period, duty, size in np.unique(rows[:, (0, 2, 3)], axis=0):
                own = {"period": period, "duty": duty} if drive == "pulses" else {"Omega": 2.0 * np.pi / period}
                own |= ground
                own |= {AMPLITUDE[drive]: size} if source == "column" else {}
                own |= {AMPLITUDE[drive]: size * chosen["K"]} if source == "current" else {}
                if source == "setting":
                    own |= {
                        AMPLITUDE[drive]: _value(chosen, AMPLITUDE[drive], table, getattr(settings, AMPLITUDE[drive]))
                    }
                words = [
                    f"{1e3 * period:g} ms",
                    f"duty {duty:g}" if drive == "pulses" else "",
                    {"column": f"{size:g} N", "current": f"{size:g} A"}.get(source, ""),
                ]
                same = np.all(rows[:, (0, 2, 3)] == (period, duty, size), axis=1)
                label = f"{table.label}: {', '.join(word for word in words if word)}"
                found.append((label, own, float(np.mean(speed[same]))))
            continue
        k2 = 0.0 if settings.spring is None else chosen.get(f"k2[{settings.spring}]")
        current = recorded_drive(table) if drive == "harmonic" and settings.P_d is None else None
        amplitude = getattr(settings, AMPLITUDE[drive])
        force = amplitude and _value(chosen, AMPLITUDE[drive], table, amplitude)
        force = chosen["K"] * current.amplitude if current and "K" in chosen else force
        if k2 is None or force is None:
            continue
        if settings.normal_force is not None:
            known = _fitted(result, chosen) | ground
            weight = (known["m1"] + known["m2"]) * known["g"] * np.cos(known["slope"])
            ground["N0"] = settings.normal_force - weight
        gap = _value(chosen, "G", table, stated_gap(table))
        own = {"k2": k2, "G": gap, AMPLITUDE[drive]: force, **ground, **_behind(table, chosen)}
        Omega = stated_Omega(table)
        own |= {"Omega": Omega} if drive == "harmonic" else {"period": 2.0 * np.pi / Omega, "duty": settings.duty}
        found.append((table.label, own, measured_motion(table).mean_velocity))
    return found


def _table(
    model: _Model,
    best: Values,
    points: list[tuple[str, Values, float]],
    fitted: Values,
    faster_than: float | None,
    trust: str,
) -> pd.DataFrame:
    """``Tuning.table``. Measured points are those of the ``fitted`` rig, not of the one that was searched or given."""
    rows, threshold, known = {}, MM_PER_M * (faster_than or 0.0), {k: x for k, x in fitted.items() if x is not None}
    shown = list(dict.fromkeys([*best, *(name for _, own, _ in points for name in own)]))
    leaves = {**model.leaves, **best}
    # A point names its spring behind the rod, and the force between its pulses, where it has them.
    none = {name: x for name, x in {"k2_back": 0.0, "G_back": np.inf, "P_off": 0.0}.items() if name in leaves}
    everything = [leaves, *({**leaves, **none, **known, **own} for _, own, _ in points)]
    settings = {
        name: np.stack([np.broadcast_to(one[name], model.draws) for one in everything]) for name in everything[0]
    }
    predicted = MM_PER_M * model.velocity(settings, FINAL)
    measured = [("best", np.nan), *((label, MM_PER_M * speed) for label, _, speed in points)]
    for i, (label, speed) in enumerate(measured):
        lower, _, upper = np.quantile(predicted[i], QUANTILES)
        rows[label] = {f"{name} [{LEAVES[name].unit}]": float(np.mean(settings[name][i])) for name in shown} | {
            "predicted [mm/s]": float(predicted[i].mean()),
            "lower [mm/s]": float(lower),
            "upper [mm/s]": float(upper),
            f"P(> {threshold:g} mm/s)": float((predicted[i] > threshold).mean()),
            "measured [mm/s]": speed,
            "trust": "trusted" if trust == "trusted" else "not judged",
        }
    return pd.DataFrame.from_dict(rows, orient="index").rename_axis("setting")


def _other_motions(model: _Model, best: Values, seed: int) -> pd.DataFrame:
    """``Tuning.motions``, the most frequent first."""
    middle = {name: float(np.median(x)) for name, x in {**model.leaves, **best}.items()}
    starts = spread_starts(*capsule_and_drive(middle, model.drive), STARTS, seed)
    seen = model.motions({name: np.full(STARTS, x) for name, x in best.items()}, FINAL, starts)
    frame = pd.DataFrame({"motion": seen["label"].ravel(), "velocity": MM_PER_M * seen["mean_velocity"].ravel()})
    found = frame.groupby("motion")["velocity"]
    columns = {"share": found.size() / len(frame), "mean velocity [mm/s]": found.mean()}
    return pd.DataFrame(columns).sort_values(by="share", ascending=False, kind="stable")


def _sensitivity(model: _Model, best: Values, bounds: Mapping[str, tuple[float, float]]) -> pd.DataFrame:
    """``Tuning.sensitivity``. Draws of a positive parameter are multiplied, so that they stay positive."""
    fixed, changes, rows = {name: np.full(model.draws, x) for name, x in best.items()}, [], {}
    for name, x in model.leaves.items():
        if np.ndim(x) and np.std(x) > 0.0:
            factor = np.exp(np.std(np.log(np.abs(x)))) if np.all(x > 0.0) or np.all(x < 0.0) else None
            pair = (x - np.std(x), x + np.std(x)) if factor is None else (x / factor, x * factor)
            changes.append((name, "sd", float(np.std(x)), pair))
    for name, (low, high) in bounds.items():
        step = STEP * (high - low)
        changes.append((name, "step", step, tuple(np.clip(best[name] + s * step, low, high) for s in (-1.0, 1.0))))
    sides = [{**model.leaves, **fixed, name: side} for name, _, _, pair in changes for side in pair]
    every = {name: np.stack([np.broadcast_to(side[name], model.draws) for side in sides]) for name in sides[0]}
    velocity = MM_PER_M * model.velocity(every, FINAL).mean(axis=1)
    for (name, word, step, _), (below, above) in zip(changes, velocity.reshape(-1, 2), strict=True):
        rows[name] = {
            "unit": LEAVES[name].unit,
            "change": word,
            "size": step,
            "below [mm/s]": below,
            "above [mm/s]": above,
        }
    return pd.DataFrame.from_dict(rows, orient="index").rename_axis("parameter")


def _surface(model: _Model, bounds: Mapping[str, tuple[float, float]], best: Values) -> xr.Dataset:
    """``Tuning.surface``."""
    shown = list(bounds)[:2]
    number = MAP_POINTS if len(shown) == 2 else CURVE_POINTS
    axes = {name: np.linspace(*bounds[name], number) for name in shown}
    mesh = dict(zip(shown, np.meshgrid(*axes.values(), indexing="ij"), strict=True))
    shape = mesh[shown[0]].shape
    settings = {name: np.broadcast_to(x, shape).ravel() for name, x in {**best, **mesh}.items()}
    velocity = model.velocity(settings, SEARCH)
    about = {"units": "m/s", "long_name": "mean velocity of the capsule, mean over the draws"}
    quantiles = np.quantile(velocity, QUANTILES, axis=1).reshape(-1, *shape)
    return xr.Dataset(
        {
            "mean_velocity": (shown, velocity.mean(axis=1).reshape(shape), about),
            "mean_velocity_quantiles": (("quantile", *shown), quantiles, about),
        },
        {name: (name, x, {"units": LEAVES[name].unit}) for name, x in axes.items()} | {"quantile": list(QUANTILES)},
    )
