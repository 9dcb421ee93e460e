"""Every record that passes between the parts of BirdSLAM, with its frames and units.

Frames (all REP-103: x forward, y left, z up, yaw counter-clockwise, pitch > 0 is nose down):

| frame   | what                                                                                         |
|---------|----------------------------------------------------------------------------------------------|
| world   | the ego pose at the first frame of an `epoch`; the road there is its plane                     |
| ego     | the camera's foot on the road, x along the optical axis laid on the road                      |
| vehicle | the centre of a vehicle's footprint, x towards its front                                     |
| camera  | x right, y down, z forward (only inside birdslam/, and in the columns of KITTI files)        |

Units end the names: `_m _rad _px _ns _mps`. `T_a_b` takes points of b to a. A covariance is row-major, of the tangent
(x_m, y_m, yaw_rad) at the pose: nine numbers for a pose, four for a point or a velocity.

Time comes in with the data: `t_source_ns` is the recording's or the camera's own clock (what motion is computed from),
`t_capture_ns` is CLOCK_MONOTONIC when the frame was captured on this computer (what ages are measured from),
`t_utc_ns` is UTC beside it.

Versions: a field may be appended with a default; a changed meaning is a new version in the topic's key. The records are
validated on decoding: a number that is not finite, a negative variance or a wrong type is msgspec.ValidationError.
"""

from __future__ import annotations

import enum
import math
from dataclasses import dataclass
from typing import Annotated

import msgspec
import numpy as np
from numpy.typing import NDArray

from birdslam.geometry.se2 import SE2
from birdslam.status import INVALIDATING as INVALIDATING
from birdslam.status import Status as Status
from birdslam.status import Word as Word

Cov3 = Annotated[tuple[float, ...], msgspec.Meta(min_length=9, max_length=9)]
Cov2 = Annotated[tuple[float, ...], msgspec.Meta(min_length=4, max_length=4)]
FrameId = Annotated[int, msgspec.Meta(ge=0)]
Probability = Annotated[float, msgspec.Meta(ge=0.0, le=1.0)]
BodyId = Annotated[int, msgspec.Meta(ge=0)]
NS_PER_S = 1_000_000_000
PEOPLE = frozenset({"pedestrian", "cyclist"})  # labels of `Estimate.people`
FIRST_PERSON = 1 << 20  # people's numbers begin here, so that no vehicle has one of them
IN_SIGHT_NS = 350_000_000  # perceive runs its networks at least three times a second


def check_finite(record: msgspec.Struct, *fields: str) -> None:
    for name in fields:
        value = getattr(record, name)
        if not math.isfinite(sum(value) if isinstance(value, tuple) else value):
            raise ValueError(f"{type(record).__name__}.{name} needs finite numbers, got {value}")


def _check_cov(record: msgspec.Struct, *fields: str) -> None:
    check_finite(record, *fields)
    for name in fields:
        cov = getattr(record, name)
        if min(cov[:: math.isqrt(len(cov)) + 1]) < 0.0:
            raise ValueError(f"{type(record).__name__}.{name} has a negative variance")


def _is_sound(total: float, *variances: float) -> bool:
    """Whether the sum is finite and no variance negative: a fast check before those of each number."""
    return math.isfinite(total) and min(variances) >= 0.0


def _curve_sigma(cov: tuple[float, ...], x_m: float) -> float:
    """1-sigma of y at x of a cubic with this covariance (4, 4)."""
    at = (1.0, x_m, x_m * x_m / 2.0, x_m * x_m * x_m / 6.0)
    return math.sqrt(max(0.0, sum(at[i] * cov[4 * i + j] * at[j] for i in range(4) for j in range(4))))


def check_points(record: msgspec.Struct, *points_m: tuple[float, float]) -> None:
    for x_m, y_m in points_m:
        if not math.isfinite(x_m + y_m):
            raise ValueError(f"{type(record).__name__} needs finite points, got ({x_m}, {y_m})")


