"""What CP edges of a log err by: what the landmarks of a frame have in common, and what each has of its own.

Real landmarks lie on a road that is no plane, over a tilt that is not exact: in each frame they err together as if the
camera's pitch and roll were others, for as long as that stretch of road is in sight. Least squares over a whole log,
with the ego's true motion, finds these two of each frame beside where each landmark is.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import msgspec
import numpy as np
from scipy.sparse import csc_matrix, diags
from scipy.sparse.linalg import spsolve

from birdslam.geometry.arrays import Bools, Floats
from birdslam.geometry.camera import Camera
from birdslam.geometry.se2 import SE2
from birdslam.types import LandmarkKind, Measurements

LEAST_SIGHTS = 3  # of a landmark in a log, and of landmarks in a frame
LEAST_FRAMES = 30
LATER = 4  # frames: from one key frame to the next
# 1-sigma of what is solved for, before anything is seen: pitch and roll of a frame, and the angle of the poses' axes
PRIOR_PITCH_RAD, PRIOR_ROLL_RAD, PRIOR_AXES_RAD = 0.01, 0.015, 0.02
PRIOR_PX = 1.0  # of a landmark's own error
HUBER_SIGMA, ROUNDS, NORMAL = 2.0, 8, 1.4826  # a robust fit; sigma of a normal error over the median of its size


class LandmarkErrors(msgspec.Struct, frozen=True, kw_only=True):
    """Angles of the camera over the road as landmarks see them, less those by which they were placed."""

    frames: int
    pitch_mrad: float  # root mean square
    pitch_later: float  # its correlation with that of LATER frames on
    roll_mrad: float
    roll_later: float
    own_px: float  # 1-sigma of what is left, along the image's column


def landmark_errors(log: Sequence[Measurements], ego: Mapping[int, SE2], camera: Camera) -> LandmarkErrors | None:
    """Of one log, whose true poses `ego` has by frame id; None with fewer than LEAST_FRAMES frames that tell."""
    sights: dict[int, list[tuple[int, float, float]]] = {}
    for row, m in enumerate(log):
        for edge in m.cp:
            if edge.kind is LandmarkKind.ROAD_POINT:
                sights.setdefault(edge.landmark, []).append((row, edge.x_m, edge.y_m))
    tracks = [track for track in sights.values() if len(track) >= LEAST_SIGHTS]
    seen = np.bincount([row for track in tracks for row, _, _ in track], minlength=len(log)) >= LEAST_SIGHTS
    if seen.sum() < LEAST_FRAMES:
        return None
    pitch, roll, own = _solve(tracks, [ego[m.frame_id] for m in log], camera)
    return LandmarkErrors(
        frames=int(seen.sum()),
        pitch_mrad=1e3 * _rms(pitch[seen]),
        pitch_later=_later(pitch, seen),
        roll_mrad=1e3 * _rms(roll[seen]),
        roll_later=_later(roll, seen),
        own_px=own * PRIOR_PX,
    )


def _solve(
    tracks: Sequence[Sequence[tuple[int, float, float]]], ego: Sequence[SE2], camera: Camera
) -> tuple[Floats, Floats, float]:
    """Pitch (N,) and roll (N,) by frame, and the sigma of what is left in PRIOR_PX.

    Unknowns: those, the angle of the poses' axes, then each landmark's place in the ego of its first sight. A point at
    (x, y) that is placed with a pitch and a roll too large by (e, r) is at (x, y) + e (x^2 + h^2, x y) / h
    + r (x y, y^2 + h^2) / h: the derivatives of Eq. 1.
    """
    n, h, f_px = len(ego), camera.height_m, float(camera.K[1, 1])
    axes, first = 2 * n, 2 * n + 1
    entries: list[tuple[int, int, float]] = []
    goals: list[float] = []

    def equation(terms: Sequence[tuple[int, float]], goal: float, sigma: float) -> None:
        entries.extend((len(goals), column, value / sigma) for column, value in terms)
        goals.append(goal / sigma)

    for k, track in enumerate(tracks):
        origin = ego[track[0][0]]
        for row, x, y in track:
            T = ego[row].between(origin)
            R, place = T.rotation(), first + 2 * k
            sigma_x, sigma_y = PRIOR_PX * (x * x + h * h) / (f_px * h), PRIOR_PX * math.hypot(x, x * y / h) / f_px
            of_x = (row, (x * x + h * h) / h), (n + row, x * y / h), (axes, -T.y_m)
            of_y = (row, x * y / h), (n + row, (y * y + h * h) / h), (axes, T.x_m)
            equation([(place, R[0, 0]), (place + 1, R[0, 1]), *of_x], x - T.x_m, sigma_x)
            equation([(place, R[1, 0]), (place + 1, R[1, 1]), *of_y], y - T.y_m, sigma_y)
    measured = len(goals)
    priors = [(PRIOR_PITCH_RAD, range(n)), (PRIOR_ROLL_RAD, range(n, axes)), (PRIOR_AXES_RAD, [axes])]
    for sigma, columns in priors:
        for column in columns:
            equation([(column, 1.0)], 0.0, sigma)
    rows, columns_of, values = (np.array(part) for part in zip(*entries, strict=True))
    A = csc_matrix((values, (rows, columns_of)), shape=(len(goals), first + 2 * len(tracks)))
    b, weights = np.array(goals), np.ones(len(goals))
    left = np.zeros(measured)
    for _ in range(ROUNDS):
        weighted = A.T @ diags(weights)
        found = spsolve((weighted @ A).tocsc(), weighted @ b)
        left = np.abs(A @ found - b)[:measured]
        limit = HUBER_SIGMA * NORMAL * float(np.median(left))
        weights[:measured] = np.minimum(1.0, limit / np.maximum(left, 1e-12))
    return found[:n].copy(), found[n:axes].copy(), NORMAL * float(np.median(left[::2]))


def _rms(x: Floats) -> float:
    return math.sqrt(float(np.mean(x * x)))


def _later(x: Floats, seen: Bools) -> float:
    both = seen[:-LATER] & seen[LATER:]
    if not both.any():
        return math.nan
    return float(np.mean(x[:-LATER][both] * x[LATER:][both])) / max(_rms(x[seen]) ** 2, 1e-12)
