"""The verdict on a drive: which frames are valid, why the others are not, and how exact the lengths are."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from birdslam.types import INVALIDATING, SpeedSource, Status

# The meaning of each status for people; status.py defines it for planners
MEANINGS: Mapping[Status, str] = {
    Status.END_OF_SOURCE: "the film or the camera has ended",
    Status.FRAME_UNREADABLE: "the image is damaged or missing",
    Status.FRAMES_DROPPED: "images before this one are missing",
    Status.CAMERA_FROZEN: "the camera repeats the same image",
    Status.CAMERA_DARK: "the image is too dark or has hardly any contrast",
    Status.LOW_TEXTURE: "the image has too few features to track",
    Status.ODOMETRY_COASTING: "the motion is predicted, not measured",
    Status.SCALE_CARRIED: "the road is hidden, and the scale is kept from earlier frames",
    Status.SCALE_INVALID: "the road has shown too little to determine the scale",
    Status.MOTION_IMPLAUSIBLE: "the measured motion is impossible for a car",
    Status.STANDSTILL: "the car is stationary",
    Status.GROUND_VIOLATED: "the road is not as flat as the model assumes",
    Status.CAR_SPEED_LATE: "the speed of the car arrived late",
    Status.CAR_SPEED_MISSING: "the speed of the car is missing",
    Status.CAR_SPEED_IMPLAUSIBLE: "the speed of the car contradicts the images and was not used",
    Status.CAR_SPEED_FROZEN: "the speed of the car does not change and was not used",
    Status.VIEW_OBSTRUCTED: "a part of the view moves with the camera (bonnet, caption, drops) and is ignored",
    Status.CALIBRATION_DRIFT: "vehicles or the road contradict the height or tilt of the camera",
    Status.DETECTIONS_CARRIED: "the boxes are those of an earlier image",
    Status.SEGMENTATION_CARRIED: "the road mask is that of an earlier image",
    Status.DEPTH_CARRIED: "the depths are those of an earlier image",
    Status.LANES_CARRIED: "the lanes are those of an earlier image",
    Status.PROVIDER_MISSING: "a network runs on the processor, because its accelerator is missing or failed",
    Status.NETWORK_FAILED: "a network returned no finite numbers",
    Status.INPUT_STALE: "an input arrived late",
    Status.DEGRADED_RATE: "the computer is too slow, and the detector runs less often",
    Status.DEGRADED_BOXES: "the computer is too slow, and only the detector runs",
    Status.DEGRADED_ODOMETRY: "the computer is too slow, and no network runs",
    Status.COASTING: "the computer is too slow, and this image was skipped",
    Status.COASTED_TOO_LONG: "the computer is too slow, and images were skipped for too long",
    Status.PERCEPTION_LATE: "the measurements of this image are late",
    Status.GRAPH_RESET: "the trajectory restarts here, at an unknown distance from the part before",
    Status.GRAPH_RESTORED: "a process was restarted and continues from its checkpoint",
    Status.NOT_INITIALISED: "no motion has been measured yet",
    Status.SCALE_ESTIMATED: "the height or the lens of the camera is an estimate, and so are all lengths",
    Status.UNKNOWN: "the status is unknown to this version",
}

# The remedy for a status of many frames
REMEDIES: Mapping[Status, str] = {
    Status.CAMERA_DARK: "record in daylight",
    Status.SCALE_INVALID: "give the speed of the car or a GPS track (--speed FILE)",
    Status.CALIBRATION_DRIFT: "measure the height of the camera again and check its mount",
    Status.FRAME_UNREADABLE: "copy the film again or re-encode it",
    Status.CAMERA_FROZEN: "if the film has each image twice, read every second one (--stride 2)",
    Status.COASTED_TOO_LONG: "process every frame, slower than real time (--rate max)",
    Status.CAR_SPEED_IMPLAUSIBLE: "check that the speed file and the film use the same clock",
}
MAX_SIGMA_REL = 0.04  # a tape measure or a data sheet is more accurate
MIN_REMEDY_SHARE = 0.2  # of the frames
REPORTED = (Status.CALIBRATION_DRIFT, Status.SCALE_ESTIMATED, Status.VIEW_OBSTRUCTED, Status.STANDSTILL)


class LengthsBy(NamedTuple):
    """The source of the scale, and the 1-sigma of all lengths due to the camera height and the focal length."""

    words: str = "the height and lens of the camera, as the camera file or the recording states them"
    height_sigma_rel: float = 0.0
    focal_sigma_rel: float = 0.0
    contradicted_by: str = ""  # the evidence for another height than the stated one
    view_is_stated: bool = False  # the field of view was given


AS_STATED = LengthsBy()


@dataclass(frozen=True, kw_only=True)
class DriveCounts:
    """The input of the verdict: the counts of one drive."""

    frames: int
    invalid_frames: int
    invalid_by: Mapping[str, int]  # invalid frames by status
    statuses: Mapping[str, int]
    speed_sources: Mapping[str, int]
    path_m: float
    valid_path_m: float
    scale_sigma_rel: float | None  # median of the valid frames
    camera_sigma_rel: float  # the part due to camera height and lens
    lengths_by: LengthsBy = AS_STATED
    ends_unreadable: bool = False  # the last image is damaged or missing


def verdict(drive: DriveCounts) -> list[str]:
    """Returns sentences: the share of valid frames, why others are not, how exact lengths are, what to do next."""
    return [*_validity(drive), *_lengths(drive), *_next_steps(drive)]


def _validity(drive: DriveCounts) -> Iterable[str]:
    valid = drive.frames - drive.invalid_frames
    if not drive.frames:
        yield "No frame was processed."
        return
    if not valid:
        yield f"No frame is valid (0 of {drive.frames})."
    elif valid == drive.frames:
        yield f"All {valid} frames are valid ({drive.path_m:.0f} m)."
    else:
        share = _share(valid, drive.frames)
        yield f"{share} of frames are valid ({valid} of {drive.frames}, {drive.valid_path_m:.0f} m)."
    for name, frames in sorted(drive.invalid_by.items(), key=lambda item: -item[1]):
        yield f"Not valid: {_frames(frames)}, because {meaning(name)} ({name})."
    if drive.ends_unreadable:
        yield "The last image is damaged or missing. The film was cut off there."
    for status in REPORTED:
        frames = drive.statuses.get(status.value, 0)
        if frames and status not in INVALIDATING:
            yield f"{_frames(frames).capitalize()}: {MEANINGS[status]} ({status.value})."


def _lengths(drive: DriveCounts) -> Iterable[str]:
    if drive.scale_sigma_rel is None:
        return
    by = drive.lengths_by.words
    by_car = drive.speed_sources.get(SpeedSource.CAR.value, 0)
    if by_car:
        by += f"; for {_share(by_car, drive.frames)} of the frames on the speed of the car"
    yield f"Lengths are accurate to {drive.scale_sigma_rel:.0%} (1 sigma). They rest on {by}."
    if drive.lengths_by.contradicted_by:
        yield (
            f"The stated height or lens is contradicted: {drive.lengths_by.contradicted_by}. "
            "Measure it again; the sigma covers both values."
        )
    if not drive.camera_sigma_rel:
        yield "This takes the height as exact: an error of 5 % in the height is an error of 5 % in all lengths."


def _next_steps(drive: DriveCounts) -> Iterable[str]:
    height_rel, focal_rel = drive.lengths_by.height_sigma_rel, drive.lengths_by.focal_sigma_rel
    advice = [
        (
            height_rel,
            "measure the height of the camera above the road (--height M): 5 % of height is 5 % of all lengths.",
        ),
        (
            focal_rel,
            ("" if drive.lengths_by.view_is_stated else "give the field of view (--fov DEG), or ")
            + "photograph a chessboard (birdslam calibrate --chessboard): "
            "5 % of focal length is 5 % of lengths along the road.",
        ),
    ]
    for sigma_rel, words in sorted(advice, reverse=True):  # the largest first
        if sigma_rel > MAX_SIGMA_REL:
            yield f"Next: {words}"
    stationary = drive.statuses.get(Status.STANDSTILL.value, 0)
    if drive.invalid_frames == drive.frames < 2 * stationary:  # most frames
        yield "The camera hardly moves. Without motion there is no scale and no trajectory: film from a moving car."
        return
    for status, remedy in REMEDIES.items():
        if drive.statuses.get(status.value, 0) > MIN_REMEDY_SHARE * drive.frames:
            yield f"Remedy for {status.value}: {remedy}."


def meaning(status: str) -> str:
    """Returns the meaning of a status."""
    return MEANINGS[Status(status)]


def _frames(count: int) -> str:
    return f"{count} frame{'s' * (count != 1)}"


def _share(part: int, whole: int) -> str:
    """Returns a percentage that is 0 or 100 % only if exactly so."""
    return f"{min(max(round(100.0 * part / max(whole, 1)), part > 0), 100 - (part < whole))} %"


def readme(name: str, sentences: Sequence[str], files: Mapping[str, str]) -> str:
    """Returns the README.txt of a drive: the verdict and the meaning of each file."""
    width = max(map(len, files), default=0)
    lines = [f"Results of BirdSLAM: {name}", "", *sentences, "", "Files:", ""]
    return "\n".join([*lines, *(f"  {file:<{width}}  {what}" for file, what in files.items()), ""])
