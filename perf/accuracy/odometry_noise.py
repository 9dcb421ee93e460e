"""Fits `simulation.odometry.OdometryNoise` to what the image odometry does on the real clips, and prints it.

    python -m perf odometry_noise [--data DIR]

KITTI's true poses are interpolated over the first frames of a sequence (13 of 00, 11 of 06): they are left out.
"""

from __future__ import annotations

import cv2
import msgspec
import numpy as np
from scipy.spatial.transform import Rotation

from birdslam.bench.ego.trajectory_errors import from_first
from birdslam.bench.simulation.odometry import OdometryNoise, fit_drift
from birdslam.geometry.arrays import Floats, Ints
from birdslam.odometry.motion import Motion
from birdslam.odometry.odometry import Odometry
from birdslam.perf.reporting.arguments import add_data, benchmark_parser
from birdslam.sources.opening import open_recording
from birdslam.sources.recording import Recording
from birdslam.trajectory import Transform, as_poses, inverse

CLIPS = {"kitti_odometry/sequences/00": 13, "kitti_odometry/sequences/06": 11, "kitti_raw_clip": 1}  # frames left out
LEAST_STEP_M = 0.05  # a shorter step has no direction to speak of
ROAD_AHEAD_M = 12.0  # the tilt that counts is that against the road so far ahead
# Of road tracks, which become landmarks: the networks' road and boxes take the others. With it a frame of a simulated
# drive has 9.8 CP edges to points; one of 0002's images has 10.0 (`python -m perf edges`)
LANDMARKS_SHARE = 0.5
COLUMNS = ("step_m", "true_turn", "tilt_x", "turn", "tilt_z", "rise", "side", "log_scale", "pitch")


label = "the simulated odometry's noise, fitted to the real clips"


def run(arguments: list[str]) -> None:
    parser = benchmark_parser("odometry_noise", label, output="")
    add_data(parser)
    data = parser.parse_args(arguments).data
    noise = fit([(open_recording(f"kitti:{data / clip}"), left_out) for clip, left_out in CLIPS.items()])
    print(msgspec.json.format(msgspec.json.encode(noise), indent=2).decode())


def fit(clips: list[tuple[Recording, int]]) -> OdometryNoise:
    """The noise of all clips together."""
    cv2.setNumThreads(1)
    series, lives, counts = [], [], []
    for recording, left_out in clips:
        rows, tracks = measure(recording, left_out)
        series.append(rows)
        ids, seen = np.unique(np.concatenate([ids for ids, _ in tracks]), return_counts=True)
        lives.append(len(ids) and seen.mean())
        counts.append(np.mean([len(ids) for ids, _ in tracks]))
    of = {name: [rows[:, k] for rows in series] for k, name in enumerate(COLUMNS)}
    even = [np.ones(len(rows)) for rows in series]
    true_turn, turn, side, step = (np.concatenate(of[name]) for name in ("true_turn", "turn", "side", "step_m"))
    turn_rel = float((true_turn * turn).sum() / (true_turn**2).sum())
    of["turn"] = [t - turn_rel * w for t, w in zip(of["turn"], of["true_turn"], strict=True)]
    turn = np.concatenate(of["turn"])
    # GPS poses know the camera's mounting to no better than half a degree: only how the tilt varies can be compared
    pitch = [rows[np.isfinite(rows)] for rows in of["pitch"]]
    pitch = [rows - np.median(rows) for rows in pitch if len(rows)]
    side_per_turn = float((turn * side * step**2).sum() / (turn**2 * step**2).sum())
    return OdometryNoise(
        tilt_rad=fit_drift([*of["tilt_x"], *of["tilt_z"]], even * 2),
        turn_rad=fit_drift(of["turn"], even),
        turn_rel=abs(turn_rel),
        rise_rad=fit_drift(of["rise"], of["step_m"]),
        side_rad=fit_drift([s - side_per_turn * t for s, t in zip(of["side"], of["turn"], strict=True)], of["step_m"]),
        side_per_turn=side_per_turn,
        log_scale=fit_drift(of["log_scale"], of["step_m"]),
        ground_rad=fit_drift(pitch, [np.ones(len(rows)) for rows in pitch]),
        landmarks=LANDMARKS_SHARE * float(np.median(counts)),
        landmark_frames=float(np.median(lives)),
    )


def measure(recording: Recording, left_out: int) -> tuple[Floats, list[tuple[Ints, Floats]]]:
    """The errors (N, len(COLUMNS)), and the road tracks of each frame."""
    odometry = Odometry(recording.camera)
    T_cam0_cam = recording.T_cam0_cam()
    truth = recording.truth_poses()
    assert truth is not None, recording.name
    poses = from_first(inverse(T_cam0_cam) @ as_poses(truth) @ T_cam0_cam)
    rows, tracks = [], []
    for frame in recording.frames():
        assert frame.image is not None, frame.error
        motion = odometry.estimate(odometry.track(frame.image), frame.index, frame.t_source_ns, np.zeros((0, 4)))
        tracks.append(odometry.road_tracks)
        if motion is None or motion.standstill or motion.from_frame < left_out:
            continue
        step = inverse(poses[motion.from_frame]) @ poses[motion.to_frame]
        if np.linalg.norm(step[:3, 3]) > LEAST_STEP_M:
            rows.append(
                [*_errors(step, motion), motion.ground.pitch_rad - _pitch_rad(poses[motion.to_frame :], recording)]
            )
    return np.array(rows), tracks[1:]


def _errors(step: Transform, motion: Motion) -> list[float]:
    turned = Rotation.from_matrix(step[:3, :3].T @ motion.R_prev_curr).as_rotvec()
    true_m, found_m = float(np.linalg.norm(step[:3, 3])), max(float(np.linalg.norm(motion.t_prev_curr_m)), 1e-6)
    swung = np.cross(step[:3, 3] / true_m, motion.t_prev_curr_m / found_m)
    true_turn = Rotation.from_matrix(step[:3, :3]).as_rotvec()[1]
    return [true_m, true_turn, *turned, swung[0], swung[1], float(np.log(found_m / true_m))]


def _pitch_rad(poses: Transform, recording: Recording) -> float:
    """Of the camera against the road that it drives on `ROAD_AHEAD_M` further; NaN at the end of the clip."""
    away = np.linalg.norm(poses[:, :3, 3] - poses[0, :3, 3], axis=1)
    if away.max() < ROAD_AHEAD_M:
        return np.nan
    T = inverse(poses[0]) @ poses[int(np.argmax(away >= ROAD_AHEAD_M))]
    up = np.array([0.0, -1.0, 0.0])
    road = T[:3, 3] - recording.camera.height_m * (T[:3, :3] @ up - up)
    return float(np.arctan2(-road[1], road[2]))
