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
    at_focal_length,
    cost_of,
    shared_by,
    some_corners,
)
from birdslam.calibration.lens_windows import FOCAL_PX, CornersOfImage, Window, begin, windows_of
from birdslam.calibration.travel import TravelPitch, pitch_by_travel
from birdslam.geometry.pose import rotation_log

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

SIGMA_PX = 0.5  # of a corner, by pixels of a lens of FOCAL_PX
_MIN_TURN_RAD = math.radians(30.0)  # a drive that turns less shows no focal length: of 19 real ones eleven did not
_BEGUN = -1.0, 0.0, 1.0  # where the focal length is looked for from, in sigmas of what is known of it
_ROUGHLY = 1e-4  # how far each is adjusted
_BLOCKS = 8  # of the windows, for the sigma
_SHOWN = 0.7  # of the sigma beforehand: a focal length that is known no better is kept
# How wide cameras see, across, and 1-sigma of their focal length as a fraction: by judgement
FIELD_OF_VIEW_DEG = {"dashcam": (75.0, 0.25), "phone": (65.0, 0.1)}
STATED_SIGMA_REL = 0.03  # of a focal length by a field of view that somebody states
# A lens that sees farther than this across is about equidistant: rectilinear ones are built up to here; by judgement
WIDE_DEG = 110.0
# ... of whose focal length it is this: equisolid and stereographic lenses are 4 to 6 % and 8 to 15 % off (110, 140 deg)
WIDE_SIGMA_REL = 0.08
MIN_SIGMA_REL = 0.03  # of the focal length: on 19 real drives the fit's own was up to 26 times too small
MIN_SIGMA_K1 = 0.01


