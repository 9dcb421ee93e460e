"""A real drive as ROS bags: the same estimates as from its files, bit for bit."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Iterator
from itertools import islice
from pathlib import Path

import cv2
import msgspec
import numpy as np
import pytest

from birdslam.bench.ego.trajectory_errors import evaluate_recordings
from birdslam.geometry.camera import AXES_EGO_CAM, Camera
from birdslam.ros.bag import Bag, BagTopics, stamp_ns
from birdslam.ros.frames import StaticFrames
from birdslam.runtime.cli.main import main
from birdslam.runtime.configuration import Configuration, SourceConfig, dump
from birdslam.runtime.recording.recording import About, RecordingWriter
from birdslam.slam import BirdSLAM
from birdslam.sources.kitti import KittiRecording
from birdslam.sources.opening import open_recording
from birdslam.sources.recording import Recording
from birdslam.sources.rosbag_truth import WGS84_A_M, WGS84_E2
from birdslam.trajectory import Transform, as_poses, inverse, mount_pose
from birdslam.types import Estimate
from tests import ros_bags as ros

DISTORTION = (-0.28, 0.09, 0.0006, -0.0004, -0.012)  # about that of KITTI's unrectified cameras


def write(
    path: Path, drive: KittiRecording, count: int, storage: str, kind: str, lens: tuple[float, ...] = (),
    truth: Transform | None = None,
) -> str:  # fmt: skip
    """The first frames of a KITTI drive as a bag: `kind` is raw or compressed, the latter with the very files.

    `truth` are the camera's poses: they become /gnss/odometry, and their places, as if z went north, /gnss/fix.
    """
    camera = drive.camera
    rotation = ros.Rotation.from_matrix(AXES_EGO_CAM)
    stand = ros.transform("base_footprint", "camera_optical", (0.0, 0.0, camera.height_m), rotation)
    numbers = (camera.width_px, camera.height_px, camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px)
    model = (*lens, *(0.0,) * (5 - len(lens)))
    topic = "/camera/image_raw" if lens else "/camera/image_rect_color"

    def messages() -> Iterable[ros.Written]:
        yield "/tf_static", 0, ros.tf(stand)
        yield "/camera/camera_info", 0, ros.camera_info(*numbers, distortion=model)
        for number, frame in zip(drive.numbers, islice(drive.frames(), count), strict=False):
            assert frame.image is not None
            if kind == "raw":
                encoding = "mono8" if frame.image.ndim == 2 else "bgr8"
                yield topic, frame.t_source_ns, ros.image(frame.image, frame.t_source_ns, encoding)
            else:
                data = next(drive.directory.glob(f"{number:06d}.*")).read_bytes()
                yield f"{topic}/compressed", frame.t_source_ns, ros.compressed(data, frame.t_source_ns)
            if truth is not None:
                pose, t_ns = truth[frame.index], frame.t_source_ns
                yield "/gnss/odometry", t_ns, ros.odometry(t_ns, pose, child="camera_optical")
                yield "/gnss/fix", t_ns, ros.fix(t_ns, *geodetic(*pose[[0, 2, 1], 3]))

    return f"rosbag:{ros.write_bag(path, messages(), storage)}"


def geodetic(east_m: float, north_m: float, down_m: float) -> tuple[float, float, float]:
    """Latitude, longitude, altitude near 49 degrees north, by the ellipsoid's radii there."""
    latitude, flat = np.radians(49.0), 1.0 - WGS84_E2 * np.sin(np.radians(49.0)) ** 2
    across, along = WGS84_A_M / np.sqrt(flat), WGS84_A_M * (1.0 - WGS84_E2) / flat**1.5
    longitude = 8.0 + np.degrees(east_m / (across * np.cos(latitude)))
    return 49.0 + float(np.degrees(north_m / along)), float(longitude), 100.0 - down_m


def estimates(recording: Recording, count: int) -> list[bytes]:
    slam = BirdSLAM.with_shipped_networks(recording.camera, recording.rate_hz)
    return [msgspec.msgpack.encode(slam.step(f)[1]) for f in islice(recording.undistorted_frames(), count)]


def small_drive(folder: Path, data_dir: Path, count: int, width: int = 310) -> KittiRecording:
    """The first frames of a real drive, a quarter as wide, as a separate KITTI drive."""
    drive = KittiRecording(data_dir / "kitti_tracking" / "training" / "image_03" / "0005")
    scale = width / drive.camera.width_px
    images = folder / "image_02" / "0005"
    images.mkdir(parents=True)
    for frame in islice(drive.frames(), count):
        assert frame.image is not None
        height = round(drive.camera.height_px * scale)
        small = cv2.resize(frame.image, (width, height), interpolation=cv2.INTER_AREA)
        cv2.imwrite(str(images / f"{frame.index:06d}.png"), small)
    (folder / "calib").mkdir()
    c = drive.camera
    P = np.array([[c.fx_px, 0, c.cx_px, 0], [0, c.fy_px, c.cy_px, 0], [0, 0, 1 / scale, 0]]) * scale
    (folder / "calib" / "0005.txt").write_text(f"P2: {' '.join(f'{v:.12g}' for v in P.ravel())}\n")
    return KittiRecording(images)


