"""Meshes of trucks: cab, chassis with attachments, and load. Compiled by numba."""

from __future__ import annotations

from numba import njit

from birdslam.world.rendering import materials as m
from birdslam.world.rendering.shapes.bodies import TRACK_RATIO, loft
from birdslam.world.rendering.shapes.solids import box, limb, wheel


@njit(cache=True, nogil=True)
def _side(B, body, P, s, x0, x1):  # type: ignore[no-untyped-def]
    """The side between the axles of a truck without a skirt: two bars, and a fuel tank or a toolbox behind the cab."""
    y, z0 = 0.5 * P[m.WIDTH], P[m.CARGO_Z0]
    for bar in range(2):
        z = 0.5 + 0.5 * bar * (z0 - 0.55)
        box(
            B,
            body,
            m.METAL,
            x0,
            x1 - 1.6,
            min(0.93 * s * y, 0.97 * s * y),
            max(0.93 * s * y, 0.97 * s * y),
            z,
            z + 0.12,
        )
    inner, outer = min(0.5 * s * y, 0.95 * s * y), max(0.5 * s * y, 0.95 * s * y)
    if P[m.RIM] > 0.4:
        limb(
            B,
            body,
            m.METAL,
            (x1 - 0.1, 0.7 * s * y, 0.5 * z0 + 0.1),
            (x1 - 1.5, 0.7 * s * y, 0.5 * z0 + 0.1),
            0.3,
            0.3,
            10,
        )
    else:
        box(B, body, m.DARK, x1 - 1.5, x1 - 0.1, inner, outer, 0.35, z0 - 0.05)


@njit(cache=True, nogil=True)
def _load(B, body, P):  # type: ignore[no-untyped-def]
    """The load: a tank, a flat bed with its load, a mixer, or a box."""
    y, x0, x1 = 0.5 * P[m.WIDTH], P[m.CARGO_X0], P[m.CARGO_X1]
    z0, z1 = P[m.CARGO_Z0], P[m.HEIGHT]
    kind = int(P[m.CARGO_KIND])
    if kind == 2:  # a tank
        mid, radius = 0.5 * (z0 + z1), 0.5 * (z1 - z0)
        limb(B, body, m.CARGO, (x1, 0.0, mid), (x0 + 0.3, 0.0, mid), min(radius, 0.98 * y), min(radius, 0.98 * y), 14)
        limb(B, body, m.CARGO, (x0 + 0.3, 0.0, mid), (x0, 0.0, mid), min(radius, 0.98 * y), 0.75 * radius, 14)
        box(B, body, m.DARK, x0, x1, -0.6 * y, 0.6 * y, z0 - 0.2, mid - 0.6 * radius)
        for side in range(2):  # a ladder, a hose, a rail along the top
            s = 1.0 - 2.0 * side
            limb(B, body, m.METAL, (x0 - 0.04, 0.2 * s, 0.6), (x0 - 0.02, 0.2 * s, z1), 0.03, 0.03, 4)
            limb(B, body, m.DARK, (x1 - 1.0, 0.9 * s * y, z0), (x0 + 1.0, 0.9 * s * y, z0), 0.1, 0.1, 6)
            limb(B, body, m.METAL, (x1 - 0.6, 0.3 * s, z1), (x0 + 0.9, 0.3 * s, z1), 0.03, 0.03, 4)
    elif kind == 4:  # a flat bed and its load
        box(B, body, m.CARGO, x0, x1, -y, y, z0 - 0.1, z0 + 0.45)
        box(B, body, m.PLAIN, x0 + 0.6, 0.5 * (x0 + x1), -0.7 * y, 0.7 * y, z0, z0 + 0.6 * (z1 - z0))
    elif kind == 5:  # a mixer
        limb(B, body, m.CARGO, (x1 - 0.3, 0.0, z0 + 0.9), (0.5 * (x0 + x1), 0.0, z0 + 1.1), 0.6, 0.97 * y, 12)
        limb(B, body, m.CARGO, (0.5 * (x0 + x1), 0.0, z0 + 1.1), (x0 + 0.2, 0.0, z1 - 0.5), 0.97 * y, 0.45, 12)
        box(B, body, m.DARK, x0, x1, -0.5 * y, 0.5 * y, z0 - 0.2, z0 + 0.4)
    else:
        box(B, body, m.CARGO, x0, x1, -y, y, z0, z1)


@njit(cache=True, nogil=True)
def truck(B, body, P):  # type: ignore[no-untyped-def]
    """A truck: cab, chassis with wheels, and load."""
    loft(B, body, P)
    y, r, x0, z0 = 0.5 * P[m.WIDTH], P[m.WHEEL_RADIUS], P[m.CARGO_X0], P[m.CARGO_Z0]
    box(B, body, m.DARK, x0 + 0.15, P[m.LOFT_X0] + 0.4, -0.45, 0.45, 0.55, z0)
    box(B, body, m.CARGO, x0 + 0.02, x0 + 0.08, -0.95 * y, 0.95 * y, 0.5, 0.75)  # bumper with lamps and plate
    axles = 3 if P[m.LENGTH] > 12.0 else (2 if P[m.LENGTH] > 8.5 else 1)
    skirt0, skirt1 = x0 + 1.6 * r + 1.6, P[m.X_FRONT_AXLE] - 1.5 * r
    if P[m.SEED] < 0.5:
        box(B, body, m.DARK, skirt0, skirt1, -0.9 * y, 0.9 * y, 0.45, z0 - 0.05)
    for side in range(2):
        s = 1.0 - 2.0 * side
        wheel(B, body, m.WHEEL, P[m.X_FRONT_AXLE], s * TRACK_RATIO * y, s, r, 0.3)
        if P[m.LENGTH] > 12.0:
            wheel(B, body, m.WHEEL, P[m.LOFT_X0] - 0.6, s * y, s, r, 0.5)
        for axle in range(axles):
            wheel(B, body, m.WHEEL, P[m.X_REAR_AXLE] + axle * 2.3 * r, s * y, s, r, 0.5)
        if P[m.SEED] >= 0.5:
            _side(B, body, P, s, skirt0, skirt1)
        if z0 > 2.0 * r and P[m.GLOSS] > 0.4:  # mudguards
            edge0, edge1 = P[m.X_REAR_AXLE] - 1.1 * r, P[m.X_REAR_AXLE] + (2.3 * (axles - 1) + 1.1) * r
            box(
                B,
                body,
                m.DARK,
                edge0,
                edge1,
                min(0.6 * s * y, s * y),
                max(0.6 * s * y, s * y),
                2.02 * r,
                2.02 * r + 0.06,
            )
        limb(
            B,
            body,
            m.DARK,
            (P[m.LOFT_X1] - 0.4, s * 0.9 * y, z0 + 1.0),
            (P[m.LOFT_X1] - 0.3, s * (y + 0.12), z0 + 1.3),
            0.1,
            0.12,
            5,
        )
    _load(B, body, P)
