"""``capsule-id init`` and ``capsule-id check``."""

import argparse
import json
import math
import re
import tomllib
from pathlib import Path
from typing import Any

import pytest

from capsule_id.api import read_rig
from capsule_id.cli import capsule_id
from capsule_id.commands import add_options, check, init
from capsule_id.errors import FolderError, InputError
from capsule_id.experiments.kind import Registry, default_registry
from capsule_id.rig.schema import INSTRUMENT_KEYS, TABLE_KEYS, ChoiceRule
from tests.cli_tools import DATA, ROOT
from tests.experiments.test_registry import hop
from tests.rig.folder import RIG_TOML, TABLES, write_folder

KINDS = default_registry()


def call(command: object, *words: str) -> int:
    """Run a command as the command line does."""
    parser = argparse.ArgumentParser()
    add_options(parser, command.OPTIONS)  # type: ignore[attr-defined]
    return command.run(parser.parse_args(words))  # type: ignore[attr-defined]


def uncommented(text: str) -> str:
    """The template with all entries in use: every `# ` removed except in comments."""
    return re.sub(r"(?m)^# ", "", text)


FILES = {
    "free_vibration_1.csv": "time [s],x_rel [mm]\n" + "".join(f"{i / 100},{2 * (-0.8) ** i}\n" for i in range(51)),
    "support_spring_L60.csv": TABLES["support_spring_L60.csv"],
    "run_01.csv": TABLES["run_01.csv"],
    "progression.csv": "period [ms],duty [%],periods [1],distance [cm]\n60,30,100,4.5\n80,30,50,-2.1\n",
    # Five levels of 15 s each, read at 2 Hz.
    "load_cell.csv": "".join(f"{k / 2} {224 * (0, 10, 20, 10, 0)[k // 30] + k % 3}\n" for k in range(150)),
    **{f"{kind}.csv": TABLES[f"{kind}.csv"] for kind in ("static_friction", "dynamic_friction", "motor_current")},
    "sliding_friction.csv": TABLES["sliding_friction.csv"],
}


def refusals(text: str, schema: object = None) -> list[str]:
    """What a JSON schema, by default that of all kinds here, refuses in a ``rig.toml``."""
    jsonschema = pytest.importorskip("jsonschema")
    validator = jsonschema.Draft7Validator(schema or json.loads(json.dumps(init.rig_schema(KINDS))))
    validator.check_schema(validator.schema)
    return [error.message for error in validator.iter_errors(tomllib.loads(text))]


def test_the_schema_accepts_every_rig() -> None:
    """Those of the repository, and of the corpus where it is at hand."""
    corpus = (ROOT.parent / "shared" / "corpus").glob("*/rig.toml")
    places = [DATA / "rig.toml", *(ROOT / "tests").rglob("rig.toml"), *corpus]
    texts = {str(place): place.read_text(encoding="utf-8") for place in places} | {"every key": RIG_TOML}
    assert {place: found for place, text in texts.items() if (found := refusals(text))} == {}


@pytest.mark.parametrize(
    ("part", "wrong"),
    [
        ('name = "twin"', 'nam = "twin"'),
        ('name = "twin"', 'name = "a b"'),
        ("synthetic = true", 'synthetic = "yes"'),
        ("m1 = { value = ", "m1 = { valeu = "),
        ("m1 = { value = 1", "m1 = { value = -1"),
        ('unit = "kg"', "unit = 1"),
        ("m2 = { value", "m3 = { value"),
        ("k1 = { median = 1.5", "k1 = { scale = 1.5"),
        ("k1 = { median = 1.5", 'k1 = { median = "1.5"'),
        ('"k2[L60]"', '"k2"'),
        ("[rig]", "[rigs]"),
        ("[[experiment]]", "[[experiments]]"),
        ('kind = "static_friction"', 'kind = "tilt"'),
        ('length_is = "board"', 'length_is = "plank"'),
        ('kind = "motor_current"', 'kind = "motor_current"\nlabel = "a b"'),
        ('kind = "motor_current"', 'kind = "motor_current"\nspring = "L60"'),
        ('kind = "motor_current"', 'kind = "motor_current"\ncolums = {}'),
        ('kind = "motor_current"', 'kind = "motor_current"\ncolumns = { angle = { from = 1, unit = "deg" } }'),
        ('kind = "motor_current"', 'kind = "motor_current"\ncolumns = { force = { from = 0, unit = "N" } }'),
        ('kind = "motor_current"', 'kind = "motor_current"\nforce_sd = 1'),
        ('kind = "motor_current"', 'kind = "motor_current"\ndecimal = ";"'),
        ('kind = "motor_current"', 'kind = "motor_current"\nwhere = { a = { low = 1 } }'),
        ('kind = "motor_current"', 'kind = "motor_current"\nreject = { rule = "hampel" }'),
        ('kind = "motor_current"', 'kind = "motor_current"\nplateaus = { levels = [1], unit = "N" }'),
        ('damping = "dry"', 'damping = ["viscose"]'),
        ('kind = "free_vibration"', 'kind = "free_vibration"\nthin = 0'),
        ('capsule = "held"', 'capsule = "loose"'),
        ('spring = "L60"', "spring = 60"),
        ('spring = "L60"\n', ""),
        ("[prior]", '[model]\nfriction = "dry"\n[prior]'),
        ("[prior]", '[model]\nfree = ["mu"]\n[prior]'),
        ("[prior]", '[[instrument]]\nname = "a"\ngain = 1\n[prior]'),
    ],
)
def test_the_schema_refuses_mistakes(part: str, wrong: str) -> None:
    assert part in RIG_TOML
    assert refusals(RIG_TOML) == []
    assert refusals(RIG_TOML.replace(part, wrong, 1)) != []


