"""The house keeps its order: who may import whom, how files are called, what is documented."""

from __future__ import annotations

import ast
import functools
from collections.abc import Iterator
from pathlib import Path

import pytest

import mapp_env

REPOSITORY = Path(__file__).resolve().parents[2]
PACKAGE = REPOSITORY / "mapp_env"
FILES = sorted(PACKAGE.rglob("*.py"))
BASELINES = sorted((REPOSITORY / "baselines").rglob("*.py"))

# Rooms from the ground up: a file imports only from its own room and from rooms below it.
LAYERS: tuple[str, ...] = (
    "mapp_env.validation",
    "mapp_env.compiled",
    "mapp_env.draws",
    "mapp_env.files",
    "mapp_env.records",
    "mapp_env.map_format",
    "mapp_env.paths",
    "mapp_env.grid",
    "mapp_env.grids",
    "mapp_env.engine.state",  # the rules stand below what is played by them
    "mapp_env.engine.rules",
    "mapp_env.engine.observation",
    "mapp_env.engine.world",
    "mapp_env.problem",
    "mapp_env.engine",
    "mapp_env.plans",
    "mapp_env.solvers",
    "mapp_env.rendering",
    "mapp_env.envs",
    "mapp_env.mapp_v0",
    "mapp_env.adapters",
    "mapp_env.evaluation",
    "mapp_env",
    "mapp_env.commands",
    "mapp_env.__main__",
    "baselines.runs",
    "baselines.networks",
    "baselines.replay",
    "baselines.policies",
    "baselines.learning",
    "baselines",  # the scripts
)
FACES = {"mapp_env", "mapp_env.envs", "mapp_env.mapp_v0", "mapp_env.adapters"}
DRAWING = {"PIL", "matplotlib", "pygame"}
TRAINERS = {"stable_baselines3", "supersuit"}


def module_name(path: Path) -> str:
    """Return a file's dotted name: ``mapp_env.rendering.ansi``; of a room that of its folder."""
    parts = list(path.relative_to(REPOSITORY).with_suffix("").parts)
    if parts[-1] == "__init__":
        parts.pop()
    return ".".join(parts)


def room(module: str) -> str:
    """Return the room of a module: the longest name in LAYERS that it is, or is in."""
    parts = module.split(".")
    for length in range(len(parts), 0, -1):
        name = ".".join(parts[:length])
        if name in LAYERS:
            # A new folder or file at the top of the package is no room yet.
            assert name != "mapp_env" or length == len(parts), f"{module}: give it a place"
            return name
    raise AssertionError(f"{module} has no place in LAYERS: give it one")


def layer(module: str) -> int:
    """Return how high the room of a module stands."""
    return LAYERS.index(room(module))


@functools.cache
def imports(path: Path) -> tuple[tuple[str, bool], ...]:
    """Return what a file imports, dotted, and whether already when it is imported itself."""
    return tuple(_imports(ast.parse(path.read_text(encoding="utf-8")), True))


def _imports(node: ast.AST, at_import: bool) -> Iterator[tuple[str, bool]]:
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.Import):
            yield from ((alias.name, at_import) for alias in child.names)
        elif isinstance(child, ast.ImportFrom):
            assert child.level == 0, "imports are absolute here"
            yield from ((f"{child.module}.{alias.name}", at_import) for alias in child.names)
        elif isinstance(child, ast.If) and ast.unparse(child.test) == "TYPE_CHECKING":
            continue
        else:
            inside = isinstance(child, (ast.FunctionDef, ast.AsyncFunctionDef, ast.Lambda))
            yield from _imports(child, at_import and not inside)


def own(name: str) -> str | None:
    """Return the module of the house that an imported name comes from, or None."""
    parts = name.split(".")
    if parts[0] not in {"mapp_env", "baselines"}:
        return None
    for length in range(len(parts), 0, -1):
        path = REPOSITORY.joinpath(*parts[:length])
        if path.with_suffix(".py").is_file() or (path / "__init__.py").is_file():
            return ".".join(parts[:length])
    return None


