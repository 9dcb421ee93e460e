"""The benchmark on a small exact world: logs, matching, rows, ablations, tables and the command."""

from __future__ import annotations

import argparse
import dataclasses
import itertools
import json
import math
from pathlib import Path

import numpy as np
import pytest
from msgspec.structs import replace

from birdslam.bench.baselines.trajectories import Trajectories
from birdslam.bench.simulation.odometry import EXACT, SimulatedOdometry, SimulationConfig
from birdslam.bench.tracking import ablation, tables
from birdslam.bench.tracking.benchmark import (
    EGO,
    PAPER,
    Live,
    Row,
    Truth,
    make_log,
    methods,
    most_labelled,
    ours,
    run_trial,
    summarise,
    within,
)
from birdslam.bench.tracking.tables import Published, read_published
from birdslam.frontend import FrontEndConfig
from birdslam.geometry.camera import Camera
from birdslam.geometry.se2 import SE2
from birdslam.graph.weights import weighted
from birdslam.lanes.amodal.landmark_edges import StaticMapConfig
from birdslam.perception import Perception, Ready
from birdslam.runtime.cli.commands import parse
from birdslam.runtime.cli.evaluate.tracking import evaluate
from birdslam.runtime.configuration import Configuration, ConfigurationError, load
from birdslam.runtime.evaluation.tracking import PUBLISHED
from birdslam.runtime.evaluation.tracking_job import BY_EQ_1, frames_of
from birdslam.slam import SlamConfig
from birdslam.sources.kitti_tracking import TrackingSequence, open_tracking, read_detections
from birdslam.sources.recording import DatasetError
from birdslam.types import Measurements
from tests import tiny_networks as tiny
from tests import tracking_world
from tests.test_kitti_labels import with_right_camera

FRAMES = range(40)


@pytest.fixture(scope="module")
def sequence(tmp_path_factory: pytest.TempPathFactory) -> TrackingSequence:
    return open_tracking(tracking_world.write(tmp_path_factory.mktemp("tracking")), "0002")


@pytest.fixture(scope="module")
def published() -> Published:
    return read_published(PUBLISHED)


def log_of(
    sequence: TrackingSequence, root: Path, config: SimulationConfig, seed: int = 0, landmark_range_m: float = 20.0
) -> list[Measurements]:
    found = read_detections(root / "det_02_rrc", sequence.name, len(sequence))
    odometry = SimulatedOdometry(sequence.camera, sequence.camera_poses, config, np.random.default_rng(seed))
    return make_log(
        sequence,
        FRAMES,
        odometry,
        lambda frame, image: Ready(Perception(found[frame], None, {"detector": 0}, ())),
        None,
        FrontEndConfig(static_map=StaticMapConfig(landmark_range_m=landmark_range_m)),
    )


@pytest.fixture(scope="module")
def exact_log(sequence: TrackingSequence, tmp_path_factory: pytest.TempPathFactory) -> list[Measurements]:
    return log_of(sequence, tracking_world.write(tmp_path_factory.mktemp("log")), EXACT)


def test_an_exact_world_has_hardly_any_error(sequence: TrackingSequence, exact_log: list[Measurements]) -> None:
    trial = run_trial(sequence, exact_log, methods(SlamConfig()))
    assert trial.frames_labelled[EGO] == len(FRAMES)
    for name in ("birdslam", "nair", "cubeslam", "namdev"):
        ego = trial.errors[name][EGO]
        assert ego.ate_m < 0.05, name
    for car in ("3", "7", "9"):
        errors = trial.errors["birdslam"][car]
        assert errors.ate_m < 0.8, car
        assert errors.frames >= trial.frames_labelled[car] - 4  # a track is confirmed by its third sight


def test_frames_may_start_anywhere(sequence: TrackingSequence, exact_log: list[Measurements]) -> None:
    truth = Truth.of(sequence, exact_log[10:])
    assert truth.ego[10].x_m == 0.0
    assert min(truth.ego) == 10
    with pytest.raises(ValueError, match="no frames"):
        Truth.of(sequence, [])


