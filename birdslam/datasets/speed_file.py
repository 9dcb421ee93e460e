"""Speeds of the car beside a recording, as a text file."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from birdslam.datasets.recording import DatasetError


def read_speeds(path: Path) -> NDArray[np.float64]:
    """(N, 2) of a text file: time in s by the recording's clock, speed in m/s; by commas or blanks, `#` comments."""
    rows: list[tuple[float, float]] = []
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise DatasetError(f"{path}: can't be read: {getattr(error, 'strerror', None) or 'not UTF-8'}") from None
    for number, line in enumerate(lines, start=1):
        words = line.partition("#")[0].replace(",", " ").split()
        if not words:
            continue
        try:
            t_s, speed_mps = (float(word) for word in words)
        except ValueError:
            raise DatasetError(f"{path}: line {number} is no time in s and speed in m/s: {line[:40]!r}") from None
        if not (math.isfinite(t_s) and 0.0 <= speed_mps < 150.0):
            raise DatasetError(f"{path}: line {number}: {speed_mps:g} m/s at {t_s:g} s is no speed of a car")
        if rows and t_s <= rows[-1][0]:
            raise DatasetError(f"{path}: line {number} is not later than the time before it")
        rows.append((t_s, speed_mps))
    if len(rows) < 2:
        raise DatasetError(f"{path}: holds {len(rows)} speeds, 2 are needed")
    return np.array(rows)
