"""One network's bodies for another's boxes: by overlap, in the same image, and unknown without overlap."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from birdslam.geometry.camera import Camera
from birdslam.perception import Boxes3d, Detections, Findings, Networks
from birdslam.perception.decoding.detection import with_bodies
from birdslam.perception.shipped import run_at_once
from birdslam.road_users.placement.depth_fusion import PseudoLidarConfig
from birdslam.road_users.placement.localisation import LocalisationConfig, observe_boxes
from birdslam.road_users.placement.pseudolidar import locate_detected_bodies
from tests.heads import Head

CAMERA = Camera(1242, 375, 720.0, 720.0, 620.0, 180.0, height_m=1.65)
IMAGE = np.zeros((2, 2), np.uint8)


def boxes(*corners: tuple[float, float, float, float]) -> Detections:
    px = np.array(corners, dtype=np.float64).reshape(-1, 4)
    return Detections(px, np.full(len(px), 0.9), ("car",) * len(px))


def embodied(found: Detections, depths_m: list[float]) -> Detections:
    n = len(found)
    bodies = Boxes3d(
        centre_px=(found.boxes_px[:, :2] + found.boxes_px[:, 2:]) / 2.0,
        depth_m=np.array(depths_m),
        size_m=np.tile([4.4, 1.8, 1.5], (n, 1)),
        alpha_rad=np.zeros(n),
        sigma_depth_m=np.full(n, 0.5),
        sigma_size_m=np.full((n, 3), 0.1),
        sigma_alpha_rad=np.full(n, 0.1),
        flip=np.full(n, 0.1),
    )
    return Detections(found.boxes_px, found.scores, found.labels, bodies)


LEFT, RIGHT = (300.0, 180.0, 360.0, 230.0), (700.0, 180.0, 780.0, 240.0)
SHIFTED_RIGHT = (704.0, 182.0, 786.0, 241.0)


def test_each_box_has_the_body_of_the_box_that_overlaps_it_most() -> None:
    theirs = embodied(boxes(RIGHT, LEFT), [20.0, 25.0])
    found = with_bodies(boxes(LEFT, SHIFTED_RIGHT), theirs)
    assert found.boxes3d.depth_m.tolist() == [25.0, 20.0]
    assert found.boxes_px.tolist() == [list(LEFT), list(SHIFTED_RIGHT)]  # the boxes stay the detector's
    assert with_bodies(theirs, embodied(boxes(LEFT), [9.0])) is theirs  # whose bodies are its own


def test_box_without_body_is_placed_by_its_edges() -> None:
    found = with_bodies(boxes(LEFT, RIGHT), embodied(boxes(SHIFTED_RIGHT), [20.0]))
    seen = observe_boxes(found.boxes_px, found.scores, found.labels, CAMERA, CAMERA.ground, LocalisationConfig(), None)
    measured, places = locate_detected_bodies(seen, found, CAMERA, CAMERA.ground, PseudoLidarConfig())
    by_row = {o.row: (o, m, p) for o, m, p in zip(seen, measured, places, strict=True)}
    before, after, place = by_row[0]
    assert place is None
    assert after.dimensions.length_m == before.dimensions.length_m
    assert after.dimensions.sigma_length_rel == pytest.approx(before.dimensions.sigma_length_rel)
    before, after, place = by_row[1]
    assert place.centre_m[0] == pytest.approx(20.0, abs=0.5)
    assert after.dimensions.length_m > before.dimensions.length_m


@pytest.mark.parametrize("others", [None, boxes(LEFT), embodied(boxes(), [])])
def test_without_bodies_detections_are_unchanged(others: Detections | None) -> None:
    mine = boxes(LEFT)
    assert with_bodies(mine, others) is mine
    assert len(with_bodies(boxes(), embodied(boxes(LEFT), [9.0]))) == 0


def head(role: Any, found: Detections, every: int = 1) -> Head:
    return Head(role, Findings(detections=found), every=every)


def test_bodies_are_of_the_same_image() -> None:
    heads = [head("detector", boxes(LEFT)), head("segmenter", boxes()), head("depth", boxes())]
    shipped = head("multitask", embodied(boxes(LEFT), [25.0]), every=2)
    networks = Networks([*heads, shipped], run_at_once, bodies=True)
    first, second = (networks.start(frame, IMAGE).result().detections for frame in (0, 1))
    assert first.boxes3d is not None
    assert second.boxes3d is None  # the multi-task network did not look
    assert shipped.runs == 1
    unasked = head("multitask", embodied(boxes(LEFT), [25.0]))
    plain = Networks([*heads, unasked], run_at_once).start(0, IMAGE).result().detections
    assert plain.boxes3d is None
    assert unasked.runs == 0
