"""What each edge of the graph is worth: the ego's and vehicles' errors with each left out, alone, halved and doubled.

    python -m perf edges --logs DIR [--model ROLE=PATH ...] [--clips 0005,0002] [--seeds 3] [--draws 20] [--output FILE]

Logs of images are recorded once by the whole front end and kept in DIR; simulated ones are made anew. ATE in m, nothing
aligned; NEES over its degrees of freedom, the ego's in the world, also beside the error of the true poses' axes, a
vehicle's in the ego's frame. Vehicles are those labelled in five frames or more; 00 and 06 begin where their true poses
are no longer interpolated.
"""

from __future__ import annotations

import math
from argparse import ArgumentParser, Namespace
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import msgspec
import numpy as np
from numpy.typing import NDArray

from birdslam.bench.baselines.trajectories import LiveTrajectories, Trajectories
from birdslam.bench.ego.motion_consistency import moved_by_turn
from birdslam.bench.ego.truth_quality import AXES_SIGMA_RAD
from birdslam.bench.figures import markdown
from birdslam.bench.simulation.edge_statistics import EdgeStatistics, edge_statistics
from birdslam.bench.simulation.landmark_errors import LandmarkErrors, landmark_errors
from birdslam.bench.simulation.odometry import SimulatedOdometry, SimulationConfig
from birdslam.bench.tracking.benchmark import LEAST_FRAMES, Live, Truth, inflated, make_log, ours
from birdslam.bench.tracking.localisation import CAMERA_OF_BOXES
from birdslam.bench.tracking.metrics import path_errors
from birdslam.geometry.arrays import Floats
from birdslam.geometry.camera import Camera
from birdslam.geometry.se2 import SE2
from birdslam.graph.factors.factor import Factor
from birdslam.graph.factors.standard import standard_factors
from birdslam.graph.pose_graph import PoseGraph
from birdslam.paper import NO_GATE
from birdslam.perception import Pending, Perception, Ready
from birdslam.perf.graph.edges_table import left_out, nees_spread, table
from birdslam.perf.reporting.arguments import add_data, benchmark_parser
from birdslam.perf.reporting.figures import write_json
from birdslam.runtime.batch.offline import pipeline
from birdslam.runtime.cli.arguments import add_config, add_settings
from birdslam.runtime.configuration import Configuration
from birdslam.runtime.nodes.sources import open_recorded, recording_uri
from birdslam.runtime.options import configuration_of
from birdslam.slam import SlamConfig
from birdslam.sources.kitti_tracking import open_tracking, read_detections
from birdslam.sources.opening import open_recording
from birdslam.trajectory import as_poses, inverse, mount_pose, split_pose
from birdslam.types import LandmarkEdge, LandmarkKind, Measurements
from birdslam.vehicles.rts_smoother import RtsSmoother, SmootherConfig

label = "what each edge of the graph is worth, on images and on simulated drives"

TRACKING = "kitti_tracking/training"
CLIPS = {  # folder, and how many frames are left out at its beginning
    "0005": (f"{TRACKING}/image_03/0005", 0),
    "0002": (f"{TRACKING}/image_02/0002", 0),
    "raw": ("kitti_raw_clip", 1),
    "00": ("kitti_odometry/sequences/00", 13),
    "06": ("kitti_odometry/sequences/06", 11),
}
SIMULATED = ("0002", "0003", "0005", "0018")  # sequences whose true poses and boxes simulated drives take
EGO_DIMENSIONS, PLACE = 3, 2
FIRST_DRAW = 100  # its seed: none of the table's
SURELY, VEHICLE_IDS = 0.95, 1 << 36  # a vehicle stands; its number among landmarks
Change = Callable[[Measurements], Measurements]


@dataclass(frozen=True)
class Variant:
    """The default but for a change of the graph, or of each record, or with factors of one's own and their records."""

    live: Live
    change: Change = lambda m: m
    factors: Callable[[], Sequence[Factor]] = tuple
    records: Callable[[Measurements], Sequence[object]] = lambda m: ()


