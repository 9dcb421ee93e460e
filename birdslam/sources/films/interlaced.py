"""Detects interlaced H.264 films, which some builds of OpenCV decode to nothing without an error (FFmpeg 8).

In the sequence parameter set (ISO/IEC 14496-10, 7.3.2.1) `frame_mbs_only_flag` is 0 if a frame may have two fields.
"""

from __future__ import annotations

from pathlib import Path

import cv2

_SEARCHED_BYTES = 1 << 20  # at the start and the end of a film
_HIGH_PROFILES = {44, 83, 86, 100, 110, 118, 122, 128, 138, 139, 134, 135, 244}
_TESTED_IMAGES = 3


def is_undecoded(path: Path) -> bool:
    """Whether a film is interlaced and OpenCV does not write its images."""
    return may_be_interlaced(path) and _leaves_images_unchanged(path)


def may_be_interlaced(path: Path) -> bool:
    """From the first sequence parameter set; False without one."""
    size = path.stat().st_size
    with path.open("rb") as file:
        data = file.read(_SEARCHED_BYTES)
        file.seek(max(0, size - _SEARCHED_BYTES))
        data += file.read()
    at = data.find(b"avcC")
    begin = at + 12 if at >= 0 else data.find(b"\x00\x00\x01\x67") + 3  # after sizes and counts; after a start code
    if begin < 4 or begin >= len(data) or data[begin] & 0x1F != 7:
        return False
    try:
        return not _frame_mbs_only(_Bits(data[begin + 1 : begin + 200].replace(b"\x00\x00\x03", b"\x00\x00")))
    except (IndexError, ValueError):
        return False


def _leaves_images_unchanged(path: Path) -> bool:
    capture = cv2.VideoCapture(str(path))
    images = [capture.read()[1] for _ in range(_TESTED_IMAGES)]
    capture.release()
    shown = {image.tobytes() for image in images if image is not None}
    return len(shown) == 1 and all(image is not None for image in images)


class _Bits:
    """Reads bits and Exp-Golomb codes (9.1). Raises IndexError at the end."""

    def __init__(self, data: bytes) -> None:
        self._data, self._at = data, 0

    def bits(self, count: int) -> int:
        out = 0
        for _ in range(count):
            out = out << 1 | self._data[self._at >> 3] >> (7 - (self._at & 7)) & 1
            self._at += 1
        return out

    def ue(self) -> int:
        zeros = 0
        while not self.bits(1):
            zeros += 1
        return (1 << zeros) - 1 + self.bits(zeros)


def _frame_mbs_only(bits: _Bits) -> bool:
    """Raises ValueError for scaling matrices, which are not supported."""
    profile = bits.bits(8)
    bits.bits(16)  # constraints, level
    bits.ue()  # number of the set
    if profile in _HIGH_PROFILES:
        if bits.ue() == 3:
            bits.bits(1)
        bits.ue()
        bits.ue()
        if bits.bits(2) & 1:
            raise ValueError("scaling matrices")
    bits.ue()  # of frame numbers
    order = bits.ue()
    if order == 0:
        bits.ue()
    elif order == 1:
        bits.bits(1)
        bits.ue()
        bits.ue()
        for _ in range(bits.ue()):
            bits.ue()
    bits.ue()  # reference frames
    bits.bits(1)
    bits.ue()  # width
    bits.ue()  # height
    return bool(bits.bits(1))
