"""What is released: the wheel holds the package alone, the sdist its sources."""

from __future__ import annotations

import re
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import pytest

import mapp_env

REPOSITORY = Path(__file__).resolve().parents[2]
NAME = f"mapp_env-{mapp_env.__version__}"
HEAVY = {".safetensors", ".png", ".gif", ".npz", ".pyc", ".nbc", ".nbi"}


def build(source: Path, target: Path, *kinds: str) -> Path:
    """Build what is released, without downloading anything."""
    words = [word for kind in kinds for word in ("-t", kind)]
    subprocess.run(
        [sys.executable, "-m", "hatchling", "build", "-d", str(target), *words],
        cwd=source,
        check=True,
        capture_output=True,
    )
    return target


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with a wheel and an sdist."""
    return build(REPOSITORY, tmp_path_factory.mktemp("dist"), "wheel", "sdist")


def wheel_names(folder: Path) -> set[str]:
    """Return the files of the one wheel in a folder."""
    (path,) = folder.glob("*.whl")
    with zipfile.ZipFile(path) as archive:
        return set(archive.namelist())


def test_the_wheel_holds_the_package_alone(built: Path) -> None:
    """Every source and data file of `mapp_env` is in it, and nothing of what stands beside it."""
    names = wheel_names(built)
    package = {name for name in names if not name.startswith(f"{NAME}.dist-info/")}
    sources = {
        str(path.relative_to(REPOSITORY))
        for path in (REPOSITORY / "mapp_env").rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    }
    assert package == sources
    assert {"mapp_env/py.typed", "mapp_env/grids/paper-7x7.txt"} <= package


def test_the_sdist_holds_no_weights_and_no_documents(built: Path) -> None:
    """Sources and the texts of a release; no trained weights, no pictures, no tests of the rest."""
    (path,) = built.glob("*.tar.gz")
    with tarfile.open(path) as archive:
        names = {name.partition("/")[2] for name in archive.getnames()}
    assert {"mapp_env/__init__.py", "LICENSE", "README.md", "CHANGELOG.md", "PKG-INFO"} <= names
    assert not {name for name in names if Path(name).suffix in HEAVY}
    assert not {
        name for name in names if name.startswith(("docs/", "baselines/", "runs/", "tests/"))
    }
    assert path.stat().st_size < 1_000_000


def test_the_sdist_builds_the_same_wheel(built: Path, tmp_path: Path) -> None:
    """A wheel made from the unpacked sdist has the files of that made from the repository."""
    (path,) = built.glob("*.tar.gz")
    with tarfile.open(path) as archive:
        archive.extractall(tmp_path, filter="data")
    assert wheel_names(build(tmp_path / NAME, tmp_path / "dist", "wheel")) == wheel_names(built)


def test_the_version_stands_in_one_place(built: Path) -> None:
    """The wheel's version is the package's; besides it only changes and citations say it.

    `test_citations_agree` holds that those say the same.
    """
    (path,) = built.glob("*.whl")
    with zipfile.ZipFile(path) as archive:
        metadata = archive.read(f"{NAME}.dist-info/METADATA").decode()
    assert re.search(rf"^Version: {re.escape(mapp_env.__version__)}$", metadata, re.MULTILINE)
    said = rf'^\s*(__)?version(__)?\s*[:=]\s*"?{re.escape(mapp_env.__version__)}"?\s*$'
    places = [
        path.name
        for pattern in ("*.toml", "mapp_env/**/*.py", "docs/*.py")
        for path in REPOSITORY.glob(pattern)
        if re.search(said, path.read_text(encoding="utf-8"), re.MULTILINE)
    ]
    assert places == ["__init__.py"]


def test_the_changelog_is_kept() -> None:
    """It opens with what is not released yet, or with the version that the package has."""
    text = (REPOSITORY / "CHANGELOG.md").read_text(encoding="utf-8")
    first = re.findall(r"^## \[?([^\]\s]+)", text, re.MULTILINE)[0]
    assert first in ("Unreleased", mapp_env.__version__)


def test_workflows_pin_their_actions() -> None:
    """Each action of a workflow is pinned to a commit, and may read the repository only."""
    workflows = sorted((REPOSITORY / ".github" / "workflows").glob("*.yml"))
    assert workflows
    for path in workflows:
        text = path.read_text(encoding="utf-8")
        used = re.findall(r"uses: *(\S+)", text)
        assert used, path.name
        assert all(re.fullmatch(r"[\w-]+/[\w-]+@[0-9a-f]{40}", action) for action in used)
        assert re.search(r"^permissions:\n  contents: read$", text, re.MULTILINE)
