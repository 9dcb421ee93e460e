"""Rendered dashcams hold for ever: lens, rows read in turn, wipers, drops, bonnet, each with its camera file unknown.

The films in tests/dashcams are rendered by

    python -m perf lens narrow phone rain wide --render tests/dashcams

(extra `train`, and PyAV): the shipped drive's street at 10 Hz, 6 s through its first bend, by four of
`world.dashcam.DASHCAMS`, H.264.
"""

from __future__ import annotations

import importlib.util
import math
from pathlib import Path

import numpy as np
import pytest

from birdslam.calibration.lens import Lens, self_calibrate
from birdslam.calibration.lens_windows import CornersOfImage, followed_corners
from birdslam.calibration.readout import USUAL
from birdslam.geometry.camera import Undistorter
from birdslam.odometry.odometry import Odometry
from birdslam.perf.accuracy.drives import is_valid
from birdslam.runtime.calibration.height import shutter_rel
from birdslam.sources.camera_file import load_camera
from birdslam.sources.opening import open_recording
from birdslam.types import Status
from tests.cases import first

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
    corners = followed_corners(((image, NO_BOXES, 0.1 * k) for k, image in enumerate(images_of(name))), camera)
    some = [CornersOfImage(each.ids, each.px) for each in corners]
    lens = self_calibrate(some, (camera.width_px, camera.height_px), prior * camera.fx_px, PRIOR_SIGMA)
    return lens, 0.0 if lens is None else math.log(lens.focal_px / camera.fx_px)


@pytest.mark.slow
@pytest.mark.parametrize("prior", [1.15, 1.0 / 1.15])
@pytest.mark.parametrize("name", NAMES)
def test_a_lens_from_the_film_is_within_its_sigma_or_refused(name: str, prior: float) -> None:
    lens, error = lens_of(name, prior)
    assert lens is None or abs(error) < 2.0 * lens.focal_sigma_rel


@pytest.mark.slow  # docs/lens.md has it too
def test_a_narrow_lens_with_distortion_is_not_taken_for_a_longer_one() -> None:
    """A sigma by interleaved windows once said +36.8 +- 3 % of such a film."""
    lens, error = lens_of("narrow", 1.15)
    assert lens is not None
    assert abs(error) < 2.0 * lens.focal_sigma_rel
    assert abs(lens.k1 + 0.3) < 2.5 * math.hypot(lens.k1_sigma, 2.0 * 0.3 * lens.focal_sigma_rel)


def ways(name: str) -> tuple[float, float, float, list[bool]]:
    """The way over the true one and its 1-sigma, of valid frames; the mean true speed; and which were valid."""
    camera = load_camera(FILMS / f"{name}.toml")
    with np.load(FILMS / f"{name}.npz") as kept:
        at_m = kept["T_world_cam"][:, :3, 3]
    odometry, undistort = Odometry(camera), Undistorter(camera)
    way_m = true_m = 0.0
    sigmas, valid = [], []
    for k, image in enumerate(images_of(name)):
        motion = odometry.estimate(odometry.track(undistort(image)), k, k * 100_000_000, NO_BOXES, None)
        if motion is None:
            continue
        valid.append(is_valid(motion))
        assert Status.STANDSTILL not in motion.status
        if valid[-1]:
            way_m += float(np.linalg.norm(motion.t_prev_curr_m))
            true_m += float(np.linalg.norm(at_m[k] - at_m[motion.from_frame]))
            sigmas.append(motion.scale_sigma_rel)
    speed_mps = float(np.linalg.norm(np.diff(at_m, axis=0), axis=1).mean()) * 10.0
    shutter = shutter_rel(camera, camera.height_m, speed_mps, USUAL.sigma_s)
    sigma_rel = math.hypot(float(np.median(sigmas)), shutter) if sigmas else math.inf
    return (way_m / true_m if true_m else math.nan), sigma_rel, speed_mps, valid


@pytest.mark.parametrize("name", first(1, ["rain", "phone"]))
def test_a_known_lens_gives_a_way_within_its_sigma(name: str) -> None:
    ratio, sigma_rel, _, valid = ways(name)
    assert np.mean(valid) > 0.8
    assert abs(math.log(ratio)) < 2.0 * sigma_rel


@pytest.mark.slow
@pytest.mark.parametrize("name", ["narrow", "wide"])
def test_the_others_ways_are_within_their_sigma(name: str) -> None:
    ratio, sigma_rel, _, valid = ways(name)
    assert not any(valid) or abs(math.log(ratio)) < 2.0 * sigma_rel


# --- rendered anew ---


def rendered(name: str, count: int) -> list[np.ndarray]:
    if importlib.util.find_spec("numba") is None:
        pytest.skip("the built-in world is rendered with numba (extra `train`)")
    from birdslam.world.dashcam import DASHCAMS, film
    from birdslam.world.demo_world import demo_scenario

    return [frame.image for frame in film(demo_scenario(), DASHCAMS[name], count, 10.0)]


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_a_film_is_what_its_dashcam_takes(name: str) -> None:
    """But for what the encoder lost, and another processor rounds."""
    for one, other in zip(rendered(name, 2), images_of(name), strict=False):
        assert np.abs(one.astype(int) - other).mean() < 8.0