def test_the_reader_reads() -> None:
    """The reader of imports sees the files and what they are known to import."""
    rules, observation = PACKAGE / "engine/rules.py", PACKAGE / "engine/observation.py"
    assert ("numpy", True) in imports(rules)
    assert own("mapp_env.grid.Grid") == "mapp_env.grid"
    assert own("mapp_env.mapp_v0") == "mapp_env.mapp_v0"
    assert own("mapp_env.Grid") == "mapp_env"
    assert own("numpy.typing") is None
    assert any(own(name) == "mapp_env.engine.state" for name, _ in imports(observation))
    assert {room(module_name(path)) for path in (*FILES, *BASELINES)} == set(LAYERS)
    assert room("baselines.meta_dqn") == "baselines"


@pytest.mark.parametrize("path", [*FILES, *BASELINES], ids=module_name)
def test_imports_run_downwards(path: Path) -> None:
    """No file imports from a room above its own, so none of the package's its top.

    Commands stand above it, and say its version.
    """
    here = module_name(path)
    for name, _ in imports(path):
        source = own(name)
        if source is not None:
            assert layer(source) <= layer(here), f"{here} imports {source}, which stands above it"


def test_imports_have_no_cycle() -> None:
    """No file imports itself by way of others, not even inside one room."""
    files = (*FILES, *BASELINES)
    graph = {module_name(path): {own(name) for name, _ in imports(path)} - {None} for path in files}
    done: set[str] = set()

    def visit(module: str, trail: tuple[str, ...]) -> None:
        assert module not in trail, f"cycle: {' -> '.join((*trail, module))}"
        if module in done:
            return
        for source in sorted(name for name in graph[module] if name):
            visit(source, (*trail, module))
        done.add(module)

    for module in graph:
        visit(module, ())
    assert done == set(graph)


def test_rooms_are_small() -> None:
    """A dozen files at one level is plenty, and scripts and their parts never stand mixed."""
    first_name = REPOSITORY / "baselines" / "policy.py"  # of load_policy: not a file of its own
    for folder in {path.parent for path in (*FILES, *BASELINES)}:
        names = [path.name for path in folder.glob("*.py") if path != first_name]
        assert len(names) - ("__init__.py" in names) <= 12, f"{folder}: {names}"
    for path in BASELINES:
        script = "__name__" in path.read_text(encoding="utf-8")
        at_top = path.parent.name == "baselines" and path.name not in {"__init__.py", "policy.py"}
        assert script == at_top, path


@pytest.mark.parametrize("path", FILES, ids=module_name)
def test_libraries_stay_in_their_places(path: Path) -> None:
    """PettingZoo in the faces, drawing in rendering, trainers in the adapters, torch nowhere.

    Drawing libraries are not imported early, and nothing else imports an adapter.

    Gymnasium's seeding is allowed everywhere: it is where generators come from.
    """
    here = room(module_name(path))
    for name, at_import in imports(path):
        library = name.split(".")[0]
        assert library not in {"torch", "baselines", "tests", "examples", "benchmarks"}
        assert library not in {"random", "pickle"}, f"{path} imports {library}"
        if library in {"pettingzoo", "gymnasium"}:
            seeding = name.startswith("gymnasium.utils.seeding")
            assert here in FACES or seeding, f"{path} imports {name}"
        if library in TRAINERS or (own(name) or "").startswith("mapp_env.adapters"):
            assert here == "mapp_env.adapters", f"{path} imports {name}"
        if library in DRAWING:
            assert here == "mapp_env.rendering", f"{path} imports {name}"
            if path.name == "__init__.py":
                assert not at_import, "importing mapp_env.rendering draws nothing"


def test_compiling_stands_in_one_place() -> None:
    """One file alone asks numba to compile, so that what is done without a cache is done by all."""
    askers = [
        p
        for p in (*FILES, *BASELINES)
        if any(name.split(".")[0] == "numba" for name, _ in imports(p))
    ]
    assert askers == [PACKAGE / "compiled.py"]


