"""Every fault of rig.toml gives its full place and rule in one line. The mark ‸ is the expected place."""

import os
from pathlib import Path
from typing import Any

import pytest

from tests.rig.faults import MARK, assert_fault, fault_of, place_of
from tests.rig.folder import RIG_TOML, TABLES, write_folder

RUN = 'kind = "forced_run"\nspring = "L60"\ngap = { value = 1.0, sd = 0.02, unit = "mm" }\n'

# (part of rig.toml, its replacement with the mark, part of the rule)
TOML_FAULTS = [
    ('name = "twin"', "name = ‸7", "name must be a string"),
    ('name = "twin"', 'name = ‸"my rig"', "name must be a name of letters"),
    ('name = "twin"', 'name = ‸".."', "name must be a name of letters"),
    ('name = "twin"', 'name = ‸"../x"', "name must be a name of letters"),
    ('name = "twin"', 'name = ‸""', 'name must not be empty, "", write a word between the quotes'),
    ('[rig]\nname = "twin"', "‸[rig]", "[rig] must have a name"),
    ("# A rig with every kind of experiment.\n[rig]", "‸[rog]", "unknown key, 'rog', write rig"),
    ("synthetic = true", 'synthetic = ‸"yes"', "synthetic must be true or false"),
    ("synthetic = true", "‸colour = 1", "unknown key, 'colour', remove it"),
    (
        "synthetic = true",
        '‸friction = "constant"',
        "unknown key, 'friction', move it to [model]; known: name synthetic",
    ),
    ('kind = "static_friction"', 'kind = "static_friction"\n‸free = []', "unknown key, 'free', move it to [model]"),
    # Before: "move it to [rig]", which has a name.
    ('kind = "static_friction"', 'kind = "static_friction"\n‸name = "a"', "unknown key, 'name', write label"),
    ('m1 = { value = 110, sd = 0.5, unit = "g" }', "m1 = ‸0.11", "m1 must be a table"),
    ("g = { value = 9.81,", "g = { value = 9.81, ‸sd = 0.01,", "unknown key, 'sd', remove it"),
    ("m1 = { value = 110", "m1 = { value = ‸-110", "m1 must be greater than 0"),
    ("m1 = { value = 110", "m1 = { value = ‸0", "m1 must be greater than 0"),
    ("m1 = { value = 110", "m1 = { value = ‸true", "m1 must be a number"),
    ("m1 = { value = 110", 'm1 = { value = ‸"110"', "m1 must be a number"),
    ("m1 = { value = 110", "m1 = { value = ‸nan", "m1 must be a finite number"),
    ("m1 = { value = 110", "m1 = { value = ‸inf", "m1 must be a finite number"),
    ("m1 = { value = 110", "m1 = { value = ‸1e999", "m1 must be a finite number"),
    ("m1 = { value = 110", "m1 = { value = ‸1_1e-400", "a number must be one that float64 holds, 1_1e-400, write 0"),
    ("sd = 0.5", "sd = ‸1e-400", "a number must be one that float64 holds"),  # 0 is a standard deviation
    ("m1 = { value = 110", "m1 = { value = ‸0x" + "f" * 5000, "m1 must be a finite number"),
    ("m1 = { value = 110,", "m1 = ‸{", "m1 must have a value"),
    ("m1 = { value = 110, sd = 0.5", "m1 = { value = 110, sd = ‸-0.5", "sd of m1 must be 0 or greater"),
    ("m1 = { value = 110, sd", "m1 = { value = 110, ‸error", "unknown key, 'error'"),
    ('sd = 0.5, unit = "g"', 'sd = 0.5, unit = ‸"mm"', "unit must have the dimension of kg"),
    ('sd = 0.5, unit = "g"', 'sd = 0.5, unit = ‸"stone"', "unknown unit symbol stone"),
    ('sd = 0.5, unit = "g"', "sd = 0.5, unit = ‸1", "unit must be a string"),
    ("[prior]\nk1", "[prior]\n‸k9", "unknown key, 'k9'"),
    ('"k2[L60]" = {', '‸"k2[L61]" = {', "a prior of k2 must name a spring of an experiment, L61, write k2[L60]"),
    ('"k2[L60]" = {', "‸k2 = {", 'must name a spring of an experiment, k2, write "k2[L60]"'),
    ('"k2[L60]" = {', '‸"k2[<spring>]" = {', 'must name a spring of an experiment, k2[<spring>], write "k2[L60]"'),
    ("median = 1.5", "median = ‸0", "median of k1 must be greater than 0"),
    ("factor = 3,", "factor = ‸1,", "factor of k1 must be greater than 1"),
    ("k1 = { median = 1.5, factor = 3,", "k1 = ‸{ median = 1.5,", "k1 must have a factor"),
    ("k1 = { median", "k1 = { ‸scale", "unknown key, 'scale'"),
    ("k1 = { median = 1.5", "k1 = { ‸value = 1.5", "unknown key, 'value'"),
    ("scale = 1,", "scale = ‸0,", "scale of tilt_sd must be greater than 0"),
    ("push_scatter = { scale", "push_scatter = { ‸median", "unknown key, 'median'"),
    ("push_scatter = { scale = 0.05", 'push_scatter = { scale = 0.05, unit = ‸"deg"', "unit must be 1 (a pure number)"),
    ('kind = "free_vibration"', 'kind = ‸"free_vibrations"', "unknown kind"),
    ('file = "free_vibration_1.csv"', "file = ‸[]", "file must be a string"),
    ('file = "free_vibration_1.csv"', 'file = ‸"/etc/passwd"', "file must be a path relative to the rig folder"),
    ('file = "free_vibration_1.csv"', "file = ‸'C:\\x.csv'", "file must be a path relative to the rig folder"),
    ('file = "free_vibration_1.csv"', 'file = ‸"\\u0000.csv"', "file must be a path relative to the rig folder"),
    ('file = "free_vibration_1.csv"', 'file = ‸"../outside.csv"', "file must lie inside the rig folder"),
    ('file = "free_vibration_1.csv"', 'file = ‸"boards/../../outside.csv"', "file must lie inside the rig folder"),
    ('file = "free_vibration_1.csv"', 'file = ‸"link.csv"', "file must lie inside the rig folder, links followed"),
    ('file = "free_vibration_1.csv"', 'file = ‸"linked/outside.csv"', "file must lie inside the rig folder, links"),
    ('file = "free_vibration_1.csv"', 'file = ‸"loop.csv"', "file must "),
    ('file = "free_vibration_1.csv"', 'file = ‸"absent.csv"', "file must exist"),
    ('file = "free_vibration_1.csv"', 'file = ‸"boards"', "file must be a regular file"),
    ('file = "free_vibration_1.csv"', 'file = ‸"rig.toml"', "file must be a table of a known kind (.csv"),
    ('file = "free_vibration_1.csv"', 'file = ‸"' + "x" * 300 + '.csv"', "file must be a readable file"),
    ('capsule = "held"', 'capsule = ‸"loose"', 'capsule must be "held" or "free"'),
    ('capsule = "held"', "capsule = ‸false", "capsule must be a string"),
    ('damping = "dry"', 'damping = ‸"wet"', 'damping must be "viscous" or "dry" or "quadratic"'),
    ('damping = "dry"', 'forward = ‸"open"', 'forward must be "closed" or "capsule"'),
    ('capsule = "held"', 'forward = ‸"capsule"', "needs a capsule that is free to move, held"),
    (
        'capsule = "held"',
        'capsule = "free"\nforward = ‸"capsule"',
        "viscous damping, a linear spring and white noise only, viscous + dry",
    ),
    ('damping = "dry"', "damping = ‸[]", "damping must not be empty"),
    ('damping = "dry"', 'damping = ‸["dry", "wet"]', 'must be "viscous" or "dry" or "quadratic"'),
    ('damping = "dry"', '‸damp = "dry"', "unknown key, 'damp', write damping"),
    ('damping = "dry"', '‸spring = "L60"', "spring and gap must stand together, spring alone"),
    ('damping = "dry"', '‸gap = { value = 1, unit = "mm" }', "spring and gap must stand together, gap alone"),
    ("smoothing_window = { value = 5", "smoothing_window = { value = ‸0", "smoothing_window must be greater than 0"),
    ("stop = { value = 9", "stop = { value = 9, ‸sd = 1", "unknown key, 'sd'"),
    ("stop = { value = 9", "stop = ‸{ value = 10.2", "stop must lie inside the record, 0.0102 s"),
    ("start = { value = 0.0", "start = ‸{ value = -1", "start must lie inside the record"),
    ("stop = { value = 9", "stop = ‸{ value = 6.5", "at least 8 samples must lie between start and stop, 7 samples"),
    ("x_rel_sd = { value = 0.02", "x_rel_sd = { value = ‸0", "x_rel_sd must be greater than 0"),
    ("x_rel_sd = { value = 0.02", "x_rel_sd = { value = ‸-1", "x_rel_sd must be greater than 0"),
    (
        'resolution = { value = 1, unit = "um"',
        'resolution = { value = 1, unit = ‸"s"',
        "unit must have the dimension of m",
    ),
    ("x_rel_sd", "‸angle_sd", "unknown key, 'angle_sd'"),
    ('length_is = "board"', 'length_is = ‸"side"', 'length_is must be "board" or "base"'),
    (
        'label = "lifted"',
        'label = ‸"static_friction"',
        "labels must be unique, 'static_friction', give one of them a label",
    ),
    ('label = "lifted"', 'label = ‸"a/b"', "label must be a name"),
    (
        'file = "sliding_friction.csv"',
        'file = "sliding_friction.csv"\n‸force_sd = { value = 1, unit = "N" }',
        "force_sd needs",
    ),
    ("sd_ratio = { value = 3", "sd_ratio = { value = ‸0", "sd_ratio must be greater than 0"),
    ('value = 3, unit = "N/A"', 'value = 3, unit = ‸"N/m"', "unit must have the dimension of N/A"),
    ('spring = "L60"\nlength', 'spring = ‸"L 60"\nlength', "spring must be a name"),
    ("length = { value = 60", "length = { value = ‸-60", "length must be greater than 0"),
    ("gap = { value = 1.0, sd = 0.02", "gap = { value = 1.0, sd = ‸-0.02", "sd of gap must be 0 or greater"),
    ("Omega = { value = 34.56", "Omega = { value = ‸0", "Omega must be greater than 0"),
    ('34.56, unit = "rad/s"', '34.56, unit = ‸"Hz"', "unit must have the dimension of rad/s"),
    (
        "Omega = {",
        "f = ‸{ value = 5.5, unit = 'Hz' }\nOmega = {",
        "forced_run must have Omega (rad/s) or f (Hz), not both",
    ),
    (
        '[[experiment]]\nkind = "forced_run"\nspring = "L60"\n',
        '[[experiment]]\nkind = "forced_run"\n‸',
        "spring and gap must stand together, gap alone",
    ),
    (f"[[experiment]]\n{RUN}Omega", f"‸[[experiment]]\n{RUN}#", "forced_run must have Omega (rad/s) or f (Hz)"),
    ('damping = "dry"', 'damping = "dry"\ndamping = "dry"‸', "the file must be valid TOML"),
]
# Where the place is not in the replaced part: (part, replacement, part of rig.toml at which the place is, rule)
TOML_FAULTS_ELSEWHERE = [
    ('sd = 0.5, unit = "g" }', "sd = 0.5 }", "{ value = 110", "m1 must have a unit"),
    ('kind = "free_vibration"\n', "", "[[experiment]]", "an experiment must have a kind"),
    ('file = "free_vibration_1.csv"\n', "", "[[experiment]]", "an experiment must have a file"),
    (
        'length_is = "board"\n',
        "",
        '[[experiment]]\nkind = "static_friction"\nfile = "boards',
        "length_is must say which side",
    ),
    (
        'file = "static_friction.csv"',
        'length_is = "base"\nfile = "static_friction.csv"',
        '"base"',
        "length_is needs the columns",
    ),
    (
        "start = { value = 0.0",
        "start = { value = 0.009",
        "{ value = 9,",
        "start must be before stop, 0.009 s and 0.009 s",
    ),
    ('m1 = { value = 110, sd = 0.5, unit = "g" }\n', "", '"free_vibration"', "free_vibration needs m1"),
    ('m2 = { value = 0.530, sd = 0.001, unit = "kg" }\n', "", '"forced_run"', "forced_run needs m2"),
    (
        'P_d = { value = 4.0, sd = 0.1, unit = "N" }\n',
        "",
        '[[experiment]]\nkind = "forced_run"',
        "must have P_d where current",
    ),
    ('spring = "L60"\nlength', "length", '[[experiment]]\nkind = "support', "support_spring must have a spring"),
    (
        "sd_ratio =",
        "force_sd = { value = 1, unit = 'N' }\ncurrent_sd = { value = 1, unit = 'A' }\nsd_ratio =",
        "sd_ratio",
        "state sd_ratio or both of force_sd and current_sd",
    ),
]


