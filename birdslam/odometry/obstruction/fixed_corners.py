"""Fixed corners: corners that do not move in the image of a moving car (dirt, drops, reflections, the bonnet).

They are consistent with zero motion and would outvote the street. Below the horizon a static corner moves at least as
far as the road behind it. Above the horizon, unmoved corners are excluded only if enough below it are fixed. While the
scale is unknown, corners that stay while those of the street move are fixed.
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

# Median displacement of the moving corners below the horizon at which unmoved corners are not of the street
_MIN_STREET_FLOW_PX = 6.0


class FixedCornersConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Thresholds of a fixed corner and of a dirty windscreen."""

    still_px: Positive = 1.0  # minimum displacement of a moved corner
    road_px: Positive = 15.0  # minimum flow of the road behind a fixed corner
    on_threshold: Count = 6  # minimum fixed corners below the horizon, for a dirty windscreen
    on_threshold_share: Annotated[float, msgspec.Meta(gt=0.0, le=1.0)] = 0.15  # and their minimum ratio
    judged_m: Positive = 2.0  # distance over which the road below the horizon moves by road_px
    far_m: Positive = 120.0  # assumed depth above the horizon
    far_px: Positive = 3.0  # minimum flow at far_m of a fixed corner


class _FlowInterval:
    """Interval over which the street's corners move by `_MIN_STREET_FLOW_PX`, and the corners that stay meanwhile.

    State: the corners at its start, and the ids of the unmoved ones of the last interval. Reader: `FixedCorners`.
    """

    def __init__(self, still_px: float, min_count: int) -> None:
        self._still_px, self._min_count = still_px, min_count
        self._ids: Ints = np.zeros(0, np.int64)
        self._px: Floats = np.zeros((0, 2))
        self.unmoved_ids: Ints = np.zeros(0, np.int64)

    def start(self, ids: Ints, px: Floats) -> None:
        """Starts an interval at corners ids (N,) ascending, px (N, 2)."""
        self._ids, self._px = ids, px

    @property
    def is_started(self) -> bool:
        """Whether an interval was started."""
        return len(self._ids) > 0

    def update(self, ids: Ints, px: Floats, below: Bools) -> None:
        """Adds the corners of the current image, as in `start`; `below` (N,) marks those below the horizon."""
        a, b = match_ids(self._ids, ids)
        moved_px = np.hypot(*(px[b] - self._px[a]).T)
        street = below[b] & (moved_px > self._still_px)
        if street.sum() >= self._min_count and quantile(moved_px[street], 0.5) > _MIN_STREET_FLOW_PX:
            self.unmoved_ids = ids[b][moved_px < self._still_px]
            self.start(ids, px)
        elif 2 * len(a) <= len(self._ids):  # most were lost
            self.start(ids, px)


class FixedCorners:
    """State: each corner's pixel and the distance travelled when it last moved. Reader: `CornerSelector`."""

    def __init__(self, camera: Camera, config: FixedCornersConfig) -> None:
        self.camera, self.config = camera, config
        self._ids: Ints = np.zeros(0, np.int64)
        self._px: Floats = np.zeros((0, 2))
        self._since_m: Floats = np.zeros(0)
        self._path_m = 0.0
        self._interval = _FlowInterval(config.still_px, config.on_threshold)
        self.present = False

    def start(self, ids: Ints, px: Floats) -> None:
        """Adds the corners of the image before the first `update`."""
        if not self._interval.is_started:
            self._interval.start(ids, px)

    def update(self, ids: Ints, px: Floats, ground: GroundPlane, travelled_m: float | None) -> Bools:
        """(N,) which corners of the current image are fixed; ids (N,) ascending, px (N, 2).

        `travelled_m` is the distance since the previous image; None: unknown.
        """
        cfg = self.config
        self._path_m += travelled_m or 0.0
        at_px, at_m = px.copy(), np.full(len(ids), self._path_m)
        before, now = match_ids(self._ids, ids)
        same = np.square(px[now] - self._px[before]).sum(axis=1) < cfg.still_px**2
        before, now = before[same], now[same]
        at_px[now], at_m[now] = self._px[before], self._since_m[before]
        self._ids, self._px, self._since_m = ids, at_px, at_m
        path_m = self._path_m - at_m
        fixed = self._road_flow_px(px, ground, path_m) > cfg.road_px
        below = self._road_flow_px(px, ground, np.full(len(px), cfg.judged_m)) > cfg.road_px
        self._interval.update(ids, px, below)
        unmoved = np.isin(ids, self._interval.unmoved_ids) & (travelled_m is None)
        fixed |= unmoved & below
        limit = max(cfg.on_threshold, cfg.on_threshold_share * int(below.sum())) * (0.5 if self.present else 1.0)
        self.present = int(fixed.sum()) >= limit
        if self.present:
            fixed |= unmoved | (self._road_flow_px(px, ground, path_m, 1.0 / cfg.far_m) > cfg.far_px)
        return fixed

    def _road_flow_px(self, px: Floats, ground: GroundPlane, path_m: Floats, min_inverse_depth: float = 0.0) -> Floats:
        """(N,) optical flow of the road at pixels (N, 2) over distances (N,) straight ahead.

        Above the horizon it is that of a point at depth `1 / min_inverse_depth` (m).
        """
        cam = self.camera
        rays = rays_cam(cam, px)
        inverse_depth = -(rays @ plane_normal(ground.pitch_rad, ground.roll_rad)[0]) / cam.height_m
        from_centre_px = np.hypot(rays[:, 0] * cam.fx_px, (rays[:, 1] + np.tan(ground.pitch_rad)) * cam.fy_px)
        nearer = path_m * np.maximum(inverse_depth, min_inverse_depth)
        out: Floats = from_centre_px * nearer / np.maximum(1.0 - nearer, 0.1)
        return out
