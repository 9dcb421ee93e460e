"""Difficult roads for odometry and lanes, each from a seed: motorways, ramps, nights, a town, an avenue, hills."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from birdslam.geometry.arrays import Floats
from birdslam.geometry.camera import Camera
from birdslam.world.rendering import materials as m
from birdslam.world.rendering.night import Night, even_sky
from birdslam.world.rendering.photometrics import Lens
from birdslam.world.scenario import Scenario
from birdslam.world.street.course import STEP_M, Course
from birdslam.world.street.street import ASPHALT, BAND, CROSSING, GRASS, HATCHED, LINE, LINE_KINDS, MARK, Lane, Street
from birdslam.world.street.street_plan import draw_street
from birdslam.world.traffic.fleet import draw_shape, draw_truck
from birdslam.world.traffic.flow import Mover, populate, set_initial_motion
from birdslam.world.traffic.placement import Scenery, background, furnish, tree
from birdslam.world.traffic.poses import place

# The field of view of KITTI's cameras, at a size that renders fast
CAMERA = Camera(640, 192, 371.2, 371.2, 319.5, 90.0, height_m=1.65, pitch_rad=0.008)

AXLE_M = 1.7  # from the rear axle to the camera
LANE_M, SHOULDER_M, MEDIAN_M = 3.6, 2.5, 3.0
GERMAN, AMERICAN = (18.0, 6.0), (12.2, 3.05)  # a dashed line's period and dash
RAIL_M, RAIL_HIGH_M = 4.0, 0.75  # length and height of a piece of guard rail
POST_EVERY_M = 50.0  # spacing of posts beside a road
EGO_M = 30.0  # initial position of the ego
QUEUE_M, LIGHT_M = 14.0, 45.0  # from the ego: the vehicle ahead in a queue, and its red light
NIGHT_GREY = 1.0  # cd/m^2; luminance that becomes middle grey
_BEYOND_M = 280.0  # length of road beyond the end of a drive
MAX_OFFSET_RATIO = 0.75  # of a bend's radius: lateral extent of the ground


def camera_of(width_px: int) -> Camera:
    """A camera with the same field of view and another image width."""
    k = width_px / CAMERA.width_px
    middle_u, middle_v = (k * (c + 0.5) - 0.5 for c in (CAMERA.cx_px, CAMERA.cy_px))
    size = width_px, round(k * CAMERA.height_px)
    lens = k * CAMERA.fx_px, k * CAMERA.fy_px, middle_u, middle_v
    return Camera(*size, *lens, height_m=CAMERA.height_m, pitch_rad=CAMERA.pitch_rad)


@dataclass(frozen=True)
class Road:
    """A drive of `frames` images along a road; `hard` describes its difficulty."""

    hard: str
    scenario: Callable[[], Scenario]
    rate_hz: float
    frames: int = 100


@dataclass(frozen=True)
class _Surface:
    """Appearance of asphalt and paint."""

    tone: float = 1.0
    dashes: tuple[float, float] = GERMAN
    yellow: float = 0.0  # the line beside the median


def motorway(
    seed: int, speed_mps: float, bend_per_m: float, surface: _Surface, traffic: bool = True, night: Night | None = None
) -> Scenario:
    """Three lanes per direction; the ego is in the right one or, with traffic, in the middle one."""
    rng = np.random.default_rng([seed, 6])
    length_m = EGO_M + 14.0 * speed_mps + _BEYOND_M
    s = np.arange(int(length_m / STEP_M) + 1) * STEP_M
    course = Course(bend_per_m * np.ones_like(s), np.zeros_like(s))
    street = _road(course, 3, 3, surface)
    standing = _verge(rng, street, length_m)
    lanes = sorted((lane for lane in street.lanes if lane.direction > 0), key=lambda lane: lane.d_m)
    own = lanes[1] if traffic else lanes[0]
    ego = Mover(draw_shape(rng, "estate"), EGO_M, own.d_m, 0.0, speed_mps, speed_mps, own.d_m)
    movers = _traffic(rng, street, own.d_m, speed_mps) if traffic else ()
    return Scenario(
        street, standing, movers, ego, _sunny() if night is None else even_sky(),
        _camera() if night is None else dark_camera(), seed, AXLE_M, night,
    )  # fmt: skip


def ramp(seed: int, radius_m: float, speed_mps: float, arc_m: float, left: bool, glare: bool = False) -> Scenario:
    """One lane that bends from the start and is straight after `arc_m`; with `glare` overexposed, with chevrons."""
    rng = np.random.default_rng([seed, 7])
    length_m = EGO_M + 14.0 * speed_mps + _BEYOND_M
    s = np.arange(int(length_m / STEP_M) + 1) * STEP_M
    straight = np.clip((s - EGO_M - arc_m) / 25.0, 0.0, 1.0)
    before = np.clip((s - EGO_M + 12.0) / 4.0, 0.0, 1.0)  # straight behind the ego, so that the circle does not close
    course = Course((1.0 if left else -1.0) / radius_m * (1.0 - straight) * before, np.zeros_like(s))
    street = _road(course, 1, 0, _Surface(tone=1.7 if glare else 1.0))
    if glare:
        rows = [(HATCHED, at, at + 12.0, 0.6, 3.4, 0.0) for at in np.arange(EGO_M - 8.0, length_m, 12.0)]
        street = replace(street, marks=np.array(rows, np.float32).reshape(-1, len(MARK)))
    standing = _verge(rng, street, min(length_m, EGO_M + arc_m + 250.0))
    lane = street.lanes[0]
    ego = Mover(draw_shape(rng, "estate"), EGO_M, lane.d_m, 0.0, speed_mps, speed_mps, lane.d_m)
    return Scenario(street, standing, (), ego, _sunny(), _camera(2.6 if glare else 1.0), seed, AXLE_M)


def night_street(seed: int, speed_mps: float) -> Scenario:
    """A country road with bends: a car ahead, oncoming cars, posts and trees in the beams."""
    rng = np.random.default_rng([seed, 8])
    length_m = EGO_M + 14.0 * speed_mps + _BEYOND_M
    s = np.arange(int(length_m / STEP_M) + 1) * STEP_M
    course = Course(0.004 * np.sin(2.0 * math.pi * s / 220.0), np.zeros_like(s))
    street = _road(course, 1, 1, _Surface(dashes=(12.0, 4.0)))
    standing = _verge(rng, street, length_m)
    forth, back = (next(lane for lane in street.lanes if lane.direction == sign) for sign in (1, -1))
    ego = Mover(draw_shape(rng, "estate"), EGO_M, forth.d_m, 0.0, speed_mps, speed_mps, forth.d_m)
    ahead = Mover(draw_shape(rng, "sedan"), EGO_M + 35.0, forth.d_m, 0.0, speed_mps, 1.02 * speed_mps, forth.d_m)
    coming = [
        Mover(draw_shape(rng, shape), EGO_M + at, back.d_m, math.pi, speed_mps, speed_mps, back.d_m)
        for shape, at in (("hatchback", 70.0), ("suv", 190.0), ("van", 330.0))
    ]
    return Scenario(
        street, standing, (ahead, *coming), ego, even_sky(0.25), dark_camera(), seed, AXLE_M, Night()
    )  # fmt: skip


def built_up(seed: int, kind: str, speed_mps: float, grade: float = 0.0) -> Scenario:
    """A random street of a kind by day with scenery and traffic, gently bent, up and down at `grade`."""
    rng = np.random.default_rng([seed, 9])
    length_m = EGO_M + 14.0 * speed_mps + _BEYOND_M
    s = np.arange(int(length_m / STEP_M) + 1) * STEP_M
    course = Course(0.003 * np.sin(2.0 * math.pi * s / 240.0), grade * np.sin(2.0 * math.pi * s / 180.0))
    street = draw_street(rng, length_m, EGO_M, kind, course)
    standing = place(street, furnish(rng, street, EGO_M - 12.0, length_m - 50.0))
    lane = next(lane for lane in street.lanes if lane.direction > 0)
    movers = tuple(set_initial_motion(populate(rng, street, EGO_M, lane.d_m, 300.0), street))
    ego = Mover(draw_shape(rng, "estate"), EGO_M, lane.d_m, 0.0, speed_mps, speed_mps, lane.d_m)
    return Scenario(street, standing, movers, ego, _sunny(), _camera(), seed, AXLE_M)


def queue(seed: int, kind: str, speed_mps: float, ahead: str, red_s: float = 6.0) -> Scenario:
    """A random street; a vehicle close ahead brakes for a red light, others drive beside the ego.

    `ahead` is the vehicle's shape, or "truck"; the light is red until `red_s`.
    """
    street = built_up(seed, kind, speed_mps)
    rng = np.random.default_rng([seed, 10])
    own_d_m, red = street.ego.d_m, ((EGO_M + LIGHT_M, red_s),)
    body = draw_truck(rng) if ahead == "truck" else draw_shape(rng, ahead)
    front = Mover(body, EGO_M + QUEUE_M, own_d_m, 0.0, speed_mps, speed_mps, own_d_m, stops=red)
    others = [m for m in street.movers if abs(m.d_m - own_d_m) > 1.5 or abs(m.s_m - EGO_M) > 70.0]
    return replace(street, movers=(front, *others), ego=replace(street.ego, stops=red))


def _road(course: Course, forth: int, back: int, surface: _Surface) -> Street:
    """Lanes forth and back, a median if both directions have several, shoulders, guard rails and grass."""
    apart = 0.5 * MEDIAN_M if min(forth, back) > 1 else 0.0
    right, left = -apart - forth * LANE_M, apart + back * LANE_M
    shoulder = SHOULDER_M if max(forth, back) > 1 or back == 0 else 0.5
    far = min(MAX_OFFSET_RATIO / max(float(np.abs(course.curvature).max()), 1e-4), 75.0)
    edges = right - shoulder, left + shoulder
    bands = [(-far, edges[0], 0.0, 0.0, GRASS, 1.0), (edges[1], far, 0.0, 0.0, GRASS, 1.0)]
    if apart > 0.0:
        bands += [(edges[0], -apart, 0.0, 0.0, ASPHALT, surface.tone), (-apart, apart, 0.0, 0.0, GRASS, 0.9),
                  (apart, edges[1], 0.0, 0.0, ASPHALT, surface.tone)]  # fmt: skip
    else:
        bands += [(*edges, 0.0, 0.0, ASPHALT, surface.tone)]
    rows: list[tuple[float, ...]] = []

    def line(d: float, name: str, thick: float = 0.15, yellow: float = 0.0) -> None:
        rows.append((d, LINE_KINDS.index(name), thick, *surface.dashes, 3.0, yellow, 0.1, len(rows)))

    line(right, "solid", 0.25)
    line(left, "solid", 0.25)
    for sign, count in ((-1.0, forth), (1.0, back)):
        for k in range(1, count):
            line(sign * (apart + k * LANE_M), "dashed")
        if apart > 0.0:
            line(sign * (apart + 0.4), "solid", 0.2, surface.yellow)
    if back and apart == 0.0:
        line(0.0, "dashed")
    lanes = [Lane(-apart - (k + 0.5) * LANE_M, 1, 30.0) for k in range(forth)]
    lanes += [Lane(apart + (k + 0.5) * LANE_M, -1, 30.0) for k in range(back)]
    x, y, z, yaw = course.table()
    return Street(
        "motorway", x, y, z, yaw, np.array(sorted(bands), np.float32).reshape(-1, len(BAND)),
        np.array(rows, np.float32).reshape(-1, len(LINE)), np.zeros((0, len(CROSSING)), np.float32),
        np.zeros((0, len(MARK)), np.float32), tuple(lanes), (), *edges, *edges, 0.0, 0.3,
    )  # fmt: skip


def _verge(rng: np.random.Generator, street: Street, length_m: float):  # type: ignore[no-untyped-def]
    """Guard rails outside and along the median, white posts, bushes, and woods farther away."""
    out = Scenery([], [], [], [], [])
    wide = max(abs(lane.d_m) for lane in street.lanes) > LANE_M
    rails = [street.right_m - 0.6, street.left_m + 0.6, *((-0.5, 0.5) if wide else ())]
    inside = 1.0 if street.curvature(EGO_M + 20.0) > 0.0 else -1.0  # towards the centre of a bend
    for d in rails if wide else [rail for rail in rails if rail * inside < 0.0]:
        for s in np.arange(0.0, length_m, RAIL_M):
            P = out.add(m.WALLING, float(s) + 0.5 * RAIL_M, d, 0.0, (RAIL_M, 0.1, RAIL_HIGH_M))
            P[8], P[:3], P[m.PICTURE] = 3.0, 0.3, -1
    for sign, front in ((-1.0, street.front_right_m), (1.0, street.front_left_m)):
        for s in np.arange(float(rng.uniform(0.0, POST_EVERY_M)), length_m, POST_EVERY_M if wide else 25.0):
            P = out.add(m.POST, float(s), front + sign * 0.9, 0.0, (0.1, 0.06, 1.0))
            P[:3] = 0.75
        for s in np.arange(0.0, length_m, 9.0):
            d = front + sign * float(rng.uniform(3.0, 8.0))
            if rng.random() < 0.6 and street.curvature(float(s)) * d < 0.6:
                tree(rng, out, float(s), d, float(rng.uniform(0.8, 2.5)), 1, 1)
        background(rng, street, out, sign, front, 0.0, length_m)
        for s in np.arange(0.0, length_m, 6.0):  # sharp bends have no scenery inside
            bend = abs(street.curvature(float(s)))
            d = front + sign * float(rng.uniform(4.0, 30.0))
            if bend > 0.01 and abs(d) * bend < MAX_OFFSET_RATIO - 0.05:
                tree(rng, out, float(s), d, float(rng.uniform(3.0, 12.0)), int(rng.choice([0, 2])), 3)
    return place(street, out)


def _traffic(rng: np.random.Generator, street: Street, own_d_m: float, speed_mps: float) -> tuple[Mover, ...]:
    """Cars and trucks on the other lanes; the ego lane is free ahead."""
    movers = []
    for lane in street.lanes:
        mean = speed_mps * (0.85 if lane.d_m < own_d_m else 1.12) if lane.direction > 0 else speed_mps
        s = EGO_M + float(rng.uniform(-30.0, 15.0)) + (75.0 if lane.d_m == own_d_m else 0.0)
        while s < EGO_M + 600.0:
            slow = lane.direction > 0 and lane.d_m < own_d_m
            truck = slow and rng.random() < 0.5
            body = draw_truck(rng) if truck else draw_shape(rng, str(rng.choice(["sedan", "estate", "suv", "mpv"])))
            own = speed_mps if lane.d_m == own_d_m else mean
            turn = 0.0 if lane.direction > 0 else math.pi
            movers.append(Mover(body, s, lane.d_m, turn, own, own, lane.d_m))
            s += float(rng.uniform(45.0, 90.0))
    return tuple(movers)


def _sunny() -> Floats:
    """A clear day; asphalt without grit or cracks."""
    sky = np.zeros(even_sky().shape)
    sky[0:3] = 0.25, 0.62, 0.74
    sky[3:6] = 4.8, 4.6, 4.1
    sky[6:9], sky[9:12], sky[12:15] = (0.7, 0.9, 1.15), (1.6, 1.7, 1.8), (1.3, 1.4, 1.5)
    sky[15], sky[17], sky[18], sky[19] = 2500.0, 0.3, 0.2, 0.4
    sky[21], sky[22], sky[23], sky[25] = 1.0, 0.5, 0.5, 0.5
    return sky


def _camera(exposure: float = 1.0) -> Lens:
    """A camera by day; with an exposure of two or more the road is nearly white."""
    return Lens(exposure, 1.0 / 2.2, 1.05, (1.0, 1.0, 1.0), 0.4, 0.002, 0.004, 0.1, 0.0, 0.8, 0, 0.0)


def dark_camera() -> Lens:
    """The same camera at maximum gain: noise, a glow around lamps."""
    return Lens(
        1.0, 1.0 / 2.2, 1.05, (1.0, 1.0, 1.0), 0.6, 0.0015, 0.015, 0.2, 0.1, 0.6, 0, 0.0, fixed=NIGHT_GREY
    )  # fmt: skip


ROADS: dict[str, Road] = {
    "motorway_20": Road(
        "straight, 20 m/s, lines of 12.2 m",
        lambda: motorway(1, 20.0, 0.0, _Surface(0.75, AMERICAN, 1.0)), 10.0,
    ),
    "motorway_30": Road("gently bent, 30 m/s, lines of 18 m", lambda: motorway(2, 30.0, 1 / 900, _Surface(0.6)), 20.0),
    "motorway_40": Road(
        "straight and empty, 40 m/s", lambda: motorway(3, 40.0, 0.0, _Surface(0.6), traffic=False), 33.0, 150
    ),
    "motorway_33_10hz": Road(
        "bent the other way, 33 m/s in 10 images a second",
        lambda: motorway(4, 33.0, -1 / 700, _Surface(0.7, AMERICAN)), 10.0, 60,
    ),
    "ramp_20": Road("to the right, 20 m radius", lambda: ramp(5, 20.0, 8.7, 55.0, False), 10.0, 80),
    "ramp_21_glare": Road(
        "to the right, 21 m radius, 10 m/s; over-exposed asphalt with chevrons, as in KITTI 01",
        lambda: ramp(6, 21.0, 10.0, 55.0, False, glare=True), 10.0, 80,
    ),
    "ramp_35": Road("to the left, 35 m radius", lambda: ramp(7, 35.0, 11.5, 90.0, True), 10.0, 80),
    "ramp_60": Road("to the right, 60 m radius, 15 m/s", lambda: ramp(8, 60.0, 15.0, 150.0, False), 33.0, 150),
    "night_street": Road("a country road in own headlights, 14 m/s", lambda: night_street(9, 14.0), 10.0),
    "night_motorway": Road(
        "a motorway in own headlights, 27 m/s",
        lambda: motorway(10, 27.0, 0.0, _Surface(0.8), night=Night()), 20.0,
    ),
    "town": Road("a street of a town with parked cars, 10 m/s", lambda: built_up(11, "urban", 10.0), 10.0),
    "avenue": Road("an avenue of a town, 13 m/s", lambda: built_up(12, "avenue", 13.0), 10.0),
    "queue_avenue": Road(
        "behind a van that brakes for a red light, from 14 m/s; trucks beside",
        lambda: queue(75, "avenue", 14.0, "van"), 10.0, 70,
    ),
    "queue_street": Road("the same behind a car, from 10 m/s", lambda: queue(76, "urban", 10.0, "suv"), 10.0, 70),
    "queue_sedan": Road("the same, from 13 m/s", lambda: queue(82, "avenue", 13.0, "sedan"), 10.0, 70),
    "queue_truck": Road(
        "behind a truck that hides the road, until both stand, from 12 m/s",
        lambda: queue(94, "urban", 12.0, "truck", 10.0), 10.0, 110,
    ),
    "hills": Road("a country road up and down at 6 %, 16 m/s", lambda: built_up(13, "country", 16.0, 0.06), 10.0),
}  # fmt: skip
