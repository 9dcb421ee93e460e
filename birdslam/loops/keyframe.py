"""A keyframe: a pose in the map with triangulated points and the lane lines beside it."""

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
    """The position of a keyframe by its nearest GNSS fix, moved there along the trajectory."""

    latitude_deg: float
    longitude_deg: float
    sigma_m: float  # 1-sigma of the fix
    weighed_m: float  # 1-sigma with the error shared with neighbouring fixes


@dataclass(frozen=True, eq=False)
class LinePiece:
    """A lane line beside a keyframe, in its ego frame."""

    drive: int  # that saw it
    line: int  # its number in that drive
    kind: LineKind
    colour: LineColour
    points_m: Floats  # (N, 2)
    sigma_m: float  # 1-sigma across it, against the ego that saw it

    def seen_from(self, T_other_keyframe: SE2) -> LinePiece:
        """Returns the line in another keyframe's frame."""
        return replace(self, points_m=T_other_keyframe @ self.points_m)


@dataclass(frozen=True, eq=False)
class Keyframe:
    """Points are in the keyframe's ego frame: x forward, y left, z up, from the camera's foot on the road.

    They are in metres of its drive's odometry; `scale` converts them to map metres, about the camera.
    """

    number: int  # unique in its map
    drive: int  # its drive; 0 created the map
    t_source_ns: int
    T_map_keyframe: SE2
    cov: Floats  # (3, 3) of T_map_keyframe, of the tangent at the pose; of a georeferenced map relative to Earth
    attitude: Attitude
    points_m: Floats  # (N, 3)
    sigma_depth_rel: Floats  # (N,) 1-sigma of each point's depth from the keyframe's camera, as a fraction
    descriptors: NDArray[np.uint8]  # (N, 32)
    camera_height_m: float
    gnss: Fixed | None = None
    lines: tuple[LinePiece, ...] = ()
    scale: float = 1.0  # map metres over odometry metres

    @property
    def from_camera_m(self) -> Floats:
        """Points (N, 3) relative to the camera, in the car's axes and map metres."""
        return self.scale * (self.points_m - np.array([0.0, 0.0, self.camera_height_m]))

    @property
    def T_map(self) -> Transform:
        """Pose (4, 4) of the car's axes, in which the points are."""
        return body_pose(self.T_map_keyframe, self.attitude, self.camera_height_m)

    def at(self, T_map_keyframe: SE2, cov: Floats | None = None, scale: float | None = None) -> Keyframe:
        """Returns the keyframe at another pose."""
        cov, scale = self.cov if cov is None else cov, self.scale if scale is None else scale
        return replace(self, T_map_keyframe=T_map_keyframe, cov=cov, scale=scale)


@dataclass(frozen=True)
class Link:
    """Odometry between consecutive keyframes, or a loop, in odometry metres of the first keyframe."""

    from_number: int
    to_number: int
    T_from_to: SE2
    cov: Floats  # (3, 3); of odometry without its scale error
    loop: bool = False
    scale_rel: float = 0.0  # odometry's 1-sigma of its scale
