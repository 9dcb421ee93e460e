"""Labels projected into another camera: the right colour camera's images are as good as the left one's."""

from __future__ import annotations

import math
import os
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from birdslam.sources.kitti_tracking import camera_with_images, open_tracking
from birdslam.sources.label_projection import hull_px, project_labels
from tests import tracking_world

BASELINE_M = 0.532
KITTI = Path(os.environ.get("BIRDSLAM_DATA", Path(__file__).parents[2] / "shared" / "data")) / "kitti_tracking/training"


def with_right_camera(root: Path, frames: int = 2, suffix: str = ".jpg") -> Path:
    """The tracking world with a second colour camera at its right, whose images are there."""
    tracking_world.write(root)
    fx, cx, cy = tracking_world.FX, tracking_world.CX, tracking_world.CY
    calibration = root / "calib" / "0002.txt"
    calibration.write_text(f"{calibration.read_text()}P3: {fx} 0 {cx} {-fx * BASELINE_M} 0 {fx} {cy} 0 0 0 1 0\n")
    folder = root / "image_03" / "0002"
    folder.mkdir(parents=True)
    image = np.full((tracking_world.HEIGHT_PX, tracking_world.WIDTH_PX, 3), 90, np.uint8)
    for number in range(frames):
        cv2.imwrite(str(folder / f"{number:06d}{suffix}"), image)
    return root


@pytest.mark.parametrize("suffix", [".jpg", ".png"])
def test_the_camera_that_has_images_is_opened(tmp_path: Path, suffix: str) -> None:
    root = with_right_camera(tmp_path, suffix=suffix)
    assert camera_with_images(root, "0002") == 3
    assert camera_with_images(root, "0007") is None
    right, left = open_tracking(root, "0002"), open_tracking(root, "0002", 2)
    assert (right.number, left.number, left.images) == (3, 2, None)
    assert right.images == root / "image_03" / "0002"
    assert right.T_cam0_camera[0, 3] == pytest.approx(BASELINE_M)
    ours, theirs = (s.vehicle_truth(s.labels_of(0)[0], 0) for s in (right, left))
    assert ours.y_m == pytest.approx(theirs.y_m + BASELINE_M)  # seen from further right it is further left


def test_boxes_are_where_the_camera_sees_the_cars(tmp_path: Path) -> None:
    right = open_tracking(with_right_camera(tmp_path), "0002")
    for car in tracking_world.CARS:
        label = next(label for label in right.labels_of(0) if label.track == car.track)
        assert label.box_px == pytest.approx(tracking_world.box(car.z_m, car.x_m - BASELINE_M))
        assert label.truncated == 0


def test_labels_outside_the_image_are_truncated_or_dropped(tmp_path: Path) -> None:
    right = open_tracking(with_right_camera(tmp_path), "0002")
    label, T = right.labels_of(0)[0], right.T_cam0_camera

    def seen(x_m: float, z_m: float, **changed: object) -> list[tuple[tuple[float, ...], float]]:
        moved = replace(label, place_m=(x_m, tracking_world.HEIGHT_M, z_m), **changed)
        return [(found.box_px, found.truncated) for found in project_labels([moved], right.camera, T)]

    ((box, truncated),) = seen(-8.0, 9.5)
    assert (box[0], truncated) == (0.0, 1.0)
    assert seen(-40.0, 9.5) == []
    assert seen(0.0, -20.0) == []
    ((box, truncated),) = seen(1.5, 1.0)  # beside the camera: half of it is behind
    assert truncated == 1.0
    assert box[2:] == (tracking_world.WIDTH_PX, tracking_world.HEIGHT_PX)
    assert all(map(math.isfinite, box))
    region = replace(label, kind="DontCare", track=-1, place_m=(-1000.0, -1000.0, -1000.0))
    assert project_labels([region], right.camera, T) == [region]


@pytest.mark.skipif(not (KITTI / "image_03" / "0005").is_dir(), reason=f"no real images in {KITTI}")
def test_real_bodies_project_to_the_boxes_that_were_drawn() -> None:
    """In camera 2, whose boxes were drawn, hulls and labels must be one."""
    drawn = open_tracking(KITTI, "0005", 2)
    whole = [label for label in drawn.labels if label.kind == "Car" and label.truncated <= 0 and label.occluded == 0]
    apart = []
    for label in whole:
        hull = hull_px(label, drawn.camera, drawn.T_cam0_camera)
        apart.append((hull - label.box_px) / (label.box_px[3] - label.box_px[1]))
    assert np.abs(np.median(apart, axis=0)).max() < 0.02
    assert np.percentile(np.abs(apart), 95) < 0.05
    assert open_tracking(KITTI, "0005").number == 3
