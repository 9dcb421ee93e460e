"""OpenVINO IRs as Intel's Model Optimizer wrote them in 2020 (version 10, FP16), made by the tests that need one."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any
from xml.sax.saxutils import quoteattr

import numpy as np
from numpy.typing import NDArray

ELEMENTS = {"f16": np.float16, "f32": np.float32, "i64": np.int64}
PRIOR = {"clip": "0", "density": "", "fixed_ratio": "", "fixed_size": "", "flip": "1", "offset": "0.5"}
VARIANCE = "0.10000000149011612,0.10000000149011612,0.20000000298023224,0.20000000298023224"

Port = tuple[int, int, tuple[int, ...]]  # layer, port, shape


class Ir:
    """Layers one after the other; each returns the port of its output."""

    def __init__(self) -> None:
        self.layers: list[str] = []
        self.edges: list[str] = []
        self.weights = b""

    def layer(self, kind: str, inputs: Sequence[Port], shape: tuple[int, ...] | None, /, **data: Any) -> Port:
        """`shape` None: it has no output. In the names of `data` _0_ stands for a hyphen."""
        number, out = len(self.layers), len(inputs)
        for port, (source, source_port, _) in enumerate(inputs):
            self.edges.append(
                f'<edge from-layer="{source}" from-port="{source_port}" to-layer="{number}" to-port="{port}"/>'
            )
        words = " ".join(f"{key.replace('_0_', '-')}={quoteattr(str(value))}" for key, value in data.items())
        ports = "".join(_port(port, taken) for port, (_, _, taken) in enumerate(inputs))
        self.layers.append(
            f'<layer id="{number}" name="{kind}/{number}" type="{kind}" version="opset1">'
            + (f"<data {words}/>" if data else "")
            + (f"<input>{ports}</input>" if inputs else "")
            + ("" if shape is None else f"<output>{_port(out, shape)}</output>")
            + "</layer>"
        )
        return number, out, shape or ()

    def const(self, numbers: Any, element: str = "f16") -> Port:
        array = np.asarray(numbers, dtype=ELEMENTS[element])
        data = array.tobytes()
        shape = ",".join(map(str, array.shape))
        made = self.layer(
            "Const", [], array.shape, element_type=element, offset=len(self.weights), shape=shape, size=len(data)
        )
        self.weights += data
        return made

    def image(self, height_px: int, width_px: int) -> Port:
        shape = (1, 3, height_px, width_px)
        return self.layer("Parameter", [], shape, element_type="f16", shape=",".join(map(str, shape)))

    def convolution(
        self,
        of: Port,
        kernel: NDArray[Any],
        shape: tuple[int, ...],
        strides: Sequence[int] = (1, 1),
        pads: Sequence[int] = (0, 0, 0, 0),
        groups: int = 1,
        dilations: Sequence[int] = (1, 1),
    ) -> Port:
        """`kernel` as ONNX has it; `pads` at the beginning and at the end."""
        kind = "Convolution" if groups == 1 else "GroupConvolution"
        if groups > 1:
            kernel = kernel.reshape(groups, -1, *kernel.shape[1:])
        how = {
            "dilations": comma(dilations),
            "output_padding": "0,0",
            "pads_begin": comma(pads[:2]),
            "pads_end": comma(pads[2:]),
        }
        return self.layer(kind, [of, self.const(kernel)], shape, **how, strides=comma(strides))

    def priors(self, of: Port, image: Port, count: int, **data: Any) -> Port:
        """The chain of layers about one PriorBox: `count` boxes of four numbers."""
        sizes = []
        for source in (of, image):
            shape = self.layer("ShapeOf", [source], (4,))
            narrow = self.layer("Convert", [shape], (4,), destination_type="i32")
            masks = {"begin_mask": 0, "ellipsis_mask": 0, "end_mask": 1, "new_axis_mask": 0, "shrink_axis_mask": 0}
            bounds = [self.const([number], "i64") for number in (2, 4, 1)]
            part = self.layer("StridedSlice", [narrow, *bounds], (2,), **masks)
            sizes.append(self.layer("Convert", [part], (2,), destination_type="i64"))
        boxes = self.layer("PriorBox", sizes, (2, 4 * count), **PRIOR, **data, variance=VARIANCE)
        return self.layer("Unsqueeze", [boxes, self.const([0], "i64")], (1, 2, 4 * count))

    def result(self, of: Port) -> None:
        self.layer("Result", [of], None)

    @property
    def xml(self) -> bytes:
        layers, edges = "\n".join(self.layers), "\n".join(self.edges)
        text = f'<net name="tiny" version="10"><layers>{layers}</layers><edges>{edges}</edges><meta_data/></net>\n'
        return b'<?xml version="1.0" ?>\n' + text.encode()


def comma(numbers: Sequence[int]) -> str:
    """As an IR writes a list."""
    return ",".join(map(str, numbers))


def _port(number: int, shape: tuple[int, ...]) -> str:
    return f'<port id="{number}">' + "".join(f"<dim>{size}</dim>" for size in shape) + "</port>"
