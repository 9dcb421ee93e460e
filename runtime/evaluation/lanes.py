"""Draws the cells and lanes of one frame (Fig. 4 of the paper)."""

from __future__ import annotations

from pathlib import Path

from birdslam.outputs.drive_files import claim_directory
from birdslam.outputs.lane_picture import draw_lanes
from birdslam.runtime.configuration import Configuration, ConfigurationError, complete
from birdslam.runtime.nodes.inference import Inference
from birdslam.runtime.nodes.sources import RecordedSource, offline_frames, open_recorded, recording_uri
from birdslam.runtime.progress import Progress
from birdslam.slam import BirdSLAM


def draw_frame_lanes(configuration: Configuration, drive: str, frame_id: int | None) -> Path:
    """Processes a drive up to the frame (None: the last), draws it, and returns the path of the picture.

    `drive`: a KITTI directory or the URI of a source. Raises ConfigurationError, DatasetError, ResultsError.
    """
    configuration = configuration.as_lossless()
    recording = open_recorded(recording_uri(drive), configuration.camera, configuration.source.stride)
    frames = len(recording)
    target = frame_id if frame_id is not None else max(frames - 1, 0)
    if not 0 <= target < max(frames, 1):
        raise ConfigurationError(f"--frame {target}: {recording.name} has {frames} frames")
    output = Path(configuration.output)
    claim_directory(output)
    source = RecordedSource(recording, configuration.source)
    path = output / f"lanes_{recording.name}_{target}.png"
    with (
        Inference(complete(configuration, recording.camera, source.rate_hz)) as inference,
        Progress(recording.name, target + 1) as progress,
    ):
        slam = BirdSLAM(recording.camera, inference.networks, configuration.slam, lane_head=inference.lane_head)
        for frame in offline_frames(source):
            slam.step(frame)
            progress.advance()
            if frame.frame_id == target:
                if frame.image is None:
                    raise ConfigurationError(f"--frame {target}: the image of {recording.name} can't be read")
                title = f"{recording.name}, frame {target}"
                draw_lanes(title, frame.image, slam.frontend.lane_view(), configuration.slam.frontend.lanes, path)
                break
    return path
