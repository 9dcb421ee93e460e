"""Removes the grass verge from road masks by excess green (Woebbecke et al. 1995).

Networks trained on other roads label a verge without a kerb as road. Its texture would dominate the alignment of the
road. Excess green, 2 g - r - b with r, g, b = R, G, B over R + G + B, is compared with the road's own level, or with
grey if that is higher.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from birdslam.geometry.arrays import Bools

SHRINK = 4  # downscaling suppresses single blades and noise
# Min. excess of grass over the road's level
MIN_EXCESS = 0.06
ROAD_SHARE = 0.3  # the road's level is this quantile of the mask, up to 70 % of which may be grass
MIN_BRIGHTNESS = 60.0  # of R + G + B: darker pixels have no reliable colour
MIN_PIXELS = 50  # of a downscaled mask, for the level


def without_verge(road: Bools, image: NDArray[np.uint8]) -> Bools:
    """The road mask (H, W) without its green pixels in the BGR image (H, W, 3); unchanged for a grey one (H, W)."""
    if image.ndim != 3:
        return road
    top = int(road.any(axis=1).argmax())  # no road above
    rows, columns = (road.shape[0] - top) // SHRINK, road.shape[1] // SHRINK
    if not (rows and columns):
        return road
    part = slice(top, top + SHRINK * rows), slice(0, SHRINK * columns)  # an integer factor is the fastest
    small = cv2.resize(image[part], (columns, rows), interpolation=cv2.INTER_AREA)
    blue, green, red = (plane.astype(np.float32) for plane in cv2.split(small))
    sums = blue + green + red
    excess = 3.0 * green / np.maximum(sums, 1.0) - 1.0  # 2 g - r - b, since r + g + b = 1
    coloured = road[part][SHRINK // 2 :: SHRINK, SHRINK // 2 :: SHRINK] & (sums > MIN_BRIGHTNESS)
    excess_road = excess[coloured]
    if len(excess_road) < MIN_PIXELS:
        return road
    at = int(ROAD_SHARE * len(excess_road))
    level = max(
        float(np.partition(excess_road, at)[at]), 0.0
    )  # red bricks and cars in a mask must not make a grey road count as green
    # A single pixel is a leaf on the road or the fringe of a marking
    grass = cv2.medianBlur((coloured & (excess > level + MIN_EXCESS)).view(np.uint8), 3)
    out = road.copy()
    size = SHRINK * columns, SHRINK * rows
    out[part] &= cv2.resize(grass, size, interpolation=cv2.INTER_NEAREST) == 0
    return out
