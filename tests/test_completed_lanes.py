"""Completed lanes as constraints of the batch: without noise they move nothing, a drift sideways they hold."""

from __future__ import annotations

import numpy as np
import pytest
from msgspec.structs import replace

from birdslam.bench.baselines.posegraph3 import BatchConfig, optimise_batch
from birdslam.bench.tracking.completed_lanes import of_kind, with_completed_lanes
from birdslam.geometry.se2 import SE2
from birdslam.types import EgoEdge, LandmarkEdge, LandmarkKind, LanePoint, Measurements

FRAMES, SIDES_M = 25, (-1.75, 1.75)
COV = (1e-4, 0.0, 0.0, 0.0, 1e-4, 0.0, 0.0, 0.0, 1e-6)
METRIC = BatchConfig(metric=True, landmarks=True)


def straight(sideways_m: float) -> list[Measurements]:
    """A car on a straight road along x that is told to go `sideways_m` aside in each metre; lanes as one sees them."""
    log = []
    for frame in range(FRAMES):
        ahead = np.arange(2.0, 20.0, 0.5)
        lanes = tuple(LanePoint(float(x), y, lane) for lane, y in enumerate(SIDES_M) for x in ahead)
        cc = EgoEdge(from_frame=frame - 1, to_frame=frame, T_from_to=SE2(1.0, sideways_m), cov=COV) if frame else None
        seen = LandmarkEdge(
            landmark=999, frame=frame, x_m=9.0, y_m=0.0, cov=(1.0, 0.0, 0.0, 1.0), kind=LandmarkKind.LANE_STATION
        )
        t_ns = frame * 100_000_000
        log.append(
            Measurements(
                frame_id=frame, t_source_ns=t_ns, t_capture_ns=t_ns, t_utc_ns=t_ns, cc=cc, lanes=lanes, cp=(seen,)
            )
        )
    return log


def test_stations_are_the_same_from_frame_to_frame_and_lie_on_their_lanes() -> None:
    log = with_completed_lanes(straight(0.0))
    frames: dict[int, int] = {}
    for m in log:
        assert len(m.cp) > 4
        for edge in m.cp:
            assert (edge.kind, edge.landmark != 999) == (LandmarkKind.LANE_STATION, True)
            assert min(abs(edge.y_m - y) for y in SIDES_M) < 1e-9
            assert edge.cov[0] > 50.0 > 0.1 > edge.cov[3]  # along, across
            frames[edge.landmark] = frames.get(edge.landmark, 0) + 1
    assert max(frames.values()) >= 3
    assert not any(m.cp for m in of_kind(log, LandmarkKind.ROAD_POINT))


def test_lanes_without_an_id_and_frames_without_lanes_say_nothing() -> None:
    log = straight(0.0)
    log[3] = replace(log[3], lanes=())
    log[4] = replace(log[4], lanes=tuple(replace(point, lane=-1) for point in log[4].lanes))
    told = with_completed_lanes(log)
    assert (told[3].cp, told[4].cp) == ((), ())


def test_they_move_nothing_that_is_right_and_hold_what_drifts_sideways() -> None:
    exact = optimise_batch(with_completed_lanes(straight(0.0)), METRIC).ego[FRAMES - 1]
    assert (exact.x_m, exact.y_m) == pytest.approx((FRAMES - 1.0, 0.0), abs=1e-4)
    drifting = straight(0.02)
    free = optimise_batch(of_kind(drifting, LandmarkKind.ROAD_POINT), METRIC).ego[FRAMES - 1]
    held = optimise_batch(with_completed_lanes(drifting), METRIC).ego[FRAMES - 1]
    assert free.y_m == pytest.approx(0.02 * (FRAMES - 1.0), abs=1e-4)
    assert abs(held.y_m) < 0.2 * free.y_m
    assert held.x_m == pytest.approx(FRAMES - 1.0, abs=0.1)
