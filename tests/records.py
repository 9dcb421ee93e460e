"""Records for tests: every field that a test does not name is zero."""

from __future__ import annotations

from typing import Any

from birdslam.geometry.se2 import SE2
from birdslam.types import Estimate, FrameRef, Measurements, VehicleEstimate

STAMPS = {"frame_id": 0, "t_source_ns": 0, "t_capture_ns": 0, "t_utc_ns": 0}
POSE = {"T_world_ego": SE2(), "cov": (0.0,) * 9}
MOVES = {"cov": (0.0,) * 9, "velocity_mps": (0.0, 0.0), "velocity_cov": (0.0,) * 4, "age_ns": 0, "frames": 1}


def new_frame_ref(**fields: Any) -> FrameRef:
    return FrameRef(**{**STAMPS, **fields})


def new_measurements(**fields: Any) -> Measurements:
    return Measurements(**{**STAMPS, **fields})


def new_estimate(**fields: Any) -> Estimate:
    return Estimate(**{**STAMPS, **POSE, "epoch": 0, "valid": True, **fields})


def new_vehicle(vehicle: int, T_world_vehicle: SE2, **fields: Any) -> VehicleEstimate:
    return VehicleEstimate(vehicle=vehicle, T_world_vehicle=T_world_vehicle, **{**MOVES, **fields})
