"""The lanes of the vehicles of a rendered drive against the truth."""

from __future__ import annotations

import math
from collections.abc import Sequence

import msgspec

from birdslam.bench.figures import mean
from birdslam.bench.lanes.true_lines import KERB, ego_bounds, y_at
from birdslam.geometry.se2 import SE2
from birdslam.sources.shipped_drive import TrueBody, TrueLine
from birdslam.types import Estimate

# From an estimated vehicle to its body, and so much more in a metre of distance: a bearing is known to half a width, a
# distance to a tenth or two. Alike in all directions, cars 40 m ahead stood for those of the next lane
ALONG_M, ALONG_REL = 2.0, 0.15
ACROSS_M, ACROSS_REL = 1.0, 0.02
PEOPLE = ("pedestrian", "cyclist")  # bodies that are no vehicle's
AGAINST_RAD = math.pi / 2
DASHED = "dashed"  # of a true line's kinds
# Wide enough a strip beside a lane for cars to park in it; lanes of one road differ by a few decimetres
PARKED_M = 1.7
PLACES = ("ego_lane", "left", "right", "oncoming", "off_road")


class VehiclesReport(msgspec.Struct, frozen=True, kw_only=True):
    """Vehicles in lanes, over all frames of a drive."""

    vehicles: int  # estimates that belong to a body whose lane is known
    right: float | None = None  # share whose likeliest place is the true one


class VehicleScores:
    """Collects frame by frame."""

    def __init__(self) -> None:
        self._right: list[bool] = []

    def add(self, estimate: Estimate, bodies: Sequence[TrueBody], truth: tuple[TrueLine, ...]) -> None:
        """Adds a frame."""
        if estimate.lanes is None:
            return
        T_ego_world = estimate.T_world_ego.inverse()
        poses = {v.vehicle: T_ego_world @ v.T_world_vehicle for v in estimate.vehicles}
        for place in estimate.lanes.vehicles:
            body = _nearest(poses[place.vehicle], bodies) if place.vehicle in poses else None  # people have lanes, too
            where = None if body is None else true_place(body, truth)
            if where is not None:
                self._right.append(max(PLACES, key=lambda name, of=place: getattr(of, name)) == where)  # type: ignore[misc]

    def report(self) -> VehiclesReport:
        """Returns the scores of all frames."""
        return VehiclesReport(vehicles=len(self._right), right=mean(self._right))


def _nearest(pose: SE2, bodies: Sequence[TrueBody]) -> TrueBody | None:
    """The vehicle in the direction of an estimated one, at about its distance; None where there is none."""
    seen_m = math.hypot(pose.x_m, pose.y_m)
    bearing_rad = math.atan2(pose.y_m, pose.x_m)

    def away(body: TrueBody) -> float:
        x, y = body.T_ego_body.x_m, body.T_ego_body.y_m
        turn_rad = math.remainder(math.atan2(y, x) - bearing_rad, 2.0 * math.pi)
        along = (math.hypot(x, y) - seen_m) / (ALONG_M + ALONG_REL * seen_m)
        return math.hypot(along, turn_rad * seen_m / (ACROSS_M + ACROSS_REL * seen_m))

    body = min((body for body in bodies if body.label not in PEOPLE), key=away, default=None)
    return body if body is not None and away(body) < 1.0 else None


def true_place(body: TrueBody, truth: tuple[TrueLine, ...]) -> str | None:
    """One of PLACES; None where the lines beside the body are not known."""
    x, y = body.T_ego_body.x_m, body.T_ego_body.y_m
    bounds = ego_bounds(truth, x)
    here = sorted((at, t.kind) for t in truth if (at := y_at(t, x)) is not None)
    painted = [k for k, (_, kind) in enumerate(here) if kind != KERB]
    if bounds is None or len(here) < 2 or not painted:
        return None
    first, last = painted[0], painted[-1]
    # Beyond its outermost lines is no road; but beyond a dashed one, or a street's only one, a lane up to the kerb
    right, left = (len(painted) == 1 or here[k][1] == DASHED for k in (first, last))
    lane_m = bounds[0] - bounds[1]
    first_m = _outer_m([-at for at, _ in here[first::-1]], lane_m, right)
    last_m = _outer_m([at for at, _ in here[last:]], lane_m, left)
    if not -first_m < y < last_m:
        return "off_road"
    if bounds[1] < y < bounds[0]:
        return "ego_lane"
    if abs(body.T_ego_body.yaw_rad) > AGAINST_RAD and math.hypot(*body.velocity_mps) > 1.0:
        return "oncoming"
    return "left" if y >= bounds[0] else "right"


def _outer_m(outwards_m: list[float], lane_m: float, has_lane: bool) -> float:
    """Where a road's lanes end at one side: `outwards_m` is its outermost painted line and what comes after it.

    A truth of lines has none between the last lane and a strip along the kerb in which cars park.
    """
    if not has_lane or len(outwards_m) < 2:
        return outwards_m[0]
    line, kerb = outwards_m[:2]
    return line + lane_m if kerb - line - lane_m > PARKED_M else kerb
