"""Vehicles in bird's-eye view from their boxes (paper, dynamic object localization).

`observe_boxes` converts a box to an `Observation`: slopes and bearings relative to the road, with sigmas. The depths
come from all boxes of a frame together, by Eq. 1 on their bottom edges (ground_size_filter.py). `place` computes the
centre of the footprint from the edges of the box and the yaw.
"""

from __future__ import annotations

import math

import msgspec
import numpy as np
from numpy.typing import NDArray

from birdslam.geometry import bev
from birdslam.geometry.camera import Camera, GroundPlane
from birdslam.perception.decoding.detection import EdgeSigma
from birdslam.perception.manifest import LowerEdge


class Dimensions(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Mean dimensions of a class of vehicles, and relative 1-sigma within it."""

    length_m: float  # mean of the class
    width_m: float  # mean of the class
    height_m: float  # mean of the class
    sigma_length_rel: float = 0.12  # of the length
    sigma_width_rel: float = 0.2  # of the outline across the line of sight, which includes the length if oblique
    sigma_height_rel: float = 0.08  # of the height


DIMENSIONS = {
    "car": Dimensions(3.85, 1.61, 1.5),
    "van": Dimensions(5.0, 1.9, 2.1, sigma_height_rel=0.12),
    "truck": Dimensions(7.0, 2.4, 3.0, sigma_length_rel=0.3, sigma_height_rel=0.2),
    "bus": Dimensions(11.0, 2.5, 3.1, sigma_length_rel=0.2, sigma_height_rel=0.1),
    "motorcycle": Dimensions(2.1, 0.8, 1.6, sigma_height_rel=0.12),
}
STEP_M = 0.1  # step of a numeric derivative by depth
MIN_DISTANCE_M = 1.0  # minimum depth of a visible vehicle
CENTRE_STEPS = 3  # iterations; each reduces the error tenfold
MIN_HIDING_RATIO = 0.1  # fraction of a box's side that an occluding box covers


class LocalisationConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Parameters of places from boxes; the class table lists the labels of vehicles."""

    vehicles: dict[str, Dimensions] = msgspec.field(default_factory=lambda: dict(DIMENSIONS))
    sigma_box_rel: float = 0.02  # 1-sigma of the edges as a fraction of the box, without a detector value
    sigma_box_px: float = 0.4  # and a constant part
    # Relative growth of the edge noise as the score falls from `sure_score` to 0
    sigma_growth: float = 2.0
    sure_score: float = 0.9  # score above which the noise is not increased
    reach_rel: float = 1.0  # factor on the distance from face to centre; the paper uses the face (0)
    sigma_cut_rel: float = 1.0  # 1-sigma of an edge cut by the image, as a fraction of the box
    # At the image sides: relative width below which a part of the length is assumed hidden
    cut_width_rel: float = 0.7
    cut_length_rel: float = 1.0  # hidden length per missing width
    sigma_reach_side_rel: float = 0.3  # 1-sigma of the distance from face to centre if the lower edge is visible
    sigma_reach_cut_rel: float = 0.5  # and if the image bottom cuts it
    sigma_hidden_rel: float = 0.025  # 1-sigma of an occluded edge
    cut_margin_px: float = 4.0  # distance to the border within which an edge counts as cut
    # At the image bottom, of the height: detectors draw cut edges slightly inside
    cut_margin_rel: float = 0.1
    cut_margin_side_rel: float = 0.05  # at the image sides, of the box's width
    overhang_rel: float = 0.2  # distance from the end of a body to its axle, of the length
    clearance_m: float = 0.2  # height of the lower edge of the body over the road
    shape_floor_m: float = 0.02  # minimum lateral 1-sigma: vehicles are not cuboids
    max_above_road_rad: float = 0.06  # maximum angle of the bottom above the road at the depth by height
    same_vehicle_iou: float = 0.6  # overlap above which boxes of different classes are one vehicle
    max_range_m: float = 100.0  # by the height of the class

    @property
    def edge_sigma(self) -> EdgeSigma:
        """Edge noise of detectors that do not state their own."""
        return EdgeSigma((self.sigma_box_rel,) * 4, self.sigma_box_px)


class Observation(msgspec.Struct, frozen=True):
    """One vehicle's box in one frame.

    `left` and `right` are the bearings (y/x in ego) of its edges at the bottom. Slopes (-z/x in ego) are positive below
    the road's horizon, so Eq. 1 puts the bottom edge at x = H / slope_bottom. Sigmas are standard deviations.
    """

    label: str
    score: float
    box_px: tuple[float, float, float, float]
    left: float
    sigma_left: float
    right: float
    sigma_right: float
    slope_bottom: float
    sigma_bottom: float
    slope_top: float
    sigma_top: float
    is_cut_at_side: bool
    dimensions: Dimensions
    sigma_cut: float | None = None  # of slope_bottom if the image cuts the bottom; a lower bound
    row: int = 0  # index of its box
    is_bottom_at_tyres: bool = False  # the bottom is at the tyres, not at the nearest face (tyre_contact.py)
    track_id: int | None = None  # id of another tracker

    @property
    def bearing(self) -> float:
        """Bearing of the middle column."""
        return (self.left + self.right) / 2.0

    @property
    def tan_width(self) -> float:
        """Width at a depth of 1."""
        return self.left - self.right

    @property
    def tan_height(self) -> float:
        """Height at a depth of 1."""
        return self.slope_bottom - self.slope_top

    @property
    def depth_by_height_m(self) -> float:
        """Depth for the mean height of the class."""
        return self.dimensions.height_m / max(self.tan_height, 1e-3)


class AssumedSize(msgspec.Struct, frozen=True):
    """Size used for a place; the smoother (rts_smoother.py) corrects it by a later, better size.

    `log_height` is the log of the height (m), `depth_per_height` the derivative of the log depth by it.
    """

    log_height: float
    sigma_log_height: float
    depth_per_height: float
    standing: float  # probability of being stationary


class Place(msgspec.Struct, frozen=True):
    """Place of an observed vehicle in ego: depth of the nearest face, centre of the footprint (2,), cov (2, 2)."""

    depth_m: float
    centre_m: NDArray[np.float64]
    cov: NDArray[np.float64]
    assumed: AssumedSize | None = None


def iou(a_px: NDArray[np.float64], b_px: NDArray[np.float64]) -> NDArray[np.float64]:
    """Intersection over union (A, B) of boxes (A, 4) and (B, 4), as x1, y1, x2, y2."""
    a, b = np.reshape(a_px, (-1, 1, 4)), np.reshape(b_px, (1, -1, 4))
    span = np.maximum(np.minimum(a[..., 2:], b[..., 2:]) - np.maximum(a[..., :2], b[..., :2]), 0.0)
    shared = span[..., 0] * span[..., 1]
    area_a = (a[..., 2] - a[..., 0]) * (a[..., 3] - a[..., 1])
    area_b = (b[..., 2] - b[..., 0]) * (b[..., 3] - b[..., 1])
    out: NDArray[np.float64] = shared / np.maximum(area_a + area_b - shared, 1e-9)
    return out


def corners_of(dimensions: Dimensions, yaw_rad: float, size: float = 1.0) -> list[tuple[float, float]]:
    """Corners of the footprint about its centre, in ego axes; `yaw_rad` is the yaw in ego.

    `size` is a factor on length and width.
    """
    c, s = size * math.cos(yaw_rad), size * math.sin(yaw_rad)
    half_l, half_w = dimensions.length_m / 2.0, dimensions.width_m / 2.0
    lc, ls, wc, ws = half_l * c, half_l * s, half_w * c, half_w * s
    return [(-lc + ws, -ls - wc), (-lc - ws, -ls + wc), (lc + ws, ls - wc), (lc - ws, ls + wc)]


def extent_m(dimensions: Dimensions, yaw_rad: float, depth_m: float, bearing: float) -> tuple[float, float]:
    """(extent along ego x, width of the outline at the depth of the nearest face) of a vehicle, in metres."""
    corners = corners_of(dimensions, yaw_rad)
    reach_m = _reach_m(corners)
    x_m = depth_m + reach_m
    y_m = bearing * x_m
    (x0, y0), (x1, y1), (x2, y2), (x3, y3) = corners
    a, b = (y_m + y0) / max(x_m + x0, 0.1), (y_m + y1) / max(x_m + x1, 0.1)
    c, d = (y_m + y2) / max(x_m + x2, 0.1), (y_m + y3) / max(x_m + x3, 0.1)
    return 2.0 * reach_m, (max(a, b, c, d) - min(a, b, c, d)) * depth_m


def _reach_m(corners: list[tuple[float, float]]) -> float:
    """Distance from the nearest corner to the centre along ego x."""
    (a, _), (b, _), (c, _), (d, _) = corners
    return -min(a, b, c, d)


def centre_at(
    seen: Observation, depth_m: float, yaw_rad: float, config: LocalisationConfig
) -> tuple[float, float, float, float]:
    """(x, y, reach, outline): centre in ego, its distance behind the nearest face (m), outline at a depth of 1.

    The centre is moved laterally until the outermost corners match the edges of the box, weighted by their information.
    """
    corners = corners_of(seen.dimensions, yaw_rad, config.reach_rel)
    reach_m = _reach_m(corners)
    x_m = depth_m + reach_m
    left, right = seen.left, seen.right
    y_m = (left + right) / 2.0 * x_m
    of_left, of_right = seen.sigma_left**-2, seen.sigma_right**-2
    (x0, y0), (x1, y1), (x2, y2), (x3, y3) = corners
    x0, x1, x2, x3 = max(x_m + x0, 0.1), max(x_m + x1, 0.1), max(x_m + x2, 0.1), max(x_m + x3, 0.1)
    widest = least = 0.0
    for _ in range(CENTRE_STEPS):
        a, b, c, d = (y_m + y0) / x0, (y_m + y1) / x1, (y_m + y2) / x2, (y_m + y3) / x3
        widest, least = max(a, b, c, d), min(a, b, c, d)
        y_m += ((left - widest) * of_left + (right - least) * of_right) / (of_left + of_right) * x_m
    return x_m, y_m, reach_m, widest - least


def place(seen: Observation, log_depth: float, var_depth: float, yaw_rad: float, config: LocalisationConfig) -> Place:
    """Place of an observation in ego, from log depth with its variance and the yaw in ego."""
    depth_m = math.exp(log_depth)
    x_m, y_m, reach_m, outline = centre_at(seen, depth_m, yaw_rad, config)
    slope = y_m / x_m
    if seen.is_cut_at_side and reach_m > 0.0:  # the paper uses the face
        # The visible part is narrower than the outline; the rest is beside the ego, nearer
        narrower = max(0.0, config.cut_width_rel - seen.tan_width / outline)
        hidden_m = min(config.cut_length_rel * narrower, 1.0) * 2.0 * reach_m
        nearest_m = max(depth_m - hidden_m, MIN_DISTANCE_M)
        x_m, y_m, reach_m, _ = centre_at(seen, nearest_m, yaw_rad, config)
        # The visible edge is a corner behind the centre: the centre moves along its line of sight
        farther_x_m, farther_y_m, *_ = centre_at(seen, nearest_m + STEP_M, yaw_rad, config)
        slope = (farther_y_m - y_m) / (farther_x_m - x_m)
    of_left, of_right = seen.sigma_left**-2, seen.sigma_right**-2

    # A single edge gives the centre with the uncertainty of half the outline
    lopsided = (of_left - of_right) / (of_left + of_right)
    half_outline = max(seen.tan_width, outline) / 2.0
    if seen.is_cut_at_side:
        # The depth error is along that edge's line of sight; the lateral rest is half the extent
        half_outline = max(y for _, y in corners_of(seen.dimensions, yaw_rad)) / x_m
    sigma_half = seen.dimensions.sigma_width_rel * half_outline
    sigma_across = math.hypot(
        1.0 / math.sqrt(of_left + of_right), lopsided * sigma_half, config.shape_floor_m / max(x_m, 1.0)
    )
    sigma_reach_rel = seen.dimensions.sigma_length_rel
    if seen.is_cut_at_side:
        sigma_reach_rel = config.sigma_reach_side_rel if seen.sigma_cut is None else config.sigma_reach_cut_rel
    along = depth_m**2 * var_depth + (sigma_reach_rel * reach_m) ** 2
    return Place(depth_m, np.array([x_m, y_m]), line_of_sight_cov(slope, along, (x_m * sigma_across) ** 2))


def line_of_sight_cov(slope: float, along: float, across: float) -> NDArray[np.float64]:
    """(2, 2) covariance from the variance of x along a line of sight y = `slope` x, and that of y at fixed x."""
    return np.array([[along, along * slope], [along * slope, along * slope**2 + across]])


def observe_boxes(
    boxes_px: NDArray[np.float64],
    scores: NDArray[np.float64],
    labels: tuple[str, ...],
    camera: Camera,
    ground: GroundPlane,
    config: LocalisationConfig,
    edge_sigma: EdgeSigma | None = None,
    lower_edge: LowerEdge = "body",
) -> list[Observation]:
    """Observations of the vehicles among boxes (N, 4) with scores (N,), best score first.

    Boxes that float above the road or lie beyond `max_range_m` are dropped. `edge_sigma` is the detector's, or None for
    the configured one; `lower_edge` states where its boxes end (`manifest.DetectorTable`).
    """
    vehicles = np.array([label in config.vehicles for label in labels], dtype=np.bool_).reshape(-1)
    sizes = boxes_px[:, 2:] - boxes_px[:, :2]
    candidates = np.flatnonzero(vehicles & (sizes >= 1.0).all(axis=1))
    candidates = candidates[np.argsort(-scores[candidates], kind="stable")]
    overlap = iou(boxes_px[candidates], boxes_px[candidates])
    kept: list[int] = []  # rows of `overlap`
    for row in range(len(candidates)):
        if not kept or overlap[row, kept].max() <= config.same_vehicle_iou:
            kept.append(row)
    chosen = candidates[kept]
    boxes = boxes_px[chosen]
    hidden = hidden_edges(boxes)
    slopes = _slopes(camera, ground, boxes)
    sigma, is_bottom_at_tyres = edge_sigma or config.edge_sigma, lower_edge == "tyres"
    found = (
        _observe(i, box, float(scores[i]), labels[i], camera, slope, edges, sigma, is_bottom_at_tyres, config)
        for i, box, slope, edges in zip(chosen.tolist(), boxes.tolist(), slopes.tolist(), hidden.tolist(), strict=True)
    )
    return [seen for seen in found if _is_on_road(seen, ground, config)]


def hidden_edges(boxes_px: NDArray[np.float64]) -> NDArray[np.bool_]:
    """(N, 3) whether left, right and bottom edge of each box are occluded by a nearer box with a lower bottom."""
    x1, y1, x2, y2 = (boxes_px[:, k, None] for k in range(4))
    n1, m1, n2, m2 = (boxes_px[None, :, k] for k in range(4))
    nearer = m2 > y2
    rows = np.maximum(np.minimum(y2, m2) - np.maximum(y1, m1), 0.0) > MIN_HIDING_RATIO * (y2 - y1)
    columns = np.maximum(np.minimum(x2, n2) - np.maximum(x1, n1), 0.0) > MIN_HIDING_RATIO * (x2 - x1)
    left = nearer & rows & (n1 < x1) & (n2 > x1)
    right = nearer & rows & (n1 < x2) & (n2 > x2)
    bottom = nearer & columns & (m1 < y2)
    edges: NDArray[np.bool_] = np.stack([left, right, bottom], axis=1)  # (N, 3, N)
    return np.asarray(edges.any(axis=2))


def _slopes(camera: Camera, ground: GroundPlane, boxes_px: NDArray[np.float64]) -> NDArray[np.float64]:
    """(N, 4) bearings of the left and right edge at the bottom, slopes of bottom and top (rays of Eq. 1)."""
    px = np.concatenate([boxes_px[:, [0, 3]], boxes_px[:, [2, 3]], boxes_px[:, [0, 1]]])
    left, right, top = bev.bearing_and_slope(camera, ground, px).reshape(3, -1, 2)
    return np.column_stack([left[:, 0], right[:, 0], left[:, 1], top[:, 1]])


def _observe(
    row: int,
    box: list[float],
    score: float,
    label: str,
    camera: Camera,
    slopes: list[float],
    hidden: list[bool],
    edge_sigma: EdgeSigma,
    is_bottom_at_tyres: bool,
    config: LocalisationConfig,
) -> Observation:
    x1, y1, x2, y2 = box
    width_px, height_px = x2 - x1, y2 - y1
    margin_px, cut_rel = config.cut_margin_px, config.sigma_cut_rel
    side_margin_px = margin_px + config.cut_margin_side_rel * width_px
    cut_left, cut_right = x1 < side_margin_px, x2 > camera.width_px - side_margin_px
    cut_top = y1 < margin_px
    cut_bottom = y2 > camera.height_px - margin_px - config.cut_margin_rel * height_px
    hidden_left, hidden_right, hidden_bottom = hidden

    of_left, of_right, of_top, of_bottom = edge_sigma.rel
    score_factor = 1.0 + config.sigma_growth * max(0.0, config.sure_score - score)

    def sigma_px(size_px: float, edge_rel: float, cut: bool, hidden: bool) -> float:
        rel = cut_rel if cut else config.sigma_hidden_rel if hidden else 0.0
        return math.hypot(score_factor * size_px * edge_rel, score_factor * edge_sigma.px, size_px * rel)

    return Observation(
        label=label,
        score=score,
        box_px=(x1, y1, x2, y2),
        left=slopes[0],
        sigma_left=sigma_px(width_px, of_left, cut_left, hidden_left) / camera.fx_px,
        right=slopes[1],
        sigma_right=sigma_px(width_px, of_right, cut_right, hidden_right) / camera.fx_px,
        slope_bottom=slopes[2],
        sigma_bottom=sigma_px(height_px, of_bottom, cut_bottom, hidden_bottom) / camera.fy_px,
        slope_top=slopes[3],
        sigma_top=sigma_px(height_px, of_top, cut_top, False) / camera.fy_px,
        is_cut_at_side=cut_left or cut_right,
        dimensions=config.vehicles[label],
        sigma_cut=sigma_px(height_px, of_bottom, False, False) / camera.fy_px if cut_bottom else None,
        row=row,
        is_bottom_at_tyres=is_bottom_at_tyres,
    )


def _is_on_road(seen: Observation, ground: GroundPlane, config: LocalisationConfig) -> bool:
    depth_m = seen.depth_by_height_m
    above_road = (
        seen.slope_bottom
        < bev.road_slope(depth_m, ground.height_m) - config.max_above_road_rad - 3.0 * seen.sigma_bottom
    )
    return depth_m < config.max_range_m and not above_road
