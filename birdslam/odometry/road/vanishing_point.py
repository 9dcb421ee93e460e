"""Vanishing point of the road's parallel lines in one image, by robust least squares over line segments.

Segments come from LSD (von Gioi et al. 2012). The image of a line at X to the right, on a road of curvature c along a
path of curvature k, is x = x_v + X / H s + k H / (2 s) with s = y - y_h. Its tangent at depth z = H / s meets the
horizon at x_v + k z, which is c z higher there than that of the plane under the camera.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import cv2
import msgspec
import numpy as np
from numpy.typing import NDArray

from birdslam.geometry.camera import Camera
from birdslam.odometry.road.points import outside

Floats = NDArray[np.float64]
Positive = Annotated[float, msgspec.Meta(gt=0.0)]

_KERNEL_SIGMAS = (16.0, 8.0, 4.0, 2.0, 2.0, 2.0, 2.0)  # in sigmas, one for each iteration
_SPREAD_KERNEL_SIGMAS = 8.0  # of the kernel for the spread of the residuals
_MAX_NOSE_UP_RAD = 0.05  # maximum pitch for which the search area includes far_m
_MIN_TANGENT_BELOW = 0.02  # of a segment below the horizon, as a tangent
_WIDTH_PX = 640  # approximate working width; larger images are halved


class VanishingPointConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Parameters of the segments on the road and of the vanishing point's uncertainty."""

    every_m: Positive = 5.0  # distance between two detections
    at_most_every_m: Positive = 40.0  # maximum distance: it doubles after each failed detection
    far_m: Positive = 40.0  # far end of the strip of road
    half_width_m: Positive = 12.0  # of the strip, with other lanes and guard rails
    max_bend_per_m: Positive = 0.004  # in a tighter bend, lines have no vanishing point
    least_px: Positive = 15.0  # minimum length of a segment
    sigma_px: Positive = 0.4  # of an end of a segment
    sigma_parallel_rad: Positive = 0.0015  # deviation of the lines from parallel
    min_segments: Positive = 4.0  # minimum sum of the robust weights
    max_spread: Positive = 2.0  # of the residuals in sigmas; lines of a town are not parallel and have more
    sigma_heading_rad: Positive = 0.05  # prior, of the road's direction relative to the car
    sigma_pitch_rad: Positive = 0.05  # prior, of the pitch
    sigma_bend_per_m: Positive = 0.001  # prior, of the difference of the curvatures of road and path
    max_sigma_rad: Positive = 0.006  # maximum of the estimated pitch
    sigma_road_rad: Positive = 0.0015  # systematic: lanes narrow, and the road is not a plane
    max_distance_m: Positive = 20.0  # of the extrapolation of the road's curvature
    max_innovation_sigma: Positive = 3.0  # outlier gate of a vanishing point


@dataclass(frozen=True)
class VanishingPoint:
    """The vanishing point as a direction in camera axes (3,); it lies in the road `distance_m` ahead."""

    direction: Floats
    sigma_rad: float  # of the direction against the road plane
    distance_m: float
    segments: float  # sum of the robust weights


class VanishingPointDetector:
    """State: the distance since the last detection, and to the next. Reader: `RoadScale`, for the tilt."""

    def __init__(self, camera: Camera, config: VanishingPointConfig) -> None:
        self.camera, self.config = camera, config
        horizon_px = camera.cy_px + camera.fy_px * (camera.height_m / config.far_m - _MAX_NOSE_UP_RAD)
        self._top_px = int(np.clip(horizon_px, 0, camera.height_px - 32))
        self._halvings = max(0, round(np.log2(camera.width_px / _WIDTH_PX)))
        # Scale 1.0, since the detector's own downscaling biases the segments
        self._detector = cv2.createLineSegmentDetector(cv2.LSD_REFINE_STD, 1.0)
        self._since_m, self._every_m = np.inf, config.every_m

    def detect(
        self,
        grey: NDArray[np.uint8],
        boxes_px: Floats,
        pitch_rad: float,
        heading_rad: float,
        bend_per_m: float,
        travelled_m: float,
    ) -> VanishingPoint | None:
        """Detects the vanishing point in (H, W) grey, without vehicles (N, 4); None if not due or not found.

        `pitch_rad`, `heading_rad` (of the road, to the right) and `bend_per_m` are the prior. `travelled_m` is the
        distance since the last image.
        """
        cfg = self.config
        self._since_m += travelled_m
        if self._since_m < self._every_m or abs(bend_per_m) > cfg.max_bend_per_m:
            return None
        self._since_m = 0.0
        rows = np.ascontiguousarray(grey[self._top_px :])
        for _ in range(self._halvings):
            rows = np.asarray(cv2.pyrDown(rows), np.uint8)
        found = self._detector.detect(rows)[0]
        ends_px = np.array([] if found is None else found, np.float64).reshape(-1, 2, 2)
        ends_px = ends_px * 2.0**self._halvings + np.array([0.0, self._top_px])
        ends_px = ends_px[outside(ends_px.mean(axis=1), boxes_px)]
        lines = fit_vanishing_point(self.camera, cfg, ends_px, pitch_rad, heading_rad, bend_per_m)
        self._every_m = cfg.every_m if lines is not None else min(2.0 * self._every_m, cfg.at_most_every_m)
        return lines


