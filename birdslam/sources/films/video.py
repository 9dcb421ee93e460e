"""Films as recorded drives through OpenCV: one file, or a directory of successive files of one camera."""

from __future__ import annotations

import math
import re
from collections import deque
from collections.abc import Generator, Iterator, Sequence
from dataclasses import dataclass
from datetime import datetime
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from birdslam.geometry.arrays import Floats
from birdslam.geometry.camera import Camera
from birdslam.ros.bag import BagTopics
from birdslam.sources.films.container import films_in, is_raw_stream, is_torn, stated_focal_rel, why_unreadable
from birdslam.sources.films.interlaced import is_undecoded
from birdslam.sources.recording import DatasetError, RecordedFrame, Recording
from birdslam.sources.schemes import VIDEO
from birdslam.types import NS_PER_S

GAP_NS = NS_PER_S  # a longer gap between frames is reported as a frame without an image
NAME_RESOLUTION_S = 2.0  # times in names have a resolution of a second, and each of two may be rounded
MAX_OVERLAP_S = 3.0  # max. searched overlap of two films
OVERLAP_FRAMES = 5  # consecutive frames that must agree
_MAX_DIFFERENCE, _MAX_DIFFERENCE_REL = 8.0, 0.5  # mean, in grey levels, and relative to the best other part
_COUNTED_SUFFIXES = (".mp4", ".mov", ".m4v", ".avi", ".3gp")  # containers that state the number of frames
_VALID_HZ = 1.0, 240.0  # outside, a stated rate is measured instead
_MEASURED_FRAMES = 24
# 20240131_235959, 2024-01-31 23.59.59 and the like
_NAME_TIME = re.compile(r"(20\d\d)[-_.]?(\d\d)[-_.]?(\d\d)[-_. T]{0,3}(\d\d)[-_.:h]?(\d\d)[-_.:m]?(\d\d)")


@dataclass(frozen=True)
class _Film:
    """A file: metadata of its container, and its gap to the file before."""

    path: Path
    rate_hz: float
    declared: int  # frames; 0: not declared
    gap_ns: int = 0

    @property
    def period_ns(self) -> int:
        return round(NS_PER_S / self.rate_hz)

    @property
    def length_s(self) -> float:
        return self.declared / self.rate_hz

    def ends_early(self, frames: int, last_s: float) -> bool:
        """Whether it has fewer frames than declared, given the frames read and the time of the last."""
        if self.path.suffix.lower() in _COUNTED_SUFFIXES:
            return frames < 0.99 * self.declared - 1.0  # some containers miscount by one
        return last_s < 0.98 * self.length_s - 0.5  # the count is the duration times the mean rate


