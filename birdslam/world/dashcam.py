"""Dashboard cameras in the built-in world: a description of one, and the film that it takes of a drive.

What a film has and a rendered image has not: a wide lens with distortion, rows that are read one after the other while
the car goes on (rolling shutter), blur by the exposure, an exposure that lags behind the light, what is before the
lens (`windscreen.py`), a caption, and an encoder. Each is a field of `Dashcam`; the truth comes with each image.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import cached_property
from pathlib import Path
from typing import Any

import cv2
import msgspec
import numpy as np

from birdslam.geometry.arrays import Floats, Floats32, Image
from birdslam.geometry.camera import Camera
from birdslam.geometry.pose import rotation_exp, rotation_log
from birdslam.types import NS_PER_S
from birdslam.world.rendering.photometrics import develop, metered
from birdslam.world.rendering.renderer import Renderer
from birdslam.world.scenario import Moment, Scenario, moments
from birdslam.world.windscreen import Edit, bonnet, caption, from_share, wiper

_WIDEST_VIEW_RAD = math.radians(80.0)  # of one rendered view, across: a wider lens is put together of several
_MARGIN_RAD = math.radians(4.0)  # of a view beyond its sector: rows see farther while the car turns
_SKY_M = 1e4
SAMPLES = 2  # rays of a pixel, each way
_BLUR_STEPS = 4  # views within an exposure


@dataclass(frozen=True)
class Dashcam:
    """A camera behind a windscreen, and what its film is like; by default a good one in the way of nothing."""

    width_px: int = 640
    height_px: int = 360
    fov_deg: float = 75.0  # across the film, as its distorted edges show it
    k1: float = 0.0  # of the radial distortion; `fisheye` has none, it is equidistant
    fisheye: bool = False
    height_m: float = 1.35
    pitch_rad: float = 0.0
    roll_rad: float = 0.0
    readout_s: float = 0.0  # from the first row to the last
    tremble_rad: float = 0.0  # how far a loose mount swings up and down, and half as far about the axis of view
    tremble_hz: float = 0.0
    exposure_s: float = 0.0  # of each row
    adapts_s: float = 0.0  # time constant of the exposure
    light: float = 1.0  # of a day's: with less of it the picture is grainier
    glass: tuple[Edit, ...] = ()  # what is before the lens, from the farthest to the nearest, and captions

    @cached_property
    def camera(self) -> Camera:
        """As a camera file would state it."""
        half = math.radians(0.5 * self.fov_deg)
        edge = half if self.fisheye else math.tan(half) * (1.0 + self.k1 * math.tan(half) ** 2)
        focal_px = 0.5 * self.width_px / edge
        distortion = (0.0,) * 4 if self.fisheye else (self.k1, 0.0, 0.0, 0.0)
        return Camera(
            self.width_px,
            self.height_px,
            focal_px,
            focal_px,
            0.5 * (self.width_px - 1.0),
            0.5 * (self.height_px - 1.0),
            height_m=self.height_m,
            pitch_rad=self.pitch_rad,
            roll_rad=self.roll_rad,
            distortion=distortion if self.fisheye or self.k1 else (),
            fisheye=self.fisheye,
            readout_s=self.readout_s,
        )

    def trembled(self, t_s: float) -> tuple[float, float]:
        """By how much pitch and roll differ then from those of a firm mount, rad."""
        phase = 2.0 * math.pi * self.tremble_hz * t_s
        return self.tremble_rad * math.sin(phase), 0.5 * self.tremble_rad * math.sin(phase + 1.0)


DASHCAMS: dict[str, Dashcam] = {
    "narrow": Dashcam(fov_deg=60.0, k1=-0.3, glass=(caption,)),
    "phone": Dashcam(fov_deg=65.0, readout_s=0.03, exposure_s=0.004),
    "wide": Dashcam(fov_deg=100.0, k1=-0.08, readout_s=0.015, glass=(lambda index, count, image: bonnet(image),)),
    "fisheye": Dashcam(fov_deg=140.0, fisheye=True, readout_s=0.02, glass=(caption,)),
    "dusk": Dashcam(fov_deg=75.0, k1=-0.15, exposure_s=0.02, adapts_s=0.5, light=0.03),
    "rain": Dashcam(fov_deg=75.0, k1=-0.15, glass=(from_share("drops_defocused", 3, 0.0), wiper(8))),
}


@dataclass(frozen=True)
class FilmFrame:
    """An image as the camera delivers it, and where it was taken from when its middle row was read."""

    image: Image  # (H, W, 3) BGR, distorted
    t_source_ns: int
    T_world_cam: Floats  # (4, 4)
    camera: Camera  # with this frame's own height, pitch and roll over the road


def film(scenario: Scenario, dashcam: Dashcam, count: int, rate_hz: float) -> Iterator[FilmFrame]:
    """`count` images of a drive, at `rate_hz`. Raises ValueError at night, whose light is of a lens without distortion.

    Other cars stand still while an image is read, the camera moves.
    """
    if scenario.night is not None:
        raise ValueError("a night is lit through a lens without distortion alone")
    renderer, optics = Renderer(scenario.street, scenario.sky, SAMPLES), _Optics(dashcam)
    exposure = _Exposure(dashcam.adapts_s, rate_hz)
    before: Floats | None = None
    now: Moment | None = None
    # The motion while an image is read is that between its neighbours, so each waits for the next
    for after in moments(scenario, count + 1, rate_hz):
        T_after = _pose(after, dashcam.camera)
        if now is not None:
            T_now = _pose(now, dashcam.camera)
            T_before, steps = (T_now, 1.0) if before is None else (before, 2.0)
            motion = _twist(np.linalg.inv(T_before) @ T_after) * (rate_hz / steps)
            before = T_now
            now = _loose(now, dashcam)
            T_now = _pose(now, dashcam.camera)
            light = optics.light(renderer, now, motion)
            grain = dashcam.light**-0.5
            lens = replace(
                scenario.lens,
                fixed=scenario.lens.fixed or exposure.metered(light, scenario.lens.whole),
                noise=scenario.lens.noise * grain,
                shot=scenario.lens.shot * grain,
            )
            image = develop(light, lens, np.random.default_rng([scenario.shake_seed, now.frame_id]))
            for edit in dashcam.glass:
                image = edit(now.frame_id, count, image)
            yield FilmFrame(image, round(now.t_s * NS_PER_S), T_now, now.shaken(dashcam.camera))
        now = after


def write_film(path: Path, images: Iterator[Image], rate_hz: float, crf: int = 23, **options: str) -> int:
    """An H.264 film of images of one size; gives how many. Needs PyAV (extra `dev`)."""
    import av  # only here: nothing else of the world needs an encoder

    count = 0
    with av.open(str(path), "w") as out:
        stream: Any = None
        for image in images:
            if stream is None:
                rate = Fraction(rate_hz).limit_denominator(1001)
                stream = out.add_stream("libx264", rate=rate, options={"crf": str(crf), "preset": "veryfast"} | options)
                stream.height, stream.width = image.shape[:2]
                stream.pix_fmt = "yuv420p"
            out.mux(stream.encode(av.VideoFrame.from_ndarray(image, "bgr24")))
            count += 1
        if stream is not None:
            out.mux(stream.encode(None))
    return count


def _pose(moment: Moment, camera: Camera) -> Floats:
    shaken = moment.shaken(camera)
    T_ego_cam = np.eye(4)
    T_ego_cam[:3, :3], T_ego_cam[:3, 3] = shaken.ground.R_ego_cam, (0.0, 0.0, shaken.height_m)
    out: Floats = moment.T_world_ego @ T_ego_cam
    return out


def _loose(moment: Moment, dashcam: Dashcam) -> Moment:
    """With the camera's own trembling in its mount beside how the body is shaken."""
    (pitch, roll, heave), (up, about) = moment.shake, dashcam.trembled(moment.t_s)
    return replace(moment, shake=(pitch + up, roll + about, heave))


