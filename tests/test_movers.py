"""Standing tracks that are reported to drive, and the road by labels, on made-up sequences."""

from __future__ import annotations

import math

import numpy as np
import pytest

from birdslam.bench.simulation.odometry import EXACT, OdometryNoise, SimulatedOdometry
from birdslam.bench.simulation.tilt_from_images import TiltFromImages
from birdslam.bench.tracking.labelled_road import labelled_grounds
from birdslam.bench.tracking.localisation import ego_speeds_mps
from birdslam.bench.tracking.movers import MoversRow, movers_row
from birdslam.bench.tracking.tables import movers_table
from birdslam.geometry.camera import Camera
from birdslam.geometry.se2 import SE2
from birdslam.sources.kitti_tracking import TrackingSequence
from birdslam.sources.label_projection import Label
from birdslam.types import Estimate, Measurements, Moves, VehicleEdge, VehicleEstimate

CAMERA = Camera(1242, 375, 721.5, 721.5, 609.6, 172.9, 1.65)
COV, FRAMES = tuple(np.eye(3).ravel()), 40
PITCH_RAD, ROLL_RAD = 0.012, 0.03
SPEEDS_MPS = (0.0, 0.0, 8.0)  # of three cars


def labelled(track: int, frame: int) -> Label:
    x_m, y_m = 15.0 + 8.0 * track + SPEEDS_MPS[track] * frame / 10.0, 4.0 - 4.0 * track
    down_m = 1.65 + x_m * (-PITCH_RAD + ROLL_RAD * y_m / x_m)
    box = (100.0 * track, 100.0, 100.0 * track + 60.0, 150.0)
    return Label(frame, track, "Car", 0.0, 0, box, 1.5, 1.6, 3.9, (-y_m, down_m, x_m), -math.pi / 2)


def sequence_of(ego_mps: float = 0.0) -> TrackingSequence:
    labels = [labelled(track, frame) for frame in range(FRAMES) for track in range(3)]
    poses = np.tile(np.eye(4), (FRAMES, 1, 1))
    poses[:, 2, 3] = ego_mps / 10.0 * np.arange(FRAMES)
    return TrackingSequence("9999", CAMERA, np.eye(4), poses, tuple(labels), None)


def told(sequence: TrackingSequence, drives: dict[int, range]) -> MoversRow:
    """Car k is vehicle 10 + k, and is reported to drive in these frames."""
    log, estimates = [], []
    for frame in range(FRAMES):
        here, times = sequence.labels_of(frame), {"t_source_ns": 0, "t_capture_ns": 0, "t_utc_ns": 0}
        cv = tuple(
            VehicleEdge(
                vehicle=10 + one.track, frame=frame, T_ego_vehicle=SE2(15.0, 0.0, 0.0), cov=COV, box_px=one.box_px
            )
            for one in here
        )
        log.append(Measurements(frame_id=frame, cv=cv, **times))
        vehicles = tuple(
            VehicleEstimate(
                vehicle=10 + one.track,
                T_world_vehicle=SE2(),
                cov=COV,
                velocity_mps=(5.0, 0.0) if frame in drives.get(one.track, ()) else (0.0, 0.0),
                velocity_cov=(1.0, 0.0, 0.0, 1.0),
                age_ns=0,
                frames=5,
                moves=Moves.DRIVING if frame in drives.get(one.track, ()) else Moves.UNDECIDED,
            )
            for one in here
        )
        estimates.append(
            Estimate(epoch=0, frame_id=frame, T_world_ego=SE2(), cov=COV, valid=True, vehicles=vehicles, **times)
        )
    return movers_row(sequence, log, estimates, "truth")


def test_a_parked_car_that_is_reported_to_drive_is_counted_once_with_its_place() -> None:
    row = told(sequence_of(), {0: range(12, 15), 2: range(0, FRAMES)})
    assert (row.standing, row.driving, row.reported, row.soon) == (2, 1, 1, 1)
    (false,) = row.false
    assert (false.vehicle, false.label, false.frame, false.sights) == (10, 0, 12, 3)
    assert (false.x_m, false.y_m, false.reported_mps) == pytest.approx((15.0, 4.0, 5.0))
    assert "15, 4: 5.0" in movers_table([row])


@pytest.mark.parametrize(("first", "soon"), [(15, 1), (16, 0), (FRAMES, 0)])
def test_a_driver_is_told_soon_within_a_second_of_its_first_known_speed(first: int, soon: int) -> None:
    row = told(sequence_of(), {2: range(first, FRAMES)})
    assert (row.driving, row.reported, row.soon) == (1, int(first < FRAMES - 5), soon)
    assert not row.false


def test_labels_tell_the_road_and_images_err_from_it_as_they_do() -> None:
    sequence = sequence_of(ego_mps=5.0)
    grounds = labelled_grounds(sequence)
    for labelled_ground in grounds:
        assert labelled_ground is not None
        assert labelled_ground.vehicles == 3
        assert labelled_ground.ground.pitch_rad == pytest.approx(PITCH_RAD, abs=2.0 * labelled_ground.sigma_pitch_rad)
        assert labelled_ground.ground.roll_rad == pytest.approx(ROLL_RAD, abs=2.0 * labelled_ground.sigma_roll_rad)
    np.testing.assert_allclose(ego_speeds_mps(sequence), 5.0)
    errors, noise = [], OdometryNoise()
    for seed in range(40):
        rng = np.random.default_rng(seed)
        planes = [None if one is None else one.ground for one in grounds]
        odometry = TiltFromImages(SimulatedOdometry(CAMERA, sequence.camera_poses, EXACT, rng), planes, noise, rng)
        motions = [odometry.estimate(None, frame, 0, np.zeros((0, 4))) for frame in range(FRAMES)]
        assert motions[0] is None
        last = motions[-1]
        assert last is not None
        assert planes[-1] is not None
        errors.append((last.ground.pitch_rad - planes[-1].pitch_rad) / last.pitch_sigma_rad)
    assert 0.6 < float(np.std(errors)) < 1.4


def test_a_standing_ego_is_told_no_tilt() -> None:
    sequence, rng = sequence_of(), np.random.default_rng(0)
    planes = [None if one is None else one.ground for one in labelled_grounds(sequence)]
    odometry = TiltFromImages(
        SimulatedOdometry(CAMERA, sequence.camera_poses, EXACT, rng), planes, OdometryNoise(), rng
    )
    motions = [odometry.estimate(None, frame, 0, np.zeros((0, 4))) for frame in range(5)]
    assert all(motion.ground == CAMERA.ground for motion in motions if motion is not None)
