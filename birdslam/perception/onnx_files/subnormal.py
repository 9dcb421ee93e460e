"""Sets negligible weights in an ONNX file's bytes to zero, for speed.

Weight decay leaves dead channels at 1e-40. Their products are subnormal numbers, which many CPUs multiply slowly.
onnxruntime's switch (session.set_denormal_as_zero) does not affect the calling thread.
"""

from __future__ import annotations

import numpy as np

from birdslam.perception.onnx_files.onnx_file import GRAPH_INITIALIZER, MODEL_GRAPH, fields

MIN_WEIGHT = np.float32(1e-20)  # its product with 1e12 is below the rounding error of outputs near 1
_TENSOR_DIMS, _TENSOR_TYPE, _TENSOR_FLOATS, _TENSOR_RAW = 1, 2, 4, 9
_TYPE_FLOAT = 1


def without_tiny_weights(content: bytes) -> bytes:
    """The same network with weights below `MIN_WEIGHT` at zero.

    Vectors and scalars stay: they may be an epsilon that guards a logarithm. `content` must be a valid ONNX file.
    """
    out = bytearray(content)
    for number, _, graph, _ in fields(out, 0, len(out)):
        if number == MODEL_GRAPH:
            for inner, _, tensor, _ in fields(out, graph.start, graph.stop):
                if inner == GRAPH_INITIALIZER:
                    _flush(out, tensor)
    return bytes(out)


def _flush(out: bytearray, tensor: range) -> None:
    axes, data_type, values = 0, 0, None
    for number, value, span, _ in fields(out, tensor.start, tensor.stop):
        if number == _TENSOR_DIMS:
            # Dimensions are packed or single; in packed ones each byte below 0x80 ends a number
            axes += sum(byte < 0x80 for byte in out[span.start : span.stop]) if span else 1
        elif number == _TENSOR_TYPE:
            data_type = value
        elif number in (_TENSOR_RAW, _TENSOR_FLOATS) and span:
            values = span
    if data_type == _TYPE_FLOAT and axes >= 2 and values is not None and len(values) % 4 == 0:
        weights = np.frombuffer(out, dtype="<f4", count=len(values) // 4, offset=values.start)
        weights[np.abs(weights) < MIN_WEIGHT] = 0.0
