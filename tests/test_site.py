"""The documentation as a site: built with warnings as errors, with every page and public name."""

from __future__ import annotations

import importlib.util
import os
import re
import shutil
import subprocess
import sys
from html import unescape
from pathlib import Path
from typing import Any

import pytest

import mapp_env
from mapp_env import rendering

REPOSITORY = Path(__file__).resolve().parents[1]
DOCS = REPOSITORY / "docs"

if importlib.util.find_spec("sphinx") is None:
    pytest.skip("the extra 'docs' is not installed", allow_module_level=True)


def build(docs: Path, site: Path) -> subprocess.CompletedProcess[str]:
    """Build the site in a process of its own, as the documents say it is built."""
    command = [sys.executable, "-m", "sphinx", "-W", "--keep-going", "-q", "-b", "html"]
    return subprocess.run(
        [*command, str(docs), str(site)],
        env={**os.environ, "PYTHONPATH": str(REPOSITORY)},
        capture_output=True,
        text=True,
        check=False,
    )


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Build the site without a warning; return its folder."""
    folder = tmp_path_factory.mktemp("site")
    docs, site = folder / "docs", folder / "site"
    shutil.copytree(DOCS, docs, ignore=shutil.ignore_patterns("_build"))
    for name in ("examples", "README.md", "CHANGELOG.md"):
        (folder / name).symlink_to(REPOSITORY / name)
    done = build(docs, site)
    assert (done.returncode, done.stderr) == (0, "")
    return site


def test_site_is_built_without_a_warning(site: Path) -> None:
    """A page for every document, a docstring for every public name, and all pictures."""
    for page in DOCS.glob("*.md"):
        assert (site / f"{page.stem}.html").is_file(), page.name
    reference = (site / "api.html").read_text(encoding="utf-8")
    for name in mapp_env.__all__:
        if name not in ("__version__", "mapp_v0", "solvers"):
            assert re.search(rf'id="mapp_env\.(\w+\.)*{name}"', reference), name
    for name in rendering.__all__:
        assert re.search(rf'id="mapp_env\.rendering\.(\w+\.)*{name}"', reference), name
    index = unescape((site / "index.html").read_text(encoding="utf-8"))
    assert f"mapp_env {mapp_env.__version__}" in index
    assert 'href="playground/index.html"' in (site / "playground.html").read_text(encoding="utf-8")
    for file in (DOCS / "playground").iterdir():
        assert (site / "playground" / file.name).is_file(), file.name
    playground = (site / "playground" / "index.html").read_text(encoding="utf-8")
    links = re.findall(r'href="\.\./([^"#]+)', playground)
    assert links
    assert all((site / link).is_file() for link in links), links


@pytest.mark.parametrize("width", [390, 1280])
def test_pages_keep_to_the_window(site: Path, browser: Any, width: int) -> None:
    """Nothing makes a page wider than the window, on a phone or beside a table of contents."""
    page = browser.new_page(viewport={"width": width, "height": 800})
    for path in sorted(site.glob("*.html")):
        page.goto(path.as_uri())
        assert page.evaluate("document.documentElement.scrollWidth") <= width, path.name
    page.close()


def test_a_broken_link_is_an_error(tmp_path: Path) -> None:
    """A link to a heading that is not there stops the building of the site."""
    (tmp_path / "docs").mkdir()
    for name in ("conf.py", "_static"):
        source = DOCS / name
        copy = shutil.copytree if source.is_dir() else shutil.copy
        copy(source, tmp_path / "docs" / name)
    page = "# Page\n\n[here](#no-such-heading)\n"
    (tmp_path / "docs" / "index.md").write_text(page, encoding="utf-8")
    done = build(tmp_path / "docs", tmp_path / "site")
    assert done.returncode != 0
    assert "no-such-heading" in done.stderr
