"""Vehicles and people: shapes, sizes, colours, each drawn from a generator as a row of parameters (see `materials`)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from birdslam.geometry.arrays import Floats32
from birdslam.world.rendering import materials as m

# Linear light
_PAINTS = np.array(
    [
        (0.012, 0.012, 0.014), (0.03, 0.03, 0.035), (0.07, 0.075, 0.08), (0.17, 0.175, 0.18), (0.33, 0.335, 0.34),
        (0.5, 0.5, 0.5), (0.74, 0.74, 0.73), (0.8, 0.8, 0.8), (0.02, 0.04, 0.13), (0.05, 0.1, 0.28),
        (0.3, 0.02, 0.02), (0.45, 0.03, 0.03), (0.02, 0.08, 0.04), (0.2, 0.16, 0.1), (0.35, 0.31, 0.22),
        (0.55, 0.4, 0.03), (0.4, 0.12, 0.02), (0.1, 0.25, 0.35), (0.09, 0.05, 0.035), (0.12, 0.03, 0.05),
    ]
)  # fmt: skip
_PAINT_ODDS = np.array([12, 10, 9, 11, 11, 6, 8, 8, 7, 6, 3, 4, 2, 2, 2, 2, 1, 2, 2, 2], dtype=float)
_PAINT_ODDS /= _PAINT_ODDS.sum()


@dataclass(frozen=True)
class Shape:
    """Mean proportions of a kind of vehicle; x as fractions of the length from the rear, z of the height."""

    label: str
    length_m: tuple[float, float]
    width_m: tuple[float, float]
    height_m: tuple[float, float]
    belt: float
    cowl: float
    screen_top: float
    roof_end: float
    back_bottom: float
    nose: float
    z_cowl: float
    tail: float
    tumble_m: float
    round_front: float
    round_rear: float
    wheel_m: tuple[float, float]
    front_axle_m: float  # behind the nose
    rear_axle_m: float  # before the tail
    clearance_m: float = 0.2
    glass_end: float = 0.12


_CAR_WHEEL = (0.29, 0.34)
SHAPES: dict[str, Shape] = {
    "hatchback": Shape("car", (3.7, 4.4), (1.66, 1.82), (1.42, 1.55), 0.63, 0.75, 0.55, 0.14, 0.05, 0.46, 0.65, 0.63,
                       0.17, 0.16, 0.13, _CAR_WHEEL, 0.82, 0.7, glass_end=0.14),
    "city": Shape("car", (3.3, 3.75), (1.6, 1.7), (1.45, 1.58), 0.6, 0.8, 0.6, 0.1, 0.04, 0.47, 0.65, 0.6, 0.15, 0.16,
                  0.13, _CAR_WHEEL, 0.68, 0.6),
    "sedan": Shape("car", (4.4, 5.0), (1.72, 1.88), (1.4, 1.48), 0.64, 0.725, 0.56, 0.27, 0.12, 0.48, 0.66, 0.67, 0.19,
                   0.15, 0.12, _CAR_WHEEL, 0.9, 1.0, glass_end=0.2),
    "old_sedan": Shape("car", (4.2, 4.8), (1.62, 1.76), (1.38, 1.45), 0.63, 0.70, 0.58, 0.3, 0.2, 0.56, 0.65, 0.64,
                       0.13, 0.07, 0.06, _CAR_WHEEL, 0.85, 0.95, glass_end=0.25),
    "estate": Shape("car", (4.4, 4.95), (1.72, 1.86), (1.42, 1.53), 0.62, 0.735, 0.57, 0.1, 0.03, 0.47, 0.65, 0.6, 0.17,
                    0.15, 0.1, _CAR_WHEEL, 0.88, 0.95, glass_end=0.07),
    "mpv": Shape("car", (4.2, 4.85), (1.76, 1.9), (1.6, 1.78), 0.56, 0.82, 0.62, 0.09, 0.03, 0.44, 0.61, 0.55, 0.16,
                 0.17, 0.11, _CAR_WHEEL, 0.85, 0.8, glass_end=0.06),
    "suv": Shape("car", (4.3, 4.95), (1.8, 1.98), (1.62, 1.85), 0.62, 0.73, 0.58, 0.11, 0.04, 0.54, 0.66, 0.6, 0.15,
                 0.12, 0.1, (0.34, 0.4), 0.88, 0.88, 0.26, 0.08),
    "jeep": Shape("car", (3.9, 4.6), (1.7, 1.85), (1.75, 1.9), 0.6, 0.68, 0.62, 0.04, 0.01, 0.57, 0.61, 0.6, 0.06, 0.05,
                  0.04, (0.35, 0.4), 0.75, 0.85, 0.3, 0.06),
    "coupe": Shape("car", (4.1, 4.6), (1.72, 1.86), (1.28, 1.38), 0.66, 0.70, 0.52, 0.3, 0.09, 0.48, 0.67, 0.7, 0.22,
                   0.17, 0.15, _CAR_WHEEL, 0.88, 0.85, glass_end=0.27),
    "pickup": Shape("car", (4.9, 5.5), (1.8, 1.95), (1.7, 1.85), 0.6, 0.72, 0.6, 0.42, 0.4, 0.55, 0.63, 0.58, 0.12, 0.1,
                    0.03, (0.35, 0.4), 0.9, 1.2, 0.27, 0.43),
    "small_van": Shape("van", (4.2, 4.6), (1.7, 1.84), (1.78, 1.9), 0.55, 0.79, 0.62, 0.03, 0.015, 0.44, 0.58, 0.56,
                       0.1, 0.15, 0.04, _CAR_WHEEL, 0.82, 0.75, 0.2, 0.05),
    "van": Shape("van", (4.8, 5.5), (1.88, 2.02), (1.92, 2.1), 0.53, 0.86, 0.71, 0.02, 0.01, 0.42, 0.54, 0.54, 0.12,
                 0.13, 0.03, (0.32, 0.36), 0.95, 0.95, 0.22, 0.04),
    "big_van": Shape("van", (5.5, 7.0), (1.95, 2.08), (2.4, 2.8), 0.46, 0.87, 0.76, 0.01, 0.006, 0.38, 0.47, 0.46, 0.1,
                     0.1, 0.02, (0.33, 0.37), 1.0, 1.1, 0.25, 0.04),
    "bus": Shape("bus", (9.5, 13.0), (2.45, 2.55), (2.9, 3.3), 0.38, 0.985, 0.97, 0.012, 0.006, 0.33, 0.38, 0.38, 0.05,
                 0.03, 0.02, (0.45, 0.5), 2.6, 3.2, 0.28, 0.03),
    "minibus": Shape("bus", (6.5, 8.0), (2.1, 2.3), (2.6, 2.9), 0.42, 0.93, 0.86, 0.01, 0.006, 0.38, 0.44, 0.42, 0.08,
                     0.07, 0.02, (0.36, 0.42), 1.1, 1.7, 0.26, 0.03),
}  # fmt: skip
# Cab of a truck: lengths in metres from the nose
_CARS = ("hatchback", "city", "sedan", "old_sedan", "estate", "mpv", "suv", "jeep", "coupe", "pickup")
_CAR_ODDS = (0.27, 0.1, 0.17, 0.05, 0.14, 0.1, 0.1, 0.02, 0.03, 0.02)


@dataclass(frozen=True)
class Body:
    """A movable body: its label, its mesh's kind, and its parameters (SLOTS,)."""

    label: str
    kind: int
    parameters: Floats32


