"""Initial motion between two images without a motion model, at the start and after a loss of tracking.

Rotation: blocks above the horizon of the cylindrical projection vote for yaw and pitch by normalised cross-correlation.
Length: regression of the road's image over distance and pitch (road/scale_likelihood.py); the direction follows from
the rotation about the rear axle.
"""

from __future__ import annotations

from typing import Annotated

import cv2
import msgspec
import numpy as np
from numpy.typing import NDArray

from birdslam.geometry.camera import Camera
from birdslam.geometry.pose import Pose, rotation_exp
from birdslam.odometry.road.alignment import RoadAligner
from birdslam.odometry.road.road_image import RoadImage
from birdslam.odometry.road.scale_likelihood import best_length, explained_by_motion

Floats = NDArray[np.float64]
Grey = NDArray[np.float32]
Positive = Annotated[float, msgspec.Meta(gt=0.0)]

_BLOCK_SHAPE = (14, 24)  # rows and columns on the cylinder, 4.5 by 8 degrees
_NO_BOXES = np.zeros((0, 4))


class InitialisationConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Search range of the motion between two images."""

    resolution_px: Positive = 180.0  # per radian on the cylinder: 0.3 degrees per pixel, within reach of the flow
    max_yaw_rad: Positive = 0.16  # maximum yaw: 35 degrees per second at 4 Hz
    max_pitch_rad: Positive = 0.03  # maximum change of pitch between two images
    below_horizon_rad: Positive = 0.03  # lower edge of the blocks below the horizon
    least_contrast: Positive = 0.08  # minimum standard deviation of a block's log brightness, above that of sky
    least_correlation: Annotated[float, msgspec.Meta(ge=0.0, lt=1.0)] = 0.4  # minimum correlation of a block
    max_length_m: Positive = 8.0  # maximum length: 40 m/s at 5 Hz
    lengths: Annotated[int, msgspec.Meta(ge=2)] = 80  # number of candidate lengths, in geometric progression
    max_tilt_rad: Positive = 0.05  # maximum error of the camera file's pitch
    tilts: Annotated[int, msgspec.Meta(ge=1)] = 9  # number of candidate pitches
    samples: Annotated[int, msgspec.Meta(ge=50)] = 900  # number of compared road pixels
    camera_ahead_m: Annotated[float, msgspec.Meta(ge=0.0)] = (
        1.7  # distance from the rear axle to the camera, for a passenger car
    )


class MotionInitialiser:
    """Searches for the motion between two images; the residuals of the flow then select among its guesses."""

    def __init__(self, camera: Camera, aligner: RoadAligner, config: InitialisationConfig) -> None:
        self.camera, self.config, self._aligner = camera, config, aligner
        # At most half the image's resolution
        self._scale = min(config.resolution_px, 0.5 * camera.fx_px)
        yaw = np.arctan((np.array([0.0, camera.width_px - 1.0]) - camera.cx_px) / camera.fx_px)
        slope = (np.array([0.0, camera.height_px - 1.0]) - camera.cy_px) / camera.fy_px
        yaws, slopes = (np.arange(low, high, 1.0 / self._scale) for low, high in (yaw, slope))
        self._rows_used = int(np.searchsorted(slopes, config.below_horizon_rad - camera.pitch_rad))
        grid_yaw, grid_slope = np.meshgrid(yaws, slopes)
        self._u = (np.tan(grid_yaw) * camera.fx_px + camera.cx_px).astype(np.float32)
        self._v = (grid_slope / np.cos(grid_yaw) * camera.fy_px + camera.cy_px).astype(np.float32)
        self._lengths_m = np.geomspace(0.03, config.max_length_m, config.lengths)
        self._pitches_rad = camera.pitch_rad + np.linspace(-1.0, 1.0, config.tilts) * config.max_tilt_rad

    def guesses(self, past: NDArray[np.uint8], present: NDArray[np.uint8]) -> list[Pose]:
        """T_past_present candidates of (H, W) grey images: the rotation alone, and with the translation."""
        turned = self.search_rotation(past, present)
        road = [self._aligner.image(image) for image in (past, present)]
        return [Pose(turned, np.zeros(3)), self.road_motion(turned, *road)]

    # --- rotation ---

    def search_rotation(self, past: NDArray[np.uint8], present: NDArray[np.uint8]) -> Floats:
        """(3, 3) R_past_present from yaw and pitch, to about half a degree; roll is neglected."""
        cfg = self.config
        then, now = self._to_cylinder(past), self._to_cylinder(present)
        reach = tuple(int(np.ceil(angle * self._scale)) for angle in (cfg.max_pitch_rad, cfg.max_yaw_rad))
        border = (reach[0], reach[0], reach[1], reach[1])
        bordered = np.asarray(cv2.copyMakeBorder(then, *border, cv2.BORDER_REPLICATE), np.float32)
        textured = _contrast(bordered) > 0.5 * cfg.least_contrast  # elsewhere the correlation is rounding error
        votes = np.zeros((2 * reach[0] + 1, 2 * reach[1] + 1), np.float32)
        rows, cols = _BLOCK_SHAPE
        for v in range(0, max(self._rows_used - rows, 0) + 1, rows // 2):
            for u in range(0, now.shape[1] - cols + 1, cols // 2):
                block = now[v : v + rows, u : u + cols]
                if block.shape != _BLOCK_SHAPE or float(block.std()) < cfg.least_contrast:
                    continue
                where = bordered[v : v + rows + 2 * reach[0], u : u + cols + 2 * reach[1]]
                score = cv2.matchTemplate(where, block, cv2.TM_CCOEFF_NORMED)
                there = textured[v : v + score.shape[0], u : u + score.shape[1]]
                votes += np.where(there, np.maximum(score - cfg.least_correlation, 0.0), 0.0)
        if not votes.any():
            return np.eye(3)
        # Smoothing favours true peaks, whose votes spread over neighbouring cells
        j, i = np.unravel_index(int(cv2.GaussianBlur(votes, (3, 3), 0.0).argmax()), votes.shape)
        return rotation_exp(np.array([(j - reach[0]) / self._scale, (i - reach[1]) / self._scale, 0.0]))

    def _to_cylinder(self, image: NDArray[np.uint8]) -> Grey:
        """Projects an image to the cylinder, log brightness; columns are yaw angles, rows are slopes."""
        smooth = cv2.GaussianBlur(image, (0, 0), 0.5 * self.camera.fx_px / self._scale)
        out = cv2.remap(smooth, self._u, self._v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return np.asarray(np.log(out.astype(np.float32) + np.float32(10.0)), np.float32)

    # --- length ---

    def road_motion(self, R_past_present: Floats, past: RoadImage, present: RoadImage) -> Pose:
        """T_past_present of this rotation with the length that explains most of the road."""
        yaw_rad = float(np.arctan2(R_past_present[0, 2], R_past_present[2, 2]))
        motions, explained = [], []
        for pitch_rad in map(float, self._pitches_rad):
            tilt = pitch_rad, self.camera.roll_rad
            px = self._aligner.samples(tilt, _NO_BOXES, None)
            px = px[:: max(1, len(px) // self.config.samples)]
            if len(px) >= 50:
                motions.append(self._translations(yaw_rad, pitch_rad))
                explained.append(explained_by_motion(self.camera, past, present, R_past_present, motions[-1], px, tilt))
        if not motions:
            return Pose(R_past_present, np.zeros(3))
        pitch, length = best_length(np.array(explained))
        return Pose(R_past_present, motions[pitch][length])

    def _translations(self, yaw_rad: float, pitch_rad: float) -> Floats:
        """(L, 3) translations of the camera for arcs of constant curvature of the rear axle."""
        half, ahead_m = 0.5 * yaw_rad, self.config.camera_ahead_m * np.sin(yaw_rad)
        forward = self._lengths_m * np.cos(half)
        return np.column_stack([self._lengths_m * np.sin(half) + ahead_m, -np.tan(pitch_rad) * forward, forward])


def _contrast(image: Grey) -> Grey:
    """Standard deviation of the block that starts at each pixel."""
    size = (_BLOCK_SHAPE[1], _BLOCK_SHAPE[0])
    mean = cv2.boxFilter(image, cv2.CV_32F, size, anchor=(0, 0))
    square = cv2.sqrBoxFilter(image, cv2.CV_32F, size, anchor=(0, 0))
    return np.asarray(np.sqrt(np.maximum(square - mean * mean, 0.0)), np.float32)