class SpeedSource(Word):
    """The source of the metric scale of a frame's motion."""

    ROAD = "road"  # the road's image, under a camera of known height
    CAR = "car"  # the car's own speed
    CARRIED = "carried"  # the scale of an earlier frame
    UNKNOWN = "unknown"  # a newer sender's source that this reader does not know

    NEWER = UNKNOWN


class Moves(Word):
    """Whether a vehicle is stationary or moving, with hysteresis."""

    UNDECIDED = "undecided"  # too few observations
    STANDING = "standing"  # its velocity is reported as zero
    DRIVING = "driving"

    NEWER = UNDECIDED


class SpeedReading(msgspec.Struct, frozen=True, kw_only=True):
    """A reading of the car's own speed, from wheels or another source.

    Plausibility is checked by the consumer: an implausible reading is a status, not a malformed record.
    """

    t_ns: int  # its time, by the frames' t_source_ns; in topic `speed` by CLOCK_MONOTONIC, 0: on arrival
    speed_mps: float  # along the car's x axis, < 0 backwards
    sigma_mps: float  # 1-sigma of its noise, without the tyres' scale factor
    yaw_rate_radps: float | None = None  # counter-clockwise; None: no yaw rate
    yaw_rate_sigma_radps: float = 0.0


@dataclass(frozen=True)
class Frame:
    """One undistorted image inside a process; on the bus a `FrameRef` replaces it.

    `image` is (H, W) grey or (H, W, 3) BGR, uint8; None if the frame reports only its status.
    """

    frame_id: int
    t_source_ns: int
    t_capture_ns: int
    t_utc_ns: int
    image: NDArray[np.uint8] | None
    status: tuple[Status, ...] = ()
    speeds: tuple[SpeedReading, ...] = ()  # readings of the last second, in order of arrival


class FrameRef(msgspec.Struct, frozen=True, kw_only=True):
    """capture -> perceive: the position of a frame's pixels in the shared-memory ring.

    Without pixels (`slot` = -1) it only reports a status: an unreadable image, or the end of the source.
    """

    frame_id: FrameId
    t_source_ns: int
    t_capture_ns: int
    t_utc_ns: int
    slot: int = -1  # of the ring
    sequence: int = 0  # the slot's sequence number when the frame was written (see runtime/transport/ring.py)
    ring_epoch: int = 0  # which incarnation of the ring
    width_px: int = 0  # of the image
    height_px: int = 0
    channels: int = 0  # 1 grey, 3 BGR
    dropped: int = 0  # frames that capture itself had to drop since the start
    status: tuple[Status, ...] = ()
    speeds: tuple[SpeedReading, ...] = ()  # as in `Frame`; those of a dropped frame are in the next one too


class EgoEdge(msgspec.Struct, frozen=True, kw_only=True, gc=False):
    """CC: the ego's motion between two frames (camera-camera edge, Eq. 2)."""

    from_frame: FrameId
    to_frame: FrameId
    T_from_to: SE2
    cov: Cov3

    def __post_init__(self) -> None:
        _check_cov(self, "cov")


