"""The paper's benchmark: every method on one log of measurements, held to KITTI tracking's labels and poses.

A *log* is what the front end says of a drive. It is made once for each seed and given to every method, so that methods
differ in nothing else. Track ids are our own tracker's; a label's track in a frame is the one whose box overlaps it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass

import msgspec
import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from birdslam.bench.baselines import batch_se3, cubeslam, nair, namdev
from birdslam.bench.baselines.trajectories import LiveTrajectories, Method, Trajectories
from birdslam.bench.figures import median
from birdslam.bench.simulation.odometry import SimulatedOdometry
from birdslam.bench.tracking.metrics import PathErrors, match_vehicles, path_errors
from birdslam.frontend import EgoMotion, FrontEnd, FrontEndConfig, Pending
from birdslam.geometry.camera import Camera, GroundPlane
from birdslam.geometry.se2 import SE2
from birdslam.graph.graph_config import GraphConfig
from birdslam.graph.pose_graph import PoseGraph
from birdslam.graph.weights import WeightsConfig
from birdslam.lanes.amodal.lane_mapper import LaneHead
from birdslam.paper import PAPER as AS_PUBLISHED
from birdslam.road_users.placement.pseudolidar import FrustumNetwork
from birdslam.road_users.rts_smoother import RtsSmoother, SmootherConfig
from birdslam.slam import SlamConfig
from birdslam.sources.kitti import KITTI_RATE_HZ
from birdslam.sources.kitti_tracking import VEHICLE_KINDS, TrackingSequence
from birdslam.types import NS_PER_S, Frame, LandmarkEdge, LandmarkKind, Measurements

EGO = "ego"
MIN_FRAMES = 5  # a vehicle matched in fewer is left out of the report, unless the paper names it

NO_IMAGE = np.zeros((1, 1), dtype=np.uint8)  # for an odometry that needs none


def inflated(edge: LandmarkEdge, factor: float) -> LandmarkEdge:
    """The edge with its own and its shared variances multiplied."""
    shared = edge.shared and tuple(math.sqrt(factor) * v for v in edge.shared)
    return replace(edge, cov=tuple(factor * v for v in edge.cov), shared=shared)


@dataclass(frozen=True)
class Live:
    """Our incremental pose graph: the live estimate of each frame, which knows nothing of later ones."""

    weights: WeightsConfig
    graph: GraphConfig
    cv_inflation: float = 1.0  # of the variances in the log
    cp_inflation: float = 1.0

    def run(self, log: Sequence[Measurements], camera: Camera) -> Trajectories:
        """One update for each record."""
        graph, live = PoseGraph(self.graph, self.weights), LiveTrajectories()
        for measurements in log:
            live.add(graph.optimise(self.reweighed(measurements)))
        return live.result

    def reweighed(self, m: Measurements) -> Measurements:
        """The record with the variances of its CV and CP edges inflated."""
        if self.cv_inflation == self.cp_inflation == 1.0:
            return m
        cv = [replace(e, cov=tuple(self.cv_inflation * v for v in e.cov)) for e in m.cv]
        cp = [inflated(e, self.cp_inflation) for e in m.cp]
        return replace(m, cv=tuple(cv), cp=tuple(cp))


@dataclass(frozen=True)
class Final:
    """The vehicles' trajectories smoothed over the whole log, and the ego's live one.

    A batch, and the paper's graph, which keeps every pose, estimate each frame from the whole log: so does this.
    """

    live: Live
    smoother: SmootherConfig

    def run(self, log: Sequence[Measurements], camera: Camera) -> Trajectories:
        """One update for each record, and a smoother backwards over the log."""
        graph, live = PoseGraph(self.live.graph, self.live.weights), LiveTrajectories()
        smoother = RtsSmoother(self.smoother)
        for measurements in log:
            estimate = graph.optimise(measurements)
            live.add(estimate)
            smoother.add(measurements, estimate)
        out = Trajectories(ego=live.result.ego)
        for (epoch, vehicle), way in smoother.smooth().items():
            for frame, pose in way.items():
                out.put_vehicle(vehicle, frame, live.T_first_world[epoch] @ pose)
        return out


PAPER = Live(AS_PUBLISHED.weights, AS_PUBLISHED.graph)


def ours(config: SlamConfig) -> Live:
    """The method as configured: what a planner gets."""
    return Live(config.weights, config.graph)


def methods(config: SlamConfig) -> dict[str, Method]:
    """Every method by its name; `config` is that of `birdslam`."""
    return {
        "birdslam": Final(ours(config), SmootherConfig()),
        "birdslam_live": ours(config),
        "paper": PAPER,
        "paper_final": Final(PAPER, SmootherConfig()),
        "batch_se3": batch_se3,
        "nair": nair,
        "namdev": namdev,
        "cubeslam": cubeslam,
    }


def make_log(
    sequence: TrackingSequence,
    frames: range,
    odometry: EgoMotion | None,
    perceive: Callable[[int, NDArray[np.uint8]], Pending],
    images: Callable[[int], NDArray[np.uint8] | None] | None,
    config: FrontEndConfig,
    frustum_network: FrustumNetwork | None = None,
    lane_head: LaneHead | None = None,
) -> list[Measurements]:
    """The front end's measurements of `frames`; frame ids are KITTI's.

    `images` returns a frame's image, None if it is unreadable; without `images` the odometry needs none.
    `frustum_network` and `lane_head` are those of `FrontEnd`.
    """
    frontend, log = FrontEnd(sequence.camera, config, odometry, frustum_network, lane_head or LaneHead()), []
    for index in frames:
        image = NO_IMAGE if images is None else images(index)
        t_ns = round(index / KITTI_RATE_HZ * NS_PER_S)
        pending = perceive(index, NO_IMAGE if image is None else image)
        m = frontend.measure(Frame(index, t_ns, t_ns, t_ns, image), pending)
        if isinstance(odometry, SimulatedOdometry) and m.ground is not None:
            ground = GroundPlane(m.ground.height_m, m.ground.pitch_rad, m.ground.roll_rad)
            m = replace(m, cp=odometry.landmarks(index, ground, config.static_map))
        log.append(m)
    return log


def within(log: Sequence[Measurements], range_m: float) -> list[Measurements]:
    """The log as the front end makes it with landmarks of the road as far as `range_m`, of one that has them farther.

    The nearest count in either, so that these are all.
    """
    return [
        replace(m, cp=tuple(e for e in m.cp if e.kind is not LandmarkKind.ROAD_POINT or e.x_m < range_m)) for m in log
    ]


def most_labelled(sequence: TrackingSequence, cars: Iterable[int], frames: int) -> range:
    """So many frames in which the labels of `cars` are the most together: the first of such stretches."""
    length = len(sequence)
    labels = np.zeros(length + 1)
    for label in sequence.labels:
        labels[label.frame + 1] += label.track in set(cars)
    frames = min(frames, length)
    so_far = np.cumsum(labels)
    start = int(np.argmax(so_far[frames:] - so_far[: length + 1 - frames]))
    return range(start, start + frames)


@dataclass(frozen=True)
class Truth:
    """What a log is held to: poses in the world of its first frame, and each frame's label -> track of ours."""

    ego: dict[int, SE2]
    vehicles: dict[int, dict[int, SE2]]  # label's id -> frame -> pose
    matches: dict[int, dict[int, int]]  # frame -> label's id -> vehicle

    @staticmethod
    def of(sequence: TrackingSequence, log: Sequence[Measurements]) -> Truth:
        """Raises ValueError for an empty log."""
        if not log:
            raise ValueError(f"sequence {sequence.name}: no frames to evaluate")
        first = log[0].frame_id
        ego = sequence.ego_truth(first)
        out = Truth({m.frame_id: ego[m.frame_id] for m in log}, {}, {})
        for m in log:
            labels = sequence.labels_of(m.frame_id)
            ids, boxes_px = [edge.vehicle for edge in m.cv], np.array([edge.box_px for edge in m.cv]).reshape(-1, 4)
            for label in labels:
                if label.kind in VEHICLE_KINDS:
                    pose = sequence.vehicle_truth(label, first)
                    out.vehicles.setdefault(label.track, {})[m.frame_id] = pose
            out.matches[m.frame_id] = match_vehicles(labels, ids, boxes_px)
        return out

    def found(self, label: int, result: Trajectories) -> dict[int, SE2]:
        """A label's poses as a method estimated them, through whichever track held it in each frame."""
        out = {}
        for frame, match in self.matches.items():
            pose = result.vehicles.get(match.get(label, -1), {}).get(frame)
            if pose is not None:
                out[frame] = pose
        return out

    def errors(self, result: Trajectories, bodies: Iterable[str] | None = None) -> dict[str, PathErrors | None]:
        """Errors of "ego" and of every labelled vehicle, or those of `bodies`; None for one that was never found."""
        out = {EGO: path_errors(self.ego, result.ego)}
        asked = self.vehicles if bodies is None else {label for label in self.vehicles if str(label) in bodies}
        for label in sorted(asked):
            out[str(label)] = path_errors(self.vehicles[label], self.found(label, result))
        return out


