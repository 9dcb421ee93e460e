"""The configuration of the metric scale and of the road's tilt; each constant's data stand in docs/constants.md."""

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
    """The metric scale and the tilt over time.

    `mode` is the strategy: "kalman" is `road.scale.RoadScale`, "paper" `road.moving_median.MovingMedianScale`.
    """

    mode: Literal["kalman", "paper"] = "kalman"  # of the metric scale: a Kalman filter, or the paper's moving median
    align: RoadAlignConfig = RoadAlignConfig()
    fixed_pattern: FixedPatternConfig = FixedPatternConfig()
    bonnet: BonnetConfig = BonnetConfig()
    vanishing_point: VanishingPointConfig = VanishingPointConfig()
    min_baseline_m: Positive = 0.35  # travelled between the two images
    target_baseline_m: Positive = 1.1  # the keyframe image nearest to this is aligned with
    keyframes: Annotated[int, msgspec.Meta(ge=2)] = 8  # keyframe images of the road
    # of the two images of the road; less is a rejection
    min_correlation: Annotated[float, msgspec.Meta(gt=0.0, lt=1.0)] = 0.35
    max_innovation_sigma: Positive = 4.0  # an alignment farther from its prediction is rejected
    confirmations: Annotated[int, msgspec.Meta(ge=1)] = 3  # alignments in a row before a scale counts as known
    doubt_sigma_rel: Positive = 0.15  # above it lengths far from the present one are searched for
    doubt_after: Annotated[int, msgspec.Meta(ge=1)] = 3  # rejected alignments in a row that begin such a search
    violated_after: Annotated[int, msgspec.Meta(ge=1)] = 5  # rejected alignments in a row until the ground is doubtful
    sigma_scale_floor_rel: Positive = 0.015  # of one alignment, at the least: the road is no perfect plane
    sigma_tilt_floor_rad: Positive = 0.004  # of one alignment, at the least
    sigma_bounce_rad: Positive = 0.012  # pitch and roll of the body about their mean, one sample in bounce_m
    bounce_m: Positive = 3.0  # correlation length of the body's bounce
    sigma_travel_rad: Positive = 0.012  # of the direction of travel against the road, over one metre
    # The corners' error of that direction is correlated while they are in sight. The roads of tests/roads and the
    # shipped drive behind its windscreens, from six images each, KITTI 00, 01, 06 and 0005 chose it of 0 to 15 m
    travel_correlation_m: Positive = 3.0
    # A camera file's pitch this far from the first direction of travel is wrong: bumps and loads make a degree
    wrong_pitch_rad: Positive = 0.025
    max_wrong_pitch_rad: Positive = 0.08  # a direction that is off by more is no car's and is not used
    sigma_mount_rad: Positive = 0.02  # of the calibrated pitch and roll
    sigma_unseen_rad: Positive = 0.03  # of the tilt after the camera turned without being seen
    scale_walk_rel_per_sqrt_m: Positive = 0.004  # random walk of the visual scale
    # ... and what of it lasts: the motorway clip drifts by -0.24 % a metre, KITTI 01 by -0.19, 00, 06 and 0005 by 0.04
    scale_drift_per_m: Positive = 0.0013
    scale_drift_memory_m: Positive = 100.0  # over which that drift lasts
    # The walk by the path's curvature: on KITTI 01's ramp of 21 m radius it drifts by 12 % over as many metres
    scale_walk_bend_sqrt_m: Positive = 0.4
    max_bend_per_m: Positive = 0.15  # the path's curvature is clipped to it
    tilt_walk_rad_per_sqrt_m: Positive = 0.003  # crown and grade of the road
    sigma_curvature_per_m: Positive = 0.0006  # of roads lengthwise: town streets have radii of 500 m and more
    curvature_memory_m: Positive = 30.0  # correlation length of crests and sags
    sigma_curvature_floor_per_m: Positive = 0.0001  # of one alignment, at the least
    chord_m: Positive = 15.0  # the reported ground plane meets the road at the foot and this far ahead
    mount_walk_rad_per_sqrt_m: Positive = 0.0007  # of the mean pitch and roll, as loads and tanks change
    carried_after_m: Positive = 6.0  # without an accepted alignment, until the status says so
    invalid_sigma_rel: Positive = 0.15  # of the scale; above it a frame is invalid
    # By judgement: behind rain drawn over recorded drives lengths are off by 1 to 6 %, all the way
    sigma_on_glass_rel: Positive = 0.03  # of the scale, lasting, while something on the windscreen is in view
    mount_change: MountChangeConfig = MountChangeConfig()
    car: CarSpeedConfig = CarSpeedConfig()
    # mode "paper" only
    median_frames: Annotated[int, msgspec.Meta(ge=1)] = 21  # of the moving median; the paper states none
    median_landmarks: Annotated[int, msgspec.Meta(ge=1)] = 3  # on the road, or the frame gives no scale
    median_range_m: Positive = 20.0  # of those landmarks: the paper's depth threshold T
    median_sigma_depth_rel: Positive = 0.1  # of the depth of a landmark that counts, 1-sigma
