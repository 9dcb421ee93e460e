"""BirdSLAM in one process: the front end and the pose graph, one frame at a time."""

from __future__ import annotations

from typing import overload

import msgspec

from birdslam.frontend import EgoMotion, FrontEnd, FrontEndConfig
from birdslam.geometry.camera import Camera
from birdslam.graph.graph_config import GraphConfig, check_together
from birdslam.graph.pose_graph import PoseGraph
from birdslam.graph.weights import WeightsConfig
from birdslam.lanes.amodal.lane_mapper import LaneHead
from birdslam.perception import Networks, shipped_networks
from birdslam.perception.completion import shipped_completion
from birdslam.perception.decoding.detection import Detections
from birdslam.road_users.placed_boxes import PlacedBox, place_boxes
from birdslam.road_users.placement.pseudolidar import FrustumNetwork
from birdslam.types import Estimate, Frame, MapUpdate, Measurements

LANES_HZ = 5.0  # default rate of lane detection (`[perceive.schedule]`)


class SlamConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """All parameters of the method; one setting serves all roads.

    Some are configuration keys (docs/configuration.md), the others constants. `birdslam.paper.PAPER` is the paper's
    configuration; `msgspec.structs.replace` changes single fields.
    """

    frontend: FrontEndConfig = FrontEndConfig()
    weights: WeightsConfig = WeightsConfig()
    graph: GraphConfig = GraphConfig()

    def __post_init__(self) -> None:
        check_together(self.graph, self.weights)


class BirdSLAM:
    """The whole method in one object (paper, Fig. 2): undistorted frames in, measurements and estimates out.

    The three processes of `birdslam run` use the same front end and graph, with identical results at `--rate max`.
    `networks` detect vehicles, road and lanes (`perception.shipped_networks()`, `load_networks`); `lane_head` sets the
    rate of lane detection and the completion of occluded lanes; `frustum_network` estimates bodies from the points of a
    depth network; `odometry` replaces visual odometry (`odometry.external.ExternalOdometry`). Not thread-safe.
    """

    def __init__(
        self,
        camera: Camera,
        networks: Networks,
        config: SlamConfig = SlamConfig(),  # noqa: B008
        frustum_network: FrustumNetwork | None = None,
        lane_head: LaneHead = LaneHead(),  # noqa: B008
        odometry: EgoMotion | None = None,
    ) -> None:
        self.networks = networks
        self.frontend = FrontEnd(camera, config.frontend, odometry, frustum_network, lane_head)
        self.graph = PoseGraph(config.graph, config.weights)

    @staticmethod
    def with_shipped_networks(
        camera: Camera,
        rate_hz: float,
        config: SlamConfig = SlamConfig(),  # noqa: B008
    ) -> BirdSLAM:
        """Creates it with the shipped networks, as `birdslam evaluate odometry` does.

        `rate_hz` is the rate of the frames; lanes are detected LANES_HZ times a second. Raises ModelError.
        """
        completion = shipped_completion(config.frontend.lanes.shape)
        lane_head = LaneHead(completion, every=max(1, round(rate_hz / LANES_HZ)))
        return BirdSLAM(camera, shipped_networks(), config, lane_head=lane_head)

    @overload
    def step(self, frame: Frame) -> tuple[Measurements, Estimate]: ...
    @overload
    def step(
        self, frame: Frame, detections: Detections
    ) -> tuple[Measurements, Estimate, tuple[PlacedBox | None, ...]]: ...
    def step(
        self, frame: Frame, detections: Detections | None = None
    ) -> tuple[Measurements, Estimate] | tuple[Measurements, Estimate, tuple[PlacedBox | None, ...]]:
        """Processes one undistorted frame: networks and feature tracking in parallel, then the back end.

        Frames must be in the order of `frame_id` and `t_source_ns`; motion is computed from the latter. Poses are in
        metres and rad, in the world of `Estimate.epoch` (`types.py` defines frames and units). Problems with a frame
        are a `Status` in both records; `Estimate.valid` states whether the estimate may be used for driving.
        `detections` of another detector (`perception.external.external_detections`) replace the network's; the third
        result then has the position of each box, in their order. Raises ValueError if the image size differs from the
        camera's, never because of its content.
        """
        pending = self.networks.start(frame.frame_id, frame.image, detections=detections)
        measurements = self.frontend.measure(frame, pending)
        estimate = self.graph.optimise(measurements)
        if detections is None:
            return measurements, estimate
        tracks = self.frontend.vehicles.tracker.tracks
        people = [(p.number, p.box.rows) for p in self.frontend.people.tracks if p.frame.frame_id == frame.frame_id]
        return measurements, estimate, place_boxes(len(detections), frame.frame_id, tracks, people, estimate)

    def map_update(self) -> MapUpdate | None:
        """New map points in world since the last call: landmarks that left the window, and points of lanes.

        None without new points.
        """
        return self.graph.map_update()
