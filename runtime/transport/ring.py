"""Images between processes: a ring of slots in shared memory, one writer, any number of readers.

The writer never waits; a reader that lags by more than `slots - 1` frames gets None. A sequence lock (odd during a
write) and a checksum over pixels, shape and sequence protect each slot; `FrameReader.read` copies, then verifies. A
restarted writer replaces the file atomically, with a new `epoch` (FrameRef.ring_epoch).
"""

from __future__ import annotations

import mmap
import os
import time
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from birdslam.runtime.transport.closing import Closing
from birdslam.types import FrameRef

_MAGIC = int.from_bytes(b"BIRDRING", "little")
_LAYOUT = 1  # increment when the layout below changes
_HEAD_WORDS = 8  # magic, layout, epoch, slots, bytes of a slot, then the largest frame: height, width, channels
_SLOT_WORDS = 8  # sequence, height, width, channels, checksum; the rest is spare. The pixels follow
_WORD_BYTES = 8
_MAX_SIDE_PX = 16_384
_MAX_SLOTS = 64
_MIX = 0x9E3779B97F4A7C15  # odd multiplier that spreads each number of a slot's head over all bits

Image = NDArray[np.uint8]


class FrameError(ValueError):
    """An image that does not fit the ring, or a file that is not a ring."""


