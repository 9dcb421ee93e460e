"""KITTI tracking (Geiger et al., 2012) as a benchmark: calibration, true poses, labels and 2-D detections.

ROOT holds for each sequence N: `calib/N.txt`, `label_02/N.txt`, `oxts/N.txt` (GPS/IMU) or `pose_cam0/N.txt` (KITTI 3x4
rows), and optionally `image_02/N/`, `image_03/N/` and `det_02_rrc/{Car,Pedestrian}/N.txt`. Labels are in the axes of
camera 0, boxes in the image of camera 2 (camera 3: label_projection.py). Errors are DatasetError with file and line.
"""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from birdslam.geometry.arrays import Floats
from birdslam.geometry.camera import Camera
from birdslam.geometry.se2 import SE2
from birdslam.perception import Detections
from birdslam.sources.kitti import KITTI_HEIGHT_M, find_images, read_image, read_projection
from birdslam.sources.label_projection import Label, project_labels
from birdslam.sources.recording import DatasetError
from birdslam.trajectory import Transform, as_poses, inverse, read_kitti

COLOUR_CAMERAS = (2, 3)  # left, right
IMAGE_SIZE_PX = (1242, 375)  # of most sequences, used without images
# Image sizes of other recording days by rectified focal length
SIZES_BY_FOCAL_PX = {707.0493: (1224, 370), 718.3351: (1238, 374), 718.856: (1241, 376), 707.0912: (1226, 370)}
MAX_FOCAL_DIFFERENCE_PX = 0.01
EARTH_RADIUS_M = 6378137.0
DETECTED_LABELS = {"Car": "car", "Pedestrian": "person"}  # detector's folder -> label
VEHICLE_KINDS = ("Car", "Van", "Truck")  # of the labels
_LABEL_COLUMNS, _OXTS_COLUMNS, _DETECTION_COLUMNS = 17, 30, 6


@dataclass(frozen=True)
class TrackingSequence:
    """`poses` (N, 4, 4) are `T_first_i` of camera 0; label boxes are of `camera`, whose `number` is 2 or 3."""

    name: str
    camera: Camera
    T_cam0_camera: Transform
    poses: Transform
    labels: tuple[Label, ...]
    images: Path | None
    number: int = COLOUR_CAMERAS[0]

    def __len__(self) -> int:
        return len(self.poses)

    @property
    def camera_poses(self) -> Transform:
        """(N, 4, 4) `T_first_i` of `camera`."""
        out: Transform = inverse(self.T_cam0_camera) @ self.poses @ self.T_cam0_camera
        return out

    def labels_of(self, frame: int) -> list[Label]:
        """The labels of one frame."""
        first = bisect_left(self.labels, frame, key=lambda label: label.frame)
        return list(self.labels[first : bisect_right(self.labels, frame, lo=first, key=lambda label: label.frame)])

    def ego_truth(self, first: int) -> list[SE2]:
        """`T_world_ego` of each frame; world is the ego at frame `first`, projected to its level plane."""
        poses = self.camera_poses
        return [_project_to_ground(pose) for pose in inverse(poses[first]) @ poses]

    def vehicle_truth(self, label: Label, first: int) -> SE2:
        """`T_world_vehicle` of a label in the world of `ego_truth`."""
        T_cam0_vehicle = np.eye(4)
        T_cam0_vehicle[:3, :3] = Rotation.from_euler("y", label.rotation_y_rad + math.pi / 2.0).as_matrix()  # z ahead
        T_cam0_vehicle[:3, 3] = label.place_m
        poses = inverse(self.T_cam0_camera) @ inverse(self.poses[first]) @ self.poses[label.frame]
        return _project_to_ground(poses @ T_cam0_vehicle)


def _project_to_ground(T_first_i: Transform) -> SE2:
    """Projects a pose in camera axes to the ground plane."""
    forward = T_first_i[:3, 2]
    return SE2(float(T_first_i[2, 3]), float(-T_first_i[0, 3]), math.atan2(-forward[0], forward[2]))


def camera_with_images(root: Path, name: str) -> int | None:
    """Number of the colour camera that has images of a sequence, the left one first; None without images."""
    return next((number for number in COLOUR_CAMERAS if (root / f"image_{number:02d}" / name).is_dir()), None)


