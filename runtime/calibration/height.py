"""The height of a camera, which sets the metric scale: as stated, or the most certain estimate, with its sigma."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import msgspec
import numpy as np

from birdslam.calibration.calibration import Calibration, CalibrationError
from birdslam.calibration.height_check import KNOWN_VEHICLE, LANES, SPEED, VEHICLES, HeightCheck, KnownLength
from birdslam.calibration.intrinsics import Intrinsics
from birdslam.calibration.readout import Readout
from birdslam.geometry.camera import Camera
from birdslam.outputs.plain_words import LengthsBy
from birdslam.sources.recording import Recording, check_times
from birdslam.sources.speed_file import read_speed_curve
from birdslam.types import NS_PER_S

UNKNOWN_HEIGHT_M = 1.5  # placeholder: all lengths are proportional to it, and it is replaced
COUNTRY_SIGMA_REL = 0.08  # of the height from the size of cars, which differs between countries (docs/calibration.md)
WINDSCREEN_M, WINDSCREEN_SIGMA_REL = 1.35, 0.2  # prior: behind a car's windscreen, 1.1 to 1.6 m; by judgement
AGREES_SIGMA = 2.0
SIZES = (
    VEHICLES,
    LANES,
    KNOWN_VEHICLE,
)  # cues for the height alone; the others constrain height and focal length together
_SHUTTER_PER_M2 = 0.066  # docs/constants.md


def known_lengths(recording: Recording, speed_file: Path | None) -> dict[str, KnownLength]:
    """Returns other sources of the distance between two frames: the recording's poses, a speed file."""
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
        out[SPEED] = by_speed
    return out


class HeightBy(NamedTuple):
    """The source of the camera's height; `checks`: the cues that determined it, none if it was stated."""

    words: str
    checks: tuple[HeightCheck, ...]
    sigma_rel: float  # of all lengths along the road, from this height and the focal length
    contradicted_by: str = ""  # the estimate that contradicts the stated height
    shutter_rel: float = 0.0  # 1-sigma of the same lengths from the rolling shutter

    @property
    def a_length(self) -> bool:
        """Whether a known length determined it, which constrains height and focal length together."""
        return any(check.cue not in SIZES for check in self.checks)


def with_height(
    found: Calibration, known: bool, lens: Intrinsics | None, uri: str, readout: Readout | None = None
) -> tuple[Camera, HeightBy]:
    """Returns the camera with the stated height, else the most certain estimate.

    A stated height that an estimate contradicts is kept, with a sigma that covers both. `readout`: of the rows of a
    video's camera, already in the found camera.
    """
    focal_rel = focal_sigma_rel(lens)
    if known:
        height_m, by = found.camera.height_m, _stated_height(found, focal_rel)
    else:
        height_m, by = _estimated_height(found, focal_rel)
    if readout is not None and not by.a_length:  # a known length includes the effect of the shutter
        rel = shutter_rel(found.camera, height_m, found.speed_mps, readout.sigma_s)
        by = by._replace(shutter_rel=rel)
    sigma_rel = min(math.hypot(by.sigma_rel, by.shutter_rel), 1.0)
    try:
        return msgspec.structs.replace(found.camera, height_m=height_m, scale_sigma_rel=sigma_rel), by
    except ValueError as error:
        raise CalibrationError(f"{uri}: height {by.words}: {error}") from None


def shutter_rel(camera: Camera, height_m: float, speed_mps: float, sigma_s: float) -> float:
    """Returns the 1-sigma of lengths along the road, as a fraction, for a readout time known to `sigma_s`.

    Near road is read later than far road and moves down in the image meanwhile, so that its motion spans more than the
    frame interval. A point of the road at depth z moves by f h V / z^2 rows per second.
    """
    return _SHUTTER_PER_M2 * sigma_s * speed_mps * height_m * camera.fy_px / camera.height_px


def check_sigma_rel(check: HeightCheck) -> float:
    """Returns the 1-sigma of a height as a fraction, including the variation of car sizes between countries."""
    return math.hypot(check.sigma_m / check.height_m, COUNTRY_SIGMA_REL * (check.cue == VEHICLES))


