"""Converts the records of a drive to messages that Foxglove draws.

Frames: `world` (of the current epoch), `ego`, `camera`; z is up in the first two, as in types.py.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

import cv2
import msgspec
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from birdslam.geometry.arrays import Floats
from birdslam.geometry.camera import Camera
from birdslam.geometry.se2 import SE2
from birdslam.runtime.recording.foxglove import (
    ALL,
    LINE_LOOP,
    LINE_STRIP,
    CameraCalibration,
    Color,
    CompressedImage,
    CubePrimitive,
    FoxglovePose,
    FrameTransform,
    ImageAnnotations,
    LinePrimitive,
    Point2,
    PointCloud,
    PointsAnnotation,
    PoseInFrame,
    Quaternion,
    SceneEntity,
    SceneEntityDeletion,
    SceneUpdate,
    TextAnnotation,
    TextPrimitive,
    Time,
    Vector3,
)
from birdslam.trajectory import Transform, ego_pose, mount_pose
from birdslam.types import (
    NS_PER_S,
    Attitude,
    Estimate,
    Lane,
    LaneLine,
    Lanes,
    LineColour,
    LineKind,
    MapUpdate,
    Measurements,
    Status,
    VehicleEstimate,
)

VEHICLE_HEIGHT_M = 1.5  # drawn if no height is estimated
ELLIPSE_POINTS = 24
_BOXES_STAY_FRAMES = 8  # after the last detection: a quarter of a second at 33 Hz
EGO, VEHICLE, UNSEEN = Color(0.1, 0.4, 0.9), Color(0.9, 0.4, 0.1), Color(0.6, 0.6, 0.6)
WHITE_LINE, YELLOW_LINE, OWN_LANE = Color(1.0, 1.0, 1.0), Color(1.0, 0.8, 0.1), Color(0.3, 0.7, 0.4)
LINE_STEP_M = 2.0  # between points of a line

CHANNELS: dict[str, type[msgspec.Struct]] = {
    "/tf": FrameTransform,
    "/ego": PoseInFrame,
    "/scene": SceneUpdate,
    "/road": PointCloud,
    "/map": PointCloud,
    "/camera/boxes": ImageAnnotations,
    "/camera/calibration": CameraCalibration,
    "/camera/image": CompressedImage,
}

Drawn = tuple[str, msgspec.Struct]  # channel, message


def timestamp(t_ns: int) -> Time:
    """Converts nanoseconds since 1970."""
    sec, nsec = divmod(max(t_ns, 0), NS_PER_S)
    return Time(sec, nsec)


def from_estimate(estimate: Estimate, t_ns: int) -> Iterator[Drawn]:
    """Yields the poses of the ego and all road users, with 2-sigma ellipses."""
    t, T_world_ego = timestamp(t_ns), ego_pose(estimate.T_world_ego, estimate.attitude)
    at = _pose(T_world_ego)
    yield (
        "/tf",
        FrameTransform(
            timestamp=t, parent_frame_id="world", child_frame_id="ego", translation=at.position, rotation=at.orientation
        ),
    )
    yield "/ego", PoseInFrame(timestamp=t, frame_id="world", pose=at)
    z_m = estimate.attitude.z_m
    outline = _ellipse(estimate.T_world_ego, estimate.cov, z_m, EGO if estimate.valid else UNSEEN)
    entities = [SceneEntity(timestamp=t, frame_id="world", id="ego", lines=(outline,))]
    entities += [_entity(vehicle, t, z_m) for vehicle in estimate.road_users]
    if estimate.lanes is not None:
        entities.append(_lanes(estimate.lanes, t))
    gone = SceneEntityDeletion(timestamp=t, type=ALL)
    yield "/scene", SceneUpdate(deletions=(gone,), entities=tuple(entities))


def curve_points(curve: LaneLine | Lane) -> Floats:
    """Returns points (N, 2) in ego of a line or a lane's centre line, up to its known end."""
    x = np.arange(0.0, max(curve.to_m, 0.0) + LINE_STEP_M, LINE_STEP_M)
    a, h, c, d = curve.offset_m, curve.slope, curve.curvature_per_m, curve.curvature_rate_per_m2
    return np.column_stack([x, a + x * (h + x * (c / 2.0 + x * d / 6.0))])


