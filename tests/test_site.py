"""The documentation as a site: it is built without a warning, each public name has its page, each link leads somewhere."""

import json
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

import pytest

import capsule_id as cid
from tests.cli_tools import ROOT

pytestmark = pytest.mark.full


class _Page(HTMLParser):
    """The links and the anchors of a page."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.links: list[str] = []
        self.anchors: set[str] = set()
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        for name, value in attrs:
            if name in ("href", "src") and value:
                self.links.append(value)
            if name == "id" and value:
                self.anchors.add(value)


def build(source: Path) -> tuple[Path, subprocess.CompletedProcess[str]]:
    """The command of README in a copy of what the site is made of; the sources of the package are those under test."""
    line = next(one for one in (ROOT / "README.md").read_text(encoding="utf-8").splitlines() if " -m sphinx " in one)
    words = line.partition(" -m sphinx ")[2].split()
    for name in ("README.md", "CHANGELOG.md", "notebooks", "capsule_id/guide"):
        copy = shutil.copytree if (ROOT / name).is_dir() else shutil.copy
        (source / name).parent.mkdir(exist_ok=True)
        copy(ROOT / name, source / name)
    return source / words[-1], subprocess.run(
        [sys.executable, "-m", "sphinx", "-q", *words], cwd=source, capture_output=True, text=True, check=False
    )


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder, done = build(tmp_path_factory.mktemp("docs"))
    assert (done.returncode, done.stderr) == (0, "")
    return folder


def broken(site: Path) -> Iterator[str]:
    """Links within the site that lead to no file, or to no anchor of their page."""
    pages = {path: _Page(path.read_text(encoding="utf-8")) for path in site.rglob("*.html")}
    for path, page in pages.items():
        for link in page.links:
            parts = urlsplit(link)
            if parts.scheme or parts.netloc:
                continue
            aim = (path.parent / unquote(parts.path)).resolve() if parts.path else path
            if not aim.exists() or (parts.fragment and aim in pages and parts.fragment not in pages[aim].anchors):
                yield f"{path.relative_to(site)}: {link}"


def test_every_link_leads_to_a_page_and_its_anchor(site: Path) -> None:
    assert len(list(site.rglob("*.html"))) > 60
    assert list(broken(site)) == []


def test_every_public_name_has_a_page_with_its_text(site: Path) -> None:
    for name in cid.__all__:
        pages = site.glob(f"capsule_id/guide/api/capsule_id.{name}*.html")
        text = next(page for page in pages if page.stem in (f"capsule_id.{name}", f"capsule_id.{name}-class"))
        assert f'id="capsule_id.{name}"' in text.read_text(encoding="utf-8"), name


def test_the_first_page_leads_to_the_guide_and_the_notebooks_show_figures(site: Path) -> None:
    assert "capsule_id/guide/index.html" in (site / "index.html").read_text(encoding="utf-8")
    chapters = list(site.glob("notebooks/*.html"))
    assert len(chapters) == 10
    assert all("<img" in chapter.read_text(encoding="utf-8") for chapter in chapters)


def test_the_gallery_shows_a_figure_of_every_chapter_and_its_title(site: Path) -> None:
    page = (site / "capsule_id" / "guide" / "gallery.html").read_text(encoding="utf-8")
    shown = re.findall(r'<a [^>]*href="[./]*notebooks/(\w+)\.html"[^>]*>(?:<span[^>]*>)?<img', page)
    assert shown == [path.stem for path in sorted((ROOT / "notebooks").glob("*.ipynb"))]
    source = (ROOT / "capsule_id" / "guide" / "gallery.md").read_text(encoding="utf-8")
    for name in shown:
        cells = json.loads((ROOT / "notebooks" / f"{name}.ipynb").read_text(encoding="utf-8"))["cells"]
        assert f"\n#{cells[0]['source'][0]}" in source


def test_a_link_that_leads_nowhere_ends_the_build(tmp_path: Path) -> None:
    """Negative control: one page with a wrong anchor."""
    shutil.copytree(ROOT / "capsule_id" / "guide", tmp_path / "capsule_id" / "guide")
    page = tmp_path / "capsule_id" / "guide" / "limits.md"
    page.write_text(page.read_text(encoding="utf-8") + "\n[x](checks.md#no-such-part)\n", encoding="utf-8")
    words = ["-q", "-W", "-c", "capsule_id/guide", "-D", "root_doc=capsule_id/guide/limits", ".", "html"]
    done = subprocess.run(
        [sys.executable, "-m", "sphinx", *words], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert done.returncode != 0
    assert "no-such-part" in done.stderr
