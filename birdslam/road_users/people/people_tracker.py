"""Tracking of people: association, new tracks, deletion. Ids persist through a second of occlusion."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from birdslam.geometry.arrays import Floats
from birdslam.geometry.bev import RoadProfile
from birdslam.geometry.camera import Camera
from birdslam.perception import Detections
from birdslam.road_users.association import MAX_SQUARED_SIGMAS
from birdslam.road_users.life_cycle import LifeCycle
from birdslam.road_users.models.user_filter import UserFilter
from birdslam.road_users.out_of_sequence import OpenFrame
from birdslam.road_users.people.box_model import MIN_DT_S, MIN_SLOPE, measured_boxes, road_tilts
from birdslam.road_users.people.people_boxes import (
    BICYCLE,
    CYCLIST,
    PEDESTRIAN,
    PersonBox,
    observe_people,
)
from birdslam.road_users.people.people_config import PeopleConfig
from birdslam.road_users.placement.localisation import LocalisationConfig
from birdslam.road_users.state.ground_size_filter import GroundSizeFilter
from birdslam.road_users.track import Track, TrackingConfig
from birdslam.types import FIRST_PERSON

BIRTH_ITERATIONS = 4  # of the update by the first box
NEW_PER_S = 1.0  # rate of new people, per unit of bearing, slope and log height
SIDE_MARGIN = 0.03  # of the image width, beyond which a person has left
MAX_OUTSIDE_S = 0.3  # until a person outside the image is removed
MIN_STATIONARY_PROBABILITY, MIN_STAY_PROBABILITY = 0.7, 0.4  # hysteresis of standing
FORGET_S = 1.5  # without a box, with an id
SEEN_FOR_S = 1.1  # mean time until a person has no box
HIDDEN_FOR_S = 0.65  # mean time until the box returns
SIGMA_SHAPE = 0.07  # of the log aspect of a box, between two boxes
SIGMA_SHAPES = 0.17  # of the log aspect among people
SHAPE_DOF = 3.0  # of Student's t of the log aspect
MAX_TRACKS = 60  # maximum number of tracks: the nearest


@dataclass(kw_only=True)
class PersonTrack(Track):
    """A tracked person, in the row of the filter with its index."""

    box: PersonBox  # last one
    is_stationary: bool = False  # with hysteresis
    outside_s: float = 0.0  # time outside the image, as predicted

    @property
    def label(self) -> str:
        """The class; a bicycle with an occasionally detected rider is a cyclist."""
        return CYCLIST if self.votes[CYCLIST] * 2 >= self.votes[PEDESTRIAN] and self.votes[CYCLIST] else PEDESTRIAN

    @property
    def label_probability(self) -> float:
        """Probability of the class by the rule of succession."""
        of = self.votes[self.label]
        return (of + 1.0) / (self.votes[PEDESTRIAN] + self.votes[CYCLIST] + 2.0)


class PeopleTracker:
    """Calls: settle() for each frame in order, with its detections or without.

    The road is the front end's ground in that frame, with its vertical curvature.
    """

    def __init__(
        self,
        camera: Camera,
        config: PeopleConfig,
        tracking: TrackingConfig,
        localisation: LocalisationConfig,
        first_id: int = FIRST_PERSON,
    ) -> None:
        """`tracking` and `localisation` are those of vehicles, for what both have in common."""
        self.camera = camera
        self.config = config
        self.tracking = tracking
        self.localisation = localisation
        self.filter = UserFilter(config.kinds)
        self.life = LifeCycle[PersonTrack](tracking, FORGET_S, (self.filter,), first_id)
        self.frame: OpenFrame | None = None  # last settled frame

    @property
    def tracks(self) -> list[PersonTrack]:
        """The tracked people."""
        return self.life.tracks

    def settle(self, frame: OpenFrame, detections: Detections | None, road: GroundSizeFilter) -> None:
        """Processes the next frame; `detections` is None if no detector processed it, `road` is the ground in it."""
        ego, ground = frame.ego, road.ground
        profile = RoadProfile(ground.height_m, road.vertical_per_m)
        self.filter.predict(frame.dt_s, ego.T_world_ego, ego.step_cov, road.step)
        self.frame = frame
        if detections is not None:
            self.life.count_missed()
            boxes = observe_people(detections, self.camera, ground, self.localisation)
            pairs = self._associate(boxes, frame, profile)
            seen, unseen_s = [boxes[k] for _, k in pairs], []
            measured = measured_boxes(seen, ego.T_world_ego, self.config)
            self.filter.correct([row for row, _ in pairs], measured, ego.T_world_ego, profile)
            for row, k in pairs:
                track = self.tracks[row]
                unseen_s.append((ego.t_source_ns - track.frame.t_source_ns) * 1e-9)
                track.box = boxes[k]
                self.life.observe(track, ego, boxes[k].label)
            born = self._start_tracks(boxes, {k for _, k in pairs}, frame, profile)
            unseen_s += [math.inf] * len(born)
            road.correct_by_people(road_tilts([*seen, *born], unseen_s, profile, self.config))
            self.filter.set_common_priors(np.array([(0.0, road.sigma_pitch_rad**2), road.bodies]))
        self._finish_frame(frame)

    def _associate(self, boxes: Sequence[PersonBox], frame: OpenFrame, road: RoadProfile) -> list[tuple[int, int]]:
        """Pairs (row, box) of least total cost, -2 log likelihood within the gate."""
        if not boxes or not self.tracks:
            return []
        squared, costs = self.filter.distances(
            measured_boxes(boxes, frame.ego.T_world_ego, self.config), frame.ego.T_world_ego, road
        )
        costs += self._shape_costs(boxes)
        squared, costs = np.where(costs[0] <= costs[1], squared[0], squared[1]), costs.min(axis=0)
        last_ns = max(track.frame.t_source_ns for track in self.tracks)
        since_s = max((frame.ego.t_source_ns - last_ns) * 1e-9, MIN_DT_S)
        costs += self._detection_costs(since_s) + self._class_costs(boxes)
        return self.life.associate(costs, squared <= MAX_SQUARED_SIGMAS, -2.0 * math.log(NEW_PER_S * since_s))

    def _detection_costs(self, since_s: float) -> Floats:
        """(N, 1) -2 log odds that each person has a box, by a Markov chain.

        So an occluded person does not take the box of the person in front.
        """
        lost = -math.expm1(-since_s / SEEN_FOR_S)
        found = -math.expm1(-since_s / HIDDEN_FOR_S)
        last = max(track.frame.frame_id for track in self.tracks)
        again = np.where([track.frame.frame_id == last for track in self.tracks], 1.0 - lost, found)
        return np.asarray(-2.0 * np.log(again / (1.0 - again)))[:, None]

    def _class_costs(self, boxes: Sequence[PersonBox]) -> Floats:
        """(N, M) -2 log probability of each box's class by the votes of each track (rule of succession)."""
        rides = np.array([box.label != PEDESTRIAN for box in boxes])
        walked = np.array([track.votes[PEDESTRIAN] for track in self.tracks])[:, None]
        all_votes = np.array([track.votes.total() for track in self.tracks])[:, None]
        return np.asarray(-2.0 * np.log((np.where(rides, all_votes - walked, walked) + 1.0) / (all_votes + 2.0)))

    def _shape_costs(self, boxes: Sequence[PersonBox]) -> Floats:
        """(2, N, M) -2 log likelihood ratio of the shape of each box, given the last box of each track.

        With visible feet (first) the aspect stays, with hidden feet (second) the width, while the height shrinks.
        Student's t, since limbs swing and are occluded.
        """
        before = [track.box for track in self.tracks]
        (last_width, last), (now_width, now) = (
            (
                np.array([box.log_width for box in of]),
                np.array([box.log_width - math.log(max(box.tan_height, MIN_SLOPE)) for box in of]),
            )
            for of in (before, boxes)
        )
        off = np.stack([np.subtract.outer(last, now), np.subtract.outer(last_width, now_width)])
        squared = np.square(off / SIGMA_SHAPE)
        cost = (SHAPE_DOF + 1.0) * np.log1p(squared / SHAPE_DOF) + 2.0 * math.log(SIGMA_SHAPE / SIGMA_SHAPES)
        same = np.equal.outer([box.label for box in before], [box.label for box in boxes])
        return np.where(same, cost, 0.0)

    def _start_tracks(
        self, boxes: list[PersonBox], matched: set[int], frame: OpenFrame, road: RoadProfile
    ) -> list[PersonBox]:
        """Starts tracks of unmatched boxes, and returns these."""
        unmatched = self.life.births([box.score for box in boxes], matched)
        births = [boxes[k] for k in unmatched if boxes[k].label != BICYCLE]
        ego = frame.ego
        if not births:
            return births
        seen, before = measured_boxes(births, ego.T_world_ego, self.config), len(self.filter)
        kinds = [self.config.kind(box.label) for box in births]
        heights = np.array([self.config.kinds[kind].heights for kind in kinds])
        self.filter.add(kinds, seen, heights, np.zeros(len(births)), ego.T_world_ego)
        self.filter.correct(range(before, len(self.filter)), seen, ego.T_world_ego, road, BIRTH_ITERATIONS)
        self.tracks.extend(PersonTrack(frame=ego, box=box, votes=Counter({box.label: 1})) for box in births)
        return births

    def _finish_frame(self, frame: OpenFrame) -> None:
        """Removes lost tracks, assigns ids, decides which people are standing."""
        if not self.tracks:
            return
        ego, moments = frame.ego, self.filter.moments()
        at = (moments.mean[:, :2] - [ego.T_world_ego.x_m, ego.T_world_ego.y_m]) @ ego.T_world_ego.rotation()
        edge = (0.5 + SIDE_MARGIN) * self.camera.width_px / self.camera.fx_px
        for (x_m, y_m), standing, track in zip(at.tolist(), moments.standing.tolist(), self.tracks, strict=True):
            outside = (x_m < 1.0 or abs(y_m) > edge * x_m) and track.frame.t_source_ns != ego.t_source_ns
            track.outside_s = track.outside_s + frame.dt_s if outside else 0.0
            track.is_stationary = standing > (
                MIN_STAY_PROBABILITY if track.is_stationary else MIN_STATIONARY_PROBABILITY
            )
        away_m = np.linalg.norm(at, axis=1)
        farthest_m = np.sort(away_m)[min(MAX_TRACKS, len(away_m)) - 1]
        gone = (away_m > farthest_m) | ~np.isfinite(away_m)
        tracks = self.tracks
        self.life.delete_lost(ego.t_source_ns, lambda row: bool(gone[row]) or tracks[row].outside_s > MAX_OUTSIDE_S)
        self.life.confirm(ego)
