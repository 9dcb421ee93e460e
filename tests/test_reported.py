"""Reported estimates of labelled cars: each figure on synthetic estimates with known errors."""

from __future__ import annotations

import math

import pytest
from msgspec.structs import replace

from birdslam.bench.tracking.reported import HALF_SPAN, Sight, motion_row, range_rows, sights
from birdslam.geometry.se2 import SE2
from birdslam.sources.kitti_tracking import TrackingSequence, open_tracking
from birdslam.types import Estimate, VehicleEstimate
from tests import tracking_world

EYE = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
RATE_HZ = 10.0


@pytest.fixture(scope="module")
def sequence(tmp_path_factory: pytest.TempPathFactory) -> TrackingSequence:
    return open_tracking(tracking_world.write(tmp_path_factory.mktemp("told")), "0002")


def told(
    sequence: TrackingSequence, frame: int, too_far_rel: float = 0.0, aside_m: float = 0.0, speed_up_mps: float = 0.0
) -> Estimate:
    """An estimate whose vehicles err by this amount, in a world that is turned and moved against the first frame's."""
    T_world_ego = SE2(40.0, -7.0, 2.0)
    vehicles = []
    for label in sequence.labels_of(frame):
        at = sequence.vehicle_truth(label, frame)
        car = next(car for car in tracking_world.CARS if car.track == label.track)
        speed_mps = car.step_m * RATE_HZ + speed_up_mps
        vehicles.append(
            VehicleEstimate(
                vehicle=label.track + 100,
                T_world_vehicle=T_world_ego @ SE2(at.x_m * (1.0 + too_far_rel), at.y_m + aside_m, at.yaw_rad),
                cov=EYE,
                velocity_mps=(speed_mps * math.cos(2.0), speed_mps * math.sin(2.0)),
                velocity_cov=(1.0, 0.0, 0.0, 1.0),
                age_ns=0,
                frames=3,
            )
        )
    return Estimate(
        epoch=0,
        frame_id=frame,
        t_source_ns=0,
        t_capture_ns=0,
        t_utc_ns=0,
        T_world_ego=T_world_ego,
        cov=EYE,
        valid=True,
        vehicles=tuple(vehicles),
    )


def test_exact_estimates_are_found_without_error(sequence: TrackingSequence) -> None:
    seen = sights(sequence, [told(sequence, k) for k in range(HALF_SPAN, 20)])
    rows = range_rows("0002", seen)
    assert sum(row.asked for row in rows) == sum(row.found for row in rows) == len(seen) == 15 * 3
    for row in (row for row in rows if row.asked):
        assert row.depth_error_median_rel == pytest.approx(0.0, abs=1e-9)
        assert row.across_error_median_m == pytest.approx(0.0, abs=1e-9)
    motion = motion_row("0002", seen)
    assert motion.velocity_error_median_mps == pytest.approx(0.0, abs=1e-6)
    assert (motion.standing, motion.driving, motion.false_movers, motion.missed_movers) == (15, 30, 0, 0)


def test_errors_are_told_with_their_sign_until_a_car_is_lost(sequence: TrackingSequence) -> None:
    def of(**errors: float) -> list[tuple[int, float | None, float | None]]:
        rows = range_rows("0002", sights(sequence, [told(sequence, 8, **errors)]))
        return [(row.found, row.depth_bias_median_rel, row.across_error_median_m) for row in rows if row.asked]

    for found, bias, across in of(too_far_rel=0.1, aside_m=0.5):
        assert found >= 1
        assert bias == pytest.approx(0.1)
        assert across == pytest.approx(0.5)
    assert {found for found, *_ in of(too_far_rel=-0.21)} == {0}
    assert {found for found, *_ in of(aside_m=1.6)} == {0}


def test_standing_cars_reported_as_driving_are_counted_and_the_reverse(sequence: TrackingSequence) -> None:
    for speed_up_mps, false_movers, missed_movers in ((1.4, 0, 0), (1.6, 1, 0), (-8.0, 1, 1), (-10.0, 1, 2)):
        row = motion_row("0002", sights(sequence, [told(sequence, 10, speed_up_mps=speed_up_mps)]))
        assert (row.standing, row.driving) == (1, 2)
        assert (row.false_movers, row.missed_movers) == (false_movers, missed_movers), speed_up_mps
        assert row.false_movers_sure == (abs(speed_up_mps) > 3.5)  # the sigma that is told with it is 1 m/s
        assert row.velocity_error_median_mps == pytest.approx(abs(speed_up_mps))


@pytest.mark.parametrize(("sigma_mps", "sure"), [(0.2, 1), (0.3, 0)])
def test_a_driving_car_reported_as_surely_standing_is_counted_apart(sigma_mps: float, sure: int) -> None:
    sight = Sight(7, 20.0, (5.0, 0.0), error_m=(0.0, 0.0), reported_mps=(1.0, 0.0), reported_sigma_mps=sigma_mps)
    row = motion_row("0002", [sight])
    assert (row.driving, row.missed_movers, row.missed_movers_sure) == (1, 1, sure)


def test_one_estimate_is_found_for_one_car_alone(sequence: TrackingSequence) -> None:
    estimate = told(sequence, 10)
    alone = sights(sequence, [replace(estimate, vehicles=estimate.vehicles[:1] * 2)])
    assert sum(sight.error_m is not None for sight in alone) == 1
    nobody = sights(sequence, [replace(estimate, vehicles=())])
    assert [sight.error_m for sight in nobody] == [None] * 3


def test_without_any_car_there_are_no_figures() -> None:
    assert [(row.asked, row.found) for row in range_rows("x", [])] == [(0, 0)] * 3
    empty = motion_row("x", [Sight(1, 10.0, None)])
    assert (empty.asked, empty.velocity_error_median_mps) == (0, None)
