"""The built-in world: a street with traffic, seen by a car's camera, with exact truth. Needs numba (extra `train`).

`sample` gives one frame of an independent world, `World` a drive. Deterministic by seed on one machine.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import msgspec
import numpy as np

from birdslam.geometry.camera import Camera
from birdslam.world.labels import frame_of
from birdslam.world.rendering.photometrics import develop, draw_lens, draw_sky
from birdslam.world.rendering.renderer import Renderer
from birdslam.world.scenario import draw_scenario, drive
from birdslam.world.street.street_plan import draw_street
from birdslam.world.traffic.flow import populate
from birdslam.world.traffic.parking import cleared, draw_lots
from birdslam.world.traffic.placement import furnish
from birdslam.world.traffic.poses import ego_pose, moving, place
from birdslam.world.truth import WorldFrame


class WorldConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Distribution of cameras, and range of the truth."""

    width_px: int = 640
    height_px: int = 192
    height_m: tuple[float, float] = (1.2, 2.2)
    pitch_rad: float = math.radians(4.0)  # at most, up and down
    roll_rad: float = math.radians(2.0)
    field_of_view_rad: tuple[float, float] = (math.radians(40.0), math.radians(100.0))
    samples: int = 2  # per pixel, horizontally and vertically
    street: str = ""  # residential, urban, avenue, country, motorway, industrial, alley; "": random
    street_m: float = 240.0  # its length in a sample
    ego_m: float = 30.0  # initial position of the ego along it


def sample(seed: int, width_px: int, height_px: int) -> WorldFrame:
    """One frame of a random street, weather and camera, as used for training."""
    rng = np.random.default_rng([seed, 1])
    config = WorldConfig(width_px=width_px, height_px=height_px)
    street = draw_street(rng, config.street_m, config.ego_m, config.street or None)
    camera = draw_camera(rng, config)
    lanes = [lane for lane in street.lanes if lane.direction > 0] or list(street.lanes)
    lane = lanes[int(rng.integers(0, len(lanes)))]
    aside, turned = (
        (rng.normal(0.0, 0.3), rng.normal(0.0, 0.03))
        if rng.random() < 0.85
        else (rng.normal(0.0, 1.2), rng.normal(0.0, 0.15))
    )
    d = float(np.clip(lane.d_m + aside, street.right_m + 1.0, street.left_m - 1.0))
    lots_rng = rng.spawn(1)[0]
    lots = draw_lots(lots_rng, street, config.ego_m)
    standing = place(street, cleared(furnish(rng, street, config.ego_m - 12.0, config.ego_m + 150.0), lots, lots_rng))
    movers = populate(rng, street, config.ego_m, d, lots=lots)
    renderer = Renderer(street, draw_sky(rng), config.samples)
    T_world_ego = ego_pose(street, config.ego_m, d, turned)
    scene = standing.plus(moving(street, movers))
    rendered = renderer.render(scene, camera, T_world_ego, config.ego_m)
    image = develop(rendered.light, draw_lens(rng), rng)
    return frame_of(image, rendered, scene, movers, street, camera, T_world_ego, config.ego_m, 0, 0)


def draw_camera(rng: np.random.Generator, config: WorldConfig) -> Camera:
    """A random car camera; its image may be a crop, so the principal point may be off-centre."""
    u = rng.random(3)
    low, high = config.field_of_view_rad
    fx = 0.5 * config.width_px / math.tan(0.5 * (low + (high - low) * float(rng.beta(1.6, 1.8))))
    fy = fx * float(np.clip(rng.normal(1.0, 0.015), 0.96, 1.04))
    pitch = float(np.clip(rng.normal(0.0, 0.4), -1.0, 1.0)) * config.pitch_rad
    horizon = float(np.clip(rng.normal(0.43, 0.1), 0.12, 0.66))  # in image heights, after the crop
    return Camera(
        config.width_px,
        config.height_px,
        fx,
        fy,
        config.width_px * float(np.clip(rng.normal(0.5, 0.015), 0.45, 0.55)) - 0.5,
        float(
            np.clip(config.height_px * horizon + fy * math.tan(pitch), 0.05 * config.height_px, 0.95 * config.height_px)
        ),
        config.height_m[0] + float(u[0]) * (config.height_m[1] - config.height_m[0]),
        pitch,
        float(np.clip(rng.normal(0.0, 0.35), -1.0, 1.0)) * config.roll_rad,
    )


class World:
    """A street with traffic from a seed, and a camera, random unless given."""

    def __init__(self, seed: int, config: WorldConfig = WorldConfig(), camera: Camera | None = None) -> None:  # noqa: B008
        rng = np.random.default_rng([seed, 2])
        self.camera = camera or draw_camera(rng, config)
        self.scenario = draw_scenario(rng, config.street, config.ego_m)
        self._samples = config.samples

    def frames(self, count: int, rate_hz: float = 33.0) -> Iterator[WorldFrame]:
        """The first `count` frames of a drive; ego and traffic move between them."""
        return drive(self.scenario, self.camera, count, rate_hz, self._samples)
