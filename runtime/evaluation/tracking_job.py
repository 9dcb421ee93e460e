"""One sequence of KITTI tracking in one process: all methods and ablations of the paper's tables."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import msgspec
import numpy as np
from numpy.typing import NDArray

from birdslam.bench.baselines.trajectories import Method, Trajectories
from birdslam.bench.simulation.odometry import SimulatedOdometry, SimulationConfig
from birdslam.bench.tracking import ablation
from birdslam.bench.tracking.benchmark import (
    PAPER,
    Row,
    Trial,
    make_log,
    methods,
    most_labelled,
    ours,
    run_trial,
    summarise,
    within,
)
from birdslam.bench.tracking.localisation import BOXES, CAMERA_OF_BOXES
from birdslam.bench.tracking.report import Outcome
from birdslam.bench.tracking.tables import Published
from birdslam.frontend import EgoMotion, FrontEndConfig, Pending
from birdslam.paper import PAPER as AS_PUBLISHED
from birdslam.perception import ModelSpec, Perception, Ready
from birdslam.runtime.configuration import Configuration, ConfigurationError, complete
from birdslam.runtime.models import store
from birdslam.runtime.nodes.inference import Inference
from birdslam.sources.kitti import KITTI_RATE_HZ, find_images, read_image
from birdslam.sources.kitti_tracking import TrackingSequence, open_tracking, read_detections
from birdslam.types import Measurements

# The graph of the paper with its localization of vehicles (Eq. 1), and on images with its whole front end
BY_EQ_1: dict[str, Method] = {"paper_eq1": PAPER, "paper_eq1_final": methods(AS_PUBLISHED)["paper_final"]}


@dataclass(frozen=True)
class Job:
    """The work of one process: a sequence with its settings."""

    root: Path
    sequence: str
    frames: str  # "all", "paper" or "A:B"
    images: bool  # visual odometry and boxes of the networks, else simulated odometry and recorded boxes
    seeds: int
    output: Path
    configuration: Configuration
    published: Published

    @property
    def odometry(self) -> str:
        """The name of the odometry in rows."""
        return "images" if self.images else "simulate"

    def open(self) -> TrackingSequence:
        """Opens the sequence with the camera that has images, or with that of the recorded boxes."""
        return open_tracking(self.root, self.sequence, None if self.images else CAMERA_OF_BOXES)


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
    """Returns the number of frames that the front end processes for a job, over all seeds and both logs."""
    return 2 * len(frames_of(job.frames, job.open(), job.published)) * job.seeds


def run_sequence(job: Job, frame_made: Callable[[], object] = lambda: None) -> Outcome:
    """Runs all methods and ablations on one sequence; calls `frame_made` after each frame of the front end."""
    cv2.setNumThreads(1)
    sequence = job.open()
    frames = frames_of(job.frames, sequence, job.published)
    slam = job.configuration.slam
    paper = job.published.sequences.get(sequence.name)
    bodies = () if paper is None else paper.bodies
    named = bodies if job.frames == "paper" else None  # bodies of the ablations; None: all
    static_map = slam.frontend.static_map
    far = msgspec.structs.replace(static_map, landmark_range_m=ablation.MAX_LANDMARK_DISTANCE_M)
    variants = _variants(job)
    beyond = {name: m for name, m in variants.items() if ablation.depth_of(m) > static_map.landmark_range_m}
    near = {name: method for name, method in variants.items() if name not in beyond}
    ideas = {f"ideas/{name}": method for name, method in ablation.idea_variants().items()}
    placed = {f"ideas/{name}": method for name, method in ablation.placed_variants(ours(slam)).items()}
    trials, ablations, worth = [], [], []
    with ExitStack() as stack:
        make = _log_maker(job, sequence, frames, stack, frame_made)
        for seed in range(job.seeds):
            far_log = make(seed, msgspec.structs.replace(slam.frontend, static_map=far))
            log, log_eq_1 = within(far_log, static_map.landmark_range_m), make(seed, AS_PUBLISHED.frontend)
            solved: dict[Method, Trajectories] = {}
            solved_eq_1: dict[Method, Trajectories] = {}
            trial = run_trial(sequence, log, methods(slam), solved=solved)
            trials.append(_joined(trial, run_trial(sequence, log_eq_1, BY_EQ_1, named, solved_eq_1)))
            if variants:
                trial = run_trial(sequence, log, near, named, solved)
                ablations.append(_joined(trial, run_trial(sequence, far_log, beyond, named)))
            if not job.images:
                trial = run_trial(sequence, log_eq_1, ideas, named, solved_eq_1)
                worth.append(_joined(trial, run_trial(sequence, log, placed, named, solved)))

    def rows_of(trials: Sequence[Trial]) -> list[Row]:
        detections = "network" if job.images else "rrc"
        return summarise(sequence.name, trials, bodies, job.odometry, detections) if trials else []

    return Outcome(sequence.name, job.odometry, frames, rows_of(trials), rows_of(ablations), rows_of(worth))


def _joined(trial: Trial, other: Trial) -> Trial:
    """Returns the methods of both trials of one seed."""
    return replace(trial, errors={**trial.errors, **other.errors})


def _variants(job: Job) -> dict[str, Method]:
    """Returns the ablations as "METHOD/VARIANT"; those of Table 5 as "VARIANT"."""
    out: dict[str, Method] = {}
    if not job.images:
        for name, base in (("paper", PAPER), ("birdslam", ours(job.configuration.slam))):
            for part in (ablation.constraint_variants(base), ablation.landmark_variants(base)):
                out |= {f"{name}/{variant}": live for variant, live in part.items()}
    if job.images or job.frames != "paper" or job.sequence in job.published.table5.frames:
        out |= ablation.lane_variants()
    return out


def _log_maker(
    job: Job, sequence: TrackingSequence, frames: range, stack: ExitStack, frame_made: Callable[[], object]
) -> Callable[[int, FrontEndConfig], list[Measurements]]:
    """Returns a function that makes the log of a seed."""
    paths = {} if sequence.images is None else find_images(sequence.images)
    found = [] if job.images else read_detections(job.root / BOXES, sequence.name, len(sequence))

    def image_of(frame: int) -> NDArray[np.uint8] | None:
        try:
            return read_image(paths[frame])
        except (KeyError, ValueError):
            return None

    def recorded(frame: int, image: NDArray[np.uint8]) -> Pending:
        return Ready(Perception(found[frame], None, {"detector": 0}, ()))

    def make(seed: int, config: FrontEndConfig) -> list[Measurements]:
        perceive: Callable[[int, NDArray[np.uint8]], Pending] = recorded
        odometry: EgoMotion | None = None
        frustum_network = lane_head = None
        if job.images:
            configuration = complete(job.configuration.as_lossless(), sequence.camera, KITTI_RATE_HZ)
            if config.pseudolidar.rule == "paper" and configuration.models.pointnet is None:  # Sec. 3.1.3
                frustum = ModelSpec(path=str(store.find("pointnet", configuration.runtime.models_dir)))
                models = msgspec.structs.replace(configuration.models, pointnet=frustum)
                configuration = msgspec.structs.replace(configuration, models=models)
            inference = stack.enter_context(Inference(configuration))
            perceive = inference.networks.start
            frustum_network, lane_head = inference.frustum_network, inference.lane_head
        else:
            rng = np.random.default_rng([seed, *sequence.name.encode()])
            odometry = SimulatedOdometry(sequence.camera, sequence.camera_poses, SimulationConfig(), rng)

        def counted(frame: int, image: NDArray[np.uint8]) -> Pending:
            frame_made()
            return perceive(frame, image)

        images = image_of if job.images else None
        return make_log(sequence, frames, odometry, counted, images, config, frustum_network, lane_head)

    return make
