"""The plausibility gate: whether the ego's measured motions are those of a car.

Images out of order, or replayed, give motions that no car makes. After such a motion, or after a long time without a
measured one, the estimate is invalid until the odometry has been steady for a while. Then the CC edge is left out, so
that the graph begins a new epoch, since the motion in between is unknown.
"""

from __future__ import annotations

from collections import deque
from typing import Annotated, NamedTuple

import msgspec

from birdslam.types import EgoEdge, Measurements, SpeedSource, Status

Positive = Annotated[float, msgspec.Meta(gt=0.0)]
_MAX_FRAMES = 64
_MIN_STEP_S = 1e-3
_CLOCK_TOLERANCE = 0.1  # of a span


class PlausibilityConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """How fast a car's speed may change, and how long the odometry must be steady to be valid again."""

    acceleration_mps2: Positive = 15.0  # no car changes its speed faster
    change_mps: Positive = 3.0  # beside acceleration_mps2, for the noise of the motions within span_s
    span_s: Positive = 0.1  # over which a speed is averaged: one motion at 33 Hz is three times as noisy as at 10
    sigmas: Positive = 3.0  # beside both: of the metric scale
    blind_s: Positive = 0.5  # of source time without a measured motion: after it the car's place is unknown
    steady_s: Positive = 0.5  # of source time, in which every motion is measured and plausible


class _Step(NamedTuple):
    t_ns: int  # source time of its end
    dt_s: float
    x_m: float  # forwards
    scale_sigma_rel: float


class PlausibilityGate:
    """State, measurements and readers:

    - State: the last measured motions (m forwards, s), and the source time of the last one that was not plausible.
    - Measurements: each frame's CC edge, through `admit`, in the order of the frames.
    - Readers: `FrontEnd.measure`, whose records pass through it last; by MOTION_IMPLAUSIBLE the planner.
    """

    def __init__(self, config: PlausibilityConfig) -> None:
        self._config = config
        self._times_ns: deque[tuple[int, int]] = deque(maxlen=_MAX_FRAMES)  # (frame, source time)
        self._steps: deque[_Step] = deque(maxlen=_MAX_FRAMES)  # the measured ones
        self._turn_known_ns = 0  # source time of the last frame with a measured turn
        self._implausible_ns: int | None = None  # source time of the last motion that was not measured or not plausible

    def admit(self, measurements: Measurements) -> Measurements:
        """The measurements as they are, or with MOTION_IMPLAUSIBLE, or, to begin a new epoch, without the CC edge."""
        m, cc = measurements, measurements.cc
        self._times_ns.append((m.frame_id, m.t_source_ns))
        coasting = Status.ODOMETRY_COASTING in m.status
        by_car = coasting and SpeedSource.CAR in m.speed_sources  # its distance is measured, its turn is not
        step = None if cc is None or (coasting and not by_car) else self._step_of(m, cc)
        if not by_car:
            self._turn_known_ns = m.t_source_ns
        if step is not None:
            self._steps.append(step)
            if not self._is_plausible():
                self._implausible_ns = m.t_source_ns
        elif self._steps and (m.t_source_ns - self._steps[-1].t_ns) * 1e-9 > self._config.blind_s:
            self._implausible_ns = m.t_source_ns
        if self._implausible_ns is None and (m.t_source_ns - self._turn_known_ns) * 1e-9 <= self._config.blind_s:
            return m
        if self._implausible_ns is None:
            return msgspec.structs.replace(m, status=(*m.status, Status.MOTION_IMPLAUSIBLE))
        if step is None:
            self._implausible_ns = m.t_source_ns
        if (m.t_source_ns - self._implausible_ns) * 1e-9 >= self._config.steady_s:
            self._implausible_ns = None
            return msgspec.structs.replace(m, cc=None)
        return msgspec.structs.replace(m, status=(*m.status, Status.MOTION_IMPLAUSIBLE))

    def _step_of(self, m: Measurements, cc: EgoEdge) -> _Step | None:
        """The motion of the edge; None where its first frame is too long ago."""
        times_ns = dict(self._times_ns)
        if cc.from_frame not in times_ns or cc.to_frame not in times_ns:
            return None
        dt_s = (times_ns[cc.to_frame] - times_ns[cc.from_frame]) * 1e-9
        return _Step(m.t_source_ns, dt_s, cc.T_from_to.x_m, m.scale_sigma_rel) if dt_s > _MIN_STEP_S else None

    def _is_plausible(self) -> bool:
        """Whether the change of speed between the last two spans of span_s is plausible for a car."""
        config, steps = self._config, list(self._steps)
        now, before = _last_span(steps, config.span_s)
        then, _ = _last_span(before, config.span_s)
        if not then:
            return True
        now_mps, then_mps = _speed_mps(now), _speed_mps(then)
        sigma = max(entry.scale_sigma_rel for entry in (*now, *then))
        scale = config.sigmas * sigma * max(abs(now_mps), abs(then_mps))
        passed_s = max(now[-1].t_ns - then[-1].t_ns, 0) * 1e-9
        return abs(now_mps - then_mps) <= config.change_mps + config.acceleration_mps2 * passed_s + scale


def _last_span(steps: list[_Step], span_s: float) -> tuple[list[_Step], list[_Step]]:
    """The last motions, together at least `span_s` long if there are enough, and those before them."""
    total_s, k = 0.0, len(steps)
    while k and total_s < (1.0 - _CLOCK_TOLERANCE) * span_s:
        k -= 1
        total_s += steps[k].dt_s
    return steps[k:], steps[:k]


def _speed_mps(steps: list[_Step]) -> float:
    return sum(entry.x_m for entry in steps) / sum(entry.dt_s for entry in steps)
