"""Converts records to ROS messages, for a bag or for a live ROS 2; docs/ros.md lists the topics.

Axes follow REP-103, frames REP-105: `odom` is the world frame, and a new epoch continues at the last pose of the one
before; `base_link` is ego, the camera's foot on the road; `map` is the frame of a kept map.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np

from birdslam.geometry.arrays import Floats
from birdslam.geometry.camera import Camera
from birdslam.geometry.se2 import SE2
from birdslam.loops.map_pose import EarthPose, MapPose, MapState
from birdslam.ros.parts import (
    BASE,
    CAMERA,
    MAP,
    ODOM,
    UNKNOWN_VARIANCE,
    Level,
    Make,
    MessageParts,
    Sent,
    rotated,
    six,
)
from birdslam.trajectory import Transform, ego_pose, mount_pose
from birdslam.types import NS_PER_S, Attitude, EgoEdge, Estimate, Lanes, LineColour, LineKind, MapUpdate, RoadUser

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
    "/birdslam/map_pose": "geometry_msgs/msg/PoseWithCovarianceStamped",
    "/birdslam/fix": "sensor_msgs/msg/NavSatFix",
    "/diagnostics": "diagnostic_msgs/msg/DiagnosticArray",
}
LATCHED = ("/tf_static", "/birdslam/path")  # sent once, also delivered to later subscribers

VEHICLE_HEIGHT_M = 1.5  # of boxes of unknown height
LANE_WIDTH_M = 0.15  # drawn
CURVE_STEP_M = 2.0  # between two points of a line or a lane
COLOURS = {LineColour.YELLOW: (1.0, 0.8, 0.0)}  # others are white
EDGE_COLOUR = (0.5, 0.5, 0.5)
COVARIANCE_KNOWN = 3  # of sensor_msgs/NavSatFix


class RosMessages(MessageParts):
    """Converts the records of one drive, in order; keeps the last pose of each epoch and, with `keep_path`, all poses.

    `frames` is the prefix of all frame names ("red/"), so that several cars can share a tree.
    """

    def __init__(self, make: Make, camera: Camera, name: str, keep_path: bool = False, frames: str = "") -> None:
        super().__init__(make, name, frames)
        self._camera = camera
        self._T_odom_world = SE2()
        self._last: tuple[Estimate, SE2] | None = None  # and T_odom_ego
        self._keep_path = keep_path
        self._path: list[tuple[int, Transform]] = []
        self._markers: Counter[str] = Counter()

    def fixed(self, t_ns: int) -> Sent:
        """The camera's mount on the car."""
        mount = self.transform(BASE, CAMERA, mount_pose(self._camera.ground), t_ns)
        return "/tf_static", self.make("tf2_msgs/msg/TFMessage", transforms=[mount])

    def of_estimate(self, estimate: Estimate, t_ns: int, motion: EgoEdge | None = None) -> Iterator[Sent]:
        """The messages of one frame; `motion` is the measured ego-motion since the previous frame."""
        before = self._last
        if before is not None and before[0].epoch != estimate.epoch:
            self._T_odom_world = before[1] @ estimate.T_world_ego.inverse()
        T_odom_ego = self._T_odom_world @ estimate.T_world_ego
        pose = ego_pose(T_odom_ego, estimate.attitude)
        self._last = estimate, T_odom_ego
        if self._keep_path:
            self._path.append((t_ns, pose))
        yield "/tf", self.make("tf2_msgs/msg/TFMessage", transforms=[self.transform(ODOM, BASE, pose, t_ns)])
        cov = rotated(np.reshape(estimate.cov, (3, 3)), T_odom_ego.yaw_rad)
        twist, twist_cov = _twist(estimate, before, T_odom_ego, motion)
        yield "/birdslam/odometry", self._odometry(BASE, self.pose(pose), cov, twist, twist_cov, t_ns)
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
        """The map's new lane points, one marker per lane; nothing for an earlier epoch."""
        if not update.lanes_m or self._last is None or update.epoch != self._last[0].epoch:
            return
        lanes: dict[int, list[Any]] = {}
        z_m = self._last[0].attitude.z_m
        ids = update.lane_ids or (-1,) * len(update.lanes_m)
        for lane, (x_m, y_m) in zip(ids, (self._T_odom_world @ np.array(update.lanes_m)).tolist(), strict=True):
            lanes.setdefault(lane, []).append(self.make("geometry_msgs/msg/Point", x=x_m, y=y_m, z=z_m))
        markers = [self._marker(lane, points, t_ns) for lane, points in sorted(lanes.items())]
        yield "/birdslam/lanes", self.make(MARKERS, markers=markers)

    def of_map_pose(self, found: MapPose, t_ns: int) -> Iterator[Sent]:
        """The pose of `odom` in `map`, of the ego in `map`, and on Earth if the map is georeferenced.

        Only a diagnostic if localization is lost; nothing for an earlier epoch. `map` is planar.
        """
        if self._last is None or found.epoch != self._last[0].epoch:
            return
        values = {"map_epoch": found.map_epoch, "inliers": found.inliers, "keyframes": found.keyframes}
        level = Level.OK if found.state is MapState.LOCALISED else Level.WARN
        yield self.diagnostic("map", level, found.state.value, values, t_ns)
        if found.T_map_odom is None or found.T_odom_ego is None or found.cov is None:
            return
        T_map_odom = found.T_map_odom @ self._T_odom_world.inverse()  # the record's odom is the world of this epoch
        joined = self.transform(MAP, ODOM, ego_pose(T_map_odom, Attitude()), t_ns)
        yield "/tf", self.make("tf2_msgs/msg/TFMessage", transforms=[joined])
        T_map_ego = found.T_map_odom @ found.T_odom_ego
        cov = rotated(np.reshape(found.cov, (3, 3)), T_map_ego.yaw_rad)
        pose = self.make("geometry_msgs/msg/PoseWithCovariance", pose=self.level(T_map_ego, 0.0), covariance=six(cov))
        header = self.header(MAP, t_ns)
        yield "/birdslam/map_pose", self.make(TOPICS["/birdslam/map_pose"], header=header, pose=pose)
        if found.earth is not None:
            yield "/birdslam/fix", self._fix(found.earth, t_ns)

    def _fix(self, earth: EarthPose, t_ns: int) -> Any:
        """The ego's position on Earth; its altitude is unknown."""
        cov = np.diag([0.0, 0.0, UNKNOWN_VARIANCE])
        cov[:2, :2] = np.reshape(earth.cov, (2, 2))
        return self.make(
            TOPICS["/birdslam/fix"], header=self.header(BASE, t_ns), latitude=earth.latitude_deg,
            longitude=earth.longitude_deg, altitude=math.nan, position_covariance=cov.ravel(),
            position_covariance_type=COVARIANCE_KNOWN,
        )  # fmt: skip

    def _lanes(self, lanes: Lanes, t_ns: int) -> Iterator[Sent]:
        """The lines of one frame, which replace those of the previous frame, and the centre of the ego lane."""
        markers = [self.make("visualization_msgs/msg/Marker", header=self.header(BASE, t_ns), action=3)]  # DELETEALL
        for line in lanes.lines:
            points = self._curve(line.y_m, line.seen_from_m, line.to_m)
            colour = EDGE_COLOUR if line.kind is LineKind.EDGE else COLOURS.get(line.colour, (1.0, 1.0, 1.0))
            marker = self._marker_of(BASE, line.kind.value, line.line, points, t_ns)
            marker.type = marker.LINE_STRIP
            marker.color = self.colour(*colour, line.existence)
            markers.append(marker)
        yield "/birdslam/lane_lines", self.make(MARKERS, markers=markers)
        if lanes.ego is not None:
            header = self.header(BASE, t_ns)
            poses = [
                self.make("geometry_msgs/msg/PoseStamped", header=header, pose=self.at(point))
                for point in self._curve(lanes.ego.centre_m, 0.0, lanes.ego.to_m)
            ]
            yield "/birdslam/ego_lane", self.make("nav_msgs/msg/Path", header=header, poses=poses)

    def _curve(self, y_m: Callable[[float], float], from_m: float, to_m: float) -> list[Any]:
        steps = max(2, round(abs(to_m - from_m) / CURVE_STEP_M) + 1)
        return [
            self.make("geometry_msgs/msg/Point", x=x_m, y=y_m(x_m), z=0.0)
            for x_m in np.linspace(from_m, to_m, steps).tolist()
        ]

    def path(self) -> Iterator[Sent]:
        """The whole path, after the drive; nothing without `keep_path`."""
        if self._path:
            poses = [
                self.make("geometry_msgs/msg/PoseStamped", header=self.header(ODOM, t_ns), pose=self.pose(pose))
                for t_ns, pose in self._path
            ]
            header = self.header(ODOM, self._path[-1][0])
            yield "/birdslam/path", self.make("nav_msgs/msg/Path", header=header, poses=poses)

    def _vehicle(self, vehicle: RoadUser, z_m: float, t_ns: int, kind: str = "vehicle") -> Any:
        T_odom_vehicle = self._T_odom_world @ vehicle.T_world_vehicle
        pose = self.level(T_odom_vehicle, z_m)
        cov = rotated(np.reshape(vehicle.cov, (3, 3)), T_odom_vehicle.yaw_rad)
        c, s = math.cos(vehicle.T_world_vehicle.yaw_rad), math.sin(vehicle.T_world_vehicle.yaw_rad)
        R_vehicle_world = np.array([[c, s], [-s, c]])
        vx, vy = (R_vehicle_world @ vehicle.velocity_mps).tolist()
        twist_cov = np.diag([0.0, 0.0, UNKNOWN_VARIANCE])
        twist_cov[:2, :2] = R_vehicle_world @ np.reshape(vehicle.velocity_cov, (2, 2)) @ R_vehicle_world.T
        return self._odometry(f"{kind}_{vehicle.vehicle}", pose, cov, (vx, vy, 0.0), twist_cov, t_ns)

    def _detections(self, estimate: Estimate, users: Sequence[RoadUser], t_ns: int) -> Any:
        header, detections = self.header(ODOM, t_ns), []
        for vehicle in users:
            height_m = vehicle.height_m or VEHICLE_HEIGHT_M
            T_odom_vehicle = self._T_odom_world @ vehicle.T_world_vehicle
            z_m = estimate.attitude.z_m
            foot = self.level(T_odom_vehicle, z_m)
            middle = self.level(T_odom_vehicle, z_m + height_m / 2.0)
            cov = rotated(np.reshape(vehicle.cov, (3, 3)), T_odom_vehicle.yaw_rad)
            hypothesis = self.make(
                "vision_msgs/msg/ObjectHypothesisWithPose",
                hypothesis=self.make("vision_msgs/msg/ObjectHypothesis", class_id=vehicle.label, score=_score(vehicle)),
                pose=self.make("geometry_msgs/msg/PoseWithCovariance", pose=foot, covariance=six(cov)),
            )
            size = self.vector(vehicle.length_m, vehicle.width_m, height_m)
            box = self.make("vision_msgs/msg/BoundingBox3D", center=middle, size=size)
            detections.append(
                self.make(
                    "vision_msgs/msg/Detection3D", header=header, results=[hypothesis], bbox=box,
                    id=str(vehicle.vehicle),
                )
            )  # fmt: skip
        return self.make(DETECTIONS, header=header, detections=detections)

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

    def _marker(self, lane: int, points: list[Any], t_ns: int) -> Any:
        space = "lane" if lane < 0 else f"lane {lane}"
        self._markers[space] += 1  # a new id keeps the earlier markers
        return self._marker_of(ODOM, space, self._markers[space], points, t_ns)

    def _marker_of(self, frame: str, space: str, number: int, points: list[Any], t_ns: int) -> Any:
        return self.make(
            "visualization_msgs/msg/Marker", header=self.header(frame, t_ns), ns=space, id=number, type=8, action=0,
            pose=self.pose(np.eye(4)), scale=self.vector(LANE_WIDTH_M, LANE_WIDTH_M, 0.0),
            color=self.colour(1.0, 1.0, 1.0, 1.0), points=points,
        )  # fmt: skip

    def _odometry(
        self, child: str, pose: Any, cov: Floats, twist: tuple[float, ...], twist_cov: Floats, t_ns: int
    ) -> Any:
        vx, vy, yaw_rate = twist
        moving = self.make(
            "geometry_msgs/msg/Twist", linear=self.vector(vx, vy, 0.0), angular=self.vector(0.0, 0.0, yaw_rate)
        )
        return self.make(
            ODOMETRY,
            header=self.header(ODOM, t_ns),
            child_frame_id=self.frames + child,
            pose=self.make("geometry_msgs/msg/PoseWithCovariance", pose=pose, covariance=six(cov)),
            twist=self.make("geometry_msgs/msg/TwistWithCovariance", twist=moving, covariance=six(twist_cov)),
        )