def test_rows_are_medians_over_seeds(sequence: TrackingSequence, tmp_path: Path) -> None:
    root = tracking_world.write(tmp_path)
    chosen = {"birdslam": ours(SlamConfig())}
    trials = [run_trial(sequence, log_of(sequence, root, SimulationConfig(), seed), chosen) for seed in range(3)]
    rows = summarise("0002", trials, ["1"], "simulate", "rrc")
    ego = next(row for row in rows if row.body == EGO)
    errors = [trial.errors["birdslam"][EGO] for trial in trials]
    each = [e.ate_m for e in errors if e is not None]
    assert ego.ate_m == pytest.approx(np.median(each))
    assert ego.ate_m_spread == pytest.approx(np.std(each))
    assert (ego.seeds, ego.odometry, ego.detections) == (3, "simulate", "rrc")
    assert {row.body for row in rows} == {EGO, "3", "7", "9"}


# --- the ablations: each is the same method on a log without those edges, and its name is what it leaves out ---

BASES = (PAPER, ours(SlamConfig()))
of_both_graphs = pytest.mark.parametrize("base", BASES, ids=["paper", "birdslam"])


@pytest.fixture(scope="module")
def noisy_log(sequence: TrackingSequence, tmp_path_factory: pytest.TempPathFactory) -> list[Measurements]:
    """With landmarks beyond every threshold of Table 4."""
    root = tracking_world.write(tmp_path_factory.mktemp("noisy"))
    return log_of(sequence, root, SimulationConfig(), 1, ablation.MAX_LANDMARK_DISTANCE_M)


def test_a_log_with_far_landmarks_has_the_nearer_one_in_it(
    sequence: TrackingSequence, noisy_log: list[Measurements], tmp_path: Path
) -> None:
    nearer = log_of(sequence, tracking_world.write(tmp_path), SimulationConfig(), 1, 12.0)
    assert within(noisy_log, 12.0) == nearer
    assert sum(len(m.cp) for m in nearer) < 0.8 * sum(len(m.cp) for m in noisy_log)


def shift_m(one: Trajectories, other: Trajectories) -> tuple[float, float]:
    """How far the ego, and a vehicle, of one result is at the most from that of the other."""
    pairs = [(pose, other.vehicles[car][k]) for car, poses in one.vehicles.items() for k, pose in poses.items()]
    far = [[a.between(b) for a, b in both] for both in ([(one.ego[k], other.ego[k]) for k in one.ego], pairs)]
    ego, cars = (max(math.hypot(T.x_m, T.y_m) for T in steps) for steps in far)
    return ego, cars


@of_both_graphs
def test_every_row_of_tables_3_and_4_has_a_variant(
    sequence: TrackingSequence, noisy_log: list[Measurements], base: Live
) -> None:
    variants = ablation.constraint_variants(base) | ablation.landmark_variants(base)
    assert tuple(variants) == tables.CONSTRAINTS + tables.LANDMARKS
    assert variants["all"] == base
    trial = run_trial(sequence, noisy_log, variants)
    ates = {name: [e and e.ate_m for e in (errors[EGO], errors["3"])] for name, errors in trial.errors.items()}
    assert all(ate_m is not None and 0.0 < ate_m < 20.0 for row in ates.values() for ate_m in row)
    same = {name for name, row in ates.items() if row == ates["all"]}
    assert same == {"all", "cp_medium", "depth_20"}  # whose numbers are the method's own; all others change something


@of_both_graphs
def test_without_cp_and_vv_are_a_log_without_them(
    sequence: TrackingSequence, noisy_log: list[Measurements], base: Live
) -> None:
    variants = ablation.constraint_variants(base)
    no_cp, no_vv = ([replace(m, **{name: ()}) for m in noisy_log] for name in ("cp", "vv"))
    assert variants["without_cp"].run(noisy_log, sequence.camera) == base.run(no_cp, sequence.camera)
    predicted = dataclasses.replace(base, graph=replace(base.graph, constant_velocity=False))
    assert variants["without_vv"].run(noisy_log, sequence.camera) == predicted.run(no_vv, sequence.camera)


