"""The part of a recording that calibration reads."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from birdslam.geometry.camera import Camera
from birdslam.perception import KeptFindings, Networks, Segmentation
from birdslam.perception.decoding.multitask import Findings
from birdslam.perception.manifest import Schedule
from birdslam.runtime.calibration.pieces import READ_S, pieces, read_pieces
from birdslam.sources.recording import RecordedFrame, Recording
from birdslam.types import Frame

CAMERA = Camera(8, 4, 6.0, 6.0, 4.0, 2.0, 1.5)


class Film(Recording):
    """Frames whose pixels are their index; declares `declared` frames."""

    def __init__(self, frames: int, rate_hz: float, declared: int | None = None) -> None:
        self.camera, self.rate_hz, self.name = CAMERA, rate_hz, "film"
        self._frames, self._declared = frames, frames if declared is None else declared

    def __len__(self) -> int:
        return self._declared

    def frames(self, start: int = 0) -> Iterator[RecordedFrame]:
        for index in range(start, self._frames):
            yield RecordedFrame(index, round(index * 1e9 / self.rate_hz), np.full((4, 8), index % 256, np.uint8))


@given(
    frames=st.integers(0, 100_000),
    rate_hz=st.floats(1.0, 120.0),
    most_frames=st.none() | st.integers(1, 100_000),
)
def test_pieces_lie_apart_within_the_film_and_last_a_minute(
    frames: int, rate_hz: float, most_frames: int | None
) -> None:
    read = pieces(Film(frames, rate_hz), most_frames)
    indices = [index for piece in read for index in piece]
    assert indices == sorted(set(indices))
    assert len(indices) <= max(1, round(READ_S * rate_hz))
    assert indices[-1] < min(n for n in (frames, most_frames, indices[-1] + 1) if n)
    if frames and frames / rate_hz <= READ_S - 1.0 and most_frames is None:
        assert indices == list(range(frames))


def test_frames_keep_their_index_and_time() -> None:
    film = Film(2000, 10.0)
    read = pieces(film, None)
    frames = list(read_pieces(film, read, "test"))
    assert [frame.frame_id for frame in frames] == [index for piece in read for index in piece]
    assert all(frame.t_source_ns == frame.frame_id * 100_000_000 for frame in frames)
    assert all(frame.image is not None and frame.image[0, 0] == frame.frame_id % 256 for frame in frames)


@pytest.mark.parametrize("declared", [0, 700])
def test_a_film_that_is_shorter_than_declared_ends_where_it_ends(declared: int) -> None:
    film = Film(30, 10.0, declared)
    assert len(list(read_pieces(film, pieces(film, None), "test"))) == 30


class _Masks:
    """A network whose masks and boxes depend on the image; counts its runs."""

    name, role, schedule, fell_back = "masks", "segmenter", Schedule(every=2), ""

    def __init__(self) -> None:
        self.runs = 0

    def run(self, image: np.ndarray) -> Findings:
        self.runs += 1
        mask = np.arange(image.size).reshape(image.shape) % (2 + int(image[0, 0])) == 0
        return Findings(segmentation=Segmentation(mask, ~mask))


def test_second_pass_has_the_networks_results_of_the_first(tmp_path: Path) -> None:
    head, kept, passes = _Masks(), KeptFindings(), []
    with ThreadPoolExecutor(1) as threads:
        for number in range(3):
            networks = Networks([head], threads.submit, kept=kept)
            frames = [Frame(k, k, k, 0, np.full((5, 7), k % 3, np.uint8)) for k in range(9)]
            passes.append([pending.result() for _, pending in networks.in_order(frames)])
            if number == 1:
                kept.write(tmp_path / "findings")
                kept = KeptFindings.read(tmp_path / "findings")
    assert head.runs == 5
    for first, second, third in zip(*passes, strict=True):
        for later in (second, third):
            assert (first.ages, first.status, first.detections) == (later.ages, later.status, later.detections)
            np.testing.assert_array_equal(first.segmentation.road, later.segmentation.road)
            np.testing.assert_array_equal(first.segmentation.lane, later.segmentation.lane)


def test_findings_of_another_image_are_not_used() -> None:
    kept, at = KeptFindings(), {"name": "masks", "t_source_ns": 1}
    for value in (0, 1):
        found = kept.run(**at, run=_Masks().run, image=np.full((5, 7), value, np.uint8))
        assert found.segmentation.road.sum() == (18, 12)[value]
