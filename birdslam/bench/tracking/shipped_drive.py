"""A run over the shipped drive against its truth: the ego, and every vehicle.

A vehicle of an estimate is matched to a body of the truth frame by frame, by where it stands from the ego, so that the
ego's drift costs no match; its ATE is then taken in the global frame with nothing aligned, as the paper's.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import msgspec
import numpy as np

from birdslam.bench.ego.trajectory_errors import ate_m, from_first, path_length_m, scale_error
from birdslam.bench.figures import median
from birdslam.bench.tracking.metrics import least_cost, path_errors
from birdslam.geometry.arrays import Floats
from birdslam.geometry.camera import GroundPlane
from birdslam.geometry.se2 import SE2
from birdslam.sources.kitti import KITTI_RATE_HZ
from birdslam.sources.shipped_drive import DemoRecording, TrueBody
from birdslam.trajectory import CameraTrajectory, as_poses, ego_pose, inverse, mount_pose, split_pose
from birdslam.types import Estimate, Moves, VehicleEstimate

VEHICLES = ("car", "van", "truck", "bus")
ASKED_VISIBLE, ASKED_TRUNCATED, ASKED_RANGE_M = 0.5, 0.2, (4.0, 40.0)  # bodies that are to be found
GATE_M, GATE_REL = 2.0, 0.2  # a vehicle further from a body than the greater of the two (of its range) is another's
MIN_VISIBLE, MAX_LOG_RANGE = 0.15, 0.6  # of what a mover is judged by: part in view, and 1.8 times as far off
MIN_FRAMES = 10  # a body matched in fewer is not counted as a vehicle
STANDS_MPS, DRIVES_MPS = 0.5, 2.0  # true speeds; a track between them is neither stationary nor moving
REPORTED_DRIVING_MPS = 1.5  # of an estimate, as in the pictures
MIN_SIGHTS = 5  # at 10 Hz; a shorter track is not counted
SOON_S = 1.0

Sight = tuple[int, float, VehicleEstimate]  # frame, true speed over the ground in m/s, and what was estimated


class DemoGrade(msgspec.Struct, frozen=True, kw_only=True):
    """A drive against its truth; the vehicles' numbers are None where none was matched."""

    frames: int
    path_m: float  # the ego's true one
    ego_ate_m: float  # root mean square of the positions' errors in 3-D, first pose aligned, no scale
    ego_ate_pct: float | None  # of path_m; None where the ego stood
    ego_scale_error: float | None
    vehicles: int  # matched in MIN_FRAMES and more
    vehicle_ate_m: float | None  # in the global frame, nothing aligned: the median over the vehicles
    vehicle_centre_m: float | None  # median distance from the true centre, both as seen from the ego
    vehicle_centre_rel: float | None  # the same over the body's range
    found: float | None  # share of the bodies in clear sight (ASKED_...), frame by frame, that were matched
    reported: float | None = None  # the same with vehicles that the last looks showed, predicted to the frame
    # Tracks, one of our ids on one body
    standing: int = 0
    false_movers: int = 0  # of these, reported to drive
    driving: int = 0  # for a second or longer
    missed_movers: int = 0  # of these, never reported to
    movers_soon: int = 0  # of these, reported to within a second


class GlobalFrame:
    """Estimates in the truth's world: the first one starts at its true pose, a new epoch where the last one ended."""

    def __init__(self) -> None:
        self._epoch: int | None = None
        self._T_true_world = SE2()
        self.T_true_ego = SE2()  # of the newest estimate

    def place(self, estimate: Estimate, true_ego: SE2) -> SE2:
        """`T_true_world` of this estimate's poses."""
        if estimate.epoch != self._epoch:
            anchor = true_ego if self._epoch is None else self.T_true_ego
            self._T_true_world = anchor @ estimate.T_world_ego.inverse()
            self._epoch = estimate.epoch
        self.T_true_ego = self._T_true_world @ estimate.T_world_ego
        return self._T_true_world


