"""The tilt of the road from labels, on made-up sequences."""

from __future__ import annotations

import math

import numpy as np
import pytest

from birdslam.bench.simulation.odometry import EXACT, OdometryNoise, SimulatedOdometry
from birdslam.bench.simulation.tilt_from_images import TiltFromImages
from birdslam.bench.tracking.labelled_road import labelled_grounds
from birdslam.geometry.camera import Camera
from birdslam.sources.kitti_tracking import TrackingSequence
from birdslam.sources.label_projection import Label

CAMERA = Camera(1242, 375, 721.5, 721.5, 609.6, 172.9, 1.65)
FRAMES = 40
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


def test_labels_tell_the_road_and_images_err_from_it_as_they_do() -> None:
    sequence = sequence_of(ego_mps=5.0)
    grounds = labelled_grounds(sequence)
    for ground in grounds:
        assert ground.pitch_rad == pytest.approx(PITCH_RAD, abs=0.01)
        assert ground.roll_rad == pytest.approx(ROLL_RAD, abs=0.02)
    errors, noise = [], OdometryNoise()
    for seed in range(40):
        rng = np.random.default_rng(seed)
        odometry = TiltFromImages(SimulatedOdometry(CAMERA, sequence.camera_poses, EXACT, rng), grounds, noise, rng)
        motions = [odometry.estimate(None, frame, 0, np.zeros((0, 4))) for frame in range(FRAMES)]
        assert motions[0] is None
        last = motions[-1]
        errors.append((last.ground.pitch_rad - grounds[-1].pitch_rad) / last.pitch_sigma_rad)
    assert 0.6 < float(np.std(errors)) < 1.4
