"""The list of planted faults of the study of remedies: each is a function of a clean folder and a seed.

Written before any message was changed. ``ending`` is what following the printed text to the letter must give:
"a" the true values are covered and trusted, "b" the text names the cause and the measurement to repeat, "c" the text names
the cause, proposes no edit, and the parameters are not trusted.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import numpy as np

Random = np.random.Generator


@dataclass
class Folder:
    """A rig folder in memory: lines of ``rig.toml``, lines of each table, and the true values by name."""

    toml: list[str]
    tables: dict[str, list[str]]
    truth: dict[str, float] = field(default_factory=dict)

    def write(self, folder: Path) -> Path:
        """Write the files into ``folder``."""
        folder.mkdir(parents=True, exist_ok=True)
        for name, lines in {"rig.toml": self.toml, **self.tables}.items():
            (folder / name).write_text("\n".join(lines) + "\n", encoding="utf-8")
        return folder

    def replace(self, old: str, new: str) -> None:
        """Replace a part of ``rig.toml`` that stands there."""
        assert old in "\n".join(self.toml), old
        self.toml = "\n".join(self.toml).replace(old, new).split("\n")


@dataclass(frozen=True)
class Planted:
    """A fault in a folder; ``cause``: words of which the text must hold one for "b" and "c"."""

    kind: str
    seed: int
    clean: Callable[[Random], Folder]
    plant: Callable[[Folder, Random], None]
    ending: str
    cause: tuple[str, ...] = ()


HEAD = '[rig]\nname = "a"\nm1 = { value = 110, sd = 0.2, unit = "g" }\nm2 = { value = 530, sd = 0.5, unit = "g" }'
MASSES = {"m1": 0.11, "m2": 0.53}


def decay(rng: Random, samples: int = 700, step: float = 1e-3, digits: int = 5) -> Folder:
    """A viscous decay of 15 to 25 Hz in mm, 3 to 5 mm at the start."""
    k1, c, noise = 0.11 * (2 * np.pi * rng.uniform(15.0, 25.0)) ** 2, rng.uniform(0.8, 1.3), 1e-2
    time = step * np.arange(samples)
    values = released(time, rng.uniform(3.0, 5.0), k1, c) + noise * rng.standard_normal(samples)
    lines = rows(("time [s]", "x_rel [mm]"), time, values, digits)
    toml = f'{HEAD}\n[[experiment]]\nkind = "free_vibration"\nfile = "decay.csv"'
    return Folder(toml.split("\n"), {"decay.csv": lines}, {"k1": k1, "c": c})


def released(time: np.ndarray, amplitude: float, k1: float, c: float, m1: float = 0.11) -> np.ndarray:
    """A viscous decay released at rest."""
    gamma = c / (2.0 * m1)
    omega = np.sqrt(k1 / m1 - gamma**2)
    return amplitude * np.exp(-gamma * time) * (np.cos(omega * time) + gamma / omega * np.sin(omega * time))


def rows(headers: tuple[str, str], time: np.ndarray, values: np.ndarray, digits: int = 5) -> list[str]:
    """The lines of a table of two columns."""
    return [",".join(headers), *(f"{t:.{digits}f},{x:.4f}" for t, x in zip(time, values, strict=True))]


def columns(folder: Folder) -> tuple[np.ndarray, np.ndarray]:
    """The readings of a decay."""
    time, values = np.array([line.split(",") for line in folder.tables["decay.csv"][1:]], dtype=float).T
    return time, values


def rewrite(folder: Folder, time: np.ndarray, values: np.ndarray, digits: int = 5) -> None:
    """Write other readings of a decay under the same headers."""
    first, second = folder.tables["decay.csv"][0].split(",")
    folder.tables["decay.csv"] = rows((first, second), time, values, digits)


def pulls(rng: Random, trials: int = 14) -> Folder:
    """Pulls until slip at several loads, with a scatter of 2 %."""
    mu, load = rng.uniform(0.3, 0.6), np.resize([6.3, 9.2, 12.1, 15.0, 18.3], trials)
    force = mu * load * (1.0 + 0.02 * rng.standard_normal(trials))
    lines = ["force [N],normal_force [N]", *(f"{f:.3f},{n:.2f}" for f, n in zip(force, load, strict=True))]
    toml = f'{HEAD}\n[[experiment]]\nkind = "static_friction"\nfile = "pulls.csv"'
    return Folder(toml.split("\n"), {"pulls.csv": lines}, {"mu": mu})


def tilts(rng: Random, trials: int = 14) -> Folder:
    """Tilts until slip, deg."""
    mu = rng.uniform(0.3, 0.6)
    angle = np.rad2deg(np.arctan(mu)) + 0.4 * rng.standard_normal(trials)
    lines = ["angle [deg]", *(f"{a:.2f}" for a in angle)]
    toml = f'{HEAD}\n[[experiment]]\nkind = "static_friction"\nfile = "tilts.csv"'
    return Folder(toml.split("\n"), {"tilts.csv": lines}, {"mu": mu})


def sliding(rng: Random, points: int = 24) -> Folder:
    """Steady sliding with the same friction at every speed."""
    mu, speed = rng.uniform(0.3, 0.6), np.linspace(0.02, 0.4, points)
    force = mu * 0.64 * 9.81 * (1.0 + 0.01 * rng.standard_normal(points))
    lines = ["speed [m/s],force [N]", *(f"{v:.4f},{f:.4f}" for v, f in zip(speed, force, strict=True))]
    toml = f'{HEAD}\n[model]\nfriction = "constant"\n[[experiment]]\nkind = "sliding_friction"\nfile = "slides.csv"'
    return Folder(toml.split("\n"), {"slides.csv": lines}, {"mu": mu})


# Words and units.


def header(old: str, new: str, folder: Folder, rng: Random) -> None:
    """Write another header."""
    del rng
    (name,) = folder.tables
    assert old in folder.tables[name][0]
    folder.tables[name][0] = folder.tables[name][0].replace(old, new)


def word(old: str, new: str, folder: Folder, rng: Random) -> None:
    """Write another word in ``rig.toml``."""
    del rng
    folder.replace(old, new)


def scaled(column: int, factor: float, unit: str, folder: Folder, rng: Random) -> None:
    """The readings of one column in another unit, ``unit``; "" where the header keeps the wrong one."""
    del rng
    time, values = columns(folder)
    time, values = (time * factor, values) if column == 0 else (time, values * factor)
    rewrite(folder, time, values, 0 if factor > 1e6 else 5)
    if unit:
        first, second = folder.tables["decay.csv"][0].split(",")
        both = [first, second]
        both[column] = f"{both[column].partition(' [')[0]} [{unit}]"
        folder.tables["decay.csv"][0] = ",".join(both)


def pull_trace(folder: Folder, rng: Random) -> None:
    """A force against time in place of a table of trials."""
    time = 0.01 * np.arange(500)
    force = np.where(time < 1.0, 0.0, np.where(time < 3.0, 2.0 * (time - 1.0), 2.2)) + 0.03 * rng.standard_normal(500)
    folder.tables["pulls.csv"] = rows(("time [s]", "force [N]"), time, force, 2)


# Columns.


def swapped(folder: Folder, rng: Random) -> None:
    """The columns exchanged, their headers not."""
    del rng
    first, *body = folder.tables["decay.csv"]
    folder.tables["decay.csv"] = [first, *(",".join(line.split(",")[::-1]) for line in body)]


def text_column(mapped: bool, folder: Folder, rng: Random) -> None:
    """A column of text in front of the readings, which no column of the kind is read from."""
    del rng
    (name,) = folder.tables
    first, *body = folder.tables[name]
    if mapped:
        first = first.replace("[", "(").replace("]", ")").replace("_", " ")
        own = ", ".join(f'{key} = {{ from = "{key.replace("_", " ")} (N)", unit = "N" }}' for key in KEYS[name])
        folder.toml += [f"columns = {{ {own} }}"]
    folder.tables[name] = [f"block,{first}", *(f"A no. {k},{line}" for k, line in enumerate(body, 1))]


KEYS = {"pulls.csv": ("force", "normal_force")}


def more_column(name: str, folder: Folder, rng: Random) -> None:
    """One more column of numbers in front."""
    (file,) = folder.tables
    first, *body = folder.tables[file]
    folder.tables[file] = [f"{name},{first}", *(f"{rng.uniform(1.0, 5.0):.2f},{line}" for line in body)]


def signed(folder: Folder, rng: Random) -> None:
    """The second half of the points slides backwards: speeds and forces negative."""
    del rng
    first, *body = folder.tables["slides.csv"]
    back = [",".join(f"-{cell}" for cell in line.split(",")) for line in body[1::2]]
    folder.tables["slides.csv"] = [first, *body[::2], *back]


# Clocks.


def restarted(folder: Folder, rng: Random) -> None:
    """The clock jumps back during the record, not to its beginning."""
    time, values = columns(folder)
    row = int(rng.integers(300, 500))
    time[row:] -= rng.uniform(0.1, 0.2)
    rewrite(folder, time, values)


def two_records(folder: Folder, rng: Random) -> None:
    """A second record of the same decay below the first one, with its own clock from 0."""
    time, values = columns(folder)
    other = 0.8 * values + 1e-2 * rng.standard_normal(len(values))
    rewrite(folder, np.concatenate([time, time]), np.concatenate([values, other]))


def rounded(step: float, folder: Folder, rng: Random) -> None:
    """Times rounded down to a multiple of ``step``, so that several samples share one."""
    time, values = columns(folder)
    time = time + rng.uniform(0.0, 1e-4)
    rewrite(folder, np.floor(time / step + 1e-9) * step, values)


def repeated_rows(folder: Folder, rng: Random) -> None:
    """A few rows written twice."""
    first, *body = folder.tables["decay.csv"]
    for row in sorted(rng.choice(len(body), 4, replace=False))[::-1]:
        body.insert(row, body[row])
    folder.tables["decay.csv"] = [first, *body]


def held_times(folder: Folder, rng: Random) -> None:
    """The time of one row stays for the next two."""
    time, values = columns(folder)
    row = int(rng.integers(100, 400))
    time[row + 1 : row + 3] = time[row]
    rewrite(folder, time, values)


def shuffled(folder: Folder, rng: Random) -> None:
    """Rows out of order: one block exchanged with the next."""
    first, *body = folder.tables["decay.csv"]
    row = int(rng.integers(100, 300))
    body[row : row + 200] = body[row + 100 : row + 200] + body[row : row + 100]
    folder.tables["decay.csv"] = [first, *body]


# Readings of a decay.


def changed(change: Callable[[np.ndarray, np.ndarray, Random], np.ndarray], folder: Folder, rng: Random) -> None:
    """Other readings at the same times."""
    time, values = columns(folder)
    rewrite(folder, time, change(time, values, rng))


def spikes(number: int, time: np.ndarray, values: np.ndarray, rng: Random) -> np.ndarray:
    """Single samples far off, each by another amount."""
    del time
    for row in rng.choice(np.arange(40, len(values) - 40), number, replace=False):
        values[row] += rng.choice([-1.0, 1.0]) * rng.uniform(5.0, 20.0)
    return values


def zeros(time: np.ndarray, values: np.ndarray, rng: Random) -> np.ndarray:
    """Four samples of exactly 0 among the largest deflections."""
    del time
    large = np.flatnonzero(np.abs(values) > 0.6 * np.max(values))
    values[rng.choice(large[5:], 4, replace=False)] = 0.0
    return values


def hum(time: np.ndarray, values: np.ndarray, rng: Random) -> np.ndarray:
    """Mains hum of 5 % of the amplitude."""
    return values + 0.05 * np.max(values) * np.sin(2 * np.pi * 50.0 * time + rng.uniform(0.0, 6.0))


def modes(time: np.ndarray, values: np.ndarray, rng: Random) -> np.ndarray:
    """Two further modes of the structure in the record."""
    for share, frequency in zip((0.2, 0.1), rng.uniform((60.0, 130.0), (110.0, 200.0)), strict=True):
        values = values + share * np.max(values) * np.exp(-6.0 * time) * np.cos(2 * np.pi * frequency * time)
    return values


def coarse(time: np.ndarray, values: np.ndarray, rng: Random) -> np.ndarray:
    """A sensor that reads in steps of 1/9 of the amplitude: a smooth top reads 6 8 8 6, and most of the record is rest."""
    del time
    step = np.max(values) / rng.uniform(8.0, 10.0)
    return step * np.round(values / step)


def clipped(time: np.ndarray, values: np.ndarray, rng: Random) -> np.ndarray:
    """The largest deflections are cut."""
    del time
    limit = rng.uniform(0.6, 0.75) * np.max(values)
    return np.clip(values, -limit, limit)


def second_release(time: np.ndarray, values: np.ndarray, rng: Random) -> np.ndarray:
    """The rod is released a second time later in the record."""
    del time
    row = int(rng.integers(400, 450))
    again = 0.9 * values[: len(values) - row] + 1e-2 * rng.standard_normal(len(values) - row)
    return np.concatenate([values[:row], again])


def step_response(folder: Folder, rng: Random) -> None:
    """Rest at exactly 0, then a step of the force: oscillation about the new equilibrium."""
    time, values = columns(folder)
    row = int(rng.integers(80, 150))
    after = values[0] - values[: len(values) - row]
    rewrite(folder, time, np.concatenate([np.zeros(row), after]))


def rest(folder: Folder, rng: Random) -> None:
    """Held at the release position before the release."""
    time, values = columns(folder)
    row = int(rng.integers(80, 150))
    held = values[0] + 1e-2 * rng.standard_normal(row)
    rewrite(folder, time, np.concatenate([held, values[: len(values) - row]]))


def lost(folder: Folder, rng: Random) -> None:
    """A quarter of a period is lost, without a gap in the times."""
    time, values = columns(folder)
    row = int(rng.integers(60, 90))
    rewrite(folder, time[:-13], np.delete(values, slice(row, row + 13)))


def cells(text: str, folder: Folder, rng: Random) -> None:
    """Cells without a reading."""
    first, *body = folder.tables["decay.csv"]
    for row in rng.choice(np.arange(20, len(body)), 12, replace=False):
        body[row] = f"{body[row].split(',')[0]},{text}"
    folder.tables["decay.csv"] = [first, *body]


def thinned(step: int, folder: Folder, rng: Random) -> None:
    """Sampled far too slowly."""
    del rng
    time, values = columns(folder)
    rewrite(folder, time[::step], values[::step])


def cut(folder: Folder, rng: Random) -> None:
    """Recorded for less than a period and a half."""
    del rng
    first, *body = folder.tables["decay.csv"]
    folder.tables["decay.csv"] = [first, *body[:50]]


def planted(kind: str, clean: Callable[..., Folder], plant: object, ending: str, *seeds: int, cause: str = "") -> list:
    """One fault for each seed."""
    assert callable(plant)
    return [Planted(kind, seed, clean, plant, ending, tuple(cause.split("|")) if cause else ()) for seed in seeds]


FAULTS: list[Planted] = [
    # Units that are unknown, and wrong ones.
    *planted("unit symbol", decay, partial(header, "[s]", "[sec]"), "a", 1),
    *planted("unit symbol", pulls, partial(header, "force [N],", "force [Newton],"), "a", 2),
    *planted("unit symbol", decay, partial(word, '0.2, unit = "g"', '0.2, unit = "gram"'), "a", 3),
    *planted("unit symbol", decay, partial(scaled, 1, 1.0 / 25.4, "inch"), "a", 4),
    *planted("unit symbol", tilts, partial(header, "[deg]", "[degrees]"), "a", 5),
    *planted("nanoseconds", decay, partial(scaled, 0, 1e9, "ns"), "a", 6, 7),
    *planted("wrong unit", decay, partial(word, '0.2, unit = "g"', '0.2, unit = "kg"'), "a", 8),
    *planted("wrong unit", decay, partial(scaled, 0, 1e3, ""), "a", 9),
    *planted("wrong unit", decay, partial(scaled, 1, 1e3, ""), "a", 10),
    # Words of rig.toml.
    *planted("key", decay, partial(word, "m1 =", "mass1 ="), "a", 11),
    *planted("key", decay, partial(word, "sd = 0.2", "uncertainty = 0.2"), "a", 12),
    *planted("key", pulls, partial(word, "m1 =", "M1 ="), "a", 13),
    *planted("key", decay, partial(word, 'file = "', 'flie = "'), "a", 14),
    *planted("kind", decay, partial(word, "free_vibration", "free-vibration"), "a", 15),
    *planted("kind", tilts, partial(word, "static_friction", "Static Friction"), "a", 16),
    *planted("file name", decay, partial(word, "decay.csv", "Decay.csv"), "a", 17),
    *planted("file name", pulls, partial(word, "pulls.csv", "pull.csv"), "a", 18),
    # Columns.
    *planted("swapped columns", decay, swapped, "a", 19, 20, 21),
    *planted("text column", pulls, partial(text_column, True), "a", 22),
    *planted("text column", pulls, partial(text_column, False), "a", 23),
    *planted("further column", pulls, partial(more_column, "mass [kg]"), "a", 24),
    *planted("further column", tilts, partial(more_column, "temperature [1]"), "a", 25),
    *planted("further column", decay, partial(more_column, "trial [1]"), "a", 26),
    *planted("signs for direction", sliding, signed, "a", 27, 28),
    *planted("trace of a pull", pulls, pull_trace, "b", 29, 30, cause="trace|trials"),
    # Clocks.
    *planted("restarted clock", decay, restarted, "c", 31, 32, cause="clock|set back"),
    *planted("own clocks", decay, two_records, "a", 33, 34),
    *planted("rounded times", decay, partial(rounded, 0.01), "c", 35, cause="round"),
    *planted("rounded times", decay, partial(rounded, 0.0156), "c", 36, cause="round"),
    *planted("rounded times", decay, partial(rounded, 0.0025), "c", 37, cause="round"),
    *planted("repeated rows", decay, repeated_rows, "a", 38),
    *planted("held times", decay, held_times, "a", 39),
    *planted("order of rows", decay, shuffled, "a", 40),
    # Readings.
    *planted("four spikes", decay, partial(changed, partial(spikes, 4)), "a", 41, 42, 43),
    *planted("one spike", decay, partial(changed, partial(spikes, 1)), "a", 44),
    *planted("drop-outs", decay, partial(changed, zeros), "a", 45),
    *planted("hum", decay, partial(changed, hum), "a", 46, 47),
    *planted("further modes", decay, partial(changed, modes), "c", 48, 49, cause="oscillation|mode"),
    *planted("coarse steps", partial(decay, samples=2000, step=2e-3), partial(changed, coarse), "a", 50, 63),
    *planted("clipped", decay, partial(changed, clipped), "a", 52),
    *planted("second release", decay, partial(changed, second_release), "a", 53),
    *planted("rest before a step", decay, step_response, "a", 54, 55),
    *planted("rest before release", decay, rest, "a", 56),
    *planted("lost samples", decay, lost, "a", 57),
    *planted("no readings", decay, partial(cells, "NaN"), "a", 58),
    *planted("no readings", decay, partial(cells, ""), "a", 59),
    *planted("sampled slowly", decay, partial(thinned, 80), "b", 60, cause="faster|Record"),
]
#: Seeds and kinds of the clean folders.
CLEAN = [(kind, seed) for kind in (decay, pulls, tilts, sliding) for seed in range(101, 106)]


def folder_of(fault: Planted) -> Folder:
    """The folder with the fault."""
    rng = np.random.default_rng(fault.seed)
    folder = fault.clean(rng)
    fault.plant(folder, rng)
    return folder