@of_both_graphs
def test_without_cc_the_ego_hardly_follows_its_odometry(
    sequence: TrackingSequence, noisy_log: list[Measurements], base: Live
) -> None:
    """With all, but for landmarks, that would hold it; without CC, they and the vehicles are all it follows.

    Vehicles move the ego here, which they don't by default.
    """
    base = dataclasses.replace(base, graph=replace(base.graph, vehicles_move_ego=True))
    aside = SE2(0.0, 0.05, 0.0)
    variants, drifts_m = ablation.constraint_variants(base), {}
    for name, log in (("all", [replace(m, cp=()) for m in noisy_log]), ("without_cc", noisy_log)):
        drifting = [
            m if m.cc is None or m.frame_id < 20 else replace(m, cc=replace(m.cc, T_from_to=m.cc.T_from_to @ aside))
            for m in log
        ]
        drifts_m[name] = shift_m(*(variants[name].run(one, sequence.camera) for one in (log, drifting)))[0]
    assert drifts_m["all"] > 0.9  # of the 1 m of 20 frames
    assert drifts_m["without_cc"] < 0.5 * drifts_m["all"]


@of_both_graphs
def test_without_cv_a_vehicle_hardly_follows_one_detection(
    sequence: TrackingSequence, noisy_log: list[Measurements], base: Live
) -> None:
    log = list(noisy_log)
    off = SE2(0.3)
    log[25] = replace(log[25], cv=tuple(replace(e, T_ego_vehicle=off @ e.T_ego_vehicle) for e in log[25].cv))
    follows_m = {
        name: shift_m(*(method.run(one, sequence.camera) for one in (noisy_log, log)))[1]
        for name, method in ablation.constraint_variants(base).items()
        if name in ("all", "without_cv")
    }
    assert follows_m["all"] > 0.1
    assert follows_m["without_cv"] < 0.8 * follows_m["all"]


@of_both_graphs
def test_a_depth_threshold_is_a_log_without_landmarks_beyond_it(
    sequence: TrackingSequence, noisy_log: list[Measurements], base: Live
) -> None:
    variants = ablation.landmark_variants(base)
    results = []
    for name, depth_m in ablation.DEPTHS_M.items():
        far_m = math.inf if depth_m is None else depth_m
        near = [replace(m, cp=tuple(edge for edge in m.cp if edge.x_m <= far_m)) for m in noisy_log]
        results.append(variants[name].run(noisy_log, sequence.camera))
        assert results[-1] == variants["depth_none"].run(near, sequence.camera), name
    assert all(one != other for one, other in itertools.combinations(results, 2))


def test_the_weight_of_landmarks_is_against_that_of_the_odometry(noisy_log: list[Measurements]) -> None:
    paper, own = (ablation.landmark_variants(base) for base in BASES)
    record = next(m for m in noisy_log if m.cp and m.cc)
    for name, factor in ablation.CP_WEIGHTS.items():
        believed = weighted(record, paper[name].weights)
        assert believed.cp[0].cov[0] * factor == pytest.approx(believed.cc.cov[0])
        assert own[name].cp_inflation == pytest.approx(1.0 / factor)


def test_before_lanes_is_a_log_without_landmarks(sequence: TrackingSequence, noisy_log: list[Measurements]) -> None:
    variants = ablation.lane_variants()
    assert tuple(variants) == tables.LANES
    before, after = (method.run(noisy_log, sequence.camera) for method in variants.values())
    assert before == variants["after_lanes"].run([replace(m, cp=()) for m in noisy_log], sequence.camera)
    assert shift_m(before, after)[0] > 0.1


def test_the_papers_frames_are_those_with_most_labels_of_its_cars(sequence: TrackingSequence) -> None:
    assert most_labelled(sequence, (), 10) == range(10)
    seen = sorted(label.frame for label in sequence.labels if label.track == 3)
    whole = most_labelled(sequence, (3,), len(seen))
    assert sum(frame in whole for frame in seen) == max(
        sum(start <= frame < start + len(seen) for frame in seen) for start in range(len(sequence) - len(seen) + 1)
    )
    late = dataclasses.replace(sequence, labels=tuple(label for label in sequence.labels if label.frame >= 20))
    assert most_labelled(late, (3,), 5) == range(20, 25)
    assert most_labelled(sequence, (3,), 10_000) == range(len(sequence))


# --- the simulated odometry ---


def test_the_simulated_odometry_errs_as_it_says() -> None:
    camera = Camera(1242, 375, 721.5, 721.5, 609.6, 172.9, height_m=1.65)
    poses = np.tile(np.eye(4), (400, 1, 1))
    poses[:, 2, 3] = 1.2 * np.arange(400)
    config = SimulationConfig()
    odometry = SimulatedOdometry(camera, poses, config, np.random.default_rng(0))
    motions = [odometry.estimate(None, k, k, np.zeros((0, 4))) for k in range(400)]
    assert motions[0] is None
    steps = np.array([[m.T_prev_curr.x_m, m.T_prev_curr.y_m, m.T_prev_curr.yaw_rad] for m in motions if m])
    sigma = np.sqrt(np.diag(motions[1].cov))
    ratio = (steps - [1.2, 0.0, 0.0]).std(axis=0) / sigma
    assert (ratio > 0.6).all()
    assert (ratio < 1.4).all()


