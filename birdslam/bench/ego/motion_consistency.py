"""Whether the covariance of each frame's relative motion (CC edge) is consistent with its error.

A pose's own consistency (`consistency.py`) is that after the alignment of the first poses, which KITTI's first poses
spoil. Here each motion is held to the truth's motion between the same frames, and so are stretches of STRETCH_M, which
the pose graph makes of the motions alone (over those the error of the scale lasts). What the truth itself is worth is
measured on the truth alone (`truth_quality.py`), and printed beside the plain figures.
"""

from __future__ import annotations

import msgspec
import numpy as np

from birdslam.bench.ego import truth_quality
from birdslam.geometry.arrays import Bools, Floats
from birdslam.geometry.camera import GroundPlane
from birdslam.geometry.se2 import SE2
from birdslam.graph.graph_config import GraphConfig
from birdslam.graph.pose_graph import PoseGraph
from birdslam.graph.weights import WeightsConfig
from birdslam.trajectory import Transform, inverse, mount_pose, split_pose
from birdslam.types import INVALIDATING, EgoEdge, Estimate, Measurements, Status

DIMENSIONS = 3
MEDIAN = 2.366  # of the chi-square of three degrees of freedom: what a consistent error's squared distance is as often
MEDIAN_LENGTH = 0.455  # the same of one degree of freedom
STRETCH_M = 10.0
MIN_M = 0.05  # a shorter motion's length says nothing of the scale


def _alone(measurements: Measurements) -> Measurements:
    """Without anything but the ego's motion."""
    return msgspec.structs.replace(measurements, cv=(), vv=(), cp=(), lanes=())


class MotionConsistency(msgspec.Struct, frozen=True, kw_only=True):
    """Of motions that were measured and valid; those of a standing car, whose pose is held, are left out."""

    n: int
    nees: float | None = None  # mean of e' P^-1 e over its degrees of freedom, the truth taken as exact
    nees_median: float | None = None  # its median over that of a consistent error: outliers of the truth do not count
    n_measured: int = 0  # of them those whose truth is no interpolation
    nees_measured: float | None = None  # of these, the truth's own noise and that of its axes added to P
    length_nees: float | None = None  # of the way's length alone, which is the scale's error; also of the measured
    length_nees_median: float | None = None  # over that of a consistent error


class MotionConsistencyReport(msgspec.Struct, frozen=True, kw_only=True):
    """Of one sequence."""

    frames: MotionConsistency
    stretches: MotionConsistency  # of STRETCH_M
    truth_interpolated: int  # frames whose truth is a constant twist
    truth_implausible: int  # frames at which the truth accelerates as no car does
    truth_sigma_m: tuple[float, float]  # 1-sigma of the truth of one step, forwards and sideways
    truth_sigma_rad: float  # ... and of its yaw
    truth_axes_off_rad: float | None = None  # from the truth's axes to its way on straight road; None: too little


