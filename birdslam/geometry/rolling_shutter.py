"""Rows that are read one after the other: when each pixel of an image was read, and where its point was at one time.

An image is said to be of the time when its middle row was read. A point that is read later or earlier has moved in the
meantime: its place then and its place at the image's time differ by the camera's own motion (Hedborg et al., "Rolling
shutter bundle adjustment", CVPR 2012), which is constant while one image is read.
"""

from __future__ import annotations

import cv2
import numpy as np

from birdslam.geometry.arrays import Floats
from birdslam.geometry.camera import Camera

_CELL_PX = 8  # of the table of rows: a lens bends a row by far less within it
_MIN_DISTANCE = 0.05  # of a depth that a motion while an image is read would leave, as a share of it
_ROUNDS = 2  # by which the row is found that a point is read in
Rate = tuple[Floats, Floats]  # (3,) a second and (3,) rad/s of the camera, in its own axes


class RollingShutter:
    """Of one camera, whose images are undistorted: what was a row of the sensor is a bent line there."""

    def __init__(self, camera: Camera) -> None:
        self.readout_s = camera.readout_s
        self._camera = camera
        self._rows: Floats | None = None
        if camera.readout_s and camera.distortion:
            self._rows = _rows_of_sensor(camera)

    def row(self, u: Floats, v: Floats) -> Floats:
        """Which row of the sensor pixels (u, v) of the undistorted image were read in: -0.5 the first, 0.5 the last."""
        if self._rows is None:
            out: Floats = (v + 0.5) / self._camera.height_px - 0.5
            return out
        rows, columns = self._rows.shape
        at = np.clip(v * (1.0 / _CELL_PX) + 0.5, 0, rows - 1).astype(np.int64)
        return self._rows[at, np.clip(u * (1.0 / _CELL_PX) + 0.5, 0, columns - 1).astype(np.int64)]

    def at_middle(self, xy: Floats, inverse_depth: Floats, rate: Rate) -> Floats:
        """(N, 2) where points seen at `xy` (N, 2) were when the middle row was read; the camera moves at `rate`.

        `inverse_depth` (N,) is theirs as seen, in the rate's scale.
        """
        late_s = self.readout_s * self.row(*self._camera.to_px(xy).T)
        return _moved(xy, inverse_depth, rate, late_s)

    def as_read(self, xy: Floats, inverse_depth: Floats, rate: Rate) -> Floats:
        """(N, 2) where points are read that were at `xy` (N, 2) when the middle row was; the inverse of `at_middle`."""
        out = xy
        for _ in range(_ROUNDS):
            late_s = self.readout_s * self.row(*self._camera.to_px(out).T)
            out = _moved(xy, inverse_depth, rate, -late_s)
        return out


def _moved(xy: Floats, inverse_depth: Floats, rate: Rate, for_s: Floats) -> Floats:
    """(N, 2) of points as a camera sees them that stands where it was `for_s` (N,) before."""
    rays = np.column_stack([xy, np.ones(len(xy))])
    shift, turn = rate
    q = rays + for_s[:, None] * (inverse_depth[:, None] * shift + np.cross(turn, rays))
    out: Floats = q[:, :2] / np.maximum(q[:, 2:], _MIN_DISTANCE)
    return out


def _rows_of_sensor(camera: Camera) -> Floats:
    """`RollingShutter.row` at every eighth pixel of the undistorted image."""
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
