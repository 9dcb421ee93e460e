"""The pitch of the camera by the road's own lines: lanes, kerbs and rails run side by side and meet on its horizon.

One image shows it, however smooth the asphalt and however dark the night, and no length comes into it. Segments of a
line detector (LSD; von Gioi et al. 2012, by OpenCV) vote for the point where they meet, in the order in which a wrong
guess and lines of other directions do least harm: robust least squares whose kernel narrows.

A line at X to the right, on a road of curvature c and a way that bends by k, is in the image, with s = y - y_h,

    x = x_v + X / H s + k H / (2 s)        its tangent at the depth z = H / s meets the horizon at x_v + k z

and the horizon of the road at that depth is c z higher than that of the plane under the camera.
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

_KERNELS = (16.0, 8.0, 4.0, 2.0, 2.0, 2.0, 2.0)  # sigmas of a segment, one round each
_WIDE_SIGMAS = 8.0  # within which the segments' spread is taken, whether they agree or not
_NOSE_UP_RAD = 0.05  # rows are looked at that show the road with the nose up by so much
_LEAST_BELOW = 0.02  # of a segment below the horizon, as a tangent: nearer to it nothing is road
_WIDTH_PX = 640  # about so wide an image is looked at, for time: larger ones are halved


class RoadLinesConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Which lines are taken for the road's, and how well they show the pitch.

    By judgement of roads; that their pitch lies within its sigma was looked at on rendered motorways, by day, by night
    and behind an encoder, on KITTI 00, 06 and 0005 and on a motorway clip.
    """

    every_m: Positive = 5.0  # travelled from one look to the next
    at_most_every_m: Positive = 40.0  # where looks show nothing, each is twice as far from the one before
    far_m: Positive = 40.0  # where the strip of road ends
    half_width_m: Positive = 12.0  # of the strip: the other lanes' lines count, and the rails
    max_bend_per_m: Positive = 0.004  # in a tighter bend lines have no common direction
    least_px: Positive = 15.0  # of a segment
    sigma_px: Positive = 0.4  # of a segment's end
    sigma_parallel_rad: Positive = 0.0015  # by which lines of one road run apart
    min_segments: Positive = 4.0  # that agree, each counted by its weight: a painted line has two edges
    # Sigmas of all lines that lead about there; with more they are a town's, and meet anywhere. Rendered motorways have
    # 1.0 to 1.2, KITTI 06 and 0005 2.2 to 3, 00 3.4 to 4.6
    max_spread: Positive = 2.0
    sigma_heading_rad: Positive = 0.05  # of the road's direction, before the lines, against the car's
    sigma_pitch_rad: Positive = 0.05  # of the pitch before them
    sigma_bend_per_m: Positive = 0.001  # of the road's bend against the way's
    max_sigma_rad: Positive = 0.006  # lines that show the pitch no better say nothing
    sigma_road_rad: Positive = 0.0015  # of the horizon by any lines: they narrow, and the road is no plane
    max_distance_m: Positive = 20.0  # to which the road's curvature is believed
    max_innovation_sigma: Positive = 3.0  # lines farther from what was expected are others


@dataclass(frozen=True)
class LinesDirection:
    """Where the road's lines lead, in camera axes (3,); it lies in the road that is `distance_m` ahead."""

    direction: Floats
    sigma_rad: float  # of it against that road
    distance_m: float
    segments: float  # that agree


class RoadLines:
    """State: the way since the last look, and to the next. Reader: `RoadScale`, for the tilt of its filter."""

    def __init__(self, camera: Camera, config: RoadLinesConfig) -> None:
        self.camera, self.config = camera, config
        horizon_px = camera.cy_px + camera.fy_px * (camera.height_m / config.far_m - _NOSE_UP_RAD)
        self._top_px = int(np.clip(horizon_px, 0, camera.height_px - 32))
        self._halvings = max(0, round(np.log2(camera.width_px / _WIDTH_PX)))
        # Where the detector shrinks the image by itself its segments are off by a pixel, and the pitch by 0.3 degrees
        self._detector = cv2.createLineSegmentDetector(cv2.LSD_REFINE_STD, 1.0)
        self._since_m, self._every_m = np.inf, config.every_m

    def look(
        self,
        grey: NDArray[np.uint8],
        boxes_px: Floats,
        pitch_rad: float,
        heading_rad: float,
        bend_per_m: float,
        travelled_m: float,
    ) -> LinesDirection | None:
        """(H, W) grey, (N, 4) vehicles, the guesses of pitch and of the way to the right, and the way since the image
        before; None where it is too early for a look, or lines show nothing.
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
        lines = meeting(self.camera, cfg, ends_px, pitch_rad, heading_rad, bend_per_m)
        self._every_m = cfg.every_m if lines is not None else min(2.0 * self._every_m, cfg.at_most_every_m)
        return lines


def meeting(
    camera: Camera, config: RoadLinesConfig, ends_px: Floats, pitch_rad: float, heading_rad: float, bend_per_m: float
) -> LinesDirection | None:
    """Where segments (N, 2 ends, 2) meet that are the road's; None where too few of them do."""
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
    prior = np.array([np.tan(heading_rad), -np.tan(pitch_rad), bend_per_m])  # where they meet, and the bend
    prior_info = np.diag(np.power([cfg.sigma_heading_rad, cfg.sigma_pitch_rad, cfg.sigma_bend_per_m], -2.0))
    at = prior.copy()
    for kernel in _KERNELS:
        below = np.maximum(y - at[1], _LEAST_BELOW)
        z = height_m / below
        off = x + slope * (at[1] - y) - (at[0] + at[2] * z)  # on the horizon, of the segment's own end
        ends_off = np.sqrt(2.0) * cfg.sigma_px / length_px * (1.0 + slope**2) * below
        sigma = np.hypot(ends_off, cfg.sigma_parallel_rad)
        agrees = (1.0 + (off / (kernel * sigma)) ** 2) ** -2.0
        J = np.column_stack([-np.ones_like(z), slope, -z])
        JW = J.T * (agrees / sigma**2)
        info = JW @ J + prior_info
        at = at - np.linalg.solve(info, JW @ off + prior_info @ (at - prior))
    wide = (1.0 + (off / (_WIDE_SIGMAS * sigma)) ** 2) ** -2.0
    spread = float(np.sqrt(max((wide * (off / sigma) ** 2).sum() / wide.sum(), 1.0)))
    sigma_rad = spread * float(np.sqrt(np.linalg.inv(info)[1, 1]))
    if agrees.sum() < cfg.min_segments or spread > cfg.max_spread or not sigma_rad < cfg.max_sigma_rad:
        return None
    tells = agrees / sigma**2 * slope**2  # of the horizon
    distance_m = min(float(tells @ z / max(tells.sum(), 1e-12)), cfg.max_distance_m)
    direction = np.array([at[0], at[1], 1.0]) / np.sqrt(at[0] ** 2 + at[1] ** 2 + 1.0)
    return LinesDirection(direction, float(np.hypot(sigma_rad, cfg.sigma_road_rad)), distance_m, float(agrees.sum()))
