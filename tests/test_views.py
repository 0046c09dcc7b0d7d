"""Texts of findings: counts, and no count before a plural that a single one would contradict."""

import re

import pytest

from capsule_id.experiments.kind import default_registry
from capsule_id.report.messages import messages_of
from capsule_id.views import Message, counted, listed
from tests.cli_tools import ROOT

#: A count before a plural, without the format of counts. The first word after it is the noun or its adjective.
PLURAL = re.compile(
    r"\{(?:len\([^{}]*\)|[a-z_\[\]'.]*(?:count|number|rows|samples|records|settings|lost|shared))[^{}:]*\}"
    r"(?: [a-z-]+)? [a-z]{2,}[^s ]s\b"
)
#: Counts that are two or more: blocks of readings, releases, errors beyond the twentieth, laws and decays compared, rows of a
#: trend, bytes and samples of a record, levels.
SEVERAL = {
    "{len(self.errors)} errors", "{view.samples} samples", "{len(deepest)} levels", "{len(content)} bytes",
    "{count} plateaus", "{len(parts)} plateaus", "{len(view.time)} samples", "{len(view.section_x_rel)} points",
    "{len(names)} parameters", "{samples} samples", "{len(values)} samples", "{records} records",
    "{rows} rows", "{count} friction laws",
    "{len(found.blocks)} blocks", "{len(found)} releases", "{len(several)} releases",
    "{number} such tables", "{len(labels) - 8} others",
}  # fmt: skip


def test_a_count_has_its_plural() -> None:
    message = Message("t", warn="{rows:# row} of {size:.2g} m, {lost:# missing sample}")
    assert message.text("warn", {"rows": 1, "size": 0.1234, "lost": 0}) == "1 row of 0.12 m, 0 missing samples"
    assert message.text("warn", {"rows": 12, "size": 1.0, "lost": 1}) == "12 rows of 1 m, 1 missing sample"
    assert counted(2, "row") == "2 rows"
    assert listed(["a", "b"]) == "a, b"
    assert listed([f"d{i}" for i in range(11)]) == "d0, d1, d2, d3, d4, d5, d6, d7, and 3 others"
    with pytest.raises(KeyError):
        message.text("warn", {"rows": 1})


def test_no_text_writes_one_rows() -> None:
    found = [
        match[0]
        for path in (ROOT / "capsule_id").rglob("*.py")
        for match in PLURAL.finditer(path.read_text(encoding="utf-8"))
    ]
    assert set(found) == SEVERAL
    assert PLURAL.search('f"{len(table.rows)} rows of"')
    assert PLURAL.search('"{number} bench tests are those"')


def test_findings_count_one_row_as_one() -> None:
    messages = messages_of(default_registry())
    text = messages["readings.missing"].text("warn", {"file": "a.csv", "rows": 1, "used": 9, "share": 0.1, "near": 0})
    assert text.startswith("a.csv: the fit drops 1 row with a missing reading and uses 9.")