def true_egos(recording: DemoRecording) -> list[SE2]:
    """The ego on the plane of its first road, frame by frame."""
    T_world_first = mount_pose_of(recording, 0)
    return [
        split_pose(T_world_first @ T_first_cam @ inverse(mount_pose_of(recording, index)))[0]
        for index, T_first_cam in enumerate(as_poses(recording.truth_poses()))
    ]


def mount_pose_of(recording: DemoRecording, index: int) -> Floats:
    """`T_ego_cam` (4, 4) of a frame: its springs move the camera."""
    ground = recording.truth_ground(index)
    return mount_pose(GroundPlane(ground.height_m, ground.pitch_rad, ground.roll_rad))


def grade(recording: DemoRecording, estimates: Sequence[Estimate]) -> DemoGrade:
    """Estimates, in order, of frames of the recording: at least one."""
    truth, egos = from_first(as_poses(recording.truth_poses())), true_egos(recording)
    trajectory, frame = CameraTrajectory(recording.camera.ground), GlobalFrame()
    cameras: list[Floats] = []
    true_paths: dict[int, dict[int, SE2]] = {}
    paths: dict[int, dict[int, SE2]] = {}
    errors: list[tuple[float, float]] = []  # distance, range
    asked = found = reported = 0
    tracks: dict[tuple[int, int], list[Sight]] = {}
    for estimate in estimates:
        k = estimate.frame_id
        cameras.append(trajectory.add(estimate.epoch, ego_pose(estimate.T_world_ego, estimate.attitude)))
        T_true_world = frame.place(estimate, egos[k])
        bodies = [body for body in recording.truth_bodies(k) if body.label in VEHICLES]
        matched = match(estimate, bodies, [v for v in estimate.vehicles if v.age_ns == 0])
        for body, vehicle in matched:
            seen, true = estimate.T_world_ego.between(vehicle.T_world_vehicle), body.T_ego_body
            errors.append((math.hypot(seen.x_m - true.x_m, seen.y_m - true.y_m), math.hypot(true.x_m, true.y_m)))
            true_paths.setdefault(body.body, {})[k] = egos[k] @ true
            paths.setdefault(body.body, {})[k] = T_true_world @ vehicle.T_world_vehicle
        for body, vehicle in match_by_bearing(estimate, bodies):
            tracks.setdefault((vehicle.vehicle, body.body), []).append((k, math.hypot(*body.velocity_mps), vehicle))
        clear = {body.body for body in bodies if in_clear_sight(body)}
        asked += len(clear)
        found += len(clear & {body.body for body, _ in matched})
        in_sight = match(estimate, bodies, [v for v in estimate.vehicles if v.in_sight])
        reported += len(clear & {body.body for body, _ in in_sight})
    goal, poses = truth[[e.frame_id for e in estimates]], np.array(cameras)
    path_m, error_m = path_length_m(goal), ate_m(goal, poses)
    ates = [
        errors_of.ate_m
        for body, path in paths.items()
        if len(path) >= MIN_FRAMES and (errors_of := path_errors(true_paths[body], path)) is not None
    ]
    distance, reach = np.array(errors).reshape(-1, 2).T
    return DemoGrade(
        frames=len(estimates),
        path_m=path_m,
        ego_ate_m=error_m,
        ego_ate_pct=100.0 * error_m / path_m if path_m > 0.0 else None,
        ego_scale_error=scale_error(goal, poses),
        vehicles=len(ates),
        vehicle_ate_m=median(ates),
        vehicle_centre_m=median(distance),
        vehicle_centre_rel=median(distance / reach),
        found=found / asked if asked else None,
        reported=reported / asked if asked else None,
        **_movers(list(tracks.values()), recording.rate_hz),
    )


def _movers(tracks: Sequence[Sequence[Sight]], rate_hz: float) -> dict[str, int]:
    """The fields of a grade that count tracks."""
    long_enough = [seen for seen in tracks if len(seen) >= MIN_SIGHTS / KITTI_RATE_HZ * rate_hz]
    standing = [seen for seen in long_enough if all(speed < STANDS_MPS for _, speed, _ in seen)]
    delays = [delay for seen in long_enough if (delay := delay_s(seen, rate_hz)) is not None]
    return {
        "standing": len(standing),
        "false_movers": sum(any(is_reported_driving(v) for _, _, v in seen) for seen in standing),
        "driving": len(delays),
        "missed_movers": sum(math.isinf(delay) for delay in delays),
        "movers_soon": sum(delay <= SOON_S for delay in delays),
    }