class VideoRecording(Recording):
    """A film, or the films of a directory in natural order as one drive.

    Frames have the container's times, also uneven ones, and the container's rotation. `len` is the declared number of
    frames (0 if one film declares none). Films follow each other without a gap unless the times in their names leave
    one. Frames at the start of a film that repeat the end of the film before are left out. A gap above a second, there
    or within a film, is one frame without an image.
    """

    def __init__(self, path: Path, camera: Camera | None, stride: int = 1) -> None:
        files = films_in(path, VIDEO.suffixes)
        for file in files if camera is None else ():
            _capture(file).release()  # errors of the film come before a missing camera
        if camera is None:
            raise DatasetError(
                f"video:{path}: a film does not state its camera; give a camera file (`birdslam run` without "
                "--camera estimates it)"
            )
        self.camera, self._stride, self.name = camera, stride, path.stem
        self._films = _with_gaps([_film(file, camera) for file in files])
        self.rate_hz = self._films[0].rate_hz / stride

    @classmethod
    def frame_size(cls, path: Path, topics: BagTopics) -> tuple[int, int]:
        """Size as displayed: a film in portrait orientation is higher than wide. Raises DatasetError."""
        capture = _capture(films_in(path, VIDEO.suffixes)[0])
        size = _size(capture)
        capture.release()
        return size

    @classmethod
    def stated_focal_px(cls, path: Path) -> float | None:
        """The focal length from the container's metadata, of the whole sensor; None if not stated."""
        focal_rel = stated_focal_rel(films_in(path, VIDEO.suffixes)[0])
        return None if focal_rel is None else focal_rel * max(cls.frame_size(path, BagTopics()))

    def __len__(self) -> int:
        declared = [film.declared for film in self._films]
        return -(-sum(declared) // self._stride) if all(declared) else 0

    def frames(self, start: int = 0) -> Iterator[RecordedFrame]:
        """Yields the frames in order with the container's times; a truncated file ends with an unreadable frame."""
        return (frame for frame in self._frames(start) if frame.index >= start)

    def _frames(self, start: int) -> Iterator[RecordedFrame]:
        index, t_ns = 0, -self._films[0].period_ns
        tail: deque[Floats] = deque(maxlen=1)  # the last frames of a film, downsampled
        for film in self._films:
            begin_ns = t_ns + film.period_ns + film.gap_ns
            skipped = _overlap(film.path, list(tail)) if tail and not film.gap_ns else 0
            tail = deque(maxlen=max(1, round(MAX_OVERLAP_S * film.rate_hz)))
            index, t_ns = yield from self._frames_of(film, index, begin_ns, t_ns, start, skipped, tail)

    def _frames_of(
        self,
        film: _Film,
        index: int,
        begin_ns: int,
        last_ns: int,
        start: int,
        skipped: int,
        tail: deque[Floats],
    ) -> Generator[RecordedFrame, None, tuple[int, int]]:
        """Yields the frames of a file after its first `skipped`, numbered from `index`; adds small ones to `tail`.

        Frames before `start` are not decoded, except the last ones, which `tail` needs. Returns the next index and the
        time of the last frame, for any stride.
        """
        followed = film is not self._films[-1]
        capture = _capture(film.path)
        square = _size(capture)
        try:
            position, shift_ns, t_ns = 0, begin_ns, last_ns
            while capture.grab():
                stamp_ns = round(capture.get(cv2.CAP_PROP_POS_MSEC) * 1e6) + shift_ns
                if position < skipped:
                    position += 1
                    # of the next frame, the first one used
                    shift_ns = begin_ns - (stamp_ns - shift_ns) - film.period_ns
                    continue
                if stamp_ns <= t_ns:  # a clock that restarted, or a container without times (zeros)
                    shift_ns += t_ns + film.period_ns - stamp_ns
                    stamp_ns = t_ns + film.period_ns
                gap_ns, t_ns = (stamp_ns - t_ns if index else 0), stamp_ns
                if gap_ns > GAP_NS + film.period_ns:
                    words = f"{film.path}: {gap_ns / NS_PER_S:.1f} s are missing before frame {position}"
                    yield RecordedFrame(index, t_ns - film.period_ns // 2, None, words)
                    index += 1
                is_taken = position % self._stride == 0
                is_last = followed and position >= film.declared - tail.maxlen  # type: ignore[operator]
                ok, image = capture.retrieve() if is_last or (is_taken and index >= start) else (False, None)
                if ok and is_last and image is not None:
                    tail.append(_small(np.asarray(image, np.uint8)))
                if is_taken:
                    if ok and image is not None and square != (image.shape[1], image.shape[0]):
                        image = cv2.resize(image, square, interpolation=cv2.INTER_LINEAR)
                    error = None if ok else f"{film.path}: frame {position} can't be decoded"
                    yield RecordedFrame(index, t_ns, image if ok else None, error)  # type: ignore[arg-type]
                    index += 1
                position += 1
            if film.ends_early(position, (t_ns - begin_ns) / NS_PER_S):
                error = f"{film.path}: ends after {position} of {film.declared} frames: cut off"
            elif is_torn(film.path):
                error = f"{film.path}: ends within a packet, after {position} frames: cut off"
            else:
                return index, t_ns
            t_ns += film.period_ns
            yield RecordedFrame(index, t_ns, None, error)
            return index + 1, t_ns
        finally:
            capture.release()


def _film(path: Path, camera: Camera) -> _Film:
    """Opens a film to check that it fits. Raises DatasetError."""
    capture = _capture(path)
    rate_hz, size = capture.get(cv2.CAP_PROP_FPS), _size(capture)
    declared = max(int(capture.get(cv2.CAP_PROP_FRAME_COUNT)), 0)
    if not _VALID_HZ[0] <= rate_hz <= _VALID_HZ[1]:  # also NaN
        # the value is a duration
        declared = round(declared / rate_hz) if math.isfinite(rate_hz) and rate_hz > 0.0 else 0
        rate_hz = _measure_hz(capture)
        declared = round(declared * rate_hz) if math.isfinite(rate_hz) else 0
    capture.release()
    if is_raw_stream(path):
        raise DatasetError(
            f"{path}: a raw stream without frame times; put it into a container at the camera's rate: "
            f"ffmpeg -framerate HZ -i {path.name} -c copy film.mp4"
        )
    if is_undecoded(path):
        raise DatasetError(
            f"{path}: is interlaced, which this OpenCV cannot decode; make it progressive first: "
            f"ffmpeg -i {path.name} -vf yadif progressive.mp4"
        )
    if not (math.isfinite(rate_hz) and 0.0 < rate_hz <= 1000.0):
        raise DatasetError(f"{path}: neither its container nor its frames have a usable frame rate ({rate_hz:g})")
    if size != (camera.width_px, camera.height_px):
        raise DatasetError(
            f"{path}: is {size[0]}x{size[1]}, but the given camera is {camera.width_px}x{camera.height_px}"
        )
    return _Film(path, rate_hz, declared)


def _measure_hz(capture: cv2.VideoCapture) -> float:
    """Frame rate from the times of the first frames; NaN without times."""
    times: list[float] = []
    while len(times) < _MEASURED_FRAMES and capture.grab():
        times.append(capture.get(cv2.CAP_PROP_POS_MSEC))
    steps = np.diff(times)
    return float(1e3 / np.median(steps)) if len(steps) and np.median(steps) > 0.0 else math.nan


def _with_gaps(films: list[_Film]) -> list[_Film]:
    """The films with the gaps between the times in their names."""
    out = films[:1]
    for before, film in pairwise(films):
        began, begins = _name_time(before.path), _name_time(film.path)
        gap_s = 0.0
        if began is not None and begins is not None and before.declared:
            gap_s = (begins - began).total_seconds() - before.length_s
        gap_ns = round(gap_s * NS_PER_S) if gap_s > NAME_RESOLUTION_S else 0
        out.append(_Film(film.path, film.rate_hz, film.declared, gap_ns))
    return out


def _small(image: NDArray[np.uint8]) -> Floats:
    """Every 16th pixel of an image (one channel), for the comparison of frames."""
    return np.asarray(image[8::16, 8::16] if image.ndim == 2 else image[8::16, 8::16, 1], np.float64)


def _overlap(path: Path, tail: Sequence[Floats]) -> int:
    """Returns the number of frames at the start of a film that repeat the `tail` of the film before.

    Its first frames are compared with every part of the tail. One part must match far better than all parts that are
    not its neighbours, which excludes a stationary camera.
    """
    capture, first = _capture(path), list[Floats]()
    while len(first) < OVERLAP_FRAMES and capture.grab():
        ok, image = capture.retrieve()
        if not ok:
            break
        first.append(_small(np.asarray(image, np.uint8)))
    capture.release()
    if len(first) < OVERLAP_FRAMES or len(tail) < 2 * OVERLAP_FRAMES or first[0].shape != tail[0].shape:
        return 0
    frames, starts = np.stack(tail), np.arange(len(tail) - OVERLAP_FRAMES + 1)
    differences = np.array([np.abs(frames[starts + k] - small).mean(axis=(1, 2)) for k, small in enumerate(first)])
    difference = differences.mean(axis=0)
    best = int(difference.argmin())
    others = difference[np.abs(starts - best) > OVERLAP_FRAMES]
    is_clear = len(others) > 0 and difference[best] < min(_MAX_DIFFERENCE, _MAX_DIFFERENCE_REL * others.min())
    return len(tail) - best if is_clear else 0


def _name_time(path: Path) -> datetime | None:
    found = _NAME_TIME.search(path.stem)
    try:
        return datetime(*map(int, found.groups())) if found else None  # type: ignore[arg-type]
    except ValueError:  # invalid digits
        return None


def _capture(path: Path) -> cv2.VideoCapture:
    """Opens a film. Raises DatasetError."""
    if not path.is_file():
        raise DatasetError(f"{path}: {'not a file' if path.exists() else 'no such file'}")
    capture = cv2.VideoCapture(str(path))
    if not capture.isOpened():
        raise DatasetError(f"{path}: {why_unreadable(path)}")
    return capture


def _size(capture: cv2.VideoCapture) -> tuple[int, int]:
    """Width and height of an image with square pixels, as read and rotated by OpenCV.

    The sample aspect ratio of anamorphic films widens the image.
    """
    width, height = capture.get(cv2.CAP_PROP_FRAME_WIDTH), capture.get(cv2.CAP_PROP_FRAME_HEIGHT)
    over, under = capture.get(cv2.CAP_PROP_SAR_NUM), capture.get(cv2.CAP_PROP_SAR_DEN)
    aspect = over / under if over > 0.0 and under > 0.0 else 1.0
    if round(capture.get(cv2.CAP_PROP_ORIENTATION_META)) % 180 == 90:
        height *= aspect
    else:
        width *= aspect
    return round(width), round(height)
