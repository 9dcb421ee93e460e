"""How well vehicles are placed on real roads: the front end's CV edges against labelled cars.

Each matched car's BEV centre is compared with the label's, along (depth, ego's x) and across (ego's y) the
optical axis. The covariance is consistent where the ellipse that holds 68.3 % of a 2-D Gaussian (chi-square of two
degrees of freedom: 2.30) holds as many of the errors, and the one for 95.4 % (6.18) likewise: `inside_1_sigma` and
`inside_2_sigma`; and where `nees` is 1 for young tracks and for old ones.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import msgspec
import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from birdslam.bench.simulation.odometry import EXACT, OdometryNoise, SimulatedOdometry
from birdslam.bench.simulation.tilt_from_images import TiltFromImages
from birdslam.bench.tracking.benchmark import make_log
from birdslam.bench.tracking.labelled_road import MIN_VEHICLES, labelled_grounds
from birdslam.bench.tracking.metrics import match_vehicles
from birdslam.frontend import EgoMotion, FrontEndConfig
from birdslam.geometry.arrays import Floats
from birdslam.geometry.se2 import wrap
from birdslam.perception import Detections, Perception, Ready
from birdslam.sources.kitti import KITTI_RATE_HZ
from birdslam.sources.kitti_tracking import TrackingSequence
from birdslam.sources.label_projection import Label
from birdslam.types import Estimate, Measurements, VehicleEdge

CAMERA_OF_BOXES = 2  # labels and RRC detections were drawn in its images
RANGES_M = ((0.0, 15.0), (15.0, 30.0), (30.0, 50.0))
INSIDE_1_SIGMA, INSIDE_2_SIGMA = (float(chi2.ppf(chi2.cdf(k**2, 1), 2)) for k in (1, 2))  # 2.30, 6.18
MEASURED_KIND = "Car"
MAX_SQUARED_DISTANCE = 25.0  # squared Mahalanobis distance of a car, at the most: five sigma
STANDS_MPS = 1.0  # an ego that is slower stands or nearly
TALL_M = 1.75  # of a label: taller than nearly all cars
CHOSE_NOTHING = ("0012", "0013", "0014", "0016", "0017")  # of places; docs/constants.md has the few priors by labels
AGES_S = ((0.0, 0.5), (0.5, 2.0), (2.0, 5.0), (5.0, math.inf))  # since the vehicle's first edge


@dataclass(frozen=True)
class CarError:
    """One car in one frame: its true depth, the error of its centre in ego (2,), that error's square over its cov."""

    sequence: str
    frame: int
    label: int
    depth_m: float
    error_m: Floats
    mahalanobis2: float
    yaw_error_rad: float
    log_det_cov: float  # of the place's covariance (2, 2), in m^4
    cut: bool = False  # by the image's edge
    height_m: float = 0.0  # of the label
    ego_mps: float = math.inf  # the ego's speed
    age_s: float = 0.0  # since the vehicle's first edge
    sigma_depth_m: float = 0.0  # 1-sigma along ego's x, as the edge states it


class LocalisationRow(msgspec.Struct, frozen=True, kw_only=True):
    """A row of report.json; medians are None where `n` is 0. `depth_bias_median_rel` > 0 is too far."""

    sequence: str
    range: str
    n: int
    depth_error_median_rel: float | None = None
    lateral_error_median_m: float | None = None
    inside_1_sigma: float | None = None
    inside_2_sigma: float | None = None
    depth_bias_median_rel: float | None = None
    yaw_error_median_deg: float | None = None
    cars: int = 0  # labelled tracks
    nees: float | None = None  # mean squared Mahalanobis distance over its expectation; a car counts 25 at the most
    yaw_off_10_deg: float | None = None  # share of those that are off by more
    # The same shares with each car counted once, in however many frames: errors of one last while it is seen
    inside_1_sigma_by_car: float | None = None
    inside_2_sigma_by_car: float | None = None
    # RMS of relative errors of the depth and of the sigmas that edges state, and what the errors are made of: what
    # changes while a car is seen, what differs between the cars of a sequence, and between sequences
    depth_rms_rel: float | None = None
    depth_stated_rel: float | None = None
    within_cars_rel: float | None = None
    between_cars_rel: float | None = None
    between_sequences_rel: float | None = None


class TiltRow(msgspec.Struct, frozen=True, kw_only=True):
    """The road that the front end uses against the labelled one, over frames with two vehicles or more."""

    sequence: str
    n: int
    pitch_error_median_mrad: float | None = None
    roll_error_median_mrad: float | None = None