class VehicleEdge(msgspec.Struct, frozen=True, kw_only=True, gc=False):
    """CV: a vehicle observed from the ego in one frame (camera-vehicle edge, Eq. 2).

    `T_ego_vehicle` is the centre of the footprint; if only the nearest face is visible, that face shifted by half of
    `length_m` along the heading. `box_px` = (x1, y1, x2, y2) of the undistorted image.
    """

    vehicle: BodyId
    frame: FrameId
    T_ego_vehicle: SE2
    cov: Cov3
    label: str = "car"
    score: float = 1.0
    box_px: Annotated[tuple[float, ...], msgspec.Meta(min_length=4, max_length=4)] = (0.0, 0.0, 0.0, 0.0)
    length_m: float = 4.0
    width_m: float = 1.7
    # The size used for its position in this frame; a better size later corrects the position
    log_height: float = 0.0  # of its height in metres
    sigma_log_height: float = 0.0
    depth_per_height: float = 0.0  # derivative of the log of its depth by log_height
    standing: float = 0.0  # the probability that it is stationary
    delay_ns: Annotated[int, msgspec.Meta(ge=0)] = 0  # > 0: age of the observation, which is predicted to this frame

    def __post_init__(self) -> None:
        cov, sizes = self.cov, self.length_m + self.width_m + self.log_height + self.sigma_log_height
        total = self.score + sum(self.box_px) + sizes + self.depth_per_height + self.standing + sum(cov)
        if not _is_sound(total, cov[0], cov[4], cov[8]):
            check_finite(self, "score", "box_px", "length_m", "width_m")
            check_finite(self, "log_height", "sigma_log_height", "depth_per_height", "standing")
            _check_cov(self, "cov")


class MotionEdge(msgspec.Struct, frozen=True, kw_only=True, gc=False):
    """VV: a vehicle's motion between two frames, predicted by the tracker (vehicle-vehicle edge, Eq. 2)."""

    vehicle: BodyId
    from_frame: FrameId
    to_frame: FrameId
    T_from_to: SE2
    cov: Cov3

    def __post_init__(self) -> None:
        cov = self.cov
        if not _is_sound(sum(cov), cov[0], cov[4], cov[8]):
            _check_cov(self, "cov")


class LandmarkKind(enum.IntEnum):
    """The kinds of landmarks of the static map."""

    ROAD_POINT = 0  # a feature on the road's surface
    LANE_STATION = 1  # crossing of a lane with a grid line in world: observable only across the lane


_STATION_IDS = 1 << 48  # offset of stations' ids in older records, which have no `kind`


class LandmarkEdge(msgspec.Struct, frozen=True, kw_only=True, array_like=True, gc=False):
    """CP: a landmark of the static map observed from the ego (camera-point edge, Eq. 3), back-projected by Eq. 1.

    `kind` and `landmark` together identify it: each kind has its own ids.
    """

    landmark: BodyId
    frame: FrameId
    x_m: float  # in ego
    y_m: float
    cov: Cov2  # including the shared part
    kind: LandmarkKind = LandmarkKind.ROAD_POINT  # a feature on the road (0) or a station of a lane (1)
    # (2, 2), row-major, metres: shift of this landmark by 1-sigma of the frame's pitch (first column) and height, which
    # all landmarks of the frame share; None: no shared error
    shared: Cov2 | None = None

    def __post_init__(self) -> None:
        cov = self.cov
        if not _is_sound(self.x_m + self.y_m + sum(cov) + (sum(self.shared) if self.shared else 0.0), cov[0], cov[3]):
            check_finite(self, "x_m", "y_m", *(("shared",) if self.shared else ()))
            _check_cov(self, "cov")
        if self.landmark >= _STATION_IDS and self.kind is LandmarkKind.ROAD_POINT:  # an older record
            msgspec.structs.force_setattr(self, "kind", LandmarkKind.LANE_STATION)
            msgspec.structs.force_setattr(self, "landmark", self.landmark - _STATION_IDS)


class LanePoint(msgspec.Struct, frozen=True, array_like=True, gc=False):
    """A point of a lane line on the road, in ego; for the map only."""

    x_m: float
    y_m: float
    lane: int = -1  # persistent id of its lane; -1: unknown

    def __post_init__(self) -> None:
        if not math.isfinite(self.x_m + self.y_m):
            check_finite(self, "x_m", "y_m")


class LineKind(Word):
    """The type of a line on the road."""

    UNKNOWN = "unknown"
    SOLID = "solid"
    DASHED = "dashed"
    DOUBLE = "double"  # two lines of paint side by side
    EDGE = "edge"  # where the road ends, with or without a kerb

    NEWER = UNKNOWN


