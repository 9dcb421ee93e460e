"""The shipped drive: half a minute through a town, deterministic.

The ego takes a bend, overtakes a slow van, waits at a red light behind a car next to a bus, climbs a grade through
another bend, and drives down again.
"""

from __future__ import annotations

import math

import numpy as np

from birdslam.geometry.arrays import Floats
from birdslam.geometry.camera import Camera
from birdslam.world.rendering.light import SKY_SLOTS
from birdslam.world.rendering.photometrics import Lens
from birdslam.world.scenario import Scenario
from birdslam.world.street.course import STEP_M, Course
from birdslam.world.street.street import Street
from birdslam.world.street.street_plan import draw_street
from birdslam.world.traffic.fleet import draw_cyclist, draw_pedestrian, draw_shape, draw_truck
from birdslam.world.traffic.flow import Mover, populate, set_initial_motion
from birdslam.world.traffic.placement import furnish
from birdslam.world.traffic.poses import place

RATE_HZ = 33.0
FRAMES = 1000
# The field of view of KITTI's cameras, at the input size of the shipped networks
CAMERA = Camera(640, 192, 371.2, 371.2, 319.5, 90.0, height_m=1.55, pitch_rad=0.012)
_SEED = 495
_STREET_M, _EGO_M = 700.0, 30.0
_RED_UNTIL_S = 27.0
# (from s, length in m, heading change in rad) and (from s, length in m, change of slope)
_BENDS = ((56.0, 45.0, 0.62), (172.0, 42.0, -0.75), (250.0, 50.0, 0.5))
_GRADES = ((75.0, 110.0, 0.04), (190.0, 110.0, -0.055))


def demo_scenario() -> Scenario:
    """The initial state of the shipped drive."""
    rng = np.random.default_rng([_SEED, 5])
    street = draw_street(rng, _STREET_M, _EGO_M, "avenue", demo_course())
    standing = place(street, furnish(rng, street, _EGO_M - 12.0, 560.0))
    right, left = sorted(lane.d_m for lane in street.lanes if lane.direction > 0)[:2]
    light_s = stop_line(street)
    everybody = populate(rng, street, _EGO_M, right, 480.0)
    bystanders = [mover for mover in set_initial_motion(everybody, street) if mover.lane_d_m is None]
    red = ((light_s, _RED_UNTIL_S),)

    def car(shape: str, s: float, d: float, speed: float, wish: float, **more: object) -> Mover:
        return Mover(draw_shape(rng, shape), s, d, 0.0, speed, wish, d, **more)  # type: ignore[arg-type]

    ego = car("estate", _EGO_M, right, 11.5, 12.5, stops=red)
    ego.plan = [(_EGO_M + 12.0, left, 14.0), (_EGO_M + 122.0, right, 13.5), (light_s + 8.0, right, 14.0)]
    ahead = car("hatchback", _EGO_M + 29.0, right, 13.0, 14.5, stops=red)
    ahead.plan = [(_EGO_M + 30.0, left, 14.5), (_EGO_M + 118.0, right, 14.0), (light_s + 2.0, right, 14.0)]
    movers = [
        *bystanders,
        ahead,
        car("van", _EGO_M + 56.0, right, 4.5, 4.7),
        car("sedan", _EGO_M + 66.0, left, 13.0, 14.5, stops=((light_s, _RED_UNTIL_S - 0.5),)),
        car("suv", _EGO_M + 84.0, left, 13.0, 14.5, stops=((light_s, _RED_UNTIL_S - 0.5),)),
        car("bus", _EGO_M - 28.0, left, 12.0, 13.0, stops=red),
        car("mpv", _EGO_M + 140.0, right, 9.0, 10.0),
    ]
    for k, lane in enumerate(lane for lane in street.lanes if lane.direction < 0):
        for j, shape in enumerate(("hatchback", "suv", "truck", "sedan", "city", "small_van", "estate")):
            body = draw_truck(rng) if shape == "truck" else draw_shape(rng, shape)
            s = _EGO_M + 70.0 + 62.0 * j + 25.0 * k + rng.uniform(-8, 8)
            movers.append(Mover(body, s, lane.d_m, math.pi, 11.0, 11.0 + 0.5 * k, lane.d_m))
    movers.append(
        Mover(
            draw_cyclist(rng),
            light_s + 60.0,
            street.right_m + 0.8,
            0.0,
            4.5,
            4.5,
            street.right_m + 0.8,
            phase_per_m=1.1,
        )
    )
    for j in range(3):  # people who cross while the light is red
        d = street.right_m - 1.0 - 1.6 * j
        movers.append(
            Mover(draw_pedestrian(rng), light_s + 1.6 + 0.5 * j, d - 14.0, math.pi / 2, 1.35, 1.35, phase_per_m=4.3)
        )
    return Scenario(street, standing, tuple(movers), ego, demo_sky(), demo_lens(), _SEED)


def demo_course() -> Course:
    """Bends and grades with smooth transitions."""
    s = np.arange(int(_STREET_M / STEP_M) + 1) * STEP_M
    curvature, slope = np.zeros_like(s), np.zeros_like(s)
    for at, long, turn in _BENDS:  # a raised cosine of that area
        inside = (s >= at) & (s <= at + long)
        curvature[inside] += turn / long * (1.0 - np.cos(2.0 * math.pi * (s[inside] - at) / long))
    for at, long, change in _GRADES:
        share = np.clip((s - at) / long, 0.0, 1.0)
        slope += change * share * share * (3.0 - 2.0 * share)
    return Course(curvature, slope)


def stop_line(street: Street) -> float:
    """The stop line of the first crossing after the van."""
    s = [float(row[0] - row[1]) - 3.5 for row in street.crossings]
    return next(at for at in s if at > _EGO_M + 150.0)


def demo_sky() -> Floats:
    """A clear afternoon."""
    sky = np.zeros(SKY_SLOTS)
    sky[0:3] = 0.35, -0.70, 0.62
    sky[3:6] = 5.2, 4.9, 4.3
    sky[6:9] = 0.7, 0.9, 1.15
    sky[9:12] = 1.7, 1.8, 1.9
    sky[12:15] = 1.3, 1.4, 1.5
    sky[15], sky[17], sky[18], sky[19], sky[21], sky[22], sky[23], sky[24], sky[25] = (
        2500.0,
        0.35,
        0.42,
        0.6,
        0.9,
        0.5,
        0.5,
        0.25,
        0.6,
    )
    return sky


def demo_lens() -> Lens:
    """A good camera with a little noise."""
    return Lens(1.0, 1.0 / 2.2, 1.05, (1.0, 1.0, 1.0), 0.4, 0.001, 0.003, 0.05, 0.0, 0.9, 0, 0.0)
