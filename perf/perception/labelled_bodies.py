"""Errors of size and heading of a network's bodies in real images, compared with the class prior.

Images and labels of KITTI tracking, 0002 and 0005. A body belongs to the label that its box overlaps most. Errors of
size are means over a vehicle's observations, since they are correlated.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from birdslam.geometry.arrays import Floats
from birdslam.geometry.camera import Camera
from birdslam.perception import Detections
from birdslam.sources.kitti import find_images, read_image
from birdslam.sources.kitti_tracking import open_tracking
from birdslam.sources.label_projection import Label
from birdslam.sources.recording import DatasetError
from birdslam.trajectory import Transform, inverse
from birdslam.vehicles.placement.localisation import DIMENSIONS
from birdslam.world.training.grading import box_ious

SEQUENCES = ("0002", "0005")
KINDS = {"cars": ("Car",), "cars and vans": ("Car", "Van")}  # the network labels vans as cars, like most detectors
VEHICLES = ("car", "truck", "bus")
RANGES_M = ((0.0, 15.0), (15.0, 30.0), (30.0, 50.0))
SAME_IOU = 0.5
MAX_OCCLUDED = 1  # KITTI: partly
OFF_DEG = 10.0  # min. error of a wrong heading
PRIOR_M = (DIMENSIONS["car"].length_m, DIMENSIONS["car"].width_m, DIMENSIONS["car"].height_m)
# A row of `errors`: depth (m), heading error (rad), 1 if truncated or occluded, logs of the estimated over the true
# size (length, width, height), of the prior over the true size
DEPTH, OFF, CUT, SIZE, PRIOR = 0, 1, 2, slice(3, 6), slice(6, 9)

Look = Callable[[NDArray[np.uint8]], Detections | None]


def measure(look: Look, data: Path) -> dict[str, dict[str, float]]:
    """Results by kind, visibility and range; empty without labelled images."""
    rows: list[Floats] = []
    vehicles: list[str] = []
    kinds: list[str] = []
    for name in SEQUENCES:
        for image, here, camera, T_cam0_camera in _labelled(data / "kitti_tracking" / "training", name):
            found = look(image)
            if found is None or not here:
                continue
            for label, row in errors(found.only(VEHICLES), here, camera, T_cam0_camera):
                rows.append(row)
                vehicles.append(f"{name}:{label.track}")
                kinds.append(label.kind)
    if not rows:
        return {}
    table, of, kind = np.array(rows), np.array(vehicles), np.array(kinds)
    out = {}
    for title, counted in KINDS.items():
        for cut in (False, True):
            for low_m, high_m in RANGES_M:
                near = (table[:, DEPTH] >= low_m) & (table[:, DEPTH] < high_m)
                some = near & np.isin(kind, counted) & ((table[:, CUT] > 0.0) == cut)
                if some.any():
                    seen = "cut or hidden" if cut else "in view"
                    out[f"{title} {seen} {low_m:.0f}-{high_m:.0f} m"] = summary(table[some], of[some])
    return out


def _labelled(root: Path, name: str) -> Iterator[tuple[NDArray[np.uint8], list[Label], Camera, Transform]]:
    try:
        sequence = open_tracking(root, name)
    except DatasetError:
        return
    if sequence.images is None:
        return
    for frame, path in find_images(sequence.images).items():
        yield np.ascontiguousarray(read_image(path)), sequence.labels_of(frame), sequence.camera, sequence.T_cam0_camera


def errors(
    found: Detections, labels: Sequence[Label], camera: Camera, T_cam0_camera: Transform
) -> list[tuple[Label, Floats]]:
    """A row for each vehicle label with a matching body."""
    here = [label for label in labels if any(label.kind in kinds for kinds in KINDS.values())]
    if found.boxes3d is None or not len(found.boxes_px) or not here:
        return []
    shared = box_ious(np.array([label.box_px for label in here]), found.boxes_px)
    bodies, out = found.boxes3d.in_metres(camera), []
    for i, label in enumerate(here):
        j = int(shared[i].argmax())
        if shared[i, j] < SAME_IOU or shared[:, j].argmax() != i:
            continue
        place_m = inverse(T_cam0_camera) @ np.append(label.place_m, 1.0)
        # KITTI's yaw is about down, 0 to the right; ours about up, 0 ahead
        yaw_rad = math.atan2(-math.cos(label.rotation_y_rad), -math.sin(label.rotation_y_rad))
        alpha_rad = yaw_rad - math.atan2(-place_m[0], place_m[2])
        off_rad = math.remainder(float(bodies.alpha_rad[j]) - alpha_rad, 2.0 * math.pi)
        true_m = np.array([label.length_m, label.width_m, label.height_m])
        cut = float(label.truncated > 0.0 or label.occluded > MAX_OCCLUDED)
        sizes = np.log(bodies.size_m[j] / true_m), np.log(PRIOR_M / true_m)
        out.append((label, np.hstack([place_m[2], off_rad, cut, *sizes])))
    return out


def summary(table: Floats, vehicles: NDArray[np.str_]) -> dict[str, float]:
    """Summary of rows of `errors`: headings per observation, sizes per vehicle (RMS of logs, also of the prior)."""
    off_deg = np.degrees(np.abs(table[:, OFF]))
    axis_deg = np.minimum(off_deg, 180.0 - off_deg)
    means = np.array([table[vehicles == vehicle].mean(axis=0) for vehicle in np.unique(vehicles)])
    said, prior = (np.sqrt(np.mean(np.square(means[:, part]), axis=0)) for part in (SIZE, PRIOR))
    figures = {
        "sights": len(table),
        "vehicles": len(means),
        "axis_deg_p50": float(np.median(axis_deg)),
        "axis_off": float(np.mean(axis_deg > OFF_DEG)),
        "swapped": float(np.mean(off_deg > 90.0)),
    }
    for k, name in enumerate(("length", "width", "height")):
        figures |= {f"{name}_rms": float(said[k]), f"{name}_prior_rms": float(prior[k])}
    return figures