def variants() -> dict[str, Variant]:
    """All that are compared; the first is the default."""
    base = ours(SlamConfig())

    def graph(**fields: object) -> Variant:
        return Variant(replace(base, graph=msgspec.structs.replace(base.graph, **fields)))

    def out(*edges: str) -> Variant:
        return Variant(replace(base, weights=msgspec.structs.replace(base.weights, leave_out=("vv", "lanes", *edges))))

    moved = graph(vehicles_move_ego=True)
    with_lanes = Variant(replace(base, weights=msgspec.structs.replace(base.weights, leave_out=("vv",))))
    gates = {"detection_gate_sigma": NO_GATE, "landmark_gate_sigma": NO_GATE}
    bare = {"correlation_length_m": 0.0, "front_back_ambiguity": False, "lasting_share": 0.0}
    found = {
        "default": Variant(base),
        "vehicles move the ego": moved,
        "without CC": out("cc"),
        "without CP: CC alone": out("cp"),
        "with lanes": with_lanes,
        "CC and lanes": replace(with_lanes, change=_without_points),
        "CC and vehicles": replace(moved, live=replace(moved.live, weights=out("cp").live.weights)),
        "VV beside constant velocity": Variant(
            replace(base, weights=msgspec.structs.replace(base.weights, leave_out=("lanes",)))
        ),
        "VV alone, as in Eq. 6": Variant(
            replace(
                base,
                graph=msgspec.structs.replace(base.graph, constant_velocity=False),
                weights=msgspec.structs.replace(base.weights, leave_out=("lanes",)),
            )
        ),
        "standing vehicles as landmarks": Variant(base, _with_standing),
        "landmarks share no error": Variant(base, _sharing_nothing),
        "errors of vehicles' edges do not last": graph(lasting_share=0.0),
        "without gates": graph(**gates),
        "gates alone": replace(graph(**bare), change=_sharing_nothing),
    }
    for name, field in (("CC", "cc"), ("CP", "cp"), ("CV", "cv")):
        for word, factor in (("halved", 2.0), ("doubled", 0.5)):
            found[f"{name} {word}"] = Variant(base, _reweighed(field, factor))
    return found


def _without_points(m: Measurements) -> Measurements:
    return msgspec.structs.replace(m, cp=tuple(e for e in m.cp if e.kind is LandmarkKind.LANE_STATION))


def _with_standing(m: Measurements) -> Measurements:
    """Vehicles that surely stand as landmarks beside those of the road, where their CV edges see them."""
    seen = [
        LandmarkEdge(
            landmark=VEHICLE_IDS + e.vehicle,
            frame=e.frame,
            x_m=e.T_ego_vehicle.x_m,
            y_m=e.T_ego_vehicle.y_m,
            cov=(e.cov[0], e.cov[1], e.cov[3], e.cov[4]),
        )
        for e in m.cv
        if e.standing > SURELY
    ]
    return msgspec.structs.replace(m, cp=(*m.cp, *seen))


def _sharing_nothing(m: Measurements) -> Measurements:
    """What landmarks share as if it were each one's own."""
    return msgspec.structs.replace(m, cp=tuple(msgspec.structs.replace(e, shared=None) for e in m.cp))


def _reweighed(field: str, factor: float) -> Change:
    """Multiplies the covariances of one type of edge, which divides its information."""

    def change(m: Measurements) -> Measurements:
        edges = getattr(m, field)
        if not edges:
            return m
        wider = [
            inflated(e, factor)
            if isinstance(e, LandmarkEdge)
            else msgspec.structs.replace(e, cov=tuple(factor * c for c in e.cov))
            for e in (edges if isinstance(edges, tuple) else (edges,))
        ]
        return msgspec.structs.replace(m, **{field: tuple(wider) if isinstance(edges, tuple) else wider[0]})

    return change


# --- logs and truth ---


@dataclass(frozen=True)
class Case:
    """A log with the ego's true poses in the world of its first frame and, of tracking sequences, labels.

    `axes_rad` is 1-sigma of the angle between the true poses' axes and their way.
    """

    name: str
    log: list[Measurements]
    ego: dict[int, SE2]
    camera: Camera
    truth: Truth | None
    axes_rad: float = 0.0


def recorded(name: str, data: Path, logs: Path, configuration: Configuration) -> Case:
    """A clip's log of its images: the one in `logs`, or recorded anew and put there."""
    folder, left_out = CLIPS[name]
    log = log_of(str(data / folder), logs / f"{name}.log", configuration)[left_out:]
    recording = open_recording(f"kitti:{data / folder}")
    if folder.startswith(TRACKING):
        truth = Truth.of(open_tracking(data / TRACKING, name), log)
        return Case(name, log, truth.ego, recording.camera, truth, AXES_SIGMA_RAD)
    poses = recording.truth_poses()
    assert poses is not None, name
    T_cam0_cam, mount = recording.T_cam0_cam(), mount_pose(recording.camera.ground)
    camera = inverse(T_cam0_cam) @ as_poses(poses) @ T_cam0_cam
    first = inverse(camera[log[0].frame_id])
    ego = {m.frame_id: split_pose(mount @ first @ camera[m.frame_id] @ inverse(mount))[0] for m in log}
    return Case(name, log, ego, recording.camera, None, AXES_SIGMA_RAD)


