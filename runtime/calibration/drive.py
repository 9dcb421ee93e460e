"""Calibrates a camera from a drive: intrinsics read or estimated, pitch and roll estimated, the height checked."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import cv2
import msgspec

from birdslam.calibration.calibration import Calibration, CalibrationConfig, CalibrationError, calibrate
from birdslam.calibration.height_check import KNOWN_VEHICLE, LANES
from birdslam.calibration.intrinsics import Intrinsics
from birdslam.calibration.lane_width import MIN_DISTANCE_M
from birdslam.calibration.lens_windows import CornersOfImage
from birdslam.calibration.readout import Readout, readout_of_drive
from birdslam.calibration.travel import TravelPitch
from birdslam.frontend import Pending
from birdslam.geometry.camera import Camera
from birdslam.outputs.plain_words import LengthsBy
from birdslam.perception import KeptFindings
from birdslam.ros.bag import BagTopics
from birdslam.runtime.calibration.given import Given, frame_size, lens_of
from birdslam.runtime.calibration.height import (
    UNKNOWN_HEIGHT_M,
    focal_sigma_rel,
    known_lengths,
    lengths_by,
    with_height,
)
from birdslam.runtime.calibration.lens import corners_of_drive, lens_of_drive
from birdslam.runtime.calibration.pieces import pieces, read_pieces
from birdslam.runtime.calibration.report import report
from birdslam.runtime.configuration import Configuration
from birdslam.runtime.nodes.inference import Inference
from birdslam.runtime.nodes.sources import open_recorded, parsed, recording_uri
from birdslam.sources.recording import DatasetError, Recording
from birdslam.types import Frame

# For a first pass: the run that follows estimates the tilt again
ROUGH = CalibrationConfig(max_sigma_rad=0.05, max_sigma_roll_rad=0.1)
LEVEL_SIGMA_RAD = 0.035  # prior of pitch and roll: two degrees, by judgement
TILT_HZ = 12.0  # least frame rate of the passes for the tilt: a higher one adds correlated alignments of the road


class Calibrated(NamedTuple):
    """A camera with its report, the source of its metric scale (`lengths_by`), and the networks' findings."""

    camera: Camera
    report: list[str]
    lengths_by: LengthsBy
    kept: KeptFindings


