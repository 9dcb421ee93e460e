"""Ego-motion without images: true camera poses with the errors that our own image odometry has on real clips.

It takes the place of `birdslam.odometry.odometry.Odometry` in the front end. Errors have a white part and a slow one
(AR(1)): a scale that is 3 % short stays so for a while. `OdometryNoise` is fitted to KITTI odometry 00 and 06 and to a
raw clip. The ground is reported as calibrated, since no pose says how the camera
leans over the road; landmarks are seen over the front end's ground, with the error of our odometry's tilt.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from typing import Annotated

import msgspec
import numpy as np
from scipy.spatial.transform import Rotation

from birdslam.geometry import bev
from birdslam.geometry.arrays import Bools, Floats
from birdslam.geometry.camera import Camera, GroundPlane
from birdslam.geometry.pose import Pose
from birdslam.geometry.se2 import SE2
from birdslam.lanes.amodal.landmark_edges import StaticMapConfig, landmark_edges
from birdslam.odometry.external import WithoutImages
from birdslam.odometry.motion import Motion, planar
from birdslam.trajectory import Transform, inverse
from birdslam.types import LandmarkEdge, SpeedReading, Status

NotNegative = Annotated[float, msgspec.Meta(ge=0.0)]


class Drift(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Standard deviations of an error's white and slow part; the slow one is forgotten over `memory_frames`."""

    white: NotNegative = 0.0
    slow: NotNegative = 0.0
    memory_frames: Annotated[float, msgspec.Meta(gt=0.0)] = 10.0

    @property
    def sigma(self) -> float:
        """Of both together."""
        return math.hypot(self.white, self.slow)


