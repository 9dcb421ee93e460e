"""Quantizes a multi-task network to int8. Needs the extra [train].

    python -m birdslam.runtime.world.quantise NETWORK.onnx [--frames 128] [--output DIR]

The ranges are calibrated on rendered frames outside the training and test sets. The last convolution of each head
stays in fp32 for accurate mask edges. Weights have seven bits (reduce_range), so that AVX2 does not overflow.
"""

from __future__ import annotations

import argparse
import hashlib
import re
import tempfile
from pathlib import Path

import numpy as np
import onnx
from onnxruntime.quantization import CalibrationDataReader, CalibrationMethod, QuantFormat, QuantType, quantize_static
from onnxruntime.quantization.shape_inference import quant_pre_process

from birdslam.geometry.arrays import Floats32
from birdslam.perception.decoding.multitask import OUTPUTS
from birdslam.perception.manifest import Input
from birdslam.perception.manifest_file import read_manifest
from birdslam.perception.views import Preparation, make_views
from birdslam.runtime.world.train import write_network
from birdslam.world.training.augmentation import AugmentationConfig, photometric
from birdslam.world.training.validation import VALIDATION_SEEDS


class Frames(CalibrationDataReader):
    """Rendered frames as network inputs."""

    def __init__(self, size: Input, count: int) -> None:
        self._size, self._preparation = size, Preparation(size)
        self._seeds = iter(range(VALIDATION_SEEDS, VALIDATION_SEEDS + count))

    def get_next(self) -> dict[str, Floats32] | None:
        """Returns the next input; None at the end."""
        from birdslam.world.world import sample

        seed = next(self._seeds, None)
        if seed is None:
            return None
        frame = sample(seed, self._size.width_px, self._size.height_px)
        image = photometric(frame.image, AugmentationConfig(), np.random.default_rng(seed))
        (view,) = make_views(self._size.width_px, self._size.height_px, self._size, None)
        self._preparation.fill(image, view)
        return {self._size.name: self._preparation.tensor.copy()}


def quantise(network: Path, frames: int) -> tuple[bytes, str]:
    """Returns the int8 network and its manifest."""
    source = network.with_suffix(".toml")
    with tempfile.TemporaryDirectory(prefix="quantise") as folder:
        prepared, result = Path(folder, "prepared.onnx"), Path(folder, "int8.onnx")
        quant_pre_process(str(network), str(prepared), skip_symbolic_shape=True)
        quantize_static(
            str(prepared),
            str(result),
            Frames(read_manifest(source).input, frames),
            quant_format=QuantFormat.QDQ,
            activation_type=QuantType.QUInt8,
            weight_type=QuantType.QInt8,
            per_channel=True,
            reduce_range=True,
            nodes_to_exclude=last_convolutions(onnx.load(prepared)),
            calibrate_method=CalibrationMethod.MinMax,
        )
        content = result.read_bytes()
    text = re.sub(r'sha256 = "[0-9a-f]*"', f'sha256 = "{hashlib.sha256(content).hexdigest()}"', source.read_text())
    return content, re.sub(r'^title = "(.*)"', r'title = "\1, int8"', text, flags=re.MULTILINE)


def last_convolutions(model: onnx.ModelProto) -> list[str]:
    """Returns the names of the last convolutions before the outputs, and of the nodes after them."""
    producers = {output: node for node in model.graph.node for output in node.output}
    names, waiting = [], list(OUTPUTS)
    while waiting:
        node = producers.get(waiting.pop())
        if node is not None:
            names.append(node.name)
            if node.op_type != "Conv":
                waiting.extend(node.input)
    return names


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        prog="python -m birdslam.runtime.world.quantise", description="quantize a network to int8"
    )
    parser.add_argument("network", type=Path)
    parser.add_argument("--frames", type=int, default=128)
    parser.add_argument("--output", type=Path, help="output directory; default: that of the network")
    options = parser.parse_args(arguments)
    content, text = quantise(options.network, options.frames)
    write_network(options.output or options.network.parent, content, text, f"{options.network.stem}_int8")


if __name__ == "__main__":
    main()
