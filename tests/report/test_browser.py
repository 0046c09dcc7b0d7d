"""The page in a browser: no message, no request, sortable, as narrow as a phone, dark, and whole when printed."""

import re
import shutil
import subprocess
from pathlib import Path
from typing import cast

import pytest

from capsule_id.inference.result import Result
from capsule_id.report.html import Picture, render

BROWSER = shutil.which("chromium") or shutil.which("google-chrome") or shutil.which("chromium-browser")
pytestmark = pytest.mark.skipif(BROWSER is None, reason="no Chromium is installed")
#: Runs in the page: opens all parts, sorts the first sortable table twice, then says what it sees in the title.
PROBE = """<script>
for (const part of document.querySelectorAll("details")) part.open = true;
const button = [...document.querySelectorAll("th button")].find(item => item.textContent === "value ± sd");
const table = button.closest("table");
const place = [...button.closest("tr").children].indexOf(button.closest("th"));
const numbers = () => [...table.tBodies[0].rows].map(row => parseFloat(row.children[place].textContent));
button.click();
const up = numbers();
button.click();
const down = numbers();
const rows = JSON.stringify([up, down, document.documentElement.scrollWidth, innerWidth,
  getComputedStyle(document.body).backgroundColor,
  [...document.querySelectorAll(".findings span")].filter(part => part.getBoundingClientRect().right > innerWidth).length,
  [...document.images].filter(image => image.width > Number(image.getAttribute("width"))).length]);
const boxes = [...document.querySelectorAll("svg.rig text")].map(text => text.getBBox());
const crossed = boxes.filter((a, i) => boxes.some((b, j) => i < j && Math.min(a.x + a.width, b.x + b.width) > Math.max(a.x, b.x)
  && Math.min(a.y + a.height, b.y + b.height) > Math.max(a.y, b.y)) || a.x < 0 || a.x + a.width > 520 || a.y + a.height > 262);
document.title = rows + "|" + crossed.length;
</script>"""


def browse(file: Path, *flags: str) -> tuple[str, list[str]]:
    """The document after its scripts, and the messages of its console."""
    words = [
        cast(str, BROWSER),
        "--headless",
        "--no-sandbox",
        "--disable-gpu",
        "--enable-logging=stderr",
        "--dump-dom",
        *flags,
    ]
    words += [f"--user-data-dir={file.parent / 'profile'}", "--allow-file-access-from-files", file.as_uri()]
    done = subprocess.run(words, capture_output=True, text=True, timeout=120, check=False)
    return done.stdout, [line for line in done.stderr.splitlines() if "CONSOLE" in line]


def seen(document: str) -> tuple[list[float], list[float], int, int, str, int, int, int]:
    """What ``PROBE`` has written: sorted numbers, widths, background, cut findings, magnified figures, faults of the sketch."""
    import html
    import json

    (title,) = re.findall(r"<title>(.*?)</title>", document)
    values, crossed = html.unescape(title).split("|")
    return (*json.loads(values), int(crossed))


def test_it_opens_without_a_message_and_sorts(result: Result, drawn: tuple[Picture, ...], tmp_path: Path) -> None:
    file = tmp_path / "report.html"
    file.write_text(render(result, drawn).replace("</body>", PROBE + "</body>"), encoding="utf-8")
    document, messages = browse(file, "--blink-settings=preferredColorScheme=0")
    assert messages == []
    up, down, _, _, background, _, magnified, crossed = seen(document)
    assert up == sorted(up)
    assert down == up[::-1]
    assert len(up) == len(result.summary)
    assert background == "rgb(23, 24, 26)"  # the dark scheme
    assert magnified == 0
    assert crossed == 0  # values of the sketch lie apart and inside