class LineColour(Word):
    """The colour of a painted line; unknown if it is not certain."""

    UNKNOWN = "unknown"
    WHITE = "white"
    YELLOW = "yellow"

    NEWER = UNKNOWN


Cov4 = Annotated[tuple[float, ...], msgspec.Meta(min_length=16, max_length=16)]


class LaneLine(msgspec.Struct, frozen=True, kw_only=True, gc=False):
    """A line on the road, or the road's edge, as a curve in ego (to third order a clothoid):

    y(x) = offset_m + slope x + curvature_per_m x^2 / 2 + curvature_rate_per_m2 x^3 / 6, from `seen_from_m` to `to_m`.
    `cov` (4, 4) row-major is that of the four numbers, in their order.
    """

    line: BodyId  # its number, for as long as it is followed
    offset_m: float  # to the left of the ego
    slope: float  # dy/dx at the ego: the tangent of its heading
    curvature_per_m: float  # > 0: to the left
    curvature_rate_per_m2: float
    cov: Cov4
    seen_from_m: float  # x of the nearest point that was seen of it, behind the ego < 0
    seen_to_m: float  # x of the farthest point that was seen of it; beyond, up to `to_m`, it is predicted
    to_m: float  # x up to which it is known to 0.6 m
    kind: LineKind = LineKind.UNKNOWN
    colour: LineColour = LineColour.UNKNOWN
    existence: Probability = 1.0  # the probability that it is a line

    def y_m(self, x_m: float) -> float:
        """y of the line at `x_m` ahead of the ego."""
        rate = self.curvature_rate_per_m2
        return self.offset_m + x_m * (self.slope + x_m * (self.curvature_per_m / 2.0 + x_m * rate / 6.0))

    def sigma_m(self, x_m: float) -> float:
        """1-sigma of `y_m(x_m)`."""
        return _curve_sigma(self.cov, x_m)

    def __post_init__(self) -> None:
        shape = self.offset_m + self.slope + self.curvature_per_m + self.curvature_rate_per_m2
        total = shape + self.seen_from_m + self.seen_to_m + self.to_m + sum(self.cov)
        if not _is_sound(total, *self.cov[::5]):
            check_finite(self, "offset_m", "slope", "curvature_per_m", "curvature_rate_per_m2")
            check_finite(self, "seen_from_m", "seen_to_m", "to_m")
            _check_cov(self, "cov")


class Bound(Word):
    """The source of a lane's left or right bound."""

    PAINT = "paint"
    EDGE = "edge"  # the road's edge
    WIDTH = "width"  # neither is visible: from the other side's line and the lane width

    NEWER = WIDTH


class Lane(msgspec.Struct, frozen=True, kw_only=True, gc=False):
    """A lane in ego: its centre line, a curve like `LaneLine`, and its width."""

    offset_m: float  # of the centre line, to the left of the ego
    slope: float
    curvature_per_m: float
    curvature_rate_per_m2: float
    cov: Cov4  # (4, 4) of those four
    width_m: float  # at the ego
    width_slope: float  # growth of the width per metre ahead
    width_sigma_m: float
    to_m: float  # x up to which it is known
    left: BodyId | None = None  # the line at its left; None where `left_bound` is WIDTH
    right: BodyId | None = None
    left_bound: Bound = Bound.PAINT
    right_bound: Bound = Bound.PAINT
    carriageway: bool = False  # without dividing paint: all of the road between its edges, possibly for both directions
    oncoming: Probability | None = None  # that its traffic is oncoming; None: not observed
    ends_m: float | None = None  # x where it is too narrow for a car: it ends or merges; None: not in sight
    splits_m: float | None = None  # x where it is as wide as two lanes; None: not in sight

    def centre_m(self, x_m: float) -> float:
        """y of the centre line `x_m` ahead of the ego."""
        rate = self.curvature_rate_per_m2
        return self.offset_m + x_m * (self.slope + x_m * (self.curvature_per_m / 2.0 + x_m * rate / 6.0))

    def left_m(self, x_m: float) -> float:
        """y of its left bound `x_m` ahead of the ego."""
        return self.centre_m(x_m) + 0.5 * (self.width_m + self.width_slope * x_m)

    def right_m(self, x_m: float) -> float:
        """y of its right bound `x_m` ahead of the ego."""
        return self.centre_m(x_m) - 0.5 * (self.width_m + self.width_slope * x_m)

    def sigma_m(self, x_m: float) -> float:
        """1-sigma of `centre_m(x_m)`."""
        return _curve_sigma(self.cov, x_m)

    def __post_init__(self) -> None:
        shape = self.offset_m + self.slope + self.curvature_per_m + self.curvature_rate_per_m2
        total = shape + self.width_m + self.width_slope + self.width_sigma_m + self.to_m + sum(self.cov)
        if not _is_sound(total, *self.cov[::5]):
            check_finite(self, "offset_m", "slope", "curvature_per_m", "curvature_rate_per_m2")
            check_finite(self, "width_m", "width_slope", "width_sigma_m", "to_m")
            _check_cov(self, "cov")


