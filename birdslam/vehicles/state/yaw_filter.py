"""The yaw of each vehicle: a filter of one angle, corrected by the direction of its motion and by its body's yaw."""

from __future__ import annotations

import math

import msgspec
import numpy as np

from birdslam.geometry.se2 import SE2, wrap
from birdslam.vehicles.placement.depth_fusion import DepthPlace
from birdslam.vehicles.placement.localisation import LocalisationConfig, centre_at, extent_m
from birdslam.vehicles.state.ground_size_filter import GroundSizeFilter
from birdslam.vehicles.state.yaw_by_outline import YawByOutline
from birdslam.vehicles.track import Track, TrackingConfig

MIN_TURN_RAD = 0.02  # a smaller turn is none, so that yaws that are not known don't quiver
MOTION_LOGIT = 6.0  # log odds of the front of a vehicle that was seen to move


class YawFilter:
    """A scalar Kalman filter for each vehicle.

    State: the yaw in the odometry's world and its 1-sigma (rad), and the log odds that it points to the front; all are
    fields of `Track`. Measurements: the direction of the track's velocity (rad), once the vehicle surely moves, and the
    yaw (rad) that a network sees in its body. Read by `vehicle_edges` (the yaw of CV and VV edges), by
    `placing.Placing` and by the next frames' outlines in `ground_size_filter.GroundSizeFilter`.
    """

    def __init__(self, config: TrackingConfig, localisation: LocalisationConfig, ground_size: GroundSizeFilter) -> None:
        self.config = config
        self.ground_size = ground_size
        self.localisation = localisation
        self._dt_s = 0.0
        self._ego_speed_mps = 0.0

    def predict(self, dt_s: float, step: SE2) -> None:
        """To the next frame, `dt_s` later, to which the ego made `step`."""
        if dt_s > 0.0:
            self._ego_speed_mps = math.hypot(step.x_m, step.y_m) / dt_s
        self._dt_s = dt_s

    def correct_by_motion(self, row: int, track: Track) -> None:
        """A vehicle that surely moves heads where it moves; one that may stand keeps its yaw."""
        if track.stands or track.observation.cut_side:
            return
        vx, vy = track.state[2:].tolist()
        speed = math.hypot(vx, vy)
        sigma = math.sqrt(max(float(track.cov[2, 2] + track.cov[3, 3]) / 2.0, 1e-12))
        config = self.config
        slowest = max(config.moving_mps, config.moving_sigma * sigma, config.moving_of_ego * self._ego_speed_mps)
        if speed < slowest or not self._has_moved(track):
            return
        turn = wrap(math.atan2(vy, vx) - track.yaw_rad)
        if track.yaw_known and abs(turn) > math.pi / 2.0:  # its rear was mistaken for its front
            track.yaw_rad, turn = wrap(track.yaw_rad + math.pi), wrap(turn - math.pi)
        track.front_logit = MOTION_LOGIT
        self._correct(row, track, turn, (config.direction_inflation * sigma / speed) ** 2)

    def correct_by_body(self, row: int, track: Track, by_depth: DepthPlace | None) -> None:
        """Towards the yaw that a network saw in the body: its axis each time, its front by all that was seen so far."""
        if by_depth is None or not by_depth.front_seen or track.observation.cut_side:
            return
        turn = wrap(track.frame.T_world_ego.yaw_rad + by_depth.yaw_rad - track.yaw_rad)
        opposed = abs(turn) > math.pi / 2.0
        logit = by_depth.front_logit / self.config.body_yaw_inflation**2
        track.front_logit = min(track.front_logit + (-logit if opposed else logit), MOTION_LOGIT)
        if opposed:
            turn = wrap(turn - math.pi)
        if track.front_logit < 0.0:
            track.yaw_rad, track.front_logit = wrap(track.yaw_rad + math.pi), -track.front_logit
        self._correct(row, track, turn, (self.config.body_yaw_inflation * by_depth.sigma_yaw_rad) ** 2)

    def correct_by_outline(self, row: int, track: Track, outline: YawByOutline) -> None:
        """To the likeliest yaw by its widths so far, while neither motion nor body has given it."""
        if track.yaw_known or track.observation.cut_side:
            return
        yaw_rad, track.sigma_yaw_rad = outline.estimate(row, track.yaw_rad)
        turn = wrap(yaw_rad - track.yaw_rad)
        if abs(turn) > MIN_TURN_RAD:
            self._turn(row, track, turn)

    def _correct(self, row: int, track: Track, turn: float, variance: float) -> None:
        """The yaw by a measured turn (rad) with its variance."""
        before = track.sigma_yaw_rad**2 + (self.config.sigma_yaw_rate_radps * self._dt_s) ** 2
        gain = before / (before + variance) if track.yaw_known else 1.0
        track.sigma_yaw_rad = math.sqrt((1.0 - gain) * before if track.yaw_known else variance)
        track.yaw_known = True
        self._turn(row, track, gain * turn)

    def _turn(self, row: int, track: Track, turn: float) -> None:
        """Turns it by `turn` (rad), and with it what was derived from the old yaw.

        A vehicle turns about what was seen of it: that its centre lies elsewhere than was thought is no motion.
        """
        track.yaw_rad = wrap(track.yaw_rad + turn)
        seen, depth_m, ego_yaw_rad = track.observation, track.place.depth_m, track.frame.T_world_ego.yaw_rad
        yaw_ego_rad = wrap(track.yaw_rad - ego_yaw_rad)
        yaws_rad = yaw_ego_rad, yaw_ego_rad - turn
        after, before_it = (extent_m(seen.dimensions, yaw_rad, depth_m, seen.bearing)[1] for yaw_rad in yaws_rad)
        self.ground_size.rescale_outline(row, math.log(after / before_it))
        (x, y, *_), (x0, y0, *_) = (centre_at(seen, depth_m, yaw_rad, self.localisation) for yaw_rad in yaws_rad)
        shift_m = SE2(yaw_rad=ego_yaw_rad) @ SE2(x - x0, y - y0)
        shift_world_m = np.array([shift_m.x_m, shift_m.y_m])
        track.state[:2] += shift_world_m
        track.first_m = track.first_m + shift_world_m
        track.place = msgspec.structs.replace(track.place, centre_m=track.place.centre_m + np.array([x - x0, y - y0]))

    def _has_moved(self, track: Track) -> bool:
        """Whether it has left the place where it was first seen by more than the error of that place explains."""
        x, y = track.first_offset_m.tolist()
        dx, dy = (track.state[:2] - track.first_m).tolist()
        distance2 = x * x + y * y
        along, across = (x * dx + y * dy) / distance2, (x * dy - y * dx) / distance2
        return math.hypot(along / self.config.moved_along_rel, across / self.config.moved_across_rel) > 1.0
