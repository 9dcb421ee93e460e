"""Does the camera still lean as it was calibrated? Looks at its tilt over the road, and knocks between them.

What is measured of the tilt over a few metres is the mount, by which the camera file can be wrong, and a wander about
it: the road's crown and changes of grade, loads, braking. The wander lasts for tens of metres, so that looks are not
independent, and the mean of a long way is worth less than their number. A Kalman filter holds both, of pitch and roll:

    look = mount + wander + noise        wander: Ornstein-Uhlenbeck along the way

A knock turns the mount at once. At each look another filter begins as if it had just happened; the one that foretells
the looks since so much better than the filter without a knock that this outweighs how rare knocks are is believed
(Bayesian change points, Adams and MacKay 2007). A step shows against the metres before it more clearly than against
the file: the wander is nearly the same there. What was never right shows in the mount itself.
"""

from __future__ import annotations

import math
from typing import Annotated

import msgspec
import numpy as np
from numpy.typing import NDArray

from birdslam.geometry.camera import Camera

Floats = NDArray[np.float64]
Positive = Annotated[float, msgspec.Meta(gt=0.0)]

AXES = 2  # pitch, roll
MOUNT, WANDER = range(2)


class TiltWatchConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """How cameras lean in their cars, and cars on real roads."""

    look_m: Positive = 2.0  # the way from one look at the tilt to the next
    sigma_look_rad: Positive = 0.003  # bounces, and errors of one look
    wander_m: Positive = 40.0  # the way over which grade and load last
    sigma_wander_pitch_rad: Positive = 0.005  # grade and load
    sigma_wander_roll_rad: Positive = 0.012  # grade, load and the road's crown
    mount_walk_rad_per_sqrt_m: Positive = 2e-5  # by which the camera's mount gives way
    sigma_knock_rad: Positive = 0.05  # 1-sigma of what a knock turns the camera by
    knock_odds: Positive = 1e-5  # of a knock at one look, beforehand
    gate_sigma: Positive = 3.5  # a look farther from what was expected is a pothole's: it moves nothing
    kept_looks: Annotated[int, msgspec.Meta(ge=2)] = 24  # a knock that so many looks did not show is none
    drift_sigma: Positive = 3.0  # a mount that is off by more is told as calibration_drift


class TiltWatch:
    """see() the tilt along the way; `drifted` says whether the mount is another than the camera file's.

    Rows of the filters (K, AXES, 2): the first knows of no further knock, each next one of a later one.
    """

    def __init__(self, camera: Camera, config: TiltWatchConfig) -> None:
        self.config = config
        self._calibrated = np.array([camera.pitch_rad, camera.roll_rad])
        self._calibrated_var = camera.tilt_sigma_rad**2
        self._wander_var = np.square([config.sigma_wander_pitch_rad, config.sigma_wander_roll_rad])
        self._x = np.zeros((1, AXES, 2))
        self._P = np.zeros((1, AXES, 2, 2))
        self._P[..., MOUNT, MOUNT] = self._calibrated_var
        self._P[..., WANDER, WANDER] = self._wander_var
        self._log_odds = np.zeros(1)  # of each against the first
        self._knocked = False
        self._sum_rad_m, self._seen_m, self._unseen_m = np.zeros(AXES), 0.0, 0.0

    @property
    def mount(self) -> tuple[Floats, Floats]:
        """(2,) each, rad: how far pitch and roll of the mount are off the camera file's, and 1-sigma."""
        return self._x[0, :, MOUNT].copy(), np.sqrt(self._P[0, :, MOUNT, MOUNT])

    @property
    def drifted(self) -> bool:
        """Whether that is more than chance: by the file's sigma and the looks', or, after a knock, by the latter."""
        off, sigma = self.mount
        # The variance of an estimate that begins at the file's, were the file right
        var = np.square(sigma) if self._knocked else np.maximum(self._calibrated_var - np.square(sigma), 0.0)
        return bool((np.abs(off) > self.config.drift_sigma * np.sqrt(var)).any())

    def see(self, tilt_rad: Floats, travelled_m: float, measured: bool) -> None:
        """(pitch, roll) after a further `travelled_m`; where it was not `measured` it says nothing."""
        if not measured:
            self._unseen_m += travelled_m
            return
        self._sum_rad_m += (tilt_rad - self._calibrated) * travelled_m
        self._seen_m += travelled_m
        if self._seen_m >= self.config.look_m:
            self._look(self._sum_rad_m / self._seen_m, self._seen_m + self._unseen_m)
            self._sum_rad_m, self._seen_m, self._unseen_m = np.zeros(AXES), 0.0, 0.0

    def _look(self, off_rad: Floats, way_m: float) -> None:
        cfg = self.config
        keep = math.exp(-way_m / cfg.wander_m)
        F = np.array([1.0, keep])
        x, P = self._x * F, self._P * np.outer(F, F)
        P[..., WANDER, WANDER] += (1.0 - keep**2) * self._wander_var
        P[..., MOUNT, MOUNT] += cfg.mount_walk_rad_per_sqrt_m**2 * way_m
        knocked = P[:1].copy()
        knocked[..., MOUNT, MOUNT] += cfg.sigma_knock_rad**2
        x, P = np.concatenate([x, x[:1]]), np.concatenate([P, knocked])
        log_odds = np.append(self._log_odds, math.log(cfg.knock_odds))

        PH = P.sum(axis=-1)  # of H = [1, 1]
        S = PH.sum(axis=-1) + cfg.sigma_look_rad**2
        innovation = off_rad - x.sum(axis=-1)
        misfit2 = np.square(innovation) / S
        gain = np.where(misfit2 < cfg.gate_sigma**2, 1.0 / S, 0.0)[..., None] * PH
        x = x + gain * innovation[..., None]
        P = P - gain[..., None] * PH[..., None, :]
        log_odds = log_odds - 0.5 * (np.minimum(misfit2, cfg.gate_sigma**2) + np.log(S)).sum(axis=-1)

        best = int(np.argmax(log_odds))
        if best > 0:
            self._knocked = True
            kept = slice(best, best + 1)
            x, P, log_odds = x[kept], P[kept], log_odds[kept]
        elif len(x) > 1 + cfg.kept_looks:
            x, P, log_odds = (np.delete(array, 1, axis=0) for array in (x, P, log_odds))
        self._x, self._P, self._log_odds = x, P, log_odds - log_odds[0]
