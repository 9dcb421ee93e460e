"""Cars placed by the front end against labels: of a world made here, and of KITTI tracking where it is at hand."""

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from birdslam.bench.tracking.localisation import (
    CAR_RANGES_M,
    INSIDE_1_SIGMA,
    INSIDE_2_SIGMA,
    PlaceError,
    PlacesRow,
    match_cars,
    measure,
    summarise_ranges,
)
from birdslam.frontend import FrontEndConfig
from birdslam.geometry.camera import Camera
from birdslam.paper import PAPER
from birdslam.perception import Detections
from birdslam.runtime.cli.main import main
from birdslam.sources.kitti_tracking import TrackingSequence, open_tracking, read_detections
from birdslam.sources.label_projection import Label
from tests import tracking_world

CAMERA = Camera(1242, 375, 721.5, 721.5, 609.6, 172.9, 1.65)
HEIGHT_M, WIDTH_M, LENGTH_M = 1.5, 1.6, 4.0
PITCH_RAD = 0.015  # of the camera against the road, which nobody tells the front end


def label(frame: int, track: int, x_m: float, y_m: float, truncated: float = 0.0) -> Label:
    """A car headed like the ego, in camera axes (x right, y down, z ahead) over a road that the camera leans to."""
    half = [(sx * WIDTH_M / 2, sz * LENGTH_M / 2) for sx in (-1, 1) for sz in (-1, 1)]
    down_m = 1.65 - math.tan(PITCH_RAD) * x_m
    corners = np.array([[-y_m + dx, down_m - h, x_m + dz] for dx, dz in half for h in (0.0, HEIGHT_M)])
    px = corners[:, :2] / corners[:, 2:] * 721.5 + [609.6, 172.9]
    box_px = (*px.min(axis=0).tolist(), *px.max(axis=0).tolist())
    return Label(
        frame, track, "Car", truncated, 0, box_px, HEIGHT_M, WIDTH_M, LENGTH_M, (-y_m, down_m, x_m), -math.pi / 2
    )


def world(frames: int) -> tuple[TrackingSequence, list[Detections]]:
    """The ego closes in on three cars at 0.4 m a frame."""
    cars = [(18.0, 0.0), (30.0, 4.0), (42.0, -4.0)]
    labels = [label(k, i, x - 0.4 * k, y, float(i == 0)) for k in range(frames) for i, (x, y) in enumerate(cars)]
    poses = np.tile(np.eye(4), (frames, 1, 1))
    poses[:, 2, 3] = 0.4 * np.arange(frames)
    sequence = TrackingSequence("9999", CAMERA, np.eye(4), poses, tuple(labels), None)
    boxes = [np.array([one.box_px for one in labels if one.frame == k]) for k in range(frames)]
    return sequence, [Detections(box, np.full(3, 0.9), ("car",) * 3) for box in boxes]


def depth_error(errors: list[PlaceError], span: str) -> float:
    """The median of a range over all sequences."""
    (row,) = [row for row in summarise_ranges(errors, CAR_RANGES_M) if row.sequence == "all" and row.range == span]
    assert row.depth_error_median_rel is not None
    return row.depth_error_median_rel


def test_untruncated_cars_are_compared_and_a_tilted_road_is_found_out() -> None:
    sequence, detections = world(12)
    errors, paper = (
        match_cars(sequence, measure(sequence, detections, config)) for config in (FrontEndConfig(), PAPER.frontend)
    )
    assert {error.label for error in errors if error.cut} == {0}
    errors = [error for error in errors if not error.cut]
    assert {error.label for error in errors} == {1, 2}
    assert {error.frame for error in errors} == set(range(1, 12))  # a track is confirmed in its second frame
    assert depth_error(errors, "15-30") < 0.05
    assert depth_error(paper, "15-30") > 0.15
    # Eq. 1 on level ground, on the nearest face
    slope = (1.65 - math.tan(PITCH_RAD) * paper[0].depth_m) / (paper[0].depth_m - LENGTH_M / 2)
    assert paper[0].depth_m + paper[0].error_m[0] == pytest.approx(1.65 / slope, rel=1e-3)


