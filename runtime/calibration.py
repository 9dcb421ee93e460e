"""A camera file from a drive: intrinsics read or measured, pitch and roll estimated, the height checked."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import NamedTuple

import cv2
import msgspec
import numpy as np
from numpy.typing import NDArray

from birdslam.calibration.calibration import Calibration, CalibrationConfig, CalibrationError, calibrate
from birdslam.calibration.height_check import VEHICLES, HeightCheck, KnownLength
from birdslam.calibration.intrinsics import Intrinsics, from_chessboard, read_intrinsics
from birdslam.calibration.lens import (
    FIELD_OF_VIEW_DEG,
    STATED_SIGMA_REL,
    focal_by_field_of_view,
    followed_corners,
    self_calibrate,
)
from birdslam.calibration.lens_adjustment import IMAGES
from birdslam.frontend import Pending
from birdslam.geometry.camera import Camera
from birdslam.outputs.drive_files import ResultsError
from birdslam.outputs.plain_words import LengthsBy
from birdslam.ros.bag import BagTopics
from birdslam.runtime.configuration import Configuration, ConfigurationError, complete
from birdslam.runtime.nodes.inference import Inference
from birdslam.runtime.nodes.sources import RecordedSource, offline_frames, open_recorded, parsed, recording_uri
from birdslam.runtime.progress import with_progress
from birdslam.sources.camera_file import camera_text, load_camera
from birdslam.sources.recording import DatasetError, Recording, check_times
from birdslam.sources.speed_file import read_speed_curve
from birdslam.types import NS_PER_S, Frame

UNKNOWN_HEIGHT_M = 1.5  # where none was given: all lengths are in proportion to it, and it is replaced
# Of the height by the size of cars, beside the estimate's own sigma: how much taller cars are from country to country.
# Its own sigma alone is honest on KITTI's sequences, which are of one town (docs/calibration.md)
COUNTRY_SIGMA_REL = 0.08
# Where nothing shows the height: behind a car's windscreen, 1.1 to 1.6 m; by judgement
WINDSCREEN_M, WINDSCREEN_SIGMA_REL = 1.35, 0.2
AGREES_SIGMA = 2.0
# For a drive that follows at once: it looks for the tilt itself, and begins from what the first pass knows
ROUGH = CalibrationConfig(max_sigma_rad=0.05, max_sigma_roll_rad=0.1)
LEVEL_SIGMA_RAD = 0.035  # of pitch and roll where the drive shows neither: two degrees, by judgement
METADATA_SIGMA_REL = 0.1  # of a focal length by metadata: a film often shows less than the sensor sees; by judgement
_LENS_S = 120.0  # of a film, from which its lens is found
_MOUNT_S = 180.0  # of a film, from which pitch, roll and height are found


@dataclass(frozen=True)
class Given:
    """What is known of the camera beside the drive: intrinsics from at most one of the first three, and lengths."""

    camera: Path | None = None  # an older camera file
    intrinsics: Path | None = None  # KITTI's calib.txt, or ROS or OpenCV YAML
    chessboard: Path | None = None  # a directory of images
    board: tuple[int, int] = (9, 6)  # the chessboard's inner corners: columns, rows
    square_m: float = 0.025
    height_m: float | None = None
    fov_deg: float | None = None  # across the image, of a lens that nothing else tells
    kind: str = "dashcam"  # of the camera, where not even that is known
    speed: Path | None = None  # lines of time in s, speed in m/s


class Calibrated(NamedTuple):
    """A camera, and what it rests on, a line each; `lengths_by` is what its metres rest on."""

    camera: Camera
    report: list[str]
    lengths_by: LengthsBy


def calibrate_drive(
    configuration: Configuration,
    source: str,
    given: Given,
    stride: int = 1,
    config: CalibrationConfig = CalibrationConfig(),  # noqa: B008
    must_show: bool = True,
) -> Calibrated:
    """The camera of a drive. `source`: a KITTI directory or a source's URI.

    Without `must_show` what the drive does not show (rain, a truck ahead) is assumed, with its sigma, and the report
    says so. Raises CalibrationError, ConfigurationError, DatasetError.
    """
    uri = recording_uri(source)
    topics = configuration.source.topics
    lens, height_m = lens_of(given, uri, topics)
    size = _frame_size(uri, topics)
    if lens is None and size is not None and parsed(uri)[0].camera in ("frame size", "nothing"):
        lens = lens_of_drive(configuration, uri, given, size, stride, must_show)
    if lens is not None and size is not None:
        lens = lens.for_size(*size)
    recording = _open(uri, lens, height_m, stride, topics)
    known_height = height_m is not None or lens is None  # a recording with a calibration of its own says the height
    cv2.setNumThreads(configuration.perceive.opencv_threads)
    configuration = _lossless(configuration)
    with Inference(configuration) as inference:

        def drive() -> Iterator[tuple[Frame, Pending]]:
            most = round(_MOUNT_S * recording.rate_hz)
            frames = islice(offline_frames(RecordedSource(recording, configuration.source)), most)
            for frame in with_progress(frames, "calibrate", min(most, len(recording)) or None):
                yield frame, inference.start(frame)

        try:
            found = calibrate(
                drive,
                recording.camera,
                configuration.slam.frontend,
                config,
                _lengths(recording, given.speed),
            )
        except CalibrationError as error:
            if must_show:
                raise CalibrationError(f"{uri}: {error}") from None
            found = _level(recording.camera, str(error))
    camera, height_by = _with_height(found, known_height, lens, uri)
    return Calibrated(camera, [*_report(found, camera, height_by, uri, lens)], _lengths_by(camera, height_by, lens))


# --- what is given ---


def lens_of(given: Given, uri: str, topics: BagTopics) -> tuple[Intrinsics | None, float | None]:
    """Intrinsics from elsewhere than the recording, and the height that the user states."""
    height_m = given.height_m
    if height_m is not None and not 0.2 < height_m < 5.0:
        raise ConfigurationError(f"--height {height_m:g}: is no height of a camera over the road (0.2 to 5 m)")
    if given.camera is not None:
        old = load_camera(given.camera)
        numbers = {name: getattr(old, name) for name in ("fx_px", "fy_px", "cx_px", "cy_px", "distortion", "fisheye")}
        lens = Intrinsics(**numbers, width_px=old.width_px, height_px=old.height_px, source=str(given.camera))
        return lens, height_m or old.height_m
    if given.intrinsics is not None:
        return read_intrinsics(given.intrinsics), height_m
    if given.chessboard is not None:
        return from_chessboard(given.chessboard, *given.board, given.square_m), height_m
    kind, path = _class_and_path(uri)
    own = kind.own_lens(path, topics)
    if own is not None:
        return Intrinsics(**own.lens._asdict(), source=own.source), height_m or own.height_m
    return None, height_m


def lens_of_drive(
    configuration: Configuration,
    uri: str,
    given: Given,
    size_px: tuple[int, int],
    stride: int,
    must_show: bool = True,
) -> Intrinsics:
    """The lens of a film that says nothing of its camera, by what its images show.

    Raises CalibrationError where they do not show it; without `must_show` it is then what is known beforehand.
    """
    width_px, height_px = size_px
    focal_px, sigma_rel, by = focal_length_of(given, uri, width_px)
    middle = 0.5 * (width_px - 1.0), 0.5 * (height_px - 1.0)
    camera = Camera(width_px, height_px, focal_px, focal_px, *middle, height_m=given.height_m or UNKNOWN_HEIGHT_M)
    recording = open_recorded(uri, camera, stride, configuration.source.topics)
    configuration = _lossless(configuration)
    frames = max(1, round(_LENS_S * recording.rate_hz))
    with Inference(complete(configuration, camera, recording.rate_hz)) as inference:

        def images() -> Iterator[tuple[NDArray[np.uint8], NDArray[np.float64]]]:
            seen = islice(offline_frames(RecordedSource(recording, configuration.source)), frames)
            for frame in with_progress(seen, "lens", min(frames, len(recording)) or None):
                if frame.image is not None:
                    found = inference.start(frame).result().detections
                    yield frame.image, np.zeros((0, 4)) if found is None else found.boxes_px

        corners = followed_corners(images(), camera)
    lens = self_calibrate(corners, size_px, focal_px, sigma_rel)
    if lens is None and not must_show and len(corners) >= IMAGES:
        return Intrinsics(
            fx_px=focal_px,
            fy_px=focal_px,
            cx_px=middle[0],
            cy_px=middle[1],
            distortion=(),
            width_px=width_px,
            height_px=height_px,
            source=f"assumed, since the drive does not show it: focal length {focal_px:.0f} px +- {sigma_rel:.0%}, "
            f"{by}; no distortion",
            sigma_focal_px=focal_px * sigma_rel,
        )
    if lens is None:
        raise CalibrationError(
            f"{uri}: its images do not show its lens: the car hardly drives in its first {_LENS_S:g} s, or little is "
            "to be seen; --intrinsics, --chessboard or --camera name a lens"
        )
    focal = f"focal length {lens.focal_px:.0f} px +- {lens.focal_sigma_rel:.0%}"
    shown = "by the drive" if lens.focal_shown else f"{by}; the drive turns too little to show it"
    return Intrinsics(
        fx_px=lens.focal_px,
        fy_px=lens.focal_px,
        cx_px=middle[0],
        cy_px=middle[1],
        distortion=(lens.k1, 0.0, 0.0, 0.0),
        width_px=width_px,
        height_px=height_px,
        source=(
            f"the drive: {focal}, {shown}; k1 {lens.k1:+.3f} +- {lens.k1_sigma:.3f} "
            f"(of {lens.windows} windows, {np.degrees(lens.turned_rad):.0f} deg turned)"
        ),
        sigma_focal_px=lens.focal_px * lens.focal_sigma_rel,
    )


def focal_length_of(given: Given, uri: str, width_px: int) -> tuple[float, float, str]:
    """What is known of it before the drive: as stated, by the film's metadata, or by the kind of camera.

    In pixels, its 1-sigma as a fraction, and where it comes from. Raises ConfigurationError.
    """
    if given.fov_deg is not None:
        if not 10.0 <= given.fov_deg <= 150.0:
            raise ConfigurationError(f"--fov {given.fov_deg:g}: is no field of view of a camera here (10 to 150 deg)")
        focal_px = focal_by_field_of_view(width_px, given.fov_deg)
        return focal_px, STATED_SIGMA_REL, f"as stated, {given.fov_deg:g} deg across"
    kind, path = _class_and_path(uri)
    stated_px = kind.stated_focal_px(path)
    if stated_px is not None and focal_by_field_of_view(width_px, 150.0) < stated_px:
        return stated_px, METADATA_SIGMA_REL, f"that of the film's own metadata, {stated_px:.0f} px"
    fov_deg, sigma_rel = FIELD_OF_VIEW_DEG[given.kind]
    return focal_by_field_of_view(width_px, fov_deg), sigma_rel, f"that of a {given.kind}, {fov_deg:g} deg across"


def _level(camera: Camera, why: str) -> Calibration:
    """A camera that looks level, since the drive does not show how it is mounted."""
    camera = msgspec.structs.replace(camera, pitch_rad=0.0, roll_rad=0.0, tilt_sigma_rad=LEVEL_SIGMA_RAD)
    var = LEVEL_SIGMA_RAD**2
    return Calibration(
        camera=camera,
        cov=(var, 0.0, 0.0, var),
        estimates=(),
        height_checks=(),
        yaw_rad=None,
        path_m=0.0,
        frames=0,
        assumed=why,
    )


def _lossless(configuration: Configuration) -> Configuration:
    return msgspec.structs.replace(configuration, source=msgspec.structs.replace(configuration.source, rate="max"))


def _class_and_path(uri: str) -> tuple[type[Recording], Path]:
    scheme, address = parsed(uri)
    return scheme.load(), Path(address).expanduser()


def _frame_size(uri: str, topics: BagTopics) -> tuple[int, int] | None:
    """(width, height) in pixels of the recording's frames; None where it is unknown."""
    kind, path = _class_and_path(uri)
    try:
        return kind.frame_size(path, topics)
    except DatasetError:  # opening it says what is wrong
        return None


