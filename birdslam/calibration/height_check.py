"""Checks of the camera height by independent measurements.

The camera height defines the metric scale, so images alone cannot check it. Known speeds or poses, sizes of vehicles
(road_users/camera_height.py) and widths of lanes (lane_width.py) each give a height with its sigma.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Annotated

import msgspec
import numpy as np
from numpy.typing import NDArray

from birdslam.geometry.camera import Camera
from birdslam.road_users.camera_height import (
    BANK_RAD,
    STATES,
    BoxHeight,
    jacobian,
    marginalise_own_errors,
    own_variance,
)
from birdslam.types import NS_PER_S

VEHICLES, LANES, KNOWN_VEHICLE = "vehicles", "lanes", "known vehicle"  # cues by size
SPEED = "speed"  # cue by a file of speeds
_LAGS_S = np.linspace(0.0, 4.0, 41)  # of a speed behind the images: receivers filter their speed
_MIN_SECTIONS = 2  # for a scatter
_MIN_SIGMA_REL = 1e-3  # of a stated height
_KNOWN_SIGMA_REL = 0.03  # of the height from a vehicle of known size: boxes are a few per cent too large or too small
Floats = NDArray[np.float64]
Positive = Annotated[float, msgspec.Meta(gt=0.0)]
Step = tuple[int, int, float]  # from frame, to frame, length measured by the odometry
KnownLength = Callable[[int, int, int, int], float | None]  # (frames from, to; times from, to in ns) -> metres


class HeightCheckConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Uncertainty of known lengths."""

    section_m: Positive = 8.0  # length over which an estimated length is compared with a known one
    sigma_scale_rel: Positive = 0.015  # of the mean ratio of lengths


class VehicleHeightConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Uncertainty of the camera height from boxes of vehicles."""

    sigma_class_rel: Positive = 0.04  # of the mean height of a class, by country and detector
    sigma_bounce_rad: Positive = 0.008  # of the camera's pitch in a frame around its mean
    sigma_pitch_rad: Positive = 0.003  # of the mean: lower box edges have a common offset from the wheels' contact
    # Of the mean roll: vehicles on one side share the crown, kerb or bank of the road
    sigma_crown_rad: Positive = 0.05
    gate_sigma: Positive = 3.0  # max. residual of a vehicle
    min_vehicles: Annotated[int, msgspec.Meta(ge=2)] = 5


class HeightCheck(msgspec.Struct, frozen=True, kw_only=True):
    """Camera height from objects of known size or speed."""

    cue: str
    height_m: float
    sigma_m: float
    samples: int
    lag_s: float = 0.0  # of a speed behind the images
    lag_sigma_s: float = 0.0  # its 1-sigma


@dataclass(frozen=True)
class Mounting:
    """Camera mounting: (height_m, pitch_rad, roll_rad) with cov (3, 3), and the number of vehicles used."""

    state: Floats
    cov: Floats
    vehicles: int


def checks_by_length(
    lengths: dict[str, KnownLength],
    steps: Sequence[Step],
    times_ns: dict[int, int],
    camera: Camera,
    config: HeightCheckConfig,
) -> list[HeightCheck]:
    """Checks from each of `lengths` that covers enough of the drive."""
    checks = (_by_length(cue, known, steps, times_ns, camera, config) for cue, known in lengths.items())
    return [check for check in checks if check is not None]


def checks_by_vehicles(
    boxes: Sequence[BoxHeight],
    camera: Camera,
    cov: Floats,
    config: VehicleHeightConfig,
    known_height_m: float | None = None,
) -> list[HeightCheck]:
    """Checks from the vehicles of each class, with enough of them, and from the one of known size.

    `cov` (2, 2) of pitch and roll; `known_height_m` is the stated height of the vehicle with the most boxes.
    """
    out = []
    if known_height_m is not None and boxes:
        known, _ = Counter(box.vehicle for box in boxes).most_common(1)[0]
        of_known = [
            replace(box, height_m=known_height_m, sigma_height_rel=_MIN_SIGMA_REL)
            for box in boxes
            if box.vehicle == known
        ]
        boxes = [box for box in boxes if box.vehicle != known]
        alone = msgspec.structs.replace(config, sigma_class_rel=_KNOWN_SIGMA_REL, min_vehicles=1, gate_sigma=math.inf)
        out += _check_by_vehicles(KNOWN_VEHICLE, of_known, camera, cov, alone)
    return out + _check_by_vehicles(VEHICLES, boxes, camera, cov, config)


def _check_by_vehicles(
    cue: str, boxes: Sequence[BoxHeight], camera: Camera, cov: Floats, config: VehicleHeightConfig
) -> list[HeightCheck]:
    prior = np.array([camera.height_m, camera.pitch_rad, camera.roll_rad])
    prior_cov = np.zeros((3, 3))
    prior_cov[0, 0] = (0.5 * camera.height_m) ** 2
    prior_cov[1:, 1:] = cov
    mounting = solve_mounting(boxes, prior, prior_cov, config)
    if mounting is None:
        return []
    sigma_m = float(np.sqrt(mounting.cov[0, 0]))
    return [HeightCheck(cue=cue, height_m=float(mounting.state[0]), sigma_m=sigma_m, samples=mounting.vehicles)]


def solve_mounting(
    boxes: Sequence[BoxHeight], prior: Floats, prior_cov: Floats, config: VehicleHeightConfig
) -> Mounting | None:
    """Generalised least squares over all boxes with a prior of (height, pitch, roll); None with too few inliers.

    For a check of the height its prior should be vague.
    """
    if not boxes:
        return None
    table = np.array(
        [[s.vehicle, s.slope_bottom, s.sigma_bottom, s.tan_height, s.sigma_height, s.bearing, s.height_m,
          s.sigma_height_rel] for s in boxes]
    )  # fmt: skip
    table = table[np.argsort(table[:, 0], kind="stable")]
    _, first = np.unique(table[:, 0], return_index=True)
    groups = np.split(table, first[1:])
    inlier = np.ones(len(groups), bool)
    expected = np.append(prior, np.zeros(STATES - 3))
    of_prior = np.diag(np.full(STATES, BANK_RAD**-2))
    of_prior[:3, :3] = np.linalg.inv(prior_cov)
    state = expected
    for _ in range(6):
        equations = [_of_vehicle(rows, state, config) for rows in groups]
        A, b, own, normalised = (np.array(part) for part in zip(*equations, strict=True))
        information, right = marginalise_own_errors(A, b, own)
        cov = np.linalg.inv(of_prior + information[inlier].sum(axis=0))
        state = cov @ (of_prior @ expected + right[inlier].sum(axis=0))
        inlier = np.abs(normalised) < config.gate_sigma
        if inlier.sum() < config.min_vehicles:
            return None
    # A scatter above the sigmas, as on a hill, widens the covariance (Birge's ratio)
    state, cov = state[:3], cov[:3, :3]
    scatter = float(np.square(normalised[inlier]).sum()) / max(int(inlier.sum()) - len(state), 1)
    cov *= max(1.0, scatter)
    cov += np.diag(np.square([state[0] * config.sigma_class_rel, config.sigma_pitch_rad, config.sigma_crown_rad]))
    return Mounting(state, 0.5 * (cov + cov.T), int(inlier.sum()))


def _of_vehicle(rows: Floats, state: Floats, config: VehicleHeightConfig) -> tuple[Floats, Floats, Floats, float]:
    """Normal equations of a vehicle's boxes, (6, 6) and (6,), its own variances (2,), and its residual in sigmas."""
    bottom, sigma_bottom, tall, sigma_tall, bearing, height_m, sigma_rel = rows[:, 1:].T
    inverse_depth = tall / height_m  # 1 / z of a vehicle with its class's height
    J = jacobian(inverse_depth, bearing)
    variance = sigma_bottom**2 + (state[0] / height_m * sigma_tall) ** 2 + config.sigma_bounce_rad**2
    aside_m = np.median(bearing / inverse_depth)
    (own,) = own_variance(float(state[0]), sigma_rel[:1], np.array([aside_m]))
    residual = float(np.median(bottom - J[:, :STATES] @ state))
    common = np.square(np.median(J[:, [0, -1]], axis=0)) @ own
    sigma = math.sqrt(float(np.median(variance)) + float(common))
    weighted = J / (variance[:, None] * len(rows))  # the boxes of a vehicle have common errors and count as one
    return J.T @ weighted, weighted.T @ bottom, own, residual / sigma


