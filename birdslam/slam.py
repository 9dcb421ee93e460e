"""BirdSLAM in one process: the front end and the pose graph, one frame at a time."""

from __future__ import annotations

import msgspec

from birdslam.frontend import FrontEnd, FrontEndConfig
from birdslam.geometry.camera import Camera
from birdslam.graph.pose_graph import GraphConfig, PoseGraph
from birdslam.graph.weights import WeightsConfig
from birdslam.mapping.lane_mapper import LaneHead
from birdslam.perception import Networks
from birdslam.types import Estimate, Frame, MapUpdate, Measurements
from birdslam.vehicles.pseudolidar import FrustumNetwork


class SlamConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Every number of the method that can be tuned; one setting serves all roads."""

    frontend: FrontEndConfig = FrontEndConfig()
    weights: WeightsConfig = WeightsConfig()
    graph: GraphConfig = GraphConfig()


class BirdSLAM:
    """The whole method. The three processes of `runtime` run the same two objects, and get the same bytes."""

    def __init__(
        self,
        camera: Camera,
        networks: Networks,
        config: SlamConfig,
        frustum_network: FrustumNetwork | None = None,
        lane_head: LaneHead = LaneHead(),  # noqa: B008
    ) -> None:
        self.networks = networks
        self.frontend = FrontEnd(camera, config.frontend, frustum_network=frustum_network, lane_head=lane_head)
        self.graph = PoseGraph(config.graph, config.weights)

    def step(self, frame: Frame) -> tuple[Measurements, Estimate]:
        """One undistorted frame (paper, Fig. 2): the networks run beside the feature tracking, then the back end."""
        measurements = self.frontend.step(frame, self.networks.start(frame.frame_id, frame.image))
        return measurements, self.graph.optimise(measurements)

    def map_update(self) -> MapUpdate | None:
        """What the map gained since the last call."""
        return self.graph.map_update()
