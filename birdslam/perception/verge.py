"""Removes the grass verge from road masks by excess green (Woebbecke et al. 1995).

A network trained on other roads takes a verge for road where no kerb divides them. Grass is no plane and has far more
texture than asphalt, so that the alignment of the road would see little else. Excess green separates them in any light
that shows colours:  2 g - r - b,  with r, g, b = R, G, B over R + G + B.  It counts from the road's own level where
that is green itself (white balance, light), else from grey.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from birdslam.geometry.arrays import Bools

SHRINK = 4  # downscaling: single blades and the camera's noise do not count
# Above the road's level, of a pixel that shows grass. On five images of KITTI tracking 0005 the lane's pixels lie
# within 0.03 of their median, and 19 of 20 of the verge's 0.1 to 0.3 above it
MIN_EXCESS = 0.06
ROAD_SHARE = 0.3  # the road's level is this quantile of the mask, of which 70 % may be grass
DARKEST = 60.0  # of R + G + B: darker pixels have no reliable colour
MIN_PIXELS = 50  # of a downscaled mask, for the level


def without_verge(road: Bools, image: NDArray[np.uint8]) -> Bools:
    """The road mask (H, W) without its green pixels in the BGR image (H, W, 3); unchanged for a grey one (H, W)."""
    if image.ndim != 3:
        return road
    top = int(road.any(axis=1).argmax())  # no road above
    rows, columns = (road.shape[0] - top) // SHRINK, road.shape[1] // SHRINK
    if not (rows and columns):
        return road
    part = slice(top, top + SHRINK * rows), slice(0, SHRINK * columns)  # an integer factor is by far the fastest
    small = cv2.resize(image[part], (columns, rows), interpolation=cv2.INTER_AREA)
    blue, green, red = (plane.astype(np.float32) for plane in cv2.split(small))
    sums = blue + green + red
    excess = 3.0 * green / np.maximum(sums, 1.0) - 1.0  # 2 g - r - b, since r + g + b = 1
    coloured = road[part][SHRINK // 2 :: SHRINK, SHRINK // 2 :: SHRINK] & (sums > DARKEST)
    excess_road = excess[coloured]
    if len(excess_road) < MIN_PIXELS:
        return road
    at = int(ROAD_SHARE * len(excess_road))
    level = max(
        float(np.partition(excess_road, at)[at]), 0.0
    )  # red bricks and cars in a mask must not make a grey road count as green
    # A single pixel is a leaf on the road, or a marking's fringe
    grass = cv2.medianBlur((coloured & (excess > level + MIN_EXCESS)).view(np.uint8), 3)
    out = road.copy()
    size = SHRINK * columns, SHRINK * rows
    out[part] &= cv2.resize(grass, size, interpolation=cv2.INTER_NEAREST) == 0
    return out
