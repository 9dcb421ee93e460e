"""A 2 km loop in a town for repeated drives: other light, another lane, the opposite direction, rain, night.

The second half of the loop is the first rotated by half a turn, so the loop closes. Texture and paint repeat in each
round: the asphalt's tiles divide two kilometres.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from birdslam.geometry.arrays import Bools, Floats, Floats32
from birdslam.world.demo_world import demo_lens, demo_sky
from birdslam.world.rendering import materials as m
from birdslam.world.rendering.night import Night, even_sky
from birdslam.world.rendering.scene import Bodies
from birdslam.world.roads import AXLE_M, CAMERA, dark_camera
from birdslam.world.scenario import Scenario, drive
from birdslam.world.street.course import STEP_M, Course
from birdslam.world.street.street import Street
from birdslam.world.street.street_plan import draw_street
from birdslam.world.traffic.fleet import draw_shape
from birdslam.world.traffic.flow import Mover, populate, set_initial_motion
from birdslam.world.traffic.placement import Scenery, furnish
from birdslam.world.traffic.poses import moving, place
from birdslam.world.truth import WorldFrame
from birdslam.world.windscreen import Overlay

ROUND_M, ROUNDS = 2000.0, 2
BEYOND_M = 300.0  # length of road beyond the end
RATE_HZ, SPEED_MPS = 10.0, 10.0
START_M = 30.0
CORNERS_M, CORNER_M = (210.0, 690.0), 110.0  # starts and length of the two corners in half a round
GRADE, GRADE_M = 0.02, 500.0
SAMPLES = 2  # per pixel, horizontally and vertically
_SEED = 17  # an urban street of two lanes forth and one back, cars parked on both sides


@dataclass(frozen=True)
class TownDrive:
    """A drive in the town; `differs` describes the difference to the mapping drive."""

    differs: str
    frames: int
    begin_m: float = START_M
    lane: int = 0  # in the ego's direction, counted from the middle of the road
    seed: int = 1  # of moving and parked cars
    light: str = "afternoon"  # evening, rain, night
    back: bool = False  # opposite direction


DRIVES: dict[str, TownDrive] = {
    "twice": TownDrive("two rounds", round(ROUNDS * ROUND_M / SPEED_MPS * RATE_HZ)),
    "traffic": TownDrive("other cars, parked and moving", 300, 330.0, seed=2),
    "lane": TownDrive("the other lane, other cars", 300, 330.0, lane=1, seed=3),
    "evening": TownDrive("low sun from the other side, other cars", 300, 330.0, seed=4, light="evening"),
    "evening_lane": TownDrive("low sun and the other lane, other cars", 300, 330.0, 1, 5, "evening"),
    "rain": TownDrive("rain on the glass, a wet road", 300, 330.0, seed=6, light="rain"),
    "night": TownDrive("own headlights alone", 300, 330.0, seed=7, light="night"),
    "back": TownDrive("the other way", 300, 330.0, seed=8, back=True),
}


def frames(name: str, count: int | None = None) -> Iterator[WorldFrame]:
    """The first `count` frames of a drive (None: all) with their truth, from roads.CAMERA at RATE_HZ."""
    planned = DRIVES[name]
    rain = Overlay("rain", CAMERA.width_px, CAMERA.height_px, planned.seed) if planned.light == "rain" else None
    for frame in drive(scenario(planned), CAMERA, count or planned.frames, RATE_HZ, SAMPLES):
        yield frame if rain is None else replace(frame, image=rain.draw(frame.image))


def scenario(planned: TownDrive) -> Scenario:
    """The initial state of a drive in the town."""
    rng = np.random.default_rng([_SEED, 39])
    course = _course()
    around = draw_street(rng, ROUND_M, START_M, "urban", course)
    street = _repeat_rounds(around, course)
    standing = furnish(rng, replace(street, crossings=around.crossings), 0.0, ROUND_M)
    built = place(street, standing)
    built = built.subset(_clear_of_the_road(street, standing, built))

    rng = np.random.default_rng([planned.seed, 40])
    everybody = set_initial_motion(populate(rng, around, 0.0, 0.0, ROUND_M), around)
    parked = moving(street, [each for each in everybody if each.lane_d_m is None])
    parked = replace(parked, object_id=np.full(len(parked.kind), -1, np.int32))
    road = _reversed(street) if planned.back else street
    lanes = sorted((lane for lane in road.lanes if lane.direction > 0), key=lambda lane: abs(lane.d_m))
    own = lanes[planned.lane]
    ego = Mover(draw_shape(rng, "estate"), planned.begin_m, own.d_m, 0.0, SPEED_MPS, SPEED_MPS, own.d_m)
    night = planned.light == "night"
    return Scenario(
        road, built.plus(parked), tuple(_traffic(rng, road, planned.begin_m, own.d_m)), ego, sky_of(planned.light),
        dark_camera() if night else demo_lens(), planned.seed, AXLE_M, Night() if night else None,
    )  # fmt: skip


def _course() -> Course:
    """The course of one round."""
    s = np.arange(round(0.5 * ROUND_M / STEP_M)) * STEP_M
    curvature = np.zeros_like(s)
    for begin in CORNERS_M:
        inside = (s >= begin) & (s < begin + CORNER_M)
        curvature[inside] += 1.0 - np.cos(2.0 * math.pi * (s[inside] - begin) / CORNER_M)
    curvature *= math.pi / (STEP_M * curvature.sum())
    slope = GRADE * np.sin(2.0 * math.pi * s / GRADE_M)
    # Tables of streets have one more entry than steps
    return Course(*(np.append(np.tile(column, 2), column[0]) for column in (curvature, slope)))


def _repeat_rounds(street: Street, course: Course) -> Street:
    """Repeats a street of one round ROUNDS times, with BEYOND_M more at the end."""
    count = round((ROUNDS * ROUND_M + BEYOND_M) / STEP_M) + 1
    along = Course(*(np.resize(column[:-1], count) for column in course.columns))
    kept = street.marks[(street.marks[:, 1] > 0.0) & (street.marks[:, 2] < ROUND_M)]
    crossings, marks = (
        np.concatenate([_shift_columns(rows, columns, turn * ROUND_M) for turn in range(ROUNDS + 1)])
        for rows, columns in ((street.crossings, [0]), (kept, [1, 2]))
    )
    return replace(street.along(along), crossings=crossings, marks=marks)


def _shift_columns(rows: Floats32, columns: list[int], way_m: float) -> Floats32:
    """Adds an offset to the columns that hold an s."""
    out = rows.copy()
    out[:, columns] += np.float32(way_m)
    return out


def _clear_of_the_road(street: Street, standing: Scenery, built: Bodies) -> Bools:
    """Mask (N,) of the scenery that is not on another part of the road, nor duplicated at the end of the round."""
    one_round = round(ROUND_M / STEP_M)
    line = np.column_stack([street.x_m, street.y_m])[:one_round]
    nearest_m, _ = cKDTree(line).query(built.position_m[:, :2])
    half_m = 0.5 * np.hypot(built.parameters[:, m.LENGTH], built.parameters[:, m.WIDTH])
    clear_m = max(-street.right_m, street.left_m) + half_m + 1.0
    s, d = np.array(standing.s_m), np.abs(np.array(standing.d_m))
    inside: Bools = (s < ROUND_M) & (nearest_m > np.minimum(0.9 * d, clear_m)) & (built.kind != m.BRIDGE)
    return inside


def _reversed(street: Street) -> Street:
    """The street for driving in the opposite direction."""
    length_m = street.length_m
    bands = street.bands[:, [1, 0, 3, 2, 4, 5]] * np.array([-1, -1, 1, 1, 1, 1], np.float32)
    lines = street.lines * np.array([-1, *[1] * 8], np.float32)
    crossings = street.crossings[:, [0, 1, 3, 2, 4, 5]] * np.array([-1, *[1] * 5], np.float32)
    crossings[:, 0] += length_m
    marks = street.marks[:, [0, 2, 1, 4, 3, 5]] * np.array([1, -1, -1, -1, -1, -1], np.float32)
    marks[:, 1:3] += length_m
    return replace(
        street,
        x_m=street.x_m[::-1].copy(), y_m=street.y_m[::-1].copy(), z_m=street.z_m[::-1].copy(),
        yaw_rad=street.yaw_rad[::-1] + math.pi,
        bands=bands[np.argsort(bands[:, 0])], lines=lines, crossings=crossings[::-1].copy(),
        marks=marks[np.argsort(marks[:, 1], kind="stable")],
        lanes=tuple(replace(lane, d_m=-lane.d_m, direction=-lane.direction) for lane in street.lanes),
        parking=tuple((-d, -direction) for d, direction in street.parking),
        right_m=-street.left_m, left_m=-street.right_m,
        front_right_m=-street.front_left_m, front_left_m=-street.front_right_m,
    )  # fmt: skip


def _traffic(rng: np.random.Generator, street: Street, begin_m: float, own_d_m: float) -> Iterator[Mover]:
    """A car ahead, cars in the other lane, and oncoming cars."""
    shapes = "hatchback", "suv", "van", "sedan", "estate", "city"
    for lane in street.lanes:
        at = begin_m + (35.0 if lane.d_m == own_d_m else float(rng.uniform(15.0, 60.0)))
        while at < street.length_m - 20.0:
            speed = SPEED_MPS * float(rng.uniform(1.0, 1.03) if lane.direction > 0 else rng.uniform(0.8, 1.1))
            turn = 0.0 if lane.direction > 0 else math.pi
            shape = draw_shape(rng, str(rng.choice(shapes)))
            yield Mover(shape, at, lane.d_m, turn, speed, speed, lane.d_m)
            if lane.d_m == own_d_m:
                break
            at += float(rng.uniform(50.0, 160.0))


def sky_of(light: str) -> Floats:
    """The sky of day, evening, rain or night."""
    if light == "night":
        return even_sky(0.25)
    sky = demo_sky()
    if light == "evening":
        sky[0:3] = -0.66, 0.66, 0.36
        sky[3:6], sky[6:9], sky[9:12] = (4.6, 3.9, 2.9), (0.5, 0.6, 0.8), (1.2, 1.2, 1.2)
        sky[17], sky[18], sky[22], sky[23] = 0.7, 0.42, 0.6, 0.4
    elif light == "rain":
        sky[3:6], sky[6:9], sky[9:12] = 0.0, (1.5, 1.55, 1.6), (1.6, 1.65, 1.7)
        sky[15], sky[16], sky[17] = 400.0, 0.8, 0.0
    return sky
