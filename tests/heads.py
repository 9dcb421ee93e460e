"""Fake networks for tests of schedules and results."""

from __future__ import annotations

from typing import Any

import numpy as np

from birdslam.perception import Detections, Findings, Segmentation
from birdslam.perception.manifest import Schedule

NOTHING = Detections(np.zeros((0, 4)), np.zeros(0), ())


class Head:
    """Answers at once: `found`, or what its role finds where there is nothing. `frames`: each image's first pixel."""

    fell_back = ""  # its provider is the CPU

    def __init__(self, role: Any, found: Findings | None = None, **schedule: Any) -> None:
        self.name = self.role = role
        self.found, self.schedule = found, Schedule(**schedule)
        self.frames: list[int] = []

    @property
    def runs(self) -> int:
        """How often it has run."""
        return len(self.frames)

    def run(self, image: np.ndarray) -> Findings:
        self.frames.append(int(image.flat[0]))
        return self.answer(image)

    def answer(self, image: np.ndarray) -> Findings:
        """Findings for an image."""
        if self.found is not None:
            return self.found
        if self.role == "detector":
            return Findings(detections=NOTHING)
        return Findings(segmentation=Segmentation(image > 0, image > 0))
