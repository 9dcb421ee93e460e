"""People in bird's-eye view: placed by feet and height, tracked, reported in the world of the graph."""

from __future__ import annotations

import math
import runpy
from pathlib import Path

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from birdslam.geometry import bev
from birdslam.geometry.bev import RoadProfile
from birdslam.geometry.camera import VerticalCurvature
from birdslam.geometry.se2 import SE2
from birdslam.graph.around.approach import approaches
from birdslam.graph.around.hidden_road import hidden_fans
from birdslam.graph.graph_config import GraphConfig
from birdslam.graph.pose_graph import PoseGraph
from birdslam.graph.weights import WeightsConfig
from birdslam.perception import Detections
from birdslam.queries import nearby
from birdslam.road_users.out_of_sequence import OpenFrame
from birdslam.road_users.people.box_model import road_tilts
from birdslam.road_users.people.people_boxes import observe_people
from birdslam.road_users.people.people_config import PeopleConfig
from birdslam.road_users.people.people_records import followed_people
from birdslam.road_users.people.people_tracker import PeopleTracker
from birdslam.road_users.placed_boxes import place_boxes
from birdslam.road_users.placement.localisation import LocalisationConfig
from birdslam.road_users.state.ground_size_config import GroundSizeConfig
from birdslam.road_users.state.ground_size_filter import GroundSizeFilter
from birdslam.road_users.track import EgoFrame, TrackingConfig
from birdslam.types import (
    FIRST_PERSON,
    Estimate,
    FollowedPerson,
    Ground,
    Measurements,
    Moves,
    RoadUser,
    Status,
)
from tests.recordings import KITTI as CAMERA
from tests.records import step_at

BOXES = (LocalisationConfig(),)
Box = tuple[float, float, float, float]
HZ = 10.0


def box_of(
    x_m: float, y_m: float, height_m: float = 1.72, width_m: float = 0.6, reach_m: float = 0.25, rise: float = 0.0
) -> Box:
    """Of somebody at a place in ego, over a level road or one that rises; the feet reach out to the camera.

    With the margins of a detector.
    """
    near_m = x_m - reach_m
    points = np.array([[near_m, y_m, rise * near_m], [x_m, y_m, rise * x_m + height_m]])
    foot, head = bev.ego_to_pixel(CAMERA, CAMERA.ground, points)
    middle = bev.ego_to_pixel(CAMERA, CAMERA.ground, np.array([[x_m, y_m, 0.0]]))[0, 0]
    half, tall, sizes = width_m / x_m * CAMERA.fx_px / 2.0, foot[1] - head[1], PeopleConfig().pedestrian
    top, bottom = head[1] - sizes.head_rel * tall, foot[1] + sizes.foot_rel * tall
    return float(middle - half), float(top), float(middle + half), float(bottom)


def found(boxes: list[Box], labels: list[str] | None = None, score: float = 0.9) -> Detections:
    names = tuple(labels or ["person"] * len(boxes))
    return Detections(np.array(boxes, dtype=float).reshape(-1, 4), np.full(len(boxes), score), names)


class Scene:
    """A tracker, and the ego that drives along x."""

    def __init__(self, ego_mps: float = 0.0) -> None:
        self.tracker = PeopleTracker(CAMERA, PeopleConfig(), TrackingConfig(), LocalisationConfig())
        self.road = GroundSizeFilter(CAMERA, GroundSizeConfig())
        self.ego_mps, self.k = ego_mps, 0

    @property
    def ego_m(self) -> float:
        return self.ego_mps * self.k / HZ

    def see(
        self, detections: Detections | None, road: GroundSizeFilter | None = None, frames: int = 1
    ) -> tuple[FollowedPerson, ...]:
        """The people after the next frames, which all show the same."""
        for _ in range(frames):
            people = self._step(detections, road)
        return people

    def _step(self, detections: Detections | None, road: GroundSizeFilter | None) -> tuple[FollowedPerson, ...]:
        ego = EgoFrame(self.k, round(self.k * 1e9 / HZ), SE2(self.ego_m, 0.0, 0.0), np.zeros((3, 3)))
        dt_s = 0.0 if self.k == 0 else 1.0 / HZ
        frame = OpenFrame(ego, dt_s, 0.0, None, None, self.ego_mps * dt_s)
        if road is None:
            self.road.predict(dt_s, 0.0, None, None, self.ego_mps * dt_s)
        self.tracker.settle(frame, detections, self.road if road is None else road)
        self.k += 1
        return followed_people(self.tracker, ego)


