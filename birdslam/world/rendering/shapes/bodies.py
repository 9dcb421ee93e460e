"""Meshes of road users: cars, vans, buses, pedestrians, cyclists. Compiled by numba.

A car is a loft: cross-sections from tail to nose under a profile of bonnet, screens and roof. `paint` adds windows,
lamps, plates and door gaps per pixel.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from birdslam.world.rendering import materials as m
from birdslam.world.rendering.shapes.solids import ball, begin, box, corner, limb, wheel

STATIONS = 15
RIBS = 8  # points of half a cross-section
TRACK_RATIO = 0.935  # width over the tyres relative to a vehicle's width


@njit(cache=True, nogil=True)
def profile(P, x):  # type: ignore[no-untyped-def]
    """Height of the body's top at x."""
    x0, x1 = P[m.LOFT_X0], P[m.LOFT_X1]
    if x >= P[m.X_COWL]:
        t = (x - P[m.X_COWL]) / max(x1 - P[m.X_COWL], 1e-3)
        z = P[m.Z_COWL] + (P[m.Z_NOSE] - P[m.Z_COWL]) * t * t
        d = x1 - x
        return z - 0.5 * max(0.0, 0.16 - d) * min(1.0, 2.0 * (P[m.Z_NOSE] - P[m.CLEARANCE]))
    if x >= P[m.X_SCREEN_TOP]:
        t = (x - P[m.X_SCREEN_TOP]) / max(P[m.X_COWL] - P[m.X_SCREEN_TOP], 1e-3)
        top = 0.985 * P[m.HEIGHT]
        return top + (P[m.Z_COWL] - top) * (0.8 * t + 0.2 * t * t)
    if x >= P[m.X_ROOF_END]:
        t = (x - P[m.X_ROOF_END]) / max(P[m.X_SCREEN_TOP] - P[m.X_ROOF_END], 1e-3)
        return P[m.HEIGHT] * (0.965 + 0.02 * t + 0.1 * t * (1.0 - t))
    z_back = max(P[m.Z_TAIL], P[m.BELT])
    if x >= P[m.X_BACK_BOTTOM]:
        t = (P[m.X_ROOF_END] - x) / max(P[m.X_ROOF_END] - P[m.X_BACK_BOTTOM], 1e-3)
        top = 0.965 * P[m.HEIGHT]
        return top + (z_back - top) * (0.7 * t + 0.3 * t * t)
    t = (P[m.X_BACK_BOTTOM] - x) / max(P[m.X_BACK_BOTTOM] - x0, 1e-3)
    return z_back + (P[m.Z_TAIL] - z_back) * t - 0.6 * max(0.0, 0.1 - (x - x0))


@njit(cache=True, nogil=True)
def half_width(P, x):  # type: ignore[no-untyped-def]
    """Half the body's width at its waist at x: narrower at the rounded ends."""
    reach = min(0.8, 0.35 * (P[m.LOFT_X1] - P[m.LOFT_X0]))
    f = max(0.0, 1.0 - (P[m.LOFT_X1] - x) / reach)
    r = max(0.0, 1.0 - (x - P[m.LOFT_X0]) / reach)
    return 0.49 * P[m.WIDTH] * (1.0 - P[m.ROUND_FRONT] * f * f * f - P[m.ROUND_REAR] * r * r * r)


@njit(cache=True, nogil=True)
def roof_half_width(P, x, z):  # type: ignore[no-untyped-def]
    """Half the width of the windows at height z over the belt."""
    t = max(0.0, (z - P[m.BELT]) / max(P[m.HEIGHT] - P[m.BELT], 0.05))
    return half_width(P, x) * 0.955 - P[m.TUMBLE] * t


@njit(cache=True, nogil=True)
def _stations(P, x0, x1):  # type: ignore[no-untyped-def]
    """x (STATIONS,) of the cross-sections from tail to nose: at bends of the profile, and between."""
    xs = np.empty(STATIONS)
    xs[0], xs[1], xs[2] = x0, x0 + 0.04, x0 + 0.13
    xs[3] = max(P[m.X_BACK_BOTTOM], x0 + 0.18)
    xs[5] = max(P[m.X_ROOF_END], xs[3] + 0.1)
    xs[4] = 0.5 * (xs[3] + xs[5])
    xs[8] = P[m.X_SCREEN_TOP]
    xs[6], xs[7] = xs[5] + 0.35 * (xs[8] - xs[5]), xs[5] + 0.7 * (xs[8] - xs[5])
    xs[10] = min(P[m.X_COWL], x1 - 0.06)
    xs[9] = 0.5 * (xs[8] + xs[10])
    xs[13], xs[14] = max(x1 - 0.05, 0.4 * xs[10] + 0.6 * x1), x1
    xs[12] = max(x1 - 0.14, 0.6 * xs[10] + 0.4 * xs[13])
    xs[11] = 0.5 * (xs[10] + xs[12])
    return xs