@pytest.fixture
def parent(tmp_path: Path) -> Path:
    """A folder with links inside and beside the rig that lead outside."""
    rig = tmp_path / "rig"
    rig.mkdir()
    (tmp_path / "outside.csv").write_text(TABLES["free_vibration_1.csv"])
    (rig / "link.csv").symlink_to(tmp_path / "outside.csv")
    (rig / "linked").symlink_to(tmp_path)
    (rig / "loop.csv").symlink_to(rig / "loop.csv")
    return tmp_path


@pytest.mark.parametrize(("part", "replacement", "rule"), TOML_FAULTS)
def test_fault_in_rig_toml(parent: Path, part: str, replacement: str, rule: str) -> None:
    assert part in RIG_TOML
    marked = RIG_TOML.replace(part, replacement, 1)
    folder = write_folder(parent / "rig", marked.replace(MARK, ""))
    assert_fault(fault_of(folder), folder / "rig.toml", place_of(marked, MARK), rule)


@pytest.mark.parametrize(("part", "replacement", "at", "rule"), TOML_FAULTS_ELSEWHERE)
def test_fault_seen_elsewhere_in_rig_toml(tmp_path: Path, part: str, replacement: str, at: str, rule: str) -> None:
    assert part in RIG_TOML
    text = RIG_TOML.replace(part, replacement, 1)
    folder = write_folder(tmp_path / "rig", text)
    assert_fault(fault_of(folder), folder / "rig.toml", place_of(text, at), rule)


