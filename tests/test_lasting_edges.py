"""Properties of the correlated part of a CV edge's error (graph/factors/lasting_error.py)."""

from __future__ import annotations

import cmath
import math

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from birdslam.geometry.arrays import Floats
from birdslam.geometry.se2 import SE2
from birdslam.graph.factors.lasting_error import lasting_correlation, line_of_sight_factor
from birdslam.graph.graph_config import GraphConfig
from birdslam.graph.pose_graph import PoseGraph
from birdslam.graph.weights import WeightsConfig
from tests.records import new_edge, step_at

SIGMAS_M = np.array([2.0, 0.3])  # along the line of sight, and across
EXACT = tuple(np.diag([1e-8, 1e-8, 1e-10]).ravel().tolist())
positive, numbers = st.floats(1e-3, 1e2), st.floats(-3.0, 3.0)


@given(st.floats(0.0, 2.0 * math.pi), numbers, numbers, numbers, numbers)
def test_factors_reproduce_covariance_along_line_of_sight(
    bearing_rad: float, a: float, b: float, c: float, d: float
) -> None:
    A = np.array([[a, b], [c, d]])
    covs = np.zeros((1, 3, 3))
    covs[0, :2, :2] = A @ A.T  # singular ones, too
    (xx, xy), (_, yy) = (A @ A.T).tolist()
    columns = line_of_sight_factor(cmath.rect(1.0, bearing_rad), 0.5 * (xx + yy), complex(0.5 * (xx - yy), xy))
    F = np.array([[[c.real for c in columns], [c.imag for c in columns]]])
    np.testing.assert_allclose(F @ F.transpose(0, 2, 1), covs[:, :2, :2], atol=1e-5 * (1.0 + covs.max()))
    across = np.array([-math.sin(bearing_rad), math.cos(bearing_rad)])
    np.testing.assert_allclose(abs(across @ F[0, :, 1]), np.linalg.norm(F[0, :, 1]), rtol=1e-9)


@given(st.tuples(positive, positive), st.tuples(positive, positive), st.floats(0.0, 100.0), positive)
def test_error_is_fully_correlated_without_change(
    now: tuple[float, float], before: tuple[float, float], driven_s: float, memory_s: float
) -> None:
    of, driven = (
        lasting_correlation(np.array([now]), np.array([before]), np.array([driven_s]), memory_s),
        np.array([driven_s]),
    )
    assert (of >= 0.0).all()
    assert (of <= 1.0).all()
    np.testing.assert_array_equal(of, lasting_correlation(np.array([before]), np.array([now]), driven, memory_s))
    np.testing.assert_array_equal(lasting_correlation(np.array([now]), np.array([now]), np.zeros(1), memory_s), 1.0)


def variances(frames: int, ego_mps: float, config: GraphConfig) -> Floats:
    """(2,) of a standing vehicle's place along and across the line of sight, seen in so many frames at 10 Hz."""
    graph = PoseGraph(config, WeightsConfig())
    for k in range(frames):
        step = SE2(ego_mps / 10.0)
        seen = new_edge(1, k, SE2(60.0 - k * step.x_m), (*np.square(SIGMAS_M).tolist(), 0.01))
        (vehicle,) = graph.optimise(step_at(k, step, cov=EXACT, cv=(seen,))).vehicles
    return np.diag(np.reshape(vehicle.cov, (3, 3)))[:2]


def test_correlated_error_does_not_average_out() -> None:
    steady = {"change_forward_mps": 1e-3, "change_sideways_mps": 1e-3, "birth_forward_mps": 1e-2}
    config = GraphConfig(**steady, birth_sideways_mps=1e-2)
    floor = config.lasting_share * np.square(SIGMAS_M)
    assert (variances(300, 0.0, config) > 0.95 * floor).all()  # a stationary ego always observes the same
    driven, standing = (variances(40, mps, config) for mps in (10.0, 0.0))
    assert (driven < standing).all()  # new road, new errors
    assert (variances(300, 0.0, GraphConfig(**steady, birth_sideways_mps=1e-2, lasting_share=0.0)) < 0.1 * floor).all()
