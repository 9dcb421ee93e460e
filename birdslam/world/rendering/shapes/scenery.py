"""Meshes of scenery: buildings, trees, hedges, posts, signs, fences, bridges. Compiled by numba."""

from __future__ import annotations

import math

from numba import njit

from birdslam.world.rendering import materials as m
from birdslam.world.rendering.shapes.solids import ball, begin, box, card, corner, gable, limb

# Slots of the parameters from 8 on, by kind:
# BUILDING 8 roof rise, 9 storey height, 10 window spacing, 11 window width, 12 window height, 13 style,
#          14-16 roof colour, 17 balconies, 18 ground floor (0 plain, 1 shop, 2 garage), 19 shutters,
#          20 picture or -1, 21 chimney
# TREE 8 trunk height, 9 cards, 10 crown width, 11 first mask, 12 kind (0 crown, 1 bush, 2 conifer), 13-15 view
#      direction
# POST 8 arm length, 9 lamps   SIGN 8 plate height, 9 shape (0 disc, 1 triangle, 2 square, 3 board), 10 plate width
# WALLING 8 kind (0 wall, 1 planks, 2 mesh, 3 guard rail)   CRATE 8 kind (0 container, 1 bin, 2 kiosk, 3 cabinet)


@njit(cache=True, nogil=True)
def _hash(a, b):  # type: ignore[no-untyped-def]
    """A pseudo-random number in [0, 1) from two numbers."""
    v = math.sin(a * 127.1 + b * 311.7) * 43758.5453
    return v - math.floor(v)


@njit(cache=True, nogil=True)
def building(B, body, P):  # type: ignore[no-untyped-def]
    """Walls on the ground, from 1 m below it (slopes), and a flat or a saddle roof."""
    hx, hy, h = 0.5 * P[m.LENGTH], 0.5 * P[m.WIDTH], P[m.HEIGHT]
    box(B, body, m.WALL, -hx, hx, -hy, hy, -1.0, h)
    if P[8] > 0.1:
        gable(B, body, m.WALL, -hx, hx, -hy, hy, h, P[8], 0.35)
        if P[21] > 0.5:
            box(B, body, m.CONCRETE, 0.3 * hx, 0.3 * hx + 0.6, 0.2 * hy, 0.2 * hy + 0.6, h, h + P[8] + 0.5)
        for j in range(int(P[17])):  # dormers
            x = hx * (-0.7 + 1.4 * (j + 0.5) / P[17])
            box(B, body, m.PLAIN, x - 0.7, x + 0.7, -hy + 0.5, 0.0, h, h + min(1.5, 0.75 * P[8]))
            box(B, body, m.PLAIN, x - 0.7, x + 0.7, 0.0, hy - 0.5, h, h + min(1.5, 0.75 * P[8]))
    elif P[17] > 0.5:  # balconies on both long sides
        storeys = int(h / P[9])
        for storey in range(1, storeys):
            for j in range(int(P[17])):
                x = hx * (-0.8 + 1.6 * (j + 0.5) / P[17])
                z = storey * P[9]
                box(B, body, m.CONCRETE, x - 1.4, x + 1.4, -hy - 1.1, -hy, z, z + 0.95)
                box(B, body, m.CONCRETE, x - 1.4, x + 1.4, hy, hy + 1.1, z, z + 0.95)


