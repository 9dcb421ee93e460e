"""Removes unread outputs from an ONNX file's bytes, with all nodes that only they need, for speed.

onnxruntime computes every node of a graph, even for outputs that are not requested.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator

from birdslam.perception.onnx_files.onnx_file import MODEL_GRAPH, fields

_GRAPH_NODE, _GRAPH_OUTPUT = 1, 12
_NODE_INPUT, _NODE_OUTPUT, _NODE_ATTRIBUTE = 1, 2, 5
_OUTPUT_NAME = 1
_ATTRIBUTE_GRAPHS = (6, 11)
_DELIMITED = 2  # wire type


def without_outputs(content: bytes, unread: Collection[str]) -> bytes:
    """The same network without the outputs `unread`; the other outputs stay bit-identical.

    A network with nested graphs is returned unchanged, since these may read any value. `content` must be a valid ONNX
    file.
    """
    out = bytearray()
    for number, whole, inside in _records(content, range(len(content))):
        if number != MODEL_GRAPH:
            out += content[whole.start : whole.stop]
            continue
        graph = _cut(content, inside, unread)
        if graph is None:
            return content
        out += _varint(MODEL_GRAPH << 3 | _DELIMITED) + _varint(len(graph)) + graph
    return bytes(out)


def _cut(content: bytes, graph: range, unread: Collection[str]) -> bytes | None:
    """The graph's record; None if a node contains a graph."""
    records = list(_records(content, graph))
    kept, wanted = [], set[str]()
    for number, whole, inside in reversed(records):  # nodes come after those that they read, outputs after nodes
        if number == _GRAPH_OUTPUT:
            name = _texts(content, inside, _OUTPUT_NAME)[0]
            if name in unread:
                continue
            wanted.add(name)
        kept.append((number, whole, inside))
    alive = []
    for number, whole, inside in kept:
        if number == _GRAPH_NODE:
            if _holds_graph(content, inside):
                return None
            if wanted.isdisjoint(_texts(content, inside, _NODE_OUTPUT)):
                continue
            wanted.update(_texts(content, inside, _NODE_INPUT))
        alive.append(content[whole.start : whole.stop])
    return b"".join(reversed(alive))


def _records(content: bytes, record: range) -> Iterator[tuple[int, range, range]]:
    """(field number, range with the key, range of the content) of each field of a record."""
    at = record.start
    for number, _, inside, end in fields(content, record.start, record.stop):
        yield number, range(at, end), inside
        at = end


def _texts(content: bytes, record: range, field: int) -> list[str]:
    return [
        content[inside.start : inside.stop].decode()
        for number, _, inside in _records(content, record)
        if number == field
    ]


def _holds_graph(content: bytes, node: range) -> bool:
    return any(
        inner in _ATTRIBUTE_GRAPHS
        for number, _, attribute in _records(content, node)
        if number == _NODE_ATTRIBUTE
        for inner, _, _ in _records(content, attribute)
    )


def _varint(value: int) -> bytes:
    out = bytearray()
    while value > 0x7F:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    return bytes((*out, value))
