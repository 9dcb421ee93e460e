"""What a record says of trouble that was to be expected."""

from __future__ import annotations

import enum


class Status(enum.StrEnum):
    """Expected trouble, carried in the record; `INVALIDATING` says which make an estimate invalid."""

    END_OF_SOURCE = "end_of_source"  # the source has no further frame; the last record of a run
    FRAME_UNREADABLE = "frame_unreadable"  # the image was torn or missing: no pixels for this frame
    FRAMES_DROPPED = "frames_dropped"  # frames between this one and the last never reached perceive
    CAMERA_FROZEN = "camera_frozen"  # the image is bit for bit the one before
    CAMERA_DARK = "camera_dark"  # too little contrast to see by
    LOW_TEXTURE = "low_texture"  # too few feature tracks for a motion
    ODOMETRY_COASTING = "odometry_coasting"  # the motion is predicted from the one before, not measured
    SCALE_CARRIED = "scale_carried"  # no road seen: the metric scale is an older one
    SCALE_INVALID = "scale_invalid"  # the metric scale has been carried for too long to trust
    MOTION_IMPLAUSIBLE = "motion_implausible"  # a motion of no car, or a long blindness; until all is steady again
    STANDSTILL = "standstill"  # the car stands: the pose is held
    GROUND_VIOLATED = "ground_violated"  # the road does not fit the ground plane
    CAR_SPEED_LATE = "car_speed_late"  # the car's newest reading of its speed is old: it is let go on
    CAR_SPEED_MISSING = "car_speed_missing"  # the car told its speed before and does not any more: it is not used
    CAR_SPEED_IMPLAUSIBLE = "car_speed_implausible"  # it is no car's, or the images contradict it: it is not used
    CAR_SPEED_FROZEN = "car_speed_frozen"  # it is the same number again and again, and the images contradict it
    VIEW_OBSTRUCTED = "view_obstructed"  # something stands still in the image while the car drives; it is left out
    CALIBRATION_DRIFT = "calibration_drift"  # the estimated pitch or height left the calibrated one
    DETECTIONS_CARRIED = "detections_carried"  # the detector did not run on this frame
    SEGMENTATION_CARRIED = "segmentation_carried"  # the segmenter did not run on this frame
    DEPTH_CARRIED = "depth_carried"  # the depth network did not run on this frame
    LANES_CARRIED = "lanes_carried"  # lanes were due to be made out, but their last run is not done yet
    NETWORK_FAILED = "network_failed"  # a network gave no usable numbers on this frame
    INPUT_STALE = "input_stale"  # the record in front of this one came later than it should
    DEGRADED_RATE = "degraded_rate"  # short of time: the networks run on fewer frames
    DEGRADED_BOXES = "degraded_boxes"  # short of time: the detector alone runs, no road and no lanes
    DEGRADED_ODOMETRY = "degraded_odometry"  # short of time: no network runs, the ego alone is followed
    COASTING = "coasting"  # short of time: nobody looked at this frame; told by the last motion, less surely
    COASTED_TOO_LONG = "coasted_too_long"  # no frame has been looked at for too long
    PERCEPTION_LATE = "perception_late"  # perceive has not answered in time: the optimizer coasts from the last answer
    GRAPH_RESET = "graph_reset"  # the optimizer began a new epoch on this frame
    GRAPH_RESTORED = "graph_restored"  # the optimizer began anew from its last checkpoint: the epoch goes on
    NOT_INITIALISED = "not_initialised"  # no motion has been measured yet
    UNKNOWN = "unknown"  # a status that a newer sender knows and this reader does not

    @classmethod
    def _missing_(cls, value: object) -> Status | None:
        return cls.UNKNOWN if isinstance(value, str) else None


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
