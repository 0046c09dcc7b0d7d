"""Every fault of a table gives its full place and rule in one line. The mark ‸ is the expected place."""

from pathlib import Path

import pytest

from tests.rig.faults import MARK, assert_fault, fault_of, place_of
from tests.rig.folder import TABLES, write_folder

RECORD = TABLES["free_vibration_1.csv"]
# (table, its content with the mark, part of the rule)
TABLE_FAULTS = [
    ("static_friction.csv", MARK, "a table must not be empty"),
    ("static_friction.csv", MARK + "\n  \n", "a table must not be empty"),
    ("static_friction.csv", "‸angle [deg]\n", "a table must have rows, a header only"),
    ("static_friction.csv", "‸33\n34\n", "the first line must be headers"),
    ("static_friction.csv", "‸angle\n34\n", "the first line must be headers `name [unit]`, 'angle'"),
    ("static_friction.csv", "‸angle []\n34\n", "the first line must be headers"),
    ("static_friction.csv", "‸# tilts\nangle [deg]\n34\n", "the first line must be headers"),
    ("static_friction.csv", "‸\nangle [deg]\n34\n", "must not be blank"),
    ("static_friction.csv", "angle [deg]\n34\n‸\n35\n", "must not be blank"),
    ("static_friction.csv", "angle [deg]\n34\n‸# moved\n35\n", "a row must be numbers"),
    ("static_friction.csv", "‸angle [mm]\n34\n", "angle: unit must have the dimension of rad"),
    ("static_friction.csv", "‸angle [degrees]\n34\n", "angle: unknown unit symbol degrees"),
    ("static_friction.csv", "angle [deg]\n34\n‸90\n", "angle must lie between 0 and 90 deg, 90 deg"),
    ("static_friction.csv", "angle [deg]\n34\n‸-1\n", "angle must lie between 0 and 90 deg"),
    ("static_friction.csv", "angle [deg]\n34\n ‸inf\n", "a cell must be a finite number, 'inf'"),
    ("static_friction.csv", "angle [deg]\n34\n‸-inf\n", "a cell must be a finite number"),
    ("static_friction.csv", "angle [deg]\n34\n‸1e999\n", "a cell must be a finite number, '1e999'"),
    ("static_friction.csv", "angle [deg]\n34\n‸33.x\n", "a cell must be a number"),
    ("static_friction.csv", "angle [deg]\n34\n3\0".replace("3\0", "3‸\0"), "a binary file (NUL byte)"),
    ("static_friction.csv", "angle [deg]\n34\n35,‸36\n", "a row must have 1 cell, as line 2 has, 2 cells"),
    ("dynamic_friction.csv", "speed [m/s],distance [mm]\n0.1‸\n", "a row must have 2 cells, as the header has, 1 cell"),
    (
        "dynamic_friction.csv",
        "speed [m/s],distance [mm]\n0.1,1,‸2\n",
        "a row must have 2 cells, as the header has, 3 cells",
    ),
    (
        "dynamic_friction.csv",
        "speed [m/s],distance [mm]\n0,1,‸2,5\n",
        "a row must have 2 cells, as the header has, 4 cells",
    ),
    ("dynamic_friction.csv", "speed [m/s],distance [mm]\n0.1,‸\n", "a cell must not be empty"),
    ("dynamic_friction.csv", "speed [m/s];distance [mm]\n0,1;12\n0,2;‸1.5\n", "a cell must be a number"),
    ("dynamic_friction.csv", "speed [m/s];distance [mm]\n0,1;1,2\n0,2;‸1.5\n", "a cell must be a number"),
    (
        "dynamic_friction.csv",
        "speed [m/s],distance [mm],‸\n0.1,1,\n",
        "the first line must be headers `name [unit]`, ''",
    ),
    ("dynamic_friction.csv", "speed [m/s],‸speed [m/s]\n0.1,1\n", "column names must be unique, a second speed"),
    (
        "dynamic_friction.csv",
        "speed [m/s],‸distanc [mm]\n0.1,1\n",
        "unknown column in dynamic_friction, 'distanc', rename it to distance",
    ),
    (
        "dynamic_friction.csv",
        "‸speed [m/s]\n0.1\n",
        "dynamic_friction must have the columns speed and distance, speed,",
    ),
    (
        "dynamic_friction.csv",
        "speed [m/s],distance [mm]\n0.1,12\n0.2, ‸-12\n",
        "distance must be greater than 0, -12 mm",
    ),
    ("dynamic_friction.csv", "speed [m/s],distance [mm]\n‸0,12\n", "speed must be greater than 0"),
    ("dynamic_friction.csv", "speed [km/s],distance [mm]\n‸1e307,12\n", "speed must be greater than 0"),
    (
        "sliding_friction.csv",
        "‸speed [m/s],coefficient [1],force [N]\n1,1,1\n",
        "sliding_friction must have the columns speed and force, or",
    ),
    ("sliding_friction.csv", "speed [m/s],‸coefficient [deg]\n1,1\n", "coefficient: unit must be 1"),
    (
        "boards/lifted.csv",
        "height [mm],length [mm]\n1,2\n‸600,60\n",
        "height must be less than the length of the board, 600 mm of 60 mm",
    ),
    ("boards/lifted.csv", "‸height [mm]\n1\n", "static_friction must have the columns angle, or height and length"),
    (
        "boards/lifted.csv",
        "‸height [mm],length [mm],angle [deg]\n1,1,1\n",
        "static_friction must have the columns angle, or",
    ),
    ("motor_current.csv", "force [N],‸current [A]\n1,2\n3,2\n", "current must not be constant, 2 A in every row"),
    ("motor_current.csv", "force [N],current [A]\n‸1,2\n", "force must vary over the rows, one row"),
    ("support_spring_L60.csv", "‸deflection [mm],force [N]\n1,2\n1,3\n", "deflection must not be constant"),
    ("free_vibration_1.csv", RECORD.replace("\n4,", "\n‸3,"), "time must increase from row to row, 3 ms"),
    ("free_vibration_1.csv", RECORD.replace("\n4,", "\n‸2,"), "time must increase from row to row"),
    (
        "free_vibration_1.csv",
        "time [ms],‸x_rel [mm]\n" + "".join(f"{i},1\n" for i in range(10)),
        "x_rel must not be constant",
    ),
    ("free_vibration_1.csv", "time [ms],x_rel [mm]\n0,1\n‸9,2\n", "a record must have at least 8 samples, 2 samples"),
    ("run_01.csv", "‸time [s]\n1\n", "forced_run must have a channel beside time"),
    ("run_01.csv", "‸x_rel [mm]\n1\n", "forced_run must have the columns time"),
    ("run_01.csv", "time [s],‸x_rod [mm]\n1,2\n", "unknown column in forced_run, 'x_rod'"),
]


@pytest.mark.parametrize(("table", "marked", "rule"), TABLE_FAULTS)
def test_fault_in_a_table(tmp_path: Path, table: str, marked: str, rule: str) -> None:
    folder = write_folder(tmp_path / "rig", tables={table: marked.replace(MARK, "")})
    assert_fault(fault_of(folder), folder / table, place_of(marked, MARK), rule)


def test_bytes_that_are_no_text(tmp_path: Path) -> None:
    folder = write_folder(tmp_path / "rig", tables={"static_friction.csv": "angle [deg]\n33\nµ".encode() + b"\xff\n"})
    assert_fault(fault_of(folder), folder / "static_friction.csv", (3, 2), "the file must be UTF-8 text, byte 0xff")
    (folder / "rig.toml").write_bytes("[rig]\n# µ".encode() + b"\xe4\n")
    assert_fault(fault_of(folder), folder / "rig.toml", (2, 4), "the file must be UTF-8 text, byte 0xe4")
