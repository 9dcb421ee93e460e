"""Poses of one body with time stamps, as in a trajectory file."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from birdslam.geometry.arrays import Floats, Ints
from birdslam.geometry.pose import Pose


@dataclass(frozen=True)
class TimedPoses:
    """`poses` (N, 4, 4) in metres in an arbitrary world frame at `t_ns` (N,) ascending; None: one per frame from 0."""

    poses: Floats
    t_ns: Ints | None

    def at(self, frame_id: int, t_ns: int, max_gap_ns: int) -> Pose | None:
        """The pose of a frame at a time, interpolated over at most `max_gap_ns`; None if there is none."""
        if self.t_ns is None:
            return _pose(self.poses[frame_id]) if 0 <= frame_id < len(self.poses) else None
        after = int(np.searchsorted(self.t_ns, t_ns))
        if after < len(self.t_ns) and self.t_ns[after] == t_ns:
            return _pose(self.poses[after])
        if not 0 < after < len(self.t_ns):
            return None
        begin, end = int(self.t_ns[after - 1]), int(self.t_ns[after])
        if end - begin > max_gap_ns:
            return None
        from scipy.spatial.transform import Rotation, Slerp  # lazy: few processes that import geometry need scipy

        fraction = (t_ns - begin) / (end - begin)
        earlier, later = self.poses[after - 1], self.poses[after]
        R = Slerp([0.0, 1.0], Rotation.from_matrix([earlier[:3, :3], later[:3, :3]]))(fraction).as_matrix()
        return Pose(R, (1.0 - fraction) * earlier[:3, 3] + fraction * later[:3, 3])


def _pose(T: Floats) -> Pose:
    return Pose(T[:3, :3], T[:3, 3])
