"""Damaged files of a result: ``load`` and ``capsule-id report`` read them, or name the file and the remedy."""

import io
import json
import shutil
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from capsule_id import load
from capsule_id.cli import capsule_id
from capsule_id.errors import InputError
from capsule_id.report.write import write_result

#: What stands in the place of a value of JSON.
OTHERS = (None, True, 0, -1, 1e400, "x", "", [], [[]], {}, {"x": 1}, {"array": "a0"}, {"object": []}, 10**400)
Damage = Callable[[bytes, np.random.Generator], bytes]


@pytest.fixture(scope="module")
def whole(files: dict[str, bytes], tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("whole")
    write_result(files, path)
    return path


def truncated(content: bytes, random: np.random.Generator) -> bytes:
    return content[: int(random.integers(len(content)))]


def flipped(content: bytes, random: np.random.Generator) -> bytes:
    changed = bytearray(content)
    for place in random.integers(len(content), size=int(random.integers(1, 9))):
        changed[place] ^= int(random.integers(1, 256))
    return bytes(changed)


def zeroed(content: bytes, random: np.random.Generator) -> bytes:
    begin = int(random.integers(len(content)))
    return content[:begin] + bytes(len(content[begin : begin + 512])) + content[begin + 512 :]


def places(tree: Any) -> Iterator[tuple[Any, Any]]:
    """Every (container, key) of a JSON tree."""
    for key in list(tree if isinstance(tree, dict) else range(len(tree))):
        yield tree, key
        if isinstance(tree[key], dict | list):
            yield from places(tree[key])


def with_other_json(content: bytes, random: np.random.Generator) -> bytes:
    """One value replaced or removed."""
    tree = json.loads(content)
    found = list(places(tree))
    container, key = found[int(random.integers(len(found)))]
    other = OTHERS[int(random.integers(len(OTHERS) + 4)) % len(OTHERS)]
    if random.random() < 0.4:
        del container[key]
    else:
        container[key] = other
    return json.dumps(tree).encode()


def with_other_members(content: bytes, random: np.random.Generator) -> bytes:
    """A member of the archive is removed, damaged, or an array of other values; or its tree is damaged."""
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    name = list(members)[int(random.integers(len(members)))]
    kind = int(random.integers(6))
    if kind >= 3:
        tree = np.load(io.BytesIO(members["tree.npy"])).tobytes()
        np.save(file := io.BytesIO(), np.frombuffer(with_other_json(tree, random), np.uint8))
        members["tree.npy"] = file.getvalue()
    elif kind == 2:
        np.save(
            file := io.BytesIO(),
            (np.zeros(3), np.array("x"), np.zeros((2, 0)), np.array([None]))[int(random.integers(4))],
        )
        members[name] = file.getvalue()
    elif kind == 1:
        members[name] = (truncated, flipped)[int(random.integers(2))](members[name], random)
    else:
        del members[name]
    with zipfile.ZipFile(made := io.BytesIO(), "w") as archive:
        for member, data in members.items():
            archive.writestr(member, data)
    return made.getvalue()


BYTES: tuple[Damage, ...] = (truncated, flipped, zeroed)
DAMAGES = [
    *(("figures/data.npz", damage) for damage in (*BYTES, with_other_members, with_other_members, with_other_members)),
    *(("posterior.nc", damage) for damage in BYTES),
    *(("parameters.json", damage) for damage in (*BYTES, with_other_json, with_other_json)),
]


def outcome(folder: Path, name: str, summary: pd.DataFrame, capsys: pytest.CaptureFixture[str]) -> str:
    if name == "parameters.json":
        for words in ([], ["--json"]):
            code = capsule_id(["report", str(folder), *words])
            text = capsys.readouterr().err
            if code == 2:
                assert text.startswith(f"{folder / name}: ")
                assert text.endswith("run fit-params again\n"), text
            elif code not in (0, 3):
                return text
        return "ok"
    refused = None
    try:
        loaded = load(folder)
    except InputError as error:
        refused = error
    if refused is not None:
        return "ok" if refused.file == str(folder / name) and refused.remedy == "run fit-params again" else str(refused)
    return "ok" if loaded.summary.equals(summary) else "other numbers"


@pytest.mark.parametrize(
    ("seed", "times"),
    [
        (0, 2 * len(DAMAGES)),
        pytest.param(1, 280, marks=pytest.mark.full),
        pytest.param(1, 3000, marks=[pytest.mark.full, pytest.mark.slow]),
    ],
)
def test_any_damage_is_named(
    whole: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], seed: int, times: int
) -> None:
    found: dict[str, list[str]] = {}
    summary = load(whole).summary
    for number in range(times):
        random = np.random.default_rng([seed, number])
        name, damage = DAMAGES[number % len(DAMAGES)]
        folder = tmp_path / str(number)
        shutil.copytree(whole, folder)
        (folder / name).write_bytes(damage((whole / name).read_bytes(), random))
        try:
            text = outcome(folder, name, summary, capsys)
        except Exception as error:  # anything but an InputError is a failure of its own
            text = f"{type(error).__name__}: {error}"
        if text != "ok":
            found.setdefault(text[:150], []).append(f"{number} {name} {damage.__name__}")
        shutil.rmtree(folder)
    assert found == {}
