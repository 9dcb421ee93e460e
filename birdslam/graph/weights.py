"""Weights of the graph's edges: their measured covariances, or the paper's numbers (Eq. 4)."""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec
from msgspec.structs import replace

from birdslam.types import LandmarkKind, Measurements

Positive = Annotated[float, msgspec.Meta(gt=0.0)]
EdgeType = Literal["cc", "cp", "cv", "vv", "lanes"]

NO_WEIGHT = 1e-3  # lambda of an ignored edge; not 0, since the graph needs an initial guess of each pose


class WeightsConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """`measured`: each edge keeps its own covariance; `paper`: an edge's information is `lambda` times the unit matrix.

    `leave_out` names the edge types that do not enter the graph (the ablations of Table 3); "lanes" are the CP edges of
    lanes, "cp" all CP edges. None is the mode's default: `paper` uses all; `measured` leaves out VV, which the tracker
    predicts from the detections of the CV edges and a constant-velocity factor replaces, and lanes.
    """

    # measured: each edge has its own covariance; paper: the weights below
    mode: Literal["measured", "paper"] = "measured"
    cc: Positive = 10_000.0  # lambda of Eq. 4, as those below
    cp: Positive = 10_000.0  # of landmarks
    # CP edges of vehicles to the landmarks of their frame (Eq. 7); None: no such edges. Needs
    # slam.graph.landmark_anchor = "first_sight"
    cp_vehicles: Positive | None = None
    cv_near: Positive = 1_000.0  # of a vehicle at the camera
    cv_far: Positive = 10.0  # of a vehicle at cv_far_m and farther
    cv_far_m: Positive = 60.0  # the paper states no distance
    vv: Positive = 1.0  # of a vehicle's own motion
    depth_threshold_m: Positive | None = 20.0  # T of Table 4: landmarks beyond it are left out; None keeps all
    leave_out: tuple[EdgeType, ...] | None = None  # edge types that do not enter the graph; None: the mode's default

    @property
    def left_out(self) -> tuple[EdgeType, ...]:
        """The edge types that do not enter the graph."""
        if self.leave_out is not None:
            return self.leave_out
        return () if self.mode == "paper" else ("vv", "lanes")

    def cv_at(self, depth_m: float) -> float:
        """The CV weight: `cv_near` at the camera, `cv_far` from `cv_far_m` on, linear in the logarithm between."""
        share = min(max(depth_m / self.cv_far_m, 0.0), 1.0)
        return float(self.cv_near * (self.cv_far / self.cv_near) ** share)


# The paper's: Eq. 4 has one information matrix for each type of edge, Eq. 7 CP edges of ego and vehicles
PAPER_WEIGHTS = WeightsConfig(mode="paper", cp_vehicles=10_000.0)


def effective_cov(weight: float, dimensions: int) -> tuple[float, ...]:
    """Row-major covariance of an edge whose information matrix is `weight` (lambda) times the unit matrix."""
    variance = 1.0 / weight  # Eq. 4, inverted
    return tuple(variance if i == j else 0.0 for i in range(dimensions) for j in range(dimensions))


def weighted(measurements: Measurements, config: WeightsConfig) -> Measurements:
    """The measurements with the covariances for the graph.

    Without "cc" the ego's motion remains as an initial guess with a sigma of 32 m (`NO_WEIGHT`): the other edges do not
    constrain a frame without vehicles.
    """
    out = config.left_out
    threshold_m = config.depth_threshold_m
    cp = () if "cp" in out else measurements.cp
    if "lanes" in out and cp:
        cp = tuple([edge for edge in cp if edge.kind is not LandmarkKind.LANE_STATION])
    if threshold_m is not None and cp:
        cp = tuple([edge for edge in cp if edge.x_m <= threshold_m])
    cv = () if "cv" in out else measurements.cv
    vv = () if "vv" in out else measurements.vv
    cc = measurements.cc
    if config.mode == "paper":
        cp_cov, vv_cov = effective_cov(config.cp, 2), effective_cov(config.vv, 3)  # Eq. 4, here and in the next lines
        # Each CP edge has the same weight; their number does not matter
        cp = tuple(replace(edge, cov=cp_cov, shared=None) for edge in cp)
        cv = tuple(
            # Eq. 4 gives the whole covariance; sizes are not used
            replace(edge, cov=effective_cov(config.cv_at(edge.T_ego_vehicle.x_m), 3), sigma_log_height=0.0)
            for edge in cv
        )
        vv = tuple(replace(edge, cov=vv_cov) for edge in vv)
        cc = cc and replace(cc, cov=effective_cov(config.cc, 3))
    if cc and "cc" in out:
        cc = replace(cc, cov=effective_cov(NO_WEIGHT, 3))
    if cc is measurements.cc and cv is measurements.cv and vv is measurements.vv and cp is measurements.cp:
        return measurements
    return replace(measurements, cc=cc, cv=cv, vv=vv, cp=cp)
