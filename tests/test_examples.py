"""The examples with external detectors: the program on a film and a file of boxes, the notebook cell by cell."""

from __future__ import annotations

import json
import runpy
import sys
from itertools import islice
from pathlib import Path
from typing import Any

import cv2
import matplotlib as mpl
import numpy as np
import pytest

from birdslam import open_recording
from birdslam.perception import load_network
from birdslam.perception.manifest import SHIPPED_MULTITASK, SHIPPED_NETWORKS
from birdslam.perception.network import ModelSpec
from birdslam.sources.camera_file import camera_text

pytest.importorskip("supervision")
EXAMPLES = Path(__file__).resolve().parent.parent / "docs" / "examples"
FRAMES = 12


@pytest.mark.parametrize(("name", "most"), [("speeds.py", 25), ("stop_for_people.py", 20)])
def test_example_has_the_stated_length(name: str, most: int) -> None:
    assert sum(bool(line.strip()) for line in (EXAMPLES / name).read_text().splitlines()) <= most


def test_the_program_draws_metres_over_a_film(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    recording = open_recording("demo")
    network = load_network("multitask", ModelSpec(str(SHIPPED_NETWORKS / SHIPPED_MULTITASK)))
    size = (recording.camera.width_px, recording.camera.height_px)
    film = cv2.VideoWriter(str(tmp_path / "film.avi"), cv2.VideoWriter.fourcc(*"MJPG"), recording.rate_hz, size)
    boxes = []
    for frame in islice(recording.undistorted_frames(), FRAMES):
        image = frame.image if frame.image.ndim == 3 else cv2.cvtColor(frame.image, cv2.COLOR_GRAY2BGR)
        film.write(image)
        found = network.run(image)
        for (x0, y0, x1, y1), score in zip(found.detections.boxes_px, found.detections.scores, strict=True):
            boxes.append(f"{frame.frame_id + 1},-1,{x0:.1f},{y0:.1f},{x1 - x0:.1f},{y1 - y0:.1f},{score:.3f},3,1\n")
    film.release()
    (tmp_path / "boxes.txt").write_text("".join(boxes))
    (tmp_path / "camera.toml").write_text(camera_text(recording.camera, []))
    files = (str(tmp_path / name) for name in ("film.avi", "camera.toml", "boxes.txt", "out.mp4"))
    monkeypatch.setattr(sys, "argv", ["speeds.py", *files])
    runpy.run_path(str(EXAMPLES / "speeds.py"))
    drawn = cv2.VideoCapture(str(tmp_path / "out.mp4"))
    count = 0
    while drawn.grab():
        count += 1
    assert count == FRAMES


def test_the_notebook_runs_cell_by_cell() -> None:
    cells = json.loads((EXAMPLES / "speeds.ipynb").read_text())["cells"]
    assert all(not cell.get("outputs") for cell in cells)
    names: dict[str, Any] = {}
    with mpl.rc_context({"backend": "Agg"}):
        for cell in cells:
            if cell["cell_type"] == "code":
                exec(cell["source"].replace("FRAMES = 120", f"FRAMES = {2 * FRAMES}"), names)
    history = names["history"]
    assert len(history) > FRAMES
    known = [(m, sigma) for _, _, m, sigma in history if m is not None]
    assert known
    assert all(0.0 < sigma < m < 200.0 for m, sigma in known)
    assert names["shown"].shape == (names["recording"].camera.height_px, names["recording"].camera.width_px, 3)
    assert np.ptp(names["shown"]) > 0