def test_rows_are_medians_by_range_and_shares_inside_the_right_ellipses() -> None:
    rng = np.random.default_rng(0)
    z = rng.standard_normal((20000, 2))
    errors = [PlaceError("a", k, 0, 20.0, e, float(e @ e)) for k, e in enumerate(z)]
    errors.append(PlaceError("b", 0, 0, 45.0, np.array([-4.5, 0.2]), 9.0))
    errors.append(PlaceError("b", 0, 1, 45.0, np.array([40.0, 40.0]), 900.0, cut=True))
    rows = {(row.sequence, row.range): row for row in summarise_ranges(errors, CAR_RANGES_M)}
    assert list(rows) == [(s, r) for s in ("a", "b", "all") for r in ("0-15", "15-30", "30-50")]
    assert rows["a", "0-15"] == PlacesRow(sequence="a", range="0-15", n=0)
    gauss = rows["a", "15-30"]
    assert gauss.tracks == 1
    assert gauss.inside_1_sigma == pytest.approx(0.683, abs=0.01)
    assert gauss.inside_2_sigma == pytest.approx(0.954, abs=0.01)
    far = rows["all", "30-50"]
    assert (far.n, far.depth_error_median_rel, far.lateral_error_median_m) == (
        1,
        pytest.approx(0.1),
        pytest.approx(0.2),
    )
    assert far.depth_bias_median_rel == pytest.approx(-0.1)
    assert pytest.approx((2.2957, 6.1801), abs=1e-3) == (INSIDE_1_SIGMA, INSIDE_2_SIGMA)


def test_real_boxes_of_cars_beat_the_level_ground(data_dir: Path) -> None:
    root = data_dir / "kitti_tracking" / "training"
    whole = open_tracking(root, "0003")
    sequence = replace(whole, poses=whole.poses[:60])
    detections = read_detections(root / "det_02_rrc", "0003", len(sequence))
    ours, paper = (
        match_cars(sequence, measure(sequence, detections, config)) for config in (FrontEndConfig(), PAPER.frontend)
    )
    for span in ("15-30", "30-50"):
        assert depth_error(ours, span) < min(0.08, 0.5 * depth_error(paper, span))


def test_constants_of_the_command_line_count_in_paper_mode_too(tmp_path: Path) -> None:
    root = tracking_world.write(tmp_path / "root")
    rows = {}
    for reach in ("0.0", "1.0"):
        asked = ["--set", "method=paper", "--set", f"slam.frontend.localisation.reach_rel={reach}"]
        assert main(["evaluate", "localisation", str(root), *asked, "--output", str(tmp_path / reach)]) == 0
        rows[reach] = json.loads((tmp_path / reach / "report.json").read_text())
    at_face, at_centre = ([row["depth_bias_median_rel"] for row in rows[reach] if row["n"]] for reach in ("0.0", "1.0"))
    assert at_face  # Eq. 1 puts the nearest face where the centre should be
    assert all(face < centre for face, centre in zip(at_face, at_centre, strict=True))


def test_draws_of_the_tilt_count_together(tmp_path: Path) -> None:
    root = tracking_world.write(tmp_path / "root")
    found = {}
    for draws in ("1", "2"):
        asked = ["--draws", draws, "--output", str(tmp_path / draws)]
        assert main(["evaluate", "localisation", str(root), *asked]) == 0
        rows = json.loads((tmp_path / draws / "report.json").read_text())
        found[draws] = {(row["sequence"], row["range"]): row for row in rows if row["n"]}
    assert [2 * row["n"] for row in found["1"].values()] == [row["n"] for row in found["2"].values()]
    assert any(found["1"][key]["nees"] != row["nees"] for key, row in found["2"].items())


@pytest.mark.parametrize("asked", [["0"], ["2", "--class", "pedestrian"]])
def test_draws_that_there_are_not_are_refused(
    asked: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    root = tracking_world.write(tmp_path / "root")
    assert main(["evaluate", "localisation", str(root), "--draws", *asked, "--output", str(tmp_path / "out")]) == 2
    assert "--draws" in capsys.readouterr().err