def observed(boxes: list[Box], labels: list[str]) -> list[str]:
    return [box.label for box in observe_people(found(boxes, labels), CAMERA, CAMERA.ground, *BOXES)]


# --- which boxes are whom ---


def test_rider_and_bicycle_are_one_and_motorcyclist_is_not_a_pedestrian() -> None:
    person, mount = (600.0, 150.0, 640.0, 250.0), (595.0, 200.0, 645.0, 265.0)
    (whole,) = observe_people(found([person, mount], ["person", "bicycle"]), CAMERA, CAMERA.ground, *BOXES)
    assert whole.label == "cyclist"
    assert whole.rows == (0, 1)
    assert whole.box_px == (595.0, 150.0, 645.0, 265.0)
    assert observed([person, mount], ["person", "motorcycle"]) == []
    beside = (660.0, 150.0, 700.0, 262.0)
    assert sorted(observed([person, beside, mount], ["person", "person", "bicycle"])) == ["cyclist", "pedestrian"]


def test_only_the_rider_is_merged_with_a_bicycle() -> None:
    cyclist = (449.0, 124.0, 474.0, 185.0)
    assert observed([cyclist, (451.0, 124.0, 472.0, 178.0)], ["cyclist", "person"]) == ["cyclist"]
    before = (455.0, 126.0, 478.0, 197.0)
    assert sorted(observed([cyclist, before], ["cyclist", "person"])) == ["cyclist", "pedestrian"]


def test_occupants_are_not_pedestrians_and_people_near_cars_are() -> None:
    car = (500.0, 160.0, 700.0, 280.0)
    assert observed([car, (560.0, 170.0, 600.0, 220.0)], ["car", "person"]) == []
    assert observed([car, (560.0, 165.0, 600.0, 290.0)], ["car", "person"]) == ["pedestrian"]
    assert observed([car, (560.0, 130.0, 600.0, 220.0)], ["car", "person"]) == ["pedestrian"]


def test_bicycle_without_rider_starts_no_track() -> None:
    scene = Scene()
    for _ in range(5):
        assert scene.see(found([(595.0, 200.0, 645.0, 265.0)], ["bicycle"])) == ()


# --- places ---


@given(x_m=st.floats(7.0, 40.0), bearing=st.floats(-0.6, 0.6), height_m=st.floats(1.55, 1.9))
@settings(max_examples=25)
def test_stationary_person_is_within_sigma(x_m: float, bearing: float, height_m: float) -> None:
    scene = Scene()
    (person,) = scene.see(found([box_of(x_m, bearing * x_m, height_m)]), frames=3)
    error = np.array([person.x_m - x_m, person.y_m - bearing * x_m])
    assert error @ np.linalg.solve(np.reshape(person.cov, (2, 2)), error) < 3.0**2
    assert abs(error[0]) < 0.12 * x_m
    assert person.person == FIRST_PERSON


def test_child_is_not_a_distant_adult() -> None:
    scene = Scene()
    for _ in range(4):
        (child,) = scene.see(found([box_of(8.0, 1.0, 1.1)])) or (None,)
    assert child.x_m == pytest.approx(8.0, rel=0.12)  # an adult's box of that height is one at 12.5 m
    assert child.child > 0.5
    assert child.height_m == pytest.approx(1.1, rel=0.15)


RISE = 0.03  # of a street before a standing ego
HEIGHTS = [1.8, 1.65, 1.72, 1.75, 1.68, 1.7]
PASSERS_BY = [(9.0, -3.0), (12.0, 2.5), (16.0, -4.0), (20.0, 4.0), (25.0, -5.0), (30.0, 2.0)]