def draw_vehicle(rng: np.random.Generator, parked: bool = False) -> Body:
    """A random vehicle: mostly cars, also vans, trucks and buses."""
    p = rng.random()
    if p < (0.88 if parked else 0.76):
        return draw_shape(rng, str(rng.choice(_CARS, p=_CAR_ODDS)))
    if p < (0.97 if parked else 0.87):
        return draw_shape(rng, str(rng.choice(["small_van", "van", "big_van"], p=[0.35, 0.35, 0.3])))
    if p < (0.995 if parked else 0.955):
        return draw_truck(rng)
    return draw_shape(rng, str(rng.choice(["bus", "minibus"], p=[0.7, 0.3])))


def draw_shape(rng: np.random.Generator, name: str) -> Body:
    """A vehicle of one of SHAPES."""
    shape = SHAPES[name]
    P = np.zeros(m.SLOTS, np.float32)
    u = rng.random(28)
    length = shape.length_m[0] + u[0] * (shape.length_m[1] - shape.length_m[0])
    height = shape.height_m[0] + u[2] * (shape.height_m[1] - shape.height_m[0])
    P[m.LENGTH], P[m.HEIGHT] = length, height
    P[m.WIDTH] = shape.width_m[0] + (0.6 * u[0] + 0.4 * u[1]) * (shape.width_m[1] - shape.width_m[0])
    _paint(rng, P, shape.label)
    jitter = 1.0 + 0.1 * (u[3:11] - 0.5)
    P[m.CLEARANCE] = shape.clearance_m * (0.85 + 0.3 * u[11])
    P[m.BELT] = shape.belt * height * jitter[0]
    x = np.array([shape.cowl, shape.screen_top, shape.roof_end, shape.back_bottom]) + 0.04 * (u[12:16] - 0.5) * (
        shape.label == "car"
    )
    P[[m.X_COWL, m.X_SCREEN_TOP, m.X_ROOF_END, m.X_BACK_BOTTOM]] = (np.clip(x, 0.004, 0.99) - 0.5) * length
    P[m.Z_NOSE], P[m.Z_TAIL] = shape.nose * height * jitter[1], shape.tail * height * jitter[2]
    P[m.Z_COWL] = max(shape.z_cowl * height * jitter[0], float(P[m.Z_NOSE]) + 0.04)
    P[m.TUMBLE] = shape.tumble_m * (0.7 + 0.6 * u[16])
    P[m.ROUND_FRONT], P[m.ROUND_REAR] = shape.round_front * (0.7 + 0.6 * u[17]), shape.round_rear * (0.7 + 0.6 * u[18])
    P[m.WHEEL_RADIUS] = shape.wheel_m[0] + u[19] * (shape.wheel_m[1] - shape.wheel_m[0])
    P[m.X_FRONT_AXLE], P[m.X_REAR_AXLE] = 0.5 * length - shape.front_axle_m, -0.5 * length + shape.rear_axle_m
    P[m.X_PILLAR] = 0.5 * (P[m.X_SCREEN_TOP] + P[m.X_COWL]) * 0.35 - 0.02 * length
    P[m.X_PILLAR_2] = P[m.X_PILLAR] - 0.2 * length
    P[m.X_GLASS_END] = (shape.glass_end - 0.5) * length
    if shape.label == "van" and u[20] < 0.65:  # panels behind the driver's door
        P[m.X_GLASS_END] = P[m.X_SCREEN_TOP] - 0.55
    P[m.LOFT_X0], P[m.LOFT_X1] = -0.5 * length, 0.5 * length
    P[m.CLADDING] = float(u[21] < 0.35)
    return Body(shape.label, m.VEHICLE, P)


