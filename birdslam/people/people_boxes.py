"""What a detector's boxes say of people: riders joined with what they ride, feet that something hides.

A box's lower edge is where a person's feet meet the road, unless a nearer box or the image's border covers them:
`hidden` is the prior probability of that, which people_filter.py weighs against the box's size and row.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import msgspec
import numpy as np

from birdslam.geometry import bev
from birdslam.geometry.arrays import Bools, Floats
from birdslam.geometry.camera import Camera, GroundPlane
from birdslam.perception import Detections
from birdslam.perception.decoding.detection import EdgeSigma
from birdslam.vehicles.placement.localisation import iou

PEDESTRIAN, CYCLIST = "pedestrian", "cyclist"  # labels of records
PERSON, BICYCLE, MOTORCYCLE = "person", "bicycle", "motorcycle"  # labels of detectors, which may say "cyclist" too
CARS = ("car", "van", "truck", "bus", "trailer")
RIDER_COLUMNS = 0.5  # of the narrower of two boxes, that a rider and what is ridden share
RIDER_FEET = 0.35  # of the bicycle's height: from its lower edge up to the feet of its rider, at the most
RIDER_SIZES = (0.8, 2.6)  # height of a rider's box over the bicycle's
RIDER_INSIDE, SAME_RIDER_IOU = 0.8, 0.5  # a rider's box lies so far in the cyclist's, and overlaps it so much
OCCUPANT_INSIDE = 0.9  # of a person's box, inside that of a vehicle whose wheels are lower: somebody in it
SAME_PERSON_IOU = 0.7  # of two boxes: the better score stays
COVER_WIDTH = 0.3  # of a box's width: a nearer box that covers less of its lower edge hides no feet


class PeopleBoxesConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """How sure boxes of people are; fractions are of the box's height."""

    sigma_edge_rel: float = 0.03  # 1-sigma of lower and upper edge: RRC's boxes of people on KITTI tracking
    sigma_edge_px: float = 0.5  # and beside it
    sigma_covered_rel: float = 0.06  # of a lower edge that a nearer box covers, beside it
    sigma_side_rel: float = 0.035  # of the middle column: arms and legs swing
    sigma_growth: float = 2.0  # as `LocalisationConfig.sigma_growth`
    sure_score: float = 0.85  # from it on nothing grows
    cut_margin_px: float = 4.0  # an edge so near to the image's border counts as cut
    hidden: float = 0.003  # prior probability that feet are hidden though no box covers them: behind what has no box
    hidden_covered: float = 0.03  # and where a nearer box covers them
    hidden_cut: float = 0.8  # and where the image's border cuts the box


