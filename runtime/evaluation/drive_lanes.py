"""Compares lanes with the true lines of a rendered drive."""

from __future__ import annotations

from pathlib import Path

import msgspec

from birdslam.bench.lanes.true_lines import LineScores, LinesReport
from birdslam.bench.lanes.true_vehicles import VehicleScores, VehiclesReport
from birdslam.outputs.drive_files import claim_directory, write_json
from birdslam.runtime.configuration import Configuration, complete
from birdslam.runtime.nodes.inference import Inference
from birdslam.runtime.nodes.sources import RecordedSource, offline_frames, open_recorded, recording_uri
from birdslam.runtime.progress import Progress
from birdslam.slam import BirdSLAM
from birdslam.sources.recording import DatasetError
from birdslam.sources.shipped_drive import DemoRecording


class DriveReport(msgspec.Struct, frozen=True, kw_only=True):
    """The scores of lines and of vehicles in lanes."""

    lines: LinesReport
    vehicles: VehiclesReport


def evaluate_drive(configuration: Configuration, drive: str) -> DriveReport:
    """Processes a rendered drive (`demo:DIR`) and compares each frame; writes report.json to the output.

    Raises ConfigurationError, DatasetError, ModelError, ResultsError.
    """
    configuration = configuration.as_lossless()
    recording = open_recorded(recording_uri(drive), configuration.camera, configuration.source.stride)
    if not isinstance(recording, DemoRecording) or not recording.has_lines:
        raise DatasetError(
            f"{drive}: has no true lines; `python -m perf roads --keep DIR` renders drives with true lines"
        )
    output = Path(configuration.output)
    claim_directory(output)
    source = RecordedSource(recording, configuration.source)
    lines, vehicles = LineScores(), VehicleScores()
    with (
        Inference(complete(configuration, recording.camera, source.rate_hz)) as inference,
        Progress(recording.name, len(recording)) as progress,
    ):
        slam = BirdSLAM(recording.camera, inference.networks, configuration.slam, lane_head=inference.lane_head)
        for frame in offline_frames(source):
            _, estimate = slam.step(frame)
            progress.advance()
            if frame.image is None:
                continue
            truth = recording.truth_lines(frame.frame_id)
            lines.add(estimate.lanes, truth)
            vehicles.add(estimate, recording.truth_bodies(frame.frame_id), truth)
    report = DriveReport(lines=lines.report(recording.name), vehicles=vehicles.report())
    write_json(output / "report.json", report)
    return report
