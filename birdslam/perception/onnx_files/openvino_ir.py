"""OpenVINO's intermediate representation (IR, version 10): a graph in XML, its numbers in a .bin beside it."""

from __future__ import annotations

from dataclasses import dataclass
from graphlib import CycleError, TopologicalSorter
from xml.etree import ElementTree


class IrError(ValueError):
    """An IR that can't be converted; the message says which layer and why."""


@dataclass(frozen=True)
class Layer:
    """One layer: `sources` are (layer, port) in the order of its inputs, `input_shapes` theirs as the file has them."""

    id: str
    name: str
    type: str
    data: dict[str, str]
    input_shapes: tuple[tuple[int, ...], ...]
    sources: tuple[tuple[str, str], ...]
    outputs: tuple[str, ...]  # ports

    def ints(self, key: str) -> list[int]:
        """A list of integers in its data."""
        return [int(word) for word in self.data[key].split(",")]

    def floats(self, key: str) -> list[float]:
        """A list of numbers in its data, which may be empty or absent."""
        return [float(word) for word in self.data.get(key, "").split(",") if word]


def read_layers(xml: bytes) -> list[Layer]:
    """The layers of an IR, each after those that it takes from. Raises IrError."""
    if b"<!DOCTYPE" in xml or b"<!ENTITY" in xml:
        raise IrError("an IR declares no entities")
    try:
        net = ElementTree.fromstring(xml)
    except ElementTree.ParseError as error:
        raise IrError(f"no XML: {error}") from error
    if net.tag != "net" or net.get("version") != "10":
        raise IrError(f"no IR of version 10: <{net.tag} version={net.get('version')!r}>")
    sources = {}
    for edge in net.iterfind("edges/edge"):
        a, b, c, d = (edge.get(key, "") for key in ("from-layer", "from-port", "to-layer", "to-port"))
        sources[c, d] = (a, b)
    try:
        layers = {found.id: found for found in (_layer(each, sources) for each in net.iterfind("layers/layer"))}
    except (KeyError, ValueError) as error:
        raise IrError(f"a layer is incomplete: {type(error).__name__}: {error}") from error
    return _in_order(layers)


def _layer(each: ElementTree.Element, sources: dict[tuple[str, str], tuple[str, str]]) -> Layer:
    data = each.find("data")
    inputs = each.findall("input/port")
    number = each.attrib["id"]
    return Layer(
        id=number,
        name=each.attrib["name"],
        type=each.attrib["type"],
        data={} if data is None else dict(data.attrib),
        input_shapes=tuple(tuple(int(dim.text or "") for dim in port.iterfind("dim")) for port in inputs),
        sources=tuple(sources[number, port.attrib["id"]] for port in inputs),
        outputs=tuple(port.attrib["id"] for port in each.iterfind("output/port")),
    )


def _in_order(layers: dict[str, Layer]) -> list[Layer]:
    for layer in layers.values():
        for source, _ in layer.sources:
            if source not in layers:
                raise IrError(f"layer {layer.name!r} takes from layer {source}, a layer that is not there")
    try:
        order = list(
            TopologicalSorter({id: [s for s, _ in layer.sources] for id, layer in layers.items()}).static_order()
        )
    except CycleError as error:
        raise IrError(f"layers take from each other in a circle: {error.args[1]}") from error
    return [layers[id] for id in order]
