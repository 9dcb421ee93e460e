"""ONNX files of a few nodes, made by the tests that need one, and manifests that fit such."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper, save_model

Shape = tuple[int | str | None, ...]

SEGMENTER = """
role = "segmenter"
[input]
name = "images"
width_px = 32
height_px = 16
layout = "NCHW"
colour = "RGB"
resize = { mode = "stretch" }
[segmenter]
decoding = "class_maps"
[[segmenter.maps]]
meaning = "road"
output = "output"
channel = 1
channels = 3
"""

DETECTOR = """
role = "detector"
[input]
name = "images"
width_px = 64
height_px = 64
layout = "NCHW"
colour = "BGR"
resize = { mode = "fit_pad" }
[detector]
decoding = "yolox"
output = "output"
strides = [8, 16, 32]
classes = 2
score_threshold = 0.3
nms_iou = 0.5
[detector.labels]
0 = "car"
"""


def _save(
    path: Path,
    nodes: list,
    inputs: dict[str, Shape],
    outputs: dict[str, Shape],
    weights: dict[str, NDArray] | None = None,
    dtype: int = TensorProto.FLOAT,
) -> Path:
    graph = helper.make_graph(
        nodes,
        "tiny",
        [helper.make_tensor_value_info(name, dtype, shape) for name, shape in inputs.items()],
        [helper.make_tensor_value_info(name, dtype, shape) for name, shape in outputs.items()],
        [numpy_helper.from_array(array, name) for name, array in (weights or {}).items()],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=9)
    save_model(model, path)
    return path


def echo(path: Path, shape: Shape, dtype: int = TensorProto.FLOAT, outputs: tuple[str, ...] = ("output",)) -> Path:
    """Each output is the input `images`: what the network is given can be read."""
    nodes = [helper.make_node("Identity", ["images"], [name]) for name in outputs]
    return _save(path, nodes, {"images": shape}, dict.fromkeys(outputs, shape), dtype=dtype)


def constant(path: Path, input_shape: Shape, answer: NDArray[np.float32]) -> Path:
    """`output` is `answer` whatever the image, and NaN for a black one."""
    nodes = [
        helper.make_node("ReduceMax", ["images"], ["brightest"], keepdims=0),
        helper.make_node("Log", ["brightest"], ["log"]),
        helper.make_node("Mul", ["log", "zero"], ["nothing"]),
        helper.make_node("Add", ["answer", "nothing"], ["output"]),
    ]
    weights = {"answer": answer.astype(np.float32), "zero": np.zeros(1, np.float32)}
    return _save(path, nodes, {"images": input_shape}, {"output": answer.shape}, weights)


def constants(path: Path, input_shape: Shape, answers: dict[str, NDArray[np.float32]]) -> Path:
    """Each output is its answer whatever the image."""
    return answering(path, {"images": input_shape}, answers)


def answering(path: Path, inputs: dict[str, Shape], answers: dict[str, NDArray]) -> Path:
    """Each output is its answer whatever the inputs, which it must have."""
    nodes = [helper.make_node("Identity", [f"{name}_"], [name]) for name in answers]
    weights = {f"{name}_": answer.astype(np.float32) for name, answer in answers.items()}
    return _save(path, nodes, inputs, {n: a.shape for n, a in answers.items()}, weights)


def two_inputs(path: Path, shape: Shape) -> Path:
    """Takes `images` and `other`."""
    nodes = [helper.make_node("Add", ["images", "other"], ["output"])]
    return _save(path, nodes, {"images": shape, "other": shape}, {"output": shape})


def dense(path: Path, weights: NDArray[np.float32], bias: NDArray[np.float32]) -> Path:
    """`output` = `images` @ weights + bias, on rows."""
    nodes = [helper.make_node("MatMul", ["images", "w"], ["m"]), helper.make_node("Add", ["m", "b"], ["output"])]
    rows, columns = weights.shape
    return _save(path, nodes, {"images": (1, rows)}, {"output": (1, columns)}, {"w": weights, "b": bias})
