"""Compares the ego lane of a real drive with its traced borders, or with its own lane when the ego gets there."""

from __future__ import annotations

from pathlib import Path

from birdslam.bench.lanes.later_lanes import LaterLanes
from birdslam.bench.lanes.true_borders import START_S, BorderScores, BordersReport, TrueBorders, read_borders
from birdslam.outputs.drive_files import claim_directory, write_json
from birdslam.runtime.configuration import Configuration, complete
from birdslam.runtime.evaluation.still_lanes import perceive_still
from birdslam.runtime.nodes.inference import Inference
from birdslam.runtime.nodes.sources import RecordedSource, offline_frames, open_recorded, recording_uri
from birdslam.runtime.progress import Progress
from birdslam.slam import BirdSLAM

IMAGE_STEP = 10  # every n-th image is searched for its lane on its own
MIN_AHEAD_M = 33.0  # known borders ahead of a frame that counts


def evaluate_borders(configuration: Configuration, drive: str, file: Path) -> BordersReport:
    """Processes a drive with true poses and compares its lanes with the borders; writes report.json to the output.

    Raises ConfigurationError, DatasetError, ModelError, ResultsError.
    """
    configuration = configuration.as_lossless()
    recording = open_recorded(recording_uri(drive), configuration.camera, configuration.source.stride)
    truth = TrueBorders(recording, read_borders(file))
    output = Path(configuration.output)
    claim_directory(output)
    source = RecordedSource(recording, configuration.source)
    scores = BorderScores()
    camera = recording.camera
    with (
        Inference(complete(configuration, camera, source.rate_hz)) as inference,
        Progress(recording.name, len(recording)) as progress,
    ):
        slam = BirdSLAM(camera, inference.networks, configuration.slam, lane_head=inference.lane_head)
        frames = list(offline_frames(source))
        for frame in frames:
            _, estimate = slam.step(frame)
            progress.advance()
            if frame.frame_id >= START_S * recording.rate_hz and truth.covers(frame.frame_id, MIN_AHEAD_M):
                scores.add(estimate.lanes, *truth.borders_m(frame.frame_id))
    with Inference(complete(configuration, camera, source.rate_hz)) as inference:
        for frame in frames[::IMAGE_STEP]:
            if frame.image is None or not truth.covers(frame.frame_id, MIN_AHEAD_M):
                continue
            scores.ious.append(truth.image_iou(frame.frame_id, frame.image, *perceive_still(inference, frame.image)))
    report = scores.report(recording.name)
    write_json(output / "report.json", report)
    return report


def evaluate_later(configuration: Configuration, drive: str) -> tuple[BordersReport, list[int]]:
    """Processes any drive, and compares its lanes with those of later frames; writes report.json to the output.

    Also returns the worst frames. Raises ConfigurationError, DatasetError, ModelError, ResultsError.
    """
    configuration = configuration.as_lossless()
    recording = open_recorded(recording_uri(drive), configuration.camera, configuration.source.stride)
    output = Path(configuration.output)
    claim_directory(output)
    source, later = RecordedSource(recording, configuration.source), LaterLanes()
    with (
        Inference(complete(configuration, recording.camera, source.rate_hz)) as inference,
        Progress(recording.name, len(recording)) as progress,
    ):
        slam = BirdSLAM(recording.camera, inference.networks, configuration.slam, lane_head=inference.lane_head)
        for frame in offline_frames(source):
            later.add(slam.step(frame)[1])
            progress.advance()
    scores, worst = later.scores(int(START_S * recording.rate_hz))
    report = scores.report(recording.name)
    write_json(output / "report.json", report)
    return report, worst
