"""A synthetic street with a given height profile, drawn by numpy, for tests with a known ground.

The road is level across and its height is a function of the way along it alone, so that the ray of an image row, which
has one slope, meets it in one place: exact for every grade, vertical curve and crest. House fronts on both sides give
corners to follow; grain, patches and lane lines are on the road.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from birdslam.geometry.arrays import Bools, Floats, Floats32
from birdslam.geometry.camera import Camera

TEXEL_M, SIDE, LEVELS = 0.02, 1024, 6
LOOK_M, SAMPLES = 160.0, 4000
LEFT_M, RIGHT_M, FRONT_M = -7.0, 6.5, 6.0  # the house fronts, and how high they are
WHEELBASE_M, CAMERA_AHEAD_M = 2.7, 1.7  # of the rear axle
CURVE_M, HOLD_M = 30.0, 40.0  # transition length of a grade, and its length


@dataclass(frozen=True)
class Stand:
    """The camera over the graded road: where along it, how high in the world, and nose down by `pitch_rad`."""

    way_m: float
    up_m: float
    pitch_rad: float


class GradedRoad:
    """Level, then up at `grade`, over a crest, down at `grade`, and level again."""

    def __init__(self, camera: Camera, grade: float, seed: int = 1) -> None:
        self.camera = camera
        knots = np.cumsum([0.0, 25.0, CURVE_M, HOLD_M, 2 * CURVE_M, HOLD_M, CURVE_M, 2 * LOOK_M])
        slopes = np.array([0.0, 0.0, grade, grade, -grade, -grade, 0.0, 0.0])
        self.length_m = float(knots[-2] + 20.0)
        self._way = np.arange(-20.0, knots[-1], 0.05)
        slope = np.interp(self._way, knots, slopes)
        self._up = np.concatenate([[0.0], np.cumsum(0.5 * (slope[1:] + slope[:-1]) * 0.05)])
        self._road, self._front = _texture(seed), _texture(seed + 1)
        v, u = np.mgrid[0 : camera.height_px, 0 : camera.width_px].astype(np.float64)
        self._x = (u - camera.cx_px) / camera.fx_px
        self._y = (v[:, 0] - camera.cy_px) / camera.fy_px

    def up_m(self, way_m: Floats | float) -> Floats:
        """The road's height at a way along it."""
        out: Floats = np.interp(way_m, self._way, self._up)
        return out

    def stand(self, rear_m: float) -> Stand:
        """Pose of a car with its rear axle at `rear_m`; the camera is fixed to the body at the calibrated height."""
        rear, front = (float(self.up_m(rear_m + a)) for a in (0.0, WHEELBASE_M))
        rise = math.atan2(front - rear, WHEELBASE_M)
        height_m = self.camera.height_m
        up = rear + CAMERA_AHEAD_M * math.tan(rise) + height_m * math.cos(rise)
        return Stand(rear_m + CAMERA_AHEAD_M - height_m * math.sin(rise), up, self.camera.pitch_rad - rise)

    def pixel_row(self, stand: Stand, ahead_m: float) -> float:
        """The image row of the road `ahead_m` in front of the camera."""
        down = stand.up_m - float(self.up_m(stand.way_m + ahead_m))
        c, s = math.cos(stand.pitch_rad), math.sin(stand.pitch_rad)
        return self.camera.cy_px + self.camera.fy_px * (down * c - ahead_m * s) / (ahead_m * c + down * s)

    def render(self, stand: Stand, rng: np.random.Generator) -> NDArray[np.uint8]:
        """(H, W) grey."""
        c, s = math.cos(stand.pitch_rad), math.sin(stand.pitch_rad)
        down, along = self._y * c + s, c - self._y * s  # of a ray of z = 1, by rows, in the world
        ahead = np.geomspace(1.0, LOOK_M, SAMPLES)
        below = stand.up_m - self.up_m(stand.way_m + ahead)  # of the road under the camera's height
        gap = (down / along)[:, None] * ahead - below  # of a row's ray under the road
        first = (gap > 0.0).argmax(axis=1)
        hits = (gap[:, -1] > 0.0) | (first > 0)
        k = np.maximum(first, 1)
        rows = np.arange(len(k))
        share = gap[rows, k - 1] / np.minimum(gap[rows, k - 1] - gap[rows, k], -1e-12)
        road_m = np.where(hits, ahead[k - 1] + share * (ahead[k] - ahead[k - 1]), np.inf)
        depth_road = (road_m / along)[:, None]
        depth_front = np.where(self._x > 0.0, RIGHT_M, -LEFT_M) / np.maximum(np.abs(self._x), 1e-6)
        ahead_front = np.minimum(depth_front * along[:, None], 2 * LOOK_M)
        up_front = stand.up_m - depth_front * down[:, None] - self.up_m(stand.way_m + ahead_front)
        on_front = (depth_front < depth_road) & (up_front < FRONT_M) & (ahead_front < 120.0)
        on_road = ~on_front & np.isfinite(depth_road) & (depth_road < depth_front)
        image = np.full(self._x.shape, 205.0, np.float32)
        depth = np.where(on_road, depth_road, np.where(on_front, depth_front, 1.0))
        footprint = depth / self.camera.fx_px
        way = stand.way_m + depth * along[:, None]
        across = depth * self._x
        image = np.where(on_road, 0.5 * _sample(self._road, across, way, 4.0 * footprint) + 40.0, image)
        image = np.where(on_road & _painted(across, way), 190.0, image)
        image = np.where(on_front, _sample(self._front, way, up_front, 2.0 * footprint), image)
        image = cv2.GaussianBlur(image.astype(np.float32), (3, 3), 0.6) + rng.normal(0.0, 1.5, image.shape)
        return np.clip(image, 0.0, 255.0).astype(np.uint8)


def _painted(across: Floats, way: Floats) -> Bools:
    edge = np.abs(np.abs(across) - 3.4) < 0.07
    dash = (np.abs(across + 1.7) < 0.06) & (way % 9.0 < 3.0)
    out: Bools = edge | dash
    return out


def _texture(seed: int) -> list[Floats32]:
    """Blotches and tiles of all sizes, and its pyramid."""
    rng = np.random.default_rng(seed)
    image = np.zeros((SIDE, SIDE), np.float32)
    for octave in (2, 4, 8, 16, 32, 64):
        for how in (cv2.INTER_LINEAR, cv2.INTER_NEAREST):
            coarse = rng.normal(size=(SIDE // octave, SIDE // octave)).astype(np.float32)
            image += cv2.resize(coarse, (SIDE, SIDE), interpolation=how)
    levels = [(120.0 + 25.0 * image / image.std()).astype(np.float32)]
    for _ in range(LEVELS - 1):
        levels.append(cv2.pyrDown(levels[-1]).astype(np.float32))
    return levels


def _sample(levels: list[Floats32], a_m: Floats, b_m: Floats, footprint_m: Floats) -> Floats32:
    """The texture at (a, b), mirrored at its edges, between the two levels that suit the pixel's footprint."""
    level = np.clip(np.log2(np.maximum(footprint_m / TEXEL_M, 1.0)), 0.0, LEVELS - 1.01)
    out = np.zeros(a_m.shape, np.float32)
    for k, image in enumerate(levels):
        share = np.maximum(1.0 - np.abs(level - k), 0.0).astype(np.float32)
        side, texel = image.shape[0] - 1, TEXEL_M * 2**k
        u, v = ((side - np.abs(x / texel % (2 * side) - side)).astype(np.float32) for x in (a_m, b_m))
        out += share * cv2.remap(image, u, v, cv2.INTER_LINEAR)
    return out
