"""Consistency of the ego's covariance: errors drawn from it have NEES 1, others the ratio of the variances."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from birdslam.bench.ego.consistency import CERTAIN_M, Consistency
from birdslam.geometry.camera import GroundPlane
from birdslam.geometry.se2 import SE2
from birdslam.trajectory import ego_pose, inverse, mount_pose
from birdslam.types import Attitude, Estimate, Status

MOUNT = GroundPlane(height_m=1.6, pitch_rad=0.05, roll_rad=-0.02)
START = SE2(3.0, -2.0, 0.7)


def way(frames: int) -> list[SE2]:
    """A bend that goes on, from the origin."""
    steps = [SE2(0.9, 0.02, 0.04)] * (frames - 1)
    poses = [SE2()]
    for step in steps:
        poses.append(poses[-1] @ step)
    return poses


def estimate(frame_id: int, T_world_ego: SE2, covariance: NDArray[np.float64], **fields: object) -> Estimate:
    plain = Estimate(
        epoch=0,
        frame_id=frame_id,
        t_source_ns=0,
        t_capture_ns=0,
        t_utc_ns=0,
        T_world_ego=T_world_ego,
        cov=tuple(covariance.ravel()),
        valid=True,
    )
    return msgspec.structs.replace(plain, **fields)


def camera_poses(egos: list[SE2]) -> NDArray[np.float64]:
    """`T_first_i` of the camera that rides on the egos."""
    T_ego_cam = mount_pose(MOUNT)
    poses = np.array([ego_pose(ego, Attitude()) @ T_ego_cam for ego in egos])
    out: NDArray[np.float64] = inverse(poses[0]) @ poses
    return out


EGOS = way(1000)
TRUTH = camera_poses(EGOS)


@given(told=st.floats(0.3, 3.0), seed=st.integers(0, 2**32 - 1))
@example(told=1.0, seed=0)
@settings(max_examples=8)
def test_an_honest_covariance_has_a_nees_of_one_and_a_narrower_one_more(told: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    consistency = Consistency(MOUNT)
    L = np.array([[0.5, 0.0, 0.0], [0.1, 0.3, 0.0], [0.004, 0.01, 0.02]])
    for index, ego in enumerate(EGOS):
        error = SE2.exp(L @ rng.standard_normal(3)) if index else SE2()
        consistency.add(estimate(index, START @ ego @ error, told**2 * L @ L.T))
    report = consistency.report(TRUTH)
    assert report.frames == len(EGOS)
    assert report.nees == pytest.approx(1.0 / told**2, rel=0.12)
    if told == 1.0:
        assert report.inside_95 == pytest.approx(0.95, abs=0.02)
    assert report.inside_95 is not None
    assert (report.inside_95 > 0.95) == (told > 1.0) or abs(told - 1.0) < 0.1


def test_what_is_invalid_or_certain_or_of_no_frame_is_not_held_to_the_truth() -> None:
    egos = way(4)
    sure, doubtful = np.eye(3) * (0.5 * CERTAIN_M) ** 2, np.eye(3)
    consistency = Consistency(MOUNT)
    consistency.add(estimate(0, egos[0], sure))
    consistency.add(estimate(1, SE2(99.0, 0.0, 0.0), doubtful, valid=False))
    consistency.add(estimate(2, egos[2] @ SE2(1.0, 0.0, 0.0), doubtful))
    consistency.add(estimate(3, egos[3], doubtful))
    consistency.add(estimate(4, SE2(99.0, 0.0, 0.0), doubtful, status=(Status.END_OF_SOURCE,)))
    report = consistency.report(camera_poses(egos))
    assert (report.frames, report.inside_95) == (2, 1.0)
    assert report.nees == pytest.approx(0.5 / 3.0, rel=1e-6)


def test_a_new_epoch_begins_at_the_truth() -> None:
    egos = way(6)
    again = SE2(1.0, 2.0, -0.4)  # where the second world has the ego at its begin
    consistency = Consistency(MOUNT)
    for index, ego in enumerate(egos):
        epoch, pose = (0, ego) if index < 3 else (1, again @ egos[3].between(ego))
        consistency.add(estimate(index, pose, np.eye(3), epoch=epoch))
    assert consistency.report(camera_poses(egos)).nees == pytest.approx(0.0, abs=1e-9)


def test_nothing_stated_is_nothing_judged() -> None:
    report = Consistency(MOUNT).report(camera_poses(way(2)))
    assert (report.frames, report.nees, report.inside_95) == (0, None, None)