def is_reported_driving(vehicle: VehicleEstimate) -> bool:
    """Whether an estimate shows a moving vehicle in pictures."""
    return vehicle.moves is Moves.DRIVING and math.hypot(*vehicle.velocity_mps) > REPORTED_DRIVING_MPS


def delay_s(seen: Sequence[Sight], rate_hz: float) -> float | None:
    """Returns the time from the first sight of a moving vehicle to its report; inf: never; None: it did not move."""
    drives = [frame for frame, speed, _ in seen if speed > DRIVES_MPS]
    if len(drives) < SOON_S * rate_hz:
        return None
    reported = [frame for frame, _, estimate in seen if frame >= drives[0] and is_reported_driving(estimate)]
    return (reported[0] - drives[0]) / rate_hz if reported else math.inf


def in_clear_sight(body: TrueBody) -> bool:
    """Whether a body is to be found in this frame."""
    near_m, far_m = ASKED_RANGE_M
    return (
        body.visible >= ASKED_VISIBLE and body.truncated <= ASKED_TRUNCATED and near_m <= body.T_ego_body.x_m <= far_m
    )


def match(
    estimate: Estimate, bodies: Sequence[TrueBody], seen: Sequence[VehicleEstimate]
) -> list[tuple[TrueBody, VehicleEstimate]]:
    """Pairs of least total distance, measured in gates, of bodies and of vehicles `seen` in this frame's estimate."""
    if not seen or not bodies:
        return []
    from_ego = [estimate.T_world_ego.between(vehicle.T_world_vehicle) for vehicle in seen]
    at = np.array([[pose.x_m, pose.y_m] for pose in from_ego])
    goal = np.array([[body.T_ego_body.x_m, body.T_ego_body.y_m] for body in bodies])
    gates_m = np.maximum(GATE_M, GATE_REL * np.linalg.norm(goal, axis=1))
    distance = np.linalg.norm(goal[:, None] - at[None], axis=2) / gates_m[:, None]
    rows, columns = least_cost(np.minimum(distance, 1.0))
    return [(bodies[i], seen[j]) for i, j in zip(rows, columns, strict=True) if distance[i, j] < 1.0]


def match_by_bearing(estimate: Estimate, bodies: Sequence[TrueBody]) -> list[tuple[TrueBody, VehicleEstimate]]:
    """Pairs of bodies and of vehicles seen in this frame that lie in one direction, whatever their range is off by.

    What is reported to drive falsely often stands at a wrong range.
    """
    seen = [vehicle for vehicle in estimate.vehicles if vehicle.age_ns == 0]
    open_to_view = [body for body in bodies if body.visible >= MIN_VISIBLE and body.T_ego_body.x_m > 0.0]
    if not seen or not open_to_view:
        return []
    at = [estimate.T_world_ego.between(vehicle.T_world_vehicle) for vehicle in seen]
    goal = [body.T_ego_body for body in open_to_view]
    bearing, range_m = (np.array([of(p.y_m, p.x_m) for p in at]) for of in (math.atan2, math.hypot))
    true_bearing, true_range_m = (np.array([of(p.y_m, p.x_m) for p in goal]) for of in (math.atan2, math.hypot))
    half_rad = np.array([0.5 * body.width_m for body in open_to_view]) / np.maximum(true_range_m, 1.0)
    aside = np.abs(true_bearing[:, None] - bearing) / half_rad[:, None]
    along = np.abs(np.log(np.maximum(range_m, 1.0) / np.maximum(true_range_m, 1.0)[:, None])) / MAX_LOG_RANGE
    off = np.maximum(aside, along)
    rows, columns = least_cost(np.minimum(off, 1.0))
    return [(open_to_view[i], seen[j]) for i, j in zip(rows, columns, strict=True) if off[i, j] < 1.0]
