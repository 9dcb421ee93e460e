"""Stable ids: vehicles of a known world through the tracker, with gaps, flicker and false alarms."""

import math
from itertools import pairwise

import numpy as np
import pytest

from birdslam.geometry.se2 import SE2, wrap
from birdslam.road_users.association import predict_boxes_px
from birdslam.road_users.placement.depth_fusion import DepthPlace
from birdslam.road_users.placement.localisation import LocalisationConfig, iou, observe_boxes
from birdslam.road_users.state.ground_size_config import GroundSizeConfig
from birdslam.road_users.state.ground_size_filter import GroundSizeFilter
from birdslam.road_users.track import EgoFrame, TrackingConfig, VehicleTrack
from birdslam.road_users.tracking import Tracker
from tests.boxes import cuboid_px, footprint_m
from tests.recordings import KITTI as CAMERA

SIZE_M = 4.0, 1.7
PERIOD_NS = 100_000_000


def box_px(T_ego_vehicle: SE2, height_m: float = 1.5) -> np.ndarray | None:
    on_road = footprint_m(T_ego_vehicle, *SIZE_M)
    if on_road[:, 0].min() < 3.0:
        return None
    box = cuboid_px(on_road, height_m)
    return box if box[0] > 0 and box[2] < CAMERA.width_px and box[3] < CAMERA.height_px else None


class Drive:
    """Runs a tracker over a world; `sees` may take boxes away or add some."""

    def __init__(self, config: TrackingConfig | None = None, noise_px: float = 0.0) -> None:
        self.ground_size = GroundSizeFilter(CAMERA, GroundSizeConfig())
        self.tracker = Tracker(CAMERA, config or TrackingConfig(), LocalisationConfig(), self.ground_size)
        self.rng = np.random.default_rng(1)
        self.noise_px = noise_px
        self.frame = 0

    def step(self, T_world_ego: SE2, vehicles: list[SE2], labels: list[str] | None = None) -> list[VehicleTrack]:
        boxes = [box_px(T_world_ego.between(vehicle)) for vehicle in vehicles]
        kept = [i for i, box in enumerate(boxes) if box is not None]
        px = np.array([boxes[i] for i in kept]).reshape(-1, 4)
        px = px + self.noise_px * self.rng.standard_normal(px.shape)
        names = tuple((labels or ["car"] * len(vehicles))[i] for i in kept)
        seen = observe_boxes(px, np.full(len(px), 0.9), names, CAMERA, self.ground_size.ground, LocalisationConfig())
        self.ground_size.predict(0.1, 0.0, None, None)
        out = self.tracker.update(EgoFrame(self.frame, self.frame * PERIOD_NS, T_world_ego), seen)
        self.frame += 1
        return out


def test_parked_cars_keep_their_ids_and_places_as_the_ego_passes() -> None:
    drive = Drive(noise_px=0.5)
    parked = [SE2(15.0 + 7.0 * i, 3.5 if i % 2 else -3.5, 0.0) for i in range(6)]
    place_of: dict[int, list[SE2]] = {}
    for k in range(60):
        for track in drive.step(SE2(0.8 * k, 0.0, 0.0), parked):
            place_of.setdefault(track.number, []).append(track.pose())
    assert len(place_of) == len(parked)
    for poses in place_of.values():
        nearest = min(parked, key=lambda p: math.hypot(p.x_m - poses[-1].x_m, p.y_m - poses[-1].y_m))
        assert math.hypot(nearest.x_m - poses[-1].x_m, nearest.y_m - poses[-1].y_m) < 0.5
        assert abs(wrap(poses[-1].yaw_rad)) < 0.2  # stationary, so it keeps the road's direction


