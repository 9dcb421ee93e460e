"""Corners that stand still in the image while the car drives: on dirt, drops or reflections of the windscreen, bonnets.

They agree with one another perfectly, are never lost, and say that the camera neither turns nor comes nearer to
anything, so that after some seconds they outvote the street. A corner of the street that lies below the horizon cannot
stand: the road behind it is the farthest that it can be, and the way of the car says how far the road's image has moved
there at the least. Above the horizon nothing tells dirt from what is far away. So, where enough of those below the
horizon stand, the glass is not clean, and whatever stands is left out, above the horizon too.
"""

from __future__ import annotations

from typing import Annotated

import msgspec
import numpy as np
from numpy.typing import NDArray

from birdslam.geometry.bev import rays_cam
from birdslam.geometry.camera import Camera, GroundPlane
from birdslam.odometry.corners.sliding_window import common
from birdslam.odometry.road.alignment import plane_normal

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]
Positive = Annotated[float, msgspec.Meta(gt=0.0)]
Count = Annotated[int, msgspec.Meta(ge=1)]


class StandingCornersConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """When a corner stands, and how many make the glass a dirty one. By judgement, tried on the shipped drive's street
    with dirt, drops and reflections; on KITTI 00, 01, 06 and 0005 no corner is left out."""

    still_px: Positive = 1.0  # a corner that is farther from where it was has moved
    road_px: Positive = 15.0  # the road's image has moved so far there meanwhile
    begins_at: Count = 6  # so many that stand below the horizon
    begins_at_share: Annotated[float, msgspec.Meta(gt=0.0, le=1.0)] = 0.15  # and this part of those below it
    judged_m: Positive = 2.0  # those below it are the ones that the road would move so far over this way
    far_m: Positive = 120.0  # above the horizon, where the glass is dirty: most of what has corners is nearer
    far_px: Positive = 3.0  # ... and has moved so far meanwhile, if it stands in the street


class StandingCorners:
    """State: where each corner was when it last moved, and the way since. Reader: `Odometry`, which corners to use."""

    def __init__(self, camera: Camera, config: StandingCornersConfig) -> None:
        self.camera, self.config = camera, config
        self._ids: Ints = np.zeros(0, np.int64)
        self._px: Floats = np.zeros((0, 2))
        self._at_m: Floats = np.zeros(0)
        self._way_m = 0.0
        self.present = False

    def see(self, ids: Ints, px: Floats, ground: GroundPlane, driven_m: float) -> Bools:
        """(N,) which corners of the present image stand on the glass; ids (N,) ascending, px (N, 2).

        `driven_m` is the car's way since the image before.
        """
        cfg = self.config
        self._way_m += driven_m
        at_px, at_m = px.copy(), np.full(len(ids), self._way_m)
        before, now = common(self._ids, ids)
        stood = np.square(px[now] - self._px[before]).sum(axis=1) < cfg.still_px**2
        before, now = before[stood], now[stood]
        at_px[now], at_m[now] = self._px[before], self._at_m[before]
        self._ids, self._px, self._at_m = ids, at_px, at_m
        way_m = self._way_m - at_m
        stands = self._moves_px(px, ground, way_m) > cfg.road_px
        below = int((self._moves_px(px, ground, np.full(len(px), cfg.judged_m)) > cfg.road_px).sum())
        few = max(cfg.begins_at, cfg.begins_at_share * below) * (0.5 if self.present else 1.0)
        self.present = int(stands.sum()) >= few
        if self.present:
            stands |= self._moves_px(px, ground, way_m, 1.0 / cfg.far_m) > cfg.far_px
        return stands

    def _moves_px(self, px: Floats, ground: GroundPlane, way_m: Floats, least_by_depth: float = 0.0) -> Floats:
        """(N,) how far the image of the road moves at a pixel over a way straight on.

        Of what is no road, above the horizon, that of something at `1 / least_by_depth` (m).
        """
        cam = self.camera
        rays = rays_cam(cam, px)
        by_depth = -(rays @ plane_normal(ground.pitch_rad, ground.roll_rad)[0]) / cam.height_m
        from_centre_px = np.hypot(rays[:, 0] * cam.fx_px, (rays[:, 1] + np.tan(ground.pitch_rad)) * cam.fy_px)
        nearer = way_m * np.maximum(by_depth, least_by_depth)
        out: Floats = from_centre_px * nearer / np.maximum(1.0 - nearer, 0.1)
        return out
