"""Procedural textures of facades, roofs, leaves, plates and other vertical surfaces. Compiled by numba."""

from __future__ import annotations

import math

from birdslam.world.rendering import materials as m
from birdslam.world.rendering.compiled import per_pixel
from birdslam.world.rendering.light import hashed, noise


@per_pixel
def _roof(P, bank, u, v, foot):  # type: ignore[no-untyped-def]
    """(r, g, b, mirror) of tiles in rows."""
    t = foot * 256.0
    f = min(max(1.6 - foot / 0.1, 0.0), 1.0)
    row = math.floor(v / 0.3)
    tile = (
        1.0
        + f * 0.2 * (hashed(math.floor(u / 0.25 + 0.5 * (row % 2.0)), row) - 0.5)
        - f * 0.25 * ((v / 0.3) % 1.0 < 0.15)
    )
    k = tile * (1.0 + 0.15 * noise(bank, 0, u * 0.05, v * 0.05 + P[m.SEED], t * 0.05))
    return P[14] * k, P[15] * k, P[16] * k, 0.0


@per_pixel
def _wall(P, bank, u, v, face, foot):  # type: ignore[no-untyped-def]
    """(r, g, b) of a wall without windows: plaster, brick or stone, stained, perhaps over a plinth."""
    t = foot * 256.0
    r, g, b = P[m.RED], P[m.GREEN], P[m.BLUE]
    stain = 1.0 + 0.07 * noise(bank, 0, u * 0.06 + P[m.SEED] * 7.0, v * 0.06 + face, t * 0.06)
    stain *= 1.0 + 0.05 * noise(bank, 1, u * 0.4, v * 0.4, t * 0.4) - 0.1 * max(0.0, 0.6 - v)
    style = int(P[13])
    f = min(max(1.6 - foot / 0.03, 0.0), 1.0)
    if style == 1:  # brick
        row = math.floor(v / 0.08)
        i = math.floor(u / 0.25 + 0.5 * (row % 2.0))
        mortar = (v / 0.08) % 1.0 < 0.15 or (u / 0.25 + 0.5 * (row % 2.0)) % 1.0 < 0.06
        stain *= 1.0 + f * (0.35 * (hashed(i, row) - 0.5) + 0.5 * mortar)
    elif style == 4:  # stone
        row = math.floor(v / 0.4)
        i = math.floor(u / 0.8 + 0.5 * (row % 2.0))
        stain *= 1.0 + 0.16 * (hashed(i, row + 3.0) - 0.5) - 0.3 * f * ((v / 0.4) % 1.0 < 0.05)
    r, g, b = r * stain, g * stain, b * stain
    if v < 0.5 and P[m.SEED] > 0.5:
        r, g, b = 0.6 * r, 0.6 * g, 0.6 * b  # a plinth
    return r, g, b


@per_pixel
def _ground_floor(P, bank, pictures, u, v, foot, r, g, b):  # type: ignore[no-untyped-def]
    """(r, g, b, mirror) of shop windows under a sign, or of garage doors, in the wall (r, g, b)."""
    t = foot * 256.0
    f = min(max(1.6 - foot / 0.03, 0.0), 1.0)
    i = math.floor(u / 3.4)
    w = u - 3.4 * i
    if P[18] < 1.5:
        if 2.5 < v < 3.0:
            p = pictures[int(16.0 * hashed(P[m.SEED], i * 0.1)) % 16, 32, int(w / 3.4 * 63.0)]
            return p[0], p[1], p[2], 0.02
        if 0.4 < v < 2.4 and 0.2 < w < 3.2:
            inside = 0.03 + 0.12 * max(0.0, noise(bank, 0, u * 0.21, v * 0.3 + P[m.SEED], t * 0.2))
            return inside, inside, 0.9 * inside, 0.08
    elif 0.05 < v < 2.2 and 0.35 < w < 3.05 and hashed(i, P[m.SEED] * 3.0) > 0.35:
        groove = (v / 0.28) % 1.0 < 0.1
        k = (0.2 + 0.6 * hashed(P[m.SEED] + 2.0, i)) * (1.0 - 0.4 * f * groove)
        return k, k, 0.97 * k, 0.01
    return r, g, b, 0.0


