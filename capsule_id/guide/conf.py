"""The documentation as a site: ``python -m sphinx -W -c capsule_id/guide . site/html`` at the top of a clone."""

import json
import re
from pathlib import Path
from typing import Any

project = html_title = "capsule-id"
extensions = ["myst_nb", "numpydoc", "sphinx.ext.autodoc", "sphinx.ext.autosummary"]
root_doc = "capsule_id/guide/index"
include_patterns = ["README.md", "CHANGELOG.md", "capsule_id/guide/**", "notebooks/*.ipynb"]
exclude_patterns = ["**/.*", ".*", "capsule_id/guide/*.py", "capsule_id/guide/*.png"]
html_theme = "furo"
html_show_copyright = False
# The notebooks keep their results; the tests run them.
nb_execution_mode = "off"
myst_heading_anchors = 3
autodoc_default_options = {"members": True}
autodoc_typehints = "none"
numpydoc_show_class_members = False
# File systems that ignore case would hold one of the two.
autosummary_filename_map = {f"capsule_id.{name}": f"capsule_id.{name}-class" for name in ("Fit", "Response")}
# Tables of numbers need no colours.
suppress_warnings = ["misc.highlighting_failure"]


def list_names(app: Any, what: str, name: str, thing: Any, options: Any, lines: list[str]) -> None:
    """Make a list of the lines ``name : meaning`` that stand before the first section of a docstring."""
    end = next((i for i, line in enumerate(lines) if line.startswith("---")), len(lines) + 1) - 1
    made, listing = [], False
    for line in lines[:end]:
        if entry := re.fullmatch(r"([A-Za-z_][\w, ]*) : (.*)", line):
            made += ["", f"- **{entry[1]}**: {entry[2]}"]
            listing = True
        elif listing and line.startswith("    "):
            made.append(f"  {line.strip()}")
        else:
            made += ["", line] if listing else [line]
            listing = False
    lines[:end] = [*made, ""]


def lead_to_the_first_page(app: Any, exception: Exception | None) -> None:
    """The first page of the site stands in a folder; ``index.html`` at the top leads there."""
    page = f'<meta http-equiv="refresh" content="0; url={root_doc}.html"><a href="{root_doc}.html">{project}</a>'
    (Path(app.outdir) / "index.html").write_text(page, encoding="utf-8", newline="\n")


def show_figures(app: Any, page: str, source: list[str]) -> None:
    """Show the figures of notebooks on the page ``gallery``, where its source has links ``[Figure 3](a notebook)``."""

    def shown(link: re.Match[str]) -> str:
        file = Path(app.srcdir, page).parent / link[2]
        if not file.is_file():
            return link[0]  # Sphinx reports it
        cells = json.loads(file.read_text(encoding="utf-8"))["cells"]
        kept = [out.get("data", {}) for cell in cells for out in cell.get("outputs", [])]
        pictures = [data["image/png"] for data in kept if "image/png" in data]
        return f"[![Figure {link[1]}](data:image/png;base64,{pictures[int(link[1]) - 1].strip()})]({link[2]})"

    if page.endswith("/gallery"):
        source[0] = re.sub(r"\[Figure (\d+)\]\((\S+\.ipynb)\)", shown, source[0])


def setup(app: Any) -> None:
    """Connect the three functions above; Sphinx calls this."""
    app.connect("source-read", show_figures)
    app.connect("autodoc-process-docstring", list_names, priority=400)  # before numpydoc
    app.connect("build-finished", lead_to_the_first_page)