@njit(cache=True, nogil=True)
def tree(B, body, P):  # type: ignore[no-untyped-def]
    """A trunk with boughs under cards of leaves that face the camera."""
    trunk, width, h = P[8], P[10], P[m.HEIGHT]
    ux, uy = -P[14], P[13]
    if P[12] == 0.0:
        lean = 0.4 * (P[m.SEED] - 0.5)
        r = 0.035 * h * (0.5 + 0.6 * P[m.SEED])
        limb(B, body, m.BARK, (0.0, 0.0, -0.3), (lean, 0.0, trunk), r, 0.75 * r, 7)
        for j in range(4):
            a = 6.28 * _hash(P[m.SEED], j)
            reach = 0.3 * width
            tip = (lean + reach * math.cos(a), reach * math.sin(a), 0.55 * (trunk + h))
            limb(B, body, m.BARK, (lean, 0.0, trunk - 0.2), tip, 0.6 * r, 0.2 * r, 5)
    elif P[12] == 2.0:
        limb(B, body, m.BARK, (0.0, 0.0, -0.3), (0.0, 0.0, 0.5 * h), 0.02 * h, 0.01 * h, 5)
    cards = int(P[9])
    for j in range(cards):
        a, b = _hash(P[m.SEED] + 3.1, j), _hash(P[m.SEED] + 7.7, j)
        mask = P[12] + 3.0 * math.floor(8.0 * _hash(P[m.SEED], 20.0 + j))
        if P[12] == 2.0:
            card(B, body, m.FOLIAGE, 0.1 * P[13] * (j - 1), 0.1 * P[14] * (j - 1), 0.12 * h * j * (1.0 / cards), ux, uy,
                 width * (1.0 - 0.15 * j), h * (1.0 - 0.12 * j * (1.0 / cards)), mask)  # fmt: skip
        elif cards == 1:
            card(B, body, m.FOLIAGE, 0.0, 0.0, trunk, ux, uy, width, h - trunk, mask)
        else:
            size = 0.5 + 0.3 * _hash(P[m.SEED] + 1.3, j)
            turn = 6.28 * a
            reach = 0.32 * width * math.sqrt(b)
            z = trunk + (h - trunk) * (1.0 - size) * _hash(P[m.SEED] + 5.9, j)
            card(
                B,
                body,
                m.FOLIAGE,
                reach * math.cos(turn),
                reach * math.sin(turn),
                z,
                ux,
                uy,
                size * width,
                size * (h - trunk),
                mask,
            )


@njit(cache=True, nogil=True)
def hedge(B, body, P):  # type: ignore[no-untyped-def]
    """A row of bushes along x."""
    count = max(1, int(P[m.LENGTH] / (1.2 * P[m.HEIGHT])))
    for j in range(count):
        x = P[m.LENGTH] * ((j + 0.5) / count - 0.5)
        mask = 1.0 + 3.0 * math.floor(8.0 * _hash(P[m.SEED], j))
        card(
            B,
            body,
            m.FOLIAGE,
            x,
            0.25 * P[m.WIDTH],
            0.0,
            -P[14],
            P[13],
            1.9 * P[m.HEIGHT],
            P[m.HEIGHT] * (0.85 + 0.3 * _hash(P[m.SEED], 9.0 + j)),
            mask,
        )
        card(B, body, m.FOLIAGE, x, -0.25 * P[m.WIDTH], 0.0, 1.0, 0.0, 1.9 * P[m.HEIGHT], P[m.HEIGHT] * 0.9, mask)


@njit(cache=True, nogil=True)
def post(B, body, P):  # type: ignore[no-untyped-def]
    """A lamp post or a mast; the arm reaches to the left (+y)."""
    h, r = P[m.HEIGHT], P[m.WIDTH]
    limb(B, body, m.METAL, (0.0, 0.0, -0.2), (0.0, 0.0, h), r, 0.6 * r, 6)
    if P[8] > 0.0:
        limb(B, body, m.METAL, (0.0, 0.0, h), (0.0, P[8], h + 0.3), 0.6 * r, 0.5 * r, 5)
        box(B, body, m.METAL, -0.15, 0.15, P[8] - 0.2, P[8] + 0.5, h + 0.2, h + 0.35)
    elif P[9] > 0.5:
        ball(B, body, m.PLAIN, 0.0, 0.0, h, 0.25, 0.25, 0.25)


@njit(cache=True, nogil=True)
def sign(B, body, P):  # type: ignore[no-untyped-def]
    """A plate on a post, seen from its rear side (-x)."""
    h, w = P[8], 0.5 * P[10]
    limb(B, body, m.METAL, (0.04, 0.0, -0.2), (0.04, 0.0, h), 0.035, 0.035, 5)
    corners = 12 if P[9] == 0.0 else (3 if P[9] == 1.0 else 4)
    k = begin(B, body, m.PANEL, corners)
    for j in range(corners if k >= 0 else 0):
        for c in range(3):
            a = 2.0 * math.pi * (j + c + 0.5) / corners
            if corners == 3:
                a = 2.0 * math.pi * (j + c) / 3.0 + (0.5 if P[m.SEED] > 0.3 else -0.5) * math.pi
            reach = 1.4142 if corners == 4 else 1.15
            u, v = (reach * math.cos(a), reach * math.sin(a)) if c < 2 else (0.0, 0.0)
            z = h - w + w * v * (1.0 if P[9] < 3.0 else 0.6)
            corner(B, k + j, c, 0.0, -w * u, z, u, v, 0.0, -1.0, 0.0, 0.0)
    if P[9] == 3.0:
        limb(B, body, m.METAL, (0.04, 0.8 * w, -0.2), (0.04, 0.8 * w, h), 0.05, 0.05, 5)


