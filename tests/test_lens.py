"""A lens from the drive: observable focal length and distortion, and the pieces of a calibration."""

from __future__ import annotations

import math
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from birdslam.calibration.lens import Lens, focal_by_field_of_view, self_calibrate
from birdslam.calibration.lens_windows import CornersOfImage
from birdslam.geometry.camera import Camera
from birdslam.perception import KeptFindings, Networks, Segmentation
from birdslam.perception.decoding.multitask import Findings
from birdslam.perception.manifest import Schedule
from birdslam.runtime.calibration.given import Given, focal_length_of
from birdslam.runtime.calibration.pieces import READ_S, pieces, read_pieces
from birdslam.sources.recording import RecordedFrame, Recording
from birdslam.types import Frame
from tests.cases import first

SIZE_PX = 1280, 720
FOCAL_PX = 1000.0
NOISE_PX = 0.3


def drive(
    k1: float,
    turn_rad: float,
    images: int = 54,
    step_m: float = 0.8,
    seed: int = 0,
    focal_px: float = FOCAL_PX,
    pitch_rad: float = 0.0,
) -> list[CornersOfImage]:
    """Corners of a street's facades and ground, by a camera that turns to both sides, `turn_rad` together."""
    rng = np.random.default_rng(seed)
    # x right, y down, z forward from the first camera; enough for the whole way
    n = 9 * images
    side = rng.choice([-1.0, 1.0], n)
    places = np.column_stack([side * rng.uniform(4.0, 25.0, n), rng.uniform(-8.0, 1.3, n), rng.uniform(3.0, 150.0, n)])
    middle = 0.5 * (np.array(SIZE_PX) - 1.0)
    heading, at = 0.0, np.zeros(3)
    out = []
    for k in range(images):
        if k:
            heading += turn_rad / images * (1.0 if (k // (images // 3)) % 2 == 0 else -1.0)
            at = at + step_m * np.array([math.sin(heading), 0.0, math.cos(heading)])
        R = cv2.Rodrigues(np.array([0.0, heading, 0.0]))[0]
        q = (places - at) @ R @ cv2.Rodrigues(np.array([-pitch_rad, 0.0, 0.0]))[0]
        ahead = (q[:, 2] > 2.0) & (q[:, 2] < 90.0)
        u = q[:, :2] / np.where(ahead, q[:, 2], 1.0)[:, None]
        r2 = np.square(u).sum(axis=1, keepdims=True)
        px = focal_px * u * (1.0 + k1 * r2) + middle + rng.normal(0.0, NOISE_PX, u.shape)
        one_to_one = (1.0 + 3.0 * k1 * r2[:, 0]) > 0.2
        seen = ahead & one_to_one & (px > 5.0).all(axis=1) & (px < np.array(SIZE_PX) - 5.0).all(axis=1)
        ids = np.flatnonzero(seen)
        out.append(CornersOfImage(ids, px[ids]))
    return out


def calibrated(images: list[CornersOfImage], focal_px: float = FOCAL_PX, sigma_rel: float = 0.15) -> Lens:
    lens = self_calibrate(images, SIZE_PX, focal_px, sigma_rel)
    assert lens is not None
    return lens


@pytest.mark.parametrize("k1", [-0.3, pytest.param(0.0, marks=pytest.mark.slow)])
def test_turning_drive_determines_focal_length_and_distortion(k1: float) -> None:
    lens = calibrated(drive(k1, math.radians(120.0)), 1.1 * FOCAL_PX)
    assert lens.focal_shown
    assert abs(math.log(lens.focal_px / FOCAL_PX)) < 2.0 * lens.focal_sigma_rel
    assert lens.focal_sigma_rel < 0.06
    assert abs(lens.k1 - k1) < 3.0 * lens.k1_sigma
    assert lens.k1_sigma < 0.05


def test_straight_drive_determines_only_distortion() -> None:
    images = drive(-0.3, 0.0)
    lens = calibrated(images)
    assert lens == calibrated(images)  # deterministic
    assert not lens.focal_shown
    assert (lens.focal_px, lens.focal_sigma_rel) == (pytest.approx(FOCAL_PX), 0.15)
    assert lens.turned_rad < math.radians(15.0)
    assert abs(lens.k1 + 0.3) < 3.0 * lens.k1_sigma


@pytest.mark.parametrize("pitch_rad", first(1, [-0.06, 0.05]))
def test_direction_of_travel_determines_pitch(pitch_rad: float) -> None:
    lens = calibrated(drive(-0.2, math.radians(40.0), images=40, pitch_rad=pitch_rad), 1.1 * FOCAL_PX)
    assert abs(lens.pitch.pitch_rad - pitch_rad) < 3.0 * lens.pitch.sigma_rad
    assert lens.pitch.sigma_rad < 0.015


def test_prior_is_kept_without_information() -> None:
    lens = calibrated(drive(-0.2, 0.0), FOCAL_PX, 0.02)
    assert lens.focal_px == pytest.approx(FOCAL_PX, rel=0.03)
    assert lens.focal_sigma_rel == pytest.approx(0.02)
    assert lens.k1 == pytest.approx(-0.2, abs=3.0 * lens.k1_sigma)


def test_a_wide_lens_is_about_equidistant() -> None:
    """Of 120 degrees across a pinhole's focal length is half of the true one."""
    focal_px = focal_by_field_of_view(SIZE_PX[0], 120.0, fisheye=True)
    middle = 0.5 * (np.array(SIZE_PX) - 1.0)
    images = []
    for corners in drive(0.0, 0.0, images=66, focal_px=250.0):  # a pinhole that sees as far
        u = (corners.px - middle) / 250.0
        r = np.linalg.norm(u, axis=1, keepdims=True)
        images.append(CornersOfImage(corners.ids, focal_px * u / r * np.arctan(r) + middle))
    wide = self_calibrate(images, SIZE_PX, focal_px, 0.08, by_view=True, fisheye=True)
    assert wide.fisheye
    assert wide.k1 == pytest.approx(0.0, abs=3.0 * wide.k1_sigma)
    assert wide.k1_sigma < 0.1
    given = focal_length_of(Given(fov_deg=140.0), "video:film.mp4", (960, 540))
    assert given.fisheye
    Camera(960, 540, given.px, given.px, 479.5, 269.5, height_m=1.4)  # a pinhole's is refused


def test_stationary_car_determines_no_lens() -> None:
    standing = drive(-0.2, 0.0, images=40, step_m=0.0)
    assert self_calibrate(standing, SIZE_PX, FOCAL_PX, 0.15) is None
    assert self_calibrate([], SIZE_PX, FOCAL_PX, 0.15) is None


def test_moving_features_do_not_bias_the_lens() -> None:
    images = drive(-0.25, 0.0)
    rng = np.random.default_rng(3)
    wrong = set(
        rng.choice(9 * len(images), len(images), replace=False).tolist()
    )  # one corner in nine drifts on its own
    drift = {k: rng.normal(0.0, 4.0, 2) for k in wrong}
    moved = []
    for number, image in enumerate(images):
        px = image.px.copy()
        for row, k in enumerate(image.ids.tolist()):
            if k in drift:
                px[row] += number * drift[k] / 3.0
        moved.append(CornersOfImage(image.ids, px))
    lens = calibrated(moved)
    assert abs(lens.k1 + 0.25) < 3.0 * lens.k1_sigma
    assert lens.k1_sigma < 0.1


def test_one_sided_features_give_a_lens_or_none() -> None:
    """Without that part of the image nothing is left of its windows."""
    images = []
    for image in drive(-0.2, math.radians(60.0), images=40):
        some = (image.px[:, 0] > 640.0) & (image.px[:, 1] < 360.0)
        some |= np.arange(len(some)) % 12 == 0
        images.append(CornersOfImage(image.ids[some], image.px[some]))
    lens = self_calibrate(images, SIZE_PX, FOCAL_PX, 0.15)
    assert lens is None or abs(math.log(lens.focal_px / FOCAL_PX)) < 2.0 * lens.focal_sigma_rel


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
    for once, second, third in zip(*passes, strict=True):
        for later in (second, third):
            assert (once.ages, once.status, once.detections) == (later.ages, later.status, later.detections)
            np.testing.assert_array_equal(once.segmentation.road, later.segmentation.road)
            np.testing.assert_array_equal(once.segmentation.lane, later.segmentation.lane)


def test_findings_of_another_image_are_not_used() -> None:
    kept, at = KeptFindings(), {"name": "masks", "t_source_ns": 1}
    for value in (0, 1):
        found = kept.run(**at, run=_Masks().run, image=np.full((5, 7), value, np.uint8))
        assert found.segmentation.road.sum() == (18, 12)[value]
