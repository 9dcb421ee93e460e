"""A search for the length of a motion of known direction: candidate lengths are compared on the road's image.

An alignment (`road/alignment.py`) converges only from within the size of the road's texture. Where nothing is known of
the length, this search gives it a start that is near enough.
"""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import NDArray

from birdslam.geometry.camera import Camera
from birdslam.geometry.pose import Pose
from birdslam.odometry.road.alignment import RoadImage, plane_normal

Floats = NDArray[np.float64]

_STANDS_M = 0.1  # a car that drives so little at a start stands as well as not
_LEAD = 0.1  # of the correlation of what changed as it moves over that as it stands


def search_length(
    camera: Camera,
    past: RoadImage,
    present: RoadImage,
    T_past_present: Pose,
    px: NDArray[np.int64],
    tilt: tuple[float, float],
    lengths: Floats,
) -> float:
    """The one of `lengths` (L,) in metres with the best correlation, on a flat road, over a few pitches about `tilt`.

    `px` (N, 2) are pixels of the present image that show road, `tilt` its (pitch, roll) in rad; only the direction of
    `T_past_present`'s translation counts."""
    px = px[:: max(1, len(px) // 900)]
    tilts = [(pitch_rad, tilt[1]) for pitch_rad in (tilt[0] - 0.01, tilt[0], tilt[0] + 0.01)]
    ways = lengths[:, None] * (T_past_present.p / max(float(np.linalg.norm(T_past_present.p)), 1e-9))

    def alike(changed: bool) -> Floats:
        shown = far_and_changed(past, present, px) if changed else px
        return np.array([correlations(camera, past, present, T_past_present.R, ways, shown, each) for each in tilts])

    return float(lengths[most_alike(alike, lengths)[1]])


def most_alike(alike: Callable[[bool], Floats], lengths: Floats) -> tuple[int, int]:
    """Which pitch and which of `lengths` (L,) ascending, in metres, make two images of the road most alike.

    `alike` gives correlations (pitches, L), of the whole road, or where it is told so of the farther road that
    changed alone. Of a car that stands no length explains what changed. Where one does, what stands is no road: the
    car's own bonnet on the near road, or grain that a video encoder left where it was.
    """
    whole = alike(False)
    pitch, length = np.unravel_index(int(whole.argmax()), whole.shape)
    if lengths[length] < _STANDS_M:
        moved = alike(True)
        moved_pitch, moved_length = np.unravel_index(int(moved.argmax()), moved.shape)
        if moved[moved_pitch, moved_length] > moved[:, lengths < _STANDS_M].max() + _LEAD:
            pitch, length = moved_pitch, moved_length
    return int(pitch), int(length)


def far_and_changed(past: RoadImage, present: RoadImage, px: NDArray[np.int64]) -> NDArray[np.int64]:
    """Of the pixels (N, 2) of the present image's road the farther half, above their median row, and of that the half
    that differs most from the same pixels of the past image."""
    far = px[px[:, 1] < np.median(px[:, 1])]
    then, now = (image.grey[far[:, 1] - image.top_px, far[:, 0]] for image in (past, present))
    change = np.abs(now - then)
    return far[change >= np.median(change)] if len(far) else far


def correlations(
    camera: Camera,
    past: RoadImage,
    present: RoadImage,
    R_past_present: Floats,
    ways: Floats,
    px: NDArray[np.int64],
    tilt: tuple[float, float],
) -> Floats:
    """(L,) correlation of the road's samples (N, 2) with the past image, for each translation of `ways` (L, 3)."""
    f32 = np.float32
    focal_px, centre_px = [camera.fx_px, camera.fy_px], [camera.cx_px, camera.cy_px]
    rays = np.stack([*((px - centre_px) / focal_px).T, np.ones(len(px))]).astype(f32)
    here = present.grey[px[:, 1] - present.top_px, px[:, 0]]
    rho = (plane_normal(*tilt)[0].astype(f32) @ rays) * f32(-1.0 / camera.height_m)
    q = (R_past_present.astype(f32) @ rays)[:, None, :] + ways.astype(f32).T[:, :, None] * rho
    by_z = f32(1.0) / np.maximum(q[2], f32(1e-3))
    u = q[0] * by_z * f32(camera.fx_px) + f32(camera.cx_px)
    v = q[1] * by_z * f32(camera.fy_px) + f32(camera.cy_px - past.top_px)
    rows, cols = past.grey.shape
    inside = ((u > 0) & (u < cols - 1) & (v > 0) & (v < rows - 1)).astype(f32)
    count = np.maximum(inside.sum(axis=1), 1.0)
    a, b = cv2.remap(past.grey, u, v, cv2.INTER_LINEAR) * inside, here * inside
    mean_a, mean_b = a.sum(axis=1) / count, b.sum(axis=1) / count
    ab, aa, bb = (np.einsum("ij,ij->i", *pair) for pair in ((a, b), (a, a), (b, b)))
    variances = (aa - count * mean_a**2) * (bb - count * mean_b**2)
    out: Floats = (ab - count * mean_a * mean_b) / np.sqrt(np.maximum(variances, 1e-9))
    out[count < 0.5 * len(px)] = -1.0  # what leaves the image says nothing
    return out
