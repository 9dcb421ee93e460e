"""Lane lines in a kept map, and the map process with late estimates on a busy computer."""

from __future__ import annotations

import json
import time
import zlib
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import geojson
import msgspec
import numpy as np
import pytest

from birdslam.geometry.se2 import SE2
from birdslam.loops.gnss.earth import Earth
from birdslam.loops.map_file import HEAD, MAGIC, decode_map, encode_map
from birdslam.loops.place_map import MapCamera, PlaceMap
from birdslam.loops.session import MapSession
from birdslam.perf.maps.places import CAMERA, along, build, drive
from birdslam.runtime.configuration import load
from birdslam.runtime.maps import map_process
from birdslam.runtime.maps.map_export import export_map
from birdslam.runtime.maps.map_process import WAITING_IMAGES, LiveMap
from birdslam.runtime.process.restarts import FIRST
from birdslam.runtime.process.vitals import Vitals
from birdslam.runtime.transport.presence import ring_path
from birdslam.runtime.transport.ring import FrameRing
from birdslam.types import Estimate, FrameRef, LaneLine, Lanes, LineColour, LineKind
from tests.fake_bus import FakeBus

STREET = replace(build(along([0.0] * 60 + [0.01] * 60), seed=1), max_seen=120)
LINES = {3: (1.75, LineKind.DASHED), 4: (-1.75, LineKind.SOLID)}
COV4 = tuple(np.diag([0.02**2, 0.002**2, 1e-8, 1e-12]).ravel().tolist())


def lanes(row: int) -> Lanes:
    """Lines beside the route, 1.75 m to its left and right."""
    bend = 0.01 if row >= 60 else 0.0
    return Lanes(
        lines=tuple(
            LaneLine(
                line=number,
                offset_m=offset_m,
                slope=0.0,
                curvature_per_m=bend,
                curvature_rate_per_m2=0.0,
                cov=COV4,
                seen_from_m=3.0,
                seen_to_m=30.0,
                to_m=40.0,
                kind=kind,
                colour=LineColour.WHITE,
            )
            for number, (offset_m, kind) in LINES.items()
        )
    )


def driven(place_map: PlaceMap, rows: range, with_lines: bool, seed: int = 1) -> PlaceMap:
    session = MapSession(CAMERA, place_map, True, extract=lambda features: features)
    for estimate, seen, _ in drive(STREET, rows, seed):
        if with_lines:
            estimate = msgspec.structs.replace(estimate, lanes=lanes(rows.start + estimate.frame_id))
        session.step(estimate, seen)
    session.finish()
    return place_map


@pytest.fixture(scope="module")
def mapped() -> bytes:
    return encode_map(driven(PlaceMap(MapCamera.of(CAMERA)), range(110), with_lines=True))


def aside_m(place_map: PlaceMap, line: int) -> np.ndarray:
    """Lateral distance of the map's line from the trajectory between keyframes, positive to the left."""
    out = []
    for each in place_map.lines():
        if each.line == line:
            poses = place_map.poses()
            for x_m, y_m in each.points_m:
                nearest = np.hypot(poses[:, 0] - x_m, poses[:, 1] - y_m).argmin()
                out.append((SE2(*poses[nearest].tolist()).inverse() @ np.array([[x_m, y_m]]))[0, 1])
    return np.array(out)


def test_lines_are_beside_the_whole_trajectory(mapped: bytes) -> None:
    place_map = decode_map(mapped)
    for number, (offset_m, kind) in LINES.items():
        found = [line for line in place_map.lines() if line.line == number]
        assert [(line.kind, line.colour, line.drive) for line in found] == [(kind, LineColour.WHITE, 0)]
        assert 0.8 * 110 < np.hypot(*np.diff(found[0].points_m, axis=0).T).sum() < 120.0
        assert np.abs(aside_m(place_map, number) - offset_m).max() < 0.15
        assert 0.0 < found[0].sigma_m < 0.1


def test_lines_move_with_their_keyframes(mapped: bytes) -> None:
    place_map, before = decode_map(mapped), decode_map(mapped)
    T = SE2(100.0, -20.0, 1.0)
    place_map.place({each.number: (T @ each.T_map_keyframe, each.cov) for each in place_map.keyframes})
    for old, new in zip(before.lines(), place_map.lines(), strict=True):
        assert new.points_m == pytest.approx(T @ old.points_m)


def test_a_kilometre_with_lines_is_below_two_megabytes(mapped: bytes) -> None:
    place_map = decode_map(mapped)
    assert len(mapped) / place_map.length_m * 1e3 < 2e6
    assert sum(len(each.lines) for each in place_map.keyframes) > 40


def test_a_keyframe_without_lines_gets_them_from_a_later_drive() -> None:
    place_map = driven(PlaceMap(MapCamera.of(CAMERA)), range(32), with_lines=False)
    assert not place_map.lines()
    driven(place_map, range(32), with_lines=True, seed=3)
    assert {line.line for line in place_map.lines()} == set(LINES)
    assert np.abs(aside_m(place_map, 3) - LINES[3][0]).max() < 0.3


