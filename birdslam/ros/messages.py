"""Our records as ROS messages, for a bag or for a live ROS 2; docs/ros.md lists the topics.

Axes are REP-103's as everywhere in types.py. REP-105: `odom` is our world, continued where a new epoch begins (at the
pose where the last one ended: the motion between is unknown); `base_link` is ego, the camera's foot on the road. Our
covariances are in the body's own axes; ROS has those of a pose in the axes of the parent frame, those of a twist in
the child's. What is not estimated has the variance UNKNOWN.
"""

from __future__ import annotations

import enum
import math
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, Protocol

import numpy as np

from birdslam.geometry.arrays import Floats
from birdslam.geometry.camera import Camera
from birdslam.geometry.se2 import SE2
from birdslam.trajectory import Transform, ego_pose, mount_pose
from birdslam.types import NS_PER_S, EgoEdge, Estimate, Lanes, LineColour, LineKind, MapUpdate, RoadUser

Sent = tuple[str, Any]  # topic, message

ODOMETRY, DETECTIONS, MARKERS = (
    "nav_msgs/msg/Odometry",
    "vision_msgs/msg/Detection3DArray",
    "visualization_msgs/msg/MarkerArray",
)
TOPICS = {  # topic -> type of its messages
    "/tf": "tf2_msgs/msg/TFMessage",
    "/tf_static": "tf2_msgs/msg/TFMessage",
    "/birdslam/odometry": ODOMETRY,
    "/birdslam/path": "nav_msgs/msg/Path",
    "/birdslam/vehicles": DETECTIONS,
    "/birdslam/vehicles/odometry": ODOMETRY,
    "/birdslam/people": DETECTIONS,
    "/birdslam/people/odometry": ODOMETRY,
    "/birdslam/lanes": MARKERS,
    "/birdslam/lane_lines": MARKERS,
    "/birdslam/ego_lane": "nav_msgs/msg/Path",
    "/diagnostics": "diagnostic_msgs/msg/DiagnosticArray",
}
LATCHED = ("/tf_static", "/birdslam/path")  # what comes once must wait for those who come later

ODOM, BASE, CAMERA = "odom", "base_link", "camera_optical_frame"
UNKNOWN = 1e6  # variance of what is not estimated
VEHICLE_HEIGHT_M = 1.5  # of boxes of a height that is not known
LANE_WIDTH_M = 0.15  # drawn
CURVE_STEP_M = 2.0  # between two points of a line or a lane
COLOURS = {LineColour.YELLOW: (1.0, 0.8, 0.0)}  # others are white
EDGE_COLOUR = (0.5, 0.5, 0.5)
PLANE = (0, 1, 5)  # x, y and yaw among ROS' six: x, y, z, about x, about y, about z


class Level(enum.IntEnum):
    """Of diagnostic_msgs/DiagnosticStatus."""

    OK = 0
    WARN = 1
    ERROR = 2


class Make(Protocol):
    """Makes a message of its full name, as "nav_msgs/msg/Odometry"; fields that are not given are zero."""

    def __call__(self, name: str, /, **fields: Any) -> Any: ...


