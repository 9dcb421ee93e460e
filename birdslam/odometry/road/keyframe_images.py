"""Keyframe images of the road, with their poses: what the present image is aligned with."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from birdslam.geometry.pose import Pose
from birdslam.odometry.road.road_image import RoadImage

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class RoadFrame:
    """The road in one image."""

    raw: RoadImage
    corrected: RoadImage  # without the fixed pattern, where there is one


@dataclass(frozen=True)
class RoadKeyframe(RoadFrame):
    """The road in an earlier image."""

    pose: Pose  # in the odometry's frame and unit


class RoadKeyframes:
    """The last `most` images that were far enough apart."""

    def __init__(self, most: int) -> None:
        self._most = most
        self._images: list[RoadKeyframe] = []

    def clear(self) -> None:
        """Forgets all."""
        self._images = []

    def insert(self, seen: RoadFrame, pose: Pose, min_baseline_m: float, alone: bool = False) -> None:
        """Adds the image if it is that far from the newest; `alone`: the earlier ones are dropped."""
        newest = self._images[-1] if self._images else None
        if newest is None or float(np.linalg.norm(newest.pose.p - pose.p)) > min_baseline_m:
            earlier = [] if alone else self._images[1 - self._most :]
            self._images = [*earlier, RoadKeyframe(seen.raw, seen.corrected, pose)]

    def rescale(self, centre: Floats, factor: float) -> None:
        """Scales the poses about a point (3,)."""
        moved = [Pose(k.pose.R, centre + factor * (k.pose.p - centre)) for k in self._images]
        self._images = [RoadKeyframe(k.raw, k.corrected, T) for k, T in zip(self._images, moved, strict=True)]

    def at_baseline(self, pose: Pose, target_m: float, min_baseline_m: float) -> RoadKeyframe | None:
        """The one whose distance from `pose` is nearest to the target; None where all are too near."""
        distance = np.array([np.linalg.norm(k.pose.p - pose.p) for k in self._images])
        usable = np.flatnonzero(distance > min_baseline_m)
        if not len(usable):
            return None
        return self._images[int(usable[np.argmin(np.abs(np.log(distance[usable] / target_m)))])]

    def candidate(self, tries: int) -> RoadKeyframe | None:
        """The oldest, then the newest, the one before it, and so on."""
        return self._images[-tries % len(self._images)] if self._images else None
