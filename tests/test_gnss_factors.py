"""Fixes as factors of the graph: jumps are rejected, drift of the odometry is corrected; sources of fixes."""

from __future__ import annotations

import json
import math
import os
import pty
import tracemalloc
from collections.abc import Iterator
from pathlib import Path

import geojson
import gpxpy
import msgspec
import numpy as np
import pymap3d
import pytest

from birdslam.geometry.se2 import SE2
from birdslam.loops.drift import link_cov
from birdslam.loops.gnss.earth import EarthError, GnssFix, align_with_fixes
from birdslam.loops.gnss.factors import Node, OnEarth, fixed_keyframes, georeference
from birdslam.loops.gnss.sentences import NmeaReader
from birdslam.loops.keyframe import Link
from birdslam.outputs import placed
from birdslam.outputs.placed import Place, write_around, write_places
from birdslam.perf.maps.places import CAMERA
from birdslam.runtime.configuration import ConfigurationError, load
from birdslam.runtime.maps.drive_earth import write_earth
from birdslam.runtime.maps.gnss_input import Receiver, recorded_fixes
from tests import ros_bags
from tests.test_bus import until

ORIGIN = 51.05, -114.05
SPACING_M, SPEED_MPS = 4.0, 10.0


def way(length_m: float, seed: int) -> tuple[list[SE2], list[Node], list[Link]]:
    """A drive with a bend: its true poses, and what odometry with an error of scale and of yaw makes of it."""
    chance = np.random.default_rng(seed)
    true, here, links = [SE2()], [Node(0, SE2())], []
    for number in range(1, round(length_m / SPACING_M)):
        step = SE2(SPACING_M, 0.0, 0.02 if 100 <= number % 250 < 180 else 0.0)
        true.append(true[-1] @ step)
        seen = SE2(
            step.x_m * 1.01, 0.02 * chance.standard_normal(), step.yaw_rad + 2e-4 + 1e-3 * chance.standard_normal()
        )
        links.append(Link(number - 1, number, seen, link_cov(seen, 0.0)))
        here.append(Node(number, here[-1].T_map_keyframe @ seen))
    return true, here, links


def times(count: int) -> np.ndarray:
    return (np.arange(count) * SPACING_M / SPEED_MPS * 1e9).astype(np.int64)


def fixes_of(true: list[SE2], noise_m: float, off: range = range(0), seed: int = 0) -> list[GnssFix]:
    """One about each second; those of `off` are 15 m wrong."""
    chance, out = np.random.default_rng(seed), []
    for row in range(0, len(true), 2):
        east, north = np.array([true[row].x_m, true[row].y_m]) + noise_m * chance.standard_normal(2)
        east, north = (east + 12.0, north - 9.0) if row in off else (east, north)
        lat, lon, _ = pymap3d.enu2geodetic(east, north, 0.0, *ORIGIN, 0.0)
        at_ns = int(times(row + 1)[-1])
        out.append(GnssFix(t_source_ns=at_ns, latitude_deg=float(lat), longitude_deg=float(lon), sigma_m=noise_m))
    return out


def tied(true: list[SE2], nodes: list[Node], links: list[Link], fixes: list[GnssFix]) -> OnEarth:
    t_ns, poses = times(len(nodes)), [node.T_map_keyframe for node in nodes]
    earth = align_with_fixes(t_ns, poses, fixes)
    return georeference(earth, nodes, links, fixed_keyframes(earth, t_ns, poses, fixes, nodes))


def errors_m(found: OnEarth, nodes: list[Node], true: list[SE2]) -> np.ndarray:
    placed = [found.poses[node.number][0] for node in nodes]
    degrees = found.earth.wgs84(np.array([(T.x_m, T.y_m) for T in placed]))
    east, north, _ = pymap3d.geodetic2enu(degrees[:, 0], degrees[:, 1], 0.0, *ORIGIN, 0.0)
    return np.hypot(east - [T.x_m for T in true], north - [T.y_m for T in true])