def test_prediction_depends_on_the_motion_state() -> None:
    drive = Drive(noise_px=0.5)
    for k in range(30):
        parked, drives = SE2(45.0, -5.0), SE2(20.0 + 1.4 * k, 4.0)
        seen = drive.step(SE2(0.8 * k, 0.0, 0.0), [parked, drives])
    stands, moves = sorted(seen, key=lambda track: float(track.predicted_m[1]))
    assert (stands.is_stationary, moves.is_stationary) == (True, False)
    assert stands.velocity_mps.tolist() == [0.0, 0.0]
    assert moves.velocity_mps[0] == pytest.approx(14.0, abs=2.0)
    assert stands.kinematic_cov[2, 2] < moves.kinematic_cov[2, 2]


def test_a_gap_shorter_than_forget_s_keeps_the_id() -> None:
    drive = Drive(noise_px=0.3)
    ids = set()
    for k in range(40):
        car = SE2(15.0 + 1.2 * k, 0.5, 0.0)
        hidden = 15 <= k < 21
        ids |= {t.number for t in drive.step(SE2(1.0 * k, 0.0, 0.0), [] if hidden else [car])}
    assert ids == {0}


def test_stationary_car_takes_no_neighbouring_box_after_a_gap() -> None:
    drive, near, tracks = Drive(noise_px=0.3), SE2(60.0, -4.0, 0.0), list[VehicleTrack]()
    for k in range(22):
        tracks = drive.step(SE2(0.6 * k, 0.0, 0.0), [near])
    assert tracks[0].is_stationary
    for k in range(22, 24):
        drive.step(SE2(0.6 * k, 0.0, 0.0), [])
    ids = {t.number for k in range(24, 27) for t in drive.step(SE2(0.6 * k, 0.0, 0.0), [SE2(61.5, -5.5, 0.0)])}
    assert ids == {1}  # its box overlaps by a fifth, and the car is expected to within a fifth of its width


def test_a_gap_longer_than_forget_s_gives_a_new_id() -> None:
    drive = Drive()
    ids = set()
    for k in range(40):
        hidden = 10 <= k < 25
        ids |= {t.number for t in drive.step(SE2(), [] if hidden else [SE2(15.0, 0.0, 0.0)])}
    assert ids == {0, 1}


def test_heading_of_an_oncoming_car_follows_its_motion() -> None:
    drive = Drive(noise_px=0.3)
    tracks: list[VehicleTrack] = []
    for k in range(15):
        tracks = drive.step(SE2(), [SE2(45.0 - 1.0 * k, 3.5, math.pi)])
    (track,) = tracks
    assert abs(wrap(track.yaw_rad - math.pi)) < 0.15
    assert track.velocity_mps[0] == pytest.approx(-10.0, abs=1.5)


@pytest.mark.parametrize(("sigmas_mps", "turned"), [((3.0, 0.3), 0.12), ((0.3, 5.0), 0.0), ((5.0, 5.0), 0.0)])
def test_a_direction_is_as_certain_as_the_velocity_across_it(sigmas_mps: tuple[float, float], turned: float) -> None:
    drive = Drive(noise_px=0.3)
    track = [drive.step(SE2(0.5 * k, 0.0, 0.0), [SE2(20.0 + 1.5 * k, 3.0)]) for k in range(10)][-1][0]
    assert track.is_yaw_known
    track.yaw_rad, track.sigma_yaw_rad = 0.0, 0.1
    track.velocity_mps = np.array([10.0, 2.0])
    across = SE2(yaw_rad=math.atan2(2.0, 10.0)).rotation()
    track.kinematic_cov[2:, 2:] = across @ np.diag(np.square(sigmas_mps)) @ across.T
    drive.tracker.yaw.correct_by_motion(0, track)
    assert track.yaw_rad == pytest.approx(turned, abs=0.02)


def test_crossing_cars_do_not_swap_ids() -> None:
    drive = Drive(noise_px=0.3)
    history: dict[int, list[float]] = {}
    for k in range(45):
        cars = [SE2(18.0, -8.0 + 0.4 * k, math.pi / 2), SE2(30.0, 8.0 - 0.4 * k, -math.pi / 2)]
        for track in drive.step(SE2(), cars):
            history.setdefault(track.number, []).append(float(track.predicted_m[0]))
    assert len(history) == 2
    for depths in history.values():
        assert np.ptp(depths) < 4.0


