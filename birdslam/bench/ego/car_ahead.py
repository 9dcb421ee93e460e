"""The distance to the car ahead, which matters most to a planner, against LiDAR.

LiDAR returns stand beside the images as `lidar_cam0/NNNNNN.npy`, (N, 3) metres in the axes of camera 0.
"""

from __future__ import annotations

from pathlib import Path

import msgspec
import numpy as np

from birdslam.geometry.arrays import Floats
from birdslam.geometry.camera import Camera, GroundPlane
from birdslam.sources.kitti import KittiRecording
from birdslam.sources.recording import Recording
from birdslam.trajectory import inverse
from birdslam.types import Estimate, Ground, Measurements, VehicleEdge, VehicleEstimate

SIDE_FRACTION, TOP_FRACTION = 0.15, 0.1  # of the box, cut off: there it shows what is behind the car
ROAD_CLEARANCE_M, OVERHEAD_M = 0.25, 3.0  # over the road; lower returns are the road, higher ones hang over it
NEAR_FACE_PERCENTILE = 10.0  # a few returns in front of the face are of something else
FEWEST_RETURNS = 20


class CarAheadReport(msgspec.Struct, frozen=True, kw_only=True):
    """Errors of the distance to the near face of the car ahead, as fractions of the LiDAR's distance."""

    frames: int  # in which a tracked vehicle ahead had LiDAR returns
    error_median_rel: float | None = None
    error_p90_rel: float | None = None
    bias_median_rel: float | None = None  # signed: above 0 is too far


class CarAhead:
    """Collects, frame by frame, where the car ahead was estimated and where the LiDAR saw it."""

    def __init__(self, recording: KittiRecording) -> None:
        self._recording = recording
        self._T_cam_cam0 = inverse(recording.T_cam0_cam())
        self._box_px: dict[int, tuple[float, ...]] = {}
        self._box_frame = -1
        self.distances_m: list[tuple[int, float, float]] = []  # frame, estimated, LiDAR

    @staticmethod
    def of(recording: Recording) -> CarAhead | None:
        """A collector for this recording, None where it has no LiDAR."""
        if isinstance(recording, KittiRecording) and _lidar_folder(recording).is_dir():
            return CarAhead(recording)
        return None

    def add_measurements(self, measurements: Measurements) -> None:
        """What was seen in a frame; its estimate comes next."""
        self._box_px = {
            edge.vehicle: edge.box_px for edge in measurements.cv if _is_ahead(edge, self._recording.camera)
        }
        self._box_frame = measurements.frame_id

    def add_estimate(self, estimate: Estimate) -> None:
        """The estimate of the frame whose measurements came last."""
        if estimate.frame_id != self._box_frame:
            return
        seen = [vehicle for vehicle in estimate.vehicles if vehicle.vehicle in self._box_px]
        if not seen:
            return
        distance_m, vehicle = min((near_face_m(estimate, v), v.vehicle) for v in seen)
        lidar_m = self._lidar_m(estimate.frame_id, self._box_px[vehicle], estimate.ground)
        if lidar_m is not None:
            self.distances_m.append((estimate.frame_id, distance_m, lidar_m))

    def report(self) -> CarAheadReport:
        """The errors so far."""
        if not self.distances_m:
            return CarAheadReport(frames=0)
        _, estimated, lidar = np.array(self.distances_m).T
        error = estimated / lidar - 1.0
        return CarAheadReport(
            frames=len(error),
            error_median_rel=float(np.median(np.abs(error))),
            error_p90_rel=float(np.percentile(np.abs(error), 90.0)),
            bias_median_rel=float(np.median(error)),
        )

    def _lidar_m(self, frame_id: int, box_px: tuple[float, ...], ground: Ground | None) -> float | None:
        path = _lidar_folder(self._recording) / f"{self._recording.numbers[frame_id]:06d}.npy"
        if not path.is_file():
            return None
        camera = self._recording.camera
        mount = camera.ground if ground is None else GroundPlane(ground.height_m, ground.pitch_rad, ground.roll_rad)
        points = np.load(path).astype(np.float64) @ self._T_cam_cam0[:3, :3].T + self._T_cam_cam0[:3, 3]
        return lidar_distance_m(camera, mount, points, box_px)


def _lidar_folder(recording: KittiRecording) -> Path:
    return recording.directory.parent / "lidar_cam0"


def _is_ahead(edge: VehicleEdge, camera: Camera) -> bool:
    """Whether the vehicle's box crosses the image column in which the car drives on."""
    return edge.box_px[0] < camera.cx_px < edge.box_px[2]


def near_face_m(estimate: Estimate, vehicle: VehicleEstimate) -> float:
    """Distance ahead of the camera to the near face: the footprint's centre less half its length along the heading."""
    T_ego_vehicle = estimate.T_world_ego.between(vehicle.T_world_vehicle)
    return T_ego_vehicle.x_m - 0.5 * vehicle.length_m * abs(float(np.cos(T_ego_vehicle.yaw_rad)))


def lidar_distance_m(camera: Camera, mount: GroundPlane, points_cam: Floats, box_px: tuple[float, ...]) -> float | None:
    """Distance ahead (ego's x) to the near face of what fills the box, of returns (N, 3) in camera axes.

    None where fewer than FEWEST_RETURNS lie in the inner part of the box and off the road.
    """
    points_cam = points_cam[points_cam[:, 2] > 0.5]
    px = points_cam[:, :2] / points_cam[:, 2:] * [camera.fx_px, camera.fy_px] + [camera.cx_px, camera.cy_px]
    x1, y1, x2, y2 = box_px
    side_px, top_px = SIDE_FRACTION * (x2 - x1), TOP_FRACTION * (y2 - y1)
    inside = (px > [x1 + side_px, y1 + top_px]).all(axis=1) & (px < [x2 - side_px, y2]).all(axis=1)
    points = points_cam[inside] @ mount.R_ego_cam.T + [0.0, 0.0, mount.height_m]
    ahead_m = points[(points[:, 2] > ROAD_CLEARANCE_M) & (points[:, 2] < OVERHEAD_M), 0]
    return float(np.percentile(ahead_m, NEAR_FACE_PERCENTILE)) if len(ahead_m) >= FEWEST_RETURNS else None
