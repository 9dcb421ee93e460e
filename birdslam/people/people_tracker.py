"""People followed through time: which box is whom, who is new, who is gone.

Ids last through a second of hiding.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field

import msgspec
import numpy as np

from birdslam.geometry.arrays import Floats
from birdslam.geometry.bev import RoadProfile
from birdslam.geometry.camera import Camera
from birdslam.people.box_model import MIN_SLOPE
from birdslam.people.people_boxes import BICYCLE, CYCLIST, PEDESTRIAN, PeopleBoxesConfig, PersonBox, people_boxes
from birdslam.people.people_config import PeopleConfig
from birdslam.people.people_filter import PeopleFilter
from birdslam.perception import Detections
from birdslam.types import FIRST_PERSON
from birdslam.vehicles.out_of_sequence import OpenFrame
from birdslam.vehicles.placement.localisation import iou
from birdslam.vehicles.state.ground_size_filter import GroundSizeFilter

NEVER = 1e9  # the cost of what can't be
NEW_PER_S = 1.0  # how many new people a second begin, in a unit of bearing, slope and log height: about the image
MIN_DT_S = 1e-3
SIDE_MARGIN = 0.03  # of the image's width: who is predicted farther outside has left
UNKNOWN_MPS = 10.0  # an ego of unknown motion is taken to drive
LEAVES_S = 0.3  # until who left the image is forgotten

SHAPE_DOF = 3.0  # of Student's t

STANDS, WALKS = 0.7, 0.4  # probability of standing: hysteresis of what is reported


class PeopleTrackingConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """When boxes are the same person."""

    gate: float = 16.3  # squared Mahalanobis distance of bearing, bottom and top: 99.9 % of three
    birth_score: float = 0.5  # a box must reach it to begin a track
    birth_iou: float = 0.55  # a box that overlaps a followed one's more begins none
    confirm_hits: int = 2  # a track gets its id when it has been seen so often
    forget_unconfirmed_s: float = 0.25  # without a box, of who has no id yet
    forget_s: float = 1.5  # without a box, of who has an id
    seen_for_s: float = 1.1  # on average, until somebody has no box: hidden, or missed
    hidden_for_s: float = 0.65  # and until one comes back
    sigma_shape: float = 0.07  # of the log of a box's width over its height, from one box to the next
    sigma_stride: float = 0.14  # and beside it, as arms and legs swing
    stride_s: float = 1.0  # in so long
    sigma_shapes: float = 0.17  # of the same from one person to another
    most: int = 60  # who is followed at once: the nearest
    boxes: PeopleBoxesConfig = PeopleBoxesConfig()  # how sure boxes are
    people: PeopleConfig = PeopleConfig()  # how people are and move


@dataclass
class PersonTrack:
    """One followed person, in the row of the filter at which it stands."""

    box: PersonBox  # the last one
    seen_ns: int
    seen_frame: int
    person: int = -1  # the persistent id, once confirmed
    hits: int = 1
    votes: Counter[str] = field(default_factory=Counter)
    stands: bool = False  # with hysteresis
    outside_s: float = 0.0  # for how long it has been predicted outside the image

    @property
    def label(self) -> str:
        """A bicycle whose rider was seen now and then is a cyclist's."""
        return CYCLIST if self.votes[CYCLIST] * 2 >= self.votes[PEDESTRIAN] and self.votes[CYCLIST] else PEDESTRIAN

    @property
    def label_probability(self) -> float:
        """By Laplace's rule of succession."""
        of = self.votes[self.label]
        return (of + 1.0) / (self.votes[PEDESTRIAN] + self.votes[CYCLIST] + 2.0)


