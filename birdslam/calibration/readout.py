"""Readout time of a rolling shutter from a drive, by bundle adjustment of short windows of near corners.

A near point that moves down the image is read later, so its displacement in the lower part is too large, in proportion
to the speed (Albl et al., CVPR 2016; here with a known lens). The estimate is fused with a prior of typical cameras.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import cv2
import numpy as np

from birdslam.calibration.lens import MIN_SIGMA_K1, SIGMA_PX, sigmas_of
from birdslam.calibration.lens_adjustment import HELD, FocalPrior, adjust
from birdslam.calibration.lens_windows import FOCAL_PX, CornersOfImage, begin, near_windows
from birdslam.geometry.arrays import Floats
from birdslam.geometry.camera import Camera

_USUAL_S = 0.0, 0.03  # of dashboard cameras and phones, each as likely
_MIN_FOCAL_REL = 0.005  # 1-sigma of a focal length that was measured
_FREE_S = 0.1  # 1-sigma with which the corners begin
MAX_S = 0.1  # of a camera file


class Readout(NamedTuple):
    """From an image's first row to its last, with its 1-sigma; and what the drive alone says, where it says anything.

    `windows` is of how many windows that is.
    """

    readout_s: float
    sigma_s: float
    by_drive: tuple[float, float] | None = None
    windows: int = 0


USUAL = Readout(0.5 * sum(_USUAL_S), (_USUAL_S[1] - _USUAL_S[0]) / math.sqrt(12.0))


def readout_of_drive(
    images: Sequence[CornersOfImage],
    camera: Camera,
    focal_sigma_rel: float = 0.0,
    k1_sigma: float = 0.0,
) -> Readout:
    """Readout time from corners of raw images and a camera with this lens uncertainty; USUAL without evidence.

    Drive and prior are fused by their information.
    """
    focal_px = 0.5 * (camera.fx_px + camera.fy_px)
    middle = 0.5 * (np.array([camera.width_px, camera.height_px], dtype=np.float64) - 1.0)
    windows = [
        replace(window, px=focal_px * _undistorted(window.px + middle, camera))
        for window in near_windows(images, middle, focal_px)
    ]
    k1 = 0.0, max(k1_sigma, MIN_SIGMA_K1)
    started = begin(windows, focal_px, 0.0, SIGMA_PX * focal_px / FOCAL_PX, False, k1, (0.0, _FREE_S))
    if started is None:
        return USUAL
    prior = FocalPrior(math.log(focal_px), max(focal_sigma_rel, _MIN_FOCAL_REL, HELD))
    fitted = adjust(started, prior)
    by_drive, sigma_s = fitted.readout_s, float(sigmas_of(fitted, prior)[2])
    if not (math.isfinite(by_drive) and sigma_s < _FREE_S):
        return USUAL
    information = sigma_s**-2.0, USUAL.sigma_s**-2.0
    both_s = (information[0] * by_drive + information[1] * USUAL.readout_s) / sum(information)
    return Readout(min(max(both_s, 0.0), MAX_S), sum(information) ** -0.5, (by_drive, sigma_s), len(fitted.R))


def _undistorted(px: Floats, camera: Camera) -> Floats:
    """(..., 2) normalised coordinates of raw pixels."""
    flat = np.ascontiguousarray(px.reshape(-1, 1, 2))
    if not camera.distortion:
        return camera.to_xy(flat[:, 0]).reshape(px.shape)
    undistort = cv2.fisheye.undistortPoints if camera.fisheye else cv2.undistortPoints
    return np.asarray(undistort(flat, camera.K, np.array(camera.distortion)), np.float64).reshape(px.shape)
