"""Fit of a vehicle's footprint to the pseudo-lidar in its box, without a network.

The pseudo-lidar gives the depth of the visible surface per column of the box. It is compared with the surface of a
footprint of the class's size at each yaw of a fan. The likelihoods give centre, yaw and their covariance.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from birdslam.geometry.camera import Camera, GroundPlane
from birdslam.perception import DepthMap
from birdslam.road_users.placement.depth_fusion import DepthPlace, PseudoLidarConfig, lateral_variance
from birdslam.road_users.placement.localisation import CENTRE_STEPS, Observation, line_of_sight_cov

Floats = NDArray[np.float64]


def fit_footprint(
    seen: Observation, depth: DepthMap, camera: Camera, ground: GroundPlane, config: PseudoLidarConfig
) -> DepthPlace | None:
    """Fits the class's footprint to the visible surface; `depth` in metres. None if there are too few columns."""
    profile = visible_surface(seen, depth, camera, ground, config)
    if profile is None:
        return None
    bearings, x_m = profile
    middle_m = float(np.median(x_m))
    if not 0.0 < middle_m <= config.max_range_m:
        return None
    yaws: Floats = np.arange(config.yaws, dtype=np.float64) * (math.pi / config.yaws) - math.pi / 2.0
    corners = footprints(seen, yaws)
    centres, squared_error = _fit_centres(seen, corners, bearings, x_m, middle_m, config)
    sigma_m = math.hypot(config.sigma_shape_rel * middle_m, config.sigma_shape_m)
    log_weight = -0.5 * squared_error / sigma_m**2 * min(config.independent_columns, len(x_m))
    log_weight -= 0.5 * _width_error(seen, corners, centres, depth.sigma_rel)
    weight = np.exp(log_weight - log_weight.max())
    weight /= weight.sum()
    centre = weight @ centres
    spread = (centres - centre).T * weight @ (centres - centre)
    axis = complex(weight @ np.exp(2j * yaws))
    return DepthPlace(
        centre,
        spread + _centre_cov(seen, centre, depth.sigma_rel, sigma_m),
        math.atan2(axis.imag, axis.real) / 2.0,
        _sigma_of_axis(abs(axis), math.pi / config.yaws),
    )


