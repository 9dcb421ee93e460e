"""The map process beside a running drive: real processes, real zenoh; killed, stalled, refused, on a full disk."""

from __future__ import annotations

import os
import resource
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import msgspec
import numpy as np
import pytest

from birdslam.loops.map_pose import InMap, MapState
from birdslam.runtime.batch.offline import pipeline
from birdslam.runtime.cli.main import main
from birdslam.runtime.client import Planner
from birdslam.runtime.configuration import load
from birdslam.runtime.maps.drive_map import DriveMap
from birdslam.runtime.maps.map_drive import MapChoice
from birdslam.runtime.maps.map_store import read_map
from birdslam.runtime.recording.recording import Recording
from birdslam.sources.opening import open_recording
from birdslam.types import Estimate
from tests.test_bus import until
from tests.test_pipeline import F_PX, HEIGHT, LIMIT_S, UNHURRIED, WIDTH, Run, road_image

pytestmark = pytest.mark.processes

FRAMES, STEP_M = 48, 0.5


WALL_M, WALL_HEIGHT_M = 5.0, 4.0


def street_image(x_m: float) -> np.ndarray:
    """The road between two walls, whose corners have depths that a map can keep."""
    image = road_image(x_m)
    u, v = np.meshgrid(np.arange(WIDTH, dtype=np.float32) - WIDTH / 2, np.arange(HEIGHT, dtype=np.float32) - HEIGHT / 2)
    depth = WALL_M * F_PX / np.maximum(np.abs(u), 1.0)
    down_m = v * depth / F_PX
    blocks = np.random.default_rng(6).integers(0, 256, (16, 200), dtype=np.uint8)
    blocks = cv2.resize(blocks, None, fx=16, fy=16, interpolation=cv2.INTER_NEAREST)
    scale = np.float32(32.0)  # texels a metre: blocks of half a metre
    along = (depth + x_m) * scale + np.where(u < 0.0, 0.0, 1500.0).astype(np.float32)
    up = (down_m + WALL_HEIGHT_M) * scale
    wall = cv2.remap(
        blocks, along.astype(np.float32), up.astype(np.float32), cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP
    )
    on_wall = (down_m < 1.65) & (down_m > -WALL_HEIGHT_M) & (depth < 60.0)
    return np.where(on_wall, wall, image).astype(np.uint8)


def write_drive(sequence: Path, frames: int) -> Path:
    """A small KITTI drive: straight on, half a metre a frame."""
    (sequence / "image_0").mkdir(parents=True)
    for number in range(frames):
        assert cv2.imwrite(str(sequence / "image_0" / f"{number:06d}.png"), street_image(STEP_M * number))
    row = f"{F_PX} 0 {WIDTH / 2} 0 0 {F_PX} {HEIGHT / 2} 0 0 0 1 0"
    (sequence / "calib.txt").write_text(f"P0: {row}\n")
    (sequence / "times.txt").write_text("".join(f"{0.1 * i:e}\n" for i in range(frames)))
    return sequence


