"""Hard roads hold for ever: motorways, ramps and nights of the built-in world, and what comes to lie on the windscreen.

From the first, the third and the fifth image, without networks: no valid frame has a speed off by more than a tenth,
no way is off by more than 5 %, nothing says standstill while the car drives, four frames in five are valid. Of some a
few valid frames do not hold yet (NOT_YET). tests/roads was rendered by

    python -m perf roads motorway_20 motorway_40 ramp_20 ramp_21_glare night_street night_motorway \
        --frames 26 --quality 70 --keep tests/roads
"""

from __future__ import annotations

import importlib.util
from itertools import islice
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from birdslam.geometry.pose import Pose, rotation_exp
from birdslam.odometry.road.alignment import RoadAlignConfig, RoadAligner
from birdslam.perf.accuracy.drives import SCALE_LIMIT, Drive, errors, follow
from birdslam.perf.accuracy.roads import EFFECTS, measure, read
from birdslam.sources.shipped_drive import DIRECTORY, DemoRecording
from birdslam.trajectory import inverse
from birdslam.types import Status
from birdslam.world.compression import VideoEncoder
from birdslam.world.windscreen import KINDS, Overlay, bonnet
from tests.cases import first

CLIPS = Path(__file__).parent / "roads"
NAMES = ("motorway_20", "motorway_40", "ramp_20", "ramp_21_glare", "night_street", "night_motorway")
# Where a few valid frames are off by more than a tenth still: of the street's motions beside what lies on the glass, of
# the night's between its lamps. A rounding decides between none and four
NOT_YET = ("night_street", *(f"street+{effect}" for effect in EFFECTS))
MOST_WRONG = 4  # of their motions, some 70 to 120 in all
BEGIN_AT = (0, 2, 4)  # one start alone is luck: a rounding decides between 4 and 6 %
FRAMES = 26
QUALITY = 70  # of the clips' WebP images
TOWN_STRIDE, TOWN_FRAMES = 3, 44  # of the shipped drive: 44 m of a street; what comes, comes after half of them
LEAST_VALID = 0.8  # of the frames: the first two or three of a cold start are in doubt


def holds(row: dict[str, Any], name: str = "") -> None:
    """The four things that are asked of every road."""
    assert row["way_m"] > 20.0
    assert row["standstill"] == 0
    assert max(abs(error) for error in row["scale_errors"]) <= SCALE_LIMIT
    assert len(row["wrong_valid"]) <= (MOST_WRONG if name in NOT_YET else 0)
    assert row["valid"] >= LEAST_VALID * row["motions"]


@pytest.mark.parametrize("name", first(1, sorted(NAMES, key=("night_street", *NAMES).index)))
def test_a_cold_start(name: str) -> None:
    holds(measure(read(DemoRecording(directory=CLIPS / name)), BEGIN_AT), name)


@pytest.mark.parametrize("effect", first(0, EFFECTS))
def test_a_street_behind_a_windscreen(effect: str) -> None:
    town = DemoRecording(stride=TOWN_STRIDE, directory=DIRECTORY)
    holds(measure(read(town, EFFECTS[effect](), TOWN_FRAMES), BEGIN_AT), f"street+{effect}")


@pytest.mark.parametrize("effect", first(3, sorted(EFFECTS, key=("bonnet", "drops", "compression", *EFFECTS).index)))
def test_a_motorway_behind_a_windscreen(effect: str) -> None:
    holds(measure(read(DemoRecording(directory=CLIPS / "motorway_20"), EFFECTS[effect]()), BEGIN_AT))


@pytest.mark.parametrize("effect", first(0, EFFECTS))
def test_a_fast_motorway_behind_a_windscreen(effect: str) -> None:
    """Drops that come must not stop a car that drives: what they agree on knows no length."""
    holds(measure(read(DemoRecording(directory=CLIPS / "motorway_40"), EFFECTS[effect]()), BEGIN_AT))


