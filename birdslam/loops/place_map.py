"""A map: keyframes, their links, and the index for place recognition."""

from __future__ import annotations

import hashlib
import math
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

import msgspec
import numpy as np
from numpy.typing import NDArray

from birdslam.geometry.arrays import Bools, Floats
from birdslam.geometry.camera import Camera
from birdslam.geometry.se2 import SE2
from birdslam.loops.closing import Solved
from birdslam.loops.gnss.earth import Earth
from birdslam.loops.gnss.factors import OnEarth
from birdslam.loops.keyframe import Fixed, Keyframe, LinePiece, Link
from birdslam.loops.map_pose import EarthPose
from birdslam.loops.place_index import PlaceIndex, index_of, learn_words, words_for
from birdslam.loops.verification import LocalMap
from birdslam.types import LineColour, LineKind

NEIGHBOUR_M, NEIGHBOURS = 9.0, 3  # keyframes that are matched together
FAR_NEIGHBOUR_M, FAR_NEIGHBOURS = 17.0, 7  # with too few inliers
MAX_GAP_M = 8.0  # between two pieces of one line
EARTH_REACH_M = 100.0  # max. distance of a keyframe for the ego's pose on Earth
SAME_HEADING_RAD = math.radians(60.0)
MAX_HEIGHT_RATIO, MAX_FOCAL_RATIO = 0.1, 0.1  # logarithms


