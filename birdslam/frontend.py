"""The front end: from one image and the networks' results to the edges of the pose graph (paper, Fig. 2)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Protocol

import msgspec
import numpy as np
from numpy.typing import NDArray

from birdslam.geometry.arrays import Bools, Floats, Ints
from birdslam.geometry.camera import Camera
from birdslam.geometry.se2 import SE2
from birdslam.lanes.amodal.landmark_edges import StaticMapConfig, landmark_edges
from birdslam.lanes.amodal.lane_edges import LaneEdgesConfig
from birdslam.lanes.amodal.lane_mapper import LaneHead, LaneMapper, LaneOutput
from birdslam.lanes.amodal.lanes import LanesConfig, LaneView
from birdslam.odometry.dead_reckoning import DeadReckoning
from birdslam.odometry.external import ExternalConfig
from birdslam.odometry.odometry import Motion, Odometry, OdometryConfig
from birdslam.odometry.plausibility import PlausibilityConfig, PlausibilityGate
from birdslam.perception import Perception
from birdslam.road_users.camera_height import CameraHeightConfig, CameraHeightEstimator
from birdslam.road_users.out_of_sequence import OpenFrame, OutOfSequenceConfig, OutOfSequenceTracker
from birdslam.road_users.people.people_config import PeopleConfig
from birdslam.road_users.people.people_records import followed_people
from birdslam.road_users.people.people_tracker import PeopleTracker
from birdslam.road_users.placement.depth_fusion import PseudoLidarConfig
from birdslam.road_users.placement.localisation import LocalisationConfig
from birdslam.road_users.placement.pseudolidar import FrustumNetwork
from birdslam.road_users.state.ground_size_config import GroundSizeConfig
from birdslam.road_users.state.ground_size_filter import GroundSizeFilter
from birdslam.road_users.track import EgoFrame, TrackingConfig
from birdslam.road_users.tracking import Tracker
from birdslam.road_users.vehicle_edges import vehicle_edges
from birdslam.types import (
    FIRST_PERSON,
    NS_PER_S,
    EgoEdge,
    Frame,
    Ground,
    LandmarkEdge,
    Measurements,
    MotionEdge,
    SpeedReading,
    Status,
    VehicleEdge,
)

MAX_GAP_NS = 5 * NS_PER_S  # between two frames; no filter can predict over a longer time
MEASURED_SIGMA_REL = 0.05  # a height or lens with a smaller sigma counts as measured


class FrontEndConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The parts of the front end."""

    odometry: OdometryConfig = OdometryConfig()
    external: ExternalConfig = ExternalConfig()  # of an external odometry, if its file is given
    plausibility: PlausibilityConfig = PlausibilityConfig()
    localisation: LocalisationConfig = LocalisationConfig()
    ground_size: GroundSizeConfig = GroundSizeConfig()
    pseudolidar: PseudoLidarConfig = PseudoLidarConfig()
    tracking: TrackingConfig = TrackingConfig()
    out_of_sequence: OutOfSequenceConfig = OutOfSequenceConfig()
    static_map: StaticMapConfig = StaticMapConfig()
    lanes: LanesConfig = LanesConfig()
    lane_edges: LaneEdgesConfig = LaneEdgesConfig()
    height: CameraHeightConfig = CameraHeightConfig()
    people: PeopleConfig = PeopleConfig()


class Pending(Protocol):
    """Results that the networks may still be computing; `perception.Networks.start` returns one."""

    def result(self) -> Perception: ...


class EgoMotion(Protocol):
    """The interface of an odometry; `odometry.Odometry` is that of the images."""

    def track(self, image: NDArray[np.uint8]) -> Any: ...

    def estimate(
        self,
        tracks: Any,
        frame_id: int,
        t_source_ns: int,
        vehicle_boxes_px: Floats,
        road_mask: Bools | None,
        speeds: Sequence[SpeedReading],
    ) -> Motion | None: ...

    @property
    def road_tracks(self) -> tuple[Ints, Floats]: ...

    @property
    def bonnet_px(self) -> Floats | None: ...


