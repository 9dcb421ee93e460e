"""Simulates other rounding of a processor: tracked corners move by up to a ten-thousandth of a pixel.

With BIRDSLAM_ROUNDING=SEED in the environment every test runs so. A test whose result depends on the last digits fails
under some seed; kernels of other processors differ by no more (`make test-cpus`).
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np

AMPLITUDE_PX = 1e-4  # float32 resolves 6e-5 px at 1000 px


def perturb_tracks(seed: int) -> None:
    """Replaces OpenCV's optical flow by one with seeded noise, the same in each process and at each call."""
    track = cv2.calcOpticalFlowPyrLK

    def perturbed(previous: Any, current: Any, px: Any, *arguments: Any, **options: Any) -> Any:
        found, *rest = track(previous, current, px, *arguments, **options)
        if found is not None:
            rng = np.random.default_rng((seed, len(found)))
            found = found + rng.uniform(-AMPLITUDE_PX, AMPLITUDE_PX, found.shape).astype(found.dtype)
        return found, *rest

    cv2.calcOpticalFlowPyrLK = perturbed
