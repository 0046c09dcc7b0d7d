"""Reading a valid rig folder."""

import dataclasses
import hashlib
import math
import shutil
from pathlib import Path

import numpy as np
import pytest

from capsule_id.api import read_rig
from capsule_id.errors import InputError
from capsule_id.experiments.free_vibration.readings import decay_window
from capsule_id.experiments.kind import default_registry
from capsule_id.parameters import Prior
from capsule_id.rig.model import Quantity, Table
from tests.cli_tools import DATA, small_rig
from tests.rig.folder import RIG_TOML, TABLES, write_folder

DEGREE = math.pi / 180.0


def stated(table: Table) -> dict[str, object]:
    """The settings that are not absent."""
    settings = ((field.name, getattr(table.settings, field.name)) for field in dataclasses.fields(table.settings))
    return {name: value for name, value in settings if value is not None}


def test_everything_is_si(tmp_path: Path) -> None:
    rig = read_rig(write_folder(tmp_path / "rig"))
    assert (rig.name, rig.synthetic, rig.folder) == ("twin", True, tmp_path / "rig")
    assert (rig.m1, rig.m2, rig.g) == (Quantity(0.110, 0.0005), Quantity(0.530, 0.001), Quantity(9.81, 0.0))
    assert dict(rig.priors) == {
        "k1": Prior("lognormal", 1500.0, 3.0),
        "k2[L60]": Prior("lognormal", 20000.0, 10.0),
        "tilt_sd": Prior("halfnormal", 0.0, DEGREE),
        "push_scatter": Prior("halfnormal", 0.0, 0.05),
    }
    assert [table.kind for table in rig.tables] == [
        "free_vibration",
        "static_friction",
        "static_friction",
        "dynamic_friction",
        "sliding_friction",
        "motor_current",
        "support_spring",
        "forced_run",
        "transducer",
        "progression",
    ]
    assert {table.kind for table in rig.tables} == set(default_registry())
    decay, tilts, boards, pushes, _, motor, spring, run, *_ = rig.tables
    np.testing.assert_array_equal(decay["time"], np.arange(10) / 1000)
    np.testing.assert_array_equal(decay["x_rel"][:3], [0.002, 0.0015, 0.0005])
    assert decay.columns["x_rel"].reading_sd == pytest.approx(math.hypot(2e-5, 1e-6 / math.sqrt(12.0)), rel=1e-15)
    assert stated(decay) == {
        "start": 0.0,
        "stop": 0.009,
        "capsule": "held",
        "damping": ("dry",),
        "samples": "record",
        "smoothing_window": 0.005,
        "forward": "closed",
    }
    np.testing.assert_allclose(tilts["angle"], np.array([33.1, 33.6, 33.2]) * DEGREE, rtol=1e-15)
    assert tilts.columns["angle"].to_display * tilts["angle"][0] == pytest.approx(33.1, rel=1e-15)
    assert (boards.label, boards.file, boards.settings.length_is) == ("lifted", "boards/lifted.csv", "board")
    np.testing.assert_array_equal(boards["height"], [0.3315, 0.329])
    np.testing.assert_array_equal(pushes["distance"], [0.0019, 0.025])
    assert (pushes.columns["speed"].sd, pushes.columns["distance"].sd) == (0.005, None)
    assert motor.settings.sd_ratio == 3.0
    assert stated(spring) == {"spring": "L60", "length": Quantity(0.06, 0.0005)}
    assert stated(run) == {
        "drive": "harmonic",
        "spring": "L60",
        "gap": Quantity(0.001, 0.02 / 1000),
        "Omega": 34.56,
        "P_d": Quantity(4.0, 0.1),
        "start": "auto",
    }
    np.testing.assert_array_equal(run.rows, np.arange(2, 11))


def test_files_are_hashed(tmp_path: Path) -> None:
    rig = read_rig(write_folder(tmp_path / "rig"))
    contents = {"rig.toml": RIG_TOML, **TABLES}
    assert dict(rig.files) == {name: hashlib.sha256(text.encode()).hexdigest() for name, text in contents.items()}


def test_nothing_can_be_changed(tmp_path: Path) -> None:
    rig = read_rig(write_folder(tmp_path / "rig"))
    table = rig.tables[0]
    for array in (*(column.values for column in table.columns.values()), table.rows):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 1
    for mapping in (rig.files, rig.priors, table.columns):
        with pytest.raises(TypeError):
            mapping["new"] = 1  # type: ignore[index]
    with pytest.raises(dataclasses.FrozenInstanceError):
        table.settings.damping = "viscous"  # type: ignore[misc]


def minimal(tmp_path: Path, head: str, entry: str, table: str) -> Path:
    return write_folder(
        tmp_path / "rig", f'[rig]\nname = "a"\n{head}\n[[experiment]]\nfile = "t.csv"\n{entry}', {"t.csv": table}
    )


def record(step: float, samples: int) -> str:
    return "time [s],x_rel [mm]\n" + "".join(f"{i * step!r},{(-1) ** i}\n" for i in range(samples))


