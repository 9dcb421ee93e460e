"""The walls of the house: who may import what. There is no list of exceptions."""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
IMPURE = {"runtime", "perf", "zenoh", "time", "threading", "logging", "os", "multiprocessing", "subprocess", "psutil"}
LAYERS = (  # each imports only from itself and from what stands before it
    ("se2", "status"),
    ("types",),
    ("camera", "bev"),
)
ON_TOP = (
    *("frontend", "slam", "baselines", "evaluation"),
    *("localisation_evaluation", "calibration", "demo_grading"),
    *("tracking_metrics", "tracking_evaluation", "tracking_picture", "tracking_report", "ablation", "tables"),
)


def imports(path: Path) -> set[str]:
    """Full names of the modules that a file imports, wherever in it the import stands."""
    found: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            found |= {node.module or ""} | {f"{node.module}.{alias.name}" for alias in node.names}
    return found


def modules(package: str) -> list[Path]:
    return sorted((ROOT / package).rglob("*.py"))


def name_of(path: Path) -> str:
    return path.relative_to(ROOT / "birdslam").parts[0].removesuffix(".py")


@pytest.mark.parametrize("path", modules("birdslam"), ids=lambda p: str(p.relative_to(ROOT)))
def test_birdslam_is_pure(path: Path) -> None:
    roots = {name.split(".")[0] for name in imports(path)}
    assert not roots & IMPURE
    if "onnxruntime" in roots:
        assert name_of(path) == "perception"
    if "gtsam" in roots:
        assert name_of(path) in ("graph", "baselines")
    if "torch" in roots:
        assert name_of(path) == "training"
    if "numba" in roots:
        assert name_of(path) in ("simulation", "training")
    calls = {
        n.func.id
        for n in ast.walk(ast.parse(path.read_text()))
        if isinstance(n, ast.Call) and isinstance(n.func, ast.Name)
    }
    assert "print" not in calls


@pytest.mark.parametrize("path", modules("birdslam"), ids=lambda p: str(p.relative_to(ROOT)))
def test_imports_go_one_way(path: Path) -> None:
    inside = {name.split(".")[1] for name in imports(path) if name.startswith("birdslam.")}
    own = name_of(path)
    allowed: set[str] = set()
    for layer in LAYERS:
        allowed |= set(layer)
        if own in layer:
            assert inside <= allowed
    if own not in ON_TOP:
        assert not inside & set(ON_TOP)


@pytest.mark.parametrize("path", modules("runtime"), ids=lambda p: str(p.relative_to(ROOT)))
def test_runtime_does_not_know_perf(path: Path) -> None:
    assert "perf" not in {name.split(".")[0] for name in imports(path)}


def test_no_machine_path_or_secret_host_in_the_tree() -> None:
    for package in ("birdslam", "runtime", "perf", "tests", "configs", "deploy"):
        for path in (ROOT / package).rglob("*"):
            if path.suffix in (".py", ".toml", ".md", ".service", ".sh") and path.name != Path(__file__).name:
                text = path.read_text()
                assert "/home/" not in text, path
                assert "/root/" not in text, path
