"""Localises a frame against map points: matching, PnP with RANSAC, and a pose in SE(2) with its covariance.

All six degrees of freedom of the camera are estimated, with priors on height and tilt; the covariance is the marginal
of (x, y, yaw). Residuals are weighted by the noise of the corner and the depth uncertainty of its point; the depth of
each match is profiled out.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from birdslam.geometry.arrays import Bools, Floats, Ints
from birdslam.geometry.camera import Camera
from birdslam.geometry.pose import rotation_exp
from birdslam.geometry.se2 import SE2
from birdslam.loops.features import Features, match, match_near
from birdslam.loops.foot import body_pose, foot
from birdslam.loops.keyframe import Keyframe
from birdslam.loops.triangulation import cross
from birdslam.trajectory import Transform, ego_pose, inverse, mount_pose, split_pose
from birdslam.types import Attitude

MATCH_BITS, MATCH_RATIO = 72, 0.85  # without a prediction
GUIDED_BITS, GUIDED_RATIO = 80, 0.9  # with a prediction
GRID_CELLS = 8, 4  # columns and rows
RANSAC_PX, RANSAC_ITERATIONS = 4.0, 400
GATE = 3.0  # standard deviations of a coordinate
SIGMA_Z_M, SIGMA_TILT_RAD = 0.15, 0.03  # priors of a car's height and tilt relative to the map
ITERATIONS = 12
FORESEEN_PX = 12.0  # radius of the second matching, after RANSAC
# Number of further starts forwards and backwards along the direction of the largest variance, and their spacing
STARTS, START_STEP_M = 4, 0.5
MATCHES_AS_ONE = 4.0  # number of matches with a common error
TINY = 1e-12
WIDTH_STEP_RATIO = 3.0  # by which the width of the weight function decreases per iteration
MIN_WIDTH = 9.0  # its final width, as a chi-square
# Expected weighted mean of chi-square, and the ratio of the covariance to the weighted system's (asymptotic variance of
# an M-estimator, Huber 1981)
MEAN_CHI2, EFFICIENCY = 1.4911, 0.8105
OTHER_VIEW_PX = 1.0  # additional 1-sigma of a corner seen from another place and at another time


@dataclass(frozen=True, eq=False)
class LocalMap:
    """Points of a keyframe and its neighbours, in its ego frame."""

    keyframe: Keyframe
    points_m: Floats  # (N, 3)
    along_m: Floats  # (N, 3) depth sigma of each point, as a vector along its ray
    descriptors: NDArray[np.uint8]  # (N, 32)

    @staticmethod
    def around(keyframe: Keyframe, neighbours: Sequence[Keyframe]) -> LocalMap:
        """Collects the points of `keyframe` and of its `neighbours`."""
        points, along, descriptors = [], [], []
        back = inverse(keyframe.T_map)
        for other in (keyframe, *neighbours):
            T = back @ other.T_map
            from_camera = other.from_camera_m @ T[:3, :3].T
            points.append(from_camera + T[:3, 3] + other.camera_height_m * T[:3, 2])
            along.append(from_camera * other.sigma_depth_rel[:, None])
            descriptors.append(other.descriptors)
        return LocalMap(keyframe, np.concatenate(points), np.concatenate(along), np.concatenate(descriptors))


@dataclass(frozen=True, eq=False)
class Fix:
    """The pose of the ego relative to a keyframe, from one frame."""

    keyframe: Keyframe
    T_keyframe_ego: SE2
    cov: Floats  # (3, 3) of the tangent at the pose, from this frame's noise
    inliers: int
    matches: int
    places: int  # image cells with inliers
    attitude: Attitude  # of the ego in the keyframe's frame

    @property
    def T_map_ego(self) -> SE2:
        return self.keyframe.T_map_keyframe @ self.T_keyframe_ego

    @property
    def in_odometry(self) -> SE2:
        """T_keyframe_ego in metres of the keyframe's odometry."""
        return self.T_keyframe_ego.scaled(1.0 / self.keyframe.scale)

    def attitude_in_map(self, camera: Camera) -> Attitude:
        """Returns the attitude of the ego in the map, including the keyframe's."""
        T = self.keyframe.T_map @ body_pose(self.T_keyframe_ego, self.attitude, camera.height_m)
        return foot(T, camera.height_m)[1]