def test_fixes_correct_odometry_drift() -> None:
    true, nodes, links = way(1600.0, seed=1)
    before = np.hypot(
        *(np.array([nodes[-1].T_map_keyframe.x_m, nodes[-1].T_map_keyframe.y_m]) - (true[-1].x_m, true[-1].y_m))
    )
    found = tied(true, nodes, links, fixes_of(true, 1.5))
    error = errors_m(found, nodes, true)
    assert before > 30.0
    assert error.max() < 3.0  # and the delay is known to a tenth of a second, which is a metre
    assert found.earth.scale == pytest.approx(1 / 1.01, abs=0.004)
    assert found.earth.outliers < 0.03 * found.earth.fixes


def test_fixes_with_15_m_error_for_10_s_are_rejected() -> None:
    true, nodes, links = way(800.0, seed=2)
    off = range(100, 126)  # ten seconds
    right = tied(true, nodes, links, fixes_of(true, 1.5))
    wrong = tied(true, nodes, links, fixes_of(true, 1.5, off))
    assert wrong.earth.outliers >= len(off) // 2
    assert errors_m(wrong, nodes, true).max() < errors_m(right, nodes, true).max() + 1.0


@pytest.mark.parametrize("length_m", [80.0, 200.0])
@pytest.mark.parametrize("off_m", [100.0, 1e3, 1e5])
def test_a_short_drive_with_a_far_outlier_keeps_its_place(length_m: float, off_m: float) -> None:
    true, nodes, links = way(length_m, seed=1)
    fixes = fixes_of(true, 5.0)
    right = tied(true, nodes, links, fixes)
    far = msgspec.structs.replace(fixes[2], latitude_deg=fixes[2].latitude_deg + off_m / 111e3)
    wrong = tied(true, nodes, links, [*fixes[:2], far, *fixes[3:]])
    assert wrong.earth.fixes == right.earth.fixes
    assert wrong.earth.outliers == right.earth.outliers + 1
    assert errors_m(wrong, nodes, true).max() < errors_m(right, nodes, true).max() + 3.0


def test_invalid_fixes_are_refused() -> None:
    true, nodes, links = way(400.0, seed=3)
    chance = np.random.default_rng(1)
    scattered = [
        replaced(
            fix, fix.latitude_deg + 0.02 * chance.standard_normal(), fix.longitude_deg + 0.02 * chance.standard_normal()
        )
        for fix in fixes_of(true, 1.5)
    ]
    with pytest.raises(EarthError, match="fit the trajectory"):
        tied(true, nodes, links, scattered)


def replaced(fix: GnssFix, latitude_deg: float, longitude_deg: float) -> GnssFix:
    return GnssFix(
        t_source_ns=fix.t_source_ns, latitude_deg=latitude_deg, longitude_deg=longitude_deg, sigma_m=fix.sigma_m
    )


def test_position_on_earth_is_within_its_covariance() -> None:
    """Over many drives, at their end, where it is worst."""
    inside = []
    for seed in range(12):
        true, nodes, links = way(240.0, seed)
        found = tied(true, nodes, links, fixes_of(true, 1.5, seed=seed))
        T, cov, _ = found.poses[nodes[-1].number]
        here = found.earth.pose(T, cov)
        east, north, _ = pymap3d.geodetic2enu(here.latitude_deg, here.longitude_deg, 0.0, *ORIGIN, 0.0)
        error = np.array([east - true[-1].x_m, north - true[-1].y_m])
        inside.append(float(error @ np.linalg.solve(np.array(here.cov).reshape(2, 2), error)) < 9.2)
    assert np.mean(inside) >= 0.9