def _paint(rng: np.random.Generator, P: Floats32, label: str) -> None:
    u = rng.random(12)
    paint = _PAINTS[int(rng.choice(len(_PAINTS), p=_PAINT_ODDS))] * (0.8 + 0.4 * u[0])
    if label in ("van", "truck") and u[1] < 0.5:
        paint = _PAINTS[6]
    if label in ("bus", "truck") and u[1] > 0.6:
        paint = rng.uniform(0.02, 0.6, 3)
    P[:3] = paint
    P[m.GLOSS], P[m.SEED] = 0.3 + 0.7 * u[2], u[3]
    P[m.GLASS], P[m.DIRT] = u[4] ** 2, u[5] ** 3
    P[m.BRAKING], P[m.HEADLIGHTS] = 0.0, float(u[6] < 0.2)
    P[m.PLATE] = 0.0 if u[7] < 0.72 else (1.0 if u[7] < 0.93 else 2.0)
    P[m.RIM], P[m.LAMPS], P[m.PICTURE] = u[8], u[9], int(16 * u[10])


def draw_truck(rng: np.random.Generator) -> Body:
    """A rigid or articulated truck with a random load; van-sized ones are labelled as trucks too."""
    P = np.zeros(m.SLOTS, np.float32)
    u = rng.random(16)
    length = (6.0 + 2.3 * u[0], 8.6 + 3.0 * u[0], 13.0 + 3.5 * u[0])[int(rng.choice(3, p=[0.4, 0.3, 0.3]))]
    big = length > 8.5
    P[m.LENGTH], P[m.WIDTH] = length, 2.5 if big else 2.1 + 0.2 * u[1]
    P[m.HEIGHT] = (3.4 + 0.6 * u[2]) if big else (2.7 + 0.6 * u[2])
    _paint(rng, P, "truck")
    cab_m, x1 = (2.1 + 0.3 * u[3]) if big else (1.7 + 0.3 * u[3]), 0.5 * length
    P[m.CARGO_X0], P[m.CARGO_X1] = -0.5 * length, x1 - cab_m - 0.35 - 0.3 * u[4]
    P[m.CARGO_KIND] = rng.choice(6, p=[0.32, 0.23, 0.18, 0.1, 0.1, 0.07])
    P[m.CARGO_Z0] = 1.1 if big else 0.85
    P[m.CARGO_RED : m.CARGO_BLUE + 1] = (
        rng.uniform(0.02, 0.75, 3) if u[5] < 0.5 else np.array([0.7, 0.7, 0.68]) * (0.6 + 0.4 * u[6])
    )
    if P[m.CARGO_KIND] == 3:
        P[m.HEIGHT] *= 0.85
    cab_top = min(float(P[m.HEIGHT]) * 0.97, 3.4 if big else 2.5)
    P[m.CLEARANCE], P[m.BELT] = 0.4, 0.52 * cab_top
    P[m.LOFT_X0], P[m.LOFT_X1] = x1 - cab_m, x1
    P[m.X_COWL], P[m.X_SCREEN_TOP] = x1 - 0.12, x1 - 0.3
    P[m.X_ROOF_END], P[m.X_BACK_BOTTOM] = x1 - cab_m + 0.06, x1 - cab_m + 0.03
    P[m.Z_NOSE], P[m.Z_COWL], P[m.Z_TAIL] = 0.48 * cab_top, 0.53 * cab_top, 0.5 * cab_top
    P[m.TUMBLE], P[m.ROUND_FRONT], P[m.ROUND_REAR] = 0.06, 0.06, 0.02
    P[m.WHEEL_RADIUS] = 0.5 if big else 0.38
    P[m.X_FRONT_AXLE], P[m.X_REAR_AXLE] = x1 - (1.4 if big else 1.05), -0.5 * length + 1.4 + 0.6 * u[7]
    P[m.X_PILLAR], P[m.X_PILLAR_2], P[m.X_GLASS_END] = x1 - 1.3, x1 - 9.0, x1 - cab_m + 0.5
    return Body("truck", m.TRUCK, P)


