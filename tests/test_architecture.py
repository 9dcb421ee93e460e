"""Imports between packages follow the table in CONTRIBUTING.md."""

import ast
import re
from collections.abc import Iterator
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
FOLDERS = {"birdslam": "birdslam", "runtime": "birdslam.runtime", "perf": "birdslam.perf"}
IMPURE = {"zenoh", "time", "threading", "logging", "os", "multiprocessing", "subprocess", "psutil", "asyncio", "socket"}
ONLY_IN = {  # third-party library: the packages that may import it
    "onnxruntime": {"perception", "runtime.world"},
    "gtsam": {"bench.baselines", "loops", "perf"},
    "torch": {"world.training", "runtime.world", "perf"},
    "numba": {"world", "world.training", "perf"},
    "ray": {"runtime.batch"},
    "rosbags": {"ros"},
    "zenoh": {"runtime.transport", "runtime.gate", "runtime.fleet", "runtime.ros", "perf"},
}
MAX_MODULES = 15  # in a folder
MAX_LINES_OF_HEAD = 8


def modules() -> dict[str, Path]:
    """Every module by its full name; setup.py maps the folders runtime/ and perf/ into the package."""
    found = {}
    for folder, name in FOLDERS.items():
        for path in sorted((ROOT / folder).rglob("*.py")):
            parts = path.relative_to(ROOT / folder).with_suffix("").parts
            found[".".join((name, *parts)).removesuffix(".__init__")] = path
    return found


MODULES = modules()
HOUSE = [name for name in MODULES if name.count(".") > 1 or MODULES[name].name != "__init__.py"]


def statements(nested: ast.AST) -> Iterator[ast.AST]:
    """All statements of a syntax tree, without their expressions."""
    for name in ("body", "orelse", "finalbody", "handlers", "cases"):
        for statement in getattr(nested, name, ()) if not isinstance(nested, ast.IfExp | ast.Lambda) else ():
            yield statement
            yield from statements(statement)


@cache
def docstring(path: Path) -> str:
    return ast.get_docstring(ast.parse(path.read_text().partition("\nfrom __future__")[0])) or ""


@cache
def imports(path: Path) -> set[str]:
    """Full names of the modules that a file imports, wherever in it the import stands."""
    found: set[str] = set()
    for node in statements(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            module = node.module or ""
            found |= {name if (name := f"{module}.{alias.name}") in MODULES else module for alias in node.names}
    return found


def table() -> dict[str, set[str]]:
    """Package -> the packages that it may import, from CONTRIBUTING.md."""
    rows = re.findall(r"^\| `([a-z_.]+)` \| [^|]* \| ([^|]*) \|$", (ROOT / "CONTRIBUTING.md").read_text(), re.M)
    every = {name for name, _ in rows}
    return {
        name: every - {name} if may == "everything" else set(re.findall(r"`([a-z_.]+)`", may)) for name, may in rows
    }


TABLE = table()


def package_of(module: str) -> str:
    """The row of the table that a module belongs to, the longest that fits: `geometry`, `bench.ego`."""
    parts = module.split(".")[1:]
    names = [".".join(parts[:end]) for end in range(len(parts), 0, -1)]
    return next((name for name in names if name in TABLE), names[-1])


def inside(module: str) -> set[str]:
    return {name for name in imports(MODULES[module]) if name in MODULES and name not in (module, "birdslam")}


def test_every_package_has_its_row() -> None:
    assert {package_of(module) for module in HOUSE} - set(TABLE) == set()


def test_package_imports_follow_the_table() -> None:
    for module in HOUSE:
        own = package_of(module)
        others = {package_of(name) for name in inside(module)} - {own} - TABLE.get(own, set())
        assert not others, f"{module} imports of {', '.join(sorted(others))}"


def test_table_lists_exactly_the_used_imports() -> None:
    used: dict[str, set[str]] = {package_of(module): set() for module in HOUSE}
    for module in HOUSE:
        used[package_of(module)] |= {package_of(name) for name in inside(module)} - {package_of(module)}
    assert {name: may for name, may in used.items() if name != "perf"} == {
        name: may for name, may in TABLE.items() if name != "perf"
    }


@pytest.mark.parametrize("graph", ["packages", "modules"])
def test_imports_have_no_cycle(graph: str) -> None:
    of = {module: inside(module) for module in HOUSE} if graph == "modules" else TABLE
    try:
        TopologicalSorter(of).prepare()
    except CycleError as error:
        pytest.fail(f"a circle: {error.args[1]}")


def test_libraries_stay_in_their_packages() -> None:
    for module in HOUSE:
        own, roots = package_of(module), {name.split(".")[0] for name in imports(MODULES[module])}
        for library in roots & set(ONLY_IN):
            assert {own, own.split(".")[0]} & ONLY_IN[library], f"{module} imports {library}"


def test_the_method_has_no_clock_no_process_and_prints_nothing() -> None:
    for module in HOUSE:
        if package_of(module).startswith(("runtime", "perf")):
            continue
        roots = {name.split(".")[0] for name in imports(MODULES[module])}
        assert not roots & IMPURE, f"{module} imports {', '.join(roots & IMPURE)}"
        assert not re.search(r"^[^#\"]*\bprint\(", MODULES[module].read_text(), re.M), module


def test_every_import_uses_the_name_that_the_wheel_installs() -> None:
    """`runtime` and `perf` are folders of the checkout; their modules are birdslam.runtime and birdslam.perf."""
    for path in (*MODULES.values(), *(ROOT / "tests").rglob("*.py"), *(ROOT / "docs").rglob("*.py")):
        assert not {name.split(".")[0] for name in imports(path)} & {"runtime", "perf"}, path


FOLDERS_OF_MODULES = sorted({path.parent for path in MODULES.values()})


@pytest.mark.parametrize("folder", FOLDERS_OF_MODULES, ids=lambda folder: str(folder.relative_to(ROOT)))
def test_a_folder_holds_few_modules(folder: Path) -> None:
    assert len([path for path in folder.glob("*.py") if path.name != "__init__.py"]) <= MAX_MODULES


LONGER_HEAD = {"birdslam.types"}  # its head is the section of frames and units of docs/planner.md


def test_the_head_of_a_module_is_at_most_eight_lines() -> None:
    for module, path in MODULES.items():
        head = docstring(path)
        assert len(head.splitlines()) <= MAX_LINES_OF_HEAD or module in LONGER_HEAD, module


def test_no_machine_path_or_secret_host_in_the_tree() -> None:
    for package in ("birdslam", "runtime", "perf", "tests", "configs", "deploy"):
        for path in (ROOT / package).rglob("*"):
            if path.suffix in (".py", ".toml", ".md", ".service", ".sh") and path.name != Path(__file__).name:
                text = path.read_text()
                assert "/home/" not in text, path
                assert "/root/" not in text, path


NAMEDTUPLES = {"_replace", "_asdict", "_fields", "_make"}  # public, though they look otherwise


def is_private(name: str) -> bool:
    return name.startswith("_") and not name.startswith("__") and name != "_" and name not in NAMEDTUPLES


def own_names(tree: ast.AST) -> set[str]:
    """What the classes of a file define of themselves."""
    found = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            found.add(node.name)
        elif isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Store):
            found.add(node.attr)
        elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            found.add(node.id)
    return found


