"""Rolling shutter: the readout time of each pixel, and the correction of its position to the image time.

The image time is the readout time of the middle row. The camera velocity is assumed constant during one readout
(Hedborg et al., "Rolling shutter bundle adjustment", CVPR 2012).
"""

from __future__ import annotations

import cv2
import numpy as np

from birdslam.geometry.arrays import Floats
from birdslam.geometry.camera import Camera

_CELL_PX = 8  # of the lookup table of rows
_MIN_DEPTH_RATIO = 0.05  # depth after the motion during the readout over the depth before
_FIXED_POINT_ITERATIONS = 2  # for the row in which a moving point is read
Rate = tuple[Floats, Floats]  # camera velocity (3,) per second and angular velocity (3,) rad/s, in camera axes


class RollingShutter:
    """Rolling-shutter correction for undistorted images, in which a sensor row is a curve."""

    def __init__(self, camera: Camera) -> None:
        self.readout_s = camera.readout_s
        self._camera = camera
        self._rows: Floats | None = None
        if camera.readout_s and camera.distortion:
            self._rows = _sensor_row_table(camera)

    def row(self, u: Floats, v: Floats) -> Floats:
        """(N,) sensor row of undistorted pixels (u, v), from -0.5 (first) to 0.5 (last)."""
        if self._rows is None:
            out: Floats = (v + 0.5) / self._camera.height_px - 0.5
            return out
        rows, columns = self._rows.shape
        at = np.clip(v * (1.0 / _CELL_PX) + 0.5, 0, rows - 1).astype(np.int64)
        return self._rows[at, np.clip(u * (1.0 / _CELL_PX) + 0.5, 0, columns - 1).astype(np.int64)]

    def at_middle(self, xy: Floats, inverse_depth: Floats, rate: Rate) -> Floats:
        """Corrects observations `xy` (N, 2) to the readout time of the middle row, for a camera that moves at `rate`.

        `inverse_depth` (N,) is at the observation, in the scale of the rate.
        """
        late_s = self.readout_s * self.row(*self._camera.to_px(xy).T)
        return _project_before(xy, inverse_depth, rate, late_s)

    def as_read(self, xy: Floats, inverse_depth: Floats, rate: Rate) -> Floats:
        """(N, 2) observations of points that are at `xy` (N, 2) at the image time; the inverse of `at_middle`."""
        out = xy
        for _ in range(_FIXED_POINT_ITERATIONS):
            late_s = self.readout_s * self.row(*self._camera.to_px(out).T)
            out = _project_before(xy, inverse_depth, rate, -late_s)
        return out


def _project_before(xy: Floats, inverse_depth: Floats, rate: Rate, for_s: Floats) -> Floats:
    """(N, 2) projections of points into the camera as it was `for_s` (N,) before."""
    rays = np.column_stack([xy, np.ones(len(xy))])
    shift, turn = rate
    q = rays + for_s[:, None] * (inverse_depth[:, None] * shift + np.cross(turn, rays))
    out: Floats = q[:, :2] / np.maximum(q[:, 2:], _MIN_DEPTH_RATIO)
    return out


def _sensor_row_table(camera: Camera) -> Floats:
    """Table of `RollingShutter.row` on a grid of _CELL_PX over the undistorted image."""
    v, u = np.mgrid[: camera.height_px + _CELL_PX : _CELL_PX, : camera.width_px + _CELL_PX : _CELL_PX]
    xy = camera.to_xy(np.column_stack([u.ravel(), v.ravel()]).astype(np.float64))
    lens = np.array(camera.distortion)
    if camera.fisheye:
        seen = cv2.fisheye.distortPoints(xy[:, None], camera.K, lens)
    else:
        rays = np.column_stack([xy, np.ones(len(xy))])
        seen, _ = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), camera.K, lens)
    row = (np.asarray(seen, np.float64).reshape(-1, 2)[:, 1] + 0.5) / camera.height_px - 0.5
    return np.clip(row, -0.5, 0.5).reshape(u.shape)