def _twist(T: Floats) -> Floats:
    """(6,) turn and shift of a motion, in the axes of its first camera."""
    return np.concatenate([rotation_log(T[:3, :3]), T[:3, 3]])


class _Exposure:
    """The light that becomes middle grey: metered, and followed with a lag as cameras do."""

    def __init__(self, adapts_s: float, rate_hz: float) -> None:
        self._share = 1.0 - math.exp(-1.0 / (adapts_s * rate_hz)) if adapts_s > 0.0 else 1.0
        self._log: float | None = None

    def metered(self, light: Floats32, whole: float) -> float:
        log = math.log(max(metered(light, whole), 1e-3))
        self._log = log if self._log is None else self._log + self._share * (log - self._log)
        return math.exp(self._log)


class _Optics:
    """What falls on each pixel of a dashcam: rendered views, seen through its lens row by row."""

    def __init__(self, dashcam: Dashcam) -> None:
        self._dashcam, camera = dashcam, dashcam.camera
        v, u = np.mgrid[: camera.height_px, : camera.width_px].astype(np.float64)
        self._rays = _rays(camera, np.stack([u, v], axis=-1))
        row = (np.arange(camera.height_px) + 0.5) / camera.height_px - 0.5
        self._row_s = np.repeat(row * dashcam.readout_s, camera.width_px).reshape(u.shape)
        count = max(1, math.ceil(math.radians(dashcam.fov_deg) / _WIDEST_VIEW_RAD))
        yaws = (np.arange(count) - 0.5 * (count - 1)) * math.radians(dashcam.fov_deg) / count
        self._views = [_view(camera, self._rays, yaw, math.radians(dashcam.fov_deg) / count) for yaw in yaws]

    def light(self, renderer: Renderer, moment: Moment, motion: Floats) -> Floats32:
        """(H, W, 3) linear BGR; `motion` (6,) is the camera's turn and shift a second, in its own axes."""
        rendered = []
        shaken = moment.shaken(self._dashcam.camera)
        R_cam_ego = shaken.ground.R_ego_cam.T
        for view in self._views:
            T = moment.T_world_ego.copy()
            T[:3, :3] = T[:3, :3] @ view.R_ego_view
            seen = renderer.render(moment.scene, view.camera(shaken), T, moment.s_m)
            R_view_cam = shaken.ground.R_ego_cam.T @ view.R_ego_view.T @ R_cam_ego.T
            rendered.append((view, R_view_cam, seen.light, np.where(np.isinf(seen.depth_m), _SKY_M, seen.depth_m)))
        steps = _BLUR_STEPS if self._dashcam.exposure_s > 0.0 else 1
        blurred = [
            self._seen(rendered, motion, moment.t_s, ((k + 0.5) / steps - 0.5) * self._dashcam.exposure_s)
            for k in range(steps)
        ]
        out: Floats32 = np.mean(blurred, axis=0, dtype=np.float32)
        return out

    def _seen(self, rendered: list[Any], motion: Floats, t_s: float, late_s: float) -> Floats32:
        """Each row at its own time: its rays are turned and moved to where the views were rendered from."""
        at_s = self._row_s + late_s
        moves = bool(self._dashcam.readout_s or late_s)
        turned = _turned(self._rays, self._turns(motion[:3], t_s, at_s[:, 0])) if moves else self._rays
        shift = at_s[..., None] * motion[3:]
        rays = turned
        for _ in range(3 if moves else 0):  # how far a ray's point is decides where it is seen from elsewhere
            range_m = _looked_up(rendered, rays, depth=True)
            point = rays / np.linalg.norm(rays, axis=-1, keepdims=True) * range_m[..., None]
            rays = turned * np.linalg.norm(point - shift, axis=-1, keepdims=True) + shift
        return _looked_up(rendered, rays, depth=False)

    def _turns(self, turn: Floats, t_s: float, at_s: Floats) -> Floats:
        """(H, 3) how far the camera has turned at the time of each row (H,) about `t_s`, at `turn` (3,) a second."""
        out = np.outer(at_s, turn)
        if self._dashcam.tremble_rad:
            now, then = self._dashcam.trembled(t_s), np.array([self._dashcam.trembled(t_s + t) for t in at_s])
            out[:, 0] -= then[:, 0] - now[0]  # pitch is > 0 with the nose down: a turn about x to the right is < 0 then
            out[:, 2] += then[:, 1] - now[1]
        return out