def _lanes(lanes: Lanes, t: Time) -> SceneEntity:
    """Draws lines in their colours, road edges in grey, the centre line of the ego's lane in green."""
    strips = []
    for line in lanes.lines:
        painted = YELLOW_LINE if line.colour is LineColour.YELLOW else WHITE_LINE
        strips.append((curve_points(line), UNSEEN if line.kind is LineKind.EDGE else painted))
    if lanes.ego is not None:
        strips.append((curve_points(lanes.ego), OWN_LANE))
    drawn = (
        LinePrimitive(type=LINE_STRIP, points=tuple(Vector3(x, y, 0.0) for x, y in points.tolist()), color=color)
        for points, color in strips
    )
    return SceneEntity(timestamp=t, frame_id="ego", id="lanes", lines=tuple(drawn))


def between_looks(measurements: Measurements) -> bool:
    """Whether the detector has not run on this frame and the boxes of its last run are still shown."""
    carried = Status.DETECTIONS_CARRIED in measurements.status and not measurements.cv
    return carried and measurements.ages.get("detector", _BOXES_STAY_FRAMES + 1) <= _BOXES_STAY_FRAMES


def from_measurements(measurements: Measurements, t_ns: int) -> Iterator[Drawn]:
    """Yields the boxes in the image and the points on the road in ego; boxes stay between two runs of the detector."""
    t = timestamp(t_ns)
    if not between_looks(measurements):
        yield "/camera/boxes", _boxes(measurements, t)
    seen = [(point.x_m, point.y_m) for point in measurements.lanes]
    seen += [(edge.x_m, edge.y_m) for edge in measurements.cp]
    yield "/road", PointCloud(timestamp=t, frame_id="ego", data=_packed(seen))


def _boxes(measurements: Measurements, t: Time) -> ImageAnnotations:
    boxes, texts = [], []
    for edge in measurements.cv:
        x1, y1, x2, y2 = edge.box_px
        corners = tuple(Point2(x, y) for x, y in ((x1, y1), (x2, y1), (x2, y2), (x1, y2)))
        boxes.append(PointsAnnotation(timestamp=t, points=corners, outline_color=VEHICLE))
        text = f"{edge.label} {edge.vehicle}  {math.hypot(edge.T_ego_vehicle.x_m, edge.T_ego_vehicle.y_m):.1f} m"
        texts.append(TextAnnotation(timestamp=t, position=Point2(x1, y1), text=text))
    for person in measurements.people:
        if person.age_ns == 0:
            x1, y1, x2, y2 = person.box_px
            corners = tuple(Point2(x, y) for x, y in ((x1, y1), (x2, y1), (x2, y2), (x1, y2)))
            boxes.append(PointsAnnotation(timestamp=t, points=corners, outline_color=VEHICLE))
            text = f"{person.label} {person.person}  {math.hypot(person.x_m, person.y_m):.1f} m"
            texts.append(TextAnnotation(timestamp=t, position=Point2(x1, y1), text=text))
    return ImageAnnotations(points=tuple(boxes), texts=tuple(texts))


def from_map(update: MapUpdate, t_ns: int) -> Iterator[Drawn]:
    """Yields the new points of the map, in world."""
    points = [*update.landmarks_m, *update.lanes_m]
    if points:
        yield "/map", PointCloud(timestamp=timestamp(t_ns), frame_id="world", data=_packed(points))


