"""The estimates of a drive with its images."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from birdslam.runtime.batch.offline import pipeline
from birdslam.runtime.configuration import load
from birdslam.runtime.nodes.sources import open_recorded
from birdslam.types import Estimate

Seen = tuple[Estimate, NDArray[np.uint8]]


def estimated(uri: str) -> Iterator[Seen]:
    """The estimates of the whole pipeline for a recording, with the undistorted images."""
    recording = open_recorded(uri)
    with pipeline(load(None, {"source.uri": uri})) as through:
        yield from _with_images(uri, (record for record in through(recording) if isinstance(record, Estimate)))


def _with_images(uri: str, estimates: Iterator[Estimate]) -> Iterator[Seen]:
    frames = open_recorded(uri).undistorted_frames()
    for estimate in estimates:
        frame = next(each for each in frames if each.frame_id == estimate.frame_id)
        if frame.image is not None:
            yield estimate, frame.image