@njit(cache=True, nogil=True)
def lights(B, body, P):  # type: ignore[no-untyped-def]
    """Traffic lights on a post, perhaps with an arm over the road."""
    limb(B, body, m.METAL, (0.0, 0.0, -0.2), (0.0, 0.0, P[8]), 0.07, 0.06, 6)
    box(B, body, m.PANEL, -0.15, 0.1, -0.17, 0.17, P[8] - 0.9, P[8])
    if P[9] > 0.5:
        limb(B, body, m.METAL, (0.0, 0.0, P[8]), (0.0, P[9], P[8] + 0.6), 0.07, 0.05, 6)
        box(B, body, m.PANEL, -0.15, 0.1, P[9] - 0.17, P[9] + 0.17, P[8] - 0.3, P[8] + 0.6)


@njit(cache=True, nogil=True)
def crate(B, body, P):  # type: ignore[no-untyped-def]
    """Containers, bins, kiosks, cabinets: boxes that are not cars."""
    hx, hy, h = 0.5 * P[m.LENGTH], 0.5 * P[m.WIDTH], P[m.HEIGHT]
    if P[8] == 1.0:
        box(B, body, m.PLAIN, -hx, hx, -hy, hy, 0.08, 0.9 * h)
        box(B, body, m.DARK, -hx - 0.03, hx + 0.03, -hy - 0.03, hy + 0.03, 0.9 * h, h)
    else:
        box(B, body, m.CONTAINER, -hx, hx, -hy, hy, 0.0, h)


@njit(cache=True, nogil=True)
def walling(B, body, P):  # type: ignore[no-untyped-def]
    """A wall, fence or guard rail along x."""
    hx, h = 0.5 * P[m.LENGTH], P[m.HEIGHT]
    if P[8] == 3.0:
        box(B, body, m.METAL, -hx, hx, -0.04, 0.04, h - 0.3, h)
        for j in range(int(P[m.LENGTH] / 2.0)):
            limb(B, body, m.METAL, (-hx + 2.0 * j, 0.06, -0.1), (-hx + 2.0 * j, 0.06, h - 0.1), 0.05, 0.05, 4)
    elif P[8] == 2.0:
        for j in range(int(P[m.LENGTH] / 2.5) + 1):
            limb(B, body, m.METAL, (-hx + 2.5 * j, 0.0, -0.1), (-hx + 2.5 * j, 0.0, h), 0.03, 0.03, 4)
        box(B, body, m.METAL, -hx, hx, -0.015, 0.015, h - 0.06, h)
        box(B, body, m.METAL, -hx, hx, -0.015, 0.015, 0.5 * h, 0.5 * h + 0.04)
    else:
        box(B, body, m.FENCE, -hx, hx, -0.12, 0.12, -0.5, h)


@njit(cache=True, nogil=True)
def bridge(B, body, P):  # type: ignore[no-untyped-def]
    """A deck across the road (along y) on piers, its underside at HEIGHT."""
    hx, hy, h = 0.5 * P[m.LENGTH], 0.5 * P[m.WIDTH], P[m.HEIGHT]
    box(B, body, m.CONCRETE, -hx, hx, -hy, hy, h, h + P[8])
    box(B, body, m.METAL, -hx, -hx + 0.1, -hy, hy, h + P[8], h + P[8] + 1.0)
    box(B, body, m.METAL, hx - 0.1, hx, -hy, hy, h + P[8], h + P[8] + 1.0)
    for side in range(2):
        s = 1.0 - 2.0 * side
        y = s * P[9]
        box(B, body, m.CONCRETE, -0.7 * hx, 0.7 * hx, min(y, y + s * 0.9), max(y, y + s * 0.9), -1.0, h)
        box(B, body, m.CONCRETE, -hx, hx, min(s * (P[9] + 9.0), s * hy), max(s * (P[9] + 9.0), s * hy), -1.0, h)