class RosMessages:
    """Of one drive, in order: it remembers where the last epoch ended and, with `keep_path`, all poses.

    `frames` stands before the names of all frames ("red/"), so that several cars are in one tree.
    """

    def __init__(self, make: Make, camera: Camera, name: str, keep_path: bool = False, frames: str = "") -> None:
        self._make, self._camera, self._name, self._frames = make, camera, name, frames
        self._T_odom_world = SE2()
        self._last: tuple[Estimate, SE2] | None = None  # and T_odom_ego
        self._keep_path = keep_path
        self._path: list[tuple[int, Transform]] = []
        self._markers: Counter[str] = Counter()

    def fixed(self, t_ns: int) -> Sent:
        """The camera's mount on the car."""
        mount = self._transform(BASE, CAMERA, mount_pose(self._camera.ground), t_ns)
        return "/tf_static", self._make("tf2_msgs/msg/TFMessage", transforms=[mount])

    def of_estimate(self, estimate: Estimate, t_ns: int, motion: EgoEdge | None = None) -> Iterator[Sent]:
        """One frame; `motion` is the ego's since the frame before, as it was measured."""
        before = self._last
        if before is not None and before[0].epoch != estimate.epoch:
            self._T_odom_world = before[1] @ estimate.T_world_ego.inverse()
        T_odom_ego = self._T_odom_world @ estimate.T_world_ego
        pose = ego_pose(T_odom_ego, estimate.attitude)
        self._last = estimate, T_odom_ego
        if self._keep_path:
            self._path.append((t_ns, pose))
        yield "/tf", self._make("tf2_msgs/msg/TFMessage", transforms=[self._transform(ODOM, BASE, pose, t_ns)])
        cov = _rotated(np.reshape(estimate.cov, (3, 3)), T_odom_ego.yaw_rad)
        twist, twist_cov = _twist(estimate, before, T_odom_ego, motion)
        yield "/birdslam/odometry", self._odometry(BASE, self._pose(pose), cov, twist, twist_cov, t_ns)
        yield "/birdslam/vehicles", self._detections(estimate, estimate.vehicles, t_ns)
        for vehicle in estimate.vehicles:
            yield "/birdslam/vehicles/odometry", self._vehicle(vehicle, estimate.attitude.z_m, t_ns)
        yield "/birdslam/people", self._detections(estimate, estimate.people, t_ns)
        for person in estimate.people:
            yield "/birdslam/people/odometry", self._vehicle(person, estimate.attitude.z_m, t_ns, "person")
        if estimate.lanes is not None:
            yield from self._lanes(estimate.lanes, t_ns)
        yield "/diagnostics", self._diagnostics(estimate, t_ns)

    def of_map(self, update: MapUpdate, t_ns: int) -> Iterator[Sent]:
        """The lane points that the map gained, one marker a lane; none of an epoch that is over."""
        if not update.lanes_m or self._last is None or update.epoch != self._last[0].epoch:
            return
        lanes: dict[int, list[Any]] = {}
        z_m = self._last[0].attitude.z_m
        ids = update.lane_ids or (-1,) * len(update.lanes_m)
        for lane, (x_m, y_m) in zip(ids, (self._T_odom_world @ np.array(update.lanes_m)).tolist(), strict=True):
            lanes.setdefault(lane, []).append(self._make("geometry_msgs/msg/Point", x=x_m, y=y_m, z=z_m))
        markers = [self._marker(lane, points, t_ns) for lane, points in sorted(lanes.items())]
        yield "/birdslam/lanes", self._make(MARKERS, markers=markers)

    def _lanes(self, lanes: Lanes, t_ns: int) -> Iterator[Sent]:
        """The lines of one frame, which replace those of the frame before, and the middle of the ego's lane."""
        markers = [self._make("visualization_msgs/msg/Marker", header=self._header(BASE, t_ns), action=3)]  # DELETEALL
        for line in lanes.lines:
            points = self._curve(line.y_m, line.seen_from_m, line.to_m)
            colour = EDGE_COLOUR if line.kind is LineKind.EDGE else COLOURS.get(line.colour, (1.0, 1.0, 1.0))
            marker = self._marker_of(BASE, line.kind.value, line.line, points, t_ns)
            marker.type = marker.LINE_STRIP
            marker.color = self._colour(*colour, line.existence)
            markers.append(marker)
        yield "/birdslam/lane_lines", self._make(MARKERS, markers=markers)
        if lanes.ego is not None:
            header = self._header(BASE, t_ns)
            poses = [
                self._make("geometry_msgs/msg/PoseStamped", header=header, pose=self._at(point))
                for point in self._curve(lanes.ego.centre_m, 0.0, lanes.ego.to_m)
            ]
            yield "/birdslam/ego_lane", self._make("nav_msgs/msg/Path", header=header, poses=poses)

    def _curve(self, y_m: Callable[[float], float], from_m: float, to_m: float) -> list[Any]:
        steps = max(2, round(abs(to_m - from_m) / CURVE_STEP_M) + 1)
        return [
            self._make("geometry_msgs/msg/Point", x=x_m, y=y_m(x_m), z=0.0)
            for x_m in np.linspace(from_m, to_m, steps).tolist()
        ]

    def path(self) -> Iterator[Sent]:
        """The whole path, when the drive is over; nothing without `keep_path`."""
        if self._path:
            poses = [
                self._make("geometry_msgs/msg/PoseStamped", header=self._header(ODOM, t_ns), pose=self._pose(pose))
                for t_ns, pose in self._path
            ]
            header = self._header(ODOM, self._path[-1][0])
            yield "/birdslam/path", self._make("nav_msgs/msg/Path", header=header, poses=poses)

    def _vehicle(self, vehicle: RoadUser, z_m: float, t_ns: int, kind: str = "vehicle") -> Any:
        T_odom_vehicle = self._T_odom_world @ vehicle.T_world_vehicle
        pose = self._level(T_odom_vehicle, z_m)
        cov = _rotated(np.reshape(vehicle.cov, (3, 3)), T_odom_vehicle.yaw_rad)
        c, s = math.cos(vehicle.T_world_vehicle.yaw_rad), math.sin(vehicle.T_world_vehicle.yaw_rad)
        R_vehicle_world = np.array([[c, s], [-s, c]])
        vx, vy = (R_vehicle_world @ vehicle.velocity_mps).tolist()
        twist_cov = np.diag([0.0, 0.0, UNKNOWN])
        twist_cov[:2, :2] = R_vehicle_world @ np.reshape(vehicle.velocity_cov, (2, 2)) @ R_vehicle_world.T
        return self._odometry(f"{kind}_{vehicle.vehicle}", pose, cov, (vx, vy, 0.0), twist_cov, t_ns)

    def _detections(self, estimate: Estimate, users: Sequence[RoadUser], t_ns: int) -> Any:
        header, detections = self._header(ODOM, t_ns), []
        for vehicle in users:
            height_m = vehicle.height_m or VEHICLE_HEIGHT_M
            T_odom_vehicle = self._T_odom_world @ vehicle.T_world_vehicle
            z_m = estimate.attitude.z_m
            foot = self._level(T_odom_vehicle, z_m)
            middle = self._level(T_odom_vehicle, z_m + height_m / 2.0)
            cov = _rotated(np.reshape(vehicle.cov, (3, 3)), T_odom_vehicle.yaw_rad)
            hypothesis = self._make(
                "vision_msgs/msg/ObjectHypothesisWithPose",
                hypothesis=self._make(
                    "vision_msgs/msg/ObjectHypothesis", class_id=vehicle.label, score=_score(vehicle)
                ),
                pose=self._make("geometry_msgs/msg/PoseWithCovariance", pose=foot, covariance=_six(cov)),
            )
            size = self._vector(vehicle.length_m, vehicle.width_m, height_m)
            box = self._make("vision_msgs/msg/BoundingBox3D", center=middle, size=size)
            detections.append(
                self._make(
                    "vision_msgs/msg/Detection3D", header=header, results=[hypothesis], bbox=box,
                    id=str(vehicle.vehicle),
                )
            )  # fmt: skip
        return self._make(DETECTIONS, header=header, detections=detections)

    def _diagnostics(self, estimate: Estimate, t_ns: int) -> Any:
        statuses = ", ".join(status.value for status in estimate.status)
        values = {
            "frame_id": estimate.frame_id,
            "epoch": estimate.epoch,
            "valid": str(estimate.valid).lower(),
            "scale_sigma_rel": f"{estimate.scale_sigma_rel:.6g}",
            "speed_sources": ", ".join(source.value for source in estimate.speed_sources),
            "vehicles": len(estimate.vehicles),
            "people": len(estimate.people),
        }
        level = Level.ERROR if not estimate.valid else Level.WARN if estimate.status else Level.OK
        return self.diagnostic("estimate", level, statuses or "ok", values, t_ns)[1]

    def diagnostic(self, what: str, level: Level, text: str, values: Mapping[str, object], t_ns: int) -> Sent:
        """The state of a part of the system."""
        status = self._make(
            "diagnostic_msgs/msg/DiagnosticStatus",
            name=f"birdslam: {what}",
            message=text,
            hardware_id=self._name,
            level=int(level),
            values=[self._make("diagnostic_msgs/msg/KeyValue", key=key, value=str(v)) for key, v in values.items()],
        )
        header = self._header("", t_ns)
        return "/diagnostics", self._make("diagnostic_msgs/msg/DiagnosticArray", header=header, status=[status])

    def _marker(self, lane: int, points: list[Any], t_ns: int) -> Any:
        space = "lane" if lane < 0 else f"lane {lane}"
        self._markers[space] += 1  # each stays, so that the map grows
        return self._marker_of(ODOM, space, self._markers[space], points, t_ns)

    def _marker_of(self, frame: str, space: str, number: int, points: list[Any], t_ns: int) -> Any:
        return self._make(
            "visualization_msgs/msg/Marker", header=self._header(frame, t_ns), ns=space, id=number, type=8, action=0,
            pose=self._pose(np.eye(4)), scale=self._vector(LANE_WIDTH_M, LANE_WIDTH_M, 0.0),
            color=self._colour(1.0, 1.0, 1.0, 1.0), points=points,
        )  # fmt: skip

    def _colour(self, red: float, green: float, blue: float, alpha: float) -> Any:
        return self._make("std_msgs/msg/ColorRGBA", r=red, g=green, b=blue, a=alpha)

    def _at(self, point: Any) -> Any:
        turn = self._make("geometry_msgs/msg/Quaternion", w=1.0)
        return self._make("geometry_msgs/msg/Pose", position=point, orientation=turn)

    def _odometry(
        self, child: str, pose: Any, cov: Floats, twist: tuple[float, ...], twist_cov: Floats, t_ns: int
    ) -> Any:
        vx, vy, yaw_rate = twist
        moving = self._make(
            "geometry_msgs/msg/Twist", linear=self._vector(vx, vy, 0.0), angular=self._vector(0.0, 0.0, yaw_rate)
        )
        return self._make(
            ODOMETRY,
            header=self._header(ODOM, t_ns),
            child_frame_id=self._frames + child,
            pose=self._make("geometry_msgs/msg/PoseWithCovariance", pose=pose, covariance=_six(cov)),
            twist=self._make("geometry_msgs/msg/TwistWithCovariance", twist=moving, covariance=_six(twist_cov)),
        )

    def _transform(self, parent: str, child: str, T_parent_child: Transform, t_ns: int) -> Any:
        pose = self._pose(T_parent_child)
        at = pose.position
        moved = self._make(
            "geometry_msgs/msg/Transform", translation=self._vector(at.x, at.y, at.z), rotation=pose.orientation
        )
        header = self._header(parent, t_ns)
        return self._make(
            "geometry_msgs/msg/TransformStamped", header=header, child_frame_id=self._frames + child, transform=moved
        )

    def _header(self, frame: str, t_ns: int) -> Any:
        sec, nanosec = divmod(max(t_ns, 0), NS_PER_S)
        stamp = self._make("builtin_interfaces/msg/Time", sec=sec, nanosec=nanosec)
        return self._make("std_msgs/msg/Header", stamp=stamp, frame_id=frame and self._frames + frame)

    def _pose(self, T: Transform) -> Any:
        from scipy.spatial.transform import Rotation  # here, as in trajectory.py

        x, y, z, w = Rotation.from_matrix(T[:3, :3]).as_quat(canonical=True).tolist()
        at_x, at_y, at_z = T[:3, 3].tolist()
        return self._make(
            "geometry_msgs/msg/Pose",
            position=self._make("geometry_msgs/msg/Point", x=at_x, y=at_y, z=at_z),
            orientation=self._make("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w),
        )

    def _level(self, T: SE2, z_m: float) -> Any:
        """Of a body on the road, without pitch and roll."""
        return self._make(
            "geometry_msgs/msg/Pose",
            position=self._make("geometry_msgs/msg/Point", x=T.x_m, y=T.y_m, z=z_m),
            orientation=self._make(
                "geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=math.sin(T.yaw_rad / 2.0), w=math.cos(T.yaw_rad / 2.0)
            ),
        )

    def _vector(self, x: float, y: float, z: float) -> Any:
        return self._make("geometry_msgs/msg/Vector3", x=x, y=y, z=z)


def _score(user: RoadUser) -> float:
    """The probability of its class; 1 where nobody said."""
    return 1.0 if user.label_probability is None else user.label_probability


def _twist(
    estimate: Estimate, before: tuple[Estimate, SE2] | None, T_odom_ego: SE2, motion: EgoEdge | None
) -> tuple[tuple[float, ...], Floats]:
    """Speed ahead and to the left in m/s, yaw rate in rad/s since the frame before, and their covariance (3, 3)."""
    unknown = UNKNOWN * np.eye(3)
    if before is None or estimate.t_source_ns <= before[0].t_source_ns or before[0].epoch != estimate.epoch:
        return (0.0, 0.0, 0.0), unknown
    dt_s = (estimate.t_source_ns - before[0].t_source_ns) / NS_PER_S
    step = before[1].between(T_odom_ego)
    if motion is not None and (motion.from_frame, motion.to_frame) == (before[0].frame_id, estimate.frame_id):
        step, unknown = motion.T_from_to, np.reshape(motion.cov, (3, 3)) / dt_s**2
    return (step.x_m / dt_s, step.y_m / dt_s, step.yaw_rad / dt_s), unknown


def _rotated(cov: Floats, yaw_rad: float) -> Floats:
    """A covariance (3, 3) of a body's own axes in those of the frame in which it has this yaw."""
    c, s = math.cos(yaw_rad), math.sin(yaw_rad)
    R = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    out: Floats = R @ cov @ R.T
    return out


def _six(cov: Floats) -> Floats:
    """(36,) of ROS: x, y, z and the turns about them; what the road leaves out is UNKNOWN."""
    out = UNKNOWN * np.eye(6)
    out[np.ix_(PLANE, PLANE)] = cov
    return out.ravel()


def t_of(estimate: Estimate, live: bool) -> int:
    """The time of a message: UTC of a live camera, else the recording's own clock, as in the bag that it came from."""
    return estimate.t_utc_ns if live and estimate.t_utc_ns else estimate.t_source_ns
