"""Model manifests: content, lookup, and errors that name the contradiction with the network."""

from __future__ import annotations

import hashlib
from pathlib import Path

import numpy as np
import onnxruntime as ort
import pytest
from hypothesis import given
from hypothesis import strategies as st
from onnx import TensorProto

from birdslam.perception import ModelError, ModelSpec, load_network, shipped_manifests
from birdslam.perception.manifest_file import find_manifest, read_manifest
from birdslam.perception.onnx_files.subnormal import without_tiny_weights
from tests import tiny_networks as tiny
from tests.tiny_networks import DETECTOR, SEGMENTER


def write(network: Path, manifest: str) -> ModelSpec:
    network.with_suffix(".toml").write_text(manifest)
    return ModelSpec(str(network))


def refusal(spec: ModelSpec, name: str = "network") -> str:
    with pytest.raises(ModelError) as caught:
        load_network(name, spec)
    return str(caught.value)


def test_a_fitting_manifest_loads(tmp_path: Path) -> None:
    spec = write(tiny.echo(tmp_path / "a.onnx", (1, 3, 16, 32)), SEGMENTER)
    network = load_network("segmenter", spec)
    assert network.sha256 == hashlib.sha256((tmp_path / "a.onnx").read_bytes()).hexdigest()
    summary = network.describe()
    assert summary["file"] == "a.onnx"
    assert summary["sha256"] == network.sha256
    assert str(tmp_path) not in str(summary)


@pytest.mark.parametrize("shape", [("n", 3, "h", "w"), (None, None, None, None), ("n", "c", 16, 32)])
def test_a_dynamic_axis_is_fixed_by_the_manifest(tmp_path: Path, shape: tiny.Shape) -> None:
    network = load_network("segmenter", write(tiny.echo(tmp_path / "a.onnx", shape), SEGMENTER))
    findings = network.run(np.full((48, 64), 200, np.uint8))
    assert findings.segmentation.road.shape == (48, 64)


CONTRADICTIONS = [
    ('name = "images"', 'name = "image"', ["input.name", "'image'", "['images']"]),
    ("width_px = 32", "width_px = 40", ["input.width_px", "40", "32"]),
    ("height_px = 16", "height_px = 24", ["input.height_px", "24", "16"]),
    ("NCHW", "NHWC", ["input", "NHWC", "[1, 3, 16, 32]"]),
    ('output = "output"', 'output = "mask"', ["output", "'mask'", "['output']"]),
    ("channels = 3", "channels = 2", ["segmenter.maps[0].channels", "2", "3"]),
]


@pytest.mark.parametrize(("key", "wrong", "named"), CONTRADICTIONS)
def test_contradiction_names_file_key_and_both_values(tmp_path: Path, key: str, wrong: str, named: list[str]) -> None:
    message = refusal(write(tiny.echo(tmp_path / "a.onnx", (1, 3, 16, 32)), SEGMENTER.replace(key, wrong)))
    for part in [str(tmp_path / "a.onnx"), str(tmp_path / "a.toml"), *named]:
        assert part in message


def test_a_network_of_another_kind_is_refused(tmp_path: Path) -> None:
    assert "the inputs ['images', 'other']" in refusal(
        write(tiny.two_inputs(tmp_path / "two.onnx", (1, 3, 16, 32)), SEGMENTER)
    )
    assert "[1, 3, 16]" in refusal(write(tiny.echo(tmp_path / "flat.onnx", (1, 3, 16)), SEGMENTER))
    assert "tensor(double)" in refusal(
        write(tiny.echo(tmp_path / "double.onnx", (1, 3, 16, 32), TensorProto.DOUBLE), SEGMENTER)
    )


@pytest.mark.parametrize(
    ("shape", "named"),
    [
        ((1, 84, 8), ["detector.classes", "7 channels", "8 channels"]),
        ((1, 80, 7), ["detector.strides", "[8, 16, 32] over 64x64", "84 cells", "80 cells"]),
        ((84, 7), ["detector.output", "(1, cells, 5 + classes)", "(84, 7)"]),
    ],
)
def test_a_detector_of_another_shape_is_refused(tmp_path: Path, shape: tuple[int, ...], named: list[str]) -> None:
    network = tiny.constant(tmp_path / "a.onnx", (1, 3, 64, 64), np.zeros(shape, np.float32))
    message = refusal(write(network, DETECTOR))
    for part in [str(network), *named]:
        assert part in message


BAD_TEXTS = [
    (SEGMENTER + "colour = 1\n", "colour"),
    (SEGMENTER.replace("[input]", "[input]\nsise = 4"), "sise"),
    (SEGMENTER.replace('decoding = "class_maps"', 'decoding = "yolov9"'), "yolov9"),
    (SEGMENTER.replace('"RGB"', '"RBG"'), "RBG"),
    (SEGMENTER.replace("width_px = 32", ""), "width_px"),
    (SEGMENTER.replace("width_px = 32", "width_px = '32'"), "width_px"),
    (SEGMENTER.replace("channel = 1", "channel = 3"), "channel: 3 is not one of 3 channels"),
    (SEGMENTER.replace("channels = 3", "channels = 3\nthreshold = 0.5"), 'needs rule = "above"'),
    (SEGMENTER.replace('role = "segmenter"', 'role = "detector"'), "role: a detector needs the table [detector]"),
    (SEGMENTER + "[tiles]\ncolumns = 2\n", "tiles: only a detector can run on tiles"),
    (SEGMENTER.replace("[segmenter]", "[segmenter"), "line"),
    (SEGMENTER.replace('"RGB"', '"RGB"\nstd = [1, 0, 1]'), "std must be positive"),
    (SEGMENTER.replace('"RGB"', '"RGB"\nscale = nan'), "finite"),
    (DETECTOR + '7 = "bus"\n', "labels: class 7 is not one of 2 classes"),
    (DETECTOR.replace('"car"', '"cra"'), "cra"),
]


