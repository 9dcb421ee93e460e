"""A keyframe: a place of the map, with points that were triangulated on the way past it, and the road's lines there."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from birdslam.geometry.arrays import Floats
from birdslam.geometry.se2 import SE2
from birdslam.loops.foot import body_pose
from birdslam.trajectory import Transform
from birdslam.types import Attitude, LineColour, LineKind


class Placed(Protocol):
    """A node of the graph."""

    @property
    def number(self) -> int: ...
    @property
    def T_map_keyframe(self) -> SE2: ...
    @property
    def scale(self) -> float: ...


@dataclass(frozen=True)
class Fixed:
    """Where a keyframe is by the fix of GNSS nearest to it, brought there along the drive's way."""

    latitude_deg: float
    longitude_deg: float
    sigma_m: float  # 1-sigma of the fix by itself
    weighed_m: float  # with what it shares with those before and after it


@dataclass(frozen=True, eq=False)
class LinePiece:
    """A line of the road beside a keyframe, in its ego frame: it moves with it."""

    drive: int  # that saw it
    line: int  # its number in that drive
    kind: LineKind
    colour: LineColour
    points_m: Floats  # (N, 2)
    sigma_m: float  # 1-sigma across it, against the ego that saw it

    def seen_from(self, T_other_keyframe: SE2) -> LinePiece:
        """The same in another keyframe's frame."""
        return replace(self, points_m=T_other_keyframe @ self.points_m)


@dataclass(frozen=True, eq=False)
class Keyframe:
    """Points are in the keyframe's ego frame: x forward, y left, z up, from the camera's foot on the road.

    They are in metres of its drive's odometry there; `scale` makes them the map's, about the camera that saw them.
    """

    number: int  # unique in its map
    drive: int  # the drive that it is of: 0 made the map, further ones extended it
    t_source_ns: int
    T_map_keyframe: SE2
    cov: Floats  # (3, 3) of T_map_keyframe, of the tangent at the pose; where fixes placed the map, of its place there
    attitude: Attitude
    points_m: Floats  # (N, 3)
    sigma_depth_rel: Floats  # (N,) 1-sigma of each point's depth from the keyframe's camera, as a fraction
    descriptors: NDArray[np.uint8]  # (N, 32)
    camera_height_m: float
    gnss: Fixed | None = None
    lines: tuple[LinePiece, ...] = ()
    scale: float = 1.0  # metres of the map over those of its odometry

    @property
    def from_camera_m(self) -> Floats:
        """(N, 3) its points from its camera, in the car's axes and metres of the map."""
        return self.scale * (self.points_m - np.array([0.0, 0.0, self.camera_height_m]))

    @property
    def T_map(self) -> Transform:
        """(4, 4) of the car's axes, in which its points are."""
        return body_pose(self.T_map_keyframe, self.attitude, self.camera_height_m)

    def at(self, T_map_keyframe: SE2, cov: Floats | None = None, scale: float | None = None) -> Keyframe:
        """The same, elsewhere in the map: its points move along."""
        cov, scale = self.cov if cov is None else cov, self.scale if scale is None else scale
        return replace(self, T_map_keyframe=T_map_keyframe, cov=cov, scale=scale)


@dataclass(frozen=True)
class Link:
    """A drive's own motion between two keyframes that followed one another, or a place recognised.

    Both are in metres of the odometry of the keyframe that they begin at.
    """

    from_number: int
    to_number: int
    T_from_to: SE2
    cov: Floats  # (3, 3); of a drive's own motion: apart from its scale
    loop: bool = False
    scale_rel: float = 0.0  # 1-sigma of odometry's metres, by its own word; of its own motion
