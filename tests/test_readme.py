"""README and the guide are correct: their commands run, their tables are those of the package."""

import re
import shlex
import tomllib
from dataclasses import fields
from datetime import datetime, timedelta
from pathlib import Path
from typing import get_args, get_type_hints

import numpy as np
import pandas as pd
import pytest

import capsule_id as cid
from capsule_id import cli
from capsule_id.experiments.kind import default_registry
from capsule_id.parameters import Parameter
from capsule_id.report import html as citation
from capsule_id.report.columns import COLUMNS
from capsule_id.report.messages import QUESTIONS, messages_of
from capsule_id.rig.model import ModelChoices
from capsule_id.rig.schema import OPTIONAL
from capsule_id.views import Trust
from tests.cli_tools import ROOT, parsers

README = (ROOT / "README.md").read_text(encoding="utf-8")
GUIDE_FOLDER = ROOT / "capsule_id" / "guide"
INDEX = GUIDE_FOLDER / "index.md"  # of the site: a list of the pages
PAGES = sorted(path for path in GUIDE_FOLDER.glob("*.md") if path != INDEX)
GUIDE = {path.stem: path.read_text(encoding="utf-8") for path in PAGES}
TEXTS = {ROOT / "README.md": README} | {GUIDE_FOLDER / f"{name}.md": text for name, text in GUIDE.items()}
EVERYTHING = "\n".join(TEXTS.values())
KINDS = default_registry()
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
LONGEST_README, WIDEST_README, LONGEST_PAGE = 130, 110, 150  # lines, columns, lines
LARGEST_FIGURE = 150_000  # bytes


def blocks(language: str, text: str = README) -> list[str]:
    """The fenced blocks of a language, without the indentation of a list."""
    found = re.findall(rf"^( *)```{language}\n(.*?)^ *```$", text, re.MULTILINE | re.DOTALL)
    return [re.sub(rf"^{indent}", "", body, flags=re.MULTILINE) for indent, body in found]


def set_up_commands() -> list[list[str]]:
    """The two fenced commands at the start of README, each split at &&."""
    return [[part.strip() for part in block.split("&&")] for block in blocks("sh")[:2]]


def rows(header: str, text: str) -> dict[str, list[str]]:
    """The table of ``text`` whose header line is ``header``: cells by the first one."""
    lines = text.split(header + "\n", 1)[1].splitlines()[1:]
    table = lines[: lines.index("") if "" in lines else None]
    cells = [[cell.strip() for cell in line.strip("|").split(" | ")] for line in table]
    return {first.strip("`| "): [cell.strip("| ") for cell in rest] for first, *rest in cells}


def keys(header: str, text: str) -> list[str]:
    """The words in code style in the first column of a table."""
    return [key for cell in rows(header, text) for key in re.split(r"`, `", cell)]


def test_the_two_commands_set_up_and_run() -> None:
    fit, test = set_up_commands()
    venv = "python3 -m venv .venv"
    assert fit == [venv, ".venv/bin/pip install .", ".venv/bin/fit-params data/"]
    assert test == [venv, ".venv/bin/pip install '.[test]'", ".venv/bin/python -m pytest"]
    assert "fit-params" in PROJECT["scripts"]
    assert "test" in PROJECT["optional-dependencies"]


#: A first user's export: titles, semicolons, decimal commas, micrometres, notes, stamps, a release after 0.35 s.
GERMAN = "Messung 3.csv"


def own_record(file: str, header: str, readings: list[str], k1: float, c: float, m1: float) -> str:
    """A decay as README's, or as ``GERMAN``."""
    begin, second = (float(line.split(",")[0]) for line in readings)
    time = begin + (second - begin) * np.arange(1500) * (2 if file == GERMAN else 1)
    gamma, release = c / (2.0 * m1), 0.35 * (file == GERMAN)
    omega, since = np.sqrt(k1 / m1 - gamma**2), np.maximum(time - release, 0.0)
    swing = np.cos(omega * since) + gamma / omega * np.sin(omega * since)
    noise = 0.02 * np.random.default_rng(0).standard_normal(time.size)
    x_rel = float(readings[0].split(",")[1]) * np.exp(-gamma * since) * swing + noise
    if file != GERMAN:
        return f"{header}\n" + "".join(f"{t:.4f},{x:.4f}\n" for t, x in zip(time, x_rel, strict=True))
    stamps = [datetime(2024, 3, 1, 12, 34, 56, 789000) + timedelta(seconds=float(t)) for t in time]
    cells = zip(
        (f"{at:%H:%M:%S,%f}"[:-3] for at in stamps), (f"{1e3 * x:.1f}".replace(".", ",") for x in x_rel), strict=True
    )
    rows = [f"{stamp};{x};{'Stoß' * (k == 700)}" for k, (stamp, x) in enumerate(cells)]
    titles = [
        "Ausschwingversuch 3",
        "Prüfer: K. Weiß; Ort: Labor 2",
        "Abtastrate 1000 Hz",
        "",
        "Uhrzeit;Weg (µm);Bemerkung",
    ]
    return "\r\n".join([*titles, *rows, ""])


