"""The contract of `Recording`, for each kind of source: order, time, size, restart, stride and missing frames."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from birdslam.geometry.camera import Camera
from birdslam.runtime.configuration import RecordingConfig
from birdslam.runtime.nodes.sources import open_recorded
from birdslam.runtime.recording.scene import from_image
from birdslam.runtime.schemes import recorded_schemes
from birdslam.sources.recording import RecordedFrame, Recording
from birdslam.types import NS_PER_S, Status
from tests.ros_bags import camera_info, image, write_bag
from tests.taped_drive import Tape, measured
from tests.test_datasets import P2, write_images
from tests.test_films import film

WIDTH, HEIGHT = 60, 30  # as write_images
PAUSE_S = 300  # in the middle of recordings with their own times
TIMES_MS = [*range(0, 800, 100), *range(1000 * PAUSE_S, 1000 * PAUSE_S + 800, 100)]


def _film(folder: Path) -> tuple[str, Camera | None]:
    path = film(folder / "drive.mkv", TIMES_MS, size=(WIDTH, HEIGHT))
    return f"video:{path}", Camera(WIDTH, HEIGHT, 50.0, 50.0, 30.0, 15.0, height_m=1.4)


def _films(folder: Path) -> tuple[str, Camera | None]:
    for name in ("20240131_120000.mp4", "20240131_120500.mp4"):  # five minutes apart
        film(folder / name, range(0, 800, 100), size=(WIDTH, HEIGHT))
    return f"video:{folder}", Camera(WIDTH, HEIGHT, 50.0, 50.0, 30.0, 15.0, height_m=1.4)


def _bag(folder: Path, storage: str) -> tuple[str, Camera | None]:
    rng, messages = np.random.default_rng(3), []
    for number, t_ms in enumerate(TIMES_MS):
        clock_ms = t_ms if number < 12 else t_ms - 86_400_000  # the clock steps back by a day
        t_ns = (1_700_000_000_000 + clock_ms) * 1_000_000
        pixels = rng.integers(0, 256, (HEIGHT, WIDTH), dtype=np.uint8)
        log_ns = (1_700_000_000_000 + t_ms) * 1_000_000
        messages.append(("/camera/camera_info", log_ns, camera_info(WIDTH, HEIGHT, 50, 50, 30, 15, t_ns=t_ns)))
        messages.append(("/camera/image", log_ns, image(pixels, t_ns)))
    name = "drive.bag" if storage == "ros1" else "drive"
    return f"rosbag:{write_bag(folder / name, messages, storage)}", Camera(
        WIDTH, HEIGHT, 50.0, 50.0, 30.0, 15.0, height_m=1.4
    )


def _kitti(folder: Path) -> tuple[str, Camera | None]:
    write_images(folder / "image_2", range(len(TIMES_MS)), channels=3)
    (folder / "calib.txt").write_text(f"P2: {P2}\n")
    (folder / "times.txt").write_text("".join(f"{1e-3 * t_ms:e}\n" for t_ms in TIMES_MS))
    torn = folder / "image_2" / "000003.png"
    torn.write_bytes(torn.read_bytes()[:60])
    return f"kitti:{folder}", None


def _recorded(folder: Path) -> tuple[str, Camera | None]:
    """A drive recorded with its images, but for one frame."""
    tape = Tape(folder, recording=RecordingConfig(file="drive.mcap", images=True))
    for number, measurements in enumerate(measured(20)):
        ref = tape.frame(measurements)
        if number != 7:
            grey = np.full((192, 640), 10 * number, dtype=np.uint8)
            tape.writer.draw(*from_image(grey, 90, ref.t_utc_ns), number)
    tape.close()
    return f"mcap:{tape.path}", None


MAKERS: dict[str, Callable[[Path], tuple[str, Camera | None]]] = {
    "video": _film,
    "video, files": _films,
    "rosbag": lambda folder: _bag(folder, "mcap"),
    "rosbag, ROS 1": lambda folder: _bag(folder, "ros1"),
    "kitti": _kitti,
    "demo": lambda folder: ("demo", None),
    "mcap": _recorded,
}
MAX_FRAMES = 40  # of the shipped drive


@pytest.fixture(scope="module", params=sorted(MAKERS))
def opened(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Callable[[int], Recording]:
    """Opens the same recording with a stride."""
    uri, camera = MAKERS[request.param](tmp_path_factory.mktemp("source"))
    return lambda stride: open_recorded(uri, camera, stride)


def _frames(recording: Recording, start: int = 0) -> list[RecordedFrame]:
    return [frame for frame, _ in zip(recording.frames(start), range(MAX_FRAMES), strict=False)]


def _same(one: RecordedFrame, other: RecordedFrame) -> bool:
    if (one.index, one.t_source_ns, one.error) != (other.index, other.t_source_ns, other.error):
        return False
    return one.image is other.image is None or np.array_equal(one.image, other.image)


def test_every_kind_of_recording_is_here() -> None:
    assert {name.split(",")[0] for name in MAKERS} == {scheme.name for scheme in recorded_schemes()}


def test_frames_are_numbered_in_order_of_increasing_time(opened: Callable[[int], Recording]) -> None:
    recording = opened(1)
    frames = _frames(recording)
    assert [frame.index for frame in frames] == list(range(len(frames)))
    assert len(frames) > 10
    assert len(recording) >= sum(frame.image is not None for frame in frames)
    times_ns = [frame.t_source_ns for frame in frames]
    assert all(later > earlier for earlier, later in pairwise(times_ns))
    assert times_ns[-1] - times_ns[0] < 2 * PAUSE_S * NS_PER_S  # one clock, whatever steps


@pytest.mark.parametrize("storage", ["mcap", "ros1"])
def test_a_clock_that_was_set_is_reported(storage: str, tmp_path: Path) -> None:
    uri, camera = _bag(tmp_path, storage)
    notes = {frame.index: frame.note for frame in open_recorded(uri, camera).frames() if frame.note}
    assert list(notes) == [12]
    assert "was set by -86400.000 s" in notes[12]


def test_images_have_the_size_of_the_camera_or_a_reason(opened: Callable[[int], Recording]) -> None:
    recording = opened(1)
    camera = recording.camera
    assert camera.fx_px == pytest.approx(camera.fy_px)  # square pixels
    readable = 0
    for frame in _frames(recording):
        if frame.image is None:
            assert frame.error
        else:
            readable += 1
            assert frame.image.shape[:2] == (camera.height_px, camera.width_px)
            assert frame.image.dtype == np.uint8
    assert readable > 10


@pytest.mark.parametrize("start", [1, 5, 9])
def test_a_restart_yields_the_same_frames(opened: Callable[[int], Recording], start: int) -> None:
    whole = _frames(opened(1))
    later = _frames(opened(1), start)
    assert all(_same(one, other) for one, other in zip(whole[start:], later, strict=False))
    assert later[0].index == start


@pytest.mark.parametrize("stride", [2, 3])
def test_a_stride_leaves_out_frames_and_keeps_their_times(opened: Callable[[int], Recording], stride: int) -> None:
    whole, thinned = opened(1), opened(stride)
    assert thinned.rate_hz == pytest.approx(whole.rate_hz / stride, rel=0.02)
    times_ns = {frame.t_source_ns for frame in _frames(whole)}
    frames = _frames(thinned)[: MAX_FRAMES // stride]
    assert [frame.index for frame in frames] == list(range(len(frames)))
    assert {frame.t_source_ns for frame in frames if frame.image is not None} <= times_ns


def test_a_frame_without_an_image_has_a_status(opened: Callable[[int], Recording]) -> None:
    for frame, recorded in zip(opened(1).undistorted_frames(), _frames(opened(1)), strict=False):
        assert (frame.image is None) == (recorded.image is None) == (Status.FRAME_UNREADABLE in frame.status)
