"""Priors of roads and vehicles for `ground_size_filter.GroundSizeFilter`; docs/constants.md has the data of those that
data chose.
"""

from __future__ import annotations

import msgspec
import numpy as np
from numpy.typing import NDArray

from birdslam.vehicles.state.ground_measurements import CUES, Cue


class GroundSizeConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Priors of roads and vehicles, and how long the errors of a box last."""

    sigma_pitch_rad: float = 0.010  # of the camera over real roads against its calibration, all together
    sigma_roll_rad: float = 0.02  # the same
    pitch_memory_s: float = 5.0  # of driving: how long the pitch's deviation from the calibration lasts
    roll_memory_s: float = 20.0  # of driving: how long the roll's deviation lasts, and a crown
    sigma_pitch_step_rad: float = 0.0008  # a frame of driving: the road's change of grade, and the odometry's error
    sigma_pitch_blind_rad: float = 0.003  # a frame without odometry
    # Road and views change with time far above this speed, and with the way far below it: of a second, 1 - exp(-speed /
    # this) is of driving. KITTI tracking chose between it and 3 m/s
    driving_mps: float = 1.0
    # What the heights of a drive's vehicles have in common against their classes': the region's cars, and where the
    # detector draws a box's edges with this camera
    sigma_common_rel: float = 0.025
    size_dof: float = 4.0  # of Student's t, whose tails a height has within its class; inf: a normal distribution
    sigma_kerb_m: float = 0.018  # how far the road under a vehicle lies off the ego's plane, whatever its distance
    sigma_common_edge_rel: float = 0.015  # of its height: where a detector draws the lower edges of all vehicles alike
    sigma_edge_rel: float = 0.022  # of its height: a detector draws the lower edge of one vehicle alike in all frames
    sigma_tilt_rad: float = 0.0015  # of the road at a vehicle against the ego's
    sigma_crown_rad: float = 0.0038  # and the more the farther it stands to the side, a unit of y/x
    # By how much both sides of the road fall off, or rise, against the plane under the ego: its crown, other streets
    sigma_common_crown_rad: float = 0.012
    # Student's t of the road's vertical curvature at 5 to 50 m, by poses of KITTI tracking: two thirds of all places
    # have less than 1.6e-4, one in a hundred more than 6e-4
    sigma_vertical_per_m: float = 1.5e-4
    vertical_dof: float = 6.0  # of that distribution: hills are far in its tails
    tilt_memory_s: float = 5.0  # of driving: how long that tilt lasts
    width_drift_rel: float = 0.002  # of the outline, a frame
    width_turn_rel: float = 1.0  # of the outline, a radian that the line of sight turned: the yaw is not known as well
    # 1-sigma of the curvature of a vehicle's own way: a bend of 200 m. KITTI tracking chose between it and 100 m
    bend_per_m: float = 0.005
    width_turned_rel: float = 0.6  # of a change of the outline that comes of a yaw newly learned
    roof_reach_rel: float = 0.6  # of the vehicle's extent along the line of sight, to the edge of its roof
    cues: tuple[Cue, ...] = CUES  # which measurements of a box are used
    gate_sigma: float = 2.0  # past it a measurement is an outlier: its weight falls with its residual (Huber)
    image_pitch_sigma_rel: float = 0.5  # of the images' own sigma of the pitch, which is too cautious
    # By how much the images' tilt is off for long: they see the road before the ego, vehicles stand beside it too
    sigma_image_pitch_rad: float = 0.002
    sigma_image_roll_rad: float = 0.009  # the same of the roll
    image_pitch_memory_s: float = 1.5  # of driving: for how long
    image_roll_memory_s: float = 5.0  # the same of the roll
    box_memory_s: float = 0.5  # for so long a box has the same error: this time of driving counts as one box

    @property
    def image_var(self) -> NDArray[np.float64]:
        """(2,) of the lasting errors of the images' pitch and roll."""
        return np.square([self.sigma_image_pitch_rad, self.sigma_image_roll_rad])

    @property
    def road_var(self) -> NDArray[np.float64]:
        """(3,) of pitch and roll about the calibration, and of the crown."""
        return np.square([self.sigma_pitch_rad, self.sigma_roll_rad, self.sigma_common_crown_rad])

    @property
    def road_memory_s(self) -> NDArray[np.float64]:
        """(3,) of driving: how long each of them lasts."""
        return np.array([self.pitch_memory_s, self.roll_memory_s, self.roll_memory_s])
