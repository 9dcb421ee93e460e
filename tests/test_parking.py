"""Parked cars of the built-in world: in rows beside the street, without overlaps, lots free of buildings."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from birdslam.world.street.street import Street
from birdslam.world.street.street_plan import draw_street
from birdslam.world.traffic.flow import Mover, populate
from birdslam.world.traffic.parking import Lot, cleared, draw_lots
from birdslam.world.traffic.placement import Scenery, furnish
from birdslam.world.traffic.poses import moving

EGO_S_M, EGO_D_M = 30.0, -1.5

Place = tuple[Street, tuple[Lot, ...], Scenery, list[Mover]]


@pytest.fixture(scope="module")
def places() -> list[Place]:
    out: list[Place] = []
    for seed in range(60):
        rng = np.random.default_rng([seed, 1])
        street = draw_street(rng, 240.0, EGO_S_M)
        lots_rng = rng.spawn(1)[0]
        lots = draw_lots(lots_rng, street, EGO_S_M)
        standing = cleared(furnish(rng, street, EGO_S_M - 12.0, EGO_S_M + 150.0), lots, lots_rng)
        out.append((street, lots, standing, populate(rng, street, EGO_S_M, EGO_D_M, lots=lots)))
    return out


def _corners(mover: Mover) -> NDArray[np.float64]:
    """(4, 2) of the footprint, a little within it."""
    c, s = math.cos(mover.turn_rad), math.sin(mover.turn_rad)
    along, across = 0.48 * mover.length_m, 0.48 * mover.width_m
    signs = np.array([(1, 1), (-1, 1), (-1, -1), (1, -1)]) * [along, across]
    return signs @ np.array([[c, s], [-s, c]]) + [mover.s_m, mover.d_m]


def _apart(a: NDArray[np.float64], b: NDArray[np.float64]) -> bool:
    """Two convex shapes are apart where a side of one has all of the other beyond it."""
    for shape in (a, b):
        for start, end in zip(shape, np.roll(shape, -1, axis=0), strict=True):
            normal = np.array([start[1] - end[1], end[0] - start[0]])
            if (a @ normal).max() <= (b @ normal).min() or (b @ normal).max() <= (a @ normal).min():
                return True
    return False


def test_vehicles_do_not_overlap(places: list[Place]) -> None:
    pairs = 0
    for *_, movers in places:
        cars = [mover for mover in movers if mover.body.label in ("car", "van", "truck", "bus")]
        shapes = [_corners(car) for car in cars]
        for i, one in enumerate(cars):
            for j in range(i):
                reach = one.length_m + cars[j].length_m
                if math.hypot(one.s_m - cars[j].s_m, one.d_m - cars[j].d_m) < reach:
                    pairs += 1
                    assert _apart(shapes[i], shapes[j])
    assert pairs > 1000


def test_lots_have_angled_and_perpendicular_cars(places: list[Place]) -> None:
    tilts, counts = [], []
    for _, lots, _, movers in places:
        for lot in lots:
            low, high = sorted((lot.near_m, lot.far_m))
            on = [v for v in movers if lot.s0_m < v.s_m < lot.s1_m and low < v.d_m < high]
            counts.append(len(on))
            tilts += [abs(math.sin(v.turn_rad)) for v in on]
    assert len(counts) > 20
    assert np.median(counts) >= 4
    assert 0.2 < np.mean(np.array(tilts) < 0.96) < 0.8  # aslant; the others across


def test_bodies_behind_a_kerb_are_on_the_pavement(places: list[Place]) -> None:
    raised = 0
    for street, *_, movers in places:
        scene = moving(street, movers)
        for mover, (_, _, z_m) in zip(movers, scene.position_m, strict=True):
            road_m = float(street.place(np.array(mover.s_m), np.array(mover.d_m))[2])
            side = 1 if mover.d_m > 0.0 else -1
            if street.right_m <= mover.d_m <= street.left_m or street.in_crossing(mover.s_m, 2.0, side):
                assert z_m - road_m <= 0.14  # a median at the most
            else:
                raised += z_m - road_m > 0.03
                assert 0.0 <= z_m - road_m < 0.2
    assert raised > 100
