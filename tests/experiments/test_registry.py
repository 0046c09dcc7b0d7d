"""The declarations of kinds: what they say, that nothing else lists them, and what a faulty one leads to."""

import ast
import json
import re
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Annotated

import numpy as np
import pytest

from capsule_id.api import fit, read_rig
from capsule_id.errors import InputError
from capsule_id.experiments.free_vibration.readings import RELEASES
from capsule_id.experiments.kind import (
    BUILT_IN,
    CHOICES,
    Kind,
    Registry,
    Twin,
    TwinTable,
    Values,
    default_registry,
    make_experiments,
    select_tables,
)
from capsule_id.parameters import TABLE, Name, by_index, scatter
from capsule_id.report.messages import DATA_MESSAGES, FIT_MESSAGES, messages_of
from capsule_id.rig.model import Settings
from capsule_id.rig.schema import (
    COUNT,
    PRESSING_FORCE,
    SLOPE,
    ChoiceRule,
    ColumnRule,
    NameRule,
    QuantityRule,
    SettingRule,
    WordsRule,
)
from capsule_id.rig.toml import ANY, NOT_NEGATIVE, PART, POSITIVE, Node
from capsule_id.synthetic import Truth, synthesize
from capsule_id.views import Message
from tests.cli_tools import ROOT
from tests.rig.folder import TABLES, write_folder

KINDS = default_registry()

#: Every setting of every kind by the interface: its rule, and its default (...: it must be stated).
_CHANNELS = ("x_rel", "x_capsule", "acceleration_rod", "current")
_DIRECTION = (ChoiceRule(("forward", "backward")), "forward")
_LOAD = (ChoiceRule(("weight", "pressed")), None)
_FORWARD = (ChoiceRule(("closed", "capsule")), "closed")
_FORCE = QuantityRule("N", ANY, has_sd=True)
_LAG = QuantityRule("s", NOT_NEGATIVE, has_sd=True)
_GAP = QuantityRule("m", ANY, has_sd=True)
_SUPPORTS = {
    "spring": (NameRule(), None),
    "gap": (_GAP, None),
    "spring_back": (NameRule(), None),
    "gap_back": (_GAP, None),
}
_GROUND: dict[str, tuple[SettingRule, object]] = {"slope": (SLOPE, None), "N0": (PRESSING_FORCE, None)}
SETTINGS: dict[str, dict[str, tuple[SettingRule, object]]] = {
    "free_vibration": {
        **_GROUND,
        "start": (QuantityRule("s", ANY), None),
        "stop": (QuantityRule("s", ANY), None),
        "releases": (RELEASES, None),
        "capsule": (ChoiceRule(("held", "free")), "held"),
        "damping": (WordsRule(("viscous", "dry", "quadratic")), None),
        "stiffness": (ChoiceRule(("linear", "cubic")), None),
        "drift": (ChoiceRule(("none", "linear", "gp")), None),
        "noise": (ChoiceRule(("white", "ar1", "arma")), None),
        "hum": (QuantityRule("Hz"), None),
        "thin": (COUNT, None),
        "samples": (ChoiceRule(("record", "turning_points")), "record"),
        "smoothing_window": (QuantityRule("s"), None),
        **_SUPPORTS,
        "forward": _FORWARD,
    },
    "static_friction": {
        **_GROUND,
        "length_is": (ChoiceRule(("board", "base")), None),
        "normal_force": (QuantityRule("N"), None),
        "load_is": _LOAD,
        "direction": _DIRECTION,
    },
    "dynamic_friction": {**_GROUND, "forward": _FORWARD, "direction": _DIRECTION},
    "sliding_friction": {**_GROUND, "load_is": _LOAD, "direction": _DIRECTION},
    "motor_current": {"sd_ratio": (QuantityRule("N/A"), None)},
    "support_spring": {
        "spring": (NameRule(), ...),
        "length": (QuantityRule("m", has_sd=True), None),
        "sd_ratio": (QuantityRule("N/m"), None),
    },
    "transducer": {"sd_ratio": (QuantityRule("1/N"), None)},
    "forced_run": {
        **_GROUND,
        "drive": (ChoiceRule(("harmonic", "base", "pulses", "square", "recorded")), "harmonic"),
        **_SUPPORTS,
        "Omega": (QuantityRule("rad/s"), None),
        "f": (QuantityRule("Hz"), None),
        "P_d": (QuantityRule("N", has_sd=True), None),
        "duty": (QuantityRule("1", PART), None),
        "P_on": (_FORCE, None),
        "lag": (_LAG, None),
        "normal_force": (QuantityRule("N"), None),
        "start": (ChoiceRule(("auto", "stuck", "moving", "settled")), "auto"),
        "noise": (ChoiceRule(("white", "ar1")), None),
        "segment": (QuantityRule("s"), None),
        **{f"{name}_gain_sd": (QuantityRule("1"), None) for name in _CHANNELS},
        **{f"{name}_delay_sd": (QuantityRule("s"), None) for name in _CHANNELS},
    },
    "progression": {
        **_GROUND,
        "drive": (ChoiceRule(("pulses", "square", "harmonic")), "pulses"),
        "P_on": (_FORCE, None),
        "P_d": (_FORCE, None),
        "lag": (_LAG, None),
        "tails": (ChoiceRule(("normal", "heavy")), "normal"),
    },
}