def test_labels_are_voted_and_false_alarms_have_no_id() -> None:
    drive = Drive()
    for k in range(12):
        tracks = drive.step(SE2(), [SE2(15.0, 0.0, 0.0)], ["truck" if k % 4 == 1 else "car"])
        if k == 6:
            drive.step(SE2(), [SE2(15.0, 0.0, 0.0), SE2(20.0, 6.0, 0.0)])
    assert [t.label for t in tracks] == ["car"]
    assert len(drive.tracker.tracks) == 1
    assert tracks[0].number == 0


def test_single_truck_label_changes_neither_size_nor_position() -> None:
    drive, car = Drive(), [SE2(20.0, 0.0, 0.0)]
    for _ in range(6):
        tracks = drive.step(SE2(), car)
    before = tracks[0].observation.dimensions
    width = drive.ground_size.size(0)[1]
    (now,) = drive.step(SE2(), car, ["truck"])
    assert now.observation.dimensions == before
    assert now.pose().x_m == pytest.approx(20.0, abs=0.3)
    assert drive.ground_size.size(0)[1] == pytest.approx(width, rel=0.02)


def test_corrected_label_changes_the_size_prior() -> None:
    ways = [["car"] * 8, ["truck", *["car"] * 7]]
    heights, outlines = [], []
    for labels in ways:
        drive = Drive()
        for k, label in enumerate(labels):
            drive.step(SE2(), [SE2(20.0 - k, 0.0, 0.0)], [label])
        height_m, outline = drive.ground_size.size(0)
        heights.append(height_m)
        outlines.append(outline)
    assert heights[1] == pytest.approx(heights[0], rel=0.04)
    assert outlines[1] == pytest.approx(outlines[0], rel=0.05)


def test_position_from_depth_is_weighted_by_covariance() -> None:
    def after(sigma_m: float | None) -> tuple[float, float]:
        drive = Drive()
        tracks: list[VehicleTrack] = []
        for k in range(6):
            box = box_px(SE2(25.0, 1.0, 0.0))
            seen = observe_boxes(
                box[None], np.full(1, 0.9), ("car",), CAMERA, drive.ground_size.ground, LocalisationConfig()
            )
            by_depth = None
            if sigma_m is not None:
                by_depth = DepthPlace(np.array([26.0, 1.04]), np.eye(2) * sigma_m**2, 0.0, 0.1)
            drive.ground_size.predict(0.1, 0.0, None, None)
            tracks = drive.tracker.update(EgoFrame(k, k * PERIOD_NS, SE2()), seen, [by_depth])
        (track,) = tracks
        return float(track.place.centre_m[0]), float(track.place.cov[0, 0])

    alone_m, alone_var = after(None)
    assert after(0.01)[0] == pytest.approx(26.0, abs=0.02)
    sure_m, sure_var = after(1.0)
    assert alone_m < sure_m < 26.0
    assert sure_var < alone_var
    assert after(1e3) == pytest.approx((alone_m, alone_var), rel=1e-3)


def test_stationary_vehicle_keeps_its_yaw_while_size_is_estimated() -> None:
    drive = Drive(noise_px=0.3)
    tracks: list[VehicleTrack] = []
    for k in range(45):
        tracks = drive.step(SE2(0.9 * k, 0.0, 0.0), [SE2(65.0, 4.0, 0.0)])
    (track,) = tracks
    assert track.is_stationary
    assert drive.tracker.placing.users.stationary_probability()[drive.tracker.tracks.index(track)] > 0.9
    assert track.yaw_rad == 0.0
    assert math.hypot(track.predicted_m[0] - 65.0, track.predicted_m[1] - 4.0) < 1.0


