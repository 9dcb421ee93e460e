"""Odometry: properties on a rendered street, and results on the real clips."""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Callable, Iterable
from pathlib import Path

import cv2
import msgspec
import numpy as np
import pytest

from birdslam.geometry.camera import Camera, GroundPlane
from birdslam.geometry.pose import Pose, rotation_exp, rotation_log
from birdslam.odometry.motion import MotionConfig, planar
from birdslam.odometry.motion_model import MotionModel
from birdslam.odometry.motion_records import MotionRecords
from birdslam.odometry.odometry import Motion, Odometry, OdometryConfig
from birdslam.odometry.road.scale import RoadScale
from birdslam.odometry.scale_config import RoadScaleConfig
from birdslam.sources.opening import open_recording
from birdslam.sources.shipped_drive import DemoRecording
from birdslam.types import Status
from tests.cases import first

pytestmark = pytest.mark.numeric

WIDTH_PX, HEIGHT_PX = 620, 188
CAMERA = Camera(WIDTH_PX, HEIGHT_PX, 360.0, 360.0, 305.0, 90.0, height_m=1.65)
NO_BOXES = np.zeros((0, 4))
PITCH_RAD = math.radians(0.8)  # of the rendered camera; CAMERA doesn't know it


@functools.cache
def _texture(seed: int) -> list[np.ndarray]:
    """Blotches and tiles of all sizes, 2 cm a texel, halved again and again."""
    rng = np.random.default_rng(seed)
    image = np.zeros((1024, 1024), np.float32)
    for octave in (2, 4, 8, 16, 32, 64):
        coarse = rng.normal(size=(1024 // octave, 1024 // octave)).astype(np.float32)
        for how in (cv2.INTER_LINEAR, cv2.INTER_NEAREST):
            image += cv2.resize(coarse, (1024, 1024), interpolation=how)
            coarse = coarse[::-1, ::-1]
    levels = [120.0 + 25.0 * image / image.std()]
    for _ in range(5):
        levels.append(cv2.pyrDown(levels[-1]))
    return levels


def _sample(seed: int, a_m: np.ndarray, b_m: np.ndarray, footprint_m: np.ndarray) -> np.ndarray:
    """The texture at points (a, b), mirrored at its edges, from the levels that suit each one's footprint; (N,)."""
    level = np.clip(np.log2(np.maximum(footprint_m / 0.02, 1.0)), 0.0, 4.99)
    out = np.zeros(a_m.shape, np.float32)
    for k, image in enumerate(_texture(seed)):
        seen = np.flatnonzero(np.abs(level - k) < 1.0)
        if len(seen):
            at = np.zeros((2, -(-len(seen) // WIDTH_PX), WIDTH_PX), np.float32)  # remap takes an image of points
            at.reshape(2, -1)[:, : len(seen)] = np.array([a_m[seen], b_m[seen]]) / (0.02 * 2**k)
            texels = cv2.remap(image, *at, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT_101)
            out[seen] += (1.0 - np.abs(level[seen] - k)) * texels.ravel()[: len(seen)]
    return out


_V, _U = np.mgrid[0:HEIGHT_PX, 0:WIDTH_PX].reshape(2, -1)
RAYS = np.array([(_U - CAMERA.cx_px) / CAMERA.fx_px, (_V - CAMERA.cy_px) / CAMERA.fy_px, np.ones(_U.shape)])


def render(pose: Pose, noise_seed: int = 0) -> np.ndarray:
    """A street between two house fronts, from `pose` (camera axes; the road is the plane y = 1.65 m)."""
    return _rendered(pose.R.tobytes(), pose.p.tobytes(), noise_seed).copy()


@functools.lru_cache(maxsize=256)  # a common start of drives
def _rendered(R: bytes, p_m: bytes, noise_seed: int) -> np.ndarray:
    p, d = np.frombuffer(p_m), np.frombuffer(R).reshape(3, 3).copy() @ RAYS
    with np.errstate(divide="ignore", invalid="ignore"):
        road = np.where(d[1] > 1e-4, (1.65 - p[1]) / d[1], np.inf)
        wall = (np.where(d[0] > 0.0, 7.0, -6.0) - p[0]) / d[0]
        wall[~(wall > 0.0)] = np.inf
        front = np.where(d[2] > 1e-3, (90.0 - p[2]) / d[2], np.inf)
        depth = np.minimum(np.minimum(road, wall), front)
        y_m = p[1] + depth * d[1]
    image = np.full(depth.shape, 210.0, np.float32)  # sky
    for surface, highest_m, (a, b), seed, blur in (
        (front, -6.0, (0, 1), 3, 1.0),
        (wall, -5.0, (2, 1), 2, 2.0),
        (road, -np.inf, (0, 2), 1, 4.0),
    ):
        at = np.flatnonzero((depth == surface) & (y_m > highest_m))
        a_m, b_m = (p[axis] + depth[at] * d[axis, at] for axis in (a, b))
        texels = _sample(seed, a_m, b_m, blur * np.minimum(depth[at], 100.0) / CAMERA.fx_px)
        image[at] = 0.6 * texels + 30.0 if surface is road else texels
    noise = np.random.default_rng(noise_seed).normal(0.0, 1.5, (HEIGHT_PX, WIDTH_PX))
    return np.clip(image.reshape(noise.shape) + noise, 0, 255).astype(np.uint8)


def street(steps: Iterable[tuple[float, float]]) -> list[Pose]:
    """Camera poses of a car that goes (forward_m, turn right rad) at each step, its camera pitched by PITCH_RAD."""
    tilt = GroundPlane(1.65, PITCH_RAD)
    R_level_cam = np.linalg.inv(GroundPlane(1.65).R_ego_cam) @ tilt.R_ego_cam
    car, out = Pose(np.eye(3), np.zeros(3)), []
    for forward_m, turn_rad in [(0.0, 0.0), *steps]:
        car = car @ Pose(rotation_exp(np.array([0.0, turn_rad, 0.0])), np.array([0.0, 0.0, forward_m]))
        out.append(car @ Pose(R_level_cam, np.zeros(3)))
    return out


Edit = Callable[[int, np.ndarray], np.ndarray | None]


def drive(
    poses: list[Pose],
    rate_hz: float = 10.0,
    edit: Edit = lambda k, image: image,
    masks: Callable[[int], np.ndarray | None] = lambda k: None,
    boxes: Callable[[int], np.ndarray] = lambda k: NO_BOXES,
    first: int = 0,
) -> tuple[dict[int, Pose], list[Motion]]:
    """Poses by frame, chained from the motions as a reader of them must (from_frame to to_frame), and the motions."""
    odometry, chained, motions = Odometry(CAMERA), {0: Pose(np.eye(3), np.zeros(3))}, []
    for k, pose in enumerate(poses):
        image = edit(k, render(pose, first + k))
        if image is None:
            continue
        tracks = odometry.track(image)
        motion = odometry.estimate(tracks, k, int(k * 1e9 / rate_hz), boxes(k), masks(k))
        ids, px = odometry.road_tracks
        assert len(ids) == len(px) == len(set(ids.tolist()))
        if motion is not None:
            assert motion.to_frame == k
            check_sane(motion)
            chained[k] = chained[motion.from_frame] @ Pose(motion.R_prev_curr, motion.t_prev_curr_m)
            motions.append(motion)
    return chained, motions


def check_sane(motion: Motion) -> None:
    for value in (motion.R_prev_curr, motion.t_prev_curr_m, motion.cov, motion.T_prev_curr.log()):
        assert np.isfinite(value).all()
    assert np.allclose(motion.R_prev_curr @ motion.R_prev_curr.T, np.eye(3), atol=1e-9)
    assert np.linalg.eigvalsh(motion.cov).min() > 0.0
    assert 0.0 < motion.scale_sigma_rel <= 1.01
    assert motion.standstill == (Status.STANDSTILL in motion.status)


def path_m(poses: Iterable[Pose]) -> float:
    p = np.array([pose.p for pose in poses])
    return float(np.linalg.norm(np.diff(p, axis=0), axis=1).sum())


STRAIGHT_10_HZ = [(0.7, 0.0)] * 24
CURVE_10_HZ = [(0.8, 0.004)] * 10 + [(0.8, -0.006)] * 12


FAST_33_HZ = [(0.22, 0.0)] * 36
DRIVES = ((STRAIGHT_10_HZ, 10.0), (CURVE_10_HZ, 10.0), (FAST_33_HZ, 33.0))


@functools.cache
def start(number: int, begin: int) -> tuple[dict[int, Pose], list[Motion]]:
    """A cold start at the image `begin` of one of DRIVES."""
    steps, rate_hz = DRIVES[number]
    return drive(street(steps)[begin:], rate_hz, first=begin)


@functools.cache
def starts() -> list[tuple[Pose, float, Motion]]:
    """Of 15 cold starts, five on each of three drives: the error of the last pose, the true length, the last motion."""
    out = []
    for number, (steps, _) in enumerate(DRIVES):
        for begin in range(5):
            rest = street(steps)[begin:]
            chained, motions = start(number, begin)
            error = rest[0].between(rest[-1]).between(chained[len(rest) - 1])
            out.append((error, path_m(rest), motions[-1]))
    return out


def test_rendered_drive_has_its_length_and_heading() -> None:
    """Median over 15 starts: error of the last pose 1.4 % of the length, 0.08 degrees."""
    assert np.median([np.linalg.norm(error.p) / length_m for error, length_m, _ in starts()]) < 0.03
    assert np.median([math.degrees(np.linalg.norm(rotation_log(error.R))) for error, _, _ in starts()]) < 0.3


def test_a_rendered_drive_gives_the_pitch_of_the_camera() -> None:
    """Median over 15 starts: 0.17 degrees off."""
    pitches = [motion.ground.pitch_rad for _, _, motion in starts()]
    assert np.median(np.abs(np.array(pitches) - PITCH_RAD)) < math.radians(0.2)
    assert all(motion.status == () for _, _, motion in starts())


def test_the_motion_of_the_foot_is_planar() -> None:
    ground = GroundPlane(1.65, 0.02, -0.01)
    step = Pose(np.eye(3), np.zeros(3))
    assert planar(step, ground).log() == pytest.approx([0.0, 0.0, 0.0], abs=1e-12)
    R = ground.R_ego_cam
    forward_left = np.array([[math.cos(0.1), -math.sin(0.1), 0], [math.sin(0.1), math.cos(0.1), 0], [0, 0, 1.0]])
    motion = planar(Pose(R.T @ forward_left @ R, R.T @ np.array([2.0, 0.3, 0.0])), ground)
    assert [motion.x_m, motion.y_m, motion.yaw_rad] == pytest.approx([2.0, 0.3, 0.1])


BRAKING = [(0.5, 0.0)] * 5 + [(0.38, 0.0), (0.26, 0.0), (0.14, 0.0)]  # as hard as tyres can, at 10 Hz


def test_standstill_keeps_the_pose_exactly_and_then_continues() -> None:
    steps = [*BRAKING, *[(0.0, 0.0)] * 10, *[(0.5, 0.0)] * 6]
    truth = street(steps)
    chained, motions = drive(truth)
    held = [chained[k].p for k in range(10, 19)]
    assert all(np.array_equal(held[0], p) for p in held)
    assert [Status.STANDSTILL in m.status for m in motions] == [False] * 8 + [True] * 10 + [False] * 6
    assert path_m(chained.values()) == pytest.approx(path_m(truth), rel=0.04)


def test_creeping_is_not_a_standstill() -> None:
    truth = street([(0.4, 0.0)] * 8 + [(0.006, 0.0)] * 40)
    chained, _ = drive(truth, rate_hz=33.0)
    crept = np.linalg.norm(chained[48].p - chained[8].p)
    assert crept == pytest.approx(0.24, abs=0.04)


def test_stopping_car_creeps_before_standstill() -> None:
    """The shipped drive at its red light: below 0.8 m/s corners move by less than counts from one image to the next."""
    recording = DemoRecording()
    at_m, odometry = recording.truth_poses()[:, :, 3], Odometry(recording.camera)
    off, told = [], []
    for frame in itertools.islice(recording.frames(720), 111):
        boxes = [body.box_px for body in recording.truth_bodies(frame.index) if body.visible > 0.05]
        motion = odometry.estimate(
            odometry.track(frame.image), frame.index, frame.t_source_ns, np.array(boxes).reshape(-1, 4)
        )
        if motion is None:
            continue
        way_m = float(np.linalg.norm(at_m[motion.to_frame] - at_m[motion.from_frame]))
        if 0.1 < way_m / (motion.to_frame - motion.from_frame) * recording.rate_hz < 1.2:
            off.append((motion.T_prev_curr.x_m - way_m) / math.sqrt(motion.cov[0, 0]))
            told.append(motion.standstill)
    assert len(off) > 40
    assert not any(told)
    assert np.sqrt(np.mean(np.square(off))) < 1.5  # an unchanged image bounds the motion


def test_turning_on_the_spot_does_not_travel() -> None:
    truth = street([(0.5, 0.0)] * 8 + [(0.0, 0.01)] * 12)
    chained, _ = drive(truth)
    assert np.linalg.norm(chained[20].p - chained[8].p) < 0.1
    turned = rotation_log(chained[8].between(chained[20]).R)
    assert np.linalg.norm(turned) == pytest.approx(0.12, abs=0.003)


def test_dark_and_frozen_and_missing_frames_cost_those_frames_only() -> None:
    truth = street([(0.7, 0.0)] * 24)
    last: dict[int, np.ndarray] = {}

    def edit(k: int, image: np.ndarray) -> np.ndarray | None:
        if k in (8, 9):
            return np.zeros_like(image)
        if k == 14:
            return last[13]
        if k in (18, 19):
            return None
        last[k] = image
        return image

    chained, motions = drive(truth, edit=edit)
    by_frame = {m.to_frame: m for m in motions}
    for k in (8, 9):
        assert {Status.CAMERA_DARK, Status.ODOMETRY_COASTING} <= set(by_frame[k].status)
        assert by_frame[k].from_frame == 7
    assert {Status.CAMERA_FROZEN, Status.ODOMETRY_COASTING} <= set(by_frame[14].status)
    assert by_frame[10].from_frame == 7
    assert by_frame[20].from_frame == 17
    assert Status.ODOMETRY_COASTING not in by_frame[20].status
    assert by_frame[9].cov[0, 0] > by_frame[8].cov[0, 0] > by_frame[7].cov[0, 0]
    assert chained[9].p == pytest.approx(truth[0].between(truth[9]).p, abs=0.3)
    assert np.linalg.norm(chained[24].p) == pytest.approx(path_m(truth), rel=0.04)


def nothing_to_see(k: int, image: np.ndarray) -> np.ndarray:
    """Images 8 to 21 show no corner."""
    flat = np.tile(np.linspace(60, 120, image.shape[1], dtype=np.uint8), (image.shape[0], 1))
    return flat if 8 <= k < 22 else image


def test_without_features_odometry_coasts_and_restarts() -> None:
    truth = street([(0.7, 0.0)] * 30)
    chained, motions = drive(truth, edit=nothing_to_see)
    blind = [m for m in motions if 8 <= m.to_frame < 22]
    assert all(Status.ODOMETRY_COASTING in m.status for m in blind)
    assert Status.LOW_TEXTURE in blind[0].status
    assert Status.ODOMETRY_COASTING not in motions[-1].status
    assert np.linalg.norm(chained[30].p) == pytest.approx(path_m(truth), rel=0.1)


def test_bump_at_a_restart_is_not_a_mount_change() -> None:
    """Only the first window of a drive may reveal a wrong pitch of the camera file."""
    truth = [
        Pose(pose.R, pose.p - [0.0, 0.04 if k >= 23 else 0.0, 0.0]) for k, pose in enumerate(street([(0.7, 0.0)] * 28))
    ]
    _, motions = drive(truth, edit=nothing_to_see)
    learned_rad = next(m for m in motions if m.to_frame == 7).ground.pitch_rad
    again = [m for m in motions if m.to_frame >= 23]
    assert Status.ODOMETRY_COASTING in next(m for m in motions if m.to_frame == 22).status  # restarted there
    assert max(abs(m.ground.pitch_rad - learned_rad) for m in again) < math.radians(1.0)


def test_vehicles_everywhere_give_no_motion() -> None:
    everything = np.array([[-10.0, -10.0, WIDTH_PX + 10.0, HEIGHT_PX + 10.0]])
    _, motions = drive(street([(0.7, 0.0)] * 9), boxes=lambda k: everything if k > 5 else NO_BOXES)
    assert {Status.LOW_TEXTURE, Status.ODOMETRY_COASTING} <= set(motions[-1].status)


def _lorry(image: np.ndarray, left_px: float, width_px: int) -> tuple[np.ndarray, np.ndarray]:
    """A textured side of a lorry over the whole height of the view, and its box."""
    side = np.clip(_texture(7)[0][: image.shape[0], :width_px], 0, 255).astype(np.uint8)
    out, first = image.copy(), round(left_px)
    a, b = max(first, 0), min(first + width_px, image.shape[1])
    if b > a:
        out[:, a:b] = side[:, a - first : b - first]
    return out, np.array([[a, 0.0, b, image.shape[0]]]) if b > a else NO_BOXES


def test_passing_lorry_does_not_move_a_stationary_ego() -> None:
    truth = street([*BRAKING, *[(0.0, 0.0)] * 14])
    at_px = {k: -260.0 + 45.0 * (k - 8) for k in range(9, 23)}  # it hides up to 40 % of the view
    chained, motions = drive(
        truth,
        edit=lambda k, image: _lorry(image, at_px[k], 250)[0] if k in at_px else image,
        boxes=lambda k: _lorry(np.zeros((HEIGHT_PX, WIDTH_PX), np.uint8), at_px[k], 250)[1] if k in at_px else NO_BOXES,
    )
    assert all(Status.STANDSTILL in m.status for m in motions if m.to_frame > 9)
    assert np.array_equal(chained[22].p, chained[10].p)


def test_large_lorry_ahead_does_not_bias_the_motion() -> None:
    truth = street([(0.6, 0.0)] * 26)
    width_px, left_px = 300, 160.0
    _, box = _lorry(np.zeros((HEIGHT_PX, WIDTH_PX), np.uint8), left_px, width_px)
    chained, motions = drive(
        truth,
        edit=lambda k, image: _lorry(image, left_px, width_px)[0] if k > 5 else image,  # as fast as the car itself
        boxes=lambda k: box if k > 5 else NO_BOXES,
    )
    assert not any(m.standstill for m in motions)
    assert np.linalg.norm(chained[26].p) == pytest.approx(path_m(truth), rel=0.06)


@pytest.mark.slow  # at 10 Hz above
def test_a_turn_on_the_spot_at_33_hz_does_not_travel_either() -> None:
    truth = street([(0.2, 0.0)] * 14 + [(0.0, 0.004)] * 30)
    chained, _ = drive(truth, rate_hz=33.0)
    assert np.linalg.norm(chained[44].p - chained[14].p) < 0.15
    turned = rotation_log(chained[14].between(chained[44]).R)
    assert np.linalg.norm(turned) == pytest.approx(0.12, abs=0.005)


def test_hidden_road_carries_the_scale_with_status() -> None:
    truth = street([(0.7, 0.0)] * 34)
    hidden = np.zeros((HEIGHT_PX, WIDTH_PX), bool)
    chained, motions = drive(truth, masks=lambda k: hidden if 10 <= k < 26 else None)
    sigma = [m.scale_sigma_rel for m in motions]
    walked = OdometryConfig().road.scale_walk_rel_per_sqrt_m ** 2 * 12 * 0.7
    assert sigma[24] ** 2 - sigma[12] ** 2 > 0.5 * walked
    assert [Status.SCALE_CARRIED in m.status for m in motions[6:]] == [False] * 11 + [True] * 8 + [False] * 9
    assert sigma[-1] < sigma[24]
    assert path_m(chained.values()) == pytest.approx(path_m(truth), rel=0.05)


def test_repeated_contradiction_counts_once() -> None:
    """A textured shadow that moves with the car is on the road: for 0.4 m, then 12 m more."""
    steps = [(0.35, 0.0)] * 36 + [(0.03, 0.0)] * 14 + [(0.35, 0.0)] * 36
    truth = street(steps)
    grain = 2.5 * cv2.resize(np.random.default_rng(5).normal(size=(30, 100)), (400, 90), interpolation=cv2.INTER_CUBIC)

    def shade(k: int, image: np.ndarray) -> np.ndarray:
        if k > 36:
            image[98:188, 110:510] = np.clip(45.0 + grain, 0, 255)
        return image

    chained, motions = drive(truth, rate_hz=33.0, edit=shade)
    trouble = {Status.SCALE_INVALID, Status.GROUND_VIOLATED, Status.VIEW_OBSTRUCTED}
    told = {m.to_frame for m in motions if trouble & set(m.status)}
    assert not told & set(range(37, 51))
    assert path_m(chained[k] for k in range(36, 51)) == pytest.approx(0.42, rel=0.08)
    assert told & set(range(51, 87))
    assert path_m(chained[k] for k in range(50, 87)) == pytest.approx(36 * 0.35, rel=0.05)


@pytest.mark.parametrize("seed", first(1, range(3)))
def test_late_masks_change_length_within_sigma(seed: int) -> None:
    """Masks of a road that bends: of each frame; then of some frames before or none, as the networks' time has it."""
    truth = street([(0.35, 0.003 * math.sin(k / 6.0)) for k in range(40)])
    images = [render(pose, k) for k, pose in enumerate(truth)]
    masks: list[np.ndarray | None] = []
    for pose in truth:  # road no farther to the side than 3 m
        d = pose.R @ RAYS
        aside_m = pose.p[0] + d[0] / np.maximum(d[1], 1e-4) * 1.65
        masks.append(((d[1] > 1e-2) & (np.abs(aside_m) < 3.0)).reshape(HEIGHT_PX, WIDTH_PX))

    def driven(late: list[np.ndarray | None]) -> tuple[float, float]:
        """The length in metres and its relative sigma at the end."""
        odometry, steps, sigma_rel = Odometry(CAMERA), [], 1.0
        for k, (image, mask) in enumerate(zip(images, late, strict=True)):
            motion = odometry.estimate(odometry.track(image), k, int(k * 1e9 / 33.0), NO_BOXES, mask)
            if motion is not None:
                steps.append(float(np.linalg.norm(motion.t_prev_curr_m)))
                sigma_rel = motion.scale_sigma_rel
        return sum(steps), sigma_rel

    in_time_m, _ = driven(masks)
    assert in_time_m == pytest.approx(path_m(truth), rel=0.03)
    rng, age = np.random.default_rng(seed), 0
    late: list[np.ndarray | None] = []
    for k in range(len(masks)):
        age = 0 if rng.random() < 0.5 else min(age + 1, 5, k)
        late.append(None if rng.random() < 0.1 else masks[k - age])
    length_m, sigma_rel = driven(late)
    assert abs(math.log(length_m / in_time_m)) < sigma_rel


def test_featureless_first_images_give_no_motion() -> None:
    odometry, black = Odometry(CAMERA), np.zeros((HEIGHT_PX, WIDTH_PX, 3), np.uint8)
    for k in range(3):
        assert odometry.estimate(odometry.track(black), k, k * 10**8, NO_BOXES, None) is None


def test_an_image_of_another_size_is_an_error() -> None:
    with pytest.raises(ValueError, match="does not fit"):
        Odometry(CAMERA).track(np.zeros((10, 20), np.uint8))


def test_settings_are_typed_and_closed() -> None:
    config = msgspec.convert({"road": {"align": {"far_m": 30.0}}, "keyframes": 5}, OdometryConfig)
    assert config.road.align.far_m == 30.0
    with pytest.raises(msgspec.ValidationError):
        msgspec.convert({"keyframe": 5}, OdometryConfig)
    with pytest.raises(msgspec.ValidationError):
        msgspec.convert({"reject_px": -1.0}, OdometryConfig)


class KnownScale(RoadScale):
    """A scale that is known to a percent."""

    sigma_rel = 0.01


@pytest.mark.parametrize(("step_m", "sigma_m", "valid"), [(1.0, 0.02, True), (1.0, 0.2, False), (0.02, 0.02, True)])
def test_motion_of_uncertain_length_is_invalid(step_m: float, sigma_m: float, valid: bool) -> None:
    """However well the scale is known: behind heavy rain few corners are the street's."""
    scale = KnownScale(CAMERA, RoadScaleConfig())
    records = MotionRecords(MotionConfig(), 1.7, scale, MotionModel(), RoadScaleConfig().invalid_sigma_rel)
    cov6 = np.diag([0.001**2, 0.001**2, sigma_m**2, 1e-8, 1e-8, 1e-8])
    motion = records.measured((0, 1), Pose(np.eye(3), np.array([0.0, 0.0, step_m])), cov6, False, 0.1, 0.0)
    assert (Status.SCALE_INVALID not in motion.status) == valid


def test_odometry_is_deterministic() -> None:
    _, again = drive(street(STRAIGHT_10_HZ))
    _, once = start(0, 0)
    assert [m.t_prev_curr_m.tobytes() + m.R_prev_curr.tobytes() + m.cov.tobytes() for m in once] == [
        m.t_prev_curr_m.tobytes() + m.R_prev_curr.tobytes() + m.cov.tobytes() for m in again
    ]


def test_reset_starts_over_with_new_track_ids() -> None:
    odometry, (first, second) = Odometry(CAMERA), street([(0.7, 0.0)])
    before = odometry.track(render(first))
    odometry.estimate(before, 0, 0, NO_BOXES, None)
    odometry.reset()
    after = odometry.track(render(second))
    assert odometry.estimate(after, 1, 10**8, NO_BOXES, None) is None
    assert after.ids.min() > before.ids.max()


# --- real clips ---


def test_the_ego_of_the_raw_clip_is_stationary_when_it_has_stopped(data_dir: Path) -> None:
    recording = open_recording(f"kitti:{data_dir / 'kitti_raw_clip'}")
    odometry, at = Odometry(recording.camera), {0: Pose(np.eye(3), np.zeros(3))}
    for k, frame in enumerate(recording.frames()):
        motion = odometry.estimate(odometry.track(frame.image), k, frame.t_source_ns, NO_BOXES, None)
        if motion is not None:
            check_sane(motion)
            at[k] = at[motion.from_frame] @ Pose(motion.R_prev_curr, motion.t_prev_curr_m)
    assert max(np.linalg.norm(at[k].p - at[60].p) for k in range(60, len(recording))) < 0.1