@pytest.mark.parametrize(("text", "named"), BAD_TEXTS)
def test_a_bad_manifest_is_refused_by_name(tmp_path: Path, text: str, named: str) -> None:
    path = tmp_path / "m.toml"
    path.write_text(text)
    with pytest.raises(ModelError) as caught:
        read_manifest(path)
    assert str(path) in str(caught.value)
    assert named in str(caught.value)


def test_invalid_files_are_refused(tmp_path: Path) -> None:
    assert f"{tmp_path / 'no.onnx'}: the network can't be read" in refusal(ModelSpec(str(tmp_path / "no.onnx")))
    whole = tiny.echo(tmp_path / "a.onnx", (1, 3, 16, 32))
    torn = tmp_path / "torn.onnx"
    torn.write_bytes(whole.read_bytes()[:-20])
    for content in (torn.read_bytes(), b"", b"no network"):
        torn.write_bytes(content)
        assert f"{torn}: onnxruntime can't run this network" in refusal(write(torn, SEGMENTER))
    (tmp_path / "binary.toml").write_bytes(b"\xff\xfe\x00")
    assert "binary.toml" in refusal(ModelSpec(str(whole), manifest=str(tmp_path / "binary.toml")))


def test_manifest_lookup_order(tmp_path: Path) -> None:
    network = tiny.echo(tmp_path / "mine.onnx", (1, 3, 16, 32))
    message = refusal(ModelSpec(str(network)))
    assert "mine.toml" in message
    assert all(name in message for name in shipped_manifests())

    name, shipped = next((n, p) for n, p in shipped_manifests().items() if read_manifest(p).sha256)
    pinned = read_manifest(shipped).sha256
    assert find_manifest(network, pinned)[1] == shipped  # by hash
    assert find_manifest(network, pinned, name)[1] == shipped  # by name
    spec = write(network, SEGMENTER)
    assert find_manifest(network, pinned)[1] == network.with_suffix(".toml")  # beside wins over the hash
    other = tmp_path / "other.toml"
    other.write_text(SEGMENTER)
    assert find_manifest(network, pinned, str(other))[1] == other  # explicit wins over beside
    assert "nowhere.toml" in refusal(ModelSpec(spec.path, manifest="nowhere.toml"))


def test_a_pinned_hash_must_be_the_files(tmp_path: Path) -> None:
    network = tiny.echo(tmp_path / "a.onnx", (1, 3, 16, 32))
    has = hashlib.sha256(network.read_bytes()).hexdigest()
    assert load_network("segmenter", write(network, f'sha256 = "{has}"\n' + SEGMENTER)).sha256 == has
    message = refusal(write(network, f'sha256 = "{"0" * 64}"\n' + SEGMENTER))
    assert "0" * 64 in message
    assert has in message
    # By its stem alone a shipped manifest is found too, and holds to its hash.
    name = next(iter(shipped_manifests()))
    stray = tiny.echo(tmp_path / f"{name}.onnx", (1, 3, 16, 32))
    assert read_manifest(shipped_manifests()[name]).sha256 in refusal(ModelSpec(str(stray)))


def test_head_named_after_a_role_has_that_role(tmp_path: Path) -> None:
    spec = write(tiny.echo(tmp_path / "a.onnx", (1, 3, 16, 32)), SEGMENTER)
    message = refusal(spec, "detector")
    assert "role: the manifest" in message
    assert "says segmenter" in message


def test_the_spec_overrides_the_manifests_schedule(tmp_path: Path) -> None:
    path = write(
        tiny.echo(tmp_path / "a.onnx", (1, 3, 16, 32)),
        SEGMENTER + "[schedule]\nevery = 3\nthreads = 2\nawaited = false\n",
    ).path
    said = load_network("segmenter", ModelSpec(path)).schedule
    assert (said.every, said.threads, said.awaited) == (3, 2, False)
    overridden = load_network("segmenter", ModelSpec(path, every=1, awaited=True)).schedule
    assert (overridden.every, overridden.threads, overridden.awaited) == (1, 2, True)


def test_shipped_manifests_are_sound() -> None:
    assert {"yolox_nano_416", "twinlitenet_640x360"} <= set(shipped_manifests())
    for path in shipped_manifests().values():
        read_manifest(path)


@given(st.integers(0, 2**32 - 1), st.sampled_from([0.0, 1e-45, 1e-39, 9e-21, -1e-30]))
def test_only_negligible_weights_become_zero(tmp_path_factory: pytest.TempPathFactory, seed: int, tiny_: float) -> None:
    rng = np.random.default_rng(seed)
    weights = rng.normal(size=(5, 4)).astype(np.float32)
    dead = rng.random(weights.shape) < 0.3
    weights[dead] = np.float32(tiny_)
    bias = np.full(4, 1e-30, np.float32)  # a vector stays
    content = tiny.dense(tmp_path_factory.mktemp("dense") / "a.onnx", weights, bias).read_bytes()
    cleaned = without_tiny_weights(content)
    assert len(cleaned) == len(content)
    assert without_tiny_weights(cleaned) == cleaned
    assert bias.tobytes() in cleaned
    assert np.where(dead, np.float32(0.0), weights).tobytes() in cleaned
    row = rng.normal(size=(1, 5)).astype(np.float32)
    before, after = (
        ort.InferenceSession(c, providers=["CPUExecutionProvider"]).run(None, {"images": row})
        for c in (content, cleaned)
    )
    np.testing.assert_allclose(after[0], before[0], rtol=0, atol=1e-18)
