"""Timed poses of one body, as in a trajectory file."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from birdslam.geometry.arrays import Floats, Ints
from birdslam.geometry.pose import Pose


@dataclass(frozen=True)
class TimedPoses:
    """`poses` (N, 4, 4) in a world of their own, metres, at `t_ns` (N,), growing; None: one a frame, from 0 on."""

    poses: Floats
    t_ns: Ints | None

    def at(self, frame_id: int, t_ns: int, longest_gap_ns: int) -> Pose | None:
        """The pose of a frame at a time, interpolated over `longest_gap_ns` at the most; None where there is none."""
        if self.t_ns is None:
            return _pose(self.poses[frame_id]) if 0 <= frame_id < len(self.poses) else None
        after = int(np.searchsorted(self.t_ns, t_ns))
        if after < len(self.t_ns) and self.t_ns[after] == t_ns:
            return _pose(self.poses[after])
        if not 0 < after < len(self.t_ns):
            return None
        begin, end = int(self.t_ns[after - 1]), int(self.t_ns[after])
        if end - begin > longest_gap_ns:
            return None
        from scipy.spatial.transform import Rotation, Slerp  # here: few processes that import geometry turn poses

        share = (t_ns - begin) / (end - begin)
        before, behind = self.poses[after - 1], self.poses[after]
        R = Slerp([0.0, 1.0], Rotation.from_matrix([before[:3, :3], behind[:3, :3]]))(share).as_matrix()
        return Pose(R, (1.0 - share) * before[:3, 3] + share * behind[:3, 3])


def _pose(T: Floats) -> Pose:
    return Pose(T[:3, :3], T[:3, 3])
