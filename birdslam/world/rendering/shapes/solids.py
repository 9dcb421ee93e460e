"""Triangles of simple solids, in the local frame of their body: x forward, y left, z up. Compiled by numba.

`B` is the buffer of triangles that every function here appends to:
(corners (N, 3, 3), attributes (N, 3, 3), normals (N, 3, 3), material (N,), body (N,), (how many, how many not)).
Attributes are texture coordinates: local coordinates, or (u, v, face) in metres on flat faces.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit

Buffer = tuple[Any, ...]


def new_buffer(capacity: int) -> Buffer:
    """A buffer for `capacity` triangles; further ones are only counted."""
    return (
        np.empty((capacity, 3, 3), np.float32),
        np.empty((capacity, 3, 3), np.float32),
        np.empty((capacity, 3, 3), np.float32),
        np.empty(capacity, np.int32),
        np.empty(capacity, np.int32),
        np.zeros(2, np.int64),
    )


@njit(cache=True, nogil=True)
def corner(B, k, i, x, y, z, a, b, c, nx, ny, nz):  # type: ignore[no-untyped-def]
    """Sets corner i of triangle k: position, attributes, normal."""
    B[0][k, i, 0], B[0][k, i, 1], B[0][k, i, 2] = x, y, z
    B[1][k, i, 0], B[1][k, i, 1], B[1][k, i, 2] = a, b, c
    B[2][k, i, 0], B[2][k, i, 1], B[2][k, i, 2] = nx, ny, nz


@njit(cache=True, nogil=True)
def begin(B, body, material, triangles):  # type: ignore[no-untyped-def]
    """Index of the first of new triangles, -1 if the buffer is full."""
    k = B[5][0]
    if k + triangles > B[3].shape[0]:
        B[5][1] += triangles
        return -1
    for j in range(k, k + triangles):
        B[3][j] = material
        B[4][j] = body
    B[5][0] = k + triangles
    return k


@njit(cache=True, nogil=True)
def quad(B, body, material, p, q, r, s, n, u0, v0, u1, v1, face):  # type: ignore[no-untyped-def]
    """A flat face of corners p q r s (bottom left, bottom right, top right, top left as seen), u right and v up."""
    k = begin(B, body, material, 2)
    if k < 0:
        return
    corner(B, k, 0, p[0], p[1], p[2], u0, v0, face, n[0], n[1], n[2])
    corner(B, k, 1, q[0], q[1], q[2], u1, v0, face, n[0], n[1], n[2])
    corner(B, k, 2, r[0], r[1], r[2], u1, v1, face, n[0], n[1], n[2])
    corner(B, k + 1, 0, p[0], p[1], p[2], u0, v0, face, n[0], n[1], n[2])
    corner(B, k + 1, 1, r[0], r[1], r[2], u1, v1, face, n[0], n[1], n[2])
    corner(B, k + 1, 2, s[0], s[1], s[2], u0, v1, face, n[0], n[1], n[2])


@njit(cache=True, nogil=True)
def box(B, body, material, x0, x1, y0, y1, z0, z1):  # type: ignore[no-untyped-def]
    """A box; faces 0 front (+x), 1 left (+y), 2 rear, 3 right, 4 top, each with (u, v) in metres from its corner."""
    lx, ly, lz = x1 - x0, y1 - y0, z1 - z0
    quad(B, body, material, (x1, y0, z0), (x1, y1, z0), (x1, y1, z1), (x1, y0, z1),
         (1.0, 0.0, 0.0), 0.0, 0.0, ly, lz, 0.0)  # fmt: skip
    quad(B, body, material, (x1, y1, z0), (x0, y1, z0), (x0, y1, z1), (x1, y1, z1),
         (0.0, 1.0, 0.0), 0.0, 0.0, lx, lz, 1.0)  # fmt: skip
    quad(B, body, material, (x0, y1, z0), (x0, y0, z0), (x0, y0, z1), (x0, y1, z1),
         (-1.0, 0.0, 0.0), 0.0, 0.0, ly, lz, 2.0)  # fmt: skip
    quad(B, body, material, (x0, y0, z0), (x1, y0, z0), (x1, y0, z1), (x0, y0, z1),
         (0.0, -1.0, 0.0), 0.0, 0.0, lx, lz, 3.0)  # fmt: skip
    quad(B, body, material, (x0, y0, z1), (x1, y0, z1), (x1, y1, z1), (x0, y1, z1),
         (0.0, 0.0, 1.0), 0.0, 0.0, lx, ly, 4.0)  # fmt: skip
    if z0 > 0.5:  # visible from below
        quad(B, body, material, (x0, y1, z0), (x1, y1, z0), (x1, y0, z0), (x0, y0, z0),
             (0.0, 0.0, -1.0), 0.0, 0.0, lx, ly, 5.0)  # fmt: skip


@njit(cache=True, nogil=True)
def limb(B, body, material, p, q, r0, r1, sides):  # type: ignore[no-untyped-def]
    """A tapered tube from p to q with a cap at q; attributes (angle, metres along it, 0)."""
    dx, dy, dz = q[0] - p[0], q[1] - p[1], q[2] - p[2]
    length = math.sqrt(dx * dx + dy * dy + dz * dz) + 1e-9
    dx, dy, dz = dx / length, dy / length, dz / length
    if abs(dz) < 0.9:
        ex, ey, ez = -dy, dx, 0.0
    else:
        ex, ey, ez = 0.0, dz, -dy
    norm = math.sqrt(ex * ex + ey * ey + ez * ez) + 1e-9
    ex, ey, ez = ex / norm, ey / norm, ez / norm
    fx, fy, fz = dy * ez - dz * ey, dz * ex - dx * ez, dx * ey - dy * ex
    k = begin(B, body, material, 3 * sides)
    if k < 0:
        return
    for j in range(sides):
        a0, a1 = 2.0 * math.pi * j / sides, 2.0 * math.pi * (j + 1) / sides
        n0x, n0y, n0z = (
            math.cos(a0) * ex + math.sin(a0) * fx,
            math.cos(a0) * ey + math.sin(a0) * fy,
            math.cos(a0) * ez + math.sin(a0) * fz,
        )
        n1x, n1y, n1z = (
            math.cos(a1) * ex + math.sin(a1) * fx,
            math.cos(a1) * ey + math.sin(a1) * fy,
            math.cos(a1) * ez + math.sin(a1) * fz,
        )
        t = k + 3 * j
        corner(B, t, 0, p[0] + r0 * n0x, p[1] + r0 * n0y, p[2] + r0 * n0z, a0, 0.0, 0.0, n0x, n0y, n0z)
        corner(B, t, 1, p[0] + r0 * n1x, p[1] + r0 * n1y, p[2] + r0 * n1z, a1, 0.0, 0.0, n1x, n1y, n1z)
        corner(B, t, 2, q[0] + r1 * n1x, q[1] + r1 * n1y, q[2] + r1 * n1z, a1, length, 0.0, n1x, n1y, n1z)
        corner(B, t + 1, 0, p[0] + r0 * n0x, p[1] + r0 * n0y, p[2] + r0 * n0z, a0, 0.0, 0.0, n0x, n0y, n0z)
        corner(B, t + 1, 1, q[0] + r1 * n1x, q[1] + r1 * n1y, q[2] + r1 * n1z, a1, length, 0.0, n1x, n1y, n1z)
        corner(B, t + 1, 2, q[0] + r1 * n0x, q[1] + r1 * n0y, q[2] + r1 * n0z, a0, length, 0.0, n0x, n0y, n0z)
        corner(B, t + 2, 0, q[0] + r1 * n0x, q[1] + r1 * n0y, q[2] + r1 * n0z, a0, length, 0.0, dx, dy, dz)
        corner(B, t + 2, 1, q[0] + r1 * n1x, q[1] + r1 * n1y, q[2] + r1 * n1z, a1, length, 0.0, dx, dy, dz)
        corner(B, t + 2, 2, q[0], q[1], q[2], a0, length, 0.0, dx, dy, dz)


@njit(cache=True, nogil=True)
def ball(B, body, material, x, y, z, rx, ry, rz):  # type: ignore[no-untyped-def]
    """An ellipsoid of 8 x 4 patches."""
    k = begin(B, body, material, 64)
    if k < 0:
        return
    for j in range(4):
        t0, t1 = math.pi * (j / 4 - 0.5), math.pi * ((j + 1) / 4 - 0.5)
        for i in range(8):
            p0, p1 = 2.0 * math.pi * i / 8, 2.0 * math.pi * (i + 1) / 8
            for half in range(2):
                t = k + 2 * (8 * j + i) + half
                for c in range(3):
                    if half == 0:
                        th = t0 if c < 2 else t1
                        ph = p0 if c == 0 else p1
                    else:
                        th = t0 if c == 0 else t1
                        ph = p1 if c == 1 else p0
                    nx, ny, nz = math.cos(th) * math.cos(ph), math.cos(th) * math.sin(ph), math.sin(th)
                    px, py, pz = x + rx * nx, y + ry * ny, z + rz * nz
                    corner(B, t, c, px, py, pz, px, py, pz, nx, ny, nz)


@njit(cache=True, nogil=True)
def wheel(B, body, material, x, y, side, r, width):  # type: ignore[no-untyped-def]
    """A wheel on the ground with its outer disc at y; attributes (x / r, z / r, 1) there, 0 on the tread."""
    sides = 12
    k = begin(B, body, material, 3 * sides)
    if k < 0:
        return
    inner = y - side * width
    for j in range(sides):
        a0, a1 = 2.0 * math.pi * j / sides, 2.0 * math.pi * (j + 1) / sides
        c0, s0, c1, s1 = math.cos(a0), math.sin(a0), math.cos(a1), math.sin(a1)
        t = k + 3 * j
        corner(B, t, 0, x, y, r, 0.0, 0.0, 1.0, 0.0, side, 0.0)
        corner(B, t, 1, x + r * c0, y, r + r * s0, c0, s0, 1.0, 0.0, side, 0.0)
        corner(B, t, 2, x + r * c1, y, r + r * s1, c1, s1, 1.0, 0.0, side, 0.0)
        corner(B, t + 1, 0, x + r * c0, y, r + r * s0, c0, s0, 0.0, c0, 0.0, s0)
        corner(B, t + 1, 1, x + r * c1, y, r + r * s1, c1, s1, 0.0, c1, 0.0, s1)
        corner(B, t + 1, 2, x + r * c1, inner, r + r * s1, c1, s1, 0.0, c1, 0.0, s1)
        corner(B, t + 2, 0, x + r * c0, y, r + r * s0, c0, s0, 0.0, c0, 0.0, s0)
        corner(B, t + 2, 1, x + r * c1, inner, r + r * s1, c1, s1, 0.0, c1, 0.0, s1)
        corner(B, t + 2, 2, x + r * c0, inner, r + r * s0, c0, s0, 0.0, c0, 0.0, s0)


@njit(cache=True, nogil=True)
def card(B, body, material, x, y, z, ux, uy, width, height, mask):  # type: ignore[no-untyped-def]
    """A vertical picture with gaps, its bottom centre at (x, y, z), along the direction (ux, uy)."""
    hx, hy = 0.5 * width * ux, 0.5 * width * uy
    n = (0.0, 0.0, 1.0)
    quad(
        B, body, material, (x - hx, y - hy, z), (x + hx, y + hy, z), (x + hx, y + hy, z + height),
        (x - hx, y - hy, z + height), n, 0.0, 1.0, 1.0, 0.0, mask,
    )  # fmt: skip


@njit(cache=True, nogil=True)
def gable(B, body, material, x0, x1, y0, y1, z, rise, over):  # type: ignore[no-untyped-def]
    """A saddle roof with its ridge along x over the box's top at z, and its two gables (face 6, wall)."""
    ym = 0.5 * (y0 + y1)
    half = 0.5 * (y1 - y0)
    slope = math.hypot(half, rise)
    ny, nz = rise / slope, half / slope
    a, b = x0 - over, x1 + over
    drop = over * rise / half
    quad(B, body, material, (b, y1 + over, z - drop), (a, y1 + over, z - drop), (a, ym, z + rise), (b, ym, z + rise),
         (0.0, ny, nz), 0.0, 0.0, b - a, slope, 7.0)  # fmt: skip
    quad(B, body, material, (a, y0 - over, z - drop), (b, y0 - over, z - drop), (b, ym, z + rise), (a, ym, z + rise),
         (0.0, -ny, nz), 0.0, 0.0, b - a, slope, 7.0)  # fmt: skip
    k = begin(B, body, material, 2)
    if k < 0:
        return
    corner(B, k, 0, x1, y0, z, 0.0, 0.0, 6.0, 1.0, 0.0, 0.0)
    corner(B, k, 1, x1, y1, z, 2.0 * half, 0.0, 6.0, 1.0, 0.0, 0.0)
    corner(B, k, 2, x1, ym, z + rise, half, rise, 6.0, 1.0, 0.0, 0.0)
    corner(B, k + 1, 0, x0, y1, z, 0.0, 0.0, 6.0, -1.0, 0.0, 0.0)
    corner(B, k + 1, 1, x0, y0, z, 2.0 * half, 0.0, 6.0, -1.0, 0.0, 0.0)
    corner(B, k + 1, 2, x0, ym, z + rise, half, rise, 6.0, -1.0, 0.0, 0.0)