def told_obstructed(drive: Drive) -> list[bool]:
    """Of each motion from the middle on, where what comes has come: whether something on the glass is told of."""
    _, motions = follow(drive, range(len(drive.images)))
    return [Status.VIEW_OBSTRUCTED in motion.status for motion in motions if motion.to_frame > len(drive.images) // 2]


@pytest.mark.parametrize("name", first(1, ["motorway_40", "ramp_20", "ramp_21_glare"]))
def test_lines_along_the_way_are_not_told_as_something_on_the_glass(name: str) -> None:
    assert not any(told_obstructed(read(DemoRecording(directory=CLIPS / name))))


@pytest.mark.parametrize("effect", first(1, ["drops", "dirt", "reflection"]))
def test_what_is_on_the_glass_of_a_motorway_is_told(effect: str) -> None:
    told = told_obstructed(read(DemoRecording(directory=CLIPS / "motorway_20"), EFFECTS[effect]()))
    assert sum(told) >= 0.3 * len(told)


@pytest.mark.parametrize("begin", first(1, [0, 1, 6]))  # of the images
def test_a_bonnet_that_makes_the_car_seem_to_stand_is_seen_through(begin: int) -> None:
    """Two images do not show its edge yet, and on the near road it stands: the farther road moves."""
    drive = read(DemoRecording(directory=CLIPS / "motorway_20"), EFFECTS["bonnet"]())
    whole = errors(drive, range(begin, FRAMES), *follow(drive, range(begin, FRAMES)))
    assert whole is not None
    assert whole["scale_error"][0] > -0.3  # of the first step
    assert abs(whole["scale_error"][-1]) < SCALE_LIMIT


# --- how much a comparison of the road is believed ---


def test_a_comparison_errs_by_as_much_as_it_says() -> None:
    """Of a motion that is disturbed at random the length is measured; its error over its sigma is 1 in the mean."""
    drive = read(DemoRecording(stride=TOWN_STRIDE, directory=DIRECTORY), None, 24)
    camera, rng, squares = drive.camera, np.random.default_rng(1), []
    aligner = RoadAligner(camera, RoadAlignConfig())
    images = [aligner.image(image) for image in drive.images]
    prior = np.array([0.0, camera.pitch_rad, camera.roll_rad, 0.0])
    known = np.diag(np.square([0.3, 0.005, 0.005, 0.0001]))  # the tilt is; the length is not
    for k in range(1, len(images)):
        true = inverse(drive.poses[k - 1]) @ drive.poses[k]
        length_m = float(np.linalg.norm(true[:3, 3]))
        aside = length_m * np.append(rng.normal(0.0, 0.015, 2), 0.0)
        T = Pose(true[:3, :3] @ rotation_exp(rng.normal(0.0, 0.0005, 3)), true[:3, 3] + aside)
        px = aligner.samples((camera.pitch_rad, camera.roll_rad), drive.seen[k][0], None)
        fit = aligner.align(images[k - 1], images[k], T, px, prior, known, (0.0005, 0.015))
        assert fit is not None
        both = np.linalg.inv(np.linalg.inv(fit.cov) + np.linalg.inv(known))
        joined = both @ (np.linalg.solve(fit.cov, fit.state) + np.linalg.solve(known, prior))
        squares.append(joined[0] ** 2 / both[0, 0])
    assert 0.1 < float(np.mean(squares)) < 2.0


# --- what is drawn over images ---


@pytest.fixture(scope="module")
def images() -> list[np.ndarray]:
    frames = islice(DemoRecording(stride=TOWN_STRIDE).frames(), 4)
    return [frame.image for frame in frames if frame.image is not None]


@pytest.mark.parametrize("kind", KINDS)
def test_an_overlay_stands_still_and_is_drawn_the_same_each_time(kind: str, images: list[np.ndarray]) -> None:
    height, width = images[0].shape[:2]
    first, again = (Overlay(kind, width, height, seed=1) for _ in range(2))
    changed = []
    for image in images:
        drawn = first.draw(image)
        assert drawn.tobytes() == again.draw(image).tobytes()
        changed.append((np.abs(drawn.astype(int) - image) > 12).any(axis=2))
    if kind == "nothing":
        assert not np.any(changed)
    else:
        assert 0.01 < changed[0].mean() < 0.3
        assert (changed[0] & changed[-1]).sum() > 0.5 * changed[0].sum()
        grey = cv2.cvtColor(images[0], cv2.COLOR_BGR2GRAY)
        assert first.draw(grey).shape == grey.shape


def test_a_bonnet_covers_the_lower_edge_alone(images: list[np.ndarray]) -> None:
    image = images[0]
    for one in (image, cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)):
        drawn = bonnet(one)
        rows = np.flatnonzero((drawn != one).reshape(len(one), -1).any(axis=1))
        assert 0.8 * len(one) < rows.min()
        assert rows.max() == len(one) - 1


@pytest.mark.parametrize("size", [(640, 192), (621, 187)])
def test_compression_loses_what_is_faint_and_keeps_what_is_strong(
    images: list[np.ndarray], size: tuple[int, int]
) -> None:
    sized = [cv2.resize(image, size) for image in images]
    coarse, fine = VideoEncoder(step=40.0), VideoEncoder(step=2.0)
    errors = []
    for image in sized:
        lost, kept = coarse.code(image), fine.code(image)
        assert lost.shape == kept.shape == image.shape
        errors.append([float(np.abs(one.astype(float) - image).mean()) for one in (lost, kept)])
    assert (np.array(errors)[:, 0] > 2.0).all()
    assert (np.array(errors)[:, 0] < 12.0).all()
    assert (np.array(errors)[:, 1] < 0.5 * np.array(errors)[:, 0]).all()


def test_a_flat_road_stands_still_behind_an_encoder() -> None:
    """What moves too faintly to be coded stays where it was: the encoder's worst for an odometry."""
    rng = np.random.default_rng(2)
    grain = cv2.GaussianBlur(rng.normal(0.0, 8.0, (64, 256)), (0, 0), 1.5)
    encoder = VideoEncoder(step=32.0)
    shown = [encoder.code(np.clip(90.0 + grain[:, k : k + 128], 0, 255).astype(np.uint8)) for k in range(0, 9, 3)]
    assert np.abs(shown[1].astype(int) - shown[0]).max() <= 1
    assert encoder.code(np.full((64, 128), 200, np.uint8)).mean() > 150.0  # another scene is coded


# --- rendered anew ---


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_a_clip_is_what_its_seed_renders(name: str, tmp_path: Path) -> None:
    """The truth to the bit; the images but for what another processor or another WebP rounds."""
    if importlib.util.find_spec("numba") is None:
        pytest.skip("the built-in world is rendered with numba (extra `train`)")
    from birdslam.runtime.world.demo_drive import SAMPLES, write
    from birdslam.world.roads import ROADS, camera_of
    from birdslam.world.scenario import drive

    kept, road, camera = DemoRecording(directory=CLIPS / name), ROADS[name], camera_of(640)
    assert len(kept) == FRAMES
    write(tmp_path, drive(road.scenario(), camera, FRAMES, road.rate_hz, SAMPLES), camera, road.rate_hz, QUALITY)
    again = DemoRecording(directory=tmp_path)
    assert again.camera == kept.camera
    assert again.rate_hz == kept.rate_hz
    np.testing.assert_allclose(again.truth_poses(), kept.truth_poses(), atol=1e-9)
    for one, other in zip(again.frames(), kept.frames(), strict=True):
        assert one.image is not None
        assert other.image is not None
        assert np.abs(one.image.astype(int) - other.image).mean() < 1.0
