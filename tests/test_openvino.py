"""OpenVINO IRs to ONNX: what each layer becomes, what is refused, and the two networks of the catalogue whole."""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime as ort
import pytest
from numpy.typing import NDArray
from onnx import helper, numpy_helper

from birdslam.perception import ModelSpec, load_network
from birdslam.perception.onnx_files.openvino_ir import IrError
from birdslam.perception.onnx_files.openvino_onnx import convert, weights_sha256
from birdslam.runtime.cli.main import main
from birdslam.runtime.models import catalogue as catalogue_module
from birdslam.runtime.models.catalogue import probing_image
from tests import tiny_ir
from tests.test_models import left_in, refused, serve_files
from tests.tiny_ir import Ir, Port

MODELS = Path(os.environ.get("BIRDSLAM_MODELS", Path(__file__).parents[2] / "shared" / "models"))
NETWORKS = {"vehicle_adas": "vehicle_detection_adas_0002_640x192", "road_adas": "road_segmentation_adas_0001_640x192"}
at_hand = pytest.mark.skipif(
    not all((MODELS / f"{stem}.onnx").is_file() for stem in NETWORKS.values()),
    reason=f"the two networks are not in {MODELS}",
)


def answer(network: bytes, image: NDArray[np.float32]) -> dict[str, NDArray[np.float32]]:
    session = ort.InferenceSession(network, providers=["CPUExecutionProvider"])
    return dict(zip([o.name for o in session.get_outputs()], session.run(None, {"image": image}), strict=True))


def image_of(height_px: int, width_px: int) -> NDArray[np.float32]:
    return np.random.default_rng(3).uniform(0.0, 255.0, (1, 3, height_px, width_px)).astype(np.float32)


# --- the layers ---


def test_convolutions_pools_and_sums_are_what_they_say() -> None:
    ir = Ir()
    image = ir.image(8, 12)
    scaled = ir.layer("Multiply", [image, ir.const([[[[0.5]]]])], image[2])
    wide = ir.convolution(scaled, np.ones((3, 1, 3, 3)), image[2], pads=(1, 1, 1, 1), groups=3)
    narrow = ir.convolution(wide, np.full((2, 3, 1, 1), 0.25), (1, 2, 4, 6), strides=(2, 2))
    moved = ir.layer("Add", [narrow, ir.const(np.full((1, 2, 1, 1), -300.0))], narrow[2])
    kept = ir.layer("ReLU", [moved], narrow[2])
    how = {"kernel": "2,2", "pads_begin": "0,0", "pads_end": "0,0", "rounding_type": "ceil", "strides": "2,2"}
    ir.result(ir.layer("MaxPool", [kept], (1, 2, 2, 3), **how))
    ir.result(ir.layer("AvgPool", [kept], (1, 2, 2, 3), exclude_0_pad="false", **how))
    given = image_of(8, 12)
    found = answer(convert(ir.xml, ir.weights, 12, 8, ("largest", "mean")), given)

    padded = np.pad(given[0] * 0.5, ((0, 0), (1, 1), (1, 1)))
    summed = sum(padded[:, dy : dy + 8, dx : dx + 12] for dy in range(3) for dx in range(3)).sum(axis=0) * 0.25
    rest = np.maximum(summed[::2, ::2] - 300.0, 0.0).reshape(2, 2, 3, 2)
    np.testing.assert_allclose(found["largest"][0, 0], rest.max(axis=(1, 3)), rtol=1e-4)
    np.testing.assert_allclose(found["mean"][0, 1], rest.mean(axis=(1, 3)), rtol=1e-4)


@pytest.mark.parametrize(("height_px", "width_px"), [(4, 6), (8, 18)])
def test_another_size_of_the_input_scales_what_was_fixed(height_px: int, width_px: int) -> None:
    """Made for 4x6: the map is twice as large, and the rows are of the shape that they have at any size."""
    ir = Ir()
    image = ir.image(4, 6)
    target = ir.const([8, 12], "i64")
    how = {"align_corners": 1, "antialias": 0, "axes": "2,3", "mode": "linear", "pads_begin": 0, "pads_end": 0}
    ir.result(ir.layer("Interpolate", [image, target], (1, 3, 8, 12), **how))
    turned = ir.layer("Transpose", [image, ir.const([0, 2, 3, 1], "i64")], (1, 4, 6, 3))
    flat = ir.layer("Reshape", [turned, ir.const([0, -1], "i64")], (1, 72), special_zero="True")
    both = ir.layer("Concat", [flat, flat], (1, 144), axis=1)
    rows = ir.layer("Reshape", [both, ir.const([0, -1, 3], "i64")], (1, 48, 3), special_zero="True")
    ir.result(ir.layer("SoftMax", [rows], (1, 48, 3), axis=2))
    given = image_of(height_px, width_px)
    found = answer(convert(ir.xml, ir.weights, width_px, height_px, ("larger", "shares")), given)
    assert found["larger"].shape == (1, 3, 2 * height_px, 2 * width_px)
    np.testing.assert_allclose(found["larger"][..., ::-1, ::-1][..., 0, 0], given[..., -1, -1], rtol=1e-5)
    pixels = given[0].reshape(3, -1).T.astype(np.float64)
    shares = np.exp(pixels - pixels.max(axis=1, keepdims=True))
    shares /= shares.sum(axis=1, keepdims=True)
    np.testing.assert_allclose(found["shares"][0], np.vstack([shares, shares]), atol=1e-5)