def log_of(drive: str, path: Path, configuration: Configuration) -> list[Measurements]:
    """A drive's log: the one at `path`, or recorded anew and put there."""
    if not path.exists():
        source = configuration.source
        with pipeline(configuration) as run_through:
            recording = open_recorded(recording_uri(drive), configuration.camera, source.stride, source.topics)
            log = [record for record in run_through(recording) if isinstance(record, Measurements)]
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(msgspec.msgpack.encode(log, enc_hook=_plain))
    return msgspec.msgpack.decode(path.read_bytes(), type=list[Measurements])


def _plain(value: object) -> object:
    """A number of numpy as Python's own."""
    if isinstance(value, np.generic):
        return value.item()
    raise TypeError(f"no number: {value!r}")


def simulated(name: str, data: Path, seed: int) -> Case:
    """A drive by true poses with simulated odometry and the boxes at hand."""
    sequence = open_tracking(data / TRACKING, name, CAMERA_OF_BOXES)
    found = read_detections(data / TRACKING / "det_02_rrc", name, len(sequence))
    rng = np.random.default_rng([seed, *name.encode()])
    odometry = SimulatedOdometry(sequence.camera, sequence.camera_poses, SimulationConfig(), rng)

    def given(frame: int, image: NDArray[np.uint8]) -> Pending:
        return Ready(Perception(found[frame], None, {"detector": 0}, ()))

    frames = range(min(150, len(sequence)))
    log = make_log(sequence, frames, odometry, given, None, SlamConfig().frontend)
    truth = Truth.of(sequence, log)
    return Case(f"{name}, seed {seed}", log, truth.ego, sequence.camera, truth)


# --- grades ---


def grade(variant: Variant, case: Case) -> dict[str, float]:
    """ATE of ego and cars (mean, live and final; each car's as "live 31") and NEES of both."""
    settings = variant.live.graph, variant.live.weights
    graph, live = PoseGraph(*settings, factors=[*standard_factors(*settings), *variant.factors()]), LiveTrajectories()
    smoother = RtsSmoother(SmootherConfig())
    of_ego, of_ego_beside_axes, of_cars = [], [], []
    for record in case.log:
        m = variant.change(record)
        estimate = graph.optimise(m, variant.records(m))
        live.add(estimate)
        smoother.add(m, estimate)
        error = estimate.T_world_ego.between(case.ego[m.frame_id]).log()
        if estimate.epoch == 0 and m is not case.log[0]:
            cov = np.reshape(estimate.cov, (3, 3))
            of_ego.append(_nees(np.asarray(error), cov))
            aside = case.axes_rad * moved_by_turn(estimate.T_world_ego)
            of_ego_beside_axes.append(_nees(np.asarray(error), cov + np.outer(aside, aside)))
        if case.truth is not None:
            of_cars += _nees_of_cars(graph, m, case.truth)
    ego = path_errors(case.ego, live.result.ego)
    assert ego is not None
    out = {"ego": ego.ate_m, "NEES of the ego": float(np.mean(of_ego)) / EGO_DIMENSIONS}
    if case.axes_rad:
        out["beside the truth's axes"] = float(np.mean(of_ego_beside_axes)) / EGO_DIMENSIONS
    if case.truth is None:
        return out
    final = Trajectories(ego=live.result.ego)
    for (epoch, vehicle), way in smoother.smooth().items():
        for frame, pose in way.items():
            final.put_vehicle(vehicle, frame, live.T_first_world[epoch] @ pose)
    for what, result in (("live", live.result), ("final", final)):
        errors = case.truth.errors(result)
        cars = {k: e.ate_m for k, e in errors.items() if k != "ego" and e is not None and e.frames >= LEAST_FRAMES}
        out |= {f"{what} {car}": ate_m for car, ate_m in cars.items()}
        out[f"cars, {what}"] = float(np.mean([*cars.values()])) if cars else math.nan
    out["NEES of cars"] = float(np.mean(of_cars)) / PLACE if of_cars else math.nan
    return out


def nees_of_draws(data: Path, draws: int) -> list[float]:
    """The default's NEES of the ego in `draws` simulated drives of each sequence: what one drive of many may have."""
    default = variants()["default"]
    seeds = range(FIRST_DRAW, FIRST_DRAW + draws)
    return [grade(default, simulated(name, data, seed))["NEES of the ego"] for name in SIMULATED for seed in seeds]