@pytest.mark.parametrize("folder", ["mapp_env", "baselines", "examples", "benchmarks", "tests"])
def test_no_file_without_a_subject(folder: str) -> None:
    """No file is called utils, helpers, misc or common: each is called after what it holds."""
    for path in (REPOSITORY / folder).rglob("*.py"):
        assert path.stem.strip("_") not in {"util", "utils", "helper", "helpers", "misc", "common"}


def public_definitions() -> list[tuple[str, ast.AST]]:
    """Return every module, and every public class, function and method of the package."""
    found: list[tuple[str, ast.AST]] = []
    for path in FILES:
        tree = ast.parse(path.read_text(encoding="utf-8"))
        found.append((module_name(path), tree))
        stack: list[tuple[str, ast.AST]] = [(module_name(path), tree)]
        while stack:
            where, node = stack.pop()
            for child in ast.iter_child_nodes(node):
                if not isinstance(child, (ast.ClassDef, ast.FunctionDef)):
                    continue
                if child.name.startswith("_"):
                    continue
                name = f"{where}.{child.name}"
                decorators = {ast.unparse(decorator) for decorator in child.decorator_list}
                setter = any(text.endswith(".setter") for text in decorators)
                if not setter and not decorators & {"overload", "override"}:
                    found.append((name, child))
                if isinstance(child, ast.ClassDef):
                    stack.append((name, child))
    return found


def test_a_python_that_is_started_searches_no_working_folder() -> None:
    """Each interpreter that is started here gets -P: else `-c` and `-m` search there first."""
    started = 0
    for name in ("mapp_env", "baselines", "examples", "benchmarks"):
        for path in sorted((REPOSITORY / name).rglob("*.py")):
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
                if isinstance(node, ast.List) and ast.unparse(node).startswith("[sys.executable"):
                    started += 1
                    assert ast.unparse(node.elts[1]) == "'-P'", f"{path}:{node.lineno}"
    assert started >= 3


def test_public_names_are_documented() -> None:
    """Every module and every public class, function and method has a docstring of its own."""
    definitions = public_definitions()
    assert len(definitions) >= 60
    bare = [name for name, node in definitions if not ast.get_docstring(node)]  # type: ignore[arg-type]
    assert bare == []


def test_no_docstring_is_needed() -> None:
    """No program takes its docstring apart without asking for it first: -OO drops them all."""
    folders = ("mapp_env", "baselines", "examples", "benchmarks", "tests/engine/golden")
    paths = [path for name in folders for path in sorted((REPOSITORY / name).rglob("*.py"))]
    asked = 0
    for path in paths:
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            asked += isinstance(node, ast.Name) and node.id == "__doc__"
            if isinstance(node, (ast.Attribute, ast.Subscript)):
                text = ast.unparse(node.value)
                assert not text.endswith("__doc__"), f"{path}:{node.lineno}: {text}"
    assert asked >= 20


def test_no_assert_and_no_eval_for_users() -> None:
    """The package checks with exceptions, not asserts, and evaluates no text."""
    for path in FILES:
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            assert not isinstance(node, ast.Assert), f"{module_name(path)}:{node.lineno}"
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
                assert node.func.id not in {"eval", "exec"}, f"{module_name(path)}:{node.lineno}"


def test_all_names_exist() -> None:
    """Every name of __all__ exists, and the names that the design fixes are among them."""
    for name in mapp_env.__all__:
        assert hasattr(mapp_env, name), name
    fixed = {"Grid", "Problem", "make_grid", "make_vec", "mapp_v0", "replay"}
    assert fixed <= set(mapp_env.__all__)
    for name in ("parallel_env", "env", "raw_env"):
        assert callable(getattr(mapp_env.mapp_v0, name))


def test_every_test_says_what_it_holds() -> None:
    """Every test function has a docstring of one sentence or more."""
    count = 0
    for path in sorted((REPOSITORY / "tests").rglob("test_*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.FunctionDef) and node.name.startswith("test_"):
                count += 1
                assert ast.get_docstring(node), f"{path.name}: {node.name}"
    assert count >= 80
