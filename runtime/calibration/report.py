"""Writes the camera file and the report of a calibration."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from birdslam.calibration.calibration import Calibration
from birdslam.calibration.intrinsics import Intrinsics
from birdslam.calibration.readout import PRIOR, Readout
from birdslam.geometry.camera import Camera
from birdslam.outputs.drive_files import ResultsError
from birdslam.runtime.calibration.height import AGREES_SIGMA, HeightBy, check_sigma_rel
from birdslam.sources.camera_file import camera_text


def report(
    found: Calibration,
    camera: Camera,
    height_by: HeightBy,
    uri: str,
    lens: Intrinsics | None,
    readout: Readout | None = None,
) -> Iterator[str]:
    if found.assumed:
        yield f"from {uri}: the road does not determine the tilt; assumed {found.assumed}"
    else:
        yield f"from {uri}: {found.frames} frames, {found.path_m:.0f} m"
    source = "the recording" if lens is None else lens.source
    error = "" if lens is None or lens.reprojection_px is None else f", reprojection {lens.reprojection_px:.2f} px"
    yield f"intrinsics: {source}{error}"
    for reason in () if lens is None else lens.left_out:
        yield f"  ignored: {reason}"
    sigma = np.degrees(np.sqrt(np.diag(np.reshape(found.cov, (2, 2)))))
    pitch_deg, roll_deg = np.degrees([camera.pitch_rad, camera.roll_rad])
    yield f"pitch {pitch_deg:+.2f} +- {sigma[0]:.2f} deg, roll {roll_deg:+.2f} +- {sigma[1]:.2f} deg"
    for estimate in found.estimates:
        own = np.degrees(np.sqrt(np.diag(np.reshape(estimate.cov, (2, 2)))))
        roll = "" if estimate.roll_rad is None else f", roll {np.degrees(estimate.roll_rad):+.2f} +- {own[1]:.2f} deg"
        yield (
            f"  by {estimate.cue}: pitch {np.degrees(estimate.pitch_rad):+.2f} +- {own[0]:.2f} deg{roll} "
            f"(of {estimate.samples}, chi2 {estimate.chi2:.1f})"
        )
    if found.yaw_rad is not None:
        yield f"optical axis {np.degrees(found.yaw_rad):+.2f} deg left of the direction of travel (for information)"
    yield f"height {camera.height_m:.3f} m, {height_by.words}"
    if height_by.contradicted_by:
        yield f"  CONTRADICTED: {height_by.contradicted_by}; the sigma below covers both"
    if readout is not None:
        yield from _rows(readout, height_by, found.speed_mps)
    if camera.scale_sigma_rel:
        yield f"all lengths +- {camera.scale_sigma_rel:.0%} (scale_sigma_rel)"
    for check in found.height_checks:
        if check in height_by.checks:
            continue
        sigma_rel = check_sigma_rel(check)
        away = abs(math.log(check.height_m / camera.height_m)) / sigma_rel
        verdict = "agrees" if away < AGREES_SIGMA else f"DISAGREES ({away:.1f} sigma)"
        lag = f", {check.lag_s:.1f} +- {check.lag_sigma_s:.1f} s behind the images" if check.lag_sigma_s else ""
        yield f"  by {check.cue}: {check.height_m:.2f} m +- {sigma_rel:.0%} (of {check.samples}{lag}): {verdict}"
    if not found.height_checks:
        yield "  not checked: no poses, no speed, and too few vehicles and lane markings"


def _rows(readout: Readout, height_by: HeightBy, speed_mps: float) -> Iterator[str]:
    """Yields the readout time of the rows, its source, and its effect on all lengths."""
    effect = f": lengths +- {height_by.shutter_rel:.1%} at {speed_mps:.0f} m/s" if height_by.shutter_rel else ""
    yield f"rows read in {1e3 * readout.readout_s:.0f} +- {1e3 * readout.sigma_s:.0f} ms (readout_s){effect}"
    if readout.by_drive is None:
        yield "  as of most cameras: the drive does not determine it"
    else:
        by_drive_ms, sigma_ms = (1e3 * each for each in readout.by_drive)
        yield f"  by the drive {by_drive_ms:.0f} +- {sigma_ms:.0f} ms (of {readout.windows} windows)"
        yield f"  by most cameras {1e3 * PRIOR.readout_s:.0f} +- {1e3 * PRIOR.sigma_s:.0f} ms"


def write_camera_file(path: Path, camera: Camera, report: Sequence[str]) -> None:
    """Writes the camera, with the report as comment. Raises ResultsError."""
    text = camera_text(camera, ("A camera file of BirdSLAM, by `birdslam calibrate`", *report))
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")
    except OSError as error:
        raise ResultsError(f"camera file {path}: {error.strerror}") from None
