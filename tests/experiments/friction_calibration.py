"""Calibration of friction tests: a wrong law, trials in sessions, and tables of few rows with a force besides friction.

Run as a script for a study: ``python -m tests.experiments.friction_calibration NUMBER [FIRST_SEED]`` of the misfits, or
``... tiny NUMBER FILE`` of tables of 1 to 8 rows; FILE keeps the outcomes, and a study goes on where it ended.
"""

import json
import sys
from contextlib import suppress
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from scipy.integrate import quad

import capsule_id as cid
from tests.experiments.misfit_study import study
from tests.measured.folders import Entry, make_rig, quantity

#: Misfits: kinetic over static friction 0.8, with the default law and with the free ratio; trials in sessions, of
#: session sd 10 %.
MISFITS = ("ratio, eq. (1)", "ratio, free", "sessions")
MU, V_S, RATIO, SCATTER = 0.66, 0.3, 0.8, 0.03
SPEED = np.geomspace(5e-3, 2.0, 30)
#: Tables of few rows: of one setting, and of several loads or speeds; a constant force besides friction, in units of
#: the friction at the mean setting.
ONE_SETTING, SEVERAL = ("tilts", "pulls", "slides"), ("pulls at loads", "slides at loads", "slides at speeds", "pushes")
OFFSETS, G = (0.0, 0.3), 9.81


@dataclass(frozen=True)
class Outcome:
    """Result of one twin: errors of the logarithms in units of their sd, whether no check failed, and the sd of mu."""

    misfit: str
    seed: int
    z: tuple[float, ...]
    clean: bool
    sd: float


def entry(misfit: str, seed: int) -> Entry:
    """The table of one twin."""
    rng = np.random.default_rng([seed, MISFITS.index(misfit) > 1])
    if misfit == "sessions":
        mu = MU * np.exp(0.1 * np.repeat(rng.standard_normal(6), 5) + SCATTER * rng.standard_normal(30))
        return Entry("static_friction", "t", {"angle [deg]": np.rad2deg(np.arctan(mu))})
    coefficient = (
        MU * (RATIO + (1.0 - RATIO) * np.exp(-SPEED / V_S)) * np.exp(SCATTER * rng.standard_normal(len(SPEED)))
    )
    return Entry("sliding_friction", "t", {"speed [m/s]": SPEED, "coefficient [1]": coefficient})


def outcome(misfit: str, seed: int) -> Outcome:
    """Fit the twin without a sample."""
    with TemporaryDirectory() as name:
        rig = make_rig(Path(name), entry(misfit, seed))
        if misfit == "ratio, free":
            toml = Path(name) / "rig.toml"
            toml.write_text(toml.read_text(encoding="utf-8") + '\n[model]\nfree = ["ratio"]\n', encoding="utf-8")
            rig = cid.read_rig(name)
        result = cid.fit(rig, budget=None)
    truth = {"mu": MU, **({} if misfit == "sessions" else {"v_s": V_S})}
    rows = result.summary.loc[list(truth)]
    # Both are sampled through their logarithms, in which the posterior is nearly normal.
    z = np.log(rows["value"] / list(truth.values())) / (rows["sd"] / rows["value"])
    return Outcome(misfit, seed, tuple(float(one) for one in z), result.clean, float(rows.at["mu", "sd"]))


def tiny(kind: str, rows: int, offset: float, seed: int) -> tuple[Entry, str, dict[str, float]]:
    """A table of few rows, its lines of ``[model]``, and the truth.

    Eq. (1) and its slides by quadrature, besides the package's code. At one load, mu holds the constant force too.
    """
    rng = np.random.default_rng([seed, rows, round(10 * offset), (*ONE_SETTING, *SEVERAL).index(kind)])
    mu, v_s, noise = float(rng.uniform(0.2, 0.8)), float(rng.uniform(0.15, 0.5)), rng.standard_normal(rows)
    model = '\n[model]\nfriction = "constant"\n' if kind in ("slides", "slides at loads") else ""
    one, scatter = mu * (1.0 + offset), 1.0 + 0.03 * noise
    if kind in ONE_SETTING:
        columns = {
            "tilts": {"angle [deg]": np.rad2deg(np.arctan(one)) + 0.5 * noise},
            "pulls": {"force [N]": 20.0 * one * scatter},
            "slides": {"coefficient [1]": one * scatter},
        }[kind]
        settings = {"normal_force": quantity(20.0, "N")} if kind == "pulls" else {}
        return (
            Entry(f"{'sliding' if kind == 'slides' else 'static'}_friction", "t", columns, settings),
            model,
            {"mu": one},
        )
    if kind.endswith("loads"):
        load = rng.permutation(np.linspace(50.0, 200.0, rows)) if rows > 1 else np.array([125.0])
        columns = {"force [N]": mu * (load + offset * np.mean(load)) * scatter, "normal_force [N]": load}
        return Entry(f"{'static' if kind[0] == 'p' else 'sliding'}_friction", "t", columns), model, {"mu": mu}
    speed = np.linspace(0.15, 1.0, rows) if kind == "pushes" else np.geomspace(0.02, 1.5, rows)

    def law(v: float | np.ndarray) -> float | np.ndarray:
        return 0.5 * mu * (1.0 + np.exp(-v / v_s))

    force = offset * float(np.mean(law(speed)))
    truth = {"mu": mu + force, "v_s": v_s}
    if kind == "slides at speeds":
        columns = {"speed [m/s]": speed, "coefficient [1]": (law(speed) + force) * (1.0 + 0.02 * noise)}
        return Entry("sliding_friction", "t", columns), model, truth
    slid = [
        quad(lambda u, s=s: u / (G * s * (law(u) + force)), 0.0, v)[0]
        for v, s in zip(speed, 1.0 + 0.015 * noise, strict=True)
    ]
    columns = {
        "speed [m/s]": speed + 5e-3 * rng.standard_normal(rows),
        "distance [mm]": 1e3 * np.array(slid) + 0.3 * rng.standard_normal(rows),
    }
    settings = {"speed_sd": quantity(5e-3, "m/s"), "distance_sd": quantity(0.3, "mm")}
    return Entry("dynamic_friction", "t", columns, settings), model, truth


