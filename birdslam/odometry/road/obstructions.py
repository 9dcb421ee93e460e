"""Obstructions of the road in the image: a fixed pattern on the windscreen, and the car's own bonnet."""

from __future__ import annotations

from functools import partial

import numpy as np
from numpy.typing import NDArray

from birdslam.geometry.pose import Pose
from birdslam.odometry.obstruction.bonnet import Bonnet
from birdslam.odometry.obstruction.fixed_pattern import FixedPattern
from birdslam.odometry.road.alignment import RoadAligner
from birdslam.odometry.road.keyframe_images import RoadFrame
from birdslam.odometry.road.road_image import RoadImage
from birdslam.odometry.scale_config import RoadScaleConfig

_MOVING_PX = 3.0  # flow below the horizon between two images, above which the car moves


class RoadObstructions:
    """State: the fixed pattern and the bonnet. Reader: `RoadScale`."""

    def __init__(self, aligner: RoadAligner, config: RoadScaleConfig) -> None:
        self._aligner = aligner
        self._min_baseline_m = config.fixed_pattern.min_baseline_m
        self._fixed_pattern = FixedPattern(config.fixed_pattern)
        self._bonnet = Bonnet(config.bonnet)

    @property
    def bonnet_px(self) -> NDArray[np.float64] | None:
        """(W, 2) upper edge of the car's own bonnet in the image; None if none is visible."""
        rows = self._bonnet.rows
        return None if rows is None else np.column_stack([np.arange(len(rows)), rows]).astype(np.float64)

    @property
    def has_fixed_pattern(self) -> bool:
        """Whether the image of the road has a fixed pattern."""
        return self._fixed_pattern.present

    @property
    def is_obstructed(self) -> bool:
        """Whether anything obstructs the road."""
        return self._fixed_pattern.present or self._bonnet.present

    def initialise(self, grey: NDArray[np.uint8]) -> None:
        """Detects a bonnet in the first image."""
        if not self._bonnet.is_initialised:
            self._bonnet.update(grey, self._aligner.top_px, np.inf)

    def correct(self, grey: NDArray[np.uint8], travelled_m: float) -> RoadFrame:
        """The road in the current image, `travelled_m` after the last one, corrected for a fixed pattern."""
        raw, top_px = self._aligner.image(grey), self._aligner.top_px
        self._fixed_pattern.update_mean(grey, top_px, travelled_m)
        if not self._fixed_pattern.present:
            return RoadFrame(raw, raw)
        return RoadFrame(raw, RoadImage.from_normalised(self._fixed_pattern.subtract(grey, top_px), top_px))

    def detect_pattern_change(
        self,
        keyframe: RoadFrame,
        frame: RoadFrame,
        px: NDArray[np.int64],
        T_m: Pose,
        road: NDArray[np.float64],
        flow_px: float,
    ) -> bool:
        """Whether a fixed pattern has appeared or disappeared.

        `T_m` is T_keyframe_present in metres, `road` (4,) the predicted measurement of an alignment, `flow_px` the
        optical flow below the horizon.
        """
        baseline_m = float(np.linalg.norm(T_m.p))
        driven_m = baseline_m if flow_px < _MOVING_PX else np.inf
        warp = None
        if baseline_m >= self._min_baseline_m:  # a shorter motion warps an image onto itself
            warp = partial(self._aligner.warp, keyframe.raw, T_m, px, np.append(0.0, road[1:]))
        return self._fixed_pattern.detect(keyframe.raw, frame.raw, px, driven_m, warp)

    def detect_bonnet_change(self, grey: NDArray[np.uint8], driven_m: float | None, flow_px: float) -> bool:
        """Whether a bonnet has appeared or disappeared; without a metric `driven_m`, `flow_px` decides on motion."""
        if driven_m is None:
            if flow_px < _MOVING_PX:
                return False
            driven_m = np.inf
        return self._bonnet.update(grey, self._aligner.top_px, driven_m)

    def exclude_bonnet(self, px: NDArray[np.int64]) -> NDArray[np.int64]:
        """The pixels (M, 2) of (N, 2) that the bonnet does not cover."""
        return self._bonnet.above(px)
