"""Dynamic object localisation (paper, Fig. 2): tracking of vehicles in bird's-eye view.

`Tracker.localise_vehicles` places the boxes of a frame by the pseudo-lidar and by Eq. 1 and fuses both. The places
update tracks with persistent ids, from which vehicle_edges.py makes the CV and VV edges.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence

import msgspec
import numpy as np
from numpy.typing import NDArray

from birdslam.geometry.bev import RoadProfile
from birdslam.geometry.camera import Camera
from birdslam.geometry.se2 import SE2, wrap
from birdslam.perception import DepthMap, Detections
from birdslam.road_users.association import MAX_SQUARED_SIGMAS, assign_track_ids, match_track_ids, predict_boxes_px
from birdslam.road_users.life_cycle import LifeCycle
from birdslam.road_users.models.user_state import KINEMATIC, VELOCITY
from birdslam.road_users.placement.depth_fusion import DepthPlace, PseudoLidarConfig
from birdslam.road_users.placement.localisation import (
    LocalisationConfig,
    Observation,
    Place,
    extent_m,
    iou,
    observe_boxes,
)
from birdslam.road_users.placement.pseudolidar import FrustumNetwork, locate_by_depth
from birdslam.road_users.placement.vehicle_boxes import association_boxes
from birdslam.road_users.placing import Assignment, Placing
from birdslam.road_users.state.ground_size_filter import GroundSizeFilter
from birdslam.road_users.state.yaw_filter import YawFilter
from birdslam.road_users.track import EgoFrame, TrackingConfig, VehicleTrack, in_vehicle_axes
from birdslam.types import MotionEdge

Floats = NDArray[np.float64]


class Tracker:
    """Associates boxes with vehicles, and keeps the place, velocity and yaw of each.

    Readers: association and placing in the next frame, `yaw_filter.YawFilter`, and `vehicle_edges`. Planners read the
    pose graph instead.
    """

    def __init__(
        self,
        camera: Camera,
        config: TrackingConfig,
        localisation: LocalisationConfig,
        ground_size: GroundSizeFilter,
        pseudolidar: PseudoLidarConfig | None = None,
        frustum_network: FrustumNetwork | None = None,
        first_id: int = 0,
    ) -> None:
        self.camera = camera
        self.config = config
        self.localisation = localisation
        self.pseudolidar = pseudolidar or PseudoLidarConfig()
        self.frustum_network = frustum_network
        self.ground_size = ground_size
        self.placing = Placing(ground_size, localisation, self.pseudolidar, config.heading)
        self.yaw = YawFilter(config, localisation, ground_size)
        filters = self.placing.users, ground_size, self.placing.yaw_by_outline  # with one row per track
        self.life = LifeCycle[VehicleTrack](config, config.forget_s, filters, first_id)
        self._last: EgoFrame | None = None

    @property
    def tracks(self) -> list[VehicleTrack]:
        """The tracked vehicles."""
        return self.life.tracks

    def localise_vehicles(
        self,
        frame: EgoFrame,
        detections: Detections | None,
        depth: DepthMap | None = None,
        road: NDArray[np.bool_] | None = None,
    ) -> list[VehicleTrack]:
        """Returns the confirmed tracks with detections in this frame, ordered by id.

        The ground and size filter must be at this frame. `depth` and the mask `road` (H, W) are of this frame, or None.
        Without detections, tracks are predicted only.
        """
        if detections is None:
            return self.update(frame, None)
        observations = observe_boxes(
            detections.boxes_px,
            detections.scores,
            detections.labels,
            self.camera,
            self.ground_size.ground,
            self.localisation,
            detections.edge_sigma,
            detections.lower_edge,
        )
        if detections.track_ids is not None:
            observations = assign_track_ids(observations, detections.track_ids)
        observations, by_depth = locate_by_depth(
            observations,
            detections,
            depth,
            self.camera,
            self.ground_size.ground,
            self.pseudolidar,
            road,
            self.frustum_network,
        )
        return self.update(frame, observations, by_depth)

    def update(
        self,
        frame: EgoFrame,
        observations: list[Observation] | None,
        by_depth: Sequence[DepthPlace | None] = (),
    ) -> list[VehicleTrack]:
        """Predicts, associates, places, corrects, creates and deletes tracks; returns the confirmed observed ones.

        `by_depth` has the place by depth of each observation, or is empty. `observations` is None if no detector
        processed this frame.
        """
        self._predict(frame)
        if observations is not None:
            self.life.count_missed()
        assignments = self._assignments(frame, observations or [], by_depth)
        self._reclassify(assignments, frame.T_world_ego)
        places = self.placing.locate(assignments, frame.T_world_ego)
        self._correct(assignments, places, frame)
        self.life.delete_lost(frame.t_source_ns)
        return self.life.confirm(frame, lambda track: track.observation.track_id)

    def _predict(self, frame: EgoFrame) -> None:
        last = frame if self._last is None else self._last
        dt_s = max(0.0, (frame.t_source_ns - last.t_source_ns) * 1e-9)
        self.yaw.predict(dt_s)
        self.placing.predict(dt_s, frame.T_world_ego, frame.step_cov)
        for track in self.tracks:
            track.predicted_m = track.predicted_m + dt_s * track.velocity_mps
        self._last = frame

    def _assignments(
        self, frame: EgoFrame, observations: list[Observation], by_depth: Sequence[DepthPlace | None]
    ) -> list[Assignment]:
        """Assignments of observations to known tracks, then those of new tracks, each with its place by depth."""
        known = self._associate(frame.T_world_ego, observations)
        births = self.life.births([o.score for o in observations], (k for _, k in known))
        tracks: list[VehicleTrack | None] = [*self.tracks, *(None for _ in births)]
        pairs = [*known, *enumerate(births, len(self.tracks))]
        return [
            Assignment(
                row,
                tracks[row],
                self._with_voted_class(tracks[row], observations[k]),
                by_depth[k] if by_depth else None,
            )
            for row, k in pairs
        ]

    def _with_voted_class(self, track: VehicleTrack | None, seen: Observation) -> Observation:
        """The observation with the dimensions of its track's most frequent class."""
        label = seen.label if track is None else track.label_with(seen.label)
        if label == seen.label:
            return seen
        return msgspec.structs.replace(seen, dimensions=self.localisation.vehicles[label])

    def _reclassify(self, assignments: Sequence[Assignment], T_world_ego: SE2) -> None:
        """Changes the class of tracks whose most frequent label changes with these boxes."""
        for a in assignments:
            if a.track is not None and (label := a.track.label_with(a.observation.label)) != a.track.label:
                of_class, yaw_rad = self.localisation.vehicles, a.yaw_rad(T_world_ego, self.config.heading)
                depth_m, bearing = a.expected_depth_m(T_world_ego), a.observation.bearing
                now, before = (extent_m(of_class[k], yaw_rad, depth_m, bearing)[1] for k in (label, a.track.label))
                self.ground_size.reclassify(a.row, of_class[label], math.log(now / before))

    def _associate(self, T_world_ego: SE2, observations: list[Observation]) -> list[tuple[int, int]]:
        """Pairs (row of a track, its observation) with the largest total overlap within the gates."""
        if not self.tracks or not observations:
            return []
        if observations[0].track_id is not None:
            return match_track_ids(self.tracks, observations)
        profile = RoadProfile(self.ground_size.ground.height_m, self.ground_size.vertical_per_m)
        beside = np.array([t.observation.bearing - t.place.centre_m[1] / t.place.centre_m[0] for t in self.tracks])
        squared, _ = self.placing.users.distances(association_boxes(observations), T_world_ego, profile, beside)
        predicted = predict_boxes_px(self.tracks, self.camera, T_world_ego, self.ground_size.ground)
        overlap = np.nan_to_num(iou(predicted, np.array([o.box_px for o in observations])), nan=0.0)
        more = overlap - self.config.min_iou
        # A missing box costs as much as one at the bound, so that no box is shifted to another track
        return self.life.associate(-more, (more >= 0.0) & (squared[0] <= MAX_SQUARED_SIGMAS), 0.0)

    def _correct(self, assignments: Sequence[Assignment], places: Sequence[Place], frame: EgoFrame) -> None:
        """Updates the tracks by the places of their observations; starts those of new vehicles."""
        if not assignments:
            return
        stationary = self.placing.users.stationary_probability() > self.config.standing_probability
        moments = self.placing.users.moments(stands=stationary)
        for a, place in zip(assignments, places, strict=True):
            velocity_mps, cov = moments.mean[a.row, VELOCITY], moments.cov[a.row, KINEMATIC, KINEMATIC]
            if a.track is None:
                self.tracks.append(self._start_track(a, place, frame, velocity_mps, cov))
                self.yaw.correct_by_outline(a.row, self.tracks[-1], self.placing.yaw_by_outline)
                continue
            track = a.track
            track.motion = self._predicted_motion(track, frame)
            track.is_stationary = bool(stationary[a.row])
            track.velocity_mps, track.kinematic_cov = velocity_mps, cov
            track.observation, track.place = a.observation, place
            track.predicted_m = frame.T_world_ego @ place.centre_m
            self.life.observe(track, frame, a.observation.label)
            self.yaw.correct_by_motion(a.row, track)
            self.yaw.correct_by_body(a.row, track, a.by_depth)
            self.yaw.correct_by_outline(a.row, track, self.placing.yaw_by_outline)

    def _predicted_motion(self, track: VehicleTrack, frame: EgoFrame) -> MotionEdge | None:
        """VV edge by constant velocity; None for a track without a CV edge."""
        if track.last_edge is None:
            return None
        dt_s = (frame.t_source_ns - track.last_edge.t_ns) * 1e-9
        xx, xy, yy = in_vehicle_axes(track.kinematic_cov[2:, 2:], track.yaw_rad)
        by_acceleration = (self.config.sigma_accel_mps2 * dt_s**2 / 2.0) ** 2
        xx, xy, yy = xx * dt_s**2 + by_acceleration, xy * dt_s**2, yy * dt_s**2 + by_acceleration
        return MotionEdge(
            vehicle=track.number,
            from_frame=track.last_edge.frame,
            to_frame=frame.frame_id,
            T_from_to=track.last_edge.T_world_vehicle.between(track.pose()),
            cov=(xx, xy, 0.0, xy, yy, 0.0, 0.0, 0.0, (self.config.sigma_yaw_rate_radps * dt_s) ** 2),
        )

    def _start_track(
        self, assignment: Assignment, seen: Place, frame: EgoFrame, velocity_mps: Floats, kinematic_cov: Floats
    ) -> VehicleTrack:
        observation, by_depth = assignment.observation, assignment.by_depth
        if by_depth is not None and not by_depth.has_front:
            by_depth = None
        T_world_ego = frame.T_world_ego
        return VehicleTrack(
            yaw_rad=wrap(T_world_ego.yaw_rad + assignment.yaw_rad(T_world_ego, self.config.heading)),
            observation=observation,
            place=seen,
            velocity_mps=velocity_mps,
            kinematic_cov=kinematic_cov,
            predicted_m=T_world_ego @ seen.centre_m,
            frame=frame,
            votes=Counter({observation.label: 1}),
            sigma_yaw_rad=0.0 if by_depth is None else by_depth.sigma_yaw_rad,
            is_yaw_known=by_depth is not None,
            front_logit=0.0 if by_depth is None else by_depth.front_logit,
        )
