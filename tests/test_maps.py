"""Repeated drives: place recognition, kept maps, loop closure, in simulated streets with exact truth."""

import copy
import math
import struct
import zlib
from collections.abc import Iterator
from dataclasses import replace
from itertools import islice
from pathlib import Path

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from birdslam.geometry.arrays import Ints
from birdslam.geometry.se2 import SE2
from birdslam.loops.closing import close_loops, held
from birdslam.loops.features import Features, match, match_near
from birdslam.loops.foot import body_pose, foot
from birdslam.loops.keyframe import Link
from birdslam.loops.localiser import LOOK_UP_EVERY_M, Localisation
from birdslam.loops.map_file import HEAD, MAGIC, MapError, decode_map, encode_map
from birdslam.loops.map_pose import MapPose, MapState, in_map
from birdslam.loops.merging import MergeError, merged
from birdslam.loops.place_index import PlaceIndex, learn_words
from birdslam.loops.place_map import MapCamera, PlaceMap
from birdslam.loops.session import MapSession
from birdslam.loops.verification import OTHER_VIEW_PX, LocalMap, locate
from birdslam.outputs.map_trajectory import MapTrajectory, TrajectoryFiles
from birdslam.perf.maps.places import CAMERA, OTHER_LIGHT_BITS, Street, along, block, build, drive
from birdslam.runtime.batch.one_map import DRIVE_MAP, join
from birdslam.runtime.cli.commands import parse
from birdslam.runtime.configuration import ConfigurationError, load
from birdslam.runtime.maps import held_way, map_drive
from birdslam.runtime.maps.map_drive import MapChoice
from birdslam.runtime.maps.map_store import read_map, write_map
from birdslam.trajectory import mount_pose
from birdslam.types import Attitude, Estimate
from tests import drifting_scale
from tests.cases import first

STREET = replace(build(along([0.0] * 70 + [0.004] * 90), seed=1), max_seen=120)
OTHER = replace(build(along([0.0] * 200), seed=2), max_seen=120)


def session(place_map: PlaceMap, extend: bool) -> MapSession:
    """Features come ready-made in place of images."""
    return MapSession(CAMERA, place_map, extend, extract=lambda features: features)


def driven(
    place_map: PlaceMap, street: Street, rows: range, extend: bool = False, seed: int = 1, **how: float
) -> list[tuple[Localisation, SE2]]:
    """The session's result for each frame, and the true ego pose in the frame of the route."""
    running = session(place_map, extend)
    out = [(running.step(estimate, seen), T) for estimate, seen, T in drive(street, rows, seed, **how)]
    running.finish()
    return out


@pytest.fixture(scope="module")
def mapped() -> bytes:
    place_map = PlaceMap(MapCamera.of(CAMERA))
    driven(place_map, STREET, range(120), extend=True)
    return encode_map(place_map)


def errors(found: list[tuple[Localisation, SE2]]) -> np.ndarray:
    return np.array(
        [T.between(here.T_map_ego).log() for here, T in found if here.state is MapState.LOCALISED and here.T_map_ego]
    )


FIRST = 20  # frames of the drive that localise it


def second_drive() -> Iterator[tuple[Estimate, Features, SE2]]:
    return drive(STREET, range(10, 70), 3)


@pytest.fixture(scope="module")
def after_first(mapped: bytes) -> MapSession:
    running = session(decode_map(mapped), extend=False)
    for estimate, seen, _ in islice(second_drive(), FIRST):
        here = running.step(estimate, seen)
    assert here.state is MapState.LOCALISED
    return running


@pytest.fixture
def localised(after_first: MapSession) -> MapSession:
    return another(after_first)


def another(after_first: MapSession) -> MapSession:
    """A session in the same map after the FIRST frames of the second drive."""
    return copy.deepcopy(after_first, {id(after_first.map): after_first.map})


@pytest.mark.parametrize(
    "how", first(1, [{"lateral_m": 1.5}, {}, {"bits": OTHER_LIGHT_BITS}]), ids=["lane", "same", "light"]
)
def test_a_second_drive_is_localised(mapped: bytes, how: dict[str, float]) -> None:
    found = driven(decode_map(mapped), STREET, range(20, 60), seed=7, **how)
    error = errors(found)
    assert len(error) >= 0.9 * len(found)
    position = np.hypot(error[:, 0], error[:, 1])
    assert np.median(position) < 0.4  # the map itself drifts by 1 % of its 80 m
    assert position.max() < 1.0
    assert np.degrees(np.abs(error[:, 2])).max() < 1.5