def open_tracking(root: Path, name: str, number: int | None = None) -> TrackingSequence:
    """Opens a sequence of a KITTI tracking folder for colour camera 2 or 3; None: the one with images, else 2.

    Raises DatasetError.
    """
    if not root.is_dir():
        raise DatasetError(f"{root}: no such directory")
    if number is None:
        number = camera_with_images(root, name) or COLOUR_CAMERAS[0]
    calibration = root / "calib" / f"{name}.txt"
    P = read_projection(calibration, f"P{number}")
    T_cam0_camera = np.eye(4)
    T_cam0_camera[:3, 3] = -np.linalg.solve(P[:, :3], P[:, 3])
    labels = read_labels(root / "label_02" / f"{name}.txt")
    poses = _read_poses(root, name, calibration)
    if labels and labels[-1].frame >= len(poses):
        raise DatasetError(
            f"{root}: sequence {name} has {len(poses)} poses, but its labels end at frame {labels[-1].frame}"
        )
    images: Path | None = root / f"image_{number:02d}" / name
    width_px, height_px = _size_px(float(P[0, 0]))
    if images is not None and images.is_dir():
        first = next(iter(find_images(images).values()))
        try:
            height_px, width_px = read_image(first).shape[:2]
        except ValueError as error:
            raise DatasetError(f"{first}: {error}") from None
    else:
        images = None
    try:
        camera = Camera(width_px, height_px, P[0, 0], P[1, 1], P[0, 2], P[1, 2], height_m=KITTI_HEIGHT_M)
    except ValueError as error:
        raise DatasetError(f"{calibration}: P{number}: {error}") from None
    if number != COLOUR_CAMERAS[0]:
        labels = project_labels(labels, camera, T_cam0_camera)
    return TrackingSequence(name, camera, T_cam0_camera, poses, tuple(labels), images, number)


def _size_px(fx_px: float) -> tuple[int, int]:
    """Width and height of the images by focal length; they tell which boxes the image border cuts."""
    days = (size for focal_px, size in SIZES_BY_FOCAL_PX.items() if abs(focal_px - fx_px) < MAX_FOCAL_DIFFERENCE_PX)
    return next(days, IMAGE_SIZE_PX)


def _read_poses(root: Path, name: str, calibration: Path) -> Transform:
    oxts, rows = root / "oxts" / f"{name}.txt", root / "pose_cam0" / f"{name}.txt"
    if oxts.is_file():
        return read_oxts(oxts, calibration)
    if not rows.is_file():
        raise DatasetError(f"{root}: sequence {name} has neither {oxts.relative_to(root)} nor {rows.relative_to(root)}")
    try:
        poses = as_poses(read_kitti(rows))
    except ValueError as error:
        raise DatasetError(str(error)) from None
    if not len(poses):
        raise DatasetError(f"{rows}: has no poses")
    return poses


def read_oxts(path: Path, calibration: Path) -> Transform:
    """(N, 4, 4) `T_first_i` of camera 0 from GPS/IMU rows: latitude, longitude, altitude, roll, pitch, yaw, ...

    As in the devkit: Mercator projection about the first latitude, then the chain IMU - Velodyne - camera 0.
    """
    rows = _read_table(path, _OXTS_COLUMNS, None, "GPS/IMU reading")
    if not len(rows):
        raise DatasetError(f"{path}: has no readings")
    latitude, longitude = np.deg2rad(rows[:, 0]), np.deg2rad(rows[:, 1])
    if np.abs(rows[:, 0]).max() >= 89.0:
        raise DatasetError(f"{path}: line {int(np.argmax(np.abs(rows[:, 0]))) + 1}: invalid latitude")
    scale_m = math.cos(latitude[0]) * EARTH_RADIUS_M
    T_world_imu = np.tile(np.eye(4), (len(rows), 1, 1))
    T_world_imu[:, :3, :3] = Rotation.from_euler("ZYX", rows[:, [5, 4, 3]]).as_matrix()
    T_world_imu[:, 0, 3] = scale_m * longitude
    T_world_imu[:, 1, 3] = scale_m * np.log(np.tan(math.pi / 4.0 + latitude / 2.0))
    T_world_imu[:, 2, 3] = rows[:, 2]
    rectify = np.eye(4)
    rectify[:3, :3] = _read_calibration(calibration, ("R0_rect", "R_rect"), 9).reshape(3, 3)
    T_cam0_velo, T_velo_imu = np.eye(4), np.eye(4)
    T_cam0_velo[:3] = _read_calibration(calibration, ("Tr_velo_to_cam", "Tr_velo_cam"), 12).reshape(3, 4)
    T_velo_imu[:3] = _read_calibration(calibration, ("Tr_imu_to_velo", "Tr_imu_velo"), 12).reshape(3, 4)
    T_cam0_imu = rectify @ T_cam0_velo @ T_velo_imu
    T_world_cam0 = T_world_imu @ inverse(T_cam0_imu)
    out: Transform = inverse(T_world_cam0[0]) @ T_world_cam0
    return out


