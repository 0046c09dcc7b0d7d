"""The guesses of random layouts of every kind: right, or asked; never wrong without a question."""

from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from capsule_id.experiments.kind import default_registry
from capsule_id.importing import Guess, dimensions_of, guess, propose_entry
from capsule_id.rig.guess import FoundLayout, find_layout
from capsule_id.rig.units import UNKNOWN, factor_to_si
from tests.importing.layouts_of_kinds import SETS, Layouted, layout

KINDS = default_registry()


def guessed(export: Layouted) -> tuple[FoundLayout, Guess | None]:
    found = find_layout(export.content, Path(export.file), dimensions_of(KINDS))
    return found, guess(found, KINDS)


def outcome(export: Layouted, found: FoundLayout, said: Guess | None) -> str:
    """ "right", "wrong" or "asked"."""
    if said is None or "unsure" in (said.confidence, *(one.confidence for one in said.columns.values())):
        return "asked"
    if any(one.asked or one.unit == UNKNOWN for one in said.columns.values()):
        return "asked"
    # One channel of a record may do without another.
    left = set(export.columns) - set(said.columns) - {*KINDS[said.kind].channels}
    if said.kind != export.kind or left or not set(said.columns) <= set(export.columns):
        return "wrong"
    rules = KINDS[said.kind].columns
    right = all(
        np.allclose(found.columns[one.index] * factor_to_si(one.unit, rules[name].si), export.columns[name], rtol=1e-7)
        for name, one in said.columns.items()
    )
    return "right" if right else "wrong"


def study(seeds: range, unknown: bool = False) -> tuple[Counter[str], Counter[str], list[str]]:
    """Outcomes of all layouts, of those whose headers name quantity and unit, and the files of the wrong ones."""
    every, named, wrong = Counter[str](), Counter[str](), list[str]()
    for kind in SETS:
        for seed in seeds:
            export = layout(kind, seed, unknown)
            result = outcome(export, *guessed(export))
            every[result] += 1
            named[result] += export.named
            wrong += [export.file] if result == "wrong" else []
    return every, named, wrong


@pytest.mark.parametrize(
    "seeds",
    [
        pytest.param(range(4), id="36 layouts"),
        pytest.param(range(1000, 1100), id="900 layouts", marks=pytest.mark.slow),
    ],
)
def test_guesses_are_right_or_asked(seeds: range) -> None:
    """Before, at full size: 133 of 900 wrong without a question, and 242 of the 644 that name quantity and unit right."""
    every, named, wrong = study(seeds)
    assert every.total() == len(SETS) * len(seeds)
    assert set(KINDS) == set(SETS)
    assert not wrong
    assert named.total() > 0.4 * every.total()
    assert named["right"] >= 0.8 * named.total()
    assert named["asked"] <= 0.1 * named.total()


@pytest.mark.parametrize("seeds", [range(3), pytest.param(range(2000, 2060), marks=pytest.mark.slow)])
def test_a_name_that_says_nothing_is_asked(seeds: range) -> None:
    """Before, at full size: 57 of 540 wrong without a question."""
    every, _, wrong = study(seeds, unknown=True)
    assert every["asked"] > 0.5 * every.total()
    assert not wrong


def swapped(export: Layouted) -> Layouted:
    """The layout with the headers of its first two columns exchanged."""
    lines = export.content.decode().split("\n")
    mark = next(mark for mark in "\t;," if mark in lines[0])
    cells = lines[0].split(mark)
    cells[0], cells[1] = cells[1], cells[0]
    return replace(export, content="\n".join([mark.join(cells), *lines[1:]]).encode())


def test_headers_above_the_wrong_columns_are_found_wrong() -> None:
    """Negative control: the study sees a guess of the wrong column, though its confidence cannot."""
    exports = [
        layout(kind, seed) for kind in ("motor_current", "support_spring", "dynamic_friction") for seed in range(4)
    ]
    assert not [one for one in exports if outcome(one, *guessed(one)) == "wrong"]
    assert [one for one in exports if outcome(swapped(one), *guessed(swapped(one))) == "wrong"]


PULLS = "1,2.76,1.27,6.30\n2,5.00,2.31,11.20\n3,7.73,3.24,16.10\n4,9.70,4.24,21.00\n"


@pytest.mark.parametrize(
    ("text", "lines"),
    [
        (
            "Trial,Fmax,Fk,FN\n" + PULLS,
            ['columns.force = { from = "Fmax", unit = "?" }', 'columns.normal_force = { from = "FN", unit = "?" }'],
        ),
        ("Trial,Fmax (N),Fk (N),FN (N)\n" + PULLS, ['columns.force = { from = "Fmax (N)", unit = "N" }  # likely: ']),
        (
            "Trial,Pull 1 (N),Pull 2 (N),FN (N)\n" + PULLS,
            [f'# columns.force = {{ from = "Pull {k} (N)"' for k in (1, 2)],
        ),
        ("Trial,Pull (N),Spare (N),FN (N)\n" + PULLS, ["'Spare (N)', fits less well"]),
        (
            "Angle (deg),Pull (N)\n20,3.1\n20,3.3\n20,3.2\n",
            ['slope = { value = 20, unit = "deg" }  # unsure', 'columns.force = { from = "Pull (N)"'],
        ),
        ("Angle (deg)\n20\n20\n20\n", ['# columns.angle = { from = "Angle (deg)", unit = "deg" }  # unsure']),
        ("Tilt (deg),Pull (N)\n20,3.1\n21,3.3\n24,3.2\n", ["# unsure: the columns fit angle and force"]),
        (
            "Pull (N),Kontakt (N)\n3.1,6\n3.3,7\n3.2,8\n",
            ['# columns.normal_force = { from = "Kontakt (N)", unit = "N" }  # unsure'],
        ),
    ],
)
def test_rivals_and_constant_columns_are_left_to_the_user(tmp_path: Path, text: str, lines: list[str]) -> None:
    """Before: Fk as the pulls and a constant angle as tilts, both sure; no rival named that fitted less well."""
    (tmp_path / "pull.csv").write_text(text, encoding="utf-8")
    entry = propose_entry(tmp_path / "pull.csv")
    assert 'kind = "static_friction"' in entry
    for line in lines:
        assert f"\n{line}" in entry or (line[0] in "'#" and line in entry), entry
    assert ('static_friction"  # sure' in entry) == ("Tilt" not in text)
