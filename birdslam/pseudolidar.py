"""Vehicles by their depth: the second source of a vehicle's place (paper, dynamic object localization).

A depth map makes a point of every pixel, the pseudo-lidar; those in a vehicle's box are its frustum. Frustum-PointNet
reads the body from them where the network is given. Without it the body is fitted: of every column of the box the depth
of its visible surface is known, and a footprint of the class's size, at each of a fan of yaws, has a surface of its own
to compare it with. What each yaw then deserves to be believed gives centre, yaw and their covariance together.

`combined` puts this place and the one by Eq. 1 together: by covariance, or by the paper's rule (this one where the
vehicle is near, Eq. 1 where it is far).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Literal, Protocol

import msgspec
import numpy as np
from numpy.typing import NDArray

from birdslam.bev import road_point_cam
from birdslam.camera import Camera, GroundPlane
from birdslam.localisation import CENTRE_STEPS, Observation, Place
from birdslam.perception import Boxes3d, DepthMap
from birdslam.se2 import wrap

Floats = NDArray[np.float64]
Positive = Annotated[float, msgspec.Meta(gt=0.0)]

ROAD_CELLS_MIN = 50  # of the map on the road: fewer say nothing of its scale


class PseudoLidarConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """How depth becomes a place, and what it counts beside Eq. 1."""

    rule: Literal["covariance", "paper", "off"] = "covariance"
    near_m: Positive = 20.0  # by the paper's rule: nearer, the depth map alone; farther, Eq. 1 alone
    top_rel: float = 0.35  # of a box's height: the band of rows in which a vehicle's body shows, and neither
    bottom_rel: float = 0.8  # its windows nor the road before it
    columns: Annotated[int, msgspec.Meta(ge=4, le=64)] = 16  # of the box, each with one depth
    yaws: Annotated[int, msgspec.Meta(ge=4, le=180)] = 36  # of the fan, over half a turn
    sigma_shape_rel: Positive = 0.03  # of a depth: how well the map keeps a vehicle's shape, columns apart
    sigma_shape_m: Positive = 0.25  # vehicles are no cuboids
    independent_columns: Positive = 4.0  # errors of neighbouring columns go together
    outlier_sigma: Positive = 3.0  # past it a column is taken to show something else
    least_columns: Annotated[int, msgspec.Meta(ge=2)] = 5
    least_points: Annotated[int, msgspec.Meta(ge=1)] = 40  # of a frustum that the network is asked about
    max_range_m: Positive = 60.0
    gate_sigma: Positive = 3.0  # places that differ by more are both believed less
    road_near_m: Positive = 5.0  # of the road that gives an unscaled map its metres
    road_far_m: Positive = 25.0


@dataclass(frozen=True)
class DepthPlace:
    """Where the depth map puts a vehicle, in ego: its footprint's centre (2,) and yaw, with their covariances.

    The yaw is of the axis, in (-pi/2, pi/2], where `flip` is 0.5: which end is the front is then not known. `flip` is
    the probability that the front is the rear.
    """

    centre_m: Floats
    cov: Floats  # (2, 2)
    yaw_rad: float
    sigma_yaw_rad: float
    flip: float = 0.5
    size_m: tuple[float, float, float] | None = None  # length, width, height, where they were measured


class FrustumNetwork(Protocol):
    """Reads a body from the points of each frustum; `perception.pointnet.PointNet` does it."""

    def locate(self, frusta_cam_m: Sequence[Floats], labels: Sequence[str], camera: Camera) -> Boxes3d | None: ...


def localise_by_depth(
    seen: Sequence[Observation],
    depth: DepthMap,
    camera: Camera,
    ground: GroundPlane,
    config: PseudoLidarConfig,
    road: NDArray[np.bool_] | None = None,
    network: FrustumNetwork | None = None,
) -> list[DepthPlace | None]:
    """A place for each observation of the frame that `depth` is of, None where its depth says nothing.

    `road` (H, W) is the road of the image; a map without a scale of its own needs it. Where the network gives no usable
    numbers the bodies are fitted.
    """
    metres = in_metres(depth, camera, ground, road, config)
    if metres is None or config.rule == "off" or not seen:
        return [None] * len(seen)
    if network is not None:
        frusta = [frustum_points(o, metres, camera) for o in seen]
        able = [i for i, points in enumerate(frusta) if len(points) >= config.least_points]
        bodies = network.locate([frusta[i] for i in able], [seen[i].label for i in able], camera)
        if bodies is not None:
            # It knows the errors of the maps that it was taught on, which need not be those of this one
            doubted = replace(bodies, sigma_depth_m=np.hypot(bodies.sigma_depth_m, metres.sigma_rel * bodies.depth_m))
            found = dict(zip(able, places_of(doubted, [seen[i] for i in able], camera, ground), strict=True))
            return [found.get(i) for i in range(len(seen))]
    return [fitted(o, metres, camera, ground, config) for o in seen]


def places_of(
    bodies: Boxes3d, seen: Sequence[Observation], camera: Camera, ground: GroundPlane
) -> list[DepthPlace | None]:
    """What a network says of the observed bodies, in its order, as places in ego; None: nothing is known."""
    bodies = bodies.in_metres(camera)
    poses = bodies.in_ego(camera, ground)
    return [
        DepthPlace(
            np.array([x_m, y_m]),
            _along_sight(x_m, y_m, float(bodies.sigma_depth_m[i]) ** 2, _across_var(o, x_m)),
            wrap(yaw_rad),
            float(bodies.sigma_alpha_rad[i]),
            float(bodies.flip[i]),
            tuple(bodies.size_m[i].tolist()),
        )
        if x_m > 0.0 and math.isfinite(bodies.sigma_depth_m[i])
        else None
        for i, (o, (x_m, y_m, yaw_rad)) in enumerate(zip(seen, poses.tolist(), strict=True))
    ]


def in_metres(
    depth: DepthMap,
    camera: Camera,
    ground: GroundPlane,
    road: NDArray[np.bool_] | None,
    config: PseudoLidarConfig,
) -> DepthMap | None:
    """The map in metres: its own, or by the median of what Eq. 1 says of the road; None where none is seen."""
    depth = depth.in_metres(camera)
    if depth.metric:
        return depth
    if road is None:
        return None
    factor = road_factor(depth, camera, ground, road, config)
    return None if factor is None else depth.scaled(factor)


def road_factor(
    depth: DepthMap, camera: Camera, ground: GroundPlane, road: NDArray[np.bool_], config: PseudoLidarConfig
) -> float | None:
    """By what the map is too small, by the road near the camera (Eq. 1); None where too little of it is seen."""
    height, width = depth.depth_m.shape
    sx, sy = depth.scale
    u, v = np.meshgrid((np.arange(width) + 0.5) / sx - 0.5, (np.arange(height) + 0.5) / sy - 0.5)
    px = np.column_stack([u.ravel(), v.ravel()])
    rows, columns = np.rint(px[:, 1]).astype(np.int64), np.rint(px[:, 0]).astype(np.int64)
    px = px[road[np.clip(rows, 0, road.shape[0] - 1), np.clip(columns, 0, road.shape[1] - 1)]]
    z_m = road_point_cam(camera, ground, px)[:, 2] if len(px) else np.zeros(0)
    near = (z_m >= config.road_near_m) & (z_m <= config.road_far_m)
    if near.sum() < ROAD_CELLS_MIN:
        return None
    return float(np.median(z_m[near] / depth.at(px[near])))


def frustum_points(seen: Observation, depth: DepthMap, camera: Camera) -> Floats:
    """(N, 3) the pseudo-lidar inside an observation's box, in the camera frame."""
    return depth.points_cam_m(camera, *depth.cells(seen.box_px))