def test_the_schema_has_the_keys_that_the_reader_knows(tmp_path: Path) -> None:
    """Of every kind, also one of another package; its rule without a schema takes any value."""
    kinds = Registry((*KINDS.kinds, hop()))
    schema = init.rig_schema(kinds)
    for name in kinds:
        text = f'[rig]\nname = "a"\n[[experiment]]\nkind = "{name}"\nzzz = 1\n'
        with pytest.raises(InputError, match="unknown key, 'zzz'") as caught:
            read_rig(write_folder(tmp_path / name, text, {}), kinds)
        known = caught.value.remedy.partition("known: ")[2].split()
        assert set(init.entry_schema(kinds[name], [*kinds])["properties"]) == set(known)
    for table, keys in (("rig", TABLE_KEYS["[rig]"]), ("model", TABLE_KEYS["[model]"])):
        assert set(schema["properties"][table]["properties"]) == set(keys)
    assert set(schema["properties"]["instrument"]["items"]["properties"]) == set(INSTRUMENT_KEYS)
    text = '[rig]\nname = "a"\n[[experiment]]\nkind = "hop"\nfile = "a.csv"\ndrive = {}\n'
    schema = json.loads(json.dumps(schema))
    assert refusals(text.format('"words"'), schema) == refusals(text.format("[1]"), schema) == []
    assert refusals(text.format("1\nmuch = 1"), schema) != []


