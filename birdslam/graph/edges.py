"""The pose edges of one frame as arrays, without those that can't be measurements."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from birdslam.types import EgoEdge, Measurements, MotionEdge, VehicleEdge

Floats = NDArray[np.float64]

LARGEST_M = 1e5  # an edge that is longer, or less certain, is no measurement
_LEAST_COV = 1e-12 * np.eye(3)


@dataclass(slots=True)
class PoseEdges:
    """The CC, CV and VV edges of Eq. 6 that end in a frame, in that order: poses (n, 3), covariances (n, 3, 3)."""

    cc: EgoEdge | None
    cv: list[VehicleEdge]
    vv: list[MotionEdge]
    poses: Floats
    covs: Floats

    @property
    def cv_at(self) -> slice:
        """Where the CV edges stand in the arrays."""
        first = 0 if self.cc is None else 1
        return slice(first, first + len(self.cv))

    @property
    def vv_at(self) -> slice:
        """Where the VV edges stand in the arrays."""
        return slice(len(self.poses) - len(self.vv), len(self.poses))

    def some(self, at: slice, which: list[int]) -> tuple[Floats, Floats]:
        """The poses and covariances of some of the edges that stand `at` a slice of the arrays."""
        poses, covs = self.poses[at], self.covs[at]
        return (poses, covs) if len(which) == len(poses) else (poses[which], covs[which])


def pose_edges(m: Measurements) -> PoseEdges:
    """One CV and one VV edge for each vehicle (the last one counts).

    What can't be a measurement is left out: a matrix that is no covariance, a length that is not of this world.
    """
    frame, cc = m.frame_id, m.cc
    cv = list({e.vehicle: e for e in m.cv if e.frame == frame}.values())
    vv = list({e.vehicle: e for e in m.vv if e.to_frame == frame}.values())
    transforms = [e.T_ego_vehicle for e in cv]
    numbers = [e.cov for e in cv]
    if vv:
        transforms += [e.T_from_to for e in vv]
        numbers += [e.cov for e in vv]
    if cc is not None:
        transforms, numbers = [cc.T_from_to, *transforms], [cc.cov, *numbers]
    flat = [(T.x_m, T.y_m, T.yaw_rad, *cov) for T, cov in zip(transforms, numbers, strict=True)]
    table = np.array(flat, dtype=np.float64).reshape(-1, 12)
    poses, covs = table[:, :3], table[:, 3:].reshape(-1, 3, 3)
    edges = PoseEdges(cc, cv, vv, poses, covs)
    if np.abs(table).max(initial=0.0) > LARGEST_M:
        return _sound(edges)
    try:
        np.linalg.cholesky(covs + _LEAST_COV)
    except np.linalg.LinAlgError:
        return _sound(edges)
    return edges


def _sound(edges: PoseEdges) -> PoseEdges:
    covs = 0.5 * np.clip(edges.covs, -LARGEST_M, LARGEST_M)
    covs = covs + covs.transpose(0, 2, 1)
    good = np.abs(edges.poses).max(axis=1) <= LARGEST_M
    good &= np.abs(edges.covs).max(axis=(1, 2)) <= LARGEST_M
    good &= np.linalg.eigvalsh(covs).min(axis=1) >= -_LEAST_COV[0, 0]
    keep = good.tolist()
    return PoseEdges(
        edges.cc if keep and keep[0] else None,
        [e for e, sound in zip(edges.cv, keep[edges.cv_at], strict=True) if sound],
        [e for e, sound in zip(edges.vv, keep[edges.vv_at], strict=True) if sound],
        edges.poses[good],
        edges.covs[good],
    )
