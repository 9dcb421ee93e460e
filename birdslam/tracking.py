"""Vehicles through time: association of boxes, persistent ids, and a constant-velocity filter for each vehicle.

The filter lives in the odometry's own world (dead reckoning since the start), where a parked car stands still. It
serves association and prediction; the estimates that planners get come from the pose graph.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass, field

import msgspec
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from birdslam import bev
from birdslam.camera import Camera, GroundPlane
from birdslam.localisation import LocalisationConfig, Observation, Outline, Place, iou, place
from birdslam.se2 import SE2, wrap
from birdslam.types import MotionEdge

NEAREST_M, FAR_M = 1.0, 1e4  # a nearer box is out of the image; from there one looks at the horizon


class TrackingConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """When boxes are the same vehicle, and how vehicles move."""

    min_iou: float = 0.15  # of a box with the one predicted from bird's-eye view
    gate_sigma: float = 4.0  # Mahalanobis distance in bird's-eye view past which boxes are never the same vehicle
    birth_score: float = 0.5
    confirm_hits: int = 3  # a track gets its id when it has been seen so often
    forget_unconfirmed_s: float = 0.25
    forget_s: float = 1.0
    sigma_accel_mps2: float = 3.0
    sigma_birth_mps: float = 8.0
    moving_mps: float = 2.0  # below it, or within moving_sigma of rest, a vehicle's motion says nothing of its yaw
    moving_sigma: float = 3.0
    moving_of_ego: float = 0.3  # nor within this fraction of the ego's speed: an error of the ground plane moves all
    yaw_gain: float = 0.3  # of the direction of motion into the yaw, each time it is seen
    sigma_yaw_rate_radps: float = 0.5
    sigma_yaw_unknown_rad: float = 0.5
    sigma_yaw_moving_rad: float = 0.1


@dataclass
class Track:
    """One vehicle; `state` is (x_m, y_m, vx_mps, vy_mps) of its centre in the odometry's world, `cov` (4, 4)."""

    state: NDArray[np.float64]
    cov: NDArray[np.float64]
    yaw_rad: float
    observation: Observation  # the last one
    place: Place  # and where it put the vehicle, in the ego of frame `seen_frame`
    outline: Outline
    seen_frame: int
    seen_ns: int
    T_world_ego: SE2  # of frame `seen_frame`
    T_world_seen: SE2  # its own pose then
    vehicle: int = -1  # the persistent id, once confirmed
    hits: int = 1
    votes: Counter[str] = field(default_factory=Counter)
    yaw_known: bool = False
    motion: MotionEdge | None = None  # VV: from when it was last seen to now, as predicted before it was seen again

    @property
    def label(self) -> str:
        return max(sorted(self.votes), key=self.votes.__getitem__)

    def pose(self) -> SE2:
        """T_world_vehicle in the odometry's world."""
        return SE2(float(self.state[0]), float(self.state[1]), self.yaw_rad)