def test_pitching_car_is_localised_at_its_camera(mapped: bytes) -> None:
    """A pitch of a degree would move the foot of a rigid car by 3 cm."""
    along = []
    for nod_rad in (0.0, math.radians(1.0)):
        found = driven(decode_map(mapped), STREET, range(30, 50), seed=7, nod_rad=nod_rad)
        along.append(np.array([here.T_map_ego.x_m for here, _ in found[5:] if here.T_map_ego]))
    assert np.std(along[1] - along[0]) < 0.012


def test_the_body_is_tilted_about_the_camera_over_its_foot() -> None:
    T, attitude = SE2(1.0, 2.0, 0.3), Attitude(z_m=0.2, pitch_rad=0.1, roll_rad=-0.05)
    body = body_pose(T, attitude, 1.65)
    assert (body @ (0.0, 0.0, 1.65, 1.0))[:3] == pytest.approx([1.0, 2.0, 0.2 + 1.65])
    found = foot(body, 1.65)
    assert found[0].between(T).log() == pytest.approx(np.zeros(3), abs=1e-12)
    assert msgspec.to_builtins(found[1]) == pytest.approx(msgspec.to_builtins(attitude))


def test_in_another_street_the_ego_is_lost_and_has_no_pose(mapped: bytes) -> None:
    for here, _ in driven(decode_map(mapped), OTHER, range(60)):
        assert here.state is MapState.LOST
        assert here.T_map_ego is None
        assert np.isinf(here.cov).all()


def test_queries_are_rare_on_unmapped_road(mapped: bytes, monkeypatch: pytest.MonkeyPatch) -> None:
    """Who is lost looks up with each frame; who makes a new map only so often as that it never misses a street."""
    look_ups = []
    look_up = PlaceIndex.look_up
    monkeypatch.setattr(PlaceIndex, "look_up", lambda *args: look_ups.append(1) or look_up(*args))
    driven(decode_map(mapped), OTHER, range(20))
    assert len(look_ups) == 20
    look_ups.clear()
    driven(PlaceMap(MapCamera.of(CAMERA)), STREET, range(100), extend=True)
    assert 0 < len(look_ups) <= 100 / LOOK_UP_EVERY_M + 2


def test_covariance_grows_without_matches_until_lost(localised: MapSession) -> None:
    found = [localised.step(estimate, None) for estimate, _, _ in islice(second_drive(), FIRST, None)]
    assert found[-1].state is MapState.ODOMETRY_ONLY
    sigma = [math.sqrt(here.cov[0, 0]) if here.T_map_ego else math.inf for here in found]
    assert np.all(np.diff(sigma) > 0.0)


@pytest.mark.parametrize(("valid", "state"), [(True, MapState.LOCALISED), (False, MapState.ODOMETRY_ONLY)])
def test_invalid_odometry_ends_localisation(localised: MapSession, valid: bool, state: MapState) -> None:
    for estimate, _, _ in islice(second_drive(), FIRST, FIRST + 4):
        here = localised.step(msgspec.structs.replace(estimate, valid=valid), None)
    assert here.state is state


def test_new_map_starts_with_the_first_valid_frame() -> None:
    keyframes = {}
    for valid in (True, False):
        place_map = PlaceMap(MapCamera.of(CAMERA))
        running = session(place_map, extend=True)
        for number, (estimate, seen, _) in enumerate(drive(STREET, range(30), 3)):
            running.step(msgspec.structs.replace(estimate, valid=valid or number >= 3), seen)
        running.finish()
        keyframes[valid] = place_map.keyframes[0]
    assert np.trace(keyframes[False].cov) < 2.0 * np.trace(keyframes[True].cov)


def carried(localised: MapSession, looks: bool, scale_sigma_rel: float = 0.0) -> int:
    """The number of frames that stay localised; their images show another street, or are not used."""
    count = 0
    elsewhere = drive(OTHER, range(60), 3)
    for (estimate, _, _), (_, seen, _) in zip(islice(second_drive(), FIRST, None), elsewhere, strict=False):
        estimate = msgspec.structs.replace(estimate, scale_sigma_rel=scale_sigma_rel)
        count += localised.step(estimate, seen if looks else None).state is MapState.LOCALISED
    return count


