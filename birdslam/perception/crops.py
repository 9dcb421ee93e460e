"""Size and heading of a vehicle from its own image, beside any detector: what goes in, and what comes out.

A vehicle's box is cut out at one scale along and across, and laid in the middle of a window. The network sees nothing
else: neither where the box is nor how large. What it says is independent of Eq. 1, which places the vehicle by where
its box ends.
"""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from birdslam.geometry.arrays import Floats

INPUT, OUTPUT = "image", "vehicle"
WINDOW = (96, 64)  # width and height of the input, px
MARGIN_PX = 8  # between the box and the window's edges
KINDS = ("car", "van", "truck", "bus")
CHANNELS = {
    "log_size": 3,  # length, width, height against MEAN_SIZE_M
    "log_b": 3,  # of the Laplace scales of these
    "axis": 2,  # cos and sin of twice alpha, times von Mises' concentration
    "front": 2,  # cos and sin of alpha, times the logit of "this end is the front"
    "kind": 4,  # logits
    "visible": 1,  # logit of the share of the body that nothing hides
}
MEAN_SIZE_M = (4.3, 1.8, 1.6)
_ENDS = np.cumsum(list(CHANNELS.values())).tolist()
_PART = {name: slice(end - CHANNELS[name], end) for name, end in zip(CHANNELS, _ENDS, strict=True)}


def cut_out(image: NDArray[np.uint8], box_px: Floats, spare: float = 1.0) -> NDArray[np.uint8]:
    """The window (H, W, 3) around a box (x1 y1 x2 y2, edges) of an image (H, W, 3), `spare` times as large.

    What lies outside of the image repeats its border.
    """
    x1, y1, x2, y2 = box_px.tolist()
    scale = min((WINDOW[0] - 2 * MARGIN_PX) / (x2 - x1), (WINDOW[1] - 2 * MARGIN_PX) / (y2 - y1))
    size = (round(WINDOW[0] * spare), round(WINDOW[1] * spare))
    # From pixels of the window to those of the image, both counted at their centres
    centre = np.array([x1 + x2, y1 + y2]) / 2.0
    shift = centre - np.array(size) / 2.0 / scale + 0.5 / scale - 0.5
    matrix = np.array([[1.0 / scale, 0.0, shift[0]], [0.0, 1.0 / scale, shift[1]]])
    if scale < 0.5:  # shrunk to more than half: no aliasing
        reach = np.ceil(np.array(size) / scale / 2.0 + 2.0)
        low = np.maximum(np.floor(centre - reach), 0).astype(int)
        high = np.minimum(np.ceil(centre + reach), [image.shape[1], image.shape[0]]).astype(int)
        part = image[low[1] : high[1], low[0] : high[0]]
        small = cv2.resize(part, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        ratio = np.array([small.shape[1] / part.shape[1], small.shape[0] / part.shape[0]])
        shift = ((matrix[:, 2] - low) + 0.5) * ratio - 0.5
        image = small.astype(np.uint8, copy=False)
        matrix = np.column_stack([np.diag(ratio / scale), shift])
    out = cv2.warpAffine(
        image, matrix, size, flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP, borderMode=cv2.BORDER_REPLICATE
    )
    return out.astype(np.uint8, copy=False)


def read_size_m(out: Floats) -> Floats:
    """(3,) length, width, height by one vehicle's outputs (see CHANNELS)."""
    size_m: Floats = np.exp(out[_PART["log_size"]]) * MEAN_SIZE_M
    return size_m


def read_heading(out: Floats) -> tuple[float, float]:
    """By one vehicle's outputs: the observation angle alpha, and the probability that front and rear are swapped.

    As in `boxes3d.Boxes3d`: 0 faces away from the camera, pi/2 faces left; in (-pi, pi].
    """
    axis, front = out[_PART["axis"]], out[_PART["front"]]
    alpha_rad = 0.5 * math.atan2(axis[1], axis[0])  # modulo pi; the front says which end
    logit = front[0] * math.cos(alpha_rad) + front[1] * math.sin(alpha_rad)
    if logit < 0.0:
        alpha_rad -= math.copysign(math.pi, alpha_rad)
    return alpha_rad, 1.0 / (1.0 + math.exp(min(abs(logit), 60.0)))