def fitted(
    seen: Observation, depth: DepthMap, camera: Camera, ground: GroundPlane, config: PseudoLidarConfig
) -> DepthPlace | None:
    """The class's footprint where the visible surface of the box's columns wants it; `depth` in metres."""
    profile = visible_surface(seen, depth, camera, ground, config)
    if profile is None:
        return None
    bearings, x_m = profile
    middle_m = float(np.median(x_m))
    if not 0.0 < middle_m <= config.max_range_m:
        return None
    yaws: Floats = np.arange(config.yaws, dtype=np.float64) * (math.pi / config.yaws) - math.pi / 2.0
    corners = footprints(seen, yaws)
    centres, misfit = _placed(seen, corners, bearings, x_m, middle_m, config)
    # How much each yaw is to be believed
    sigma_m = math.hypot(config.sigma_shape_rel * middle_m, config.sigma_shape_m)
    log_belief = -0.5 * misfit / sigma_m**2 * min(config.independent_columns, len(x_m))
    log_belief -= 0.5 * _width_misfit(seen, corners, centres, depth.sigma_rel)
    belief = np.exp(log_belief - log_belief.max())
    belief /= belief.sum()
    centre = belief @ centres
    spread = (centres - centre).T * belief @ (centres - centre)
    axis = complex(belief @ np.exp(2j * yaws))
    return DepthPlace(
        centre,
        spread + _own_cov(seen, centre, depth.sigma_rel, sigma_m),
        math.atan2(axis.imag, axis.real) / 2.0,
        _sigma_of_axis(abs(axis), math.pi / config.yaws),
    )


