"""Yaw filter of each vehicle, corrected by the direction of motion and by the yaw of its body."""

from __future__ import annotations

import math

import msgspec
import numpy as np

from birdslam.geometry.se2 import SE2, wrap
from birdslam.road_users.placement.depth_fusion import DepthPlace
from birdslam.road_users.placement.localisation import LocalisationConfig, centre_at, extent_m
from birdslam.road_users.state.ground_size_filter import GroundSizeFilter
from birdslam.road_users.state.yaw_by_outline import YawByOutline
from birdslam.road_users.track import TrackingConfig, VehicleTrack

MIN_TURN_RAD = 0.02  # smaller turns are ignored, against jitter
MOTION_FRONT_LOGIT = 6.0  # log odds of the front of a moving vehicle


class YawFilter:
    """A scalar Kalman filter for each vehicle.

    State: yaw in the odometry world and its 1-sigma (rad), and log odds of the front; all are fields of `Track`.
    Measurements: direction of a significant velocity (rad), and yaw (rad) of the body by a network. Readers:
    `vehicle_edges`, `placing.Placing`, and the outlines in `ground_size_filter.GroundSizeFilter`.
    """

    def __init__(self, config: TrackingConfig, localisation: LocalisationConfig, ground_size: GroundSizeFilter) -> None:
        self.config = config
        self.ground_size = ground_size
        self.localisation = localisation
        self._dt_s = 0.0

    def predict(self, dt_s: float) -> None:
        """Predicts to the next frame, `dt_s` later."""
        self._dt_s = dt_s

    def correct_by_motion(self, row: int, track: VehicleTrack) -> None:
        """Corrects the yaw by the direction of a significant motion."""
        if track.is_stationary or track.observation.is_cut_at_side:
            return
        (vx, vy), cov, config = track.velocity_mps.tolist(), track.kinematic_cov[2:, 2:], self.config
        speed = math.hypot(vx, vy)
        if speed < config.moving_mps:
            return
        if track.velocity_mps @ np.linalg.solve(cov, track.velocity_mps) < config.moving_sigma**2:
            return
        turn = wrap(math.atan2(vy, vx) - track.yaw_rad)
        if track.is_yaw_known and abs(turn) > math.pi / 2.0:  # front and rear were swapped
            track.yaw_rad, turn = wrap(track.yaw_rad + math.pi), wrap(turn - math.pi)
        track.front_logit = MOTION_FRONT_LOGIT
        across = np.array([-vy, vx]) / speed
        self._correct(row, track, turn, (config.direction_inflation / speed) ** 2 * float(across @ cov @ across))

    def correct_by_body(self, row: int, track: VehicleTrack, by_depth: DepthPlace | None) -> None:
        """Corrects the yaw by the axis of the body from a network, and the front by accumulated log odds."""
        if by_depth is None or not by_depth.has_front or track.observation.is_cut_at_side:
            return
        turn = wrap(track.frame.T_world_ego.yaw_rad + by_depth.yaw_rad - track.yaw_rad)
        opposed = abs(turn) > math.pi / 2.0
        logit = by_depth.front_logit / self.config.body_yaw_inflation**2
        track.front_logit = min(track.front_logit + (-logit if opposed else logit), MOTION_FRONT_LOGIT)
        if opposed:
            turn = wrap(turn - math.pi)
        if track.front_logit < 0.0:
            track.yaw_rad, track.front_logit = wrap(track.yaw_rad + math.pi), -track.front_logit
        self._correct(row, track, turn, (self.config.body_yaw_inflation * by_depth.sigma_yaw_rad) ** 2)

    def correct_by_outline(self, row: int, track: VehicleTrack, outline: YawByOutline) -> None:
        """Sets the yaw from the widths of the boxes, until motion or body measure it."""
        if track.is_yaw_known or track.observation.is_cut_at_side:
            return
        yaw_rad, track.sigma_yaw_rad = outline.estimate(row, track.yaw_rad)
        turn = wrap(yaw_rad - track.yaw_rad)
        if abs(turn) > MIN_TURN_RAD:
            self._turn(row, track, turn)

    def _correct(self, row: int, track: VehicleTrack, turn: float, variance: float) -> None:
        """Kalman update by a measured turn (rad) with its variance."""
        before = track.sigma_yaw_rad**2 + (self.config.sigma_yaw_rate_radps * self._dt_s) ** 2
        gain = before / (before + variance) if track.is_yaw_known else 1.0
        track.sigma_yaw_rad = math.sqrt((1.0 - gain) * before if track.is_yaw_known else variance)
        track.is_yaw_known = True
        self._turn(row, track, gain * turn)

    def _turn(self, row: int, track: VehicleTrack, turn: float) -> None:
        """Turns the vehicle by `turn` (rad), with everything that depends on the yaw.

        It turns about its visible edges; the shift of the centre is not a motion.
        """
        track.yaw_rad = wrap(track.yaw_rad + turn)
        seen, depth_m, ego_yaw_rad = track.observation, track.place.depth_m, track.frame.T_world_ego.yaw_rad
        yaw_ego_rad = wrap(track.yaw_rad - ego_yaw_rad)
        yaws_rad = yaw_ego_rad, yaw_ego_rad - turn
        after, before_it = (extent_m(seen.dimensions, yaw_rad, depth_m, seen.bearing)[1] for yaw_rad in yaws_rad)
        self.ground_size.rescale_outline(row, math.log(after / before_it))
        (x, y, *_), (x0, y0, *_) = (centre_at(seen, depth_m, yaw_rad, self.localisation) for yaw_rad in yaws_rad)
        shift_m = SE2(yaw_rad=ego_yaw_rad) @ SE2(x - x0, y - y0)
        track.predicted_m = np.add(track.predicted_m, (shift_m.x_m, shift_m.y_m))
        track.place = msgspec.structs.replace(track.place, centre_m=track.place.centre_m + np.array([x - x0, y - y0]))