def from_camera(camera: Camera, t_ns: int) -> Iterator[Drawn]:
    """Yields calibration and mount of the camera; recorded images are undistorted."""
    t, mount = timestamp(t_ns), _pose(mount_pose(camera.ground))
    K = tuple(camera.K.ravel().tolist())
    P = tuple(np.hstack([camera.K, np.zeros((3, 1))]).ravel().tolist())
    width, height = camera.width_px, camera.height_px
    yield (
        "/camera/calibration",
        CameraCalibration(timestamp=t, frame_id="camera", width=width, height=height, K=K, P=P),
    )
    yield (
        "/tf",
        FrameTransform(
            timestamp=t,
            parent_frame_id="ego",
            child_frame_id="camera",
            translation=mount.position,
            rotation=mount.orientation,
        ),
    )


def from_image(image: NDArray[np.uint8], jpeg_quality: int, t_ns: int) -> Drawn:
    """Encodes an image, (H, W) grey or (H, W, 3) BGR, as JPEG."""
    _, jpeg = cv2.imencode(".jpg", image, (cv2.IMWRITE_JPEG_QUALITY, jpeg_quality))
    data = jpeg.tobytes()
    return "/camera/image", CompressedImage(timestamp=timestamp(t_ns), frame_id="camera", data=data, format="jpeg")


def ellipse(T_world_body: SE2, cov: tuple[float, ...], sigmas: float = 2.0) -> Floats:
    """Returns the position's error ellipse (ELLIPSE_POINTS, 2) in world; `cov` is in the tangent at the pose."""
    place = np.array(cov).reshape(3, 3)[:2, :2]
    spread, axes = np.linalg.eigh((place + place.T) / 2.0)
    angle = np.linspace(0.0, 2.0 * math.pi, ELLIPSE_POINTS, endpoint=False)
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    around: Floats = T_world_body @ (sigmas * circle * np.sqrt(np.maximum(spread, 0.0)) @ axes.T)
    return around


def _ellipse(body: SE2, cov: tuple[float, ...], z_m: float, color: Color) -> LinePrimitive:
    points = tuple(Vector3(x, y, z_m) for x, y in ellipse(body, cov).tolist())
    return LinePrimitive(type=LINE_LOOP, points=points, color=color)


def _entity(vehicle: VehicleEstimate, t: Time, z_m: float) -> SceneEntity:
    height_m = vehicle.height_m or VEHICLE_HEIGHT_M
    pose = _pose(ego_pose(vehicle.T_world_vehicle, Attitude(z_m=z_m + height_m / 2.0)))
    at, (vx, vy) = pose.position, vehicle.velocity_mps
    color = VEHICLE if vehicle.in_sight else UNSEEN
    above = FoxglovePose(Vector3(at.x, at.y, z_m + height_m + 0.8))
    in_a_second = LinePrimitive(type=LINE_STRIP, points=(at, Vector3(at.x + vx, at.y + vy, at.z)), color=color)
    return SceneEntity(
        timestamp=t,
        frame_id="world",
        id=f"vehicle {vehicle.vehicle}",
        cubes=(CubePrimitive(pose=pose, size=Vector3(vehicle.length_m, vehicle.width_m, height_m), color=color),),
        lines=(_ellipse(vehicle.T_world_vehicle, vehicle.cov, z_m, color), in_a_second),
        texts=(TextPrimitive(pose=above, text=f"{vehicle.label} {vehicle.vehicle}  {math.hypot(vx, vy):.1f} m/s"),),
    )


def _pose(T_a_b: Transform) -> FoxglovePose:
    x, y, z, w = Rotation.from_matrix(T_a_b[:3, :3]).as_quat().tolist()
    return FoxglovePose(Vector3(*T_a_b[:3, 3].tolist()), Quaternion(x, y, z, w))


def _packed(points_m: list[tuple[float, float]]) -> bytes:
    flat = np.zeros((len(points_m), 3), dtype="<f4")
    if points_m:
        flat[:, :2] = points_m
    return flat.tobytes()
