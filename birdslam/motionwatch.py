"""Whether the ego's measured motions are those of a car: images that came out of order or were replayed give others.

A motion that no car makes is not believed, nor what comes after it, or after a long blindness, until the odometry has
been steady again; then the world begins anew, since how far the car has come meanwhile is not known.
"""

from __future__ import annotations

from collections import deque
from typing import Annotated

import msgspec

from birdslam.types import EgoEdge, Measurements, Status

Positive = Annotated[float, msgspec.Meta(gt=0.0)]
_KEPT_FRAMES = 64
_SHORTEST_S = 1e-3


class MotionWatchConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """How fast a car's speed may change, and how long the odometry must be steady to be believed again."""

    acceleration_mps2: Positive = 15.0
    change_mps: Positive = 3.0  # beside it, for the noise of a single motion
    sigmas: Positive = 3.0  # beside both, of the metric scale
    blind_s: Positive = 0.5  # of source time without a measured motion: where the car is by then is not known
    steady_s: Positive = 0.5  # of source time, in which every motion is measured and possible


class MotionWatch:
    """`judge` takes the measurements of each frame in their order."""

    def __init__(self, config: MotionWatchConfig) -> None:
        self._config = config
        self._times_ns: deque[tuple[int, int]] = deque(maxlen=_KEPT_FRAMES)  # (frame, source time)
        self._last: tuple[int, float, float] | None = None  # source time, speed (m/s), 1-sigma of the scale
        self._broken_ns: int | None = None  # source time of the last motion that was not measured or not possible

    def judge(self, measurements: Measurements) -> Measurements:
        """The same; with MOTION_IMPLAUSIBLE; or, where it can be believed again, without its CC edge."""
        m, cc = measurements, measurements.cc
        self._times_ns.append((m.frame_id, m.t_source_ns))
        speed_mps = None if cc is None or Status.ODOMETRY_COASTING in m.status else self._speed_mps(cc)
        if speed_mps is not None and not self._possible(m, speed_mps):
            self._broken_ns = m.t_source_ns
        if speed_mps is None and self._last is not None:
            blind = (m.t_source_ns - self._last[0]) * 1e-9 > self._config.blind_s
            self._broken_ns = m.t_source_ns if blind else self._broken_ns
        if speed_mps is not None:
            self._last = m.t_source_ns, speed_mps, m.scale_sigma_rel
        if self._broken_ns is None:
            return m
        if speed_mps is None:
            self._broken_ns = m.t_source_ns
        if (m.t_source_ns - self._broken_ns) * 1e-9 >= self._config.steady_s:
            self._broken_ns = None
            return msgspec.structs.replace(m, cc=None)
        return msgspec.structs.replace(m, status=(*m.status, Status.MOTION_IMPLAUSIBLE))

    def _speed_mps(self, cc: EgoEdge) -> float | None:
        """Forwards, over the edge; None where its beginning is too long ago."""
        times_ns = dict(self._times_ns)
        if cc.from_frame not in times_ns or cc.to_frame not in times_ns:
            return None
        dt_s = (times_ns[cc.to_frame] - times_ns[cc.from_frame]) * 1e-9
        return cc.T_from_to.x_m / dt_s if dt_s > _SHORTEST_S else None

    def _possible(self, m: Measurements, speed_mps: float) -> bool:
        if self._last is None:
            return True
        config, (t_ns, last_mps, last_sigma) = self._config, self._last
        scale = config.sigmas * max(m.scale_sigma_rel, last_sigma) * max(abs(speed_mps), abs(last_mps))
        limit_mps = config.change_mps + config.acceleration_mps2 * max(m.t_source_ns - t_ns, 0) * 1e-9 + scale
        return abs(speed_mps - last_mps) <= limit_mps
