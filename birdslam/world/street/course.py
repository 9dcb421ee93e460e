"""Random curvature and slope of a street's centre line."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from birdslam.geometry.arrays import Floats

STEP_M = 0.5  # of the table of the centre line
MAX_CURVATURE_PER_M = {"residential": 1 / 18, "urban": 1 / 22, "avenue": 1 / 45, "country": 1 / 50, "motorway": 1 / 300,
             "industrial": 1 / 20, "alley": 1 / 15}  # fmt: skip


@dataclass(frozen=True)
class Course:
    """A centre line: curvature (1/m) and slope at each step of the table."""

    curvature: Floats
    slope: Floats

    def then(self, other: Course, s_m: float) -> Course:
        """This course as far as `s_m`, the other one from there, blended over 20 m."""
        s = np.arange(len(self.curvature)) * STEP_M
        share = np.clip((s - s_m) / 20.0, 0.0, 1.0)
        share = share * share * (3.0 - 2.0 * share)
        mixed = [
            (1.0 - share) * mine + share * theirs for mine, theirs in zip(self.columns, other.columns, strict=True)
        ]
        return Course(*mixed)

    @property
    def columns(self) -> tuple[Floats, Floats]:
        return self.curvature, self.slope

    def table(self) -> tuple[Floats, Floats, Floats, Floats]:
        yaw = np.concatenate([[0.0], np.cumsum(self.curvature[:-1]) * STEP_M])
        mid = yaw + 0.5 * STEP_M * self.curvature
        level = STEP_M * np.sqrt(1.0 - np.square(np.clip(self.slope, -0.3, 0.3)))
        x = np.concatenate([[0.0], np.cumsum(np.cos(mid[:-1]) * level[:-1])])
        y = np.concatenate([[0.0], np.cumsum(np.sin(mid[:-1]) * level[:-1])])
        z = np.concatenate([[0.0], np.cumsum(self.slope[:-1]) * STEP_M])
        return x, y, z, yaw


def draw_course(rng: np.random.Generator, length_m: float, ego_s_m: float, sharpest: float) -> Course:
    """A straight, bending or sharply turning course; level or graded up to 8 %, sometimes with a crest or a sag."""
    n = int(length_m / STEP_M) + 1
    s = np.arange(n, dtype=np.float64) * STEP_M
    curvature = np.zeros(n)
    match rng.choice(4, p=[0.3, 0.35, 0.2, 0.15]):
        case 1:
            curvature += rng.uniform(-1, 1) * sharpest * 0.25 + 0.15 * sharpest * np.sin(s / rng.uniform(20, 60))
        case 2:
            curvature += rng.choice([-1.0, 1.0]) * rng.uniform(0.2, 0.6) * sharpest * _bump(s, rng, ego_s_m, 40.0)
        case 3:  # a turn of up to a right angle ahead
            turn = rng.uniform(0.5, 1.6) * rng.choice([-1.0, 1.0])
            radius = rng.uniform(1.0, 3.0) / sharpest
            begin = ego_s_m + rng.uniform(-10, 60)
            curvature[(s > begin) & (s < begin + abs(turn) * radius)] = math.copysign(1.0 / radius, turn)
            kernel = np.ones(17) / 17.0
            curvature = np.convolve(curvature, kernel, mode="same")
        case _:
            curvature += rng.normal(0.0, 0.0007)
    slope = np.zeros(n)
    if rng.random() < 0.55:
        slope += np.clip(rng.normal(0.0, 0.03), -0.08, 0.08)
    if rng.random() < 0.3:  # a crest or a sag ahead
        begin, radius = ego_s_m + rng.uniform(8, 50), rng.uniform(500, 2500) * rng.choice([-1.0, 1.0])
        slope += np.clip(np.clip(s - begin, 0.0, 60.0) / radius, -0.06, 0.06)
    return Course(curvature, np.clip(slope, -0.08, 0.08))


def _bump(s: Floats, rng: np.random.Generator, ego_s_m: float, width_m: float) -> Floats:
    out: Floats = np.exp(-np.square((s - ego_s_m - rng.uniform(-20, 80)) / width_m))
    return out