class Row(msgspec.Struct, frozen=True, kw_only=True):
    """One body in one sequence by one method: medians over the seeds, and the standard deviation of `ate_m`."""

    sequence: str
    method: str
    body: str  # "ego", or the label's id
    frames: float  # that count: the body has a label and an estimate
    frames_labelled: int
    seeds: int
    ate_m: float | None = None
    ate_m_spread: float | None = None
    odometry: str = ""
    detections: str = ""
    unconverged: int = 0  # the seeds in which the method's solver ended short of its minimum


@dataclass(frozen=True)
class Trial:
    """The errors of one seed by method and body."""

    errors: Mapping[str, Mapping[str, PathErrors | None]]
    frames_labelled: Mapping[str, int]
    unconverged: frozenset[str] = frozenset()  # methods whose solver ended short of its minimum


def run_trial(
    sequence: TrackingSequence,
    log: Sequence[Measurements],
    chosen: Mapping[str, Method],
    bodies: Sequence[str] | None = None,
    solved: dict[Method, Trajectories] | None = None,
) -> Trial:
    """Every method on one log; the errors of the labelled vehicles `bodies` alone, where these are named.

    `solved` are trajectories of this very log, which equal methods share; those of the others are added to it.
    """
    solved = {} if solved is None else solved
    for method in chosen.values():
        if method not in solved:
            solved[method] = method.run(log, sequence.camera)
    truth = Truth.of(sequence, log)
    labelled = {EGO: len(truth.ego)} | {str(label): len(poses) for label, poses in truth.vehicles.items()}
    errors = {name: truth.errors(solved[method], bodies) for name, method in chosen.items()}
    unconverged = frozenset(name for name, method in chosen.items() if not solved[method].converged)
    return Trial(errors, labelled, unconverged)