class FrontEnd:
    """Converts a frame to its `Measurements` (`measure`). Deterministic; owns no thread."""

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
        self._frustum_network = frustum_network
        self.height = CameraHeightEstimator(camera, config.height, config.localisation)
        self._lanes = LaneMapper(camera, config.static_map, config.lanes, config.lane_edges, lane_head)
        estimated = camera.scale_sigma_rel > MEASURED_SIGMA_REL
        self._scale_status = (Status.SCALE_ESTIMATED,) if estimated else ()
        self._last_frame: int | None = None
        self._last_t_ns = 0
        self._start()

    def _start(self, first_vehicle: int = 0, first_person: int = FIRST_PERSON) -> None:
        """Creates all parts that predict over time; ids of new road users start at the given numbers."""
        camera, config = self.camera, self.config
        self._dead_reckoning = DeadReckoning(camera, config.static_map.attitude_memory_m)
        self._plausibility = PlausibilityGate(config.plausibility)
        self.people = PeopleTracker(camera, config.people, config.tracking, config.localisation, first_person)
        self.vehicles = OutOfSequenceTracker(
            Tracker(
                camera,
                config.tracking,
                config.localisation,
                GroundSizeFilter(camera, config.ground_size),
                config.pseudolidar,
                self._frustum_network,
                first_vehicle,
            ),
            config.out_of_sequence,
            (self.people,),
        )
        self._present = EgoFrame(-1, 0, SE2())
        self._last = 0, 0.0, SE2()  # time, pitch of the camera relative to the horizon, and T_world_ego

    def measure(self, frame: Frame, pending: Pending) -> Measurements:
        """Returns the CC, CV, VV and CP edges of one frame (Sec. 3.1 and 3.2).

        `pending` is awaited after the feature tracking, which runs in parallel with the networks. A frame without an
        image gives only its status. Raises ValueError if the image size differs from the camera's.
        """
        status = [*frame.status, *self._dropped(frame)]
        if frame.image is None:
            return self._plausibility.admit(_measurements(frame, status, attitude=self._dead_reckoning.attitude))
        tracks = self.odometry.track(frame.image)
        perception = pending.result()

        motion, cc = self._move(frame, tracks, perception)  # scale-unambiguous ego-motion initialisation
        cv, vv = self._localise_vehicles(frame, motion, perception)  # dynamic object localisation
        status += self.height.update(cv, motion, frame.t_source_ns * 1e-9)
        cp = self._map_road(frame)  # static map initialisation
        lanes = self._map_lanes(frame, perception)  # lanes (Sec. 3.2)

        ground = self.vehicles.road.ground
        measurements = _measurements(
            frame,
            [
                *(*status, *lanes.status, *perception.status, *self._scale_status),
                *(motion.status if motion else (Status.NOT_INITIALISED,)),
            ],
            cc=cc,
            cv=cv,
            vv=vv,
            cp=(*cp, *lanes.edges),
            lanes=lanes.points,
            road_lanes=lanes.lanes,
            attitude=self._dead_reckoning.attitude,
            ground=Ground(height_m=ground.height_m, pitch_rad=ground.pitch_rad, roll_rad=ground.roll_rad),
            scale_sigma_rel=0.0 if motion is None else motion.scale_sigma_rel,
            speed_sources=() if motion is None else motion.speed_sources,
            camera_sigma_rel=self.camera.scale_sigma_rel,
            people=followed_people(self.people, self._present),
            ages=dict(perception.ages if lanes.age is None else perception.ages | {"lanes": lanes.age}),
        )
        return self._plausibility.admit(measurements)

    def lane_view(self) -> LaneView:
        """The grids and lanes around the newest frame's ego, for a picture."""
        return self._lanes.view(self._dead_reckoning.T_world_ego)

    def _dropped(self, frame: Frame) -> tuple[Status, ...]:
        """Reports missing frames; restarts after a gap in time.

        A clock that was set back is a gap too, unless the frame number falls too: then a looped source restarted.
        """
        last, self._last_frame = self._last_frame, frame.frame_id
        since_ns, self._last_t_ns = frame.t_source_ns - self._last_t_ns, frame.t_source_ns
        if last is None or frame.frame_id <= last:
            return ()
        gap = not 0 <= since_ns <= MAX_GAP_NS
        if gap:
            self._restart()
        return (Status.FRAMES_DROPPED,) if gap or frame.frame_id > last + 1 else ()

    def _restart(self) -> None:
        """Starts a new epoch: this frame has no edge to an earlier one, and all tracks are dropped."""
        if isinstance(self.odometry, Odometry):
            self.odometry.reset()
        self._lanes.clear()
        self._start(self.vehicles.tracker.life.next_id, self.people.life.next_id)

    def _move(self, frame: Frame, tracks: Any, perception: Perception) -> tuple[Motion | None, EgoEdge | None]:
        """The ego's motion in metres and its CC edge; None if the motion since earlier frames is unknown."""
        road = None if perception.segmentation is None else perception.segmentation.road
        motion = self.odometry.estimate(
            tracks, frame.frame_id, frame.t_source_ns, _boxes_px(perception), road, frame.speeds
        )
        if motion is None:
            self._lanes.clear()
            return None, None
        if Status.SCALE_INVALID in motion.status:
            self._lanes.forget_position()
        return motion, self._dead_reckoning.advance(motion)

    def _localise_vehicles(
        self, frame: Frame, motion: Motion | None, perception: Perception
    ) -> tuple[tuple[VehicleEdge, ...], tuple[MotionEdge, ...]]:
        """CV and VV edges of this frame's detections, or of late detections of an earlier frame."""
        opened = self._open_frame(frame, motion)
        self._present = opened.ego
        self.vehicles.open_frame(opened)
        age = perception.ages.get("detector", 0)
        depth = perception.depth if perception.ages.get("depth", 0) == age else None
        segmentation = perception.segmentation if perception.ages.get("segmenter", 0) == age else None
        road = None if segmentation is None else segmentation.road
        seen = self.vehicles.ingest_detections(
            perception.detections, frame.frame_id - age, depth, road, perception.awaited_from
        )
        return vehicle_edges(seen, opened.ego, self.vehicles.road.ground, self.camera, self.config.tracking)

    def _open_frame(self, frame: Frame, motion: Motion | None) -> OpenFrame:
        """The ego pose, the ground from this frame's image, and the change of pitch since the last frame."""
        t_source_ns, pitch_rad = frame.t_source_ns, self._dead_reckoning.attitude.pitch_rad
        T_world_ego = self._dead_reckoning.T_world_ego
        (last_ns, last_rad, T_world_last), self._last = self._last, (t_source_ns, pitch_rad, T_world_ego)
        step = T_world_last.between(T_world_ego)
        step_cov = None if motion is None else np.asarray(motion.cov)
        return OpenFrame(
            EgoFrame(frame.frame_id, t_source_ns, T_world_ego, step_cov),
            dt_s=max(0.0, (t_source_ns - last_ns) * 1e-9),
            turn_rad=None if motion is None else pitch_rad - last_rad,
            image_ground=None if motion is None else motion.ground,
            image_cov=None if motion is None else motion.tilt_cov,
            travelled_m=None if motion is None else math.hypot(step.x_m, step.y_m),
            vertical=self._lanes.vertical,
        )

    def _map_road(self, frame: Frame) -> tuple[LandmarkEdge, ...]:
        """CP edges of the features on the road."""
        road, (ids, px) = self.vehicles.road, self.odometry.road_tracks
        return landmark_edges(
            ids,
            px,
            frame.frame_id,
            self.camera,
            road.ground,
            road.sigma_pitch_rad,
            self.config.static_map,
            road.vertical_per_m,
        )

    def _map_lanes(self, frame: Frame, perception: Perception) -> LaneOutput:
        """Lane points and edges from the latest segmentation."""
        road, age = self.vehicles.road, perception.ages.get("segmenter", 0)
        return self._lanes.map_lanes(
            frame.frame_id,
            self._dead_reckoning.T_world_ego,
            road.ground,
            (road.sigma_pitch_rad, road.sigma_roll_rad),
            perception.segmentation,
            frame.frame_id - age,
            _boxes_px(perception),
            frame.image,
            frame.t_source_ns,
            self.odometry.bonnet_px,
        )


def _boxes_px(perception: Perception) -> Floats:
    return np.zeros((0, 4)) if perception.detections is None else perception.detections.boxes_px


def _measurements(frame: Frame, status: list[Status], **fields: object) -> Measurements:
    return Measurements(
        frame_id=frame.frame_id,
        t_source_ns=frame.t_source_ns,
        t_capture_ns=frame.t_capture_ns,
        t_utc_ns=frame.t_utc_ns,
        status=tuple(dict.fromkeys(status)),
        **fields,  # type: ignore[arg-type]
    )
