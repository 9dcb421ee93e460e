"""Converts images, camera calibrations and speeds of ROS messages to our records.

Definitions: sensor_msgs, geometry_msgs and sensor_msgs/image_encodings.hpp.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from birdslam.types import NS_PER_S, SpeedReading

FIX_SIGMA_M = 5.0  # of a fix without a covariance: a receiver without corrections, under open sky

IMAGES = ("sensor_msgs/Image", "sensor_msgs/CompressedImage")
CAMERA_INFO = "sensor_msgs/CameraInfo"
FIX = "sensor_msgs/NavSatFix"
SPEEDS = ("geometry_msgs/TwistStamped", "geometry_msgs/TwistWithCovarianceStamped", "nav_msgs/Odometry")

# ROS encoding -> bytes per pixel, OpenCV's conversion
ENCODINGS: dict[str, tuple[int, int | None]] = {
    "mono8": (1, None),
    "8UC1": (1, None),
    "bgr8": (3, None),
    "8UC3": (3, None),
    "rgb8": (3, cv2.COLOR_RGB2BGR),
    "bgra8": (4, cv2.COLOR_BGRA2BGR),
    "rgba8": (4, cv2.COLOR_RGBA2BGR),
    "bayer_rggb8": (1, cv2.COLOR_BayerRGGB2BGR),
    "bayer_bggr8": (1, cv2.COLOR_BayerBGGR2BGR),
    "bayer_gbrg8": (1, cv2.COLOR_BayerGBRG2BGR),
    "bayer_grbg8": (1, cv2.COLOR_BayerGRBG2BGR),
    "yuv422": (2, cv2.COLOR_YUV2BGR_UYVY),
    "uyvy": (2, cv2.COLOR_YUV2BGR_UYVY),
    "yuv422_yuy2": (2, cv2.COLOR_YUV2BGR_YUY2),
    "yuyv": (2, cv2.COLOR_YUV2BGR_YUY2),
}
_POLYNOMIAL = (4, 5, 8, 12, 14)  # coefficients of OpenCV's model; drivers name it by either of two names
MODELS = {"plumb_bob": _POLYNOMIAL, "rational_polynomial": _POLYNOMIAL, "equidistant": (4,)}


class Lens(NamedTuple):
    """Camera intrinsics without the mounting, with the field names of `Camera`."""

    width_px: int
    height_px: int
    fx_px: float
    fy_px: float
    cx_px: float
    cy_px: float
    distortion: tuple[float, ...]
    fisheye: bool


def pixels(image: Any) -> NDArray[np.uint8]:
    """(H, W) grey or (H, W, 3) BGR of a sensor_msgs/Image. Raises ValueError with the reason."""
    if image.encoding not in ENCODINGS:
        raise ValueError(f"encoding {image.encoding!r} is not one of {', '.join(ENCODINGS)}")
    channels, conversion = ENCODINGS[image.encoding]
    height_px, width_px, row = int(image.height), int(image.width), int(image.step)
    data = np.frombuffer(memoryview(image.data), np.uint8)
    if not (width_px > 0 and height_px > 0 and row >= width_px * channels and data.size >= height_px * row):
        raise ValueError(
            f"{data.size} bytes in rows of {row} are not an image of {width_px}x{height_px} in {image.encoding}"
        )
    rows = data[: height_px * row].reshape(height_px, row)[:, : width_px * channels]
    shape = (height_px, width_px) if channels == 1 else (height_px, width_px, channels)
    out = np.ascontiguousarray(rows).reshape(shape)
    return out if conversion is None else _converted(out, image.encoding)


def demosaiced(stored_as: str, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """The decoded image of a sensor_msgs/CompressedImage with this `format`; a Bayer mosaic becomes BGR.

    The format begins with the encoding of the raw image, as in `bayer_rggb8; jpeg compressed bgr8`.
    """
    encoding = stored_as.partition(";")[0].strip()
    if image.ndim != 2 or not encoding.startswith("bayer_"):
        return image
    if encoding not in ENCODINGS:
        raise ValueError(f"encoding {encoding!r} is not one of {', '.join(ENCODINGS)}")
    return _converted(image, encoding)


def _converted(stored: NDArray[np.uint8], encoding: str) -> NDArray[np.uint8]:
    """The BGR image of an image in one of ENCODINGS. Raises ValueError."""
    try:
        return cv2.cvtColor(stored, ENCODINGS[encoding][1])  # type: ignore[return-value, arg-type]
    except cv2.error:  # too small for a Bayer mosaic or for pairs of pixels
        raise ValueError(f"{stored.shape[1]}x{stored.shape[0]} is not a valid image size in {encoding}") from None


def lens(info: Any, rectified: bool) -> Lens:
    """The lens in a sensor_msgs/CameraInfo: of the raw image (K, D), or of the rectified one (P). Raises ValueError.

    CameraInfo refers to the full sensor; binning and region of interest define the image.
    """
    P, K, D = (np.array(_field(info, name), dtype=np.float64) for name in ("p", "k", "d"))
    fx, fy, cx, cy = (P[0], P[5], P[2], P[6]) if rectified else (K[0], K[4], K[2], K[5])
    if not (fx > 0.0 and fy > 0.0):
        raise ValueError("has no calibration: its focal lengths are zero")
    model, binning = str(info.distortion_model), (max(int(info.binning_x), 1), max(int(info.binning_y), 1))
    fisheye = model == "equidistant" and not rectified
    distortion: tuple[float, ...] = ()
    if not rectified and (D.any() or fisheye):
        if model not in MODELS:
            raise ValueError(f"distortion_model {model!r} is not one of {', '.join(MODELS)}")
        if len(D) not in MODELS[model]:
            raise ValueError(f"distortion_model {model!r} with {len(D)} coefficients")
        distortion = tuple(D.tolist())
    roi = info.roi
    whole = int(roi.width) == 0 or int(roi.height) == 0
    width_px, height_px = (int(info.width), int(info.height)) if whole else (int(roi.width), int(roi.height))
    x0, y0 = (0, 0) if whole else (int(roi.x_offset), int(roi.y_offset))
    return Lens(
        width_px // binning[0],
        height_px // binning[1],
        float(fx) / binning[0],
        float(fy) / binning[1],
        float(cx - x0) / binning[0],
        float(cy - y0) / binning[1],
        distortion,
        fisheye,
    )


def is_rectified(topic: str) -> bool:
    """Whether the images are rectified, by image_proc's names `image_rect` and `image_rect_color`."""
    return any(part.startswith("image_rect") for part in topic.split("/"))


