"""The public API: lazy names, and the example that turns a video into tracks and a picture."""

from __future__ import annotations

import ast
import importlib
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import cv2
import msgspec
import numpy as np
import pytest

import birdslam
from birdslam.runtime.configuration import Configuration, complete
from birdslam.runtime.nodes.inference import Inference
from birdslam.sources.opening import open_recording
from birdslam.sources.recording import RecordedFrame, Recording
from birdslam.sources.shipped_drive import DIRECTORY
from birdslam.types import Estimate, Frame, Measurements

ROOT = Path(__file__).resolve().parent.parent
EXAMPLES = ROOT / "docs" / "examples"
FRAMES = 12


@pytest.mark.processes
def test_import_is_lazy() -> None:
    code = (
        "import sys, birdslam; assert not {'numpy', 'cv2', 'onnxruntime', 'msgspec'} & set(sys.modules); "
        "from birdslam import BirdSLAM, Camera, SlamConfig, Estimate; assert 'numpy' in sys.modules; "
        "assert not {'zenoh', 'gtsam', 'torch', 'numba'} & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_every_public_name_has_a_docstring_and_is_known_to_editors() -> None:
    for name in birdslam.__all__:
        assert (getattr(birdslam, name).__doc__ or "").strip(), name
    assert set(birdslam.__all__) <= set(dir(birdslam))
    with pytest.raises(AttributeError, match="no attribute 'Bird'"):
        _ = birdslam.Bird
    source = ast.parse(Path(str(birdslam.__file__)).read_text())
    (typed,) = (node for node in source.body if isinstance(node, ast.If))
    told = {alias.name: line.module for line in typed.body if isinstance(line, ast.ImportFrom) for alias in line.names}
    assert set(told) == set(birdslam.__all__)
    for name, module in told.items():
        assert getattr(birdslam, name) is getattr(importlib.import_module(str(module)), name)


class Beginning(Recording):
    """The first frames of a recording."""

    def __init__(self, whole: Recording) -> None:
        self.name, self.camera, self.rate_hz, self._whole = whole.name, whole.camera, whole.rate_hz, whole

    def __len__(self) -> int:
        return FRAMES

    def frames(self, start: int = 0) -> Iterator[RecordedFrame]:
        for frame in self._whole.frames(start):
            if frame.index < FRAMES:
                yield frame
            else:
                return


def records(slam: birdslam.BirdSLAM, frames: Iterator[Frame]) -> list[tuple[Measurements, Estimate]]:
    return [slam.step(frame) for frame in frames]


def test_with_shipped_networks_equals_evaluate() -> None:
    recording = Beginning(open_recording("demo"))
    own = records(
        birdslam.BirdSLAM.with_shipped_networks(recording.camera, recording.rate_hz), recording.undistorted_frames()
    )
    configuration = msgspec.convert({"source": {"rate": "max"}}, Configuration)
    with Inference(complete(configuration, recording.camera, recording.rate_hz)) as inference:
        slam = birdslam.BirdSLAM(
            recording.camera, inference.networks, configuration.slam, lane_head=inference.lane_head
        )
        assert records(slam, recording.undistorted_frames()) == own
    assert any(estimate.vehicles for _, estimate in own) or any(measured.cc for measured, _ in own)


def test_unreadable_frame_has_a_status() -> None:
    class Torn(Beginning):
        def frames(self, start: int = 0) -> Iterator[RecordedFrame]:
            first, second, third = (frame for frame in super().frames(start) if frame.index < 3)
            yield first
            yield RecordedFrame(1, second.t_source_ns, None, "torn")
            yield RecordedFrame(2, third.t_source_ns, np.zeros((8, 8, 3), np.uint8))

    frames = list(Torn(open_recording("demo")).undistorted_frames())
    assert [frame.image is None for frame in frames] == [False, True, True]
    assert frames[1].status == frames[2].status == (birdslam.Status.FRAME_UNREADABLE,)
    assert [frame.frame_id for frame in frames] == [0, 1, 2]


@pytest.mark.processes
def test_the_offline_example(tmp_path: Path) -> None:
    recording = Beginning(open_recording("demo"))
    camera = recording.camera
    video = tmp_path / "drive.avi"
    writer = cv2.VideoWriter(
        str(video), cv2.VideoWriter.fourcc(*"MJPG"), recording.rate_hz, (camera.width_px, camera.height_px)
    )
    for frame in recording.frames():
        assert frame.image is not None
        writer.write(frame.image)
    writer.release()
    example = [sys.executable, str(EXAMPLES / "offline.py"), str(video), str(DIRECTORY / "camera.toml")]
    said = subprocess.run([*example, str(tmp_path / "out")], check=True, capture_output=True, text=True).stdout
    assert f"frame {FRAMES - 1}: at " in said
    out = tmp_path / "out"
    assert len((out / "ego.kitti.txt").read_text().splitlines()) == FRAMES
    assert (out / "bev.png").stat().st_size > 10_000
    assert len((EXAMPLES / "offline.py").read_text().splitlines()) <= 25


def test_the_python_of_the_readme(capsys: pytest.CaptureFixture[str]) -> None:
    """Runs it unchanged over the first 101 frames of the demo; it prints the readme's output."""
    readme = (ROOT / "README.md").read_text()
    frames = "recording.undistorted_frames()"
    code = next(block for block in re.findall(r"```python\n(.*?)```", readme, re.DOTALL) if frames in block)
    exec(f"from itertools import islice\n{code.replace(frames, f'islice({frames}, 101)')}", {})
    line = r"frame 100: \w+ \d+, \d+\.\d m ahead, \d+\.\d m/s"
    printed = capsys.readouterr().out.splitlines()
    assert printed
    assert all(re.fullmatch(line, text) for text in printed)
    assert re.search(line, readme)


def test_the_boxes_of_the_readme_get_metres(capsys: pytest.CaptureFixture[str]) -> None:
    """The block for supervision, over the first frames of the demo, with a box on the road for a detector."""
    supervision = pytest.importorskip("supervision")
    readme = (ROOT / "README.md").read_text()
    frames, detector = "recording.undistorted_frames()", "sv.Detections.from_ultralytics(model(frame.image)[0])"
    code = next(block for block in re.findall(r"```python\n(.*?)```", readme, re.DOTALL) if detector in block)

    def detect() -> object:
        box, one = np.array([[300.0, 90.0, 340.0, 120.0]]), np.array([0.9])
        return supervision.Detections(xyxy=box, confidence=one, data={"class_name": np.array(["car"])})

    recording = open_recording("demo")
    names = {
        "recording": recording,
        "slam": birdslam.BirdSLAM.with_shipped_networks(recording.camera, recording.rate_hz),
        "detect": detect,
    }
    code = code.replace(frames, f"islice({frames}, 12)").replace(detector, "detect()")
    exec(f"from itertools import islice\n{code}", names)
    distances = [float(line.split("]")[0].strip("[ ")) for line in capsys.readouterr().out.splitlines()]
    assert len(distances) == 12
    assert all(5.0 < distance < 60.0 for distance in distances[3:])
