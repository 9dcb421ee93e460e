"""Common tilt of the road and common height of people, from all people.

With the tilt T of the road relative to the front end's ground and the log h of a common factor on heights, a box gives

    t = T + (H / depth) D + own,   D = h - offset / H:

Far boxes measure the tilt, near ones D: height or pavement. Each person is one sample, the mean of its boxes. The prior
of each person comes from all others.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from birdslam.geometry.arrays import Floats
from birdslam.geometry.bev import RoadProfile
from birdslam.road_users.people.box_model import MIN_DISTANCE_M, MIN_SLOPE
from birdslam.road_users.people.people_boxes import PersonBox
from birdslam.road_users.people.people_config import PeopleConfig

ITERATIONS = 4
_T, _D, _TILT = range(3)  # indices of a sample
_SHARED = slice(_T, _D + 1)


def make_samples(boxes: Sequence[PersonBox], road: RoadProfile, config: PeopleConfig) -> Floats:
    """(N, 3, 3) w a a' of each box, a = (1, H / depth, t), w the information of t; 0 with hidden feet."""
    out = np.zeros((len(boxes), 3, 3))
    for k, box in enumerate(boxes):
        if not box.is_complete or box.hidden > config.sure_feet or box.tan_height <= MIN_SLOPE:
            continue
        sizes = config.sizes(box.label)
        tall = box.tan_height / (1.0 + sizes.foot_rel + sizes.head_rel)
        depth = sizes.height_m / tall
        bottom = box.slope_bottom - sizes.foot_rel * tall
        tilt = road.slope(max(depth - sizes.reach_m, MIN_DISTANCE_M)) - bottom
        slope = road.height_m / depth
        of_size = config.own_height_var(sizes.sigma_height_rel) + (2.0 * config.sigma_outline_rel) ** 2
        variance = slope**2 * of_size + (config.sigma_kerb_m / depth) ** 2
        variance += config.sigma_tilt_rad**2 + (config.sigma_roll_rad * box.bearing) ** 2
        a = np.array([1.0, slope, tilt])
        out[k] = np.outer(a, a) / variance
    return out


class SharedRoad:
    """Calls per frame: predict(), add_boxes(), leave_one_out(). Row k is the k-th person.

    State: T (rad) and D from removed people, with their covariance, or the prior. For each person the sum of its
    samples and their number.
    """

    def __init__(self, config: PeopleConfig) -> None:
        self.config = config
        self._x = np.zeros(2)
        self._P = np.diag([config.sigma_common_tilt_rad**2, config.sigma_common_rel**2 + config.sigma_pavement_rel**2])
        self._is_known = False
        self._sums, self._boxes = np.zeros((0, 3, 3)), np.zeros(0)

    def add_people(self, count: int) -> None:
        """Adds new people in rows after the others."""
        self._sums = np.concatenate([self._sums, np.zeros((count, 3, 3))])
        self._boxes = np.append(self._boxes, np.zeros(count))

    def keep_rows(self, rows: Sequence[int], leaving: Sequence[int]) -> None:
        """Removes all other rows; the information of the rows `leaving` stays."""
        if len(leaving):
            reported, prior = self._samples()[leaving].sum(axis=0), np.linalg.inv(self._P)
            P = np.linalg.inv(reported[_SHARED, _SHARED] + prior)
            self._x, self._P, self._is_known = P @ (reported[_SHARED, _TILT] + prior @ self._x), P, True
        self._sums, self._boxes = self._sums[rows], self._boxes[rows]

    def predict(self, keep: float, shift_rad: float, sigma_pitch_rad: float) -> None:
        """Predicts to the next frame: the factor `keep` on the tilt, the change `shift_rad` of the front end's pitch.

        `sigma_pitch_rad` is the 1-sigma of that pitch.
        """
        prior_var = sigma_pitch_rad**2 + self.config.sigma_common_tilt_rad**2
        self._x[_T] = keep * (self._x[_T] - shift_rad) if self._is_known else 0.0
        self._P *= np.outer([keep, 1.0], [keep, 1.0])
        self._P[_T, _T] = self._P[_T, _T] + (1.0 - keep**2) * prior_var if self._is_known else prior_var
        M = np.eye(3)
        M[_TILT, _T] = -shift_rad
        self._sums, self._boxes = keep * (M @ self._sums @ M.T), keep * self._boxes

    def add_boxes(self, rows: Sequence[int], boxes: Sequence[PersonBox], road: RoadProfile) -> None:
        """Adds the boxes of the people in `rows`, one each."""
        at, samples = np.asarray(rows), make_samples(boxes, road, self.config)
        self._sums[at] += samples
        self._boxes[at] += samples[:, 0, 0] > 0.0

    def leave_one_out(self) -> Floats:
        """(N + 1, 2, 2) means and variances of T and h from all others; the last row is from all."""
        samples = np.concatenate([self._samples(), np.zeros((1, 3, 3))])
        others, prior = samples.sum(axis=0) - samples, np.linalg.inv(self._P)
        P = np.linalg.inv(others[:, _SHARED, _SHARED] + prior)
        x = (P @ (others[:, _SHARED, _TILT] + prior @ self._x)[..., None])[..., 0]
        height_var = self.config.sigma_common_rel**2
        share = height_var / (height_var + self.config.sigma_pavement_rel**2)  # fraction of D that is due to heights
        means, variances = x * [1.0, share], np.diagonal(P, axis1=1, axis2=2) * [1.0, share**2]
        variances[:, _D] += (1.0 - share) * height_var
        return np.stack([means, variances], axis=-1)

    def _samples(self) -> Floats:
        """(N, 3, 3) mean samples of each person with robust weights (Cauchy), against children and hidden feet."""
        samples = self._sums / np.maximum(self._boxes, 1.0)[:, None, None]
        prior, weight = np.linalg.inv(self._P), np.ones(len(samples))
        for _ in range(ITERATIONS):
            reported = (weight[:, None, None] * samples).sum(axis=0)
            x = np.linalg.solve(reported[_SHARED, _SHARED] + prior, reported[_SHARED, _TILT] + prior @ self._x)
            off = np.array([-x[_T], -x[_D], 1.0])
            weight = 1.0 / (1.0 + off @ samples @ off / 4.0)
        return weight[:, None, None] * samples
