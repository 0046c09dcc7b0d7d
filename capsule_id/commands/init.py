"""``capsule-id init DIR``: a rig folder with a commented ``rig.toml`` to fill in, or one that reads the given exports."""

import argparse
import json
import re
from collections.abc import Sequence
from itertools import chain
from pathlib import Path
from typing import Any

from capsule_id.console import say
from capsule_id.errors import InputError, refusing
from capsule_id.experiments.kind import Registry, default_registry
from capsule_id.importing import entry_of, read_file
from capsule_id.output import replace_files
from capsule_id.parameters import Prior
from capsule_id.rig.maps import CLOCK, LAYOUT
from capsule_id.rig.plateaus import REJECT, DurationRule
from capsule_id.rig.schema import (
    MODEL_RULES,
    OPTIONAL,
    RIG_QUANTITIES,
    RIG_WORDS,
    TABLE_KEYS,
    KindRule,
    NameRule,
    QuantityRule,
    number_schema,
    table_schema,
    words_of_tests,
)
from capsule_id.rig.toml import ANY, NAME_PATTERN, POSITIVE, PRIOR_KEYS, Node, parse_toml

#: The head of ``rig.toml``. Lines that begin with `#:` are comments; without its `# `, every other `#` line is TOML.
HEAD = Path(__file__).with_name("template.toml")


def template(kinds: Registry, name: str, entries: Sequence[str] | None = None) -> str:
    """The commented ``rig.toml`` of a rig called ``name``, with ``entries``, or a commented one for each of ``kinds``."""
    stated = [row for row in kinds.parameters.values() if row.prior_can_be_stated]
    head = HEAD.read_text(encoding="utf-8").replace("@NAME@", name)
    for kind in ("lognormal", "halfnormal", "normal"):
        rows = [row for row in stated if row.prior is not None and row.prior.kind == kind]
        words = ['"k2[<spring>]"' if row.symbol == "k2" else row.symbol for row in rows]
        head = head.replace(f"@{kind.upper()}@", " ".join(words))
    head = head.replace("@OPTIONAL@", " ".join(row.symbol for row in kinds.parameters.values() if row.optional))
    return "\n".join([head, *(entries or [kind.template for kind in kinds.values()])])


#: JSON schemas of plain values.
_TEXT, _NUMBER, _COLUMN = {"type": "string"}, {"type": "number"}, {"type": ["string", "integer"], "minimum": 1}
_TEXTS = {"type": "array", "items": _TEXT}


def entry_schema(kind: KindRule, names: Sequence[str]) -> dict[str, Any]:
    """The JSON schema of an experiment of ``kind``; ``names``: of all kinds."""
    column = {"from": _COLUMN, "minus": _COLUMN, "unit": _TEXT, "scale": _NUMBER, "offset": _NUMBER}
    source = {"anyOf": [table_schema(column, ("from", "unit")), table_schema({"rate": QuantityRule("Hz")}, ("rate",))]}
    plateaus = {"levels": {"type": "array", "items": _NUMBER, "minItems": 2}, "unit": _TEXT, "guard": DurationRule()}
    keys = {
        "kind": {"enum": names},
        "file": _TEXT,
        "files": {**_TEXTS, "minItems": 1},
        "label": NameRule(),
        "columns": table_schema({name: {**source} for name in ("time", *kind.columns)}) | {"minProperties": 1},
        **LAYOUT,
        "where": {
            "type": "object",
            "additionalProperties": {
                "anyOf": [{"type": ["string", "number"]}, table_schema({"min": _NUMBER, "max": _NUMBER})]
            },
        },
        "plateaus": table_schema(plateaus, ("levels", "unit")),
        "reject": table_schema(REJECT, REJECT),
        "clock": table_schema(CLOCK),
        **{f"{name}_{error}": QuantityRule(r.si) for name, r in kind.columns.items() for error in ("sd", "resolution")},
        **{f"{name}_instrument": _TEXT for name in kind.columns},
        **kind.setting_rules,
    }
    return table_schema(keys, ("kind", *kind.required)) | {"anyOf": [{"required": ["file"]}, {"required": ["files"]}]}


