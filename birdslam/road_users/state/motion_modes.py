"""Motion modes of vehicles and the mixing of their filters in `parallax.Parallax`.

Interacting multiple model (Blom and Bar-Shalom 1988): before each prediction the filters are mixed by the transition
probabilities of the modes; each mode has its own process noise.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from birdslam.geometry.se2 import SE2
from birdslam.road_users.state.parallax_config import (
    ANOTHER_FOR_S,
    CHANGE_ACROSS_MPS,
    CHANGE_MPS,
    CREEPING_RATIO,
    CREEPS_FOR_S,
    CROSSING_RATIO,
    DRIVES_FOR_S,
    SIGMA_ACROSS_MPS,
    SIGMA_ACROSS_REL,
    SIGMA_CREEP_MPS,
    SIGMA_DRIVE_MPS,
    STANDING_RATIO,
    STANDS_FOR_S,
    UNUSUAL_RATIO,
)
from birdslam.road_users.state.parallax_measurements import VX, VY

Floats = NDArray[np.float64]

# UNUSUAL_SIZE is stationary with an unusual size. NEIGHBOUR is stationary, but the boxes are those of a neighbour of
# the track's vehicle. STARTED was stationary before, so that its size and place are known
MODES = STATIONARY, UNUSUAL_SIZE, NEIGHBOUR, STARTED, CREEPING, DRIVING, CROSSING = range(7)
STATIONARY_MODES, MOVING_MODES = [STATIONARY, UNUSUAL_SIZE], [STARTED, CREEPING, DRIVING, CROSSING]
WITHOUT_GROUND = [7, 8]  # STATIONARY_MODES again, without the cue GROUND
_AT_REST = slice(STATIONARY, NEIGHBOUR + 1)
FILTERS = len(MODES) + len(WITHOUT_GROUND)


def birth_weights() -> Floats:
    """(MODES,) probability of each mode at the first observation."""
    driving = 1.0 - STANDING_RATIO - UNUSUAL_RATIO - CREEPING_RATIO - CROSSING_RATIO
    return np.array([STANDING_RATIO, UNUSUAL_RATIO, 0.0, 0.0, CREEPING_RATIO, driving, CROSSING_RATIO])


def birth_velocity_cov(heading_rad: Floats, on_road: bool) -> dict[int, Floats]:
    """(2, 2) velocity covariance in world of a new vehicle, per moving mode."""
    out = {CROSSING: np.eye(2) * SIGMA_DRIVE_MPS**2}
    for moving, along_mps in ((CREEPING, SIGMA_CREEP_MPS), (DRIVING, SIGMA_DRIVE_MPS)):
        on_road_mps = math.hypot(SIGMA_ACROSS_MPS, SIGMA_ACROSS_REL * along_mps)
        across_mps = on_road_mps if on_road else along_mps
        out[moving] = rotate(np.square([along_mps, across_mps]), heading_rad)[0]
    return out


def transitions(own_for_s: float, dt_s: float) -> Floats:
    """(MODES, MODES), from and to: transition probabilities within `dt_s`."""
    times_s = STANDS_FOR_S, CREEPS_FOR_S, DRIVES_FOR_S, own_for_s, ANOTHER_FOR_S
    starts, changes, slows, switches, settles = (1.0 - math.exp(-dt_s / time_s) for time_s in times_s)
    share = np.eye(len(MODES))
    share[STATIONARY_MODES, STATIONARY_MODES] = (1.0 - starts) * (1.0 - switches)
    share[STATIONARY_MODES, STARTED], share[STATIONARY_MODES, NEIGHBOUR] = starts, (1.0 - starts) * switches
    share[NEIGHBOUR, NEIGHBOUR], share[NEIGHBOUR, STATIONARY] = (
        (1.0 - starts) * (1.0 - settles),
        (1.0 - starts) * settles,
    )
    share[NEIGHBOUR, STARTED] = starts
    for slow in (STARTED, CREEPING):
        share[slow, slow], share[slow, STATIONARY] = 1.0 - changes / 2.0, changes / 2.0
    share[CREEPING, CREEPING], share[CREEPING, DRIVING] = 1.0 - changes, changes / 2.0
    for fast in (DRIVING, CROSSING):
        share[fast, fast], share[fast, CREEPING] = 1.0 - slows, slows
    return share


def mix(
    own_for_s: float, dt_s: float, weight: Floats, x: Floats, P: Floats, neighbour_cov: Floats
) -> tuple[Floats, Floats, Floats]:
    """Weights (N, MODES), states (N, FILTERS, 8) and covariances after transitions within `dt_s`.

    `own_for_s` is the mean time until the boxes are those of a neighbour, `neighbour_cov` (N, 8, 8) the covariance
    of a neighbour's state about a vehicle's own.
    """
    joint = weight[:, :, None] * transitions(own_for_s, dt_s)
    after = joint.sum(axis=1)
    share = joint / after[:, None]
    modes, without_ground = list(MODES), [*WITHOUT_GROUND, NEIGHBOUR, *MOVING_MODES]
    mixed_x, mixed_P = x.copy(), P.copy()
    mixed_x[:, modes], mixed_P[:, modes] = _mix_moments(share, x[:, modes], P[:, modes])
    mixed_P[:, NEIGHBOUR] += share[:, STATIONARY_MODES, NEIGHBOUR].sum(axis=1)[:, None, None] * neighbour_cov
    mixed_x[:, WITHOUT_GROUND], mixed_P[:, WITHOUT_GROUND] = _mix_moments(
        share[..., STATIONARY_MODES], x[:, without_ground], P[:, without_ground]
    )
    return after, mixed_x, mixed_P


def _mix_moments(share: Floats, x: Floats, P: Floats) -> tuple[Floats, Floats]:
    """Moments of filters (N, 7) mixed by `share` (N, 7, K); the first three of both are stationary."""
    P[:, _AT_REST, [[VX], [VY]], [[VX], [VY]]] = SIGMA_CREEP_MPS**2  # velocity at the start of a motion
    to = share.swapaxes(1, 2)  # (N, to, from)
    mean = to @ x
    gap = x[:, None] - mean[:, :, None]  # (N, to, from, 8)
    cov = (to @ P.reshape(*P.shape[:2], -1)).reshape(*mean.shape, P.shape[-1])
    cov += (to[..., None] * gap).swapaxes(-1, -2) @ gap
    speed = slice(VX, VY + 1)
    mean[:, _AT_REST, speed] = 0.0
    cov[:, _AT_REST, speed] = 0.0
    cov[:, _AT_REST, :, speed] = 0.0
    return mean, cov


def process_noise(dt_s: float, yaw_rad: Floats, on_road: NDArray[np.bool_]) -> Floats:
    """(N, len(MOVING_MODES), 4, 4) of x, y, vx, vy: along and across the heading, or isotropic."""
    along_across = rotate(np.square([CHANGE_MPS, CHANGE_ACROSS_MPS]), yaw_rad)
    of_velocity = np.stack([along_across] * len(MOVING_MODES), axis=1)
    of_velocity[~on_road] = of_velocity[:, MOVING_MODES.index(CROSSING)] = np.eye(2) * CHANGE_MPS**2
    in_time = np.array([[dt_s**3 / 3.0, dt_s**2 / 2.0], [dt_s**2 / 2.0, dt_s]])
    out: Floats = in_time[:, None, :, None] * of_velocity[:, :, None, :, None, :]  # the Kronecker product
    return out.reshape(*of_velocity.shape[:2], 4, 4)


def ego_step_cov(at_m: Floats, T_world_ego: SE2, cov: Floats) -> Floats:
    """(..., 2, 2) covariance in world of points `at_m` (..., 2) that an error of the ego's step moves.

    `cov` (3, 3) is that of the step in its tangent space.
    """
    from_ego = at_m - [T_world_ego.x_m, T_world_ego.y_m]
    J = np.zeros((*at_m.shape[:-1], 2, 3))
    J[..., :2] = T_world_ego.rotation()
    J[..., 0, 2], J[..., 1, 2] = -from_ego[..., 1], from_ego[..., 0]
    out: Floats = J @ cov @ J.swapaxes(-1, -2)
    return out


def rotate(variances: Floats, yaw_rad: Floats) -> Floats:
    """(N, 2, 2) in world of `variances` (2,) along and across headings (N,)."""
    c, s = np.cos(yaw_rad), np.sin(yaw_rad)
    R = np.stack([c, -s, s, c], axis=-1).reshape(-1, 2, 2)
    out: Floats = R * variances @ R.swapaxes(-1, -2)
    return out
