"""A trained network as ONNX, in fp32 and in int8, with the manifest that goes with it."""

from __future__ import annotations

import io

import torch

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
    """The network as an ONNX file for one image of a size."""
    network = network.eval().float()
    image = torch.zeros(1, 3, height_px, width_px)
    file = io.BytesIO()
    torch.onnx.export(
        network, (image,), file, input_names=[INPUT], output_names=list(OUTPUTS), opset_version=17, dynamo=False
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
    """The text of the manifest of an exported network: vehicles count from `score` on, markings from `lane_logit`."""
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
