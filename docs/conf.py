"""How Sphinx builds these pages: ``sphinx-build -W --keep-going -b html docs docs/_build/html``.

The pages are written to be read on GitHub as well, so little beyond plain Markdown is used.
"""

from __future__ import annotations

import re
import shutil
from pathlib import Path
from typing import Any

import mapp_env

HERE = Path(__file__).parent
PLAYGROUND = "playground"  # a page by itself, with scripts: copied as it is
DRAFT = "pettingzoo_third_party.md"  # a pull request that has not been sent: no page of the site

project = "mapp_env"
author = "The mapp_env authors"
project_copyright = author
version = release = mapp_env.__version__

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
exclude_patterns = ["_build", PLAYGROUND, DRAFT]
myst_heading_anchors = 4  # links such as solvers.md#files, as GitHub makes them

autodoc_member_order = "bysource"
# What is drawn with and what adapters adapt to: not needed, and not in the extra `docs`.
autodoc_mock_imports = ["matplotlib", "pygame", "stable_baselines3", "supersuit"]
autodoc_typehints = "none"  # docstrings say types, shapes and units
napoleon_google_docstring = False
napoleon_use_ivar = True
napoleon_use_param = False  # else what is said of several parameters at once is said of each

html_theme = "furo"
html_title = f"mapp_env {release}"
html_static_path = ["_static"]
html_css_files = ["tables.css"]
html_copy_source = False
html_show_sphinx = False


def list_pages(_app: Any, page: str, source: list[str]) -> None:
    """Make the front page's list, a group an item, the navigation of the site."""
    if page == "index":
        for group, links in re.findall(r"^- ([^:\[\n]+):((?:.|\n )*)", source[0], re.MULTILINE):
            pages = "\n".join(re.findall(r"\]\((\w+)\.md\)", links))
            source[0] += f"\n```{{toctree}}\n:hidden:\n:caption: {group}\n\n{pages}\n```\n"


def link_to_playground(_app: Any, _page: str, source: list[str]) -> None:
    """Make links into the playground plain ones: MyST would offer its files for download."""
    source[0] = re.sub(
        rf"(?<!!)\[([^\]]*)\]\(({PLAYGROUND}/[^)\s]*)\)", r'<a href="\2">\1</a>', source[0]
    )


def copy_playground(app: Any, error: Exception | None) -> None:
    """Copy the playground beside the pages, and let its links lead to them."""
    if error is None and app.builder.format == "html" and (HERE / PLAYGROUND).is_dir():
        target = Path(app.outdir) / PLAYGROUND
        shutil.copytree(HERE / PLAYGROUND, target, dirs_exist_ok=True)
        page = target / "index.html"
        text = page.read_text(encoding="utf-8")
        links = re.sub(r'(href="\.\./\w+)\.md', r"\1.html", text)
        page.write_text(links, encoding="utf-8")


def setup(app: Any) -> dict[str, bool]:
    """Hand the functions above to Sphinx."""
    app.connect("source-read", list_pages)
    app.connect("source-read", link_to_playground)
    app.connect("build-finished", copy_playground)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
