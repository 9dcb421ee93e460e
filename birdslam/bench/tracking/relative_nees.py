"""Consistency of the covariances of the ego's motion, of the scale and of vehicles: NEES of relative poses.

A pose in the world is one sample a drive, and of KITTI it measures the first, interpolated poses. Relative ones are
many: the ego's motion from frame to frame and over 10 m (motion_consistency.py), the part of it that is the scale's,
and vehicles where a planner has them, in the ego's frame, of the same image and of 10 m before.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence

import msgspec
import numpy as np

from birdslam.bench.ego.motion_consistency import STRETCH_M, MotionConsistency, Motions
from birdslam.bench.tracking.benchmark import Live, Truth
from birdslam.geometry.arrays import Floats
from birdslam.geometry.se2 import SE2
from birdslam.graph.pose_graph import PoseGraph
from birdslam.sources.kitti_tracking import TrackingSequence
from birdslam.trajectory import inverse
from birdslam.types import Measurements

PLACE = 2  # degrees of freedom
SIMULATED = ("simulate", "truth")  # odometries that err from the true poses themselves
MEDIAN_OF_PLACE = 1.386  # of the chi-square of two degrees of freedom


class NeesRow(msgspec.Struct, frozen=True, kw_only=True):
    """One row: `of` ego, scale or vehicles, `per` frame or 10 m; None where there is nothing to judge."""

    sequence: str
    odometry: str
    of: str
    per: str
    n: int
    bodies: int = 1  # vehicles
    nees: float | None = None
    nees_median: float | None = None  # the median over that of an honest error


def nees_rows(sequence: TrackingSequence, log: Sequence[Measurements], live: Live, odometry: str) -> list[NeesRow]:
    """The rows of one log; vehicles as `live` has them."""
    truth, motions = Truth.of(sequence, log), Motions(sequence.camera.ground)
    graph = PoseGraph(live.graph, live.weights)
    estimated = []
    for m in log:
        motions.add(m)
        graph.optimise(m)
        estimated.append(graph.vehicles_in_ego())
    first = log[0].frame_id
    poses = sequence.camera_poses[first : first + len(log)]
    camera = inverse(poses[0]) @ poses
    of_motion = motions.report(camera, exact=odometry in SIMULATED)
    stretches = {last: (begin, T, cov) for begin, last, T, cov in motions.stretches(camera)}
    per_frame: dict[int, list[float]] = defaultdict(list)
    per_stretch: dict[int, list[float]] = defaultdict(list)
    for k, m in enumerate(log):
        for label, vehicle in truth.matches[m.frame_id].items():
            if vehicle not in estimated[k] or m.frame_id not in truth.vehicles[label]:
                continue
            (T_ego_vehicle, cov), goal = estimated[k][vehicle], truth.vehicles[label][m.frame_id]
            per_frame[label].append(_nees(T_ego_vehicle, cov[:2, :2], truth.ego[m.frame_id].between(goal)))
            if k in stretches:
                begin, T_begin_ego, cov_ego = stretches[k]
                before = truth.ego[log[begin].frame_id].between(goal)
                # In the axes of the ego now: an error of its place, and of its yaw by the lever of the vehicle
                J = np.array([[1.0, 0.0, -T_ego_vehicle.y_m], [0.0, 1.0, T_ego_vehicle.x_m]])
                both = cov[:2, :2] + J @ cov_ego @ J.T
                per_stretch[label].append(_nees(T_ego_vehicle, both, T_begin_ego.between(before)))
    rows = []
    if of_motion is not None:
        for per, found in (("frame", of_motion.frames), (f"{STRETCH_M:g} m", of_motion.stretches)):
            rows += _ego_rows(sequence.name, odometry, per, found)
    for per, by_label in (("frame", per_frame), (f"{STRETCH_M:g} m", per_stretch)):
        values = [value for each in by_label.values() for value in each]
        rows.append(
            NeesRow(
                sequence=sequence.name,
                odometry=odometry,
                of="vehicles",
                per=per,
                n=len(values),
                bodies=len(by_label),
                nees=float(np.mean(values)) / PLACE if values else None,
                nees_median=float(np.median(values)) / MEDIAN_OF_PLACE if values else None,
            )
        )
    return rows


def over_seeds(rows: Sequence[Sequence[NeesRow]]) -> list[NeesRow]:
    """One row each of what seeds have one of: all that they judged, and the means over it."""
    return [
        msgspec.structs.replace(
            same[0],
            n=sum(row.n for row in same),
            nees=_mean([(row.nees, row.n) for row in same]),
            nees_median=_mean([(row.nees_median, row.n) for row in same]),
        )
        for same in zip(*rows, strict=True)
    ]


def _mean(values: Sequence[tuple[float | None, int]]) -> float | None:
    """Of values with their weights; None where there is none."""
    known = [(value, weight) for value, weight in values if value is not None and weight]
    if not known:
        return None
    means, weights = np.transpose(known)
    return float(np.average(means, weights=weights))


def _ego_rows(sequence: str, odometry: str, per: str, found: MotionConsistency) -> list[NeesRow]:
    ego = NeesRow(
        sequence=sequence,
        odometry=odometry,
        of="ego",
        per=per,
        n=found.n_measured,
        nees=found.nees_measured,
        nees_median=found.nees_median,
    )
    scale = msgspec.structs.replace(ego, of="scale", nees=found.length_nees, nees_median=found.length_nees_median)
    return [ego, scale]


def _nees(estimated: SE2, cov: Floats, goal: SE2) -> float:
    error = np.array([estimated.x_m - goal.x_m, estimated.y_m - goal.y_m])
    return float(error @ np.linalg.solve(cov, error))
