"""Reads the records of an ONNX file (protobuf, onnx.proto) as far as needed to find weights."""

from __future__ import annotations

from collections.abc import Iterator

MODEL_GRAPH, GRAPH_INITIALIZER = 7, 5
# For each kind of record that leads to tensors: field -> kind of its content
_CONTENTS = {
    "model": {MODEL_GRAPH: "graph", 25: "function"},
    "graph": {1: "node", GRAPH_INITIALIZER: "tensor", 15: "sparse_tensor"},
    "function": {7: "node"},
    "node": {5: "attribute"},
    "attribute": {5: "tensor", 10: "tensor", 6: "graph", 11: "graph", 22: "sparse_tensor", 23: "sparse_tensor"},
    "sparse_tensor": {1: "tensor", 2: "tensor"},
    "tensor": {},
}
_TENSOR_EXTERNAL, _TENSOR_LOCATION = 13, 14


def fields(data: bytes | bytearray, at: int, end: int) -> Iterator[tuple[int, int, range, int]]:
    """(field number, value of a varint, byte range of a length-delimited field, end) of each field of one record.

    Raises ValueError if the bytes are not a record.
    """
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
                raise ValueError(f"not an ONNX file: wire type {kind} at byte {at}")
        if at > end:
            raise ValueError(f"not an ONNX file: a record ends at byte {at}, past its container's end at {end}")
        yield key >> 3, value, span, at


def has_external_weights(content: bytes) -> bool:
    """Whether a tensor of the network is in another file, at a path that the network names.

    Raises ValueError if the bytes are not an ONNX file.
    """
    left = [("model", range(len(content)))]
    while left:
        kind, record = left.pop()
        for number, value, inside, _ in fields(content, record.start, record.stop):
            if kind == "tensor" and (number == _TENSOR_EXTERNAL or (number == _TENSOR_LOCATION and value != 0)):
                return True
            if number in _CONTENTS[kind]:
                left.append((_CONTENTS[kind][number], inside))
    return False


def _varint(data: bytes | bytearray, at: int) -> tuple[int, int]:
    value = shift = 0
    while at < len(data):
        byte = data[at]
        value |= (byte & 0x7F) << shift
        shift += 7
        at += 1
        if byte < 0x80:
            return value, at
        if shift > 63:
            break
    raise ValueError(f"not an ONNX file: a truncated number at byte {at}")