def _stated_height(found: Calibration, focal_rel: float) -> HeightBy:
    """Returns the stated height; its sigma covers the largest contradiction."""

    def away_sigma(check: HeightCheck) -> float:
        return abs(math.log(check.height_m / found.camera.height_m)) / math.hypot(check_sigma_rel(check), focal_rel)

    check = max(found.height_checks, key=away_sigma, default=None)
    if check is None or away_sigma(check) < AGREES_SIGMA:
        return HeightBy("as stated", (), focal_rel)
    contradicted = f"{_cue_name(check)} gives {check.height_m:.2f} m +- {check_sigma_rel(check):.0%}"
    between_rel = abs(math.log(check.height_m / found.camera.height_m))
    return HeightBy("as stated", (), math.hypot(focal_rel, between_rel), contradicted)


def _estimated_height(found: Calibration, focal_rel: float) -> tuple[float, HeightBy]:
    """Estimates the height from a known length, from cars and lanes, or from the usual mount."""
    lengths = [check for check in found.height_checks if check.cue not in SIZES]
    checks = found.height_checks if not lengths else (min(lengths, key=check_sigma_rel),)
    height_m, own_rel = _mean_height(checks) if checks else (WINDSCREEN_M, math.inf)
    if own_rel > WINDSCREEN_SIGMA_REL:
        sigma_rel = math.hypot(WINDSCREEN_SIGMA_REL, focal_rel)
        words = f"of most windscreens, +- {WINDSCREEN_SIGMA_REL:.0%}, since nothing in the drive shows it"
        return WINDSCREEN_M, HeightBy(words, (), sigma_rel)
    if lengths:  # a known length constrains height and focal length together
        by = HeightBy(f"by {checks[0].cue} along {found.path_m:.0f} m, +- {own_rel:.0%}", checks, own_rel)
    else:
        cues = " and ".join(_cue_name(check) for check in checks)
        by = HeightBy(f"by {cues}, +- {own_rel:.0%}", checks, math.hypot(own_rel, focal_rel))
    return height_m, by


def _mean_height(checks: Sequence[HeightCheck]) -> tuple[float, float]:
    """Returns the weighted mean height in m and its 1-sigma as a fraction, widened by the scatter (Birge's ratio)."""
    logs, sigmas = np.log([check.height_m for check in checks]), np.array([check_sigma_rel(check) for check in checks])
    mean = float(np.average(logs, weights=sigmas**-2.0))
    scatter = float(np.square((logs - mean) / sigmas).sum()) / max(1, len(checks) - 1)
    return math.exp(mean), math.sqrt(max(1.0, scatter) / float((sigmas**-2.0).sum()))


def _cue_name(check: HeightCheck) -> str:
    """Returns the name of a cue for the report."""
    if check.cue == VEHICLES:
        return f"the size of {check.samples} cars"
    return {LANES: "the width of lanes", KNOWN_VEHICLE: "the vehicle of known size"}.get(check.cue, f"the {check.cue}")


def focal_sigma_rel(lens: Intrinsics | None) -> float:
    """Returns the 1-sigma of an estimated focal length as a fraction; 0 for a chessboard's."""
    if lens is None or lens.sigma_focal_px is None or lens.reprojection_px is not None:
        return 0.0
    return lens.sigma_focal_px / lens.fx_px


def lengths_by(camera: Camera, by: HeightBy, lens: Intrinsics | None, fov_deg: float | None = None) -> LengthsBy:
    """Returns the source of a camera's metric scale, for the report; `fov_deg`: as stated by the user."""
    words = f"the camera's height of {camera.height_m:.2f} m ({by.words})"
    focal_rel = focal_sigma_rel(lens)
    if by.a_length:
        return LengthsBy(words, by.sigma_rel)
    if focal_rel:
        words += f" and its focal length of {camera.fx_px:.0f} px, +- {focal_rel:.0%}"
    if by.shutter_rel >= 0.005:
        words += f"; the rolling shutter adds +- {by.shutter_rel:.0%} at this speed"
    height_rel = math.sqrt(max(by.sigma_rel**2 - focal_rel**2, 0.0))
    return LengthsBy(words, height_rel, focal_rel, by.contradicted_by, fov_deg is not None)
