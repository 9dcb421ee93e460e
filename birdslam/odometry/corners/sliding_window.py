"""Sliding window of the odometry: the last keyframes and their landmarks.

A landmark is parametrised by its inverse depth along the ray of its anchor, the first keyframe of the window that
observes it (Civera et al. 2008). Coordinates are normalised; the scale is arbitrary.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from birdslam.geometry.camera import Camera
from birdslam.geometry.pose import Pose

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

MIN_DEPTH = 1e-3  # z over the length of the ray; below this a point is not visible


def match_ids(a: Ints, b: Ints) -> tuple[Ints, Ints]:
    """Indices of the common ids in a (N,) and in b (M,), both ascending; faster than numpy.intersect1d."""
    at = np.searchsorted(b, a)
    at[at == len(b)] = 0
    both = np.flatnonzero(b[at] == a) if len(b) else np.zeros(0, np.int64)
    return both, at[both]


def rotate_rays(R: Floats, anchor: Ints, xy: Floats) -> Floats:
    """(3, M) rays of normalised coordinates (M, 2), each rotated by R[anchor], R (F, 3, 3), anchor (M,).

    Expanded, since M products of small matrices are slower in numpy.
    """
    by, (x, y) = R.transpose(1, 2, 0).reshape(9, -1).take(anchor, axis=1), xy.T
    out: Floats = by[::3] * x + by[1::3] * y + by[2::3]
    return out


class SlidingWindow:
    """F keyframes, oldest first (the newest may be provisional), and M landmarks.

    `focal_px` scales residuals to pixels, `sigma_px` is the noise of a track, `reject_px` is the outlier threshold.
    """

    def __init__(self, focal_px: float, sigma_px: float, reject_px: float) -> None:
        self.focal_px, self.sigma_px, self.reject_px = focal_px, sigma_px, reject_px
        self.poses: list[Pose] = []
        self.frames: list[int] = []
        self.predicted_sigma_m: list[
            float
        ] = []  # 1-sigma of a position by the velocity prior; inf if it is by the images
        self.ids: Ints = np.zeros(0, np.int64)  # (M,) ascending
        self.obs: Floats = np.zeros((0, 0, 2))  # (F, M, 2), NaN if not observed
        self.rho: Floats = np.zeros(0)  # (M,) inverse depth along the anchor's ray (z = 1), NaN if unknown
        self.rho_sigma: Floats = np.zeros(0)

    def anchors(self) -> Ints:
        """(M,) index of each landmark's anchor keyframe."""
        out: Ints = np.isfinite(self.obs[..., 0]).argmax(axis=0)
        return out

    def xy_of(self, anchor: Ints, landmarks: Ints) -> Floats:
        """(N, 2) observations of `landmarks` (N,) by the keyframes `anchor` (N,), normalised coordinates."""
        out: Floats = self.obs.reshape(-1, 2).take(anchor * self.obs.shape[1] + landmarks, axis=0)
        return out

    def append(self, frame: int, pose: Pose, ids: Ints, xy: Floats, predicted_sigma_m: float = np.inf) -> None:
        """Appends a keyframe: ids (N,) ascending, xy (N, 2) normalised; `predicted_sigma_m` as in the class."""
        merged = np.concatenate([self.ids, ids])
        merged.sort(kind="stable")
        merged = merged[np.concatenate([[True], merged[1:] != merged[:-1]])] if len(merged) else merged
        obs = np.full((len(self.poses) + 1, len(merged), 2), np.nan)
        old = np.searchsorted(merged, self.ids)
        obs[:-1, old] = self.obs
        obs[-1, np.searchsorted(merged, ids)] = xy
        rho, sigma = np.full(len(merged), np.nan), np.full(len(merged), np.inf)
        rho[old], sigma[old] = self.rho, self.rho_sigma
        self.ids, self.obs, self.rho, self.rho_sigma = merged, obs, rho, sigma
        self.poses.append(pose)
        self.frames.append(frame)
        self.predicted_sigma_m.append(predicted_sigma_m)

    def drop(self, index: int) -> None:
        """Removes a keyframe; re-anchors its landmarks in the next keyframe that observes them."""
        anchor, gone, xy = self.anchors(), self.poses[index], self.obs[index]
        self.obs = self.obs[np.arange(len(self.poses)) != index]
        del self.poses[index], self.frames[index], self.predicted_sigma_m[index]
        seen = np.isfinite(self.obs[..., 0]).any(axis=0)
        moved = np.flatnonzero(seen & (anchor == index) & np.isfinite(self.rho))
        if len(moved):
            new = self.anchors()[moved]
            R, p = self.stacked()
            # A point at infinity stays there; a point behind its new anchor becomes unknown
            far = self.rho[moved] <= 1e-6
            depth = 1.0 / np.where(far, 1.0, self.rho[moved])
            X = (np.column_stack([xy[moved], np.ones(len(moved))]) * depth[:, None]) @ gone.R.T + gone.p
            z = (R[new, :, 2] * (X - p[new])).sum(axis=1)
            self.rho[moved] = np.where(far, 0.0, np.where(z > MIN_DEPTH, 1.0 / np.maximum(z, MIN_DEPTH), np.nan))
        self.ids, self.obs = self.ids[seen], self.obs[:, seen]
        self.rho, self.rho_sigma = self.rho[seen], self.rho_sigma[seen]

    def rescale(self, factor: float) -> None:
        """Multiplies all lengths by `factor`, about the newest camera."""
        centre = self.poses[-1].p
        self.poses = [Pose(T.R, centre + factor * (T.p - centre)) for T in self.poses]
        self.predicted_sigma_m = [factor * sigma_m for sigma_m in self.predicted_sigma_m]
        self.rho = self.rho / factor
        self.rho_sigma = self.rho_sigma / factor

    def predict_xy(self, pose: Pose) -> Floats:
        """(M, 2) projections of the landmarks into a camera at `pose`; NaN if unknown or behind the camera."""
        return self.seen_from(pose)[0][:2].T

    def predict_px(self, camera: Camera, pose: Pose, ids: Ints, default_px: Floats) -> Floats:
        """(N, 2) pixels of the landmarks `ids` (N,) in a camera at `pose`; `default_px` (N, 2) if unknown."""
        if not len(self.ids):
            return default_px
        at = np.minimum(np.searchsorted(self.ids, ids), len(self.ids) - 1)
        px = camera.to_px(self.predict_xy(pose)[at])
        known = (self.ids[at] == ids) & np.isfinite(px).all(axis=1)
        return np.where(known[:, None], px, default_px)

    def depths(self, pose: Pose) -> Floats:
        """(M,) z of the landmarks in a camera at `pose`; NaN if unknown."""
        with np.errstate(divide="ignore", invalid="ignore"):
            z: Floats = self._seen_from(pose)[2] / self.rho
        return z

    def inverse_depths(self, pose: Pose) -> Floats:
        """(M,) 1 / z of the landmarks in a camera at `pose`; NaN if unknown or behind the camera."""
        return self.seen_from(pose)[1]

    def inverse_depths_of(self, pose: Pose, ids: Ints, default: Floats) -> Floats:
        """(N,) 1 / z of the landmarks `ids` (N,) in a camera at `pose`; `default` (N,) if unknown."""
        if not len(self.ids):
            return default
        at = np.minimum(np.searchsorted(self.ids, ids), len(self.ids) - 1)
        by_z = self.inverse_depths(pose)[at]
        return np.where((self.ids[at] == ids) & np.isfinite(by_z), by_z, default)

    def seen_from(self, pose: Pose) -> tuple[Floats, Floats]:
        """(3, M) rays (z = 1) and (M,) 1 / z of the landmarks in a camera at `pose`; NaN if unknown or behind it."""
        q = self._seen_from(pose)
        z = np.where(q[2] > MIN_DEPTH, q[2], np.nan)
        return q / z, self.rho / z

    def _seen_from(self, pose: Pose) -> Floats:
        """(3, M) landmarks in the axes of a camera at `pose`, times their inverse depths."""
        anchor = self.anchors()
        R, p = self.stacked()
        rays = rotate_rays(pose.R.T @ R, anchor, self.xy_of(anchor, np.arange(len(self.ids))))
        out: Floats = rays + self.rho * (pose.R.T @ (p - pose.p).T).take(anchor, axis=1)
        return out

    def triangulate(self) -> None:
        """Triangulates the landmarks of the newest keyframe by linear least squares over all observations."""
        newest = np.isfinite(self.obs[-1, :, 0])
        anchor, xy = self.anchors()[newest], self.obs[:, newest].transpose(0, 2, 1)
        R, p = self.stacked()
        R_w = R.transpose(0, 2, 1)
        q0 = R_w @ rotate_rays(R, anchor, self.xy_of(anchor, np.flatnonzero(newest)))  # (F, 3, M)
        dq = (R_w @ (p.T - p[:, :, None])).take(anchor, axis=2)
        others = np.isfinite(xy[:, 0]) & (np.arange(len(p))[:, None] != anchor[None])
        # r(rho) = (q0 + rho dq)_xy - xy (q0 + rho dq)_z is linear in rho; weights 1 / q_z give the reprojection error
        xy = np.where(others[:, None], xy, 0.0)
        a = dq[:, :2] - xy * dq[:, 2:]
        b = q0[:, :2] - xy * q0[:, 2:]
        aa, ab = (a * a).sum(axis=1), (a * b).sum(axis=1)
        rho = np.where(np.isfinite(self.rho[newest]), self.rho[newest], 0.0)
        for _ in range(2):
            w = others / np.maximum(q0[:, 2] + rho * dq[:, 2], 0.1) ** 2
            den = (w * aa).sum(axis=0)
            rho = np.where(den > 1e-12, np.maximum(-(w * ab).sum(axis=0) / np.maximum(den, 1e-12), 0.0), 0.0)
        z = np.maximum(q0[:, 2] + rho * dq[:, 2], 0.1)
        r = np.sqrt((others * ((b + a * rho) ** 2).sum(axis=1) / z**2).max(axis=0))
        good = (den > 1e-12) & others.any(axis=0) & (r * self.focal_px < self.reject_px)
        sigma = self.sigma_px / self.focal_px / np.sqrt(np.maximum(den, 1e-12))
        self.rho[newest] = np.where(good, rho, np.nan)
        self.rho_sigma[newest] = np.where(good, sigma, np.inf)

    def stacked(self) -> tuple[Floats, Floats]:
        """The poses as arrays: (F, 3, 3) rotations, (F, 3) positions."""
        return np.array([T.R for T in self.poses]), np.array([T.p for T in self.poses])