def test_map_in_another_frame_has_the_same_position_on_earth() -> None:
    true, nodes, links = way(400.0, seed=4)
    earth = tied(true, nodes, links, fixes_of(true, 1.5)).earth
    T_other_map = SE2(30.0, -5.0, 0.7)
    p = np.array([[100.0, 20.0]])
    at = T_other_map @ SE2(100.0, 20.0, 0.0)
    assert earth.seen_from(T_other_map).wgs84(np.array([[at.x_m, at.y_m]])) == pytest.approx(earth.wgs84(p), abs=1e-9)
    assert earth.xy(earth.wgs84(p)) == pytest.approx(p, abs=1e-6)


def test_exports_open_in_other_programs(tmp_path: Path) -> None:
    true, nodes, _ = way(400.0, seed=5)
    poses = [(int(t_ns), node.T_map_keyframe) for t_ns, node in zip(times(len(nodes)), nodes, strict=True)]
    seen_from = [Place(t_ns, 0, T, T) for t_ns, T in poses]
    about, _ = write_earth(fixes_of(true, 1.5), seen_from, CAMERA, tmp_path, None)
    assert about["fixes"] > 40
    features = geojson.loads((tmp_path / "ego.geojson").read_text())
    assert features.is_valid
    lon, lat = features.features[0].geometry.coordinates[0]
    assert (lat, lon) == pytest.approx(ORIGIN, abs=1e-4)
    assert len(gpxpy.parse((tmp_path / "ego.gpx").read_text()).tracks[0].segments[0].points) == len(poses)


@pytest.mark.filterwarnings("error")
def test_drive_without_keyframes_has_no_map_points(tmp_path: Path) -> None:
    write_places(tmp_path, [])
    assert write_around(tmp_path) == []


def peak_bytes_around(folder: Path) -> int:
    """Peak memory of transforming this drive's points into the map."""
    tracemalloc.start()
    try:
        write_around(folder)
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


def test_memory_of_map_points_is_linear_in_length(tmp_path: Path) -> None:
    """Points and places both grow with it; of all pairs of them, half an hour was 76 GB."""

    def peak_bytes(length_m: int) -> int:
        poses = [SE2(float(x_m), 0.0, 0.0) for x_m in range(length_m)]
        earth = (*ORIGIN, 0.0, 1.0)
        write_places(tmp_path, [Place(k * 10**9, 0, T, SE2(5.0, 0.0, 0.0) @ T, earth) for k, T in enumerate(poses)])
        seen = [(k / 4.0, f"{k / 4.0:.2f}") for k in range(4 * length_m)]
        rows = "".join(f"0,landmark,{x_m},2.000,-1\n" for _, x_m in seen)
        (tmp_path / "map.csv").write_text("epoch,kind,x_m,y_m,lane\n" + rows)
        (tmp_path / "tracks").mkdir(exist_ok=True)
        (tmp_path / "tracks" / "3.tum.txt").write_text("".join(f"{t_s:.2f} {x_m} 2 0 0 0 0 1\n" for t_s, x_m in seen))
        return peak_bytes_around(tmp_path)

    peak_bytes(100)  # what is loaded once
    assert peak_bytes(1000) < 3.0 * peak_bytes(500)
    points = json.loads((tmp_path / "road.map.geojson").read_text())["features"][0]["geometry"]["coordinates"]
    assert points[:2000:500] == [[5.0 + k / 4.0, 2.0] for k in range(0, 2000, 500)]


def test_points_of_a_long_drive_are_transformed_in_chunks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(placed, "MAX_FEATURE_POINTS", 250)
    write_places(tmp_path, [Place(0, 0, SE2(), SE2(5.0, 0.0, 0.0))])

    def peak_bytes(points: int) -> int:
        rows = "".join(f"{k % 2},landmark,{k}.000,2.000,-1\n" for k in range(points))
        (tmp_path / "map.csv").write_text("epoch,kind,x_m,y_m,lane\n" + rows)
        return peak_bytes_around(tmp_path)

    peak_bytes(100)  # what is loaded once
    few = peak_bytes(1000)
    assert peak_bytes(4_100) < 1.5 * few
    features = json.loads((tmp_path / "road.map.geojson").read_text())["features"]
    found: dict[int, list[list[float]]] = {0: [], 1: []}
    for feature in features:
        found[feature["properties"]["epoch"]] += feature["geometry"]["coordinates"]
    assert found == {epoch: [[5.0 + k, 2.0] for k in range(epoch, 4_100, 2)] for epoch in (0, 1)}


