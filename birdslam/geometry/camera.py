"""The camera: intrinsics, lens distortion, and the ground plane under it."""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Annotated

import cv2
import msgspec
import numpy as np
from numpy.typing import NDArray

from birdslam.geometry.arrays import Floats

# Camera axes (x right, y down, z forward) to REP-103 axes (x forward, y left, z up).
AXES_EGO_CAM = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])

# Distance at which the ground plane under the camera intersects the road: the middle of the strip that odometry aligns.
# A road of vertical curvature v is v x (x - PLANE_AT_M) / 2 above that plane, which decorrelates pitch and curvature
PLANE_AT_M = 11.0

Positive = Annotated[float, msgspec.Meta(gt=0.0)]


class VerticalCurvature(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Vertical curvature of the road ahead and its 1-sigma, 1/m; > 0: the road rises over the ground plane."""

    per_m: float
    sigma_per_m: Positive


class GroundPlane(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Pose of the camera over the road: height, pitch (> 0: nose down) and roll (> 0: right side down)."""

    height_m: Positive
    pitch_rad: float = 0.0
    roll_rad: float = 0.0

    @property
    def R_ego_cam(self) -> Floats:
        """(3, 3) rotation from camera axes to ego axes; read-only."""
        return _rotation(self.pitch_rad, self.roll_rad)

    @property
    def normal_cam(self) -> Floats:
        """(3,) upward unit normal of the road in camera axes; [0, -1, 0] on level ground as in Eq. 1."""
        return self.R_ego_cam[2]


@lru_cache(maxsize=64)  # each frame uses the same few rotations many times
def _rotation(pitch_rad: float, roll_rad: float) -> Floats:
    cp, sp = math.cos(pitch_rad), math.sin(pitch_rad)
    cr, sr = math.cos(roll_rad), math.sin(roll_rad)
    Ry = np.array([[cp, 0.0, sp], [0.0, 1.0, 0.0], [-sp, 0.0, cp]])
    Rx = np.array([[1.0, 0.0, 0.0], [0.0, cr, -sr], [0.0, sr, cr]])
    out: Floats = Ry @ Rx @ AXES_EGO_CAM
    out.flags.writeable = False
    return out


def plane_normal(pitch_rad: float, roll_rad: float) -> tuple[Floats, Floats, Floats]:
    """Upward unit normal of the road in camera axes, and its derivatives by pitch and by roll, (3,) each."""
    cp, sp, cr, sr = np.cos(pitch_rad), np.sin(pitch_rad), np.cos(roll_rad), np.sin(roll_rad)
    return (
        np.array([-cp * sr, -cp * cr, -sp]),
        np.array([sp * sr, sp * cr, -cp]),
        np.array([-cp * cr, cp * sr, 0.0]),
    )


def plane_tilt(normal: Floats) -> tuple[float, float]:
    """(pitch_rad, roll_rad) of a unit normal in camera axes: the inverse of `plane_normal`."""
    return float(-np.arcsin(np.clip(normal[2], -1.0, 1.0))), float(np.arctan2(-normal[0], -normal[1]))


class Camera(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A pinhole camera over a road, as a camera file (TOML) states it.

    `distortion` holds 4, 5, 8, 12 or 14 coefficients of OpenCV (k1, k2, p1, p2, k3, ...), empty for undistorted
    images. A `fisheye` lens has those of the equidistant model (k1, k2, k3, k4; Kannala and Brandt 2006).
    Raises ValueError (on decoding: msgspec.ValidationError) for values outside the range of cameras.
    """

    width_px: Annotated[int, msgspec.Meta(ge=16, le=16384)]  # of the image
    height_px: Annotated[int, msgspec.Meta(ge=16, le=16384)]  # of the image
    fx_px: Positive  # focal length
    fy_px: Positive  # focal length
    cx_px: float  # principal point
    cy_px: float  # principal point
    height_m: Positive  # over the road: the metric scale
    pitch_rad: float = 0.0  # against the road; > 0: nose down
    roll_rad: float = 0.0  # > 0: right side down
    # 4, 5, 8, 12 or 14 coefficients of OpenCV: k1, k2, p1, p2, k3, ...; empty: undistorted images
    distortion: tuple[float, ...] = ()
    tilt_sigma_rad: Positive = 0.015  # 1-sigma of pitch and roll; the default is for a bracket mounted by hand
    fisheye: bool = False  # `distortion` is k1, k2, k3, k4 of the equidistant model
    readout_s: Annotated[float, msgspec.Meta(ge=0.0, le=0.1)] = 0.0  # from the first row to the last; 0: global shutter
    # 1-sigma of the scale as a fraction if height or focal length are estimated; 0: they were measured
    scale_sigma_rel: Annotated[float, msgspec.Meta(ge=0.0, le=1.0)] = 0.0
    distortion_sigma: Annotated[float, msgspec.Meta(ge=0.0, le=1.0)] = 0.0  # 1-sigma of k1; 0: it was measured

    def __post_init__(self) -> None:
        lens = (self.fx_px, self.fy_px, self.cx_px, self.cy_px, *self.distortion)
        if not all(
            math.isfinite(n)
            for n in (*lens, self.height_m, self.pitch_rad, self.roll_rad, self.tilt_sigma_rad, self.scale_sigma_rel)
        ):
            raise ValueError("camera: every number must be finite")
        if not (0.0 < self.cx_px < self.width_px and 0.0 < self.cy_px < self.height_px):
            raise ValueError(
                f"camera: the principal point ({self.cx_px}, {self.cy_px}) lies outside the "
                f"{self.width_px}x{self.height_px} image"
            )
        if not 0.2 < self.fx_px / self.width_px < 10.0 or not 0.5 < self.fx_px / self.fy_px < 2.0:
            raise ValueError(
                f"camera: focal lengths {self.fx_px}, {self.fy_px} px do not fit a {self.width_px} px image"
            )
        if not 0.2 <= self.height_m <= 5.0:
            raise ValueError(f"camera: height_m = {self.height_m} is outside 0.2 to 5 m; measure it over the road")
        if abs(self.pitch_rad) > 0.5 or abs(self.roll_rad) > 0.5:
            raise ValueError("camera: pitch_rad and roll_rad must lie within 0.5 rad")
        if len(self.distortion) not in (0, 4, 5, 8, 12, 14):
            raise ValueError(f"camera: distortion needs 0, 4, 5, 8, 12 or 14 coefficients, got {len(self.distortion)}")
        if self.fisheye and len(self.distortion) != 4:
            raise ValueError(f"camera: a fisheye needs 4 distortion coefficients, got {len(self.distortion)}")

    @property
    def K(self) -> Floats:
        """(3, 3) intrinsic matrix in pixels."""
        return np.array([[self.fx_px, 0.0, self.cx_px], [0.0, self.fy_px, self.cy_px], [0.0, 0.0, 1.0]])

    def to_xy(self, px: Floats) -> Floats:
        """(N, 2) normalised coordinates of pixels (N, 2)."""
        out = np.empty(px.shape)
        out[:, 0] = (px[:, 0] - self.cx_px) / self.fx_px
        out[:, 1] = (px[:, 1] - self.cy_px) / self.fy_px
        return out

    def to_px(self, xy: Floats) -> Floats:
        """(N, 2) pixels of normalised coordinates (N, 2)."""
        out = np.empty(xy.shape)
        out[:, 0] = xy[:, 0] * self.fx_px + self.cx_px
        out[:, 1] = xy[:, 1] * self.fy_px + self.cy_px
        return out

    @property
    def ground(self) -> GroundPlane:
        """The calibrated ground plane, from which the online estimate starts."""
        return GroundPlane(self.height_m, self.pitch_rad, self.roll_rad)


class Undistorter:
    """Undistorts images of one camera; the maps are computed once."""

    def __init__(self, camera: Camera) -> None:
        self.camera = camera
        self._maps: tuple[NDArray[np.int16], NDArray[np.uint16]] | None = None
        if camera.distortion:
            make_maps = cv2.fisheye.initUndistortRectifyMap if camera.fisheye else cv2.initUndistortRectifyMap
            self._maps = make_maps(  # type: ignore[assignment]
                camera.K,
                np.array(camera.distortion),
                np.eye(3),
                camera.K,
                (camera.width_px, camera.height_px),
                cv2.CV_16SC2,
            )

    def __call__(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Undistorts an image; K stays the same. Raises ValueError for an image of another size."""
        height_px, width_px = image.shape[:2]
        if (width_px, height_px) != (self.camera.width_px, self.camera.height_px):
            raise ValueError(
                f"image of {width_px}x{height_px} does not fit the camera of "
                f"{self.camera.width_px}x{self.camera.height_px}"
            )
        if self._maps is None:
            return image
        return cv2.remap(image, *self._maps, cv2.INTER_LINEAR)  # type: ignore[return-value]
