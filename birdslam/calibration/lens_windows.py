"""Windows of a drive for the lens calibration: selection of images and corners, and initial values."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from birdslam.calibration.lens_adjustment import FIXED_SIGMA, IMAGES, LensProblem
from birdslam.geometry.camera import Camera
from birdslam.geometry.pose import rotation_log
from birdslam.odometry.corners.feature_tracks import FeatureConfig, FeatureTracker
from birdslam.odometry.road.points import outside
from birdslam.odometry.working_resolution import WorkingResolution

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

# Share of corners that moved by a step from one image of a window to the next; the second for short drives and for wide
# lenses, which soon lose near corners
_MIN_MOVED_RATIO, _MIN_MOVED_RATIO_WIDE = 0.4, 0.15
_STEPS_RAD = (0.016, _MIN_MOVED_RATIO), (0.012, _MIN_MOVED_RATIO), (0.012, _MIN_MOVED_RATIO_WIDE)
_MIN_MOTION_RAD = 0.003  # min. motion over a window; slower corners are far away or on the windscreen or bonnet
_MAX_WINDOWS = 40
_MIN_WINDOWS = 4
_MIN_CORNERS = 20  # per window
_MAX_CORNERS = 100
_NEAR_CORNERS = 60  # of these, near ones in `select_near_windows`
_MAX_RESIDUAL_PX = 1.5  # outlier limit of the initial poses, in pixels of a lens of FOCAL_PX
FOCAL_PX = 720.0
_MAX_TURN_RAD = 0.8  # of a window
_MAX_DISTANCE = 80.0  # of a corner with initial values, in baselines of its window
_MAX_ANGLE_RAD = 1.45  # max. angle of a corner from the axis
_MAX_GAP_S = 1.0
_STARTS = 100  # windows tried where the car moves too little up to the end of the drive: else the search is quadratic


@dataclass(frozen=True)
class CornersOfImage:
    """Tracked corners of one raw image: ids (N,) ascending, px (N, 2); `t_s` is the readout time of its middle row."""

    ids: Ints
    px: Floats
    t_s: float = 0.0


def track_corners(
    images: Iterable[tuple[NDArray[np.uint8], Floats | None, float]], camera: Camera
) -> list[CornersOfImage]:
    """Tracks corners through raw images, given with the boxes (B, 4) of vehicles, None if not detected, and time in s.

    Corners are left out that are in a box of their image, or of the detections before and after it. No corner continues
    after a gap in time. `camera` needs the image size and an approximate focal length only.
    """
    tracked: list[CornersOfImage] = []
    detected: list[Floats | None] = []
    resolution = WorkingResolution(camera)
    tracker = FeatureTracker(resolution.camera.width_px, resolution.camera.height_px, FeatureConfig())
    for image, boxes_px, t_s in images:
        if tracked and not 0.0 <= t_s - tracked[-1].t_s <= _MAX_GAP_S:
            tracker.drop_reference()
        tracks = tracker.track(resolution.image(image))
        tracker.accept(tracks)
        tracked.append(CornersOfImage(tracks.ids, tracks.px, t_s))
        detected.append(None if boxes_px is None else resolution.boxes_px(boxes_px))
    out: list[CornersOfImage] = []
    for corners, before, after in zip(tracked, _last(detected), _last(detected[::-1])[::-1], strict=True):
        boxes = [boxes_px for boxes_px in (before, after) if boxes_px is not None]
        static = outside(corners.px, np.concatenate(boxes or [np.zeros((0, 4))]))
        out.append(CornersOfImage(corners.ids[static], resolution.original_px(corners.px[static]), corners.t_s))
    return out


def _last(detected: Sequence[Floats | None]) -> list[Floats | None]:
    """The last detection up to each image."""
    last, out = None, list[Floats | None]()
    for boxes_px in detected:
        last = last if boxes_px is None else boxes_px
        out.append(last)
    return out


@dataclass(frozen=True)
class Window:
    """Corners visible in all images of a window: px (IMAGES, N, 2) from the image centre; image times (IMAGES,).

    `row` (IMAGES, N): row of the observation, -0.5 first to 0.5 last.
    """

    px: Floats
    row: Floats
    t_s: Floats


def select_windows(images: Sequence[CornersOfImage], middle: Floats, focal_px: float) -> list[Window]:
    """Windows of a drive; `middle` (2,) is the image centre; the focal length is approximate."""
    windows: list[Window] = []
    for step_rad, share in _STEPS_RAD:
        if len(windows) < 2 * _MIN_WINDOWS:
            windows = _select_apart(images, middle, step_rad * focal_px, share)
    return windows


def select_near_windows(images: Sequence[CornersOfImage], middle: Floats, focal_px: float) -> list[Window]:
    """Like `select_windows`, with images so close that they share the nearest corners."""
    step_rad, share = _STEPS_RAD[-1]
    return _select_apart(images, middle, step_rad * focal_px, share, nearest=True)


def _select_apart(
    images: Sequence[CornersOfImage], middle: Floats, step_px: float, share: float, nearest: bool = False
) -> list[Window]:
    """Windows of images between which a share of the corners moved by a step."""
    found, first = [], 0
    while first < len(images) - IMAGES:
        at = [first]
        for k in range(first + 1, len(images)):
            moved = _flow_px(images[at[-1]], images[k])
            if len(moved) < _MIN_CORNERS:
                break
            if _share_moved(moved, step_px, share):
                at.append(k)
            if len(at) == IMAGES:
                break
        else:
            first += 1 + (len(images) - first) // _STARTS
            continue
        if len(at) < IMAGES:
            first += 1
            continue
        window = _common_corners(images, at, middle, step_px / _STEPS_RAD[0][0] * _MIN_MOTION_RAD, nearest)
        if window is not None:
            found.append(window)
        first = at[IMAGES // 2]
    keep = np.unique(np.linspace(0, len(found) - 1, min(len(found), _MAX_WINDOWS)).round().astype(int))
    return [found[k] for k in keep]


def _flow_px(a: CornersOfImage, b: CornersOfImage) -> Floats:
    """(N,) displacement of the corners common to both images."""
    in_b = np.searchsorted(b.ids, a.ids)
    in_b[in_b == len(b.ids)] = 0
    common = b.ids[in_b] == a.ids if len(b.ids) else np.zeros(len(a.ids), bool)
    out: Floats = np.linalg.norm(b.px[in_b[common]] - a.px[common], axis=1)
    return out


def _share_moved(moved_px: Floats, step_px: float, share: float) -> bool:
    """Whether this share of the corners moved by more than a step. The count decides most cases without sorting."""
    above = int(np.count_nonzero(moved_px > step_px))
    return above >= math.floor(share * (len(moved_px) - 1)) and bool(np.quantile(moved_px, 1.0 - share) > step_px)


def _common_corners(
    images: Sequence[CornersOfImage], at: Sequence[int], middle: Floats, fixed_px: float, nearest: bool
) -> Window | None:
    ids = images[at[0]].ids
    for k in at[1:]:
        ids = np.intersect1d(ids, images[k].ids, assume_unique=True)
    first, last = (images[k].px[np.searchsorted(images[k].ids, ids)] for k in (at[0], at[-1]))
    moved = np.linalg.norm(last - first, axis=1)
    ids, moved = ids[moved > fixed_px], moved[moved > fixed_px]
    if len(ids) < _MIN_CORNERS:
        return None
    if len(ids) > _MAX_CORNERS:  # evenly over the ids, which cover all parts of the image
        some = np.linspace(0, len(ids) - 1, _MAX_CORNERS).astype(int)
        if nearest:  # the corners with the largest motion, and others that constrain the rotation
            order = np.argsort(-moved, kind="stable")
            least = np.linspace(_NEAR_CORNERS, len(ids) - 1, _MAX_CORNERS - _NEAR_CORNERS).astype(int)
            some = np.sort(np.concatenate([order[:_NEAR_CORNERS], order[least]]))
        ids = ids[some]
    px = np.array([images[k].px[np.searchsorted(images[k].ids, ids)] - middle for k in at])
    rows = px[..., 1] / (2.0 * middle[1] + 1.0)
    return Window(px, rows, np.array([images[k].t_s for k in at]))


def _undistort(px: Floats, focal_px: float, k1: float, fisheye: bool) -> Floats:
    """(..., 2) normalised coordinates of pixels from the centre, by fixed-point iteration."""
    distorted = px / focal_px
    radius = np.maximum(np.sqrt(np.square(distorted).sum(axis=-1, keepdims=True)), 1e-9)
    found = radius
    for _ in range(8):
        found = radius / np.maximum(1.0 + k1 * np.square(found), 0.3)
    out: Floats = distorted / radius * (np.tan(np.minimum(found, _MAX_ANGLE_RAD)) if fisheye else found)
    return out


def initialize(
    windows: Sequence[Window],
    focal_px: float,
    k1: float,
    sigma_px: float,
    fisheye: bool,
    k1_prior: tuple[float, float],
    readout_prior: tuple[float, float] = (0.0, FIXED_SIGMA),
) -> LensProblem | None:
    """Initial poses and corners of each window: from its first and last image, then resection of the others."""
    px, row, t_s, of, corner = [], [], [], [], []
    R: list[Floats] = []
    t: list[Floats] = []
    for window in windows:
        started = _initialize_window(_undistort(window.px, focal_px, k1, fisheye))
        if started is None:
            continue
        keep, R_w, t_w, corner_w = started
        px.append(window.px[:, keep].transpose(1, 0, 2))
        row.append(window.row[:, keep].T)
        t_s.append(window.t_s)
        of.append(np.full(int(keep.sum()), len(R)))
        R.append(R_w)
        t.append(t_w)
        corner.append(corner_w)
    if len(R) < _MIN_WINDOWS:
        return None
    return LensProblem(
        np.concatenate(px),
        np.concatenate(row),
        np.concatenate(of),
        np.array(t_s),
        np.array(R),
        np.array(t),
        np.concatenate(corner),
        math.log(focal_px),
        k1,
        sigma_px,
        fisheye,
        k1_prior,
        readout_prior[0],
        readout_prior,
    )


def _initialize_window(xy: Floats) -> tuple[NDArray[np.bool_], Floats, Floats, Floats] | None:
    """Initial values from (IMAGES, N, 2) normalised coordinates: usable corners, poses, and corners (N', 3)."""
    cv2.setRNGSeed(1)
    first, last = xy[0], xy[-1]
    E, inliers = cv2.findEssentialMat(first, last, np.eye(3), cv2.USAC_MAGSAC, 0.999, _MAX_RESIDUAL_PX / FOCAL_PX, 500)
    if E is None or E.shape != (3, 3) or inliers is None:
        return None
    _, R, t, _, _ = cv2.recoverPose(E, first, last, cameraMatrix=np.eye(3), distanceThresh=1e5, mask=inliers.copy())
    turn: Floats = np.asarray(R, np.float64)
    R, t = turn, np.asarray(t, np.float64).ravel()
    if abs(t[2]) < 0.5 or np.linalg.norm(rotation_log(turn)) > _MAX_TURN_RAD:  # implausible for a car
        return None
    P = np.hstack([R, t[:, None]])
    X = cv2.triangulatePoints(np.eye(3, 4), P, first.T, last.T)
    with np.errstate(divide="ignore", invalid="ignore"):
        X = (X[:3] / X[3]).T
    ahead = (X[:, 2] > 0.1) & (X[:, 2] < _MAX_DISTANCE) & ((X @ R.T + t)[:, 2] > 0.1)
    keep = np.asarray((inliers.ravel() > 0) & ahead & np.isfinite(X).all(axis=1))
    if keep.sum() < _MIN_CORNERS:
        return None
    poses_R, poses_t = [np.eye(3)], [np.zeros(3)]
    for seen in xy[1:-1]:
        found, turned, place, _ = cv2.solvePnPRansac(
            X[keep], seen[keep], np.eye(3), np.zeros(4), reprojectionError=2.0 * _MAX_RESIDUAL_PX / FOCAL_PX,
            iterationsCount=50,
        )  # fmt: skip
        if not found:
            return None
        poses_R.append(np.asarray(cv2.Rodrigues(turned)[0], np.float64))
        poses_t.append(np.asarray(place, np.float64).ravel())
    by_z = 1.0 / X[keep, 2]
    corner = np.column_stack([X[keep, 0] * by_z, X[keep, 1] * by_z, by_z])
    return keep, np.array([*poses_R, R]), np.array([*poses_t, t]), corner
