"""Relative NEES: a consistent covariance has 1, an overconfident one more."""

from __future__ import annotations

import math
from dataclasses import replace as with_

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from birdslam.bench.ego.motion_consistency import nees_of_length
from birdslam.bench.simulation.odometry import EXACT
from birdslam.bench.tracking.benchmark import ours
from birdslam.bench.tracking.relative_nees import NeesRow, nees_rows, over_seeds
from birdslam.bench.tracking.tables import nees_table
from birdslam.geometry.se2 import SE2
from birdslam.slam import SlamConfig
from birdslam.sources.kitti_tracking import TrackingSequence, open_tracking
from birdslam.types import Measurements
from tests import tracking_world
from tests.test_tracking_evaluation import log_of

SIGMA = np.array([0.3, 0.2, 0.05])  # m, m, rad, of a vehicle's edge
LIVE = ours(SlamConfig())


@given(st.floats(0.1, 30.0), st.floats(-math.pi, math.pi), st.floats(-1.0, 1.0), st.floats(0.002, 0.2))
def test_a_length_that_errs_by_its_sigma_has_1(length_m: float, course_rad: float, yaw_rad: float, rel: float) -> None:
    """Whatever way it goes, and however the car stands at its end; what errs across does not count."""
    along = np.array([math.cos(course_rad), math.sin(course_rad)])
    told = SE2(*((1.0 + rel) * length_m * along).tolist(), yaw_rad)
    here = SE2(0.0, 0.0, -yaw_rad).rotation() @ along
    across = np.array([-here[1], here[0]])
    cov = np.eye(3)
    cov[:2, :2] = (rel * length_m) ** 2 * np.outer(here, here) + 100.0 * np.outer(across, across)
    assert nees_of_length(told, cov, length_m) == pytest.approx(1.0, rel=1e-6)


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> tuple[TrackingSequence, list[Measurements]]:
    root = tracking_world.write(tmp_path_factory.mktemp("tracking"))
    sequence = open_tracking(root, "0002")
    return sequence, log_of(sequence, root, EXACT)


def noisy(sequence: TrackingSequence, log: list[Measurements], times: float) -> list[Measurements]:
    """Vehicles' edges at the truth but for `times` the noise that they state, again in each frame; sizes are known."""
    rng = np.random.default_rng(1)
    cov = tuple(np.diag(SIGMA**2).ravel().tolist())
    first, out = log[0].frame_id, []
    for m in log:
        labels = {label.track: sequence.vehicle_truth(label, first) for label in sequence.labels_of(m.frame_id)}
        ego, cv = sequence.ego_truth(first)[m.frame_id], []
        for edge in m.cv:
            seen = edge.T_ego_vehicle
            places = [ego.between(pose) for pose in labels.values()]
            gaps = [math.hypot(place.x_m - seen.x_m, place.y_m - seen.y_m) for place in places]
            near = places[int(np.argmin(gaps))]
            noise = SE2.exp(times * SIGMA * rng.standard_normal(3))
            cv.append(replace(edge, T_ego_vehicle=near @ noise, cov=cov, sigma_log_height=0.0))
        out.append(replace(m, cv=tuple(cv), vv=()))
    return out


def rows_of(sequence: TrackingSequence, log: list[Measurements]) -> dict[tuple[str, str], NeesRow]:
    return {(row.of, row.per): row for row in nees_rows(sequence, log, LIVE, "truth")}


def test_vehicles_that_err_as_they_state_have_1(world: tuple[TrackingSequence, list[Measurements]]) -> None:
    sequence, log = world
    honest, sure = (rows_of(sequence, noisy(sequence, log, times)) for times in (1.0, 3.0))
    assert set(honest) == {(of, per) for of in ("ego", "scale", "vehicles") for per in ("frame", "10 m")}
    for per in ("frame", "10 m"):
        row = honest["vehicles", per]
        assert row.bodies == 3
        assert row.nees is not None
        assert 0.4 < row.nees < 2.0
        too_sure = sure["vehicles", per].nees
        assert too_sure is not None
        assert too_sure > 4.0 * row.nees  # nine times, less what gates on outliers make of it
    assert "| 0002 | true odometry | vehicles | frame |" in nees_table(list(honest.values()))


def test_without_vehicles_there_is_nothing_to_judge(world: tuple[TrackingSequence, list[Measurements]]) -> None:
    sequence, log = world
    bare = rows_of(with_(sequence, labels=()), log)
    assert (bare["vehicles", "frame"].n, bare["vehicles", "frame"].nees) == (0, None)


def test_seeds_count_by_what_each_of_them_judged() -> None:
    row = NeesRow(sequence="0002", odometry="simulate", of="ego", per="frame", n=30, nees=1.0, nees_median=0.5)
    seeds = [[row], [msgspec.structs.replace(row, n=10, nees=2.0)], [msgspec.structs.replace(row, n=0, nees=None)]]
    (both,) = over_seeds(seeds)
    assert (both.n, both.nees, both.nees_median) == (40, 1.25, 0.5)
    (none,) = over_seeds([[msgspec.structs.replace(row, n=0, nees=None, nees_median=None)]] * 2)
    assert (none.n, none.nees, none.nees_median) == (0, None, None)