def test_failed_queries_end_localisation(after_first: MapSession) -> None:
    """In a mapped street, with an odometry that has drifted off: skipped frames do not count."""
    looked, skipped = (carried(another(after_first), looks) for looks in (True, False))
    assert 1 <= looked <= 6
    assert skipped > 2 * looked


def test_near_points_correct_a_wrong_guess(mapped: bytes) -> None:
    """A guess rotated about far points, with half of the matches wrong."""
    place_map, chance = decode_map(mapped), np.random.default_rng(2)
    T = SE2(*(float(number) for number in STREET.route[40]))
    seen = STREET.see(T, chance)
    wrong = chance.random(len(seen)) < 0.5
    px = seen.px + np.where(wrong[:, None], chance.uniform(-90.0, 90.0, seen.px.shape), 0.0)
    local = place_map.around(place_map.near(T, 12.0)[0])
    truth = locate(CAMERA, seen, local, None)
    guess = truth.T_keyframe_ego @ SE2.exp(np.array([-1.2, 1.35, -0.03]))
    found = locate(CAMERA, replace(seen, px=px), local, guess, 120.0)
    assert found.T_keyframe_ego.between(truth.T_keyframe_ego).log() == pytest.approx(np.zeros(3), abs=0.1)


def seen_from(points_m: np.ndarray, T_keyframe_ego: SE2) -> np.ndarray:
    """(N, 2) pixels of points in a keyframe's ego frame."""
    T = np.linalg.inv(body_pose(T_keyframe_ego, Attitude(), CAMERA.height_m) @ mount_pose(CAMERA.ground))
    p = points_m @ T[:3, :3].T + T[:3, 3]
    return CAMERA.to_px(p[:, :2] / p[:, 2:])


@pytest.mark.parametrize("wrong", [4, 5, 7])
def test_far_points_give_the_most_likely_pose_not_the_guess(mapped: bytes, wrong: int) -> None:
    chance = np.random.default_rng(0)
    count, nearest_m, farthest_m = (30, 14), (30.0, 9.0), (60.0, 16.0)  # of far points, and of near ones
    points = np.array(
        [
            (chance.uniform(*ahead_m), chance.uniform(-8.0, 8.0), chance.uniform(0.5, 4.0))
            for n, *ahead_m in zip(count, nearest_m, farthest_m, strict=True)
            for _ in range(n)
        ]
    )
    guess = SE2.exp(np.array([0.0, 1.0, -0.022]))  # far points allow it, as they do the truth; so do a few near ones
    px = seen_from(points, SE2()) + 0.5 * chance.standard_normal((len(points), 2))
    px[-wrong:] = seen_from(points[-wrong:], guess)
    descriptors = chance.integers(0, 256, (len(points), 32), dtype=np.uint8)
    depth = 0.05 * (points - (0.0, 0.0, CAMERA.height_m))
    local = LocalMap(decode_map(mapped).keyframes[0], points, depth, descriptors)
    found = locate(CAMERA, Features(px, np.full(len(px), 0.5), descriptors), local, guess, 120.0)
    assert found.T_keyframe_ego.log() == pytest.approx(np.zeros(3), abs=0.1)


def test_uncertain_depths_do_not_bias_lateral_offset(mapped: bytes) -> None:
    """Errors in variables attenuate a slope, here the lateral offset with depth errors of 6 %."""
    chance, T, keyframe = np.random.default_rng(3), SE2(0.0, -3.0, 0.0), decode_map(mapped).keyframes[0]
    off, sigma, most_m = [], [], (40.0, 12.0, 5.0)
    for _ in range(60):
        points = chance.uniform((8.0, -12.0, 0.5), most_m, (60, 3))
        from_camera = points - (0.0, 0.0, CAMERA.height_m)
        errs = 0.06 * chance.standard_normal((60, 1))
        px = seen_from(points, T) + math.hypot(0.5, OTHER_VIEW_PX) * chance.standard_normal((60, 2))
        descriptors = chance.integers(0, 256, (60, 32), dtype=np.uint8)
        local = LocalMap(keyframe, points + errs * from_camera, 0.06 * from_camera, descriptors)
        found = locate(CAMERA, Features(px, np.full(60, 0.5), descriptors), local, T, 120.0)
        off.append(T.between(found.T_keyframe_ego).log())
        sigma.append(np.sqrt(np.diag(found.cov)))
    assert np.mean(off, axis=0)[1] == pytest.approx(0.0, abs=0.03)
    assert np.sqrt(np.mean((np.array(off) / sigma) ** 2, axis=0)) == pytest.approx(np.ones(3), abs=0.25)


