"""Compares the lanes of a drive with ground truth (`--truth`), or draws those of one frame (Fig. 4 of the paper).

`drive` is a KITTI directory or the URI of a source. The functions write to the output folder, and raise
ConfigurationError, DatasetError, ModelError, ResultsError.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import msgspec

from birdslam.bench.lanes.later_lanes import LaterLanes
from birdslam.bench.lanes.true_borders import START_S, BorderScores, BordersReport, TrueBorders, read_borders
from birdslam.bench.lanes.true_lines import LineScores, LinesReport
from birdslam.bench.lanes.true_vehicles import VehicleScores, VehiclesReport
from birdslam.outputs.drive_files import claim_directory, write_json
from birdslam.outputs.lane_picture import draw_lanes
from birdslam.runtime.configuration import Configuration, ConfigurationError, complete
from birdslam.runtime.evaluation.still_lanes import REPORT, perceive_still
from birdslam.runtime.nodes.inference import Inference
from birdslam.runtime.nodes.sources import RecordedSource, offline_frames, open_recorded, recording_uri
from birdslam.runtime.progress import Progress
from birdslam.slam import BirdSLAM
from birdslam.sources.recording import DatasetError, Recording
from birdslam.sources.shipped_drive import DemoRecording
from birdslam.types import Estimate, Frame

IMAGE_STEP = 10  # every n-th image is searched for its lane on its own
MIN_AHEAD_M = 33.0  # known borders ahead of a frame that counts


class DriveReport(msgspec.Struct, frozen=True, kw_only=True):
    """The scores of lines and of vehicles in lanes."""

    lines: LinesReport
    vehicles: VehiclesReport


def draw_frame_lanes(configuration: Configuration, drive: str, frame_id: int | None) -> Path:
    """Processes a drive up to the frame (None: the last), draws it, and returns the path of the picture."""
    recording, configuration = _open(configuration, drive)
    frames = len(recording)
    target = frame_id if frame_id is not None else max(frames - 1, 0)
    if not 0 <= target < max(frames, 1):
        raise ConfigurationError(f"--frame {target}: {recording.name} has {frames} frames")
    path = _output(configuration) / f"lanes_{recording.name}_{target}.png"
    with _processed(configuration, recording, target + 1) as (slam, processed):
        for frame, _ in processed:
            if frame.frame_id == target:
                if frame.image is None:
                    raise ConfigurationError(f"--frame {target}: the image of {recording.name} can't be read")
                title = f"{recording.name}, frame {target}"
                draw_lanes(title, frame.image, slam.frontend.lane_view(), configuration.slam.frontend.lanes, path)
                break
    return path


def evaluate_drive(configuration: Configuration, drive: str) -> DriveReport:
    """Compares each frame of a rendered drive (`demo:DIR`) with its true lines."""
    recording, configuration = _open(configuration, drive)
    if not isinstance(recording, DemoRecording) or not recording.has_lines:
        raise DatasetError(
            f"{drive}: has no true lines; `python -m perf roads --keep DIR` renders drives with true lines"
        )
    output, lines, vehicles = _output(configuration), LineScores(), VehicleScores()
    with _processed(configuration, recording) as (_, processed):
        for frame, estimate in processed:
            if frame.image is not None:
                truth = recording.truth_lines(frame.frame_id)
                lines.add(estimate.lanes, truth)
                vehicles.add(estimate, recording.truth_bodies(frame.frame_id), truth)
    report = DriveReport(lines=lines.report(recording.name), vehicles=vehicles.report())
    write_json(output / REPORT, report)
    return report


def evaluate_borders(configuration: Configuration, drive: str, file: Path) -> BordersReport:
    """Compares the ego lane of a drive with true poses with its traced borders, tracked and in single images."""
    recording, configuration = _open(configuration, drive)
    truth = TrueBorders(recording, read_borders(file))
    output, scores, images = _output(configuration), BorderScores(), list[Frame]()
    with _processed(configuration, recording) as (_, processed):
        for number, (frame, estimate) in enumerate(processed):
            if not truth.covers(frame.frame_id, MIN_AHEAD_M):
                continue
            if frame.frame_id >= START_S * recording.rate_hz:
                scores.add(estimate.lanes, *truth.borders_m(frame.frame_id))
            if number % IMAGE_STEP == 0:
                images.append(frame)
    with _inference(configuration, recording) as inference:
        for frame in images:
            if frame.image is not None:
                found = perceive_still(inference, frame.image)
                scores.ious.append(truth.image_iou(frame.frame_id, frame.image, *found))
    report = scores.report(recording.name)
    write_json(output / REPORT, report)
    return report


def evaluate_later(configuration: Configuration, drive: str) -> tuple[BordersReport, list[int]]:
    """Compares the lanes of any drive with those of later frames; also returns the worst frames."""
    recording, configuration = _open(configuration, drive)
    output, later = _output(configuration), LaterLanes()
    with _processed(configuration, recording) as (_, processed):
        for _, estimate in processed:
            later.add(estimate)
    scores, worst = later.scores(int(START_S * recording.rate_hz))
    if not worst:
        raise DatasetError(f"{drive}: the ego reaches no road that it has seen from {START_S:g} s on")
    report = scores.report(recording.name)
    write_json(output / REPORT, report)
    return report, worst


def _open(configuration: Configuration, drive: str) -> tuple[Recording, Configuration]:
    """The recording, and the configuration with rate "max"."""
    recording = open_recorded(recording_uri(drive), configuration.camera, configuration.source.stride)
    return recording, configuration.as_lossless()


def _output(configuration: Configuration) -> Path:
    output = Path(configuration.output)
    claim_directory(output)
    return output


def _inference(configuration: Configuration, recording: Recording) -> Inference:
    rate_hz = RecordedSource(recording, configuration.source).rate_hz
    return Inference(complete(configuration, recording.camera, rate_hz))


@contextmanager
def _processed(
    configuration: Configuration, recording: Recording, frames: int | None = None
) -> Iterator[tuple[BirdSLAM, Iterator[tuple[Frame, Estimate]]]]:
    """The pipeline, and the first `frames` frames (None: all) with their estimates; shows progress."""
    count = len(recording) if frames is None else frames
    with _inference(configuration, recording) as inference, Progress(recording.name, count) as progress:
        slam = BirdSLAM(recording.camera, inference.networks, configuration.slam, lane_head=inference.lane_head)

        def processed() -> Iterator[tuple[Frame, Estimate]]:
            for frame in offline_frames(RecordedSource(recording, configuration.source)):
                _, estimate = slam.step(frame)
                progress.advance()
                yield frame, estimate

        yield slam, processed()