@pytest.mark.parametrize(("storage", "kind"), [("mcap", "raw"), ("sqlite3", "compressed")])
def test_a_few_small_frames_come_to_the_method_as_from_files(
    tmp_path: Path, data_dir: Path, storage: str, kind: str
) -> None:
    drive = small_drive(tmp_path / "kitti", data_dir, 8)
    recording = open_recording(write(tmp_path / "bag", drive, 8, storage, kind))
    assert (recording.camera, recording.rate_hz) == (drive.camera, drive.rate_hz)
    for ours, theirs in zip(recording.undistorted_frames(), drive.undistorted_frames(), strict=True):
        assert np.array_equal(ours.image, theirs.image)
        assert dataclasses.replace(ours, image=None) == dataclasses.replace(theirs, image=None)


@pytest.mark.slow
@pytest.mark.parametrize("lens", [(), DISTORTION], ids=["rectified", "distorted"])
def test_a_real_drive_gives_the_same_bytes_from_every_bag(
    tmp_path: Path, data_dir: Path, lens: tuple[float, ...]
) -> None:
    """The same images, declared distorted by the bag's CameraInfo and by a camera file."""
    count = 60
    folder = data_dir / "kitti_tracking" / "training" / "image_03" / "0005"
    own: Camera = KittiRecording(folder).camera
    drive = KittiRecording(folder, msgspec.structs.replace(own, distortion=lens))
    expected = estimates(drive, count)
    for storage in ("sqlite3", "mcap"):
        for kind in ("raw", "compressed"):
            recording = open_recording(write(tmp_path / f"{storage}-{kind}", drive, count, storage, kind, lens))
            assert recording.camera == drive.camera
            assert estimates(recording, count) == expected, (storage, kind)


@pytest.mark.slow
def test_a_real_bag_driven_recorded_and_exported_comes_back(tmp_path: Path, data_dir: Path) -> None:
    """A bag in, the recording of its drive, a bag out: the same times and poses, in the axes of ROS."""
    count = 30
    drive = KittiRecording(data_dir / "kitti_tracking" / "training" / "image_03" / "0005")
    uri = write(tmp_path / "bag", drive, count, "mcap", "compressed")
    recording = open_recording(uri)
    config = dump(Configuration(source=SourceConfig(uri=uri), camera=recording.camera))
    about = About(configuration=config, models={}, versions={}, utc_offset_ns=0)
    writer = RecordingWriter(tmp_path / "drive.mcap", about, recording.camera, 500.0)
    slam = BirdSLAM.with_shipped_networks(recording.camera, recording.rate_hz)
    said = []
    for frame in recording.undistorted_frames():
        measurements, estimate = slam.step(frame)
        writer.add("measurements", measurements, frame.frame_id)
        writer.add("estimate", estimate, frame.frame_id)
        said.append(estimate)
    writer.close({})
    assert main(["export", str(tmp_path / "drive.mcap"), "--ros2", str(tmp_path / "out")]) == 0
    with Bag(tmp_path / "out") as bag:
        odometry = [message.content for message in bag.messages("/birdslam/odometry")]
        cars = [message.content for message in bag.messages("/birdslam/vehicles/odometry")]
        mount = StaticFrames(bag).find("base_link", "camera_optical_frame")
    assert np.allclose(mount, mount_pose(recording.camera.ground))
    assert [stamp_ns(message) for message in odometry] == [estimate.t_source_ns for estimate in said]
    assert {estimate.epoch for estimate in said} == {0}
    for message, estimate in zip(odometry, said, strict=True):
        at, pose = message.pose.pose.position, estimate.T_world_ego
        assert (at.x, at.y, at.z) == (pose.x_m, pose.y_m, estimate.attitude.z_m)
    assert len(cars) == sum(len(estimate.vehicles) for estimate in said) > 0


@pytest.mark.slow
def test_real_drive_is_compared_with_the_truth_of_its_bag(tmp_path: Path, data_dir: Path) -> None:
    """nav_msgs/Odometry gives the ATE that KITTI's poses give; fixes, which have no attitude, that after alignment."""
    count = 60
    drive = KittiRecording(data_dir / "kitti_tracking" / "training" / "image_03" / "0005")
    T_cam0_cam, rows = drive.T_cam0_cam(), drive.truth_poses()
    assert rows is not None
    uri = write(
        tmp_path / "bag", drive, count, "mcap", "compressed", (), inverse(T_cam0_cam) @ as_poses(rows) @ T_cam0_cam
    )

    def run(recording: Recording) -> Iterator[Estimate]:
        slam = BirdSLAM.with_shipped_networks(recording.camera, recording.rate_hz)
        for frame in islice(recording.undistorted_frames(), count):
            yield slam.step(frame)[1]

    by_poses = evaluate_recordings([drive], run, tmp_path / "files", compared=slice(0, count))[0]
    assert by_poses.ate_m is not None
    for topic in ("/gnss/odometry", "/gnss/fix"):
        bag = open_recording(uri, topics=BagTopics(truth=topic))
        place = tmp_path / topic.rpartition("/")[2]
        (by_bag,) = evaluate_recordings([bag], run, place)
        trajectories = {
            path.read_bytes() for path in (*tmp_path.glob("files/*/ego.kitti.txt"), place / "bag/ego.kitti.txt")
        }
        assert len(trajectories) == 1
        assert by_bag.ate_se3_m == pytest.approx(by_poses.ate_se3_m, rel=0.02)
        if topic == "/gnss/odometry":
            assert by_bag.ate_m == pytest.approx(by_poses.ate_m, rel=0.01)
