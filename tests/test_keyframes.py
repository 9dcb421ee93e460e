"""The scale of the keyframe window: images do not determine it, so it must not drift."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from birdslam.geometry.arrays import Floats
from birdslam.geometry.pose import Pose
from birdslam.odometry.corners.keyframes import KeyframeConfig, KeyframeWindow
from birdslam.odometry.corners.resection import resect
from birdslam.odometry.corners.sliding_window import match_ids
from birdslam.odometry.median import quantile
from birdslam.odometry.scale_config import RoadScaleConfig

FOCAL_PX, HALF_XY = 370.0, (0.86, 0.26)  # of the shipped drive's camera; half the image in normalised coordinates
STEP_M = 0.45
POINTS = 700


def unit_of_length(seed: int, way_m: float, sigma_px: float) -> Floats:
    """Estimated over true length of pieces of a straight street between points at both sides, seen with noise.

    The first two poses are the true ones; afterwards the scale is not observable.
    """
    rng = np.random.default_rng(seed)
    side = rng.choice([-1.0, 1.0], POINTS)
    points = np.column_stack(
        [side * rng.uniform(3.0, 8.0, POINTS), rng.uniform(-4.0, 1.5, POINTS), rng.uniform(3.0, way_m + 50.0, POINTS)]
    )
    window = KeyframeWindow(FOCAL_PX, KeyframeConfig())
    step = Pose(np.eye(3), np.array([0.0, 0.0, STEP_M]))
    poses = [Pose(np.eye(3), np.zeros(3))]
    for frame in range(int(way_m / STEP_M)):
        at = points - frame * step.p
        near = np.flatnonzero((at[:, 2] > 3.0) & (at[:, 2] < 50.0))
        xy = at[near, :2] / at[near, 2:]
        seen = (np.abs(xy) < HALF_XY).all(axis=1)
        ids, xy = near[seen], xy[seen] + rng.normal(0.0, sigma_px / FOCAL_PX, (int(seen.sum()), 2))
        if frame == 0:
            window.append(frame, poses[0], ids, xy)
            continue
        pose = poses[-1] @ step
        if frame > 1:
            pose, _, _ = resect(window, poses[-1] @ poses[-2].between(poses[-1]), ids, xy)
        window.extend(frame, pose, ids, xy)
        poses.append(window.refine())
    ways_m = [float(np.linalg.norm(b.p - a.p)) for a, b in zip(poses[9::3], poses[12::3], strict=False)]
    return np.array(ways_m) / (3 * STEP_M)


def test_scale_drifts_no_faster_than_stated_to_the_road_filter() -> None:
    """Over 60 m of 4 streets: the root mean square of what it walked, in which a drift to one side would show too."""
    way_m, walked = 60.0, []
    for seed in range(4):
        unit = np.log(unit_of_length(seed, way_m, 0.35))
        walked.append(unit[-8:].mean() - unit[:8].mean())
    assert np.sqrt(np.mean(np.square(walked))) < RoadScaleConfig().scale_walk_rel_per_sqrt_m * np.sqrt(way_m)


@given(st.sets(st.integers(0, 40)), st.sets(st.integers(0, 40)))
def test_common_ids_match_numpy(a: set[int], b: set[int]) -> None:
    first, second = (np.array(sorted(ids), dtype=np.int64) for ids in (a, b))
    _, at_first, at_second = np.intersect1d(first, second, return_indices=True)
    found = match_ids(first, second)
    assert found[0].tolist() == at_first.tolist()
    assert found[1].tolist() == at_second.tolist()


@given(st.lists(st.floats(-1e3, 1e3), min_size=1, max_size=30), st.floats(0.0, 1.0))
def test_quantile_matches_numpy(values: list[float], share: float) -> None:
    assert quantile(np.array(values), share) == pytest.approx(float(np.quantile(values, share)), abs=1e-9)
