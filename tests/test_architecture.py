"""The walls of the house: who may import what. The table stands in CONTRIBUTING.md; there is no list of exceptions."""

import ast
import re
from functools import cache
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
FOLDERS = {"birdslam": "birdslam", "runtime": "birdslam.runtime", "perf": "birdslam.perf"}
IMPURE = {"zenoh", "time", "threading", "logging", "os", "multiprocessing", "subprocess", "psutil", "asyncio", "socket"}
ONLY_IN = {  # third-party library: the packages that may import it
    "onnxruntime": {"perception", "runtime.world"},
    "gtsam": {"bench.baselines"},
    "torch": {"world.training", "runtime.world", "perf"},
    "numba": {"world", "world.training", "perf"},
    "ray": {"runtime.batch"},
    "rosbags": {"ros"},
    "zenoh": {"runtime.transport", "runtime.gate", "runtime.fleet", "perf"},
}
MOST_MODULES = 15  # in a folder


def modules() -> dict[str, Path]:
    """Every module by its full name, each once: birdslam/runtime and birdslam/perf are links."""
    found = {}
    for folder, name in FOLDERS.items():
        for path in sorted((ROOT / folder).rglob("*.py")):
            parts = path.relative_to(ROOT / folder).with_suffix("").parts
            found[".".join((name, *parts)).removesuffix(".__init__")] = path
    return found


MODULES = modules()
HOUSE = [name for name in MODULES if name.count(".") > 1 or MODULES[name].name != "__init__.py"]


@cache
def imports(path: Path) -> set[str]:
    """Full names of the modules that a file imports, wherever in it the import stands."""
    found: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            module = node.module or ""
            found |= {name if (name := f"{module}.{alias.name}") in MODULES else module for alias in node.names}
    return found


def table() -> dict[str, set[str]]:
    """Package -> the packages that it may import, as CONTRIBUTING.md says it."""
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


@pytest.mark.parametrize("module", HOUSE)
def test_a_package_imports_what_the_table_says_and_nothing_else(module: str) -> None:
    own = package_of(module)
    assert own in TABLE, f"{own} has no row in CONTRIBUTING.md"
    assert {package_of(name) for name in inside(module)} - {own} <= TABLE[own]


def test_the_table_names_what_there_is_and_nothing_that_is_not_used() -> None:
    used: dict[str, set[str]] = {package_of(module): set() for module in HOUSE}
    for module in HOUSE:
        used[package_of(module)] |= {package_of(name) for name in inside(module)} - {package_of(module)}
    assert {name: may for name, may in used.items() if name != "perf"} == {
        name: may for name, may in TABLE.items() if name != "perf"
    }


@pytest.mark.parametrize("graph", ["packages", "modules"])
def test_there_is_no_circle(graph: str) -> None:
    of = {module: inside(module) for module in HOUSE} if graph == "modules" else TABLE
    try:
        TopologicalSorter(of).prepare()
    except CycleError as error:
        pytest.fail(f"a circle: {error.args[1]}")


@pytest.mark.parametrize("module", HOUSE)
def test_libraries_stay_in_their_packages(module: str) -> None:
    own = package_of(module)
    roots = {name.split(".")[0] for name in imports(MODULES[module])}
    for library, packages in ONLY_IN.items():
        assert library not in roots or own in packages or own.split(".")[0] in packages, f"{module} imports {library}"
    if not own.startswith(("runtime", "perf")):
        assert not roots & IMPURE
        called = {
            node.func.id
            for node in ast.walk(ast.parse(MODULES[module].read_text()))
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Name)
        }
        assert "print" not in called


def test_every_import_uses_the_name_that_the_wheel_installs() -> None:
    """`runtime` and `perf` are folders of the checkout; their modules are birdslam.runtime and birdslam.perf."""
    for path in (*MODULES.values(), *(ROOT / "tests").rglob("*.py"), *(ROOT / "docs").rglob("*.py")):
        assert not {name.split(".")[0] for name in imports(path)} & {"runtime", "perf"}, path


FOLDERS_OF_MODULES = sorted({path.parent for path in MODULES.values()})


@pytest.mark.parametrize("folder", FOLDERS_OF_MODULES, ids=lambda folder: str(folder.relative_to(ROOT)))
def test_a_folder_holds_few_modules(folder: Path) -> None:
    assert len([path for path in folder.glob("*.py") if path.name != "__init__.py"]) <= MOST_MODULES


def test_no_machine_path_or_secret_host_in_the_tree() -> None:
    for package in ("birdslam", "runtime", "perf", "tests", "configs", "deploy"):
        for path in (ROOT / package).rglob("*"):
            if path.suffix in (".py", ".toml", ".md", ".service", ".sh") and path.name != Path(__file__).name:
                text = path.read_text()
                assert "/home/" not in text, path
                assert "/root/" not in text, path