class OdometryNoise(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What the image odometry does at 10 Hz, one motion between two frames (fitted, see the module)."""

    tilt_rad: Drift = Drift(0.00043)  # rotation about the camera's x and z axes
    turn_rad: Drift = Drift(0.00024, 0.000105, 1.7)  # rotation about its y axis: the yaw
    turn_rel: NotNegative = 0.017  # ... and of the turn itself, the same for a whole drive (a focal length that is off)
    rise_rad: Drift = Drift(0.0040, 0.0085, 25.0)  # direction of the translation, up and down
    side_rad: Drift = Drift(0.0071, 0.0078, 19.0)  # ... and sideways, less what it has in common with the turn:
    side_per_turn: float = 1.1  # a turn that is missed may be taken for a sidestep
    log_scale: Drift = Drift(0.0193, 0.0114, 5.7)
    ground_rad: Drift = Drift(0.0011, 0.0034, 6.0)  # pitch of the road as estimated from the images
    roll_rad: Drift = Drift(0.0022, 0.0097, 42.6)  # and its roll
    # Road tracks in sight of a frame that become CP edges: half of the 26 that the odometry follows by itself, since
    # the networks' road and boxes take the others from the whole front end
    landmarks: NotNegative = 13.0
    landmark_frames: Annotated[float, msgspec.Meta(ge=1.0)] = 5.6  # for how long one is followed
    # What they err by over the front end's ground: together as by a pitch and a roll, since a
    # road is no plane, and each by its own
    landmark_pitch_rad: Drift = Drift(0.0, 0.0042, 14.0)
    landmark_roll_rad: Drift = Drift(0.0, 0.013, 14.0)
    landmark_px: NotNegative = 1.05


class SimulationConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The numbers of the simulated odometry that are not fitted."""

    noise: OdometryNoise = OdometryNoise()
    standstill_m: NotNegative = 0.02  # GPS poses creep where the car stands
    sigma_floor_m: NotNegative = 0.002
    sigma_floor_rad: NotNegative = 0.0003
    sigma_pitch_rad: NotNegative = 0.006  # of the reported ground: KITTI's roads against the calibrated plane
    landmark_near_m: NotNegative = 5.0
    landmark_far_m: NotNegative = 30.0
    landmark_side_m: NotNegative = 4.0


_NONE = Drift()  # what `--odometry truth` uses:
EXACT = SimulationConfig(
    noise=OdometryNoise(
        _NONE,
        _NONE,
        0.0,
        _NONE,
        _NONE,
        0.0,
        _NONE,
        _NONE,
        landmark_pitch_rad=_NONE,
        landmark_roll_rad=_NONE,
        landmark_px=0.0,
    )
)


class Walk:
    """Draws of one Drift, frame by frame."""

    def __init__(self, drift: Drift, size: int, rng: np.random.Generator) -> None:
        self._drift, self._rng = drift, rng
        self._keep = math.exp(-1.0 / drift.memory_frames)
        self._slow = drift.slow * rng.standard_normal(size)

    def draw(self) -> Floats:
        fresh, white = self._rng.standard_normal((2, len(self._slow)))
        self._slow = self._keep * self._slow + self._drift.slow * math.sqrt(1.0 - self._keep**2) * fresh
        out: Floats = self._slow + self._drift.white * white
        return out


class SimulatedOdometry(WithoutImages):
    """An EgoMotion of the front end from `poses` (N, 4, 4): `T_first_i` of the camera; frame ids are their rows.

    `landmarks` gives the CP edges.
    """

    def __init__(
        self,
        camera: Camera,
        poses: Transform,
        config: SimulationConfig,
        rng: np.random.Generator,
    ) -> None:
        self.camera = camera
        self.config = config
        self._poses = poses
        self._rng = rng
        noise = config.noise
        self._turn_gain = noise.turn_rel * float(rng.standard_normal())
        self._tilt, self._turn = Walk(noise.tilt_rad, 2, rng), Walk(noise.turn_rad, 1, rng)
        self._rise, self._side = Walk(noise.rise_rad, 1, rng), Walk(noise.side_rad, 1, rng)
        self._scale = Walk(noise.log_scale, 1, rng)
        self._pitch, self._roll = Walk(noise.landmark_pitch_rad, 1, rng), Walk(noise.landmark_roll_rad, 1, rng)
        self._ego = _on_road(camera, poses)
        self._landmarks: dict[int, Floats] = {}  # in world
        self._next_landmark = 0
        self._last_frame: int | None = None

    def estimate(
        self,
        tracks: None,
        frame_id: int,
        t_source_ns: int,
        vehicle_boxes_px: Floats,
        road_mask: Bools | None = None,
        speeds: Sequence[SpeedReading] = (),
    ) -> Motion | None:
        """The motion since the last frame; None for the first one. The car's own speed is not simulated."""
        last, self._last_frame = self._last_frame, frame_id
        if last is None:
            return None
        config, noise = self.config, self.config.noise
        step = inverse(self._poses[last]) @ self._poses[frame_id]
        length_m = float(np.linalg.norm(step[:3, 3]))
        (tilt_x, tilt_z), (turn,) = self._tilt.draw(), self._turn.draw()
        (rise,), (side,), (log_scale,) = self._rise.draw(), self._side.draw(), self._scale.draw()
        side += noise.side_per_turn * turn
        turn += self._turn_gain * float(Rotation.from_matrix(step[:3, :3]).as_rotvec()[1])
        standstill = length_m < config.standstill_m
        if standstill:
            step = np.eye(4)
            length_m = 0.0
        else:
            step[:3, 3] = Rotation.from_rotvec([rise, side, 0.0]).apply(step[:3, 3]) * math.exp(log_scale)
            step[:3, :3] = step[:3, :3] @ Rotation.from_rotvec([tilt_x, turn, tilt_z]).as_matrix()
        sigma_side_rad = math.hypot(noise.side_rad.sigma, noise.side_per_turn * noise.turn_rad.sigma)
        sigma_m = np.hypot(config.sigma_floor_m, length_m * np.array([noise.log_scale.sigma, sigma_side_rad]))
        sigma_rad = math.hypot(config.sigma_floor_rad, noise.turn_rad.sigma)
        return Motion(
            from_frame=last,
            to_frame=frame_id,
            R_prev_curr=step[:3, :3],
            t_prev_curr_m=step[:3, 3],
            T_prev_curr=planar(Pose(step[:3, :3], step[:3, 3]), self.camera.ground),
            cov=np.diag([*np.square(sigma_m), sigma_rad**2]),
            scale_sigma_rel=noise.log_scale.slow,  # the white part averages out
            ground=self.camera.ground,
            tilt_cov=np.eye(2) * config.sigma_pitch_rad**2,
            standstill=standstill,
            status=(Status.STANDSTILL,) if standstill else (),
        )

    def landmarks(self, frame_id: int, ground: GroundPlane, config: StaticMapConfig) -> tuple[LandmarkEdge, ...]:
        """CP edges of a frame, as the front end makes them of road tracks over the `ground` that it believes in."""
        T_world_ego, noise = self._ego[frame_id], self.config.noise
        points = self._follow(T_world_ego)
        if not points:
            return ()
        (pitch_rad,), (roll_rad,) = self._pitch.draw(), self._roll.draw()
        seen_over = GroundPlane(ground.height_m, ground.pitch_rad + float(pitch_rad), ground.roll_rad + float(roll_rad))
        px = bev.ego_to_pixel(self.camera, seen_over, T_world_ego.inverse() @ np.array(list(points.values())))
        px = px + noise.landmark_px * self._rng.standard_normal(px.shape)
        inside = (px > 0.0).all(axis=1) & (px < [self.camera.width_px, self.camera.height_px]).all(axis=1)
        ids = np.array(list(points), dtype=np.int64)[inside]
        return landmark_edges(ids, px[inside], frame_id, self.camera, ground, noise.ground_rad.sigma, config)

    def _follow(self, T_world_ego: SE2) -> dict[int, Floats]:
        """Landmarks in world: each is followed for some frames, and new ones are taken up for those lost."""
        config, noise, rng = self.config, self.config.noise, self._rng
        T_ego_world = T_world_ego.inverse()
        followed = {}
        for landmark, point in self._landmarks.items():
            x_m = float((T_ego_world @ point)[0])
            if config.landmark_near_m < x_m and rng.uniform() > 1.0 / noise.landmark_frames:
                followed[landmark] = point
        while len(followed) < round(noise.landmarks):
            # As dense in the image as tracks are: uniform in the row, which is 1 / depth
            row = rng.uniform(1.0 / config.landmark_far_m, 1.0 / config.landmark_near_m)
            left_m = rng.uniform(-config.landmark_side_m, config.landmark_side_m)
            followed[self._next_landmark] = T_world_ego @ np.array([1.0 / row, left_m])
            self._next_landmark += 1
        self._landmarks = followed
        return followed


def _on_road(camera: Camera, poses: Transform) -> list[SE2]:
    out = [SE2()]
    for before, after in itertools.pairwise(poses):
        step = inverse(before) @ after
        out.append(out[-1] @ planar(Pose(step[:3, :3], step[:3, 3]), camera.ground))
    return out