def fit_vanishing_point(
    camera: Camera,
    config: VanishingPointConfig,
    ends_px: Floats,
    pitch_rad: float,
    heading_rad: float,
    bend_per_m: float,
) -> VanishingPoint | None:
    """Fits the vanishing point of segments (N, 2 ends, 2) by robust least squares; None if too few agree."""
    cfg, height_m = config, camera.height_m
    ends = camera.to_xy(ends_px.reshape(-1, 2)).reshape(-1, 2, 2)
    along, (x, y) = ends[:, 1] - ends[:, 0], ends.mean(axis=1).T
    length_px = np.linalg.norm(ends_px[:, 1] - ends_px[:, 0], axis=1)
    below = y + np.tan(pitch_rad)
    with np.errstate(divide="ignore", invalid="ignore"):
        slope = along[:, 0] / along[:, 1]
    good = (length_px > cfg.least_px) & (below > height_m / cfg.far_m) & (np.abs(slope) * height_m < cfg.half_width_m)
    if good.sum() < cfg.min_segments:
        return None
    x, y, slope, length_px = x[good], y[good], slope[good], length_px[good]
    prior = np.array([np.tan(heading_rad), -np.tan(pitch_rad), bend_per_m])  # vanishing point (2), curvature
    prior_info = np.diag(np.power([cfg.sigma_heading_rad, cfg.sigma_pitch_rad, cfg.sigma_bend_per_m], -2.0))
    estimate = prior.copy()
    for kernel in _KERNEL_SIGMAS:
        below = np.maximum(y - estimate[1], _MIN_TANGENT_BELOW)
        z = height_m / below
        residual = x + slope * (estimate[1] - y) - (estimate[0] + estimate[2] * z)  # along the horizon
        sigma_ends = np.sqrt(2.0) * cfg.sigma_px / length_px * (1.0 + slope**2) * below
        sigma = np.hypot(sigma_ends, cfg.sigma_parallel_rad)
        weight = (1.0 + (residual / (kernel * sigma)) ** 2) ** -2.0
        J = np.column_stack([-np.ones_like(z), slope, -z])
        JW = J.T * (weight / sigma**2)
        info = JW @ J + prior_info
        estimate = estimate - np.linalg.solve(info, JW @ residual + prior_info @ (estimate - prior))
    wide = (1.0 + (residual / (_SPREAD_KERNEL_SIGMAS * sigma)) ** 2) ** -2.0
    spread = float(np.sqrt(max((wide * (residual / sigma) ** 2).sum() / wide.sum(), 1.0)))
    sigma_rad = spread * float(np.sqrt(np.linalg.inv(info)[1, 1]))
    if weight.sum() < cfg.min_segments or spread > cfg.max_spread or not sigma_rad < cfg.max_sigma_rad:
        return None
    information = weight / sigma**2 * slope**2  # about the horizon
    distance_m = min(float(information @ z / max(information.sum(), 1e-12)), cfg.max_distance_m)
    direction = np.array([estimate[0], estimate[1], 1.0]) / np.sqrt(estimate[0] ** 2 + estimate[1] ** 2 + 1.0)
    return VanishingPoint(direction, float(np.hypot(sigma_rad, cfg.sigma_road_rad)), distance_m, float(weight.sum()))