def test_unusual_size_keeps_its_id_while_size_is_estimated() -> None:
    drive = Drive(noise_px=0.3)
    ids, errors = set(), []
    for k in range(50):
        ego = SE2(0.9 * k, 0.0, 0.0)
        box = box_px(ego.between(SE2(70.0, 8.0, 0.0)), height_m=2.5)
        assert box is not None
        box = box + drive.noise_px * drive.rng.standard_normal(4)
        seen = observe_boxes(
            box[None], np.full(1, 0.9), ("car",), CAMERA, drive.ground_size.ground, LocalisationConfig()
        )
        drive.ground_size.predict(0.1, 0.0, None, None)
        for track in drive.tracker.update(EgoFrame(k, k * PERIOD_NS, ego), seen):
            ids.add(track.number)
            errors.append(float((ego @ track.place.centre_m)[0]) - 70.0)
    assert ids == {0}
    assert abs(errors[0]) > 15.0  # taken for a car as cars are
    assert np.abs(errors[-10:]).max() < 0.2 * abs(errors[0])


class Looks:
    """A stationary ego observes a stationary car, with a network that gives its heading."""

    def __init__(self, config: TrackingConfig | None = None) -> None:
        self.drive = Drive(config)
        self.frame = 0

    def see(self, at: SE2, said_rad: float, flip: float = 0.05, sigma_rad: float = 0.1) -> VehicleTrack | None:
        box = box_px(at)
        seen = observe_boxes(
            box[None], np.array([0.9]), ("car",), CAMERA, self.drive.ground_size.ground, LocalisationConfig()
        )
        by_depth = DepthPlace(np.array([at.x_m, at.y_m]), np.eye(2), said_rad, sigma_rad, flip)
        frame = EgoFrame(self.frame, self.frame * PERIOD_NS, SE2())
        tracks = self.drive.tracker.update(frame, seen, [by_depth])
        self.frame += 1
        return tracks[0] if tracks else None


@pytest.mark.parametrize("yaw_rad", [0.3, -1.2, 2.8, math.pi])
def test_heading_of_a_never_moving_car_is_the_observed_one(yaw_rad: float) -> None:
    looks, track = Looks(), None
    rng = np.random.default_rng(0)
    for _ in range(30):
        track = looks.see(SE2(14.0, 1.0, yaw_rad), wrap(yaw_rad + 0.1 * rng.standard_normal()))
    assert abs(wrap(track.yaw_rad - yaw_rad)) < 0.1
    assert track.is_yaw_known
    assert track.sigma_yaw_rad < 0.15


def test_consistently_reversed_front_turns_once() -> None:
    looks, yaws = Looks(), []
    for k in range(40):
        track = looks.see(SE2(14.0, 1.0, 0.2), 0.2 if k % 4 else wrap(0.2 + math.pi), flip=0.2)  # the first is wrong
        if track is not None:
            yaws.append(track.yaw_rad)
    assert abs(wrap(yaws[0] - 0.2)) > 3.0
    turns = [abs(wrap(b - a)) > 1.0 for a, b in pairwise(yaws)]
    assert sum(turns) == 1
    assert abs(wrap(yaws[-1] - 0.2)) < 0.05


def test_axis_without_front_keeps_the_ego_heading() -> None:
    looks, track = Looks(), None
    for _ in range(5):
        track = looks.see(SE2(14.0, 1.0, 0.0), 1.0, flip=0.5)
    assert track.yaw_rad == 0.0
    assert not track.is_yaw_known


def test_motion_determines_the_front() -> None:
    looks, track = Looks(), None
    for k in range(25):
        track = looks.see(SE2(40.0 - 1.0 * k, 3.0, math.pi), 0.05, flip=0.3)  # it comes, and looks as if it went
    assert abs(wrap(track.yaw_rad - math.pi)) < 0.2