class LaneChange(Word):
    """The ego's lane change, reported once: in the frame in which the centre of the ego crosses the line."""

    NONE = "none"
    LEFT = "left"
    RIGHT = "right"

    NEWER = NONE


class VehicleLane(msgspec.Struct, frozen=True, kw_only=True, gc=False):
    """The lane of a road user: probabilities that sum to one, from the covariances of both."""

    vehicle: BodyId  # its number, of a vehicle or a person
    ego_lane: Probability = 0.0
    left: Probability = 0.0  # in a lane to the left of the ego lane, in the ego's direction
    right: Probability = 0.0
    oncoming: Probability = 0.0  # not in the ego lane, and moving against the ego's direction
    off_road: Probability = 0.0  # in no known lane, and stationary or moving in the ego's direction


class Leader(msgspec.Struct, frozen=True, kw_only=True, gc=False):
    """The next vehicle or cyclist ahead in the ego's lane."""

    vehicle: BodyId
    gap_m: float  # along the lane, from the camera's foot to the vehicle's rear
    gap_sigma_m: float
    time_gap_s: float | None = None  # at the ego's speed; None while the ego is stationary
    probability: Probability = 1.0  # that it is in the ego's lane

    def __post_init__(self) -> None:
        check_finite(self, "gap_m", "gap_sigma_m")


class Lanes(msgspec.Struct, frozen=True, kw_only=True):
    """The lines and lanes around the ego in one frame, in ego."""

    lines: tuple[LaneLine, ...] = ()  # from left to right, 8 m ahead
    lanes: tuple[Lane, ...] = ()  # from left to right
    ego_index: int | None = None  # the ego's lane among `lanes`; None: it is in none that is known
    change: LaneChange = LaneChange.NONE
    vehicles: tuple[VehicleLane, ...] = ()  # of an `Estimate`
    leader: Leader | None = None  # of an `Estimate`
    age_ns: Annotated[int, msgspec.Meta(ge=0)] = 0  # source time since the last image with lines
    tilt_rad: float = 0.0  # correction of the pitch in `Ground` that made the lines of that image parallel
    road_from_m: float = 0.0  # min. x of the road visible in that image, limited by its border or the ego's bonnet
    # Vertical curvature: height x^2 / 2 times this over the plane under the camera; > 0: the road rises
    vertical_curvature_per_m: float = 0.0

    @property
    def ego(self) -> Lane | None:
        """The ego's lane."""
        return None if self.ego_index is None else self.lanes[self.ego_index]

    @property
    def left(self) -> Lane | None:
        """The lane left of the ego lane."""
        return None if not self.ego_index else self.lanes[self.ego_index - 1]

    @property
    def right(self) -> Lane | None:
        """The lane right of the ego lane."""
        if self.ego_index is None or self.ego_index + 1 >= len(self.lanes):
            return None
        return self.lanes[self.ego_index + 1]

    def line(self, line: BodyId | None) -> LaneLine | None:
        """The line with this number."""
        return next((found for found in self.lines if found.line == line), None)

    def __post_init__(self) -> None:
        if self.ego_index is not None and not 0 <= self.ego_index < len(self.lanes):
            raise ValueError(f"Lanes.ego_index is {self.ego_index}, of {len(self.lanes)} lanes")


