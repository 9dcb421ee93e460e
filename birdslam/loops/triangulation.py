"""Triangulates a keyframe's points from its features and their matches in the frames around it.

Points are inverse depths along the keyframe's rays (Civera et al. 2008). Depths and poses are refined alternately;
odometry is the prior of the poses and sets the scale.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from birdslam.geometry.arrays import Bools, Floats, Ints
from birdslam.geometry.camera import Camera
from birdslam.geometry.pose import rotation_exp, rotation_log
from birdslam.loops.features import Features, match
from birdslam.trajectory import Transform, inverse

MATCH_BITS = 60  # max. distance between neighbouring frames
MATCH_RATIO = 0.85
MIN_FRAMES = 3  # with the point, besides the keyframe
REFINEMENTS = 3
MIN_DISTANCE_M, MAX_DISTANCE_M = 1.5, 120.0
MAX_SIGMA_REL = 0.25
GATE = 3.0  # standard deviations of a coordinate
PRIOR_ROTATION_RAD = 0.002  # of odometry between the frames of a keyframe's window
PRIOR_TRANSLATION_REL, PRIOR_TRANSLATION_M = 0.01, 0.01


@dataclass(frozen=True)
class View:
    """A frame of the window."""

    features: Features
    T_odom_cam: Transform  # (4, 4) by odometry


@dataclass(frozen=True)
class Points:
    """Points of a keyframe, in its camera frame; `feature`: their rows in the keyframe's features."""

    feature: Ints
    p_cam_m: Floats  # (N, 3)
    sigma_depth_rel: Floats  # (N,)
    frames: Ints  # (N,) number of frames with the point


def triangulate(camera: Camera, keyframe: View, others: Sequence[View]) -> Points:
    """Returns the keyframe's points that the other frames confirm."""
    rays = np.column_stack([camera.to_xy(keyframe.features.px), np.ones(len(keyframe.features))])
    poses = np.array([inverse(view.T_odom_cam) @ keyframe.T_odom_cam for view in others])  # T_other_keyframe
    rows, views, px, sigma_px = _observations(keyframe.features, others)
    if not len(rows):
        return Points(np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros(0), np.zeros(0, np.int64))
    xy, sigma = camera.to_xy(px), sigma_px / camera.fx_px
    priors, rho = poses.copy(), np.full(len(rays), 1.0 / 15.0)
    good = np.ones(len(rows), bool)
    for refinement in range(REFINEMENTS + 1):
        rho, information = _depths(rays, rho, poses, rows, views, xy, sigma, good)
        error = _residuals(rays, rho, poses, rows, views, xy) / sigma[:, None]
        good = (np.abs(error).max(axis=1) < (GATE if refinement else 3.0 * GATE)) & (rho[rows] > 1.0 / MAX_DISTANCE_M)
        if refinement == REFINEMENTS:
            break
        counts = np.bincount(rows[good], minlength=len(rays))
        used = good & (counts[rows] >= 2)
        for view in range(len(others)):
            mine = used & (views == view)
            poses[view] = _refined(poses[view], priors[view], rays[rows[mine]], rho[rows[mine]], xy[mine], sigma[mine])
    frames = np.bincount(rows[good], minlength=len(rays))
    sigma_rel = 1.0 / (np.sqrt(np.maximum(information, 1e-12)) * np.maximum(rho, 1e-6))
    kept = np.flatnonzero(
        (frames >= MIN_FRAMES)
        & (rho > 1.0 / MAX_DISTANCE_M)
        & (rho < 1.0 / MIN_DISTANCE_M)
        & (sigma_rel < MAX_SIGMA_REL)
        & (frames >= 0.6 * np.bincount(rows, minlength=len(rays)))
    )
    return Points(kept, rays[kept] / rho[kept, None], np.maximum(sigma_rel[kept], 0.01), frames[kept])


def _observations(own: Features, others: Sequence[View]) -> tuple[Ints, Ints, Floats, Floats]:
    """Returns the keyframe's feature (O,), the frame (O,), the pixel there (O, 2) and its sigma (O,)."""
    rows, views, px, sigma = [], [], [], []
    for number, view in enumerate(others):
        pairs = match(own.descriptors, view.features.descriptors, MATCH_BITS, MATCH_RATIO)
        rows.append(pairs[:, 0])
        views.append(np.full(len(pairs), number))
        px.append(view.features.px[pairs[:, 1]])
        sigma.append(np.hypot(own.sigma_px[pairs[:, 0]], view.features.sigma_px[pairs[:, 1]]))
    if not rows:
        return np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros((0, 2)), np.zeros(0)
    return np.concatenate(rows), np.concatenate(views), np.concatenate(px), np.concatenate(sigma)