@dataclass(frozen=True)
class _ViewOfSector:
    """A pinhole view of the rays within a sector: turned by `R_ego_view` about the ego's vertical axis."""

    R_ego_view: Floats
    size_px: tuple[int, int]
    focal_px: float
    centre_px: tuple[float, float]

    def camera(self, shaken: Camera) -> Camera:
        """A pinhole where the shaken camera is."""
        names = ("width_px", "height_px", "fx_px", "fy_px", "cx_px", "cy_px")
        lens = dict(zip(names, (*self.size_px, self.focal_px, self.focal_px, *self.centre_px), strict=True))
        return msgspec.structs.replace(shaken, **lens, distortion=(), fisheye=False)


def _view(camera: Camera, rays: Floats, yaw_rad: float, wide_rad: float) -> _ViewOfSector:
    """With pixels as small as the camera's own in its middle."""
    c, s = math.cos(-yaw_rad), math.sin(-yaw_rad)  # to the right is minus about the vertical
    R_ego_view = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    R_ego_cam = camera.ground.R_ego_cam
    seen = rays.reshape(-1, 3) @ (R_ego_cam.T @ R_ego_view.T @ R_ego_cam).T
    inside = (np.abs(np.arctan2(seen[:, 0], seen[:, 2])) < 0.5 * wide_rad + _MARGIN_RAD) & (seen[:, 2] > 0.1)
    xy = seen[inside, :2] / seen[inside, 2:]
    low, high = xy.min(axis=0) - _MARGIN_RAD, xy.max(axis=0) + _MARGIN_RAD
    focal_px = camera.fx_px
    width_px, height_px = (math.ceil(side) for side in focal_px * (high - low))
    cx, cy = (-focal_px * low).tolist()
    return _ViewOfSector(R_ego_view, (width_px, height_px), focal_px, (cx, cy))