class Motions:
    """Collects the CC edges, frame by frame."""

    def __init__(self, mount: GroundPlane) -> None:
        self._mount = mount
        self._index: dict[int, int] = {}  # frame of the recording, by its number in the records
        self._t_ns: list[int] = []
        self._moved: dict[int, tuple[int, EgoEdge, Measurements]] = {}  # by the frame at its end: from which it is

    def add(self, measurements: Measurements) -> None:
        """The next frame's; what comes at the source's end is of no frame."""
        status = set(measurements.status)
        if Status.END_OF_SOURCE in status:
            return
        frame = len(self._t_ns)
        self._index[measurements.frame_id] = frame
        self._t_ns.append(measurements.t_source_ns)
        cc = measurements.cc
        if cc is not None and cc.from_frame in self._index and not status & (INVALIDATING | {Status.ODOMETRY_COASTING}):
            self._moved[frame] = self._index[cc.from_frame], cc, measurements

    def report(self, truth: Transform, exact: bool = False) -> MotionConsistencyReport | None:
        """Against `T_first_i` (N, 4, 4) of the camera in its own axes, of all frames of the recording.

        `exact`: the motions were simulated from these very poses, which have no noise of their own and no
        interpolated steps then. None where not every frame has reported its measurements.
        """
        if len(self._t_ns) != len(truth):
            return None
        interpolated = np.zeros(len(truth), np.bool_) if exact else truth_quality.interpolated(truth)
        sigma = np.zeros(DIMENSIONS) if exact else truth_quality.step_noise(truth, self._mount)
        noise = np.diag(sigma**2)
        axes_rad = 0.0 if exact else truth_quality.AXES_SIGMA_RAD
        frames = [
            (first, last, cc.T_from_to, np.reshape(cc.cov, (DIMENSIONS, DIMENSIONS)))
            for last, (first, cc, measurements) in self._moved.items()
            if Status.STANDSTILL not in measurements.status
        ]
        implausible = truth_quality.implausible(truth, np.array(self._t_ns, np.int64))
        return MotionConsistencyReport(
            frames=self._judge(frames, truth, interpolated, noise, axes_rad),
            stretches=self._judge(self.stretches(truth), truth, interpolated, noise, axes_rad),
            truth_interpolated=int(interpolated.sum()),
            truth_implausible=int(implausible.sum()),
            truth_sigma_m=(float(sigma[0]), float(sigma[1])),
            truth_sigma_rad=float(sigma[2]),
            truth_axes_off_rad=truth_quality.axes_off_way(truth, self._mount),
        )

    def stretches(self, truth: Transform) -> list[tuple[int, int, SE2, Floats]]:
        """(first, last, T_first_last, its covariance (3, 3)) of each STRETCH_M of the truth's way.

        One begins every quarter of that, where all between is known.
        """
        way_m = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(truth[:, :3, 3], axis=0), axis=1))])
        begins = np.unique(np.searchsorted(way_m, np.arange(0.0, max(way_m[-1] - STRETCH_M, 0.0), 0.25 * STRETCH_M)))
        found = []
        for first in begins.tolist():
            last = int(np.searchsorted(way_m, way_m[first] + STRETCH_M))
            end = self._chain(first, last) if last < len(way_m) else None
            if end is not None:
                cov = np.reshape(end.cov, (DIMENSIONS, DIMENSIONS))
                found.append((first, last, end.T_world_ego, cov))
        return found

    def _chain(self, first: int, last: int) -> Estimate | None:
        """The motion between two frames by the edges' motions alone; None where one has none."""
        moved = [self._moved.get(frame) for frame in range(first + 1, last + 1)]
        graph, end = PoseGraph(GraphConfig(), WeightsConfig()), None
        for frame, link in enumerate(moved, first):
            if link is None or link[0] != frame:
                return None
            _, cc, m = link
            if end is None:
                end = graph.optimise(msgspec.structs.replace(_alone(m), frame_id=cc.from_frame, cc=None, status=()))
            end = graph.optimise(_alone(m))
        return end

    def _judge(
        self,
        motions: list[tuple[int, int, SE2, Floats]],
        truth: Transform,
        interpolated: Bools,
        noise: Floats,
        axes_rad: float,
    ) -> MotionConsistency:
        if not motions:
            return MotionConsistency(n=0)
        mount = mount_pose(self._mount)
        plain, measured, lengths = [], [], []
        for first, last, T_first_last, cov in motions:
            goal, _ = split_pose(mount @ inverse(truth[first]) @ truth[last] @ inverse(mount))
            error = T_first_last.between(goal).log()
            plain.append(float(error @ np.linalg.solve(cov, error)))
            if not interpolated[first + 1 : last + 1].any():
                aside = moved_by_turn(T_first_last) * axes_rad
                measured.append(float(error @ np.linalg.solve(cov + noise + np.outer(aside, aside), error)))
                if (length_m := np.hypot(goal.x_m, goal.y_m)) > MIN_M:
                    lengths.append(nees_of_length(T_first_last, cov + noise, float(length_m)))
        return MotionConsistency(
            n=len(plain),
            nees=float(np.mean(plain)) / DIMENSIONS,
            nees_median=float(np.median(plain)) / MEDIAN,
            n_measured=len(measured),
            nees_measured=float(np.mean(measured)) / DIMENSIONS if measured else None,
            length_nees=float(np.mean(lengths)) if lengths else None,
            length_nees_median=float(np.median(lengths)) / MEDIAN_LENGTH if lengths else None,
        )


def moved_by_turn(T_first_last: SE2) -> Floats:
    """(3,) how a motion, in the tangent at its end, changes with a rotation of its axes (per rad)."""
    x_m, y_m = T_first_last.rotation().T @ np.array([-T_first_last.y_m, T_first_last.x_m])
    return np.array([x_m, y_m, 0.0])


def nees_of_length(T_first_last: SE2, cov: Floats, truth_m: float) -> float:
    """Squared error of a motion's length over its variance; `cov` (3, 3) is of the tangent at its end."""
    length_m = np.hypot(T_first_last.x_m, T_first_last.y_m)
    along = T_first_last.rotation().T @ np.array([T_first_last.x_m, T_first_last.y_m]) / max(length_m, 1e-9)
    return float((length_m - truth_m) ** 2 / (along @ cov[:2, :2] @ along))
