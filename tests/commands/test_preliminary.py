"""The point fit is on the console and in ``DIR.partial`` while the sample is drawn."""

from pathlib import Path
from typing import Any

import pytest

import capsule_id as cid
from capsule_id.api import Fit
from capsule_id.cli import fit_params
from capsule_id.inference import pipeline
from capsule_id.rig.model import Rig
from tests.cli_tools import small_rig


@pytest.fixture
def pages(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The current directory holds ``rig``; its report at the beginning of the sampling, empty where there is none."""
    monkeypatch.chdir(small_rig(tmp_path / "rig").parent)
    found, sample = list[str](), pipeline.sample

    def sampled(*arguments: Any) -> Any:
        page = Path("results/small.partial/report.html")
        found.append(page.read_text(encoding="utf-8") if page.exists() else "")
        return sample(*arguments)

    monkeypatch.setattr(pipeline, "sample", sampled)
    return found


@pytest.mark.full
def test_a_fit_with_runs_shows_its_point_fit_first(
    pages: list[str], capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Rig, "has_runs", property(lambda _: True))
    fit_params(["rig", "--max-steps", "200"])
    (page,) = pages
    assert "the sample is still to be drawn" in page
    assert "Wait for the end of fit-params" in page
    out, error = capfd.readouterr()
    table = error.partition("point fit, before the sample; report: results/small.partial/report.html\n")[2]
    (row,) = (line for line in table.splitlines() if line.startswith("mu "))
    fitted = cid.fit(cid.read_rig("rig"), budget=None).summary.loc["mu"]
    assert row.split()[:5] == ["mu", "1", f"{fitted['value']:.4f}", "±", f"{fitted['sd']:.4f}"]
    assert "not judged" in row
    assert "before the sample" not in out
    final = Path("results/small/report.html").read_text(encoding="utf-8")
    assert "the sample is still to be drawn" not in final
    assert not Path("results/small.partial").exists()


@pytest.mark.full
def test_a_quiet_fit_and_one_of_bench_tests_alone_do_not(
    pages: list[str], capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    fit_params(["rig", "--max-steps", "200"])
    assert pages == [""]
    assert "before the sample" not in capfd.readouterr().err
    monkeypatch.setattr(Rig, "has_runs", property(lambda _: True))
    fit_params(["rig", "--max-steps", "200", "--quiet"])
    assert "the sample is still to be drawn" in pages[1]
    assert capfd.readouterr().err.count("before the sample") == 0


@pytest.mark.full
def test_the_point_fit_changes_no_number(pages: list[str]) -> None:
    rig, first = cid.read_rig("rig"), list[Fit]()
    shown = cid.fit(rig, budget=200, preliminary=first.append)
    plain = cid.fit(rig, budget=200)
    assert [one.posterior for one in first] == [None]
    assert first[0].trust == "not judged"
    assert (first[0].comparisons, first[0].records) == ((), ())
    assert [f.level for f in first[0].findings if f.code == "sample.unfinished"] == ["warn"]
    assert not any(f.code == "chains.converged" for f in first[0].findings)
    assert shown.summary.equals(plain.summary)
    assert shown.findings == plain.findings
    cid.fit(rig, budget=None, preliminary=first.append)
    assert len(first) == 1
    assert len(pages) == 2