@njit(cache=True, nogil=True)
def _cross_sections(P, x0, x1):  # type: ignore[no-untyped-def]
    """(STATIONS, RIBS, 3) points of the left half of the body, from the sill up to the roof's middle."""
    xs = _stations(P, x0, x1)
    grid = np.empty((STATIONS, RIBS, 3))
    for k in range(STATIONS):
        x = xs[k]
        top, w = profile(P, x), half_width(P, x)
        belt = min(P[m.BELT], top)
        ends = max(0.0, 1.0 - min(x - x0, x1 - x) / 0.5)
        low = P[m.CLEARANCE] + 0.1 * ends
        glass = top - belt
        shoulder = roof_half_width(P, x, top) if glass > 0.02 else 0.94 * w
        flat = 0.03 if glass < 0.02 else 0.0
        # Below its wings a body is narrower than its track, so that the tyres are under it
        sill = min(max(low + 0.35 * (belt - low), 1.7 * P[m.WHEEL_RADIUS]), low + 0.7 * (belt - low))
        wing = min(max(low + 0.6 * (belt - low), sill + 0.1), low + 0.8 * (belt - low))
        rows = (
            (0.8 * w, low),
            ((0.9 + 0.07 * ends) * w, low + 0.06),
            ((0.935 + 0.05 * ends) * w, sill),
            (w, wing),
            (0.955 * w, belt - flat),
            (shoulder, belt + 0.88 * glass - 0.4 * flat),
            (0.8 * shoulder, belt + 0.985 * glass),
            (0.0, top + 0.005),
        )
        for i in range(RIBS):
            grid[k, i, 0], grid[k, i, 1], grid[k, i, 2] = x, rows[i][0], rows[i][1]
    return grid


@njit(cache=True, nogil=True)
def _smooth_normals(grid):  # type: ignore[no-untyped-def]
    """The normal at each point of the cross-sections, from its neighbours; at the ends it turns to tail and nose."""
    normal = np.empty((STATIONS, RIBS, 3))
    for k in range(STATIONS):
        for i in range(RIBS):
            ka, kb = max(k - 1, 0), min(k + 1, STATIONS - 1)
            ia, ib = max(i - 1, 0), min(i + 1, RIBS - 1)
            a, b = grid[kb, i] - grid[ka, i], grid[k, ib] - grid[k, ia]
            nx, ny, nz = b[1] * a[2] - b[2] * a[1], b[2] * a[0] - b[0] * a[2], b[0] * a[1] - b[1] * a[0]
            if i == RIBS - 1:
                ny = 0.0
            if k == 0:
                nx = -1.5 * math.sqrt(ny * ny + nz * nz) - 1e-6
            if k == STATIONS - 1:
                nx = 1.5 * math.sqrt(ny * ny + nz * nz) + 1e-6
            norm = math.sqrt(nx * nx + ny * ny + nz * nz) + 1e-9
            normal[k, i, 0], normal[k, i, 1], normal[k, i, 2] = nx / norm, ny / norm, nz / norm
    return normal


