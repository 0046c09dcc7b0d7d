"""The page stands alone, says loudly what must be said, and shows every number of the result."""

import dataclasses
import html
import re
from dataclasses import replace
from html.parser import HTMLParser
from xml.etree import ElementTree

import numpy as np
import pandas as pd
import pytest
from matplotlib.figure import Figure

from capsule_id.api import read_rig
from capsule_id.experiments.base import LEVEL
from capsule_id.experiments.forced_run.experiment import LARGEST_GROWTH
from capsule_id.experiments.friction_variants import DOUBTFUL, FACTOR
from capsule_id.experiments.kind import Registry, default_registry
from capsule_id.inference.checks.posterior import AGREEMENT_LEVEL, FARTHEST_MAXIMUM, PRIOR_PULL
from capsule_id.inference.checks.settings import ORDER_LEVEL, SMALLEST_CORRELATION
from capsule_id.inference.result import Provenance, Result
from capsule_id.records.tones import SIGNIFICANT, VISIBLE
from capsule_id.report.columns import printed_table, table_rows, verdict_text
from capsule_id.report.figures.style import figure_of, new_axes, svg
from capsule_id.report.html import Picture, pictures, render
from capsule_id.report.messages import QUESTIONS, TERMS, TRUST, finding_text, messages_of, question_of
from capsule_id.views import Finding, Message, ResultTable, Text
from tests.cli_tools import DATA
from tests.report.conftest import COLOURED, OUTLIER

EMPTY = {"meta", "img", "br"}