def test_tilt_from_later_people_corrects_earlier_ones() -> None:
    scene, first = Scene(), box_of(18.0, 0.5, rise=RISE)
    (alone,) = scene.see(found([first]), frames=10)
    others = [box_of(x_m, y_m, height_m, rise=RISE) for (x_m, y_m), height_m in zip(PASSERS_BY, HEIGHTS, strict=True)]
    people = scene.see(found([first, *others]), frames=10)
    together = next(p for p in people if p.person == alone.person)
    (left,) = scene.see(found([first]), frames=25)
    assert abs(together.x_m - 18.0) < 0.9 * abs(alone.x_m - 18.0)
    assert abs(left.x_m - 18.0) < 0.9 * abs(alone.x_m - 18.0)
    assert left.cov[0] < alone.cov[0]


def test_near_people_give_heights_and_far_people_the_tilt() -> None:
    road = GroundSizeFilter(CAMERA, GroundSizeConfig())
    road.predict(1.0, 0.0, None, None)
    places = [(x_m, y_m) for x_m in (6.5, 8.0, 11.0, 18.0, 28.0, 35.0) for y_m in (-2.0, 2.0)]
    boxes = [box_of(*place, 1.72 * math.exp(0.08), rise=0.02) for place in places]
    seen = observe_people(found(boxes), CAMERA, CAMERA.ground, *BOXES)
    before, sigma_before = road.ground.pitch_rad, road.sigma_pitch_rad
    road.correct_by_people(road_tilts([], [], RoadProfile(CAMERA.height_m), PeopleConfig()))
    assert road.ground.pitch_rad == before
    road.correct_by_people(road_tilts(seen, [math.inf] * len(seen), RoadProfile(CAMERA.height_m), PeopleConfig()))
    assert abs(road.ground.pitch_rad - before - 0.02) < 2.0 * road.sigma_pitch_rad < 0.02
    assert road.sigma_pitch_rad < sigma_before
    log_height, height_var = road.bodies
    assert 0.02 < log_height < 0.08 + math.sqrt(height_var)


def test_people_follow_the_vertical_curvature() -> None:
    """A sag known from the lanes: on the plane the feet would be 4 m too far."""
    bend, x_m = 2e-3, 30.0
    box = box_of(x_m, 1.0, rise=bev.rise(x_m - 0.25, bend))
    bent = GroundSizeFilter(CAMERA, GroundSizeConfig())
    bent.predict(0.1, 0.0, None, None, 1.0, VerticalCurvature(bend, 1e-5))
    places = []
    for road in (GroundSizeFilter(CAMERA, GroundSizeConfig()), bent):
        scene = Scene()
        people = scene.see(found([box]), road=road, frames=10)
        places.append(people[0].x_m)
    level_m, bent_m = places
    assert bent_m == pytest.approx(x_m, rel=0.04)
    assert level_m > bent_m + 1.0


def test_truncated_feet_give_no_position() -> None:
    scene = Scene()
    x1, y1, x2, _ = box_of(3.4, 0.3)
    for _ in range(4):
        (person,) = scene.see(found([(x1, y1, x2, 374.0)])) or (None,)
    assert abs(person.x_m - 3.4) < 3.0 * math.sqrt(person.cov[0])


def test_hidden_feet_do_not_move_a_tracked_person() -> None:
    scene, (x1, y1, x2, y2) = Scene(), box_of(12.0, 2.0)
    scene.see(found([(x1, y1, x2, y2)]), frames=6)
    hidden = y2 - 0.45 * (y2 - y1)
    car = (x1 - 60.0, hidden - 15.0, x2 + 60.0, y2 + 30.0)
    for _ in range(6):
        (person,) = scene.see(found([(x1, y1, x2, hidden), car], ["person", "car"]))
    assert person.x_m == pytest.approx(12.0, rel=0.12)


def test_covariances_are_consistent_with_boxes_and_heights() -> None:
    rng, inside = np.random.default_rng(4), []
    for _ in range(40):
        height_m = 1.72 * math.exp(rng.normal(0.0, 0.06))
        x_m, scene = rng.uniform(6.0, 25.0), Scene()
        for _ in range(12):
            box = np.array(box_of(x_m, 1.0, height_m))
            box += rng.normal(0.0, 0.02, 4) * (box[3] - box[1])
            people = scene.see(found([tuple(box.tolist())]))
        inside += [abs(p.x_m - x_m) < math.sqrt(p.cov[0]) for p in people]
    assert len(inside) >= 38
    assert np.mean(inside) > 0.55


