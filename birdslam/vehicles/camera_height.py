"""The camera's height, pitch and roll over the road by the boxes of many vehicles, of which only the class is known.

The bottom edge of a box falls below the horizon by H / z, its height is h / z: each vehicle's depth z drops out, and

    slope of the bottom = (H / h) * height of the box - pitch + roll * bearing        (all at a depth of 1)

is linear in the camera's height H, its pitch and its roll, with the vehicles' heights h known by class to some per
cent. A vehicle is as wrong in all its boxes, so that it is one sample of H, however long it is followed. Apart from a
known speed this is the only cue that one camera has of how high it stands.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import msgspec
import numpy as np
from numpy.typing import NDArray

from birdslam.geometry.camera import Camera, GroundPlane
from birdslam.types import VehicleEdge
from birdslam.vehicles.localisation import LocalisationConfig, localise

Floats = NDArray[np.float64]
Positive = Annotated[float, msgspec.Meta(gt=0.0)]


class VehicleHeightConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """How much boxes of vehicles say of the camera."""

    sigma_class_rel: Positive = 0.04  # of the mean height of a class on a country's roads, and of a detector's boxes
    sigma_kerb_m: Positive = 0.06  # how far the road under a vehicle lies off the ego's plane
    sigma_bounce_rad: Positive = 0.008  # of the camera's pitch in one frame against its mean
    sigma_pitch_rad: Positive = 0.003  # of the mean: edges of boxes lie alike above the wheels' contact
    sigma_crown_rad: Positive = 0.015  # of the mean roll: all that park on one side stand on the same crown or kerb
    frames_alike: Positive = 5.0  # for so many frames in a row a detector errs alike
    gate_sigma: Positive = 3.0  # a vehicle that misfits by more is left out
    min_vehicles: Annotated[int, msgspec.Meta(ge=2)] = 5


@dataclass(frozen=True)
class Sight:
    """One box of one vehicle in the camera's own axes, level with its optical axis; slopes fall from there."""

    vehicle: int
    slope_bottom: float
    sigma_bottom: float
    tan_height: float
    sigma_height: float
    bearing: float
    height_m: float  # of its class
    sigma_height_rel: float


@dataclass(frozen=True)
class Stand:
    """(height_m, pitch_rad, roll_rad) and their covariance (3, 3), of so many vehicles."""

    state: Floats
    cov: Floats
    vehicles: int


def sights_of(edges: Sequence[VehicleEdge], camera: Camera, config: LocalisationConfig) -> list[Sight]:
    """The boxes of one frame's CV edges against the camera's own axes; cut and hidden edges have wide sigmas."""
    vehicle_of = {edge.box_px: edge.vehicle for edge in edges}
    seen = localise(
        np.array([edge.box_px for edge in edges]).reshape(-1, 4),
        np.array([edge.score for edge in edges]),
        tuple(edge.label for edge in edges),
        camera,
        GroundPlane(camera.height_m),
        config,
    )
    return [
        Sight(
            vehicle=vehicle_of[o.box_px],
            slope_bottom=o.slope_bottom,
            sigma_bottom=o.sigma_bottom,
            tan_height=o.tan_height,
            sigma_height=float(np.hypot(o.sigma_bottom, o.sigma_top)),
            bearing=o.bearing,
            height_m=o.dimensions.height_m,
            sigma_height_rel=o.dimensions.sigma_height_rel,
        )
        for o in seen
    ]


def stand_of(sights: Sequence[Sight], prior: Floats, prior_cov: Floats, config: VehicleHeightConfig) -> Stand | None:
    """Generalised least squares over all sights, joined with a prior of (height, pitch, roll); None where too few fit.

    The height's prior should be vague where its answer is to be a check of it.
    """
    if not sights:
        return None
    table = np.array(
        [[s.vehicle, s.slope_bottom, s.sigma_bottom, s.tan_height, s.sigma_height, s.bearing, s.height_m,
          s.sigma_height_rel] for s in sights]
    )  # fmt: skip
    table = table[np.argsort(table[:, 0], kind="stable")]
    _, first = np.unique(table[:, 0], return_index=True)
    groups = np.split(table, first[1:])
    kept = np.ones(len(groups), bool)
    state = np.array(prior, dtype=np.float64)
    cov = np.array(prior_cov, dtype=np.float64)
    for _ in range(6):
        info, right = np.linalg.inv(prior_cov), np.linalg.solve(prior_cov, prior)
        misfit = np.zeros(len(groups))
        for k, rows in enumerate(groups):
            bottom, sigma_bottom, tall, sigma_tall, bearing, height_m, sigma_rel = rows[:, 1:].T
            looks = tall / height_m  # 1 / z of a vehicle as tall as its class
            J = np.column_stack([looks, -np.ones(len(rows)), bearing])
            r = bottom - J @ state
            own = sigma_bottom**2 + (state[0] / height_m * sigma_tall) ** 2 + config.sigma_bounce_rad**2
            own = own * min(config.frames_alike, len(rows))
            # common to all boxes of the vehicle: its height and the road under it, both in proportion to 1 / z
            common = np.hypot(state[0] * sigma_rel, config.sigma_kerb_m) * looks
            weighed = J / own[:, None]
            of_common = common / own
            share = 1.0 / (1.0 + common @ of_common)  # Sherman-Morrison
            Jc = J.T @ of_common
            if kept[k]:
                info = info + J.T @ weighed - share * np.outer(Jc, Jc)
                right = right + weighed.T @ bottom - share * Jc * (of_common @ bottom)
            misfit[k] = np.median(r) / np.sqrt(np.median(own) / min(len(rows), 4) + np.median(common) ** 2)
        cov = np.linalg.inv(info)
        state = cov @ right
        kept = np.abs(misfit) < config.gate_sigma
        if kept.sum() < config.min_vehicles:
            return None
    cov += np.diag(np.square([state[0] * config.sigma_class_rel, config.sigma_pitch_rad, config.sigma_crown_rad]))
    return Stand(state, 0.5 * (cov + cov.T), int(kept.sum()))