def test_a_window_may_reach_one_sample_beyond_the_record(tmp_path: Path) -> None:
    m1 = 'm1 = { value = 0.11, unit = "kg" }'
    entry = 'kind = "free_vibration"\nstop = { value = STOP, unit = "s" }'
    table = minimal(tmp_path, m1, entry.replace("STOP", "0.5"), record(0.0005, 1000))
    assert len(decay_window(read_rig(table).tables[0])[0]) == 1000  # 0.5 s at 2 kHz end at 0.4995 s
    beyond = minimal(tmp_path, m1, entry.replace("STOP", "0.5006"), record(0.0005, 1000))
    with pytest.raises(InputError, match="stop must lie inside the record"):
        read_rig(beyond)


def test_decay_window_includes_both_ends(tmp_path: Path) -> None:
    entry = 'kind = "free_vibration"\nstart = { value = 3, unit = "ms" }\nstop = { value = 12, unit = "ms" }'
    folder = minimal(tmp_path, 'm1 = { value = 0.11, unit = "kg" }', entry, record(0.001, 20))
    time, x_rel = decay_window(read_rig(folder).tables[0])
    np.testing.assert_array_equal(time, np.arange(3, 13) * 0.001)
    np.testing.assert_array_equal(x_rel, [(-1) ** i / 1000 for i in range(3, 13)])


@pytest.mark.parametrize(
    ("entry", "table", "needed"),
    [
        ('kind = "free_vibration"', record(0.1, 8), "m1"),
        ('kind = "free_vibration"\ncapsule = "free"', record(0.1, 8), "m1 m2"),
        ('kind = "sliding_friction"', "speed [m/s],force [N]\n1,2\n", "m1 m2"),
        ('kind = "sliding_friction"', "speed [m/s],coefficient [1]\n1,2\n", ""),
        ('kind = "static_friction"', "angle [deg]\n30\n", ""),
        (
            'kind = "forced_run"\nspring = "a"\ngap = { value = 0, unit = "m" }\nf = { value = 5, unit = "Hz" }',
            "time [s],current [A]\n" + "".join(f"{i},{i}\n" for i in range(8)),
            "m1 m2",
        ),
    ],
)
def test_masses_that_an_experiment_needs(tmp_path: Path, entry: str, table: str, needed: str) -> None:
    masses = {name: f'{name} = {{ value = 1, unit = "kg" }}\n' for name in ("m1", "m2")}
    assert read_rig(minimal(tmp_path, "".join(masses[name] for name in needed.split()), entry, table)).tables
    for missing in needed.split():
        stated = "".join(text for name, text in masses.items() if name != missing)
        with pytest.raises(InputError, match=f"needs {missing}, no {missing} in"):
            read_rig(minimal(tmp_path, stated, entry, table))


def test_the_base_of_a_triangle_may_be_shorter_than_its_height(tmp_path: Path) -> None:
    table = "height [mm],length [mm]\n600,400\n"
    rig = read_rig(minimal(tmp_path, "", 'kind = "static_friction"\nlength_is = "base"', table))
    assert rig.tables[0]["height"][0] > rig.tables[0]["length"][0]
    with pytest.raises(InputError, match="height must be less than the length of the board"):
        read_rig(minimal(tmp_path, "", 'kind = "static_friction"\nlength_is = "board"', table))


def test_a_link_inside_the_folder_and_an_upper_case_suffix_are_fine(tmp_path: Path) -> None:
    folder = write_folder(tmp_path / "rig", RIG_TOML.replace('"static_friction.csv"', '"boards/../link.CSV"'))
    (folder / "link.CSV").symlink_to("static_friction.csv")
    assert read_rig(folder).tables[1].label == "link"


