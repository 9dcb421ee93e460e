"""A small drive in KITTI tracking's layout, with exact labels and boxes: what the benchmark must find without error."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

FX, CX, CY, HEIGHT_M = 721.5377, 609.5593, 172.854, 1.65
LENGTH_M, WIDTH_M, CAR_HEIGHT_M = 4.0, 1.7, 1.53  # as the class prior has them
WIDTH_PX, HEIGHT_PX = 1242, 375
CALIBRATION = f"""P2: {FX} 0 {CX} 0 0 {FX} {CY} 0 0 0 1 0
R0_rect: 1 0 0 0 1 0 0 0 1
Tr_velo_to_cam: 0 -1 0 0 0 0 -1 0 1 0 0 0
Tr_imu_to_velo: 1 0 0 0 0 1 0 0 0 0 1 0
"""


@dataclass(frozen=True)
class Car:
    """A straight drive: where it is in frame 0 (z ahead, x right of camera 0's start) and metres a frame ahead."""

    track: int
    z_m: float
    x_m: float
    step_m: float


CARS = (Car(3, 12.0, 0.0, 1.0), Car(7, 20.0, -4.0, 0.9), Car(9, 30.0, 5.0, 0.0))
EGO_STEP_M = 0.8


def box(z_m: float, x_m: float) -> tuple[float, float, float, float]:
    """Outline in the image of a car headed ahead whose centre is at (x, z) in camera 0."""
    corners = [(x_m + sx * WIDTH_M / 2, z_m + sz * LENGTH_M / 2) for sx in (-1, 1) for sz in (-1, 1)]
    u = [CX + FX * x / z for x, z in corners]
    v = [CY + FX * y / z for _, z in corners for y in (HEIGHT_M, HEIGHT_M - CAR_HEIGHT_M)]
    return min(u), min(v), max(u), max(v)


def pose_row(k: int) -> NDArray[np.float64]:
    out = np.eye(4)[:3]
    out[2, 3] = EGO_STEP_M * k
    return out


def write(root: Path, name: str = "0002", frames: int = 40, with_oxts: bool = False) -> Path:
    """The folder ROOT of one sequence."""
    labels, boxes = [], []
    for k in range(frames):
        for car in CARS:
            z_m = car.z_m + (car.step_m - EGO_STEP_M) * k
            if z_m < 6.0:
                continue
            x1, y1, x2, y2 = box(z_m, car.x_m)
            if x1 < 5.0 or x2 > WIDTH_PX - 5.0:
                continue
            labels.append(
                f"{k} {car.track} Car 0 0 0 {x1} {y1} {x2} {y2} {CAR_HEIGHT_M} {WIDTH_M} {LENGTH_M} "
                f"{car.x_m} {HEIGHT_M} {z_m} {-math.pi / 2}"
            )
            boxes.append(f"{k},{x1},{y1},{x2},{y2},0.99")
    files = {
        f"calib/{name}.txt": CALIBRATION,
        f"label_02/{name}.txt": "\n".join(labels) + "\n",
        f"det_02_rrc/Car/{name}.txt": "\n".join(boxes) + "\n",
    }
    if with_oxts:
        metres = 6378137.0 * math.pi / 180.0
        files[f"oxts/{name}.txt"] = "".join(
            f"0 {EGO_STEP_M * k / metres:.15f} 0 0 0 0 {' '.join(['0'] * 24)}\n" for k in range(frames)
        )
    else:
        files[f"pose_cam0/{name}.txt"] = "".join(
            " ".join(f"{number:.9e}" for number in pose_row(k).ravel()) + "\n" for k in range(frames)
        )
    for path, text in files.items():
        (root / path).parent.mkdir(parents=True, exist_ok=True)
        (root / path).write_text(text)
    return root