def rig_schema(kinds: Registry) -> dict[str, Any]:
    """The JSON schema of ``rig.toml``, for editors: tables, keys, types and words; ``capsule-id check`` judges the rest."""
    entries = {name: entry_schema(kind, [*kinds]) for name, kind in kinds.items()}
    forms: dict[str, list[object]] = {}
    for key, form in chain.from_iterable(entry["properties"].items() for entry in entries.values()):
        forms.setdefault(key, []).extend([form] * (form not in forms.get(key, [])))
    # Editors complete by the keys of all kinds: few of them follow an "if".
    every = table_schema({key: {"anyOf": each} if each[1:] else each[0] for key, each in forms.items()}, ("kind",))
    chosen = [
        {
            "if": {"properties": {"kind": {"enum": [name]}}, "required": ["kind"]},
            "then": {
                "properties": {key: form for key, form in entry["properties"].items() if forms[key][1:]},
                "propertyNames": {"enum": [*entry["properties"]]},
                "required": entry["required"],
                "anyOf": entry["anyOf"],
            },
        }
        for name, entry in entries.items()
    ]
    priors = {
        symbol: _prior_schema(row.unit, row.prior)
        for symbol, row in kinds.parameters.items()
        if row.prior_can_be_stated
    }
    springs = {"patternProperties": {rf"^k2\[{NAME_PATTERN}\]$": priors.pop("k2")}}
    error = table_schema({**QuantityRule("1", ANY, has_sd=True).schema["properties"], "unit": _TEXT}, ("unit",))
    instrument = {"name": NameRule(), "gain": error, "offset": error, "clock": error}
    tests = table_schema(dict.fromkeys(words_of_tests(kinds), number_schema(POSITIVE)))
    tables = {
        "rig": table_schema({**RIG_WORDS, **RIG_QUANTITIES, "confirmed": _TEXTS}, ("name",)),
        "model": table_schema(
            {**MODEL_RULES, "free": {"type": "array", "items": {"enum": OPTIONAL}, "uniqueItems": True}}
        ),
        "prior": table_schema(priors) | springs,
        "plan": table_schema(dict.fromkeys(TABLE_KEYS["[plan]"], tests)),
        "instrument": {"type": "array", "items": table_schema(instrument, ("name",))},
        "experiment": {"type": "array", "minItems": 1, "items": {"allOf": [every, *chosen]}},
    }
    return {
        "$schema": "http://json-schema.org/draft-07/schema#",
        "title": "rig.toml of capsule-id",
        **table_schema(tables, ("rig", "experiment")),
    }


def _prior_schema(unit: str, prior: Prior | None) -> dict[str, Any]:
    """The JSON schema of an entry of [prior] in place of ``prior``; a unit of 1 is optional."""
    assert prior is not None, "it can be stated"
    keys = {key: number_schema(domain) for key, domain in PRIOR_KEYS[prior.kind].items()}
    return table_schema({**keys, "unit": {**_TEXT, "description": unit}}, (*keys, *["unit"] * (unit != "1")))


_MASSES = {"m1": "rod", "m2": "capsule"}
OPTIONS = {
    "": (
        ("dir", "DIR", "new or empty folder; with --from it may hold the files"),
        (
            "--from",
            "FILE",
            "exports of loggers and programs: copy them into DIR and guess the entries that read them",
            {"dest": "files", "nargs": "+", "type": Path, "default": []},
        ),
        *(
            (f"--{m}", ("VALUE", "SD", "UNIT"), f"mass of the {part}: 110 0.5 g", {"nargs": 3})
            for m, part in _MASSES.items()
        ),
    )
}


def _mass_line(name: str, value: str, sd: str, unit: str) -> str:
    """The line of [rig] that states a mass.

    Raises
    ------
    InputError
        If it is none.
    """
    line = f"{name} = {{ value = {value}, sd = {sd}, unit = {json.dumps(unit)} }}"
    document = parse_toml(line, Path(f"--{name}"))
    rule = RIG_QUANTITIES[name]
    Node(document, (name,), document.data[name]).quantity(rule.si, rule.domain, rule.has_sd)
    return line


def run(args: argparse.Namespace) -> int:
    """Write the folder; 0.

    Raises
    ------
    InputError
        If DIR holds other files, is no folder, or cannot be written; if an export cannot be read.
    """
    folder, files = Path(args.dir), list(args.files)
    masses = {m: _mass_line(m, *getattr(args, m)) for m in _MASSES if getattr(args, m)}
    kinds = default_registry()
    contents = {path.name: read_file(path) for path in files}
    if len(contents) < len(files):
        raise InputError("files must have different names", "two of one name", "rename one of them", folder)
    guesses = {path.name: entry_of(contents[path.name], path, kinds) for path in files}
    with refusing("DIR must be writable", "name another one", folder):
        own = {path.resolve() for path in files}
        if folder.exists() and (not folder.is_dir() or any(each.resolve() not in own for each in folder.iterdir())):
            raise InputError("DIR must be new or an empty folder", str(folder), "name another one", folder)
        folder.mkdir(parents=True, exist_ok=True)
        name = folder.resolve().name
        usable = re.fullmatch(NAME_PATTERN, name) and name.strip(".")
        text = template(kinds, name if usable else "rig", [entry for entry, _ in guesses.values()])
        for m, line in masses.items():
            text = re.sub(rf"^# {m} = .*", lambda _, line=line: line, text, count=1, flags=re.MULTILINE)
        schema = json.dumps(rig_schema(kinds), separators=(",", ":")) + "\n"
        contents = {"rig.toml": text.encode(), "rig.schema.json": schema, **contents}
        # A part of a table would be read as a table.
        replace_files({folder / file: text for file, text in contents.items() if (folder / file).resolve() not in own})
    guessed = "".join(
        f"\n{file}: {'kind unsure' if one is None else one.kind}{', unsure' if one and '# unsure' in entry else ''}"
        for file, (entry, one) in guesses.items()
    )
    ahead = (
        f"\ncheck its guesses, {'' if masses else 'state the masses, '}"
        if files
        else (" add tables, remove the `# ` of their entries, ")
    )
    say(f"wrote {folder / 'rig.toml'}:{guessed}{ahead}then run capsule-id check {folder}")
    return 0
