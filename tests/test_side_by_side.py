"""Parallel drives over recordings, beside each other and beside a live car, as real processes."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from birdslam.geometry.camera import Camera
from birdslam.runtime.transport.presence import VehicleLock, own_runtime_dir, runtime_dir_of
from birdslam.sources.camera_file import camera_text

FRAMES = 12
CAMERA = Camera(160, 96, 130.0, 130.0, 80.0, 48.0, 1.4, scale_sigma_rel=0.11)
LIMIT_S = 120.0


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A film, its camera file, and a runtime directory of this test's own."""
    run = tmp_path.parent / "r"  # short: a socket's path has 107 characters
    run.mkdir(mode=0o700, exist_ok=True)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(run))
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "data"))
    writer = cv2.VideoWriter(str(tmp_path / "film.avi"), cv2.VideoWriter.fourcc(*"MJPG"), 25.0, (160, 96))
    noise = np.random.default_rng(1).integers(0, 255, (96, 400, 3), np.uint8)
    for number in range(FRAMES):
        writer.write(np.ascontiguousarray(noise[:, 5 * number : 5 * number + 160]))
    writer.release()
    (tmp_path / "camera.toml").write_text(camera_text(CAMERA, ("of a test",)))
    return tmp_path


def begin(place: Path, name: str) -> subprocess.Popen[str]:
    arguments = ["run", "--source", f"video:{place / 'film.avi'}", "--camera", str(place / "camera.toml")]
    arguments += ["--model", "none", "--rate", "max", "--output", str(place / name)]
    return subprocess.Popen(
        [sys.executable, "-m", "birdslam.runtime.cli.main", *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


@pytest.mark.processes
@pytest.mark.parametrize("films", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_films_run_in_parallel_with_a_live_car(place: Path, films: int) -> None:
    with VehicleLock("car"):  # the live one, whom planners find by this name
        runs = {name: begin(place, name) for name in ("a", "b")[:films]}
        told = {name: run.communicate(timeout=LIMIT_S) for name, run in runs.items()}
        for name, (out, err) in told.items():
            assert (runs[name].returncode, err) == (0, "")
            summary = json.loads((place / name / "summary.json").read_text())
            assert summary["frames_processed"] == FRAMES
            assert summary["statuses"]["scale_estimated"] == FRAMES
            assert summary["camera_sigma_rel"] == CAMERA.scale_sigma_rel
            for sentence in summary["verdict"]:  # on the terminal, in summary.json and in the text beside the results
                assert sentence in out
                assert sentence in (place / name / "README.txt").read_text()
            assert "of its budget" not in out  # its frames were not awaited
        lengths = [line for line in summary["verdict"] if line.startswith("Next: measure the height")]
        assert len(lengths) == 1
    left = [path.name for path in Path(os.environ["XDG_RUNTIME_DIR"], "birdslam").iterdir()]
    assert left == ["car"]


def test_leftovers_of_a_killed_drive_are_removed_by_the_next(place: Path) -> None:
    with own_runtime_dir("car") as directory:
        dead = directory.with_name("own-999999999")  # no such process
        (dead / "car").mkdir(parents=True, mode=0o700)
        (dead / "car" / "lock").touch(mode=0o600)
        mine = runtime_dir_of("car", directory)
        assert str(os.getpid()) in str(mine)
        with own_runtime_dir("car") as again:
            assert again == directory
            assert not dead.exists()
