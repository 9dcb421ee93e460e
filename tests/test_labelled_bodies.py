"""Network bodies compared with labels: the matching, and the shipped network's stated sigmas."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from birdslam.geometry.camera import Camera
from birdslam.perception import Boxes3d, Detections, ModelSpec, load_network
from birdslam.perception.decoding.multitask import SIGMA_SIZE_REL
from birdslam.perception.manifest import SHIPPED_MULTITASK, SHIPPED_NETWORKS
from birdslam.perf.perception.labelled_bodies import CUT, DEPTH, OFF, PRIOR, PRIOR_M, SIZE, errors, summary
from birdslam.sources.kitti import find_images, read_image
from birdslam.sources.kitti_tracking import open_tracking
from birdslam.sources.label_projection import Label

CAMERA = Camera(1242, 375, 721.5, 721.5, 609.6, 172.9, 1.65)
BOX = (550.0, 170.0, 650.0, 250.0)
AHEAD_RAD = -math.pi / 2.0  # of a label that faces away from the camera


def label(kind: str = "Car", truncated: float = 0.0) -> Label:
    return Label(0, 3, kind, truncated, 0, BOX, 1.5, 1.6, 4.0, (0.0, 1.65, 20.0), AHEAD_RAD)


def found(alpha_rad: float, length_m: float) -> Detections:
    body = Boxes3d(
        centre_px=np.array([[610.0, 210.0]]),
        depth_m=np.array([20.0]),
        size_m=np.array([[length_m, 1.6, 1.5]]),
        alpha_rad=np.array([alpha_rad]),
        sigma_depth_m=np.ones(1),
        sigma_size_m=np.ones((1, 3)),
        sigma_alpha_rad=np.ones(1),
        flip=np.zeros(1),
    )
    return Detections(np.array([BOX]), np.array([0.9]), ("car",), body)


def test_body_is_compared_with_the_label_of_its_box() -> None:
    ((of, row),) = errors(found(0.1, 4.4), [label()], CAMERA, np.eye(4))
    assert of.track == 3
    assert (row[DEPTH], row[OFF], row[CUT]) == pytest.approx((20.0, 0.1, 0.0))
    assert row[SIZE] == pytest.approx([math.log(1.1), 0.0, 0.0])
    assert row[PRIOR] == pytest.approx(np.log(np.array(PRIOR_M) / (4.0, 1.6, 1.5)))
    ((_, cut),) = errors(found(0.1, 4.4), [label(truncated=1.0)], CAMERA, np.eye(4))
    assert cut[CUT] == 1.0
    assert not errors(found(0.1, 4.4), [label("Pedestrian")], CAMERA, np.eye(4))


def test_headings_count_per_observation_and_sizes_per_vehicle() -> None:
    sights = [(0.0, 4.0), (math.pi, 4.8), (0.5, 4.4)]
    rows = [errors(found(*sight), [label()], CAMERA, np.eye(4))[0][1] for sight in sights]
    row = summary(np.array(rows), np.array(["a", "a", "b"]))
    assert (row["sights"], row["vehicles"]) == (3, 2)
    assert (row["axis_off"], row["swapped"]) == pytest.approx((1 / 3, 1 / 3))
    assert row["length_rms"] == pytest.approx(math.hypot(math.log(1.2) / 2.0, math.log(1.1)) / math.sqrt(2.0))


def test_the_shipped_networks_sigmas_of_size_hold_on_real_cars(data_dir: Path) -> None:
    network = load_network("multitask", ModelSpec(path=str(SHIPPED_NETWORKS / SHIPPED_MULTITASK), threads=1))
    sizes: dict[str, list[np.ndarray]] = {}
    for name in ("0002", "0005"):
        sequence = open_tracking(data_dir / "kitti_tracking" / "training", name)
        assert sequence.images is not None
        for frame, path in list(find_images(sequence.images).items())[::6]:
            seen = network.run(np.ascontiguousarray(read_image(path)))
            assert seen is not None
            assert seen.detections is not None
            here = [each for each in sequence.labels_of(frame) if each.kind == "Car"]
            for of, row in errors(seen.detections, here, sequence.camera, sequence.T_cam0_camera):
                if row[DEPTH] < 50.0:
                    sizes.setdefault(f"{name}:{of.track}", []).append(row[SIZE])
    means = np.array([np.mean(each, axis=0) for each in sizes.values()])
    assert len(means) > 25
    assert (np.mean(np.square(means / SIGMA_SIZE_REL), axis=0) < 1.5).all()
