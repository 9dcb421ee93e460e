"""People in the boxes of a detector: joins riders with bicycles, finds occluded feet.

The lower edge of a box is where the feet meet the road, unless a nearer box or the image border covers it. `hidden` is
the prior probability of that; the filter weighs it against size and row of the box.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from birdslam.geometry import bev
from birdslam.geometry.arrays import Bools, Floats
from birdslam.geometry.camera import Camera, GroundPlane
from birdslam.perception import Detections
from birdslam.perception.decoding.detection import EdgeSigma
from birdslam.road_users.placement.localisation import LocalisationConfig, iou

PEDESTRIAN, CYCLIST = "pedestrian", "cyclist"  # labels of records
PERSON, BICYCLE, MOTORCYCLE = "person", "bicycle", "motorcycle"  # labels of detectors, which may also use "cyclist"
CARS = ("car", "van", "truck", "bus", "trailer")
MIN_RIDER_COLUMNS_RATIO = 0.5  # of the narrower box, shared by rider and bicycle
MAX_RIDER_FEET_RATIO = 0.35  # maximum height of the rider's feet, of the height of the bicycle
RIDER_HEIGHT_RATIOS = (0.8, 2.6)  # height of the rider's box to that of the bicycle
MIN_RIDER_INSIDE_RATIO, MIN_RIDER_IOU = 0.8, 0.5  # of a rider's box inside the cyclist's; and IoU
MIN_OCCUPANT_INSIDE_RATIO = 0.9  # of an occupant's box inside the vehicle's
MIN_DUPLICATE_IOU = 0.7  # of two boxes of one person
MIN_COVER_RATIO = 0.3  # covered fraction of the lower edge that hides the feet
# Noise of boxes of people; fractions are of the height of the box
SIGMA_EDGE_REL = 0.03  # 1-sigma of lower and upper edge
SIGMA_EDGE_PX = 0.5  # and a constant part
SIGMA_COVERED_REL = 0.06  # additional, of a covered lower edge
SIGMA_SIDE_REL = 0.035  # of the middle column: swinging limbs
SURE_SCORE = 0.85  # score above which the noise is not increased
HIDDEN_PROBABILITY = 0.003  # prior probability of hidden feet without a covering box
HIDDEN_COVERED_PROBABILITY = 0.03  # with a covering box
HIDDEN_CUT_PROBABILITY = 0.8  # at the image border


@dataclass(frozen=True)
class PersonBox:
    """The box of a person in one frame, relative to the road, with 1-sigmas.

    Slopes (-z/x in ego) are positive below the plane of the road, `bearing` is y/x, `log_width` the log width at a
    depth of 1. For a bicycle without a rider only the foot is measured: `is_complete` is False.
    """

    label: str
    score: float
    box_px: tuple[float, float, float, float]
    bearing: float
    sigma_bearing: float
    slope_bottom: float
    sigma_bottom: float
    slope_top: float
    sigma_top: float
    log_width: float
    hidden: float
    is_complete: bool = True
    rows: tuple[int, ...] = ()  # indices of its detections

    @property
    def tan_height(self) -> float:
        """Height at a depth of 1."""
        return self.slope_bottom - self.slope_top


def observe_people(
    detections: Detections,
    camera: Camera,
    ground: GroundPlane,
    localisation: LocalisationConfig,
) -> list[PersonBox]:
    """The people among the boxes of a frame, best score first: riders once, without occupants of cars.

    A motorcycle is a vehicle that includes its rider.
    """
    boxes, labels, is_complete, rows = _join_riders(detections)
    if not len(boxes):
        return []
    scores = boxes[:, 4]
    boxes = boxes[:, :4]
    covered = _has_covered_feet(boxes, detections)
    slopes = _rays(camera, ground, boxes)
    sigma = detections.edge_sigma
    order = np.argsort(-scores, kind="stable")
    return [
        _observe(
            boxes[i],
            float(scores[i]),
            labels[i],
            is_complete[i],
            rows[i],
            bool(covered[i]),
            slopes[i],
            sigma,
            camera,
            localisation,
        )
        for i in order.tolist()
    ]


def _join_riders(detections: Detections) -> tuple[Floats, list[str], list[bool], list[tuple[int, ...]]]:
    """(boxes and scores (N, 5), labels, which are complete, rows of detections), with riders and bicycles joined.

    Occupants of vehicles are dropped.
    """
    found = np.column_stack([detections.boxes_px, detections.scores, np.arange(len(detections))])
    sizes = found[:, 2:4] - found[:, :2]
    solid = np.flatnonzero((sizes >= 1.0).all(axis=1)).tolist()

    def of(*labels: str) -> Floats:
        return found[[i for i in solid if detections.labels[i] in labels]]

    bicycles, motorcycles = of(BICYCLE), of(MOTORCYCLE)
    people = _suppress_duplicates(of(PERSON))
    cyclists = _suppress_duplicates(of(CYCLIST))
    people = people[~(_is_rider_copy(people, cyclists) | _is_occupant(people, of(*CARS)))]
    mounts = np.vstack([bicycles, motorcycles])
    rider_of = _match_riders(people, mounts)
    rows, labels, is_complete, made_of = [], list[str](), list[bool](), list[tuple[int, ...]]()
    for i, person in enumerate(people):
        mount = rider_of.get(i)
        if mount is None:
            rows.append(person[:5])
            labels.append(PEDESTRIAN)
            is_complete.append(True)
            made_of.append((int(person[5]),))
        elif mount < len(bicycles):
            bike = mounts[mount]
            rows.append(np.concatenate([np.minimum(person[:2], bike[:2]), np.maximum(person[2:5], bike[2:5])]))
            labels.append(CYCLIST)
            is_complete.append(True)
            made_of.append((int(person[5]), int(bike[5])))
    ridden = set(rider_of.values())
    for k, bike in enumerate(bicycles):
        if k not in ridden:
            rows.append(bike[:5])
            labels.append(BICYCLE)
            is_complete.append(False)
            made_of.append((int(bike[5]),))
    rows += list(cyclists[:, :5])
    labels += [CYCLIST] * len(cyclists)
    is_complete += [True] * len(cyclists)
    made_of += [(int(row),) for row in cyclists[:, 5]]
    return np.array(rows).reshape(-1, 5), labels, is_complete, made_of


def _suppress_duplicates(boxes: Floats) -> Floats:
    """Non-maximum suppression of boxes (N, 6)."""
    boxes = boxes[np.argsort(-boxes[:, 4], kind="stable")]
    overlap, kept = iou(boxes[:, :4], boxes[:, :4]), list[int]()
    for row in range(len(boxes)):
        if not kept or overlap[row, kept].max() <= MIN_DUPLICATE_IOU:
            kept.append(row)
    return boxes[kept]


def _is_rider_copy(people: Floats, cyclists: Floats) -> Bools:
    """(N,) whether a box is that of the rider of a cyclist box, and not of a person in front of it."""
    if not len(people) or not len(cyclists):
        return np.zeros(len(people), dtype=np.bool_)
    p, c = people[:, None, :4], cyclists[None, :, :4]
    span = np.maximum(np.minimum(p[..., 2:], c[..., 2:]) - np.maximum(p[..., :2], c[..., :2]), 0.0)
    inside = span.prod(axis=-1) > MIN_RIDER_INSIDE_RATIO * np.prod(p[..., 2:] - p[..., :2], axis=-1)
    return np.asarray((inside & (iou(people[:, :4], cyclists[:, :4]) >= MIN_RIDER_IOU)).any(axis=1))


def _is_occupant(people: Floats, cars: Floats) -> Bools:
    """(N,) whether a person sits in a vehicle, between its roof and its wheels."""
    if not len(people) or not len(cars):
        return np.zeros(len(people), dtype=np.bool_)
    p, c = people[:, None, :4], cars[None, :, :4]
    span = np.maximum(np.minimum(p[..., 2:], c[..., 2:]) - np.maximum(p[..., :2], c[..., :2]), 0.0)
    area = np.prod(p[..., 2:] - p[..., :2], axis=-1)
    height = c[..., 3] - c[..., 1]
    inside = (span.prod(axis=-1) > MIN_OCCUPANT_INSIDE_RATIO * area) & (p[..., 3] < c[..., 3] - 0.1 * height)
    return np.asarray((inside & (p[..., 1] > c[..., 1] - 0.05 * height)).any(axis=1))


def _match_riders(people: Floats, mounts: Floats) -> dict[int, int]:
    """Row of a person -> row of its bicycle or motorcycle, with the best total overlap, one rider each."""
    if not len(people) or not len(mounts):
        return {}
    p, m = people[:, None, :4], mounts[None, :, :4]
    columns = np.minimum(p[..., 2], m[..., 2]) - np.maximum(p[..., 0], m[..., 0])
    share = columns / np.minimum(p[..., 2] - p[..., 0], m[..., 2] - m[..., 0])
    height = m[..., 3] - m[..., 1]
    feet = (p[..., 3] > m[..., 3] - MAX_RIDER_FEET_RATIO * height - 1.0) & (
        p[..., 3] < m[..., 3] + MAX_RIDER_FEET_RATIO * height
    )
    tall = (p[..., 3] - p[..., 1]) / np.maximum(height, 1.0)
    fits = (share > MIN_RIDER_COLUMNS_RATIO) & feet & (tall > RIDER_HEIGHT_RATIOS[0]) & (tall < RIDER_HEIGHT_RATIOS[1])
    fits &= p[..., 1] < m[..., 1]
    from scipy.optimize import linear_sum_assignment

    rows, columns_of = linear_sum_assignment(np.where(fits, -share, 1.0))
    return {int(i): int(j) for i, j in zip(rows, columns_of, strict=True) if fits[i, j]}


def _has_covered_feet(boxes: Floats, detections: Detections) -> Bools:
    """(N,) whether a nearer box, with a lower bottom, covers the lower edge."""
    x1, y1, x2, y2 = (boxes[:, k, None] for k in range(4))
    n1, m1, n2, m2 = (detections.boxes_px[None, :, k] for k in range(4))
    covered = np.minimum(x2, n2) - np.maximum(x1, n1) > MIN_COVER_RATIO * (x2 - x1)
    nearer = (m2 > y2 + 0.02 * (y2 - y1)) & (m1 < y2)
    inside = (n1 >= x1 - 1.0) & (n2 <= x2 + 1.0) & (m1 >= y1 - 1.0)  # its own bicycle
    return np.asarray((covered & nearer & ~inside).any(axis=1))


def _rays(camera: Camera, ground: GroundPlane, boxes: Floats) -> Floats:
    """(N, 3): bearing of the middle column at the feet, slopes of bottom and top (rays of Eq. 1)."""
    middle = boxes[:, [0, 2]].mean(axis=1)
    px = np.concatenate([np.column_stack([middle, boxes[:, 3]]), np.column_stack([middle, boxes[:, 1]])])
    foot, head = bev.bearing_and_slope(camera, ground, px).reshape(2, -1, 2)
    return np.column_stack([foot[:, 0], foot[:, 1], head[:, 1]])


def _observe(
    box: Floats,
    score: float,
    label: str,
    is_complete: bool,
    rows: tuple[int, ...],
    covered: bool,
    rays: Floats,
    stated: EdgeSigma | None,
    camera: Camera,
    localisation: LocalisationConfig,
) -> PersonBox:
    x1, y1, x2, y2 = box.tolist()
    width_px, height_px = x2 - x1, y2 - y1
    factor = 1.0 + localisation.sigma_growth * max(0.0, SURE_SCORE - score)
    rel = (SIGMA_EDGE_REL,) * 2 if stated is None else stated.rel[2:]
    px = SIGMA_EDGE_PX if stated is None else stated.px
    upper, lower = (factor * math.hypot(height_px * max(r, SIGMA_EDGE_REL), px) / camera.fy_px for r in rel)
    if covered:
        lower = math.hypot(lower, height_px * SIGMA_COVERED_REL / camera.fy_px)
    cut_px = localisation.cut_margin_px
    margin_px = cut_px + 0.02 * height_px
    cut_bottom = y2 > camera.height_px - margin_px
    cut_top = y1 < cut_px
    is_cut_at_side = x1 < cut_px or x2 > camera.width_px - cut_px
    across = factor * math.hypot(height_px * SIGMA_SIDE_REL, px) / camera.fx_px
    if is_cut_at_side:
        across = math.hypot(across, 0.5 * width_px / camera.fx_px)
    return PersonBox(
        label=label,
        score=score,
        box_px=(x1, y1, x2, y2),
        bearing=float(rays[0]),
        sigma_bearing=across,
        slope_bottom=float(rays[1]),
        sigma_bottom=lower,
        slope_top=float(rays[2]),
        sigma_top=math.hypot(upper, 0.5 * height_px / camera.fy_px) if cut_top or not is_complete else upper,
        log_width=math.log(max(width_px, 1.0) / camera.fx_px),
        hidden=HIDDEN_CUT_PROBABILITY if cut_bottom else HIDDEN_COVERED_PROBABILITY if covered else HIDDEN_PROBABILITY,
        is_complete=is_complete,
        rows=rows,
    )
