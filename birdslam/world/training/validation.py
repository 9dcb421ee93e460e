"""Validation of the multi-task network: its metrics and best thresholds on held-out worlds."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
from numpy.typing import NDArray

from birdslam.geometry.arrays import Floats32
from birdslam.perception.decoding.multitask import INPUT, MultiTaskDecoder
from birdslam.perception.manifest import Input, MultiTask, Stretch
from birdslam.perception.views import Preparation, make_views
from birdslam.world.training.augmentation import AugmentationConfig, photometric
from birdslam.world.training.grading import Grades
from birdslam.world.training.stream import HELD_OUT_SEEDS, Render

Tensors = Mapping[str, Floats32]
Answer = Callable[[Floats32], Tensors]  # (1, 3, H, W) in [-1, 1] -> the network's outputs by name

LANE_LOGITS = (-1.5, -1.2, -0.9, -0.6, -0.3, 0.0)  # candidate thresholds of markings
MIN_SCORE = 0.05  # keeps nearly every box, for tuning the threshold
VALIDATION_SEEDS = HELD_OUT_SEEDS // 2  # worlds for thresholds and int8 ranges, neither in training nor in metrics


def validate(
    answer: Answer,
    render: Render,
    size_px: tuple[int, int],
    frames: int,
    augmentation: AugmentationConfig,
    rng: np.random.Generator,
) -> dict[str, float]:
    """The metrics of a multi-task network at (width, height) on `frames` held-out worlds; see `Grades.figures`.

    `lane_logit` and `vehicle_score` are the best thresholds on other worlds with augmented images, which lower the
    network's scores as real cameras do.
    """
    width_px, height_px = size_px
    size = Input(
        name=INPUT,
        width_px=width_px,
        height_px=height_px,
        layout="NCHW",
        colour="BGR",
        resize=Stretch(),
        scale=2.0 / 255.0,
        mean=(1.0, 1.0, 1.0),
    )
    (view,) = make_views(width_px, height_px, size, None)
    preparation = Preparation(size)

    def ask(image: NDArray[np.uint8]) -> Tensors:
        preparation.fill(image, view)
        return answer(preparation.tensor)

    augmented = {logit: Grades() for logit in LANE_LOGITS}
    for seed in range(VALIDATION_SEEDS, VALIDATION_SEEDS + frames):
        frame = render(seed, width_px, height_px)
        tensors = ask(photometric(frame.image, augmentation, rng))
        for logit, grades in augmented.items():
            grades.add(_decoder(size, tensors, logit).read(tensors, view), frame)
    figures = {logit: grades.figures() for logit, grades in augmented.items()}
    lane_logit = max(LANE_LOGITS, key=lambda logit: np.nan_to_num(figures[logit]["lane_iou"]))
    grades = Grades()
    for seed in range(frames):
        frame = render(seed, width_px, height_px)
        tensors = ask(frame.image)
        grades.add(_decoder(size, tensors, lane_logit).read(tensors, view), frame)
    score = figures[lane_logit]["vehicle_score"]
    return {**grades.figures(), "vehicle_score": score, "lane_logit": lane_logit}


def _decoder(size: Input, tensors: Tensors, lane_logit: float) -> MultiTaskDecoder:
    shapes = {name: tensor.shape for name, tensor in tensors.items()}
    return MultiTaskDecoder(MultiTask(score_threshold=MIN_SCORE, lane_logit=lane_logit), size, shapes)