# --- motion and ids ---


@pytest.mark.parametrize(("walks_mps", "seed"), [(1.5, 0), (1.5, 1), (-1.2, 0), (-1.2, 1)])
def test_walker_beside_a_moving_ego_is_not_stationary(walks_mps: float, seed: int) -> None:
    """Correlated box errors count once; otherwise repetition would favour the stationary hypothesis."""
    rng, scene, error, told = np.random.default_rng(seed), Scene(ego_mps=6.0), np.zeros(4), list[float]()
    while (x_m := 27.0 + walks_mps * scene.k / HZ - scene.ego_m) > 8.0:
        box = np.array(box_of(x_m, 3.0, 1.65))
        error = 0.7 * error + math.sqrt(1.0 - 0.7**2) * rng.normal(0.0, 0.02, 4)
        people = scene.see(found([tuple((box + error * (box[3] - box[1])).tolist())]))
        told += [p.vx_mps for p in people if x_m < 16.0]
    assert np.median(told) / walks_mps > 0.55


def test_stationary_person_is_recognized_from_a_moving_ego() -> None:
    rng, scene, told = np.random.default_rng(2), Scene(ego_mps=5.0), []
    for k in range(40):
        box = np.array(box_of(32.0 - scene.ego_m, 3.0))
        box += rng.normal(0.0, 0.015, 4) * (box[3] - box[1])
        people = scene.see(found([tuple(box.tolist())]))
        told += [math.hypot(p.vx_mps, p.vy_mps) for p in people if k > 10]
    assert np.median(told) < 0.3
    assert people[0].moves is Moves.STANDING


def test_walker_keeps_velocity_and_id_over_one_second_of_occlusion() -> None:
    scene, ids = Scene(), set()
    for k in range(35):
        y_m = 4.0 - 1.3 * k / HZ
        hidden = 15 <= k < 25
        people = scene.see(found([] if hidden else [box_of(12.0, y_m)]))
        ids |= {p.person for p in people}
        if k == 24:
            (person,) = people
            assert person.age_ns > 900_000_000
            assert abs(person.y_m - y_m) < 0.8
    (person,) = people
    assert ids == {FIRST_PERSON}
    assert (person.vx_mps, person.vy_mps) == pytest.approx((0.0, -1.3), abs=0.4)
    assert person.moves is Moves.DRIVING
    people = scene.see(found([]), frames=20)
    assert people == ()


def test_overlapping_people_keep_their_ids() -> None:
    scene = Scene()
    for k in range(40):
        left, right = 1.2 - 1.0 * k / HZ, -1.8 + 1.0 * k / HZ
        people = scene.see(found([box_of(9.0, left), box_of(11.0, right)]))
    assert len(people) == 2
    nearer = min(people, key=lambda p: p.x_m)
    assert nearer.person == FIRST_PERSON
    assert nearer.vy_mps < -0.5
    pair = Scene()
    people = pair.see(found([box_of(10.0, 0.0), box_of(10.0, 0.3)]), frames=10)
    assert len({p.person for p in people}) == 2


@pytest.mark.parametrize(
    ("label", "widths_m", "hidden"), [("person", (0.6, 0.6), 3), ("cyclist", (0.6, 0.6), 0), ("person", (0.4, 0.9), 0)]
)
def test_hidden_person_does_not_take_a_neighbours_box(label: str, widths_m: tuple[float, float], hidden: int) -> None:
    """Known by having been unseen for some frames, by the class, by the shape: the box is nearer to the hidden one."""
    scene = Scene()
    for _ in range(10):
        both = [box_of(11.5, y_m, width_m=w_m) for y_m, w_m in zip((0.0, 0.5), widths_m, strict=True)]
        told = scene.see(found(both, ["person", label]))
    neighbour = max(told, key=lambda person: person.y_m)
    for y_m in (*[0.5] * hidden, 0.2):
        told = scene.see(found([box_of(11.5, y_m, width_m=widths_m[1])], [label]))
    assert [person.person for person in told if person.age_ns == 0] == [neighbour.person]