def speed(message: Any, t_ns: int, sigma_mps: float, yaw_rate_sigma_radps: float, has_yaw_rate: bool) -> SpeedReading:
    """The reading in a message of one of SPEEDS. The sigmas apply to a message without covariance.

    The yaw rate is None unless `has_yaw_rate`.
    """
    twist, cov = message.twist, None
    if hasattr(twist, "covariance"):
        twist, cov = twist.twist, twist.covariance
    yaw_rate = float(twist.angular.z) if has_yaw_rate else None
    return SpeedReading(
        t_ns=t_ns,
        speed_mps=float(twist.linear.x),
        sigma_mps=_sigma(cov, 0, sigma_mps),
        yaw_rate_radps=yaw_rate,
        yaw_rate_sigma_radps=0.0 if yaw_rate is None else _sigma(cov, 35, yaw_rate_sigma_radps),
    )


def fix_row(message: Any, t_ns: int) -> str | None:
    """A sensor_msgs/NavSatFix as a line of loops/gnss_file.py (time, degrees, sigma); None without a fix."""
    if message.status.status < 0 or not (math.isfinite(message.latitude) and math.isfinite(message.longitude)):
        return None
    sigma_m = _sigma(message.position_covariance, 0, FIX_SIGMA_M)
    return f"{t_ns / NS_PER_S:.9f},{message.latitude:.9f},{message.longitude:.9f},{sigma_m:.3f}"


def yaw_rate(message: Any) -> float:
    """Yaw rate in rad/s about z from a message of one of SPEEDS."""
    twist = message.twist
    return float((twist.twist if hasattr(twist, "covariance") else twist).angular.z)


def _sigma(cov: Any, index: int, otherwise: float) -> float:
    """1-sigma of a covariance; in ROS a variance of zero or below means unknown."""
    variance = 0.0 if cov is None else float(cov[index])
    return math.sqrt(variance) if math.isfinite(variance) and variance > 0.0 else otherwise


def _field(message: Any, name: str) -> Any:
    """Reads a matrix of CameraInfo, whose name is in capitals in ROS 1."""
    return getattr(message, name) if hasattr(message, name) else getattr(message, name.upper())
