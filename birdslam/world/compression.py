"""Compresses images as dashboard cameras do: H.264 without look-ahead, by the library av."""

from __future__ import annotations

from fractions import Fraction

import av
import cv2
import numpy as np
from av.codec.context import Flags

from birdslam.geometry.arrays import Image

GROUP = 12  # images per group of pictures; the first is intra-coded
QUANTISER = 32  # H.264's QP: coarse enough that smooth asphalt moves with its block, or freezes


class VideoEncoder:
    """`code` encodes and decodes the images of a video in order, all of one size."""

    def __init__(self, quantiser: int = QUANTISER) -> None:
        self._encoder = av.CodecContext.create("libx264", "w")
        self._encoder.pix_fmt, self._encoder.time_base = "yuv420p", Fraction(1, 25)
        self._encoder.options = {"qp": str(quantiser), "tune": "zerolatency", "g": str(GROUP), "threads": "1"}
        self._decoder = av.CodecContext.create("h264", "r")
        self._decoder.thread_type = "NONE"
        self._decoder.flags |= Flags.low_delay

    def code(self, image: Image) -> Image:
        """(H, W) grey or (H, W, 3) BGR uint8."""
        height, width = image.shape[:2]
        even = np.asarray(cv2.copyMakeBorder(image, 0, height % 2, 0, width % 2, cv2.BORDER_REPLICATE), np.uint8)
        form = "gray" if image.ndim == 2 else "bgr24"
        frame = av.VideoFrame.from_ndarray(even, form).reformat(format=self._encoder.pix_fmt)
        if not self._encoder.is_open:
            self._encoder.width, self._encoder.height = frame.width, frame.height
        (shown,) = (shown for packet in self._encoder.encode(frame) for shown in self._decoder.decode(packet))
        return np.ascontiguousarray(shown.to_ndarray(format=form)[:height, :width])
