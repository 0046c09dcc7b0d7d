"""Thirty exports as loggers, spreadsheets and students write them, each with its true kind, columns and units.

The generator is older than the assistant that it judges. Spoils: separators, decimal marks, title lines, rows of units,
comments, other columns, other words and languages, missing cells, units in headers, no times, no headers, other formats.
"""

import gzip
import io
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
import xlsxwriter
from scipy.io import savemat

from tests.rig.formats.writers import lvm, npz, tdms


@dataclass(frozen=True)
class Spoiled:
    """One export.

    Attributes
    ----------
    file, content : name and bytes of the file
    kind : true kind of the experiment
    columns : true readings, SI, by column of the kind, (n,) each
    """

    file: str
    content: bytes
    kind: str
    columns: Mapping[str, np.ndarray]


RNG = np.random.default_rng(30)
N = 1200
TIME = np.arange(N) * 1e-3
#: Free decay of 3.6 mm at 18 Hz, m; step 1 um.
DECAY = np.round(3.6e-3 * np.exp(-4.0 * TIME) * np.cos(2 * np.pi * 18.0 * TIME) + 5e-6 * RNG.standard_normal(N), 6)
#: Forced motion at 5.5 Hz with a harmonic, m, capsule position, m, current, A, and acceleration, m/s^2.
FORCED = np.round(1.5e-3 * np.cos(34.56 * TIME) + 2e-4 * np.cos(3 * 34.56 * TIME) + 5e-6 * RNG.standard_normal(N), 6)
CAPSULE = np.round(2e-3 * TIME + 1e-4 * np.sin(34.56 * TIME), 6)
CURRENT = np.round(1.8 * np.cos(34.56 * TIME + 0.3), 4)
ACCELERATION = np.round(-1.8 * np.cos(34.56 * TIME) + 0.02 * RNG.standard_normal(N), 3)
TILTS = np.array([33.1, 33.6, 33.2, 32.9, 33.8])
SPEED = np.array([0.10, 0.15, 0.22, 0.31, 0.40, 0.52])
SLIDE = np.array([0.8, 1.9, 4.1, 8.3, 14.0, 23.6]) * 1e-3
FRICTION = np.array([3.5, 3.3, 3.1, 2.9, 2.8, 2.7])
AMPERES = np.array([0.25, 0.5, 0.75, 1.0, 1.25, 1.5, 1.75, 2.0])
NEWTONS = np.array([0.51, 1.0, 1.49, 2.02, 2.51, 2.98, 3.52, 4.01])
DEFLECTION = np.arange(0, 11) * 1e-4
SPRING = np.round(18960.0 * DEFLECTION + 0.02 * RNG.standard_normal(11), 2)


def rows(columns: list[np.ndarray], separator: str = ",", decimal: str = ".") -> str:
    return "".join(
        separator.join(f"{value:.10g}".replace(".", decimal) for value in row) + "\n"
        for row in zip(*columns, strict=True)
    )


def workbook(titles: list[list[str]], columns: list[np.ndarray]) -> bytes:
    content = io.BytesIO()
    with xlsxwriter.Workbook(content) as book:
        sheet = book.add_worksheet()
        for k, title in enumerate(titles):
            sheet.write_row(k, 0, title)
        for k, values in enumerate(columns):
            sheet.write_column(len(titles), k, values.tolist())
    return content.getvalue()


def mat(columns: Mapping[str, np.ndarray]) -> bytes:
    content = io.BytesIO()
    savemat(content, dict(columns))
    return content.getvalue()


def missing(text: str, first: int, cell: int, marker: str, separator: str) -> str:
    """The text with ``marker`` in one cell of every 97th line."""
    lines = text.split("\n")
    for k in range(first, len(lines) - 1, 97):
        cells = lines[k].split(separator)
        cells[cell] = marker
        lines[k] = separator.join(cells)
    return "\n".join(lines)


def _decays() -> list[Spoiled]:
    ms, mm = 1e3 * TIME, 1e3 * DECAY
    temperature = 21.0 + 0.01 * np.sin(TIME)
    both = {"time": TIME, "x_rel": DECAY}
    kept = {name: np.delete(values, np.arange(40, N, 97)) for name, values in both.items()}

    def decay(file: str, text: str | bytes, columns: Mapping[str, np.ndarray] = both) -> Spoiled:
        return Spoiled(file, text.encode() if isinstance(text, str) else text, "free_vibration", columns)

    gap = missing("Time [s];Displacement [mm]\n" + rows([TIME, mm], ";"), 41, 1, "--", ";")
    return [
        decay("decay_plain.csv", "Time (s),Disp (mm)\n" + rows([TIME, mm])),
        decay("decay_german.csv", "\ufeffZeit [s];Weg [mm]\n" + rows([TIME, mm], ";", ",")),
        decay("decay_units_row.txt", "t\tx\nms\tmm\n" + rows([ms, mm], "\t")),
        decay(
            "decay_titles.txt",
            "Lab 3\nDate: 2024-03-01\nSampling rate: 1000 Hz\n\nt / s, x / um\n" + rows([TIME, 1e6 * DECAY]),
        ),
        decay(
            "decay_more.csv",
            "No,Time (s),Temperature (C),Laser displacement (mm)\n"
            + rows([np.arange(1.0, N + 1), TIME, temperature, mm]),
        ),
        decay("decay_missing.csv", gap, kept),
        decay("decay_rate.txt", "fs = 1000 Hz\nposition (mm)\n" + rows([mm])),
        decay("decay_comment.dat", "# logger 7\n# time_ms disp_mm\n" + rows([ms, mm], "  ")),
        decay(
            "decay_quoted.csv",
            '"Elapsed time [s]";"Relative displacement [mm]";\n' + rows([TIME, mm], ";").replace("\n", ";\n"),
        ),
        decay(
            "decay_clock.csv",
            "timestamp_us,x_um\n" + rows([1e6 * TIME + 4e6, 1e6 * DECAY]),
            {"time": TIME + 4.0, "x_rel": DECAY},
        ),
        decay("decay.csv.gz", gzip.compress(("Time (sec), Deflection (mm)\n" + rows([TIME, mm], ", ")).encode())),
        decay("decay.lvm", lvm({"t": TIME, "Displacement (mm)": mm}, "One", 1, ",")),
        decay("decay.tdms", tdms({"t": TIME, "Laser": mm})),
        decay("decay.mat", mat({"t_s": TIME, "x_mm": mm, "fs": np.array([1000.0])})),
        decay("decay_no_units.csv", "time,displacement\n" + rows([TIME, mm])),
        decay("decay_no_header.txt", rows([TIME, mm], "\t")),
    ]