def test_implausible_step_ends_localisation(localised: MapSession) -> None:
    """Odometry that calls itself valid goes back by 2 m within a tenth of a second."""
    states = []
    for number, (estimate, seen, _) in enumerate(islice(second_drive(), FIRST, FIRST + 10)):
        estimate = msgspec.structs.replace(estimate, T_world_ego=estimate.T_world_ego @ SE2(-3.0, 0.0, 0.0))
        states.append(localised.step(estimate, seen if number > 5 else None).state)
    assert [states[0], states[5]] == [MapState.ODOMETRY_ONLY] * 2
    assert states[9] is MapState.LOCALISED


def test_uncertain_scale_shortens_localisation(after_first: MapSession) -> None:
    certain, uncertain = (carried(another(after_first), False, sigma) for sigma in (0.0, 0.06))
    assert 4 <= uncertain < certain / 2


def test_late_or_invalid_pose_is_not_a_localisation() -> None:
    estimate, _, _ = next(iter(drive(STREET, range(1), 3)))
    pose = MapPose(
        **{name: getattr(estimate, name) for name in ("frame_id", "t_source_ns", "t_capture_ns", "t_utc_ns", "epoch")},
        **{
            "state": MapState.LOCALISED,
            "T_map_odom": SE2(),
            "T_odom_ego": SE2(),
            "cov": (1e-4, 0, 0, 0, 1e-4, 0, 0, 0, 1e-6),
        },
    )
    states = [
        in_map(pose, msgspec.structs.replace(estimate, t_source_ns=late_ns, valid=valid)).state
        for late_ns, valid in ((900_000_000, True), (1_100_000_000, True), (100_000_000, False))
    ]
    assert states == [MapState.LOCALISED, MapState.ODOMETRY_ONLY, MapState.ODOMETRY_ONLY]


def test_kidnapped_ego_is_relocalised(mapped: bytes) -> None:
    """Odometry goes on as if nothing had been, 50 m further along the street."""
    running = session(decode_map(mapped), extend=False)
    first = list(drive(STREET, range(0, 20), 3))
    then = list(drive(STREET, range(70, 105), 4, first_frame=20))
    T_odom = first[-1][0].T_world_ego
    for estimate, seen, _ in first:
        running.step(estimate, seen)
    found = []
    for estimate, seen, T in then:
        moved = type(estimate)(
            **{name: getattr(estimate, name) for name in estimate.__struct_fields__}
            | {"T_world_ego": T_odom @ estimate.T_world_ego}
        )
        found.append((running.step(moved, seen), T))
    assert errors(found[-1:])[0, :2] == pytest.approx([0.0, 0.0], abs=1.0)
    wrong = [np.hypot(*error[:2]) for error in errors(found[20:])]
    assert max(wrong) < 1.0


def test_extended_map_covers_the_second_drive(mapped: bytes) -> None:
    place_map = decode_map(mapped)
    before = len(place_map)
    driven(place_map, STREET, range(95, 140), extend=True, seed=5)
    added = place_map.keyframes[before:]
    assert place_map.drives == 2
    assert {keyframe.drive for keyframe in added} == {1}
    farthest = STREET.route[140 - 1]
    near = min(np.hypot(k.T_map_keyframe.x_m - farthest[0], k.T_map_keyframe.y_m - farthest[1]) for k in added)
    assert near < 10.0
    found = driven(decode_map(encode_map(place_map)), STREET, range(110, 135), seed=6)
    assert len(errors(found)) > 15


def test_unrelated_drive_does_not_change_the_map(mapped: bytes) -> None:
    place_map = decode_map(mapped)
    running = session(place_map, extend=True)
    for estimate, seen, _ in drive(OTHER, range(40), 3):
        running.step(estimate, seen)
    running.finish()
    assert encode_map(place_map) == mapped
    assert running.lost_keyframes > 3


