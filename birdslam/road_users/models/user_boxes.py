"""Measurement model of the box of a road user, and its cases: an edge of it may be hidden. With the depth z of the
nearest face or foot, the distance r on to the upper edge, the camera height H, and the road's `rise` (`bev.rise`):

    bearing = Y / X,   bottom = (H + offset) / z - rise - tilt + foot h / (z + r)   (Eq. 1)
    log of the height = log(h) - log(z + r) + log(1 + r (H + offset) / (z h)) + foot - head
    log of the width = log(w) - log(z)
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from birdslam.geometry.arrays import Floats
from birdslam.geometry.bev import RoadProfile
from birdslam.geometry.se2 import SE2
from birdslam.road_users.models.user_state import FOOT, HEAD, HEIGHT, OFFSET, PLACE, STATES, TILT, WIDTH

CUES = BEARING, BOTTOM, TALL, WIDE = range(4)
UNUSED_SIGMA = 1e3  # 1-sigma of an unused measurement
MIN_DISTANCE_M = 0.7  # of the centre of a road user, ahead of the camera


@dataclass(frozen=True)
class Cases:
    """Cases of boxes (M,): priors (M, C), shifts of the measurements (M, C, 4) and their 1-sigmas (M, C, 4).

    In a case with a jump the box is from now on that of a neighbour in the direction of travel (1-sigma `jump_m`).
    """

    prior: Floats
    shift: Floats
    sigma: Floats
    jump_m: Floats  # (C, 1)


@dataclass(frozen=True)
class Boxes:
    """Measurements (M, 4) of boxes, covariances (M, 4, 4), and geometry (M,) of their road users."""

    z: Floats
    R: Floats
    reach_m: Floats  # from the nearest face or foot to the centre, along the line of sight
    top_m: Floats  # from it to the upper edge
    cases: Cases
    direction_rad: Floats  # of travel, in world
    outline_var: Floats  # growth of the variance of the log width since the last box
    face_var: Floats  # of the logs of height and width: unknown depth of the edges, for as long as the view lasts

    def take(self, rows: Sequence[int]) -> Boxes:
        """The boxes of these rows."""
        cases = Cases(self.cases.prior[rows], self.cases.shift[rows], self.cases.sigma[rows], self.cases.jump_m)
        names = "z", "R", "reach_m", "top_m", "direction_rad", "outline_var", "face_var"
        return Boxes(cases=cases, **{name: getattr(self, name)[rows] for name in names})


def expected_boxes(
    x: Floats, reach_m: Floats, top_m: Floats, T_world_ego: SE2, road: RoadProfile
) -> tuple[Floats, Floats]:
    """Expected measurements (M, K, 4) of states (M, K, S), and Jacobians (M, K, 4, S); geometry (M,) as in `Boxes`."""
    R = T_world_ego.rotation()
    in_ego = (x[..., PLACE] - [T_world_ego.x_m, T_world_ego.y_m]) @ R
    ahead, y = np.maximum(in_ego[..., 0], MIN_DISTANCE_M), in_ego[..., 1]
    depth = np.maximum(ahead - reach_m[:, None], 0.5 * MIN_DISTANCE_M)
    top = depth + top_m[:, None]
    height, below = np.exp(x[..., HEIGHT]), road.height_m + x[..., OFFSET]
    tall = height / top
    nearer = top_m[:, None] * below / (depth * height)  # increase of the height by the nearer lower edge
    margin = x[..., FOOT] * tall
    expected, J = np.empty((*x.shape[:2], len(CUES))), np.zeros((*x.shape[:2], len(CUES), len(STATES)))
    expected[..., BEARING] = y / ahead
    expected[..., BOTTOM] = road.slope(depth, x[..., OFFSET]) - x[..., TILT] + margin  # Eq. 1
    expected[..., TALL] = x[..., HEIGHT] - np.log(top) + np.log1p(nearer) + x[..., FOOT] - x[..., HEAD]
    expected[..., WIDE] = x[..., WIDTH] - np.log(depth)
    falls = -below / depth**2 - 0.5 * road.vertical_per_m - margin / top
    shrinks = -1.0 / top - nearer / (1.0 + nearer) / depth
    by_depth = np.stack([-y / ahead**2, falls, shrinks, -1.0 / depth], axis=-1)
    J[..., PLACE] = by_depth[..., None] * R[:, 0]
    J[..., BEARING, PLACE] += R[:, 1] / ahead[..., None]
    J[..., BOTTOM, TILT], J[..., BOTTOM, OFFSET], J[..., BOTTOM, FOOT] = -1.0, 1.0 / depth, tall
    J[..., TALL, HEIGHT], J[..., TALL, FOOT], J[..., TALL, HEAD] = 1.0 / (1.0 + nearer), 1.0, -1.0
    J[..., BOTTOM, HEIGHT], J[..., TALL, OFFSET] = margin, nearer / (1.0 + nearer) / below
    J[..., WIDE, WIDTH] = 1.0
    return expected, J


def edge_covariance(tall: Floats, sigmas: Floats) -> Floats:
    """(M, 4, 4) noise of boxes of height `tall` (M,); `sigmas` (M, 4) of middle, bottom, top, log width."""
    middle, bottom, top, width = np.square(sigmas).T
    R = np.zeros((len(tall), len(CUES), len(CUES)))
    R[:, BEARING, BEARING], R[:, BOTTOM, BOTTOM], R[:, WIDE, WIDE] = middle, bottom, width
    R[:, BOTTOM, TALL] = R[:, TALL, BOTTOM] = bottom / tall
    R[:, TALL, TALL] = (bottom + top) / tall**2
    return R
