"""The documentation as a site: built with warnings as errors, with every page and public name."""

from __future__ import annotations

import importlib.util
import io
import os
import re
import shutil
import subprocess
import sys
import tomllib
from html import unescape
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

import mapp_env
from mapp_env import rendering

REPOSITORY = Path(__file__).resolve().parents[2]
DOCS = REPOSITORY / "docs"

if importlib.util.find_spec("sphinx") is None:
    pytest.skip("the extra 'docs' is not installed", allow_module_level=True)


DRAFT = "pettingzoo_third_party"  # a document that is no page

# Sphinx where nothing can be imported but what the extra `docs` installs.
ALONE = """
import sys
from importlib.abc import MetaPathFinder

class Missing(MetaPathFinder):
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in sys.argv[1].split():
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)

sys.meta_path.insert(0, Missing())
from sphinx.cmd.build import main
sys.exit(main(sys.argv[2:]))
"""


def other_extras() -> list[str]:
    """Return the modules of the libraries that other extras than `docs` install for users."""
    project = tomllib.loads((REPOSITORY / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    wanted = {
        re.split(r"[^\w-]", requirement)[0]
        for extra, requirements in project["optional-dependencies"].items()
        if extra not in ("docs", "test")
        for requirement in requirements
    }
    modules = {"pygame-ce": "pygame"}
    return sorted(modules.get(name, name.replace("-", "_")) for name in wanted - {"mapp-env"})


def build(docs: Path, site: Path) -> subprocess.CompletedProcess[str]:
    """Build the site in a process of its own, as the documents say it is built."""
    command = [sys.executable, "-c", ALONE, " ".join(other_extras())]
    return subprocess.run(
        [*command, "-W", "--keep-going", "-q", "-b", "html", str(docs), str(site)],
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
    """A page for every document, a docstring for every public name, and all pictures.

    The extra `docs` is enough for that: figures, windows and trainers need not be installed.
    """
    assert {"matplotlib", "pygame", "torch", "stable_baselines3"} <= set(other_extras())
    for page in DOCS.glob("*.md"):
        assert (site / f"{page.stem}.html").is_file() == (page.stem != DRAFT), page.name
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


def test_navigation_has_every_page_by_its_title(site: Path) -> None:
    """The front page and README link to each page under its title, or the beginning of it."""
    titles = {
        page.stem: page.read_text(encoding="utf-8").splitlines()[0].removeprefix("# ").lower()
        for page in DOCS.glob("*.md")
        if page.stem not in ("index", DRAFT)
    }
    index = (site / "index.html").read_text(encoding="utf-8")
    listed = re.findall(r'toctree-l1"><a class="[^"]*" href="(\w+)\.html"', index)
    assert sorted(listed) == sorted(titles)
    for path, folder in ((DOCS / "index.md", ""), (REPOSITORY / "README.md", "docs/")):
        text = path.read_text(encoding="utf-8").split("## Documentation")[-1]
        links = re.findall(rf"\[([^\]]+)\]\({folder}(\w+)\.md\)", text)
        assert {page for _, page in links} - {"index"} == set(titles), path.name
        for words, page in links:
            if page != "index":
                assert titles[page].startswith(words.lower()), f"{path.name}: {words}, {page}"


def test_reference_says_nothing_twice(site: Path) -> None:
    """What is said of several parameters at once is not repeated for each of them."""
    reference = (site / "api.html").read_text(encoding="utf-8")
    entries = reference.split('<dt class="sig ')[1:]
    assert len(entries) >= 80
    for entry in entries:
        said = [
            re.sub(r"<[^>]+>", "", text).partition("\N{EN DASH}")[2].strip()
            for text in re.findall(r"<li><p>(.*?)</p>", entry, re.DOTALL)
        ]
        said = [text for text in said if len(text.split()) > 2]
        assert len(said) == len(set(said)), said


@pytest.mark.parametrize("width", [390, 1280])
def test_pages_keep_to_the_window(site: Path, browser: Any, width: int) -> None:
    """Nothing makes a page wider than the window, on a phone or beside a table of contents."""
    page = browser.new_page(viewport={"width": width, "height": 800})
    for path in sorted(site.glob("*.html")):
        page.goto(path.as_uri())
        assert page.evaluate("document.documentElement.scrollWidth") <= width, path.name
    page.close()


def shade(table: Any) -> list[float]:
    """Return how much darker than the page a table is at its left and right edge."""
    with Image.open(io.BytesIO(table.screenshot())) as image:
        columns = np.median(np.array(image.convert("L"), float), axis=0)
    return [255 - columns[:3].mean(), 255 - columns[-3:].mean()]


def test_wide_tables_show_that_there_is_more(site: Path, browser: Any) -> None:
    """On a phone a table is shaded at each edge behind which more of it is, and at no other."""
    page = browser.new_page(viewport={"width": 390, "height": 800}, color_scheme="light")
    wide = narrow = 0
    for name in ("env", "results"):
        page.goto((site / f"{name}.html").as_uri())
        for table in page.query_selector_all(".table-wrapper"):
            hidden = table.evaluate("e => e.scrollWidth - e.clientWidth")
            left, right = shade(table)
            assert left < 10, name
            if hidden < 30:  # what is nearly all there is nearly not shaded
                narrow += 1
                assert hidden > 0 or right < 10, name
                continue
            wide += 1
            assert right > 20, name
            table.evaluate("e => { e.scrollLeft = e.scrollWidth }")
            left, right = shade(table)
            assert left > 20, name
            assert right < 10, name
    page.close()
    assert wide >= 8
    assert narrow >= 2


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
