"""The part of a recording that calibration reads: a minute, in pieces of its first three."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import islice

from birdslam.geometry.camera import Undistorter
from birdslam.runtime.nodes.sources import to_frame
from birdslam.runtime.progress import Progress
from birdslam.sources.recording import Recording
from birdslam.types import Frame

READ_S = 60.0
_SPAN_S = 180.0  # that the pieces are spread over: turns, textures and speeds differ
_PIECES = 4


def pieces(recording: Recording, most_frames: int | None) -> list[range]:
    """Returns the frames to read. `most_frames`: of the recording that count (source.frames); None: all."""
    most = max(1, round(READ_S * recording.rate_hz))
    frames = len(recording)  # 0: unknown
    frames = frames if most_frames is None else min(frames or most_frames, most_frames)
    if not frames or frames <= most:
        return [range(frames or most)]
    span, length = min(frames, round(_SPAN_S * recording.rate_hz)), most // _PIECES
    starts = [k * (span - length) // (_PIECES - 1) for k in range(_PIECES)]
    return [range(start, start + length) for start in starts]


def read_pieces(recording: Recording, read: Sequence[range], what: str) -> Iterator[Frame]:
    """Yields the undistorted frames of the pieces, with their index in the recording, and shows the progress.

    Each frame is decoded while the caller processes the one before.
    """
    frames = _frames(recording, read)
    with Progress(what, sum(map(len, read)), "frames") as progress, ThreadPoolExecutor(1, "decoder") as decoder:
        coming = decoder.submit(next, frames, None)
        while (frame := coming.result()) is not None:
            coming = decoder.submit(next, frames, None)
            yield frame
            progress.advance()


def _frames(recording: Recording, read: Sequence[range]) -> Iterator[Frame]:
    undistort = Undistorter(recording.camera)
    for piece in read:
        recorded = islice(recording.frames_with_speeds(piece.start), len(piece))
        for index, frame in zip(piece, recorded, strict=False):
            yield to_frame(undistort, index, frame, frame.t_source_ns)