def _open(uri: str, lens: Intrinsics | None, height_m: float | None, stride: int, topics: BagTopics) -> Recording:
    if lens is None:
        recording = open_recorded(uri, stride=stride)
        if height_m is not None:
            recording.camera = msgspec.structs.replace(recording.camera, height_m=height_m)
        return recording
    width_px, height_px = lens.width_px, lens.height_px
    if width_px is None or height_px is None:
        calibrated = parsed(uri)[0].camera in ("calibration", "intrinsics")  # of a film it could be any size
        size = _frame_size(uri, topics) if calibrated else None
        if size is None:
            raise DatasetError(f"{lens.source}: does not say for which size of image it is")
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
        )
    except ValueError as error:
        raise DatasetError(f"{lens.source}: {error}") from None
    return open_recorded(uri, camera, stride, topics)


def _lengths(recording: Recording, speed_file: Path | None) -> dict[str, KnownLength]:
    """What else knows the way between two frames: the recording's poses, a speed file."""
    out: dict[str, KnownLength] = {}
    truth = recording.truth_poses()
    if truth is not None and np.isfinite(truth).all():
        at = truth[:, :, 3]

        def by_poses(start: int, end: int, start_ns: int, end_ns: int) -> float:
            return float(np.linalg.norm(np.diff(at[start : end + 1], axis=0), axis=1).sum())

        out["poses"] = by_poses
    if speed_file is not None:
        t_s, speed_mps = read_speed_curve(speed_file).T
        way_m = np.concatenate([[0.0], np.cumsum(np.diff(t_s) * 0.5 * (speed_mps[1:] + speed_mps[:-1]))])

        def by_speed(start: int, end: int, start_ns: int, end_ns: int) -> float | None:
            if start_ns * 1e-9 < t_s[0] or end_ns * 1e-9 > t_s[-1]:
                return None
            return float(np.interp(end_ns * 1e-9, t_s, way_m) - np.interp(start_ns * 1e-9, t_s, way_m))

        check_times(recording, speed_file, round(t_s[0] * NS_PER_S), round(t_s[-1] * NS_PER_S))
        out["speed"] = by_speed
    return out