@pytest.mark.parametrize("file", ["decay.csv", GERMAN])
def test_a_record_of_ones_own_gives_k1(
    file: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The three commands of README, from a file of a laboratory program to k1, without an edit.

    In this process: a child process would import JAX for each step. That the installed command runs in a process of its
    own stands in ``test_main_job.py``.
    """
    monkeypatch.chdir(tmp_path)
    k1, c, m1 = 1420.0, 1.9, 0.11
    header, *readings = blocks("csv")[0].splitlines()
    encoding = "cp1252" if file == GERMAN else "utf-8"
    Path(file).write_text(own_record(file, header, readings, k1, c, m1), encoding=encoding, newline="")
    steps = [line.removeprefix(".venv/bin/").split() for line in blocks("sh")[2].splitlines()]
    assert [words[-1] for words in steps] == ["decay.csv", "my-rig", "my-rig"]
    (program, *init), (_, *check), (_, *fit) = steps
    assert program == "capsule-id"
    assert cli.capsule_id([*init[:-1], file]) == 0
    if file != GERMAN:
        written = (tmp_path / "my-rig" / "rig.toml").read_text(encoding="utf-8").splitlines()
        shown = [re.sub(r"\d+(%| rows)", "", line) for line in blocks("toml")[0].splitlines()]
        assert [line for line in shown if line not in {re.sub(r"\d+(%| rows)", "", each) for each in written}] == []
    capsys.readouterr()
    assert cli.capsule_id(check) == 0
    assert not re.search("^(fail|warn)", capsys.readouterr().out, re.MULTILINE)
    code, (out, error) = cli.fit_params([*fit, "--no-sample", "--quiet"]), capsys.readouterr()
    assert (code, error) == (0, "")
    value, sd = (float(x) for x in re.findall(r"^k1 +N/m +(\S+) ± (\S+)", out, re.MULTILINE)[0])
    assert abs(value - k1) < 3.0 * sd < 0.02 * k1
    (report,) = re.findall(r"`(results/my-rig/\S+)`", README)
    assert (tmp_path / report).is_file()


def test_the_reference_is_the_same_everywhere() -> None:
    """README, CITATION.cff, the report's methods and its BibTeX entry take the paper from one place."""
    words = " ".join(README.split())
    assert f"*{citation.TITLE}*, {citation.PUBLISHED}." in words
    (entry,) = yaml_references((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    start, end = citation.PAPER["pages"].split("--")
    known = {key: citation.PAPER[key] for key in ("title", "journal", "volume", "year")}
    assert entry == known | {"start": start, "end": end, "type": "article"}


def yaml_references(text: str) -> list[dict[str, str]]:
    """The scalar fields of every reference of CITATION.cff."""
    parts = text.split("references:\n", 1)[1].split("  - type: ")[1:]
    return [
        dict(re.findall(r'^    (\w+): "?(.*?)"?$', part, re.MULTILINE)) | {"type": part.split()[0]} for part in parts
    ]


def test_readme_and_the_pages_are_short() -> None:
    lines = README.splitlines()
    assert len(lines) <= LONGEST_README
    assert max(map(len, lines)) <= WIDEST_README
    assert {name: text.count("\n") for name, text in GUIDE.items() if text.count("\n") > LONGEST_PAGE} == {}


def test_every_link_leads_to_a_file_and_readme_links_every_page() -> None:
    for path, text in TEXTS.items():
        links = re.findall(r"\]\(([^)#:]+)\)", text)
        assert links, path
        assert [link for link in links if not (path.parent / link).is_file()] == [], path
    linked = {ROOT / link for link in re.findall(r"\]\(([^)#:]+)\)", README)}
    assert linked == {path for path in GUIDE_FOLDER.iterdir() if path.is_file()} - {GUIDE_FOLDER / "conf.py", INDEX}


def test_the_figure_is_small_and_described() -> None:
    ((description, figure),) = re.findall(r"!\[(.*?)\]\((.*?)\)", README, re.DOTALL)
    assert len(description.split()) > 20
    content = (ROOT / figure).read_bytes()
    assert content.startswith(b"\x89PNG")
    assert len(content) <= LARGEST_FIGURE


def test_the_three_words_of_trust_are_the_packages() -> None:
    assert set(rows("| trust | meaning | what to do |", README)) == set(get_args(Trust))


def _prior(row: Parameter) -> str:
    """The default prior in one phrase, SI; "constant" if it is not sampled."""
    if not row.sampled:
        return "constant"
    described = "by the experiment" if row.prior is None else row.prior.describe()
    return f"{row.describe_default()}; if free: {described}" if row.optional else described


def test_the_parameter_table_is_the_packages() -> None:
    expected = {symbol: [row.unit, row.meaning, _prior(row)] for symbol, row in KINDS.parameters.items()}
    assert rows("| symbol | unit | meaning | default prior |", GUIDE["parameters"]) == expected


def test_the_kinds_of_experiments_are_the_packages() -> None:
    table = rows("| kind | columns | informs |", GUIDE["experiments"])
    assert list(table) == list(KINDS)
    for kind, (columns, informs) in table.items():
        assert set(re.findall(r"`(\w+) \[", columns)) == set(KINDS[kind].columns)
        assert informs == KINDS[kind].informs


@pytest.mark.parametrize("kind", list(KINDS))
def test_the_settings_of_every_kind_are_the_packages(kind: str) -> None:
    (page,) = (text for text in GUIDE.values() if f"| setting of `{kind}` |" in text)
    assert sorted(keys(f"| setting of `{kind}` | meaning |", page)) == sorted(KINDS[kind].setting_rules)


def test_the_choices_of_model_are_the_packages() -> None:
    table = rows("| key of `[model]` | meaning |", GUIDE["friction"])
    assert list(table) == ["friction", "free", "reaction", "engine"]
    for key in ("friction", "reaction", "engine"):
        words = get_args(get_type_hints(ModelChoices)[key])
        assert tuple(re.findall(r'`"(\w+)"`', table[key][0])) == words
    assert tuple(re.findall(r"`(\w+)`", table["free"][0])) == OPTIONAL


def test_the_columns_of_a_result_are_the_packages() -> None:
    found = keys("| column | content |", GUIDE["results"])
    assert sorted(found) == sorted(column.key for column in COLUMNS)


def test_the_drives_have_the_arguments_of_the_guide() -> None:
    for call in rows("| drive | force on the rod |", GUIDE["capsule_model"]):
        name, arguments = re.findall(r"cid\.([\w.]+)\((.*)\)", call)[0]
        if "." not in name:
            assert arguments.split(", ") == [field.name for field in fields(getattr(cid, name))]
        else:
            assert callable(getattr(getattr(cid, name.split(".")[0]), name.split(".")[1]))


def test_every_path_that_the_texts_name_exists() -> None:
    named = set(re.findall(r"`((?:capsule_id|data|notebooks|tests)/[\w/.]*)`", EVERYTHING))
    assert len(named) >= 25
    assert [path for path in named if not (ROOT / path).exists()] == []


def test_the_checks_are_those_of_the_package() -> None:
    """Every question in its words, and every other code that can be a finding, with its title and its levels."""
    messages = messages_of(KINDS)
    asked = rows("| check | question | limit |", GUIDE["checks"])
    assert {code: cells[0] for code, cells in asked.items()} == {
        code: text.partition("?")[0] + "?" for code, text in QUESTIONS.items()
    }
    for code, text in QUESTIONS.items():
        stated = re.findall(r"0\.\d+|\d+ sd|\d{3,}", re.sub(r"\{[^}]*\}", "", text))
        assert all(number in asked[code][1] for number in stated), code
    others = {
        code: [words.title, ", ".join(level for level in ("fail", "warn", "ok") if getattr(words, level))]
        for code, words in messages.items()
        if code not in QUESTIONS and (words.ok or words.warn or words.fail)
    }
    assert rows("| finding | subject | levels |", GUIDE["checks"]) == others


def test_the_list_of_public_names_is_whole() -> None:
    assert sorted(re.findall(r"^   ([A-Za-z_]+)$", GUIDE["api"], re.MULTILINE)) == cid.__all__


#: Columns of the files that the how-tos name without ``columns``.
OF_DATA = {"run.csv": "run_1.csv", "motor.csv": "motor_current.csv", "decay.csv": "free_vibration_1.csv"}


def two_releases() -> pd.DataFrame:
    """A pull, a hold and a decay, twice."""
    t = np.arange(1500) / 1000.0
    one = np.concatenate(
        [2.0 * np.linspace(0.0, 1.0, 400), np.full(300, 2.0), 2.0 * np.exp(-6.0 * t) * np.cos(70.0 * t)]
    )
    x_rel = np.tile(one, 2) + 0.004 * np.random.default_rng(0).standard_normal(2 * len(one))
    return pd.DataFrame({"time [s]": np.arange(len(x_rel)) / 1000.0, "x_rel [mm]": x_rel})


@pytest.mark.parametrize("block", blocks("toml", GUIDE["how_to"]), ids=lambda block: block.splitlines()[-1][:20])
def test_the_lines_of_the_how_tos_are_read(block: str, tmp_path: Path) -> None:
    """Each block with the file that it names, beside the masses; lines without an experiment act on a decay."""
    content = tomllib.loads(block)
    first = "" if "experiment" in content else '[[experiment]]\nkind = "free_vibration"\nfile = "decay.csv"\n'
    rig = '[rig]\nname = "x"\nm1 = { value = 110, sd = 0.5, unit = "g" }\nm2 = { value = 530, unit = "g" }\n'
    text = rig + (block + first if "model" in content else first + block)
    (tmp_path / "rig.toml").write_text(text, encoding="utf-8")
    for entry in tomllib.loads(text)["experiment"]:
        table = two_releases() if "releases" in entry else pd.read_csv(ROOT / "data" / OF_DATA[entry["file"]])
        if "P_d" in entry:
            table = table.drop(columns="current [A]")
        if "columns" in entry:
            table.columns = [column["from"] for column in entry["columns"].values()]
        table.to_csv(tmp_path / entry["file"], index=False)
    rig_read = cid.read_rig(tmp_path)
    kinds = [each["kind"] for each in tomllib.loads(text)["experiment"] for _ in range(1 + ("releases" in each))]
    assert [table.kind for table in rig_read.tables] == kinds


def test_the_exit_codes_are_those_of_the_command() -> None:
    table = rows("| exit code | meaning |", GUIDE["results"])
    assert set(table) == {"0", "3", *map(str, (cli.BAD_INPUT, cli.INTERNAL, cli.INTERRUPTED))}


def test_every_command_and_option_is_understood() -> None:
    lines = [line.split(" && ")[-1].removeprefix(".venv/bin/") for text in TEXTS.values() for line in _commands(text)]
    assert len(lines) >= 8
    for line in lines:
        program, *words = shlex.split(line)
        parser = {"fit-params": cli._fit_parser, "capsule-id": cli._capsule_parser}[program](program)
        parser.parse_args(words)
    known = {option for parser in parsers() for option in parser._option_string_actions}
    spans = re.findall(r"`([^`\n]+)`", re.sub(r"```.*?```", "", EVERYTHING, flags=re.DOTALL))
    named = {option for span in spans for option in re.findall(r"(?:^| )(--[a-z][\w-]*)", span)}
    assert len(named) >= 15
    assert named - known == set()


def _commands(text: str) -> list[str]:
    """The lines of fenced shell blocks that end in a command of this package."""
    lines = [line for block in blocks("sh", text) for line in block.splitlines()]
    return [line for line in lines if re.search(r"(^|/)(fit-params|capsule-id) ", line)]


def test_the_examples_in_python_give_what_they_say(capsys: pytest.CaptureFixture[str]) -> None:
    """The motion, then a force and a friction law that go on from it."""
    names: dict[str, object] = {"__name__": "readme"}
    examples = blocks("python", GUIDE["capsule_model"])
    for block in examples:
        exec(block, names)
        (promised,) = re.findall(r"print\(.*\)  # (\S+)", block)
        assert capsys.readouterr().out.split() == [promised]
    # Those of the results are below; that of a kind is installed and fitted in tests/experiments/test_plugin.py; scripts
    # are typed and run in tests/test_typed.py.
    others = [block for name in ("results", "extending", "scripts") for block in blocks("python", GUIDE[name])]
    assert len(examples) == EVERYTHING.count("```python") - len(others) == 3


def test_the_example_of_a_result_uses_what_there_is() -> None:
    """Every attribute of its lines, and every plot that its comment lists; a plot of another name would fail."""
    (example,) = blocks("python", GUIDE["results"])
    compile(example, "results.md", "exec")
    used = {tuple(pair) for pair in re.findall(r"\b(cid|result)\.(\w+)", example)}
    fields_of_fit = {field.name for field in fields(cid.Fit)}
    owners = {"cid": set(dir(cid)), "result": set(dir(cid.Fit)) | fields_of_fit}
    assert [(owner, name) for owner, name in used if name not in owners[owner]] == []
    plots = {"plot_comparison", *(f"plot{name}" for name in re.findall(r"\b_[a-z]+", example.partition("also ")[2]))}
    assert plots == {name for name in dir(cid.Fit) if name.startswith("plot_")}