def read_labels(path: Path) -> list[Label]:
    """All labels of a tracking label file, ordered by frame. "DontCare" regions (track -1) have no position."""
    found = []
    for number, words in _lines(path, None):
        if len(words) < _LABEL_COLUMNS:
            raise DatasetError(f"{path}: line {number} has {len(words)} columns, a label has {_LABEL_COLUMNS}")
        try:
            frame, track, occluded = (int(words[k]) for k in (0, 1, 4))
            numbers = [float(word) for word in (words[3], *words[5:_LABEL_COLUMNS])]
        except ValueError:
            raise DatasetError(f"{path}: line {number} is not a label: {' '.join(words)[:60]!r}") from None
        if frame < 0 or not all(map(math.isfinite, numbers)):
            raise DatasetError(f"{path}: line {number} has invalid numbers")
        truncated, _, x1, y1, x2, y2, height_m, width_m, length_m, x_m, y_m, z_m, rotation_y_rad = numbers
        found.append(
            Label(
                frame=frame,
                track=track,
                kind=words[2],
                truncated=truncated,
                occluded=occluded,
                box_px=(x1, y1, x2, y2),
                height_m=height_m,
                width_m=width_m,
                length_m=length_m,
                place_m=(x_m, y_m, z_m),
                rotation_y_rad=rotation_y_rad,
            )
        )
    return sorted(found, key=lambda label: (label.frame, label.track))


def read_detections(folder: Path, name: str, frames: int) -> list[Detections]:
    """Detections per frame from `folder/{Car,Pedestrian}/N.txt`, rows `frame,x1,y1,x2,y2,score` in pixels."""
    files = {label: folder / kind / f"{name}.txt" for kind, label in DETECTED_LABELS.items()}
    if not any(path.is_file() for path in files.values()):
        raise DatasetError(f"{folder}: no detections of sequence {name} ({'/, '.join(DETECTED_LABELS)}/{name}.txt)")
    rows, labels = [np.zeros((0, _DETECTION_COLUMNS))], []
    for label, path in files.items():
        if path.is_file():
            table = _read_table(path, _DETECTION_COLUMNS, ",", "detection (frame,x1,y1,x2,y2,score)")
            rows.append(table)
            labels += [label] * len(table)
    table = np.vstack(rows)
    out = []
    for frame in range(frames):
        at = np.flatnonzero(table[:, 0] == frame)
        at = at[np.argsort(-table[at, 5], kind="stable")]
        out.append(Detections(table[at, 1:5], table[at, 5], tuple(labels[i] for i in at)))
    return out


def _lines(path: Path, separator: str | None) -> list[tuple[int, list[str]]]:
    try:
        text = path.read_text(encoding="ascii")
    except OSError as error:
        raise DatasetError(f"{path}: can't be read: {error.strerror}") from None
    except UnicodeDecodeError:
        raise DatasetError(f"{path}: not a text file") from None
    return [(n, line.split(separator)) for n, line in enumerate(text.splitlines(), start=1) if line.strip()]


def _read_table(path: Path, columns: int, separator: str | None, what: str) -> Floats:
    rows = []
    for number, words in _lines(path, separator):
        try:
            row = [float(word) for word in words]
        except ValueError:
            row = []
        if len(row) != columns or not all(map(math.isfinite, row)):
            raise DatasetError(f"{path}: line {number} is not a {what} of {columns} finite numbers")
        rows.append(row)
    return np.array(rows, dtype=np.float64).reshape(len(rows), columns)


def _read_calibration(path: Path, keys: tuple[str, ...], count: int) -> Floats:
    for _, words in _lines(path, None):
        if words[0].rstrip(":") in keys:
            try:
                numbers = np.array([float(word) for word in words[1:]])
            except ValueError:
                raise DatasetError(f"{path}: {words[0]} contains a value that is not a number") from None
            if numbers.size != count or not np.isfinite(numbers).all():
                raise DatasetError(f"{path}: {words[0]} needs {count} finite numbers")
            return numbers
    raise DatasetError(f"{path}: has no {keys[0]}, which oxts needs")