def locate(
    camera: Camera, features: Features, local: LocalMap, guess: SE2 | None, radius_px: float = 60.0
) -> Fix | None:
    """Localises `features` in the local map; returns None with too few matches.

    `guess`: T_keyframe_ego, accurate to `radius_px` in the image; without it the pose comes from RANSAC.
    """
    if len(features) < 8 or len(local.points_m) < 8:
        return None
    if guess is None:
        pairs = match(local.descriptors, features.descriptors, MATCH_BITS, MATCH_RATIO)
        pose, pairs = _ransac(camera, features, local, pairs)
    else:
        pose = ego_pose(guess, Attitude())
        pairs = _guided(camera, features, local, pose, radius_px)
    if pose is None or len(pairs) < 8:
        return None
    matches = _Matches(camera, features, local, pairs, radius_px)
    if guess is None:  # match again with the predicted positions
        first = _adjust(matches, pose)
        pose = first.pose if first is not None else pose
        pairs = _guided(camera, features, local, pose, FORESEEN_PX)
        matches = _Matches(camera, features, local, pairs, FORESEEN_PX)
    found = _adjust(matches, pose)
    return None if found is None else _likeliest(matches, found)


@dataclass(frozen=True, eq=False)
class _Matches:
    camera: Camera
    features: Features
    local: LocalMap
    pairs: Ints  # (N, 2) rows of the local map's points, and of the features
    radius_px: float  # search radius


@dataclass(frozen=True, eq=False)
class _Pose:
    """A local maximum of the likelihood of the matches."""

    pose: Transform  # T_keyframe_ego
    cov: Floats  # (3, 3) of (x, y, yaw) of the foot
    good: Bools  # (N,) inliers
    log_likelihood: float  # of matches that are inliers, or uniform within the radius


def _likeliest(matches: _Matches, first: _Pose) -> Fix:
    """Returns the most likely pose along the direction of the largest variance; the covariance includes the others.

    With many wrong matches the likelihood has several maxima along that direction, and the one nearest to the guess may
    be wrong.
    """
    h = matches.camera.height_m
    at, attitude = foot(first.pose, h)
    least = np.linalg.eigh(first.cov)[1][:, -1]
    least = least / math.hypot(least[0], least[1])
    steps_m = [START_STEP_M * n for n in range(-STARTS, STARTS + 1) if n]
    starts = [body_pose(at @ SE2.exp(step_m * least), attitude, h) for step_m in steps_m]
    found = [first, *filter(None, (_adjust(matches, start, MIN_WIDTH) for start in starts))]
    best, *others = sorted(found, key=lambda each: -each.log_likelihood)
    T_best, attitude = foot(best.pose, h)
    offs, weights = [np.zeros(3)], [1.0]
    for other in others:
        off = T_best.between(foot(other.pose, h)[0]).log()
        if all(float((off - known) @ np.linalg.solve(best.cov, off - known)) > GATE**2 for known in offs):
            offs.append(off)
            weights.append(math.exp((other.log_likelihood - best.log_likelihood) / MATCHES_AS_ONE))
    spread = np.einsum("k,ki,kj->ij", np.array(weights) / sum(weights), np.array(offs), np.array(offs))
    size_px = matches.camera.width_px, matches.camera.height_px
    cells = np.floor(matches.features.px[matches.pairs[best.good, 1]] / size_px * GRID_CELLS).astype(int)
    places = len(np.unique(cells, axis=0))
    inliers = int(best.good.sum())
    return Fix(matches.local.keyframe, T_best, best.cov + spread, inliers, len(matches.pairs), places, attitude)


