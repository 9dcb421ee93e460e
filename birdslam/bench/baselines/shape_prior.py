"""Vehicles placed by a shape prior, with which the paper initialises its baselines in SE(3) (end of its Sec. 3.1.3).

After Murthy et al., "Reconstructing vehicles from a single image: shape priors for road scene understanding" (ICRA
2017). Kept: a wireframe of keypoints with a prior on its shape, one fit of pose and shape for each sight. Not kept:
keypoints by a network: the edges of the box stand in for the outermost ones, the log's distance for those on the road,
its heading for what tells front from back, so that the fit knows nothing that the log's own placing did not know. The
shape varies in length, width and height alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import msgspec
import numpy as np

from birdslam.bench.baselines.trajectories import Method, Trajectories
from birdslam.geometry.arrays import Floats
from birdslam.geometry.camera import Camera
from birdslam.geometry.se2 import SE2
from birdslam.types import Measurements, VehicleEdge

# Keypoints as fractions of length, width and height about the middle of the footprint: the body's corners under and
# over the bumpers, and the roof's
WIREFRAME = np.array(
    [(x, y, z) for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (0.0, 0.5)]
    + [(x, y, 1.0) for x in (-0.35, 0.15) for y in (-0.4, 0.4)]
)
_STEPS = 8  # of Gauss-Newton
_STEP = 1e-5  # for derivatives
_LONGEST = np.array([2.0, 1.0, 0.3, 0.2, 0.2, 0.2])  # of one step, in each unknown


class ShapePriorConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """How much shapes vary (1-sigma, as fractions of the log's sizes), and how well boxes fit."""

    height_m: float = 1.53  # of a vehicle whose height nobody stated
    sigma_length_rel: float = 0.12
    sigma_width_rel: float = 0.1
    sigma_height_rel: float = 0.08
    sigma_box_px: float = 1.5
    sigma_box_rel: float = 0.02
    cut_margin_px: float = 4.0  # an edge so near to the image's border is none of the vehicle's


@dataclass(frozen=True)
class Initialised:
    """A baseline on the log's vehicles as the shape prior places them."""

    label: str = field(compare=False)
    method: Method

    def run(self, log: Sequence[Measurements], camera: Camera) -> Trajectories:
        """Trajectories of the whole log at once."""
        return self.method.run(fitted(log, camera), camera)


def fitted(log: Sequence[Measurements], camera: Camera) -> list[Measurements]:
    """The log with each CV edge's pose, sizes and covariance by the wireframe; one without a fit is kept as it is."""
    edges = [edge for m in log for edge in m.cv]
    if not edges:
        return list(log)
    found = iter(_fit(edges, camera, ShapePriorConfig()))
    return [msgspec.structs.replace(m, cv=tuple(next(found) for _ in m.cv)) for m in log]


def project(unknowns: Floats, camera: Camera) -> Floats:
    """(N, 3) left and right edge, and height, in pixels, of the boxes around wireframes.

    `unknowns` (N, 6): x, y (m) and yaw (rad) in ego, and the logarithms of length, width and height (m).
    """
    points = WIREFRAME * np.exp(unknowns[:, None, 3:])
    at = (points[..., 0] + 1j * points[..., 1]) * np.exp(1j * unknowns[:, 2])[:, None]
    ahead = np.maximum(at.real + unknowns[:, :1], 0.5)
    u = camera.cx_px - camera.fx_px * (at.imag + unknowns[:, 1:2]) / ahead
    v = camera.fy_px * (camera.height_m - points[..., 2]) / ahead
    return np.column_stack([u.min(axis=1), u.max(axis=1), np.ptp(v, axis=1)])


def _fit(edges: Sequence[VehicleEdge], camera: Camera, config: ShapePriorConfig) -> list[VehicleEdge]:
    boxes = np.array([edge.box_px for edge in edges])
    log = np.array([_prior(edge, config) for edge in edges])
    size_px = np.maximum(boxes[:, 2:] - boxes[:, :2], 1.0)
    measured = np.column_stack([boxes[:, 0], boxes[:, 2], size_px[:, 1]])
    sigma_px = config.sigma_box_px + config.sigma_box_rel * size_px[:, [0, 0, 1]]
    margin = config.cut_margin_px
    cut = np.column_stack(
        [
            boxes[:, 0] < margin,
            boxes[:, 2] > camera.width_px - margin,
            (boxes[:, 1] < margin) | (boxes[:, 3] > camera.height_px - margin),
        ]
    )
    sigma_px[cut] = 1e6
    sigma_away_m = np.array([_sigma_away_m(edge) for edge in edges])
    sigma_prior = np.empty((len(edges), 4))
    sigma_prior[:, 0] = [max(edge.cov[8], 1e-6) ** 0.5 for edge in edges]
    sigma_prior[:, 1:] = config.sigma_length_rel, config.sigma_width_rel, config.sigma_height_rel
    away_m = np.hypot(log[:, 0], log[:, 1])

    def residuals(q: Floats) -> Floats:
        """(N, 8): box, distance, and prior on heading and shape."""
        box = (project(q, camera) - measured) / sigma_px
        away = (np.hypot(q[:, 0], q[:, 1]) - away_m) / sigma_away_m
        return np.column_stack([box, away, (q[:, 2:] - log[:, 2:]) / sigma_prior])

    q, J = log.copy(), np.empty((len(edges), 8, 6))
    for _ in range(_STEPS):
        for k, step in enumerate(np.eye(6) * _STEP):
            J[:, :, k] = (residuals(q + step) - residuals(q - step)) / (2.0 * _STEP)
        information = J.transpose(0, 2, 1) @ J + 1e-9 * np.eye(6)
        step = np.linalg.solve(information, J.transpose(0, 2, 1) @ residuals(q)[:, :, None])[:, :, 0]
        q = q - np.clip(step, -_LONGEST, _LONGEST)
    better = np.sum(residuals(q) ** 2, axis=1) < np.sum(residuals(log) ** 2, axis=1)
    covs = np.linalg.inv(information)[:, :3, :3]
    return [
        _placed(edge, one, cov) if good else edge for edge, one, cov, good in zip(edges, q, covs, better, strict=True)
    ]


def _prior(edge: VehicleEdge, config: ShapePriorConfig) -> tuple[float, ...]:
    T = edge.T_ego_vehicle
    log_height = edge.log_height if edge.sigma_log_height else np.log(config.height_m)
    return T.x_m, T.y_m, T.yaw_rad, np.log(edge.length_m), np.log(edge.width_m), log_height


def _sigma_away_m(edge: VehicleEdge) -> float:
    """1-sigma of the distance as the log has it; its covariance is in the vehicle's axes."""
    T = edge.T_ego_vehicle
    along = T.rotation().T @ np.array([T.x_m, T.y_m]) / max(np.hypot(T.x_m, T.y_m), 1e-6)
    return float(max(along @ np.reshape(edge.cov, (3, 3))[:2, :2] @ along, 1e-4)) ** 0.5


def _placed(edge: VehicleEdge, q: Floats, cov: Floats) -> VehicleEdge:
    x_m, y_m, yaw_rad = q[:3].tolist()
    pose = SE2(x_m, y_m, yaw_rad)
    R = np.eye(3)
    R[:2, :2] = pose.rotation().T  # the graph has an edge's covariance in the vehicle's own axes
    turned = R @ cov @ R.T
    length_m, width_m = np.exp(q[3:5]).tolist()
    return msgspec.structs.replace(
        edge, T_ego_vehicle=pose, cov=tuple(turned.ravel().tolist()), length_m=length_m, width_m=width_m
    )
