"""Compares the completed road behind vehicles with observations of later frames."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from birdslam.bench.lanes.hidden_cells import HiddenCells, HiddenReport
from birdslam.outputs.drive_files import claim_directory, write_json
from birdslam.outputs.lane_picture import draw_lanes
from birdslam.perception.completion import shipped_completion
from birdslam.perception.schedule import Ready
from birdslam.runtime.configuration import Configuration, ConfigurationError, complete
from birdslam.runtime.nodes.inference import Inference
from birdslam.runtime.nodes.sources import RecordedSource, offline_frames, open_recorded, recording_uri
from birdslam.runtime.progress import Progress
from birdslam.slam import BirdSLAM
from birdslam.types import INVALIDATING


def evaluate_hidden(configuration: Configuration, drive: str) -> HiddenReport:
    """Processes a recording; writes report.json and a picture of the frame with the most completed cells (Fig. 4).

    Raises ConfigurationError, DatasetError, ModelError, ResultsError.
    """
    configuration = configuration.as_lossless()
    recording = open_recorded(recording_uri(drive), configuration.camera, configuration.source.stride)
    output = Path(configuration.output)
    claim_directory(output)
    source = RecordedSource(recording, configuration.source)
    lanes = configuration.slam.frontend.lanes
    images: dict[int, tuple[int, NDArray[np.uint8]]] = {}  # look -> its frame
    with (
        Inference(complete(configuration, recording.camera, source.rate_hz)) as inference,
        Progress(recording.name, len(recording)) as progress,
    ):
        cells = HiddenCells(recording.camera, lanes, shipped_completion(lanes.shape))
        slam = BirdSLAM(recording.camera, inference.networks, configuration.slam, lane_head=inference.lane_head)
        epoch = 0
        for frame in offline_frames(source):
            perception = inference.networks.start(frame.frame_id, frame.image).result()
            measurements = slam.frontend.measure(frame, Ready(perception))
            estimate = slam.graph.optimise(measurements)
            progress.advance()
            if frame.image is None or not INVALIDATING.isdisjoint(estimate.status) or estimate.ground is None:
                continue
            if perception.segmentation is None:
                raise ConfigurationError("--model: no network segments road and lanes")
            if perception.ages.get("segmenter", 0):
                continue
            if estimate.epoch != epoch:  # the transform to the previous world is unknown
                epoch, images = estimate.epoch, {}
                cells = HiddenCells(recording.camera, lanes, shipped_completion(lanes.shape))
            boxes = np.zeros((0, 4)) if perception.detections is None else perception.detections.boxes_px
            ground, bonnet_px = slam.frontend.vehicles.road.ground, slam.frontend.odometry.bonnet_px
            look = cells.add(estimate.T_world_ego, ground, perception.segmentation, boxes, bonnet_px)
            if look >= 0:
                images[look] = frame.frame_id, frame.image
    report, best = cells.report(recording.name)
    if best is not None:
        frame_id, image = images[best.look]
        title = f"{recording.name}, frame {frame_id}"
        draw_lanes(title, image, best.view, lanes, output / f"hidden_{recording.name}_{frame_id}.png", best.later)
    write_json(output / "report.json", report)
    return report