def measure(
    sequence: TrackingSequence,
    detections: Sequence[Detections],
    config: FrontEndConfig,
    tilt_from_images: bool = False,
    draw: int = 0,
) -> list[Measurements]:
    """The front end over a sequence of known ego motion.

    Of the road it knows only the calibrated camera, or, with `tilt_from_images`, its pitch too with the error that
    images give it with; `draw` is the seed of that error.
    """
    rng = np.random.default_rng(draw)
    simulated = SimulatedOdometry(sequence.camera, sequence.camera_poses, EXACT, rng)
    odometry: EgoMotion = simulated
    if tilt_from_images:
        grounds = [None if labelled is None else labelled.ground for labelled in labelled_grounds(sequence)]
        odometry = TiltFromImages(simulated, grounds, OdometryNoise(), rng)

    def perceive(frame: int, _: NDArray[np.uint8]) -> Ready:
        return Ready(Perception(detections[frame], segmentation=None, ages={"detector": 0}, status=()))

    return make_log(sequence, range(len(sequence)), odometry, perceive, None, config)


def match_cars(sequence: TrackingSequence, measurements: Iterable[Measurements]) -> list[CarError]:
    """Every matched car of the labels in every frame."""
    errors: list[CarError] = []
    speeds, first = ego_speeds_mps(sequence), dict[int, int]()
    for record in measurements:
        here, edges = sequence.labels_of(record.frame_id), {edge.vehicle: edge for edge in record.cv}
        pairs = match_vehicles(here, list(edges), np.array([e.box_px for e in edges.values()]).reshape(-1, 4))
        for vehicle in edges:
            first.setdefault(vehicle, record.t_source_ns)
        errors += [
            _error(
                sequence,
                label,
                edges[pairs[label.track]],
                float(speeds[record.frame_id]),
                (record.t_source_ns - first[pairs[label.track]]) * 1e-9,
            )
            for label in here
            if label.track in pairs and label.kind == MEASURED_KIND
        ]
    return errors


def as_reported(measurements: Sequence[Measurements], estimates: Sequence[Estimate]) -> list[Measurements]:
    """The records with each CV edge's pose as the graph reports it, which knows where a vehicle was before."""
    out = []
    for record, estimate in zip(measurements, estimates, strict=True):
        poses = {v.vehicle: estimate.T_world_ego.between(v.T_world_vehicle) for v in estimate.vehicles}
        cv = [
            msgspec.structs.replace(edge, T_ego_vehicle=poses[edge.vehicle])
            for edge in record.cv
            if edge.vehicle in poses
        ]
        out.append(msgspec.structs.replace(record, cv=tuple(cv)))
    return out


def ego_speeds_mps(sequence: TrackingSequence) -> Floats:
    """(N,) by its poses 0.2 s before and after."""
    frames = np.arange(len(sequence))
    before, after = np.maximum(frames - 2, 0), np.minimum(frames + 2, len(frames) - 1)
    at = sequence.camera_poses[:, :3, 3]
    way_m = np.linalg.norm(at[after] - at[before], axis=1)
    out: Floats = way_m * KITTI_RATE_HZ / np.maximum(after - before, 1)
    return out


def tilt_row(sequence: TrackingSequence, measurements: Iterable[Measurements]) -> TiltRow:
    """Errors of pitch and roll, of the roads that records were made over."""
    labelled, errors = labelled_grounds(sequence), []
    for record in measurements:
        truth = labelled[record.frame_id]
        if truth is not None and truth.vehicles >= MIN_VEHICLES and record.ground is not None:
            of_roll = abs(record.ground.roll_rad - truth.ground.roll_rad)
            errors.append((abs(record.ground.pitch_rad - truth.ground.pitch_rad), of_roll))
    if not errors:
        return TiltRow(sequence=sequence.name, n=0)
    pitch_mrad, roll_mrad = (1e3 * np.median(errors, axis=0)).tolist()
    return TiltRow(
        sequence=sequence.name, n=len(errors), pitch_error_median_mrad=pitch_mrad, roll_error_median_mrad=roll_mrad
    )


def _error(
    sequence: TrackingSequence, label: Label, edge: VehicleEdge, ego_mps: float = math.inf, age_s: float = 0.0
) -> CarError:
    truth = sequence.vehicle_truth(label, label.frame)  # world is the ego of that very frame
    error = np.array([edge.T_ego_vehicle.x_m - truth.x_m, edge.T_ego_vehicle.y_m - truth.y_m])
    R_ego_vehicle = edge.T_ego_vehicle.rotation()  # an edge's covariance is of the tangent at the vehicle's pose
    cov = R_ego_vehicle @ np.reshape(edge.cov, (3, 3))[:2, :2] @ R_ego_vehicle.T
    return CarError(
        sequence=sequence.name,
        frame=label.frame,
        label=label.track,
        depth_m=truth.x_m,
        error_m=error,
        mahalanobis2=float(error @ np.linalg.solve(cov, error)),
        log_det_cov=float(np.linalg.slogdet(cov)[1]),
        yaw_error_rad=wrap(edge.T_ego_vehicle.yaw_rad - truth.yaw_rad),
        cut=label.truncated > 0,
        height_m=label.height_m,
        ego_mps=ego_mps,
        age_s=age_s,
        sigma_depth_m=math.sqrt(float(cov[0, 0])),
    )


