"""The map process and late estimates on a busy computer."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path

import msgspec
import numpy as np
import pytest

from birdslam.geometry.se2 import SE2
from birdslam.perf.maps.places import CAMERA, along, build, drive
from birdslam.runtime.configuration import load
from birdslam.runtime.maps import map_process
from birdslam.runtime.maps.map_process import WAITING_IMAGES, LiveMap
from birdslam.runtime.process.restarts import FIRST
from birdslam.runtime.process.vitals import Vitals
from birdslam.runtime.transport.presence import ring_path
from birdslam.runtime.transport.ring import FrameRing
from birdslam.types import Estimate, FrameRef
from tests.fake_bus import FakeBus

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