@pytest.mark.parametrize("name", SETTINGS)
def test_the_settings_are_those_of_the_interface(name: str) -> None:
    kind = KINDS[name]
    assert dict(kind.setting_rules) == {key: rule for key, (rule, _) in SETTINGS[name].items()}
    assert kind.required == tuple(key for key, (_, default) in SETTINGS[name].items() if default is ...)
    defaults = {field.name: field.default for field in fields(kind.settings) if field.name not in kind.required}
    assert defaults == {key: default for key, (_, default) in SETTINGS[name].items() if default is not ...}


def test_the_registry_has_every_built_in_kind_in_order() -> None:
    assert tuple(KINDS)[: len(BUILT_IN)] == BUILT_IN == tuple(SETTINGS)
    assert [name for name, kind in KINDS.items() if not kind.bench] == ["forced_run", "progression"]
    own = {row.symbol for kind in KINDS.values() for row in kind.parameters}
    assert own.isdisjoint(TABLE)
    assert set(KINDS.parameters) == own | set(TABLE)


def test_nothing_else_lists_kinds() -> None:
    """No string that is a kind's name stands outside of its file or folder and of the registry's one line."""
    package = ROOT / "capsule_id"
    found = [
        (file.relative_to(package).as_posix(), node.value)
        for file in package.rglob("*.py")
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8")))
        if isinstance(node, ast.Constant) and node.value in KINDS
    ]
    elsewhere = [(file, kind) for file, kind in found if not re.match(rf"experiments/{kind}(/|\.py)", file)]
    assert elsewhere == [("experiments/kind.py", kind) for kind in BUILT_IN]
    assert ("experiments/static_friction.py", "static_friction") in found  # the search does find them


def test_two_kinds_of_one_name_are_refused() -> None:
    with pytest.raises(ValueError, match="kind motor_current is declared twice"):
        Registry((*KINDS.kinds, KINDS["motor_current"]))


def test_two_meanings_of_one_parameter_are_refused() -> None:
    own = replace(KINDS["motor_current"], name="other", parameters=(scatter("tilt_sd", "rad", "another one", "s"),))
    with pytest.raises(ValueError, match="parameter tilt_sd of kind other is declared twice"):
        Registry((*KINDS.kinds, own))
    shared = replace(own, parameters=KINDS["static_friction"].parameters)
    assert Registry((*KINDS.kinds, shared)).parameters == KINDS.parameters


def test_a_setting_without_a_rule_is_refused() -> None:
    @dataclass(frozen=True, kw_only=True)
    class NoRule(Settings):
        size: float = 0.0

    with pytest.raises(TypeError, match="setting size must be a Literal, or Annotated with its rule"):
        Registry((replace(KINDS["motor_current"], settings=NoRule),))