def summarise(sequence: str, trials: Sequence[Trial], keep: Iterable[str], odometry: str, detections: str) -> list[Row]:
    """The rows of one sequence from its trials, one for each seed; bodies in `keep` stay however little was seen."""
    rows, keep = [], set(keep) | {EGO}
    for method in trials[0].errors:
        for body, labelled in trials[0].frames_labelled.items():
            found = [trial.errors[method].get(body) for trial in trials]
            seen = [errors for errors in found if errors is not None]
            frames = float(np.median([0 if errors is None else errors.frames for errors in found]))
            if frames < MIN_FRAMES and body not in keep:
                continue
            rows.append(
                Row(
                    sequence=sequence,
                    method=method,
                    body=body,
                    frames=frames,
                    frames_labelled=labelled,
                    seeds=len(trials),
                    ate_m=median([errors.ate_m for errors in seen]),
                    ate_m_spread=float(np.std([errors.ate_m for errors in seen])) if seen else None,
                    odometry=odometry,
                    detections=detections,
                    unconverged=sum(method in trial.unconverged for trial in trials),
                )
            )
    return rows


def mean_ate_m(rows: Iterable[Row], method: str, bodies: Mapping[str, Iterable[str]]) -> float | None:
    """Mean of `ate_m` over bodies by sequence; None where one of them is missing, or there are none.

    The rows must be of one odometry.
    """
    of = {(row.sequence, row.body): row.ate_m for row in rows if row.method == method}
    errors = [of.get((sequence, body)) for sequence, names in bodies.items() for body in names]
    return float(np.mean([e for e in errors if e is not None])) if errors and None not in errors else None
