"""CV and VV edges of a frame (paper, Eq. 2), from the tracks of current or late detections.

Edges end in the current frame. A vehicle of an earlier frame is extrapolated by its velocity, with a larger covariance.
"""

from __future__ import annotations

from dataclasses import replace

import msgspec
import numpy as np
from numpy.typing import NDArray

from birdslam.geometry.camera import Camera, GroundPlane
from birdslam.geometry.se2 import SE2, wrap
from birdslam.road_users.association import predict_boxes_px
from birdslam.road_users.track import EgoFrame, LastEdge, TrackingConfig, VehicleTrack, in_vehicle_axes
from birdslam.types import MotionEdge, VehicleEdge


def vehicle_edges(
    tracks: list[VehicleTrack], present: EgoFrame, ground: GroundPlane, camera: Camera, config: TrackingConfig
) -> tuple[tuple[VehicleEdge, ...], tuple[MotionEdge, ...]]:
    """CV and VV edges of tracks that were all observed in one frame, the current or an earlier one.

    Edges end in `present`; `ground` is the road under the camera in it.
    """
    cv, vv = [], []
    late = bool(tracks) and tracks[0].frame.frame_id != present.frame_id
    now = _extrapolated(tracks, present, ground, camera, config) if late else tracks
    for seen, track in zip(tracks, now, strict=True):
        if track is None:
            continue
        cv.append(_vehicle_edge(track, present.t_source_ns - seen.frame.t_source_ns, config))
        if track.motion is not None:
            vv.append(track.motion)
        seen.last_edge = LastEdge(present.frame_id, present.t_source_ns, track.pose())
    return tuple(cv), tuple(vv)


def _vehicle_edge(track: VehicleTrack, delay_ns: int, config: TrackingConfig) -> VehicleEdge:
    seen, place = track.observation, track.place
    yaw_rad = wrap(wrap(-track.frame.T_world_ego.yaw_rad) + track.yaw_rad)
    xx, xy, yy = in_vehicle_axes(place.cov, yaw_rad)  # in the tangent space at the vehicle's pose
    least_rad = config.sigma_yaw_moving_rad if track.is_yaw_known else config.sigma_yaw_unknown_rad
    var_yaw = least_rad**2 + track.sigma_yaw_rad**2
    return VehicleEdge(
        vehicle=track.number,
        frame=track.frame.frame_id,
        T_ego_vehicle=SE2(float(place.centre_m[0]), float(place.centre_m[1]), yaw_rad),
        cov=(xx, xy, 0.0, xy, yy, 0.0, 0.0, 0.0, var_yaw),
        label=track.label,
        score=seen.score,
        box_px=seen.box_px,
        length_m=seen.dimensions.length_m,
        width_m=seen.dimensions.width_m,
        delay_ns=max(delay_ns, 0),
        **({} if place.assumed is None else msgspec.structs.asdict(place.assumed)),
    )


def _extrapolated(
    tracks: list[VehicleTrack], present: EgoFrame, ground: GroundPlane, camera: Camera, config: TrackingConfig
) -> list[VehicleTrack | None]:
    """Extrapolates tracks of one frame to the current one by their velocities.

    None if a vehicle left the view or its velocity is too uncertain.
    """
    dt_s, T_world_then = (present.t_source_ns - tracks[0].frame.t_source_ns) * 1e-9, tracks[0].frame.T_world_ego
    steps = np.array([track.velocity_mps for track in tracks]) * dt_s
    cov = np.array([track.kinematic_cov for track in tracks])
    drift = cov[:, 2:, 2:] * dt_s**2
    drift += np.eye(2) * (config.sigma_accel_mps2 * dt_s**2 / 2.0) ** 2
    moved = [replace(track, predicted_m=track.predicted_m + step) for track, step in zip(tracks, steps, strict=True)]
    boxes = predict_boxes_px(moved, camera, present.T_world_ego, ground)
    known = (np.linalg.eigvalsh(drift)[:, -1] <= config.late_sigma_m**2) & np.isfinite(boxes).all(axis=1)
    R_world_then, R_now_world = T_world_then.rotation(), present.T_world_ego.rotation().T
    places_cov = R_world_then @ np.array([track.place.cov for track in tracks]) @ R_world_then.T + drift
    places_cov += dt_s * (cov[:, 2:, :2] + cov[:, :2, 2:])  # both are from the same boxes
    places_cov = R_now_world @ places_cov @ R_now_world.T
    centres = np.array([track.place.centre_m for track in tracks])
    centres = present.T_world_ego.inverse() @ (T_world_then @ centres + steps)
    for k, (track, box) in enumerate(zip(moved, boxes.tolist(), strict=True)):
        track.place = msgspec.structs.replace(track.place, centre_m=centres[k], cov=places_cov[k])
        track.observation = msgspec.structs.replace(track.observation, box_px=tuple(box))
        track.frame = present
        if track.motion is not None:
            track.motion = _extrapolated_motion(track.motion, track, present.frame_id, steps[k], drift[k], config, dt_s)
    return [track if certain else None for track, certain in zip(moved, known.tolist(), strict=True)]


def _extrapolated_motion(
    motion: MotionEdge,
    track: VehicleTrack,
    frame_id: int,
    step_m: NDArray[np.float64],
    drift: NDArray[np.float64],
    config: TrackingConfig,
    dt_s: float,
) -> MotionEdge:
    """Extrapolates a VV edge to a later frame by the same velocity."""
    R_vehicle_world = SE2(yaw_rad=track.yaw_rad).rotation().T
    ahead_m, left_m = (R_vehicle_world @ step_m).tolist()
    cov = np.reshape(motion.cov, (3, 3)).copy()
    cov[:2, :2] += R_vehicle_world @ drift @ R_vehicle_world.T
    cov[2, 2] += (config.sigma_yaw_rate_radps * dt_s) ** 2
    return msgspec.structs.replace(
        motion, to_frame=frame_id, T_from_to=motion.T_from_to @ SE2(ahead_m, left_m), cov=tuple(cov.ravel().tolist())
    )