def test_road_and_tracks_are_beside_the_trajectory_on_earth(tmp_path: Path) -> None:
    """A line 2 m to the left and a car 10 m ahead, with an odometry that drifts by metres."""
    true, nodes, _ = way(1200.0, seed=6)
    t_ns = [int(each) for each in times(len(nodes))]
    seen_from = [Place(t, 0, node.T_map_keyframe, node.T_map_keyframe) for t, node in zip(t_ns, nodes, strict=True)]
    _, places = write_earth(fixes_of(true, 1.5), seen_from, CAMERA, tmp_path, None)
    write_places(tmp_path, places)
    beside = [place.T_odom_ego @ np.array([[0.0, 2.0]]) for place in places]
    line = {"line": 7, "epoch": 0, "kind": "dashed", "sigma_m": [0.1], "first_seen_s": 0.0, "last_seen_s": 1e9}
    geometry = {"type": "LineString", "coordinates": [p[0].tolist() for p in beside]}
    lines = {"type": "FeatureCollection", "features": [{"type": "Feature", "geometry": geometry, "properties": line}]}
    (tmp_path / "map.geojson").write_text(json.dumps(lines))
    (tmp_path / "tracks").mkdir()
    ahead = [(place.t_source_ns / 1e9, *(place.T_odom_ego @ np.array([[10.0, 0.0]]))[0]) for place in places]
    rows = (f"{t:.6f} {x:.4f} {y:.4f} 0 0 0 0 1\n" for t, x, y in ahead)
    (tmp_path / "tracks" / "3.tum.txt").write_text("# track 3\n" + "".join(rows))
    assert set(write_around(tmp_path)) == {"road.map.geojson", "road.geojson", "tracks.geojson"}
    open_m = np.hypot(nodes[-1].T_map_keyframe.x_m - true[-1].x_m, nodes[-1].T_map_keyframe.y_m - true[-1].y_m)
    assert open_m > 10.0
    for name, x_m, y_m in (("road", 0.0, 2.0), ("tracks", 10.0, 0.0)):
        found = geojson.loads((tmp_path / f"{name}.geojson").read_text())
        assert found.is_valid
        lon, lat = np.array(found.features[0].geometry.coordinates).T
        east, north, _ = pymap3d.geodetic2enu(lat, lon, 0.0, *ORIGIN, 0.0)
        wanted = np.array([(T @ np.array([[x_m, y_m]]))[0] for T in true])
        assert np.hypot(east - wanted[:, 0], north - wanted[:, 1]).max() < 3.0
        assert (tmp_path / f"{name}.kml").is_file()
    in_map = json.loads((tmp_path / "road.map.geojson").read_text())["features"][0]["geometry"]["coordinates"]
    left_m = [place.T_map_ego.inverse() @ np.array([p]) for place, p in zip(places, in_map, strict=True)]
    assert np.array(left_m).reshape(-1, 2) == pytest.approx(np.array([[0.0, 2.0]] * len(places)), abs=0.01)


def sentence(body: str) -> bytes:
    total = 0
    for byte in body.encode():
        total ^= byte
    return f"${body}*{total:02X}\r\n".encode()


def epoch(second: int, accuracy: str = "") -> bytes:
    """As a receiver sends it: RMC first, and then the accuracy."""
    rmc = sentence(f"GPRMC,1200{second:02d}.00,A,5103.000,N,11403.000,W,019.4,084.4,230394,,,A")
    return rmc + (sentence(accuracy) if accuracy else b"")