def test_rig_toml_itself(tmp_path: Path) -> None:
    missing = fault_of(tmp_path / "nowhere")
    assert (missing.file, missing.rule) == (str(tmp_path / "nowhere"), "the rig must be a folder")
    folder = tmp_path / "rig"
    folder.mkdir()
    assert_fault(fault_of(folder), folder / "rig.toml", (1, 1), "a rig folder must contain a file rig.toml")
    (tmp_path / "rig.toml").write_text(RIG_TOML)
    (folder / "rig.toml").symlink_to(tmp_path / "rig.toml")
    assert_fault(fault_of(folder), folder / "rig.toml", (1, 1), "rig.toml must lie inside the folder, links followed")
    (folder / "rig.toml").unlink()
    (folder / "rig.toml").mkdir()
    assert_fault(fault_of(folder), folder / "rig.toml", (1, 1), "a rig folder must contain a file rig.toml")
    (folder / "rig.toml").rmdir()
    for text, rule in (
        ("", "must have a table [rig]"),
        ('rig = { name = "a" }', "at least one [[experiment]]"),
        ("rig = 3", "rig must be a table"),
        ('rig = { name = "a" }\nexperiment = 3', "at least one [[experiment]]"),
        ('rig = { name = "a" }\nexperiment = [3]', "0 must be a table"),
    ):
        (folder / "rig.toml").write_text(text)
        assert rule in str(fault_of(folder))


def test_a_pipe_is_no_table(tmp_path: Path) -> None:
    folder = write_folder(tmp_path / "rig")
    (folder / "static_friction.csv").unlink()
    os.mkfifo(folder / "static_friction.csv")  # opening it would wait for a writer for ever
    place = place_of(RIG_TOML, '"static_friction.csv"')
    assert_fault(fault_of(folder), folder / "rig.toml", place, "file must be a regular file")


@pytest.mark.parametrize(("name", "at"), [("rig.toml", None), ("static_friction.csv", '"static_friction.csv"')])
def test_a_file_without_permission(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, at: str | None) -> None:
    folder = write_folder(tmp_path / "rig")
    opened = Path.open

    def refuse(path: Path, *words: Any, **options: Any) -> Any:
        """Refuse like the system for a file of another user; root may read every file."""
        if path.name == name:
            raise PermissionError(13, "Permission denied")
        return opened(path, *words, **options)

    monkeypatch.setattr(Path, "open", refuse)
    place = place_of(RIG_TOML, at) if at else (1, 1)
    assert_fault(fault_of(folder), folder / "rig.toml", place, "must be readable")
