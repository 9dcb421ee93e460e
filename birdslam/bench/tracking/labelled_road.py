"""The road's tilt by labelled vehicles: without images nothing else says how the camera leans over the road.

A label's bottom stands on the road: its slope below the camera's axis is H / z - pitch + roll y/x + crown |y|/x
(Eq. 1), less what the road differs by at each vehicle. The crown tells the ego's road from streets beside it.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import numpy as np

from birdslam.geometry.camera import GroundPlane
from birdslam.road_users.state.ground_size_config import GroundSizeConfig
from birdslam.sources.kitti_tracking import VEHICLE_KINDS, TrackingSequence

HALF_SPAN = 3  # frames before and after, whose labels count too: a camera pitches within half a second
MIN_DISTANCE_M, MAX_DISTANCE_M = 5.0, 60.0  # of labels that are used


def labelled_grounds(sequence: TrackingSequence) -> list[GroundPlane | None]:
    """Returns the camera over the road of each frame; None if no vehicle is labelled near it.

    The priors of roads are those of `GroundSizeConfig`.
    """
    road = GroundSizeConfig()
    found: dict[int, list[tuple[int, float, float, float]]] = {}
    for label in sequence.labels:
        x, y, z = label.place_m
        if label.kind in VEHICLE_KINDS and label.truncated <= 0 and MIN_DISTANCE_M < z < MAX_DISTANCE_M:
            slope = (y - sequence.camera.height_m) / z
            found.setdefault(label.frame, []).append((label.track, z, -x / z, slope))
    out: list[GroundPlane | None] = []
    for frame in range(len(sequence)):
        near = [one for k in range(frame - HALF_SPAN, frame + HALF_SPAN + 1) for one in found.get(k, ())]
        out.append(_fitted(near, sequence.camera.height_m, road) if near else None)
    return out


def _fitted(labels: Sequence[tuple[int, float, float, float]], height_m: float, road: GroundSizeConfig) -> GroundPlane:
    """Least squares with the priors of roads; a vehicle counts once, in however many frames it is labelled."""
    times = Counter(track for track, *_ in labels)
    z, bearing, slope = np.array([numbers for _, *numbers in labels]).T
    variance = road.sigma_tilt_rad**2 + (road.sigma_kerb_m / z) ** 2 + (road.sigma_crown_rad * bearing) ** 2
    weight = 1.0 / (variance * np.array([times[track] for track, *_ in labels]))
    J = np.column_stack([-np.ones_like(bearing), bearing, np.abs(bearing)])
    cov = np.linalg.inv((J.T * weight) @ J + np.diag(1.0 / road.road_var))
    pitch_rad, roll_rad, _ = (cov @ (J.T * weight) @ slope).tolist()
    return GroundPlane(height_m, pitch_rad, roll_rad)
