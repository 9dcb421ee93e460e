"""Data for measuring a length on the road by two clicks on a picture of the report."""

from __future__ import annotations

import tomllib

import msgspec
import numpy as np

from birdslam.geometry.camera import Camera, plane_normal
from birdslam.outputs.drive_video import SideBySide

_BOUNCE_RAD = 0.008  # 1-sigma of the body's pitch in one image (height_check.py)
_CLICK_PX = 1.5  # 1-sigma of a click in a picture


def ruler(camera_toml: str, video_px: tuple[int, int], picture_px: int) -> dict[str, object] | None:
    """Returns the camera for `measure` in page.js; None if the video does not show its images.

    `video_px` is the size of the video, `picture_px` the width of the pictures in the page. Coordinates of a click are
    fractions of the picture; `scale_px` converts them to pixels of the camera.
    """
    try:
        camera = msgspec.convert(tomllib.loads(camera_toml), Camera)
    except (tomllib.TOMLDecodeError, msgspec.ValidationError):
        return None
    drawn = SideBySide(camera)
    if drawn.size_px != video_px:
        return None
    sigma_rad = float(np.hypot(camera.tilt_sigma_rad, _BOUNCE_RAD))
    normal, by_pitch, _ = plane_normal(camera.pitch_rad, camera.roll_rad)
    return {
        "scale_px": [side / drawn.scale for side in video_px],
        "size_px": [camera.width_px, camera.height_px],
        "focal_px": [camera.fx_px, camera.fy_px],
        "centre_px": [camera.cx_px + 0.5, camera.cy_px + 0.5],  # from the corner of the image, as clicks are
        "height_m": camera.height_m,
        "normal": normal.tolist(),
        "normal_sigma": (by_pitch * sigma_rad).tolist(),
        "click": _CLICK_PX / picture_px,
    }
