"""Vehicles through time: association of boxes, persistent ids, and a constant-velocity filter for each vehicle.

The filter lives in the odometry's own world (dead reckoning since the start), where a parked car stands still. It
serves association and prediction; the estimates that planners get come from the pose graph.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace

import msgspec
import numpy as np
from numpy.typing import NDArray

from birdslam.geometry.camera import Camera, GroundPlane
from birdslam.geometry.se2 import SE2, wrap
from birdslam.types import MotionEdge
from birdslam.vehicles.association import predicted_boxes_px, within_gate
from birdslam.vehicles.depth_fusion import DepthPlace, PseudoLidarConfig
from birdslam.vehicles.ground_size_filter import Horizon
from birdslam.vehicles.heading import HeadingConfig
from birdslam.vehicles.localisation import LocalisationConfig, Observation, Place, extent_m, iou, place
from birdslam.vehicles.parallax import ParallaxConfig
from birdslam.vehicles.placing import Body, Placing
from birdslam.vehicles.track import Track

MOTION_LOGIT = 6.0  # of the front of a vehicle that was seen to move


class TrackingConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """When boxes are the same vehicle, and how vehicles move."""

    min_iou: float = 0.15  # of a box with the one predicted from bird's-eye view
    gate_sigma: float = 3.0  # Mahalanobis distance in bird's-eye view past which boxes are never the same vehicle
    birth_score: float = 0.5
    confirm_hits: int = 3  # a track gets its id when it has been seen so often
    forget_unconfirmed_s: float = 0.25
    forget_s: float = 1.0
    sigma_accel_mps2: float = 3.0
    sigma_birth_mps: float = 8.0
    moving_mps: float = 2.0  # below it, or within moving_sigma of rest, a vehicle's motion says nothing of its yaw
    moving_sigma: float = 3.0
    moving_of_ego: float = 0.3  # nor within this fraction of the ego's speed: an error of the ground plane moves all
    moved_along_rel: float = 0.15  # nor until it has come so far from where it was first seen, as fractions of its
    moved_across_rel: float = 0.05  # distance then: along the line of sight, and across it
    sigma_yaw_rate_radps: float = 0.5
    direction_inflation: float = 3.0  # of the motion's direction: its errors last for many frames
    body_yaw_inflation: float = 3.0  # of a yaw that a network sees in the body: so do its errors
    sigma_yaw_unknown_rad: float = 0.2
    sigma_yaw_moving_rad: float = 0.1
    parallax: ParallaxConfig = ParallaxConfig()
    heading: HeadingConfig = HeadingConfig()
    stands: float = 0.5  # the probability from which on a vehicle does, by its parallax: its yaw is kept
    late_sigma_m: float = 3.0  # a late detection that the velocity puts so far off is not shown in the present frame


class Tracker:
    """step(): predict, associate, correct, begin and forget tracks; returns those seen in this frame."""

    def __init__(
        self,
        camera: Camera,
        config: TrackingConfig,
        localisation: LocalisationConfig,
        pseudolidar: PseudoLidarConfig | None = None,
    ) -> None:
        from scipy.optimize import linear_sum_assignment  # only who tracks holds its 9 MB: capture and optimize don't

        self._assign = linear_sum_assignment
        self.camera = camera
        self.config = config
        self.localisation = localisation
        self.placing = Placing(localisation, config.parallax, pseudolidar or PseudoLidarConfig(), config.heading)
        self.tracks: list[Track] = []
        self._next_id = 0
        self._next_serial = 0
        self._t_ns: int | None = None
        self._dt_s = 0.0
        self._T_world_ego = SE2()
        self._ego_speed_mps = 0.0

    def step(
        self,
        observations: list[Observation] | None,
        T_world_ego: SE2,
        horizon: Horizon,
        frame_id: int,
        t_source_ns: int,
        ego_cov: NDArray[np.float64] | None = None,
        by_depth: Sequence[DepthPlace | None] = (),
    ) -> list[Track]:
        """Confirmed tracks that were seen in this frame, each with its state corrected, ordered by id.

        Depths come of all of them together (`horizon`), which learns the road's tilt and their sizes from it. None for
        `observations`: no detector looked at this frame. `ego_cov` (3, 3) is of the ego's last step, in its tangent.
        `by_depth` are the places that a depth map gives the observations, where there is one.
        """
        self._predict(t_source_ns, T_world_ego, ego_cov)
        for known in self.tracks:
            known.missed += observations is not None
        observations = observations or []
        pairs: list[tuple[Track | None, Observation]] = [*self._associate(observations, T_world_ego, horizon.ground)]
        matched = {id(observation) for _, observation in pairs}
        pairs += [
            (None, observation)
            for observation in observations
            if id(observation) not in matched and observation.score >= self.config.birth_score
        ]
        bodies = self._bodies(pairs, dict(zip(map(id, observations), by_depth, strict=False)))
        for body, where in zip(bodies, self.placing.places(bodies, T_world_ego, horizon), strict=True):
            if body.track is not None:
                self._correct(body.track, body.seen, where, T_world_ego, horizon, frame_id, t_source_ns)
                self._face(body.track, body.by_depth, T_world_ego, horizon)
            else:
                self.tracks.append(self._begin(body, where, T_world_ego, frame_id, t_source_ns))
        self.tracks = [track for track in self.tracks if not self._is_lost(track, t_source_ns)]
        horizon.keep_only(track.serial for track in self.tracks)
        self.placing.keep_only(track.serial for track in self.tracks)
        seen_now = [t for t in self.tracks if t.seen_frame == frame_id and t.hits >= self.config.confirm_hits]
        for track in seen_now:
            if track.vehicle < 0:
                track.vehicle, self._next_id = self._next_id, self._next_id + 1
        return sorted(seen_now, key=lambda track: track.vehicle)

    def _bodies(
        self, pairs: list[tuple[Track | None, Observation]], by_depth: dict[int, DepthPlace | None]
    ) -> list[Body]:
        """The pairs; a new vehicle gets its serial number."""
        bodies = []
        for track, seen in pairs:
            serial = self._next_serial if track is None else track.serial
            self._next_serial += track is None
            bodies.append(Body(serial, track, seen, by_depth.get(id(seen))))
        return bodies

    def _predict(self, t_source_ns: int, T_world_ego: SE2, ego_cov: NDArray[np.float64] | None) -> None:
        dt_s = 0.0 if self._t_ns is None else max(0.0, (t_source_ns - self._t_ns) * 1e-9)
        if dt_s > 0.0:
            step = self._T_world_ego.between(T_world_ego)
            self._ego_speed_mps = math.hypot(step.x_m, step.y_m) / dt_s
        self._t_ns, self._T_world_ego, self._dt_s = t_source_ns, T_world_ego, dt_s
        self.placing.predict(dt_s, T_world_ego, ego_cov)
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
        overlap = iou(
            predicted_boxes_px(self.tracks, self.camera, T_world_ego, ground),
            np.array([o.box_px for o in observations]),
        )
        overlap = np.nan_to_num(overlap, nan=0.0)
        possible = (overlap >= self.config.min_iou) & within_gate(
            self.tracks, observations, T_world_ego, self.config.gate_sigma
        )
        rows, columns = self._assign(np.where(possible, 1.0 - overlap, 2.0))
        return [(self.tracks[i], observations[j]) for i, j in zip(rows, columns, strict=True) if possible[i, j]]

    def _correct(
        self,
        track: Track,
        observation: Observation,
        seen: Place,
        T_world_ego: SE2,
        horizon: Horizon,
        frame_id: int,
        t_source_ns: int,
    ) -> None:
        track.motion = self._predicted_motion(track, frame_id, t_source_ns)
        R = T_world_ego.rotation()
        R_seen = R @ seen.cov @ R.T
        S = track.cov[:2, :2] + R_seen
        innovation = T_world_ego @ seen.centre_m - track.state[:2]
        information = np.linalg.inv(S)
        track.stands = self.placing.parallax.standing(track.serial) > self.config.stands
        if track.stands and innovation @ information @ innovation > self.config.gate_sigma**2:
            # Its size is thought of anew: that is no motion
            track.state[:2] += innovation
            track.first_m = track.first_m + innovation
            track.cov[:2, :], track.cov[2:, :2] = 0.0, 0.0
            track.cov[:2, :2] = R_seen
        else:
            gain = track.cov[:, :2] @ information
            track.state = track.state + gain @ innovation
            track.cov = track.cov - gain @ S @ gain.T
        track.observation, track.place = observation, seen
        track.seen_frame, track.seen_ns, track.T_world_ego = frame_id, t_source_ns, T_world_ego
        track.hits += 1
        track.missed = 0
        track.votes[observation.label] += 1
        if not observation.cut_side:
            self._turn(track, T_world_ego, horizon)

    def _predicted_motion(self, track: Track, frame_id: int, t_source_ns: int) -> MotionEdge | None:
        """VV by constant velocity; None for a track that no edge has shown yet."""
        if track.shown is None:
            return None
        dt_s = (t_source_ns - track.shown.t_ns) * 1e-9
        R = SE2(yaw_rad=track.yaw_rad).rotation()
        growth = track.cov[2:, 2:] * dt_s**2 + np.eye(2) * (self.config.sigma_accel_mps2 * dt_s**2 / 2.0) ** 2
        cov = np.zeros((3, 3))
        cov[:2, :2] = R.T @ growth @ R
        cov[2, 2] = (self.config.sigma_yaw_rate_radps * dt_s) ** 2
        return MotionEdge(
            vehicle=track.vehicle,
            from_frame=track.shown.frame,
            to_frame=frame_id,
            T_from_to=track.shown.T_world_vehicle.between(track.pose()),
            cov=tuple(cov.ravel().tolist()),
        )

    def _turn(self, track: Track, T_world_ego: SE2, horizon: Horizon) -> None:
        """A vehicle that surely moves heads where it moves; one that may stand keeps its yaw.

        It turns about what was seen of it: that its centre lies elsewhere than was thought is no motion.
        """
        if track.stands:
            return
        vx, vy = track.state[2:].tolist()
        speed = math.hypot(vx, vy)
        sigma = math.sqrt(max(float(np.trace(track.cov[2:, 2:])) / 2.0, 1e-12))
        config = self.config
        slowest = max(config.moving_mps, config.moving_sigma * sigma, config.moving_of_ego * self._ego_speed_mps)
        if speed < slowest or not self._has_moved(track):
            return
        turn = wrap(math.atan2(vy, vx) - track.yaw_rad)
        if track.yaw_known and abs(turn) > math.pi / 2.0:  # it was taken for the other way round
            track.yaw_rad, turn = wrap(track.yaw_rad + math.pi), wrap(turn - math.pi)
        track.front_logit = MOTION_LOGIT
        self._turned(track, turn, (config.direction_inflation * sigma / speed) ** 2, T_world_ego, horizon)

    def _face(self, track: Track, by_depth: DepthPlace | None, T_world_ego: SE2, horizon: Horizon) -> None:
        """Towards the yaw that a network saw in the body: its axis each time, its front by all that was seen so far."""
        if by_depth is None or not by_depth.front_seen or track.observation.cut_side:
            return
        turn = wrap(T_world_ego.yaw_rad + by_depth.yaw_rad - track.yaw_rad)
        opposed = abs(turn) > math.pi / 2.0
        said = by_depth.front_logit / self.config.body_yaw_inflation**2
        track.front_logit = min(track.front_logit + (-said if opposed else said), MOTION_LOGIT)
        if opposed:
            turn = wrap(turn - math.pi)
        if track.front_logit < 0.0:
            track.yaw_rad, track.front_logit = wrap(track.yaw_rad + math.pi), -track.front_logit
        self._turned(track, turn, (self.config.body_yaw_inflation * by_depth.sigma_yaw_rad) ** 2, T_world_ego, horizon)

    def _turned(self, track: Track, turn: float, noise: float, T_world_ego: SE2, horizon: Horizon) -> None:
        """The yaw corrected by a measured turn with its variance."""
        before = track.sigma_yaw_rad**2 + (self.config.sigma_yaw_rate_radps * self._dt_s) ** 2
        gain = before / (before + noise) if track.yaw_known else 1.0
        track.sigma_yaw_rad = math.sqrt((1.0 - gain) * before if track.yaw_known else noise)
        track.yaw_rad = wrap(track.yaw_rad + gain * turn)
        track.yaw_known = True
        seen, depth_m = track.observation, track.place.depth_m
        yaw_ego_rad = wrap(track.yaw_rad - T_world_ego.yaw_rad)
        outlines = [
            extent_m(seen.dimensions, yaw_rad, depth_m, seen.bearing)[1]
            for yaw_rad in (yaw_ego_rad, yaw_ego_rad - gain * turn)
        ]
        horizon.turn(track.serial, math.log(outlines[0] / outlines[1]))
        after_m, before_m = (
            place(seen, math.log(depth_m), 0.0, yaw_rad, self.localisation).centre_m
            for yaw_rad in (yaw_ego_rad, yaw_ego_rad - gain * turn)
        )
        shift_m = T_world_ego.rotation() @ (after_m - before_m)
        track.state[:2] += shift_m
        track.first_m = track.first_m + shift_m
        track.place = replace(track.place, centre_m=track.place.centre_m + (after_m - before_m))

    def _has_moved(self, track: Track) -> bool:
        """Whether it left where it was first seen by more than a parked car seems to that is seen better and better."""
        x, y = track.first_sight_m.tolist()
        dx, dy = (track.state[:2] - track.first_m).tolist()
        distance2 = x * x + y * y
        along, across = (x * dx + y * dy) / distance2, (x * dy - y * dx) / distance2
        return math.hypot(along / self.config.moved_along_rel, across / self.config.moved_across_rel) > 1.0

    def _begin(self, body: Body, seen: Place, T_world_ego: SE2, frame_id: int, t_source_ns: int) -> Track:
        # Most traffic runs along the road: until it is seen to face or to move otherwise, it is headed like the ego.
        observation, by_depth = body.seen, body.by_depth
        if by_depth is not None and not by_depth.front_seen:
            by_depth = None
        R = T_world_ego.rotation()
        cov = np.zeros((4, 4))
        cov[:2, :2] = R @ seen.cov @ R.T
        cov[2:, 2:] = np.eye(2) * self.config.sigma_birth_mps**2
        return Track(
            state=np.concatenate([T_world_ego @ seen.centre_m, np.zeros(2)]),
            cov=cov,
            yaw_rad=wrap(T_world_ego.yaw_rad + body.yaw_rad(T_world_ego)),
            observation=observation,
            place=seen,
            serial=body.serial,
            first_m=T_world_ego @ seen.centre_m,
            first_sight_m=R @ seen.centre_m,
            seen_frame=frame_id,
            seen_ns=t_source_ns,
            T_world_ego=T_world_ego,
            votes=Counter({observation.label: 1}),
            sigma_yaw_rad=0.0 if by_depth is None else by_depth.sigma_yaw_rad,
            yaw_known=by_depth is not None,
            front_logit=0.0 if by_depth is None else by_depth.front_logit,
        )

    def _is_lost(self, track: Track, t_source_ns: int) -> bool:
        lasting = track.hits >= self.config.confirm_hits or not track.missed
        patience_s = self.config.forget_s if lasting else self.config.forget_unconfirmed_s
        return (t_source_ns - track.seen_ns) * 1e-9 > patience_s