def test_loop_closure_joins_end_and_start() -> None:
    street = build(block(40.0), seed=4)
    around = len(street.route)
    place_map = PlaceMap(MapCamera.of(CAMERA))
    found = driven(place_map, street, range(around + 30), extend=True, seed=11)
    assert found[-1][0].state is MapState.LOCALISED
    assert any(link.loop for link in place_map.links)
    assert np.abs(errors(found[-1:])[0, :2]).max() < 0.5


def test_a_street_of_equal_houses_closes_no_loop() -> None:
    street = build(along([0.0] * 300), seed=3, house_m=20.0)
    place_map = PlaceMap(MapCamera.of(CAMERA))
    found = driven(place_map, street, range(200), extend=True)
    assert not any(here.state is MapState.LOCALISED for here, _ in found)
    assert not any(link.loop for link in place_map.links)


def test_false_loop_is_rejected() -> None:
    place_map = PlaceMap(MapCamera.of(CAMERA))
    driven(place_map, STREET, range(60), extend=True)
    last = place_map.keyframes[-1].number
    false = Link(0, last, SE2(1.0, 5.0, 0.5), np.diag([0.01, 0.01, 1e-4]), loop=True)
    poses = close_loops(place_map.keyframes, [*place_map.links, false])
    for keyframe in place_map.keyframes:
        assert np.hypot(*keyframe.T_map_keyframe.between(poses[keyframe.number][0]).log()[:2]) < 0.3
    assert false not in held([*place_map.links, false], poses)


def test_rejected_loops_do_not_move_keyframes() -> None:
    place_map = PlaceMap(MapCamera.of(CAMERA))
    driven(place_map, STREET, range(60), extend=True)
    first, cut, last = place_map.keyframes[0], place_map.keyframes[-3], place_map.keyframes[-1]
    links = [
        link for link in place_map.links if link.to_number != cut.number
    ]  # the last three are a chain of their own
    cov = np.diag([1e-4, 1e-4, 1e-6])
    far = [Link(first.number, last.number, SE2(1e4 * sign, 5.0, 0.5), cov, loop=True) for sign in (1.0, -1.0)]
    at, at_cov, _ = close_loops(place_map.keyframes, [*links, *far])[last.number]
    assert np.hypot(*last.T_map_keyframe.between(at).log()[:2]) < 1.0
    assert at_cov[0, 0] > 1e3  # its position is unknown


def test_loop_closure_corrects_drift_of_carried_scale() -> None:
    """Each keyframe is within its sigma of the truth; where the odometry does not report the drift, not."""
    true, nodes, links = drifting_scale.carried(seed=1, drift=0.06)
    off, sigma = drifting_scale.in_sim2(true, nodes, links)
    assert (np.abs(off) < 2.0 * sigma).mean() > 0.95
    assert (np.abs(off) < 3.0 * sigma).all()
    silent = [link if link.loop else replace(link, scale_rel=0.0) for link in links]
    off_silent, sigma_silent = drifting_scale.in_sim2(true, nodes, silent)
    assert np.abs(off).max() < 0.7 * np.abs(off_silent).max()
    assert (np.abs(off_silent) < 2.0 * sigma_silent).mean() < 0.95


def test_keyframe_points_follow_its_scale(mapped: bytes) -> None:
    place_map = decode_map(mapped)
    true = decode_map(mapped)
    place_map.keyframes = [
        replace(
            each,
            scale=0.95,
            points_m=(each.points_m - (0, 0, each.camera_height_m)) / 0.95 + (0, 0, each.camera_height_m),
        )
        for each in place_map.keyframes
    ]
    place_map = decode_map(encode_map(place_map))
    for a, b in zip(place_map.keyframes, true.keyframes, strict=True):
        np.testing.assert_allclose(a.from_camera_m, b.from_camera_m, atol=0.011)  # a file has centimetres
    np.testing.assert_array_less(np.abs(errors(driven(place_map, STREET, range(20, 45), seed=6))[:, :2]), 0.5)


# --- the file ---


def test_map_is_read_as_written(mapped: bytes, tmp_path: Path) -> None:
    path = tmp_path / "street.map"
    assert write_map(path, decode_map(mapped)) == len(mapped)
    assert encode_map(read_map(path)) == mapped
    assert [entry.name for entry in tmp_path.iterdir()] == ["street.map"]
    assert len(mapped) / decode_map(mapped).length_m < 2000.0  # 2 MB a km