def test_a_standing_car_holds_its_pose() -> None:
    camera = Camera(1242, 375, 721.5, 721.5, 609.6, 172.9, height_m=1.65)
    poses = np.tile(np.eye(4), (5, 1, 1))
    poses[:, 2, 3] = [0.0, 0.001, 0.0, 0.002, 0.001]
    odometry = SimulatedOdometry(camera, poses, SimulationConfig(), np.random.default_rng(0))
    for k in range(5):
        motion = odometry.estimate(None, k, k, np.zeros((0, 4)))
        if motion is not None:
            assert motion.standstill
            assert motion.T_prev_curr.x_m == 0.0


# --- the paper's numbers ---


def test_published_is_complete(published: Published) -> None:
    def cells(table: tables.PublishedTable) -> list[int]:
        return [sum(len(bodies) for bodies in column.values()) for column in table.ate_m.values()]

    assert [len(paper.cars) for paper in published.sequences.values()] == [1, 2, 1, 1, 1, 3, 2]
    assert [paper.frames for paper in published.sequences.values()] == [67, 123, 149, 101, 249, 141, 414]
    assert list(published.table1.ate_m) == list(published.table2.ate_m) == list(tables.METHOD_TITLES)
    assert cells(published.table1) == [11, 11, 11, 3, 11]
    assert cells(published.table2) == [7, 7, 7, 1, 7]
    assert tuple(published.table3.ate_m) == tables.CONSTRAINTS
    assert tuple(published.table4.ate_m) == tables.LANDMARKS
    assert set(cells(published.table3)) == set(cells(published.table4)) == {18}
    assert tuple(published.table5.ate_m) == tables.LANES
    assert cells(published.table5) == [9, 9]
    for name, average in published.table5.average_m.items():
        numbers = [n for bodies in published.table5.ate_m[name].values() for n in bodies.values()]
        assert np.mean(numbers) == pytest.approx(average, abs=0.02)


def test_table_1_and_table_3_agree_on_the_same_method(published: Published) -> None:
    for sequence, cars in published.table1.ate_m["paper"].items():
        for car, ate_m in cars.items():
            assert published.table3.ate_m["all"][sequence][car] == ate_m
            assert published.table4.ate_m["cp_medium"][sequence][car] == ate_m


def test_a_broken_file_of_published_numbers_is_named(tmp_path: Path) -> None:
    path = tmp_path / "published.toml"
    with pytest.raises(DatasetError, match=r"published\.toml: can't be read"):
        read_published(path)
    path.write_text("sequences = 3\n")
    with pytest.raises(DatasetError, match=r"published\.toml: .*sequences"):
        read_published(path)


def test_tables_have_every_cell_of_the_paper(published: Published) -> None:
    row = Row(
        sequence="0002",
        method="birdslam",
        body="1",
        frames=30,
        frames_labelled=42,
        seeds=2,
        ate_m=1.234,
        ate_m_spread=0.0,
        odometry="simulate",
    )
    text = tables.methods_table([row], published, ego=False)
    assert "| 0002 | 1 | simulated odometry | 30 of 42 | 5.01 | 6.35 | 6.02 | - | 2.09 | 1.23 ± 0.00 |" in text
    assert "| 0020 | 122 |  |  | 12.86 |" in text
    assert text.count("\n") == 2 + 11 + 1
    seen = replace(row, odometry="images", ate_m=1.5)
    both = tables.methods_table([row, seen], published, ego=False)
    assert "| 0002 | 1 | images | 30 of 42 | 5.01 | 6.35 | 6.02 | - | 2.09 | 1.50 ± 0.00 |" in both
    assert both.count("\n") == 2 + 11 + 1 + 2  # a row and a mean more
    cut = tables.methods_table([replace(row, unconverged=1), seen], published, ego=False)
    assert "| 2.09 | 1.23 ± 0.00 \\* |" in cut  # the batch of one seed ended short of its minimum
    assert "| 2.09 | 1.50 ± 0.00 |" in cut
    ego = tables.methods_table([], published, ego=True)
    assert ego.count("\n") == 2 + 7 + 1
    for columns, table in ((tables.CONSTRAINTS, published.table3), (tables.LANDMARKS, published.table4)):
        assert tables.variants_table([], published, table, columns).count("\n") == 2 + 18 + 1