def test_accuracy_may_follow_its_fix() -> None:
    reader = NmeaReader()
    gst = "GPGST,120001.00,1.2,,,,3.0,4.0,5.0"
    gga = "GPGGA,120002.00,5103.000,N,11403.000,W,1,08,0.9,1045.4,M,,M,,"
    lines = (epoch(1, gst) + epoch(2, gga) + epoch(3)).decode().splitlines()
    found = [fix for line in lines if (fix := reader.take(line)) is not None] + [reader.finish()]
    assert [round(fix[3], 3) for fix in found if fix] == [round(math.hypot(3.0, 4.0) / math.sqrt(2.0), 3), 3.6, 5.0]
    assert found[0][1:3] == pytest.approx((51.05, -114.05))


@pytest.fixture
def line() -> Iterator[tuple[int, str]]:
    """The receiver's end, and the name of ours."""
    ours, theirs = pty.openpty()
    name = os.ttyname(theirs)
    yield ours, name
    os.close(ours)
    os.close(theirs)


def test_receiver_on_a_serial_line_is_read(line: tuple[int, str]) -> None:
    end, name = line
    receiver = Receiver(f"{name}@38400")
    heard: list[GnssFix] = []

    def hears(count: int) -> bool:
        heard.extend(receiver.take(1_000))
        return len(heard) >= count

    os.write(end, epoch(1)[:20])
    os.write(
        end,
        epoch(1)[20:]
        + b"\xff\xfe,,\n$GPRMC,cut off\r\n"
        + sentence("GPRMC,x,A,y,N,z,W,,,230394")
        + epoch(2)
        + epoch(3),
    )
    until(lambda: hears(2), "two fixes are there: the third waits for its accuracy")
    receiver.close()
    assert [fix.latitude_deg for fix in heard] == pytest.approx([51.05, 51.05])
    assert heard[0].speed_mps == pytest.approx(19.4 * 0.514444)
    assert receiver.refused == 1


def test_non_serial_device_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match="can't be opened"):
        Receiver("/dev/no-such-line")
    with pytest.raises(ConfigurationError, match="is not a serial line"):
        Receiver("/dev/null")
    with pytest.raises(ConfigurationError, match="no 12345 baud"):
        Receiver("/dev/null@12345")


def test_fixes_of_a_bag_have_their_covariance(tmp_path: Path) -> None:
    images = np.full((60, 80), 90, np.uint8)
    written = []
    for number in range(4):
        t_ns = 1_000_000_000 * (number + 1)
        fix = ros_bags.fix(t_ns, 51.05, -114.05, status=-1 if number == 3 else 0)
        fix.position_covariance = np.array([4.0, 0, 0, 0, 4.0, 0, 0, 0, 9.0])
        fix.position_covariance_type = 2 if number else 0
        written += [("/image", t_ns, ros_bags.image(images, t_ns)), ("/gps/fix", t_ns, fix)]
    bag = ros_bags.write_bag(tmp_path / "bag", written)
    camera = replace_camera()
    configuration = load(None, {"source.uri": f"rosbag:{bag}", "results.gnss": "topic:/gps/fix", "camera": camera})
    fixes = recorded_fixes(configuration)
    assert [fix.sigma_m for fix in fixes(0).fixes] == [5.0, 2.0, 2.0]
    with pytest.raises(ConfigurationError, match="not a ROS bag"):
        recorded_fixes(load(None, {"source.uri": "demo", "results.gnss": "topic:/gps/fix"}))


def replace_camera() -> dict[str, float | int]:
    return {
        "width_px": 80,
        "height_px": 60,
        "fx_px": 80.0,
        "fy_px": 80.0,
        "cx_px": 40.0,
        "cy_px": 30.0,
        "height_m": 1.5,
    }
