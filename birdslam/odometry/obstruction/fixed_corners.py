"""Fixed corners: those that do not move in the image while the car drives (dirt, drops, reflections, the bonnet).

They agree perfectly with one another on no motion, and soon outvote the street. Below the horizon a corner of it
must move at least as far as the road behind it, which the travelled distance gives. Above it dirt looks like what is
far: there fixed corners are left out where enough below it are fixed. At a start that distance is not known, and a way
by corners on drops fits no length of the road: where the street's corners below the horizon have moved far, those of
all that stood are fixed.
"""

from __future__ import annotations

from typing import Annotated

import msgspec
import numpy as np
from numpy.typing import NDArray

from birdslam.geometry.bev import rays_cam
from birdslam.geometry.camera import Camera, GroundPlane, plane_normal
from birdslam.odometry.corners.sliding_window import match_ids
from birdslam.odometry.median import quantile

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]
Positive = Annotated[float, msgspec.Meta(gt=0.0)]
Count = Annotated[int, msgspec.Meta(ge=1)]

# Displacement of the street below the horizon, in the median of what moves there: then what stands is not the street
_STRETCH_PX = 6.0


class FixedCornersConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """When a corner is fixed, and how many make a dirty windscreen. By judgement, tried on the shipped drive's street
    with dirt, drops and reflections; on KITTI 00, 01, 06 and 0005 no corner is left out."""

    still_px: Positive = 1.0  # displacement of a corner that counts as moved
    road_px: Positive = 15.0  # flow of the road behind a corner that is fixed
    on_threshold: Count = 6  # fixed corners below the horizon
    on_threshold_share: Annotated[float, msgspec.Meta(gt=0.0, le=1.0)] = 0.15  # and their share of those below it
    judged_m: Positive = 2.0  # travel over which the road moves by road_px where corners count as below it
    far_m: Positive = 120.0  # depth assumed above the horizon: most of what has corners is nearer
    far_px: Positive = 3.0  # flow at far_m of a corner that is fixed


class _Stretch:
    """The way over which the street's corners move by `_STRETCH_PX`: which others stand all along it.

    State: the corners at its begin, and the ids of those that stood over the last one. Reader: `FixedCorners`.
    """

    def __init__(self, still_px: float, least: int) -> None:
        self._still_px, self._least = still_px, least
        self._ids: Ints = np.zeros(0, np.int64)
        self._px: Floats = np.zeros((0, 2))
        self.stood: Ints = np.zeros(0, np.int64)

    def begin(self, ids: Ints, px: Floats) -> None:
        """A new one from corners ids (N,) ascending, px (N, 2)."""
        self._ids, self._px = ids, px

    @property
    def started(self) -> bool:
        """Whether there were corners to begin with."""
        return len(self._ids) > 0

    def update(self, ids: Ints, px: Floats, below: Bools) -> None:
        """Takes the corners of the present image, as `begin`; `below` (N,) are those below the horizon."""
        a, b = match_ids(self._ids, ids)
        moved_px = np.hypot(*(px[b] - self._px[a]).T)
        street = below[b] & (moved_px > self._still_px)
        if street.sum() >= self._least and quantile(moved_px[street], 0.5) > _STRETCH_PX:
            self.stood = ids[b][moved_px < self._still_px]
            self.begin(ids, px)
        elif 2 * len(a) <= len(self._ids):  # most were lost, or none were there
            self.begin(ids, px)


class FixedCorners:
    """State: each corner's position when it last moved, and the distance then. Reader: `CornerSelector`."""

    def __init__(self, camera: Camera, config: FixedCornersConfig) -> None:
        self.camera, self.config = camera, config
        self._ids: Ints = np.zeros(0, np.int64)
        self._px: Floats = np.zeros((0, 2))
        self._since_m: Floats = np.zeros(0)
        self._path_m = 0.0
        self._stretch = _Stretch(config.still_px, config.on_threshold)
        self.present = False

    def begin(self, ids: Ints, px: Floats) -> None:
        """Takes the corners of the image before the first of `update`, as it does."""
        if not self._stretch.started:
            self._stretch.begin(ids, px)

    def update(self, ids: Ints, px: Floats, ground: GroundPlane, driven_m: float | None) -> Bools:
        """(N,) which corners of the present image are fixed; ids (N,) ascending, px (N, 2).

        `driven_m` is the car's travel since the image before; None: it is not known.
        """
        cfg = self.config
        self._path_m += driven_m or 0.0
        at_px, at_m = px.copy(), np.full(len(ids), self._path_m)
        before, now = match_ids(self._ids, ids)
        unmoved = np.square(px[now] - self._px[before]).sum(axis=1) < cfg.still_px**2
        before, now = before[unmoved], now[unmoved]
        at_px[now], at_m[now] = self._px[before], self._since_m[before]
        self._ids, self._px, self._since_m = ids, at_px, at_m
        path_m = self._path_m - at_m
        fixed = self._road_flow_px(px, ground, path_m) > cfg.road_px
        below = self._road_flow_px(px, ground, np.full(len(px), cfg.judged_m)) > cfg.road_px
        self._stretch.update(ids, px, below)
        stood = np.isin(ids, self._stretch.stood) & (driven_m is None)
        fixed |= stood & below
        limit = max(cfg.on_threshold, cfg.on_threshold_share * int(below.sum())) * (0.5 if self.present else 1.0)
        self.present = int(fixed.sum()) >= limit
        if self.present:
            fixed |= stood | (self._road_flow_px(px, ground, path_m, 1.0 / cfg.far_m) > cfg.far_px)
        return fixed

    def _road_flow_px(self, px: Floats, ground: GroundPlane, path_m: Floats, min_inverse_depth: float = 0.0) -> Floats:
        """(N,) optical flow of the road at pixels (N, 2) over distances (N,) straight ahead.

        Above the horizon, that of a point at depth `1 / min_inverse_depth` (m).
        """
        cam = self.camera
        rays = rays_cam(cam, px)
        inverse_depth = -(rays @ plane_normal(ground.pitch_rad, ground.roll_rad)[0]) / cam.height_m
        from_centre_px = np.hypot(rays[:, 0] * cam.fx_px, (rays[:, 1] + np.tan(ground.pitch_rad)) * cam.fy_px)
        nearer = path_m * np.maximum(inverse_depth, min_inverse_depth)
        out: Floats = from_centre_px * nearer / np.maximum(1.0 - nearer, 0.1)
        return out
