"""How well vehicles are placed on real roads: the front end's CV edges against labelled cars.

Each matched car's BEV centre is compared with the label's, along (depth, ego's x) and across (ego's y) the
optical axis. The covariance is consistent if the ellipse that holds 68.3 % of a 2-D Gaussian (chi-square of two
degrees of freedom: 2.30) holds as many of the errors, and the one for 95.4 % (6.18) likewise: `inside_1_sigma` and
`inside_2_sigma`; and if `nees` is 1.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import msgspec
import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from birdslam.bench.figures import median
from birdslam.bench.simulation.odometry import EXACT, OdometryNoise, SimulatedOdometry
from birdslam.bench.simulation.tilt_from_images import TiltFromImages
from birdslam.bench.tracking.benchmark import make_log
from birdslam.bench.tracking.labelled_road import labelled_grounds
from birdslam.bench.tracking.metrics import match_vehicles
from birdslam.frontend import EgoMotion, FrontEndConfig
from birdslam.geometry.arrays import Floats
from birdslam.perception import Detections, Perception, Ready
from birdslam.sources.kitti_tracking import TrackingSequence
from birdslam.sources.label_projection import Label
from birdslam.types import Measurements, VehicleEdge

CAMERA_OF_BOXES = 2  # labels and RRC detections were drawn in its images
BOXES = "det_02_rrc"  # the folder of the recorded boxes
CAR_RANGES_M = ((0.0, 15.0), (15.0, 30.0), (30.0, 50.0))
INSIDE_1_SIGMA, INSIDE_2_SIGMA = (float(chi2.ppf(chi2.cdf(k**2, 1), 2)) for k in (1, 2))  # 2.30, 6.18
MEASURED_KIND = "Car"
MAX_SQUARED_DISTANCE = 25.0  # squared Mahalanobis distance, at the most: five sigma
WALKING_MPS = 0.5  # true speed of walking people


@dataclass(frozen=True)
class PlaceError:
    """One road user in one frame: true depth, error of its centre in ego (2,), the square of that error over its cov.

    `velocities_mps` of people are the true and the estimated one (2,) in ego; `cut`: by the image's edge.
    """

    sequence: str
    frame: int
    label: int
    depth_m: float
    error_m: Floats
    mahalanobis2: float
    cut: bool = False
    velocities_mps: tuple[Floats, Floats] | None = None


class PlacesRow(msgspec.Struct, frozen=True, kw_only=True):
    """A row of report.json; medians are None where `n` is 0. `depth_bias_median_rel` > 0 is too far."""

    sequence: str
    range: str
    n: int
    depth_error_median_rel: float | None = None
    lateral_error_median_m: float | None = None
    inside_1_sigma: float | None = None
    inside_2_sigma: float | None = None
    depth_bias_median_rel: float | None = None
    tracks: int = msgspec.field(default=0, name="cars")  # labelled; `cars` in report.json for any class
    nees: float | None = None  # mean squared Mahalanobis distance over its expectation; 25 counts at most
    walking_speed_error_median_mps: float | None = None  # of both components of the velocity of moving people


def measure(
    sequence: TrackingSequence,
    detections: Sequence[Detections],
    config: FrontEndConfig,
    draw: int | None = None,
) -> list[Measurements]:
    """Runs the front end over a sequence with true ego motion.

    `draw` None: the ground is the calibrated plane; else it has the labelled tilt with the error of visual odometry,
    drawn from this seed.
    """
    rng = np.random.default_rng(draw or 0)
    simulated = SimulatedOdometry(sequence.camera, sequence.camera_poses, EXACT, rng)
    odometry: EgoMotion = simulated
    if draw is not None:
        odometry = TiltFromImages(simulated, labelled_grounds(sequence), OdometryNoise(), rng)

    def perceive(frame: int, _: NDArray[np.uint8]) -> Ready:
        return Ready(Perception(detections[frame], segmentation=None, ages={"detector": 0}, status=()))

    return make_log(sequence, range(len(sequence)), odometry, perceive, None, config)


def match_cars(sequence: TrackingSequence, measurements: Iterable[Measurements]) -> list[PlaceError]:
    """Every matched car of the labels in every frame."""
    errors: list[PlaceError] = []
    for record in measurements:
        here, edges = sequence.labels_of(record.frame_id), {edge.vehicle: edge for edge in record.cv}
        pairs = match_vehicles(here, list(edges), np.array([e.box_px for e in edges.values()]).reshape(-1, 4))
        errors += [
            _error(sequence, label, edges[pairs[label.track]])
            for label in here
            if label.track in pairs and label.kind == MEASURED_KIND
        ]
    return errors


def _error(sequence: TrackingSequence, label: Label, edge: VehicleEdge) -> PlaceError:
    truth = sequence.vehicle_truth(label, label.frame)  # world is the ego of that very frame
    error = np.array([edge.T_ego_vehicle.x_m - truth.x_m, edge.T_ego_vehicle.y_m - truth.y_m])
    R_ego_vehicle = edge.T_ego_vehicle.rotation()  # an edge's covariance is of the tangent at the vehicle's pose
    cov = R_ego_vehicle @ np.reshape(edge.cov, (3, 3))[:2, :2] @ R_ego_vehicle.T
    return PlaceError(
        sequence=sequence.name,
        frame=label.frame,
        label=label.track,
        depth_m=truth.x_m,
        error_m=error,
        mahalanobis2=float(error @ np.linalg.solve(cov, error)),
        cut=label.truncated > 0,
    )


def summarise_ranges(errors: Sequence[PlaceError], ranges_m: Sequence[tuple[float, float]]) -> list[PlacesRow]:
    """Returns a row for each sequence and range, then those of "all", of bodies that the image does not cut."""
    whole = [e for e in errors if not e.cut]
    names = list(dict.fromkeys(error.sequence for error in errors))
    groups = [(name, [e for e in whole if e.sequence == name]) for name in names] + [("all", whole)]
    return [
        _row(name, f"{near:.0f}-{far:.0f}", [e for e in group if near <= e.depth_m < far])
        for name, group in groups
        for near, far in ranges_m
    ]


def _row(sequence: str, span: str, errors: Sequence[PlaceError]) -> PlacesRow:
    if not errors:
        return PlacesRow(sequence=sequence, range=span, n=0)
    depth_m = np.array([e.depth_m for e in errors])
    along, across = np.array([e.error_m for e in errors]).T
    spread = np.array([e.mahalanobis2 for e in errors])
    both = [e.velocities_mps for e in errors if e.velocities_mps is not None]
    return PlacesRow(
        sequence=sequence,
        range=span,
        n=len(errors),
        depth_error_median_rel=float(np.median(np.abs(along) / depth_m)),
        lateral_error_median_m=float(np.median(np.abs(across))),
        inside_1_sigma=float(np.mean(spread <= INSIDE_1_SIGMA)),
        inside_2_sigma=float(np.mean(spread <= INSIDE_2_SIGMA)),
        depth_bias_median_rel=float(np.median(along / depth_m)),
        tracks=len({(e.sequence, e.label) for e in errors}),
        nees=float(np.mean(np.minimum(spread, MAX_SQUARED_DISTANCE))) / 2.0,
        walking_speed_error_median_mps=median(
            float(np.linalg.norm(estimated - true)) for true, estimated in both if np.linalg.norm(true) > WALKING_MPS
        ),
    )
