"""Cars placed by the front end against labels: of a world made here, and of KITTI tracking where it is at hand."""

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from birdslam.bench.tracking.localisation import (
    INSIDE_1_SIGMA,
    INSIDE_2_SIGMA,
    CarError,
    LocalisationRow,
    as_reported,
    match_cars,
    measure,
    summarise_ranges,
)
from birdslam.frontend import FrontEndConfig
from birdslam.geometry.camera import Camera
from birdslam.graph.graph_config import GraphConfig
from birdslam.graph.pose_graph import PoseGraph
from birdslam.graph.weights import WeightsConfig
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


def depth_error(errors: list[CarError], span: str) -> float:
    """The median of a range over all sequences."""
    (row,) = [row for row in summarise_ranges(errors) if row.sequence == "all" and row.range == span]
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
    errors = [CarError("a", k, 0, 20.0, e, float(e @ e), 0.0, 0.0) for k, e in enumerate(z)]
    errors.append(CarError("b", 0, 0, 45.0, np.array([-4.5, 0.2]), 9.0, math.pi, 0.0))
    rows = {(row.sequence, row.range): row for row in summarise_ranges(errors)}
    parts = "ego drives", "ego stands", "0-0.5 s", "0.5-2 s", "2-5 s", "5-inf s", "over 1.75 m", "chose none", "cut"
    assert list(rows) == [(s, r) for s in ("a", "b", "all", *parts) for r in ("0-15", "15-30", "30-50")]
    assert rows["a", "0-15"] == LocalisationRow(sequence="a", range="0-15", n=0)
    gauss = rows["a", "15-30"]
    assert gauss.inside_1_sigma == pytest.approx(0.683, abs=0.01)
    assert gauss.inside_2_sigma == pytest.approx(0.954, abs=0.01)
    assert gauss.inside_1_sigma_by_car == pytest.approx(0.683, abs=0.01)
    once = [CarError("c", k, int(k == 0), 20.0, z[0], 9.0 * (k > 0), 0.0, 0.0) for k in range(10)]
    (often,) = [row for row in summarise_ranges(once) if (row.sequence, row.range) == ("c", "15-30")]
    assert (often.inside_1_sigma, often.inside_1_sigma_by_car) == pytest.approx((0.1, 0.5))
    far = rows["all", "30-50"]
    assert (far.n, far.depth_error_median_rel, far.lateral_error_median_m) == (
        1,
        pytest.approx(0.1),
        pytest.approx(0.2),
    )
    assert far.depth_bias_median_rel == pytest.approx(-0.1)
    assert far.yaw_error_median_deg == pytest.approx(0.0, abs=1e-6)
    assert pytest.approx((2.2957, 6.1801), abs=1e-3) == (INSIDE_1_SIGMA, INSIDE_2_SIGMA)


def test_cut_cars_are_graded_as_planners_get_them_too() -> None:
    sequence, detections = world(12)
    log, graph = measure(sequence, detections, FrontEndConfig()), PoseGraph(GraphConfig(), WeightsConfig())
    estimates = [graph.optimise(record) for record in log]
    reported = as_reported(log, estimates)
    ids = {edge.vehicle for edge in log[-1].cv}
    of = {v.vehicle: estimates[-1].T_world_ego.between(v.T_world_vehicle) for v in estimates[-1].vehicles}
    assert {edge.vehicle: edge.T_ego_vehicle for edge in reported[-1].cv} == {k: of[k] for k in ids}
    errors = match_cars(sequence, reported)
    rows = {(row.sequence, row.range): row for row in summarise_ranges(errors, errors)}
    by_range = [rows["cut, graph", span] for span in ("0-15", "15-30", "30-50")]
    assert sum(row.n for row in by_range) == sum(error.cut for error in errors) > 0
    assert all(row.inside_1_sigma is None and row.nees is None for row in by_range)
    assert ("cut, graph", "0-15") not in {(row.sequence, row.range) for row in summarise_ranges(errors)}


def test_what_errors_are_made_of_is_told_apart() -> None:
    rng = np.random.default_rng(0)
    errors = []
    for name in "abcdefghijklmnopqrst":
        of_drive = rng.normal(0.0, 0.04)
        for car in range(20):
            of_car = of_drive + rng.normal(0.0, 0.03)
            for k in range(10):
                e = np.array([20.0 * (of_car + rng.normal(0.0, 0.02)), 0.0])
                errors.append(CarError(name, k, car, 20.0, e, 1.0, 0.0, 0.0, sigma_depth_m=2.0))
    (row,) = [row for row in summarise_ranges(errors) if (row.sequence, row.range) == ("all", "15-30")]
    assert row.depth_stated_rel == pytest.approx(0.1)
    assert row.within_cars_rel == pytest.approx(0.02 * math.sqrt(0.9), rel=0.05)
    assert row.between_cars_rel == pytest.approx(math.hypot(0.03, 0.02 / math.sqrt(10)), rel=0.1)
    assert row.between_sequences_rel == pytest.approx(0.04, rel=0.4)
    alone = [row for row in summarise_ranges(errors[:10]) if (row.sequence, row.range) == ("a", "15-30")]
    assert alone[0].between_cars_rel is None
    assert alone[0].between_sequences_rel is None


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
        asked = ["--mode", "paper", "--constant", f"slam.frontend.localisation.reach_rel={reach}"]
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
        movers = json.loads((tmp_path / draws / "movers.json").read_text())
        found[draws] = {(row["sequence"], row["range"]): row for row in rows if row["n"]}, movers
    (once, movers), (twice, of_two) = found["1"], found["2"]
    assert [2 * row["n"] for row in once.values()] == [row["n"] for row in twice.values()]
    assert [2 * row["standing"] + 2 * row["driving"] for row in movers] == [
        row["standing"] + row["driving"] for row in of_two
    ]
    assert any(once[key]["depth_rms_rel"] != row["depth_rms_rel"] for key, row in twice.items())


@pytest.mark.parametrize("asked", [["0"], ["2", "--class", "pedestrian"], ["2", "--tilt", "none"]])
def test_draws_that_there_are_not_are_refused(
    asked: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    root = tracking_world.write(tmp_path / "root")
    assert main(["evaluate", "localisation", str(root), "--draws", *asked, "--output", str(tmp_path / "out")]) == 2
    assert "--draws" in capsys.readouterr().err
