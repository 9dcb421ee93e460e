"""The prior of heights: a drive's common part and Student's t; and information on the tilt."""

from __future__ import annotations

import math

import numpy as np
import pytest

from birdslam.geometry.camera import Camera, GroundPlane
from birdslam.road_users.state.ground_size_config import GroundSizeConfig
from birdslam.road_users.state.ground_size_filter import GroundSizeFilter
from birdslam.road_users.state.size_prior import SizePrior

CAMERA = Camera(1242, 375, 721.5, 721.5, 609.6, 172.9, 1.65)
SIGMA, COMMON, DOF = 0.08, 0.025, 4.0
AT = np.array([1, 2])  # of log h of two vehicles, after what they share


def born(dof: float = DOF) -> tuple[SizePrior, np.ndarray, np.ndarray]:
    """Two new vehicles: the prior, the state (common, log h, log h), and its covariance."""
    prior, x, P = SizePrior(COMMON, dof), np.zeros(3), np.zeros((3, 3))
    P[0, 0] = COMMON**2
    for k in AT:
        share, own = prior.add_vehicle(1.5, SIGMA)
        x[k] = math.log(1.5)
        P[k] = P[:, k] = share * P[:, 0]
        P[k, k] = share * P[0, 0] + own
    P[1, 2] = P[2, 1] = COMMON**2
    return prior, x, P


def measured(x: np.ndarray, P: np.ndarray, log_height: float, sigma: float) -> tuple[np.ndarray, np.ndarray]:
    gain = P[:, 1] / (P[1, 1] + sigma**2)
    return x + gain * (log_height - x[1]), P - np.outer(gain, P[1])


def test_height_prior_has_class_spread_and_common_part() -> None:
    prior, x, P = born()
    assert math.sqrt(P[1, 1]) == pytest.approx(SIGMA)
    same_x, same_P = prior.reweigh([0, 1], x, P, AT, 0)
    assert same_x == pytest.approx(x)
    assert same_P == pytest.approx(P)
    x, _ = measured(x, P, math.log(1.6), 0.01)
    assert math.log(1.5) < x[2] < x[1]  # a taller car raises the common part


@pytest.mark.parametrize(("height_m", "nearer"), [(1.85, True), (1.5, False)])
def test_heavy_tails_allow_tall_cars(height_m: float, nearer: bool) -> None:
    found = {}
    for dof in (DOF, math.inf):
        prior, x, P = born(dof)
        for _ in range(6):
            x, P = prior.reweigh([0, 1], *measured(x, P, math.log(height_m), 0.12), AT, 0)
        found[dof] = x[1], math.sqrt(P[1, 1])
        assert np.linalg.eigvalsh(P).min() > 0.0
    off = {dof: abs(height - math.log(height_m)) for dof, (height, _) in found.items()}
    if nearer:
        assert off[DOF] < 0.8 * off[math.inf]
        assert found[DOF][1] > found[math.inf][1]
    else:
        assert found[DOF][1] < found[math.inf][1]


def test_reweighting_equals_a_prior_of_that_weight() -> None:
    prior, x, P = born()
    x, P = prior.reweigh([0, 1], *measured(x, P, math.log(1.9), 0.05), AT, 0)
    information = np.zeros((3, 3))
    information[0, 0] = COMMON**-2
    own, variance = x[AT] - x[0] - math.log(1.5), P[AT, AT] - 2.0 * P[AT, 0] + P[0, 0]
    scale2 = (SIGMA**2 - COMMON**2) * (1.0 - 2.0 / DOF)
    for k, along in zip(range(2), (np.array([-1.0, 1.0, 0.0]), np.array([-1.0, 0.0, 1.0])), strict=True):
        weight = (DOF - 1.0) / (DOF + (own[k] ** 2 + variance[k]) / scale2)
        information += np.outer(along, along) * weight / scale2
    information[1, 1] += 0.05**-2
    # The weight was taken at the state before it was changed: one step of a fixed point
    assert np.linalg.inv(information)[1, 1] == pytest.approx(P[1, 1], rel=0.1)


def test_changed_prior_equals_initial_prior() -> None:
    prior, x, P = born()
    x, P = measured(x, P, math.log(1.55), 0.05)
    changed_x, changed_P = prior.replace(0, x, P, (1, 0), 2.1, 0.12)
    own = 0.12**2 - COMMON**2
    _, fresh_x, fresh_P = born()
    fresh_x[1], fresh_P[1, 1] = math.log(2.1), own + COMMON**2
    fresh_x, fresh_P = measured(fresh_x, fresh_P, math.log(1.55), 0.05)
    assert changed_x == pytest.approx(fresh_x)
    assert changed_P == pytest.approx(fresh_P)


def test_correlated_roll_error_stays_in_the_sigma() -> None:
    ground_size = GroundSizeFilter(CAMERA, GroundSizeConfig())
    for k in range(300):
        tilt = GroundPlane(CAMERA.height_m, 0.0, 0.008 + 1e-9 * k)
        ground_size.predict(0.1, 0.0, tilt, np.eye(2) * 0.002**2, 1.0)
    assert math.sqrt(ground_size.tilt_cov[1, 1]) > 0.003  # 300 images are not 300 errors
    assert 0.0 < ground_size.ground.roll_rad < 0.008
