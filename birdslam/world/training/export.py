"""Exports a trained network as ONNX with its manifest."""

from __future__ import annotations

import copy
import io
from collections.abc import Sequence

import torch
from torch import Tensor, nn

from birdslam.perception.decoding.multitask import INPUT, OUTPUTS
from birdslam.world.training.network import MultiTask

MANIFEST = """\
# {title}, {parameters} parameters. Trained by `make train` on the built-in world alone.
title = "{title}"
role = "multitask"
sha256 = "{sha256}"

[input]
name = "image"
width_px = {width_px}
height_px = {height_px}
layout = "NCHW"
colour = "BGR"
scale = 0.00784313725490196 # 2 / 255
mean = [1.0, 1.0, 1.0]
resize = {{ mode = "stretch" }}

[schedule]
every = 1
threads = 2

[multitask]
score_threshold = {score:.2f} # where precision and recall are best together on held-out worlds, augmented
lane_logit = {lane_logit:.1f} # where the markings' IoU is best on those
depth_sigma_rel = {depth_sigma_rel:.2f}
"""


def to_onnx(network: MultiTask, width_px: int, height_px: int) -> bytes:
    """The network as an ONNX file for batch 1 at this image size."""
    return onnx_file(network, torch.zeros(1, 3, height_px, width_px), INPUT, OUTPUTS)


def onnx_file(
    network: nn.Module, example: Tensor, name: str, outputs: Sequence[str], count: str | None = None
) -> bytes:
    """The ONNX file of a network in inference mode, for the batch size of `example` or a variable one named `count`."""
    file = io.BytesIO()
    torch.onnx.export(
        copy.deepcopy(network).cpu().eval().float(),
        (example,),
        file,
        input_names=[name],
        output_names=list(outputs),
        dynamic_axes=None if count is None else {each: {0: count} for each in (name, *outputs)},
        opset_version=17,
        dynamo=False,
    )
    return file.getvalue()


def manifest(
    title: str,
    parameters: int,
    sha256: str,
    size_px: tuple[int, int],
    score: float,
    lane_logit: float,
    depth_sigma_rel: float,
) -> str:
    """The manifest of an exported network, with thresholds `score` for vehicles and `lane_logit` for markings."""
    return MANIFEST.format(
        title=title,
        parameters=parameters,
        sha256=sha256,
        width_px=size_px[0],
        height_px=size_px[1],
        score=min(max(score, 0.05), 0.95),
        lane_logit=lane_logit,
        depth_sigma_rel=min(max(depth_sigma_rel, 0.01), 0.99),
    )
