"""`birdslam evaluate lanes`: what the lanes of one frame are made of, as a picture (Fig. 4 of the paper)."""

from __future__ import annotations

import argparse
from pathlib import Path

import msgspec

from birdslam.outputs.drive_files import claim_directory
from birdslam.outputs.lane_picture import draw_lanes
from birdslam.runtime.configuration import FILE_SCHEMES, ConfigurationError, complete
from birdslam.runtime.nodes.inference import Inference
from birdslam.runtime.nodes.sources import RecordedSource, offline_frames
from birdslam.runtime.options import configuration_of
from birdslam.runtime.progress import Progress
from birdslam.slam import BirdSLAM
from birdslam.sources.opening import open_recording


def evaluate(options: argparse.Namespace) -> int:
    """Drives to the frame and draws it; gives the exit status."""
    configuration = configuration_of(options)
    lossless = msgspec.structs.replace(configuration.source, rate="max")
    configuration = msgspec.structs.replace(configuration, source=lossless)
    uri = options.drive if options.drive.partition(":")[0] in FILE_SCHEMES else f"kitti:{options.drive}"
    recording = open_recording(uri, configuration.camera, configuration.source.stride)
    frames = len(recording)
    asked = options.frame if options.frame is not None else max(frames - 1, 0)
    if not 0 <= asked < max(frames, 1):
        raise ConfigurationError(f"--frame {asked}: {recording.name} has {frames} frames")
    output = Path(configuration.output)
    claim_directory(output)
    source = RecordedSource(recording, configuration.source)
    path = output / f"lanes_{recording.name}_{asked}.png"
    with (
        Inference(complete(configuration, recording.camera, source.rate_hz)) as inference,
        Progress(recording.name, asked + 1) as progress,
    ):
        slam = BirdSLAM(recording.camera, inference.networks, configuration.slam, lane_head=inference.lane_head)
        for frame in offline_frames(source):
            slam.step(frame)
            progress.advance()
            if frame.frame_id == asked:
                if frame.image is None:
                    raise ConfigurationError(f"--frame {asked}: the image of {recording.name} can't be read")
                title = f"{recording.name}, frame {asked}"
                draw_lanes(title, frame.image, slam.frontend.lane_view(), configuration.slam.frontend.lanes, path)
                break
    print(path)
    return 0
