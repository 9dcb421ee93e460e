"""The shipped drive: it is complete, its truth matches its images, and it is read without numba."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from birdslam.geometry import bev
from birdslam.geometry.camera import GroundPlane
from birdslam.sources.opening import open_recording
from birdslam.sources.recording import DatasetError
from birdslam.sources.shipped_drive import COLUMNS, DIRECTORY, DemoRecording, write_drive


@pytest.fixture(scope="module")
def demo() -> DemoRecording:
    recording = open_recording("demo")
    assert isinstance(recording, DemoRecording)
    return recording


def test_drive_is_half_a_minute_at_33_hz_below_12_mb(demo: DemoRecording) -> None:
    assert len(demo) == 1000
    assert demo.rate_hz == pytest.approx(33.0)
    assert sum(path.stat().st_size for path in DIRECTORY.iterdir()) < 12_000_000


def test_its_frames_are_deterministic_and_fit_its_camera(demo: DemoRecording) -> None:
    frame = next(demo.frames(500))
    assert frame.index == 500
    assert frame.t_source_ns == round(500 / 33.0 * 1e9)
    assert frame.image.shape == (demo.camera.height_px, demo.camera.width_px, 3)
    again = next(open_recording("demo:").frames(500))
    assert frame.image.tobytes() == again.image.tobytes()
    assert float(frame.image.std()) > 20.0


def test_a_stride_keeps_times_and_truth_together() -> None:
    third = open_recording("demo", stride=3)
    assert len(third) == 334
    assert third.rate_hz == pytest.approx(11.0)
    assert next(third.frames(10)).t_source_ns == round(30 / 33.0 * 1e9)
    every = open_recording("demo").truth_poses()
    poses = third.truth_poses()
    assert poses is not None
    np.testing.assert_array_equal(poses, every[::3])


def test_bodies_project_into_their_boxes(demo: DemoRecording) -> None:
    """A footprint on the road projects into the lower part of its box; hidden bodies are included."""
    checked, hidden = 0, 0
    for index in range(0, 1000, 50):
        plane = demo.truth_ground(index)
        ground = GroundPlane(plane.height_m, plane.pitch_rad, plane.roll_rad)
        for body in demo.truth_bodies(index):
            hidden += body.visible == 0.0
            if 8.0 < body.T_ego_body.x_m < 20.0 and body.truncated == 0.0:
                u, v = bev.ego_to_pixel(demo.camera, ground, np.array([[body.T_ego_body.x_m, body.T_ego_body.y_m]]))[0]
                x1, y1, x2, y2 = body.box_px
                assert x1 - 3.0 <= u <= x2 + 3.0
                assert y1 <= v <= y2 + 0.35 * (y2 - y1) + 3.0
                checked += 1
    assert checked > 10
    assert hidden > 0


@pytest.mark.processes
def test_drive_is_read_without_renderer() -> None:
    code = (
        "import sys; sys.modules['numba'] = sys.modules['torch'] = None\n"
        "from birdslam.sources.opening import open_recording\n"
        "assert next(open_recording('demo').frames()).image is not None"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=600)


def test_a_drive_written_is_the_drive_read(tmp_path: Path, demo: DemoRecording) -> None:
    image = next(demo.frames()).image
    assert image is not None
    camera = (DIRECTORY / "camera.toml").read_text()
    (tmp_path / "camera.toml").write_text(camera)
    data = cv2.imencode(".jpg", image)[1]
    poses = np.tile(np.eye(4)[:3], (2, 1, 1))
    row = [1, 7, 3, 12.0, -2.0, 0.1, 11.0, 2.5, 3.0, 5.0, 0.5, 0.25, 0.5, 1.0, 2.0, 30.0, 40.0]
    assert len(row) == len(COLUMNS)
    write_drive(tmp_path, [data.tobytes(), b"torn"], 20.0, poses, np.array([[1.5, 0.01, 0.0]] * 2), np.array([row]))
    drive = DemoRecording(directory=tmp_path)
    first, second = drive.frames()
    assert first.image.tobytes() == cv2.imdecode(data, cv2.IMREAD_COLOR).tobytes()
    assert second.image is None
    assert second.error is not None
    assert "image 1 can't be decoded" in second.error
    (body,) = drive.truth_bodies(1)
    assert (body.body, body.label, body.T_ego_body.x_m, body.visible) == (7, "bus", 12.0, 0.25)
    assert drive.truth_bodies(0) == ()
    assert drive.truth_ground(0).height_m == 1.5


@pytest.mark.parametrize("content", [b"", b"no zip at all", None])
def test_a_torn_drive_is_named(tmp_path: Path, content: bytes | None) -> None:
    if content is not None:
        (tmp_path / "drive.npz").write_bytes(content)
    with pytest.raises(DatasetError, match=r"drive\.npz"):
        DemoRecording(directory=tmp_path)