def _nees_of_cars(graph: PoseGraph, m: Measurements, truth: Truth) -> list[float]:
    estimated, out = graph.vehicles_in_ego(), []
    for car, vehicle in truth.matches[m.frame_id].items():
        goal = truth.vehicles[car].get(m.frame_id)
        if vehicle in estimated and goal is not None:
            T_ego_vehicle, cov = estimated[vehicle]
            there = truth.ego[m.frame_id].between(goal)
            error = np.array([T_ego_vehicle.x_m - there.x_m, T_ego_vehicle.y_m - there.y_m])
            out.append(_nees(error, cov[:2, :2]))
    return out


def _nees(error: Floats, cov: Floats) -> float:
    return float(error @ np.linalg.solve(cov + 1e-9 * np.eye(len(cov)), error))


# --- the statistics ---


def statistics_table(cases: Sequence[Case]) -> str:
    """A row for each log: what its CC and CP edges are worth, and what its landmarks err by."""
    of_edges, of_landmarks = EdgeStatistics.__struct_fields__, LandmarkErrors.__struct_fields__
    lines = []
    for case in cases:
        edges, landmarks = edge_statistics(case.log, case.ego), landmark_errors(case.log, case.ego, case.camera)
        cells = [(edges, name) for name in of_edges] + [(landmarks, name) for name in of_landmarks]
        lines.append([case.name, *("-" if of is None else f"{getattr(of, name):.3g}" for of, name in cells)])
    return markdown(["log", *(name.replace("_", " ") for name in (*of_edges, *of_landmarks))], lines)


def case_parser(name: str, what: str) -> ArgumentParser:
    """Which cases: recorded logs, which a configuration made, and simulated drives."""
    parser = benchmark_parser(name, what)
    add_data(parser)
    add_config(parser)
    parser.add_argument("--model", action="append", default=[], metavar="ROLE=PATH", help="that looks at the images")
    add_settings(parser)
    parser.add_argument("--logs", type=Path, required=True, help="where recorded logs are kept")
    parser.add_argument("--clips", default=",".join(CLIPS), help="with images, a list; none where empty")
    parser.add_argument("--seeds", type=int, default=3, help="of each simulated drive")
    return parser


def cases_of(options: Namespace, configuration: Configuration) -> tuple[list[Case], list[Case]]:
    """Recorded ones, and simulated ones."""
    clips = [clip for clip in options.clips.split(",") if clip]
    return (
        [recorded(clip, options.data, options.logs, configuration) for clip in clips],
        [simulated(name, options.data, seed) for name in SIMULATED for seed in range(options.seeds)],
    )


def run(arguments: list[str]) -> None:
    parser = case_parser("edges", label)
    parser.add_argument("--draws", type=int, default=20, help="of each simulated drive, for the spread of the NEES")
    options = parser.parse_args(arguments)
    output, options.output = options.output, None  # of the benchmark, not of a drive
    cases, drives = cases_of(options, configuration_of(options))
    for case in cases:
        kinds = [edge.kind for m in case.log for edge in m.cp]
        lanes = sum(kind is LandmarkKind.LANE_STATION for kind in kinds)
        print(
            f"{case.name}: {len(case.log)} frames, {len(kinds) - lanes} sights of points, {lanes} of lanes", flush=True
        )
    print(statistics_table([*cases, *drives]), flush=True)
    grades: dict[str, dict[str, dict[str, float]]] = {}
    for name, variant in variants().items():
        grades[name] = {case.name: grade(variant, case) for case in [*cases, *drives]}
        of = grades[name]
        print(f"{name:30} " + "  ".join(f"{case.name} {of[case.name]['ego']:.2f}" for case in cases), flush=True)
    drawn = {f"simulated {name}": [d.name for d in drives if d.name.startswith(name)] for name in SIMULATED if drives}
    print(table(grades, drawn))
    left = {what: left_out(grades, what) for what in ("ego", "cars, live", "cars, final")}
    for what, lines in left.items():
        print(f"\nBest on the others, {what}, left one out:", *lines, sep="\n  ")
    spread = nees_spread(nees_of_draws(options.data, options.draws)) if options.draws else ""
    print(f"\n{spread}")
    if output is not None:
        kept = {"statistics": statistics_table([*cases, *drives]), "table": table(grades, drawn), "left": left}
        kept["nees"] = spread
        write_json(output, kept | {"grades": grades})
