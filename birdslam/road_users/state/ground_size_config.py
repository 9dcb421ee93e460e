"""Parameters of `ground_size_filter.GroundSizeFilter`; docs/constants.md lists the tuned ones."""

from __future__ import annotations

import msgspec
import numpy as np
from numpy.typing import NDArray

from birdslam.road_users.state.ground_measurements import CUES, Cue

ROLL_MEMORY_S = 20.0  # correlation time of roll and crown, in driving time
# Road and view change with the distance, not with time: the driving fraction of a second is 1 - exp(-speed / this)
DRIVING_MPS = 1.0
# Common relative offset of the heights: regional cars, edges of the detector
SIGMA_COMMON_REL = 0.025  # 1-sigma
SIZE_DOF = 4.0  # degrees of freedom of Student's t of the height; inf: normal distribution
TILT_MEMORY_S = 5.0  # correlation time of the road's tilt at a road user, in driving time
WIDTH_DRIFT_REL = 0.002  # of the outline, per frame
WIDTH_TURN_REL = 1.0  # of the outline, per radian of rotation of the line of sight
WIDTH_TURNED_REL = 0.6  # of a change of the outline by a yaw correction
IMAGE_PITCH_SIGMA_REL = 0.5  # factor on the images' sigma of the pitch
# 1-sigma of the systematic errors of the tilt by images
SIGMA_IMAGE_PITCH_RAD = 0.002
SIGMA_IMAGE_ROLL_RAD = 0.009  # the same of the roll
IMAGE_PITCH_MEMORY_S = 1.5  # correlation time, in driving time
IMAGE_ROLL_MEMORY_S = 5.0  # the same of the roll
# Common relative offset of the heights of people, and common height of the pavement relative to the camera's
SIGMA_BODIES_REL = 0.055
SIGMA_PAVEMENT_REL = 0.036  # 1-sigma of the latter
IMAGE_VAR = np.square([SIGMA_IMAGE_PITCH_RAD, SIGMA_IMAGE_ROLL_RAD])


class GroundSizeConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Priors of roads and vehicles, and correlation of the errors of boxes."""

    sigma_pitch_rad: float = 0.010  # of the camera over the road about its calibration
    sigma_roll_rad: float = 0.02  # the same
    pitch_memory_s: float = 5.0  # correlation time of the pitch, in driving time
    sigma_pitch_step_rad: float = 0.0008  # per frame of driving: change of grade, odometry error
    sigma_pitch_blind_rad: float = 0.003  # per frame without odometry
    sigma_kerb_m: float = 0.018  # ground offset under a vehicle from the ego's plane
    sigma_common_edge_rel: float = 0.015  # of the height: common offset of all lower edges
    sigma_edge_rel: float = 0.022  # of the height: offset of the lower edge of a vehicle
    sigma_tilt_rad: float = 0.0015  # of the road at a vehicle relative to the ego
    sigma_crown_rad: float = 0.0038  # and its growth per unit of y/x
    # Crown: common slope of both sides of the road relative to the ego plane
    sigma_common_crown_rad: float = 0.012
    # Scale of Student's t of the road's vertical curvature
    sigma_vertical_per_m: float = 1.5e-4
    vertical_dof: float = 6.0  # of that distribution
    # 1-sigma of the curvature of a vehicle's path: a bend of 200 m
    bend_per_m: float = 0.005
    roof_reach_rel: float = 0.6  # of the vehicle's extent along the line of sight, to the edge of its roof
    cues: tuple[Cue, ...] = CUES  # measurements of a box that are used
    gate_sigma: float = 2.0  # Huber threshold of a measurement
    box_memory_s: float = 0.5  # correlation time of the errors of a box, in driving time

    @property
    def road_var(self) -> NDArray[np.float64]:
        """(3,) variances of pitch and roll about the calibration, and of the crown."""
        return np.square([self.sigma_pitch_rad, self.sigma_roll_rad, self.sigma_common_crown_rad])

    @property
    def road_memory_s(self) -> NDArray[np.float64]:
        """(3,) their correlation times, in driving time."""
        return np.array([self.pitch_memory_s, ROLL_MEMORY_S, ROLL_MEMORY_S])