class PeopleTracker:
    """settle() once for each frame, in order, with its detections or without any.

    What it knows of the road is the front end's ground in that frame, and its vertical curvature.
    """

    def __init__(self, camera: Camera, config: PeopleTrackingConfig, first_id: int = FIRST_PERSON) -> None:
        from scipy.optimize import linear_sum_assignment  # only who tracks holds its 9 MB

        self._assign = linear_sum_assignment
        self.camera = camera
        self.config = config
        self.filter = PeopleFilter(config.people)
        self.tracks: list[PersonTrack] = []
        self.frame: OpenFrame | None = None  # the last settled one
        self._pitch_rad: float | None = None
        self.next_id = first_id

    def settle(self, frame: OpenFrame, detections: Detections | None, road: GroundSizeFilter) -> None:
        """The next frame. None for `detections`: no detector looked at it. `road` is the ground in it."""
        ego, ground = frame.ego, road.ground
        profile = RoadProfile(ground.height_m, road.vertical_per_m)
        self._predict(frame, road)
        self.frame = frame
        if detections is not None:
            boxes = people_boxes(detections, self.camera, ground, self.config.boxes)
            pairs = self._associate(boxes, frame, profile)
            rows = [row for row, _ in pairs]
            self.filter.correct(rows, [boxes[k] for _, k in pairs], ego.T_world_ego, profile)
            for row, k in pairs:
                track = self.tracks[row]
                track.box, track.seen_ns, track.seen_frame = boxes[k], ego.t_source_ns, ego.frame_id
                track.hits += 1
                track.votes[boxes[k].label] += 1
            self.filter.share()
            self._begin(boxes, {k for _, k in pairs}, frame, profile)
        self._conclude(frame)

    def _predict(self, frame: OpenFrame, road: GroundSizeFilter) -> None:
        ego, pitch_rad = frame.ego, road.ground.pitch_rad
        shift_rad = 0.0 if self._pitch_rad is None else pitch_rad - self._pitch_rad - (frame.turn_rad or 0.0)
        self._pitch_rad = pitch_rad
        ego_mps = UNKNOWN_MPS if frame.travelled_m is None else frame.travelled_m / max(frame.dt_s, 1e-3)
        self.filter.predict(frame.dt_s, ego.T_world_ego, ego.step_cov, shift_rad, ego_mps, road.sigma_pitch_rad)

    def _associate(self, boxes: Sequence[PersonBox], frame: OpenFrame, road: RoadProfile) -> list[tuple[int, int]]:
        """(row, box): the assignment of least total cost, -2 log of the likelihood within the gate."""
        if not boxes or not self.tracks:
            return []
        squared, costs = self.filter.distances(boxes, frame.ego.T_world_ego, road)
        t_ns = frame.ego.t_source_ns
        since_s = max((t_ns - max(track.seen_ns for track in self.tracks)) * 1e-9, MIN_DT_S)  # anybody had a box
        costs += self._sight(since_s) + self._classes(boxes) + self._shapes(boxes, t_ns)
        cost = np.where(squared <= self.config.gate, costs, NEVER)
        new = -2.0 * math.log(NEW_PER_S * since_s)
        births = np.where(np.eye(len(boxes)), new, NEVER)  # a row of somebody new for each box
        rows, columns = self._assign(np.vstack([cost, births]))
        known = len(self.tracks)
        return [
            (int(i), int(j)) for i, j in zip(rows, columns, strict=True) if i < known and cost[i, j] < NEVER
        ]  # fmt: skip

    def _sight(self, since_s: float) -> Floats:
        """(N, 1): -2 log of the odds that each has a box. Who had one in the last frame has one again, and who had none
        is hidden still (a Markov chain), so that nobody hidden takes the box of who is in front.
        """
        lost = -math.expm1(-since_s / self.config.seen_for_s)
        found = -math.expm1(-since_s / self.config.hidden_for_s)
        last = max(track.seen_frame for track in self.tracks)
        again = np.where([track.seen_frame == last for track in self.tracks], 1.0 - lost, found)
        return np.asarray(-2.0 * np.log(again / (1.0 - again)))[:, None]

    def _classes(self, boxes: Sequence[PersonBox]) -> Floats:
        """(N, M): -2 log of the probability of each box's class by the votes of each (Laplace's rule of succession)."""
        rides = np.array([box.label != PEDESTRIAN for box in boxes])
        walked = np.array([track.votes[PEDESTRIAN] for track in self.tracks])[:, None]
        all_votes = np.array([track.votes.total() for track in self.tracks])[:, None]
        return np.asarray(-2.0 * np.log((np.where(rides, all_votes - walked, walked) + 1.0) / (all_votes + 2.0)))

    def _shapes(self, boxes: Sequence[PersonBox], t_ns: int) -> Floats:
        """(N, M): -2 log of how likely each box has its width over its height after the last one of each, against one
        of anybody: limbs swing, and what is in front covers them (Student's t).
        """
        config, before = self.config, [track.box for track in self.tracks]
        last, now = ([box.log_width - math.log(max(box.tan_height, MIN_SLOPE)) for box in of] for of in (before, boxes))
        unseen_s = np.array([(t_ns - track.seen_ns) * 1e-9 for track in self.tracks])[:, None]
        variance = config.sigma_shape**2 - config.sigma_stride**2 * np.expm1(-unseen_s / config.stride_s)
        squared = np.square(np.subtract.outer(last, now)) / variance
        cost = (SHAPE_DOF + 1.0) * np.log1p(squared / SHAPE_DOF) + np.log(variance / config.sigma_shapes**2)
        same = np.equal.outer([box.label for box in before], [box.label for box in boxes])
        return np.where(same, cost, 0.0)

    def _begin(self, boxes: list[PersonBox], matched: set[int], frame: OpenFrame, road: RoadProfile) -> None:
        followed = np.array([boxes[k].box_px for k in matched]).reshape(-1, 4)
        births: list[int] = []
        for k, box in enumerate(boxes):
            if k in matched or box.label == BICYCLE or box.score < self.config.birth_score:
                continue
            if len(followed) and iou(np.array([box.box_px]), followed).max() > self.config.birth_iou:
                continue
            births.append(k)
        ego = frame.ego
        self.filter.begin([boxes[k] for k in births], ego.T_world_ego, road)
        self.tracks += [
            PersonTrack(boxes[k], ego.t_source_ns, ego.frame_id, votes=Counter({boxes[k].label: 1})) for k in births
        ]  # fmt: skip

    def _conclude(self, frame: OpenFrame) -> None:
        """Removes lost tracks, assigns ids, decides which are standing."""
        if not self.tracks:
            return
        ego, moments = frame.ego, self.filter.moments()
        at = (moments.mean[:, :2] - [ego.T_world_ego.x_m, ego.T_world_ego.y_m]) @ ego.T_world_ego.rotation()
        edge = (0.5 + SIDE_MARGIN) * self.camera.width_px / self.camera.fx_px
        alive = []
        for row, track in enumerate(self.tracks):
            x_m, y_m = at[row].tolist()
            outside = x_m < 1.0 or abs(y_m) > edge * x_m
            track.outside_s = track.outside_s + frame.dt_s if outside and track.seen_ns != ego.t_source_ns else 0.0
            lasting = track.hits >= self.config.confirm_hits
            unseen_s = (ego.t_source_ns - track.seen_ns) * 1e-9
            limit_s = self.config.forget_s if lasting else self.config.forget_unconfirmed_s
            if unseen_s <= limit_s and track.outside_s <= LEAVES_S and math.isfinite(x_m + y_m):
                alive.append((math.hypot(x_m, y_m), row))
        rows = sorted(row for _, row in sorted(alive)[: self.config.most])
        if len(rows) < len(self.tracks):
            gone = set(range(len(self.tracks))) - set(rows)
            self.filter.keep_rows(rows, [row for row in sorted(gone) if self.tracks[row].person >= 0])
            self.tracks = [self.tracks[row] for row in rows]
        for track, standing in zip(self.tracks, moments.standing[rows].tolist(), strict=True):
            if track.person < 0 and track.hits >= self.config.confirm_hits:
                track.person, self.next_id = self.next_id, self.next_id + 1
            track.stands = standing > (WALKS if track.stands else STANDS)
