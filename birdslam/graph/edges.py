"""The valid pose edges of one frame (Eq. 6)."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import chain

import numpy as np

from birdslam.geometry.arrays import Complexes, Floats
from birdslam.geometry.se2 import SE2
from birdslam.types import EgoEdge, Measurements, MotionEdge, VehicleEdge

MAX_M = 1e5  # maximum length and variance of a valid edge
_MIN_COV = 1e-12


@dataclass(slots=True)
class PoseEdges:
    """The CC, CV and VV edges of Eq. 6 that end in a frame; of CV and VV one for each vehicle."""

    cc: EgoEdge | None
    cv: list[VehicleEdge]
    vv: list[MotionEdge]
    vv_numbers: Floats  # (k, 12) of each VV edge: x_m, y_m, yaw_rad and the covariance, row-major


@dataclass(slots=True)
class CvEdges:
    """CV edges of the newest frame to k vehicles that the window has, in ego."""

    rows: list[int]  # of the vehicles in the window
    at: Complexes  # (k,) the measured places
    heading: Complexes  # (k,)
    covs: Floats  # (k, 3, 3)
    factors: Floats  # (k, 2, 2) of the places' covariances, by the lines of sight: lasting_error.py
    sigma_rel: Floats  # (k, 2) 1-sigma of the places along and across the lines of sight, fractions of the distance


@dataclass(slots=True)
class VvEdges:
    """VV edges from the newest poses of k vehicles in the window to the newest frame."""

    rows: list[int]  # of the vehicles in the window
    dt_s: Floats  # (k,) the intervals that the edges span
    at: Complexes  # (k,) T_from_to
    yaw_rad: Floats  # (k,)
    covs: Floats  # (k, 3, 3) in the axes of the measured poses


def pose_edges(m: Measurements) -> PoseEdges:
    """Returns one CV and one VV edge for each vehicle (the last one of the record).

    Invalid edges are left out: a matrix that is no covariance, or a length beyond MAX_M.
    """
    frame, cc = m.frame_id, m.cc
    cv = [*{e.vehicle: e for e in m.cv if e.frame == frame}.values()]
    vv = [*{e.vehicle: e for e in m.vv if e.to_frame == frame}.values()]
    cv = [e for e in cv if _is_valid(e.T_ego_vehicle, e.cov)]
    vv = [e for e in vv if _is_valid(e.T_from_to, e.cov)]
    return PoseEdges(
        cc if cc is not None and _is_valid(cc.T_from_to, cc.cov) else None,
        cv,
        vv,
        _numbers([part for e in vv for T in (e.T_from_to,) for part in ((T.x_m, T.y_m, T.yaw_rad), e.cov)]),
    )


def _numbers(parts: list[tuple[float, ...]]) -> Floats:
    return np.fromiter(chain.from_iterable(parts), np.float64, 6 * len(parts)).reshape(-1, 12)


def _is_valid(T: SE2, cov: tuple[float, ...]) -> bool:
    """Whether a pose is within MAX_M and its covariance symmetric and positive semidefinite."""
    if not (abs(T.x_m) <= MAX_M and abs(T.y_m) <= MAX_M and abs(T.yaw_rad) <= MAX_M):
        return False
    xx, xy, xt, yx, yy, yt, tx, ty, tt = cov
    if xy == yx and xt == tx and yt == ty and 0.0 < xx <= MAX_M and 0.0 < yy <= MAX_M and 0.0 < tt <= MAX_M:
        det = xx * yy - xy * xy  # Sylvester: all leading minors are positive
        if det > 0.0 and tt * det > xx * yt * yt - 2.0 * xy * xt * yt + yy * xt * xt:
            return True
    if max(map(abs, cov)) > MAX_M:
        return False
    P = np.reshape(cov, (3, 3))
    return bool(np.linalg.eigvalsh(0.5 * (P + P.T))[0] >= -_MIN_COV)
