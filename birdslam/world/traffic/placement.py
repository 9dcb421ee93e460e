"""Places scenery along a street: houses, trees, hedges, posts, signs, bridges, and boxes that resemble vehicles."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from birdslam.geometry.arrays import Floats32
from birdslam.world.rendering import materials as m
from birdslam.world.street.street import Street

_WALLS = np.array(
    [(0.62, 0.58, 0.5), (0.72, 0.7, 0.66), (0.5, 0.42, 0.3), (0.45, 0.45, 0.45), (0.3, 0.12, 0.08), (0.55, 0.35, 0.22),
     (0.65, 0.6, 0.35), (0.4, 0.3, 0.22), (0.8, 0.79, 0.77), (0.22, 0.22, 0.24), (0.35, 0.42, 0.5), (0.5, 0.3, 0.3)]
)  # fmt: skip
_ROOFS = np.array([(0.2, 0.07, 0.04), (0.06, 0.055, 0.055), (0.13, 0.09, 0.07), (0.28, 0.11, 0.06)])


@dataclass
class Scenery:
    """Static objects, row by row: kind, (s, d) on the street, rotation relative to the street, parameters."""

    kind: list[int]
    s_m: list[float]
    d_m: list[float]
    turn_rad: list[float]
    parameters: list[Floats32]

    def add(self, kind: int, s_m: float, d_m: float, turn_rad: float, size: tuple[float, float, float]) -> Floats32:
        """Adds an object; returns its parameters for further changes."""
        P = np.zeros(m.SLOTS, np.float32)
        P[m.LENGTH], P[m.WIDTH], P[m.HEIGHT] = size
        self.kind.append(kind)
        self.s_m.append(s_m)
        self.d_m.append(d_m)
        self.turn_rad.append(turn_rad)
        self.parameters.append(P)
        return P


def furnish(rng: np.random.Generator, street: Street, s0_m: float, s1_m: float) -> Scenery:
    """All scenery between s0 and s1, on both sides and in the background."""
    out = Scenery([], [], [], [], [])
    for sign, front in ((-1.0, street.front_right_m), (1.0, street.front_left_m)):
        _houses(rng, street, out, sign, front, s0_m, s1_m)
        _roadside(rng, street, out, sign, front, s0_m, s1_m)
        background(rng, street, out, sign, front, s0_m, s1_m)
    _over_the_road(rng, street, out, s0_m, s1_m)
    for s, half, left, right, *_ in street.crossings.tolist():
        if s0_m < s < s1_m:
            _corner(rng, street, out, s, half, left, right)
    return out


def _free(street: Street, s: float, d: float, reach_m: float) -> bool:
    """Whether (s, d) is neither on a crossing nor inside a sharp bend."""
    side = 1 if d > 0 else -1
    return not street.in_crossing(s, reach_m + 2.0, side) and street.curvature(s) * d < 0.7


def tree(rng: np.random.Generator, out: Scenery, s: float, d: float, h: float, kind: int, cards: int) -> None:
    u = rng.random(4)
    width = h * ((0.55 + 0.5 * u[0]) if kind == 0 else ((0.9 + u[0]) if kind == 1 else (0.3 + 0.2 * u[0])))
    P = out.add(m.TREE, s, d, 0.0, (width, width, h))
    P[8] = h * (0.18 + 0.22 * u[1]) if kind == 0 else 0.0
    P[9], P[10], P[12], P[m.SEED] = cards, width, kind, u[2]
    tint = 0.6 + 0.8 * u[3]
    P[:3] = np.array([0.05, 0.085, 0.025]) * tint * rng.uniform(0.75, 1.3, 3)
    if rng.random() < 0.06:
        P[:3] = np.array([0.2, 0.1, 0.03]) * tint  # autumn


def _houses(
    rng: np.random.Generator, street: Street, out: Scenery, sign: float, front: float, s0: float, s1: float
) -> None:
    setback = float(rng.choice([0.0, rng.uniform(1.0, 4.0), rng.uniform(4.0, 14.0)], p=[0.3, 0.4, 0.3]))
    row = rng.random() < 0.4  # wall to wall
    storeys = int(rng.choice([1, 2, 3, 4, 6, 9], p=[0.15, 0.35, 0.25, 0.15, 0.07, 0.03]))
    garden = int(rng.choice(5)) if setback > 1.0 else 0
    s = s0
    while s < s1:
        long = float(rng.uniform(14, 45) if street.kind == "industrial" else rng.uniform(8, 24))
        deep = float(rng.uniform(8, 14))
        mid = s + 0.5 * long
        d = front + sign * (setback + 0.5 * deep + 0.1)
        if rng.random() < street.built and _free(street, mid, d + sign * 0.5 * deep, 0.5 * long):
            u = rng.random(16)
            floor = 2.6 + 0.8 * u[0]
            levels = max(1, storeys + int(rng.integers(-1, 2)))
            P = out.add(m.BUILDING, mid, d, 0.0 if u[1] < 0.8 else math.pi / 2, (long, deep, levels * floor + 0.4))
            if u[1] >= 0.8:
                P[m.LENGTH], P[m.WIDTH] = deep, min(long, 1.6 * deep)
            P[:3] = _WALLS[int(12 * u[2])] * rng.uniform(0.8, 1.15, 3)
            P[8] = 0.0 if u[3] < (0.3 if levels < 4 else 0.7) else 0.5 * float(P[m.WIDTH]) * (0.4 + 0.7 * u[4])
            P[9], P[10] = floor, 1.6 + 2.4 * u[5]
            P[11], P[12] = float(P[10]) * (0.35 + 0.45 * u[6]), floor * (0.35 + 0.25 * u[7])
            P[13] = int(rng.choice(5, p=[0.45, 0.2, 0.1, 0.1, 0.15]))  # plaster, brick, panels, glass, stone
            P[14:17] = _ROOFS[int(4 * u[8])] * (0.6 + 0.8 * u[9])
            P[17] = int(rng.integers(0, 4)) if u[10] < 0.35 else 0.0
            P[18] = int(rng.choice(3, p=[0.6, 0.25, 0.15]))
            P[19], P[20], P[21] = float(u[11] < 0.3), (int(16 * u[12]) if u[13] < 0.12 else -1), float(u[14] < 0.5)
            P[m.SEED] = u[15]
        if garden and setback > 1.0 and _free(street, mid, front, 0.5 * long):
            _garden(rng, out, mid, front + sign * 0.3, long, garden, setback, sign)
        s += long + (0.0 if row else float(rng.uniform(1.0, 12.0)))


def _garden(
    rng: np.random.Generator, out: Scenery, s: float, d: float, long: float, kind: int, setback: float, sign: float
) -> None:
    if kind == 1:
        h = float(rng.uniform(0.7, 2.0))
        P = out.add(m.HEDGE, s, d + sign * 0.4, 0.0, (long * 0.8, 0.8, h))
        P[:3] = np.array([0.045, 0.075, 0.025]) * rng.uniform(0.5, 1.5)
        P[m.SEED] = rng.random()
    elif kind in (2, 3):
        h = float(rng.uniform(0.5, 2.0))
        P = out.add(m.WALLING, s, d, 0.0, (long * 0.85, 0.2, h))
        P[8] = int(rng.choice([0, 1, 2]))
        P[:3] = _WALLS[int(rng.integers(0, 12))] * rng.uniform(0.4, 1.1)
        P[m.SEED], P[m.PICTURE] = rng.random(), rng.integers(0, 16) if rng.random() < 0.15 else -1
    for _ in range(int(rng.integers(0, 4))):
        tree(rng, out, s + rng.uniform(-0.5, 0.5) * long, d + sign * rng.uniform(0.3, 1.0) * min(setback, 4.0),
              float(rng.uniform(0.7, 2.8)), 1, 1)  # fmt: skip


def _roadside(
    rng: np.random.Generator, street: Street, out: Scenery, sign: float, front: float, s0: float, s1: float
) -> None:
    edge = street.left_m if sign > 0 else street.right_m
    wide = abs(front - edge)
    at = edge + sign * min(0.9, 0.4 * wide + 0.2)
    if rng.random() < street.green * 0.8:  # a row of trees
        gap, h = float(rng.uniform(7, 20)), float(rng.uniform(4, 14))
        d = at if wide > 1.5 else front + sign * 1.0
        for s in np.arange(s0 + rng.uniform(0, gap), s1, gap):
            if rng.random() < 0.85 and _free(street, s, d, 2.0):
                tree(rng, out, float(s), d, h * float(rng.uniform(0.75, 1.25)), 0, int(rng.integers(5, 10)))
    gap = float(rng.uniform(18, 40))
    arm = float(rng.choice([0.0, rng.uniform(0.8, 2.5)]))
    high, grey = float(rng.uniform(3.5, 9)), float(rng.uniform(0.03, 0.4))
    for s in np.arange(s0 + rng.uniform(0, gap), s1, gap):
        if _free(street, s, at, 1.0):
            P = out.add(m.POST, float(s), at, 0.0 if sign < 0 else math.pi, (0.2, float(rng.uniform(0.05, 0.11)), high))
            P[8], P[9], P[:3] = arm, 1.0, grey
    for s in np.arange(s0 + rng.uniform(0, 20), s1, float(rng.uniform(12, 60))):
        d = edge + sign * float(rng.uniform(0.4, max(0.5, min(2.5, wide))))
        if not _free(street, s, d, 0.5):
            continue
        u = rng.random(6)
        if u[0] < 0.55:
            back = u[1] < 0.3
            P = out.add(m.SIGN, float(s), d, (math.pi if back else 0.0) + 0.2 * (u[2] - 0.5), (0.1, 0.7, 3.0))
            P[8], P[9] = 2.0 + 1.2 * u[3], int(rng.choice(4, p=[0.3, 0.2, 0.35, 0.15]))
            P[10] = (0.45 + 0.4 * u[4]) if P[9] < 3 else 1.0 + 3.0 * u[4]
            P[:3], P[m.SEED], P[m.PICTURE] = rng.uniform(0.02, 0.7, 3), u[5], rng.integers(0, 16)
        elif u[0] < 0.9:
            kind = int(rng.choice([0, 1, 2, 3], p=[0.15, 0.4, 0.15, 0.3]))
            size = ((4.0, 2.2, 2.3), (0.6, 0.6, 1.0), (2.5, 2.0, 2.5), (0.9, 0.4, 1.2))[kind]
            scale = float(rng.uniform(0.8, 1.4))
            far = d if kind in (1, 3) else front + sign * (1.3 + size[1])
            P = out.add(m.CRATE, float(s), far, 0.1 * (u[1] - 0.5), (size[0] * scale, size[1] * scale, size[2] * scale))
            P[8], P[:3], P[m.SEED], P[m.PICTURE] = kind, rng.uniform(0.02, 0.6, 3), u[2], rng.integers(0, 16)
        else:
            for j in range(int(rng.integers(2, 7))):  # bollards
                P = out.add(m.POST, float(s) + 1.5 * j, edge + sign * 0.4, 0.0, (0.1, 0.06, 0.9))
                P[:3] = rng.choice([0.04, 0.3, 0.6])
    if street.kind == "motorway" and rng.random() < 0.8:
        h = float(rng.choice([0.8, rng.uniform(2.0, 5.0)], p=[0.7, 0.3]))
        for s in np.arange(s0, s1, 12.0):
            P = out.add(m.WALLING, float(s) + 6.0, edge + sign * 0.8, 0.0, (12.0, 0.2, h))
            P[8], P[:3], P[m.PICTURE] = (3.0 if h < 1.0 else 0.0), rng.uniform(0.25, 0.4), -1


def background(
    rng: np.random.Generator, street: Street, out: Scenery, sign: float, front: float, s0: float, s1: float
) -> None:
    """Distant trees and blocks, so that streets do not end in an empty sky."""
    d = abs(front) + 18.0
    wood = rng.random() < 0.5
    kind = 0 if rng.random() < 0.7 else 2
    for s in np.arange(s0, s1 + 60.0, float(rng.uniform(8, 22))):
        dd = sign * (d + float(rng.uniform(0, 30)))
        if abs(dd * street.curvature(float(s))) > 0.6:
            continue
        if wood or rng.random() < 0.5:
            tree(
                rng,
                out,
                float(s),
                dd,
                float(rng.uniform(6, 18)),
                kind if rng.random() < 0.8 else 2,
                int(rng.integers(2, 5)),
            )
        elif not street.in_crossing(float(s), 9.0):
            u = rng.random(8)
            P = out.add(m.BUILDING, float(s), dd, 0.0, (14.0, 12.0, 5.0 + 18.0 * u[0]))
            P[:3], P[8] = _WALLS[int(12 * u[1])], 0.0 if u[2] < 0.5 else 3.0
            P[9:13] = 2.9, 2.4, 1.2, 1.4
            P[14:17], P[20], P[m.SEED] = _ROOFS[int(4 * u[3])], -1, u[4]


def _over_the_road(rng: np.random.Generator, street: Street, out: Scenery, s0: float, s1: float) -> None:
    if rng.random() < (0.35 if street.kind in ("motorway", "avenue") else 0.06):
        reach = max(abs(street.left_m), abs(street.right_m)) + 1.5
        P = out.add(
            m.BRIDGE,
            float(rng.uniform(s0 + 25, s1)),
            0.0,
            float(rng.normal(0, 0.15)),
            (rng.uniform(4, 14), 160.0, rng.uniform(4.6, 6.5)),
        )
        P[8], P[9], P[:3] = rng.uniform(0.8, 1.8), reach, rng.uniform(0.2, 0.5)
    if rng.random() < 0.15:  # a board on a gantry
        s = float(rng.uniform(s0 + 30, s1))
        P = out.add(m.SIGN, s, street.right_m - 0.8, 0.0, (0.1, 3.0, 7.0))
        P[8], P[9], P[10], P[:3], P[m.PICTURE] = 6.5, 3.0, 3.5, (0.02, 0.06, 0.3), rng.integers(0, 16)
    # an object at the visible end of the street
    for d in np.arange(-40.0, 41.0, 9.0):
        tree(
            rng,
            out,
            s1 + float(rng.uniform(2, 15)),
            float(d),
            float(rng.uniform(5, 15)),
            0 if rng.random() < 0.7 else 2,
            3,
        )


def _corner(
    rng: np.random.Generator, street: Street, out: Scenery, s: float, half: float, left: float, right: float
) -> None:
    """Traffic lights at a crossing, houses at the far ends of its side roads."""
    if rng.random() < 0.3:
        arm = float(rng.choice([0.0, rng.uniform(2.0, 5.0)]))
        for sign, edge in ((-1.0, street.right_m), (1.0, street.left_m)):
            P = out.add(
                m.LIGHTS, s + sign * (half + 3.0), edge + sign * 0.8, 0.0 if sign < 0 else math.pi, (0.3, 0.3, 4.0)
            )
            P[8], P[9], P[:3], P[m.SEED] = (3.2 if arm == 0.0 else 5.2), arm, 0.15, rng.random()
    for flag, sign in ((left, 1.0), (right, -1.0)):
        if flag > 0.5:
            P = out.add(m.BUILDING, s, sign * 66.0, 0.0, (24.0, 12.0, float(rng.uniform(5, 14))))
            P[:3], P[9:13], P[20], P[m.SEED] = _WALLS[int(rng.integers(0, 12))], (2.9, 2.5, 1.2, 1.4), -1, rng.random()