class Page(HTMLParser):
    """Collects what the page is made of, and checks that every element is closed in order."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.attributes: list[tuple[str, str]] = []
        self.words: list[str] = []
        self.open: list[str] = []
        self.feed(text)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.attributes += [(key, value or "") for key, value in attrs]
        if tag not in EMPTY:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.words.append(data)

    @property
    def text(self) -> str:
        return " ".join(" ".join(self.words).split())


@pytest.fixture(scope="module")
def page(result: Result, drawn: tuple[Picture, ...]) -> str:
    return render(result, drawn)


def test_self_contained(page: str, drawn: tuple[Picture, ...]) -> None:
    parsed = Page(page)
    assert not re.search(r"https?:|url\(|@import|//[a-z]", re.sub(r"base64,[A-Za-z0-9+/=]+", "", page))
    assert not {"link", "iframe", "object", "embed", "form"} & set(parsed.tags)
    assert page.count("<script") == page.count("<script>\n") == 1  # inline, so that tables can be sorted
    anchors = [value[1:] for key, value in parsed.attributes if key == "href"]
    assert set(anchors) <= {value for key, value in parsed.attributes if key == "id"}
    sources = [value for key, value in parsed.attributes if key == "src"]
    assert len(sources) == len(drawn)
    assert all(
        source.startswith(("data:image/png;base64,iVBORw0KGgo", "data:image/svg+xml;base64,")) for source in sources
    )
    assert not [key for key, _ in parsed.attributes if key.startswith("on")]


def test_the_numbers_of_a_line_figure_are_those_of_its_axes() -> None:
    """Before: every tick of this axis read 0.00, because the places of lines and the texts were shortened alike."""
    ax = new_axes()
    ax.plot([0.0, 1.0], [0.0, 0.008])
    ax.set_title("k = 1.23456")
    (figure := figure_of(ax)).canvas.draw()
    written = {text.get_text() for text in (*ax.get_xticklabels(), *ax.get_yticklabels(), ax.title)}
    assert {"0.001", "0.007", "k = 1.23456"} <= written
    shown = set(re.findall(r"<text[^>]*>([^<]*)</text>", svg(figure, 1_000_000).decode()))
    assert {"0.001", "0.007", "k = 1.23456"} <= shown <= written


def test_a_cloud_of_points_is_not_written_as_svg_first(monkeypatch: pytest.MonkeyPatch) -> None:
    """The SVG of 100,000 readings took 100 MB, and was then dropped for its size."""
    line, points = new_axes(), np.linspace(0.0, 1.0, 3000)
    line.plot(points, points**2)
    assert svg(figure_of(line), 60_000)
    cloud = new_axes()
    cloud.plot(points, points**2, ls="", marker=".")
    with monkeypatch.context() as patched:
        patched.setattr(Figure, "savefig", None)
        assert svg(figure_of(cloud), 60_000) == b""
    assert len(svg(figure_of(cloud), 1_000_000)) > 40 * len(points)
    # The contours of a corner plot are such a cloud too.
    area = new_axes()
    area.fill_between(points, points**2)
    with monkeypatch.context() as patched:
        patched.setattr(Figure, "savefig", None)
        assert svg(figure_of(area), 60_000) == b""
    assert svg(figure_of(area), 1_000_000)


def test_lines_are_svg_in_the_colours_of_the_page_and_load_nothing(page: str, drawn: tuple[Picture, ...]) -> None:
    """A cloud of points stays PNG; the page grows by no more than a half."""
    by_name = {picture.name: picture for picture in drawn}
    assert all(by_name[name].svg for name in ("friction", "support_spring_soft"))
    assert not any(by_name[name].svg for name in ("free_vibration_1", "corner"))
    for picture in drawn:
        root = ElementTree.fromstring(picture.svg or b"<svg/>")
        values = [value for item in root.iter() for key, value in item.attrib.items() if not key.startswith("xmlns")]
        assert not [value for value in values if "http" in value or value.startswith(("#ffffff", "fill: #ffffff"))]
        assert b": #000000" not in picture.svg  # black would vanish on a dark page
        assert b"url(" not in picture.svg.replace(b"url(#", b"")
        assert len(picture.svg) <= 1.5 * len(picture.png)
    assert b"prefers-color-scheme: dark" in by_name["friction"].svg
    assert "synthetic data" in by_name["friction"].svg.decode()


def test_every_number_of_the_table_is_there(result: Result, page: str) -> None:
    text = Page(page).text
    row = result.summary.loc["k1"]
    for number in ("1386.0", "1421.3 ± 3.0", f"{row['value']:.1f} ± 3.1", f"{row['lower']:.1f} to {row['upper']:.1f}"):
        assert number in text
    assert "0.302 ± 0.033" in text
    # The nuisance in micrometres, its unit beside it.
    assert re.search(r"µm \d\d\.\d\d ± 0\.46 trusted \d\d\.\d\d to \d\d\.\d\d (– )?20\.20 ± 0\.45", text)
    assert f"{row['value']:.1f}(31) N/m" in text
    assert page.count("<td>weighed</td>") == 2


def test_uninformed_parameter_stands_out(result: Result, drawn: tuple[Picture, ...]) -> None:
    summary = result.summary.copy()
    summary.loc["K", "informed"] = False
    page = render(replace(result, summary=summary), drawn)
    assert page.count('<td class="warn">no</td>') == 1


def test_symbols_are_set_as_in_the_paper(page: str) -> None:
    for symbol in (
        "<var>k</var><sub>1</sub>",
        "<var>v</var><sub>s</sub>",
        "<var>μ</var>",
        '<span class="label">soft</span>',
    ):
        assert symbol in page


def test_a_finding_has_text_beside_colour(unclean: Result) -> None:
    page = render(unclean, ())
    cells = re.findall(r'<li><span class="chip (\w+)">([^<]+)</span> <b>([^<]+)</b>', page)
    words = {"ok": "✓ ok", "warn": "! warning", "fail": "✗ failed"}
    assert all(words[level] == word for level, word, _ in cells)
    assert [(level, check) for level, _, check in cells] == [
        ("fail", "stated errors"), ("warn", "parameters informed"),
        ("ok", "starts agree"), ("ok", "chains converged"), ("ok", "residuals white"), ("ok", "linearity"),
        ("fail", "residuals white"), ("warn", "outliers"),
    ]  # fmt: skip


def test_what_is_ok_is_one_line(unclean: Result) -> None:
    """Closed: the number and the titles; opened: the texts."""
    (part,) = re.findall(r'<details class="passed">(.*?)</details>', render(unclean, ()), re.DOTALL)
    line, _, opened = part.partition("</summary>")
    assert Page(line + "</summary>").text == "✓ 4 ok starts agree, chains converged, residuals white, linearity"
    assert "all 6 starts of the point fit ended at the same maximum" in opened
    assert "motor_current" in opened


def test_a_check_shows_question_number_and_limit(unclean: Result) -> None:
    text = Page(render(unclean, ())).text
    assert "Has the sampler converged? R-hat 1.0020, limit 1.01; 61 autocorrelation times, at least 20; " in text
    assert "Does a reading stand apart? 4.1 sd off (p = 0.0001), limit p = 0.002 over all readings. " in text
    assert question_of(Finding("decays.halves", "fail", {"name": "k1", "z": 4.25})).startswith(
        "Do both halves of the record agree? k1: 4.2 sd apart, limit 4"
    )
    # The question alone where the number is not among the facts, and nothing for other codes.
    assert question_of(Finding("decays.halves", "ok", {"labels": "a"})) == "Do both halves of the record agree?"
    assert question_of(Finding("own", "fail", {"p": 0.1})) == ""


def test_the_limits_of_the_questions_are_those_of_the_checks() -> None:
    assert QUESTIONS.keys() <= messages_of(default_registry()).keys()
    assert all(text.partition("{")[0].count("?") == 1 for text in QUESTIONS.values())
    said = {
        code: set(map(float, re.findall(r"(?<![\w.])\d+(?:\.\d+)?", re.sub(r"{.*?}", "", text))))
        for code, text in QUESTIONS.items()
    }
    limits = {
        "sample.maximum": {FARTHEST_MAXIMUM}, "priors.tails": {PRIOR_PULL}, "trials.loads": {ORDER_LEVEL},
        "trials.order": {SMALLEST_CORRELATION, ORDER_LEVEL}, "trials.tables": {ORDER_LEVEL}, "trials.speeds": {ORDER_LEVEL},
        "bench_and_runs.agree": {AGREEMENT_LEVEL}, "runs.predictable": {LARGEST_GROWTH},
        "decays.halves": {SIGNIFICANT, VISIBLE}, "friction.variants": {FACTOR, DOUBTFUL}, "starts.agree": {0.0},
        "springs.cantilever": {LEVEL, 3.0},
    }  # fmt: skip
    for code, numbers in said.items():
        assert numbers == limits.get(code, {LEVEL} if numbers else set()), code


def before_contents(text: str) -> str:
    return text.partition("<nav")[0]


def with_shares(result: Result, **shares: dict[str, float]) -> Result:
    return replace(result, point_fit=replace(result.point_fit, shares=shares))


def test_page_one_has_the_picture_that_warns_or_convinces(
    result: Result, unclean: Result, drawn: tuple[Picture, ...]
) -> None:
    def first(of: Result) -> tuple[list[str], str]:
        text = before_contents(render(of, drawn))
        return re.findall(r'alt="([^.]*)\.', text), Page(text + "</body></html>").text

    titles, text = first(unclean)
    assert titles == ["Free vibration free_vibration_2"]
    assert "The worst failed check: residuals white." in text
    # The one that is least probable; a certain fault before it.
    more = Finding("outliers", "fail", {**OUTLIER, "p": 1e-40}, "support_spring_stiff")
    assert first(replace(unclean, findings=(more, *unclean.findings)))[0] == ["Support spring stiff"]
    certain = Finding("lines.rise", "fail", {}, "motor_current")
    assert first(replace(unclean, findings=(more, *unclean.findings, certain)))[0] == ["Current against force"]
    shares = {"k1": {"free_vibration_1": 0.3}, "c": {"free_vibration_1": 0.4}, "K": {"motor_current": 0.6}}
    titles, text = first(with_shares(result, **shares))
    assert titles == ["Free vibration free_vibration_1"]
    assert "No check failed. The readings of this experiment decide more than those of any other." in text
    doubt = Finding("friction.variants", "warn", {}, "motor_current", ("K",))
    titles, text = first(with_shares(replace(result, findings=(doubt,)), **shares))
    assert titles == ["Current against force"]
    assert "A warning concerns K: friction law." in text
    # A failed check of no experiment: the picture of what informs its parameters.
    conflict = Finding("sample.modes", "fail", {"name": "K"}, parameters=("K",))
    titles, text = first(with_shares(replace(result, findings=(conflict,)), **shares))
    assert titles == ["Current against force"]
    assert "Failed: maximum and sample. This experiment informs the parameters concerned most." in text
    assert first(replace(result, comparisons=()))[0] != []
    assert 'id="picture"' not in render(result, ())


def test_a_failed_channel_is_the_picture_of_its_run(result: Result) -> None:
    """One picture of each experiment; that of the channel that a failed check names, not of the first one."""
    run = [
        Picture(f"run_1_{name}", "measured", name, "", 900, 500, b"", group="run_1") for name in ("x_rel", "current")
    ]
    assert before_contents(render(result, run)).count('alt="x_rel.') == 1
    bad = Finding("residuals.white", "fail", {**COLOURED, "record": "run_1 current"}, "run_1")
    page = render(replace(result, findings=(bad,)), run)
    assert before_contents(page).count('alt="current.') == 1
    assert re.search(r"<summary><b>run_1</b> 1 more figure</summary>.*alt=\"x_rel\.", page, re.DOTALL)


def test_findings_of_tables_with_a_shared_panel_stand_beside_it(result: Result, drawn: tuple[Picture, ...]) -> None:
    bad = Finding("outliers", "warn", OUTLIER, "static_friction")
    page = Page(render(replace(result, rig=read_rig(DATA), findings=(bad,)), drawn)).text
    assert re.search(r"friction ! warning .{,400}! warning outliers Does a reading stand apart", page)


def test_a_table_with_the_name_of_a_check_has_no_findings_of_the_whole_fit(result: Result) -> None:
    rig = read_rig(DATA)
    table = replace(rig.tables[0], label="priors")
    named = replace(result, rig=replace(rig, tables=(table,)), findings=(Finding("priors.tails", "warn", {}),))
    page = Page(render(named, [Picture("x", "measured", "t", "c", 9, 9, b"", group="priors")])).text
    assert "The whole fit ! warning" in page
    assert "priors ✓ ok" in page


def test_terms_of_the_questions_are_explained() -> None:
    words = {"R-hat", "autocorrelation time", "chi-square", "sd", "Pareto shape", "prior", "white", "residual"}
    asked = " ".join(QUESTIONS.values()).lower()
    assert all(word.lower() in asked for word in words)
    assert words <= TERMS.keys()


def sketch_of(result: Result) -> str:
    (svg,) = re.findall(r"<svg.*?</svg>", render(result, ()), re.DOTALL)
    return " ".join(re.sub(r"<[^>]*>", " ", svg).split())


def test_the_sketch_has_the_parts_of_the_fit_with_their_values(result: Result) -> None:
    rows = {row.name: row.quoted for row in table_rows(result.summary)}
    sketch = sketch_of(result)
    for name, symbol in (("k1", "k 1"), ("c", "c"), ("m1", "m 1"), ("m2", "m 2"), ("mu", "μ")):
        assert f"{symbol} {rows[name]}" in sketch
    assert "k 2 3 springs" in sketch
    assert "G" not in sketch
    springs = replace(result, summary=result.summary.loc[["k2[soft]", "mu"]])
    assert sketch_of(springs) == f"k 2 {rows['k2[soft]']} N/m μ {rows['mu']}"
    gone = result.summary.loc[["K", "v_s"]]
    assert "<svg" not in render(replace(result, summary=gone), ())


def test_every_finding_is_there_in_full_worst_first(unclean: Result) -> None:
    text = Page(render(unclean, ())).text
    messages = messages_of(unclean.registry)
    places = [text.index(" ".join(finding_text(finding, messages).split())) for finding in unclean.findings]
    assert max(places[-2:]) < min(places[:-2])


def test_the_first_screen_has_value_trust_and_next_step(result: Result, unclean: Result, page: str) -> None:
    """Before the contents list: the verdict, a row per parameter, what to do."""
    text = render(unclean, ())
    first = Page(text.partition("<nav")[0] + "</body></html>").text
    assert "Verdict: not trusted; failed: stated errors, residuals white; 2 warnings." in first
    assert 'class="untrusted"' in text
    for row in table_rows(unclean.summary):
        assert row.plus_minus("value", "sd", row.decimals) in first
    assert "What would improve it Correct the whole fit. expected " in first
    assert "Correct experiment free_vibration_2." in first
    assert "Quote trusted numbers only." in first
    clean = Page(page.partition("<nav")[0] + "</body></html>").text
    assert f"trusted : {TRUST['trusted']}" in clean.replace("trusted:", "trusted :")
    assert TRUST["not judged"] not in clean
    warned = sum(finding.level == "warn" for finding in result.findings)
    assert f"V{verdict_text('trusted', [('warn', 'a')] * warned)[1:]}." in clean
    assert 'class="untrusted"' not in page


def test_a_number_that_must_not_be_quoted_is_named_in_the_verdict(unclean: Result) -> None:
    summary = unclean.summary.copy()
    summary.loc["c", "trust"] = "not trusted"
    text = Page(render(replace(unclean, summary=summary), ())).text
    assert "Do not quote c; the other numbers stand as marked." in text
    assert "see the findings. Not to be quoted: c. The sd contains no error of" in methods_of(
        replace(unclean, summary=summary)
    )
    assert "Not to be quoted" not in methods_of(unclean)
    assert TRUST["not trusted"] in before_contents(render(replace(unclean, summary=summary), ()))
    assert "Do not quote" not in Page(render(unclean, ())).text


def test_a_shared_panel_has_the_level_of_its_checks(result: Result, drawn: tuple[Picture, ...]) -> None:
    """The friction panel belongs to no single table; a failed check of friction must not leave it marked ok."""
    facts = {"labels": "s", "name": "eq. (1)", "factor": 165.0, "line": 'friction = "constant"', "shift": 0.2}
    for level, word in (("fail", "✗ failed"), ("ok", "✓ ok")):
        finding = Finding("friction.variants", level, facts | {"count": 3, "simplest": "eq. (1)"})
        text = Page(render(replace(result, findings=(finding,)), drawn)).text
        assert f"friction {word} Its picture stands on the first page" in text


def test_the_methods_paragraph_counts_the_fitted_experiments(result: Result) -> None:
    fitted_bench = replace(result, rig=read_rig(DATA))
    text = methods_of(fitted_bench)
    assert "3 x free vibration" in text
    assert "forced run" not in text
    everything = replace(fitted_bench, provenance=replace(fitted_bench.provenance, experiments="all"))
    assert "4 x forced run" in methods_of(everything)


def methods_of(result: Result) -> str:
    """The methods paragraph of the page, in one line."""
    (text,) = re.findall(r'<pre id="copy-methods" tabindex="0">(.*)</pre>', render(result, ()))
    return html.unescape(text)


def test_the_smallest_sample_size_is_that_of_the_check(result: Result) -> None:
    """Before: the table showed another, larger number than the check that it passed by."""
    summary = result.summary.assign(ess=9000.0, ess_bulk=4800.0, ess_tail=4700.0)
    cells = [cell for _, cells in printed_table(summary, "html")[1] for cell in cells]
    assert cells.count("4700") == len(summary)
    assert "9000" not in cells


def test_terms_of_the_first_screen_are_explained(page: str) -> None:
    assert '<a href="#terms">' in page.partition("<nav")[0]
    assert "AR(1)" in TERMS["AR(1), ARMA"]
    assert all(f"<dt>{term}</dt><dd>{meaning}</dd>" in html.unescape(page) for term, meaning in TERMS.items())


def test_the_truth_of_a_synthetic_rig_stands_beside_the_estimate(result: Result) -> None:
    value, sd = (float(result.summary.at["k1", column]) for column in ("value", "sd"))
    text = Page(render(replace(result, truth={"k1": value + 2.0 * sd}), ())).text
    assert f"{value + 2.0 * sd:.1f} (−2.0 sd)" in text
    assert "truth" not in Page(render(result, ())).text


def test_one_picture_of_each_experiment_is_open(result: Result, drawn: tuple[Picture, ...]) -> None:
    """Everything else is in closed parts, and no picture is there twice."""
    bad = tuple(Finding("outliers", "warn", OUTLIER, item.label) for item in result.comparisons)
    for findings in ((), bad):
        page = render(replace(result, findings=findings), (*drawn, *drawn))
        assert not re.search(r"<details[^>]* open", page)
        shown = re.sub(r"<details.*?</details>", "", page, flags=re.DOTALL)
        assert shown.count("<img") == len({picture.group for picture in drawn} - {""})
        assert page.count("<img") == 2 * len(drawn)
    tables = re.sub(r"<details.*?</details>", "", page, flags=re.DOTALL).count("<table")
    assert tables == 1


def test_alternative_texts_say_what_is_seen(drawn: tuple[Picture, ...]) -> None:
    alts = {picture.name: picture.alt for picture in drawn}
    assert re.search(
        r"8 readings from 0\.1 to 2; curves: this fit; \d+ % of the residuals within", alts["motor_current"]
    )
    assert "strongest correlation" in alts["corner"]
    assert all(len(alt) > 30 for alt in alts.values())


def test_texts_to_copy_hold_the_numbers(result: Result, page: str) -> None:
    text = html.unescape(page)
    row = next(row for row in table_rows(result.summary) if row.name == "k2[soft]")
    number = row.plus_minus("value", "sd", row.decimals).replace("±", r"\pm")
    assert rf"$k_2$ (soft) & N/m & ${number}$ & trusted \\" in text
    assert "title = {Experimental verification of the vibro-impact capsule model}" in text
    assert "author = {Liu, Yang and Pavlovskaia, Ekaterina and Wiercigroch, Marian}" in text
    assert "4 independent ensembles of 8 walkers" in text
    for equation in ("F_s = μ/2", "m₁ X₁″ = P_d cos(Ω t) − f"):
        assert equation in text


def test_date_and_command_are_shown_where_they_are_known(result: Result) -> None:
    made = ("2020-02-20T20:20:20+00:00", "fit-params data/")
    text = Page(render(replace(result, provenance=replace(result.provenance, made=made)), ())).text
    assert "date 2020-02-20T20:20:20+00:00 command fit-params data/" in text


def test_synthetic_is_said_loudly_and_only_when_true(page: str, unclean: Result) -> None:
    assert page.index("SYNTHETIC RIG") < page.index("<h1>")
    assert page.count("synthetic data</span>") >= 3  # beside every table
    assert "ynthetic" not in re.sub(r"base64,[A-Za-z0-9+/=]+", "", render(unclean, ()))


@pytest.mark.full
def test_point_fit_only(unsampled: Result) -> None:
    text = Page(render(dataclasses.replace(unsampled, findings=()), pictures(unsampled))).text
    assert "nothing was sampled" in text
    assert "1421.3 ± 3.0" in text
    for absent in ("R-hat", "95 % interval", "Corner plot", "The sample"):
        assert absent not in text
    assert not re.search(r"\bnan\b", text, re.IGNORECASE)


@pytest.mark.parametrize(
    "bad", ['<script>alert("x")</script>', "<img src=x onerror=y>", "&lt;b&gt;", '"><b>', "{{ 7 * 7 }}"]
)
def test_hostile_text_is_escaped(result: Result, bad: str) -> None:
    summary = result.summary.rename(index={"k2[soft]": f"k2[{bad}]"})
    summary["meaning"] = bad
    frame = pd.DataFrame({bad: [bad]}, index=[bad])
    hostile = dataclasses.replace(
        result, summary=summary, notes=(ResultTable(bad, frame),), findings=(Finding(bad, "fail", {bad: bad}, bad),),
        rig=dataclasses.replace(result.rig, name=bad), provenance=Provenance(0, "all", bad, {bad: bad}, {bad: bad}),
    )  # fmt: skip
    picture = Picture("x", "measured", bad, bad, 10, 10, b"")
    page = render(hostile, (picture,))
    parsed = Page(page)
    allowed = set(Page(render(result, (Picture("x", "measured", "t", "c", 10, 10, b""),))).tags)
    assert set(parsed.tags) <= allowed
    assert parsed.text.count(" ".join(bad.split())) >= 10
    assert not [key for key, _ in parsed.attributes if key.startswith("on")]


def test_notes_show_cells_and_dashes(page: str) -> None:
    text = Page(page).text
    assert "all rows 56410 46" in text
    assert "mu log-normal 0.4 –" in text
    assert "<NA>" not in text


def test_note_frames_of_every_kind(result: Result) -> None:
    frame = pd.DataFrame({"text": ["a", None], "number": [-1.23456789e-7, np.nan], "count": [1234567, 2]})
    page = render(dataclasses.replace(result, notes=(ResultTable("t", frame), ResultTable("e", frame.iloc[:0]))), ())
    text = Page(page).text
    assert "a −1.2346e−07 1234567" in text
    assert "– – 2" in text


def test_provenance_is_complete_and_undated(result: Result, page: str) -> None:
    text = Page(page).text
    for digest in result.rig.files.values():
        assert digest in text
    assert "0.10.2" in text
    assert "seed 0 experiments bench" in text
    assert not re.search(r"\b20\d\d-\d\d", text)


def test_minimal_result(result: Result) -> None:
    bare = dataclasses.replace(
        result, posterior=None, findings=(), comparisons=(), notes=(), pointwise=None, nuisances=result.nuisances.iloc[:0],
        summary=result.summary.iloc[:1],
    )  # fmt: skip
    text = Page(render(bare, pictures(bare))).text
    assert "Scatters and noise" not in text
    assert "Notes" not in text


@pytest.mark.parametrize(
    ("words", "error"),
    [
        ("{missing} of them", "KeyError: 'missing'"),
        ("{} of them", "IndexError"),
        ("{number:.1q}", "ValueError"),
        ("{pair[2]}", "IndexError"),
        ("{pair:.2f}", "TypeError"),
        ("{number.size}", "AttributeError"),
        (lambda facts: None, "TypeError: the text must be a string, found None"),
        (lambda facts: f"{1 / facts['nought']}", "ZeroDivisionError"),
    ],
)
def test_faulty_words_give_the_facts(result: Result, words: Text, error: str) -> None:
    """A faulty text of a kind must not end the run after the sampling."""
    own = replace(result.registry["motor_current"], messages={"own": Message("own", fail=words, caption=words)})
    facts = {"number": 3, "pair": (1, 2), "nought": 0}
    faulty = replace(
        result,
        registry=Registry((own,)),
        findings=(Finding("own", "fail", facts, "run_1"),),
        notes=(ResultTable("own", pd.DataFrame({"a": [1]}), facts),),
    )
    said = [
        " ".join(text.split()) for text in re.findall(r"the words of own are [^<]*", html.unescape(render(faulty, ())))
    ]
    assert len(said) == 3  # the next step, the finding and the caption
    for text in said:
        assert f"faulty ({error}" in text
        assert "the facts: number = 3, pair = (1, 2), nought = 0" in text


def test_an_unknown_level_is_refused() -> None:
    with pytest.raises(ValueError, match=r"level of finding own must be one of .*; found 'failed'"):
        Finding("own", "failed")  # type: ignore[arg-type]