def test_files_of_one_name_in_several_folders_have_labels_of_their_own(tmp_path: Path) -> None:
    (tmp_path / "rig.toml").write_text('[rig]\nname = "r"\n', encoding="utf-8")
    names = ["monday/tilt.csv", "tuesday/late/tilt.csv", "slow.csv"]
    with (tmp_path / "rig.toml").open("a", encoding="utf-8") as file:
        for number, name in enumerate(names):
            (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
            (tmp_path / name).write_text(f"angle [deg]\n{30 + number}\n31\n", encoding="utf-8")
            file.write(f'[[experiment]]\nkind = "static_friction"\nfile = "{name}"\n')
    rig = read_rig(tmp_path)
    assert [table.label for table in rig.tables] == ["monday_tilt", "tuesday_late_tilt", "slow"]
    text = (tmp_path / "rig.toml").read_text(encoding="utf-8")
    stated = text.replace('monday/tilt.csv"', 'monday/tilt.csv"\nlabel = "first"')
    (tmp_path / "rig.toml").write_text(stated, encoding="utf-8")
    assert [table.label for table in read_rig(tmp_path).tables] == ["first", "tilt", "slow"]
    (tmp_path / "rig.toml").write_text(text + '[[experiment]]\nkind = "static_friction"\nfiles = 5\n', encoding="utf-8")
    with pytest.raises(InputError, match="files must be a list of files"):
        read_rig(tmp_path)


def test_a_label_has_no_dots_of_a_path(tmp_path: Path) -> None:
    """``a/../b/tilt.csv`` had the label ``a_.._b_tilt``."""
    (tmp_path / "rig.toml").write_text('[rig]\nname = "r"\n', encoding="utf-8")
    with (tmp_path / "rig.toml").open("a", encoding="utf-8") as file:
        for number, name in enumerate(["a/tilt.csv", "a/../b/tilt.csv", "./slow.csv"]):
            (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
            (tmp_path / name).write_text(f"angle [deg]\n{30 + number}\n31\n", encoding="utf-8")
            file.write(f'[[experiment]]\nkind = "static_friction"\nfile = "{name}"\n')
    assert [table.label for table in read_rig(tmp_path).tables] == ["a_tilt", "b_tilt", "slow"]


def test_the_same_file_may_be_used_under_two_labels(tmp_path: Path) -> None:
    twice = '\n[[experiment]]\nkind = "static_friction"\nfile = "static_friction.csv"\n'
    with pytest.raises(InputError, match="labels must be unique"):
        read_rig(write_folder(tmp_path / "rig", RIG_TOML + twice))
    rig = read_rig(write_folder(tmp_path / "rig", RIG_TOML + twice + 'label = "again"\n'))
    assert [table.label for table in rig.tables if table.file == "static_friction.csv"] == ["static_friction", "again"]


def test_a_rig_without_an_experiment(tmp_path: Path) -> None:
    rig = read_rig(DATA)
    rest = rig.without("run_2")
    assert [table.label for table in rest.tables] == [one.label for one in rig.tables if one.label != "run_2"]
    assert set(rig.files) - set(rest.files) == {next(one.file for one in rig.tables if one.label == "run_2")}
    assert dataclasses.replace(rest, tables=rig.tables, files=rig.files) == rig
    alone = read_rig(small_rig(tmp_path / "rig"))
    with pytest.raises(InputError, match="a rig must keep an experiment, static_friction is its only one"):
        alone.without("static_friction")


def test_a_record_is_cut_between_two_times(tmp_path: Path) -> None:
    """A free decay as by ``start`` and ``stop`` in ``rig.toml``, a run by its rows."""
    rig = read_rig(DATA)
    folder = shutil.copytree(DATA, tmp_path / "rig")
    text = (folder / "rig.toml").read_text(encoding="utf-8")
    lines = 'file = "free_vibration_1.csv"\nstart = { value = 0.05, unit = "s" }\nstop = { value = 0.2, unit = "s" }'
    (folder / "rig.toml").write_text(text.replace('file = "free_vibration_1.csv"', lines), encoding="utf-8")
    written = read_rig(folder).tables[0]
    cut = rig.cut("free_vibration_1", 0.05).cut("free_vibration_1", stop=0.2)
    assert cut.tables[0].settings == written.settings
    np.testing.assert_array_equal(decay_window(cut.tables[0])[0], decay_window(written)[0])
    assert cut.tables[1:] == rig.tables[1:]
    whole = next(one for one in rig.tables if one.label == "run_1")
    middle = 0.5 * (whole["time"][0] + whole["time"][-1])
    run = next(one for one in rig.cut("run_1", stop=middle).tables if one.label == "run_1")
    count = int(np.sum(whole["time"] <= middle))
    for name in whole.columns:
        np.testing.assert_array_equal(run[name], whole[name][:count])
        assert not run[name].flags.writeable
    np.testing.assert_array_equal(run.rows, whole.rows[:count])


def test_a_stated_first_state_does_not_outlive_the_first_sample() -> None:
    rig = read_rig(DATA)
    label, (place, run) = "run_1", next((i, one) for i, one in enumerate(rig.tables) if one.label == "run_1")
    for word, kept in (("stuck", "auto"), ("moving", "auto"), ("settled", "settled")):
        settings = dataclasses.replace(run.settings, start=word)
        tables = [*rig.tables[:place], dataclasses.replace(run, settings=settings), *rig.tables[place + 1 :]]
        stated = dataclasses.replace(rig, tables=tuple(tables))
        first, last = run["time"][5], run["time"][-5]
        assert stated.cut(label, start=first).tables[place].settings.start == kept
        assert stated.cut(label, stop=last).tables[place].settings.start == word


def test_what_cannot_be_cut_says_what_can() -> None:
    rig = read_rig(DATA)
    labels = ", ".join(table.label for table in rig.tables)
    for change in (rig.without, rig.cut):
        with pytest.raises(InputError) as error:
            change("run_9")
        assert str(error.value).endswith(f"'run_9', choose from {labels}")
    with pytest.raises(InputError, match="motor_current has no column time, choose from free_vibration_1, "):
        rig.cut("motor_current", stop=1.0)
    with pytest.raises(InputError, match=r"at least 8 samples must lie .* 0 samples of run_1, choose times between 0"):
        rig.cut("run_1", start=1e3)
    with pytest.raises(InputError, match="0 samples of free_vibration_1"):
        rig.cut("free_vibration_1", stop=0.1).cut("free_vibration_1", start=0.2)
