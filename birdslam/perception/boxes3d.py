"""3-D boxes of vehicles by a network: centre, size and heading with their uncertainties."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from birdslam.geometry.arrays import Floats, Ints
from birdslam.geometry.camera import Camera, GroundPlane


@dataclass(frozen=True)
class Boxes3d:
    """N bodies, one per 2-D box in its order; sigmas are standard deviations.

    `alpha_rad` is the observation angle: yaw in ego minus the centre's bearing (REP-103; 0 faces away from the camera,
    pi/2 faces left). `flip` is the probability that front and rear are swapped. With `canonical_focal_rel` > 0 depths
    are those of a canonical camera with this focal length over image width; `in_metres` converts them.
    """

    centre_px: Floats  # (N, 2) the body's centre in the undistorted image, also beyond its edge
    depth_m: Floats  # (N,) of that centre along the optical axis
    size_m: Floats  # (N, 3) length, width, height
    alpha_rad: Floats  # (N,) in (-pi, pi]
    sigma_depth_m: Floats  # (N,)
    sigma_size_m: Floats  # (N, 3)
    sigma_alpha_rad: Floats  # (N,) of the axis, in a Gaussian near its peak
    flip: Floats  # (N,) in [0, 0.5]
    canonical_focal_rel: float = 0.0

    def __len__(self) -> int:
        return len(self.depth_m)

    def take(self, rows: Ints | Sequence[int]) -> Boxes3d:
        """Selects rows in the given order."""
        return Boxes3d(
            self.centre_px[rows],
            self.depth_m[rows],
            self.size_m[rows],
            self.alpha_rad[rows],
            self.sigma_depth_m[rows],
            self.sigma_size_m[rows],
            self.sigma_alpha_rad[rows],
            self.flip[rows],
            self.canonical_focal_rel,
        )

    def in_metres(self, camera: Camera) -> Boxes3d:
        """The bodies with depths of this camera; itself if they are not canonical."""
        if self.canonical_focal_rel <= 0.0:
            return self
        factor = camera.fx_px / (self.canonical_focal_rel * camera.width_px)
        return replace(
            self, depth_m=self.depth_m * factor, sigma_depth_m=self.sigma_depth_m * factor, canonical_focal_rel=0.0
        )

    def centres_cam_m(self, camera: Camera) -> Floats:
        """(N, 3) the bodies' centres in the camera frame."""
        x = (self.centre_px[:, 0] - camera.cx_px) / camera.fx_px
        y = (self.centre_px[:, 1] - camera.cy_px) / camera.fy_px
        return self.in_metres(camera).depth_m[:, None] * np.column_stack([x, y, np.ones_like(x)])

    def in_ego(self, camera: Camera, ground: GroundPlane) -> Floats:
        """(N, 3) x_m, y_m, yaw_rad in ego: the bodies projected onto the road."""
        centres_m = self.centres_cam_m(camera) @ ground.R_ego_cam.T
        yaw_rad = self.alpha_rad + np.arctan2(centres_m[:, 1], centres_m[:, 0])
        return np.column_stack([centres_m[:, :2], np.remainder(yaw_rad + math.pi, 2.0 * math.pi) - math.pi])