def _by_length(
    cue: str,
    known: KnownLength,
    steps: Sequence[Step],
    times_ns: dict[int, int],
    camera: Camera,
    config: HeightCheckConfig,
) -> HeightCheck | None:
    """All lengths of the odometry are proportional to the camera's height, and so are their errors.

    The lag of a speed is marginalized: its likelihood is that of the scatter of the ratios of lengths.
    """
    sections = _sections(steps, config.section_m)
    lags_s = _LAGS_S if cue == SPEED else np.zeros(1)
    known_m = np.array([[_known_m(known, times_ns, each, lag_s) for each in sections] for lag_s in lags_s])
    # Lags are compared over the same sections: those at lag 0 that the other lags cover, too
    covered = np.isfinite(known_m) & np.isfinite(known_m[0])
    kept = covered.sum(axis=1) >= max(_MIN_SECTIONS, 0.5 * covered[0].sum())
    if not kept[0]:
        return None
    common = covered[kept].all(axis=0)
    estimated_m = np.array([sum(length for *_, length in each) for each in sections])[common]
    log_ratios, lags_s = np.log(np.maximum(known_m[kept][:, common], 1e-3) / estimated_m), lags_s[kept]
    count = len(estimated_m)
    means = np.average(log_ratios, axis=1, weights=estimated_m)
    variances = np.average((log_ratios - means[:, None]) ** 2, axis=1, weights=estimated_m)
    spread = variances + config.sigma_scale_rel**2
    # Neighbouring sections share readings: half of them count
    likelihood = np.power(spread.min() / spread, 0.25 * count)
    weight = likelihood / likelihood.sum()
    mean, lag_s = float(weight @ means), float(weight @ lags_s)
    var = float(weight @ (variances / (count - 1) + (means - mean) ** 2)) + config.sigma_scale_rel**2
    height_m = camera.height_m * math.exp(mean)
    return HeightCheck(
        cue=cue,
        height_m=height_m,
        sigma_m=height_m * math.sqrt(var),
        samples=count,
        lag_s=lag_s,
        lag_sigma_s=math.sqrt(float(weight @ (lags_s - lag_s) ** 2)),
    )


def _sections(steps: Sequence[Step], section_m: float) -> list[list[Step]]:
    """Consecutive steps of more than `section_m` together; without an incomplete last section."""
    out, section, estimated_m = [], list[Step](), 0.0
    for step in steps:
        section.append(step)
        estimated_m += step[2]
        if estimated_m > section_m:
            out.append(section)
            section, estimated_m = [], 0.0
    return out


def _known_m(known: KnownLength, times_ns: dict[int, int], section: Sequence[Step], lag_s: float) -> float:
    """Known length of a section if readings are `lag_s` late; NaN if it is not known for each step."""
    lag_ns = round(lag_s * NS_PER_S)
    each = [known(start, end, times_ns[start] + lag_ns, times_ns[end] + lag_ns) for start, end, _ in section]
    return sum(math.nan if length is None else length for length in each)
