"""gtsam's incremental solvers on the edges of `Measurements`: what the pose graph's time is measured against.

ISAM2 is Kaess et al., "iSAM2: Incremental smoothing and mapping using the Bayes tree" (IJRR 2012); the fixed-lag
smoothers are gtsam's.
"""

from __future__ import annotations

from typing import Any

import gtsam
import numpy as np

from birdslam.bench.baselines.posegraph3 import landmark_key
from birdslam.types import LandmarkEdge, Measurements

_PRIOR = gtsam.noiseModel.Isotropic.Sigma(3, 1e-3)
_RELINEARIZE_SKIP = 10


class Smoother:
    """The graph of Eqs. 6 and 7 from records, and its newest poses back.

    A landmark is a node (Point2). "..._qr" is the factorization.
    """

    def __init__(self, kind: str, lag_frames: int) -> None:
        self.kind = kind
        self.lag_frames = lag_frames
        params = gtsam.ISAM2Params()
        params.setFactorization("QR" if kind.endswith("qr") else "CHOLESKY")
        params.relinearizeSkip = 1 if kind == "isam2" else _RELINEARIZE_SKIP
        params.findUnusedFactorSlots = True
        self.solver: Any
        if kind == "isam2":
            self.solver = gtsam.ISAM2(params)
        elif kind == "batch_fixed_lag":
            self.solver = gtsam.BatchFixedLagSmoother(lag_frames)
        else:
            self.solver = gtsam.IncrementalFixedLagSmoother(lag_frames, params)
        self.frame: int | None = None
        self.ego = gtsam.Pose2()
        self.seen: dict[int, int] = {}
        self.landmarks: dict[int, int] = {}  # by key, the frame that each node was last seen in

    def step(self, m: Measurements) -> list[tuple[gtsam.Pose2, Any]]:
        """The newest ego pose and every vehicle's, with their covariances."""
        factors, values, stamps = gtsam.NonlinearFactorGraph(), gtsam.Values(), gtsam.FixedLagSmootherKeyTimestampMap()
        ego = gtsam.symbol("x", m.frame_id)
        if self.frame is None or m.cc is None:
            factors.add(gtsam.PriorFactorPose2(ego, self.ego, _PRIOR))
        else:
            motion = _pose(m.cc.T_from_to)
            factors.add(gtsam.BetweenFactorPose2(gtsam.symbol("x", m.cc.from_frame), ego, motion, _noise(m.cc.cov)))
            self.ego = self.ego.compose(motion)
        values.insert(ego, self.ego)
        stamps.insert((ego, float(m.frame_id)))
        keys = [ego]
        for edge in m.cv:
            key, seen = _vehicle(edge.vehicle, m.frame_id), _pose(edge.T_ego_vehicle)
            factors.add(gtsam.BetweenFactorPose2(ego, key, seen, _noise(edge.cov)))
            values.insert(key, self.ego.compose(seen))
            stamps.insert((key, float(m.frame_id)))
            keys.append(key)
        for link in m.vv:
            if self.frame is not None and self.seen.get(link.vehicle) == link.from_frame == self.frame:
                before, key = _vehicle(link.vehicle, link.from_frame), _vehicle(link.vehicle, m.frame_id)
                factors.add(gtsam.BetweenFactorPose2(before, key, _pose(link.T_from_to), _noise(link.cov)))
        for sight in m.cp:
            key = landmark_key(sight.kind, sight.landmark)
            factors.add(_landmark_factor(ego, key, sight))
            if key not in self.landmarks:
                values.insert(key, self.ego.transformFrom(np.array([sight.x_m, sight.y_m])))
            self.landmarks[key] = m.frame_id
            stamps.insert((key, float(m.frame_id)))
        if self.kind == "isam2":
            self.solver.update(factors, values)
        else:
            self.solver.update(factors, values, stamps)
            oldest = m.frame_id - self.lag_frames
            self.landmarks = {key: frame for key, frame in self.landmarks.items() if frame >= oldest}
        self.frame, self.seen = m.frame_id, {edge.vehicle: m.frame_id for edge in m.cv}
        poses = [self.solver.calculateEstimatePose2(key) for key in keys]
        self.ego = poses[0]
        if self.kind == "batch_fixed_lag":
            return [(pose, None) for pose in poses]
        return [(pose, self.solver.marginalCovariance(key)) for pose, key in zip(poses, keys, strict=True)]

    def between(self) -> None:
        """Nothing to do between frames."""


def _landmark_factor(ego: int, landmark: int, sight: LandmarkEdge) -> gtsam.BearingRangeFactor2D:
    """Eq. 3 by the only factor that gtsam has between a Pose2 and a Point2."""
    range_m, bearing_rad = float(np.hypot(sight.x_m, sight.y_m)), float(np.arctan2(sight.y_m, sight.x_m))
    c, s = np.cos(bearing_rad), np.sin(bearing_rad)
    J = np.array([[-s / range_m, c / range_m], [c, s]])
    noise = gtsam.noiseModel.Gaussian.Covariance(J @ np.reshape(sight.cov, (2, 2)) @ J.T)
    return gtsam.BearingRangeFactor2D(ego, landmark, gtsam.Rot2(bearing_rad), range_m, noise)


def _pose(T: Any) -> gtsam.Pose2:
    return gtsam.Pose2(T.x_m, T.y_m, T.yaw_rad)


def _noise(cov: tuple[float, ...]) -> gtsam.noiseModel.Gaussian:
    return gtsam.noiseModel.Gaussian.Covariance(np.array(cov).reshape(3, 3))


def _vehicle(vehicle: int, frame: int) -> int:
    key: int = gtsam.symbol(chr(ord("A") + vehicle), frame)
    return key