def test_the_whole_template_reads_once_its_comments_are_removed(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    assert call(init, str(tmp_path / "new" / "my-rig")) == 0
    assert "rig.toml" in capsys.readouterr().out
    file = tmp_path / "new" / "my-rig" / "rig.toml"
    assert sorted(path.name for path in file.parent.iterdir()) == ["rig.schema.json", "rig.toml"]
    text = file.read_text(encoding="utf-8")
    file.write_text(uncommented(text), encoding="utf-8")
    for name, content in FILES.items():
        (file.parent / name).write_text(content)
    rig = read_rig(file.parent)
    # The schema beside it is no part of the rig, and accepts it.
    assert "rig.schema.json" not in rig.files
    assert text.startswith("#:schema ./rig.schema.json\n")
    assert refusals(file.read_text(encoding="utf-8"), json.loads((file.parent / "rig.schema.json").read_bytes())) == []
    assert rig.name == "my-rig"
    assert {table.kind for table in rig.tables} == set(KINDS)


@pytest.mark.parametrize("kind", KINDS)
def test_each_experiment_of_the_template_alone(tmp_path: Path, kind: str) -> None:
    head, *blocks = init.template(KINDS, "a").split("# [[experiment]]")
    block = next(block for block in blocks if f'kind = "{kind}"' in block)
    head = re.sub(r"(?m)^# (?=m[12] )", "", head)
    name = re.findall(r'file = "(.*)"', block)[0]
    text = head + "[[experiment]]" + uncommented(block)
    assert [table.kind for table in read_rig(write_folder(tmp_path / "a", text, {name: FILES[name]})).tables] == [kind]


def test_the_template_mentions_everything_that_a_rig_may_say() -> None:
    for kind in KINDS.values():
        assert [column for column in kind.columns if not re.search(rf"\b{column}\b", kind.template)] == []
        assert [key for key in kind.setting_rules if not re.search(rf"\b{key}\b", kind.template)] == []
        choices = [rule.choices for rule in kind.setting_rules.values() if isinstance(rule, ChoiceRule)]
        assert [word for words in choices for word in words if f'"{word}"' not in kind.template] == []
    stated = [symbol for symbol, row in KINDS.parameters.items() if row.prior_can_be_stated]
    assert {"k1", "tilt_sd", "sliding_scatter"} < set(stated)
    assert [key for key in stated if not re.search(rf"\b{key}\b", init.template(KINDS, "a"))] == []


def test_an_untouched_template_asks_for_an_experiment(tmp_path: Path) -> None:
    call(init, str(tmp_path / "a"))
    with pytest.raises(InputError, match="at least one"):
        read_rig(tmp_path / "a")


def test_init_takes_an_empty_folder_and_no_other(tmp_path: Path) -> None:
    (tmp_path / "empty folder").mkdir()
    assert call(init, str(tmp_path / "empty folder")) == 0
    assert 'name = "rig"' in (tmp_path / "empty folder" / "rig.toml").read_text()
    for name in ("empty folder", "empty folder/rig.toml", "empty folder/rig.toml/below"):
        before = (tmp_path / "empty folder" / "rig.toml").read_bytes()
        with pytest.raises(InputError, match="DIR must be"):
            call(init, str(tmp_path / name))
        assert (tmp_path / "empty folder" / "rig.toml").read_bytes() == before


def test_init_states_the_masses(tmp_path: Path) -> None:
    assert call(init, str(tmp_path / "a"), "--m1", "110", "0.5", "g", "--m2", "0.53", "0", "kg") == 0
    text = (tmp_path / "a" / "rig.toml").read_text()
    assert '\nm1 = { value = 110, sd = 0.5, unit = "g" }\n' in text
    assert '\nm2 = { value = 0.53, sd = 0, unit = "kg" }\n' in text
    for words in (
        ("heavy", "1", "g"),
        ("110", "0.5", "mm"),
        ("-1", "0", "kg"),
        ("1", "2", "kg"),
        ("1 }\nx = 1", "0", "g"),
    ):
        with pytest.raises(InputError):
            call(init, str(tmp_path / "b"), "--m1", *words)
    assert not (tmp_path / "b").exists()


def test_check_prints_a_line_per_experiment(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    assert call(check, str(write_folder(tmp_path / "rig"))) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "twin: 10 experiments, SYNTHETIC data"
    assert lines[1] == "free_vibration free_vibration_1: 10 rows of time [ms], x_rel [mm], 1000 Hz"
    assert lines[3] == "static_friction lifted: 2 rows of height [mm], length [mm]"
    assert lines[8] == "forced_run run_01: 9 rows of time [s], x_rel [mm], acceleration_rod [m/s^2], 100 Hz"


PROBLEM = {
    "code", "level", "experiment", "parameters", "file", "line", "column", "rule", "value", "remedy", "text"
}  # fmt: skip


def as_json(folder: Path, capsys: pytest.CaptureFixture) -> tuple[int, dict[str, Any]]:
    """Exit code and content of ``check --json``."""
    code = capsule_id(["check", str(folder), "--json"])
    content = json.loads(capsys.readouterr().out)
    assert content.keys() == {"format", "rig", "synthetic", "tables", "findings", "errors"}
    assert content["format"] == "capsule-id check 1"
    assert all(problem.keys() == PROBLEM for problem in content["findings"] + content["errors"])
    return code, content


def test_check_as_json_holds_the_same_findings(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    folder = write_folder(tmp_path / "rig")
    code, content = as_json(folder, capsys)
    assert (code, content["rig"], content["synthetic"], content["errors"]) == (0, "twin", True, [])
    first, rig = content["tables"][0], read_rig(folder)
    assert [table["label"] for table in content["tables"]] == [table.label for table in rig.tables]
    assert first == {
        "label": "free_vibration_1", "kind": "free_vibration", "file": "free_vibration_1.csv", "rows": 10, "missing": 0,
        "rejected": 0, "columns": {"time": "ms", "x_rel": "mm"},
    }  # fmt: skip
    call(check, str(folder))
    said = capsys.readouterr().out
    assert content["findings"]
    for found in content["findings"]:
        assert f"{found['level']}: {found['text']}\n" in said
        assert f"{found['value']} {found['remedy']}".strip() == found["text"]


def test_check_as_json_names_the_line_of_a_finding(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    rows = (DATA / "free_vibration_1.csv").read_text().splitlines()
    head = '[rig]\nname = "a"\nm1 = { value = 0.1, sd = 0.001, unit = "kg" }\n'
    text = f'{head}[[experiment]]\nkind = "free_vibration"\nfile = "a.csv"\n'
    folder = write_folder(tmp_path / "rig", text, {"a.csv": "\n".join([*rows[:50], *rows[53:], ""])})
    gap = next(found for found in as_json(folder, capsys)[1]["findings"] if found["code"] == "readings.gaps")
    place = str(folder / "a.csv"), 50, None
    assert (gap["experiment"], gap["file"], gap["line"], gap["column"]) == ("a", *place)


def test_check_as_json_holds_all_errors(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    wrong = RIG_TOML.replace('name = "twin"', 'name = "a b"', 1).replace('kind = "motor_current"', 'kind = "motor"', 1)
    code, content = as_json(write_folder(tmp_path / "rig", wrong), capsys)
    assert (code, content["rig"], content["tables"], content["findings"]) == (2, None, [], [])
    with pytest.raises(FolderError) as caught:
        read_rig(tmp_path / "rig")
    assert [error["text"] for error in content["errors"]] == [str(error) for error in caught.value.errors]
    assert [(error["rule"], error["value"]) for error in content["errors"]][1] == ("unknown kind", "'motor'")
    assert as_json(tmp_path / "none", capsys)[1]["errors"][0]["remedy"] == "name a folder with a rig.toml"


def findings(folder: Path, capsys: pytest.CaptureFixture) -> list[str]:
    call(check, str(folder))
    lines = capsys.readouterr().out.splitlines()
    found = [line.split(": ", 1)[1] for line in lines if line.startswith(("warn: ", "fail: "))]
    assert lines[-1] == {0: "no findings", 1: "1 finding"}.get(len(found), f"{len(found)} findings")
    return found


def test_lint(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    head = '[rig]\nname = "a"\nm1 = { value = 0.11, unit = "kg" }\n'
    entry = '[[experiment]]\nkind = "free_vibration"\nfile = "{}"\n'
    # 16 Hz for 0.5 s (8 periods) at 1 kHz (62 per period); at 128 Hz (8 per period); and its first 0.1 s (1.6 periods)
    good, coarse, short = (sine(1000, 500), sine(128, 64), sine(1000, 100))
    uneven = good.replace("\n0.003,", "\n0.0034,")
    for name, table, finding in (
        ("good.csv", good, ""),
        (
            "coarse.csv",
            coarse,
            r"coarse: 8\.\d samples per period; 20 or more are wanted. Sample faster.coarse.csv: the sampling cannot .*",
        ),
        ("short.csv", short, r"short: 1\.\d periods; 2 or more are wanted. Record for longer."),
        (
            "uneven.csv",
            uneven,
            r"uneven: a filter needs evenly spaced samples; found steps from 0.0006 to 0.0014 s. .*",
        ),
    ):
        found = findings(write_folder(tmp_path / "rig", head + entry.format(name), {name: table}), capsys)
        assert found.pop(0).startswith("m1: no sd stated")
        assert re.fullmatch(finding, "".join(found))
    rows = '[rig]\nname = "a"\n[[experiment]]\nkind = "motor_current"\nfile = "motor_current.csv"\n'
    found = findings(write_folder(tmp_path / "rig", rows), capsys)
    assert found == [
        "motor_current: too few rows to estimate the scatter: 3 instead of 5. Measure more rows.",
        "motor_current: no reading error is stated for force and current. Add force_sd to the experiment.",
    ]
    twice = rows + '[[experiment]]\nkind = "motor_current"\nfile = "copy.csv"\n'
    found = findings(write_folder(tmp_path / "rig", twice, {"copy.csv": TABLES["motor_current.csv"]}), capsys)
    assert any(line.startswith("copy.csv has the same content as the file of motor_current") for line in found)


def test_check_says_what_a_forced_run_cannot_do(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    """The smallest amplitude of the paper's Fig. 11 gives no contact; twice that does."""
    drive = RIG_TOML.replace("34.56", "73.58")
    low = findings(write_folder(tmp_path / "low", drive.replace("value = 4.0", "value = 0.6")), capsys)
    assert [line for line in low if line.startswith("run_01:") and "does not determine k2" in line]
    enough = findings(write_folder(tmp_path / "high", drive), capsys)
    assert not [line for line in enough if "does not determine" in line]
    assert [line for line in enough if line.startswith("run_01:") and "record for" in line.lower()]


def sine(rate: int, samples: int) -> str:
    """A 16 Hz swing sampled at ``rate`` Hz."""
    rows = (f"{i / rate!r},{math.sin(2 * math.pi * 16 * i / rate)!r}\n" for i in range(samples))
    return "time [s],x_rel [mm]\n" + "".join(rows)


def test_check_refuses_with_the_place(tmp_path: Path) -> None:
    folder = write_folder(tmp_path / "rig", RIG_TOML.replace('"held"', '"hold"'))
    with pytest.raises(InputError, match=r"rig\.toml:20:11: capsule must be"):
        call(check, str(folder))
