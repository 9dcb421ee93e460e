"""A check of the camera's height by what is known from elsewhere.

The metric scale of one camera is its height: nothing in the images alone can tell whether that is right. What can is a
speed or poses of the recording, or what vehicles measure; each says what it makes of the height, and how sure it is.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Annotated

import msgspec
import numpy as np
from numpy.typing import NDArray

from birdslam.geometry.camera import Camera
from birdslam.vehicles.camera_height import Sight, VehicleHeightConfig, stand_of

Floats = NDArray[np.float64]
Positive = Annotated[float, msgspec.Meta(gt=0.0)]
Step = tuple[int, int, float]  # from frame, to frame, length as the odometry measured it
KnownLength = Callable[[int, int, int, int], float | None]  # (frames from, to; times from, to in ns) -> metres


class HeightCheckConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What is believed of known lengths."""

    section_m: Positive = 8.0  # over which an estimated length is compared with a known one
    sigma_scale_rel: Positive = 0.015  # of the mean ratio of lengths


class HeightCheck(msgspec.Struct, frozen=True, kw_only=True):
    """The camera's height as something of known size or speed has it."""

    cue: str
    height_m: float
    sigma_m: float
    samples: int


def checks_by_length(
    lengths: dict[str, KnownLength],
    steps: Sequence[Step],
    times_ns: dict[int, int],
    camera: Camera,
    config: HeightCheckConfig,
) -> list[HeightCheck]:
    """By each of `lengths` that covers enough of the way."""
    checks = (_by_length(cue, known, steps, times_ns, camera, config) for cue, known in lengths.items())
    return [check for check in checks if check is not None]


def checks_by_vehicles(
    sights: Sequence[Sight], camera: Camera, cov: Floats, config: VehicleHeightConfig
) -> list[HeightCheck]:
    """One, or none where too few vehicles were seen; `cov` (2, 2) is of the camera's pitch and roll."""
    prior = np.array([camera.height_m, camera.pitch_rad, camera.roll_rad])
    prior_cov = np.zeros((3, 3))
    prior_cov[0, 0] = (0.5 * camera.height_m) ** 2
    prior_cov[1:, 1:] = cov
    stand = stand_of(sights, prior, prior_cov, config)
    if stand is None:
        return []
    sigma_m = float(np.sqrt(stand.cov[0, 0]))
    return [HeightCheck(cue="vehicles", height_m=float(stand.state[0]), sigma_m=sigma_m, samples=stand.vehicles)]


def _by_length(
    cue: str,
    known: KnownLength,
    steps: Sequence[Step],
    times_ns: dict[int, int],
    camera: Camera,
    config: HeightCheckConfig,
) -> HeightCheck | None:
    """All lengths of the odometry are in proportion to the camera's height: so is the error of both."""
    ratios, weights = [], []
    estimated_m = true_m = 0.0
    for start, end, length in steps:
        truth = known(start, end, times_ns[start], times_ns[end])
        if truth is None:
            continue
        estimated_m, true_m = estimated_m + length, true_m + truth
        if estimated_m > config.section_m:
            ratios.append(np.log(max(true_m, 1e-3) / estimated_m))
            weights.append(estimated_m)
            estimated_m = true_m = 0.0
    if len(ratios) < 2:
        return None
    mean = float(np.average(ratios, weights=weights))
    scatter = float(np.sqrt(np.average((np.array(ratios) - mean) ** 2, weights=weights) / (len(ratios) - 1)))
    sigma_rel = float(np.hypot(scatter, config.sigma_scale_rel))
    height_m = camera.height_m * float(np.exp(mean))
    return HeightCheck(cue=cue, height_m=height_m, sigma_m=height_m * sigma_rel, samples=len(ratios))