# --- what is found ---


class HeightBy(NamedTuple):
    """Where the camera's height comes from; `check` is the cue that gave it, None where it was stated."""

    words: str
    check: HeightCheck | None
    sigma_rel: float  # of all lengths along the road, by this height and the focal length


def _with_height(found: Calibration, known: bool, lens: Intrinsics | None, uri: str) -> tuple[Camera, HeightBy]:
    """The camera with the height that was stated, else with the surest that was estimated."""
    focal_rel = _focal_sigma_rel(lens)
    if known:
        height_m, by = found.camera.height_m, HeightBy("as stated", None, focal_rel)
    else:
        height_m, by = _estimated_height(found, focal_rel)
    try:
        return msgspec.structs.replace(found.camera, height_m=height_m, scale_sigma_rel=min(by.sigma_rel, 1.0)), by
    except ValueError as error:
        raise CalibrationError(f"{uri}: height {by.words}: {error}") from None


def _estimated_height(found: Calibration, focal_rel: float) -> tuple[float, HeightBy]:
    """By a known length, by the size of cars, or by where cameras are."""
    sigmas = {
        check.cue: math.hypot(check.sigma_m / check.height_m, COUNTRY_SIGMA_REL * (check.cue == VEHICLES))
        for check in found.height_checks
    }
    check = min(found.height_checks, key=lambda check: sigmas[check.cue], default=None)
    if check is None or sigmas[check.cue] > WINDSCREEN_SIGMA_REL:
        sigma_rel = math.hypot(WINDSCREEN_SIGMA_REL, focal_rel)
        words = f"of most windscreens, +- {WINDSCREEN_SIGMA_REL:.0%}, since nothing here tells it"
        return WINDSCREEN_M, HeightBy(words, None, sigma_rel)
    own_rel = sigmas[check.cue]
    if check.cue == VEHICLES:
        by = HeightBy(f"by the size of {check.samples} cars, +- {own_rel:.0%}", check, math.hypot(own_rel, focal_rel))
    else:  # a known length holds height and focal length together
        by = HeightBy(f"by {check.cue} along {found.path_m:.0f} m, +- {own_rel:.0%}", check, own_rel)
    return check.height_m, by