def test_a_file_of_version_2_has_no_lines(mapped: bytes) -> None:
    head = len(MAGIC) + HEAD.size
    record = msgspec.msgpack.decode(mapped[head:])
    record["keyframes"] = [keyframe[:9] for keyframe in record["keyframes"]]
    body = msgspec.msgpack.encode(record)
    old = decode_map(MAGIC + HEAD.pack(2, len(body), zlib.crc32(body)) + body)
    assert len(old) == len(decode_map(mapped))
    assert not old.lines()


def test_lines_are_exported_in_metres_and_on_earth(mapped: bytes, tmp_path: Path) -> None:
    place_map = decode_map(mapped)
    said = export_map(place_map, tmp_path / "street.map.geojson")
    assert said == "1 trajectories and 2 lines"
    features = json.loads((tmp_path / "street.map.geojson").read_text())["features"]
    assert {each["properties"]["name"] for each in features} == {"drive 0", "dashed 3", "solid 4"}
    place_map.earth = Earth(51.0, 7.0, 0.0, 0.0, 0.0, 1.0, np.eye(4), 0.0, 40, 0, 1.0, None, 0.0)
    export_map(place_map, tmp_path / "street.geojson")
    found = geojson.loads((tmp_path / "street.geojson").read_text())
    assert found.is_valid
    dashed = next(each for each in found["features"] if each["properties"]["name"] == "dashed 3")
    assert dashed["properties"]["kind"] == "dashed"
    assert dashed["geometry"]["coordinates"][0][:2] == pytest.approx([7.0, 51.0], abs=2e-3)


FRAMES = 30


@pytest.fixture
def ring(tmp_path: Path) -> Iterator[FrameRing]:
    with FrameRing(ring_path("late", tmp_path / "rt"), CAMERA.height_px, CAMERA.width_px, 1) as ring:
        yield ring


class Drive:
    """A map process without its bus, fed by hand: each turn an image, and an estimate that may be of an older one."""

    def __init__(self, folder: Path, ring: FrameRing) -> None:
        settings = {
            "vehicle": "late",
            "output": str(folder),
            "runtime.runtime_dir": str(folder / "rt"),
            "results.map": str(folder / "new.map"),
        }
        configuration = msgspec.structs.replace(load(None, settings), camera=CAMERA)
        (folder / "logs").mkdir()
        self._ring, self._bus, self._began_ns = ring, FakeBus(), time.monotonic_ns()
        self.live = LiveMap(configuration, self._bus, Vitals(), FIRST)

    def turn(self, number: int, newest: Estimate, of_image: Estimate | None) -> None:
        slot, sequence = self._ring.write(np.zeros((CAMERA.height_px, CAMERA.width_px), np.uint8))
        of_frame = {"slot": slot, "sequence": sequence, "ring_epoch": self._ring.epoch, "channels": 1}
        of_frame |= {"width_px": CAMERA.width_px, "height_px": CAMERA.height_px}
        times = {"t_source_ns": newest.t_source_ns, "t_utc_ns": 0}
        far_ns = self._began_ns + number * 10**12  # regardless of the budget
        self._bus.inboxes["frame"].come(FrameRef(frame_id=newest.frame_id, t_capture_ns=far_ns, **times, **of_frame))
        if of_image is not None:
            self._bus.inboxes["estimate"].come(of_image)
        self.live.turn(0.0)


def estimates() -> list[Estimate]:
    return [estimate for estimate, _, _ in drive(build(along([0.0] * 40), seed=1), range(FRAMES), 1)]


@pytest.mark.parametrize("late", [0, WAITING_IMAGES + 3])
def test_frames_are_used_with_late_estimates(tmp_path: Path, ring: FrameRing, late: int) -> None:
    driven, made = Drive(tmp_path, ring), estimates()
    for number, newest in enumerate(made):
        driven.turn(number, newest, made[number - late] if number >= late else None)
    live = driven.live
    assert live.finish() == ""
    assert live.torn == 0
    assert live.looks >= 0.2 * (FRAMES - late)


def test_only_due_images_are_undistorted(tmp_path: Path, ring: FrameRing, monkeypatch: pytest.MonkeyPatch) -> None:
    """A car creeps: hardly anything new is seen."""
    undistorted = []
    monkeypatch.setattr(map_process, "Undistorter", lambda camera: lambda image: undistorted.append(1) or image)
    driven, begin = Drive(tmp_path, ring), estimates()[0]
    for number in range(FRAMES):
        T = begin.T_world_ego @ SE2(0.01 * number, 0.0, 0.0)
        t_ns = begin.t_source_ns + number * 10**7
        newest = msgspec.structs.replace(begin, frame_id=number, T_world_ego=T, t_source_ns=t_ns)
        driven.turn(number, newest, newest)
    assert driven.live.finish() == ""
    assert len(undistorted) == driven.live.looks == 1