def visible_surface(
    seen: Observation, depth: DepthMap, camera: Camera, ground: GroundPlane, config: PseudoLidarConfig
) -> tuple[Floats, Floats] | None:
    """Bearings (y / x) and x_m (C,) in ego of what the columns of a box show, the median of each over its rows."""
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
    """(Y, 4, 2) corners about the centre, in order around it, of the class's footprint at each yaw."""
    half_l, half_w = seen.dimensions.length_m / 2.0, seen.dimensions.width_m / 2.0
    around = np.array([[half_l, half_w], [-half_l, half_w], [-half_l, -half_w], [half_l, -half_w]])
    c, s = np.cos(yaws_rad), np.sin(yaws_rad)
    turns = np.stack([np.stack([c, -s], axis=-1), np.stack([s, c], axis=-1)], axis=-2)  # (Y, 2, 2)
    out: Floats = np.einsum("yij,kj->yki", turns, around)
    return out


def surface_m(corners: Floats, bearings: Floats) -> Floats:
    """(Y, C) x_m at which rays of the given bearings (y / x) first meet each footprint (Y, 4, 2); NaN: it is passed."""
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


def _placed(
    seen: Observation,
    corners: Floats,
    bearings: Floats,
    x_m: Floats,
    middle_m: float,
    config: PseudoLidarConfig,
) -> tuple[Floats, Floats]:
    """Centres (Y, 2) of the footprints where box and surface want them, and how the surface misfits there (Y,), m^2."""
    along = middle_m + np.abs(corners[:, :, 0]).max(axis=1) / 2.0
    across = _between_edges(seen, corners, along)
    bound = config.outlier_sigma * math.hypot(config.sigma_shape_rel * middle_m, config.sigma_shape_m)
    error = np.zeros((len(corners), len(bearings)))
    for _ in range(CENTRE_STEPS):
        model = surface_m(corners + np.stack([along, across], axis=-1)[:, None, :], bearings)
        error = x_m - model  # NaN: the footprint is too narrow to reach this column
        missed = np.isnan(model).all(axis=1, keepdims=True)
        shift = np.asarray(np.nanmedian(np.where(missed, 0.0, error), axis=1))
        along = np.maximum(along + shift, 1.0)
        across = _between_edges(seen, corners, along)
        error = error - shift[:, None]
    misfit = np.minimum(np.nan_to_num(error, nan=bound) ** 2, bound**2).mean(axis=1)
    return np.stack([along, across], axis=-1), misfit


