"""Compares the ego lane and lane markings in single images with masks.

The functions write the report and pictures to the output folder, and raise ConfigurationError, DatasetError,
ModelError, ResultsError.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from birdslam.bench.lanes import kitti_road, line_masks, paint_masks
from birdslam.bench.lanes.image_masks import Pair, read_pair
from birdslam.bench.lanes.kitti_road import Still, draw, find_lane
from birdslam.geometry.arrays import Image
from birdslam.geometry.camera import Camera
from birdslam.outputs.drive_files import ResultsError, claim_directory, write_json
from birdslam.perception import Segmentation
from birdslam.runtime.configuration import Configuration, ConfigurationError
from birdslam.runtime.nodes.inference import Inference
from birdslam.runtime.progress import Progress
from birdslam.sources.recording import DatasetError

REPORT = "report.json"


def evaluate_paint(configuration: Configuration, folder: Path) -> paint_masks.PaintReport:
    """Scores the lane markings that the network segments in the images of a folder."""
    scores = []
    with _images(configuration, folder, paint_masks.find_pairs(folder)) as (inference, images):
        for pair, image, mask in images:
            segmentation, _ = perceive_still(inference, image)
            scores.append(paint_masks.score_paint(pair.image.name, image, segmentation.lane, mask))
    own = configuration.models.segmenter
    report = paint_masks.report_of("shipped" if own is None else Path(own.path).name, scores)
    write_json(Path(configuration.output) / REPORT, report)
    return report


def evaluate_stills(configuration: Configuration, folder: Path) -> kitti_road.StillsReport:
    """Scores the ego lane in all images of a folder; the camera is that of the configuration or of KITTI."""
    if configuration.camera is not None and configuration.camera.distortion:
        raise ConfigurationError("--camera: the masks fit undistorted images; use a camera without distortion")
    scores = []
    with _images(configuration, folder, kitti_road.find_pairs(folder)) as (inference, images):
        heads = inference.networks.heads
        for pair, image, mask in images:
            try:
                camera = kitti_road.camera_of(image, configuration.camera)
            except DatasetError as error:
                raise DatasetError(f"{pair.image}: {error}") from None
            still = _find(configuration, inference, pair, image, camera)
            scores.append(kitti_road.score(pair.image.name, camera, still, mask))
    report = kitti_road.report_of(scores, tuple(head.name for head in heads))
    write_json(Path(configuration.output) / REPORT, report)
    return report


def evaluate_line_masks(configuration: Configuration, folder: Path) -> line_masks.LineMasksReport:
    """Scores the painted lines in all images of a folder; the camera is that of the configuration or an assumed one."""
    scores = []
    with _images(configuration, folder, line_masks.find_pairs(folder)) as (inference, images):
        for pair, image, mask in images:
            camera = configuration.camera or line_masks.camera_of(image)
            still = _find(configuration, inference, pair, image, camera)
            scores.append(line_masks.score_lines(pair.image.name, camera, still, mask))
    report = line_masks.report_of(scores)
    write_json(Path(configuration.output) / REPORT, report)
    return report


def perceive_still(inference: Inference, image: Image) -> tuple[Segmentation, NDArray[np.float64]]:
    """Segmentation and vehicle boxes (B, 4) of one image. Raises ConfigurationError if no network segments."""
    perception = inference.networks.start(0, image).result()  # always frame 0: no result is carried over
    if perception.segmentation is None:
        raise ConfigurationError("--model: no network segments road and lanes")
    boxes_px = np.zeros((0, 4)) if perception.detections is None else perception.detections.boxes_px
    return perception.segmentation, boxes_px


@contextmanager
def _images(
    configuration: Configuration, folder: Path, pairs: Sequence[Pair]
) -> Iterator[tuple[Inference, Iterator[tuple[Pair, Image, Image]]]]:
    """The networks, and each pair with its image and mask; claims the output folder, shows progress."""
    claim_directory(Path(configuration.output))
    with Inference(configuration.as_lossless()) as inference, Progress(folder.name, len(pairs)) as progress:

        def images() -> Iterator[tuple[Pair, Image, Image]]:
            for pair in pairs:
                yield pair, *read_pair(pair)
                progress.advance()

        yield inference, images()


def _find(configuration: Configuration, inference: Inference, pair: Pair, image: Image, camera: Camera) -> Still:
    """The lines and the ego lane of an image, also as a picture in the output folder."""
    still = find_lane(camera, image, *perceive_still(inference, image))
    path = Path(configuration.output) / f"lanes_{pair.number}.png"
    if not cv2.imwrite(str(path), draw(image, camera, still)):
        raise ResultsError(f"{path}: can't be written")
    return still
