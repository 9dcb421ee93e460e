"""Writes the graph of Eqs. 2-8 in g2o's text format, for other solvers.

`VERTEX_SE2 id x y yaw`, `EDGE_SE2 from to x y yaw` with the upper triangle of the information matrix, in the axes of
the measured pose; a landmark is a `VERTEX_XY` with an `EDGE_SE2_XY` per observation (Kuemmerle et al., "g2o: A General
Framework for Graph Optimization", ICRA 2011). Units are metres and radians.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np

from birdslam.geometry.se2 import SE2
from birdslam.graph.edges import pose_edges
from birdslam.graph.factors.landmark_points import LandmarkKey, sightings
from birdslam.graph.weights import WeightsConfig, weighted
from birdslam.types import Measurements

_MIN_VARIANCE = 1e-12  # an edge may be exact in some direction

Node = tuple[str, int, int] | LandmarkKey  # "ego" or "vehicle", which, frame; or a landmark


def g2o_lines(log: Iterable[Measurements], weights: WeightsConfig) -> Iterator[str]:
    """Vertices from dead reckoning, and the valid edges with the covariances of `weights`.

    The first pose is fixed, and the first pose after each loss of the odometry.
    """
    ids: dict[Node, int] = {}
    poses: dict[int, SE2] = {}
    pose, fixed = SE2(), list[int]()

    def added(node: Node) -> int:
        return ids.setdefault(node, len(ids))

    for m in (weighted(record, weights) for record in log):
        edges, frame = pose_edges(m), m.frame_id
        cc = edges.cc
        if cc is None and not edges.cv and not m.cp and poses:
            continue  # a frame without an image has no pose
        follows = cc is not None and cc.from_frame in poses
        if cc is not None and follows:
            pose = poses[cc.from_frame] @ cc.T_from_to
        poses[frame] = pose
        ego = added(("ego", 0, frame))
        yield f"VERTEX_SE2 {ego} {_pose(pose)}"
        if cc is not None and follows:
            yield _edge(ids["ego", 0, cc.from_frame], ego, cc.T_from_to, cc.cov)
        else:
            fixed.append(ego)
        for cv in edges.cv:
            vehicle = added(("vehicle", cv.vehicle, frame))
            yield f"VERTEX_SE2 {vehicle} {_pose(pose @ cv.T_ego_vehicle)}"
            yield _edge(ego, vehicle, cv.T_ego_vehicle, cv.cov)
        for vv in edges.vv:
            ends = [ids.get(("vehicle", vv.vehicle, at)) for at in (vv.from_frame, vv.to_frame)]
            if ends[0] is not None and ends[1] is not None:
                yield _edge(ends[0], ends[1], vv.T_from_to, vv.cov)
        seen = sightings(m.cp)
        for key, point, mean, deviator in zip(seen.keys, seen.points, seen.means, seen.deviators, strict=True):
            new = key not in ids
            landmark = added(key)
            if new:
                x, y = (pose @ np.array([point.real, point.imag])).tolist()
                yield f"VERTEX_XY {landmark} {x!r} {y!r}"
            cov = np.array([[mean + deviator.real, deviator.imag], [deviator.imag, mean - deviator.real]])
            numbers = (point.real, point.imag, *np.linalg.inv(cov)[np.triu_indices(2)].tolist())
            yield f"EDGE_SE2_XY {ego} {landmark} {' '.join(repr(float(n)) for n in numbers)}"

    # At the end: gtsam's reader ignores all edges after a FIX, which it does not support
    for ego in fixed:
        yield f"FIX {ego}"


def _pose(T: SE2) -> str:
    return f"{T.x_m!r} {T.y_m!r} {T.yaw_rad!r}"


def _edge(start: int, end: int, T: SE2, cov: tuple[float, ...]) -> str:
    information = np.linalg.inv(np.reshape(cov, (3, 3)) + _MIN_VARIANCE * np.eye(3))
    upper = " ".join(repr(n) for n in information[np.triu_indices(3)].tolist())
    return f"EDGE_SE2 {start} {end} {_pose(T)} {upper}"
