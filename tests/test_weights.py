"""Eq. 4: the weights of the edges."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from birdslam.graph.weights import WeightsConfig, weighted
from birdslam.perf.latency.drive import DriveConfig, drive

FRAME = drive(DriveConfig(frames=40, vehicles=6), seed=3).measurements[-1]


def test_paper_mode_replaces_every_covariance_by_the_inverse_weight() -> None:
    m = weighted(FRAME, WeightsConfig(mode="paper"))
    assert m.cc.cov == (1e-4, 0, 0, 0, 1e-4, 0, 0, 0, 1e-4)
    assert all(e.cov == (1.0, 0, 0, 0, 1.0, 0, 0, 0, 1.0) for e in m.vv)
    assert all(e.cov == (1e-4, 0, 0, 1e-4) for e in m.cp)
    assert all(1e-3 <= e.cov[0] <= 1e-1 and e.cov[1] == 0 for e in m.cv)
    assert [e.T_ego_vehicle for e in m.cv] == [e.T_ego_vehicle for e in FRAME.cv]


def test_measured_mode_keeps_the_covariances_and_leaves_out_the_trackers_predictions() -> None:
    m = weighted(FRAME, WeightsConfig())
    assert m.cc == FRAME.cc
    assert m.cv == FRAME.cv
    assert m.vv == ()
    assert weighted(FRAME, WeightsConfig(leave_out=(), depth_threshold_m=None)) is FRAME


@pytest.mark.parametrize("mode", ["measured", "paper"])
def test_landmarks_beyond_the_threshold_are_left_out(mode: str) -> None:
    m = weighted(FRAME, WeightsConfig(mode=mode, depth_threshold_m=10.0))
    assert {e.landmark for e in m.cp} == {e.landmark for e in FRAME.cp if e.x_m <= 10.0}
    assert 0 < len(m.cp) < len(FRAME.cp)


@pytest.mark.parametrize("edge", ["cv", "vv", "cp"])
def test_an_edge_type_can_be_left_out(edge: str) -> None:
    m = weighted(FRAME, WeightsConfig(mode="paper", leave_out=(edge,)))
    assert getattr(m, edge) == ()
    assert all(getattr(m, other) for other in {"cv", "vv", "cp"} - {edge})


def test_without_cc_the_motion_is_only_a_guess() -> None:
    m = weighted(FRAME, WeightsConfig(leave_out=("cc",)))
    assert m.cc.T_from_to == FRAME.cc.T_from_to
    assert m.cc.cov[::4] == (1e3, 1e3, 1e3)  # lambda as good as 0


@given(st.floats(-10, 500), st.floats(-10, 500))
def test_cv_weighs_less_with_depth_within_the_papers_range(a: float, b: float) -> None:
    config = WeightsConfig()
    near, far = sorted((a, b))
    assert 10.0 <= config.cv_at(far) <= config.cv_at(near) <= 1000.0
    assert config.cv_at(0.0) == 1000.0
    assert config.cv_at(config.cv_far_m) == pytest.approx(10.0)