def test_it_fits_a_phone(unclean: Result, drawn: tuple[Picture, ...], tmp_path: Path) -> None:
    """A frame of 390 px: nothing makes the page wider."""
    text = render(unclean, drawn).replace("</body>", PROBE + "</body>")
    (tmp_path / "page.html").write_text(text, encoding="utf-8")
    (tmp_path / "report.html").write_text(
        '<title>none</title><iframe src="page.html" style="width: 390px; height: 800px; border: 0" '
        'onload="document.title = this.contentDocument.title"></iframe>',
        encoding="utf-8",
    )
    document, messages = browse(tmp_path / "report.html")
    assert messages == []
    _, _, width, window, background, cut, *_ = seen(document)
    assert (window, background) == (390, "rgb(255, 255, 255)")
    assert width <= window
    assert cut == 0  # no text of a finding begins or ends outside


#: Opens all parts, enlarges the first figure, says what it sees, goes back by Escape; also texts that are cut or overlap.
ZOOM = """<script>
for (const part of document.querySelectorAll("details")) part.open = true;
const image = document.querySelector("figure img"), before = image.width;
image.click();
const box = image.parentElement.getBoundingClientRect();
const seen = [image.width / before > 2, box.width >= innerWidth - 20, image.parentElement.scrollWidth > box.width];
dispatchEvent(new KeyboardEvent("keydown", {key: "Escape"}));
const boxes = [...document.querySelectorAll("h1, h2, h3, figcaption, .findings .text, .findings .asked, .verdict, td, th, dd")]
  .filter(item => item.textContent.trim() && item.checkVisibility())
  .map(item => [item, item.getBoundingClientRect(), item.closest(".scroll")]);
const cut = boxes.filter(([item, b, scroll]) => !scroll && (b.left < 0 || b.right > innerWidth
  || item.scrollWidth > item.clientWidth + 1));
const crossed = boxes.filter(([one, a, s], i) => !s && boxes.some(([other, b, t], j) => i < j && !t && !one.contains(other)
  && Math.min(a.right, b.right) - Math.max(a.left, b.left) > 1 && Math.min(a.bottom, b.bottom) - Math.max(a.top, b.top) > 1));
document.title = JSON.stringify([...seen, image.width === before, boxes.length > 100, cut.length, crossed.length]);
</script>"""


@pytest.mark.parametrize("width", [390, 1280])
def test_figures_are_enlarged_and_opened_parts_cut_no_text(
    unclean: Result, drawn: tuple[Picture, ...], tmp_path: Path, width: int
) -> None:
    text = render(unclean, drawn).replace("</body>", ZOOM + "</body>")
    (tmp_path / "page.html").write_text(text, encoding="utf-8")
    (tmp_path / "report.html").write_text(
        f'<title>none</title><iframe src="page.html" style="width: {width}px; height: 800px; border: 0" '
        'onload="document.title = this.contentDocument.title"></iframe>',
        encoding="utf-8",
    )
    document, messages = browse(tmp_path / "report.html")
    assert messages == []
    assert re.findall(r"<title>(.*?)</title>", document) == ["[true,true,true,true,true,0,0]"]


def test_few_pages_are_printed_unless_parts_are_opened(
    result: Result, drawn: tuple[Picture, ...], tmp_path: Path
) -> None:
    """Page one, then a picture of each experiment; the appendix is printed as far as it is open."""

    def pages(text: str) -> int:
        (tmp_path / "page.html").write_text(text, encoding="utf-8")
        browse(tmp_path / "page.html", f"--print-to-pdf={tmp_path / 'page.pdf'}")
        return len(re.findall(rb"/Type\s*/Page\b", (tmp_path / "page.pdf").read_bytes()))

    text = render(result, drawn)
    closed = pages(text)
    assert 3 <= closed <= 8
    assert pages(text.replace("<details", "<details open")) > closed + 2


def test_a_message_would_be_noticed(tmp_path: Path) -> None:
    """Negative control: an error of a script and a missing picture are messages."""
    file = tmp_path / "bad.html"
    file.write_text("<title>x</title><script>undefinedFunction()</script>", encoding="utf-8")
    assert len(browse(file)[1]) == 1
