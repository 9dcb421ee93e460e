"""Shows a drive in rerun (https://rerun.io): image with boxes, world, bird's-eye view, latencies; docs/recording.md.

Entities: `camera` and `camera/boxes`; `world/ego`, `world/path`, `world/vehicles`, `world/map` with 2-sigma ellipses;
`bev` from above, in ego, x forward is up; `latency/*` in ms; `ego/*` speed and 1-sigma of the pose; `status`.
"""

from __future__ import annotations

import math
import os
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import msgspec
import numpy as np

from birdslam.geometry.arrays import Floats
from birdslam.geometry.camera import Camera
from birdslam.geometry.se2 import SE2
from birdslam.runtime.configuration import ConfigurationError
from birdslam.runtime.latency import key_of, stages
from birdslam.runtime.recording.foxglove import CompressedImage
from birdslam.runtime.recording.recording import Latency, Recording
from birdslam.runtime.recording.scene import VEHICLE_HEIGHT_M, between_looks, curve_points, ellipse
from birdslam.runtime.transport.bus import Bus, BusError
from birdslam.runtime.transport.presence import ring_path
from birdslam.runtime.transport.ring import FrameReader
from birdslam.runtime.wire import decode
from birdslam.trajectory import ego_pose, mount_pose
from birdslam.types import Estimate, FrameRef, MapUpdate, Measurements, Status, VehicleEstimate

try:
    import rerun as rr
    import rerun.blueprint as blueprint
except ImportError as error:
    raise ConfigurationError(f"view: needs rerun: pip install 'birdslam[view]' ({error})") from None

APPLICATION = "BirdSLAM"
BLOCK_FRAMES = 100  # path and map are sent in blocks; only the last block is sent again as it grows
JPEG_QUALITY = 80
QUEUE, IMAGES = 64, 2
TURN_S = 0.2
EGO, SEEN, UNSEEN, ROAD = (30, 100, 230), (230, 110, 30), (150, 150, 150), (220, 220, 120)
READ = ("v1/frame", "v1/measurements", "v1/estimate", "v1/map", "/latency", "/camera/image")


