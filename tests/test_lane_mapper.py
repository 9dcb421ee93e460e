"""Lanes in the front end: on their schedule, never awaited, reported when late, and their edges in the measurements."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future
from typing import Any

import numpy as np
import pytest

from birdslam.geometry import bev
from birdslam.geometry.camera import Camera
from birdslam.geometry.se2 import SE2
from birdslam.lanes.amodal.landmark_edges import StaticMapConfig
from birdslam.lanes.amodal.lane_edges import LaneEdgesConfig
from birdslam.lanes.amodal.lane_mapper import LaneHead, LaneMapper, LaneOutput
from birdslam.lanes.amodal.lanes import Grids
from birdslam.perception import Segmentation
from birdslam.types import LandmarkKind, Status

CAMERA = Camera(
    width_px=640, height_px=192, fx_px=370.0, fy_px=370.0, cx_px=320.0, cy_px=88.0, height_m=1.6, pitch_rad=0.02
)
NOBODY = np.zeros((0, 4))
SIGMA_TILT = (0.003, 0.003)  # of pitch and roll
STEP_M = 0.5


def masks() -> Segmentation:
    """A straight road with a line on either side."""
    rows, columns = np.mgrid[: CAMERA.height_px, : CAMERA.width_px]
    px = np.column_stack([columns.ravel(), rows.ravel()]).astype(np.float64)
    y_m = bev.pixel_to_ego(CAMERA, CAMERA.ground, px)[:, 1].reshape(rows.shape)
    with np.errstate(invalid="ignore"):
        return Segmentation(road=np.abs(y_m) < 5.0, lane=(np.abs(y_m - 3.0) < 0.15) | (np.abs(y_m + 2.0) < 0.15))


MASKS = masks()


class Counted:
    """A completion that changes nothing."""

    def __init__(self) -> None:
        self.runs = 0

    def __call__(self, grids: Grids) -> Grids:
        self.runs += 1
        return grids


class Elsewhere:
    """Runs submitted work on request."""

    def __init__(self) -> None:
        self.waiting: list[tuple[Future[Any], Callable[..., Any], tuple[Any, ...]]] = []

    def __call__(self, run: Callable[..., Any], *arguments: Any) -> Future[Any]:
        future: Future[Any] = Future()
        self.waiting.append((future, run, arguments))
        return future

    def work(self) -> None:
        for future, run, arguments in self.waiting:
            future.set_result(run(*arguments))
        self.waiting.clear()


class Driver:
    """Straight on, by this amount a frame."""

    def __init__(self, head: LaneHead) -> None:
        self.mapper = LaneMapper(CAMERA, StaticMapConfig(), head=head)
        self.frame = -1

    def step(self, segmentation: Segmentation | None = MASKS) -> LaneOutput:
        self.frame += 1
        T_world_ego = SE2(STEP_M * self.frame)
        return self.mapper.map_lanes(
            self.frame, T_world_ego, CAMERA.ground, SIGMA_TILT, segmentation, self.frame, NOBODY
        )


@pytest.mark.parametrize("every", [1, 4, 7])
def test_lanes_run_on_their_schedule_and_report_their_age(every: int) -> None:
    complete = Counted()
    drive = Driver(LaneHead(complete, None, every))
    news = [drive.step() for _ in range(21)]
    assert complete.runs == -(-21 // every)
    assert [n.age for n in news] == [k % every for k in range(21)]
    with_ids = [any(p.lane >= 0 for p in n.points) for n in news]
    assert all(with_ids[k] == (k % every == 0) for k in range(every, 21))  # at first too little was seen
    assert not any(n.status for n in news)


def test_lane_detection_yields_to_frames() -> None:
    """One run of all parts is 15 ms of the interpreter that the frames need, too."""
    ways, image = [0], np.full((CAMERA.height_px, CAMERA.width_px), 90, np.uint8)

    def yield_core() -> None:
        ways[0] += 1

    polite, plain = Driver(LaneHead(Counted(), None, 3, yield_core=yield_core)), Driver(LaneHead(Counted(), None, 3))
    for k in range(7):
        before = ways[0]
        found = [
            drive.mapper.map_lanes(
                k, SE2(STEP_M * k), CAMERA.ground, SIGMA_TILT, MASKS, k, NOBODY, image, 30_000_000 * k
            )
            for drive in (polite, plain)
        ]
        assert found[0] == found[1]
        assert ways[0] - before >= (7 if k % 3 == 0 else 2)


def test_rate_drops_on_a_busy_computer() -> None:
    complete, sparing = Counted(), [1]
    drive = Driver(LaneHead(complete, None, 3, lambda: sparing[0]))
    ages = []
    for k in range(18):
        sparing[0] = 1 if k < 6 else 2
        ages.append(drive.step().age)
    assert ages == [0, 1, 2, 0, 1, 2, 3, 4, 5, 0, 1, 2, 3, 4, 5, 0, 1, 2]


def test_frame_without_segmentation_does_not_stop_lane_detection() -> None:
    complete = Counted()
    drive = Driver(LaneHead(complete, None, 4))
    ages = [drive.step(None if k in (4, 5, 9) else MASKS).age for k in range(12)]
    assert ages == [0, 1, 2, 3, 4, 5, 0, 1, 2, 3, 0, 1]
    assert complete.runs == 3


def test_unfinished_run_is_not_awaited_but_reported() -> None:
    elsewhere = Elsewhere()
    drive = Driver(LaneHead(Counted(), elsewhere, 3))
    for _ in range(12):  # in time, each with the next frame
        drive.step()
        elsewhere.work()
    news = [drive.step() for _ in range(7)]  # of these nothing is done
    assert len(elsewhere.waiting) == 1
    assert [n.status for n in news] == [(), (), (), *[(Status.LANES_CARRIED,)] * 4]
    ages = [n.age for n in news]
    assert ages == [3, 4, 5, 6, 7, 8, 9]
    assert news[0].points or news[0].edges  # of the frame before
    assert not any(n.points for n in news[1:])
    carried = LaneEdgesConfig().carried_frames
    assert [bool(n.edges) for n in news] == [True] * carried + [False] * (7 - carried)
    elsewhere.work()
    late = drive.step()
    assert late.status == ()  # it goes on
    assert late.age == 7  # from frame 12 on, its own
    assert len(elsewhere.waiting) == 1


def test_late_lanes_are_at_their_own_pose() -> None:
    elsewhere = Elsewhere()
    late, punctual = Driver(LaneHead(None, elsewhere)), Driver(LaneHead())
    before: LaneOutput | None = None
    for _ in range(10):
        now, then = punctual.step(), late.step()
        if before is not None:
            assert [p.lane for p in then.points] == [p.lane for p in before.points]
            assert [p.x_m + STEP_M for p in then.points] == pytest.approx([p.x_m for p in before.points])
            assert [e.landmark for e in then.edges] == [e.landmark for e in before.edges]
            assert [e.x_m + STEP_M for e in then.edges] == pytest.approx([e.x_m for e in before.edges])
            assert {e.frame for e in then.edges} <= {late.frame}
        before = now
        elsewhere.work()


def test_new_epoch_discards_earlier_lanes() -> None:
    elsewhere = Elsewhere()
    drive = Driver(LaneHead(None, elsewhere))
    drive.step()
    drive.mapper.clear()
    elsewhere.work()
    news = drive.step()
    assert (news.points, news.edges, news.age) == ((), (), None)


def test_edges_refer_to_known_lanes_at_fixed_positions() -> None:
    drive = Driver(LaneHead(None, None, 4))
    news = [drive.step() for _ in range(30)]
    assert not news[0].edges
    seen: dict[int, list[tuple[float, float]]] = {}
    for k, n in enumerate(news):
        for edge in n.edges:
            assert edge.kind is LandmarkKind.LANE_STATION
            seen.setdefault(edge.landmark, []).append((edge.x_m + STEP_M * k, edge.y_m))
    assert len(seen) > 6
    assert max(len(at) for at in seen.values()) > 5
    for at in seen.values():
        np.testing.assert_allclose(np.array(at) - at[0], 0.0, atol=0.12)  # a lattice of 0.1 m
    assert {round(float(np.mean(at, axis=0)[1])) for at in seen.values()} == {3, -2}


def test_lanes_are_transformed_to_later_frames() -> None:
    drive = Driver(LaneHead())
    for _ in range(8):
        seen = drive.step()
    for k in range(1, 6):
        told = drive.step(None)
        if k > LaneEdgesConfig().carried_frames:
            assert told.edges == ()
            continue
        assert [e.landmark for e in told.edges] == [e.landmark for e in seen.edges]
        assert [e.x_m + k * STEP_M for e in told.edges] == pytest.approx([e.x_m for e in seen.edges])
        assert {e.frame for e in told.edges} == {drive.frame}


def test_failed_completion_is_reported_and_keeps_observations() -> None:
    whole, broken = Driver(LaneHead(None, None, 3)), Driver(LaneHead(lambda grids: grids * np.nan, None, 3))
    for k in range(9):
        seen, said = whole.step(), broken.step()
        assert said.status == ((Status.NETWORK_FAILED,) if k % 3 == 0 else ())
        assert (said.points, said.edges, said.age) == (seen.points, seen.edges, seen.age)
