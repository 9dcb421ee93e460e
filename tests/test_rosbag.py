"""ROS bags as sources: storages, encodings, camera and mount, speeds, truth; torn or ambiguous bags."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Iterator
from pathlib import Path

import cv2
import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from birdslam.bench.ego.trajectory_errors import evaluate_recordings
from birdslam.geometry.camera import AXES_EGO_CAM, Camera, GroundPlane, Undistorter
from birdslam.ros.bag import BagTopics
from birdslam.ros.sensor import demosaiced, lens, pixels
from birdslam.runtime.calibration.given import Given, lens_of
from birdslam.runtime.configuration import load
from birdslam.runtime.nodes.sources import open_source
from birdslam.sources.opening import open_recording
from birdslam.sources.recording import DatasetError, Recording
from birdslam.sources.rosbag import MAX_CLOCK_ERROR_NS, ImageClock, RosbagRecording
from birdslam.sources.rosbag_truth import east_north_up
from birdslam.trajectory import as_poses, mount_pose
from birdslam.types import Estimate
from tests import ros_bags as ros
from tests.records import new_estimate

WIDTH, HEIGHT = 64, 32
PERIOD_NS = 100_000_000
FIRST_NS = 1_700_000_000_123_456_789
CAMERA = Camera(WIDTH, HEIGHT, 50.0, 51.0, 31.0, 16.5, 1.5)
MOUNT = GroundPlane(1.4, pitch_rad=0.03, roll_rad=-0.01)
INFO = (WIDTH, HEIGHT, 50.0, 51.0, 31.0, 16.5)
RNG = np.random.default_rng(11)
GREYS = [RNG.integers(0, 256, (HEIGHT, WIDTH), dtype=np.uint8) for _ in range(6)]
IMAGE, CAMERA_INFO = "/car/front/image_raw", "/car/front/camera_info"


def mounted() -> ros.Written:
    """The camera over the road by two transforms, its optical frame as REP-103 has it."""
    T_base_cam = mount_pose(MOUNT)
    T_base_cam[:2, 3] = 1.8, 0.3
    turned = Rotation.from_matrix(T_base_cam[:3, :3] @ AXES_EGO_CAM.T)
    link = ros.transform("base_link", "camera", (1.8, 0.3, MOUNT.height_m), turned)
    return "/tf_static", FIRST_NS, ros.tf(ros.transform("camera", "camera_optical", (0, 0, 0), OPTICAL), link)


OPTICAL = Rotation.from_matrix(AXES_EGO_CAM)


def drive(count: int = 6, start_ns: int = FIRST_NS) -> list[ros.Written]:
    times = [start_ns + i * PERIOD_NS for i in range(count)]
    images = [(IMAGE, t + 5_000_000, ros.image(GREYS[i % 6], t)) for i, t in enumerate(times)]
    return [(CAMERA_INFO, start_ns, ros.camera_info(*INFO)), mounted(), *images]


def bag(path: Path, *more: ros.Written, storage: str = "sqlite3") -> str:
    messages = sorted([*drive(), *more], key=lambda message: message[1])
    return f"rosbag:{ros.write_bag(path, messages, storage)}"


@pytest.mark.parametrize("storage", ["sqlite3", "mcap", "ros1"])
def test_drive_is_read_from_every_storage(tmp_path: Path, storage: str) -> None:
    place = tmp_path / ("drive.bag" if storage == "ros1" else "drive")
    recording = open_recording(bag(place, storage=storage))
    assert (recording.name, len(recording), recording.rate_hz) == ("drive", 6, pytest.approx(10.0))
    own = recording.camera
    assert (own.fx_px, own.fy_px, own.cx_px, own.cy_px, own.distortion) == (50.0, 51.0, 31.0, 16.5, ())
    assert (own.height_m, own.pitch_rad, own.roll_rad) == pytest.approx((1.4, 0.03, -0.01))
    frames = list(recording.frames())
    assert [frame.t_source_ns for frame in frames] == [FIRST_NS + i * PERIOD_NS for i in range(6)]
    assert [frame.index for frame in frames] == list(range(6))
    for frame, expected in zip(frames, GREYS, strict=True):
        assert np.array_equal(frame.image, expected)
    assert [frame.index for frame in recording.frames(4)] == [4, 5]
    assert RosbagRecording.frame_size(place, BagTopics()) == (WIDTH, HEIGHT)


def test_a_single_file_is_a_bag_too(tmp_path: Path) -> None:
    for storage, suffix in (("sqlite3", "db3"), ("mcap", "mcap")):
        bag(tmp_path / storage, storage=storage)
        (file,) = (tmp_path / storage).glob(f"*.{suffix}")
        assert len(list(open_recording(f"rosbag:{file}").frames())) == 6


def test_a_stride_takes_every_nth_frame(tmp_path: Path) -> None:
    recording = open_recording(bag(tmp_path / "drive"), stride=4)
    assert (len(recording), recording.rate_hz) == (2, pytest.approx(2.5))
    assert [(f.index, f.t_source_ns) for f in recording.frames()] == [(0, FIRST_NS), (1, FIRST_NS + 4 * PERIOD_NS)]


BGR = RNG.integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8)


@pytest.mark.parametrize(
    ("encoding", "stored", "expected"),
    [
        ("mono8", GREYS[0], GREYS[0]),
        ("bgr8", BGR, BGR),
        ("rgb8", BGR[..., ::-1], BGR),
        ("bgra8", np.dstack([BGR, BGR[..., 0]]), BGR),
        ("rgba8", np.dstack([BGR[..., ::-1], BGR[..., 0]]), BGR),
    ],
)
@given(padding=st.integers(0, 40))
def test_each_encoding_is_decoded(encoding: str, stored: np.ndarray, expected: np.ndarray, padding: int) -> None:
    assert np.array_equal(pixels(ros.image(stored, 0, encoding, padding)), expected)


@pytest.mark.parametrize("pattern", ["rggb", "bggr", "gbrg", "grbg"])
def test_a_bayer_mosaic_is_demosaiced_also_from_a_jpeg(pattern: str) -> None:
    colour = {"r": 200, "g": 100, "b": 30}
    mosaic = np.tile(np.array([colour[c] for c in pattern], np.uint8).reshape(2, 2), (HEIGHT // 2, WIDTH // 2))
    raw = pixels(ros.image(mosaic, 0, f"bayer_{pattern}8"))
    assert (raw[4:-4, 4:-4] == (30, 100, 200)).all()
    assert np.array_equal(demosaiced(f"bayer_{pattern}8; png compressed ", mosaic), raw)
    assert demosaiced(f"bayer_{pattern}8; jpeg compressed bgr8", raw) is raw  # the driver has made it BGR
    assert demosaiced("mono8; jpeg compressed mono8", mosaic) is mosaic
    with pytest.raises(ValueError, match="bayer_rggb16"):
        demosaiced("bayer_rggb16; png compressed ", mosaic)


@pytest.mark.parametrize(("encoding", "luma"), [("yuv422", 1), ("uyvy", 1), ("yuyv", 0), ("yuv422_yuy2", 0)])
def test_yuv_without_colour_is_grey(encoding: str, luma: int) -> None:
    stored = np.full((HEIGHT, WIDTH, 2), 128, np.uint8)
    stored[..., luma] = GREYS[0] // 2 + 50
    image = pixels(ros.image(stored, 0, encoding)).astype(int)
    assert np.array_equal(image[..., 0], image[..., 1])
    expected = (stored[..., luma].astype(int) - 16) * 255 / 219
    assert np.abs(image[..., 2] - expected).max() <= 1


@given(
    st.sampled_from(["mono8", "rgb8", "yuv422", "bayer_rggb8", "16UC1", "", "jpeg"]),
    st.integers(0, 40), st.integers(0, 40), st.integers(0, 200), st.binary(max_size=300),
)  # fmt: skip
def test_any_image_message_is_an_image_or_an_error(
    encoding: str, height: int, width: int, step: int, data: bytes
) -> None:
    message = ros.image(GREYS[0], 0, encoding)
    message.height, message.width, message.step = height, width, step
    message.data = np.frombuffer(data, np.uint8)
    with contextlib.suppress(ValueError):
        assert pixels(message).shape[:2] == (height, width)


def test_compressed_images(tmp_path: Path) -> None:
    smooth = cv2.GaussianBlur(GREYS[0], (0, 0), 5)
    files = [cv2.imencode(suffix, smooth)[1].tobytes() for suffix in (".png", ".jpg")]
    torn = files[1][: len(files[1]) // 2]
    topic = "/car/front/image_raw/compressed"
    images = [
        (topic, FIRST_NS + i, ros.compressed(data, FIRST_NS + i * PERIOD_NS)) for i, data in enumerate([*files, torn])
    ]
    messages = [(CAMERA_INFO, FIRST_NS, ros.camera_info(*INFO)), mounted(), *images]
    recording = open_recording(f"rosbag:{ros.write_bag(tmp_path / 'drive', messages)}")
    png, jpeg, cut = recording.frames()
    assert np.array_equal(png.image, smooth)
    assert np.array_equal(jpeg.image, cv2.imdecode(np.frombuffer(files[1], np.uint8), cv2.IMREAD_UNCHANGED))
    assert cut.image is None
    assert "image 2: truncated JPEG" in str(cut.error)


@pytest.mark.parametrize(
    ("info", "rectified", "expected"),
    [
        (ros.camera_info(*INFO, "plumb_bob", (-0.3, 0.1, 0.001, 0.002, 0.0)), False, (50.0, 31.0, 5, False)),
        (ros.camera_info(*INFO, "rational_polynomial", (0.1,) * 8), False, (50.0, 31.0, 8, False)),
        *((ros.camera_info(*INFO, "plumb_bob", (0.1,) * n), False, (50.0, 31.0, n, False)) for n in (4, 8, 12, 14)),
        (ros.camera_info(*INFO, "equidistant", (0.0,) * 4), False, (50.0, 31.0, 4, True)),
        (ros.camera_info(*INFO, "plumb_bob", (-0.3,) * 5, rectified=(45, 46, 30, 15)), True, (45.0, 30.0, 0, False)),
        (ros.camera_info(*INFO, binning=2), False, (25.0, 15.5, 0, False)),
        (ros.camera_info(*INFO, roi=(11, 2, 40, 20)), False, (50.0, 20.0, 0, False)),
    ],
)
def test_camera_info(info: object, rectified: bool, expected: tuple[float, float, int, bool]) -> None:
    found = lens(info, rectified)
    assert (found.fx_px, found.cx_px, len(found.distortion), found.fisheye) == expected


@pytest.mark.parametrize("fisheye", [False, True])
def test_distorted_image_is_undistorted(fisheye: bool) -> None:
    """A grid of world points seen through the lens is at its pinhole projection after undistortion."""
    coefficients = (0.05, -0.01, 0.002, -0.001) if fisheye else (-0.25, 0.08, 0.001, -0.002, 0.0)
    camera = Camera(640, 480, 300.0, 305.0, 322.0, 238.0, 1.5, distortion=coefficients, fisheye=fisheye)
    rays = np.array([[x, y, 1.0] for x in (-0.5, 0.0, 0.4) for y in (-0.3, 0.25)])
    project = cv2.fisheye.projectPoints if fisheye else cv2.projectPoints
    seen = project(rays.reshape(-1, 1, 3), np.zeros(3), np.zeros(3), camera.K, np.array(coefficients))[0].reshape(-1, 2)
    for at, ray in zip(seen, rays, strict=True):
        spot = np.zeros((480, 640), np.uint8)
        cv2.circle(spot, tuple(np.round(at * 16).astype(int).tolist()), 5 * 16, 255, -1, cv2.LINE_AA, 4)
        y, x = np.nonzero(Undistorter(camera)(spot) > 127)
        assert np.abs([x.mean(), y.mean()] - camera.to_px(ray[None, :2])[0]).max() < 1.0


def test_a_fisheye_needs_its_four_coefficients() -> None:
    with pytest.raises(ValueError, match="fisheye needs 4 distortion"):
        Camera(640, 480, 300.0, 305.0, 322.0, 238.0, 1.5, fisheye=True)


def test_several_topics_are_listed_and_one_is_named(tmp_path: Path) -> None:
    rear, info = "/car/rear/image_rect_color", "/car/rear/camera_info"
    uri = bag(
        tmp_path / "drive",
        *((rear, FIRST_NS + i, ros.image(GREYS[0], FIRST_NS + i * PERIOD_NS)) for i in range(3)),
        (info, FIRST_NS, ros.camera_info(*INFO, distortion=(-0.3,) * 5, rectified=(44, 45, 30, 15))),
    )
    with pytest.raises(DatasetError, match=r"2 image topics; name one \(--topic\).*front/image_raw.*rear/image_rect"):
        open_recording(uri)
    with pytest.raises(DatasetError, match=r"/nothing is not in it; .*Such topics: /car/front/image_raw"):
        open_recording(uri, topics=BagTopics(image="/nothing"))
    recording = open_recording(uri, topics=BagTopics(image=rear))
    assert (len(recording), recording.camera.fx_px, recording.camera.distortion) == (3, 44.0, ())
    front = open_recording(uri, topics=BagTopics(image=IMAGE, camera_info=info))
    assert front.camera.distortion == (-0.3,) * 5
    with pytest.raises(DatasetError, match=r"camera_info is sensor_msgs/CameraInfo; expected geometry_msgs/Twist"):
        open_recording(uri, topics=BagTopics(image=IMAGE, speed=info))


def test_camera_without_mount_needs_a_file(tmp_path: Path) -> None:
    messages = [message for message in drive() if message[0] != "/tf_static"]
    path = ros.write_bag(tmp_path / "drive", messages)
    with pytest.raises(DatasetError, match=r"height of the camera above.*birdslam calibrate rosbag:.*--height M"):
        open_recording(f"rosbag:{path}")
    assert open_recording(f"rosbag:{path}", CAMERA).camera is CAMERA
    own = RosbagRecording.own_lens(path, BagTopics())
    assert (own.source, own.height_m, own.lens.fx_px) == (CAMERA_INFO, None, 50.0)
    wrong = msgspec.structs.replace(CAMERA, width_px=65)
    with pytest.raises(DatasetError, match="are 64x32, but the given camera is for 65x32"):
        open_recording(f"rosbag:{path}", wrong)


def test_implausible_mount_is_named(tmp_path: Path) -> None:
    messages = [message for message in drive() if message[0] != "/tf_static"]
    frames = ros.tf(ros.transform("base_link", "camera_optical", (1.0, 0.0, 1.5), Rotation.identity()))
    path = ros.write_bag(tmp_path / "drive", [("/tf_static", FIRST_NS, frames), *messages])
    with pytest.raises(DatasetError, match="not an optical frame"):
        open_recording(f"rosbag:{path}")


def test_a_camera_without_calibration_is_named(tmp_path: Path) -> None:
    empty = ros.camera_info(WIDTH, HEIGHT, 0.0, 0.0, 0.0, 0.0)
    path = ros.write_bag(tmp_path / "drive", [(CAMERA_INFO, FIRST_NS, empty), *drive()[1:]])
    with pytest.raises(DatasetError, match="has no calibration: its focal lengths are zero; give a camera file"):
        open_recording(f"rosbag:{path}")


def test_image_out_of_order_is_unreadable(tmp_path: Path) -> None:
    messages = drive()
    messages.insert(5, (IMAGE, messages[4][1] + 1, ros.image(GREYS[5], FIRST_NS)))
    frames = list(open_recording(f"rosbag:{ros.write_bag(tmp_path / 'drive', messages)}").frames())
    assert [frame.image is None for frame in frames] == [False, False, False, True, False, False, False]
    assert "not later than the previous" in str(frames[3].error)
    times = [frame.t_source_ns for frame in frames]
    assert times == sorted(set(times))
    assert times[-1] == FIRST_NS + 5 * PERIOD_NS


def test_images_without_times_have_those_of_the_bag(tmp_path: Path) -> None:
    messages = [(topic, t_ns, m if topic != IMAGE else ros.image(GREYS[0], 0)) for topic, t_ns, m in drive()]
    recording = open_recording(f"rosbag:{ros.write_bag(tmp_path / 'drive', messages)}")
    assert [f.t_source_ns for f in recording.frames()] == [FIRST_NS + 5_000_000 + i * PERIOD_NS for i in range(6)]


def test_the_speed_of_the_car(tmp_path: Path) -> None:
    speeds = [("/speed", FIRST_NS + i, ros.twist(FIRST_NS + i * PERIOD_NS, 3.0 + i)) for i in range(6)]
    pose = np.eye(4)
    wheels = [("/wheels", FIRST_NS, ros.odometry(FIRST_NS, pose, speed_mps=7.0, variance=0.04))]
    uri = bag(tmp_path / "drive", *speeds, *wheels)
    assert all(frame.speeds == () for frame in open_recording(uri).frames_with_speeds())
    frames = list(open_recording(uri, topics=BagTopics(speed="/speed")).frames_with_speeds())
    assert [frame.speeds[-1].speed_mps for frame in frames] == [3.0, 4.0, 5.0, 6.0, 7.0, 8.0]
    assert frames[3].speeds[-1].t_ns == frames[3].t_source_ns
    assert {(r.sigma_mps, r.yaw_rate_radps) for r in frames[-1].speeds} == {(0.1, None)}  # without yaw rate
    (reading,) = next(open_recording(uri, topics=BagTopics(speed="/wheels")).frames_with_speeds()).speeds
    assert (reading.speed_mps, reading.sigma_mps) == (7.0, pytest.approx(0.2))


def truth_of(recording: Recording) -> np.ndarray:
    rows = recording.truth_poses()
    assert rows is not None
    return rows


def test_the_truth_of_an_odometry_is_that_of_the_camera(tmp_path: Path) -> None:
    """A car that turns: its base_link's poses, at times between the frames, give the camera's with its lever arm."""
    T_base_cam = mount_pose(MOUNT)
    T_base_cam[:2, 3] = 1.8, 0.3

    def base(s: float) -> np.ndarray:
        pose = np.eye(4)
        pose[:3, :3] = Rotation.from_euler("z", 0.8 * s).as_matrix()
        pose[:3, 3] = 5.0 * np.sin(0.8 * s), 5.0 * (1.0 - np.cos(0.8 * s)), 0.0
        return pose

    at = [-0.02 + 0.004 * i for i in range(140)]
    poses = [("/gt", FIRST_NS + i, ros.odometry(FIRST_NS + round(s * 1e9), base(s))) for i, s in enumerate(at)]
    uri = bag(tmp_path / "drive", *poses)
    assert open_recording(uri).truth_poses() is None
    rows = as_poses(truth_of(open_recording(uri, topics=BagTopics(truth="/gt"))))
    camera = [base(0.1 * i) @ T_base_cam for i in range(6)]
    for row, pose in zip(rows, camera, strict=True):
        assert np.abs(row - np.linalg.inv(camera[0]) @ pose).max() < 1e-4
    late = [message for message in poses if message[2].header.stamp.nanosec > 400_000_000]
    rows = truth_of(open_recording(bag(tmp_path / "late", *late), topics=BagTopics(truth="/gt")))
    assert np.isfinite(rows).all(axis=(1, 2)).tolist() == [False, False, False, True, True, True]


def test_frames_without_truth_are_named_and_left_out(tmp_path: Path) -> None:
    poses = [("/gt", FIRST_NS + i, ros.odometry(FIRST_NS + 250_000_000 + i * PERIOD_NS, np.eye(4))) for i in range(5)]
    recording = open_recording(bag(tmp_path / "drive", *poses), topics=BagTopics(truth="/gt"))

    def standing(recording: Recording) -> Iterator[Estimate]:
        for frame in recording.frames():
            yield new_estimate(frame_id=frame.index, t_source_ns=frame.t_source_ns)  # fmt: skip

    with pytest.raises(DatasetError, match=r"known of 3 of 6 frames, from 3 to 5: compare those \(--frames 3:6\)"):
        evaluate_recordings([recording], standing, tmp_path / "out")
    (report,) = evaluate_recordings([recording], standing, tmp_path / "out", compared=slice(3, 6))
    assert (report.frames, report.ate_m) == (3, pytest.approx(0.0, abs=1e-6))


def test_calibrate_takes_the_lens_of_the_bag_and_the_height_where_it_is_known(tmp_path: Path) -> None:
    none = Given()
    found, height_m = lens_of(none, bag(tmp_path / "drive"), BagTopics())
    assert (found.fx_px, found.width_px, found.source, height_m) == (50.0, WIDTH, CAMERA_INFO, pytest.approx(1.4))
    without = ros.write_bag(tmp_path / "without", [message for message in drive() if message[0] != "/tf_static"])
    assert lens_of(none, f"rosbag:{without}", BagTopics())[1] is None
    stated = Given(height_m=1.2)
    assert lens_of(stated, f"rosbag:{without}", BagTopics())[1] == 1.2


def test_the_truth_of_a_satellites_fixes(tmp_path: Path) -> None:
    """Ten metres to the east in half a second; a lost fix is left out."""
    metre_deg = 1.0 / (
        6378137.0 * np.cos(np.radians(49.0)) / np.sqrt(1.0 - 6.69437999014e-3 * np.sin(np.radians(49.0)) ** 2)
    )
    fixes = [
        ("/gnss", FIRST_NS + i, ros.fix(FIRST_NS + i * PERIOD_NS // 2, 49.0, 8.4 + np.degrees(metre_deg) * i))
        for i in range(11)
    ]
    lost = ("/gnss", FIRST_NS + 20, ros.fix(FIRST_NS + 10_000_000, 0.0, 0.0, status=-1))
    recording = open_recording(bag(tmp_path / "drive", *fixes, lost), topics=BagTopics(truth="/gnss"))
    rows = truth_of(recording)
    ground = recording.camera.ground.R_ego_cam
    ahead = rows[:, :, 3] @ ground.T
    assert np.abs(ahead[:, 0] - 2.0 * np.arange(6)).max() < 1e-3
    assert np.abs(ahead[:, 1:]).max() < 1e-3


def test_east_north_up_agrees_with_the_arc() -> None:
    up = east_north_up([(50.0, 8.0, 100.0), (50.0001, 8.0, 100.0), (50.0, 8.0001, 130.0)])
    assert up[0].tolist() == [0.0, 0.0, 0.0]
    assert up[1] == pytest.approx([0.0, 11.1229, 0.0], abs=2e-3)  # a degree of the meridian at 50 N: 111 229 m
    assert up[2] == pytest.approx([7.1697, 0.0, 30.0], abs=2e-3)  # of the parallel: 71 697 m


@pytest.mark.parametrize("storage", ["sqlite3", "mcap", "ros1"])
@pytest.mark.parametrize("kept", [0.0, 0.3, 0.9])
def test_a_bag_cut_off_anywhere_is_named_or_ends_with_an_unreadable_frame(
    tmp_path: Path, storage: str, kept: float
) -> None:
    uri = bag(tmp_path / ("drive.bag" if storage == "ros1" else "drive"), storage=storage)
    path = Path(uri.removeprefix("rosbag:"))
    file = path if storage == "ros1" else next(path.glob("*.[dm]*[3p]"))
    file.write_bytes(file.read_bytes()[: int(kept * file.stat().st_size)])
    said = ""
    try:
        frames = list(open_recording(uri).frames())
        said = str(frames[-1].error)
        assert frames[-1].image is None
    except DatasetError as error:
        said = str(error)
    assert str(path) in said


def test_non_bag_is_named(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match="nowhere: no such file or directory"):
        open_recording(f"rosbag:{tmp_path / 'nowhere'}")
    (tmp_path / "drive.mcap").write_bytes(b"\x89MCAP0\r\n nothing")
    with pytest.raises(DatasetError, match=r"drive\.mcap: is not a readable ROS bag"):
        open_recording(f"rosbag:{tmp_path / 'drive.mcap'}")
    with pytest.raises(DatasetError, match="is not a readable ROS bag"):
        open_recording(f"rosbag:{tmp_path}")
    with pytest.raises(DatasetError, match="topics need a ROS bag"):
        open_recording(f"kitti:{tmp_path}", topics=BagTopics(image="/a"))


def test_without_the_library_the_extra_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "rosbags.highlevel", None)
    with pytest.raises(DatasetError, match=r"pip install 'birdslam\[ros\]'"):
        open_recording(f"rosbag:{tmp_path}")


def test_a_run_opens_it_with_its_topics(tmp_path: Path) -> None:
    speeds = [("/speed", FIRST_NS + i, ros.twist(FIRST_NS + i * PERIOD_NS, 3.0, 0.1)) for i in range(6)]
    uri = bag(tmp_path / "drive", *speeds)
    source = open_source(load(None, {"source.uri": uri, "source.topics.speed": "/speed"}))
    assert not source.live
    first = next(source.frames())
    assert (first.speeds[0].speed_mps, first.speeds[0].yaw_rate_radps) == (3.0, 0.1)
    config = tmp_path / "run.toml"
    config.write_text('[source]\nuri = "rosbag:drive"\n[source.topics]\nimage = "/car/front/image_raw"\n')
    assert open_source(load(config)).name == "drive"


@given(
    st.lists(st.integers(20_000_000, 200_000_000), min_size=2, max_size=30),
    st.dictionaries(st.integers(1, 29), st.integers(-(10**18), 10**18), max_size=4),
)
def test_clock_steps_do_not_stop_the_images(periods_ns: list[int], steps_ns: dict[int, int]) -> None:
    """Whatever the clock of the stamps does, the images keep their periods; small errors of both clocks stay."""
    clock, stamp_ns, recorded_ns, times = ImageClock(), 0, 10**18, []
    for k, period_ns in enumerate(periods_ns):
        step_ns = steps_ns.get(k, 0)
        stamp_ns += period_ns + (step_ns if abs(step_ns) > 2 * MAX_CLOCK_ERROR_NS else 0)
        recorded_ns += period_ns
        times.append(clock.time_ns(stamp_ns, recorded_ns))
    assert np.diff(times).tolist() == periods_ns[1:]


def test_pause_of_a_bag_is_kept() -> None:
    clock = ImageClock()
    assert [clock.time_ns(t, t + 7) for t in (0, 10**8, 300 * 10**9, 300 * 10**9 + 10**8)][2] == 300 * 10**9