class Viewer:
    """Sends records to a rerun stream; one frame is one point on its time line."""

    def __init__(self, stream: Any) -> None:
        self._stream = stream
        self._epoch: int | None = None
        self._block = -1
        self._path: list[tuple[float, float, float]] = []
        self._points: list[tuple[float, float, float]] = []
        self._last: Estimate | None = None
        self._height_m = 0.0
        self._stream.send_blueprint(_blueprint())
        self._stream.log("world", rr.ViewCoordinates.FLU, static=True)

    def at(self, frame_id: int, t_source_ns: int) -> None:
        """Sets the frame of the next log calls."""
        self._stream.set_time("frame", sequence=frame_id)
        self._stream.set_time("drive", duration=t_source_ns / 1e9)

    def camera(self, camera: Camera) -> None:
        """Logs the calibrated camera at its mount on the ego."""
        mount = mount_pose(camera.ground)
        pose = rr.Transform3D(translation=mount[:3, 3], mat3x3=mount[:3, :3])
        size = {"width": camera.width_px, "height": camera.height_px}
        self._stream.log("world/ego/camera", pose, rr.Pinhole(image_from_camera=camera.K, **size), static=True)

    def image(self, jpeg: bytes) -> None:
        """Logs the image of the frame."""
        self._stream.log("camera", rr.EncodedImage(contents=jpeg, media_type="image/jpeg"))

    def measurements(self, measurements: Measurements) -> None:
        """Logs the boxes in the image and the lane points in the bird's-eye view."""
        if Status.END_OF_SOURCE in measurements.status:
            return
        self.at(measurements.frame_id, measurements.t_source_ns)
        if not between_looks(measurements):
            seen = [(edge.box_px, edge.label, edge.vehicle) for edge in measurements.cv]
            seen += [(p.box_px, p.label, p.person) for p in measurements.people if p.age_ns == 0]
            boxes = np.array([box_px for box_px, _, _ in seen]).reshape(-1, 4)
            labels = [f"{label} {body}" for _, label, body in seen]
            shown = rr.Boxes2D(array=boxes, array_format=rr.Box2DFormat.XYXY, labels=labels, colors=SEEN)
            self._stream.log("camera/boxes", shown)
        lanes = np.array([(p.x_m, p.y_m) for p in measurements.lanes]).reshape(-1, 2)
        self._stream.log("bev/lanes", rr.Points2D(_above(lanes), radii=0.15, colors=ROAD))

    def estimate(self, estimate: Estimate) -> None:
        """Logs the poses of the ego and all road users."""
        if Status.END_OF_SOURCE in estimate.status:
            return
        self.at(estimate.frame_id, estimate.t_source_ns)
        if estimate.epoch != self._epoch:
            self._begin(estimate)
        T_world_ego = ego_pose(estimate.T_world_ego, estimate.attitude)
        self._height_m = estimate.attitude.z_m
        self._stream.log("world/ego", rr.Transform3D(translation=T_world_ego[:3, 3], mat3x3=T_world_ego[:3, :3]))
        self._stream.log("world/ego_ellipse", self._loops([ellipse(estimate.T_world_ego, estimate.cov)], EGO))
        self._grow(estimate.frame_id)
        self._path.append(tuple(T_world_ego[:3, 3].tolist()))
        self._stream.log(f"world/path/{self._block}", rr.LineStrips3D([self._path], colors=EGO))
        self._vehicles(estimate.road_users)
        self._bird_eye_view(estimate)
        self._plots(estimate)
        self._last = estimate

    def latency(self, latency: Latency) -> None:
        """Logs the latencies of the frame."""
        self._stream.set_time("frame", sequence=latency.frame_id)
        for name, ms in (("age", latency.age_ms), ("left", latency.left_ms), *latency.stages_ms.items()):
            if ms is not None:
                self._stream.log(f"latency/{key_of(name)}", rr.Scalars(ms))

    def map(self, update: MapUpdate) -> None:
        """Logs the new points of the map."""
        if update.epoch != self._epoch:
            return
        self._grow(update.frame_id)
        self._points += [(x, y, self._height_m) for x, y in (*update.landmarks_m, *update.lanes_m)]
        self._stream.log(f"world/map/{self._block}", rr.Points3D(self._points, radii=0.1, colors=ROAD))

    def _begin(self, estimate: Estimate) -> None:
        """Clears the world for a new epoch."""
        self._stream.log("world", rr.Clear(recursive=True))
        self._stream.log("status", rr.TextLog(f"epoch {estimate.epoch} starts", level="WARN"))
        self._epoch, self._block, self._last = estimate.epoch, -1, None
        self._path, self._points = [], []

    def _grow(self, frame_id: int) -> None:
        block = frame_id // BLOCK_FRAMES
        if block != self._block:
            self._block, self._path, self._points = block, self._path[-1:], []

    def _vehicles(self, vehicles: tuple[VehicleEstimate, ...]) -> None:
        heights = [v.height_m or VEHICLE_HEIGHT_M for v in vehicles]
        centers = np.array(
            [
                (v.T_world_vehicle.x_m, v.T_world_vehicle.y_m, self._height_m + height_m / 2.0)
                for v, height_m in zip(vehicles, heights, strict=True)
            ]
        ).reshape(-1, 3)
        colors = [SEEN if v.in_sight else UNSEEN for v in vehicles]
        speeds_mps = [math.hypot(*v.velocity_mps) for v in vehicles]
        boxes = rr.Boxes3D(
            centers=centers,
            sizes=[(v.length_m, v.width_m, height_m) for v, height_m in zip(vehicles, heights, strict=True)],
            quaternions=[_yaw_quaternion(v.T_world_vehicle.yaw_rad) for v in vehicles],
            labels=[f"{v.label} {v.vehicle}  {mps:.1f} m/s" for v, mps in zip(vehicles, speeds_mps, strict=True)],
            colors=colors,
        )
        self._stream.log("world/vehicles", boxes)
        velocities = [(*v.velocity_mps, 0.0) for v in vehicles]
        self._stream.log("world/vehicles/velocity", rr.Arrows3D(vectors=velocities, origins=centers, colors=colors))
        self._stream.log(
            "world/vehicles/ellipse", self._loops([ellipse(v.T_world_vehicle, v.cov) for v in vehicles], SEEN)
        )

    def _loops(self, outlines_m: list[Floats], color: tuple[int, int, int]) -> Any:
        loops = [np.vstack([outline, outline[:1]]) for outline in outlines_m]
        strips = [np.column_stack([loop, np.full(len(loop), self._height_m)]) for loop in loops]
        return rr.LineStrips3D(strips, colors=color)

    def _bird_eye_view(self, estimate: Estimate) -> None:
        T_ego_world = estimate.T_world_ego.inverse()
        footprints, ellipses = [_footprint(SE2(), 4.0, 1.7)], []
        for vehicle in estimate.road_users:
            T_ego_vehicle = T_ego_world @ vehicle.T_world_vehicle
            footprints.append(_footprint(T_ego_vehicle, vehicle.length_m, vehicle.width_m))
            ellipses.append(ellipse(T_ego_vehicle, vehicle.cov))
        colors = [EGO, *(SEEN if v.in_sight else UNSEEN for v in estimate.road_users)]
        labels = ["ego", *(f"{v.label} {v.vehicle}" for v in estimate.road_users)]
        shown = [_above(np.vstack([outline, outline[:1]])) for outline in footprints]
        self._stream.log("bev/bodies", rr.LineStrips2D(shown, colors=colors, labels=labels))
        around = [_above(np.vstack([outline, outline[:1]])) for outline in ellipses]
        self._stream.log("bev/ellipses", rr.LineStrips2D(around, colors=UNSEEN))
        lines = () if estimate.lanes is None else estimate.lanes.lines
        kinds = [f"{line.kind} {line.line}" for line in lines]
        self._stream.log(
            "bev/lines", rr.LineStrips2D([_above(curve_points(line)) for line in lines], colors=ROAD, labels=kinds)
        )

    def _plots(self, estimate: Estimate) -> None:
        if self._last is not None and estimate.t_source_ns > self._last.t_source_ns:
            step = self._last.T_world_ego.between(estimate.T_world_ego)
            speed_mps = math.hypot(step.x_m, step.y_m) * 1e9 / (estimate.t_source_ns - self._last.t_source_ns)
            self._stream.log("ego/speed_mps", rr.Scalars(speed_mps))
        for name, variance in zip(("x_m", "y_m", "yaw_rad"), estimate.cov[::4], strict=True):
            self._stream.log(f"ego/sigma_{name}", rr.Scalars(math.sqrt(max(variance, 0.0))))
        if self._last is None or estimate.speed_sources != self._last.speed_sources:
            sources = " and ".join(estimate.speed_sources) or "nothing yet"
            self._stream.log("status", rr.TextLog(f"scale from {sources}", level="INFO"))
        if estimate.status or not estimate.valid:
            text = f"{'' if estimate.valid else 'NOT VALID '}{' '.join(estimate.status)}"
            self._stream.log("status", rr.TextLog(text, level="INFO" if estimate.valid else "WARN"))