class MapCamera(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The camera that made a map."""

    digest: str  # of its camera file
    width_px: int
    height_px: int
    fx_px: float
    height_m: float  # over the road, which sets the map's scale

    @staticmethod
    def of(camera: Camera) -> MapCamera:
        """Returns the record of a camera."""
        digest = hashlib.sha256(msgspec.json.encode(camera)).hexdigest()[:16]
        return MapCamera(digest, camera.width_px, camera.height_px, camera.fx_px, camera.height_m)

    def differs(self, camera: Camera) -> str:
        """Returns how another camera differs in height or focal length; "" if it does not."""
        if abs(math.log(self.height_m / camera.height_m)) > MAX_HEIGHT_RATIO:
            return f"its height is {camera.height_m:g} m, that of the map's camera {self.height_m:g} m"
        per_px = self.fx_px / self.width_px / (camera.fx_px / camera.width_px)
        if abs(math.log(per_px)) > MAX_FOCAL_RATIO:
            return (
                f"its focal length is {camera.fx_px:g} px of {camera.width_px}, "
                f"the map's was {self.fx_px:g} px of {self.width_px}"
            )
        return ""


@dataclass(frozen=True, eq=False)
class MapLine:
    """A lane line in the map."""

    drive: int
    line: int  # its number in that drive
    kind: LineKind  # of most of its pieces
    colour: LineColour
    points_m: Floats  # (N, 2)
    sigma_m: float  # the largest of its pieces


class PlaceMap:
    """A map: keyframes in the map frame, links, and an index."""

    def __init__(
        self,
        camera: MapCamera,
        keyframes: Iterable[Keyframe] = (),
        links: Iterable[Link] = (),
        words: NDArray[np.uint8] | None = None,
        drives: int = 0,
        earth: Earth | None = None,
    ) -> None:
        self.camera = camera
        self.keyframes: list[Keyframe] = list(keyframes)
        self.links: list[Link] = list(links)
        self.drives = drives  # number of drives
        self.earth = earth  # georeference; None: no fixes yet
        self.words = words
        self._descriptors = sum(len(keyframe.descriptors) for keyframe in self.keyframes)
        self._index: PlaceIndex | None = None
        self._poses = np.zeros((0, 3))

    def __len__(self) -> int:
        return len(self.keyframes)

    @property
    def next_number(self) -> int:
        return 1 + max((keyframe.number for keyframe in self.keyframes), default=-1)

    @property
    def length_m(self) -> float:
        """Length of all drives."""
        return float(sum(math.hypot(link.T_from_to.x_m, link.T_from_to.y_m) for link in self.links if not link.loop))

    def add(self, keyframe: Keyframe) -> None:
        """Adds a keyframe; the words are learned again when the map needs twice as many."""
        self.keyframes.append(keyframe)
        self._descriptors += len(keyframe.descriptors)
        if self.words is not None and words_for(self._descriptors) >= 2 * len(self.words):
            self.words, self._index = None, None
        elif self._index is not None:
            self._index.add(keyframe.descriptors)

    def place(self, poses: Mapping[int, Solved]) -> None:
        """Moves keyframes to their poses in the solved graph."""
        self.keyframes = [
            keyframe.at(*poses[keyframe.number]) if keyframe.number in poses else keyframe
            for keyframe in self.keyframes
        ]
        self._poses = np.zeros((0, 3))

    def fixed(self) -> dict[int, Fixed]:
        """Returns the fixes of the keyframes, by number."""
        return {keyframe.number: keyframe.gnss for keyframe in self.keyframes if keyframe.gnss is not None}

    def georeference(self, found: OnEarth) -> None:
        """Applies the result of `gnss.factors.georeference`."""
        self.place(found.poses)
        self.keyframes = [replace(each, gnss=found.fixed.get(each.number)) for each in self.keyframes]
        self.earth = found.earth

    def on_earth(self, T_map_ego: SE2, cov: Floats) -> EarthPose | None:
        """Returns the ego's pose on Earth, given its covariance (3, 3) of the tangent.

        None if the map is not georeferenced or has no keyframe near the ego.
        """
        rows = self.near(T_map_ego, EARTH_REACH_M)
        if self.earth is None or not rows:
            return None
        nearest = self.keyframes[rows[0]]
        Ad = T_map_ego.between(nearest.T_map_keyframe).adjoint()
        return self.earth.pose(T_map_ego, cov + Ad @ nearest.cov @ Ad.T)

    def index(self) -> PlaceIndex:
        """Returns the index; built at the first call."""
        if self._index is None:
            if self.words is None or not len(self.words):
                every = [keyframe.descriptors for keyframe in self.keyframes]
                self.words = learn_words(np.concatenate(every) if every else np.zeros((0, 32), np.uint8))
            self._index = index_of([keyframe.descriptors for keyframe in self.keyframes], self.words)
        return self._index

    def learn(self) -> None:
        """Learns the words from the current keyframes."""
        self.words, self._index = None, None
        self.index()

    def poses(self) -> Floats:
        """Returns (N, 3): x, y and yaw of every keyframe."""
        if len(self._poses) != len(self.keyframes):
            placed = [keyframe.T_map_keyframe for keyframe in self.keyframes]
            self._poses = np.array([(T.x_m, T.y_m, T.yaw_rad) for T in placed]).reshape(-1, 3)
        return self._poses

    def lines(self) -> list[MapLine]:
        """Returns the lane lines for the current poses of the keyframes, joined from adjacent pieces."""
        joined: dict[tuple[int, int], list[list[tuple[Floats, LinePiece]]]] = {}
        for keyframe in self.keyframes:
            for piece in keyframe.lines:
                points_m = keyframe.T_map_keyframe @ piece.points_m
                runs = joined.setdefault((piece.drive, piece.line), [])
                if not runs or math.hypot(*(runs[-1][-1][0][-1] - points_m[0])) > MAX_GAP_M:
                    runs.append([])
                runs[-1].append((points_m, piece))
        out = []
        for (drive, line), runs in joined.items():
            for run in runs:
                points_m = np.concatenate([points for points, _ in run])
                kind = Counter(piece.kind for _, piece in run).most_common(1)[0][0]
                colour = Counter(piece.colour for _, piece in run).most_common(1)[0][0]
                if len(points_m) > 1:
                    out.append(MapLine(drive, line, kind, colour, points_m, max(piece.sigma_m for _, piece in run)))
        return out

    def near(self, T_map_ego: SE2, radius_m: float, among: Bools | None = None) -> list[int]:
        """Returns rows of keyframes within the radius and with a similar heading, nearest first."""
        poses = self.poses()
        if not len(poses):
            return []
        distance = np.hypot(poses[:, 0] - T_map_ego.x_m, poses[:, 1] - T_map_ego.y_m)
        turned = np.abs((poses[:, 2] - T_map_ego.yaw_rad + math.pi) % (2.0 * math.pi) - math.pi)
        fits = (distance < radius_m) & (turned < SAME_HEADING_RAD)
        if among is not None:
            fits &= among
        rows = np.flatnonzero(fits)
        return [int(row) for row in rows[np.argsort(distance[rows], kind="stable")]]

    def around(self, row: int, among: Bools | None = None, far: bool = False) -> LocalMap:
        """Returns the points of a keyframe and its neighbours; `far`: also farther ones."""
        own = self.keyframes[row]
        reach_m, most = (FAR_NEIGHBOUR_M, FAR_NEIGHBOURS) if far else (NEIGHBOUR_M, NEIGHBOURS)
        rows = [other for other in self.near(own.T_map_keyframe, reach_m, among) if other != row]
        return LocalMap.around(own, [self.keyframes[other] for other in rows[: most - 1]])