def calibrate_drive(
    configuration: Configuration,
    source: str,
    given: Given,
    stride: int = 1,
    config: CalibrationConfig = CalibrationConfig(),  # noqa: B008
    must_show: bool = True,
) -> Calibrated:
    """Calibrates the camera of a drive. `source`: a KITTI directory or a source's URI.

    Without `must_show` quantities that the drive does not determine get a prior with its sigma, named in the report.
    Raises CalibrationError, ConfigurationError, DatasetError.
    """
    uri = recording_uri(source)
    topics = configuration.source.topics
    lens, height_m = lens_of(given, uri, topics)
    size = frame_size(uri, topics)
    is_film = parsed(uri)[0].camera in ("frame size", "nothing")
    pitch: TravelPitch | None = None
    corners: list[CornersOfImage] | None = None
    if lens is None and size is not None and is_film:
        lens, corners, pitch = lens_of_drive(configuration, uri, given, size, stride, must_show)
    if lens is not None and size is not None:
        lens = lens.for_size(*size)
    recording, every = _open_slowly(uri, lens, height_m, stride, topics)
    if pitch is not None:
        recording.camera = msgspec.structs.replace(recording.camera, pitch_rad=pitch.pitch_rad)
    readout: Readout | None = None
    # In a portrait video the rows of the sensor are columns of the image
    if is_film and recording.camera.width_px >= recording.camera.height_px:
        corners = corners or corners_of_drive(configuration, uri, recording.camera, stride)
        readout = readout_of_drive(corners, recording.camera, focal_sigma_rel(lens))
        recording.camera = msgspec.structs.replace(recording.camera, readout_s=readout.readout_s)
    most_frames = None if configuration.source.frames is None else max(1, configuration.source.frames // every)
    known_height = height_m is not None or lens is None  # a recording with its own calibration has the height
    cv2.setNumThreads(configuration.perceive.opencv_threads)
    configuration = configuration.as_lossless()
    config = msgspec.structs.replace(config, known_lane_m=given.size.lane_m, known_vehicle_m=given.size.car_height_m)
    kept = KeptFindings()
    with Inference(configuration, kept=kept) as inference:

        def drive() -> Iterator[tuple[Frame, Pending]]:
            return inference.networks.in_order(read_pieces(recording, pieces(recording, most_frames), "calibrate"))

        try:
            found = calibrate(
                drive, recording.camera, configuration.slam.frontend, config, known_lengths(recording, given.speed)
            )
        except CalibrationError as error:
            if must_show:
                raise CalibrationError(f"{uri}: {error}") from None
            found = _assumed(recording.camera, pitch, str(error))
    if given.size.lane_m is not None and not any(check.cue == LANES for check in found.height_checks):
        raise CalibrationError(f"{uri}: --known-length lane: less than {MIN_DISTANCE_M:g} m between two painted lines")
    if given.size.car_height_m is not None and not any(check.cue == KNOWN_VEHICLE for check in found.height_checks):
        raise CalibrationError(f"{uri}: --known-length car: the drive shows no vehicle well enough")
    camera, height_by = with_height(found, known_height, lens, uri, readout)
    return Calibrated(
        camera,
        [*report(found, camera, height_by, uri, lens, readout)],
        lengths_by(camera, height_by, lens, given.fov_deg),
        kept,
    )


def _assumed(camera: Camera, pitch: TravelPitch | None, why: str) -> Calibration:
    """Returns a level camera, or one with the pitch of its direction of travel, if the road does not show the tilt."""
    level = TravelPitch(0.0, LEVEL_SIGMA_RAD)
    pitch_rad, sigma_rad = pitch or level
    camera = msgspec.structs.replace(camera, pitch_rad=pitch_rad, roll_rad=0.0, tilt_sigma_rad=LEVEL_SIGMA_RAD)
    return Calibration(
        camera=camera,
        cov=(sigma_rad**2, 0.0, 0.0, LEVEL_SIGMA_RAD**2),
        estimates=(),
        height_checks=(),
        yaw_rad=None,
        path_m=0.0,
        frames=0,
        speed_mps=0.0,
        assumed=f"pitch from the direction of travel, no roll: {why}" if pitch else f"a level camera: {why}",
    )


def _open_slowly(
    uri: str, lens: Intrinsics | None, height_m: float | None, stride: int, topics: BagTopics
) -> tuple[Recording, int]:
    """Opens the recording at a frame rate of TILT_HZ or a little more; also returns the factor on the stride."""
    recording = _open(uri, lens, height_m, stride, topics)
    every = max(1, int(recording.rate_hz / TILT_HZ))
    return (recording if every == 1 else _open(uri, lens, height_m, stride * every, topics)), every


def _open(uri: str, lens: Intrinsics | None, height_m: float | None, stride: int, topics: BagTopics) -> Recording:
    if lens is None:
        recording = open_recorded(uri, stride=stride)
        if height_m is not None:
            recording.camera = msgspec.structs.replace(recording.camera, height_m=height_m)
        return recording
    width_px, height_px = lens.width_px, lens.height_px
    if width_px is None or height_px is None:
        calibrated = parsed(uri)[0].camera in ("calibration", "intrinsics")  # a video may have any size
        size = frame_size(uri, topics) if calibrated else None
        if size is None:
            raise DatasetError(
                f"{lens.source}: has no image size, which a film does not show; write the camera as camera_info of ROS"
            )
        width_px, height_px = size
    try:
        camera = Camera(
            width_px,
            height_px,
            lens.fx_px,
            lens.fy_px,
            lens.cx_px,
            lens.cy_px,
            height_m=height_m or UNKNOWN_HEIGHT_M,
            distortion=lens.distortion,
            fisheye=lens.fisheye,
            distortion_sigma=lens.distortion_sigma,
        )
    except ValueError as error:
        raise DatasetError(f"{lens.source}: {error}") from None
    return open_recorded(uri, camera, stride, topics)