class Attitude(msgspec.Struct, frozen=True, kw_only=True):
    """The degrees of freedom beyond SE(2): the ego's height and tilt in world, integrated from visual odometry.

    Not part of the graph; used for 6-DoF trajectories (a graded road, the camera's vibration).
    """

    z_m: float = 0.0  # the ego over the world's plane
    pitch_rad: float = 0.0  # of the camera; > 0: nose down
    roll_rad: float = 0.0

    def __post_init__(self) -> None:
        check_finite(self, "z_m", "pitch_rad", "roll_rad")


class Ground(msgspec.Struct, frozen=True, kw_only=True):
    """The front end's estimate of the camera pose over the road in this frame (camera.GroundPlane on the wire)."""

    height_m: float  # of the camera over the road
    pitch_rad: float = 0.0  # of the camera relative to the road; > 0: nose down
    roll_rad: float = 0.0

    def __post_init__(self) -> None:
        check_finite(self, "height_m", "pitch_rad", "roll_rad")


class FollowedPerson(msgspec.Struct, frozen=True, kw_only=True, array_like=True, gc=False):
    """A person or cyclist in one frame, tracked by the front end's filter (road_users/models/).

    Position and velocity over the ground are in the axes of this frame's ego. People are filtered outside the graph,
    which transforms them to world.
    """

    person: BodyId  # its number, distinct from those of vehicles
    x_m: float
    y_m: float
    cov: Cov2
    vx_mps: float  # over the ground
    vy_mps: float
    velocity_cov: Cov2  # including the probability that they are stationary
    label: str = "pedestrian"
    label_probability: Probability = 1.0
    score: float = 1.0  # of the last box
    box_px: Annotated[tuple[float, ...], msgspec.Meta(min_length=4, max_length=4)] = (0.0, 0.0, 0.0, 0.0)  # the last
    height_m: float = 1.7
    sigma_height_m: float = 0.0
    child: Probability = 0.0  # the probability of a child's height
    length_m: float = 0.7  # of the footprint
    width_m: float = 0.6
    standing: Probability = 0.5  # the probability that they are stationary
    moves: Moves = Moves.UNDECIDED
    age_ns: Annotated[int, msgspec.Meta(ge=0)] = 0  # source time since their last box; 0: in this frame
    frames: int = 1  # number of frames with an observation

    def __post_init__(self) -> None:
        cov, u = self.cov, self.velocity_cov
        total = self.x_m + self.y_m + self.vx_mps + self.vy_mps + sum(cov) + sum(u) + self.score + sum(self.box_px)
        total += self.height_m + self.sigma_height_m + self.length_m + self.width_m
        if not _is_sound(total, cov[0], cov[3], u[0], u[3]):
            check_finite(self, "x_m", "y_m", "vx_mps", "vy_mps", "score", "box_px", "height_m", "sigma_height_m")
            check_finite(self, "length_m", "width_m")
            _check_cov(self, "cov", "velocity_cov")


