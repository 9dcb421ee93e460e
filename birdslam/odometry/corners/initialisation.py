"""The motion between two images without a motion model: at the start and after a loss of tracking, it is searched for.

Optical flow reaches as far as its pyramid: 16 px sideways; a car in a bend of 21 m radius at 10 Hz turns by 33 px.
- Rotation: on a cylinder about the vertical axis a yaw shifts the whole image. Blocks above the horizon, which are
  mostly far away, vote for the shift (yaw and pitch) by normalised cross-correlation, independent of the exposure.
- Length: with that rotation the road's image is compared over travelled distance and pitch (road/scale_search.py). The
  car rolls on its rear axle, so that the direction follows from the rotation and the length.
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
from birdslam.odometry.road.scale_search import best_correlation, correlations, far_changed_pixels

Floats = NDArray[np.float64]
Grey = NDArray[np.float32]
Positive = Annotated[float, msgspec.Meta(gt=0.0)]

_BLOCK_SHAPE = (14, 24)  # rows and columns on the cylinder: 4.5 by 8 degrees; an image has some dozens
_NO_BOXES = np.zeros((0, 4))


class InitialisationConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """How far a car turns and drives from one image to the next."""

    resolution_px: Positive = 180.0  # of a radian on the cylinder: 0.3 degrees a pixel, within reach of the flow
    max_yaw_rad: Positive = 0.16  # 35 degrees a second at 4 Hz
    max_pitch_rad: Positive = 0.03  # change of the car's pitch from one image to the next
    below_horizon_rad: Positive = 0.03  # lower edge of the blocks, for a camera that looks up or down
    least_contrast: Positive = 0.08  # standard deviation of a block's log brightness: the sky has less
    least_correlation: Annotated[float, msgspec.Meta(ge=0.0, lt=1.0)] = 0.4  # a block of less has no vote
    max_length_m: Positive = 8.0  # 40 m/s at 5 Hz
    lengths: Annotated[int, msgspec.Meta(ge=2)] = 80  # tried, each 6 % longer than the one before
    max_tilt_rad: Positive = 0.05  # of the camera's pitch against the file's
    tilts: Annotated[int, msgspec.Meta(ge=1)] = 9  # pitches that are tried
    samples: Annotated[int, msgspec.Meta(ge=50)] = 900  # pixels of the road that are compared
    camera_ahead_m: Annotated[float, msgspec.Meta(ge=0.0)] = 1.7  # of the rear axle, in a passenger car


class MotionInitialiser:
    """Searches the motion between two images of one camera; the flow's residuals then select among its guesses."""

    def __init__(self, camera: Camera, aligner: RoadAligner, config: InitialisationConfig) -> None:
        self.camera, self.config, self._aligner = camera, config, aligner
        # No finer than half the image's own resolution
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
        """T_past_present of (H, W) grey images: the rotation alone, and with the translation found on the road."""
        turned = self.search_rotation(past, present)
        road = [self._aligner.image(image) for image in (past, present)]
        return [Pose(turned, np.zeros(3)), self.road_motion(turned, *road)]

    # --- rotation ---

    def search_rotation(self, past: NDArray[np.uint8], present: NDArray[np.uint8]) -> Floats:
        """(3, 3) R_past_present by yaw and pitch, to half a degree or so; the car's roll is less than that."""
        cfg = self.config
        then, now = self._to_cylinder(past), self._to_cylinder(present)
        reach = tuple(int(np.ceil(angle * self._scale)) for angle in (cfg.max_pitch_rad, cfg.max_yaw_rad))
        border = (reach[0], reach[0], reach[1], reach[1])
        bordered = np.asarray(cv2.copyMakeBorder(then, *border, cv2.BORDER_REPLICATE), np.float32)
        textured = _contrast(bordered) > 0.5 * cfg.least_contrast  # elsewhere a correlation is rounding error
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
        # The votes of a true peak spread over its neighbours, those of a chance one do not
        j, i = np.unravel_index(int(cv2.GaussianBlur(votes, (3, 3), 0.0).argmax()), votes.shape)
        return rotation_exp(np.array([(j - reach[0]) / self._scale, (i - reach[1]) / self._scale, 0.0]))

    def _to_cylinder(self, image: NDArray[np.uint8]) -> Grey:
        """Log brightness; columns are equal angles of yaw, rows equal slopes against the axis."""
        smooth = cv2.GaussianBlur(image, (0, 0), 0.5 * self.camera.fx_px / self._scale)
        out = cv2.remap(smooth, self._u, self._v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return np.asarray(np.log(out.astype(np.float32) + np.float32(10.0)), np.float32)

    # --- length ---

    def road_motion(self, R_past_present: Floats, past: RoadImage, present: RoadImage) -> Pose:
        """T_past_present of this rotation, with the length of best correlation on the road."""
        yaw_rad = float(np.arctan2(R_past_present[0, 2], R_past_present[2, 2]))
        views = []
        for pitch_rad in self._pitches_rad:
            px = self._aligner.samples((float(pitch_rad), self.camera.roll_rad), _NO_BOXES, None)
            px = px[:: max(1, len(px) // self.config.samples)]
            if len(px) >= 50:
                views.append((float(pitch_rad), self._translations(yaw_rad, float(pitch_rad)), px))

        def correlate(changed: bool) -> Floats:
            rows = []
            for pitch_rad, translations, px in views:
                tilt = (pitch_rad, self.camera.roll_rad)
                shown = far_changed_pixels(past, present, px) if changed else px
                rows.append(correlations(self.camera, past, present, R_past_present, translations, shown, tilt))
            return np.array(rows)

        if not views:
            return Pose(R_past_present, np.zeros(3))
        pitch, length = best_correlation(correlate, self._lengths_m)
        return Pose(R_past_present, views[pitch][1][length])

    def _translations(self, yaw_rad: float, pitch_rad: float) -> Floats:
        """(L, 3) translations of a camera in front of the rear axle, for arcs of constant curvature along the road."""
        half, ahead_m = 0.5 * yaw_rad, self.config.camera_ahead_m * np.sin(yaw_rad)
        forward = self._lengths_m * np.cos(half)
        return np.column_stack([self._lengths_m * np.sin(half) + ahead_m, -np.tan(pitch_rad) * forward, forward])


def _contrast(image: Grey) -> Grey:
    """Standard deviation of the block whose first corner is at each pixel."""
    size = (_BLOCK_SHAPE[1], _BLOCK_SHAPE[0])
    mean = cv2.boxFilter(image, cv2.CV_32F, size, anchor=(0, 0))
    square = cv2.sqrBoxFilter(image, cv2.CV_32F, size, anchor=(0, 0))
    return np.asarray(np.sqrt(np.maximum(square - mean * mean, 0.0)), np.float32)
