"""Inference rate of the networks: set at the start from measured run times, reduced under load.

A lower rate prevents late and dropped frames. Vehicles are tracked and predicted between two inferences; ego motion is
measured in every frame. This acts before the modes of degradation.py, which judge the age of estimates, because
dropped frames keep that age low.
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

MIN_RUNS = 3  # timed runs of each network, after a warm-up run
MASKS_SPARING = 2  # at a reduced rate, masks are computed on every n-th inference
FRONT_END_CORES = 1.25  # load of the front end: one core in perceive, a part of another in other nodes


@dataclass(frozen=True)
class Cost:
    """The cost of one run of a network."""

    ms: float
    threads: int
    every: int  # frames between two runs in its schedule
    boxes_ms: float | None = None  # of a run without masks; None if the network has no masks

    def look_ms(self, sparing: int) -> float:
        """Returns the mean time of a run, over runs with and without masks, in ms."""
        if self.boxes_ms is None or sparing == 1:
            return self.ms
        return self.boxes_ms + (self.ms - self.boxes_ms) / MASKS_SPARING


def measure(
    runs: Mapping[str, Callable[[NDArray[np.uint8]], object]], camera: Camera, within_s: float
) -> dict[str, float]:
    """Returns the median run time in ms per network name, on a noise image of the camera's size."""
    shape = (camera.height_px, camera.width_px, 3)
    image = np.random.default_rng(0).integers(0, 255, shape, np.uint8)
    out = {}
    for name, run in runs.items():
        run(image)
        until_s, took_ms = time.monotonic() + within_s / len(runs), list[float]()
        while len(took_ms) < MIN_RUNS or time.monotonic() < until_s:
            start_s = time.perf_counter()
            run(image)
            took_ms.append((time.perf_counter() - start_s) * 1e3)
        out[name] = statistics.median(took_ms)
    return out


def threads_of_a_network(cores: float) -> int:
    """Returns the default thread count of a network; one core remains for the front end."""
    return max(1, int(cores) - 1)


def load(costs: Mapping[str, Cost], period_ms: float, sparing: int) -> float:
    """Returns the load of the networks in cores, if they run `sparing` times less often than scheduled."""
    return sum(cost.look_ms(sparing) * cost.threads / (cost.every * sparing * period_ms) for cost in costs.values())


class LookRate:
    """Controls `sparing`: a network runs on one frame in `every * sparing`. It starts at what the cores sustain."""

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
        self._dropped = 0  # frames that followed dropped ones, since the last change
        self._calm = 0  # consecutive frames
        self._calm_frames = config.calm_frames
        self._tried: int | None = None  # frames since the rate was increased

    def describe(self, costs: Mapping[str, Cost], awaited: Collection[str]) -> str:
        """Returns a log line with the measured run times and the selected rates."""
        parts = [
            f"{name} {cost.look_ms(self.sparing):.0f} ms on {cost.threads} threads, "
            f"every {cost.every * self.sparing} frames, "
            f"{'awaited' if name in awaited else 'not awaited'}"
            for name, cost in costs.items()
        ]
        return f"{self._cores:g} cores, {1e3 / self._period_ms:.3g} Hz: {'; '.join(parts)}"

    @property
    def masks_every(self) -> int:
        """Number of runs per computation of masks, for networks that can omit them."""
        return 1 if self.sparing == 1 else MASKS_SPARING

    def judge(self, step_ms: float, dropped: bool) -> bool:
        """Adds a frame: its processing time, whether frames before it were dropped. Returns if `sparing` changed."""
        config = self._config
        self._steps_ms.append(step_ms)
        self._dropped += dropped
        self._tried = None if self._tried is None else self._tried + 1
        if len(self._steps_ms) < config.window_frames:  # wait until the window covers only frames after the last change
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
