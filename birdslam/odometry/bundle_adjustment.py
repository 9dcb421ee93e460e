"""A sliding window of key images and inverse-depth landmarks: relative pose, adjusted jointly over the window.

A landmark is one number, its inverse depth along the ray of the first image of the window that saw it (its anchor), so
that the Schur complement of the normal equations divides by scalars. Everything here is in normalised coordinates of
an undistorted camera; residuals are scaled by the focal length to pixels. The unit of length is the caller's.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from birdslam.geometry.pose import Pose, middle, orthonormal, rotation_exp

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

    def drop(self, index: int) -> None:
        """Forgets one image. Landmarks anchored in it move to the next image that saw them."""
        anchor, gone, xy = self.anchors(), self.poses[index], self.obs[index]
        self.obs = self.obs[np.arange(len(self.poses)) != index]
        del self.poses[index], self.frames[index]
        seen = np.isfinite(self.obs[..., 0]).any(axis=0)
        moved = np.flatnonzero(seen & (anchor == index) & np.isfinite(self.rho))
        if len(moved):
            new = self.anchors()[moved]
            R, p = self._stacked()
            # A point at infinity stays there; one behind its new anchor is forgotten.
            far = self.rho[moved] <= 1e-6
            depth = 1.0 / np.where(far, 1.0, self.rho[moved])
            X = (np.column_stack([xy[moved], np.ones(len(moved))]) * depth[:, None]) @ gone.R.T + gone.p
            z = (R[new, :, 2] * (X - p[new])).sum(axis=1)
            self.rho[moved] = np.where(far, 0.0, np.where(z > _MIN_DEPTH, 1.0 / np.maximum(z, _MIN_DEPTH), np.nan))
        self.ids, self.obs = self.ids[seen], self.obs[:, seen]
        self.rho, self.rho_sigma = self.rho[seen], self.rho_sigma[seen]

    def rescale(self, factor: float) -> None:
        """Multiplies all lengths, about the newest camera."""
        centre = self.poses[-1].p
        self.poses = [Pose(T.R, centre + factor * (T.p - centre)) for T in self.poses]
        self.rho = self.rho / factor
        self.rho_sigma = self.rho_sigma / factor

    def predict_xy(self, pose: Pose) -> Floats:
        """(M, 2) where a camera at `pose` sees the landmarks; NaN where unknown or behind it."""
        anchor = self.anchors()
        R, p = self._stacked()
        rays = np.column_stack([self.obs[anchor, np.arange(len(self.ids))], np.ones(len(self.ids))])
        q = pose.R.T @ ((R[anchor] @ rays[:, :, None])[:, :, 0] + self.rho[:, None] * (p[anchor] - pose.p)).T
        xy: Floats = (q[:2] / np.where(q[2] > _MIN_DEPTH, q[2], np.nan)).T
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
        rays = np.column_stack([self.obs[anchor, m], np.ones(len(m))])
        base = (R[anchor] @ rays[:, :, None])[:, :, 0]
        rho, target = self.rho[m], xy[known].T
        depth_noise = np.where(np.isfinite(self.rho_sigma[m]), self.rho_sigma[m], 0.0)
        from_w = base + rho[:, None] * p[anchor]  # the landmark, but for the camera's own place
        pose, info, f = guess, np.zeros((6, 6)), self.focal_px
        limit = self.reject_px / self.sigma_px
        J = np.zeros((6, 2, len(m)))  # of (translation, rotation) in the camera's own axes
        for k in range(iterations):
            q = pose.R.T @ (from_w - rho[:, None] * pose.p).T
            ahead = q[2] > _MIN_DEPTH
            z = np.maximum(q[2], _MIN_DEPTH)
            u, v = uv = q[:2] / z
            r = (uv - target) * f
            by_z = f / z
            J[0, 0] = J[1, 1] = -rho * by_z
            J[2] = rho * by_z * uv
            J[3, 0], J[3, 1] = f * u * v, f * (q[2] / z + v * v)
            J[4, 0], J[4, 1] = -f * (q[2] / z + u * u), -f * u * v
            J[5, 0], J[5, 1] = f * v, -f * u
            # An uncertain depth blurs the observation along its epipolar line; isotropic is near enough.
            a = pose.R.T @ (p[anchor] - pose.p).T
            along = (a[:2] - uv * a[2]) * (by_z * depth_noise)
            variance = self.sigma_px**2 + (along**2).sum(axis=0)
            norm = np.sqrt((r**2).sum(axis=0) / variance)
            gate = max(limit, 3.0 * 1.2 * middle(norm)) if k < 3 else limit
            w = np.where(ahead & (norm < gate), 1.0 / (np.maximum(1.0, norm / 1.5) * variance), 0.0)
            flat = J.reshape(6, -1)
            Jw = (J * w).reshape(6, -1)
            info = Jw @ flat.T
            g = Jw @ r.reshape(-1)
            step = -np.linalg.solve(info + (1e-9 * np.trace(info) + 1e-9) * np.eye(6), g)
            pose = pose.moved(step)
            if k >= 3 and np.abs(step).max() < 1e-5:
                break
        fits[np.flatnonzero(known)] = (norm < limit) & ahead
        return pose, fits, info

    def triangulate(self) -> None:
        """Inverse depths of what the newest image and another see, by linear least squares with the poses held."""
        newest = np.isfinite(self.obs[-1, :, 0])
        anchor, xy = self.anchors()[newest], self.obs[:, newest].transpose(0, 2, 1)
        R, p = self._stacked()
        rays = np.concatenate([xy[anchor, :, np.arange(len(anchor))].T, np.ones((1, len(anchor)))])
        R_w = R.transpose(0, 2, 1)
        q0 = R_w @ (R[anchor] @ rays.T[:, :, None])[:, :, 0].T  # (F, 3, M)
        dq = R_w @ (p[anchor].T - p[:, :, None])
        others = np.isfinite(xy[:, 0]) & (np.arange(len(p))[:, None] != anchor[None])
        # r(rho) = (q0 + rho dq)_xy - xy (q0 + rho dq)_z is linear in rho; weights 1 / q_z make it a reprojection error
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

    def adjust(self, iterations: int, max_landmarks: int, prior: Floats) -> None:
        """Joint adjustment of all poses but the oldest and of the best `max_landmarks` depths.

        `prior` (6,) is the information of each step against where the pose was before. It damps, and it carries the
        unit of length: no image says anything of that, so the least step leaves it where all poses together have it.
        Two poses held would carry it as well, but from a short piece of way whose error all the others then take over.
        """
        anchor = self.anchors()
        count = np.isfinite(self.obs[..., 0]).sum(axis=0)
        usable = np.isfinite(self.rho) & (count >= 2)
        F, free = len(self.poses), len(self.poses) - 1
        if usable.sum() < 8 or free < 1:
            return
        rank = np.lexsort((self.ids, -count))
        chosen = np.sort(rank[usable[rank]][:max_landmarks])
        chosen = chosen[np.argsort(anchor[chosen], kind="stable")]  # those of one anchor stand together
        anchor, rho, xy = anchor[chosen], self.rho[chosen].copy(), self.obs[:, chosen]
        groups = [slice(*np.searchsorted(anchor, [i, i + 1])) for i in range(F)]
        rays = np.concatenate([xy[anchor, np.arange(len(chosen))].T, np.ones((1, len(chosen)))])
        # Everything stands in a grid of images (F) and landmarks (M, last: numpy is quick along it). What was not seen,
        # or is the anchor's own, weighs nothing.
        others = np.isfinite(xy[..., 0]) & (np.arange(F)[:, None] != anchor[None])
        target, f = np.where(others[:, None], xy.transpose(0, 2, 1), 0.0), self.focal_px
        moved = np.zeros((free, 6))  # steps so far: (translation, rotation vector), both in the window's axes
        S, norm, C = np.eye(6 * free), np.zeros(others.shape), np.ones(len(chosen))
        J_anchor, J_seen = np.zeros((2, F, 6, 2, len(chosen)))
        for k in range(iterations):
            R, p = self._stacked()
            base = np.concatenate([R[i] @ rays[:, of] for i, of in enumerate(groups)], axis=1)  # (3, M)
            between = p[anchor].T - p[:, :, None]  # (F, 3, M)
            c = base + rho * between
            q = R.transpose(0, 2, 1) @ c
            ahead = q[:, 2] > _MIN_DEPTH
            z = np.where(ahead, q[:, 2], 1.0)
            uv = q[:, :2] / z[:, None]
            r = (uv - target) * f
            norm = np.sqrt((r**2).sum(axis=1)) / self.sigma_px
            gate = self.reject_px / self.sigma_px * (2.0 if k == 0 else 1.0)
            w = np.where(others & ahead & (norm < gate), 1.0 / np.maximum(1.0, norm / 1.5), 0.0) / self.sigma_px**2
            sw = np.sqrt(w)
            rw = r * sw[:, None]
            # E (F, 3, 2, M): whitened derivative of both coordinates by the landmark in the window's axes
            E = (R[:, :, :2, None] - R[:, :, 2, None, None] * uv[:, None]) * (f * sw / z)[:, None, None]
            J_rho = (E * between[:, :, None]).sum(axis=1)  # (F, 2, M)
            np.multiply(E, rho, out=J_anchor[:, :3])
            np.negative(J_anchor[:, :3], out=J_seen[:, :3])
            _cross(base[None, :, None], E, J_anchor[:, 3:])
            _cross(-c[:, :, None], E, J_seen[:, 3:])
            seen = J_seen.reshape(F, 6, -1)
            A = np.zeros((F, 6, F, 6))
            A[range(F), :, range(F)] = seen @ seen.transpose(0, 2, 1)
            g = (seen @ rw.reshape(F, -1, 1))[..., 0]
            for i, of in enumerate(groups):
                if of.start == of.stop:
                    continue
                of_i, seen_i = J_anchor[..., of].reshape(F, 6, -1), J_seen[..., of].reshape(F, 6, -1)
                A[i, :, i] += (of_i @ of_i.transpose(0, 2, 1)).sum(axis=0)
                g[i] += (of_i @ rw[..., of].reshape(F, -1, 1)).sum(axis=0)[:, 0]
                mixed = of_i @ seen_i.transpose(0, 2, 1)  # (F, 6, 6); nothing where the image is the anchor
                A[i] += mixed.transpose(1, 0, 2)
                A[:, :, i] += mixed.transpose(0, 2, 1)
            B = (J_rho[:, None] * J_seen).sum(axis=2)  # (F, 6, M)
            B[anchor, :, np.arange(len(anchor))] += (J_rho[:, None] * J_anchor).sum(axis=(0, 2)).T
            B = B[1:].reshape(6 * free, -1).T
            C = (J_rho**2).sum(axis=(0, 1)) + 1e-6
            gr = (J_rho * rw).sum(axis=(0, 1))
            A_free = A[1:, :, 1:].reshape(6 * free, 6 * free) + np.diag(np.tile(prior, free))
            g_free = (g[1:] + prior * moved).reshape(-1)
            S = A_free - B.T @ (B / C[:, None])
            step = -np.linalg.solve(S, g_free - B.T @ (gr / C))
            if not np.isfinite(step).all():
                return
            rho = np.maximum(rho - (gr + B @ step) / C, 0.0)
            steps = step.reshape(free, 6)
            for at, (T, by) in enumerate(zip(self.poses[1:], steps, strict=True), start=1):
                self.poses[at] = Pose(rotation_exp(by[3:]) @ T.R, T.p + by[:3])
            moved += steps
            if np.abs(steps).max() < 1e-5:
                break
        self.poses = [Pose(R, T.p) for R, T in zip(orthonormal(self._stacked()[0]), self.poses, strict=True)]
        self.rho[chosen] = rho
        self.rho_sigma[chosen] = 1.0 / np.sqrt(C)
        # What no longer fits is forgotten; if it is a landmark after all, it is triangulated anew.
        fits = (others & (norm < self.reject_px / self.sigma_px)).sum(axis=0)
        self.rho[chosen[2 * fits < others.sum(axis=0)]] = np.nan

    # --- geometry shared by the above ---

    def _stacked(self) -> tuple[Floats, Floats]:
        return np.stack([T.R for T in self.poses]), np.stack([T.p for T in self.poses])


def _cross(a: Floats, b: Floats, out: Floats) -> None:
    """a x b along the second axis of (F, 3, ..., M)."""
    out[:, 0] = a[:, 1] * b[:, 2] - a[:, 2] * b[:, 1]
    out[:, 1] = a[:, 2] * b[:, 0] - a[:, 0] * b[:, 2]
    out[:, 2] = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]


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
