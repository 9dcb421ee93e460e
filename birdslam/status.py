"""Enumerations of records that newer senders may extend, and the statuses: expected problems that records report."""

from __future__ import annotations

import enum
from typing import Self


class Word(enum.StrEnum):
    """A string enumeration of records; an unknown value, from a newer sender, is read as the member `NEWER`."""

    @classmethod
    def _missing_(cls, value: object) -> Self | None:
        return cls["NEWER"] if isinstance(value, str) else None


class Status(Word):
    """Expected problems, reported in records; those in `INVALIDATING` make an estimate invalid."""

    END_OF_SOURCE = "end_of_source"  # the source has no further frame; the last record of a run
    FRAME_UNREADABLE = "frame_unreadable"  # the image is damaged or missing: this frame has no pixels
    FRAMES_DROPPED = "frames_dropped"  # frames between the last one and this were lost before perceive
    CAMERA_FROZEN = "camera_frozen"  # the image is identical to the previous one
    CAMERA_DARK = "camera_dark"  # the image is too dark, or has too little contrast
    LOW_TEXTURE = "low_texture"  # too few feature tracks to measure the motion
    ODOMETRY_COASTING = "odometry_coasting"  # the motion is predicted by the motion model, not measured
    SCALE_CARRIED = "scale_carried"  # no road is visible: the metric scale is that of an earlier frame
    # the metric scale is unknown or was carried for too long, or the images do not determine the length of this motion
    SCALE_INVALID = "scale_invalid"
    MOTION_IMPLAUSIBLE = "motion_implausible"  # the motion is implausible for a car, or was not measured for too long
    STANDSTILL = "standstill"  # zero-velocity update: the car is stationary and keeps its pose
    GROUND_VIOLATED = "ground_violated"  # alignments of the road repeatedly contradict the estimated ground plane
    CAR_SPEED_LATE = "car_speed_late"  # the newest reading of the car's own speed is old and is extrapolated
    CAR_SPEED_MISSING = "car_speed_missing"  # there are no more readings of the car's own speed: it is not used
    CAR_SPEED_IMPLAUSIBLE = (
        "car_speed_implausible"  # the car's own speed is impossible, or the images contradict it: it is not used
    )
    CAR_SPEED_FROZEN = "car_speed_frozen"  # the car's own speed is stuck at one number: it is not used
    VIEW_OBSTRUCTED = "view_obstructed"  # an obstruction is fixed in the image while the car moves: it is masked
    CALIBRATION_DRIFT = "calibration_drift"  # the camera's pitch, roll or height differs from the camera file
    DETECTIONS_CARRIED = "detections_carried"  # the detections are of an earlier frame
    SEGMENTATION_CARRIED = "segmentation_carried"  # the segmentation is of an earlier frame
    DEPTH_CARRIED = "depth_carried"  # the depth map is of an earlier frame
    LANES_CARRIED = "lanes_carried"  # lane detection was due, but its last run has not finished yet
    NETWORK_FAILED = "network_failed"  # an output of a network is not finite
    PROVIDER_MISSING = "provider_missing"  # a network runs on the CPU: its accelerator is missing or failed
    INPUT_STALE = "input_stale"  # the input record arrived late
    DEGRADED_RATE = "degraded_rate"  # short of time: the networks run on fewer frames
    DEGRADED_BOXES = "degraded_boxes"  # short of time: only the detector runs, without segmentation
    DEGRADED_ODOMETRY = "degraded_odometry"  # short of time: no network runs, only the ego-motion is estimated
    COASTING = "coasting"  # short of time: this frame was not processed; the motion model predicts it
    COASTED_TOO_LONG = "coasted_too_long"  # no frame has been processed for too long
    PERCEPTION_LATE = (
        "perception_late"  # perceive has not answered in time: the optimizer predicts from its last answer
    )
    GRAPH_RESET = "graph_reset"  # the optimizer started a new epoch on this frame
    GRAPH_RESTORED = "graph_restored"  # the optimizer restarted from its last checkpoint: the epoch continues
    NOT_INITIALISED = "not_initialised"  # no motion has been measured yet
    SCALE_ESTIMATED = (
        "scale_estimated"  # the camera's height or focal length is estimated, not measured: see scale_sigma_rel
    )
    UNKNOWN = "unknown"  # a newer sender's status that this reader does not know

    NEWER = UNKNOWN


INVALIDATING = frozenset(
    {
        Status.END_OF_SOURCE,
        Status.FRAME_UNREADABLE,
        Status.CAMERA_FROZEN,
        Status.CAMERA_DARK,
        Status.SCALE_INVALID,
        Status.MOTION_IMPLAUSIBLE,
        Status.COASTED_TOO_LONG,
        Status.NOT_INITIALISED,
    }
)
