"""Images between processes: a ring of slots in shared memory, one writer, any number of readers.

The writer never waits: a reader that is slower than `slots - 1` frames finds its frame overwritten, and gets None. A
slot is guarded by a sequence lock (odd while it is written) and by a checksum over the pixels, their shape and the
sequence: `FrameReader.read` copies first and verifies afterwards. The file is made under another name and renamed; a
writer that starts again replaces it under a new `epoch`, which readers see in FrameRef.ring_epoch.
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
_LAYOUT = 1  # raise it where the layout below changes
_HEAD_WORDS = 8  # magic, layout, epoch, slots, bytes of a slot, then the largest frame: height, width, channels
_SLOT_WORDS = 8  # sequence, height, width, channels, checksum; the rest is spare. The pixels follow
_WORD_BYTES = 8
_MAX_SIDE_PX = 16_384
_MAX_SLOTS = 64
_MIX = 0x9E3779B97F4A7C15  # odd, so that it spreads each number of a slot's head over the whole checksum

Image = NDArray[np.uint8]


class FrameError(ValueError):
    """An image does not fit the ring, or a file is not a ring."""


def _slot_bytes(height_px: int, width_px: int, channels: int) -> int:
    pixels_bytes = height_px * width_px * channels
    return _WORD_BYTES * _SLOT_WORDS + -(-pixels_bytes // 64) * 64


# Why a lock and a checksum. On x86-64 stores are seen in their order and loads are made in theirs (memcpy fences the
# streaming stores that it uses for large blocks), each sequence is one aligned 8-byte store, and Python's separate
# calls keep the compiler from moving them: the sequence lock alone would do. On machines of weaker order (ARM) it would
# not, and Python has no fences; there the checksum decides, since it is taken from the very bytes that are handed out.
# It costs about 20 us for a 1.4 MB image, so it is taken everywhere.
def _checksum(pixels: Image, sequence: int, height_px: int, width_px: int, channels: int) -> int:
    """Of a flat, contiguous array of pixels and of the head that describes them."""
    whole = pixels.size // _WORD_BYTES * _WORD_BYTES
    total = int(np.add.reduce(pixels[:whole].view(np.uint64))) + int(np.add.reduce(pixels[whole:], dtype=np.uint64))
    for number in (sequence, height_px, width_px, channels):
        total = (total ^ number) * _MIX
    return total % (1 << 64)


def _check_frame(height_px: int, width_px: int, channels: int) -> None:
    if not (0 < height_px <= _MAX_SIDE_PX and 0 < width_px <= _MAX_SIDE_PX and channels in (1, 3)):
        raise FrameError(f"no frame of a camera: {width_px}x{height_px} px of {channels} channels")


class _Mapping:
    """The file of a ring in memory, as words and as bytes; the same for both sides."""

    def __init__(self, fd: int, size: int, writable: bool) -> None:
        access = mmap.PROT_READ | mmap.PROT_WRITE if writable else mmap.PROT_READ
        memory = mmap.mmap(fd, size, flags=mmap.MAP_SHARED | mmap.MAP_POPULATE, prot=access)  # unmapped with its views
        self.bytes: NDArray[np.uint8] = np.frombuffer(memory, dtype=np.uint8)
        self.words: NDArray[np.uint64] = np.frombuffer(memory, dtype=np.uint64)

    def head(self) -> list[int]:
        return [int(word) for word in self.words[:_HEAD_WORDS]]

    def slot(self, slot: int, slot_bytes: int) -> tuple[NDArray[np.uint64], Image]:
        """The head and the pixels of one slot, as views."""
        start = _WORD_BYTES * _HEAD_WORDS + slot * slot_bytes
        head = start // _WORD_BYTES
        pixels = self.bytes[start + _WORD_BYTES * _SLOT_WORDS : start + slot_bytes]
        return self.words[head : head + _SLOT_WORDS], pixels


class FrameRing(Closing):
    """The writer's side: makes the ring at `path`, sized by the camera's largest frame; a context manager.

    Replaces what a dead process left there (VehicleLock keeps a second writer away), and removes its file on close.
    Raises FrameError for sizes that no camera has, OSError naming the path where there is no room.
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
            except OSError as error:  # better now than a SIGBUS in the middle of a drive
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
        """Puts an image, (H, W) or (H, W, 3) uint8, into the next slot; gives (slot, sequence) for its FrameRef.

        Raises FrameError for an image that is not of this kind, or larger than the ring was made for.
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
        """Removes the ring; frames that were not yet read are gone. A second call does nothing."""
        if self._mapping is None:
            return
        self._mapping = None
        try:
            if self.path.stat().st_ino == self._inode:  # else a newer writer has replaced it
                self.path.unlink()
        except FileNotFoundError:
            return  # somebody cleaned up before us


class FrameReader(Closing):
    """The reader's side. It may be made before the ring, and outlives its writers; a context manager."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._mapping: _Mapping | None = None
        self._epoch = self._slots = self._slot_bytes = 0

    def read(self, ref: FrameRef, out: Image | None = None) -> Image | None:
        """A copy of the pixels of `ref`, (H, W) or (H, W, 3); None where they are gone, torn, or never were there.

        With `out`, contiguous and of the frame's shape, they are copied there; what it holds after a None is no frame.
        Raises FrameError for another shape of `out`, and where the file is no ring of this layout.
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
        """Maps the ring that is at the path now; whether it is the one of `epoch`."""
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
            raise FrameError(f"{self.path} has {state.st_size} B, which does not fit what its head says")
        if found_epoch != epoch:
            return False
        self._mapping, self._epoch, self._slots, self._slot_bytes = mapping, epoch, slots, slot_bytes
        return True

    def close(self) -> None:
        """Lets go of the ring."""
        self._mapping, self._epoch = None, 0