def _projected(rays: Floats, rho: Floats, T: Transform) -> tuple[Floats, Floats]:
    """Returns points (O, 3) scaled by the inverse depth, and their z bounded from below; `T` (O, 4, 4)."""
    p = np.einsum("oij,oj->oi", T[:, :3, :3], rays) + rho[:, None] * T[:, :3, 3]
    return p, np.maximum(p[:, 2], 1e-3)


def _residuals(rays: Floats, rho: Floats, poses: Transform, rows: Ints, views: Ints, xy: Floats) -> Floats:
    p, z = _projected(rays[rows], rho[rows], poses[views])
    out: Floats = xy - p[:, :2] / z[:, None]
    return out


def _depths(
    rays: Floats, rho: Floats, poses: Transform, rows: Ints, views: Ints, xy: Floats, sigma: Floats, good: Bools
) -> tuple[Floats, Floats]:
    """Returns inverse depths by Gauss-Newton with Cauchy weights, and their information."""
    T = poses[views]
    information: Floats = np.zeros(len(rho))
    for _ in range(6):
        p, z = _projected(rays[rows], rho[rows], T)
        predicted = p[:, :2] / z[:, None]
        J = (T[:, :2, 3] - predicted * T[:, 2:3, 3]) / z[:, None]  # of the prediction, by rho
        error = (xy - predicted) / sigma[:, None]
        weight = good / (1.0 + (error**2).sum(axis=1) / 4.0) / sigma**2
        information = np.bincount(rows, weight * (J**2).sum(axis=1), len(rho)).astype(np.float64)
        gradient = np.bincount(rows, weight * (J * (xy - predicted)).sum(axis=1), len(rho))
        step = gradient / np.maximum(information, 1e-9)
        rho = np.clip(rho + np.clip(step, -0.1, 0.1), 1e-4, 1.0)
    return rho, information


def _refined(T: Transform, prior: Transform, rays: Floats, rho: Floats, xy: Floats, sigma: Floats) -> Transform:
    """Refines one frame's pose `T_other_keyframe` by Gauss-Newton on its points, with odometry as prior."""
    if len(rays) < 10:
        return T
    length_m = float(np.linalg.norm(prior[:3, 3]))
    sigma_t = PRIOR_TRANSLATION_M + PRIOR_TRANSLATION_REL * length_m
    prior_information = np.diag([sigma_t**-2] * 3 + [PRIOR_ROTATION_RAD**-2] * 3)
    for _ in range(3):
        p, z = _projected(rays, rho, np.broadcast_to(T, (len(rays), 4, 4)))
        predicted = p[:, :2] / z[:, None]
        # p = R ray + rho t; a step (dt, w) rotates R by w and moves t, in the other camera's frame
        turned = p - rho[:, None] * T[:3, 3]
        Jp = np.zeros((len(rays), 3, 6))
        Jp[:, :, :3] = rho[:, None, None] * np.eye(3)
        Jp[:, :, 3:] = -cross(turned)
        J = (Jp[:, :2] - predicted[:, :, None] * Jp[:, 2:3]) / z[:, None, None]
        error = xy - predicted
        weight = 1.0 / (1.0 + ((error / sigma[:, None]) ** 2).sum(axis=1) / 4.0) / sigma**2
        weighed = (J * weight[:, None, None]).reshape(-1, 6)
        H = weighed.T @ J.reshape(-1, 6) + prior_information
        deviation = np.concatenate([T[:3, 3] - prior[:3, 3], rotation_log(T[:3, :3] @ prior[:3, :3].T)])
        g = weighed.T @ error.ravel() - prior_information @ deviation
        step = np.linalg.solve(H, g)
        T = T.copy()
        T[:3, :3] = rotation_exp(step[3:]) @ T[:3, :3]
        T[:3, 3] += step[:3]
    return T


def cross(v: Floats) -> Floats:
    """Returns the matrices (N, 3, 3) of the cross product with `v` (N, 3)."""
    out = np.zeros((len(v), 3, 3))
    out[:, 0, 1], out[:, 0, 2], out[:, 1, 2] = -v[:, 2], v[:, 1], -v[:, 0]
    out[:, 1, 0], out[:, 2, 0], out[:, 2, 1] = v[:, 2], -v[:, 1], v[:, 0]
    return out
