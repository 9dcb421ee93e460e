"""Keyframe images of the road with their poses, for the alignment with the current image."""

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
    corrected: RoadImage  # without the fixed pattern, if there is one


@dataclass(frozen=True)
class RoadKeyframe(RoadFrame):
    """The road in an earlier image."""

    pose: Pose  # in the window frame and scale


class RoadKeyframes:
    """The last `max_count` images with a minimum distance."""

    def __init__(self, max_count: int) -> None:
        self._max_count = max_count
        self._images: list[RoadKeyframe] = []

    def clear(self) -> None:
        """Drops all images."""
        self._images = []

    def insert(self, seen: RoadFrame, pose: Pose, min_baseline_m: float, alone: bool = False) -> None:
        """Adds the image if it is that far from the newest; `alone` drops the earlier ones."""
        newest = self._images[-1] if self._images else None
        if newest is None or float(np.linalg.norm(newest.pose.p - pose.p)) > min_baseline_m:
            earlier = [] if alone else self._images[1 - self._max_count :]
            self._images = [*earlier, RoadKeyframe(seen.raw, seen.corrected, pose)]

    def rescale(self, centre: Floats, factor: float) -> None:
        """Scales the poses about a point (3,)."""
        moved = [Pose(k.pose.R, centre + factor * (k.pose.p - centre)) for k in self._images]
        self._images = [RoadKeyframe(k.raw, k.corrected, T) for k, T in zip(self._images, moved, strict=True)]

    def at_baseline(self, pose: Pose, target_m: float, min_baseline_m: float) -> RoadKeyframe | None:
        """The image whose distance from `pose` is nearest to the target; None if all are too near."""
        distance = np.array([np.linalg.norm(k.pose.p - pose.p) for k in self._images])
        usable = np.flatnonzero(distance > min_baseline_m)
        if not len(usable):
            return None
        return self._images[int(usable[np.argmin(np.abs(np.log(distance[usable] / target_m)))])]

    def candidate(self, tries: int) -> RoadKeyframe | None:
        """The candidate of attempt `tries`: the oldest, then the newest, the second newest, and so on."""
        return self._images[-tries % len(self._images)] if self._images else None