class Tracker:
    """step(): predict, associate, correct, begin and forget tracks; returns those seen in this frame."""

    def __init__(self, camera: Camera, config: TrackingConfig, localisation: LocalisationConfig) -> None:
        self.camera = camera
        self.config = config
        self.localisation = localisation
        self.tracks: list[Track] = []
        self._next_id = 0
        self._t_ns: int | None = None
        self._T_world_ego = SE2()
        self._ego_speed_mps = 0.0

    def step(
        self, observations: list[Observation], T_world_ego: SE2, ground: GroundPlane, frame_id: int, t_source_ns: int
    ) -> list[Track]:
        """Confirmed tracks that were seen in this frame, each with its state corrected, ordered by id."""
        self._predict(t_source_ns, T_world_ego)
        pairs = self._associate(observations, T_world_ego, ground)
        for track, observation in pairs:
            self._correct(track, observation, T_world_ego, frame_id, t_source_ns)
        matched = {id(observation) for _, observation in pairs}
        for observation in observations:
            if id(observation) not in matched and observation.score >= self.config.birth_score:
                self.tracks.append(self._begin(observation, T_world_ego, frame_id, t_source_ns))
        self.tracks = [track for track in self.tracks if not self._is_lost(track, t_source_ns)]
        seen = [t for t in self.tracks if t.seen_frame == frame_id and t.hits >= self.config.confirm_hits]
        for track in seen:
            if track.vehicle < 0:
                track.vehicle, self._next_id = self._next_id, self._next_id + 1
        return sorted(seen, key=lambda track: track.vehicle)

    def predicted_boxes_px(self, T_world_ego: SE2, ground: GroundPlane) -> NDArray[np.float64]:
        """(N, 4): where each track's last box is expected in the current image; NaN behind the camera.

        The box's distance to the horizon and its size go with the inverse of the depth, whatever the ground plane.
        """
        boxes = np.full((len(self.tracks), 4), np.nan)
        T_ego_world = T_world_ego.inverse()
        for row, track in zip(boxes, self.tracks, strict=True):
            then, now = track.T_world_ego.inverse() @ track.state[:2], T_ego_world @ track.state[:2]
            near = np.array([track.place.depth_m, track.place.depth_m * track.observation.bearing]) + now - then
            if near[0] < NEAREST_M:
                continue
            x1, y1, x2, y2 = track.observation.box_px
            scale = track.place.depth_m / near[0]
            horizon_then, horizon_now = (
                bev.ego_to_pixel(self.camera, ground, np.array([[FAR_M, FAR_M * bearing]]))[0]
                for bearing in (track.observation.bearing, near[1] / near[0])
            )
            half_px = (x2 - x1) / 2.0 * scale
            row[:] = (
                horizon_now[0] - half_px,
                horizon_now[1] + (y1 - horizon_then[1]) * scale,
                horizon_now[0] + half_px,
                horizon_now[1] + (y2 - horizon_then[1]) * scale,
            )
        return boxes

    def _predict(self, t_source_ns: int, T_world_ego: SE2) -> None:
        dt_s = 0.0 if self._t_ns is None else max(0.0, (t_source_ns - self._t_ns) * 1e-9)
        if dt_s > 0.0:
            step = self._T_world_ego.between(T_world_ego)
            self._ego_speed_mps = math.hypot(step.x_m, step.y_m) / dt_s
        self._t_ns, self._T_world_ego = t_source_ns, T_world_ego
        F = np.eye(4)
        F[0, 2] = F[1, 3] = dt_s
        G = np.array([[dt_s**2 / 2, 0.0], [0.0, dt_s**2 / 2], [dt_s, 0.0], [0.0, dt_s]])
        Q = G @ G.T * self.config.sigma_accel_mps2**2
        for track in self.tracks:
            track.state = F @ track.state
            track.cov = F @ track.cov @ F.T + Q

    def _associate(
        self, observations: list[Observation], T_world_ego: SE2, ground: GroundPlane
    ) -> list[tuple[Track, Observation]]:
        """The pairs of least cost (1 - IoU of the predicted and the seen box) within the gates."""
        if not self.tracks or not observations:
            return []
        overlap = iou(self.predicted_boxes_px(T_world_ego, ground), np.array([o.box_px for o in observations]))
        overlap = np.nan_to_num(overlap, nan=0.0)
        cost = 1.0 - overlap
        for i, track in enumerate(self.tracks):
            for j, observation in enumerate(observations):
                if overlap[i, j] < self.config.min_iou or not self._is_near(track, observation, T_world_ego):
                    cost[i, j] = 2.0
        rows, columns = linear_sum_assignment(cost)
        return [(self.tracks[i], observations[j]) for i, j in zip(rows, columns, strict=True) if cost[i, j] <= 1.0]

    def _is_near(self, track: Track, observation: Observation, T_world_ego: SE2) -> bool:
        seen, _ = self._place(track, observation, T_world_ego)
        R = T_world_ego.rotation()
        gap = T_world_ego @ seen.centre_m - track.state[:2]
        S = track.cov[:2, :2] + R @ seen.cov @ R.T
        return bool(gap @ np.linalg.solve(S, gap) <= self.config.gate_sigma**2)

    def _place(self, track: Track, observation: Observation, T_world_ego: SE2) -> tuple[Place, Outline]:
        yaw_ego_rad = wrap(track.yaw_rad - T_world_ego.yaw_rad)
        return place(observation, track.outline, yaw_ego_rad, self.localisation)

    def _correct(
        self, track: Track, observation: Observation, T_world_ego: SE2, frame_id: int, t_source_ns: int
    ) -> None:
        track.motion = self._predicted_motion(track, frame_id, t_source_ns)
        seen, outline = self._place(track, observation, T_world_ego)
        R = T_world_ego.rotation()
        H = np.eye(2, 4)
        S = track.cov[:2, :2] + R @ seen.cov @ R.T
        gain = np.linalg.solve(S, H @ track.cov).T
        track.state = track.state + gain @ (T_world_ego @ seen.centre_m - track.state[:2])
        keep = np.eye(4) - gain @ H
        track.cov = keep @ track.cov @ keep.T + gain @ (R @ seen.cov @ R.T) @ gain.T
        track.observation, track.place, track.outline = observation, seen, outline
        track.seen_frame, track.seen_ns, track.T_world_ego = frame_id, t_source_ns, T_world_ego
        track.hits += 1
        track.votes[observation.label] += 1
        self._turn(track)
        track.T_world_seen = track.pose()

    def _predicted_motion(self, track: Track, frame_id: int, t_source_ns: int) -> MotionEdge | None:
        """VV by constant velocity; None until the track has an id, since edges name it."""
        if track.vehicle < 0:
            return None
        dt_s = (t_source_ns - track.seen_ns) * 1e-9
        R = SE2(yaw_rad=track.yaw_rad).rotation()
        growth = track.cov[2:, 2:] * dt_s**2 + np.eye(2) * (self.config.sigma_accel_mps2 * dt_s**2 / 2.0) ** 2
        cov = np.zeros((3, 3))
        cov[:2, :2] = R.T @ growth @ R
        cov[2, 2] = (self.config.sigma_yaw_rate_radps * dt_s) ** 2
        return MotionEdge(
            vehicle=track.vehicle,
            from_frame=track.seen_frame,
            to_frame=frame_id,
            T_from_to=track.T_world_seen.between(track.pose()),
            cov=tuple(cov.ravel().tolist()),
        )

    def _turn(self, track: Track) -> None:
        """A vehicle that surely moves heads where it moves; one that may stand keeps its yaw."""
        vx, vy = track.state[2:]
        speed = math.hypot(vx, vy)
        sigma = math.sqrt(max(float(np.trace(track.cov[2:, 2:])) / 2.0, 1e-12))
        config = self.config
        if speed < max(config.moving_mps, config.moving_sigma * sigma, config.moving_of_ego * self._ego_speed_mps):
            return
        turn = wrap(math.atan2(vy, vx) - track.yaw_rad)
        track.yaw_rad = wrap(track.yaw_rad + (self.config.yaw_gain if track.yaw_known else 1.0) * turn)
        track.yaw_known = True

    def _begin(self, observation: Observation, T_world_ego: SE2, frame_id: int, t_source_ns: int) -> Track:
        # Most traffic runs along the road: until it is seen to move otherwise, it is headed like the ego.
        seen, outline = place(observation, Outline.of_class(observation.dimensions), 0.0, self.localisation)
        R = T_world_ego.rotation()
        cov = np.zeros((4, 4))
        cov[:2, :2] = R @ seen.cov @ R.T
        cov[2:, 2:] = np.eye(2) * self.config.sigma_birth_mps**2
        return Track(
            state=np.concatenate([T_world_ego @ seen.centre_m, np.zeros(2)]),
            cov=cov,
            yaw_rad=T_world_ego.yaw_rad,
            observation=observation,
            place=seen,
            outline=outline,
            seen_frame=frame_id,
            seen_ns=t_source_ns,
            T_world_ego=T_world_ego,
            T_world_seen=T_world_ego @ SE2(float(seen.centre_m[0]), float(seen.centre_m[1])),
            votes=Counter({observation.label: 1}),
        )

    def _is_lost(self, track: Track, t_source_ns: int) -> bool:
        confirmed = track.hits >= self.config.confirm_hits
        patience_s = self.config.forget_s if confirmed else self.config.forget_unconfirmed_s
        return (t_source_ns - track.seen_ns) * 1e-9 > patience_s
