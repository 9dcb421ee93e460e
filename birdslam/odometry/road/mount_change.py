"""Mount-change detection: whether the camera still has its calibrated tilt, by change-point Kalman filters.

A tilt sample is the mount's tilt plus a wander (crown, grade, load, braking), an Ornstein-Uhlenbeck process; both are
Kalman states of pitch and of roll. A knock is a change point (Bayesian online change-point detection, Adams and MacKay
2007): each sample starts a hypothesis with a knock, which wins by its posterior odds.
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


class MountChangeConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Parameters of the tilt of mounts and of cars on roads."""

    sample_m: Positive = 2.0  # distance between two samples of the tilt
    sigma_sample_rad: Positive = 0.003  # 1-sigma of a sample: bounces and filter errors
    wander_m: Positive = 40.0  # correlation length of the wander
    sigma_wander_pitch_rad: Positive = 0.005  # 1-sigma of the wander: grade and load
    sigma_wander_roll_rad: Positive = 0.012  # 1-sigma of the wander: grade, load and the road's crown
    mount_walk_rad_per_sqrt_m: Positive = 2e-5  # random walk of the mount
    sigma_knock_rad: Positive = 0.05  # 1-sigma of the rotation by a knock
    knock_odds: Positive = 1e-5  # prior odds of a knock per sample
    gate_sigma: Positive = 3.5  # outlier gate of a sample (a pothole)
    max_hypotheses: Annotated[int, msgspec.Meta(ge=2)] = (
        24  # number of samples within which a change point is confirmed or dropped
    )
    drift_sigma: Positive = 2.5  # significance of calibration_drift, in sigmas


class MountChangeDetector:
    """State, measurements and readers:

    - State of each of K hypotheses: mount and wander (rad, relative to the camera file), for pitch and roll:
      (K, AXES, 2). The first assumes no knock, each next one a later knock.
    - Measurements: the tilt of `RoadFilter`, averaged over `sample_m` metres (`update`).
    - Readers: `RoadScale`, which reports CALIBRATION_DRIFT by `has_drifted`.
    """

    def __init__(self, camera: Camera, config: MountChangeConfig) -> None:
        self.config = config
        self._file_tilt = np.array([camera.pitch_rad, camera.roll_rad])
        self._calibrated_var = camera.tilt_sigma_rad**2
        self._wander_var = np.square([config.sigma_wander_pitch_rad, config.sigma_wander_roll_rad])
        self._x = np.zeros((1, AXES, 2))
        self._P = np.zeros((1, AXES, 2, 2))
        self._P[..., MOUNT, MOUNT] = self._calibrated_var
        self._P[..., WANDER, WANDER] = self._wander_var
        self._log_odds = np.zeros(1)  # relative to the first
        self._has_changed = False
        self._tilt_sum, self._averaged_m, self._skipped_m = np.zeros(AXES), 0.0, 0.0

    @property
    def mount(self) -> tuple[Floats, Floats]:
        """(2,) each, rad: pitch and roll of the mount relative to the camera file, and 1-sigma."""
        return self._x[0, :, MOUNT].copy(), np.sqrt(self._P[0, :, MOUNT, MOUNT])

    @property
    def has_drifted(self) -> bool:
        """Whether the mount differs significantly, by the sigma of file and samples; after a knock, of the samples."""
        off, sigma = self.mount
        # Variance of an estimate that starts at the file's tilt, if the file is correct
        var = np.square(sigma) if self._has_changed else np.maximum(self._calibrated_var - np.square(sigma), 0.0)
        return bool((np.abs(off) > self.config.drift_sigma * np.sqrt(var)).any())

    def update(self, tilt_rad: Floats, travelled_m: float, measured: bool) -> None:
        """Adds the tilt (pitch, roll) after a further `travelled_m`; skips it if it was not `measured`."""
        if not measured:
            self._skipped_m += travelled_m
            return
        self._tilt_sum += (tilt_rad - self._file_tilt) * travelled_m
        self._averaged_m += travelled_m
        if self._averaged_m >= self.config.sample_m:
            self._step(self._tilt_sum / self._averaged_m, self._averaged_m + self._skipped_m)
            self._tilt_sum, self._averaged_m, self._skipped_m = np.zeros(AXES), 0.0, 0.0

    def _step(self, off_rad: Floats, distance_m: float) -> None:
        cfg = self.config
        keep = math.exp(-distance_m / cfg.wander_m)
        F = np.array([1.0, keep])
        x, P = self._x * F, self._P * np.outer(F, F)
        P[..., WANDER, WANDER] += (1.0 - keep**2) * self._wander_var
        P[..., MOUNT, MOUNT] += cfg.mount_walk_rad_per_sqrt_m**2 * distance_m
        changed = P[:1].copy()
        changed[..., MOUNT, MOUNT] += cfg.sigma_knock_rad**2
        x, P = np.concatenate([x, x[:1]]), np.concatenate([P, changed])
        log_odds = np.append(self._log_odds, math.log(cfg.knock_odds))

        PH = P.sum(axis=-1)  # of H = [1, 1]
        S = PH.sum(axis=-1) + cfg.sigma_sample_rad**2
        innovation = off_rad - x.sum(axis=-1)
        nis = np.square(innovation) / S
        gain = np.where(nis < cfg.gate_sigma**2, 1.0 / S, 0.0)[..., None] * PH
        x = x + gain * innovation[..., None]
        P = P - gain[..., None] * PH[..., None, :]
        log_odds = log_odds - 0.5 * (np.minimum(nis, cfg.gate_sigma**2) + np.log(S)).sum(axis=-1)

        best = int(np.argmax(log_odds))
        if best > 0:
            self._has_changed = True
            kept = slice(best, best + 1)
            x, P, log_odds = x[kept], P[kept], log_odds[kept]
        elif len(x) > 1 + cfg.max_hypotheses:
            x, P, log_odds = (np.delete(array, 1, axis=0) for array in (x, P, log_odds))
        self._x, self._P, self._log_odds = x, P, log_odds - log_odds[0]
