"""The height of a camera, which all metres rest on: as stated, or by what is known best; and how sure it is."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import msgspec
import numpy as np

from birdslam.calibration.calibration import Calibration, CalibrationError
from birdslam.calibration.height_check import LANES, VEHICLES, HeightCheck, KnownLength
from birdslam.calibration.intrinsics import Intrinsics
from birdslam.calibration.readout import Readout
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
AGREES_SIGMA = 2.0
SIZES = (VEHICLES, LANES)  # cues that show the height alone; others show what height and focal length make together
_SHUTTER_PER_M2 = 0.066  # by rendered films of one street, with 0, 15 and 30 ms (docs/constants.md)


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
    """Where the camera's height comes from; `checks` are the cues that gave it, none where it was stated."""

    words: str
    checks: tuple[HeightCheck, ...]
    sigma_rel: float  # of all lengths along the road, by this height and the focal length
    contradicted_by: str = ""  # what says another height than the one that was stated, and which
    shutter_rel: float = 0.0  # 1-sigma of the same lengths by rows that are read in turn

    @property
    def a_length(self) -> bool:
        """Whether a known length gave it, which holds height and focal length together."""
        return any(check.cue not in SIZES for check in self.checks)


def with_height(
    found: Calibration, known: bool, lens: Intrinsics | None, uri: str, readout: Readout | None = None
) -> tuple[Camera, HeightBy]:
    """The camera with the height that was stated, else with the surest that was estimated.

    A stated height (and focal length) that something else contradicts is kept, but its sigma covers both. `readout` of
    the camera's rows is of films, and in the found camera.
    """
    focal_rel = focal_sigma_rel(lens)
    if known:
        height_m, by = found.camera.height_m, _stated_height(found, focal_rel)
    else:
        height_m, by = _estimated_height(found, focal_rel)
    if readout is not None and not by.a_length:  # a known length has the shutter's share in it
        rel = shutter_rel(found.camera, height_m, found.speed_mps, readout.sigma_s)
        by = by._replace(shutter_rel=rel)
    sigma_rel = min(math.hypot(by.sigma_rel, by.shutter_rel), 1.0)
    try:
        return msgspec.structs.replace(found.camera, height_m=height_m, scale_sigma_rel=sigma_rel), by
    except ValueError as error:
        raise CalibrationError(f"{uri}: height {by.words}: {error}") from None


def shutter_rel(camera: Camera, height_m: float, speed_mps: float, sigma_s: float) -> float:
    """1-sigma of lengths along the road, as a fraction, by a rolling shutter whose readout is known to `sigma_s`.

    Near road is read later in an image than far road, and moves down meanwhile: its motion is seen over a longer time
    than that between two images. A point of the road at depth z moves by f h V / z^2 rows a second.
    """
    return _SHUTTER_PER_M2 * sigma_s * speed_mps * height_m * camera.fy_px / camera.height_px


def check_sigma_rel(check: HeightCheck) -> float:
    """1-sigma of a height, as a fraction, with how much cars differ from country to country."""
    return math.hypot(check.sigma_m / check.height_m, COUNTRY_SIGMA_REL * (check.cue == VEHICLES))


def _stated_height(found: Calibration, focal_rel: float) -> HeightBy:
    """The height as stated; where an estimate contradicts it, the largest difference is its sigma."""

    def away_sigma(check: HeightCheck) -> float:
        return abs(math.log(check.height_m / found.camera.height_m)) / math.hypot(check_sigma_rel(check), focal_rel)

    check = max(found.height_checks, key=away_sigma, default=None)
    if check is None or away_sigma(check) < AGREES_SIGMA:
        return HeightBy("as stated", (), focal_rel)
    contradicted = f"{_said_by(check)} says {check.height_m:.2f} m +- {check_sigma_rel(check):.0%}"
    between_rel = abs(math.log(check.height_m / found.camera.height_m))
    return HeightBy("as stated", (), math.hypot(focal_rel, between_rel), contradicted)


def _estimated_height(found: Calibration, focal_rel: float) -> tuple[float, HeightBy]:
    """By a known length, by the size of cars and the width of lanes, or by where most cameras are mounted."""
    lengths = [check for check in found.height_checks if check.cue not in SIZES]
    checks = found.height_checks if not lengths else (min(lengths, key=check_sigma_rel),)
    height_m, own_rel = _mean_height(checks) if checks else (WINDSCREEN_M, math.inf)
    if own_rel > WINDSCREEN_SIGMA_REL:
        sigma_rel = math.hypot(WINDSCREEN_SIGMA_REL, focal_rel)
        words = f"of most windscreens, +- {WINDSCREEN_SIGMA_REL:.0%}, since nothing here tells it"
        return WINDSCREEN_M, HeightBy(words, (), sigma_rel)
    if lengths:  # a known length holds height and focal length together
        by = HeightBy(f"by {checks[0].cue} along {found.path_m:.0f} m, +- {own_rel:.0%}", checks, own_rel)
    else:
        said = " and ".join(_said_by(check) for check in checks)
        by = HeightBy(f"by {said}, +- {own_rel:.0%}", checks, math.hypot(own_rel, focal_rel))
    return height_m, by


def _mean_height(checks: Sequence[HeightCheck]) -> tuple[float, float]:
    """(height_m, its 1-sigma as a fraction) by all; their disagreement widens it (Birge's ratio)."""
    logs, sigmas = np.log([check.height_m for check in checks]), np.array([check_sigma_rel(check) for check in checks])
    mean = float(np.average(logs, weights=sigmas**-2.0))
    scatter = float(np.square((logs - mean) / sigmas).sum()) / max(1, len(checks) - 1)
    return math.exp(mean), math.sqrt(max(1.0, scatter) / float((sigmas**-2.0).sum()))


def _said_by(check: HeightCheck) -> str:
    """What says a height, for people."""
    if check.cue == VEHICLES:
        return f"the size of {check.samples} cars"
    return "the width of lanes" if check.cue == LANES else f"the {check.cue}"


def focal_sigma_rel(lens: Intrinsics | None) -> float:
    """As a fraction of the focal length, where it is an estimate; a chessboard's is measured."""
    if lens is None or lens.sigma_focal_px is None or lens.reprojection_px is not None:
        return 0.0
    return lens.sigma_focal_px / lens.fx_px


def lengths_by(camera: Camera, by: HeightBy, lens: Intrinsics | None, fov_deg: float | None = None) -> LengthsBy:
    """What the metres of a camera rest on, for people; `fov_deg` as the user states it."""
    words = f"the camera's height of {camera.height_m:.2f} m ({by.words})"
    focal_rel = focal_sigma_rel(lens)
    if by.a_length:
        return LengthsBy(words, by.sigma_rel)
    if focal_rel:
        words += f" and its focal length of {camera.fx_px:.0f} px, +- {focal_rel:.0%}"
    if by.shutter_rel >= 0.005:
        words += f"; rows that the camera reads one after the other leave +- {by.shutter_rel:.0%} at this speed"
    height_rel = math.sqrt(max(by.sigma_rel**2 - focal_rel**2, 0.0))
    return LengthsBy(words, height_rel, focal_rel, by.contradicted_by, fov_deg is not None)