@njit(cache=True, nogil=True)
def loft(B, body, P):  # type: ignore[no-untyped-def]
    """The painted body of a vehicle from LOFT_X0 to LOFT_X1."""
    grid = _cross_sections(P, P[m.LOFT_X0], P[m.LOFT_X1])
    normal = _smooth_normals(grid)
    t = begin(B, body, m.PAINT, 4 * (STATIONS - 1) * (RIBS - 1) + 4 * (RIBS - 1))
    if t < 0:
        return
    for k in range(STATIONS - 1):
        for i in range(RIBS - 1):
            for side in range(2):
                s = 1.0 - 2.0 * side
                for c in range(6):
                    kk = k + (1 if c in (1, 2, 4) else 0)
                    ii = i + (1 if c in (2, 4, 5) else 0)
                    p, n = grid[kk, ii], normal[kk, ii]
                    corner(B, t + c // 3, c % 3, p[0], s * p[1], p[2], p[0], s * p[1], p[2], n[0], s * n[1], n[2])
                t += 2
    for end in range(2):  # the faces of tail and nose
        k = 0 if end == 0 else STATIONS - 1
        d = -1.0 if end == 0 else 1.0
        for i in range(RIBS - 1):
            for c in range(6):
                s = 1.0 if c in (0, 3, 5) else -1.0
                ii = i + (1 if c in (2, 4, 5) else 0)
                p = grid[k, ii]
                ny, nz = 0.25 * s * p[1] / (P[m.WIDTH] + 1e-6), 0.15 * (i - 3) / 4.0
                corner(B, t + c // 3, c % 3, p[0], s * p[1], p[2], p[0], s * p[1], p[2], d * 0.95, ny, nz)
            t += 2


@njit(cache=True, nogil=True)
def vehicle(B, body, P):  # type: ignore[no-untyped-def]
    """Car, van or bus: the loft on four wheels with its mirrors."""
    loft(B, body, P)
    y, r = 0.5 * P[m.WIDTH], P[m.WHEEL_RADIUS]
    # Exhaust, axles and tank block the view under a car
    box(
        B, body, m.DARK, P[m.X_REAR_AXLE] - 0.6 * r, P[m.X_FRONT_AXLE], -0.6 * y, 0.6 * y,
        (0.55 + 0.3 * P[m.SEED]) * P[m.CLEARANCE], P[m.CLEARANCE] + 0.12,
    )  # fmt: skip
    for side in range(2):
        s = 1.0 - 2.0 * side
        wheel(B, body, m.WHEEL, P[m.X_FRONT_AXLE], s * TRACK_RATIO * y, s, r, 0.22)
        wheel(B, body, m.WHEEL, P[m.X_REAR_AXLE], s * TRACK_RATIO * y, s, r, 0.22)
        x = P[m.X_COWL] - 0.35
        inner, outer = s * 0.90 * y, s * (y + 0.1)
        z = P[m.BELT] + 0.02
        box(
            B,
            body,
            m.DARK if P[m.CLADDING] > 0.5 else m.PLAIN,
            x,
            x + 0.12,
            min(inner, outer),
            max(inner, outer),
            z,
            z + 0.14,
        )


@njit(cache=True, nogil=True)
def person(B, body, P, z_hip, lean, seated, holds):  # type: ignore[no-untyped-def]
    """Legs, trunk, arms and head of a person of HEIGHT with the hip at `z_hip`; the face number selects the clothes.

    With `holds` both hands are on a bar ahead.
    """
    h = P[m.HEIGHT] if not seated else 1.75
    k = h / 1.75
    stride = 0.0 if seated else 0.32 * math.sin(P[m.PHASE])
    sway = 0.25 * math.sin(P[m.PHASE])
    for side in range(2):
        s = 1.0 - 2.0 * side
        y = 0.1 * k * s
        if seated:
            turn = P[m.PHASE] + math.pi * side
            knee = (0.28, y, z_hip - 0.12 + 0.1 * math.sin(turn))
            foot = (0.12 + 0.14 * math.cos(turn), y, z_hip - 0.62 + 0.14 * math.sin(turn))
        else:
            knee = (0.55 * s * stride * k + 0.03, y, 0.5 * z_hip)
            foot = (s * stride * k, y, 0.04)
        limb(B, body, m.CLOTH, (0.0, y, z_hip), knee, 0.09 * k, 0.07 * k, 6)
        limb(B, body, m.CLOTH, knee, foot, 0.07 * k, 0.05 * k, 6)
        box(
            B,
            body,
            m.DARK,
            foot[0] - 0.08,
            foot[0] + 0.16,
            y - 0.045,
            y + 0.045,
            max(foot[2] - 0.04, 0.0),
            foot[2] + 0.05,
        )
        shoulder = (lean, s * 0.2 * k, z_hip + 0.52 * k)
        elbow = (lean + (0.14 if holds else -s * sway * 0.5), s * 0.25 * k, z_hip + 0.26 * k)
        hand = (lean + 0.36 if holds else -s * sway, s * 0.24 * k, z_hip + (0.2 if holds else 0.0) * k)
        limb(B, body, m.SKIN, shoulder, elbow, 0.055 * k, 0.045 * k, 5)
        limb(B, body, m.SKIN, elbow, hand, 0.045 * k, 0.035 * k, 5)
    ball(B, body, m.SKIN, 0.5 * lean, 0.0, z_hip + 0.3 * k, 0.13 * k, 0.2 * k, 0.36 * k)
    limb(B, body, m.CLOTH, (0.0, 0.0, z_hip - 0.08), (0.1 * lean, 0.0, z_hip + 0.12 * k), 0.15 * k, 0.15 * k, 7)
    ball(B, body, m.SKIN, 1.15 * lean + 0.02, 0.0, z_hip + 0.74 * k, 0.095 * k, 0.08 * k, 0.12 * k)
    if P[m.PICTURE] > 8.0:  # a bag
        box(B, body, m.DARK, -0.26, -0.1, -0.14, 0.14, z_hip + 0.12, z_hip + 0.5)


@njit(cache=True, nogil=True)
def pedestrian(B, body, P):  # type: ignore[no-untyped-def]
    """A pedestrian, with both hands on a bar if GLOSS is over 0.5."""
    person(B, body, P, 0.5 * P[m.HEIGHT], 0.03, False, P[m.GLOSS] > 0.5)


@njit(cache=True, nogil=True)
def pram(B, body, P):  # type: ignore[no-untyped-def]
    """A pram in front of a pedestrian P: a tub with a hood on four wheels."""
    x_bar, z_bar = 0.39, 0.61 * P[m.HEIGHT]
    for s in (-1.0, 1.0):
        wheel(B, body, m.WHEEL, x_bar + 0.25, 0.22 * s, s, 0.14, 0.05)
        wheel(B, body, m.WHEEL, x_bar + 0.8, 0.22 * s, s, 0.1, 0.05)
        limb(B, body, m.METAL, (x_bar, 0.2 * s, z_bar), (x_bar + 0.8, 0.2 * s, 0.1), 0.015, 0.015, 4)
        limb(B, body, m.METAL, (x_bar + 0.25, 0.2 * s, 0.14), (x_bar + 0.6, 0.2 * s, 0.55), 0.015, 0.015, 4)
    limb(B, body, m.DARK, (x_bar, -0.24, z_bar), (x_bar, 0.24, z_bar), 0.02, 0.02, 5)
    ball(B, body, m.PLAIN, x_bar + 0.5, 0.0, 0.62, 0.4, 0.21, 0.17)
    ball(B, body, m.DARK, x_bar + 0.68, 0.0, 0.75, 0.22, 0.22, 0.25)


@njit(cache=True, nogil=True)
def _ring(B, body, x, r, thickness):  # type: ignore[no-untyped-def]
    for j in range(10):
        a0, a1 = 2.0 * math.pi * j / 10, 2.0 * math.pi * (j + 1) / 10
        p = (x + r * math.cos(a0), 0.0, r + r * math.sin(a0))
        q = (x + r * math.cos(a1), 0.0, r + r * math.sin(a1))
        limb(B, body, m.DARK, p, q, thickness, thickness, 4)


@njit(cache=True, nogil=True)
def cyclist(B, body, P):  # type: ignore[no-untyped-def]
    """A person on a bicycle, or on a motor scooter if GLOSS is over 0.5."""
    if P[m.GLOSS] > 0.5:
        for x in (-0.62, 0.62):
            wheel(B, body, m.WHEEL, x, 0.06, 1.0, 0.3, 0.12)
            wheel(B, body, m.WHEEL, x, -0.06, -1.0, 0.3, 0.12)
        ball(B, body, m.PLAIN, -0.3, 0.0, 0.62, 0.5, 0.17, 0.24)
        ball(B, body, m.PLAIN, 0.42, 0.0, 0.7, 0.25, 0.2, 0.36)
        limb(B, body, m.METAL, (0.62, 0.0, 0.3), (0.4, 0.0, 1.05), 0.05, 0.05, 5)
        person(B, body, P, 0.86, 0.12, True, True)
        return
    for x in (-0.52, 0.52):
        _ring(B, body, x, 0.34, 0.022)
    hub, seat, bar, pedals = (-0.52, 0.0, 0.34), (-0.18, 0.0, 0.88), (0.36, 0.0, 0.98), (-0.06, 0.0, 0.3)
    limb(B, body, m.PLAIN, hub, seat, 0.02, 0.02, 4)
    limb(B, body, m.PLAIN, seat, (0.36, 0.0, 0.8), 0.025, 0.025, 4)
    limb(B, body, m.PLAIN, pedals, (0.36, 0.0, 0.78), 0.025, 0.025, 4)
    limb(B, body, m.PLAIN, pedals, seat, 0.025, 0.025, 4)
    limb(B, body, m.PLAIN, hub, pedals, 0.02, 0.02, 4)
    limb(B, body, m.METAL, (0.52, 0.0, 0.34), bar, 0.022, 0.022, 4)
    limb(B, body, m.DARK, (0.34, -0.27, 1.0), (0.34, 0.27, 1.0), 0.018, 0.018, 4)
    person(B, body, P, 0.95, 0.2, True, True)