def detector(prior: dict[str, Any] | None = None, code: str = "caffe.PriorBoxParameter.CENTER_SIZE") -> Ir:
    """Four shapes of box in each of 2x3 cells of an image 32x48; locations are the map itself."""
    ir = Ir()
    image = ir.image(32, 48)
    kernels = np.random.default_rng(0).normal(size=(16, 3, 1, 1)) / 255.0
    locations = ir.convolution(image, kernels, (1, 16, 2, 3), strides=(16, 16))
    chosen = {"min_size": "16.0", "max_size": "36.0", "aspect_ratio": "4.0", "step": "16.0"} if prior is None else prior
    priors = ir.priors(locations, image, 24, **chosen)
    flat = []
    for channels, of in ((16, locations), (8, ir.convolution(image, kernels[:8], (1, 8, 2, 3), strides=(16, 16)))):
        turned = ir.layer("Transpose", [of, ir.const([0, 2, 3, 1], "i64")], (1, 2, 3, channels))
        flat.append(ir.layer("Reshape", [turned, ir.const([0, -1], "i64")], (1, 6 * channels), special_zero="True"))
    found = ir.layer("DetectionOutput", [*flat, priors], (1, 1, 200, 7), num_classes=2, code_type=code)
    ir.result(found)
    return ir