@dataclass(frozen=True)
class Lens:
    """A lens with square pixels, its principal point in the middle: pixel = focal_px u (1 + k1 |u|^2) + middle.

    `u` are normalised coordinates; a `fisheye` has the angle from its axis in place of |u|, in u's direction.
    `turned_rad` is how far the camera turned within the windows, all together; `focal_shown` whether the drive itself
    says more of the focal length than was known before; `pitch` is the camera's, by the way it travels.
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
    """The focal length in pixels of a lens that sees so far across: one without distortion, or an equidistant one."""
    half_rad = 0.5 * math.radians(degrees)
    return 0.5 * width_px / (half_rad if fisheye else math.tan(half_rad))


def k1_by_bend(bend: tuple[float, float], focal: float) -> tuple[float, float]:
    """k1 and its 1-sigma by upright lines, and by what is known beforehand; the focal length in image widths."""
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
    """The lens that the corners of a drive's raw images show; None where there is too little to see.

    `focal_px` with its 1-sigma is what is known beforehand. Where it is `by_view` across the image, it is unknown
    whether the view was counted with the lens's distortion or without: the sigma covers both, and how sure the
    distortion is. The focal length trades against turns and lateral motion in a narrow valley: so it is looked for from
    several. `bend`: that of a pinhole by upright lines (uprights.py), with its 1-sigma.
    """
    k1_before = 0.0, SIGMA_K1
    if bend is not None and not fisheye:
        k1_before = k1_by_bend(bend, focal_px / size_px[0])
    middle = 0.5 * (np.array(size_px, dtype=np.float64) - 1.0)
    windows = windows_of(images, middle, focal_px)
    sigma_px = SIGMA_PX * focal_px / FOCAL_PX
    started = begin(windows, focal_px, k1_before[0], sigma_px, fisheye, k1_before)
    if started is None:
        return None
    fitted = adjust(started)
    again = begin(windows, focal_px, fitted.k1, sigma_px, fisheye, k1_before)
    fitted = fitted if again is None else adjust(again)
    prior = FocalPrior(math.log(focal_px), focal_sigma_rel)
    turned_rad, sigmas = _turned_rad(fitted), sigmas_of(fitted, prior)
    if by_view:
        k1_sigma, edge2 = min(float(sigmas[0]), k1_before[1]), (0.5 * size_px[0] / focal_px) ** 2
        distorts = math.log(max(1.0 + fitted.k1 * edge2, 0.3))
        focal_sigma_rel = math.hypot(focal_sigma_rel, distorts, k1_sigma * edge2)
        prior = FocalPrior(math.log(focal_px), focal_sigma_rel)
        sigmas = sigmas_of(fitted, prior)
    shown = False
    if turned_rad > _MIN_TURN_RAD:
        found = _with_focal_length(windows, fitted, prior)
        sigmas_found = sigmas_of(found, prior)
        shown = bool(max(sigmas_found[1], MIN_SIGMA_REL) < _SHOWN * focal_sigma_rel)
        fitted, sigmas = (found, sigmas_found) if shown else (fitted, sigmas)
    if shown:
        focal_sigma_rel = max(float(sigmas[1]), MIN_SIGMA_REL)
    return Lens(
        focal_px=math.exp(fitted.log_focal),
        k1=fitted.k1,
        focal_sigma_rel=focal_sigma_rel,
        k1_sigma=min(max(MIN_SIGMA_K1, float(sigmas[0])), k1_before[1]),
        windows=len(fitted.R),
        corners=len(fitted.px),
        turned_rad=turned_rad,
        focal_shown=shown,
        fisheye=fisheye,
        pitch=pitch_by_travel(fitted, focal_sigma_rel),
    )


def _turned_rad(problem: LensProblem) -> float:
    """How far the camera turned; windows overlap by half."""
    return sum(float(np.linalg.norm(rotation_log(R[IMAGES // 2]))) for R in problem.R)


def _with_focal_length(windows: Sequence[Window], fitted: LensProblem, prior: FocalPrior) -> LensProblem:
    """The problem with the focal length that costs least, of those that are found from several."""
    started = (at_focal_length(fitted, prior.log_focal + by * prior.sigma) for by in _BEGUN)
    found = [adjust(problem, prior, _ROUGHLY) for problem in started]
    best = min(found, key=lambda problem: cost_of(problem, prior))
    # Which corners are outliers was decided with another lens
    again = begin(windows, math.exp(best.log_focal), best.k1, best.sigma_px, best.fisheye, best.k1_before)
    return best if again is None else adjust(again, prior)


def sigmas_of(problem: LensProblem, prior: FocalPrior) -> Floats:
    """(3,) 1-sigma of `LensProblem.shared`: k1, the log of the focal length, the readout in s.

    What the lens is without each part of the drive, and without each part of the image, in one step from here. Windows
    beside each other share images and bends, so parts of the drive are whole; a lens that is no such lens (a second
    term, another middle, rows read in turn) shows by parts of the image that disagree.
    """
    W = len(problem.R)
    blocks = (np.arange(W) * min(_BLOCKS, W) // W)[problem.of]
    middle = problem.px[:, IMAGES // 2]
    ring = np.searchsorted(
        np.quantile(np.linalg.norm(middle, axis=1), [1.0 / 3.0, 2.0 / 3.0]), np.linalg.norm(middle, axis=1)
    )
    side = 2 * (middle[:, 0] > 0.0) + (middle[:, 1] > 0.0)
    own = np.diag(np.linalg.inv(shared_by(problem, prior)[1]))
    return np.sqrt(np.max([own, *(_jackknife(problem, prior, parts) for parts in (blocks, ring, side))], axis=0))


def _jackknife(problem: LensProblem, prior: FocalPrior, parts: Ints) -> Floats:
    """(3,) variance by what the lens is without each part (P,) of the corners."""
    each = np.unique(parts)
    if len(each) < 2:
        return np.zeros(3)
    without = np.array([_shared_without(problem, prior, parts != one) for one in each])
    out: Floats = (len(each) - 1) / len(each) * np.square(without - without.mean(axis=0)).sum(axis=0)
    return out


def _shared_without(problem: LensProblem, prior: FocalPrior, some: NDArray[np.bool_]) -> Floats:
    """`LensProblem.shared` by some of the corners (P,); by what is known beforehand where few are left."""
    left = some_corners(problem, some)
    return shared_by(left, prior)[0] if len(left.R) else np.array([0.0, prior.log_focal, problem.readout_before[0]])
