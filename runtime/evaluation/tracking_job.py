"""One sequence of KITTI tracking in one process: methods, ablations, timings and picture."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import msgspec
import numpy as np
from numpy.typing import NDArray

from birdslam.bench.baselines import batch_se3, nair
from birdslam.bench.baselines.posegraph3 import solve_batch
from birdslam.bench.baselines.trajectories import Method, Trajectories
from birdslam.bench.simulation.odometry import EXACT, SimulatedOdometry, SimulationConfig
from birdslam.bench.tracking import ablation
from birdslam.bench.tracking.benchmark import (
    PAPER,
    Row,
    Trial,
    Truth,
    make_log,
    methods,
    most_labelled,
    ours,
    run_trial,
    summarise,
    within,
)
from birdslam.bench.tracking.localisation import CAMERA_OF_BOXES
from birdslam.bench.tracking.movers import movers_row
from birdslam.bench.tracking.picture import draw_sequence
from birdslam.bench.tracking.relative_nees import nees_rows, over_seeds
from birdslam.bench.tracking.report import BatchTiming, Outcome, Timing
from birdslam.bench.tracking.reported import motion_row, range_rows, sights
from birdslam.bench.tracking.tables import Published
from birdslam.frontend import EgoMotion, FrontEndConfig, Pending
from birdslam.graph.pose_graph import PoseGraph
from birdslam.paper import PAPER as AS_PUBLISHED
from birdslam.perception import ModelSpec, Perception, Ready
from birdslam.runtime.configuration import Configuration, ConfigurationError, complete
from birdslam.runtime.models import store
from birdslam.runtime.nodes.inference import Inference
from birdslam.sources.kitti import KITTI_RATE_HZ, find_images, read_image
from birdslam.sources.kitti_tracking import TrackingSequence, open_tracking, read_detections
from birdslam.sources.recording import DatasetError
from birdslam.sources.speed_file import of_sequence, read_speeds
from birdslam.trajectory import as_poses, inverse, read_kitti
from birdslam.types import Estimate, Measurements

# The graph of the paper with its localization of vehicles (Eq. 1), and on images with its whole front end
BY_EQ_1: dict[str, Method] = {"paper_eq1": PAPER, "paper_eq1_final": methods(AS_PUBLISHED)["paper_final"]}
FIGURE_FRAMES = (50, 100, 200, 414)  # of the runtime figure of the paper
BATCHES = frozenset({"batch_se3", "nair"})  # the batch methods of the runtime figure
REPEATS = 3  # of each timing; the median is reported


@dataclass(frozen=True)
class Job:
    """The work of one process: a sequence with its settings."""

    root: Path
    sequence: str
    frames: str  # "all", "paper" or "A:B"
    methods: tuple[str, ...]  # of Tables 1 and 2; none: ablations only
    odometry: str
    detections: str
    seeds: int
    ablate: bool  # also run the variants of Tables 3-5
    output: Path
    configuration: Configuration
    published: Published

    @property
    def camera(self) -> int | None:
        """The camera of the boxes; None: the camera that has images."""
        return None if self.detections == "network" else CAMERA_OF_BOXES


def frames_of(text: str, sequence: TrackingSequence, published: Published) -> range:
    """Parses `--frames`. Raises ConfigurationError."""
    if text == "all":
        return range(len(sequence))
    if text == "paper":
        paper = published.sequences.get(sequence.name)
        if paper is None:
            raise ConfigurationError(f"--frames paper: the paper has no sequence {sequence.name}")
        return most_labelled(sequence, paper.cars, paper.frames)
    first, colon, last = text.partition(":")
    try:
        frames = range(int(first or 0), int(last or len(sequence)))
    except ValueError:
        frames = range(0)
    if not colon or not 0 <= frames.start < frames.stop <= len(sequence):
        raise ConfigurationError(
            f"--frames {text}: expected all, paper or A:B within the {len(sequence)} frames of {sequence.name}"
        )
    return frames


def frames_to_make(job: Job) -> int:
    """Returns the number of frames that the front end processes for a job, over all seeds and logs."""
    frames = frames_of(job.frames, open_tracking(job.root, job.sequence, job.camera), job.published)
    logs = 1 + bool(_by_eq_1(job)) + bool(_ideas(job) and job.odometry == "images")
    return len(frames) * job.seeds * logs


def run_sequence(job: Job, frame_made: Callable[[], object] = lambda: None) -> Outcome:
    """Runs all methods and ablations on one sequence; calls `frame_made` after each frame of the front end."""
    cv2.setNumThreads(1)
    sequence = open_tracking(job.root, job.sequence, job.camera)
    frames = frames_of(job.frames, sequence, job.published)
    slam = job.configuration.slam
    chosen: dict[str, Method] = {name: methods(slam)[name] for name in job.methods}
    variants = _variants(job)
    by_eq_1, ideas = _by_eq_1(job), _ideas(job)
    paper = job.published.sequences.get(sequence.name)
    bodies = () if paper is None else paper.bodies
    named = bodies if job.frames == "paper" else None  # bodies of the ablations; None: all
    trials, ablations, worth, nees, log = [], [], [], [], []
    with ExitStack() as stack:
        make = _log_maker(job, sequence, frames, stack, frame_made)
        static_map = slam.frontend.static_map
        far = msgspec.structs.replace(static_map, landmark_range_m=ablation.MAX_LANDMARK_DISTANCE_M)
        for seed in range(job.seeds):
            far_log = make(seed, msgspec.structs.replace(slam.frontend, static_map=far))
            log = within(far_log, static_map.landmark_range_m)
            solved: dict[Method, Trajectories] = {}
            nees.append(nees_rows(sequence, log, ours(slam), job.odometry))
            if chosen:
                trials.append(run_trial(sequence, log, chosen, solved=solved))
            if variants:
                beyond = {name: m for name, m in variants.items() if ablation.depth_of(m) > static_map.landmark_range_m}
                near = {name: method for name, method in variants.items() if name not in beyond}
                trial = run_trial(sequence, log, near, named, solved)
                deep = run_trial(sequence, far_log, beyond, named)
                ablations.append(replace(trial, errors={**trial.errors, **deep.errors}))
            if by_eq_1:
                published_log = make(seed, AS_PUBLISHED.frontend)
                published: dict[Method, Trajectories] = {}
                theirs = run_trial(sequence, published_log, by_eq_1, named, published)
                if chosen:
                    trials[-1] = replace(trials[-1], errors={**trials[-1].errors, **theirs.errors})
            if ideas:
                if job.odometry == "images":  # the variants do not change the odometry
                    placing = msgspec.structs.replace(AS_PUBLISHED.frontend, odometry=slam.frontend.odometry)
                    published_log, published = make(seed, placing), {}
                theirs = run_trial(sequence, published_log, ideas, named, published)
                placed = {f"ideas/{name}": m for name, m in ablation.placed_variants(ours(slam)).items()}
                own = run_trial(sequence, log, placed, named, solved)
                worth.append(replace(theirs, errors={**theirs.errors, **own.errors}))
    if chosen:
        name = next(iter(chosen))
        truth, result = Truth.of(sequence, log), solved[chosen[name]]
        title = f"KITTI tracking {sequence.name}, {chosen[name].label}, odometry: {job.odometry}"
        of_images = "_images" if job.odometry == "images" else ""
        draw_sequence(title, truth, result, job.output / f"bev_{sequence.name}{of_images}.png")
    updates_ms = {"all vehicles": _updates_ms(log, job), "one vehicle": _updates_ms(_one_vehicle(log), job)}

    def rows_of(trials: Sequence[Trial]) -> list[Row]:
        return summarise(sequence.name, trials, bodies, job.odometry, job.detections) if trials else []

    estimates = _estimates(log, job) if chosen else []
    seen = sights(sequence, estimates) if job.detections == "network" else []
    return Outcome(
        sequence=sequence.name,
        odometry=job.odometry,
        frames=frames,
        rows=rows_of(trials),
        ablation=rows_of(ablations),
        ideas=rows_of(worth),
        ranges=range_rows(sequence.name, seen) if seen else [],
        motion=[motion_row(sequence.name, seen)] if seen else [],
        timings=[_timing(log[:length], job) for length in _lengths(log, job)],
        nees=over_seeds(nees),
        updates_ms=updates_ms,
        movers=movers_row(sequence, log, estimates, job.odometry) if chosen else None,
    )


def _by_eq_1(job: Job) -> dict[str, Method]:
    """Returns BY_EQ_1 if both our method and that of the paper run."""
    return {} if job.methods and not {"paper", "birdslam"} <= set(job.methods) else dict(BY_EQ_1)


def _ideas(job: Job) -> dict[str, Method]:
    if not job.ablate or not _by_eq_1(job):
        return {}
    return {f"ideas/{name}": method for name, method in ablation.idea_variants().items()}


def _lengths(log: Sequence[Measurements], job: Job) -> list[int]:
    """Returns the frame counts for timings: those of the figure for the sequence of the paper, else all frames.

    Empty if no batch method runs.
    """
    if job.methods and BATCHES.isdisjoint(job.methods):
        return []
    if job.sequence != job.published.runtime.sequence:
        return [len(log)]
    return sorted({*(n for n in FIGURE_FRAMES if n < len(log)), len(log)})


def _timing(log: Sequence[Measurements], job: Job) -> Timing:
    """Times all updates of the live graph and one solve of each batch method, as medians over REPEATS.

    A batch that does not converge is solved once, since its time is not reported.
    """
    batches = []
    for config in (batch_se3.CONFIG, nair.CONFIG):
        start = time.perf_counter()
        _, ended = solve_batch(log, config, check=True)
        seconds = [time.perf_counter() - start]
        if ended.converged:
            seconds = []
            for _ in range(REPEATS):
                start = time.perf_counter()
                solve_batch(log, config)
                seconds.append(time.perf_counter() - start)
        batches.append(BatchTiming(float(np.median(seconds)), ended.iterations, ended.converged))
    incremental_s = float(np.median([_updates_ms(log, job).sum() for _ in range(REPEATS)])) / 1e3
    return Timing(len(log), incremental_s, *batches)


def _variants(job: Job) -> dict[str, Method]:
    """Returns the ablations as "METHOD/VARIANT"; those of Table 5 as "VARIANT"."""
    out: dict[str, Method] = {}
    images = job.odometry == "images"
    if not job.ablate:  # another job of the sequence has these rows, but only images have lanes
        return ablation.lane_variants(images) if images and "batch_se3" in job.methods else out
    for name, base in (("paper", PAPER), ("birdslam", ours(job.configuration.slam))):
        if not job.methods or name in job.methods:
            for part in (ablation.constraint_variants(base), ablation.landmark_variants(base)):
                out |= {f"{name}/{variant}": live for variant, live in part.items()}
    reported = job.frames != "paper" or job.sequence in job.published.table5.frames
    if reported and (not job.methods or "batch_se3" in job.methods):
        out |= ablation.lane_variants(images)
    return out


def _log_maker(
    job: Job, sequence: TrackingSequence, frames: range, stack: ExitStack, frame_made: Callable[[], object]
) -> Callable[[int, FrontEndConfig], list[Measurements]]:
    """Returns a function that makes the log of a seed."""
    paths = {} if sequence.images is None else find_images(sequence.images)
    uses_images = job.odometry == "images" or job.detections == "network"

    def image_of(frame: int) -> NDArray[np.uint8] | None:
        try:
            return read_image(paths[frame])
        except (KeyError, ValueError):
            return None

    speed_path = job.configuration.source.speed if job.odometry == "images" else ""
    speeds = read_speeds(of_sequence(Path(speed_path).expanduser(), sequence.name)) if speed_path else None
    network = job.detections == "network"
    folder = job.root / "det_02_rrc" if job.detections == "rrc" else Path(job.detections)
    found = [] if network else read_detections(folder, sequence.name, len(sequence))

    def given(frame: int, image: NDArray[np.uint8]) -> Pending:
        return Ready(Perception(found[frame], None, {"detector": 0}, ()))

    def make(seed: int, config: FrontEndConfig) -> list[Measurements]:
        perceive: Callable[[int, NDArray[np.uint8]], Pending] = given
        frustum_network = lane_head = None
        if network:
            configuration = complete(job.configuration.as_lossless(), sequence.camera, KITTI_RATE_HZ)
            if config.pseudolidar.rule == "paper" and configuration.models.pointnet is None:  # Sec. 3.1.3
                frustum = ModelSpec(path=str(store.find("pointnet", configuration.runtime.models_dir)))
                models = msgspec.structs.replace(configuration.models, pointnet=frustum)
                configuration = msgspec.structs.replace(configuration, models=models)
            inference = stack.enter_context(Inference(configuration))
            perceive = inference.networks.start
            frustum_network, lane_head = inference.frustum_network, inference.lane_head
        odometry = _odometry(job, sequence, frames, np.random.default_rng([seed, *sequence.name.encode()]))

        def counted(frame: int, image: NDArray[np.uint8]) -> Pending:
            frame_made()
            return perceive(frame, image)

        images = image_of if uses_images else None
        return make_log(sequence, frames, odometry, counted, images, config, speeds, frustum_network, lane_head)

    return make


def _odometry(job: Job, sequence: TrackingSequence, frames: range, rng: np.random.Generator) -> EgoMotion | None:
    """Returns the ego motion; None: visual odometry of the front end."""
    truth = sequence.camera_poses
    if job.odometry == "images":
        return None
    if job.odometry in ("simulate", "truth"):
        config = SimulationConfig() if job.odometry == "simulate" else EXACT
        return SimulatedOdometry(sequence.camera, truth, config, rng)
    path = Path(job.odometry)
    if path.is_dir():
        path = path / f"{sequence.name}.txt"
    try:
        rows = as_poses(read_kitti(path))
    except ValueError as error:
        raise DatasetError(str(error)) from None
    if len(rows) == len(frames) < len(sequence):  # the file has only the requested frames
        rows = np.concatenate([np.tile(rows[:1], (frames.start, 1, 1)), rows])
    if len(rows) < frames.stop:
        raise DatasetError(f"{path}: {len(rows)} poses for {len(frames)} frames of sequence {sequence.name}")
    poses = inverse(sequence.T_cam0_camera) @ rows @ sequence.T_cam0_camera
    return SimulatedOdometry(sequence.camera, poses, EXACT, rng, true_poses=truth)


def _one_vehicle(log: Sequence[Measurements]) -> list[Measurements]:
    """Returns the log with only the vehicle that has the most edges."""
    seen = [edge.vehicle for m in log for edge in m.cv]
    most_seen = max(sorted(set(seen)), key=seen.count, default=-1)
    return [
        msgspec.structs.replace(
            m, cv=tuple(e for e in m.cv if e.vehicle == most_seen), vv=tuple(e for e in m.vv if e.vehicle == most_seen)
        )
        for m in log
    ]


def _estimates(log: Sequence[Measurements], job: Job) -> list[Estimate]:
    """Returns the live estimate of each frame."""
    graph = PoseGraph(job.configuration.slam.graph, job.configuration.slam.weights)
    return [graph.optimise(measurements) for measurements in log]


def _updates_ms(log: Sequence[Measurements], job: Job) -> NDArray[np.float64]:
    slam, took = job.configuration.slam, []
    graph = PoseGraph(slam.graph, slam.weights)
    for measurements in log:
        start = time.perf_counter()
        graph.optimise(measurements)
        took.append((time.perf_counter() - start) * 1e3)
    return np.array(took)