def test_a_detection_output_becomes_what_it_would_have_been_made_of() -> None:
    ir = detector()
    found = answer(convert(ir.xml, ir.weights, 48, 32, ()), image_of(32, 48))
    assert {name: numbers.shape for name, numbers in found.items()} == {
        "loc": (1, 24, 4),
        "conf": (1, 24, 2),
        "priors": (24, 4),
    }
    px = found["priors"] * [48.0, 32.0, 48.0, 32.0]
    sides = [(16.0, 16.0), (24.0, 24.0), (32.0, 8.0), (8.0, 32.0)]  # least, geometric mean, and the two aspects
    for cell in range(6):
        centre = np.array([8.0 + 16.0 * (cell % 3), 8.0 + 16.0 * (cell // 3)])
        for k, side in enumerate(sides):
            half = np.array(side) / 2.0
            np.testing.assert_allclose(px[4 * cell + k], [*(centre - half), *(centre + half)], atol=1e-4)


def test_without_a_step_the_cells_share_the_image() -> None:
    ir = detector({"min_size": "16.0", "max_size": "36.0", "aspect_ratio": "4.0"})
    priors = answer(convert(ir.xml, ir.weights, 96, 32, ()), image_of(32, 96))["priors"]
    assert priors.shape == (48, 4)  # twice as many cells in a row
    np.testing.assert_allclose((priors[:, 0] + priors[:, 2])[::4] / 2.0, np.tile((np.arange(6) + 0.5) / 6.0, 2))


def test_the_same_ir_gives_the_same_bytes_and_weights_whatever_their_names() -> None:
    ir = detector()
    once, twice = (convert(ir.xml, ir.weights, 48, 32, ()) for _ in range(2))
    assert once == twice
    renamed = onnx.load_model_from_string(once)
    for tensor in renamed.graph.initializer:
        tensor.name = f"x{tensor.name}"
    for node in renamed.graph.node:
        node.input[:] = [f"x{name}" if name.startswith("c") else name for name in node.input]
    renamed.graph.initializer.reverse()
    assert weights_sha256(renamed.SerializeToString()) == weights_sha256(once)
    assert weights_sha256(convert(ir.xml, ir.weights, 96, 32, ())) == weights_sha256(once)
    other = bytearray(ir.weights)
    other[1] ^= 1
    assert weights_sha256(convert(ir.xml, bytes(other), 48, 32, ())) != weights_sha256(once)


# --- what is refused ---


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (
            lambda xml, data: (xml.replace(b'type="Transpose"', b'type="Gather"'), data),
            "type Gather are not known here",
        ),
        (lambda xml, data: (xml, data[:40]), r"bytes at \d+ of 40 are no"),
        (lambda xml, data: (xml[: len(xml) // 2], data), "no XML"),
        (lambda xml, data: (b"<html></html>", data), "no IR of version 10"),
        (lambda xml, data: (xml.replace(b'version="10"', b'version="7"'), data), "no IR of version 10"),
        (lambda xml, data: (xml.replace(b"<net", b"<!DOCTYPE net [<!ENTITY a 'b'>]><net", 1), data), "no entities"),
        (lambda xml, data: (xml.replace(b'from-layer="1"', b'from-layer="99"'), data), "a layer that is not there"),
        (lambda xml, data: (xml.replace(b'from-layer="0"', b'from-layer="2"'), data), "in a circle"),
        (lambda xml, data: (xml.replace(b'strides="16,16"', b"", 1), data), "Convolution.*'strides'"),
        (lambda xml, data: (xml.replace(b'density=""', b'density="2"'), data), "prior boxes with density"),
        (lambda xml, data: (xml.replace(b"CENTER_SIZE", b"CORNER"), data), "boxes coded as .*CORNER"),
        (lambda xml, data: (xml.replace(b'shape="1,3,32,48"', b'shape="1,1,32,48"'), data), "an image .1, 3, H, W. is"),
        (lambda xml, data: (xml.replace(b' id="0"', b"", 1), data), "a layer is incomplete"),
    ],
)
def test_an_ir_that_is_not_understood_is_refused_with_the_reason(change: Any, said: str) -> None:
    ir = detector()
    xml, weights = change(ir.xml, ir.weights)
    with pytest.raises(IrError, match=said):
        convert(xml, weights, 48, 32, ())


def test_results_need_their_names() -> None:
    ir = Ir()
    image = ir.image(4, 6)
    ir.result(ir.layer("ReLU", [image], image[2]))
    for names in ((), ("a", "b")):
        with pytest.raises(IrError, match=f"1 results, {len(names)} are named"):
            convert(ir.xml, ir.weights, 6, 4, names)


# --- the catalogue's networks: written as an IR from the converted ones, served, converted back ---

# min_size, max_size, step and aspect ratios of the vehicle network's eight prior boxes
PRIORS = (
    (16.0, 38.4, 16.0, "2.0"),
    (38.4, 76.8, 16.0, "2.0"),
    (76.8, 124.8, 32.0, "2.0,3.0"),
    (124.8, 172.8, 32.0, "2.0,3.0"),
    (172.8, 230.4, 64.0, "2.0,3.0"),
    (230.4, 288.0, 128.0, "2.0,3.0"),
    (288.0, 345.6, None, "2.0"),
    (345.6, 403.2, None, "2.0"),
)
TWICE = 2  # the IR is of an input so many times as large: what is fixed in it must be scaled back


def as_ir(network: onnx.ModelProto) -> Ir:
    """The IR of one of the two networks, with the layers and the order of numbers that Intel's files have."""
    ir, graph = Ir(), network.graph
    arrays = {tensor.name: numpy_helper.to_array(tensor) for tensor in graph.initializer}
    shapes = {
        info.name: tuple(d.dim_value for d in info.type.tensor_type.shape.dim)
        for info in onnx.shape_inference.infer_shapes(network).graph.value_info
    }
    height_px, width_px = (d.dim_value for d in graph.input[0].type.tensor_type.shape.dim[2:])
    image = ir.image(TWICE * height_px, TWICE * width_px)
    ports: dict[str, Port] = {"image": image}
    locations: list[Port] = []
    for node in graph.node:
        how = {a.name: helper.get_attribute_value(a) for a in node.attribute}
        shape = shapes.get(node.output[0], ())
        large = (*shape[:2], *(TWICE * size for size in shape[2:])) if len(shape) == 4 else shape
        given = node.input[:1] if node.op_type in ("Conv", "Reshape", "Resize") else node.input
        taken = [ports[name] if name in ports else ir.const(arrays[name]) for name in given if name != "prior_boxes"]
        window = {
            "pads_begin": tiny_ir.comma(how.get("pads", [0] * 4)[:2]),
            "pads_end": tiny_ir.comma(how.get("pads", [0] * 4)[2:]),
            "rounding_type": "ceil",
        }
        match node.op_type:
            case "Conv":
                made = ir.convolution(
                    taken[0], arrays[node.input[1]], large, how["strides"], how["pads"], how["group"], how["dilations"]
                )
            case "Add" | "Mul":
                made = ir.layer({"Add": "Add", "Mul": "Multiply"}[node.op_type], taken, large)
            case "Relu":
                made = ir.layer("ReLU", taken, large)
            case "MaxPool" | "AveragePool":
                sizes = {"kernel": tiny_ir.comma(how["kernel_shape"]), "strides": tiny_ir.comma(how["strides"])}
                kind, more = ("MaxPool", {}) if node.op_type == "MaxPool" else ("AvgPool", {"exclude_0_pad": "false"})
                made = ir.layer(kind, taken, large, **sizes, **window, **more)
            case "Resize":
                target = ir.const([TWICE * size for size in arrays[node.input[3]][2:]], "i64")
                corners = {"align_corners": 1, "antialias": 0, "axes": "2,3", "mode": "linear"}
                made = ir.layer("Interpolate", [taken[0], target], large, **corners, pads_begin=0, pads_end=0)
            case "Transpose":
                locations.append(taken[0])
                made = ir.layer("Transpose", [taken[0], ir.const(how["perm"], "i64")], shape)
            case "Reshape" if node.output[0] in ("loc", "conf"):
                made = taken[0]
            case "Reshape":
                wanted = [0, -1, 2] if len(arrays[node.input[1]]) == 3 else [0, -1]
                made = ir.layer("Reshape", [taken[0], ir.const(wanted, "i64")], shape, special_zero="True")
            case "Concat":
                made = ir.layer("Concat", [ports[name] for name in node.input], shape, axis=1)
            case "Softmax":
                made = ir.layer("SoftMax", taken, shape, axis=how["axis"])
            case "Identity" if node.output[0] == "classes":
                ir.result(ports[node.input[0]])
                continue
            case "Identity":
                continue
        ports[node.output[0]] = made
    if "loc" in ports:
        boxes = [
            ir.priors(
                of,
                image,
                0,  # the count is for the ports' shapes alone
                min_size=small,
                max_size=large_px,
                aspect_ratio=ratios,
                **({} if step is None else {"step": step}),
            )
            for of, (small, large_px, step, ratios) in zip(locations[:8], PRIORS, strict=True)
        ]
        priors = ir.layer("Concat", boxes, (1, 2, 0), axis=2)
        code = {"code_type": "caffe.PriorBoxParameter.CENTER_SIZE", "num_classes": 2}
        ir.result(ir.layer("DetectionOutput", [ports["loc"], ports["conf"], priors], (1, 1, 200, 7), **code))
    return ir


@at_hand
@pytest.mark.parametrize("name", ["vehicle_adas", pytest.param("road_adas", marks=pytest.mark.slow)])
def test_an_ir_of_the_catalogue_is_fetched_converted_and_installed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], name: str
) -> None:
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "data"))
    store, served = tmp_path / "data" / "birdslam" / "models", tmp_path / "served"
    entry, original = catalogue_module.catalogue().models[name], MODELS / f"{NETWORKS[name]}.onnx"
    ir = as_ir(onnx.load(original))
    xml = served / entry.repository / entry.commit / entry.path
    xml.parent.mkdir(parents=True)
    xml.write_bytes(ir.xml)
    xml.with_suffix(".bin").write_bytes(ir.weights)
    assert max(len(ir.xml), len(ir.weights)) < entry.size_bytes
    lines = catalogue_module.CATALOGUE.read_text().splitlines()
    at = next(k for k, line in enumerate(lines) if line.startswith("address"))
    monkeypatch.setattr(catalogue_module, "CATALOGUE", tmp_path / "catalogue.toml")
    for _, address in serve_files(served):
        lines[at] = f'address = "{address}/{{repository}}/{{commit}}/{{path}}"'
        catalogue_module.CATALOGUE.write_text("\n".join(lines))
        assert main(["models", "add", name]) == 0
        ours = load_network("", ModelSpec(str(store / name / f"{name}.onnx"))).answer(probing_image())
        for output, numbers in load_network("", ModelSpec(str(original))).answer(probing_image()).items():
            np.testing.assert_allclose(ours[output], numbers, atol=2e-4, err_msg=output)
        capsys.readouterr()

        weights = bytearray(ir.weights)
        weights[101] ^= 1
        xml.with_suffix(".bin").write_bytes(weights)
        assert "its weights have the SHA-256" in refused(capsys, "add", name)
        xml.with_suffix(".bin").write_bytes(ir.weights)
        xml.write_bytes(ir.xml.replace(b'type="ReLU"', b'type="Sigmoid"', 1))
        assert "type Sigmoid are not known" in refused(capsys, "add", name)
        relu = int(re.findall(rb'<layer id="(\d+)" name="[^"]*" type="ReLU"', ir.xml)[0])
        around = ir.xml.replace(b'from-layer="%d" from-port="1"' % relu, b'from-layer="%d" from-port="2"' % (relu - 1))
        xml.write_bytes(around)  # what took from the first ReLU takes from what that takes from
        assert "on the probing image" in refused(capsys, "add", name)
        xml.with_suffix(".bin").unlink()
        assert "the server says 404" in refused(capsys, "add", name)
        assert left_in(store) == {name}
