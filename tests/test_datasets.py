"""KITTI layouts built small: torn, missing or wrong files are named; real recordings are read."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from birdslam.geometry.camera import Camera
from birdslam.sources.camera_file import load_camera
from birdslam.sources.kitti import KittiRecording
from birdslam.sources.opening import open_recording
from birdslam.sources.recording import DatasetError, RecordedFrame, Recording
from birdslam.trajectory import kitti_row

WIDTH, HEIGHT = 64, 32
P0 = "50 0 30 0 0 50 15 0 0 0 1 0"
P2 = "60 0 31 30 0 60 16 6 0 0 1 0.01"
CAMERA_TOML = "width_px = 64\nheight_px = 32\nfx_px = 50\nfy_px = 50.0\ncx_px = 32.0\ncy_px = 16.0\nheight_m = 1.5\n"
CAMERA = Camera(WIDTH, HEIGHT, 50.0, 50.0, 32.0, 16.0, 1.5)


def write_images(folder: Path, numbers: range, channels: int = 1, digits: int = 6, suffix: str = ".png") -> None:
    folder.mkdir(parents=True)
    rng = np.random.default_rng(7)
    shape = (HEIGHT, WIDTH) if channels == 1 else (HEIGHT, WIDTH, channels)
    for number in numbers:
        image = rng.integers(0, 256, shape, dtype=np.uint8)
        image.flat[0] = number
        assert cv2.imwrite(str(folder / f"{number:0{digits}d}{suffix}"), image)


def write_poses(path: Path, count: int) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, 2, 3] = np.arange(count)
    path.write_text("".join(kitti_row(T) + "\n" for T in poses))


@pytest.fixture
def odometry(tmp_path: Path) -> Path:
    sequence = tmp_path / "sequences" / "04"
    write_images(sequence / "image_0", range(6))
    (sequence / "calib.txt").write_text(f"P0: {P0}\nP1: {P0}\nP2: {P2}\nTr: 1 2 3\n")
    (sequence / "times.txt").write_text("".join(f"{0.2 * i:e}\n" for i in range(6)))
    write_poses(tmp_path / "poses" / "04.txt", 6)
    return sequence


def read(uri: Path, **options: int) -> tuple[Recording, list[RecordedFrame]]:
    recording = open_recording(f"kitti:{uri}", **options)
    return recording, list(recording.frames())


def test_odometry(odometry: Path) -> None:
    recording, frames = read(odometry)
    assert (recording.name, len(recording), recording.rate_hz) == ("04", 6, pytest.approx(5.0))
    assert recording.camera == Camera(WIDTH, HEIGHT, 50.0, 50.0, 30.0, 15.0, height_m=1.65)
    assert [frame.index for frame in frames] == list(range(6))
    assert [frame.t_source_ns for frame in frames] == [200_000_000 * i for i in range(6)]
    for number, frame in enumerate(frames):
        assert frame.image.shape == (HEIGHT, WIDTH)
        assert frame.image[0, 0] == number
    truth = recording.truth_poses()
    assert truth[:, 2, 3].tolist() == list(range(6))
    assert np.array_equal(recording.T_cam0_cam(), np.eye(4))


def test_odometry_takes_grey_before_colour_and_the_matrix_of_the_camera(odometry: Path) -> None:
    write_images(odometry / "image_2", range(6), channels=3)
    assert open_recording(f"kitti:{odometry}").camera.fx_px == 50.0
    (odometry / "image_0").rename(odometry / "image_9")
    recording, frames = read(odometry)
    assert (recording.camera.fx_px, recording.camera.cx_px) == (60.0, 31.0)
    assert frames[0].image.shape == (HEIGHT, WIDTH, 3)
    # P = K [I | t]: t = ((30 - 31 * 0.01) / 60, (6 - 16 * 0.01) / 60, 0.01), and the camera is at -t
    assert recording.T_cam0_cam()[:3, 3] == pytest.approx([-29.69 / 60.0, -5.84 / 60.0, -0.01])


def test_stride_keeps_images_times_and_truth_together(odometry: Path) -> None:
    recording, frames = read(odometry, stride=2)
    assert (len(recording), recording.rate_hz) == (3, pytest.approx(2.5))
    assert [(frame.index, frame.t_source_ns) for frame in frames] == [(0, 0), (1, 400_000_000), (2, 800_000_000)]
    assert [frame.image[0, 0] for frame in frames if frame.image is not None] == [0, 2, 4]
    truth = recording.truth_poses()
    assert truth[:, 2, 3].tolist() == [0.0, 2.0, 4.0]
    with pytest.raises(DatasetError, match="stride"):
        open_recording(f"kitti:{odometry}", stride=0)


def test_without_times_a_drive_is_at_10_hz_and_without_poses_it_has_no_truth(odometry: Path) -> None:
    (odometry / "times.txt").unlink()
    (odometry.parent.parent / "poses" / "04.txt").unlink()
    recording, frames = read(odometry)
    assert recording.rate_hz == 10.0
    assert [frame.t_source_ns for frame in frames[:3]] == [0, 100_000_000, 200_000_000]
    assert recording.truth_poses() is None


def test_tracking(tmp_path: Path) -> None:
    root = tmp_path / "training"
    write_images(root / "image_02" / "0003", range(4), channels=3)
    (root / "calib").mkdir()
    (root / "calib" / "0003.txt").write_text(f"P0: {P0}\nP2: {P2}\nR_rect 1 0 0\n")
    write_poses(root / "pose_cam0" / "0003.txt", 4)
    recording, frames = read(root / "image_02" / "0003")
    assert (recording.name, len(frames), recording.camera.fx_px, recording.rate_hz) == ("0003", 4, 60.0, 10.0)
    truth = recording.truth_poses()
    assert truth.shape == (4, 3, 4)
    with pytest.raises(DatasetError, match=r"contains the sequences 0003; name one, as in kitti:.*image_02/0003"):
        open_recording(f"kitti:{root}")


def test_raw_drive(tmp_path: Path) -> None:
    drive = tmp_path / "2011_09_26" / "2011_09_26_drive_0001_sync"
    write_images(drive / "image_02" / "data", range(3), channels=3, digits=10)
    (drive / "image_02" / "timestamps.txt").write_text(
        "2011-09-26 13:02:25.964389445\n2011-09-26 13:02:26.064389446\n2011-09-26 13:02:26.164389447\n"
    )
    (drive.parent / "calib_cam_to_cam.txt").write_text(
        f"calib_time: 09-Jan-2012 13:57:47\nP_rect_00: {P0}\nP_rect_02: {P2}\n"
    )
    recording, frames = read(drive)
    assert (recording.name, recording.camera.fx_px) == (drive.name, 60.0)
    assert frames[1].t_source_ns - frames[0].t_source_ns == 100_000_001
    assert frames[0].t_source_ns % 1_000_000_000 == 964_389_445
    assert recording.truth_poses() is None


def test_clip(tmp_path: Path) -> None:
    write_images(tmp_path / "image_02", range(3), channels=3, suffix=".jpg")
    (tmp_path / "calib.txt").write_text(f"P2: {P2}\n")
    write_poses(tmp_path / "pose_cam0.txt", 3)
    recording, frames = read(tmp_path)
    assert (len(recording), recording.camera.fx_px) == (3, 60.0)
    assert all(frame.image is not None for frame in frames)
    assert isinstance(recording, KittiRecording)
    assert recording.directory.name == "image_02"


def test_unreadable_image_costs_only_its_frame(odometry: Path) -> None:
    images = odometry / "image_0"
    torn = images / "000002.png"
    torn.write_bytes(torn.read_bytes()[:-40])
    (images / "000003.png").unlink()
    cv2.imwrite(str(images / "000004.png"), np.zeros((20, 20), np.uint8))
    recording, frames = read(odometry)
    assert len(recording) == len(frames) == 6
    assert [frame.image is None for frame in frames] == [False, False, True, True, True, False]
    assert "000002.png: damaged" in str(frames[2].error)
    assert "number 3 is missing" in str(frames[3].error)
    assert "20x20, not 64x32" in str(frames[4].error)
    assert frames[5].image[0, 0] == 5  # no shift
    assert frames[5].t_source_ns == 1_000_000_000


def test_truncated_jpeg_is_unreadable(tmp_path: Path) -> None:
    write_images(tmp_path / "image_02", range(3), suffix=".jpg")
    (tmp_path / "calib.txt").write_text(f"P2: {P2}\n")
    torn = tmp_path / "image_02" / "000001.jpg"
    torn.write_bytes(torn.read_bytes()[:-200])
    _, frames = read(tmp_path)
    assert [frame.image is None for frame in frames] == [False, True, False]


def test_sequence_may_start_at_any_number_and_with_a_torn_image(odometry: Path) -> None:
    (odometry / "image_0" / "000000.png").unlink()
    (odometry / "image_0" / "000001.png").write_bytes(b"no image")
    recording, frames = read(odometry)
    assert len(recording) == 5
    assert frames[0].image is None
    assert frames[0].t_source_ns == 200_000_000
    truth = recording.truth_poses()
    assert truth[0, 2, 3] == 1.0


def test_missing_directories_are_named(tmp_path: Path) -> None:
    for uri, what in (
        (f"kitti:{tmp_path / 'none'}", "no such directory"),
        (f"kitti:{tmp_path}", "not a KITTI recording"),
        ("kitti:", "expected kitti:DIR"),
        ("gopher:x", "unknown source 'gopher:'; choose from .*kitti:DIR"),
        ("nothing", "nothing: there is no such file.*kitti:DIR"),
    ):
        with pytest.raises(DatasetError, match=what):
            open_recording(uri)
    (tmp_path / "file").write_text("")
    with pytest.raises(DatasetError, match="not a directory"):
        open_recording(f"kitti:{tmp_path / 'file'}")


def test_folders_without_usable_images_are_named(odometry: Path) -> None:
    images = odometry / "image_0"
    (images / "000001.jpg").write_bytes(b"")
    with pytest.raises(DatasetError, match=r"two images with number 1"):
        open_recording(f"kitti:{odometry}")
    (images / "000001.jpg").rename(images / "900000000.jpg")
    with pytest.raises(DatasetError, match="only 7 images for the numbers 0 to 900000000"):
        open_recording(f"kitti:{odometry}")
    for path in images.iterdir():
        path.write_bytes(b"torn")
    (images / "900000000.jpg").unlink()
    with pytest.raises(DatasetError, match=r"no readable image \(000000.png: damaged"):
        open_recording(f"kitti:{odometry}")
    for path in images.iterdir():
        path.unlink()
    with pytest.raises(DatasetError, match=r"image_0: no images in it"):
        open_recording(f"kitti:{odometry}")


@pytest.mark.parametrize(
    ("calibration", "what"),
    [
        (None, "can't be read"),
        (f"P2: {P2}\n", "has no P0"),
        ("P0: 1 2 3\n", "P0 has 3 numbers, not 12"),
        ("P0: " + P0.replace("30", "nan") + "\n", "not finite"),
        ("P0: " + P0.replace("30", "x") + "\n", "not a number"),
        ("P0: 0 0 30 0 0 50 15 0 0 0 1 0\n", "focal lengths 0, 50"),
        ("P0: 50 0 30 0 0 50 15 0 0 0 2 0\n", "not the projection matrix"),
        ("P0: 50 0 900 0 0 50 15 0 0 0 1 0\n", "principal point"),
    ],
)
def test_a_wrong_calibration_is_named(odometry: Path, calibration: str | None, what: str) -> None:
    path = odometry / "calib.txt"
    if calibration is None:
        path.unlink()
    else:
        path.write_text(calibration)
    with pytest.raises(DatasetError, match=what) as caught:
        open_recording(f"kitti:{odometry}")
    assert str(path) in str(caught.value)
    recording = open_recording(f"kitti:{odometry}", camera=CAMERA)  # a camera given goes before it
    assert recording.camera is CAMERA


def test_camera_of_another_size_is_refused(odometry: Path) -> None:
    with pytest.raises(DatasetError, match="is 64x32, but the given camera is 640x480"):
        open_recording(f"kitti:{odometry}", camera=Camera(640, 480, 500.0, 500.0, 320.0, 240.0, 1.5))


@pytest.mark.parametrize(
    ("times", "what"),
    [
        ("0\n0.1\n", "2 times, but the images .* end at number 5"),
        ("0\n0.1\n0.1\n0.3\n0.4\n0.5\n", "line 3 is not later"),
        ("0\n0.1\nnan\n0.3\n0.4\n0.5\n", "line 3 is not a time"),
        ("0\n0.1\ntea\n0.3\n0.4\n0.5\n", "line 3 is not a time"),
    ],
)
def test_wrong_times_are_named(odometry: Path, times: str, what: str) -> None:
    (odometry / "times.txt").write_text(times)
    with pytest.raises(DatasetError, match=what):
        open_recording(f"kitti:{odometry}")


def test_a_short_or_torn_truth_is_named(odometry: Path) -> None:
    path = odometry.parent.parent / "poses" / "04.txt"
    write_poses(path, 4)
    with pytest.raises(DatasetError, match=r"04\.txt: 4 poses, but the images end at number 5"):
        open_recording(f"kitti:{odometry}").truth_poses()
    path.write_text("1 2 3\n")
    with pytest.raises(DatasetError, match=r"04\.txt: line 1"):
        open_recording(f"kitti:{odometry}").truth_poses()


@pytest.fixture
def video(tmp_path: Path) -> Path:
    path = tmp_path / "drive.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 25.0, (WIDTH, HEIGHT))
    assert writer.isOpened()
    for level in range(20):
        writer.write(np.full((HEIGHT, WIDTH, 3), 10 * level, np.uint8))
    writer.release()
    return path


def test_a_video_without_camera_or_of_another_size_is_refused(video: Path) -> None:
    with pytest.raises(DatasetError, match="give a camera file"):
        open_recording(f"video:{video}")
    with pytest.raises(DatasetError, match="is 64x32, but the given camera is 640x480"):
        open_recording(f"video:{video}", camera=Camera(640, 480, 500.0, 500.0, 320.0, 240.0, 1.5))


def test_truncated_video_ends_with_its_reason(video: Path) -> None:
    data = video.read_bytes()
    assert [f.t_source_ns for f in open_recording(f"video:{video}", camera=CAMERA).frames()] == [
        40_000_000 * i for i in range(20)
    ]
    video.write_bytes(data[: len(data) * 6 // 10])
    frames = list(open_recording(f"video:{video}", camera=CAMERA).frames())
    assert frames[-1].image is None
    assert "of 20 frames: cut off" in str(frames[-1].error)


def test_camera_file(tmp_path: Path) -> None:
    path = tmp_path / "camera.toml"
    path.write_text(CAMERA_TOML + "distortion = [0.1, 0.0, 0.0, 0.0]\npitch_rad = 0.02\n")
    camera = load_camera(path)
    assert (camera.fx_px, camera.pitch_rad, camera.distortion) == (50.0, 0.02, (0.1, 0.0, 0.0, 0.0))


@pytest.mark.parametrize(
    ("text", "what"),
    [
        (CAMERA_TOML.replace("fx_px = 50\n", ""), "fx_px"),
        (CAMERA_TOML.replace("fx_px", "focal"), "focal"),
        (CAMERA_TOML.replace("height_m = 1.5", 'height_m = "high"'), "height_m"),
        (CAMERA_TOML.replace("height_m = 1.5", "height_m = nan"), "height_m|finite"),
        (CAMERA_TOML.replace("height_m = 1.5", "height_m = 15"), "height_m = 15"),
        (CAMERA_TOML.replace("cx_px = 32.0", "cx_px = 99.0"), "principal point"),
        ("width_px = = 3", "line 1"),
    ],
)
def test_a_wrong_camera_file_names_file_and_key(tmp_path: Path, text: str, what: str) -> None:
    path = tmp_path / "camera.toml"
    path.write_text(text)
    with pytest.raises(DatasetError, match=what) as caught:
        load_camera(path)
    assert str(path) in str(caught.value)


def test_a_missing_or_binary_camera_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match=r"none\.toml: can't be read"):
        load_camera(tmp_path / "none.toml")
    (tmp_path / "b.toml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(DatasetError, match=r"b\.toml"):
        load_camera(tmp_path / "b.toml")


@pytest.mark.parametrize(
    ("uri", "name", "frames", "size", "fx_px", "path_m"),
    [
        ("kitti_odometry/sequences/00", "00", 120, (1241, 376), 718.856, 92.0),
        ("kitti_odometry/sequences/06", "06", 51, (1226, 370), 707.0912, 60.0),
        ("kitti_raw_clip", "kitti_raw_clip", 78, (1242, 375), 721.5377, 7.9),
    ],
)
def test_real_recordings(
    data_dir: Path, uri: str, name: str, frames: int, size: tuple[int, int], fx_px: float, path_m: float
) -> None:
    recording = open_recording(f"kitti:{data_dir / uri}")
    assert (recording.name, len(recording)) == (name, frames)
    camera = recording.camera
    assert (camera.width_px, camera.height_px, camera.fx_px, camera.height_m) == (*size, fx_px, 1.65)
    first = next(recording.frames())
    assert first.image.shape[:2] == size[::-1]
    truth = recording.truth_poses()
    assert np.linalg.norm(np.diff(truth[:, :, 3], axis=0), axis=1).sum() == pytest.approx(path_m, rel=0.05)