def _runs() -> list[Spoiled]:
    mm = 1e3 * FORCED
    four = {"time": TIME, "x_rel": FORCED, "x_capsule": CAPSULE, "current": CURRENT}
    three = {"time": TIME, "x_rel": FORCED, "acceleration_rod": ACCELERATION, "current": CURRENT}
    return [
        Spoiled(
            "run_all.csv",
            (
                "Time (s);Relative displacement (mm);Capsule position (mm);Coil current (mA)\n"
                + rows([TIME, mm, 1e3 * CAPSULE, 1e3 * CURRENT], ";", ",")
            ).encode(),
            "forced_run",
            four,
        ),
        Spoiled(
            "run_npz.npz",
            npz({"time_s": TIME, "x_rel_mm": mm, "acceleration_g_n": ACCELERATION / 9.80665, "current_A": CURRENT}),
            "forced_run",
            three,
        ),
        Spoiled(
            "run_accelerometer.txt",
            (
                "Zeit\tWeg\tBeschleunigung\tStrom\ns\tmm\tm/s²\tA\n"
                + rows([TIME, mm, ACCELERATION, CURRENT], "\t", ",")
            ).encode(),
            "forced_run",
            three,
        ),
        Spoiled(
            "run_two.xlsx",
            workbook([["Run 2"], [], ["Time [s]", "x_rel [mm]", "I [A]"]], [TIME, mm, CURRENT]),
            "forced_run",
            {"time": TIME, "x_rel": FORCED, "current": CURRENT},
        ),
    ]


def table(file: str, text: str | bytes, kind: str, **columns: np.ndarray) -> Spoiled:
    return Spoiled(file, text.encode() if isinstance(text, str) else text, kind, columns)


def _friction() -> list[Spoiled]:
    radians = np.deg2rad(TILTS)
    return [
        table(
            "tilt.csv",
            "Trial;Winkel (°)\n" + rows([np.arange(1.0, 6.0), TILTS], ";", ","),
            "static_friction",
            angle=radians,
        ),
        table(
            "tilt_board.txt",
            "height_mm length_mm\n" + rows([600 * np.sin(radians), np.full(5, 600.0)], " "),
            "static_friction",
            height=0.6 * np.sin(radians),
            length=np.full(5, 0.6),
        ),
        table(
            "push.csv",
            "v (m/s),travel (mm)\n" + rows([SPEED, 1e3 * SLIDE]),
            "dynamic_friction",
            speed=SPEED,
            distance=SLIDE,
        ),
        table(
            "slide.csv",
            "Velocity [mm/s]\tFriction force [N]\n" + rows([1e3 * SPEED, FRICTION], "\t"),
            "sliding_friction",
            speed=SPEED,
            force=FRICTION,
        ),
    ]


def _lines() -> list[Spoiled]:
    grams = NEWTONS / 9.80665e-3
    return [
        table(
            "motor.xlsx",
            workbook([["Motor", "calibration"], ["I", "F"], ["A", "N"]], [AMPERES, NEWTONS]),
            "motor_current",
            current=AMPERES,
            force=NEWTONS,
        ),
        table(
            "motor_german.csv",
            "Strom in mA;Kraft in N;Bemerkung\n" + rows([1e3 * AMPERES, NEWTONS], ";", ",").replace("\n", ";ok\n"),
            "motor_current",
            current=AMPERES,
            force=NEWTONS,
        ),
        table(
            "motor_weights.txt",
            "% weights on a pan\nload (gf)   current (A)\n" + rows([grams, AMPERES], "   "),
            "motor_current",
            current=AMPERES,
            force=NEWTONS,
        ),
        table(
            "spring.csv",
            "x (mm),F (N)\n" + rows([1e3 * DEFLECTION, SPRING]),
            "support_spring",
            deflection=DEFLECTION,
            force=SPRING,
        ),
        table(
            "spring_titles.csv",
            "Spring 60 mm\nInstron;2024\n\nVerformung [mm];Kraft [N]\n" + rows([1e3 * DEFLECTION, SPRING], ";", ","),
            "support_spring",
            deflection=DEFLECTION,
            force=SPRING,
        ),
        table(
            "spring_bare.txt",
            rows([DEFLECTION * 1e3, SPRING], " "),
            "support_spring",
            deflection=DEFLECTION,
            force=SPRING,
        ),
    ]


GROUPS: tuple[Callable[[], list[Spoiled]], ...] = (_decays, _runs, _friction, _lines)


def spoiled_exports() -> list[Spoiled]:
    """All thirty exports, the same in every call."""
    return [export for group in GROUPS for export in group()]