def test_the_same_drive_gives_the_same_bytes(mapped: bytes) -> None:
    place_map = PlaceMap(MapCamera.of(CAMERA))
    driven(place_map, STREET, range(120), extend=True)
    assert encode_map(place_map) == mapped


def test_incomplete_map_is_refused(mapped: bytes) -> None:
    version, length, crc = HEAD.unpack(mapped[len(MAGIC) : len(MAGIC) + HEAD.size])
    body = mapped[len(MAGIC) + HEAD.size :]
    newer = MAGIC + HEAD.pack(version + 1, length, crc) + body
    flipped = bytearray(mapped)
    flipped[-5] ^= 1
    for data, why in (
        (b"", "empty"),
        (b"PNG", "no map"),
        (mapped[:16], "truncated in its header"),
        (mapped[:-100], "is truncated"),
        (bytes(flipped), "CRC"),
        (newer, "version 5"),
        (MAGIC + HEAD.pack(version, 1, zlib.crc32(b"\xc1")) + b"\xc1", "has an invalid body"),
    ):
        with pytest.raises(MapError, match=why):
            decode_map(data)


@given(st.binary(max_size=200))
def test_corrupt_bytes_with_valid_checksum_do_no_harm(body: bytes) -> None:
    with pytest.raises(MapError):
        decode_map(MAGIC + struct.pack("<HQI", 1, len(body), zlib.crc32(body)) + body)


def test_failed_write_keeps_the_old_map(mapped: bytes, tmp_path: Path) -> None:
    with pytest.raises(MapError, match="can't be written"):
        write_map(tmp_path / "none" / "street.map", decode_map(mapped))
    with pytest.raises(MapError, match="can't be read"):
        read_map(tmp_path / "street.map")


def test_run_refuses_unusable_maps(mapped: bytes, tmp_path: Path) -> None:
    path = tmp_path / "street.map"
    path.write_bytes(mapped)
    writes = MapChoice.of(load(None, {"results.map": str(path)}))
    assert len(writes.open(CAMERA)) > 20
    other = replace_camera(height_m=1.2)
    with pytest.raises(ConfigurationError, match="another camera"):
        writes.open(other)
    reads = MapChoice.of(load(None, {"results.map_only": str(path)}))
    assert len(reads.open(other)) > 20
    path.write_bytes(mapped[:-1])
    with pytest.raises(MapError, match="truncated"):
        writes.open(CAMERA)
    with pytest.raises(ConfigurationError, match="name only one"):
        MapChoice.of(load(None, {"results.map": "a", "results.map_only": "b"}))
    with pytest.raises(MapError, match="the folder does not exist"):
        MapChoice(tmp_path / "none" / "a.map", True).open(CAMERA)


def replace_camera(**changes: float):
    return type(CAMERA)(**({name: getattr(CAMERA, name) for name in CAMERA.__struct_fields__} | changes))


# --- what is written of a drive ---


def test_frames_before_confirmation_are_localised_afterwards(mapped: bytes, tmp_path: Path) -> None:
    running, trajectory = session(decode_map(mapped), extend=False), MapTrajectory()
    with TrajectoryFiles(tmp_path) as files:
        for estimate, seen, _ in drive(STREET, range(20, 45), 3):
            files.write(trajectory.add(running.step(estimate, seen), estimate))
        files.write(trajectory.finish())
    assert trajectory.frames_before > 0
    assert trajectory.counts == {"localised": 25, "odometry_only": 0, "lost": 0}
    assert len((tmp_path / "map.tum.txt").read_text().splitlines()) == 25
    rows = (tmp_path / "localisation.csv").read_text().splitlines()
    assert len(rows) == 26
    assert rows[1].split(",")[1] == "localised"


def test_no_backward_localisation_over_invalid_odometry(mapped: bytes) -> None:
    """A step of 1 m without measured length."""
    running, trajectory = session(decode_map(mapped), extend=False), MapTrajectory()
    rows = []
    for number, (estimate, seen, _) in enumerate(drive(STREET, range(20, 45), 3)):
        estimate = msgspec.structs.replace(estimate, valid=number != 1)
        rows += trajectory.add(running.step(estimate, seen), estimate)
    rows += trajectory.finish()
    assert trajectory.frames_before > 1
    assert [row.state for row in rows[:3]] == [MapState.LOST, MapState.LOCALISED, MapState.LOCALISED]


