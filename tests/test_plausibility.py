"""Implausible motions: rejected until the motion is steady, then a new epoch starts."""

from __future__ import annotations

import numpy as np
import pytest

from birdslam.geometry.se2 import SE2
from birdslam.odometry.plausibility import PlausibilityConfig, PlausibilityGate
from birdslam.types import INVALIDATING, Measurements, Status
from tests.records import step_at


def moved(frame: int, speed_mps: float, status: tuple[Status, ...] = ()) -> Measurements:
    return step_at(frame, SE2(0.1 * speed_mps), status=status)


def test_hard_braking_is_plausible() -> None:
    gate = PlausibilityGate(PlausibilityConfig())
    drive = [moved(frame, max(0.0, 15.0 - frame)) for frame in range(1, 30)]
    assert [gate.admit(m) for m in drive] == drive


def test_reversal_is_implausible_and_starts_a_new_epoch() -> None:
    gate = PlausibilityGate(PlausibilityConfig(steady_s=0.5))
    judged = [gate.admit(moved(frame, 10.0 if frame < 5 else -10.0)) for frame in range(1, 14)]
    wrong = [m.frame_id for m in judged if Status.MOTION_IMPLAUSIBLE in m.status]
    assert wrong == [5, 6, 7, 8, 9]
    assert [m.frame_id for m in judged if m.cc is None] == [10]
    assert Status.MOTION_IMPLAUSIBLE in INVALIDATING


def test_predicted_motion_is_not_steady() -> None:
    gate = PlausibilityGate(PlausibilityConfig(steady_s=0.5))
    for frame in range(1, 6):
        gate.admit(moved(frame, 10.0 if frame < 5 else -10.0))
    for frame in range(6, 40):
        coasts = (Status.ODOMETRY_COASTING,) if frame % 2 else ()
        assert Status.MOTION_IMPLAUSIBLE in gate.admit(moved(frame, -10.0, coasts)).status


def test_long_blindness_starts_a_new_epoch() -> None:
    gate = PlausibilityGate(PlausibilityConfig(blind_s=0.5, steady_s=0.5))
    blind = (Status.ODOMETRY_COASTING,)
    judged = [gate.admit(moved(frame, 10.0, blind if 5 <= frame < 15 else ())) for frame in range(1, 24)]
    assert [m.frame_id for m in judged if Status.MOTION_IMPLAUSIBLE in m.status] == list(range(10, 19))
    assert [m.frame_id for m in judged if m.cc is None] == [19]


def at_33_hz(steps_m: list[float]) -> list[Measurements]:
    return [step_at(k, SE2(step_m), t_source_ns=round(k * 1e9 / 33.0)) for k, step_m in enumerate(steps_m, start=1)]


def test_noise_of_single_motions_at_33_hz_is_plausible() -> None:
    """0.03 m of noise, 1-sigma, in each motion, as the shipped drive shows: 1 m/s in the speed of one of them."""
    rng, gate = np.random.default_rng(3), PlausibilityGate(PlausibilityConfig())
    drive = at_33_hz((10.0 / 33.0 + rng.normal(0.0, 0.03, 400)).tolist())
    assert [gate.admit(m) for m in drive] == drive


@pytest.mark.parametrize("speed_mps", [3.0, 10.0])
def test_a_reversal_at_33_hz_is_found_within_a_span(speed_mps: float) -> None:
    gate = PlausibilityGate(PlausibilityConfig())
    judged = [gate.admit(m) for m in at_33_hz([speed_mps / 33.0 * (1.0 if k < 20 else -1.0) for k in range(60)])]
    wrong = [m.frame_id for m in judged if Status.MOTION_IMPLAUSIBLE in m.status]
    assert 21 <= wrong[0] <= 24
    assert any(m.cc is None for m in judged)  # the world restarts


def test_a_jump_of_one_motion_at_33_hz_is_found_at_once() -> None:
    gate = PlausibilityGate(PlausibilityConfig())
    steps_m = [0.3] * 20 + [1.1] + [0.3] * 40
    wrong = [m.frame_id for m in map(gate.admit, at_33_hz(steps_m)) if Status.MOTION_IMPLAUSIBLE in m.status]
    assert wrong[0] == 21