def _focal_sigma_rel(lens: Intrinsics | None) -> float:
    """As a fraction of the focal length, where it is an estimate; a chessboard's is measured."""
    if lens is None or lens.sigma_focal_px is None or lens.reprojection_px is not None:
        return 0.0
    return lens.sigma_focal_px / lens.fx_px


def _lengths_by(camera: Camera, by: HeightBy, lens: Intrinsics | None) -> LengthsBy:
    words = f"the camera's height of {camera.height_m:.2f} m ({by.words})"
    focal_rel = _focal_sigma_rel(lens)
    if by.check is not None and by.check.cue != VEHICLES:  # a known length holds both together
        return LengthsBy(words, by.sigma_rel)
    if focal_rel:
        words += f" and its focal length of {camera.fx_px:.0f} px, +- {focal_rel:.0%}"
    return LengthsBy(words, math.sqrt(max(by.sigma_rel**2 - focal_rel**2, 0.0)), focal_rel)


def _report(
    found: Calibration, camera: Camera, height_by: HeightBy, uri: str, lens: Intrinsics | None
) -> Iterator[str]:
    if found.assumed:
        yield f"from {uri}: assumed to look level, since the drive does not show its tilt: {found.assumed}"
    else:
        yield f"from {uri}: {found.frames} frames, {found.path_m:.0f} m"
    source = "the recording" if lens is None else lens.source
    error = "" if lens is None or lens.reprojection_px is None else f", reprojection {lens.reprojection_px:.2f} px"
    yield f"intrinsics: {source}{error}"
    for reason in () if lens is None else lens.left_out:
        yield f"  left out: {reason}"
    sigma = np.degrees(np.sqrt(np.diag(np.reshape(found.cov, (2, 2)))))
    pitch_deg, roll_deg = np.degrees([camera.pitch_rad, camera.roll_rad])
    yield f"pitch {pitch_deg:+.2f} +- {sigma[0]:.2f} deg, roll {roll_deg:+.2f} +- {sigma[1]:.2f} deg"
    for estimate in found.estimates:
        own = np.degrees(np.sqrt(np.diag(np.reshape(estimate.cov, (2, 2)))))
        roll = "" if estimate.roll_rad is None else f", roll {np.degrees(estimate.roll_rad):+.2f} +- {own[1]:.2f} deg"
        yield (
            f"  by {estimate.cue}: pitch {np.degrees(estimate.pitch_rad):+.2f} +- {own[0]:.2f} deg{roll} "
            f"(of {estimate.samples}, chi2 {estimate.chi2:.1f})"
        )
    if found.yaw_rad is not None:
        yield f"optical axis {np.degrees(found.yaw_rad):+.2f} deg left of the way driven (for information)"
    yield f"height {camera.height_m:.3f} m, {height_by.words}"
    if height_by.sigma_rel:
        yield f"all lengths +- {height_by.sigma_rel:.0%}, by height and focal length (scale_sigma_rel)"
    for check in found.height_checks:
        if check is height_by.check:
            continue
        away = abs(check.height_m - camera.height_m) / check.sigma_m
        verdict = "agrees" if away < AGREES_SIGMA else f"DISAGREES ({away:.1f} sigma)"
        yield f"  by {check.cue}: {check.height_m:.2f} +- {check.sigma_m:.2f} m (of {check.samples}): {verdict}"
    if not found.height_checks:
        yield "  not checked: neither poses nor a speed nor enough vehicles were there"


def write_camera_file(path: Path, camera: Camera, report: Sequence[str]) -> None:
    """Writes the camera, with the report as comment. Raises ResultsError."""
    text = camera_text(camera, ("A camera file of BirdSLAM, by `birdslam calibrate`", *report))
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")
    except OSError as error:
        raise ResultsError(f"camera file {path}: {error.strerror}") from None
