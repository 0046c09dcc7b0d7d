"""Times as loggers write them: stamps, clocks that start anew, stamps that repeat; each with what was done, in a finding."""

import datetime as dt
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import xlsxwriter

import capsule_id
from capsule_id import cli
from capsule_id.errors import InputError
from capsule_id.experiments.kind import default_registry, make_experiments
from capsule_id.experiments.lint import lint
from capsule_id.rig.formats.text import is_stamp, seconds_of_stamps
from capsule_id.rig.model import Rig
from capsule_id.rig.times import evened
from capsule_id.views import Finding

HEAD = '[rig]\nname = "r"\nm1 = { value = 1, sd = 0.001, unit = "kg" }\n'
TIME = np.arange(1500) * 1e-3
DISP = 2.0 * np.exp(-3.0 * TIME) * np.cos(2 * np.pi * 12.0 * TIME) + 2e-3 * np.random.default_rng(3).standard_normal(
    1500
)
#: Half a second before midnight at the end of a month.
START = dt.datetime(2024, 2, 29, 23, 59, 59, 500000)
STAMPS = [START + dt.timedelta(milliseconds=k) for k in range(1500)]


def place(row: int) -> tuple[Path, int, int]:
    return Path("t.csv"), row + 2, 1


def seconds(*texts: str) -> list[float]:
    return seconds_of_stamps(texts, ("",), place).tolist()


def rig_of(folder: Path, time: np.ndarray, values: np.ndarray = DISP, lines: str = "") -> Rig:
    rows = "".join(f"{t:.6g},{x:.5f}\n" for t, x in zip(time, values, strict=False))
    (folder / "d.csv").write_text(f"time [s],x_rel [mm]\n{rows}", encoding="utf-8")
    entry = f'[[experiment]]\nkind = "free_vibration"\nfile = "d.csv"\n{lines}\n'
    (folder / "rig.toml").write_text(HEAD + entry, encoding="utf-8")
    return capsule_id.read_rig(folder)


def findings_of(rig: Rig) -> dict[str, Finding]:
    return {found.code: found for found in lint(rig, default_registry(), rig.tables) if found.code.startswith("times.")}


@pytest.mark.parametrize(
    ("texts", "expected"),
    [
        (("12:34:56.789", "12:34:56.790"), [0.0, 0.001]),
        (("12:34:56,789", "12:34:57"), [0.0, 0.211]),
        (("23:59:59.9", "00:00:00.1", "13:00:00", "00:00:00"), [0.0, 0.2, 46800.1, 86400.1]),
        (("59:59.9", "00:00.1"), [0.0, 0.2]),  # minutes and seconds, as Excel shows them
        (("11:59:59.5 PM", "12:00:00.5 am"), [0.0, 1.0]),
        (("12:59:59 PM", "01:00:00 PM"), [0.0, 1.0]),
        (("2024-02-29T23:59:59.5", "2024-03-01T00:00:00.5"), [0.0, 1.0]),
        (("29.02.2024 23:59:59,5", "01.03.2024 00:00:00,5"), [0.0, 1.0]),
        (("02/29/2024 23:59:59", "03/01/2024 00:00:00"), [0.0, 1.0]),
        (("31/01/2024 23:59:59", "01/02/2024 00:00:00"), [0.0, 1.0]),
        (("05/06/2024 23:59:59", "06/06/2024 00:00:00"), [0.0, 1.0]),  # the shorter record
        (("2024-10-27T02:59:59+02:00", "2024-10-27T02:00:00+01:00"), [0.0, 1.0]),
        (("2024-01-01T05:29:59+0530", "2024-01-01T00:00:00Z"), [0.0, 1.0]),
        (("12:00:00.000000001", "12:00:00.000000003"), [0.0, 2e-9]),
        (("", "12:00:00", "12:00:01"), [np.nan, 0.0, 1.0]),
    ],
)
def test_seconds_of_stamps(texts: tuple[str, ...], expected: list[float]) -> None:
    np.testing.assert_allclose(seconds(*texts), expected, rtol=0, atol=1e-12)


@pytest.mark.parametrize("text", ["12:34", "1:2", "12.5", "12:34:56.7.8", "mean", "2024-01-01", "12:34:56 x"])
def test_what_is_no_stamp(text: str) -> None:
    assert not is_stamp(text)
    with pytest.raises(InputError, match=r"t\.csv:3:1: a time stamp must be"):
        seconds("12:00:00", text)


def test_a_date_must_exist() -> None:
    with pytest.raises(InputError, match="the date of a time stamp must exist"):
        seconds("2024-02-30 12:00:00")


WRITTEN: dict[str, Callable[[dt.datetime], str]] = {
    "ISO 8601": lambda s: s.isoformat(timespec="milliseconds") + "+01:00",
    "logger": lambda s: f"{s:%H:%M:%S},{s.microsecond // 1000:03d}",
    "United States": lambda s: f"{s:%m/%d/%Y %I:%M:%S}.{s.microsecond // 1000:03d} {s:%p}",
    "Excel": lambda s: f"{s:%M:%S}.{s.microsecond // 1000:03d}",
    "Germany": lambda s: f"{s:%d.%m.%Y %H:%M:%S}.{s.microsecond // 1000:03d}",
}


