"""A z-buffer in numba: the front triangle at each sample, and shadow maps by the same scan conversion."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from birdslam.world.rendering.compiled import per_pixel
from birdslam.world.rendering.materials import FOLIAGE

NEAR_M = 0.2  # near clipping plane


@per_pixel
def _span(x0, y0, x1, y1, x2, y2, row):  # type: ignore[no-untyped-def]
    """Interval of a row inside the triangle; empty if the first value is greater."""
    left, right = 1e9, -1e9
    for edge in range(3):
        ax, ay = (x0, y0) if edge == 0 else ((x1, y1) if edge == 1 else (x2, y2))
        bx, by = (x1, y1) if edge == 0 else ((x2, y2) if edge == 1 else (x0, y0))
        if (ay <= row <= by) or (by <= row <= ay):
            if ay == by:
                left, right = min(left, ax, bx), max(right, ax, bx)
            else:
                cross = ax + (row - ay) * (bx - ax) / (by - ay)
                left, right = min(left, cross), max(right, cross)
    return left, right


@per_pixel
def _scan(x, y, w, i, j, k, triangle, nearest, owner, gaps, u, v, mask, masks):  # type: ignore[no-untyped-def]
    """Keeps, at every sample inside the triangle of corners i j k, the greatest w and its owner.

    With `gaps`, only where the mask has a leaf at (u, v), which is linear in the image on a vertical card.
    """
    x0, y0, w0 = x[i], y[i], w[i]
    x1, y1, w1 = x[j], y[j], w[j]
    x2, y2, w2 = x[k], y[k], w[k]
    area = (x1 - x0) * (y2 - y0) - (x2 - x0) * (y1 - y0)
    if abs(area) < 1e-7:
        return
    height, width = nearest.shape
    top = max(0, math.ceil(min(y0, y1, y2)))
    bottom = min(height - 1, math.floor(max(y0, y1, y2)))
    if top > bottom or max(x0, x1, x2) < 0.0 or min(x0, x1, x2) > width - 1:
        return
    inv = 1.0 / area
    wx = ((w1 - w0) * (y2 - y0) - (w2 - w0) * (y1 - y0)) * inv
    wy = ((w2 - w0) * (x1 - x0) - (w1 - w0) * (x2 - x0)) * inv
    ux = uy = vx = vy = u0 = v0 = 0.0
    if gaps:
        u0, v0 = u[i], v[i]
        ux = ((u[j] - u0) * (y2 - y0) - (u[k] - u0) * (y1 - y0)) * inv
        uy = ((u[k] - u0) * (x1 - x0) - (u[j] - u0) * (x2 - x0)) * inv
        vx = ((v[j] - v0) * (y2 - y0) - (v[k] - v0) * (y1 - y0)) * inv
        vy = ((v[k] - v0) * (x1 - x0) - (v[j] - v0) * (x2 - x0)) * inv
    for row in range(top, bottom + 1):
        left, right = _span(x0, y0, x1, y1, x2, y2, row)
        if left > right:
            continue
        first, last = max(0, math.ceil(left)), min(width - 1, math.floor(right))
        value = w0 + (first - x0) * wx + (row - y0) * wy
        for column in range(first, last + 1):
            if value > nearest[row, column]:
                if gaps:
                    mu = int((u0 + (column - x0) * ux + (row - y0) * uy) * masks.shape[2])
                    mv = int((v0 + (column - x0) * vx + (row - y0) * vy) * masks.shape[1])
                    mu = min(max(mu, 0), masks.shape[2] - 1)
                    mv = min(max(mv, 0), masks.shape[1] - 1)
                    if masks[mask, mv, mu] > 0:
                        nearest[row, column] = value
                        owner[row, column] = triangle
                else:
                    nearest[row, column] = value
                    owner[row, column] = triangle
            value += wx


@per_pixel
def _to_camera(corners, t, c, R, C):  # type: ignore[no-untyped-def]
    """Corner c of triangle t, in camera."""
    dx, dy, dz = corners[t, c, 0] - C[0], corners[t, c, 1] - C[1], corners[t, c, 2] - C[2]
    return (
        R[0, 0] * dx + R[0, 1] * dy + R[0, 2] * dz,
        R[1, 0] * dx + R[1, 1] * dy + R[1, 2] * dz,
        R[2, 0] * dx + R[2, 1] * dy + R[2, 2] * dz,
    )


@per_pixel
def clip_near(corners, t, R, C, K, attributes, x, y, w, u, v):  # type: ignore[no-untyped-def]
    """Projects triangle t in ego; returns the number of corners (0, 3 or 4) of the fan beyond NEAR_M."""
    fx, fy, cx, cy = K[0], K[1], K[2], K[3]
    x0, y0, z0 = _to_camera(corners, t, 0, R, C)
    x1, y1, z1 = _to_camera(corners, t, 1, R, C)
    x2, y2, z2 = _to_camera(corners, t, 2, R, C)
    px, py, pz = (x0, x1, x2), (y0, y1, y2), (z0, z1, z2)
    n = 0
    for c in range(3):
        d = (c + 1) % 3
        if pz[c] >= NEAR_M:
            w[n] = 1.0 / pz[c]
            x[n], y[n] = fx * px[c] * w[n] + cx, fy * py[c] * w[n] + cy
            u[n], v[n] = attributes[t, c, 0], attributes[t, c, 1]
            n += 1
        if (pz[c] >= NEAR_M) != (pz[d] >= NEAR_M):
            share = (NEAR_M - pz[c]) / (pz[d] - pz[c])
            w[n] = 1.0 / NEAR_M
            x[n] = fx * (px[c] + share * (px[d] - px[c])) * w[n] + cx
            y[n] = fy * (py[c] + share * (py[d] - py[c])) * w[n] + cy
            u[n] = attributes[t, c, 0] + share * (attributes[t, d, 0] - attributes[t, c, 0])
            v[n] = attributes[t, c, 1] + share * (attributes[t, d, 1] - attributes[t, c, 1])
            n += 1
    return n


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def rasterize(first, last, corners, attributes, material, R, C, K, masks, nearest, owner):  # type: ignore[no-untyped-def]
    """Draws triangles [first, last) to `nearest` (1 / depth) and `owner`; K = (fx, fy, cx, cy) in samples."""
    x, y, w, u, v = np.empty(4), np.empty(4), np.empty(4), np.empty(4), np.empty(4)
    for t in range(first, last):
        n = clip_near(corners, t, R, C, K, attributes, x, y, w, u, v)
        if n < 3:
            continue
        gaps = material[t] == FOLIAGE
        mask = int(attributes[t, 0, 2]) if gaps else 0
        _scan(x, y, w, 0, 1, 2, t, nearest, owner, gaps, u, v, mask, masks)
        if n == 4:
            _scan(x, y, w, 0, 2, 3, t, nearest, owner, gaps, u, v, mask, masks)


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def shadow_map(first, last, corners, attributes, material, lean, origin, cells_per_m, masks, highest, owner):  # type: ignore[no-untyped-def]
    """Height of the highest point on each ray of the sun, indexed by the ray's intersection with z = 0 in ego.

    `lean` = (dx, dy) of the sun's direction per metre of height.
    """
    x, y, w, u, v = np.empty(4), np.empty(4), np.empty(4), np.empty(4), np.empty(4)
    for t in range(first, last):
        for c in range(3):
            w[c] = corners[t, c, 2]
            x[c] = (corners[t, c, 0] - w[c] * lean[0] - origin[0]) * cells_per_m
            y[c] = (corners[t, c, 1] - w[c] * lean[1] - origin[1]) * cells_per_m
            u[c], v[c] = attributes[t, c, 0], attributes[t, c, 1]
        gaps = material[t] == FOLIAGE
        mask = int(attributes[t, 0, 2]) if gaps else 0
        _scan(x, y, w, 0, 1, 2, t, highest, owner, gaps, u, v, mask, masks)


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def project(first, last, corners, R, C, K):  # type: ignore[no-untyped-def]
    """Bounding box x1 y1 x2 y2 of the part of triangles [first, last) in front of the camera; 0 if empty."""
    x, y, w, u, v = np.empty(4), np.empty(4), np.empty(4), np.empty(4), np.empty(4)
    box = np.array([1e9, 1e9, -1e9, -1e9])
    for t in range(first, last):
        n = clip_near(corners, t, R, C, K, corners, x, y, w, u, v)
        for c in range(n):
            box[0], box[1] = min(box[0], x[c]), min(box[1], y[c])
            box[2], box[3] = max(box[2], x[c]), max(box[3], y[c])
    if box[0] > box[2]:
        box[:] = 0.0
    return box


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def count_inside(first, last, corners, R, C, K, stamp, mark):  # type: ignore[no-untyped-def]
    """Number of distinct samples in the image covered by triangles [first, last); `stamp` gets `mark`."""
    x, y, w, u, v = np.empty(4), np.empty(4), np.empty(4), np.empty(4), np.empty(4)
    height, width = stamp.shape
    total = 0
    for t in range(first, last):
        n = clip_near(corners, t, R, C, K, corners, x, y, w, u, v)
        for part in range(n - 2):
            j, k = part + 1, part + 2
            area = (x[j] - x[0]) * (y[k] - y[0]) - (x[k] - x[0]) * (y[j] - y[0])
            if abs(area) < 1e-7:
                continue
            top = max(0, math.ceil(min(y[0], y[j], y[k])))
            bottom = min(height - 1, math.floor(max(y[0], y[j], y[k])))
            for row in range(top, bottom + 1):
                left, right = _span(x[0], y[0], x[j], y[j], x[k], y[k], row)
                for column in range(max(0, math.ceil(left)), min(width - 1, math.floor(right)) + 1):
                    if stamp[row, column] != mark:
                        stamp[row, column] = mark
                        total += 1
    return total
