"""A night without street lamps: two low beams light the road, other lamps are bright spots; numpy and OpenCV.

The scene is first rendered in even light (`even_sky`), which gives the albedo of each pixel, then lit again with its
depth. Luminance is in cd/m^2. Retroreflection is 0.15 cd/(m^2 lx) for paint with glass beads and a tenth of that for
asphalt (EN 1436, Table 3).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from birdslam.geometry.arrays import Floats, Floats32
from birdslam.geometry.camera import Camera
from birdslam.world.rendering import materials as m
from birdslam.world.rendering.light import SKY_SLOTS
from birdslam.world.rendering.scene import Bodies, Rendered
from birdslam.world.truth import CLASSES

LEVEL_CLASSES = tuple(CLASSES.index(name) for name in ("road", "lane", "pavement"))
PAINTED_CLASSES = tuple(CLASSES.index(name) for name in ("road", "lane"))
POSTS = CLASSES.index("pole_sign")
ASPHALT_RETRO, PAINT_RETRO, FOIL_RETRO = 0.015, 0.15, 3.0  # cd/(m^2 lx)
ASPHALT_ALBEDO = 0.1
TAIL_CD, FACING_CD = 6.0, 250.0  # a tail lamp, and the glare of an oncoming low beam above its cut-off
BLUR_STEPS = 5  # samples of the motion blur
_EVEN = 1.0  # light of the even sky


@dataclass(frozen=True)
class Night:
    """The ego's lamps, and the camera's exposure time."""

    ambient_lx: float = 0.02  # moon and distant town
    beam_cd: float = 12_000.0  # maximum of one lamp
    lamps_m: tuple[tuple[float, float, float], ...] = ((1.6, 0.6, 0.65), (1.6, -0.6, 0.65))  # in ego
    dip: float = 0.012  # slope of the cut-off, downwards
    exposure_s: float = 0.02


def even_sky(grit: float = 0.0) -> Floats:
    """Uniform light without sun and haze, which renders the albedo.

    `grit` is the contrast of the asphalt's stones.
    """
    sky = np.zeros(SKY_SLOTS)
    sky[6:12] = _EVEN
    sky[15], sky[18], sky[21], sky[22], sky[23] = 1e9, 0.2, 1.0, 0.5, 0.5
    sky[24], sky[25] = grit, 0.5
    return sky


def lit(
    night: Night, rendered: Rendered, scene: Bodies, camera: Camera, T_world_ego: Floats, speed_mps: float,
    yaw_rate_radps: float,
) -> Floats32:  # fmt: skip
    """Linear BGR luminance (H, W, 3) of a scene that was rendered under `even_sky`, with motion blur."""
    height, width = rendered.depth_m.shape
    v, u = np.mgrid[0:height, 0:width].astype(np.float64)
    rays = np.stack(
        [(u - camera.cx_px) / camera.fx_px, (v - camera.cy_px) / camera.fy_px, np.ones_like(u)], axis=-1
    ) @ np.asarray(camera.ground.R_ego_cam).T  # fmt: skip
    sky = np.isinf(rendered.depth_m)
    depth = np.where(sky, 1e4, rendered.depth_m).astype(np.float64)
    points = np.array([0.0, 0.0, camera.height_m]) + depth[..., None] * rays  # in ego
    albedo = rendered.light / np.float32(_EVEN)
    albedo[sky] = 0.0
    back = _retroreflection(albedo, rendered.classes)
    moves = np.where((rendered.instances > 0) | sky, 0.0, 1.0)
    albedo, back = _blurred(albedo, back, points, moves, camera, speed_mps, yaw_rate_radps, night.exposure_s)
    level = np.isin(rendered.classes, LEVEL_CLASSES)
    out = albedo * np.float32(night.ambient_lx / math.pi)
    for lamp_m in night.lamps_m:
        lux, sine = _beam(night, points - np.array(lamp_m))
        slant = np.where(level, sine, 0.6)  # vertical surfaces face the lamp approximately
        out += (lux * slant / math.pi).astype(np.float32)[..., None] * albedo
        out += lux.astype(np.float32)[..., None] * back
    out += np.float32(0.3 * night.ambient_lx / math.pi) * sky[..., None]
    _draw_lamps(out, rendered, scene, camera, T_world_ego)
    return out


def _retroreflection(albedo: Floats32, classes: NDArray[np.uint8]) -> Floats32:
    """Retroreflection (H, W, 3) in cd/(m^2 lx)."""
    bright = albedo.mean(axis=2)
    paint = np.clip((bright - 0.2) / 0.3, 0.0, 1.0) * np.isin(classes, PAINTED_CLASSES)
    foil = np.clip((bright - 0.35) / 0.2, 0.0, 1.0) * (classes == POSTS)
    share = (1.0 - paint) * ASPHALT_RETRO / ASPHALT_ALBEDO + paint * PAINT_RETRO + foil * FOIL_RETRO
    out: Floats32 = (share[..., None] * albedo).astype(np.float32)
    return out


def _beam(night: Night, away: Floats) -> tuple[Floats, Floats]:
    """The beam of one lamp at points (..., 3) from it in ego: lux across the beam, and sine of the angle to the road.

    Brightest below a dipped cut-off, which rises by 15 degrees to the right, towards the verge.
    """
    x = np.maximum(away[..., 0], 0.05)
    square = np.maximum((away**2).sum(axis=-1), 0.25)
    bearing, rise = away[..., 1] / x, away[..., 2] / x
    cut_off = -night.dip + math.tan(math.radians(15.0)) * np.clip(-bearing, 0.0, 0.08)
    below = 1.0 / (1.0 + np.exp(np.clip((rise - cut_off) / 0.004, -40.0, 40.0)))
    down = np.maximum(cut_off - rise, 0.0)
    wide = 0.75 * np.exp(-((bearing / 0.22) ** 2)) + 0.25 * np.exp(-((bearing / 0.6) ** 2))
    # Less light on the near road, for even illumination
    strength = night.beam_cd * wide * (0.92 * np.exp(-down / 0.05) + 0.08 * np.exp(-down / 0.4))
    ahead = away[..., 0] > 0.0
    return ahead * strength * (below + 0.008) / square, np.maximum(-away[..., 2], 0.0) / np.sqrt(square)


def _blurred(
    albedo: Floats32, back: Floats32, points: Floats, moves: Floats, camera: Camera, speed_mps: float,
    yaw_rate_radps: float, exposure_s: float,
) -> tuple[Floats32, Floats32]:  # fmt: skip
    """Albedo and retroreflection with motion blur; the beams move with the ego."""
    if exposure_s <= 0.0:
        return albedo, back
    R_cam_ego = np.asarray(camera.ground.R_ego_cam).T
    v, u = np.mgrid[0 : albedo.shape[0], 0 : albedo.shape[1]].astype(np.float64)
    sums = [np.zeros_like(albedo), np.zeros_like(back)]
    for t_s in (np.arange(BLUR_STEPS) / (BLUR_STEPS - 1) - 0.5) * exposure_s:
        c, s = math.cos(yaw_rate_radps * t_s), math.sin(yaw_rate_radps * t_s)
        x = c * points[..., 0] - s * points[..., 1] + speed_mps * t_s
        y = s * points[..., 0] + c * points[..., 1]
        seen = np.stack([x, y, points[..., 2] - camera.height_m], axis=-1) @ R_cam_ego.T
        z = np.maximum(seen[..., 2], 0.1)
        at_u = camera.fx_px * seen[..., 0] / z + camera.cx_px
        at_v = camera.fy_px * seen[..., 1] / z + camera.cy_px
        map_u, map_v = ((p + moves * (q - p)).astype(np.float32) for p, q in ((u, at_u), (v, at_v)))
        for total, surface in zip(sums, (albedo, back), strict=True):
            total += cv2.remap(surface, map_u, map_v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return sums[0] / np.float32(BLUR_STEPS), sums[1] / np.float32(BLUR_STEPS)


def _draw_lamps(out: Floats32, rendered: Rendered, scene: Bodies, camera: Camera, T_world_ego: Floats) -> None:
    """Adds visible tail lamps, and headlamps of oncoming vehicles."""
    height, width = rendered.depth_m.shape
    R_cam_ego = np.asarray(camera.ground.R_ego_cam).T
    for row in np.flatnonzero((scene.object_id >= 0) & np.isin(scene.kind, (m.VEHICLE, m.TRUCK))):
        yaw, P = float(scene.yaw_rad[row]), scene.parameters[row]
        axes = np.array([[math.cos(yaw), math.sin(yaw), 0.0], [-math.sin(yaw), math.cos(yaw), 0.0], [0.0, 0.0, 1.0]])
        for end, high_m, candela, colour in (
            (-1.0, 0.9, TAIL_CD, (0.05, 0.05, 1.0)),
            (1.0, 0.65, FACING_CD, (0.9, 1.0, 1.0)),
        ):
            for side in (-1.0, 1.0):
                lamp = np.array([0.5 * end * P[m.LENGTH], 0.38 * side * P[m.WIDTH], high_m])
                at = T_world_ego[:3, :3].T @ (scene.position_m[row] + lamp @ axes - T_world_ego[:3, 3])
                at = at - np.array([0.0, 0.0, camera.height_m])
                towards = -float(at @ (T_world_ego[:3, :3].T @ (end * axes[0]))) / float(np.linalg.norm(at))
                q = R_cam_ego @ at
                if q[2] < 2.0 or towards < 0.2:
                    continue
                u = camera.fx_px * q[0] / q[2] + camera.cx_px
                v = camera.fy_px * q[1] / q[2] + camera.cy_px
                if not (1.0 <= u < width - 1.0 and 1.0 <= v < height - 1.0):
                    continue
                if rendered.depth_m[round(v), round(u)] < q[2] - 1.0:
                    continue
                total = candela * towards * (camera.fx_px / q[2]) ** 2  # of all its pixels
                _spot(out, u, v, max(0.7, 0.06 * camera.fx_px / q[2]), total, colour)


def _spot(out: Floats32, u: float, v: float, sigma_px: float, total: float, colour: tuple[float, ...]) -> None:
    height, width = out.shape[:2]
    reach = math.ceil(4.0 * sigma_px)
    y = np.arange(max(round(v) - reach, 0), min(round(v) + reach + 1, height))[:, None]
    x = np.arange(max(round(u) - reach, 0), min(round(u) + reach + 1, width))[None]
    bell = np.exp(-0.5 * ((x - u) ** 2 + (y - v) ** 2) / sigma_px**2) * total / (2.0 * math.pi * sigma_px**2)
    out[y, x] += (bell[..., None] * np.array(colour)).astype(np.float32)
