"""The estimates of a drive with its images; those of a rendered one are kept beside it while their code is the same."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import msgspec
import numpy as np
from numpy.typing import NDArray

from birdslam.perf.reporting.code_digest import checkout
from birdslam.runtime.batch.offline import pipeline
from birdslam.runtime.configuration import load
from birdslam.runtime.nodes.sources import open_recorded
from birdslam.runtime.wire import decode, encode
from birdslam.types import Estimate

KEPT = "estimates.msgpack"
CODE = ("birdslam.slam.BirdSLAM",)  # that estimates come from: the method, without what opens files, and no map

Seen = tuple[Estimate, NDArray[np.uint8]]


class _Kept(msgspec.Struct, frozen=True):
    code: str  # digest of what made them
    estimates: list[bytes]


def estimated(uri: str) -> Iterator[Seen]:
    """A recording's frames, undistorted, with their estimates by the whole pipeline."""
    recording = open_recorded(uri)
    with pipeline(load(None, {"source.uri": uri})) as through:
        yield from _with_images(uri, (record for record in through(recording) if isinstance(record, Estimate)))


def estimated_once(folder: Path) -> Iterator[Seen]:
    """The same of a rendered drive, read from beside it where its estimates were kept by the code as it is now."""
    uri, file, code = f"demo:{folder}", folder / KEPT, checkout().digest(CODE)
    kept = msgspec.msgpack.decode(file.read_bytes(), type=_Kept) if file.is_file() else None
    if kept is not None and kept.code == code:
        yield from _with_images(uri, (decode(data, Estimate) for data in kept.estimates))
        return
    made = []
    for estimate, image in estimated(uri):
        made.append(encode(estimate))
        yield estimate, image
    partial = file.with_suffix(".partial")
    partial.write_bytes(msgspec.msgpack.encode(_Kept(code, made)))
    os.replace(partial, file)


def _with_images(uri: str, estimates: Iterator[Estimate]) -> Iterator[Seen]:
    frames = open_recorded(uri).undistorted_frames()
    for estimate in estimates:
        frame = next(each for each in frames if each.frame_id == estimate.frame_id)
        if frame.image is not None:
            yield estimate, frame.image
