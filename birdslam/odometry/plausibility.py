"""Plausibility gate: rejects ego-motions that a car cannot make, as from images out of order or replayed.

After an implausible motion, or after a long time without a measured one, the estimate is invalid until the odometry has
been steady for a while. Then the CC edge is omitted, so that the graph starts a new epoch.
"""

from __future__ import annotations

from collections import deque
from typing import Annotated, NamedTuple

import msgspec

from birdslam.types import EgoEdge, Measurements, SpeedSource, Status

Positive = Annotated[float, msgspec.Meta(gt=0.0)]
_MAX_FRAMES = 64
_MIN_STEP_S = 1e-3
_CLOCK_TOLERANCE_RATIO = 0.1  # of span_s


class PlausibilityConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Limits of the change of a car's speed, and the steady time after which the odometry is valid again."""

    acceleration_mps2: Positive = 15.0  # maximum acceleration of a car
    change_mps: Positive = 3.0  # allowance for the noise of the speed over span_s
    span_s: Positive = 0.1  # averaging time of a speed, since single motions at high frame rates are noisy
    sigmas: Positive = 3.0  # allowance for the uncertainty of the metric scale
    blind_s: Positive = 0.5  # source time without a measured motion after which the pose is unknown
    steady_s: Positive = 0.5  # source time with plausible measured motions until the estimate is valid again


class _Step(NamedTuple):
    t_ns: int  # source time of the end
    dt_s: float
    x_m: float  # forward
    scale_sigma_rel: float


class PlausibilityGate:
    """State, measurements and readers:

    - State: the last measured motions (m forward, s), and the source time of the last implausible one.
    - Measurements: each frame's CC edge, through `admit`, in the order of the frames.
    - Readers: `FrontEnd.measure`, as its last stage; the planner, through MOTION_IMPLAUSIBLE.
    """

    def __init__(self, config: PlausibilityConfig) -> None:
        self._config = config
        self._times_ns: deque[tuple[int, int]] = deque(maxlen=_MAX_FRAMES)  # (frame, source time)
        self._steps: deque[_Step] = deque(maxlen=_MAX_FRAMES)  # measured motions
        self._rotation_measured_ns = 0  # source time of the last frame with a measured rotation
        self._implausible_ns: int | None = None  # source time of the last unmeasured or implausible motion

    def admit(self, measurements: Measurements) -> Measurements:
        """Returns the measurements unchanged, with MOTION_IMPLAUSIBLE, or, to start a new epoch, without CC edge."""
        m, cc = measurements, measurements.cc
        self._times_ns.append((m.frame_id, m.t_source_ns))
        coasting = Status.ODOMETRY_COASTING in m.status
        is_by_car = coasting and SpeedSource.CAR in m.speed_sources  # the distance is measured, the rotation is not
        step = None if cc is None or (coasting and not is_by_car) else self._step_of(m, cc)
        if not is_by_car:
            self._rotation_measured_ns = m.t_source_ns
        if step is not None:
            self._steps.append(step)
            if not self._is_plausible():
                self._implausible_ns = m.t_source_ns
        elif self._steps and (m.t_source_ns - self._steps[-1].t_ns) * 1e-9 > self._config.blind_s:
            self._implausible_ns = m.t_source_ns
        if self._implausible_ns is None and (m.t_source_ns - self._rotation_measured_ns) * 1e-9 <= self._config.blind_s:
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
        """The motion of the edge; None if its start frame is too old."""
        times_ns = dict(self._times_ns)
        if cc.from_frame not in times_ns or cc.to_frame not in times_ns:
            return None
        dt_s = (times_ns[cc.to_frame] - times_ns[cc.from_frame]) * 1e-9
        return _Step(m.t_source_ns, dt_s, cc.T_from_to.x_m, m.scale_sigma_rel) if dt_s > _MIN_STEP_S else None

    def _is_plausible(self) -> bool:
        """Whether the change of speed between the last two averaging spans is plausible for a car."""
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
    """The last motions that cover at least `span_s`, if there are enough, and the earlier ones."""
    total_s, k = 0.0, len(steps)
    while k and total_s < (1.0 - _CLOCK_TOLERANCE_RATIO) * span_s:
        k -= 1
        total_s += steps[k].dt_s
    return steps[k:], steps[:k]


def _speed_mps(steps: list[_Step]) -> float:
    return sum(entry.x_m for entry in steps) / sum(entry.dt_s for entry in steps)