def summarise_ranges(errors: Sequence[CarError], reported: Sequence[CarError] = ()) -> list[LocalisationRow]:
    """A row for each sequence and range, then those of the union, "all", of cars that the image does not cut.

    After them those of parts of all: by whether the ego drives, by the age of the track, tall cars, cars of sequences
    that chose none of the constants, and cars that the image cuts. `reported` are errors of `as_reported`: of the cut
    cars of these too, since a frame alone hardly tells how far one is; their sigmas are others, so no share is in it.
    """
    whole = [e for e in errors if not e.cut]
    names = list(dict.fromkeys(error.sequence for error in errors))
    groups = [(name, [e for e in whole if e.sequence == name]) for name in names] + [("all", whole)]
    parts: list[tuple[str, Callable[[CarError], bool]]] = [
        ("ego drives", lambda e: e.ego_mps >= STANDS_MPS),
        ("ego stands", lambda e: e.ego_mps < STANDS_MPS),
        *((f"{low:g}-{high:g} s", lambda e, low=low, high=high: low <= e.age_s < high) for low, high in AGES_S),
        (f"over {TALL_M} m", lambda e: e.height_m > TALL_M),
        ("chose none", lambda e: e.sequence in CHOSE_NOTHING),
    ]
    groups += [(name, [e for e in whole if of_it(e)]) for name, of_it in parts]
    groups.append(("cut", [e for e in errors if e.cut]))
    rows = [_row(name, *_within(group, span)) for name, group in groups for span in RANGES_M]
    cut = [e for e in reported if e.cut]
    return rows + [_places_alone(_row("cut, graph", *_within(cut, span))) for span in RANGES_M if reported]


def _within(errors: Sequence[CarError], span: tuple[float, float]) -> tuple[str, list[CarError]]:
    near, far = span
    return f"{near:.0f}-{far:.0f}", [e for e in errors if near <= e.depth_m < far]


def _places_alone(row: LocalisationRow) -> LocalisationRow:
    return msgspec.structs.replace(
        row,
        inside_1_sigma=None,
        inside_2_sigma=None,
        inside_1_sigma_by_car=None,
        inside_2_sigma_by_car=None,
        nees=None,
        depth_stated_rel=None,
    )


def _row(sequence: str, span: str, errors: Sequence[CarError]) -> LocalisationRow:
    if not errors:
        return LocalisationRow(sequence=sequence, range=span, n=0)
    depth_m = np.array([e.depth_m for e in errors])
    along, across = np.array([e.error_m for e in errors]).T
    spread = np.array([e.mahalanobis2 for e in errors])
    _, car, sights = np.unique([f"{e.sequence} {e.label}" for e in errors], return_inverse=True, return_counts=True)
    once = 1.0 / sights[car]
    # A heading and its opposite look alike in a box; the footprint is the same
    turned = np.array([abs(wrap(2.0 * e.yaw_error_rad)) / 2.0 for e in errors])
    relative = along / depth_m
    of_car = np.bincount(car, relative) / sights  # (cars,)
    _, first = np.unique(car, return_index=True)
    _, drive, cars = np.unique([errors[k].sequence for k in first], return_inverse=True, return_counts=True)
    of_drive = np.bincount(drive, of_car) / cars
    return LocalisationRow(
        sequence=sequence,
        range=span,
        n=len(errors),
        depth_error_median_rel=float(np.median(np.abs(along) / depth_m)),
        lateral_error_median_m=float(np.median(np.abs(across))),
        inside_1_sigma=float(np.mean(spread <= INSIDE_1_SIGMA)),
        inside_2_sigma=float(np.mean(spread <= INSIDE_2_SIGMA)),
        depth_bias_median_rel=float(np.median(along / depth_m)),
        yaw_error_median_deg=math.degrees(float(np.median(turned))),
        cars=len(sights),
        nees=float(np.mean(np.minimum(spread, MAX_SQUARED_DISTANCE))) / 2.0,
        yaw_off_10_deg=float(np.mean(turned > math.radians(10.0))),
        inside_1_sigma_by_car=float(np.average(spread <= INSIDE_1_SIGMA, weights=once)),
        inside_2_sigma_by_car=float(np.average(spread <= INSIDE_2_SIGMA, weights=once)),
        depth_rms_rel=_rms(relative),
        depth_stated_rel=_rms(np.array([e.sigma_depth_m for e in errors]) / depth_m),
        within_cars_rel=_rms(relative - of_car[car]),
        between_cars_rel=_scatter(of_car - of_drive[drive], len(of_car) - len(of_drive)),
        between_sequences_rel=_scatter(of_drive - of_drive.mean(), len(of_drive) - 1),
    )


def _rms(values: Floats) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def _scatter(deviations: Floats, freedom: int) -> float | None:
    """Of deviations from means, with so many degrees of freedom; None without any."""
    return math.sqrt(float(np.square(deviations).sum()) / freedom) if freedom > 0 else None
