"""The whole pipeline in one process; waits for every network, so that results are reproducible bit for bit."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator

import cv2

from birdslam.runtime.configuration import Configuration, complete
from birdslam.runtime.nodes.ego_motion import external_odometry
from birdslam.runtime.nodes.inference import Inference
from birdslam.runtime.nodes.sources import RecordedSource, offline_frames
from birdslam.slam import BirdSLAM
from birdslam.sources.recording import Recording
from birdslam.types import Estimate, MapUpdate, Measurements

Drive = Callable[[Recording], Iterator[Measurements | Estimate | MapUpdate]]


@contextlib.contextmanager
def pipeline(configuration: Configuration) -> Iterator[Drive]:
    """Yields a function that processes a recording and yields each frame's Measurements, Estimate and MapUpdate."""
    configuration = configuration.as_lossless()
    cv2.setNumThreads(configuration.perceive.opencv_threads)
    with contextlib.ExitStack() as stack:

        def drive(recording: Recording) -> Iterator[Measurements | Estimate | MapUpdate]:
            source = RecordedSource(recording, configuration.source)
            inference = stack.enter_context(Inference(complete(configuration, recording.camera, source.rate_hz)))
            slam = BirdSLAM(
                recording.camera,
                inference.networks,
                configuration.slam,
                frustum_network=inference.frustum_network,
                lane_head=inference.lane_head,
                odometry=external_odometry(configuration, recording.camera, recording.name),
            )
            for frame, pending in inference.networks.in_order(offline_frames(source)):
                measurements = slam.frontend.measure(frame, pending)
                yield measurements
                yield slam.graph.optimise(measurements)
                gained = slam.map_update()
                if gained is not None:
                    yield gained

        yield drive
