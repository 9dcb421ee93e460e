"""Motions that no car makes: not believed, nor what follows until all is steady, and then in a new world."""

from __future__ import annotations

from birdslam.motionwatch import MotionWatch, MotionWatchConfig
from birdslam.se2 import SE2
from birdslam.types import INVALIDATING, EgoEdge, Measurements, Status

FRAME_NS = 100_000_000


def moved(frame: int, speed_mps: float, status: tuple[Status, ...] = ()) -> Measurements:
    edge = EgoEdge(from_frame=frame - 1, to_frame=frame, T_from_to=SE2(0.1 * speed_mps, 0.0, 0.0), cov=(0.0,) * 9)
    return Measurements(
        frame_id=frame, t_source_ns=frame * FRAME_NS, t_capture_ns=0, t_utc_ns=0, cc=edge, status=status
    )


def test_a_hard_braking_car_is_believed() -> None:
    watch = MotionWatch(MotionWatchConfig())
    drive = [moved(frame, max(0.0, 15.0 - frame)) for frame in range(1, 30)]
    assert [watch.judge(m) for m in drive] == drive


def test_a_reversal_is_not_and_the_world_begins_anew_when_all_is_steady() -> None:
    watch = MotionWatch(MotionWatchConfig(steady_s=0.5))
    judged = [watch.judge(moved(frame, 10.0 if frame < 5 else -10.0)) for frame in range(1, 14)]
    wrong = [m.frame_id for m in judged if Status.MOTION_IMPLAUSIBLE in m.status]
    assert wrong == [5, 6, 7, 8, 9]
    assert [m.frame_id for m in judged if m.cc is None] == [10]
    assert Status.MOTION_IMPLAUSIBLE in INVALIDATING


def test_what_is_only_predicted_is_not_steady() -> None:
    watch = MotionWatch(MotionWatchConfig(steady_s=0.5))
    for frame in range(1, 6):
        watch.judge(moved(frame, 10.0 if frame < 5 else -10.0))
    for frame in range(6, 40):
        coasts = (Status.ODOMETRY_COASTING,) if frame % 2 else ()
        assert Status.MOTION_IMPLAUSIBLE in watch.judge(moved(frame, -10.0, coasts)).status


def test_after_a_long_blindness_the_world_begins_anew() -> None:
    watch = MotionWatch(MotionWatchConfig(blind_s=0.5, steady_s=0.5))
    blind = (Status.ODOMETRY_COASTING,)
    judged = [watch.judge(moved(frame, 10.0, blind if 5 <= frame < 15 else ())) for frame in range(1, 24)]
    assert [m.frame_id for m in judged if Status.MOTION_IMPLAUSIBLE in m.status] == list(range(10, 19))
    assert [m.frame_id for m in judged if m.cc is None] == [19]