@dataclass(frozen=True)
class PersonBox:
    """One person's box in one frame, against the road as it is known; sigmas are standard deviations of the numbers.

    Slopes (-z/x in ego) count downwards from the plane of the road, `bearing` is y/x, `log_width` that of the width at
    a depth of 1. Of a bicycle whose rider was not found only the foot is measured: `whole` is False.
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
    whole: bool = True
    rows: tuple[int, ...] = ()  # of the detections that it is made of

    @property
    def tan_height(self) -> float:
        """Its height at a depth of 1."""
        return self.slope_bottom - self.slope_top


def people_boxes(
    detections: Detections, camera: Camera, ground: GroundPlane, config: PeopleBoxesConfig
) -> list[PersonBox]:
    """The people among a frame's boxes, best score first: each rider once, nobody who sits in a car.

    A motorcycle is a vehicle: whoever rides it is part of it, and no pedestrian.
    """
    boxes, labels, whole, rows = _joined(detections)
    if not len(boxes):
        return []
    scores = boxes[:, 4]
    boxes = boxes[:, :4]
    covered = _covered_feet(boxes, detections)
    slopes = _rays(camera, ground, boxes)
    sigma = detections.edge_sigma
    order = np.argsort(-scores, kind="stable")
    return [
        _observe(
            boxes[i], float(scores[i]), labels[i], whole[i], rows[i], bool(covered[i]), slopes[i], sigma, camera, config
        )
        for i in order.tolist()
    ]


def _joined(detections: Detections) -> tuple[Floats, list[str], list[bool], list[tuple[int, ...]]]:
    """(boxes and scores (N, 5), labels, which are whole, of which detections): riders and their bicycles as one.

    Occupants of vehicles are left out.
    """
    found = np.column_stack([detections.boxes_px, detections.scores, np.arange(len(detections))])
    sizes = found[:, 2:4] - found[:, :2]
    solid = np.flatnonzero((sizes >= 1.0).all(axis=1)).tolist()

    def of(*labels: str) -> Floats:
        return found[[i for i in solid if detections.labels[i] in labels]]

    bicycles, motorcycles = of(BICYCLE), of(MOTORCYCLE)
    people = _without_copies(of(PERSON))
    cyclists = _without_copies(of(CYCLIST))
    people = people[~(_copies(people, cyclists) | _occupants(people, of(*CARS)))]
    mounts = np.vstack([bicycles, motorcycles])
    rider_of = _riders(people, mounts)
    rows, labels, whole, made_of = [], list[str](), list[bool](), list[tuple[int, ...]]()
    for i, person in enumerate(people):
        mount = rider_of.get(i)
        if mount is None:
            rows.append(person[:5])
            labels.append(PEDESTRIAN)
            whole.append(True)
            made_of.append((int(person[5]),))
        elif mount < len(bicycles):
            bike = mounts[mount]
            rows.append(np.concatenate([np.minimum(person[:2], bike[:2]), np.maximum(person[2:5], bike[2:5])]))
            labels.append(CYCLIST)
            whole.append(True)
            made_of.append((int(person[5]), int(bike[5])))
    ridden = set(rider_of.values())
    for k, bike in enumerate(bicycles):
        if k not in ridden:
            rows.append(bike[:5])
            labels.append(BICYCLE)
            whole.append(False)
            made_of.append((int(bike[5]),))
    rows += list(cyclists[:, :5])
    labels += [CYCLIST] * len(cyclists)
    whole += [True] * len(cyclists)
    made_of += [(int(row),) for row in cyclists[:, 5]]
    return np.array(rows).reshape(-1, 5), labels, whole, made_of


def _without_copies(boxes: Floats) -> Floats:
    """Boxes (N, 6), the better of two that lie on one person."""
    boxes = boxes[np.argsort(-boxes[:, 4], kind="stable")]
    overlap, kept = iou(boxes[:, :4], boxes[:, :4]), list[int]()
    for row in range(len(boxes)):
        if not kept or overlap[row, kept].max() <= SAME_PERSON_IOU:
            kept.append(row)
    return boxes[kept]


def _copies(people: Floats, cyclists: Floats) -> Bools:
    """Returns (N,) bool: whether a box is that of a cyclist's rider, and not of a person in front of a cyclist."""
    if not len(people) or not len(cyclists):
        return np.zeros(len(people), dtype=np.bool_)
    p, c = people[:, None, :4], cyclists[None, :, :4]
    span = np.maximum(np.minimum(p[..., 2:], c[..., 2:]) - np.maximum(p[..., :2], c[..., :2]), 0.0)
    inside = span.prod(axis=-1) > RIDER_INSIDE * np.prod(p[..., 2:] - p[..., :2], axis=-1)
    return np.asarray((inside & (iou(people[:, :4], cyclists[:, :4]) >= SAME_RIDER_IOU)).any(axis=1))


def _occupants(people: Floats, cars: Floats) -> Bools:
    """(N,): who sits in a vehicle, its wheels lower than the person's lower edge and its roof above the head."""
    if not len(people) or not len(cars):
        return np.zeros(len(people), dtype=np.bool_)
    p, c = people[:, None, :4], cars[None, :, :4]
    span = np.maximum(np.minimum(p[..., 2:], c[..., 2:]) - np.maximum(p[..., :2], c[..., :2]), 0.0)
    area = np.prod(p[..., 2:] - p[..., :2], axis=-1)
    height = c[..., 3] - c[..., 1]
    inside = (span.prod(axis=-1) > OCCUPANT_INSIDE * area) & (p[..., 3] < c[..., 3] - 0.1 * height)
    return np.asarray((inside & (p[..., 1] > c[..., 1] - 0.05 * height)).any(axis=1))


