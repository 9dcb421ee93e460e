"""Detections that come late, used at their own frame: vehicles are followed as if every detection had been in time.

The horizon and the tracks stand at the last *settled* frame, whose detections are in, or will not be waited for. The
frames after it are open: what was known of each (pose, time, how the camera pitched) is kept, and they are settled in
their order once the detections of one of them arrive. The road under the camera now is predicted over the open frames.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import msgspec
import numpy as np
from numpy.typing import NDArray

from birdslam.geometry.camera import Camera, GroundPlane
from birdslam.geometry.se2 import SE2
from birdslam.perception import DepthMap, Detections
from birdslam.vehicles.depth_fusion import DepthPlace, PseudoLidarConfig
from birdslam.vehicles.ground_size_filter import Horizon
from birdslam.vehicles.localisation import LocalisationConfig, Observation, localise
from birdslam.vehicles.pseudolidar import FrustumNetwork, bodies_by_detector, localise_by_depth
from birdslam.vehicles.track import Track
from birdslam.vehicles.tracking import Tracker

Floats = NDArray[np.float64]


class HindsightConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """How long a frame waits for its detections."""

    latest_ms: float = 500.0  # source time; what comes later is left out


@dataclass(frozen=True)
class Moment:
    """What is known of a frame without its detections; the arguments of `Horizon.predict` from the frame before."""

    frame_id: int
    t_source_ns: int
    T_world_ego: SE2  # by dead reckoning
    ego_cov: Floats | None  # (3, 3) of the step to it, in its tangent
    dt_s: float
    turn_rad: float | None
    image_ground: GroundPlane | None
    image_sigma_rad: float


class Hindsight:
    """step() once a frame; `road` is the road under the camera in the newest one."""

    def __init__(
        self,
        camera: Camera,
        tracker: Tracker,
        horizon: Horizon,
        localisation: LocalisationConfig,
        config: HindsightConfig,
        pseudolidar: PseudoLidarConfig | None = None,
        frustum_network: FrustumNetwork | None = None,
    ) -> None:
        self.camera = camera
        self.pseudolidar = pseudolidar or PseudoLidarConfig()
        self.frustum_network = frustum_network
        self.config = config
        self.localisation = localisation
        self.tracker = tracker
        self.horizon = horizon
        self.road = horizon
        self._open: deque[Moment] = deque()
        self._newest_frame = -1
        self._used_frame = -1  # of the newest detections that were used

    def begin(self, moment: Moment) -> None:
        """A new frame. One whose number does not grow is of a source that began anew: nothing is awaited any more."""
        if moment.frame_id <= self._newest_frame:
            self._settle_before(self._newest_frame + 1)
            self._used_frame = -1
        self._newest_frame = moment.frame_id
        self._open.append(moment)
        if self.road is self.horizon:
            self.road = self.horizon.road()
        _predict(self.road, moment)
        while (moment.t_source_ns - self._open[0].t_source_ns) * 1e-6 > self.config.latest_ms:
            self._settle(None)

    def see(
        self,
        detections: Detections | None,
        detected_frame: int,
        depth: DepthMap | None = None,
        road: NDArray[np.bool_] | None = None,
    ) -> list[Track]:
        """The confirmed tracks that detections of `detected_frame` show, as they were in it, ordered by id.

        Each detections are used once. A detector works on one image at a time, so that none come after later ones.
        `depth` and `road` are of the same frame, None where they are not.
        """
        seen: list[Track] = []
        awaited = any(moment.frame_id == detected_frame for moment in self._open)
        if detections is not None and awaited and detected_frame > self._used_frame:
            self._used_frame = detected_frame
            self._settle_before(detected_frame)
            seen = self._settle(detections, depth, road)
            self.road = self.horizon if not self._open else self.horizon.road()
            for moment in self._open:
                _predict(self.road, moment)
        return seen

    def _settle_before(self, frame_id: int) -> None:
        while self._open and self._open[0].frame_id < frame_id:
            self._settle(None)

    def _settle(
        self,
        detections: Detections | None,
        depth: DepthMap | None = None,
        road: NDArray[np.bool_] | None = None,
    ) -> list[Track]:
        """The oldest open frame, with its detections or without any."""
        moment = self._open.popleft()
        _predict(self.horizon, moment)
        observations: list[Observation] | None = None
        by_depth: list[DepthPlace | None] = []
        if detections is not None:
            observations = localise(
                detections.boxes_px,
                detections.scores,
                detections.labels,
                self.camera,
                self.horizon.ground,
                self.localisation.told(detections.edge_sigma),
            )
            observations, by_depth = self._by_depth(observations, detections, depth, road)
        return self.tracker.step(
            observations,
            moment.T_world_ego,
            self.horizon,
            moment.frame_id,
            moment.t_source_ns,
            moment.ego_cov,
            by_depth,
        )

    def _by_depth(
        self,
        seen: list[Observation],
        detections: Detections,
        depth: DepthMap | None,
        road: NDArray[np.bool_] | None,
    ) -> tuple[list[Observation], list[DepthPlace | None]]:
        """The second source of each observation's place; bodies that the detector itself knows of need no depth map."""
        ground, config = self.horizon.ground, self.pseudolidar
        if detections.boxes3d is not None and self.frustum_network is None:
            return bodies_by_detector(seen, detections, self.camera, ground, config)
        if depth is None:
            return seen, []
        return seen, localise_by_depth(seen, depth, self.camera, ground, config, road, self.frustum_network)


def _predict(horizon: Horizon, moment: Moment) -> None:
    horizon.predict(moment.dt_s, moment.turn_rad, moment.image_ground, moment.image_sigma_rad)
