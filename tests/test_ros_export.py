"""A recording as a ROS 2 bag, read back field by field: frames of REP-103 and REP-105, covariances in ROS' axes."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from birdslam.geometry.camera import Camera
from birdslam.geometry.se2 import SE2
from birdslam.loops.map_pose import EarthPose, MapPose, MapState
from birdslam.ros.bag import Bag, BagError
from birdslam.ros.bag_writer import BagWriter
from birdslam.ros.frames import StaticFrames
from birdslam.ros.parts import UNKNOWN_VARIANCE
from birdslam.runtime.cli.main import main
from birdslam.runtime.configuration import Configuration, SourceConfig, dump
from birdslam.runtime.recording.recording import About, RecordingWriter
from birdslam.trajectory import ego_pose, mount_pose
from birdslam.types import Attitude, EgoEdge, Estimate, MapUpdate, Measurements, SpeedSource, Status, VehicleEstimate

CAMERA = Camera(64, 32, 50.0, 50.0, 32.0, 16.0, 1.5, pitch_rad=0.05, roll_rad=-0.02)
COV = (0.04, 0.01, 0.0, 0.01, 0.09, 0.002, 0.0, 0.002, 0.001)
FIRST_NS, PERIOD_NS = 1_700_000_000_000_000_000, 100_000_000
ATTITUDE = Attitude(z_m=0.3, pitch_rad=0.02, roll_rad=-0.01)
CAR = VehicleEstimate(
    vehicle=7, T_world_vehicle=SE2(20.0, 2.0, math.pi / 2), cov=COV, velocity_mps=(1.0, 3.0),
    velocity_cov=(0.5, 0.1, 0.1, 0.2), age_ns=0, frames=5, label="van", length_m=4.6, width_m=1.9,
)  # fmt: skip


def estimate(frame: int, pose: SE2, epoch: int = 0, **fields: Any) -> Estimate:
    t_ns = FIRST_NS + frame * PERIOD_NS
    fields = {"valid": True, "vehicles": (CAR,), "attitude": ATTITUDE, **fields}
    return Estimate(
        epoch=epoch, frame_id=frame, t_source_ns=t_ns, t_capture_ns=frame, t_utc_ns=t_ns + 5, T_world_ego=pose, cov=COV,
        **fields,
    )  # fmt: skip


def measurements(frame: int, cc: EgoEdge | None = None) -> Measurements:
    t_ns = FIRST_NS + frame * PERIOD_NS
    return Measurements(frame_id=frame, t_source_ns=t_ns, t_capture_ns=frame, t_utc_ns=t_ns + 5, cc=cc)


EDGE = EgoEdge(from_frame=0, to_frame=1, T_from_to=SE2(1.2, 0.0, 0.03), cov=tuple(v / 100.0 for v in COV))
DRIVE = (
    measurements(0),
    estimate(0, SE2(), status=(Status.SCALE_CARRIED,)),
    measurements(1, EDGE),
    estimate(1, SE2(1.0, 0.5, 0.4), speed_sources=(SpeedSource.ROAD,), scale_sigma_rel=0.02),
    MapUpdate(epoch=0, frame_id=1, lanes_m=((3.0, 1.0), (4.0, 1.0), (3.0, -2.0)), lane_ids=(4, 4, -1)),
    measurements(2),
    estimate(2, SE2(0.0, 0.0, 0.1), epoch=1, valid=False, status=(Status.NOT_INITIALISED, Status.GRAPH_RESET)),
    measurements(3),
    estimate(3, SE2(2.0, 0.0, 0.1), epoch=1, vehicles=()),
)


def recording(
    path: Path, uri: str = "kitti:drive", camera: Camera | None = CAMERA, records: Any = DRIVE, poses: Any = ()
) -> Path:
    config = dump(Configuration(vehicle="bus", source=SourceConfig(uri=uri), camera=camera))
    writer = RecordingWriter(path, About(configuration=config, models={}, versions={}, utc_offset_ns=0), camera, 500.0)
    topics = {Measurements: "measurements", Estimate: "estimate", MapUpdate: "map"}
    for t_ns, record in enumerate(records):
        writer.add(topics[type(record)], record, t_ns)
    for pose in poses:
        writer.draw("/map_pose", pose, len(records))
    writer.close({})
    return path


@pytest.fixture(scope="module", params=["mcap", "sqlite3"])
def sent(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> dict[str, list[Any]]:
    """Messages by topic."""
    place = tmp_path_factory.mktemp("export")
    bag = place / "bag"
    assert main(["export", str(recording(place / "d.mcap")), "--ros2", str(bag), "--storage", request.param]) == 0
    assert [path.name for path in place.iterdir() if path != bag] == ["d.mcap"]
    assert sorted(path.stem for path in bag.iterdir()) == ["bag", "metadata"]
    found: dict[str, list[Any]] = {}
    with Bag(bag) as opened:
        for message in opened.messages(*opened.types):
            found.setdefault(message.topic, []).append(message.content)
        T_base_cam = StaticFrames(opened).find("base_link", "camera_optical_frame")
    assert np.abs(T_base_cam - mount_pose(CAMERA.ground)).max() < 1e-12
    return found


def matrix(pose: Any) -> np.ndarray:
    at, q = (pose.position, pose.orientation) if hasattr(pose, "position") else (pose.translation, pose.rotation)
    out = np.eye(4)
    out[:3, :3] = Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix()
    out[:3, 3] = at.x, at.y, at.z
    return out


# The last epoch starts at the end of the one before
IN_ODOM = [
    SE2(),
    SE2(1.0, 0.5, 0.4),
    SE2(1.0, 0.5, 0.4),
    SE2(1.0, 0.5, 0.4) @ SE2(0, 0, 0.1).inverse() @ SE2(2, 0, 0.1),
]


def test_ego_pose_is_exported(sent: dict[str, list[Any]]) -> None:
    for frame, (message, transform, pose) in enumerate(
        zip(sent["/birdslam/odometry"], sent["/tf"], IN_ODOM, strict=True)
    ):
        assert (message.header.frame_id, message.child_frame_id) == ("odom", "base_link")
        stamp = message.header.stamp
        assert stamp.sec * 10**9 + stamp.nanosec == FIRST_NS + frame * PERIOD_NS  # the recording's clock, as in its bag
        expected = ego_pose(pose, ATTITUDE)
        assert np.abs(matrix(message.pose.pose) - expected).max() < 1e-9
        (one,) = transform.transforms
        assert (one.header.frame_id, one.child_frame_id, one.header.stamp) == ("odom", "base_link", stamp)
        assert np.abs(matrix(one.transform) - expected).max() < 1e-9
    (path,) = sent["/birdslam/path"]
    assert [matrix(p.pose)[0, 3] for p in path.poses] == pytest.approx([pose.x_m for pose in IN_ODOM])
    assert path.header.frame_id == "odom"


def test_covariances_are_in_ros_axes(sent: dict[str, list[Any]]) -> None:
    cov = sent["/birdslam/odometry"][1].pose.covariance.reshape(6, 6)
    c, s = math.cos(0.4), math.sin(0.4)
    R = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    plane = np.ix_((0, 1, 5), (0, 1, 5))
    assert np.abs(cov[plane] - R @ np.reshape(COV, (3, 3)) @ R.T).max() < 1e-12
    assert [cov[i, i] for i in (2, 3, 4)] == [UNKNOWN_VARIANCE] * 3


def test_the_motion_is_the_measured_one_with_its_covariance(sent: dict[str, list[Any]]) -> None:
    first, measured, reset, unmeasured = (message.twist for message in sent["/birdslam/odometry"])
    assert (measured.twist.linear.x, measured.twist.angular.z) == pytest.approx((12.0, 0.3))
    assert measured.covariance[0] == pytest.approx(0.04)  # of 1/100 of it in a tenth of a second
    assert measured.covariance[35] == pytest.approx(0.001)
    for unknown in (first, reset):
        assert (unknown.twist.linear.x, unknown.covariance[0]) == (0.0, UNKNOWN_VARIANCE)
    assert (unmeasured.twist.linear.x, unmeasured.covariance[0]) == (
        pytest.approx(20 * math.cos(0.1)),
        UNKNOWN_VARIANCE,
    )


def test_vehicles(sent: dict[str, list[Any]]) -> None:
    boxes = sent["/birdslam/vehicles"]
    assert [len(message.detections) for message in boxes] == [1, 1, 1, 0]
    (box,) = boxes[1].detections
    (result,) = box.results
    assert (box.id, result.hypothesis.class_id, box.header.frame_id) == ("7", "van", "odom")
    assert (box.bbox.size.x, box.bbox.size.y) == (4.6, 1.9)
    assert np.abs(matrix(result.pose.pose) - ego_pose(CAR.T_world_vehicle, Attitude(z_m=0.3))).max() < 1e-9
    assert box.bbox.center.position.z == pytest.approx(0.3 + 0.75)
    moving = sent["/birdslam/vehicles/odometry"]
    assert [message.child_frame_id for message in moving] == ["vehicle_7"] * 3
    twist = moving[1].twist
    assert (twist.twist.linear.x, twist.twist.linear.y) == pytest.approx((3.0, -1.0))  # it looks to the left of world
    cov = twist.covariance.reshape(6, 6)
    assert cov[:2, :2].ravel() == pytest.approx([0.2, -0.1, -0.1, 0.5])
    assert cov[5, 5] == UNKNOWN_VARIANCE
    assert moving[1].pose.covariance == pytest.approx(result.pose.covariance)
    placed = IN_ODOM[1] @ SE2(0, 0, 0.1).inverse() @ CAR.T_world_vehicle  # in the second world
    assert matrix(moving[2].pose.pose)[:2, 3] == pytest.approx((placed.x_m, placed.y_m))


def test_lanes(sent: dict[str, list[Any]]) -> None:
    (message,) = sent["/birdslam/lanes"]
    loose, lane = message.markers
    assert (loose.ns, lane.ns, lane.type, lane.action) == ("lane", "lane 4", lane.POINTS, lane.ADD)
    assert [(p.x, p.y, p.z) for p in lane.points] == [(3.0, 1.0, 0.3), (4.0, 1.0, 0.3)]
    assert [(p.x, p.y) for p in loose.points] == [(3.0, -2.0)]
    assert (lane.header.frame_id, lane.pose.orientation.w, lane.color.a) == ("odom", 1.0, 1.0)


def test_diagnostics(sent: dict[str, list[Any]]) -> None:
    found = [message.status[0] for message in sent["/diagnostics"]]
    assert [status.level for status in found] == [1, 0, 2, 0]
    assert [status.message for status in found] == ["scale_carried", "ok", "not_initialised, graph_reset", "ok"]
    values = {one.key: one.value for one in found[1].values}
    assert values == {
        "frame_id": "1", "epoch": "0", "valid": "true", "scale_sigma_rel": "0.02", "speed_sources": "road",
        "vehicles": "1",
        "people": "0",
    }  # fmt: skip
    assert {status.hardware_id for status in found} == {"bus"}


def map_pose(frame: int, epoch: int, state: MapState, **fields: Any) -> MapPose:
    t_ns = FIRST_NS + frame * PERIOD_NS
    return MapPose(
        frame_id=frame, t_source_ns=t_ns, t_capture_ns=frame, t_utc_ns=t_ns + 5, epoch=epoch, state=state, **fields
    )


def test_a_drive_in_a_map_is_in_its_frame_and_on_earth(tmp_path: Path) -> None:
    T_map_world, T_world_ego = SE2(100.0, 50.0, 1.2), DRIVE[-1].T_world_ego
    earth = EarthPose(latitude_deg=49.0, longitude_deg=8.4, cov=(4.0, 1.0, 1.0, 9.0), yaw_rad=0.1, yaw_sigma_rad=0.02)
    there = {"T_map_odom": T_map_world, "T_odom_ego": T_world_ego, "cov": COV, "earth": earth, "map_epoch": 3}
    poses = (
        map_pose(1, 0, MapState.LOST),
        map_pose(2, 0, MapState.LOCALISED, **there),  # of the epoch that is over
        map_pose(3, 1, MapState.LOCALISED, **there),
    )
    drive = recording(tmp_path / "d.mcap", poses=poses)
    assert main(["export", str(drive), "--ros2", str(tmp_path / "bag")]) == 0
    with Bag(tmp_path / "bag") as bag:
        joined = [one for m in bag.messages("/tf") for one in m.content.transforms if one.child_frame_id == "odom"]
        (pose,), (fix,) = (
            [m.content for m in bag.messages(topic)] for topic in ("/birdslam/map_pose", "/birdslam/fix")
        )
        said = [one for m in bag.messages("/diagnostics") for one in m.content.status if one.name == "birdslam: map"]
    assert [(one.message, one.level) for one in said] == [("lost", 1), ("localised", 0)]
    (one,) = joined
    T_map_ego = T_map_world @ T_world_ego
    assert (one.header.frame_id, pose.header.frame_id) == ("map", "map")
    level = matrix(one.transform) @ ego_pose(IN_ODOM[3], Attitude())  # through `odom`, which goes on over the epoch
    assert np.abs(level - ego_pose(T_map_ego, Attitude())).max() < 1e-9
    assert np.abs(matrix(pose.pose.pose) - ego_pose(T_map_ego, Attitude())).max() < 1e-9
    c, s = math.cos(T_map_ego.yaw_rad), math.sin(T_map_ego.yaw_rad)
    R = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    cov = pose.pose.covariance.reshape(6, 6)
    assert np.abs(cov[np.ix_((0, 1, 5), (0, 1, 5))] - R @ np.reshape(COV, (3, 3)) @ R.T).max() < 1e-12
    assert (fix.header.frame_id, fix.latitude, fix.longitude, fix.status.status) == ("base_link", 49.0, 8.4, 0)
    assert fix.position_covariance.reshape(3, 3)[:2, :2].tolist() == [[4.0, 1.0], [1.0, 9.0]]
    assert math.isnan(fix.altitude)
    assert fix.position_covariance_type == 3


def test_a_live_drive_has_utc(tmp_path: Path) -> None:
    main(["export", str(recording(tmp_path / "d.mcap", "v4l2:/dev/video0")), "--ros2", str(tmp_path / "bag")])
    with Bag(tmp_path / "bag") as bag:
        assert next(bag.messages("/birdslam/odometry")).t_ns == FIRST_NS + 5


def test_export_errors_are_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    drive = str(recording(tmp_path / "d.mcap"))
    (tmp_path / "there").mkdir()
    for arguments, said in (
        ([drive, "--ros2", str(tmp_path / "there")], "there: exists already"),
        ([str(tmp_path / "none.mcap"), "--ros2", str(tmp_path / "x")], "none.mcap: can't be read"),
        ([str(recording(tmp_path / "e.mcap", records=())), "--ros2", str(tmp_path / "x")], "has no estimate"),
        ([str(recording(tmp_path / "f.mcap", camera=None)), "--ros2", str(tmp_path / "x")], "has no camera"),
    ):
        assert main(["export", *arguments]) == 2
        assert said in capsys.readouterr().err
    assert not (tmp_path / "x").exists()
    assert not list(tmp_path.glob(".*"))


def test_failed_bag_leaves_nothing(tmp_path: Path) -> None:
    def fail() -> None:
        with BagWriter(tmp_path / "bag") as bag:
            bag.write("/a", bag.make("std_msgs/msg/String"), 3)
            raise RuntimeError("half way")

    with pytest.raises(RuntimeError, match="half way"):
        fail()
    assert not list(tmp_path.iterdir())
    with pytest.raises(BagError, match="can't be written"):
        BagWriter(Path("/proc/no/bag"))
