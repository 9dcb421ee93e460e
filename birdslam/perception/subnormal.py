"""Takes weights that are as good as zero out of an ONNX file's bytes, for speed.

Training with weight decay leaves dead channels at 1e-40. Their products are subnormal numbers, which many CPUs multiply
a hundred times slower: TwinLiteNet ran 440 ms instead of 63 ms on an Intel server, with bit-identical outputs.
onnxruntime's own switch (session.set_denormal_as_zero) does not reach the thread that calls it.

The file is a protobuf (onnx.proto): a record is read no further than to find the weights, which are changed in place.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

TINY = np.float32(1e-20)  # its product with anything up to 1e12 is below the rounding of outputs near 1
_MODEL_GRAPH, _GRAPH_INITIALIZER = 7, 5
_TENSOR_DIMS, _TENSOR_TYPE, _TENSOR_FLOATS, _TENSOR_RAW = 1, 2, 4, 9
_TYPE_FLOAT = 1


def without_tiny_weights(content: bytes) -> bytes:
    """The same network with weights below `TINY` at zero; vectors and scalars stay (a guard against log(0) is one).

    `content` must be a network that onnxruntime has read.
    """
    out = bytearray(content)
    for number, _, graph in _fields(out, 0, len(out)):
        if number == _MODEL_GRAPH:
            for inner, _, tensor in _fields(out, graph.start, graph.stop):
                if inner == _GRAPH_INITIALIZER:
                    _flush(out, tensor)
    return bytes(out)


def _flush(out: bytearray, tensor: range) -> None:
    axes, data_type, values = 0, 0, None
    for number, value, span in _fields(out, tensor.start, tensor.stop):
        if number == _TENSOR_DIMS:
            # Packed or one by one, as the writer liked; a packed axis ends with each byte below 0x80.
            axes += sum(byte < 0x80 for byte in out[span.start : span.stop]) if span else 1
        elif number == _TENSOR_TYPE:
            data_type = value
        elif number in (_TENSOR_RAW, _TENSOR_FLOATS) and span:
            values = span
    if data_type == _TYPE_FLOAT and axes >= 2 and values is not None and len(values) % 4 == 0:
        weights = np.frombuffer(out, dtype="<f4", count=len(values) // 4, offset=values.start)
        weights[np.abs(weights) < TINY] = 0.0


def _fields(data: bytearray, at: int, end: int) -> Iterator[tuple[int, int, range]]:
    """(field number, value of a varint, where the bytes of a length-delimited field lie) of one record."""
    while at < end:
        key, at = _varint(data, at)
        value, span = 0, range(0)
        match key & 7:
            case 0:  # varint
                value, at = _varint(data, at)
            case 1:  # 64 bits
                at += 8
            case 2:  # length-delimited
                length, at = _varint(data, at)
                span = range(at, at + length)
                at += length
            case 5:  # 32 bits
                at += 4
            case kind:
                raise ValueError(f"no ONNX file: wire type {kind} at byte {at}")
        yield key >> 3, value, span


def _varint(data: bytearray, at: int) -> tuple[int, int]:
    value = shift = 0
    while data[at] & 0x80:
        value |= (data[at] & 0x7F) << shift
        shift += 7
        at += 1
    return value | data[at] << shift, at + 1
