"""Configuration of the metric scale and of the camera's tilt against the road."""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec

from birdslam.odometry.obstruction.bonnet import BonnetConfig
from birdslam.odometry.obstruction.fixed_pattern import FixedPatternConfig
from birdslam.odometry.road.alignment import RoadAlignConfig
from birdslam.odometry.road.mount_change import MountChangeConfig
from birdslam.odometry.road.vanishing_point import VanishingPointConfig
from birdslam.odometry.speed.readings import CarSpeedConfig

Positive = Annotated[float, msgspec.Meta(gt=0.0)]


class RoadScaleConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Parameters of the metric scale and of the tilt.

    `mode` selects `road.scale.RoadScale` ("kalman") or `road.moving_median.MovingMedianScale` ("paper").
    """

    mode: Literal["kalman", "paper"] = "kalman"  # Kalman filter, or the paper's moving median
    align: RoadAlignConfig = RoadAlignConfig()
    fixed_pattern: FixedPatternConfig = FixedPatternConfig()
    bonnet: BonnetConfig = BonnetConfig()
    vanishing_point: VanishingPointConfig = VanishingPointConfig()
    min_baseline_m: Positive = 0.35  # minimum distance between the two aligned images
    target_baseline_m: Positive = 1.1  # preferred distance between the two aligned images
    keyframes: Annotated[int, msgspec.Meta(ge=2)] = 8  # number of keyframe images of the road
    # of the two images of the road; an alignment with less is rejected
    min_correlation: Annotated[float, msgspec.Meta(gt=0.0, lt=1.0)] = 0.35
    max_innovation_sigma: Positive = 4.0  # gate of an alignment
    doubt_sigma_rel: Positive = 0.15  # above this the length is searched globally
    doubt_after: Annotated[int, msgspec.Meta(ge=1)] = 3  # consecutive rejected alignments that trigger the search
    violated_after: Annotated[int, msgspec.Meta(ge=1)] = 5  # consecutive rejected alignments until ground_violated
    sigma_scale_floor_rel: Positive = 0.015  # minimum 1-sigma of an alignment: the road is not a perfect plane
    sigma_tilt_floor_rad: Positive = 0.004  # minimum 1-sigma of an alignment
    sigma_bounce_rad: Positive = 0.012  # 1-sigma of the body's pitch and roll about their mean, one sample per bounce_m
    bounce_m: Positive = 3.0  # correlation length of the body's bounce
    sigma_travel_rad: Positive = 0.012  # 1-sigma of the direction of travel against the road, over one metre
    travel_correlation_m: Positive = 3.0  # correlation length of that direction's error by the corners
    # Difference between the camera file's pitch and the first direction of travel above which the file is wrong
    wrong_pitch_rad: Positive = 0.025
    max_wrong_pitch_rad: Positive = 0.08  # a larger difference is not plausible and is ignored
    sigma_mount_rad: Positive = 0.02  # 1-sigma of the calibrated pitch and roll
    sigma_unseen_rad: Positive = 0.03  # 1-sigma of the tilt after an unobserved rotation
    scale_walk_rel_per_sqrt_m: Positive = 0.004  # random walk of the visual scale
    scale_drift_per_m: Positive = 0.0013  # 1-sigma of the correlated drift of the visual scale
    scale_drift_memory_m: Positive = 100.0  # correlation length of the drift
    scale_walk_bend_sqrt_m: Positive = 0.4  # random walk of the visual scale, proportional to the path's curvature
    max_bend_per_m: Positive = 0.15  # maximum curvature of the path
    tilt_walk_rad_per_sqrt_m: Positive = 0.003  # random walk of the tilt: crown and grade of the road
    sigma_curvature_per_m: Positive = 0.0006  # 1-sigma of the vertical curvature: radii of 500 m and more in towns
    curvature_memory_m: Positive = 30.0  # correlation length of crests and sags
    sigma_curvature_floor_per_m: Positive = 0.0001  # minimum 1-sigma of an alignment
    chord_m: Positive = 15.0  # the reported ground plane intersects the road at the foot and this far ahead
    mount_walk_rad_per_sqrt_m: Positive = 0.0007  # random walk of the mount's pitch and roll, by load
    carried_after_m: Positive = 6.0  # distance without an accepted alignment until scale_carried
    invalid_sigma_rel: Positive = 0.15  # 1-sigma of the scale above which a frame is invalid
    sigma_on_glass_rel: Positive = 0.03  # 1-sigma of the systematic scale error behind a dirty windscreen
    mount_change: MountChangeConfig = MountChangeConfig()
    car: CarSpeedConfig = CarSpeedConfig()
    # mode "paper" only
    median_frames: Annotated[int, msgspec.Meta(ge=1)] = 21  # window of the moving median; the paper states none
    confirmations: Annotated[int, msgspec.Meta(ge=1)] = 3  # frames with a scale until it is known
    median_landmarks: Annotated[int, msgspec.Meta(ge=1)] = 3  # minimum landmarks on the road for the scale of a frame
    median_range_m: Positive = 20.0  # maximum depth of those landmarks, the paper's threshold T
    median_sigma_depth_rel: Positive = 0.1  # maximum 1-sigma of the depth of those landmarks