def test_trajectory_without_localisation_is_an_empty_file(tmp_path: Path) -> None:
    trajectory = MapTrajectory()
    place_map = PlaceMap(MapCamera.of(CAMERA))
    running = session(place_map, extend=False)
    with TrajectoryFiles(tmp_path) as files:
        for estimate, seen, _ in drive(STREET, range(40), 3):
            files.write(trajectory.add(running.step(estimate, seen), estimate))
        assert trajectory.counts["lost"] > 10  # too far back by now: no memory is kept of them
        files.write(trajectory.finish())
    assert trajectory.counts["lost"] == 40
    assert (tmp_path / "map.tum.txt").read_bytes() == b""


# --- its parts ---


def test_matches_are_mutual_nearest_neighbours() -> None:
    chance = np.random.default_rng(0)
    a = chance.integers(0, 256, (40, 32), dtype=np.uint8)
    order = chance.permutation(40)
    pairs = match(a, a[order], 60, 0.8)
    assert len(pairs) == 40
    assert (order[pairs[:, 1]] == pairs[:, 0]).all()


def of_all_pairs(distance: Ints, most_bits: int, ratio: float) -> Ints:
    """What `match` finds, by the distances of all pairs."""
    rows, two = np.arange(len(distance)), np.sort(distance, axis=1)[:, :2]
    nearest, back = distance.argmin(axis=1), distance.argmin(axis=0)
    good = (two[:, 0] <= most_bits) & (two[:, 0] < ratio * two[:, 1]) & (back[nearest] == rows)
    return np.column_stack([rows[good], nearest[good]])


def bits_apart(a: NDArray[np.uint8], b: NDArray[np.uint8]) -> Ints:
    """(N, M) of descriptors (N, 32) and (M, 32)."""
    return (np.unpackbits(a, axis=1)[:, None] != np.unpackbits(b, axis=1)[None]).sum(axis=2)


def test_matches_equal_brute_force_with_ties() -> None:
    chance = np.random.default_rng(5)
    a = chance.integers(0, 256, (50, 32), dtype=np.uint8)
    b = np.concatenate([a[:30] ^ np.packbits(chance.random((30, 256)) < 0.1, axis=1), a[20:40], a[35:45]])
    pairs = match(a, b, 72, 0.85)
    assert len(pairs) > 20
    assert np.array_equal(pairs, of_all_pairs(bits_apart(a, b), 72, 0.85))
    assert not len(match(a, b[:1], 72, 0.85))


def test_matches_within_radius_equal_brute_force() -> None:
    chance = np.random.default_rng(4)
    a = chance.integers(0, 256, (60, 32), dtype=np.uint8)
    b = np.concatenate([a[::-1] ^ np.packbits(chance.random((60, 256)) < 0.2, axis=1), a[:20]])
    a_px, b_px = chance.uniform(0.0, 100.0, (60, 2)), chance.uniform(0.0, 100.0, (80, 2))
    far = np.hypot(*(a_px[:, None] - b_px[None]).transpose(2, 0, 1)) > 40.0
    pairs = of_all_pairs(np.where(far, 10_000, bits_apart(a, b)), 100, 0.9)
    assert len(pairs) > 5
    assert np.array_equal(match_near(a, a_px, b, b_px, 40.0, 100, 0.9), pairs)
    assert not len(match_near(a, a_px, b, b_px + 1000.0, 40.0, 100, 0.9))


def test_the_index_finds_a_noisy_copy_and_only_among_those_allowed() -> None:
    chance = np.random.default_rng(0)
    places = [chance.integers(0, 256, (60, 32), dtype=np.uint8) for _ in range(50)]
    index = PlaceIndex(learn_words(np.concatenate(places)))
    for place in places:
        index.add(place)
    seen = places[17] ^ np.packbits(chance.random((60, 256)) < 0.05, axis=1)
    assert index.look_up(seen, 3)[0] == 17
    among = np.ones(50, bool)
    among[17] = False
    assert 17 not in index.look_up(seen, 50, among)


def test_a_keyframe_moves_with_its_points(mapped: bytes) -> None:
    place_map = decode_map(mapped)
    keyframe = place_map.keyframes[3]
    place_map.place({keyframe.number: (SE2(5.0, 6.0, 0.1), keyframe.cov)})
    assert place_map.keyframes[3].T_map[:2, 3] == pytest.approx([5.0, 6.0])
    assert (place_map.keyframes[3].points_m == keyframe.points_m).all()
    assert place_map.near(SE2(5.0, 6.0, 0.1), 1.0)[0] == 3


