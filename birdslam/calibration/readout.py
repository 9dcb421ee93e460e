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

from birdslam.calibration.lens import MIN_SIGMA_K1, SIGMA_PX, estimate_sigmas
from birdslam.calibration.lens_adjustment import FIXED_SIGMA, FocalPrior, adjust
from birdslam.calibration.lens_windows import FOCAL_PX, CornersOfImage, initialize, select_near_windows
from birdslam.geometry.arrays import Floats
from birdslam.geometry.camera import Camera

_TYPICAL_S = 0.0, 0.03  # of dashboard cameras and phones, uniform
_MIN_FOCAL_REL = 0.005  # 1-sigma of a measured focal length
_INITIAL_SIGMA_S = 0.1  # initial 1-sigma of the readout time
MAX_S = 0.1  # max. of a camera file


class Readout(NamedTuple):
    """Time from an image's first row to its last, with 1-sigma.

    `by_drive`: estimate and sigma from the drive alone, or None; `windows`: their number.
    """

    readout_s: float
    sigma_s: float
    by_drive: tuple[float, float] | None = None
    windows: int = 0


PRIOR = Readout(0.5 * sum(_TYPICAL_S), (_TYPICAL_S[1] - _TYPICAL_S[0]) / math.sqrt(12.0))


def readout_of_drive(
    images: Sequence[CornersOfImage],
    camera: Camera,
    focal_sigma_rel: float = 0.0,
) -> Readout:
    """Readout time from corners of raw images and a camera with this lens uncertainty; PRIOR without evidence.

    The result fuses drive and prior by information.
    """
    focal_px = 0.5 * (camera.fx_px + camera.fy_px)
    middle = 0.5 * (np.array([camera.width_px, camera.height_px], dtype=np.float64) - 1.0)
    windows = [
        replace(window, px=focal_px * _undistorted(window.px + middle, camera))
        for window in select_near_windows(images, middle, focal_px)
    ]
    k1 = 0.0, max(camera.distortion_sigma, MIN_SIGMA_K1)
    started = initialize(windows, focal_px, 0.0, SIGMA_PX * focal_px / FOCAL_PX, False, k1, (0.0, _INITIAL_SIGMA_S))
    if started is None:
        return PRIOR
    prior = FocalPrior(math.log(focal_px), max(focal_sigma_rel, _MIN_FOCAL_REL, FIXED_SIGMA))
    fitted = adjust(started, prior)
    by_drive, sigma_s = fitted.readout_s, float(estimate_sigmas(fitted, prior)[2])
    if not (math.isfinite(by_drive) and sigma_s < _INITIAL_SIGMA_S):
        return PRIOR
    information = sigma_s**-2.0, PRIOR.sigma_s**-2.0
    both_s = (information[0] * by_drive + information[1] * PRIOR.readout_s) / sum(information)
    return Readout(min(max(both_s, 0.0), MAX_S), sum(information) ** -0.5, (by_drive, sigma_s), len(fitted.R))


def _undistorted(px: Floats, camera: Camera) -> Floats:
    """(..., 2) normalised coordinates of raw pixels."""
    flat = np.ascontiguousarray(px.reshape(-1, 1, 2))
    if not camera.distortion:
        return camera.to_xy(flat[:, 0]).reshape(px.shape)
    undistort = cv2.fisheye.undistortPoints if camera.fisheye else cv2.undistortPoints
    return np.asarray(undistort(flat, camera.K, np.array(camera.distortion)), np.float64).reshape(px.shape)