def visible_surface(
    seen: Observation, depth: DepthMap, camera: Camera, ground: GroundPlane, config: PseudoLidarConfig
) -> tuple[Floats, Floats] | None:
    """Bearings (y / x) and x_m (C,) in ego of the surface in the columns of a box, medians over its rows."""
    x1, y1, x2, y2 = seen.box_px
    band = (x1, y1 + config.top_rel * (y2 - y1), x2, y1 + config.bottom_rel * (y2 - y1))
    rows, columns = depth.cells(band)
    count, width = rows.stop - rows.start, columns.stop - columns.start
    if count < 1 or width < config.least_columns:
        return None
    points = depth.points_cam_m(camera, rows, columns) @ ground.R_ego_cam.T
    ahead = points[:, 0].reshape(count, width)
    bearing = points[:, 1].reshape(count, width)[count // 2] / ahead[count // 2]
    x_m = np.median(ahead, axis=0)
    picked = np.unique(np.linspace(0, width - 1, min(config.columns, width)).round().astype(np.int64))
    return bearing[picked], x_m[picked]


def footprints(seen: Observation, yaws_rad: Floats) -> Floats:
    """(Y, 4, 2) corners about the centre, in order, of the class's footprint at each yaw."""
    half_l, half_w = seen.dimensions.length_m / 2.0, seen.dimensions.width_m / 2.0
    around = np.array([[half_l, half_w], [-half_l, half_w], [-half_l, -half_w], [half_l, -half_w]])
    c, s = np.cos(yaws_rad), np.sin(yaws_rad)
    turns = np.stack([np.stack([c, -s], axis=-1), np.stack([s, c], axis=-1)], axis=-2)  # (Y, 2, 2)
    out: Floats = np.einsum("yij,kj->yki", turns, around)
    return out


def surface_m(corners: Floats, bearings: Floats) -> Floats:
    """(Y, C) x_m where rays of bearings (C,), y / x, first hit each footprint (Y, 4, 2); NaN without a hit."""
    a, b = corners, np.roll(corners, -1, axis=1)
    # On an edge a + t (b - a) the ray has y = bearing * x
    at_a = a[:, :, 1, None] - bearings * a[:, :, 0, None]
    at_b = b[:, :, 1, None] - bearings * b[:, :, 0, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        t = at_a / (at_a - at_b)
        x = a[:, :, 0, None] + t * (b[:, :, 0, None] - a[:, :, 0, None])
    x = np.where((t >= 0.0) & (t <= 1.0), x, np.inf)
    nearest = x.min(axis=1)
    out: Floats = np.where(np.isfinite(nearest), nearest, np.nan)
    return out


def _fit_centres(
    seen: Observation,
    corners: Floats,
    bearings: Floats,
    x_m: Floats,
    middle_m: float,
    config: PseudoLidarConfig,
) -> tuple[Floats, Floats]:
    """Best centres (Y, 2) in m at each yaw, and the mean squared error (Y,) in m^2."""
    along = middle_m + np.abs(corners[:, :, 0]).max(axis=1) / 2.0
    across = _lateral_m(seen, corners, along)
    bound = config.outlier_sigma * math.hypot(config.sigma_shape_rel * middle_m, config.sigma_shape_m)
    error = np.zeros((len(corners), len(bearings)))
    for _ in range(CENTRE_STEPS):
        model = surface_m(corners + np.stack([along, across], axis=-1)[:, None, :], bearings)
        error = x_m - model  # NaN where the footprint is too narrow
        missed = np.isnan(model).all(axis=1, keepdims=True)
        shift = np.asarray(np.nanmedian(np.where(missed, 0.0, error), axis=1))
        along = np.maximum(along + shift, 1.0)
        across = _lateral_m(seen, corners, along)
        error = error - shift[:, None]
    squared_error = np.minimum(np.nan_to_num(error, nan=bound) ** 2, bound**2).mean(axis=1)
    return np.stack([along, across], axis=-1), squared_error


def _lateral_m(seen: Observation, corners: Floats, along_m: Floats) -> Floats:
    """(Y,) lateral positions at which footprints match the edges of the box, as in `localisation.place`."""
    of_left, of_right = seen.sigma_left**-2, seen.sigma_right**-2
    across = seen.bearing * along_m
    for _ in range(CENTRE_STEPS):
        outline = (across[:, None] + corners[:, :, 1]) / np.maximum(along_m[:, None] + corners[:, :, 0], 0.1)
        error = (seen.left - outline.max(axis=1)) * of_left + (seen.right - outline.min(axis=1)) * of_right
        across = across + error / (of_left + of_right) * along_m
    return across


def _width_error(seen: Observation, corners: Floats, centres: Floats, sigma_rel: float) -> Floats:
    """(Y,) squared error of the width of each footprint against the box, in sigmas."""
    at = corners + centres[:, None, :]
    bearings = at[:, :, 1] / np.maximum(at[:, :, 0], 0.1)
    outline = np.log(np.maximum(bearings.max(axis=1) - bearings.min(axis=1), 1e-6))
    edges = math.hypot(seen.sigma_left, seen.sigma_right) / seen.tan_width
    sigma = math.hypot(edges, seen.dimensions.sigma_length_rel, sigma_rel)
    out: Floats = ((math.log(seen.tan_width) - outline) / sigma) ** 2
    return out


def _centre_cov(seen: Observation, centre_m: Floats, sigma_rel: float, sigma_m: float) -> Floats:
    """(2, 2) covariance of a centre at one yaw: depth along the line of sight, edges of the box across it."""
    x_m, y_m = centre_m.tolist()
    length_m = seen.dimensions.sigma_length_rel * seen.dimensions.length_m / 2.0
    along = (sigma_rel * x_m) ** 2 + sigma_m**2 + length_m**2
    return line_of_sight_cov(y_m / x_m, along, lateral_variance(seen, x_m))


def _sigma_of_axis(resultant: float, step_rad: float) -> float:
    """1-sigma of an axis whose doubled angles have this mean resultant length; at least the step of the fan."""
    circular = math.sqrt(max(0.0, -2.0 * math.log(max(min(resultant, 1.0), 1e-6)))) / 2.0
    return max(circular, step_rad / math.sqrt(12.0))