# --- what `birdslam map` does ---


@pytest.fixture(scope="module")
def files(mapped: bytes, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """A map, one of the same street by another drive from further on, and one of another street."""
    folder = tmp_path_factory.mktemp("maps")
    beside, other = PlaceMap(MapCamera.of(CAMERA)), PlaceMap(MapCamera.of(CAMERA))
    driven(beside, STREET, range(60, 140), extend=True, seed=21)
    driven(other, OTHER, range(60), extend=True, seed=22)
    out = {"own": folder / "own.map", "beside": folder / "beside.map", "other": folder / "other.map"}
    for path, data in zip(out.values(), (mapped, encode_map(beside), encode_map(other)), strict=True):
        path.write_bytes(data)
    return out


def test_two_maps_of_a_street_become_one(files: dict[str, Path]) -> None:
    own, beside = read_map(files["own"]), read_map(files["beside"])
    out, found = merged(own, beside)
    assert found >= 5
    assert len(out) == len(own) + len(beside)
    start = STREET.route[60]
    first = next(keyframe for keyframe in out.keyframes if keyframe.drive == 1)
    assert np.hypot(first.T_map_keyframe.x_m - start[0], first.T_map_keyframe.y_m - start[1]) < 2.0
    assert len(errors(driven(out, STREET, range(100, 130), seed=6))) > 20


def test_the_maps_of_many_drives_become_one(files: dict[str, Path], tmp_path: Path) -> None:
    folders = []
    for name in ("own", "beside", "other"):
        folders.append(tmp_path / name)
        folders[-1].mkdir()
        (folders[-1] / DRIVE_MAP).write_bytes(files[name].read_bytes())
    (tmp_path / "without").mkdir()  # a drive that failed
    found = join([*folders, tmp_path / "without"], tmp_path / "town.map")
    assert set(found.inside) == {"own", "beside"}
    assert found.outside == ("other",)
    whole = read_map(tmp_path / "town.map")
    assert len(whole) == len(read_map(files["own"])) + len(read_map(files["beside"])) == found.keyframes
    assert join([tmp_path / "without"], tmp_path / "none.map") is None


def test_maps_that_share_no_street_stay_two(files: dict[str, Path]) -> None:
    with pytest.raises(MergeError, match="no recognised street"):
        merged(read_map(files["own"]), read_map(files["other"]))


def test_the_commands(files: dict[str, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def told(*words: str) -> str:
        options = parse(["map", *words])
        assert options.call(options) == 0
        return capsys.readouterr().out

    own = str(files["own"])
    assert "keyframes" in told("info", own)
    part = tmp_path / "part.map"
    told("trim", own, "--within", "0", "0", "30", "--output", str(part))
    assert 3 < len(read_map(part)) < len(read_map(files["own"]))
    told("picture", own, "--output", str(tmp_path / "map.png"))
    assert (tmp_path / "map.png").read_bytes().startswith(b"\x89PNG")
    told("export", own, "--output", str(tmp_path / "map.g2o"))
    assert (tmp_path / "map.g2o").read_text().startswith("VERTEX_SE2 0")
    told("export", own, "--output", str(tmp_path / "map.tum.txt"))
    assert len((tmp_path / "map.tum.txt").read_text().splitlines()) == len(read_map(files["own"]))
    options = parse(["map", "export", own, "--output", str(tmp_path / "map.kml")])
    with pytest.raises(MapError, match="not georeferenced"):
        options.call(options)


def test_memory_of_a_long_drive_is_bounded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(held_way, "MAX_POSES", 16)
    driving = map_drive.MapDrive(MapChoice(tmp_path / "new.map", extend=True), CAMERA, tmp_path)
    estimates = [estimate for estimate, _, _ in drive(STREET, range(100), 3)]
    for estimate in estimates:
        driving.step(estimate, None)
    driving.end()
    places = driving.places
    assert 8 <= len(places) <= 16
    ways = [place.T_map_ego.x_m for place in places]
    assert ways[0] == 0.0
    assert max(np.diff(ways)) < 12.0
    assert abs(ways[-1] - estimates[-1].T_world_ego.x_m) < 9.0
