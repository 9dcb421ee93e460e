"""Compares the ego lane and lane markings in single images with masks."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from birdslam.bench.lanes import line_masks
from birdslam.bench.lanes.kitti_road import (
    StillsReport,
    camera_of,
    draw,
    find_lane,
    find_pairs,
    read_pair,
    report_of,
    score,
)
from birdslam.bench.lanes.paint_masks import PaintReport, find_images, read, score_paint
from birdslam.bench.lanes.paint_masks import report_of as paint_report
from birdslam.outputs.drive_files import ResultsError, claim_directory, write_json
from birdslam.perception import Segmentation
from birdslam.runtime.configuration import Configuration, ConfigurationError
from birdslam.runtime.nodes.inference import Inference
from birdslam.runtime.progress import Progress
from birdslam.sources.recording import DatasetError

REPORT = "report.json"


def evaluate_paint(configuration: Configuration, folder: Path) -> PaintReport:
    """Scores the lane markings that the network segments in the images of a folder; writes the report.

    Raises ConfigurationError, DatasetError, ModelError, ResultsError.
    """
    pairs = find_images(folder)
    output = Path(configuration.output)
    claim_directory(output)
    configuration = configuration.as_lossless()
    scores = []
    with Inference(configuration) as inference, Progress(folder.name, len(pairs)) as progress:
        for image_path, mask_path in pairs:
            image, mask = read(image_path), read(mask_path)
            if image.shape != mask.shape:
                raise DatasetError(f"{mask_path}: differs in size from its image")
            segmentation, _ = perceive_still(inference, image)
            scores.append(score_paint(image_path.name, image, segmentation.lane, mask))
            progress.advance()
        own = next((spec for spec in (configuration.models.segmenter,) if spec is not None), None)
        report = paint_report("shipped" if own is None else Path(own.path).name, scores)
    write_json(output / REPORT, report)
    return report


def evaluate_stills(configuration: Configuration, folder: Path) -> StillsReport:
    """Scores all pairs of image and mask in a folder independently; writes the report and a picture of each.

    The camera is that of the configuration or of KITTI. Raises ConfigurationError, DatasetError, ModelError,
    ResultsError.
    """
    pairs = find_pairs(folder)
    output = Path(configuration.output)
    claim_directory(output)
    configuration = configuration.as_lossless()
    if configuration.camera is not None and configuration.camera.distortion:
        raise ConfigurationError("--camera: the masks fit undistorted images; use a camera without distortion")
    scores = []
    with Inference(configuration) as inference, Progress(folder.name, len(pairs)) as progress:
        heads = inference.networks.heads
        for pair in pairs:
            image, mask = read_pair(pair)
            try:
                camera = camera_of(image, configuration.camera)
            except DatasetError as error:
                raise DatasetError(f"{pair.image}: {error}") from None
            still = find_lane(camera, image, *perceive_still(inference, image))
            scores.append(score(pair.image.name, camera, still, mask))
            _write_picture(output, pair.number, draw(image, camera, still))
            progress.advance()
    report = report_of(scores, tuple(head.name for head in heads))
    write_json(output / REPORT, report)
    return report


def evaluate_line_masks(configuration: Configuration, folder: Path) -> line_masks.LineMasksReport:
    """Scores the painted lines in all images of a folder independently; writes the report and a picture of each.

    The camera is that of the configuration or an assumed one. Raises ConfigurationError, DatasetError, ModelError,
    ResultsError.
    """
    pairs = line_masks.find_images(folder)
    output = Path(configuration.output)
    claim_directory(output)
    configuration = configuration.as_lossless()
    scores = []
    with Inference(configuration) as inference, Progress(folder.name, len(pairs)) as progress:
        for number, (image_path, mask_path) in enumerate(pairs):
            image, mask = read(image_path), read(mask_path)
            if image.shape != mask.shape:
                raise DatasetError(f"{mask_path}: differs in size from its image")
            camera = configuration.camera or line_masks.camera_of(image)
            still = find_lane(camera, image, *perceive_still(inference, image))
            scores.append(line_masks.score_lines(image_path.name, camera, still, mask))
            _write_picture(output, number, draw(image, camera, still))
            progress.advance()
    report = line_masks.report_of(scores)
    write_json(output / REPORT, report)
    return report


def perceive_still(inference: Inference, image: NDArray[np.uint8]) -> tuple[Segmentation, NDArray[np.float64]]:
    """Segmentation and vehicle boxes (B, 4) of one image. Raises ConfigurationError if no network segments."""
    perception = inference.networks.start(0, image).result()  # always frame 0: no result is carried over
    if perception.segmentation is None:
        raise ConfigurationError("--model: no network segments road and lanes")
    boxes_px = np.zeros((0, 4)) if perception.detections is None else perception.detections.boxes_px
    return perception.segmentation, boxes_px


def _write_picture(output: Path, number: int, picture: NDArray[np.uint8]) -> None:
    path = output / f"lanes_{number}.png"
    if not cv2.imwrite(str(path), picture):
        raise ResultsError(f"{path}: can't be written")