@pytest.mark.parametrize("name", WRITTEN)
def test_exports_with_stamps_enter_by_one_command(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Before: "Export times as seconds". Preamble, semicolons, decimal commas, a column of text."""
    rows = "".join(f"{WRITTEN[name](s)};{1e3 * x:.2f};ok\n".replace(".", ",") if name == "logger"
                   else f"{WRITTEN[name](s)};{1e3 * x:.2f};ok\n" for s, x in zip(STAMPS, DISP, strict=True))  # fmt: skip
    file = tmp_path / "Messung 3.csv"
    file.write_text(f"Messung 3\nPrüfer: Li Wei\n\nUhrzeit;Weg (µm);Notiz\n{rows}", encoding="cp1252")
    assert cli.capsule_id(["init", str(tmp_path / "rig"), "--from", str(file)]) == 0
    toml = tmp_path / "rig" / "rig.toml"
    text = toml.read_text(encoding="utf-8")
    assert 'time = { from = "Uhrzeit", unit = "stamp" }  # sure' in text
    assert "#: Not used: 'Notiz'." in text
    toml.write_text(text.replace("# m1 =", "m1 ="), encoding="utf-8")
    assert cli.capsule_id(["check", str(tmp_path / "rig")]) == 0
    assert "1500 time stamps are read as seconds since the first one" in capsys.readouterr().out
    (table,) = capsule_id.read_rig(tmp_path / "rig").tables
    np.testing.assert_allclose(table["time"], TIME, rtol=0, atol=1e-12)
    np.testing.assert_allclose(table["x_rel"], 1e-3 * DISP, rtol=0, atol=1e-8)


def test_dates_of_a_workbook(tmp_path: Path) -> None:
    with xlsxwriter.Workbook(tmp_path / "a.xlsx") as book:
        sheet, form = book.add_worksheet(), book.add_format({"num_format": "yyyy-mm-dd hh:mm:ss.000"})
        sheet.write_row(0, 0, ["Date Time", "x_rel (mm)"])
        for row, (stamp, x) in enumerate(zip(STAMPS, DISP.tolist(), strict=True), 1):
            sheet.write_datetime(row, 0, stamp, form)
            sheet.write_number(row, 1, x)
    assert cli.capsule_id(["init", str(tmp_path / "rig"), "--from", str(tmp_path / "a.xlsx")]) == 0
    toml = tmp_path / "rig" / "rig.toml"
    toml.write_text(toml.read_text(encoding="utf-8").replace("# m1 =", "m1 ="), encoding="utf-8")
    (table,) = capsule_id.read_rig(tmp_path / "rig").tables
    np.testing.assert_allclose(table["time"], TIME, rtol=0, atol=2e-3)  # Excel rounds to a millisecond
    np.testing.assert_allclose(np.diff(table["time"]).mean(), 1e-3, rtol=1e-5)


def test_stamps_under_the_headers_of_the_guide_propose_the_map(tmp_path: Path) -> None:
    rows = "".join(f"{s.isoformat()},{x:.5f}\n" for s, x in zip(STAMPS, DISP, strict=True))
    (tmp_path / "d.csv").write_text(f"time [s],x_rel [mm]\n{rows}", encoding="utf-8")
    (tmp_path / "rig.toml").write_text(
        f'{HEAD}[[experiment]]\nkind = "free_vibration"\nfile = "d.csv"\n', encoding="utf-8"
    )
    with pytest.raises(
        InputError, match=r'd\.csv:2:1: .* add columns = \{ time = \{ from = "time \[s\]", unit = "stamp" \}'
    ):
        capsule_id.read_rig(tmp_path)


@pytest.mark.parametrize("lines", ["scale = 2", "offset = 1", 'minus = "x"'])
def test_stamps_have_no_scale(tmp_path: Path, lines: str) -> None:
    source = f'columns = {{ time = {{ from = "t", unit = "stamp", {lines} }}, x_rel = {{ from = "x", unit = "mm" }} }}'
    with pytest.raises(InputError, match="time stamps have no"):
        rig_of(tmp_path, TIME, lines=source)


def test_numbers_are_no_stamps(tmp_path: Path) -> None:
    source = 'columns = { time = { from = 1, unit = "stamp" }, x_rel = { from = 2, unit = "mm" } }'
    with pytest.raises(InputError, match=r"d\.csv:2:1: a time stamp must be .*, '0'"):
        rig_of(tmp_path, TIME, lines=source)


def test_a_clock_that_starts_anew_begins_a_record(tmp_path: Path) -> None:
    """Before: an error, "write a file of each record"."""
    rig = rig_of(tmp_path, np.tile(TIME[:500], 3), np.concatenate([DISP[:500] * size for size in (1.0, 0.9, 1.1)]))
    assert [table.label for table in rig.tables] == ["d_1", "d_2", "d_3"]
    for k, table in enumerate(rig.tables):
        np.testing.assert_allclose(table["time"], TIME[:500], rtol=1e-12)
        assert (table.rows[0], table.rows[-1]) == (2 + 500 * k, 501 + 500 * k)
    found = findings_of(rig)["times.records"]
    assert (found.level, found.facts["records"], found.facts["lines"]) == ("ok", 3, "502 1002")


def test_missing_readings_belong_to_their_record(tmp_path: Path) -> None:
    values = np.tile(DISP[:500], 2)
    values[[100, 600, 601]] = np.nan
    first, second = rig_of(tmp_path, np.tile(TIME[:500], 2), values).tables
    assert (first.lost.tolist(), second.lost.tolist()) == ([102], [602, 603])


def test_times_held_by_the_clock_are_interpolated(tmp_path: Path) -> None:
    time = TIME.copy()
    time[[101, 102, 700]] = time[[100, 100, 699]]
    rig = rig_of(tmp_path, time)
    np.testing.assert_allclose(rig.tables[0]["time"], TIME, rtol=0, atol=1e-12)
    found = findings_of(rig)["times.held"]
    assert (found.level, found.facts["line"], found.facts["rows"]) == ("warn", 103, 3)
    assert rig.tables[0].drift.sd == 0.0


@pytest.mark.parametrize(("tick", "step"), [(0.0156, 5.0e-3), (0.015625, 1.0e-3), (0.01, 1.0e-3), (1.0, 0.0371)])
@pytest.mark.parametrize("rounding", [np.floor, np.round])
def test_ticks_of_a_clock_give_the_rate_of_the_counts(
    tick: float, step: float, rounding: Callable[[np.ndarray], np.ndarray]
) -> None:
    """The true times lie within a tick; the true step within the stated sd, for a uniform error at most 1.73 of it."""
    true = 0.123 * step + step * np.arange(1200)
    found = evened(tick * rounding(true / tick))
    assert found is not None
    assert found.code == "times.ticks"
    assert np.ptp(found.times - true) < 1.2 * tick
    rate = float(np.mean(np.diff(found.times))) / step - 1.0
    assert abs(rate) <= 1.8 * found.sd
    assert found.sd < tick / np.ptp(true)


def test_the_rate_of_counts_is_uncertain_in_the_fit(tmp_path: Path) -> None:
    rig = rig_of(tmp_path, np.floor(TIME / 0.0156 + 1e-9) * 0.0156)
    (table,) = rig.tables
    found = findings_of(rig)["times.ticks"]
    assert (found.level, found.facts["rows"], found.facts["tick"]) == ("warn", 1403, pytest.approx(0.0156))
    assert table.drift.sd == found.facts["sd"] > 0.0
    assert abs(np.mean(np.diff(table["time"])) / 1e-3 - 1.0) <= 1.8 * table.drift.sd
    assert "rounded to 0.0156 s" in default_messages(found)


def test_the_rate_of_counts_is_no_statement_about_the_clock(tmp_path: Path) -> None:
    """Two records of equal stamps: an error of the rate each, and the clock's own error is in no sd."""
    rig = rig_of(tmp_path, np.tile(np.floor(TIME / 0.0156 + 1e-9) * 0.0156, 2), np.tile(DISP, 2))
    made = make_experiments(rig, "all", default_registry())
    assert [row.name for e in made for row in e.parameters if row.symbol == "clock_drift"] == [
        "clock_drift[d_1]",
        "clock_drift[d_2]",
    ]
    assert {word for e in made for word in e.unstated_errors("k1")} == {"clock"}


def default_messages(found: Finding) -> str:
    from capsule_id.report.messages import finding_text, messages_of

    return finding_text(found, messages_of(default_registry()))


@pytest.mark.parametrize("seed", range(5))
def test_uneven_samples_with_repeated_stamps_stay_an_error(tmp_path: Path, seed: int) -> None:
    """Negative control: no even samples have these stamps, so that no rate can be taken from their number."""
    rng = np.random.default_rng(seed)
    time = np.sort(rng.uniform(0.0, 1.5, 1500))
    assert evened(np.floor(time / 0.01) * 0.01) is None
    with pytest.raises(InputError, match=r"time must increase from row to row.*the times are rounded"):
        rig_of(tmp_path, np.floor(time / 0.01) * 0.01)


def test_rows_lost_between_ticks_stay_an_error() -> None:
    kept = np.delete(TIME, np.arange(600, 640))
    assert evened(np.floor(kept / 0.0156) * 0.0156) is None


def test_copies_of_a_row_are_dropped_and_counted(tmp_path: Path) -> None:
    """Each row twice is no clock of half the rate."""
    for rows in ([100, 101, 500], range(1500)):
        at = np.insert(np.arange(1500), np.array(rows) + 1, rows)
        rig = rig_of(tmp_path, TIME[at], DISP[at])
        np.testing.assert_allclose(rig.tables[0]["time"], TIME, rtol=0, atol=1e-12)
        assert findings_of(rig)["times.copies"].facts["rows"] == len(rows)
