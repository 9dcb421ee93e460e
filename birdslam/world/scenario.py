"""A drive: a street, its road users with their plans, and the camera's vibration; rendered frame by frame."""

from __future__ import annotations

import copy
import math
from collections.abc import Iterator
from dataclasses import dataclass

import msgspec
import numpy as np

from birdslam.geometry.arrays import Floats
from birdslam.geometry.camera import Camera
from birdslam.types import NS_PER_S
from birdslam.world.labels import frame_of
from birdslam.world.rendering.night import Night, lit
from birdslam.world.rendering.photometrics import Lens, develop, draw_lens, draw_sky
from birdslam.world.rendering.renderer import Renderer
from birdslam.world.rendering.scene import Bodies
from birdslam.world.street.course import MAX_CURVATURE_PER_M, draw_course
from birdslam.world.street.street import Street
from birdslam.world.street.street_plan import draw_street
from birdslam.world.traffic.fleet import draw_shape
from birdslam.world.traffic.flow import Mover, advance, populate, set_initial_motion
from birdslam.world.traffic.placement import furnish
from birdslam.world.traffic.poses import ego_pose, moving, place
from birdslam.world.truth import WorldFrame

STREET_M = 1500.0  # length of a random drive
VISIBLE_RANGE_M = 190.0  # farther objects are left out
ACTIVE_RANGE_M = 700.0  # along the street; farther road users do not move
_STEPS = 4  # of the driver model per frame


@dataclass(frozen=True)
class Scenario:
    """The initial state of a drive. `ego` is the car with the camera, `shake_seed` the seed of its vibration.

    At `night` the sky is `night.even_sky`, and the car's lamps light the rendered image.
    """

    street: Street
    standing: Bodies
    movers: tuple[Mover, ...]
    ego: Mover
    sky: Floats
    lens: Lens
    shake_seed: int
    camera_ahead_m: float = 0.0  # of the rear axle, which moves along its heading in a bend; the camera does not
    night: Night | None = None


class Shake:
    """Motion of a car body on its suspension: slow heave and pitch, vibration, pitch when braking."""

    def __init__(self, seed: int) -> None:
        rng = np.random.default_rng([seed, 4])
        self._hz = np.concatenate([rng.uniform(0.7, 2.0, 3), rng.uniform(3.0, 7.0, 2)])
        self._phase = rng.uniform(0.0, 2.0 * math.pi, (3, 5))
        self._share = np.array([0.6, 0.6, 0.5, 0.12, 0.1])

    def at(self, t_s: float, speed_mps: float, acceleration_mps2: float) -> tuple[float, float, float]:
        """Pitch and roll in rad and heave in m, relative to the camera's mount."""
        waves = np.sin(2.0 * math.pi * self._hz * t_s + self._phase) @ self._share
        going = min(1.0, speed_mps / 6.0)
        pitch = 0.0022 * going * float(waves[0]) - 0.0025 * acceleration_mps2
        return pitch, 0.0014 * going * float(waves[1]), 0.006 * going * float(waves[2])


def draw_scenario(rng: np.random.Generator, kind: str, ego_s_m: float) -> Scenario:
    """A long street of a kind ("": random) with bends, grades and traffic, and the ego in its lane."""
    street = draw_street(rng, STREET_M, ego_s_m, kind or None)
    bends = [draw_course(rng, STREET_M, ego_s_m + 150.0 * k, MAX_CURVATURE_PER_M[street.kind]) for k in range(8)]
    course = bends[0]
    for k, bend in enumerate(bends[1:], start=1):
        course = course.then(bend, ego_s_m + 150.0 * k)
    street = street.along(course)
    lane = next((lane for lane in street.lanes if lane.direction > 0), street.lanes[0])
    standing = place(street, furnish(rng, street, ego_s_m - 12.0, STREET_M - 50.0))
    movers = tuple(set_initial_motion(populate(rng, street, ego_s_m, lane.d_m, 500.0), street))
    speed = lane.speed_mps
    ego = Mover(draw_shape(rng, "estate"), ego_s_m, lane.d_m, 0.0, 0.7 * speed, 0.9 * speed, lane.d_m)
    return Scenario(street, standing, movers, ego, draw_sky(rng), draw_lens(rng), int(rng.integers(0, 2**31)))


@dataclass(frozen=True)
class Moment:
    """The world at one frame: the ego's pose, the motion of its body, and all visible bodies."""

    frame_id: int
    t_s: float
    T_world_ego: Floats  # (4, 4)
    s_m: float  # of the ego along the street
    speed_mps: float
    bend_per_m: float
    shake: tuple[float, float, float]  # pitch and roll in rad, heave in m
    movers: list[Mover]
    scene: Bodies

    def shaken(self, camera: Camera) -> Camera:
        """The camera displaced by the car's suspension."""
        pitch, roll, heave = self.shake
        return msgspec.structs.replace(
            camera,
            height_m=camera.height_m + heave,
            pitch_rad=camera.pitch_rad + pitch,
            roll_rad=camera.roll_rad + roll,
        )


def moments(scenario: Scenario, count: int, rate_hz: float) -> Iterator[Moment]:
    """The world at each of the first `count` frames, at `rate_hz`; the list of movers is valid until the next."""
    street = scenario.street
    movers, ego = copy.deepcopy(list(scenario.movers)), copy.deepcopy(scenario.ego)
    shake, dt_s = Shake(scenario.shake_seed), 1.0 / rate_hz
    for frame_id in range(count):
        t_s = frame_id * dt_s
        bend = street.curvature(ego.s_m)
        T_world_ego = ego_pose(street, ego.s_m, ego.d_m, ego.turn_rad - scenario.camera_ahead_m * bend)
        near = np.linalg.norm(scenario.standing.position_m[:, :2] - T_world_ego[:2, 3], axis=1) < VISIBLE_RANGE_M
        everybody = moving(street, movers)
        close = np.linalg.norm(everybody.position_m[:, :2] - T_world_ego[:2, 3], axis=1) < VISIBLE_RANGE_M
        scene = scenario.standing.subset(near).plus(everybody.subset(close))
        shaken = shake.at(t_s, ego.speed_mps, ego.acceleration_mps2)
        yield Moment(frame_id, t_s, T_world_ego, ego.s_m, ego.speed_mps, bend, shaken, movers, scene)
        awake = [mover for mover in movers if abs(mover.s_m - ego.s_m) < ACTIVE_RANGE_M]
        for step in range(_STEPS):
            advance(awake, ego, street, t_s + step * dt_s / _STEPS, dt_s / _STEPS)


def drive(scenario: Scenario, camera: Camera, count: int, rate_hz: float, samples: int = 2) -> Iterator[WorldFrame]:
    """The first `count` frames of the scenario, at `rate_hz`."""
    renderer = Renderer(scenario.street, scenario.sky, samples)
    for now in moments(scenario, count, rate_hz):
        shaken = now.shaken(camera)
        rendered = renderer.render(now.scene, shaken, now.T_world_ego, now.s_m)
        light = rendered.light
        if scenario.night is not None:
            yaw_rate = now.bend_per_m * now.speed_mps
            light = lit(scenario.night, rendered, now.scene, shaken, now.T_world_ego, now.speed_mps, yaw_rate)
        image = develop(light, scenario.lens, np.random.default_rng([scenario.shake_seed, now.frame_id]))
        yield frame_of(
            image, rendered, now.scene, now.movers, scenario.street, shaken, now.T_world_ego, now.s_m, now.frame_id,
            round(now.frame_id * NS_PER_S / rate_hz),
        )  # fmt: skip