def _between_edges(seen: Observation, corners: Floats, along_m: Floats) -> Floats:
    """(Y,) where sideways footprints at a depth look as wide and as far left as the box; as `localisation.place`."""
    of_left, of_right = seen.sigma_left**-2, seen.sigma_right**-2
    across = seen.bearing * along_m
    for _ in range(CENTRE_STEPS):
        outline = (across[:, None] + corners[:, :, 1]) / np.maximum(along_m[:, None] + corners[:, :, 0], 0.1)
        error = (seen.left - outline.max(axis=1)) * of_left + (seen.right - outline.min(axis=1)) * of_right
        across = across + error / (of_left + of_right) * along_m
    return across


def _width_misfit(seen: Observation, corners: Floats, centres: Floats, sigma_rel: float) -> Floats:
    """(Y,) squares of how wide each footprint looks against the box, in sigmas of what edges, class and depth allow."""
    at = corners + centres[:, None, :]
    bearings = at[:, :, 1] / np.maximum(at[:, :, 0], 0.1)
    outline = np.log(np.maximum(bearings.max(axis=1) - bearings.min(axis=1), 1e-6))
    edges = math.hypot(seen.sigma_left, seen.sigma_right) / seen.tan_width
    sigma = math.hypot(edges, seen.dimensions.sigma_length_rel, sigma_rel)
    out: Floats = ((math.log(seen.tan_width) - outline) / sigma) ** 2
    return out


def _own_cov(seen: Observation, centre_m: Floats, sigma_rel: float, sigma_m: float) -> Floats:
    """(2, 2) of a centre at one yaw: the map's depth along the line of sight, the box's edges across it."""
    x_m, y_m = centre_m.tolist()
    length_m = seen.dimensions.sigma_length_rel * seen.dimensions.length_m / 2.0
    along = (sigma_rel * x_m) ** 2 + sigma_m**2 + length_m**2
    return _along_sight(x_m, y_m, along, _across_var(seen, x_m))


def _across_var(seen: Observation, x_m: float) -> float:
    """Variance of the centre across the line of sight: each edge is half an outline away from it."""
    of_left, of_right = seen.sigma_left**-2, seen.sigma_right**-2
    lopsided = (of_left - of_right) / (of_left + of_right)
    half_m = lopsided * seen.dimensions.sigma_width_rel * seen.tan_width * x_m / 2.0
    return x_m**2 / (of_left + of_right) + half_m**2


def _along_sight(x_m: float, y_m: float, along: float, across: float) -> Floats:
    """(2, 2) of variances of x_m along the line of sight and of y_m at that x_m."""
    slope = y_m / x_m
    return np.array([[along, along * slope], [along * slope, along * slope**2 + across]])


def _sigma_of_axis(resultant: float, step_rad: float) -> float:
    """1-sigma of an axis whose doubled angles have this mean resultant length; no finer than the fan."""
    circular = math.sqrt(max(0.0, -2.0 * math.log(max(min(resultant, 1.0), 1e-6)))) / 2.0
    return max(circular, step_rad / math.sqrt(12.0))


def combined(by_box: Place, by_depth: DepthPlace | None, config: PseudoLidarConfig) -> Place:
    """One place of the two sources.

    By covariance, with both believed less where they contradict each other by more than `gate_sigma`; or by the paper's
    rule, which asks the depth. The nearest face moves with the centre.
    """
    if by_depth is None or config.rule == "off":
        return by_box
    if config.rule == "paper":
        if by_box.depth_m > config.near_m:
            return by_box
        return _moved(by_box, by_depth.centre_m, by_depth.cov)
    apart = by_depth.centre_m - by_box.centre_m
    S = by_box.cov + by_depth.cov
    misfit = float(apart @ np.linalg.solve(S, apart)) / config.gate_sigma**2
    doubt = max(1.0, misfit)
    gain = by_box.cov @ np.linalg.inv(S)
    return _moved(by_box, by_box.centre_m + gain @ apart, doubt * (by_box.cov - gain @ by_box.cov))


def _moved(place: Place, centre_m: Floats, cov: Floats) -> Place:
    depth_m = max(place.depth_m + float(centre_m[0] - place.centre_m[0]), 0.1)
    return Place(depth_m, centre_m, (cov + cov.T) / 2.0)
