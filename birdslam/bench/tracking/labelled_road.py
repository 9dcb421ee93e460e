"""The road's tilt by labelled vehicles, and odometry that reports it with the errors that the images' has.

A label's bottom stands on the road: its slope below the camera's axis is H / z - pitch + roll y/x (Eq. 1), less what
the road differs by at each vehicle. Without images nothing else says how the camera leans over the road. Simulated
odometry reports the calibrated plane; what drives has one from the images, and errs by `OdometryNoise.ground_rad`.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import msgspec
import numpy as np
from numpy.typing import NDArray

from birdslam.bench.simulation.odometry import OdometryNoise, SimulatedOdometry, Walk
from birdslam.geometry.camera import GroundPlane
from birdslam.odometry.motion import Motion
from birdslam.sources.kitti_tracking import VEHICLE_KINDS, TrackingSequence
from birdslam.types import SpeedReading
from birdslam.vehicles.state.ground_size_filter import GroundSizeConfig

Floats = NDArray[np.float64]

HALF_SPAN = 3  # frames before and after, whose labels count too: a camera pitches within half a second
NEAREST_M, FARTHEST_M = 5.0, 60.0  # of labels that are used
LEAST_VEHICLES = 2  # a tilt by fewer is not held to another's


@dataclass(frozen=True)
class LabelledGround:
    """The camera over the road of one frame, the 1-sigma of its pitch and roll (rad), and the vehicles that tell it."""

    ground: GroundPlane
    sigma_pitch_rad: float
    sigma_roll_rad: float
    vehicles: int


def labelled_grounds(sequence: TrackingSequence) -> list[LabelledGround | None]:
    """One for each frame; None where no vehicle is labelled near it. What roads do is `GroundSizeConfig`'s."""
    road = GroundSizeConfig()
    found: dict[int, list[tuple[int, float, float, float]]] = {}
    for label in sequence.labels:
        x, y, z = label.place_m
        if label.kind in VEHICLE_KINDS and label.truncated <= 0 and NEAREST_M < z < FARTHEST_M:
            slope = (y - sequence.camera.height_m) / z
            found.setdefault(label.frame, []).append((label.track, z, -x / z, slope))
    out: list[LabelledGround | None] = []
    for frame in range(len(sequence)):
        near = [one for k in range(frame - HALF_SPAN, frame + HALF_SPAN + 1) for one in found.get(k, ())]
        out.append(_fitted(near, sequence.camera.height_m, road) if near else None)
    return out


def _fitted(
    labels: Sequence[tuple[int, float, float, float]], height_m: float, road: GroundSizeConfig
) -> LabelledGround:
    """Least squares with the priors of roads; a vehicle counts once, in however many frames it is labelled."""
    times = Counter(track for track, *_ in labels)
    z, bearing, slope = np.array([numbers for _, *numbers in labels]).T
    variance = road.sigma_tilt_rad**2 + (road.sigma_kerb_m / z) ** 2 + (road.sigma_crown_rad * bearing) ** 2
    weight = 1.0 / (variance * np.array([times[track] for track, *_ in labels]))
    J = np.column_stack([-np.ones_like(bearing), bearing])
    information = (J.T * weight) @ J + np.diag([road.sigma_pitch_rad**-2, road.sigma_roll_rad**-2])
    cov = np.linalg.inv(information)
    pitch_rad, roll_rad = (cov @ (J.T * weight) @ slope).tolist()
    sigma_pitch, sigma_roll = np.sqrt(np.diag(cov)).tolist()
    return LabelledGround(GroundPlane(height_m, pitch_rad, roll_rad), sigma_pitch, sigma_roll, len(times))


class TiltFromImages:
    """An EgoMotion: a simulated one, that reports the labelled road's pitch as the images would, while it drives.

    Of the roll images say nothing: it is the calibrated one. Where no label tells the road, none is reported anew.
    """

    def __init__(
        self,
        odometry: SimulatedOdometry,
        grounds: Sequence[LabelledGround | None],
        noise: OdometryNoise,
        rng: np.random.Generator,
    ) -> None:
        self._odometry, self._grounds = odometry, grounds
        self._error, self._sigma_rad = Walk(noise.ground_rad, 1, rng), noise.ground_rad.sigma
        self._reported = odometry.camera.ground

    @property
    def road_tracks(self) -> tuple[NDArray[np.int64], Floats]:
        """Empty, as the simulated one's."""
        return self._odometry.road_tracks

    def track(self, image: NDArray[np.uint8]) -> None:
        """Does nothing: no image is needed."""

    def estimate(
        self,
        tracks: None,
        frame_id: int,
        t_source_ns: int,
        vehicle_boxes_px: Floats,
        road_mask: NDArray[np.bool_] | None = None,
        speeds: Sequence[SpeedReading] = (),
    ) -> Motion | None:
        """The simulated motion, with the road's pitch."""
        motion = self._odometry.estimate(tracks, frame_id, t_source_ns, vehicle_boxes_px, road_mask, speeds)
        if motion is None:
            return None
        (error_rad,), labelled = self._error.draw(), self._grounds[frame_id]
        if labelled is not None and not motion.standstill:
            at = labelled.ground
            self._reported = GroundPlane(at.height_m, at.pitch_rad + float(error_rad), self._odometry.camera.roll_rad)
        return msgspec.structs.replace(motion, ground=self._reported, pitch_sigma_rad=self._sigma_rad)
