"""Rendered dashcams: narrow and wide lenses, a rolling shutter, a wiper, drops, a bonnet.

The films in tests/dashcams show the shipped drive's street at 10 Hz, 6 s through its first bend, in H.264.
"""

from __future__ import annotations

import functools
import math
from pathlib import Path

import numpy as np
import pytest

from birdslam.calibration.lens import Lens, self_calibrate
from birdslam.calibration.lens_windows import CornersOfImage, track_corners
from birdslam.calibration.readout import PRIOR
from birdslam.geometry.camera import Undistorter
from birdslam.odometry.odometry import Odometry
from birdslam.perf.accuracy.drives import is_valid
from birdslam.runtime.calibration.height import shutter_rel
from birdslam.sources.camera_file import load_camera
from birdslam.sources.opening import open_recording
from birdslam.types import Status

pytestmark = pytest.mark.numeric

FILMS = Path(__file__).parent / "dashcams"
NAMES = ("narrow", "phone", "rain", "wide")
NO_BOXES = np.zeros((0, 4))
PRIOR_SIGMA = 0.15


def images_of(name: str) -> list[np.ndarray]:
    recording = open_recording(f"video:{FILMS / name}.mp4", load_camera(FILMS / f"{name}.toml"))
    return [frame.image for frame in recording.frames() if frame.image is not None]


def lens_of(name: str, prior: float) -> tuple[Lens | None, float]:
    """What the film shows with a focal length beforehand that is off by a factor; and the error of the found one."""
    camera = load_camera(FILMS / f"{name}.toml")
    corners = track_corners(((image, NO_BOXES, 0.1 * k) for k, image in enumerate(images_of(name))), camera)
    some = [CornersOfImage(each.ids, each.px) for each in corners]
    lens = self_calibrate(some, (camera.width_px, camera.height_px), prior * camera.fx_px, PRIOR_SIGMA)
    return lens, 0.0 if lens is None else math.log(lens.focal_px / camera.fx_px)


@pytest.mark.slow
def test_lenses_from_films_are_within_their_sigma_or_refused() -> None:
    """Of eight estimates, with a prior 15 % too long or too short, at most one is beyond 2 sigma."""
    found = [lens_of(name, prior) for name in NAMES for prior in (1.15, 1.0 / 1.15)]
    beyond = [lens is not None and abs(error) > 2.0 * lens.focal_sigma_rel for lens, error in found]
    assert sum(beyond) <= 1


def distance(name: str, first: int) -> tuple[float, float, float]:
    """A start at image `first`: log of the distance over the true one, its 1-sigma, and the share of valid motions."""
    camera = load_camera(FILMS / f"{name}.toml")
    with np.load(FILMS / f"{name}.npz") as kept:
        at_m = kept["T_world_cam"][:, :3, 3]
    odometry = Odometry(camera)
    own_m = true_m = 0.0
    sigmas, valid = [], []
    for k, image in enumerate(undistorted(name)[first : first + 28], first):
        motion = odometry.estimate(odometry.track(image), k, k * 100_000_000, NO_BOXES, None)
        if motion is None:
            continue
        valid.append(is_valid(motion))
        assert Status.STANDSTILL not in motion.status
        if valid[-1]:
            own_m += float(np.linalg.norm(motion.t_prev_curr_m))
            true_m += float(np.linalg.norm(at_m[k] - at_m[motion.from_frame]))
            sigmas.append(motion.scale_sigma_rel)
    speed_mps = float(np.linalg.norm(np.diff(at_m, axis=0), axis=1).mean()) * 10.0
    shutter = shutter_rel(camera, camera.height_m, speed_mps, PRIOR.sigma_s)
    return math.log(own_m / true_m), math.hypot(float(np.median(sigmas)), shutter), float(np.mean(valid))


@functools.cache
def undistorted(name: str) -> list[np.ndarray]:
    undistort = Undistorter(load_camera(FILMS / f"{name}.toml"))
    return [undistort(image) for image in images_of(name)]


@pytest.mark.slow
def test_distances_of_dashcams_with_a_known_lens_are_within_their_sigma() -> None:
    """Of 16 starts, four of each film: median error 0.7 %, the worst at 0.8 sigma, 89 % valid and more.

    A phone and a wide lens read their rows in turn; without the readout's correction the phone's error is 3 %.
    """
    found = [distance(name, first) for name in NAMES for first in (0, 4, 8, 12)]
    error, sigma, valid = np.transpose(found)
    assert np.median(np.abs(error)) < 0.015
    assert np.mean(np.abs(error) < 2.0 * sigma) >= 0.9
    assert np.mean(valid) > 0.8