def _score(user: RoadUser) -> float:
    """The probability of its class; 1 if unknown."""
    return 1.0 if user.label_probability is None else user.label_probability


def _twist(
    estimate: Estimate, before: tuple[Estimate, SE2] | None, T_odom_ego: SE2, motion: EgoEdge | None
) -> tuple[tuple[float, ...], Floats]:
    """Speed ahead and to the left in m/s, yaw rate in rad/s since the previous frame, and their covariance (3, 3)."""
    unknown = UNKNOWN_VARIANCE * np.eye(3)
    if before is None or estimate.t_source_ns <= before[0].t_source_ns or before[0].epoch != estimate.epoch:
        return (0.0, 0.0, 0.0), unknown
    dt_s = (estimate.t_source_ns - before[0].t_source_ns) / NS_PER_S
    step = before[1].between(T_odom_ego)
    if motion is not None and (motion.from_frame, motion.to_frame) == (before[0].frame_id, estimate.frame_id):
        step, unknown = motion.T_from_to, np.reshape(motion.cov, (3, 3)) / dt_s**2
    return (step.x_m / dt_s, step.y_m / dt_s, step.yaw_rad / dt_s), unknown


def t_of(record: Estimate | MapPose, live: bool) -> int:
    """The time of a message: UTC for a live camera, else the recording's clock."""
    return record.t_utc_ns if live and record.t_utc_ns else record.t_source_ns
