"""The images of a recording as a source for the whole pipeline (`--source mcap:FILE`)."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import msgspec

from birdslam.geometry.camera import Camera
from birdslam.runtime.configuration import RecordingConfig
from birdslam.runtime.recording.foxglove import CompressedImage
from birdslam.runtime.recording.recording import Recording as File
from birdslam.runtime.recording.recording import RecordingError
from birdslam.runtime.recording.scene import timestamp
from birdslam.runtime.wire import WireError, decode
from birdslam.sources.kitti import decode_image
from birdslam.sources.recording import DatasetError, RecordedFrame, Recording
from birdslam.types import NS_PER_S, FrameRef, Status

READ = ("v1/frame", "/camera/image")


class RecordedImages(Recording):
    """One frame per captured frame; frames that were not recorded are unreadable.

    Each has the readings of the car's speed of the drive. The images are undistorted, as in perceive, but compressed as
    JPEG. Raises DatasetError.
    """

    def __init__(self, path: Path, camera: Camera | None = None, stride: int = 1) -> None:
        try:
            self._file = File(path)
            own, images = self._file.camera, self._file.part("recording", RecordingConfig).images
        except RecordingError as error:
            raise DatasetError(str(error)) from None
        if own is None or not images:
            raise DatasetError(f"{path}: was recorded without images (--record-images)")
        self.name = path.stem
        self.camera = camera or msgspec.structs.replace(own, distortion=(), fisheye=False)
        self._stride = stride
        refs = [ref for message in self._file.messages(READ[:1]) if (ref := self._ref(message.data)) is not None]
        if not refs:
            raise DatasetError(f"{path}: has no frame")
        self._first, self._last = refs[0], refs[-1]
        self.first_frame = self._first.frame_id  # of the run; frames count from it
        span_ns = self._last.t_source_ns - self._first.t_source_ns
        frames = self._last.frame_id - self._first.frame_id
        if frames > 0 and span_ns > 0:
            self.rate_hz = frames * NS_PER_S / span_ns / stride
        else:
            raise DatasetError(f"{path}: has {len(refs)} frames, too few for a drive")

    def __len__(self) -> int:
        return (self._last.frame_id - self._first.frame_id) // self._stride + 1

    def frames(self, start: int = 0) -> Iterator[RecordedFrame]:
        """Yields the frames in order, numbered from the first frame of the recording."""
        for ref, image in self._pairs():
            number = ref.frame_id - self._first.frame_id
            if number % self._stride or number // self._stride < start:
                continue
            pixels, error = None, None if image is not None else f"frame {ref.frame_id} was not recorded"
            if image is not None:
                try:
                    pixels = decode_image(image.data)
                except ValueError as damaged:
                    error = f"{self._file.path}: frame {ref.frame_id}: {damaged}"
            yield RecordedFrame(number // self._stride, ref.t_source_ns, pixels, error, ref.speeds)

    def _pairs(self) -> Iterator[tuple[FrameRef, CompressedImage | None]]:
        """Yields every frame with its image; the times of missing frames are interpolated."""
        before: FrameRef | None = None
        waiting: FrameRef | None = None
        for message in self._file.messages(READ):
            if message.channel == READ[1]:
                image = msgspec.json.decode(message.data, type=CompressedImage)
                if waiting is not None and image.timestamp == timestamp(waiting.t_utc_ns):
                    yield waiting, image
                    waiting = None
                continue
            ref = self._ref(message.data)
            if ref is None:
                continue
            if waiting is not None:
                yield waiting, None
            if before is not None:
                yield from ((missing, None) for missing in _between(before, ref))
            before = waiting = ref
        if waiting is not None:
            yield waiting, None

    def _ref(self, data: bytes) -> FrameRef | None:
        try:
            ref = decode(data, FrameRef)
        except WireError as error:
            raise DatasetError(f"{self._file.path}: {error}") from None
        return None if Status.END_OF_SOURCE in ref.status else ref


def _between(before: FrameRef, after: FrameRef) -> Iterator[FrameRef]:
    gap = after.frame_id - before.frame_id
    for step in range(1, gap):
        t_source_ns = before.t_source_ns + (after.t_source_ns - before.t_source_ns) * step // gap
        yield msgspec.structs.replace(before, frame_id=before.frame_id + step, t_source_ns=t_source_ns, speeds=())
