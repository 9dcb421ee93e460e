"""The front end, from one image and what the networks say of it to the edges of the pose graph (paper, Fig. 2)."""

from __future__ import annotations

import math
from typing import Any, Protocol

import msgspec
import numpy as np
from numpy.typing import NDArray

from birdslam.geometry.camera import Camera, GroundPlane
from birdslam.geometry.se2 import SE2
from birdslam.mapping.landmark_edges import StaticMapConfig, landmark_edges
from birdslam.mapping.lane_edges import LaneEdgesConfig
from birdslam.mapping.lane_mapper import LaneHead, LaneMapper
from birdslam.mapping.lanes import LanesConfig
from birdslam.odometry.odometry import Motion, Odometry, OdometryConfig
from birdslam.perception import Perception
from birdslam.types import Attitude, EgoEdge, Frame, Ground, Measurements, Status
from birdslam.vehicles.camera_height import HeightWatch, HeightWatchConfig
from birdslam.vehicles.depth_fusion import PseudoLidarConfig
from birdslam.vehicles.ground_size_filter import GroundSizeConfig, GroundSizeFilter
from birdslam.vehicles.localisation import LocalisationConfig
from birdslam.vehicles.out_of_sequence import OpenFrame, OutOfSequenceConfig, OutOfSequenceTracker
from birdslam.vehicles.pseudolidar import FrustumNetwork
from birdslam.vehicles.track import EgoFrame, TrackingConfig
from birdslam.vehicles.tracking import Tracker
from birdslam.vehicles.vehicle_edges import vehicle_edges


class FrontEndConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The parts of the front end."""

    odometry: OdometryConfig = OdometryConfig()
    localisation: LocalisationConfig = LocalisationConfig()
    ground_size: GroundSizeConfig = GroundSizeConfig()
    pseudolidar: PseudoLidarConfig = PseudoLidarConfig()
    tracking: TrackingConfig = TrackingConfig()
    out_of_sequence: OutOfSequenceConfig = OutOfSequenceConfig()
    static_map: StaticMapConfig = StaticMapConfig()
    lanes: LanesConfig = LanesConfig()
    lane_edges: LaneEdgesConfig = LaneEdgesConfig()
    height: HeightWatchConfig = HeightWatchConfig()


class Pending(Protocol):
    """What the networks are still at work on; `perception.Networks.start` returns one."""

    def result(self) -> Perception: ...


class EgoMotion(Protocol):
    """What the front end asks of an odometry; `odometry.Odometry` measures it in the images."""

    def track(self, image: NDArray[np.uint8]) -> Any: ...

    def estimate(
        self,
        tracks: Any,
        frame_id: int,
        t_source_ns: int,
        vehicle_boxes_px: NDArray[np.float64],
        road_mask: NDArray[np.bool_] | None,
    ) -> Motion | None: ...

    @property
    def road_tracks(self) -> tuple[NDArray[np.int64], NDArray[np.float64]]: ...


class FrontEnd:
    """step(): one frame in, its `Measurements` out. Deterministic; owns no thread."""

    def __init__(
        self,
        camera: Camera,
        config: FrontEndConfig,
        odometry: EgoMotion | None = None,
        frustum_network: FrustumNetwork | None = None,
        lane_head: LaneHead = LaneHead(),  # noqa: B008
    ) -> None:
        self.camera = camera
        self.config = config
        self.odometry: EgoMotion = odometry or Odometry(camera, config.odometry)
        self.vehicles = OutOfSequenceTracker(
            Tracker(camera, config.tracking, config.localisation, config.pseudolidar, frustum_network),
            GroundSizeFilter(camera, config.ground_size),
            config.out_of_sequence,
        )
        self._reckoning = DeadReckoning(camera, config.static_map.attitude_memory_m)
        self._lanes = LaneMapper(camera, config.static_map, config.lanes, config.lane_edges, lane_head)
        self.height = HeightWatch(camera, config.height, config.localisation)
        self._last_frame: int | None = None
        self._last_pitch = (0, 0.0)  # when, and the camera's against the level

    def step(self, frame: Frame, pending: Pending) -> Measurements:
        """`pending` is waited for after the feature tracking, which runs beside the networks."""
        status = [*frame.status, *self._dropped(frame)]
        if frame.image is None:
            return _measurements(frame, status, attitude=self._reckoning.attitude)

        # Ego motion and static map initialisation
        tracks = self.odometry.track(frame.image)
        perception = pending.result()
        detections, segmentation = perception.detections, perception.segmentation
        boxes_px = np.zeros((0, 4)) if detections is None else detections.boxes_px
        road = None if segmentation is None else segmentation.road
        motion = self.odometry.estimate(tracks, frame.frame_id, frame.t_source_ns, boxes_px, road)
        if motion is None:
            self._lanes.clear()
        cc = None if motion is None else self._advance(motion)
        T_world_ego = self._reckoning.T_world_ego
        opened = self._open_frame(frame, motion)
        self.vehicles.open_frame(opened)

        # Dynamic object localisation: of this very frame, or of the earlier one that late detections are of
        age = perception.ages.get("detector", 0)
        depth = perception.depth if perception.ages.get("depth", 0) == age else None
        road_then = road if perception.ages.get("segmenter", 0) == age else None
        tracks_seen = self.vehicles.ingest_detections(detections, frame.frame_id - age, depth, road_then)
        ground, sigma_pitch_rad = self.vehicles.road.ground, self.vehicles.road.sigma_pitch_rad
        cv, vv = vehicle_edges(tracks_seen, opened.ego, ground, self.camera, self.config.tracking)
        status += self.height.judge(cv, motion)

        # Lanes, by what is known of this frame's road or an earlier one's (Sec. 3.2)
        segmented = frame.frame_id - perception.ages.get("segmenter", 0)
        lanes = self._lanes.step(
            frame.frame_id, T_world_ego, ground, sigma_pitch_rad, segmentation, segmented, boxes_px
        )
        status += lanes.status
        ages = perception.ages if lanes.age is None else perception.ages | {"lanes": lanes.age}

        return _measurements(
            frame,
            [*status, *perception.status, *(motion.status if motion else (Status.NOT_INITIALISED,))],
            cc=cc,
            cv=cv,
            vv=vv,
            cp=(
                *landmark_edges(
                    *self.odometry.road_tracks,
                    frame.frame_id,
                    self.camera,
                    ground,
                    sigma_pitch_rad,
                    self.config.static_map,
                ),
                *lanes.edges,
            ),
            lanes=lanes.points,
            attitude=self._reckoning.attitude,
            ground=Ground(height_m=ground.height_m, pitch_rad=ground.pitch_rad, roll_rad=ground.roll_rad),
            scale_sigma_rel=0.0 if motion is None else motion.scale_sigma_rel,
            ages=dict(ages),
        )

    def _dropped(self, frame: Frame) -> tuple[Status, ...]:
        gap = self._last_frame is not None and frame.frame_id > self._last_frame + 1
        self._last_frame = frame.frame_id
        return (Status.FRAMES_DROPPED,) if gap else ()

    def _open_frame(self, frame: Frame, motion: Motion | None) -> OpenFrame:
        """The ego, and the road as this frame's image and the camera's own pitching since the last frame give it."""
        t_source_ns, pitch_rad = frame.t_source_ns, self._reckoning.attitude.pitch_rad
        (last_ns, last_rad), self._last_pitch = self._last_pitch, (t_source_ns, pitch_rad)
        step_cov = None if motion is None else np.asarray(motion.cov)
        return OpenFrame(
            EgoFrame(frame.frame_id, t_source_ns, self._reckoning.T_world_ego, step_cov),
            dt_s=max(0.0, (t_source_ns - last_ns) * 1e-9),
            turn_rad=None if motion is None else pitch_rad - last_rad,
            image_ground=None if motion is None else motion.ground,
            image_sigma_rad=0.0 if motion is None else motion.pitch_sigma_rad,
        )

    def _advance(self, motion: Motion) -> EgoEdge:
        """CC, from the frame of the last one: a coasted frame has a pose of its own, which the next edge starts from.

        So a long blindness is a chain of edges, none of which reaches back to a frame that the graph has let go.
        """
        last_frame, T_world_last = self._reckoning.frame, self._reckoning.T_world_ego
        self._reckoning.advance(motion)
        chained = last_frame not in (-1, motion.from_frame)
        return EgoEdge(
            from_frame=last_frame if chained else motion.from_frame,
            to_frame=motion.to_frame,
            T_from_to=T_world_last.between(self._reckoning.T_world_ego) if chained else motion.T_prev_curr,
            cov=tuple(np.ravel(motion.cov).tolist()),
        )


class DeadReckoning:
    """The odometry's motions chained: the ego on the road plane, for the tracker, and its height and tilt.

    A motion starts at the frame that it names, which need not be the newest: one that coasted is superseded by the next
    that was measured.
    """

    def __init__(self, camera: Camera, memory_m: float) -> None:
        self._T_ego_cam = np.eye(4)
        self._T_ego_cam[:3, :3] = camera.ground.R_ego_cam
        self._T_ego_cam[2, 3] = camera.height_m
        self._T_cam_ego = np.linalg.inv(self._T_ego_cam)
        self._memory_m = memory_m
        self.T_world_ego = SE2()
        self.attitude = Attitude()
        self._from = (-1, self.T_world_ego, self.attitude)  # the frame that the last motion started from
        self._to = self._from

    @property
    def frame(self) -> int:
        """The frame that `T_world_ego` is of; -1 before the first motion."""
        return self._to[0]

    def advance(self, motion: Motion) -> None:
        """To `motion.to_frame`, from the pose of `motion.from_frame` where that was the last motion's start or end."""
        if motion.from_frame != self._from[0] or self._from[0] < 0:
            self._from = (motion.from_frame, *self._to[1:])
        _, T_world_ego, attitude = self._from
        T_prev_curr = np.eye(4)
        T_prev_curr[:3, :3] = motion.R_prev_curr
        T_prev_curr[:3, 3] = motion.t_prev_curr_m
        T_ego_prev_curr = self._T_ego_cam @ T_prev_curr @ self._T_cam_ego
        R = _tilt(attitude) @ T_ego_prev_curr[:3, :3]
        dz_m = float((_tilt(attitude) @ T_ego_prev_curr[:3, 3])[2])
        keep = math.exp(-float(np.linalg.norm(motion.t_prev_curr_m)) / self._memory_m)
        self.T_world_ego = T_world_ego @ motion.T_prev_curr
        self.attitude = Attitude(
            z_m=attitude.z_m + dz_m,
            pitch_rad=keep * math.asin(max(-1.0, min(1.0, -R[2, 0]))),
            roll_rad=keep * math.atan2(R[2, 1], R[2, 2]),
        )
        self._to = (motion.to_frame, self.T_world_ego, self.attitude)


def _tilt(attitude: Attitude) -> NDArray[np.float64]:
    """(3, 3) Ry(pitch) Rx(roll): ego to a frame of the same yaw that is level."""
    level = GroundPlane(1.0, attitude.pitch_rad, attitude.roll_rad).R_ego_cam
    out: NDArray[np.float64] = level @ GroundPlane(1.0).R_ego_cam.T
    return out


def _measurements(frame: Frame, status: list[Status], **fields: object) -> Measurements:
    return Measurements(
        frame_id=frame.frame_id,
        t_source_ns=frame.t_source_ns,
        t_capture_ns=frame.t_capture_ns,
        t_utc_ns=frame.t_utc_ns,
        status=tuple(dict.fromkeys(status)),
        **fields,  # type: ignore[arg-type]
    )
