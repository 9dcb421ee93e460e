"""The earlier images of the road that the present one is compared with, each with the pose that it was taken from."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from birdslam.geometry.pose import Pose
from birdslam.odometry.road.alignment import RoadImage

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Seen:
    """The road in one image."""

    plain: RoadImage
    image: RoadImage  # the same, or without what stands still in it


@dataclass(frozen=True)
class Kept(Seen):
    """The road in an earlier image."""

    pose: Pose  # in the odometry's frame and unit


class KeptImages:
    """The last `most` images that were far enough from one another."""

    def __init__(self, most: int) -> None:
        self._most = most
        self._images: list[Kept] = []

    def clear(self) -> None:
        """Forgets all."""
        self._images = []

    def keep(self, seen: Seen, pose: Pose, farther_than_m: float, alone: bool = False) -> None:
        """Remembers the first image, and one that is farther than that from the newest; `alone`: the others no more."""
        newest = self._images[-1] if self._images else None
        if newest is None or float(np.linalg.norm(newest.pose.p - pose.p)) > farther_than_m:
            earlier = [] if alone else self._images[1 - self._most :]
            self._images = [*earlier, Kept(seen.plain, seen.image, pose)]

    def rescale(self, centre: Floats, factor: float) -> None:
        """Multiplies the distances of all images from a point (3,)."""
        moved = [Pose(k.pose.R, centre + factor * (k.pose.p - centre)) for k in self._images]
        self._images = [Kept(k.plain, k.image, T) for k, T in zip(self._images, moved, strict=True)]

    def nearest_to(self, pose: Pose, target_m: float, farther_than_m: float) -> Kept | None:
        """The one whose distance from `pose` is most like the target; None where all are nearer than allowed."""
        distance = np.array([np.linalg.norm(k.pose.p - pose.p) for k in self._images])
        usable = np.flatnonzero(distance > farther_than_m)
        if not len(usable):
            return None
        return self._images[int(usable[np.argmin(np.abs(np.log(distance[usable] / target_m)))])]

    def in_turn(self, tries: int) -> Kept | None:
        """The oldest, then the newest, the one before it, and so on."""
        return self._images[-tries % len(self._images)] if self._images else None