class Measurements(msgspec.Struct, frozen=True, kw_only=True):
    """perceive -> optimize: the front end's measurements of one frame, the edges of Eqs. 6 and 7.

    A log of them replays the back end alone.
    """

    frame_id: FrameId
    t_source_ns: int
    t_capture_ns: int
    t_utc_ns: int
    cc: EgoEdge | None = None  # None: the motion since earlier frames is unknown; the graph begins a new epoch
    cv: tuple[VehicleEdge, ...] = ()
    vv: tuple[MotionEdge, ...] = ()
    cp: tuple[LandmarkEdge, ...] = ()
    lanes: tuple[LanePoint, ...] = ()
    attitude: Attitude = Attitude()
    ground: Ground | None = None
    scale_sigma_rel: float = 0.0  # 1-sigma of the metric scale as a fraction
    ages: dict[str, int] = {}  # age of each network's result in frames
    status: tuple[Status, ...] = ()
    speed_sources: tuple[SpeedSource, ...] = ()  # where the metres of this frame's motion come from
    camera_sigma_rel: float = 0.0  # 1-sigma of the common scale of all lengths from the camera's height and lens
    people: tuple[FollowedPerson, ...] = ()  # all tracked people, also those out of sight
    road_lanes: Lanes | None = None  # None: no line observed yet

    def __post_init__(self) -> None:
        check_finite(self, "scale_sigma_rel", "camera_sigma_rel")


class Approach(msgspec.Struct, frozen=True, kw_only=True, gc=False):
    """The closest approach of a road user to the ego at constant velocities: an aid, not a safety function.

    From means and covariances of position and velocity, to first order. `nearby`: within 5 s the distance to the ego's
    centre may be below 2 m, at 2 sigma.
    """

    time_s: float  # until the closest approach; 0: the distance grows
    sigma_s: float
    distance_m: float  # of the centres then
    sigma_m: float
    nearby: bool = False

    def __post_init__(self) -> None:
        if not math.isfinite(self.time_s + self.sigma_s + self.distance_m + self.sigma_m):
            check_finite(self, "time_s", "sigma_s", "distance_m", "sigma_m")


class RoadUser(msgspec.Struct, frozen=True, kw_only=True, gc=False):
    """One road user of any class in an `Estimate`: pose and velocity over the ground, in world.

    `label` is car, van, truck, bus, trailer, motorcycle (with rider), cyclist (bicycle and rider) or pedestrian. A
    stationary person has an unknown yaw, with the variance of a uniform distribution.
    """

    vehicle: BodyId  # its number, for as long as it is followed
    T_world_vehicle: SE2  # where it is
    cov: Cov3  # of the pose
    velocity_mps: Annotated[tuple[float, ...], msgspec.Meta(min_length=2, max_length=2)]  # (x, y) in world
    velocity_cov: Cov2  # of the velocity, including the probability that it is stationary
    age_ns: int  # source time since the last frame with a measurement of it; 0: this frame
    frames: int  # the number of frames it has been seen in
    label: str = "car"  # its class
    length_m: float = 4.0  # of its footprint
    width_m: float = 1.7  # of its footprint
    delay_ns: int = 0  # delay of the image that it was seen in: it was last seen age_ns + delay_ns ago
    moves: Moves = Moves.UNDECIDED  # whether it is stationary or moving, with hysteresis
    standing: Probability = 0.5  # the last probability that it is stationary
    label_probability: Probability | None = None  # of its class; None: unknown
    height_m: float | None = None  # None: not known
    sigma_height_m: float = 0.0
    child: Probability = 0.0  # the probability of a child's height
    approach: Approach | None = None  # to the ego; None: not computed

    @property
    def in_sight(self) -> bool:
        """Observed within IN_SIGHT_NS; networks need not run on every frame."""
        return self.age_ns <= IN_SIGHT_NS

    @property
    def seen(self) -> bool:
        """Observed in this frame; otherwise predicted."""
        return self.age_ns == 0

    @property
    def is_person(self) -> bool:
        """A pedestrian or a cyclist."""
        return self.label in PEOPLE

    def __post_init__(self) -> None:
        cov, u = self.cov, self.velocity_cov
        total = sum(cov) + sum(u) + sum(self.velocity_mps) + self.length_m + self.width_m + self.standing
        sound = math.isfinite(total) and cov[0] >= 0.0 and cov[4] >= 0.0 and cov[8] >= 0.0
        if not (sound and u[0] >= 0.0 and u[3] >= 0.0):
            check_finite(self, "velocity_mps", "length_m", "width_m", "standing")
            _check_cov(self, "cov", "velocity_cov")


