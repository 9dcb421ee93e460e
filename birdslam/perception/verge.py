"""Grass beside the road is green, roads are grey: what a road mask has of the verge is taken out of it.

A network that learned other roads than one's own takes a verge for road where no kerb divides them. Grass is no plane,
lies higher or lower than the lane, and has far more texture than asphalt: the odometry, which takes the road for one
plane, would see little else. Excess green (Woebbecke et al. 1995) tells the two apart in any light that shows colours:

    2 g - r - b,    r, g, b = R / (R + G + B), G / (R + G + B), B / (R + G + B)

It counts from the road's own level where that is green itself, by the camera's white balance or by the light, else from
grey.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

SHRINK = 4  # the image's pixels on one that is looked at: single blades and the camera's noise do not count
# Over the road's level a pixel of the mask shows grass. On five images of KITTI tracking 0005 the lane's pixels lie
# within 0.03 of their median, and 19 of 20 of the verge's 0.1 to 0.3 above it
LEAST_EXCESS = 0.06
ROAD_SHARE = 0.3  # of the mask's pixels: their largest excess is the road's level, so that 70 % may be grass
DARKEST = 60.0  # of R + G + B: darker pixels have no colour that could be told
LEAST_PIXELS = 50  # of a mask, shrunk: fewer have no level


def without_verge(road: NDArray[np.bool_], image: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """The road mask (H, W) without what is green of it in the BGR image (H, W, 3); as it is for a grey one (H, W)."""
    if image.ndim != 3:
        return road
    top = int(road.any(axis=1).argmax())  # what lies above is sky and houses
    rows, columns = (road.shape[0] - top) // SHRINK, road.shape[1] // SHRINK
    if not (rows and columns):
        return road
    part = slice(top, top + SHRINK * rows), slice(0, SHRINK * columns)  # a whole factor shrinks by far the fastest
    small = cv2.resize(image[part], (columns, rows), interpolation=cv2.INTER_AREA)
    blue, green, red = (plane.astype(np.float32) for plane in cv2.split(small))
    sums = blue + green + red
    excess = 3.0 * green / np.maximum(sums, 1.0) - 1.0  # 2 g - r - b, since r + g + b = 1
    told = road[part][SHRINK // 2 :: SHRINK, SHRINK // 2 :: SHRINK] & (sums > DARKEST)
    seen = excess[told]
    if len(seen) < LEAST_PIXELS:
        return road
    at = int(ROAD_SHARE * len(seen))
    level = max(float(np.partition(seen, at)[at]), 0.0)  # red bricks and cars in a mask make no grey road green
    # A pixel that stands alone is a leaf on the road, or a marking's fringe
    grass = cv2.medianBlur((told & (excess > level + LEAST_EXCESS)).view(np.uint8), 3)
    out = road.copy()
    size = SHRINK * columns, SHRINK * rows
    out[part] &= cv2.resize(grass, size, interpolation=cv2.INTER_NEAREST) == 0
    return out