def _camera_pose(camera: Camera, T_keyframe_ego: Transform) -> Transform:
    """Returns `T_cam_keyframe`."""
    return inverse(T_keyframe_ego @ mount_pose(camera.ground))


def _ransac(camera: Camera, features: Features, local: LocalMap, pairs: Ints) -> tuple[Transform | None, Ints]:
    if len(pairs) < 8:
        return None, pairs
    found, rotated, moved, inliers = cv2.solvePnPRansac(
        local.points_m[pairs[:, 0]],
        features.px[pairs[:, 1]],
        camera.K,
        None,
        iterationsCount=RANSAC_ITERATIONS,
        reprojectionError=RANSAC_PX * max(1.0, float(np.median(features.sigma_px))),
        confidence=0.999,
        flags=cv2.SOLVEPNP_AP3P,
    )
    if not found or inliers is None or len(inliers) < 8:
        return None, pairs
    T_cam_keyframe = np.eye(4)
    T_cam_keyframe[:3, :3] = rotation_exp(rotated.ravel().astype(np.float64))
    T_cam_keyframe[:3, 3] = moved.ravel()
    if not np.isfinite(T_cam_keyframe).all():
        return None, pairs
    pose = inverse(mount_pose(camera.ground) @ T_cam_keyframe)
    tilt = abs(split_pose(pose)[1].pitch_rad) + abs(split_pose(pose)[1].roll_rad)
    if tilt > 6.0 * SIGMA_TILT_RAD or abs(pose[2, 3]) > 1.0:  # implausible for a car on this road
        return None, pairs
    return pose, pairs[inliers.ravel()]


def _guided(camera: Camera, features: Features, local: LocalMap, pose: Transform, radius_px: float) -> Ints:
    """Returns the matches within `radius_px` of each projected point."""
    T = _camera_pose(camera, pose)
    p = local.points_m @ T[:3, :3].T + T[:3, 3]
    rows = np.flatnonzero(p[:, 2] > 1.0)
    px = camera.to_px(p[rows, :2] / p[rows, 2:])
    pairs = match_near(
        *(local.descriptors[rows], px, features.descriptors, features.px, radius_px), GUIDED_BITS, GUIDED_RATIO
    )
    return np.column_stack([rows[pairs[:, 0]], pairs[:, 1]])


def _jacobian(p_ego: Floats, mount: Transform) -> Floats:
    """Returns the Jacobian (N, 2, 6) of image coordinates of points (N, 3) in ego by a step of the ego in its frame."""
    R_cam_ego = mount[:3, :3].T
    p = (p_ego - mount[:3, 3]) @ R_cam_ego.T
    z = np.maximum(p[:, 2], 0.3)
    J_ego = np.zeros((len(p), 3, 6))
    J_ego[:, :, :3], J_ego[:, :, 3:] = -np.eye(3), cross(p_ego)
    J_cam = R_cam_ego @ J_ego
    J: Floats = (J_cam[:, :2] - (p[:, :2] / z[:, None])[:, :, None] * J_cam[:, 2:3]) / z[:, None, None]
    return J


