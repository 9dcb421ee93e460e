"""The height of a camera, which all metres rest on: as stated, or by what is known best; and how sure it is."""

from __future__ import annotations

import math
from pathlib import Path
from typing import NamedTuple

import msgspec
import numpy as np

from birdslam.calibration.calibration import Calibration, CalibrationError
from birdslam.calibration.height_check import VEHICLES, HeightCheck, KnownLength
from birdslam.calibration.intrinsics import Intrinsics
from birdslam.geometry.camera import Camera
from birdslam.outputs.plain_words import LengthsBy
from birdslam.sources.recording import Recording, check_times
from birdslam.sources.speed_file import read_speed_curve
from birdslam.types import NS_PER_S

UNKNOWN_HEIGHT_M = 1.5  # where none was given: all lengths are in proportion to it, and it is replaced
# Of the height by the size of cars, beside the estimate's own sigma: how much taller cars are from country to country.
# Its own sigma alone is honest on KITTI's sequences, which are of one town (docs/calibration.md)
COUNTRY_SIGMA_REL = 0.08
# Where nothing shows the height: behind a car's windscreen, 1.1 to 1.6 m; by judgement
WINDSCREEN_M, WINDSCREEN_SIGMA_REL = 1.35, 0.2


def known_lengths(recording: Recording, speed_file: Path | None) -> dict[str, KnownLength]:
    """What else knows the way between two frames: the recording's poses, a speed file."""
    out: dict[str, KnownLength] = {}
    truth = recording.truth_poses()
    if truth is not None and np.isfinite(truth).all():
        at = truth[:, :, 3]

        def by_poses(start: int, end: int, start_ns: int, end_ns: int) -> float:
            return float(np.linalg.norm(np.diff(at[start : end + 1], axis=0), axis=1).sum())

        out["poses"] = by_poses
    if speed_file is not None:
        t_s, speed_mps = read_speed_curve(speed_file).T
        way_m = np.concatenate([[0.0], np.cumsum(np.diff(t_s) * 0.5 * (speed_mps[1:] + speed_mps[:-1]))])

        def by_speed(start: int, end: int, start_ns: int, end_ns: int) -> float | None:
            if start_ns * 1e-9 < t_s[0] or end_ns * 1e-9 > t_s[-1]:
                return None
            return float(np.interp(end_ns * 1e-9, t_s, way_m) - np.interp(start_ns * 1e-9, t_s, way_m))

        check_times(recording, speed_file, round(t_s[0] * NS_PER_S), round(t_s[-1] * NS_PER_S))
        out["speed"] = by_speed
    return out


class HeightBy(NamedTuple):
    """Where the camera's height comes from; `check` is the cue that gave it, None where it was stated."""

    words: str
    check: HeightCheck | None
    sigma_rel: float  # of all lengths along the road, by this height and the focal length


def with_height(found: Calibration, known: bool, lens: Intrinsics | None, uri: str) -> tuple[Camera, HeightBy]:
    """The camera with the height that was stated, else with the surest that was estimated."""
    focal_rel = focal_sigma_rel(lens)
    if known:
        height_m, by = found.camera.height_m, HeightBy("as stated", None, focal_rel)
    else:
        height_m, by = _estimated_height(found, focal_rel)
    try:
        return msgspec.structs.replace(found.camera, height_m=height_m, scale_sigma_rel=min(by.sigma_rel, 1.0)), by
    except ValueError as error:
        raise CalibrationError(f"{uri}: height {by.words}: {error}") from None


def _estimated_height(found: Calibration, focal_rel: float) -> tuple[float, HeightBy]:
    """By a known length, by the size of cars, or by where cameras are."""
    sigmas = {
        check.cue: math.hypot(check.sigma_m / check.height_m, COUNTRY_SIGMA_REL * (check.cue == VEHICLES))
        for check in found.height_checks
    }
    check = min(found.height_checks, key=lambda check: sigmas[check.cue], default=None)
    if check is None or sigmas[check.cue] > WINDSCREEN_SIGMA_REL:
        sigma_rel = math.hypot(WINDSCREEN_SIGMA_REL, focal_rel)
        words = f"of most windscreens, +- {WINDSCREEN_SIGMA_REL:.0%}, since nothing here tells it"
        return WINDSCREEN_M, HeightBy(words, None, sigma_rel)
    own_rel = sigmas[check.cue]
    if check.cue == VEHICLES:
        by = HeightBy(f"by the size of {check.samples} cars, +- {own_rel:.0%}", check, math.hypot(own_rel, focal_rel))
    else:  # a known length holds height and focal length together
        by = HeightBy(f"by {check.cue} along {found.path_m:.0f} m, +- {own_rel:.0%}", check, own_rel)
    return check.height_m, by


def focal_sigma_rel(lens: Intrinsics | None) -> float:
    """As a fraction of the focal length, where it is an estimate; a chessboard's is measured."""
    if lens is None or lens.sigma_focal_px is None or lens.reprojection_px is not None:
        return 0.0
    return lens.sigma_focal_px / lens.fx_px


def lengths_by(camera: Camera, by: HeightBy, lens: Intrinsics | None) -> LengthsBy:
    words = f"the camera's height of {camera.height_m:.2f} m ({by.words})"
    focal_rel = focal_sigma_rel(lens)
    if by.check is not None and by.check.cue != VEHICLES:  # a known length holds both together
        return LengthsBy(words, by.sigma_rel)
    if focal_rel:
        words += f" and its focal length of {camera.fx_px:.0f} px, +- {focal_rel:.0%}"
    return LengthsBy(words, math.sqrt(max(by.sigma_rel**2 - focal_rel**2, 0.0)), focal_rel)
