"""Records for tests: every field that a test does not name is zero."""

from __future__ import annotations

from typing import Any

from birdslam.geometry.se2 import SE2
from birdslam.types import EgoEdge, Estimate, FrameRef, Measurements, VehicleEdge, VehicleEstimate

STAMPS = {"frame_id": 0, "t_source_ns": 0, "t_capture_ns": 0, "t_utc_ns": 0}
POSE = {"T_world_ego": SE2(), "cov": (0.0,) * 9}
MOVES = {"cov": (0.0,) * 9, "velocity_mps": (0.0, 0.0), "velocity_cov": (0.0,) * 4, "age_ns": 0, "frames": 1}


def new_frame_ref(**fields: Any) -> FrameRef:
    return FrameRef(**{**STAMPS, **fields})


def new_measurements(**fields: Any) -> Measurements:
    return Measurements(**{**STAMPS, **fields})


def step_at(
    frame_id: int, step: SE2 | None, variance: float = 0.0, cov: tuple[float, ...] = (), **fields: Any
) -> Measurements:
    """Frame `frame_id` of a drive at 10 Hz, with the ego's motion since the frame before; the first one has none."""
    cc = None
    if frame_id and step is not None:
        cov = cov or (variance, 0.0, 0.0, 0.0, variance, 0.0, 0.0, 0.0, variance)
        cc = EgoEdge(from_frame=frame_id - 1, to_frame=frame_id, T_from_to=step, cov=cov)
    stamps = dict.fromkeys(("t_source_ns", "t_capture_ns", "t_utc_ns"), frame_id * 100_000_000)
    return Measurements(**{**stamps, "frame_id": frame_id, "cc": cc, **fields})


def new_edge(
    vehicle: int, frame: int, T_ego_vehicle: SE2, variances: tuple[float, float, float], **fields: Any
) -> VehicleEdge:
    x, y, yaw = variances
    cov = (x, 0.0, 0.0, 0.0, y, 0.0, 0.0, 0.0, yaw)
    return VehicleEdge(vehicle=vehicle, frame=frame, T_ego_vehicle=T_ego_vehicle, cov=cov, **fields)


def new_estimate(**fields: Any) -> Estimate:
    return Estimate(**{**STAMPS, **POSE, "epoch": 0, "valid": True, **fields})


def new_vehicle(vehicle: int, T_world_vehicle: SE2, **fields: Any) -> VehicleEstimate:
    return VehicleEstimate(vehicle=vehicle, T_world_vehicle=T_world_vehicle, **{**MOVES, **fields})
