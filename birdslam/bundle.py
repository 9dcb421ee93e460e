"""A sliding window of key images and inverse-depth landmarks: relative pose, adjusted jointly over the window.

A landmark is one number, its inverse depth along the ray of the first image of the window that saw it (its anchor), so
that the Schur complement of the normal equations divides by scalars. Everything here is in normalised coordinates of
an undistorted camera; residuals are scaled by the focal length to pixels. The unit of length is the caller's.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from birdslam.pose import Pose, cross, orthonormal, rotation_exp

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]

_MIN_DEPTH = 1e-3  # of a ray's own length: nearer or behind counts as not visible


class SlidingWindow:
    """Key images (oldest first, the newest may be provisional) and the landmarks that they share."""

    def __init__(self, focal_px: float, sigma_px: float, reject_px: float) -> None:
        self.focal_px, self.sigma_px, self.reject_px = focal_px, sigma_px, reject_px
        self.poses: list[Pose] = []
        self.frames: list[int] = []
        self.ids: Ints = np.zeros(0, np.int64)  # (M,) ascending
        self.obs: Floats = np.zeros((0, 0, 2))  # (F, M, 2), NaN where not seen
        self.rho: Floats = np.zeros(0)  # (M,) inverse depth along the anchor's ray (z = 1), NaN unknown
        self.rho_sigma: Floats = np.zeros(0)

    # --- what the window holds ---

    def anchors(self) -> Ints:
        """(M,) index of the first image that saw each landmark."""
        out: Ints = np.isfinite(self.obs[..., 0]).argmax(axis=0)
        return out

    def append(self, frame: int, pose: Pose, ids: Ints, xy: Floats) -> None:
        """A new image: ids (N,) ascending, xy (N, 2) normalised coordinates."""
        merged = np.union1d(self.ids, ids)
        obs = np.full((len(self.poses) + 1, len(merged), 2), np.nan)
        old = np.searchsorted(merged, self.ids)
        obs[:-1, old] = self.obs
        obs[-1, np.searchsorted(merged, ids)] = xy
        rho, sigma = np.full(len(merged), np.nan), np.full(len(merged), np.inf)
        rho[old], sigma[old] = self.rho, self.rho_sigma
        self.ids, self.obs, self.rho, self.rho_sigma = merged, obs, rho, sigma
        self.poses.append(pose)
        self.frames.append(frame)

    def drop(self, index: int) -> None:
        """Forgets one image. Landmarks anchored in it move to the next image that saw them."""
        anchor = self.anchors()
        X = self.points_w(anchor)
        keep = np.arange(len(self.poses)) != index
        self.obs = self.obs[keep]
        del self.poses[index], self.frames[index]
        seen = np.isfinite(self.obs[..., 0]).any(axis=0)
        moved = np.flatnonzero(seen & (anchor == index) & np.isfinite(self.rho))
        if len(moved):
            new = self.anchors()
            R, p = self._stacked()
            z = np.einsum("mi,mi->m", R[new[moved], :, 2], X[moved] - p[new[moved]])
            # A point at infinity stays there; one behind its new anchor is forgotten.
            far = ~np.isfinite(X[moved, 0])
            with np.errstate(divide="ignore", invalid="ignore"):
                self.rho[moved] = np.where(far, 0.0, np.where(z > _MIN_DEPTH, 1.0 / z, np.nan))
        self.ids, self.obs = self.ids[seen], self.obs[:, seen]
        self.rho, self.rho_sigma = self.rho[seen], self.rho_sigma[seen]

    def rescale(self, factor: float) -> None:
        """Multiplies all lengths, about the newest camera."""
        centre = self.poses[-1].p
        self.poses = [Pose(T.R, centre + factor * (T.p - centre)) for T in self.poses]
        self.rho = self.rho / factor
        self.rho_sigma = self.rho_sigma / factor

    def points_w(self, anchor: Ints) -> Floats:
        """(M, 3) landmarks in the window's frame; NaN or infinite where the depth is unknown or endless."""
        R, p = self._stacked()
        rays = self._rays(anchor)
        with np.errstate(divide="ignore", invalid="ignore"):
            depth = np.where(self.rho > 1e-6, 1.0 / self.rho, np.nan)
        out: Floats = np.einsum("mij,mj->mi", R[anchor], rays) * depth[:, None] + p[anchor]
        return out

    def predict_xy(self, pose: Pose) -> Floats:
        """(M, 2) where a camera at `pose` sees the landmarks; NaN where unknown or behind it."""
        anchor = self.anchors()
        q, _, _ = self._project(anchor, pose.R[None], pose.p[None], self.rho)
        q = q[0]
        with np.errstate(divide="ignore", invalid="ignore"):
            xy = q[:, :2] / q[:, 2:]
        xy[~(q[:, 2] > _MIN_DEPTH)] = np.nan
        return xy

    # --- estimation ---

    def locate(self, guess: Pose, ids: Ints, xy: Floats, iterations: int = 8) -> tuple[Pose, Bools, Floats]:
        """Pose of one image from landmarks of known depth, robustly.

        Returns the pose, which of the N observations fit it (N,), and the information matrix (6, 6) of the pose.
        """
        fits = np.zeros(len(ids), bool)
        at = np.searchsorted(self.ids, ids)
        at = np.minimum(at, max(len(self.ids) - 1, 0))
        known = np.zeros(len(ids), bool)
        if len(self.ids):
            known = (self.ids[at] == ids) & np.isfinite(self.rho[at])
        if known.sum() < 8:
            return guess, fits, np.zeros((6, 6))
        m = at[known]
        anchor = self.anchors()[m]
        R, p = self._stacked()
        rays = self.obs[anchor, m]
        rays = np.column_stack([rays, np.ones(len(m))])
        base = (R[anchor] @ rays[:, :, None])[:, :, 0]
        rho, target = self.rho[m], xy[known]
        depth_noise = np.where(np.isfinite(self.rho_sigma[m]), self.rho_sigma[m], 0.0)
        pose, info = guess, np.zeros((6, 6))
        for k in range(iterations):
            q = (base + rho[:, None] * (p[anchor] - pose.p)) @ pose.R
            z = np.maximum(q[:, 2], _MIN_DEPTH)
            uv = q[:, :2] / z[:, None]
            r = (uv - target) * self.focal_px
            D = self._projection_derivative(uv, z) * self.focal_px
            J = np.concatenate([-rho[:, None, None] * D, cross(D, q[:, None])], axis=2)
            # An uncertain depth blurs the observation along its epipolar line; isotropic is near enough.
            along = (D @ ((p[anchor] - pose.p) @ pose.R)[:, :, None])[:, :, 0] * depth_noise[:, None]
            variance = self.sigma_px**2 + (along**2).sum(axis=1)
            norm = np.sqrt((r**2).sum(axis=1) / variance)
            gate = (
                max(self.reject_px / self.sigma_px, 3.0 * 1.2 * float(np.median(norm)))
                if k < 3
                else self.reject_px / self.sigma_px
            )
            w = np.where(norm < gate, 1.0 / np.maximum(1.0, norm / 1.5), 0.0) * (q[:, 2] > _MIN_DEPTH) / variance
            Jw = (J * w[:, None, None]).reshape(-1, 6)
            info = J.reshape(-1, 6).T @ Jw
            g = Jw.T @ r.reshape(-1)
            step = -np.linalg.solve(info + 1e-9 * np.trace(info) * np.eye(6) + 1e-9 * np.eye(6), g)
            pose = pose.moved(step)
            if k >= 3 and np.abs(step).max() < 1e-5:
                break
        fits[np.flatnonzero(known)] = (norm < self.reject_px / self.sigma_px) & (q[:, 2] > _MIN_DEPTH)
        return pose, fits, info

    def triangulate(self) -> None:
        """Inverse depths of what the newest image and another see, by linear least squares with the poses held."""
        newest = np.isfinite(self.obs[-1, :, 0])
        anchor, xy = self.anchors()[newest], self.obs[:, newest]
        R, p = self._stacked()
        rays = np.column_stack([xy[anchor, np.arange(len(anchor))], np.ones(len(anchor))])
        q0 = (R[anchor] @ rays[:, :, None])[None, :, :, 0] @ R
        dq = (p[anchor][None] - p[:, None]) @ R
        others = np.isfinite(xy[..., 0]) & (np.arange(len(p))[:, None] != anchor[None])
        # r(rho) = (q0 + rho dq)_xy - xy (q0 + rho dq)_z is linear in rho; weights 1 / q_z make it a reprojection error
        xy = np.where(others[..., None], xy, 0.0)
        a = dq[..., :2] - xy * dq[..., 2:]
        b = q0[..., :2] - xy * q0[..., 2:]
        aa, ab = (a * a).sum(axis=2), (a * b).sum(axis=2)
        rho = np.where(np.isfinite(self.rho[newest]), self.rho[newest], 0.0)
        for _ in range(2):
            w = others / np.maximum(q0[..., 2] + rho * dq[..., 2], 0.1) ** 2
            den = (w * aa).sum(axis=0)
            rho = np.where(den > 1e-12, np.maximum(-(w * ab).sum(axis=0) / np.maximum(den, 1e-12), 0.0), 0.0)
        z = np.maximum(q0[..., 2] + rho * dq[..., 2], 0.1)
        r = np.sqrt((others * ((b + a * rho[:, None]) ** 2).sum(axis=2) / z**2).max(axis=0))
        good = (den > 1e-12) & others.any(axis=0) & (r * self.focal_px < self.reject_px)
        sigma = self.sigma_px / self.focal_px / np.sqrt(np.maximum(den, 1e-12))
        self.rho[newest] = np.where(good, rho, np.nan)
        self.rho_sigma[newest] = np.where(good, sigma, np.inf)

    def adjust(self, held: int, iterations: int, max_landmarks: int, prior: Floats) -> Floats:
        """Joint adjustment of all poses but the first `held` and of the best `max_landmarks` depths.

        `prior` (6,) is the information of each step against where the pose was before: it damps, and carries the unit
        of length where fewer than two poses are held. Returns the information (6, 6) of the newest pose, the others
        free.
        """
        anchor = self.anchors()
        count = np.isfinite(self.obs[..., 0]).sum(axis=0)
        usable = np.isfinite(self.rho) & (count >= 2)
        F, free = len(self.poses), len(self.poses) - held
        info_newest = np.zeros((6, 6))
        if usable.sum() < 8 or free < 1:
            return info_newest
        rank = np.lexsort((self.ids, -count))
        chosen = np.sort(rank[usable[rank]][:max_landmarks])
        anchor, rho, xy = anchor[chosen], self.rho[chosen].copy(), self.obs[:, chosen]
        rays = np.column_stack([self.obs[anchor, chosen], np.ones(len(chosen))])
        # One row for each observation but the anchors' own, landmark by landmark.
        m, j = np.nonzero((np.isfinite(xy[..., 0]) & (np.arange(F)[:, None] != anchor[None])).T)
        first = np.searchsorted(m, np.arange(len(chosen)))
        i, target, row, f = anchor[m], xy[j, m], np.arange(len(m)), self.focal_px
        moved = np.zeros((free, 6))  # steps so far: (translation, rotation vector), both in the window's axes
        S, norm, C = np.eye(6 * free), np.zeros(len(m)), np.ones(len(chosen))
        for k in range(iterations):
            R, p = self._stacked()
            base = (R[anchor] @ rays[:, :, None])[m, :, 0]
            between = p[i] - p[j]
            c = base + rho[m, None] * between
            q = (c[:, None] @ R[j])[:, 0]
            ahead = q[:, 2] > _MIN_DEPTH
            z = np.where(ahead, q[:, 2], 1.0)
            uv = q[:, :2] / z[:, None]
            r = (uv - target) * f
            norm = np.sqrt((r**2).sum(axis=1)) / self.sigma_px
            gate = self.reject_px / self.sigma_px * (2.0 if k == 0 else 1.0)
            w = np.where(ahead & (norm < gate), 1.0 / np.maximum(1.0, norm / 1.5), 0.0) / self.sigma_px**2
            sw = np.sqrt(w)[:, None]
            rw = r * sw
            # E (N, 2, 3): whitened derivative by the landmark in the window's axes
            E = self._projection_derivative(uv, z) * (f * sw[..., None]) @ R[j].transpose(0, 2, 1)
            J_rho = (E @ between[:, :, None])[:, :, 0]
            E_rho = E * rho[m, None, None]
            J = np.zeros((len(m), F, 2, 6))
            J[row, i] = np.concatenate([E_rho, cross(base[:, None], E)], axis=2)
            J[row, j] = np.concatenate([-E_rho, cross(E, c[:, None])], axis=2)
            J_free = J[:, held:].transpose(0, 2, 1, 3).reshape(2 * len(m), 6 * free)
            A = J_free.T @ J_free + np.diag(np.tile(prior, free))
            g = J_free.T @ rw.reshape(-1) + (prior * moved).reshape(-1)
            by_landmark = J_rho.reshape(-1, 1) * J_free
            B = np.add.reduceat(by_landmark, 2 * first, axis=0)
            C = np.add.reduceat((J_rho**2).sum(axis=1), first) + 1e-6
            gr = np.add.reduceat((J_rho * rw).sum(axis=1), first)
            S = A - B.T @ (B / C[:, None])
            step = -np.linalg.solve(S, g - B.T @ (gr / C))
            if not np.isfinite(step).all():
                return info_newest
            rho = np.maximum(rho - (gr + B @ step) / C, 0.0)
            steps = step.reshape(free, 6)
            for at, (T, by) in enumerate(zip(self.poses[held:], steps, strict=True)):
                self.poses[held + at] = Pose(rotation_exp(by[3:]) @ T.R, T.p + by[:3])
            moved += steps
            if np.abs(steps).max() < 1e-5:
                break
        # The newest pose against all others free but the held ones.
        n = 6 * (free - 1)
        info_newest = S[n:, n:] - S[n:, :n] @ np.linalg.solve(S[:n, :n], S[:n, n:]) if n else S
        turn = np.kron(np.eye(2), self.poses[-1].R)  # to the newest camera's own axes
        info_newest = turn.T @ info_newest @ turn
        self.poses = [Pose(orthonormal(T.R), T.p) for T in self.poses]
        self.rho[chosen] = rho
        self.rho_sigma[chosen] = 1.0 / np.sqrt(C)
        # What no longer fits is forgotten; if it is a landmark after all, it is triangulated anew.
        fits = np.add.reduceat((norm < self.reject_px / self.sigma_px).astype(float), first)
        bad = 2.0 * fits < np.bincount(m, minlength=len(chosen))
        self.rho[chosen[bad]] = np.nan
        return info_newest

    # --- geometry shared by the above ---

    def _stacked(self) -> tuple[Floats, Floats]:
        return np.stack([T.R for T in self.poses]), np.stack([T.p for T in self.poses])

    def _rays(self, anchor: Ints) -> Floats:
        return np.column_stack([self.obs[anchor, np.arange(len(self.ids))], np.ones(len(self.ids))])

    def _project(self, anchor: Ints, R: Floats, p: Floats, rho: Floats) -> tuple[Floats, Floats, Bools]:
        """q (F, M, 3) = rho times the landmark in each camera (R, p), dq/drho, and which are observed (F, M)."""
        Rs, ps = self._stacked()
        base = (Rs[anchor] @ self._rays(anchor)[:, :, None])[:, :, 0]
        dq = (ps[anchor][None] - p[:, None]) @ R
        q = base[None] @ R + rho[None, :, None] * dq
        return q, dq, np.isfinite(self.obs[..., 0])

    @staticmethod
    def _projection_derivative(uv: Floats, z: Floats) -> Floats:
        """(..., 2, 3) derivative of q_xy / q_z."""
        D = np.zeros((*uv.shape[:-1], 2, 3))
        D[..., 0, 0] = D[..., 1, 1] = 1.0 / z
        D[..., 0, 2] = -uv[..., 0] / z
        D[..., 1, 2] = -uv[..., 1] / z
        return D


def two_view(xy_a: Floats, xy_b: Floats, focal_px: float, threshold_px: float) -> tuple[Pose, Bools] | None:
    """T_a_b (translation of unit length) of two images from normalised coordinates (N, 2), by 5-point RANSAC.

    None where the two views do not determine it.
    """
    if len(xy_a) < 12:
        return None
    cv2.setRNGSeed(1)
    E, mask = cv2.findEssentialMat(xy_a, xy_b, np.eye(3), cv2.USAC_MAGSAC, 0.999, threshold_px / focal_px, 500)
    if E is None or E.shape != (3, 3) or mask is None:
        return None
    # Depths are unbounded: by default recoverPose counts whatever is 50 baselines away as wrong.
    count, R, t, _, _ = cv2.recoverPose(E, xy_a, xy_b, cameraMatrix=np.eye(3), distanceThresh=1e5, mask=mask.copy())
    if count < 5:
        return None
    T_b_a = Pose(np.asarray(R, np.float64), np.asarray(t, np.float64).ravel())
    return T_b_a.inverse(), mask.ravel() > 0