# --- the command ---


def options(*arguments: str) -> argparse.Namespace:
    return parse(["evaluate", "tracking", *arguments])


def test_the_command_writes_its_report(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    root, out = tracking_world.write(tmp_path / "root"), tmp_path / "out"
    asked = options(str(root), "--frames", "0:12", "--seeds", "1", "--jobs", "1", "--output", str(out))
    assert evaluate(asked, Configuration()) == 0
    rows = json.loads((out / "report.json").read_text())
    ours_ = {row["body"]: row for row in rows if row["method"] == "birdslam"}
    assert ours_["ego"]["ate_m"] < 1.0
    assert ours_["ego"]["frames"] == 12
    assert ours_["3"]["sequence"] == "0002"
    assert {row["method"] for row in rows} == {*methods(SlamConfig()), *BY_EQ_1}
    report = (out / "report.md").read_text()
    for number in range(1, 6):
        assert f"## Table {number}" in report
    assert "SIMULATED" in report
    assert "sequence 0002: 12 frames" in capsys.readouterr().err
    names = [*ablation.idea_variants(), *ablation.placed_variants(PAPER)]
    ideas = {(row["method"], row["body"]): row["ate_m"] for row in json.loads((out / "ideas.json").read_text())}
    assert {method for method, _ in ideas} == {f"ideas/{name}" for name in names}
    assert all(f"| {name} |" in report for name in names)
    # The tracking world's car 3 is placed on its centre by ours, on its rear by the paper's Eq. 1
    assert ideas["ideas/vehicles placed by measured ground and size", "3"] < ideas["ideas/nothing (the paper)", "3"]
    found = {row["method"] for row in json.loads((out / "ablation.json").read_text())}
    assert found == {f"{m}/{v}" for m in ("paper", "birdslam") for v in tables.CONSTRAINTS + tables.LANDMARKS} | set(
        tables.LANES
    )


def test_a_sequence_with_images_is_driven_by_them_too(tmp_path: Path) -> None:
    root, out = with_right_camera(tmp_path / "root", frames=6), tmp_path / "out"
    never = tiny.constant(tmp_path / "net.onnx", (1, 3, 64, 64), np.zeros((1, 84, 6), np.float32))
    never.with_suffix(".toml").write_text(tiny.DETECTOR.replace("classes = 2", "classes = 1"))
    without = {"models.shipped": False}
    asked = [*(str(root), "--frames", "0:6", "--seeds", "1", "--jobs", "1", "--output", str(out))]
    with pytest.raises(ConfigurationError, match="need a detector"):
        evaluate(options(*asked), load(None, without))
    configuration = load(None, without | {"models.detector.path": str(never)})
    assert evaluate(options(*asked), configuration) == 0
    rows = json.loads((out / "report.json").read_text())
    assert {(row["odometry"], row["detections"]) for row in rows} == {("simulate", "rrc"), ("images", "network")}
    report = (out / "report.md").read_text()
    assert "| 0002 | ego | images | 6 of 6 |" in report
    assert "| 0002 | ego | simulated odometry | 6 of 6 |" in report


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--sequences", "0007"], "no 0007"),
        (["--frames", "30:10"], "expected all, paper or A:B"),
        (["--frames", "x"], "expected all, paper or A:B"),
        (["--seeds", "0"], "--seeds 0"),
    ],
)
def test_a_mistake_is_named(tmp_path: Path, arguments: list[str], said: str) -> None:
    root = tracking_world.write(tmp_path / "root")
    asked = options(str(root), *arguments, "--jobs", "1", "--output", str(tmp_path / "out"))
    with pytest.raises((ConfigurationError, DatasetError), match=said):
        evaluate(asked, Configuration())


def test_the_papers_frames_are_the_first(sequence: TrackingSequence, published: Published) -> None:
    assert frames_of("paper", sequence, published) == range(40)  # as many as there are of its 67
    assert frames_of("5:", sequence, published) == range(5, 40)