@per_pixel
def _windows(P, u, v, face, long, storey, r, g, b):  # type: ignore[no-untyped-def]
    """(r, g, b, mirror) of doors and of windows with frames, sills and shutters, in the wall (r, g, b)."""
    zv = v - storey * P[9]
    i = math.floor(u / P[10])
    w = u - i * P[10] - 0.5 * P[10]
    sill = 0.32 * P[9]
    if (i + 1.0) * P[10] > long or v > P[m.HEIGHT] - 0.25:
        return r, g, b, 0.0
    if int(P[13]) == 3:  # glass all over
        if abs(w) > 0.5 * P[10] - 0.06 or zv < 0.25:
            return 0.1, 0.1, 0.11, 0.03
        return 0.02, 0.024, 0.026, 0.12
    if storey == 0.0 and hashed(i, P[m.SEED]) > 0.82 and v < 2.1 and abs(w) < 0.5:
        k = 0.05 + 0.3 * hashed(P[m.SEED], 5.0)
        return k, 0.7 * k, 0.5 * k, 0.02  # a door
    half, tall = 0.5 * P[11], P[12]
    if abs(w) < half and sill < zv < sill + tall:
        if abs(w) > half - 0.07 or zv < sill + 0.07 or zv > sill + tall - 0.07 or abs(w) < 0.025:
            k = 0.75 if P[m.SEED] > 0.3 else 0.08
            return k, k, k, 0.0  # frame
        closed = hashed(i + 11.0 * storey, P[m.SEED] * 5.0 + face)
        if closed > 0.86:
            k = 0.35 + 0.4 * hashed(P[m.SEED], 8.0)
            return k, k, 0.95 * k, 0.0  # blinds
        k = 0.012 + (0.2 if closed > 0.6 and abs(w) > 0.5 * half else 0.02 * closed)
        return k, k, k, 0.1
    if P[19] > 0.5 and half < abs(w) < half + 0.45 * half and sill < zv < sill + tall:
        k = 0.1 + 0.3 * hashed(P[m.SEED], 4.0)
        return 0.5 * k, k, 0.6 * k, 0.0  # shutters
    if abs(w) < half + 0.1 and sill - 0.08 < zv < sill:
        return 0.45, 0.45, 0.44, 0.0
    return r, g, b, 0.0


@per_pixel
def facade(P, bank, pictures, u, v, face, foot):  # type: ignore[no-untyped-def]
    """(r, g, b, mirror) of a house: its roof, or its wall with windows and doors."""
    if face < 4.0:
        v -= 1.0  # walls start 1 m below the ground
    if face >= 4.0 and face != 6.0:
        return _roof(P, bank, u, v, foot)
    r, g, b = _wall(P, bank, u, v, face, foot)
    if face == 6.0:
        return r, g, b, 0.0
    long = P[m.LENGTH] if face in (1.0, 3.0) else P[m.WIDTH]
    storey = math.floor(v / P[9])
    if P[20] >= 0.0 and face in (1.0, 3.0):  # wall art or a poster
        i, j = int((u - 0.25 * long) / 4.0 * 64.0), int((1.0 - (v - 1.0) / 3.0) * 64.0)
        if 0 <= i < 64 and 0 <= j < 64:
            p = pictures[int(P[20]) % 16, j, i]
            return p[0], p[1], p[2], 0.0
    if face in (0.0, 2.0) and P[m.SEED] < 0.4:
        return r, g, b, 0.0  # a blind gable
    if storey == 0.0 and P[18] > 0.5:
        return _ground_floor(P, bank, pictures, u, v, foot, r, g, b)
    return _windows(P, u, v, face, long, storey, r, g, b)


@per_pixel
def leaves(P, masks, u, v, mask):  # type: ignore[no-untyped-def]
    """(r, g, b) of leaves at (u, v) of a mask, with light by height in the crown."""
    i = min(max(int(u * masks.shape[2]), 0), masks.shape[2] - 1)
    j = min(max(int(v * masks.shape[1]), 0), masks.shape[1] - 1)
    k = masks[int(mask), j, i] / 255.0
    k = 0.25 + 1.5 * k * k
    return P[m.RED] * k, P[m.GREEN] * k, P[m.BLUE] * k


@per_pixel
def panel(P, pictures, u, v, face):  # type: ignore[no-untyped-def]
    """(r, g, b, light): traffic signs, boards, lights. (u, v) in -1..1 on a sign."""
    if P[9] == 3.0 and P[10] > 0.9:
        p = pictures[
            int(P[m.PICTURE]) % 16, min(max(int((1.0 - v) * 31.5), 0), 63), min(max(int((u + 1.0) * 31.5), 0), 63)
        ]
        return p[0], p[1], p[2], 0.0
    q = math.sqrt(u * u + v * v)
    shape = int(P[9])
    if shape == 0:
        if P[m.SEED] < 0.5:
            if q > 0.75:
                return 0.55, 0.02, 0.03, 0.0
            ink = abs(u) < 0.4 and abs(v) < 0.4 and hashed(math.floor(u * 6.0) + P[m.SEED], math.floor(v * 4.0)) > 0.5
            return (0.02, 0.02, 0.02, 0.0) if ink else (0.75, 0.75, 0.75, 0.0)
        white = abs(v) < 0.15 or (P[m.SEED] > 0.75 and abs(u) < 0.15)
        return (0.75, 0.75, 0.75, 0.0) if white else (P[m.RED], P[m.GREEN], P[m.BLUE], 0.0)
    if shape == 1:
        up = v if P[m.SEED] > 0.3 else -v
        if 0.575 * (1.0 - up / 1.15) - abs(u) < 0.16 or up < -0.42:
            return 0.55, 0.02, 0.03, 0.0
        return 0.75, 0.75, 0.72, 0.0
    if max(abs(u), abs(v)) > 0.9:
        return 0.7, 0.7, 0.7, 0.0
    ink = abs(u) < 0.6 and abs(v) < 0.6 and hashed(math.floor(u * 5.0) + P[m.SEED], math.floor(v * 5.0)) > 0.55
    return (0.75, 0.75, 0.75, 0.0) if ink else (P[m.RED], P[m.GREEN], P[m.BLUE], 0.0)