def _riders(people: Floats, mounts: Floats) -> dict[int, int]:
    """Row of a person -> row of what it rides, at most one rider each, the best overlaps together."""
    if not len(people) or not len(mounts):
        return {}
    p, m = people[:, None, :4], mounts[None, :, :4]
    columns = np.minimum(p[..., 2], m[..., 2]) - np.maximum(p[..., 0], m[..., 0])
    share = columns / np.minimum(p[..., 2] - p[..., 0], m[..., 2] - m[..., 0])
    height = m[..., 3] - m[..., 1]
    feet = (p[..., 3] > m[..., 3] - RIDER_FEET * height - 1.0) & (p[..., 3] < m[..., 3] + RIDER_FEET * height)
    tall = (p[..., 3] - p[..., 1]) / np.maximum(height, 1.0)
    fits = (share > RIDER_COLUMNS) & feet & (tall > RIDER_SIZES[0]) & (tall < RIDER_SIZES[1])
    fits &= p[..., 1] < m[..., 1]
    from scipy.optimize import linear_sum_assignment

    rows, columns_of = linear_sum_assignment(np.where(fits, -share, 1.0))
    return {int(i): int(j) for i, j in zip(rows, columns_of, strict=True) if fits[i, j]}


def _covered_feet(boxes: Floats, detections: Detections) -> Bools:
    """(N,): whose lower edge a nearer box, whose own is lower, covers."""
    x1, y1, x2, y2 = (boxes[:, k, None] for k in range(4))
    n1, m1, n2, m2 = (detections.boxes_px[None, :, k] for k in range(4))
    covered = np.minimum(x2, n2) - np.maximum(x1, n1) > COVER_WIDTH * (x2 - x1)
    nearer = (m2 > y2 + 0.02 * (y2 - y1)) & (m1 < y2)
    inside = (n1 >= x1 - 1.0) & (n2 <= x2 + 1.0) & (m1 >= y1 - 1.0)  # a part of itself: its bicycle
    return np.asarray((covered & nearer & ~inside).any(axis=1))


def _rays(camera: Camera, ground: GroundPlane, boxes: Floats) -> Floats:
    """(N, 3): bearing of the middle column at the feet, slopes of bottom and top (the rays of Eq. 1)."""
    middle = boxes[:, [0, 2]].mean(axis=1)
    px = np.concatenate([np.column_stack([middle, boxes[:, 3]]), np.column_stack([middle, boxes[:, 1]])])
    foot, head = bev.bearing_and_slope(camera, ground, px).reshape(2, -1, 2)
    return np.column_stack([foot[:, 0], foot[:, 1], head[:, 1]])


def _observe(
    box: Floats,
    score: float,
    label: str,
    whole: bool,
    rows: tuple[int, ...],
    covered: bool,
    rays: Floats,
    stated: EdgeSigma | None,
    camera: Camera,
    config: PeopleBoxesConfig,
) -> PersonBox:
    x1, y1, x2, y2 = box.tolist()
    width_px, height_px = x2 - x1, y2 - y1
    factor = 1.0 + config.sigma_growth * max(0.0, config.sure_score - score)
    rel = (config.sigma_edge_rel,) * 2 if stated is None else stated.rel[2:]
    px = config.sigma_edge_px if stated is None else stated.px
    upper, lower = (factor * math.hypot(height_px * max(r, config.sigma_edge_rel), px) / camera.fy_px for r in rel)
    if covered:
        lower = math.hypot(lower, height_px * config.sigma_covered_rel / camera.fy_px)
    margin_px = config.cut_margin_px + 0.02 * height_px
    cut_bottom = y2 > camera.height_px - margin_px
    cut_top = y1 < config.cut_margin_px
    is_cut_at_side = x1 < config.cut_margin_px or x2 > camera.width_px - config.cut_margin_px
    across = factor * math.hypot(height_px * config.sigma_side_rel, px) / camera.fx_px
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
        sigma_top=math.hypot(upper, 0.5 * height_px / camera.fy_px) if cut_top or not whole else upper,
        log_width=math.log(max(width_px, 1.0) / camera.fx_px),
        hidden=config.hidden_cut if cut_bottom else config.hidden_covered if covered else config.hidden,
        whole=whole,
        rows=rows,
    )