@dataclass(frozen=True)
class Tiny:
    """Result of one table of few rows, by parameter: word, whether the interval covers the truth, sd, sd without sample."""

    trust: dict[str, str]
    covers: dict[str, bool]
    sd: dict[str, float]
    sd_of_point: dict[str, float]


def tiny_outcome(kind: str, rows: int, offset: float, seed: int, budget: int = 60_000) -> Tiny:
    """Fit the table with and without a sample."""
    table, model, truth = tiny(kind, rows, offset, seed)
    with TemporaryDirectory() as name:
        with suppress(cid.InputError):  # slides without ``model``
            make_rig(Path(name), table)
        with (Path(name) / "rig.toml").open("a", encoding="utf-8") as file:
            file.write(model)
        rig = cid.read_rig(name)
        found, point = cid.fit(rig, budget=budget).summary, cid.fit(rig, budget=None).summary
    covers = {p: bool(found.at[p, "lower"] <= value <= found.at[p, "upper"]) for p, value in truth.items()}
    sd, of_point = ({p: float(one.at[p, "sd"]) for p in truth} for one in (found, point))
    return Tiny({p: str(found.at[p, "trust"]) for p in truth}, covers, sd, of_point)


def tiny_study(number: int, path: Path) -> tuple[float, dict[str, float]]:
    """Fit ``number`` tables of 1 to 8 rows of each kind, clean and with an offset; ``path`` keeps the outcomes.

    Two unknowns need three rows: fewer are never judged, and are sampled for minutes.
    Print and return the share of trusted intervals that cover, and, by kind, that of clean tables that are trusted: of
    three rows or more at one setting, of eight at several.
    """
    text = path.read_text(encoding="utf-8") if path.exists() else ""
    done = {tuple(key): one for key, one in map(json.loads, text.splitlines())}
    for key in product((*ONE_SETTING, *SEVERAL), range(1, 9), OFFSETS, range(number)):
        if key not in done and (key[1] > 2 or key[0] not in SEVERAL[2:]):
            done[key] = vars(tiny_outcome(*key))
            with path.open("a", encoding="utf-8") as file:
                file.write(json.dumps([key, done[key]]) + "\n")
    words = [(key, name, one) for key, one in done.items() for name in one["trust"]]
    trusted = [(key, one["covers"][name]) for key, name, one in words if one["trust"][name] == "trusted"]
    cover, clean_trusted = float(np.mean([covers for _, covers in trusted])), dict[str, float]()
    print("trusted", len(trusted), "of them cover", cover)
    for kind in (*ONE_SETTING, *SEVERAL):
        fewest = 3 if kind in ONE_SETTING else 8
        clean = [
            one["trust"][name] for key, name, one in words if key[0] == kind and key[1] >= fewest and key[2] == 0.0
        ]
        for offset in OFFSETS:
            own = [covers for key, covers in trusted if key[0] == kind and key[2] == offset]
            print(kind, offset, "trusted", len(own), "cover", sum(own))
        clean_trusted[kind] = float(np.mean([word == "trusted" for word in clean]))
        print(kind, f"clean, {fewest} rows or more: trusted", clean_trusted[kind])
    for rows in range(1, 9):
        ratio = [
            one["sd_of_point"][p] / one["sd"][p]
            for key, p, one in words
            if key[1] == rows and key[0] not in SEVERAL[2:]
        ]
        print(rows, "rows of one unknown: sd without sample / sd", np.quantile(ratio, [0.0, 0.5, 1.0]))
    return cover, clean_trusted


if __name__ == "__main__":
    if sys.argv[1] == "tiny":
        tiny_study(int(sys.argv[2]), Path(sys.argv[3]))
    else:
        study(MISFITS, outcome)
