"""Cameras and an in-memory recording for tests of sources and nodes."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from birdslam.geometry.camera import Camera
from birdslam.sources.recording import RecordedFrame, Recording

SMALL = Camera(64, 32, 50.0, 50.0, 32.0, 16.0, 1.5)
KITTI = Camera(1242, 375, 721.5, 721.5, 609.6, 172.9, 1.65)
PERIOD_NS = 100_000_000


class Frames(Recording):
    """`count` frames at 10 Hz, each with its number as grey level; those in `torn` are unreadable."""

    name, camera, rate_hz = "drive", SMALL, 10.0

    def __init__(self, count: int, torn: frozenset[int] = frozenset()) -> None:
        self._count, self._torn = count, torn

    def __len__(self) -> int:
        return self._count

    def frames(self, start: int = 0) -> Iterator[RecordedFrame]:
        for index in range(start, self._count):
            image = None if index in self._torn else np.full((32, 64), index, dtype=np.uint8)
            yield RecordedFrame(index, index * PERIOD_NS, image, "torn" if image is None else None)