@pytest.fixture(scope="module")
def road(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_drive(tmp_path_factory.mktemp("kitti") / "sequences" / "78", FRAMES)


@pytest.fixture(scope="module")
def kept(tmp_path_factory: pytest.TempPathFactory, road: Path) -> bytes:
    """The map of that road, made when a drive of it was over."""
    place = tmp_path_factory.mktemp("kept")
    recording = open_recording(f"kitti:{road}")
    making = DriveMap(MapChoice(place / "road.map", extend=True), None)
    with pipeline(load(None, {"models.shipped": False})) as drive:
        for record in drive(recording):
            if isinstance(record, Estimate):
                making.add(record)
    making.finish(recording.camera, ((n, 0, street_image(STEP_M * n)) for n in range(FRAMES)), place)
    assert len(read_map(place / "road.map")) >= 4
    return (place / "road.map").read_bytes()


def live(place: Path, road: Path, *arguments: str, rate_hz: int = 10) -> Run:
    """The road again and again."""
    rate = "--rate", str(rate_hz)
    return Run(*(place, "--source", f"kitti:{road}", *rate, "--set", "source.loop=true", *UNHURRIED, *arguments))


@contextmanager
def mapping(place: Path, road: Path, kept: bytes) -> Iterator[tuple[Run, Planner, Path]]:
    """The road again, with a copy of the map that was kept: the run, a planner beside it, the copy."""
    path = place / "road.map"
    path.write_bytes(kept)
    with live(place, road, "--map", str(path)) as run, Planner(run.vehicle, run.runtime_dir) as planner:
        in_map(planner, lambda here: here.pose is not None, "the map process is at work")
        yield run, planner, path


def in_map(planner: Planner, enough: Callable[[InMap], bool], what: str) -> InMap:
    """An estimate in the map that is as asked; the next one may be so no more."""
    seen: list[InMap] = []

    def asked() -> bool:
        seen.append(planner.in_map())
        return enough(seen[-1])

    until(asked, what)
    return seen[-1]


def hears(planner: Planner, frames: int) -> None:
    """So many further estimates."""
    until_s = time.monotonic() + LIMIT_S
    heard = 0
    while heard < frames:
        assert time.monotonic() < until_s
        heard += planner.wait(1.0) is not None


def test_planner_gets_poses_in_the_map(tmp_path_factory: pytest.TempPathFactory, road: Path, kept: bytes) -> None:
    place = tmp_path_factory.mktemp("l")
    path = place / "road.map"
    path.write_bytes(kept)
    with (
        # Slow: a loaded computer that predicts most frames never localises
        live(place, road, "--map-only", str(path), "--record", str(place / "l.mcap"), rate_hz=4) as run,
        Planner(run.vehicle, run.runtime_dir) as planner,
    ):
        found = in_map(planner, lambda here: here.state is MapState.LOCALISED, "the drive is localised")
        with Planner(run.vehicle, run.runtime_dir) as late:  # the last pose is there for who comes later
            in_map(late, lambda here: here.pose is not None, "one that came late knows")
        out = run.stop()
    assert abs(found.T_map_ego.y_m) < 0.5
    assert -1.0 < found.T_map_ego.x_m < STEP_M * FRAMES + 5.0
    assert np.sqrt(found.cov[0, 0]) < 0.5
    assert run.summary()["ended"] == "SIGTERM"
    assert run.left_behind() == []
    summary = run.summary()["map"]
    assert summary["localised"] > 0
    assert summary["restarts"] == 0
    assert len((run.output / "map.tum.txt").read_text().splitlines()) == summary["localised"]
    assert path.read_bytes() == kept
    assert "localised in the map" in out
    recorded = [msgspec.json.decode(m.data) for m in Recording(place / "l.mcap").messages(("/map_pose",))]
    assert {"localised"} <= {pose["state"] for pose in recorded}


@pytest.mark.slow  # a start more
def test_everything_is_loaded_before_the_first_frame(tmp_path_factory: pytest.TempPathFactory, road: Path) -> None:
    """A new map is looked up in only when it has places."""
    place = tmp_path_factory.mktemp("e")
    with (
        live(place, road, "--map", str(place / "new.map")) as run,
        Planner(run.vehicle, run.runtime_dir) as planner,
    ):
        first = in_map(planner, lambda here: here.pose is not None, "the map process is at work").pose
        assert first.keyframes == 0
        assert "faiss" in Path(f"/proc/{run.node_pid('map')}/maps").read_text()


def test_failures_of_the_map_process_do_not_affect_the_drive(
    tmp_path_factory: pytest.TempPathFactory, road: Path, kept: bytes
) -> None:
    place = tmp_path_factory.mktemp("k")
    with mapping(place, road, kept) as (run, planner, path):
        for fault in (lambda: os.kill(run.node_pid("map"), signal.SIGKILL), lambda: run.stall("map")):
            fault()
            hears(planner, 10)
            before = planner.in_map().pose
            after = before.frame_id + 3
            in_map(
                planner,
                lambda here, after=after: (
                    here.pose is not None and here.pose.frame_id > after and here.pose.keyframes >= 4
                ),
                "its successor goes on with the map that was kept",
            )
        limit = path.stat().st_size - 5_000  # no file of its process may grow past it: its log may, the map may not
        resource.prlimit(run.node_pid("map"), resource.RLIMIT_FSIZE, (limit, limit))
        newest, saved = planner.in_map().pose, len(read_map(path))
        assert newest is not None
        in_map(
            planner,
            lambda here: here.pose is not None and here.pose.frame_id > newest.frame_id and here.pose.keyframes > saved,
            "the map has grown",
        )
        whole = path.read_bytes()  # what was being saved when the limit came is in it
        out = run.stop()
    assert "map was killed by SIGKILL" in out
    assert "map is stalled: no heartbeat" in out
    summary = run.summary()
    assert set(summary["restarts"].values()) == {0}
    assert summary["map"]["restarts"] == 2, out
    assert "the old file is kept: File too large" in out
    assert "File too large" in summary["map"]["error"]
    assert path.read_bytes() == whole
    assert len(read_map(path)) >= 4
    assert sorted(entry.name for entry in place.iterdir() if entry.name.startswith(".")) == []


def test_unusable_map_is_refused_before_the_drive(
    tmp_path: Path, road: Path, kept: bytes, capsys: pytest.CaptureFixture[str]
) -> None:
    torn, empty, whole = tmp_path / "torn.map", tmp_path / "empty.map", tmp_path / "road.map"
    torn.write_bytes(kept[:-100])
    empty.write_bytes(b"")
    whole.write_bytes(kept)
    other = write_drive(tmp_path / "79", 3)
    (other / "calib.txt").write_text((other / "calib.txt").read_text().replace(f"{F_PX}", f"{2 * F_PX}"))
    for name, path, source in (("torn", torn, road), ("is empty", empty, road), ("another camera", whole, other)):
        refused = main(
            [
                *("run", "--source", f"kitti:{source}", "--rate", "10", "--map", str(path)),
                *("--output", str(tmp_path / "o"), "--set", f"runtime.runtime_dir={tmp_path / 'rt'}"),
                *("--set", "models.shipped=false"),
            ]
        )
        said = capsys.readouterr().err
        assert refused == 2, said
        assert name in said
        assert len(said.strip().splitlines()) == 1
    assert whole.read_bytes() == kept


@pytest.mark.slow  # test_maps.py joins maps, test_batch.py drives
def test_a_batch_of_drives_makes_one_map(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    drives = [str(write_drive(tmp_path / name, FRAMES // 2)) for name in ("once", "again")]
    batch = ("batch", *drives, "--output", str(tmp_path / "out"), "--jobs", "2", "--map", str(tmp_path / "street.map"))
    assert main([*batch, "--set", "models.shipped=false"]) == 0
    assert "2 drives" in capsys.readouterr().out
    assert read_map(tmp_path / "street.map").drives == 2