@pytest.mark.parametrize("label", ["bus", "car"])
def test_car_is_not_associated_with_objects_behind_it(label: str) -> None:
    """A detector that for a moment draws a bus about a car, 1.7 times as high: no car grows so from frame to frame."""
    drive = Drive()
    ego, car = SE2(), SE2(30.0, 0.5, 0.0)
    known = [drive.step(ego, [car]) for _ in range(10)][-1][0]
    users = drive.tracker.placing.users
    before_m, plain = float(users.moments().mean[0, 0]), box_px(car)
    assert plain is not None
    higher = np.add(plain, [-5.0, -0.7 * (plain[3] - plain[1]), 5.0, 0.0])
    seen = observe_boxes(
        higher[None], np.array([0.9]), (label,), CAMERA, drive.ground_size.ground, LocalisationConfig()
    )
    drive.ground_size.predict(0.1, 0.0, None, None)
    shown = drive.tracker.update(EgoFrame(drive.frame, drive.frame * PERIOD_NS, ego), seen)
    assert shown == []
    drive.frame += 1
    (again,) = [track for track in drive.step(ego, [car]) if track.number == known.number]
    row = drive.tracker.tracks.index(again)
    assert users.moments().mean[row, 0] == pytest.approx(before_m, abs=1.0)  # the road learns of the odd boxes too


def test_each_filter_has_exactly_one_row_per_track() -> None:
    drive = Drive(noise_px=0.3)
    tall = SE2(70.0, -8.0)
    for k in range(60):
        ego = SE2(0.9 * k, 0.0)
        others = [SE2(15.0 + 9.0 * i, 3.5) for i in range(9) if (k // 7 + i) % 3]  # seen at times, some forgotten
        drive.step(ego, [*others, tall])
        tracker = drive.tracker
        assert len(tracker.tracks) == len(tracker.placing.users) == len(tracker.ground_size)
        for row, track in enumerate(tracker.tracks):
            if track.frame.frame_id == k and track.place.assumed is not None:
                assert track.place.assumed.standing == tracker.placing.users.stationary_probability()[row]


def test_lost_car_does_not_pass_its_id_to_a_parked_one() -> None:
    """The nearer car of a row is missed for good: the farther one's box, which overlaps its own, is another car's."""
    drive = Drive()
    near, far = SE2(20.0, -4.0), SE2(21.5, -5.6)
    known = {track.number for k in range(10) for track in drive.step(SE2(0.3 * k, 0.0), [near])}
    others = {track.number for k in range(10, 13) for track in drive.step(SE2(0.3 * k, 0.0), [far])}
    assert len(known) == len(others) == 1
    assert known != others


def test_association_does_not_shift_boxes_to_neighbours() -> None:
    """A box is lost at the end of a row where each box overlaps its neighbour's: the others keep their own."""
    drive = Drive()
    row = [SE2(30.0 + 1.5 * i, -2.0 - 0.8 * i) for i in range(3)]
    for k in range(10):
        tracks = drive.step(SE2(0.1 * k, 0.0), row[1:])
    middle, _ = sorted(tracks, key=lambda track: track.pose().x_m)
    drive.step(SE2(1.0, 0.0), row[:2])
    own = box_px(SE2(1.0, 0.0).between(row[1]))
    assert own is not None
    assert middle.observation.box_px == pytest.approx(tuple(own))


@pytest.mark.parametrize("left", [-1.0, 1.0])
def test_truncated_car_is_predicted_to_reach_the_border(left: float) -> None:
    drive = Drive()
    tracks = [track for k in range(12) for track in drive.step(SE2(0.8 * k, 0.0), [SE2(16.0, 3.0 * left)])]
    track = tracks[-1]
    ego = SE2(float(track.pose().x_m) - 4.5, 0.0)
    box = cuboid_px(footprint_m(ego.between(track.pose()), *SIZE_M), 1.5, drive.ground_size.ground)
    true = np.clip(box, 0.0, [1242.0, 375.0, 1242.0, 375.0])
    (predicted,) = predict_boxes_px([track], CAMERA, ego, drive.ground_size.ground)
    assert iou(predicted[None], true[None])[0, 0] > 0.8