def draw_pedestrian(rng: np.random.Generator) -> Body:
    """Someone on foot: 1.1 to 1.95 m tall, in drawn clothes, mid-stride."""
    P = np.zeros(m.SLOTS, np.float32)
    P[m.HEIGHT] = rng.uniform(1.1, 1.5) if rng.random() < 0.12 else rng.normal(1.72, 0.09)
    P[m.LENGTH], P[m.WIDTH] = 0.6, 0.55
    _clothes(rng, P)
    return Body("pedestrian", m.PEDESTRIAN, P)


def draw_cyclist(rng: np.random.Generator) -> Body:
    """Someone on a bicycle or a scooter."""
    P = np.zeros(m.SLOTS, np.float32)
    P[m.LENGTH], P[m.WIDTH], P[m.HEIGHT] = 1.75, 0.6, 1.8
    _clothes(rng, P)
    P[m.GLOSS] = float(rng.random() < 0.3)
    return Body("cyclist", m.CYCLIST, P)


def _clothes(rng: np.random.Generator, P: Floats32) -> None:
    P[:3] = rng.uniform(0.01, 0.5, 3) ** 1.3 if rng.random() < 0.6 else rng.uniform(0.01, 0.6)
    P[m.CARGO_RED : m.CARGO_BLUE + 1] = (
        rng.uniform(0.01, 0.4, 3) if rng.random() < 0.3 else np.array([0.02, 0.025, 0.05]) * rng.uniform(0.5, 4)
    )
    P[m.SEED], P[m.PHASE], P[m.PICTURE] = rng.random(), rng.uniform(0, 6.28), rng.integers(0, 16)
