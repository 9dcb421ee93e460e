"""How far a drive's results are to be believed, in sentences for somebody who has read no page of ours."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from birdslam.types import INVALIDATING, SpeedSource, Status

# What each status means for a person; status.py says it for a planner
MEANINGS: Mapping[Status, str] = {
    Status.END_OF_SOURCE: "the film or the camera has ended",
    Status.FRAME_UNREADABLE: "the picture is damaged or missing",
    Status.FRAMES_DROPPED: "pictures before this one are missing",
    Status.CAMERA_FROZEN: "the camera shows the very same picture again",
    Status.CAMERA_DARK: "it is too dark, or the picture has hardly any contrast",
    Status.LOW_TEXTURE: "hardly anything in the picture can be followed",
    Status.ODOMETRY_COASTING: "the motion is guessed from the moment before, not seen",
    Status.SCALE_CARRIED: "the road is hidden: the length of a metre is kept from before",
    Status.SCALE_INVALID: "the road shows too little to know how long a metre is, or has not shown it for long",
    Status.MOTION_IMPLAUSIBLE: "the motion that was seen is none that a car makes",
    Status.STANDSTILL: "the car stands",
    Status.GROUND_VIOLATED: "the road is not as flat as it is taken for",
    Status.CAR_SPEED_LATE: "the car's own speed came late",
    Status.CAR_SPEED_MISSING: "the car's own speed is missing",
    Status.CAR_SPEED_IMPLAUSIBLE: "the car's own speed contradicts the pictures, and was left out",
    Status.CAR_SPEED_FROZEN: "the car's own speed is stuck at one number, and was left out",
    Status.VIEW_OBSTRUCTED: "something before the camera moves with it (bonnet, caption, drops): that part is left out",
    Status.CALIBRATION_DRIFT: "the cars seen, or the road, contradict the camera's height or tilt",
    Status.DETECTIONS_CARRIED: "the boxes are those of an earlier picture",
    Status.SEGMENTATION_CARRIED: "the road's outline is that of an earlier picture",
    Status.DEPTH_CARRIED: "the depths are those of an earlier picture",
    Status.LANES_CARRIED: "the lanes are those of an earlier picture",
    Status.PROVIDER_MISSING: "a network runs on the processor: its accelerator is not there, or failed",
    Status.NETWORK_FAILED: "a network gave no numbers",
    Status.INPUT_STALE: "something came late",
    Status.DEGRADED_RATE: "the computer is too slow: it looks for vehicles less often",
    Status.DEGRADED_BOXES: "the computer is too slow: it looks for vehicles only",
    Status.DEGRADED_ODOMETRY: "the computer is too slow: it looks for no vehicles",
    Status.COASTING: "the computer is too slow: this picture was passed over",
    Status.COASTED_TOO_LONG: "the computer is too slow: no picture was looked at for too long",
    Status.PERCEPTION_LATE: "the pictures' answer is late",
    Status.GRAPH_RESET: "the way restarts here, at an unknown distance from before",
    Status.GRAPH_RESTORED: "a part of the program was restarted, and goes on where it was",
    Status.NOT_INITIALISED: "no motion has been seen yet",
    Status.SCALE_ESTIMATED: "the camera's height or lens is an estimate, and so are all lengths",
    Status.UNKNOWN: "something that this version does not know",
}

# What to do about a status that stood on many frames
REMEDIES: Mapping[Status, str] = {
    Status.CAMERA_DARK: "film by daylight",
    Status.SCALE_INVALID: "the car's own speed or a GPS track (--speed FILE) gives the metres where the road does not",
    Status.CALIBRATION_DRIFT: "measure the camera's height again, and see whether it sits firmly",
    Status.FRAME_UNREADABLE: "copy the film again, or have it re-encoded",
    Status.CAMERA_FROZEN: "a film with each picture twice: take every second one (--stride 2)",
    Status.COASTED_TOO_LONG: "take every frame, however long it takes (--rate max)",
    Status.CAR_SPEED_IMPLAUSIBLE: "see whether the times of the speed file are those of the film",
}
WORTH_MEASURING_REL = 0.04  # a tape and a lens' data sheet are better than this
OFTEN = 0.2  # of the frames: then a status is worth a remedy
WORTH_TELLING = (Status.CALIBRATION_DRIFT, Status.SCALE_ESTIMATED, Status.VIEW_OBSTRUCTED, Status.STANDSTILL)


class LengthsBy(NamedTuple):
    """What the metres of a camera rest on: in words, and 1-sigma of all lengths by its height and its focal length."""

    words: str = "the camera's height and lens, as its camera file or the recording states them"
    height_sigma_rel: float = 0.0
    focal_sigma_rel: float = 0.0
    contradicted_by: str = ""  # what says another height than the one that was stated, and which
    view_is_stated: bool = False  # how wide the camera sees, which leaves the focal length as sure as it is


AS_STATED = LengthsBy()


@dataclass(frozen=True, kw_only=True)
class DriveCounts:
    """What the verdict is made of; all of one drive."""

    frames: int
    invalid_frames: int
    invalid_by: Mapping[str, int]  # of the invalid frames, how many had each status that makes one invalid
    statuses: Mapping[str, int]
    speed_sources: Mapping[str, int]
    path_m: float
    valid_path_m: float
    scale_sigma_rel: float | None  # median of the valid frames
    camera_sigma_rel: float  # of that, by the camera's height and lens
    lengths_by: LengthsBy = AS_STATED  # otherwise where a first pass found them
    ends_unreadable: bool = False  # its last picture was damaged or missing


def verdict(drive: DriveCounts) -> list[str]:
    """A sentence each: what share is valid, why the rest is not, how sure the metres are, what to do next."""
    return [*_validity(drive), *_lengths(drive), *_next_steps(drive)]


def _validity(drive: DriveCounts) -> Iterable[str]:
    valid = drive.frames - drive.invalid_frames
    if not drive.frames:
        yield "There is nothing to believe: no frame came through."
        return
    if not valid:
        yield f"None of it can be believed: not one of {drive.frames} frames is valid."
    elif valid == drive.frames:
        yield f"All {valid} frames are valid, over {drive.path_m:.0f} m."
    else:
        share = _share(valid, drive.frames)
        yield f"{share} is valid: {valid} of {drive.frames} frames, over {drive.valid_path_m:.0f} m."
    for name, frames in sorted(drive.invalid_by.items(), key=lambda item: -item[1]):
        yield f"Not valid: {_frames(frames)}, since {meaning(name)} ({name})."
    if drive.ends_unreadable:
        yield "It ends with a picture that is damaged or missing: the film was cut off there, and may have gone on."
    for status in WORTH_TELLING:
        frames = drive.statuses.get(status.value, 0)
        if frames and status not in INVALIDATING:
            yield f"On {_frames(frames)} {MEANINGS[status]} ({status.value})."


def _lengths(drive: DriveCounts) -> Iterable[str]:
    if drive.scale_sigma_rel is None:
        return
    by = drive.lengths_by.words
    by_car = drive.speed_sources.get(SpeedSource.CAR.value, 0)
    if by_car:
        by += f", on {_share(by_car, drive.frames)} of the frames on the car's own speed"
    yield f"Lengths are known to {drive.scale_sigma_rel:.0%} (1 sigma; twice that is all but sure). They rest on {by}."
    if drive.lengths_by.contradicted_by:
        yield (
            f"The stated height (or lens) is contradicted: {drive.lengths_by.contradicted_by}. "
            "One of them is wrong; the sigma covers both."
        )
    if not drive.camera_sigma_rel:
        yield "In that the height counts as exact: an error of 5 % in it is an error of 5 % in all lengths."


def _next_steps(drive: DriveCounts) -> Iterable[str]:
    height_rel, focal_rel = drive.lengths_by.height_sigma_rel, drive.lengths_by.focal_sigma_rel
    advice = [
        (
            height_rel,
            "measure how high the camera stands over the road, to 2 cm, and give it (--height M): 5 % of height is 5 % "
            "of all lengths.",
        ),
        (
            focal_rel,
            ("" if drive.lengths_by.view_is_stated else "say how wide the camera sees (--fov DEG), or ")
            + "photograph a chessboard (birdslam calibrate --chessboard): "
            "5 % of focal length is 5 % of lengths along the road.",
        ),
    ]
    for sigma_rel, words in sorted(advice, reverse=True):  # what is least known comes first
        if sigma_rel > WORTH_MEASURING_REL:
            yield f"Next: {words}"
    for status, remedy in REMEDIES.items():
        if drive.statuses.get(status.value, 0) > OFTEN * drive.frames:
            yield f"Against {status.value}: {remedy}."


def meaning(status: str) -> str:
    """The plain words of a status by its name."""
    return MEANINGS[Status(status)]


def _frames(count: int) -> str:
    return f"{count} frame{'s' * (count != 1)}"


def _share(part: int, whole: int) -> str:
    """As a percentage; neither 0 nor 100 % where that is not the whole truth."""
    return f"{min(max(round(100.0 * part / max(whole, 1)), part > 0), 100 - (part < whole))} %"


def readme(name: str, sentences: Sequence[str], files: Mapping[str, str]) -> str:
    """The text that lies beside a drive's results: the verdict, and what each file is."""
    width = max(map(len, files), default=0)
    lines = [f"Results of BirdSLAM: {name}", "", *sentences, "", "The files here:", ""]
    return "\n".join([*lines, *(f"  {file:<{width}}  {what}" for file, what in files.items()), ""])
