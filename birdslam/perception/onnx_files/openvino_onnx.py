"""OpenVINO's intermediate representation to ONNX, for networks that are published in it alone.

OpenVINO itself writes no ONNX, so this does, for the kinds of layers that Open Model Zoo's road and vehicle networks
have (`_LAYERS`); any other is refused by name. The graph is converted for an input size of choice: what depends on it
(prior boxes, the sizes that maps are resized to) follows. Constants become float32. ONNX has no DetectionOutput: its
three inputs become the outputs `loc` (1, N, 4), `conf` (1, N, classes) and `priors` (N, 4). Needs the extra `models`
(onnx).
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from birdslam.geometry.arrays import Floats32
from birdslam.perception.onnx_files.openvino_ir import IrError, Layer, read_layers

INPUT = "image"
OPSET, IR_VERSION = 17, 9  # read by every onnxruntime that the package takes
ELEMENTS = {"f16": "<f2", "f32": "<f4", "i32": "<i4", "i64": "<i8"}
MOST_NUMBERS = 1 << 24  # in one constant
_WEIGHING = ("Conv", "Add", "Mul")  # operators whose constants are weights


@dataclass(frozen=True)
class Tensor:
    """A value of the converted graph that depends on the image."""

    name: str
    shape: tuple[int, ...]


Value = Tensor | NDArray[Any]


def convert(xml: bytes, weights: bytes, width_px: int, height_px: int, outputs: Sequence[str]) -> bytes:
    """The network as ONNX bytes, for an image (1, 3, height, width) named `image`; `outputs` names its results in turn.

    With the same onnx package the bytes are always the same. Raises IrError, and ImportError without onnx.
    """
    layers = read_layers(xml)
    graph = _Graph(weights, (1, 3, height_px, width_px))
    values: dict[tuple[str, str], Value] = {}
    for layer in layers:
        make = _LAYERS.get(layer.type)
        if make is None:
            raise IrError(f"layer {layer.name!r}: layers of type {layer.type} are not known here")
        try:
            made = make(graph, layer, [values[source] for source in layer.sources])
        except IrError:
            raise
        except (KeyError, ValueError, IndexError, TypeError) as error:
            raise IrError(f"layer {layer.name!r} ({layer.type}): {type(error).__name__}: {error}") from error
        values.update({(layer.id, port): made for port in layer.outputs if made is not None})
    return graph.model(outputs)


def weights_sha256(onnx_file: bytes) -> str:
    """SHA-256 over a network's weights alone: its float constants that a Conv, Add or Mul takes, whatever their names.

    It is the hash of the sorted hashes of each one's shape and little-endian float32 numbers, so that a network has the
    same however it was converted. `onnx_file` must be one. Raises ImportError without onnx.
    """
    import onnx  # of an extra
    from onnx import numpy_helper

    graph = onnx.load_model_from_string(onnx_file).graph
    weighing = {name for node in graph.node if node.op_type in _WEIGHING for name in node.input}
    arrays = [numpy_helper.to_array(tensor) for tensor in graph.initializer if tensor.name in weighing]
    return hashlib.sha256(b"".join(sorted(_digest(a) for a in arrays if a.dtype == np.float32))).hexdigest()


def _digest(array: Floats32) -> bytes:
    numbers = np.ascontiguousarray(array, dtype="<f4")
    return hashlib.sha256(repr(numbers.shape).encode() + numbers.tobytes()).digest()


# --- the graph that is made ---


@dataclass
class _Graph:
    """Nodes and constants of the ONNX graph."""

    weights: bytes
    image_shape: tuple[int, ...]
    nodes: list[Any] = field(default_factory=list)
    constants: dict[str, NDArray[Any]] = field(default_factory=dict)
    results: list[tuple[str | None, Value]] = field(default_factory=list)  # with the name, where it has one

    def add(self, operator: str, inputs: Sequence[Value | None], shape: tuple[int, ...], **attributes: Any) -> Tensor:
        """A node; its output is a value of `shape`."""
        from onnx import helper

        name = f"t{len(self.nodes)}"
        names = ["" if value is None else self._name(value) for value in inputs]
        self.nodes.append(helper.make_node(operator, names, [name], **attributes))
        return Tensor(name, shape)

    def _name(self, value: Value) -> str:
        if isinstance(value, Tensor):
            return value.name
        name = f"c{len(self.constants)}"
        self.constants[name] = value
        return name

    def model(self, outputs: Sequence[str]) -> bytes:
        """The whole of it, checked."""
        from onnx import TensorProto, checker, helper, numpy_helper

        names = iter(outputs)
        results = [(name or next(names, ""), value) for name, value in self.results]
        if any(not name for name, _ in results) or next(names, None) is not None:
            raise IrError(f"the network has {len(results)} results, {len(outputs)} are named")
        self.nodes += [helper.make_node("Identity", [self._name(value)], [name]) for name, value in results]
        graph = helper.make_graph(
            self.nodes,
            "network",
            [helper.make_tensor_value_info(INPUT, TensorProto.FLOAT, self.image_shape)],
            [helper.make_tensor_value_info(name, TensorProto.FLOAT, value.shape) for name, value in results],
            [numpy_helper.from_array(array, name) for name, array in self.constants.items()],
        )
        model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", OPSET)], ir_version=IR_VERSION)
        checker.check_model(model)
        return model.SerializeToString(deterministic=True)


# --- the layers ---


def _parameter(graph: _Graph, layer: Layer, inputs: list[Value]) -> Value:
    if len(layer.ints("shape")) != 4 or layer.ints("shape")[:2] != [1, 3]:
        raise IrError(f"layer {layer.name!r}: an image (1, 3, H, W) is needed, it is {layer.data['shape']}")
    return Tensor(INPUT, graph.image_shape)


def _const(graph: _Graph, layer: Layer, inputs: list[Value]) -> Value:
    dtype = np.dtype(ELEMENTS[layer.data["element_type"]])
    shape = tuple(layer.ints("shape")) if layer.data["shape"] else ()
    at, size, count = int(layer.data["offset"]), int(layer.data["size"]), math.prod(shape)
    if not 0 <= count <= MOST_NUMBERS or size != count * dtype.itemsize or not 0 <= at <= len(graph.weights) - size:
        raise IrError(f"layer {layer.name!r}: {size} bytes at {at} of {len(graph.weights)} are no {shape}")
    numbers = np.frombuffer(graph.weights, dtype, count, at).reshape(shape)
    return numbers.astype(np.float32 if dtype.kind == "f" else np.int64)


def _convolution(graph: _Graph, layer: Layer, inputs: list[Value]) -> Value:
    """GroupConvolution has its weights as (groups, out, in, h, w)."""
    image, kernel = _tensor(inputs[0]), _array(inputs[1])
    groups = kernel.shape[0] if layer.type == "GroupConvolution" else 1
    kernel = kernel.reshape(-1, *kernel.shape[-3:])
    shape = (1, kernel.shape[0], *_window(layer, image.shape, kernel.shape[2:], layer.ints("dilations")))
    how = {"strides": layer.ints("strides"), "dilations": layer.ints("dilations"), "pads": _pads(layer)}
    return graph.add("Conv", [image, kernel], shape, group=groups, **how)


def _pool(graph: _Graph, layer: Layer, inputs: list[Value]) -> Value:
    image, kernel = _tensor(inputs[0]), layer.ints("kernel")
    shape = (*image.shape[:2], *_window(layer, image.shape, kernel, [1, 1]))
    how: dict[str, Any] = {"kernel_shape": kernel, "strides": layer.ints("strides"), "pads": _pads(layer)}
    how["ceil_mode"] = int(layer.data.get("rounding_type") == "ceil")
    if layer.type == "MaxPool":
        return graph.add("MaxPool", [image], shape, **how)
    return graph.add("AveragePool", [image], shape, count_include_pad=int(layer.data["exclude-pad"] == "false"), **how)


def _pads(layer: Layer) -> list[int]:
    if layer.data.get("auto_pad", "explicit") not in ("explicit", "notset"):
        raise IrError(f"layer {layer.name!r}: auto_pad {layer.data['auto_pad']} is not known here")
    return layer.ints("pads_begin") + layer.ints("pads_end")


def _window(layer: Layer, shape: tuple[int, ...], kernel: Sequence[int], dilations: Sequence[int]) -> list[int]:
    """(h, w) of what a sliding window gives."""
    up = layer.data.get("rounding_type") == "ceil"
    out = []
    for k in range(2):
        room = shape[2 + k] + layer.ints("pads_begin")[k] + layer.ints("pads_end")[k]
        room -= dilations[k] * (kernel[k] - 1) + 1
        stride = layer.ints("strides")[k]
        out.append((-(-room // stride) if up else room // stride) + 1)
    return out


def _arithmetic(graph: _Graph, layer: Layer, inputs: list[Value]) -> Value:
    shape = np.broadcast_shapes(*(value.shape for value in inputs))
    return graph.add({"Add": "Add", "Multiply": "Mul"}[layer.type], inputs, shape)


def _relu(graph: _Graph, layer: Layer, inputs: list[Value]) -> Value:
    return graph.add("Relu", inputs, inputs[0].shape)


def _softmax(graph: _Graph, layer: Layer, inputs: list[Value]) -> Value:
    return graph.add("Softmax", inputs, inputs[0].shape, axis=int(layer.data["axis"]))


def _transpose(graph: _Graph, layer: Layer, inputs: list[Value]) -> Value:
    order = [int(axis) for axis in _array(inputs[1])]
    return graph.add("Transpose", inputs[:1], tuple(inputs[0].shape[axis] for axis in order), perm=order)


def _reshape(graph: _Graph, layer: Layer, inputs: list[Value]) -> Value:
    """A 0 keeps an axis, as in ONNX; -1 takes what is left."""
    has, wanted = inputs[0].shape, [int(size) for size in _array(inputs[1])]
    shape = [has[k] if size == 0 else size for k, size in enumerate(wanted)]
    if -1 in shape:
        shape[shape.index(-1)] = math.prod(has) // -math.prod(shape)
    return graph.add("Reshape", [inputs[0], np.array(shape, dtype=np.int64)], tuple(shape))


def _concat(graph: _Graph, layer: Layer, inputs: list[Value]) -> Value:
    axis = int(layer.data["axis"])
    if not any(isinstance(value, Tensor) for value in inputs):
        return np.concatenate([_array(value) for value in inputs], axis=axis)
    shape = list(inputs[0].shape)
    shape[axis] = sum(value.shape[axis] for value in inputs)
    return graph.add("Concat", inputs, tuple(shape), axis=axis)


def _interpolate(graph: _Graph, layer: Layer, inputs: list[Value]) -> Value:
    """The target in the file is for its own input size: kept is the factor."""
    how = layer.data
    if (how["mode"], how["axes"], how["align_corners"], how.get("antialias", "0")) != ("linear", "2,3", "1", "0"):
        raise IrError(f"layer {layer.name!r}: only linear interpolation of height and width by their corners is known")
    image, stated, target = _tensor(inputs[0]), layer.input_shapes[0][2:], _array(inputs[1])
    size = [round(now * int(to) / was) for now, to, was in zip(image.shape[2:], target, stated, strict=True)]
    sizes = np.array([*image.shape[:2], *size], dtype=np.int64)
    corners = {"mode": "linear", "coordinate_transformation_mode": "align_corners"}
    return graph.add("Resize", [image, None, None, sizes], tuple(int(s) for s in sizes), **corners)


def _shape_of(graph: _Graph, layer: Layer, inputs: list[Value]) -> Value:
    return np.array(inputs[0].shape, dtype=np.int64)


def _same(graph: _Graph, layer: Layer, inputs: list[Value]) -> Value:
    """A conversion between integers, which are all of one kind here."""
    if layer.data["destination_type"] not in ("i32", "i64"):
        raise IrError(f"layer {layer.name!r}: a conversion to {layer.data['destination_type']} is not known here")
    return _array(inputs[0])


def _slice(graph: _Graph, layer: Layer, inputs: list[Value]) -> Value:
    """Of a vector; a mask of 1 ignores the bound."""
    vector, begin, end, step = (_array(value) for value in inputs)
    first = None if layer.data["begin_mask"] == "1" else int(begin[0])
    last = None if layer.data["end_mask"] == "1" else int(end[0])
    if vector.ndim != 1 or {layer.data.get(f"{k}_mask", "0") for k in ("ellipsis", "new_axis", "shrink_axis")} != {"0"}:
        raise IrError(f"layer {layer.name!r}: only a plain slice of a vector is known")
    return vector[first : last : int(step[0])]


def _unsqueeze(graph: _Graph, layer: Layer, inputs: list[Value]) -> Value:
    return np.expand_dims(_array(inputs[0]), tuple(int(axis) for axis in _array(inputs[1])))


def _prior_box(graph: _Graph, layer: Layer, inputs: list[Value]) -> Value:
    """(2, 4 N): corners as fractions of the image, and variances; by cell, and in each by shape (as Caffe's SSD)."""
    (rows, columns), (height_px, width_px) = (_array(value).tolist() for value in inputs)
    data = layer.data
    if any(layer.floats(key) for key in ("density", "fixed_ratio", "fixed_size")) or data.get("clip", "0") not in (
        "0",
        "false",
    ):
        raise IrError(f"layer {layer.name!r}: prior boxes with density, fixed sizes or clipping are not known here")
    small, large = layer.floats("min_size"), layer.floats("max_size")
    ratios = [r for r in layer.floats("aspect_ratio") if abs(r - 1.0) > 1e-6]
    flip = data.get("flip", "0") in ("1", "true")
    sides = []
    for k, side in enumerate(small):
        sides.append((side, side))
        if k < len(large):
            sides.append((math.sqrt(side * large[k]),) * 2)
        for ratio in ratios:
            turns = (ratio, 1.0 / ratio) if flip else (ratio,)
            sides += [(side * math.sqrt(turn), side / math.sqrt(turn)) for turn in turns]
    step, offset = float(data.get("step", 0.0)), float(data["offset"])
    step_x, step_y = (step, step) if step else (width_px / columns, height_px / rows)
    y, x, shape = np.meshgrid(np.arange(rows), np.arange(columns), np.arange(len(sides)), indexing="ij")
    centre = np.stack([(x + offset) * step_x, (y + offset) * step_y], axis=-1).reshape(-1, 2)
    half = np.array(sides)[shape.ravel()] / 2.0
    corners = np.hstack([centre - half, centre + half]) / [width_px, height_px, width_px, height_px]
    variances = np.tile(layer.floats("variance"), len(corners))
    return np.stack([corners.ravel(), variances]).astype(np.float32)


def _detection_output(graph: _Graph, layer: Layer, inputs: list[Value]) -> Value:
    """Its own output is nothing: results are what it would have been made of."""
    loc, conf, priors = inputs
    if not layer.data.get("code_type", "").endswith("CENTER_SIZE"):
        raise IrError(f"layer {layer.name!r}: boxes coded as {layer.data.get('code_type')} are not known here")
    count = math.prod(loc.shape) // 4
    boxes = _array(priors)[0, 0].reshape(count, 4)
    for name, value, channels in (("loc", loc, 4), ("conf", conf, math.prod(conf.shape) // count)):
        shape = (1, count, channels)
        graph.results.append((name, graph.add("Reshape", [value, np.array(shape, dtype=np.int64)], shape)))
    graph.results.append(("priors", boxes))
    return np.empty(0)


def _result(graph: _Graph, layer: Layer, inputs: list[Value]) -> None:
    if isinstance(inputs[0], Tensor):
        graph.results.append((None, inputs[0]))


def _tensor(value: Value) -> Tensor:
    if not isinstance(value, Tensor):
        raise ValueError("a value that depends on the image is needed")
    return value


def _array(value: Value) -> NDArray[Any]:
    if isinstance(value, Tensor):
        raise ValueError("a constant is needed")
    return value


_LAYERS: dict[str, Callable[[_Graph, Layer, list[Value]], Value | None]] = {
    "Parameter": _parameter,
    "Const": _const,
    "Convolution": _convolution,
    "GroupConvolution": _convolution,
    "MaxPool": _pool,
    "AvgPool": _pool,
    "Add": _arithmetic,
    "Multiply": _arithmetic,
    "ReLU": _relu,
    "SoftMax": _softmax,
    "Transpose": _transpose,
    "Reshape": _reshape,
    "Concat": _concat,
    "Interpolate": _interpolate,
    "ShapeOf": _shape_of,
    "Convert": _same,
    "StridedSlice": _slice,
    "Unsqueeze": _unsqueeze,
    "PriorBox": _prior_box,
    "DetectionOutput": _detection_output,
    "Result": _result,
}
