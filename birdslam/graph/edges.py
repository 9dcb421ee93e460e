"""The pose edges of one frame (Eq. 6), without those that can't be measurements."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from birdslam.geometry.se2 import SE2
from birdslam.graph.costs import Cov
from birdslam.types import EgoEdge, Measurements, MotionEdge, VehicleEdge

LARGEST_M = 1e5  # an edge that is longer, or less certain, is no measurement
_LEAST_COV = 1e-12


@dataclass(slots=True)
class PoseEdges:
    """The CC, CV and VV edges of Eq. 6 that end in a frame; of CV and VV one for each vehicle."""

    cc: EgoEdge | None
    cv: list[VehicleEdge]
    vv: list[MotionEdge]


class CvEdge(NamedTuple):
    """A CV edge of the newest frame to a vehicle that the window has."""

    row: int  # of the vehicle in the window
    at: complex  # the measured place, in ego
    heading: complex
    cov: Cov  # in ego


class VvEdge(NamedTuple):
    """A VV edge from the newest pose of a vehicle in the window to the newest frame."""

    row: int  # of the vehicle in the window
    dt_s: float  # the interval that the edge spans
    motion: SE2  # T_from_to
    cov: Cov  # in the axes of the measured pose


def pose_edges(m: Measurements) -> PoseEdges:
    """One CV and one VV edge for each vehicle (the last one counts).

    What can't be a measurement is left out: a matrix that is no covariance, a length that is not of this world.
    """
    frame, cc = m.frame_id, m.cc
    cv = {e.vehicle: e for e in m.cv if e.frame == frame}.values()
    vv = {e.vehicle: e for e in m.vv if e.to_frame == frame}.values()
    return PoseEdges(
        cc if cc is not None and _is_valid(cc.T_from_to, cc.cov) else None,
        [e for e in cv if _is_valid(e.T_ego_vehicle, e.cov)],
        [e for e in vv if _is_valid(e.T_from_to, e.cov)],
    )


def _is_valid(T: SE2, cov: tuple[float, ...]) -> bool:
    """Whether a pose of this world was measured, with a covariance: symmetric, without a negative eigenvalue."""
    if not (abs(T.x_m) <= LARGEST_M and abs(T.y_m) <= LARGEST_M and abs(T.yaw_rad) <= LARGEST_M):
        return False
    xx, xy, xt, yx, yy, yt, tx, ty, tt = cov
    if xy == yx and xt == tx and yt == ty and 0.0 < xx <= LARGEST_M and 0.0 < yy <= LARGEST_M and 0.0 < tt <= LARGEST_M:
        det = xx * yy - xy * xy  # Sylvester: all leading minors are positive
        if det > 0.0 and tt * det > xx * yt * yt - 2.0 * xy * xt * yt + yy * xt * xt:
            return True
    if max(map(abs, cov)) > LARGEST_M:
        return False
    P = np.reshape(cov, (3, 3))
    return bool(np.linalg.eigvalsh(0.5 * (P + P.T))[0] >= -_LEAST_COV)