@per_pixel
def traffic_light(P, u, v, face):  # type: ignore[no-untyped-def]
    """(r, g, b, light) of a signal's box: (u, v) in metres on its faces."""
    if face != 2.0 and face != 0.0:
        return 0.02, 0.02, 0.02, 0.0
    for k in range(3):
        if (u - 0.17) ** 2 + (v - 0.15 - 0.3 * k) ** 2 < 0.011:
            lit = 1.6 if int(3.0 * P[m.SEED]) == k else 0.02
            if k == 2:
                return 0.3 * lit, 0.02, 0.01, lit
            if k == 1:
                return 0.3 * lit, 0.2 * lit, 0.01, lit
            return 0.02, 0.3 * lit, 0.15 * lit, lit
    return 0.015, 0.015, 0.015, 0.0


@per_pixel
def plain(P, bank, pictures, material, u, v, face, foot):  # type: ignore[no-untyped-def]
    """(r, g, b, mirror) of the rest: bark, metal, fences, concrete, containers."""
    t = foot * 256.0
    r, g, b = P[m.RED], P[m.GREEN], P[m.BLUE]
    if material == m.BARK:
        k = 0.06 * (
            1.0 + 0.35 * noise(bank, 1, u * 0.3, v * 0.12, t * 0.3) + 0.2 * noise(bank, 0, u * 0.1, v * 0.2, t * 0.2)
        )
        return 1.15 * k, 0.95 * k, 0.75 * k, 0.0
    if material == m.DARK:
        return 0.015, 0.015, 0.016, 0.02
    if material == m.METAL:
        k = max(r, 0.04)
        return k, k, k, 0.05
    if material == m.CONCRETE:
        k = (
            1.0
            + 0.15 * noise(bank, 0, u * 0.07 + P[m.SEED], v * 0.07, t * 0.07)
            + 0.06 * noise(bank, 1, u * 0.5, v * 0.5, t * 0.5)
        )
        k *= 1.0 - 0.2 * ((u % 2.5) < 0.03)
        return r * k, g * k, b * k, 0.0
    if material == m.FENCE:
        if P[m.PICTURE] >= 0.0 and face in (1.0, 3.0) and 0.6 < v < P[m.HEIGHT] + 0.4:
            p = pictures[int(P[m.PICTURE]) % 16, int((P[m.HEIGHT] + 0.5 - v) * 40.0) % 64, int(u * 22.0) % 64]
            return 0.9 * p[0], 0.9 * p[1], 0.9 * p[2], 0.0
        k = (
            1.0
            + 0.1 * noise(bank, 0, u * 0.1 + P[m.SEED], v * 0.1, t * 0.1)
            + 0.06 * noise(bank, 1, u * 0.5, v * 0.5, t * 0.5)
        )
        if P[8] == 1.0:
            f = min(max(1.6 - foot / 0.05, 0.0), 1.0)
            k *= 1.0 + f * (0.25 * (hashed(math.floor(u / 0.14), P[m.SEED]) - 0.5) - 0.7 * ((u / 0.14) % 1.0 < 0.12))
        return r * k, g * k, b * k, 0.0
    if material == m.CONTAINER:
        f = min(max(1.6 - foot / 0.05, 0.0), 1.0)
        k = 1.0 + 0.25 * f * math.sin(u * 22.0) if P[8] == 0.0 else 1.0
        if P[m.SEED] > 0.5 and face in (1.0, 2.0, 3.0):
            i, j = int(u * 25.0), int((P[m.HEIGHT] - v) * 32.0)
            if 8 < i < 56 and 8 < j < 60:
                p = pictures[int(P[m.PICTURE]) % 16, j, i]
                return p[0], p[1], p[2], 0.02
        k *= 1.0 + 0.08 * noise(bank, 0, u * 0.1, v * 0.1 + P[m.SEED], t * 0.1)
        return r * k, g * k, b * k, 0.02
    return r, g, b, 0.02