@dataclass(frozen=True)
class WordsRule:
    """One word, or a list of words: a rule that the package does not have."""

    def read(self, node: Node) -> tuple[str, ...]:
        words = node.value if isinstance(node.value, list) else [node.value]
        node.require(all(isinstance(word, str) for word in words), "be words", "write them in quotes")
        return tuple(words)


@dataclass(frozen=True, kw_only=True)
class ProgressionSettings(Settings):
    """Settings with a rule of their own."""

    drive: Annotated[tuple[str, ...], WordsRule()] = ("harmonic",)


def hop() -> Kind:
    """A kind that another issue adds: optional columns, a setting by a rule of its own, masses by its table."""
    return replace(
        KINDS["dynamic_friction"],
        name="hop",
        columns={
            "period": ColumnRule("s", POSITIVE),
            "f": ColumnRule("Hz", POSITIVE),
            "duty": ColumnRule("1", POSITIVE),
            "distance": ColumnRule("m"),
        },
        sets=(("period", "distance"), ("f", "distance")),
        optional=("duty",),
        settings=ProgressionSettings,
        rules=(),
        masses=lambda table: ("m2",) if "duty" in table.columns else (),
        parameters=(),
    )


def test_a_new_kind_joins_the_synthetic_rig(tmp_path: Path) -> None:
    """Its own true value can be set; the other bench tests and the weighings come from the stream as before it."""

    def measure(values: Values, rng: np.random.Generator, seed: int) -> Twin:
        del rng
        columns = {"f [Hz]": np.array([4.0, 5.0]), "distance [cm]": values["stride"] * np.array([1.0, seed])}
        return Twin((TwinTable("hop.csv", columns, ('drive = "base"',)),))

    kind = replace(hop(), twin=measure, truth={"stride": 2.0})
    kinds = Registry((*KINDS.kinds, kind))
    truth = Truth().with_kinds(kinds.values()).with_values({"stride": 3.0, "k2[soft]": 2000.0})
    synthesize(tmp_path / "with", 7, truth, registry=kinds)
    synthesize(tmp_path / "without", 7, Truth().with_values({"k2[soft]": 2000.0}))
    table = read_rig(tmp_path / "with", kinds).tables[-1]
    assert (table.kind, table.settings.drive) == ("hop", ("base",))
    np.testing.assert_allclose(table["distance"], [0.03, 0.21])
    known = json.loads((tmp_path / "with.truth.json").read_text(encoding="utf-8"))["parameters"]
    assert (known["stride"], known["k2[soft]"], known["k1"]) == (3.0, 2000.0, 1420.0)
    for file in (tmp_path / "without").glob("*.csv"):
        assert file.read_bytes() == (tmp_path / "with" / file.name).read_bytes()
    files, before = ({file.name for file in (tmp_path / name).iterdir()} for name in ("with", "without"))
    assert files - before == {"hop.csv"}
    with pytest.raises(InputError, match="--set takes a parameter of the twin, stride"):
        Truth().with_values({"stride": 3.0})


def write_hop(folder: Path, columns: str, *settings: str) -> Path:
    entry = "\n".join(['[rig]\nname = "a"\n[[experiment]]\nkind = "hop"\nfile = "p.csv"', *settings])
    return write_folder(folder, entry, {"p.csv": f"{columns}\n{','.join('1' for _ in columns.split(','))}\n"})