def _yaw_quaternion(yaw_rad: float) -> tuple[float, float, float, float]:
    """Returns the quaternion (x, y, z, w) of a yaw."""
    return 0.0, 0.0, math.sin(yaw_rad / 2.0), math.cos(yaw_rad / 2.0)


def _footprint(T_ego_body: SE2, length_m: float, width_m: float) -> Floats:
    corners = np.array([(1.0, 1.0), (1.0, -1.0), (-1.0, -1.0), (-1.0, 1.0)]) * (length_m / 2.0, width_m / 2.0)
    return T_ego_body @ corners


def _above(points_m: Floats) -> Floats:
    """Returns points of ego in image axes: x (forward) up, y (left) left."""
    return np.column_stack([-points_m[:, 1], -points_m[:, 0]])


def _blueprint() -> Any:
    return blueprint.Blueprint(
        blueprint.Horizontal(
            blueprint.Vertical(
                blueprint.Spatial2DView(origin="camera", name="camera"),
                blueprint.TimeSeriesView(origin="latency", name="latency, ms"),
                blueprint.TimeSeriesView(origin="ego", name="ego"),
                blueprint.TextLogView(origin="status", name="status"),
            ),
            blueprint.Spatial3DView(origin="world", name="world"),
            blueprint.Spatial2DView(origin="bev", name="from above"),
        )
    )


