"""Scenes of people on a straight street: a child steps out between parked cars, a crowd, people who stand.

They walk along and across, wait and set out, push prams, cycle along and across, by day, night and rain; the truth is
the world's own (truth.py). `boxes` are what a detector would say of it: the outline of what is seen of each body, with
noise.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from birdslam.geometry.arrays import Floats
from birdslam.geometry.camera import Camera
from birdslam.world.demo_world import demo_lens, demo_sky
from birdslam.world.rendering import materials as m
from birdslam.world.rendering.night import Night
from birdslam.world.roads import dark_camera
from birdslam.world.scenario import Scenario
from birdslam.world.street.course import STEP_M, Course
from birdslam.world.street.street import Street
from birdslam.world.street.street_plan import draw_street
from birdslam.world.town import sky_of
from birdslam.world.traffic.fleet import draw_cyclist, draw_pedestrian, draw_shape, give_pram
from birdslam.world.traffic.flow import Mover
from birdslam.world.traffic.placement import furnish
from birdslam.world.traffic.poses import place
from birdslam.world.truth import WorldFrame

CAMERA = Camera(960, 288, 556.8, 556.8, 479.5, 135.0, height_m=1.55, pitch_rad=0.01)  # the shipped drive's, larger
EGO_M = 30.0  # where along the street the ego begins
LEAST_SEEN, LEAST_PX = 0.25, 12.0  # a detector finds who is seen to that share, and so high
BOX_SIGMA_REL = 0.02  # 1-sigma of an edge, of the box's height; RRC's boxes of people have 0.015 to 0.025
BOX_SIGMA_PX = 0.4

_SEED = 1  # a street with a parking strip on its right, on the ego's side
_STREET_M = 300.0
_ACROSS = math.pi / 2  # to the left of who drives along the street
_WALK, _CYCLE = 4.3, 1.1  # rad of the legs, of the cranks, a metre


def child_steps_out(ego_mps: float = 8.0) -> Scenario:
    """Cars park at the right; 32 m ahead a child waits between two, and walks across from 1.6 s on."""
    rng, street = _street()
    strip = street.parking[0][0]
    at = EGO_M + 32.0
    parked = [at - 20.4, at - 15.2, at - 10.0, at - 4.8, at + 3.0, at + 8.2, at + 13.4]
    movers = [Mover(draw_shape(rng, "estate" if k % 2 else "suv"), s, strip, 0.0) for k, s in enumerate(parked)]
    child = draw_pedestrian(rng)
    child.parameters[m.HEIGHT] = 1.15
    out = Mover(child, at, strip - 0.4, _ACROSS, phase_per_m=_WALK, walks=[(1.6, _ACROSS, 1.6)])
    return _scenario(rng, street, [*movers, out], ego_mps)


def crowd(people: int = 25, ego_mps: float = 2.0, vehicles: int = 0) -> Scenario:
    """So many people before a slow ego, and so many standing vehicles.

    People walk along the street or across it and turn back after some seconds, some wait before they set out, one in
    six cycles, one in eight pushes a pram.
    """
    rng, street = _street()
    movers: list[Mover] = []
    for k in range(people):
        s, d = EGO_M + 8.0 + 24.0 * k / max(people, 1), float(rng.uniform(street.right_m - 1.5, street.left_m + 1.5))
        turn = float(rng.choice([0.0, math.pi, _ACROSS, -_ACROSS])) + float(rng.normal(0.0, 0.15))
        cycles, waits_s = k % 6 == 5, float(rng.uniform(1.0, 4.0)) if k % 4 == 0 else 0.0
        speed = float(rng.uniform(2.5, 4.0) if cycles else rng.uniform(0.9, 1.6))
        goes_s = float(rng.uniform(3.0, 5.0))
        walks = [(waits_s + goes_s * leg, turn + math.pi * (leg % 2), speed) for leg in range(20)]
        body, phase = (draw_cyclist(rng), _CYCLE) if cycles else (draw_pedestrian(rng), _WALK)
        if k % 8 == 4 and not cycles:
            body = give_pram(body)
        movers.append(Mover(body, s, d, turn, 0.0, phase_per_m=phase, walks=walks))
    for k in range(vehicles):
        side = street.right_m + 1.0 if k % 2 else street.left_m - 1.0
        movers.append(Mover(draw_shape(rng, "hatchback" if k % 3 else "van"), EGO_M + 14.0 + 5.6 * k, side, 0.0))
    return _scenario(rng, street, movers, ego_mps)


def people_stand(ego_mps: float = 8.0) -> Scenario:
    """Eight people stand on both sides of the road that the ego drives along."""
    rng, street = _street()
    movers = [
        Mover(draw_pedestrian(rng), EGO_M + 18.0 + 6.0 * k, street.left_m + 1.0 if k % 2 else street.right_m - 1.0, 0.0)
        for k in range(8)
    ]
    return _scenario(rng, street, movers, ego_mps)


def lit(scenario: Scenario, light: str) -> Scenario:
    """The scene by day, evening, rain or night."""
    if light == "night":
        return replace(scenario, sky=sky_of(light), lens=dark_camera(), night=Night())
    return replace(scenario, sky=sky_of(light))


def boxes(
    frame: WorldFrame, rng: np.random.Generator, noise: float = 1.0
) -> tuple[Floats, list[str], Floats, list[int]]:
    """Whom a detector would find in a frame: boxes (N, 4) in px, labels, scores (N,), and which bodies they are.

    `noise` scales the errors of the edges.
    """
    found, labels, scores, bodies = [], [], [], []
    for body in frame.objects:
        y, x = np.nonzero(frame.instances == body.object_id + 1)
        if body.visible < LEAST_SEEN or not len(x):
            continue
        box = np.array([x.min(), y.min(), x.max() + 1.0, y.max() + 1.0], dtype=np.float64)
        height = box[3] - box[1]
        if height < LEAST_PX:
            continue
        box += noise * rng.normal(0.0, math.hypot(BOX_SIGMA_REL * height, BOX_SIGMA_PX), 4)
        box = np.clip(box, 0.0, [frame.camera.width_px, frame.camera.height_px] * 2)
        if (box[2:] - box[:2] < 1.0).any():
            continue  # a sliver at the image's border
        found.append(box)
        labels.append("person" if body.label == "pedestrian" else body.label)
        scores.append(0.5 + 0.45 * body.visible)
        bodies.append(body.object_id)
    return np.reshape(found, (-1, 4)), labels, np.array(scores), bodies


def _street() -> tuple[np.random.Generator, Street]:
    rng = np.random.default_rng([_SEED, 9])
    level = np.zeros(int(_STREET_M / STEP_M) + 1)
    return rng, draw_street(rng, _STREET_M, EGO_M, "urban", Course(level, level))


def _scenario(rng: np.random.Generator, street: Street, movers: list[Mover], ego_mps: float) -> Scenario:
    standing = place(street, furnish(rng, street, EGO_M - 12.0, _STREET_M - 50.0))
    lane = next(lane for lane in street.lanes if lane.direction > 0)
    ego = Mover(draw_shape(rng, "estate"), EGO_M, lane.d_m, 0.0, ego_mps, ego_mps)  # keeps its speed, whoever comes
    return Scenario(street, standing, tuple(movers), ego, demo_sky(), demo_lens(), _SEED)
