"""The consistency of the covariance of the ego's motion: NEES (Bar-Shalom et al. 2001, 5.4) of CC edges and 10 m.

Relative motions are used since the first, interpolated poses of KITTI would dominate the error of a pose in the world.
The pose graph chains the edges of each stretch. The noise of the truth (`truth_quality.py`) is added to the covariance,
and stretches with an interpolated truth are left out.
"""

from __future__ import annotations

from collections.abc import Sequence

import msgspec
import numpy as np

from birdslam.bench.ego import truth_quality
from birdslam.geometry.arrays import Floats
from birdslam.geometry.camera import GroundPlane
from birdslam.geometry.se2 import SE2
from birdslam.graph.graph_config import GraphConfig
from birdslam.graph.pose_graph import PoseGraph
from birdslam.graph.weights import WeightsConfig
from birdslam.trajectory import Transform, inverse, mount_pose, split_pose
from birdslam.types import INVALIDATING, EgoEdge, Estimate, Measurements, Status

DIMENSIONS = 3
MEDIAN = 2.366  # of the chi-square distribution with DIMENSIONS degrees of freedom
STRETCH_M = 10.0


class Nees(msgspec.Struct, frozen=True, kw_only=True):
    """e' P^-1 e over its value for a consistent covariance: 1 is consistent, more is overconfident."""

    n: int
    mean: float | None = None
    median: float | None = None  # outliers of the truth do not count


class MotionConsistency(msgspec.Struct, frozen=True, kw_only=True):
    """The consistency of the motions of one sequence."""

    frame: Nees  # of each CC edge of a moving car
    stretch: Nees  # of STRETCH_M


class Motions:
    """Collects the CC edges, frame by frame."""

    def __init__(self, mount: GroundPlane) -> None:
        self._mount = mount
        self._index: dict[int, int] = {}  # frame of the recording, by its number in the records
        self._moved: dict[int, tuple[int, EgoEdge, Measurements]] = {}  # start frame, edge and record, by end frame

    def add(self, measurements: Measurements) -> None:
        """Adds the measurements of the next frame; those after the end of the source belong to no frame."""
        status = set(measurements.status)
        if Status.END_OF_SOURCE in status:
            return
        frame = len(self._index)
        self._index[measurements.frame_id] = frame
        cc = measurements.cc
        if cc is not None and cc.from_frame in self._index and not status & (INVALIDATING | {Status.ODOMETRY_COASTING}):
            self._moved[frame] = self._index[cc.from_frame], cc, measurements

    def report(self, truth: Transform) -> MotionConsistency | None:
        """Compares with `T_first_i` (N, 4, 4) of the camera in its own axes, of all frames of the recording.

        None if not every frame has reported its measurements.
        """
        if len(self._index) != len(truth):
            return None
        edges = [
            (first, last, cc.T_from_to, cc.cov)
            for last, (first, cc, measurements) in self._moved.items()
            if Status.STANDSTILL not in measurements.status
        ]
        stretches = [(first, last, end.T_world_ego, end.cov) for first, last, end in self._stretches(truth)]
        return MotionConsistency(frame=self._nees(edges, truth), stretch=self._nees(stretches, truth))

    def _nees(self, motions: Sequence[tuple[int, int, SE2, Sequence[float]]], truth: Transform) -> Nees:
        """Judges motions (first frame, last frame, T_first_last, its covariance)."""
        mount, interpolated = mount_pose(self._mount), truth_quality.interpolated(truth)
        noise = np.diag(truth_quality.step_noise(truth, self._mount) ** 2)
        squares = []
        for first, last, T_first_last, cov in motions:
            if interpolated[first + 1 : last + 1].any():
                continue
            goal, _ = split_pose(mount @ inverse(truth[first]) @ truth[last] @ inverse(mount))
            error = T_first_last.between(goal).log()
            aside = moved_by_turn(T_first_last) * truth_quality.AXES_SIGMA_RAD
            total = np.reshape(cov, (DIMENSIONS, DIMENSIONS)) + noise + np.outer(aside, aside)
            squares.append(float(error @ np.linalg.solve(total, error)))
        if not squares:
            return Nees(n=0)
        return Nees(
            n=len(squares), mean=float(np.mean(squares)) / DIMENSIONS, median=float(np.median(squares)) / MEDIAN
        )

    def _stretches(self, truth: Transform) -> list[tuple[int, int, Estimate]]:
        """Returns (first, last, motion) of each STRETCH_M of the true path, starting every quarter of it.

        Stretches without a complete chain of edges are left out.
        """
        path_m = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(truth[:, :3, 3], axis=0), axis=1))])
        starts = np.unique(np.searchsorted(path_m, np.arange(0.0, max(path_m[-1] - STRETCH_M, 0.0), 0.25 * STRETCH_M)))
        found = []
        for first in starts.tolist():
            last = int(np.searchsorted(path_m, path_m[first] + STRETCH_M))
            end = self._chain(first, last) if last < len(path_m) else None
            if end is not None:
                found.append((first, last, end))
        return found

    def _chain(self, first: int, last: int) -> Estimate | None:
        """Returns the motion between two frames by the CC edges alone; None if one is missing."""
        moved = [self._moved.get(frame) for frame in range(first + 1, last + 1)]
        graph, end = PoseGraph(GraphConfig(), WeightsConfig()), None
        for frame, link in enumerate(moved, first):
            if link is None or link[0] != frame:
                return None
            _, cc, m = link
            alone = msgspec.structs.replace(m, cv=(), vv=(), cp=(), lanes=())
            if end is None:
                end = graph.optimise(msgspec.structs.replace(alone, frame_id=cc.from_frame, cc=None, status=()))
            end = graph.optimise(alone)
        return end


def moved_by_turn(T_first_last: SE2) -> Floats:
    """Returns (3,) the change of a motion, in the tangent at its end, by a rotation of its axes (per rad)."""
    x_m, y_m = T_first_last.rotation().T @ np.array([-T_first_last.y_m, T_first_last.x_m])
    return np.array([x_m, y_m, 0.0])