@pytest.mark.parametrize("far_m", [24.0, 28.0])
def test_far_person_is_not_a_near_one_with_hidden_feet(far_m: float) -> None:
    """The heads of both are at the horizon; hidden feet shorten a box, but do not make it narrower."""
    scene = Scene()
    for _ in range(10):
        (near,) = scene.see(found([box_of(9.0, 0.0)])) or (None,)
    people = scene.see(found([box_of(far_m, 0.0)]), frames=5)
    (far,) = [person for person in people if person.age_ns == 0]
    assert far.person != near.person
    assert far.x_m == pytest.approx(far_m, rel=0.15)


def test_skipped_frames_only_grow_the_covariance() -> None:
    scene = Scene()
    scene.see(found([box_of(10.0, 0.0)]), frames=5)
    (before,) = scene.see(found([box_of(10.0, 0.0)]))
    (after,) = scene.see(None)
    assert after.person == before.person
    assert after.age_ns == 100_000_000
    assert after.cov[0] > before.cov[0]


# --- in the graph's world ---


def measured(frame: int, people: tuple[FollowedPerson, ...], ahead_m: float = 0.5, **fields: object) -> Measurements:
    cov = (1e-4, 0.0, 0.0, 0.0, 1e-4, 0.0, 0.0, 0.0, 1e-6)
    return step_at(frame, SE2(ahead_m), cov=cov, people=people, ground=Ground(height_m=1.65), **fields)


def person_at(
    x_m: float, y_m: float, vx: float = 0.0, vy: float = 0.0, number: int = 0, **fields: object
) -> FollowedPerson:
    numbers = {"cov": (0.04, 0.0, 0.0, 0.01), "velocity_cov": (0.01, 0.0, 0.0, 0.01)} | fields
    return FollowedPerson(person=FIRST_PERSON + number, x_m=x_m, y_m=y_m, vx_mps=vx, vy_mps=vy, **numbers)


def driven(frames: int, *people: FollowedPerson) -> tuple[PoseGraph, Estimate]:
    graph = PoseGraph(GraphConfig(), WeightsConfig())
    for k in range(frames):
        estimate = graph.optimise(measured(k, people))
    return graph, estimate


def test_people_have_the_egos_covariance_and_do_not_affect_vehicles() -> None:
    _, estimate = driven(20, person_at(10.0, 2.0, vy=-1.0))
    (user,) = estimate.people
    assert estimate.vehicles == ()
    assert estimate.road_users == (user,)
    assert user.is_person
    assert user.seen
    assert (user.T_world_vehicle.x_m, user.T_world_vehicle.y_m) == pytest.approx((19.5, 2.0), abs=0.05)
    assert user.T_world_vehicle.yaw_rad == pytest.approx(-math.pi / 2.0, abs=0.01)
    assert user.velocity_mps == pytest.approx((0.0, -1.0), abs=0.01)
    assert user.cov[0] + user.cov[4] > 0.05  # its own, and the ego's


def test_boxes_are_at_the_reported_position() -> None:
    _, estimate = driven(20, person_at(10.0, 2.0, vy=-1.0))
    nobody, rider, bicycle = place_boxes(3, 19, [], [(FIRST_PERSON, (1, 2)), (FIRST_PERSON + 7, (0,))], estimate)
    assert nobody is None
    assert rider is not None
    assert rider == bicycle
    assert (rider.track, rider.label) == (FIRST_PERSON, "pedestrian")
    assert (rider.x_m, rider.y_m) == pytest.approx((10.0, 2.0), abs=1e-6)
    assert rider.velocity_mps == pytest.approx((0.0, -1.0), abs=0.01)


def test_people_are_predicted_without_images_and_through_a_checkpoint() -> None:
    graph, estimate = driven(10, person_at(10.0, 2.0, vy=-1.0))
    late = msgspec.structs.replace(measured(12, (), 0.0, status=(Status.COASTING,)), cc=None)
    restored = PoseGraph.restore(graph.checkpoint(), GraphConfig(), WeightsConfig())
    coasted = graph.optimise(late)
    (before,), (after,) = estimate.people, coasted.people
    assert after.T_world_vehicle.y_m == pytest.approx(before.T_world_vehicle.y_m - 0.3, abs=0.01)
    assert after.age_ns == before.age_ns + 300_000_000
    assert after.cov[0] > before.cov[0]
    assert restored.optimise(late) == coasted


