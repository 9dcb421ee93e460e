"""Lens self-calibration from a drive: focal length and radial distortion by bundle adjustment of short windows.

Two images do not determine distortion, and only rotation determines the focal length (Sturm, "Critical motion
sequences", CVPR 1997). Each window has its own poses and corners; the lens is shared. The principal point is the image
centre, pixels are square, higher terms are 0.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from birdslam.calibration.lens_adjustment import (
    IMAGES,
    SIGMA_K1,
    FocalPrior,
    LensProblem,
    adjust,
    robust_cost,
    select_corners,
    set_focal_length,
    step_shared,
)
from birdslam.calibration.lens_windows import FOCAL_PX, CornersOfImage, Window, initialize, select_windows
from birdslam.calibration.travel import TravelPitch, pitch_by_travel
from birdslam.geometry.pose import rotation_log

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

SIGMA_PX = 0.5  # of a corner, in pixels of a lens of FOCAL_PX
_MIN_TURN_RAD = math.radians(30.0)  # min. rotation of a drive that determines the focal length
_INITIAL_SIGMAS = -1.0, 0.0, 1.0  # initial values of the focal length, in sigmas of the prior
_COARSE_CONVERGENCE = 1e-4  # convergence for each initial value
_BLOCKS = 8  # parts of the drive for the sigma
_MAX_SIGMA_RATIO = 0.7  # max. ratio to the prior's sigma at which the estimate replaces the prior
# Horizontal field of view and 1-sigma of the focal length as a fraction, by kind of camera
FIELD_OF_VIEW_DEG = {"dashcam": (75.0, 0.25), "phone": (65.0, 0.1)}
STATED_SIGMA_REL = 0.1  # of a focal length from a nominal field of view: data sheets state the diagonal, or round
# Above this field of view lenses are about equidistant
WIDE_DEG = 110.0
# 1-sigma of its focal length: equisolid and stereographic lenses are 4 to 6 % and 8 to 15 % off (110, 140 degrees)
WIDE_SIGMA_REL = 0.08
MIN_SIGMA_REL = 0.03  # of the focal length: the fit's own sigma is too small on real drives
MIN_SIGMA_K1 = 0.01


@dataclass(frozen=True)
class Lens:
    """A lens with square pixels and its principal point in the centre: pixel = focal_px u (1 + k1 |u|^2) + centre.

    `u` are normalised coordinates; a `fisheye` uses the angle from the axis in place of |u|, in u's direction.
    `turned_rad`: total rotation within the windows. `focal_shown`: whether the drive improved the prior of the focal
    length. `pitch`: of the camera against the direction of travel.
    """

    focal_px: float
    k1: float
    focal_sigma_rel: float
    k1_sigma: float
    windows: int
    corners: int
    turned_rad: float
    focal_shown: bool
    fisheye: bool = False
    pitch: TravelPitch | None = None


def focal_by_field_of_view(width_px: int, degrees: float, fisheye: bool = False) -> float:
    """Focal length in pixels for a field of view, of an undistorted pinhole or an equidistant lens."""
    half_rad = 0.5 * math.radians(degrees)
    return 0.5 * width_px / (half_rad if fisheye else math.tan(half_rad))


def k1_by_bend(bend: tuple[float, float], focal: float) -> tuple[float, float]:
    """k1 and its 1-sigma from the bend of vertical edges and the prior; the focal length in image widths."""
    by_lines, by_kind = (bend[1] * focal**2) ** -2.0, SIGMA_K1**-2.0
    return bend[0] * focal**2 * by_lines / (by_lines + by_kind), (by_lines + by_kind) ** -0.5


def self_calibrate(
    images: Sequence[CornersOfImage],
    size_px: tuple[int, int],
    focal_px: float,
    focal_sigma_rel: float,
    by_view: bool = False,
    fisheye: bool = False,
    bend: tuple[float, float] | None = None,
) -> Lens | None:
    """Estimates the lens from the corners of a drive's raw images; None with too few.

    `focal_px` and its sigma are the prior. If it is `by_view`, from a field of view, the view may include the lens's
    distortion or not; the sigma of the distortion covers both. The focal length trades against rotation and lateral
    motion in a narrow valley, so several initial values are tried. `bend`: of a pinhole by vertical edges
    (vertical_edges.py), with its 1-sigma.
    """
    k1_prior = 0.0, SIGMA_K1
    if bend is not None and not fisheye:
        k1_prior = k1_by_bend(bend, focal_px / size_px[0])
    middle = 0.5 * (np.array(size_px, dtype=np.float64) - 1.0)
    windows = select_windows(images, middle, focal_px)
    sigma_px = SIGMA_PX * focal_px / FOCAL_PX
    started = initialize(windows, focal_px, k1_prior[0], sigma_px, fisheye, k1_prior)
    if started is None:
        return None
    fitted = adjust(started)
    again = initialize(windows, focal_px, fitted.k1, sigma_px, fisheye, k1_prior)
    fitted = fitted if again is None else adjust(again)
    prior = FocalPrior(math.log(focal_px), focal_sigma_rel)
    turned_rad, sigmas = _total_rotation_rad(fitted), estimate_sigmas(fitted, prior)
    if by_view:
        k1_sigma, edge2 = min(float(sigmas[0]), k1_prior[1]), (0.5 * max(size_px) / focal_px) ** 2
        distorts = math.log(max(1.0 + fitted.k1 * edge2, 0.3))
        focal_sigma_rel = math.hypot(focal_sigma_rel, distorts, k1_sigma * edge2)
        prior = FocalPrior(math.log(focal_px), focal_sigma_rel)
        sigmas = estimate_sigmas(fitted, prior)
    shown = False
    if turned_rad > _MIN_TURN_RAD:
        found = _search_focal_length(windows, fitted, prior)
        sigmas_found = estimate_sigmas(found, prior)
        shown = bool(max(sigmas_found[1], MIN_SIGMA_REL) < _MAX_SIGMA_RATIO * focal_sigma_rel)
        fitted, sigmas = (found, sigmas_found) if shown else (fitted, sigmas)
    if shown:
        focal_sigma_rel = max(float(sigmas[1]), MIN_SIGMA_REL)
    return Lens(
        focal_px=math.exp(fitted.log_focal),
        k1=fitted.k1,
        focal_sigma_rel=focal_sigma_rel,
        k1_sigma=min(max(MIN_SIGMA_K1, float(sigmas[0])), k1_prior[1]),
        windows=len(fitted.R),
        corners=len(fitted.px),
        turned_rad=turned_rad,
        focal_shown=shown,
        fisheye=fisheye,
        pitch=pitch_by_travel(fitted, focal_sigma_rel),
    )


def _total_rotation_rad(problem: LensProblem) -> float:
    """Total rotation of the camera; windows overlap by half."""
    return sum(float(np.linalg.norm(rotation_log(R[IMAGES // 2]))) for R in problem.R)


def _search_focal_length(windows: Sequence[Window], fitted: LensProblem, prior: FocalPrior) -> LensProblem:
    """The problem with the focal length of least cost over several initial values."""
    started = (set_focal_length(fitted, prior.log_focal + by * prior.sigma) for by in _INITIAL_SIGMAS)
    found = [adjust(problem, prior, _COARSE_CONVERGENCE) for problem in started]
    best = min(found, key=lambda problem: robust_cost(problem, prior))
    # Outliers were decided with another lens
    again = initialize(windows, math.exp(best.log_focal), best.k1, best.sigma_px, best.fisheye, best.k1_prior)
    return best if again is None else adjust(again, prior)


def estimate_sigmas(problem: LensProblem, prior: FocalPrior) -> Floats:
    """(3,) 1-sigma of `LensProblem.shared`: k1, log of the focal length, readout in s.

    Jackknife over parts of the drive and over parts of the image, by one step each. Neighbouring windows share images
    and curves, so the parts of the drive are contiguous; a wrong lens model (a second term, another centre, rolling
    shutter) makes parts of the image disagree.
    """
    W = len(problem.R)
    blocks = (np.arange(W) * min(_BLOCKS, W) // W)[problem.of]
    middle = problem.px[:, IMAGES // 2]
    ring = np.searchsorted(
        np.quantile(np.linalg.norm(middle, axis=1), [1.0 / 3.0, 2.0 / 3.0]), np.linalg.norm(middle, axis=1)
    )
    side = 2 * (middle[:, 0] > 0.0) + (middle[:, 1] > 0.0)
    own = np.diag(np.linalg.inv(step_shared(problem, prior)[1]))
    return np.sqrt(np.max([own, *(_jackknife(problem, prior, parts) for parts in (blocks, ring, side))], axis=0))


def _jackknife(problem: LensProblem, prior: FocalPrior, parts: Ints) -> Floats:
    """(3,) jackknife variance over the parts (P,) of the corners."""
    each = np.unique(parts)
    if len(each) < 2:
        return np.zeros(3)
    without = np.array([_shared_without(problem, prior, parts != one) for one in each])
    out: Floats = (len(each) - 1) / len(each) * np.square(without - without.mean(axis=0)).sum(axis=0)
    return out


def _shared_without(problem: LensProblem, prior: FocalPrior, some: NDArray[np.bool_]) -> Floats:
    """`LensProblem.shared` from a subset (P,) of the corners; the prior if too few are left."""
    left = select_corners(problem, some)
    return step_shared(left, prior)[0] if len(left.R) else np.array([0.0, prior.log_focal, problem.readout_prior[0]])
