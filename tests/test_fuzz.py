"""A short run of `make fuzz`; and no input file can execute code."""

from __future__ import annotations

import ast
import hashlib
from pathlib import Path

import pytest

from birdslam.perception import ModelError, ModelSpec, load_network
from birdslam.perception.manifest_file import read_manifest, shipped_manifests
from tests import fuzz

ROOT = Path(__file__).resolve().parent.parent
CASES, SEED = 5_000, 6
YAML_OF_DATA = {"SafeLoader", "YAMLError", "load_all"}  # other loaders run code
RUNS_CODE = {"eval", "exec", "compile", "__import__"}
READS_CODE = {"pickle", "marshal", "shelve", "dill", "joblib", "runpy", "imp", "code"}


def test_every_target_holds() -> None:
    counts = {count.name: count for count in fuzz.run(CASES, SEED)}
    assert abs(sum(count.cases for count in counts.values()) - CASES) < len(counts)
    for count in counts.values():  # a target that lets all or nothing in was not tried
        assert 0 < count.let_in < count.cases, count


def test_the_same_seed_gives_the_same_cases() -> None:
    first, again, other = (
        [(count.name, count.let_in) for count in fuzz.run(500, seed)] for seed in (SEED, SEED, SEED + 1)
    )
    assert first == again
    assert first != other


def called_of_yaml(call: ast.Call) -> str:
    """The function of the module yaml that is called."""
    of = call.func
    return of.attr if isinstance(of, ast.Attribute) and isinstance(of.value, ast.Name) and of.value.id == "yaml" else ""


@pytest.mark.parametrize("package", ["birdslam", "runtime"])
def test_input_is_never_executed(package: str) -> None:
    """Files and messages are data: no module evaluates, imports by name, or unpickles."""
    for path in (ROOT / package).rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Call):
                called = node.func.id if isinstance(node.func, ast.Name) else ""
                assert called not in RUNS_CODE, f"{path}: {called}"
                for keyword in node.keywords:
                    if keyword.arg in ("allow_pickle", "shell"):
                        assert ast.unparse(keyword.value) == "False", path
            if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "yaml":
                assert node.attr in YAML_OF_DATA, f"{path}: yaml.{node.attr}"
            if isinstance(node, ast.Call) and called_of_yaml(node) == "load":
                assert ast.unparse(node.args[1]) == "_Loader", path
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            names += [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            assert not {name.split(".")[0] for name in names} & READS_CODE, path


def test_a_network_is_parsed_only_after_its_hash_was_checked(tmp_path: Path) -> None:
    """A pinned network with one flipped byte is refused by its hash; onnxruntime never sees it."""
    name, manifest = next((n, path) for n, path in shipped_manifests().items() if read_manifest(path).sha256)
    text = manifest.read_text()
    network = tmp_path / f"{name}.onnx"
    network.write_bytes(b"not a network at all")
    network.with_suffix(".toml").write_text(text)
    with pytest.raises(ModelError, match="sha256") as caught:
        load_network(read_manifest(manifest).role, ModelSpec(path=str(network)))
    assert hashlib.sha256(network.read_bytes()).hexdigest() in str(caught.value)