def _slot_bytes(height_px: int, width_px: int, channels: int) -> int:
    pixels_bytes = height_px * width_px * channels
    return _WORD_BYTES * _SLOT_WORDS + -(-pixels_bytes // 64) * 64


# On x86-64 the sequence lock suffices: stores and loads keep their order, and each sequence is one 8-byte store.
# On a weaker memory model (ARM) it does not, and Python has no fences; the checksum over the copied bytes detects torn
# frames there. It costs about 20 us for a 1.4 MB image, so it is verified on all machines.
def _checksum(pixels: Image, sequence: int, height_px: int, width_px: int, channels: int) -> int:
    """Returns the checksum of a flat, contiguous array of pixels and of the head that describes them."""
    whole = pixels.size // _WORD_BYTES * _WORD_BYTES
    total = int(np.add.reduce(pixels[:whole].view(np.uint64))) + int(np.add.reduce(pixels[whole:], dtype=np.uint64))
    for number in (sequence, height_px, width_px, channels):
        total = (total ^ number) * _MIX
    return total % (1 << 64)


def _check_frame(height_px: int, width_px: int, channels: int) -> None:
    if not (0 < height_px <= _MAX_SIDE_PX and 0 < width_px <= _MAX_SIDE_PX and channels in (1, 3)):
        raise FrameError(f"no frame of a camera: {width_px}x{height_px} px of {channels} channels")


class _Mapping:
    """The memory-mapped file of a ring, as words and as bytes, for writer and reader."""

    def __init__(self, fd: int, size: int, writable: bool) -> None:
        access = mmap.PROT_READ | mmap.PROT_WRITE if writable else mmap.PROT_READ
        memory = mmap.mmap(fd, size, flags=mmap.MAP_SHARED | mmap.MAP_POPULATE, prot=access)  # unmapped with its views
        self.bytes: NDArray[np.uint8] = np.frombuffer(memory, dtype=np.uint8)
        self.words: NDArray[np.uint64] = np.frombuffer(memory, dtype=np.uint64)

    def head(self) -> list[int]:
        return [int(word) for word in self.words[:_HEAD_WORDS]]

    def slot(self, slot: int, slot_bytes: int) -> tuple[NDArray[np.uint64], Image]:
        """Returns views of the head and the pixels of one slot."""
        start = _WORD_BYTES * _HEAD_WORDS + slot * slot_bytes
        head = start // _WORD_BYTES
        pixels = self.bytes[start + _WORD_BYTES * _SLOT_WORDS : start + slot_bytes]
        return self.words[head : head + _SLOT_WORDS], pixels


class FrameRing(Closing):
    """Creates and writes the ring at `path`, sized for the camera's largest frame; a context manager.

    Replaces the file of a dead process (VehicleLock excludes a second writer) and removes its own file on close.
    Raises FrameError for an implausible frame size, and OSError with the path if there is not enough memory.
    """

    def __init__(self, path: Path, height_px: int, width_px: int, channels: int = 3, slots: int = 8) -> None:
        _check_frame(height_px, width_px, channels)
        if not 2 <= slots <= _MAX_SLOTS:
            raise FrameError(f"a ring needs 2 to {_MAX_SLOTS} slots, got {slots}")
        self.path, self.slots, self.epoch = path, slots, time.time_ns()
        self._limits = height_px, width_px, channels
        self._slot_bytes = _slot_bytes(*self._limits)
        self._written = 0
        size = _WORD_BYTES * _HEAD_WORDS + slots * self._slot_bytes
        draft = path.with_name(path.name + ".draft")
        draft.unlink(missing_ok=True)
        fd = os.open(draft, os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC | os.O_NOFOLLOW, 0o600)
        try:
            try:
                os.posix_fallocate(fd, 0, size)
            except OSError as error:  # fail here instead of with a SIGBUS on the first write
                raise OSError(error.errno, f"no room for a ring of {size} B: {error.strerror}", str(path)) from error
            self._mapping: _Mapping | None = _Mapping(fd, size, writable=True)
            head = (_MAGIC, _LAYOUT, self.epoch, slots, self._slot_bytes, *self._limits)
            self._mapping.words[:_HEAD_WORDS] = head
            self._inode = os.fstat(fd).st_ino
            os.rename(draft, path)
        finally:
            os.close(fd)
            draft.unlink(missing_ok=True)

    def write(self, image: Image) -> tuple[int, int]:
        """Writes an image, (H, W) or (H, W, 3) uint8, into the next slot; returns (slot, sequence) for its FrameRef.

        Raises FrameError for another shape or type, and for an image larger than the ring's frame size.
        """
        if self._mapping is None:
            raise FrameError(f"the ring {self.path} is closed")
        height_px, width_px = image.shape[:2] if image.ndim in (2, 3) else (0, 0)
        channels = image.shape[2] if image.ndim == 3 else 1
        _check_frame(height_px, width_px, channels)
        if image.dtype != np.uint8:
            raise FrameError(f"the ring takes pixels of uint8, not {image.dtype}")
        if any(size > limit for size, limit in zip((height_px, width_px, channels), self._limits, strict=True)):
            limits = f"{self._limits[1]}x{self._limits[0]} px of {self._limits[2]} channels"
            raise FrameError(f"{width_px}x{height_px} px of {channels} channels don't fit a ring of {limits}")
        turn, slot = divmod(self._written, self.slots)
        self._written += 1
        sequence = 2 * (turn + 1)
        head, pixels = self._mapping.slot(slot, self._slot_bytes)
        pixels = pixels[: image.size]
        head[0] = sequence - 1
        np.copyto(pixels.reshape(image.shape), image)
        head[1:5] = height_px, width_px, channels, _checksum(pixels, sequence, height_px, width_px, channels)
        head[0] = sequence
        return slot, sequence

    def close(self) -> None:
        """Removes the ring with its unread frames. A second call does nothing."""
        if self._mapping is None:
            return
        self._mapping = None
        try:
            if self.path.stat().st_ino == self._inode:  # else a newer writer has replaced it
                self.path.unlink()
        except FileNotFoundError:
            return


class FrameReader(Closing):
    """Reads the ring at `path`, which need not exist yet; survives restarts of the writer. A context manager."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._mapping: _Mapping | None = None
        self._epoch = self._slots = self._slot_bytes = 0

    def read(self, ref: FrameRef, out: Image | None = None) -> Image | None:
        """Returns a copy of the pixels of `ref`, (H, W) or (H, W, 3), or None if they are overwritten, torn or missing.

        Copies into `out` if given (contiguous, of the frame's shape); after None its content is undefined.
        Raises FrameError for another shape of `out`, and if the file is not a ring of this layout.
        """
        if ref.slot < 0 or (ref.ring_epoch != self._epoch and not self._open(ref.ring_epoch)):
            return None
        mapping, shape = self._mapping, (ref.height_px, ref.width_px, ref.channels)
        pixels_bytes = ref.height_px * ref.width_px * ref.channels
        if mapping is None or ref.slot >= self._slots or min(shape) < 1 or ref.channels not in (1, 3):
            return None
        head, pixels = mapping.slot(ref.slot, self._slot_bytes)
        if pixels_bytes > pixels.size or int(head[0]) != ref.sequence:
            return None
        image_shape = shape if ref.channels == 3 else shape[:2]
        if out is None:
            out = np.empty(image_shape, dtype=np.uint8)
        elif out.shape != image_shape or out.dtype != np.uint8 or not out.flags.c_contiguous:
            raise FrameError(f"a frame of {image_shape} needs a contiguous buffer of that shape, got {out.shape}")
        np.copyto(out.reshape(-1), pixels[:pixels_bytes])
        checksum = int(head[4])
        if int(head[0]) != ref.sequence or checksum != _checksum(out.reshape(-1), ref.sequence, *shape):
            return None
        return out

    def _open(self, epoch: int) -> bool:
        """Maps the current ring at the path; returns whether its epoch is `epoch`."""
        try:
            fd = os.open(self.path, os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW)
        except FileNotFoundError:
            return False
        try:
            state = os.fstat(fd)
            if state.st_uid != os.getuid() or state.st_size < _WORD_BYTES * _HEAD_WORDS:
                raise FrameError(f"{self.path} is no ring of user {os.getuid()}")
            mapping = _Mapping(fd, state.st_size // _WORD_BYTES * _WORD_BYTES, writable=False)
        finally:
            os.close(fd)
        magic, layout, found_epoch, slots, slot_bytes, *limits = mapping.head()
        if (magic, layout) != (_MAGIC, _LAYOUT):
            raise FrameError(f"{self.path} is no ring of layout {_LAYOUT}")
        if slot_bytes != _slot_bytes(*limits) or state.st_size != _WORD_BYTES * _HEAD_WORDS + slots * slot_bytes:
            raise FrameError(f"{self.path} has {state.st_size} B, which does not match its header")
        if found_epoch != epoch:
            return False
        self._mapping, self._epoch, self._slots, self._slot_bytes = mapping, epoch, slots, slot_bytes
        return True

    def close(self) -> None:
        """Unmaps the ring."""
        self._mapping, self._epoch = None, 0
