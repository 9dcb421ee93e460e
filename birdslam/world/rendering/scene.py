"""Input and output of the renderer; numpy only, so that placing bodies needs no numba."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from birdslam.geometry.arrays import Bools, Floats, Floats32, Ints


@dataclass(frozen=True)
class Bodies:
    """Bodies in the world, row by row: kind of mesh, parameters (`materials`), pose in world."""

    kind: NDArray[np.int32]
    parameters: Floats32  # (n, SLOTS)
    position_m: Floats  # (n, 3) in world
    yaw_rad: Floats
    slope: Floats  # of the road under it along its x, dz/dx; 0 for bodies that are vertical on a slope
    object_id: NDArray[np.int32]  # -1 for static bodies

    def subset(self, keep: Bools) -> Bodies:
        """The rows to keep."""
        return Bodies(*(column[keep] for column in self.__dict__.values()))

    def plus(self, other: Bodies) -> Bodies:
        """These rows, then the other ones."""
        pairs = zip(self.__dict__.values(), other.__dict__.values(), strict=True)
        return Bodies(*(np.concatenate(pair) for pair in pairs))


@dataclass(frozen=True)
class Rendered:
    """`light` (H, W, 3) linear BGR; boxes (n, 4) in pixels, NaN where nothing is in front of the camera."""

    light: Floats32
    depth_m: Floats32
    classes: NDArray[np.uint8]
    instances: NDArray[np.uint16]
    boxes_px: Floats  # of movable bodies, in the order of `moving`
    moving: Ints
    visible: Floats  # of each of them: unoccluded fraction of its samples inside the image
