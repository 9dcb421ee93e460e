"""Configuration of the odometry."""

from __future__ import annotations

from typing import Annotated

import msgspec

from birdslam.odometry.corners.below_plane import BelowPlaneConfig
from birdslam.odometry.corners.feature_tracks import FeatureConfig
from birdslam.odometry.corners.initialisation import InitialisationConfig
from birdslam.odometry.corners.keyframes import KeyframeConfig
from birdslam.odometry.motion import MotionConfig
from birdslam.odometry.obstruction.fixed_corners import FixedCornersConfig
from birdslam.odometry.scale_config import RoadScaleConfig
from birdslam.odometry.speed.constant_velocity import ConstantVelocityConfig
from birdslam.odometry.speed.stillness import StillnessConfig
from birdslam.odometry.speed.zero_velocity import ZeroVelocityConfig

Positive = Annotated[float, msgspec.Meta(gt=0.0)]
Count = Annotated[int, msgspec.Meta(ge=1)]


class OdometryConfig(KeyframeConfig, frozen=True, forbid_unknown_fields=True):
    """Parameters of the odometry, the same for every camera, road and frame rate."""

    features: FeatureConfig = FeatureConfig()
    road: RoadScaleConfig = RoadScaleConfig()
    motion: MotionConfig = MotionConfig()
    start: InitialisationConfig = InitialisationConfig()
    two_view_px: Positive = 0.7  # inlier threshold of a two-view pose
    min_fitting: Count = 18  # minimum inliers of a resection
    min_fitting_fraction: Positive = 0.35  # minimum ratio of inliers to visible landmarks
    max_speed_mps: Positive = 70.0  # a resection with a faster motion is rejected
    max_coast_s: Positive = 1.0  # maximum coasting time; then the window restarts
    zero_velocity: ZeroVelocityConfig = ZeroVelocityConfig()
    fixed_corners: FixedCornersConfig = FixedCornersConfig()
    constant_velocity: ConstantVelocityConfig = ConstantVelocityConfig()
    below_plane: BelowPlaneConfig = BelowPlaneConfig()
    stillness: StillnessConfig = StillnessConfig()
