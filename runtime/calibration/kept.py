"""The networks' results of a drive, kept for a second pass over the same images: they do not depend on the tilt."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from birdslam.frontend import Pending
from birdslam.geometry.arrays import Bools, Image
from birdslam.perception import Networks, Perception, Ready, Segmentation
from birdslam.types import Frame


@dataclass(frozen=True)
class _Packed:
    """A segmentation with a bit for each pixel: the masks of a minute of film then take some 100 MB."""

    road: Image
    lane: Image
    shape: tuple[int, ...]

    def unpack(self) -> Segmentation:
        return Segmentation(self._mask(self.road), self._mask(self.lane))

    def _mask(self, bits: Image) -> Bools:
        height, width = self.shape
        return np.unpackbits(bits, count=height * width).view(np.bool_).reshape(height, width)


class KeptResults:
    """Runs the networks in a first pass, and returns the same results in all further ones.

    Depth maps are not kept, since they would take gigabytes: with one the networks run in each pass.
    """

    def __init__(self, networks: Networks) -> None:
        self._networks = networks
        self._kept: dict[int, tuple[Perception, _Packed | None]] = {}  # by frame
        self._packed: tuple[Segmentation, _Packed] | None = None  # of the last frame: masks are carried
        self._unpacked: tuple[_Packed, Segmentation] | None = None
        self._is_complete = False

    def of_frames(self, frames: Iterable[Frame]) -> Iterator[tuple[Frame, Pending]]:
        """Yields each frame with its perception, as `Networks.in_order`."""
        if self._is_complete:
            for frame in frames:
                yield frame, Ready(self._unpack(*self._kept.get(frame.frame_id, (Perception(), None))))
            return
        has_depth = False
        for frame, pending in self._networks.in_order(frames):
            taken = _Taken(pending)
            yield frame, taken
            if taken.perception is not None and not has_depth:
                has_depth = taken.perception.depth is not None
                self._kept[frame.frame_id] = self._pack(taken.perception)
        self._is_complete = not has_depth

    def _pack(self, perception: Perception) -> tuple[Perception, _Packed | None]:
        masks = perception.segmentation
        if masks is None:
            return perception, None
        if self._packed is None or self._packed[0] is not masks:
            self._packed = masks, _Packed(np.packbits(masks.road), np.packbits(masks.lane), masks.road.shape)
        return replace(perception, segmentation=None), self._packed[1]

    def _unpack(self, perception: Perception, masks: _Packed | None) -> Perception:
        if masks is None:
            return perception
        if self._unpacked is None or self._unpacked[0] is not masks:
            self._unpacked = masks, masks.unpack()
        return replace(perception, segmentation=self._unpacked[1])


class _Taken:
    """A pending perception that keeps its result."""

    def __init__(self, pending: Pending) -> None:
        self._pending = pending
        self.perception: Perception | None = None

    def result(self) -> Perception:
        self.perception = self._pending.result()
        return self.perception
