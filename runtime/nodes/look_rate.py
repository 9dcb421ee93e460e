"""How often the networks look: what this computer carries, measured at the start, and less of it under load.

A frame that comes while perceive is still at the one before waits, and is only predicted if a next one comes. So before
frames are late, the networks look at fewer of them: vehicles are followed and predicted between two looks, and the
ego's motion is measured in every frame. This goes before the modes of degradation.py, which judge the age of what goes
out: frames that are left out keep that low.
"""

from __future__ import annotations

import statistics
import time
from collections import deque
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from birdslam.geometry.camera import Camera
from birdslam.runtime.configuration import LooksConfig

MIN_RUNS = 3  # of a network that is measured; its first is not counted
MASKS_SPARING = 2  # looks that are spared are for boxes; masks, which change more slowly, come with one in so many
FRONT_END_CORES = 1.25  # what the frames themselves keep busy: one core in perceive, a part of another elsewhere


@dataclass(frozen=True)
class Cost:
    """Of one run of a network."""

    ms: float
    threads: int
    every: int  # as its schedule has it
    boxes_ms: float | None = None  # of a run without masks; None: it has none

    def look_ms(self, sparing: int) -> float:
        """Of a run, the mean of those with masks and of those without."""
        if self.boxes_ms is None or sparing == 1:
            return self.ms
        return self.boxes_ms + (self.ms - self.boxes_ms) / MASKS_SPARING


def measure(
    runs: Mapping[str, Callable[[NDArray[np.uint8]], object]], camera: Camera, within_s: float
) -> dict[str, float]:
    """Name -> ms that one run takes, the median, on an image of noise of the camera's size."""
    shape = (camera.height_px, camera.width_px, 3)
    image = np.random.default_rng(0).integers(0, 255, shape, np.uint8)
    out = {}
    for name, run in runs.items():
        run(image)
        until_s, took_ms = time.monotonic() + within_s / len(runs), list[float]()
        while len(took_ms) < MIN_RUNS or time.monotonic() < until_s:
            begun_s = time.perf_counter()
            run(image)
            took_ms.append((time.perf_counter() - begun_s) * 1e3)
        out[name] = statistics.median(took_ms)
    return out


def threads_of_a_network(cores: float) -> int:
    """The most that one network gets, where the user does not say: a core is left to the frames."""
    return max(1, int(cores) - 1)


def load(costs: Mapping[str, Cost], period_ms: float, sparing: int) -> float:
    """Cores that networks keep busy which look `sparing` times less often than their schedules say."""
    return sum(cost.look_ms(sparing) * cost.threads / (cost.every * sparing * period_ms) for cost in costs.values())


class LookRate:
    """`sparing`: the networks look on one frame in `every * sparing`. It begins at what the cores at hand carry."""

    def __init__(self, config: LooksConfig, costs: Mapping[str, Cost], cores: float, period_ms: float) -> None:
        self._config, self._period_ms, self._cores = config, period_ms, cores
        often = min((cost.every for cost in costs.values()), default=1)
        most = max(1, int(1e3 / (period_ms * often * config.least_hz)))
        slight = (n for n in range(1, most) if load(costs, period_ms, n) <= config.slight_load)
        self.most = next(slight, most)
        room = config.room_share * max(cores - FRONT_END_CORES, 0.25)
        fits = (n for n in range(1, self.most + 1) if load(costs, period_ms, n) <= room)
        self.sparing = next(fits, self.most)
        self._steps_ms: deque[float] = deque(maxlen=config.window_frames)
        self._dropped = 0  # frames since the last change before which some were
        self._calm = 0  # frames in a row
        self._calm_frames = config.calm_frames
        self._tried: int | None = None  # frames since they looked more often

    def describe(self, costs: Mapping[str, Cost], awaited: Collection[str]) -> str:
        """One line for the log: what was measured and chosen."""
        parts = [
            f"{name} {cost.look_ms(self.sparing):.0f} ms on {cost.threads} threads, "
            f"every {cost.every * self.sparing} frames, "
            f"{'awaited' if name in awaited else 'not awaited'}"
            for name, cost in costs.items()
        ]
        return f"{self._cores:g} cores, {1e3 / self._period_ms:.3g} Hz: {'; '.join(parts)}"

    @property
    def masks_every(self) -> int:
        """A network that can leave its masks out computes them on every n-th run."""
        return 1 if self.sparing == 1 else MASKS_SPARING

    def judge(self, step_ms: float, dropped: bool) -> bool:
        """One frame more, which took perceive `step_ms`; `dropped`: some before it were. Whether `sparing` changed."""
        config = self._config
        self._steps_ms.append(step_ms)
        self._dropped += dropped
        self._tried = None if self._tried is None else self._tried + 1
        if len(self._steps_ms) < config.window_frames:  # a change shows first in the frames after it
            return False
        mean_ms = statistics.fmean(self._steps_ms)
        if self._dropped or mean_ms > config.busy_share * self._period_ms:
            return self._look_less()
        self._calm = self._calm + 1 if mean_ms < config.calm_share * self._period_ms else 0
        return self._calm >= self._calm_frames and self._look_more()

    def _look_less(self) -> bool:
        self._calm = self._dropped = 0
        if self.sparing == self.most:
            return False
        failed = self._tried is not None and self._tried <= self._calm_frames
        longer = min(2 * self._calm_frames, self._config.most_calm_frames)
        self._calm_frames = longer if failed else self._config.calm_frames
        return self._change(self.sparing + 1, None)

    def _look_more(self) -> bool:
        return self.sparing > 1 and self._change(self.sparing - 1, 0)

    def _change(self, sparing: int, tried: int | None) -> bool:
        self.sparing, self._tried, self._calm, self._dropped = sparing, tried, 0, 0
        self._steps_ms.clear()
        return True