def test_a_crowd_is_cut_to_the_nearest_sixty() -> None:
    crowd = tuple(person_at(5.0 + 0.5 * k, 0.0, number=k) for k in range(80))
    _, estimate = driven(3, *crowd)
    assert [user.vehicle - FIRST_PERSON for user in estimate.people] == list(range(60))


@given(
    p=st.tuples(st.floats(3.0, 40.0), st.floats(-8.0, 8.0)), v=st.tuples(st.floats(-15.0, -1.0), st.floats(-2.0, 2.0))
)
@settings(max_examples=25)
def test_closest_approach_assumes_constant_velocities(p: tuple[float, float], v: tuple[float, float]) -> None:
    means, deviators = np.full((2, 1), 1e-4), np.zeros((2, 1), np.complex128)
    (found,) = approaches(np.array([complex(*p)]), np.array([complex(*v)]), means, deviators)
    times = np.linspace(0.0, 30.0, 30_001)
    away = np.hypot(p[0] + v[0] * times, p[1] + v[1] * times)
    assert found.distance_m == pytest.approx(away.min(), abs=0.01)
    assert found.time_s == pytest.approx(times[away.argmin()], abs=0.02)
    rng = np.random.default_rng(0)
    ps, vs = rng.normal(p, 0.01, (4000, 2)), rng.normal(v, 0.01, (4000, 2))
    drawn = -(ps * vs).sum(axis=1) / (vs * vs).sum(axis=1)
    if 0.1 < found.time_s < 29.0:
        assert found.sigma_s == pytest.approx(drawn.std(), rel=0.15)


def test_crossing_person_is_nearby_and_departing_one_is_not() -> None:
    people = person_at(12.0, 3.0, vy=-1.2), person_at(12.0, 6.0, vy=1.2, number=1), person_at(25.0, 0.0, number=2)
    _, estimate = driven(10, *people)
    crossing, leaving, ahead = (user.approach for user in estimate.people)
    assert crossing.nearby
    assert crossing.time_s == pytest.approx(2.4, abs=0.2)
    assert not leaving.nearby
    assert ahead.time_s == pytest.approx(5.0, abs=0.1)
    told = nearby(estimate)
    assert told.users[0].vehicle == estimate.people[0].vehicle
    assert told.users[0].T_ego_vehicle.x_m == pytest.approx(12.0, abs=0.1)


def test_hidden_road_behind_a_parked_car_contains_a_child() -> None:
    car = RoadUser(
        vehicle=3, T_world_vehicle=SE2(10.0, 3.0, 0.0), cov=(0.01,) * 9, velocity_mps=(0.0, 0.0), age_ns=0, frames=9,
        velocity_cov=(0.01,) * 4, length_m=4.0, width_m=1.8, height_m=1.5,
    )  # fmt: skip
    (fan,) = hidden_fans((car,), SE2(), 1.65)
    corners = np.array(fan.corners_m)

    def holds(x_m: float, y_m: float) -> bool:
        edges = np.roll(corners, -1, axis=0) - corners
        to = np.array([x_m, y_m]) - corners
        return bool((edges[:, 0] * to[:, 1] - edges[:, 1] * to[:, 0] > 0.0).all())

    assert holds(16.0, 4.5)  # behind it, as the camera looks
    assert not holds(16.0, -1.0)
    assert not holds(7.0, 3.0)
    assert hidden_fans((msgspec.structs.replace(car, T_world_vehicle=SE2(-10.0, 3.0, 0.0)),), SE2(), 1.65) == ()


def test_example_stops_only_for_a_person_ahead() -> None:
    example = Path(__file__).resolve().parent.parent / "docs" / "examples" / "stop_for_people.py"
    who_stops_us = runpy.run_path(str(example))["who_stops_us"]
    scene = Scene()
    people = scene.see(found([box_of(12.0, 0.4)]), frames=5)
    assert len(who_stops_us(driven(5, *people)[1])) == 1
    aside = Scene()
    people = aside.see(found([box_of(12.0, 7.0)]), frames=5)
    assert len(people) == 1
    assert who_stops_us(driven(5, *people)[1]) == []
