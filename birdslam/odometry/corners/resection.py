"""The corners of one image and its pose by them among the landmarks of the window, without those on the glass."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from birdslam.geometry.pose import Pose, rotation_log
from birdslam.odometry.corners.relative_pose import locate
from birdslam.odometry.corners.sliding_window import SlidingWindow, common

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]
Located = tuple[Pose, Floats]  # a pose and its information (6, 6), of (translation, rotation) in its own axes

_SAME_RAD, _SAME_REL = 0.0007, 0.05  # poses that differ by less say the same: rotation, place over the way
_ENOUGH = 0.7  # of the landmarks in sight that fit: no other guess is tried


@dataclass(frozen=True)
class Corners:
    """The N corners of one image outside vehicles."""

    ids: Ints  # (N,) ascending
    xy: Floats  # (N, 2) normalised coordinates
    displacement_px: Floats  # of those that the base image shows too
    stands: Bools  # (N,) in the image while the car drives: on the glass, or on a line along the way

    def of_street(self) -> Corners:
        """Those that do not stand."""
        moves = ~self.stands
        return Corners(self.ids[moves], self.xy[moves], self.displacement_px, self.stands[moves])


@dataclass(frozen=True)
class Fitting:
    """When a pose counts as measured."""

    least: int  # landmarks that must agree
    least_fraction: float  # and so large a part of those in sight
    longest_m: float  # a longer step is no measurement


def pose_beside_glass(
    window: SlidingWindow, corners: Corners, base: Pose, guesses: Sequence[Pose], fitting: Fitting
) -> tuple[Corners, Located | None]:
    """The corners to use and the pose by them: the street's alone where those that stand lead to another pose.

    Parameters are those of `pose_among_landmarks`; `corners` themselves are given back where none is left out.
    """
    both = pose_among_landmarks(window, corners, base, guesses, fitting)
    if not corners.stands.any():
        return corners, both
    street = corners.of_street()
    alone = pose_among_landmarks(window, street, base, guesses, fitting)
    if both is None or alone is None:
        return street, alone
    between, step = both[0].between(alone[0]), base.between(alone[0])
    turned = float(np.linalg.norm(rotation_log(between.R))) > _SAME_RAD
    moved = float(np.linalg.norm(between.p)) > _SAME_REL * float(np.linalg.norm(step.p))
    return (street, alone) if turned or moved else (corners, both)


def pose_among_landmarks(
    window: SlidingWindow, corners: Corners, base: Pose, guesses: Sequence[Pose], fitting: Fitting
) -> Located | None:
    """The image's pose in the window's frame and its information (6, 6); None where too few landmarks agree on one.

    `base` is the pose of the image before, `guesses` are tried until one fits well.
    """
    shared = len(common(corners.ids, window.ids[np.isfinite(window.rho)])[0])
    best: tuple[int, Pose, Floats] | None = None
    if shared >= fitting.least:
        for guess in guesses:
            pose, inliers, info = locate(window, guess, corners.ids, corners.xy)
            if best is None or inliers.sum() > best[0]:
                best = (int(inliers.sum()), pose, info)
            if best[0] > _ENOUGH * shared:
                break
    if best is None or best[0] < max(fitting.least, fitting.least_fraction * shared):
        return None
    return best[1:] if float(np.linalg.norm(best[1].p - base.p)) <= fitting.longest_m else None
