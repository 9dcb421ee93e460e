"""The road's tilt and how tall people are, as far as all who are there share them.

With T the road's tilt against the front end's ground and h the log of a factor on all heights, a box asks for the tilt

    t = T + (H / depth) D + own,   D = h - kerb / H:

far ones tell the tilt, near ones D: the height, or a pavement under all. A person is one sample, the mean of its boxes,
so that its own height is not averaged away. What all others tell is the prior of each.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from birdslam.geometry.arrays import Floats
from birdslam.geometry.bev import RoadProfile
from birdslam.people.box_model import MIN_DISTANCE_M, MIN_SLOPE
from birdslam.people.people_boxes import PersonBox
from birdslam.people.people_config import PeopleConfig

ITERATIONS = 4
_T, _D, _TILT = range(3)  # of a sample
_SHARED = slice(_T, _D + 1)


def samples_of(boxes: Sequence[PersonBox], road: RoadProfile, config: PeopleConfig) -> Floats:
    """(N, 3, 3): of each box w a a', with a = (1, H / depth, t) and w the information of t; nothing of hidden feet."""
    out = np.zeros((len(boxes), 3, 3))
    for k, box in enumerate(boxes):
        if not box.whole or box.hidden > config.sure_feet or box.tan_height <= MIN_SLOPE:
            continue
        sizes = config.sizes(box.label)
        depth = sizes.height_m / box.tan_height
        tilt = road.slope(max(depth - sizes.reach_m, MIN_DISTANCE_M), config.kerb_m) - box.slope_bottom
        slope = road.height_m / depth
        of_size = config.own_height_var(sizes.sigma_height_rel) + (2.0 * config.sigma_outline_rel) ** 2
        variance = slope**2 * of_size + (config.sigma_kerb_m / depth) ** 2
        variance += config.sigma_tilt_rad**2 + (config.sigma_roll_rad * box.bearing) ** 2
        a = np.array([1.0, slope, tilt])
        out[k] = np.outer(a, a) / variance
    return out


class SharedRoad:
    """predict() once a frame, tell() it the boxes, then by_others(). Row k is the k-th person's.

    State: T (rad) and D by those who left, with their covariance; until somebody has, they are of the prior. Of each
    person the sum of the samples and how many they were.
    """

    def __init__(self, config: PeopleConfig) -> None:
        self.config = config
        self._x = np.zeros(2)
        self._P = np.diag([config.sigma_common_tilt_rad**2, config.sigma_common_rel**2 + config.sigma_pavement_rel**2])
        self._known = False
        self._reported, self._boxes = np.zeros((0, 3, 3)), np.zeros(0)

    def begin(self, count: int) -> None:
        """People seen for the first time, in rows after the others."""
        self._reported = np.concatenate([self._reported, np.zeros((count, 3, 3))])
        self._boxes = np.append(self._boxes, np.zeros(count))

    def keep_rows(self, rows: Sequence[int], leaving: Sequence[int]) -> None:
        """Forgets all others; of those in the rows `leaving` what they told stays."""
        if len(leaving):
            reported, prior = self._samples()[leaving].sum(axis=0), np.linalg.inv(self._P)
            P = np.linalg.inv(reported[_SHARED, _SHARED] + prior)
            self._x, self._P, self._known = P @ (reported[_SHARED, _TILT] + prior @ self._x), P, True
        self._reported, self._boxes = self._reported[rows], self._boxes[rows]

    def predict(self, keep: float, shift_rad: float, sigma_pitch_rad: float) -> None:
        """To the next frame: `keep` of the tilt lasts; the front end's ground, known to `sigma_pitch_rad`, got
        `shift_rad` more pitch.
        """
        prior_var = sigma_pitch_rad**2 + self.config.sigma_common_tilt_rad**2
        self._x[_T] = keep * (self._x[_T] - shift_rad) if self._known else 0.0
        self._P *= np.outer([keep, 1.0], [keep, 1.0])
        self._P[_T, _T] = self._P[_T, _T] + (1.0 - keep**2) * prior_var if self._known else prior_var
        M = np.eye(3)
        M[_TILT, _T] = -shift_rad
        self._reported, self._boxes = keep * (M @ self._reported @ M.T), keep * self._boxes

    def tell(self, rows: Sequence[int], boxes: Sequence[PersonBox], road: RoadProfile) -> None:
        """The boxes of the people in `rows`, one each."""
        at, samples = np.asarray(rows), samples_of(boxes, road, self.config)
        self._reported[at] += samples
        self._boxes[at] += samples[:, 0, 0] > 0.0

    def by_others(self) -> Floats:
        """(N + 1, 2, 2): means and variances of T and h as all others tell them; the last row is by all."""
        samples = np.concatenate([self._samples(), np.zeros((1, 3, 3))])
        others, prior = samples.sum(axis=0) - samples, np.linalg.inv(self._P)
        P = np.linalg.inv(others[:, _SHARED, _SHARED] + prior)
        x = (P @ (others[:, _SHARED, _TILT] + prior @ self._x)[..., None])[..., 0]
        height_var = self.config.sigma_common_rel**2
        share = height_var / (height_var + self.config.sigma_pavement_rel**2)  # of D, that is of heights
        means, variances = x * [1.0, share], np.diagonal(P, axis1=1, axis2=2) * [1.0, share**2]
        variances[:, _D] += (1.0 - share) * height_var
        return np.stack([means, variances], axis=-1)

    def _samples(self) -> Floats:
        """(N, 3, 3) means of each one's boxes, with weights of Cauchy: a child, or hidden feet, tells another tilt."""
        samples = self._reported / np.maximum(self._boxes, 1.0)[:, None, None]
        prior, weight = np.linalg.inv(self._P), np.ones(len(samples))
        for _ in range(ITERATIONS):
            reported = (weight[:, None, None] * samples).sum(axis=0)
            x = np.linalg.solve(reported[_SHARED, _SHARED] + prior, reported[_SHARED, _TILT] + prior @ self._x)
            off = np.array([-x[_T], -x[_D], 1.0])
            weight = 1.0 / (1.0 + off @ samples @ off / 4.0)
        return weight[:, None, None] * samples