def name_of(function: ast.expr) -> str:
    return function.attr if isinstance(function, ast.Attribute) else getattr(function, "id", "")


def private_touches(text: str) -> dict[int, str]:
    """Line -> what it touches: another's private attribute, a private import, a private name that is patched or asked.

    `# private: reason` on the line makes it right. What a class says of itself by `self` and `cls` is its own.
    """
    tree, lines = ast.parse(text), text.splitlines()
    own, found = own_names(tree), []
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute) and is_private(node.attr):
            of_itself = isinstance(node.value, ast.Name) and node.value.id in ("self", "cls") and node.attr in own
            found += [] if of_itself else [(node.end_lineno or 0, ast.unparse(node))]
        elif isinstance(node, ast.ImportFrom):
            found += [(alias.lineno, alias.name) for alias in node.names if is_private(alias.name)]
        elif isinstance(node, ast.Call) and name_of(node.func) in PATCHES:
            names = [a.value for a in node.args if isinstance(a, ast.Constant) and isinstance(a.value, str)]
            found += [(node.lineno, name) for name in names if is_private(name.rpartition(".")[2])]
    return {line: what for line, what in found if not re.search(r"# private: \S", lines[line - 1])}


PATCHES = {"setattr", "getattr", "hasattr", "delattr", "patch", "object"}


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("import a\na._b", 2),
        ("import a\na._b  # private: because", 0),
        ("import a\na._b  # private:", 2),
        ("from a import (\n    b,\n    _c,\n)", 3),
        ("monkeypatch.setattr(a, '_b', 1)", 1),
        ("monkeypatch.setattr('a.b._c', 1)", 1),
        ("class A:\n    def f(self):\n        self._b = 1\n        return self._b", 0),
        ("class A(B):\n    def f(self):\n        return self._b", 3),
        ("a._replace(b=1).__dict__", 0),
    ],
)
def test_private_access_is_found(text: str, line: int) -> None:
    assert [*private_touches(text)] == ([line] if line else [])


@pytest.mark.parametrize("path", sorted((ROOT / "tests").rglob("*.py")), ids=lambda path: path.stem)
def test_tests_access_private_names_only_with_a_reason(path: Path) -> None:
    assert private_touches(path.read_text()) == {}
