"""The car's speed: validation, integration, estimation of scale factor and delay, rejection of faults."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from birdslam.geometry.pose import Pose
from birdslam.geometry.se2 import SE2
from birdslam.odometry.motion import Motion
from birdslam.odometry.odometry import Odometry, OdometryConfig
from birdslam.odometry.plausibility import PlausibilityConfig, PlausibilityGate
from birdslam.odometry.road.fit import RoadFit
from birdslam.odometry.road.kalman_filter import CAR_DELAY, CAR_FACTOR, STATES, RoadFilter
from birdslam.odometry.scale_config import RoadScaleConfig
from birdslam.odometry.speed.readings import CarSpeedConfig, SpeedReadings
from birdslam.odometry.speed.scale import SpeedScale
from birdslam.types import INVALIDATING, NS_PER_S, Measurements, SpeedReading, SpeedSource, Status
from tests.records import step_at
from tests.test_odometry import CAMERA, NO_BOXES, path_m, render, street

Speed = Callable[[float], float]
CONFIG = CarSpeedConfig()


def reading(t_s: float, speed_mps: float, sigma_mps: float = 0.0, yaw_rate: float | None = None) -> SpeedReading:
    return SpeedReading(t_ns=round(t_s * NS_PER_S), speed_mps=speed_mps, sigma_mps=sigma_mps, yaw_rate_radps=yaw_rate)


def readings_of(speed: Speed, to_s: float, factor: float = 1.0, delay_s: float = 0.0) -> list[SpeedReading]:
    return [reading(t, factor * speed(t - delay_s)) for t in np.arange(0.0, to_s, 0.02)]


def heard(readings: Iterable[SpeedReading], now_s: float) -> SpeedReadings:
    speed = SpeedReadings(CONFIG)
    speed.add_readings(readings, round(now_s * NS_PER_S))
    return speed


def way(speed: SpeedReadings, from_s: float, to_s: float, delay_s: float = 0.0) -> tuple[float, float]:
    found = speed.integrate(round(from_s * NS_PER_S), round(to_s * NS_PER_S), delay_s)
    return found.distance_m, found.var_m2


@given(st.data())
def test_bad_double_and_shuffled_readings_change_nothing(data: st.DataObject) -> None:
    steps = data.draw(st.lists(st.floats(-0.3, 0.3), min_size=5, max_size=30))
    clean = [reading(0.02 * k, 10.0 + float(v), 0.1) for k, v in enumerate(np.cumsum(steps))]
    now_s = clean[-1].t_ns / NS_PER_S
    bad = st.sampled_from(
        [
            reading(0.01, math.nan),
            reading(0.03, math.inf),
            reading(0.05, 10.0, math.nan),
            reading(0.05, 10.0, -1.0),
            reading(0.07, 400.0),
            reading(0.07, 10.0, 0.1, math.nan),
            reading(0.07, 10.0, 0.1, 50.0),
            reading(now_s + 5.0, 10.0),
        ]
    )
    dirty = [*clean, *data.draw(st.lists(st.sampled_from(clean))), *data.draw(st.lists(bad))]
    expected, found = heard(clean, now_s), heard(data.draw(st.permutations(dirty)), now_s)
    assert way(found, 0.01, now_s) == way(expected, 0.01, now_s)
    assert (Status.CAR_SPEED_IMPLAUSIBLE in found.status) == (len(dirty) > len([r for r in dirty if r in clean]))


@given(st.floats(0.0, 30.0), st.floats(-2.0, 2.0), st.floats(-0.3, 0.3), st.floats(0.05, 1.0))
def test_distance_is_the_integral_of_speed(
    speed_mps: float, acceleration: float, delay_s: float, length_s: float
) -> None:
    speed = heard(readings_of(lambda t: speed_mps + acceleration * t, 3.0, delay_s=delay_s), 3.0)
    a, b = 1.0, 1.0 + length_s
    exact = speed_mps * length_s + 0.5 * acceleration * (b**2 - a**2)
    assert way(speed, a, b, delay_s)[0] == pytest.approx(exact, abs=1e-4)


def test_sigma_of_distance_grows_with_age_of_readings() -> None:
    variances = [way(heard(readings_of(lambda t: 10.0, 2.0 - late), 2.0), 1.5, 2.0)[1] for late in (0.0, 0.1, 0.2, 0.4)]
    assert all(np.diff(variances) > 0.0)
    assert heard(readings_of(lambda t: 10.0, 1.0), 2.5).integrate(2 * NS_PER_S, 5 * NS_PER_S // 2, 0.0) is None


def test_understated_noise_is_detected() -> None:
    rng = np.random.default_rng(0)
    noisy = [reading(t, 20.0 + 0.4 * rng.normal(), 0.01) for t in np.arange(0.0, 3.0, 0.02)]
    stated = [reading(t, 20.0, 0.4) for t in np.arange(0.0, 3.0, 0.02)]
    assert way(heard(noisy, 3.0), 2.0, 2.5)[1] == pytest.approx(way(heard(stated, 3.0), 2.0, 2.5)[1], rel=0.5)


def test_old_readings_are_reported() -> None:
    readings = readings_of(lambda t: 10.0, 1.0)
    assert heard(readings, 1.1).status == []
    assert heard(readings, 1.0 + CONFIG.late_s + 0.1).status == [Status.CAR_SPEED_LATE]
    assert heard(readings, 1.0 + CONFIG.missing_s + 0.1).status == [Status.CAR_SPEED_MISSING]
    assert SpeedReadings(CONFIG).status == []  # of a car without speed readings


def test_a_jump_is_refused_until_it_lasts() -> None:
    before = readings_of(lambda t: 10.0, 1.0)
    spike = heard([*before, reading(1.0, 25.0), reading(1.02, 10.0)], 1.05)
    assert spike.status == []
    assert way(spike, 0.9, 1.02)[0] == pytest.approx(1.2)
    jumped = [reading(t, 25.0) for t in np.arange(1.0, 1.4, 0.02)]
    assert Status.CAR_SPEED_IMPLAUSIBLE in heard([*before, *jumped], 1.4).status
    lasting = heard([*before, *jumped, *(reading(t, 25.0) for t in np.arange(1.4, 1.6, 0.02))], 1.6)
    assert lasting.status == []
    assert way(lasting, 1.4, 1.5)[0] == pytest.approx(2.5)


class World:
    """Odometry of images in an arbitrary scale; a road that gives the metric scale; speed readings."""

    def __init__(self, unit_m: float = 1.0) -> None:
        self.config = RoadScaleConfig()
        self.filter = RoadFilter(CAMERA, self.config)
        self.filter.reset_scale(1.0)
        self.car = SpeedScale(self.config, self.filter)
        self.unit_m = unit_m  # of the odometry's scale
        self.trembles = np.zeros(1)  # by which one image after the other sees its way too long, as a fraction
        self.error = 0.0  # of the last way, as a fraction
        self.errors: list[float] = []  # of all of them

    def drive(
        self, speed: Speed, readings: Sequence[SpeedReading], span_s: tuple[float, float], road: bool, hz: float = 10.0
    ) -> list[Status]:
        told: dict[Status, None] = {}
        for k in range(round((span_s[1] - span_s[0]) * hz)):
            a, b = span_s[0] + k / hz, span_s[0] + (k + 1) / hz
            now_ns = round(b * NS_PER_S)
            self.car.add_readings([r for r in readings if now_ns - NS_PER_S < r.t_ns <= now_ns], now_ns)
            true_m = float(np.trapezoid([speed(t) for t in np.linspace(a, b, 21)], dx=(b - a) / 20))
            way = true_m / self.unit_m * (1.0 + float(self.trembles[k % len(self.trembles)]))
            self.filter.predict(np.eye(3), way)
            if road:
                off = np.array([math.log(self.unit_m), *self.filter.x[1:4]])
                way *= self._rescale(
                    self.filter.update_alignment(RoadFit(off, np.diag([1e-6, 1e-4, 1e-4, 1e-6]), 0.9, 1000))
                )
            factor = self.car.update(round(a * NS_PER_S), now_ns, way, way, road)
            metres = way * self._rescale(factor) * self.car.motion_factor
            self.error = metres / true_m - 1.0 if true_m > 0.0 else self.error
            self.errors.append(self.error)
            told |= dict.fromkeys(self.car.status())
        return list(told)

    def _rescale(self, factor: float) -> float:
        self.car.rescale(factor)
        self.unit_m /= factor
        return factor

    def sigma(self, state: int) -> float:
        return float(np.sqrt(self.filter.cov[state, state]))


@settings(max_examples=3)
@given(st.floats(0.95, 1.05), st.floats(-0.1, 0.15), st.floats(0.4, 0.7))
def test_stop_and_go_determines_factor_and_delay(factor: float, delay_s: float, rate: float) -> None:
    def speed(t: float) -> float:
        return 9.0 * math.sin(rate * t) ** 2

    world = World()
    assert not world.drive(speed, readings_of(speed, 26.0, factor, delay_s), (1.0, 25.0), road=True)
    assert math.exp(world.filter.x[CAR_FACTOR]) == pytest.approx(factor, abs=0.006)
    assert world.filter.x[CAR_DELAY] == pytest.approx(delay_s, abs=0.015)
    assert world.sigma(CAR_FACTOR) < 0.35 * CONFIG.sigma_factor_rel
    assert world.error == pytest.approx(0.0, abs=0.006)


def test_constant_speed_does_not_change_the_delay() -> None:
    world = World()
    world.drive(lambda t: 12.0, readings_of(lambda t: 12.0, 16.0, 1.03, 0.1), (1.0, 15.0), road=True)
    assert world.filter.x[CAR_DELAY] == 0.0
    assert world.sigma(CAR_DELAY) == pytest.approx(CONFIG.sigma_delay_s)


def test_without_road_the_scale_is_the_cars_with_its_sigma() -> None:
    world = World(unit_m=0.7)
    world.drive(lambda t: 12.0, readings_of(lambda t: 12.0, 9.0, 1.03), (1.0, 8.0), road=False)
    assert world.error == pytest.approx(0.03, abs=0.003)  # the tyres' scale factor is not observable
    assert world.sigma(0) >= 0.98 * CONFIG.sigma_factor_rel
    assert world.filter.x[CAR_FACTOR] == pytest.approx(0.0, abs=0.002)


def test_factor_learned_by_day_holds_in_the_dark() -> None:
    readings, world = readings_of(lambda t: 12.0, 41.0, 1.03), World()
    world.drive(lambda t: 12.0, readings, (1.0, 20.0), road=True)
    by_day = world.sigma(0)
    world.drive(lambda t: 12.0, readings, (20.0, 40.0), road=False)
    assert abs(world.error) < 0.006
    assert by_day < world.sigma(0) < 0.02  # far less than the factor beforehand
    alone = World()
    alone.drive(lambda t: 12.0, [], (1.0, 20.0), road=True)
    assert len(alone.filter.x) == STATES  # nothing changes without speed readings


def test_readings_smooth_uncertain_image_motion() -> None:
    readings, world = [r for r in readings_of(lambda t: 12.0, 12.0, 1.03) if r.t_ns <= 11.0 * NS_PER_S], World()
    world.trembles = np.random.default_rng(0).normal(0.0, 0.03, 50)
    world.drive(lambda t: 12.0, readings, (1.0, 6.0), road=True)
    world.errors = []
    world.drive(lambda t: 12.0, readings, (6.0, 11.0), road=True)
    assert np.std(world.errors) < 0.5 * np.std(world.trembles)
    world.drive(lambda t: 12.0, readings, (11.0, 11.3), road=True)
    assert world.car.motion_factor == 1.0  # no reading covers the newest motion


@pytest.mark.parametrize(
    ("change", "status"),
    [
        (lambda r: reading(r.t_ns / NS_PER_S, 1.5 * r.speed_mps), Status.CAR_SPEED_IMPLAUSIBLE),  # wheels spin
        (lambda r: reading(r.t_ns / NS_PER_S, 3.6 * r.speed_mps), Status.CAR_SPEED_IMPLAUSIBLE),  # km/h
        (lambda r: reading(r.t_ns / NS_PER_S, -r.speed_mps), Status.CAR_SPEED_IMPLAUSIBLE),
        (lambda r: reading(r.t_ns / NS_PER_S, 30.0), Status.CAR_SPEED_FROZEN),
        (lambda r: reading(r.t_ns / NS_PER_S, 0.0), Status.CAR_SPEED_FROZEN),
    ],
)
@pytest.mark.parametrize("from_s", [0.0, 6.0])
def test_visible_road_rejects_a_wrong_speed(
    change: Callable[[SpeedReading], SpeedReading], status: Status, from_s: float
) -> None:
    def speed(t: float) -> float:
        return 10.0 + 3.0 * math.sin(0.8 * t)

    right = readings_of(speed, 13.0)
    wrong = [change(r) if r.t_ns >= from_s * NS_PER_S else r for r in right]
    world = World()
    world.drive(speed, [], (0.0, 1.0), road=True)  # the road is there first
    told = world.drive(speed, wrong, (1.0, 12.0), road=True)
    assert status in told
    assert abs(world.error) < 0.02
    assert not world.car.is_measuring


def test_lost_scale_is_restored_from_the_cars_speed() -> None:
    readings, world = readings_of(lambda t: 12.0 + 0.1 * math.sin(5.0 * t), 30.0), World()
    world.drive(lambda t: 12.0, readings, (1.0, 10.0), road=False)
    world.unit_m *= 1.6  # and the filter does not know
    told = world.drive(lambda t: 12.0, readings, (10.0, 20.0), road=False)
    assert told == [Status.CAR_SPEED_IMPLAUSIBLE]
    assert world.error == pytest.approx(0.0, abs=0.01)
    assert world.car.is_measuring


def test_frozen_reading_is_rejected() -> None:
    changing = [reading(t, 10.0 + 0.1 * (k % 3), 0.2) for k, t in enumerate(np.arange(0.0, 1.5, 0.02))]
    hung = [reading(t, 10.1, 0.2) for t in np.arange(1.5, 3.5, 0.02)]
    speed = heard([*changing, *hung], 3.5)
    assert Status.CAR_SPEED_FROZEN in speed.status
    assert speed.newest_ns < 1.55 * NS_PER_S
    speed.add_readings([reading(3.52, 10.2, 0.2)], round(3.52 * NS_PER_S))
    assert speed.status == []
    assert heard(readings_of(lambda t: 10.0, 3.5), 3.5).status == []  # of a car with a constant reading
    stopped = readings_of(lambda t: max(0.0, 3.0 - 3.0 * t), 3.5)
    assert heard(stopped, 3.5).status == []


def test_three_contradictions_by_the_road_reject_readings() -> None:
    world = World()
    world.drive(lambda t: 12.0, readings_of(lambda t: 18.0, 6.0), (1.0, 5.0), road=False)
    for _ in range(2):
        world.car.add_contradiction(-0.4)
    assert world.car.is_trusted
    world.car.add_contradiction(-0.42)
    assert not world.car.is_trusted
    assert Status.CAR_SPEED_IMPLAUSIBLE in world.car.status()
    assert world.car.motion(4 * NS_PER_S, 5 * NS_PER_S) is None


def driven(
    poses: list[Pose],
    readings: Sequence[SpeedReading],
    dark: Callable[[int], bool],
    config: OdometryConfig | None = None,
) -> tuple[dict[int, Pose], list[Motion]]:
    odometry, chained, motions = Odometry(CAMERA, config), {0: Pose(np.eye(3), np.zeros(3))}, []
    for k, pose in enumerate(poses):
        image = np.zeros((CAMERA.height_px, CAMERA.width_px), np.uint8) if dark(k) else render(pose, k)
        now_ns = k * NS_PER_S // 10
        come = [r for r in readings if now_ns - NS_PER_S < r.t_ns <= now_ns]
        motion = odometry.estimate(odometry.track(image), k, now_ns, NO_BOXES, None, come)
        if motion is not None:
            chained[k] = chained[motion.from_frame] @ Pose(motion.R_prev_curr, motion.t_prev_curr_m)
            motions.append(motion)
    return chained, motions


def test_first_motion_is_metric_also_at_night() -> None:
    truth = street([(0.8, 0.0)] * 36)
    chained, motions = driven(truth, readings_of(lambda t: 8.0, 5.0), lambda k: 6 <= k < 26)
    assert not INVALIDATING & set(motions[0].status)
    assert np.linalg.norm(motions[0].t_prev_curr_m) == pytest.approx(0.8, rel=0.05)
    by_night = [m for m in motions if 6 <= m.to_frame < 26]
    assert all(Status.CAMERA_DARK in m.status and Status.SCALE_INVALID not in m.status for m in by_night)
    assert {m.speed_sources for m in by_night} == {(SpeedSource.CAR,)}
    assert SpeedSource.CAR in motions[-1].speed_sources
    assert SpeedSource.ROAD in motions[-1].speed_sources
    assert np.linalg.norm(chained[36].p) == pytest.approx(path_m(truth), rel=0.03)
    assert len(chained) == len(truth)


def test_start_in_the_dark_follows_speed_and_yaw_rate() -> None:
    turning = [reading(t, 5.0, 0.05, 0.2) for t in np.arange(0.0, 4.0, 0.02)]
    _, motions = driven(street([(0.5, 0.0)] * 30), turning, lambda k: True)
    assert len(motions) == 30  # the first image has none before it
    way = SE2()
    for motion in motions:
        way = way @ motion.T_prev_curr
        assert Status.CAMERA_DARK in motion.status
        assert not {Status.ODOMETRY_COASTING, Status.SCALE_INVALID} & set(motion.status)
        assert np.linalg.eigvalsh(motion.cov).min() > 0.0
    assert way.log()[0] == pytest.approx(15.0, abs=0.05)
    assert way.yaw_rad == pytest.approx(0.6, abs=0.01)
    assert driven(street([(0.5, 0.0)] * 3), [], lambda k: True)[1] == []


def test_frozen_camera_is_reported_until_it_recovers() -> None:
    odometry, image = Odometry(CAMERA), render(street([])[0])
    for k in range(30):
        now_ns = k * NS_PER_S // 10
        come = [r for r in readings_of(lambda t: 8.0, 4.0) if now_ns - NS_PER_S < r.t_ns <= now_ns]
        motion = odometry.estimate(odometry.track(image), k, now_ns, NO_BOXES, None, come)
        if k:
            assert Status.CAMERA_FROZEN in motion.status
            assert motion.speed_sources == (SpeedSource.CAR,)


def test_paper_mode_ignores_the_cars_speed() -> None:
    config = OdometryConfig(road=RoadScaleConfig(mode="paper"))
    truth = street([(0.8, 0.0)] * 4)
    told = driven(truth, readings_of(lambda t: 20.0, 1.0), lambda k: k == 3, config)[1]
    silent = driven(truth, [], lambda k: k == 3, config)[1]
    assert [m.t_prev_curr_m.tolist() for m in told] == [m.t_prev_curr_m.tolist() for m in silent]
    assert [m.status for m in told] == [m.status for m in silent]


def test_guessed_turn_is_used_briefly_without_new_epoch() -> None:
    gate = PlausibilityGate(PlausibilityConfig(blind_s=0.5, steady_s=0.5))

    def moved(frame: int) -> Measurements:
        by_car = 5 <= frame < 15
        return step_at(
            frame,
            SE2(1.0),
            status=(Status.ODOMETRY_COASTING,) if by_car else (),
            speed_sources=(SpeedSource.CAR,) if by_car else (SpeedSource.ROAD,),
        )

    judged = [gate.admit(moved(frame)) for frame in range(1, 24)]
    assert [m.frame_id for m in judged if Status.MOTION_IMPLAUSIBLE in m.status] == list(range(10, 15))
    assert all(m.cc is not None for m in judged)