VehicleEstimate = RoadUser  # an alias for existing code


class HiddenFan(msgspec.Struct, frozen=True, kw_only=True, gc=False):
    """Road that a vehicle hides from the camera: a polygon in ego, in m, counter-clockwise."""

    vehicle: BodyId  # behind whom
    x_m: tuple[float, ...]  # of its corners
    y_m: tuple[float, ...]  # of its corners

    def __post_init__(self) -> None:
        if not math.isfinite(sum(self.x_m) + sum(self.y_m)):
            check_finite(self, "x_m", "y_m")
        if len(self.x_m) != len(self.y_m):
            raise ValueError(f"HiddenFan has {len(self.x_m)} x_m and {len(self.y_m)} y_m")

    @property
    def corners_m(self) -> tuple[tuple[float, float], ...]:
        """(x, y) of each corner."""
        return tuple(zip(self.x_m, self.y_m, strict=True))


class Estimate(msgspec.Struct, frozen=True, kw_only=True):
    """optimize -> planners, one for each frame: the poses of the ego and all other vehicles (paper, Sec. 3).

    Poses are in m and rad in the world of `epoch`, covariances (3, 3) row-major of the tangent (x_m, y_m, yaw_rad).
    With a new `epoch` the world frame restarted: poses of different epochs must not be compared.
    """

    epoch: int  # number of the world frame, raised where that restarted
    frame_id: FrameId  # as capture counts them; never falls within a run
    t_source_ns: int  # the camera's or the recording's own clock
    t_capture_ns: int  # CLOCK_MONOTONIC of the vehicle's computer
    t_utc_ns: int  # UTC of the same moment
    T_world_ego: SE2  # where the ego is
    cov: Cov3  # of the pose
    valid: bool  # it may be driven by: no status invalidates it
    vehicles: tuple[VehicleEstimate, ...] = ()  # all tracked vehicles, also those just out of sight
    attitude: Attitude = Attitude()  # height and tilt, which the pose leaves out
    ground: Ground | None = None  # the camera over the road
    scale_sigma_rel: float = 0.0  # 1-sigma of the metric scale as a fraction, that of the camera's height in it
    status: tuple[Status, ...] = ()  # expected trouble
    speed_sources: tuple[SpeedSource, ...] = ()  # where the metres of this frame's motion come from
    people: tuple[RoadUser, ...] = ()  # pedestrians and cyclists, also those just out of sight
    hidden: tuple[HiddenFan, ...] = ()  # of the road ahead, behind vehicles

    @property
    def road_users(self) -> tuple[RoadUser, ...]:
        """Vehicles and people."""
        return self.vehicles + self.people

    lanes: Lanes | None = None  # lines and lanes in ego; None: no line was seen yet

    def __post_init__(self) -> None:
        check_finite(self, "scale_sigma_rel")
        _check_cov(self, "cov")


class MapUpdate(msgspec.Struct, frozen=True, kw_only=True):
    """optimize -> planners: what the map gained with one frame, in world of `epoch`."""

    epoch: int
    frame_id: FrameId
    landmarks_m: tuple[tuple[float, float], ...] = ()  # road points that left the graph's window
    lanes_m: tuple[tuple[float, float], ...] = ()  # points of lane lines
    lane_ids: tuple[int, ...] = ()  # the lane of each of `lanes_m`, -1: none; empty: all none

    def __post_init__(self) -> None:
        if len(self.lane_ids) not in (0, len(self.lanes_m)):
            raise ValueError(f"lane_ids has {len(self.lane_ids)} entries for {len(self.lanes_m)} points of lanes_m")
        check_points(self, *self.landmarks_m, *self.lanes_m)