def _adjust(matches: _Matches, pose: Transform, width: float = math.inf) -> _Pose | None:
    """Refines a pose by Gauss-Newton with Geman-McClure weights.

    Graduated non-convexity (Black and Rangarajan 1996): the width of the weight function decreases from `width`, a
    chi-square; narrow weights at the start would keep a wrong guess by its far points.
    """
    camera, features, local, pairs = matches.camera, matches.features, matches.local, matches.pairs
    if len(pairs) < 8:
        return None
    mount = mount_pose(camera.ground)
    R_cam_ego = mount[:3, :3].T
    points, along = local.points_m[pairs[:, 0]], local.along_m[pairs[:, 0]]
    xy = camera.to_xy(features.px[pairs[:, 1]])
    noise = (features.sigma_px[pairs[:, 1]] ** 2 + OTHER_VIEW_PX**2) / camera.fx_px**2
    prior = np.array([0.0, 0.0, SIGMA_Z_M**-2, SIGMA_TILT_RAD**-2, SIGMA_TILT_RAD**-2, 0.0])
    good: Bools = np.ones(len(pairs), bool)
    H: Floats = np.eye(6)
    W: NDArray[np.floating[Any]] = np.zeros((len(pairs), 2, 2))
    chi2 = weight = np.zeros(len(pairs))
    for _ in range(ITERATIONS):
        p_ego = (points - pose[:3, 3]) @ pose[:3, :3]
        p = (p_ego - mount[:3, 3]) @ R_cam_ego.T
        z = np.maximum(p[:, 2], 0.3)
        predicted = p[:, :2] / z[:, None]
        along_cam = along @ pose[:3, :3] @ R_cam_ego.T
        blur = (along_cam[:, :2] - predicted * along_cam[:, 2:3]) / z[:, None]  # of the 1-sigma depth, in the image
        error = xy - predicted
        # J at the most likely depth of the match; at the map's depth the lateral offset would be attenuated (errors in
        # variables, Fuller 1987)
        sigmas = (blur * error).sum(axis=1) / (noise + (blur**2).sum(axis=1))
        q_ego = p_ego + np.clip(sigmas, -GATE, GATE)[:, None] * (along @ pose[:3, :3])
        J = _jacobian(q_ego, mount)
        W = np.linalg.inv(noise[:, None, None] * np.eye(2) + blur[:, :, None] * blur[:, None, :])
        chi2 = (error * (W @ error[:, :, None])[:, :, 0]).sum(axis=1)
        good = (chi2 < GATE**2) & (p[:, 2] > 0.5)
        width = max(min(width / WIDTH_STEP_RATIO, float(np.median(chi2))), MIN_WIDTH)
        weight = (p[:, 2] > 0.5) / (1.0 + chi2 / width) ** 2
        weighed = (weight[:, None, None] * (W @ J)).reshape(-1, 6)
        H = weighed.T @ J.reshape(-1, 6)
        g = weighed.T @ error.ravel()
        state = split_pose(pose)[1]
        g -= prior * np.array([0.0, 0.0, pose[2, 3], state.roll_rad, state.pitch_rad, 0.0])
        H += np.diag(prior)
        if not np.isfinite(H).all() or np.linalg.cond(H) > 1e14:
            return None
        step = np.linalg.solve(H, g)
        pose = pose.copy()
        pose[:3, 3] += pose[:3, :3] @ np.clip(step[:3], -2.0, 2.0)
        pose[:3, :3] = pose[:3, :3] @ rotation_exp(step[3:])
        if width == MIN_WIDTH and float(np.abs(step).max()) < 1e-5:
            break
    if not good.any() or abs(pose[2, 3]) > 1.5 or math.hypot(*pose[:2, 3]) > 60.0:
        return None
    h = camera.height_m
    J_foot = np.array([[1, 0, 0, 0, h, 0], [0, 1, 0, -h, 0, 0], [0, 0, 0, 0, 0, 1]])  # foot by body
    cov: Floats = J_foot @ np.linalg.inv(H) @ J_foot.T
    # The a posteriori variance of unit weight
    cov *= EFFICIENCY * max(1.0, float((weight * chi2).sum() / weight.sum()) / MEAN_CHI2)
    share = float(good.mean())
    right = share * np.sqrt(np.linalg.det(W)) / (2.0 * math.pi) * np.exp(-0.5 * chi2)
    wrong = (1.0 - share) * camera.fx_px**2 / (math.pi * matches.radius_px**2)
    return _Pose(pose, cov, good, float(np.log(right + wrong + TINY).sum()))