def _stream(to: Path | str | None) -> Any:
    """Opens a stream to a file, a server, or a new viewer. Raises ConfigurationError if that fails."""
    stream = rr.RecordingStream(APPLICATION)
    try:
        if isinstance(to, str):
            stream.connect_grpc(to)
        elif to is not None:
            stream.save(to)
        else:
            stream.spawn()
    except (RuntimeError, OSError) as error:
        raise ConfigurationError(f"view: {error}; without a display: --save FILE.rrd or --web") from None
    return stream


def show_recording(recording: Recording, to: Path | str | None) -> None:
    """Sends a whole recording to rerun's viewer, or `to` a file or a server's URL. Raises ConfigurationError."""
    stream = _stream(to)
    send_recording(recording, Viewer(stream))
    stream.flush()
    stream.disconnect()


def send_recording(recording: Recording, viewer: Viewer) -> None:
    """Sends all messages of a recording."""
    if recording.camera is not None:
        viewer.camera(recording.camera)
    for message in recording.messages(READ):
        if message.channel == "v1/frame":
            ref = decode(message.data, FrameRef)
            viewer.at(ref.frame_id, ref.t_source_ns)
        elif message.channel == "/camera/image":
            viewer.image(msgspec.json.decode(message.data, type=CompressedImage).data)
        elif message.channel == "/latency":
            viewer.latency(msgspec.json.decode(message.data, type=Latency))
        elif message.channel == "v1/measurements":
            viewer.measurements(decode(message.data, Measurements))
        elif message.channel == "v1/estimate":
            viewer.estimate(decode(message.data, Estimate))
        else:
            viewer.map(decode(message.data, MapUpdate))


def show_live(vehicle: str, runtime_dir: Path | None, to: Path | str | None, seconds: float | None) -> bool:
    """Shows a running drive until its source ends, or for some seconds; returns whether it received an estimate."""
    stream = _stream(to)
    viewer = Viewer(stream)
    with Bus(vehicle, f"view-{os.getpid()}", runtime_dir=runtime_dir) as bus:
        _query_camera(bus, viewer)
        seen = False
        for record in _live_records(bus, FrameReader(ring_path(vehicle, runtime_dir)), seconds):
            if isinstance(record, bytes):
                viewer.image(record)
            elif isinstance(record, FrameRef):
                viewer.at(record.frame_id, record.t_source_ns)
            elif isinstance(record, Measurements):
                viewer.measurements(record)
            elif isinstance(record, MapUpdate):
                viewer.map(record)
            elif isinstance(record, Latency):
                viewer.latency(record)
            else:
                seen = True
                viewer.estimate(record)
    stream.flush()
    stream.disconnect()
    return seen


def _query_camera(bus: Bus, viewer: Viewer) -> None:
    """Logs the camera of the run, if the query is answered."""
    try:
        for configuration in bus.query("configuration"):
            viewer.camera(msgspec.convert(configuration["camera"], Camera))
    except (BusError, KeyError, msgspec.ValidationError):
        return


def _live_records(bus: Bus, ring: FrameReader, seconds: float | None) -> Iterator[Any]:
    estimates = bus.subscriber("estimate", QUEUE)
    others = [bus.subscriber(topic, depth) for topic, depth in (("measurements", QUEUE), ("map", QUEUE))]
    frames = bus.subscriber("frame", IMAGES)
    until_s = None if seconds is None else time.monotonic() + seconds
    while until_s is None or time.monotonic() < until_s:
        message = estimates.recv(TURN_S)
        while (reference := frames.recv(0.0)) is not None:
            yield reference.record
            image = ring.read(reference.record)
            if image is not None:
                yield cv2.imencode(".jpg", image, (cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY))[1].tobytes()
        for subscriber in others:
            while (other := subscriber.recv(0.0)) is not None:
                yield other.record
        while message is not None:
            estimate: Estimate = message.record
            if Status.END_OF_SOURCE in estimate.status:
                return
            yield estimate
            yield Latency(
                frame_id=estimate.frame_id,
                age_ms=(message.t_received_ns - estimate.t_capture_ns) / 1e6,
                stages_ms=dict(stages(message.trace, message.t_received_ns)),
            )
            message = estimates.recv(0.0)