def test_a_new_kind_needs_no_change_of_the_reader(tmp_path: Path) -> None:
    kinds = Registry((*KINDS.kinds, hop()))
    (table,) = read_rig(write_hop(tmp_path / "a", "period [ms],distance [cm]"), kinds).tables
    assert (table.settings.drive, table["period"][0], table["distance"][0]) == (("harmonic",), 1e-3, 1e-2)
    several = write_hop(tmp_path / "b", "f [Hz],distance [cm]", 'drive = ["pulses", "base"]')
    assert read_rig(several, kinds).tables[0].settings.drive == ("pulses", "base")
    for columns, settings, place, rule in (
        ("f [Hz],distance [cm]", ["drive = 3"], "rig.toml:6:9", "drive must be words"),
        ("f [Hz],distance [cm],duty [1]", [], "rig.toml:4:8", "hop needs m2"),
        ("f [Hz],duty [1]", [], "p.csv:1:1", "must have the columns period and distance, or f and distance"),
    ):
        folder = write_hop(tmp_path / "c", columns, *settings)
        with pytest.raises(InputError, match=rule) as caught:
            read_rig(folder, kinds)
        assert str(caught.value).startswith(f"{folder}/{place}: ")


def test_a_kind_outside_of_the_registry_is_unknown(tmp_path: Path) -> None:
    """The negative control: the same folder without the kind."""
    folder = write_hop(tmp_path / "a", "period [ms],distance [cm]")
    with pytest.raises(InputError, match=r"rig\.toml:4:8: unknown kind, 'hop', write one of free_vibration"):
        read_rig(folder)


@pytest.mark.parametrize("word", ["bensch", "", "ALL"])
def test_an_unknown_choice_of_experiments_is_refused(tmp_path: Path, word: str) -> None:
    rig = read_rig(write_folder(tmp_path / "rig"))
    for choose in (select_tables, make_experiments, lambda r, w: fit(r, experiments=w, budget=None)):
        with pytest.raises(InputError) as caught:
            choose(rig, word)  # type: ignore[arg-type]
        assert str(caught.value) == f'experiments must be one of "bench", "runs", "all", {word!r}, correct the word'


def test_the_choices_of_experiments(tmp_path: Path) -> None:
    rig = read_rig(write_folder(tmp_path / "rig"))
    chosen = {choice: [table.label for table in select_tables(rig, choice)] for choice in CHOICES}
    assert chosen["runs"] == ["run_01", "progression"]
    assert sorted(chosen["all"]) == sorted([*chosen["bench"], *chosen["runs"]])
    assert len(chosen["bench"]) == len(TABLES) - 2
    assert rig.has_runs
    bench = tuple(table for table in rig.tables if table.label in chosen["bench"])
    assert not replace(rig, tables=bench).has_runs


def test_a_bracket_in_a_symbol_is_refused() -> None:
    own = replace(KINDS["motor_current"], name="other", parameters=(scatter("sd[a]", "rad", "a scatter", "s"),))
    with pytest.raises(ValueError, match=r"symbol of parameter sd\[a\] of kind other must have no bracket"):
        Registry((own,))


def test_a_name_is_a_symbol_and_a_spring_or_record() -> None:
    values = {"k2[soft]": 2.0, "k2[a]b]": 3.0, "mu": 0.6, "k2": 1.0, "k2_back[soft]": 4.0}
    assert by_index("k2", values) == {"soft": 2.0, "a]b": 3.0}
    assert [str(Name.parse(name)) for name in values] == list(values)


def test_two_contents_of_one_caption_or_message_are_refused() -> None:
    other = replace(KINDS["motor_current"], name="other")
    assert Registry((*KINDS.kinds, other)).messages == KINDS.messages  # the same content is fine
    with pytest.raises(ValueError, match="caption motor_current of kind other is declared twice"):
        Registry((*KINDS.kinds, replace(other, captions={"motor_current": "Another one."})))
    with pytest.raises(ValueError, match=r"message lines\.straight of kind other is declared twice"):
        Registry((*KINDS.kinds, replace(other, messages={"lines.straight": Message("another one")})))


def test_a_kind_must_not_replace_messages_of_the_fit() -> None:
    own = replace(KINDS["motor_current"], name="other", messages={"residuals.white": Message("mine")})
    with pytest.raises(
        InputError, match=r"kind other must not declare messages of the whole fit, residuals\.white, rename"
    ):
        messages_of(Registry((*KINDS.kinds, own)))
    assert messages_of(KINDS).keys() == FIT_MESSAGES.keys() | DATA_MESSAGES.keys() | KINDS.messages.keys()