def _rays(camera: Camera, px: Floats) -> Floats:
    """(..., 3) unit rays of raw pixels, by Newton's method on the radial distortion."""
    d = (px - [camera.cx_px, camera.cy_px]) / [camera.fx_px, camera.fy_px]
    r_d = np.linalg.norm(d, axis=-1)
    if camera.fisheye:
        theta = r_d
    else:
        k1, r = camera.distortion[0] if camera.distortion else 0.0, r_d.copy()
        for _ in range(20):
            r -= (r * (1.0 + k1 * r**2) - r_d) / np.maximum(1.0 + 3.0 * k1 * r**2, 0.05)
        theta = np.arctan(r)
    by = np.sin(theta) / np.maximum(r_d, 1e-12)
    return np.concatenate([d * by[..., None], np.cos(theta)[..., None]], axis=-1)


def _turned(rays: Floats, turns: Floats) -> Floats:
    """Rays at their own times in the axes of time 0, by the turn (H, 3) of each row."""
    return np.stack([row @ rotation_exp(turn).T for row, turn in zip(rays, turns, strict=True)])


def _looked_up(rendered: list[Any], rays: Floats, depth: bool) -> Any:
    """Light (H, W, 3) or range in m (H, W) along rays (H, W, 3), each of the view in whose middle it lies most."""
    out, best = None, None
    for view, R_view_cam, light, depth_m in rendered:
        seen = rays @ R_view_cam.T
        z = np.maximum(seen[..., 2], 1e-6)
        u, v = ((view.focal_px * seen[..., k] / z + view.centre_px[k]).astype(np.float32) for k in (0, 1))
        if depth:
            near = cv2.remap(depth_m.astype(np.float32), u, v, cv2.INTER_NEAREST, borderMode=cv2.BORDER_REPLICATE)
            found = near * np.linalg.norm(seen, axis=-1) / z
        else:
            found = cv2.remap(light, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        forward = seen[..., 2] / np.linalg.norm(seen, axis=-1)
        if out is None or best is None:
            out, best = found, forward
        else:
            nearer = forward > best
            out = np.where(nearer if depth else nearer[..., None], found, out)
            best = np.maximum(best, forward)
    return out
