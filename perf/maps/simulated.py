"""Simulated features of streets with exact truth: a loop, GNSS fixes, maps of 100 km."""

from __future__ import annotations

import tempfile
import time
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pymap3d

from birdslam.geometry.se2 import SE2
from birdslam.loops.features import DESCRIPTOR_BYTES
from birdslam.loops.gnss.earth import GnssFix
from birdslam.loops.keyframe import Keyframe
from birdslam.loops.keyframe_builder import MAX_POINTS, SPACING_M
from birdslam.loops.localiser import Localisation
from birdslam.loops.map_file import encode_map
from birdslam.loops.place_map import MapCamera, PlaceMap
from birdslam.loops.session import MapSession
from birdslam.outputs.placed import Place
from birdslam.perf.maps.places import CAMERA, SAME_BITS, block, build, drive
from birdslam.perf.reporting.figures import Ledger
from birdslam.runtime.maps.drive_earth import write_earth
from birdslam.types import NS_PER_S, Attitude

LENGTHS_KM = 1, 10, 100
LOOK_UPS = 20
ORIGIN, FIX_M = (51.05, -114.05), 2.5


def loop(ledger: Ledger, way_m: float) -> None:
    """A loop driven twice."""
    street = build(block(way_m / 4.0), seed=1)
    around = len(street.route)
    place_map = PlaceMap(MapCamera.of(CAMERA))
    session = _session(place_map, extend=True)
    ends: list[tuple[SE2, SE2, Localisation]] = []
    truth: dict[int, SE2] = {}
    odometry: dict[int, SE2] = {}
    first = SE2(*street.route[0].tolist())
    for estimate, seen, T in drive(street, range(2 * around), seed=5):
        truth[estimate.t_source_ns] = first.between(T)
        odometry[estimate.t_source_ns] = estimate.T_world_ego
        ends.append((truth[estimate.t_source_ns], estimate.T_world_ego, session.step(estimate, seen)))  # type: ignore[arg-type]
    T_true, T_odom, last = ends[-1]
    before_m = _distance_m(T_true, T_odom)
    session.finish()
    open_m = max(_distance_m(truth[each.t_source_ns], odometry[each.t_source_ns]) for each in place_map.keyframes)
    closed_m = max(_distance_m(truth[each.t_source_ns], each.T_map_keyframe) for each in place_map.keyframes)
    # A loop does not determine the scale: the frame has the scale error of the first drive
    at = np.array([(k.T_map_keyframe.x_m, k.T_map_keyframe.y_m) for k in place_map.keyframes])
    true = np.array([(truth[k.t_source_ns].x_m, truth[k.t_source_ns].y_m) for k in place_map.keyframes])
    scale = float((at * true).sum() / (at**2).sum())
    unscaled_m = float(np.hypot(*(scale * at - true).T).max())
    end_m = _distance_m(T_true, last.T_map_ego or T_odom)
    row: dict[str, Any] = {
        "way_m": 2 * around,
        "end_by_odometry_m": round(before_m, 3),
        "end_in_the_map_m": round(end_m, 3),
        "worst_keyframe_by_odometry_m": round(open_m, 3),
        "worst_keyframe_in_the_map_m": round(closed_m, 3),
        "true_metres_over_the_maps": round(scale, 5),
        "worst_keyframe_by_true_metres_m": round(unscaled_m, 3),
        "loops": sum(link.loop for link in place_map.links),
    }
    text = (
        f"end error {before_m:.2f} m by odometry ({before_m / around * 50.0:.2f} %), {end_m:.2f} m in the map "
        f"({end_m / around * 50.0:.2f} %); worst keyframe {open_m:.2f} m by odometry, {closed_m:.2f} m in the map, "
        f"{unscaled_m:.2f} m after scaling by {scale:.4f}"
    )
    ledger.add(f"loop of {around} m, twice", text, **row)


def gnss(ledger: Ledger, way_m: float) -> None:
    """A drive with a fix per second, and its remaining errors on Earth."""
    street = build(block(way_m / 4.0), seed=1)
    chance = np.random.default_rng(7)
    driven = [(estimate, T) for estimate, _, T in drive(street, range(len(street.route)), seed=5)]
    poses = [(estimate.t_source_ns, estimate.T_world_ego) for estimate, _ in driven]
    true = np.array([(T.x_m, T.y_m) for _, T in driven])
    first = driven[0][1]
    placed = [first @ T for _, T in poses]
    begun_m = float(np.hypot(*(np.array([(T.x_m, T.y_m) for T in placed]) - true).T).max())
    every = max(1, round(NS_PER_S / (poses[1][0] - poses[0][0])))
    for name, wrong in (
        ("fixes of 2.5 m", ()),
        ("with a jump of 15 m for 10 s", range(len(true) // 3, len(true) // 3 + 10 * every)),
    ):
        fixes = []
        for row in range(0, len(true), every):
            east, north = true[row] + FIX_M * chance.standard_normal(2) + ((12.0, 9.0) if row in wrong else (0.0, 0.0))
            latitude_deg, longitude_deg, _ = pymap3d.enu2geodetic(east, north, 0.0, *ORIGIN, 0.0)
            fixes.append(
                GnssFix(
                    t_source_ns=poses[row][0],
                    latitude_deg=float(latitude_deg),
                    longitude_deg=float(longitude_deg),
                    sigma_m=FIX_M,
                )
            )
        begun_s = time.process_time()
        with tempfile.TemporaryDirectory() as folder:
            places = [Place(t_ns, 0, T, T) for t_ns, T in poses]
            about, _ = write_earth(fixes, places, CAMERA, Path(folder), None)
            took_s = time.process_time() - begun_s
            features = msgspec.json.decode((Path(folder) / "ego.geojson").read_bytes())["features"]
        lon, lat = np.array(features[0]["geometry"]["coordinates"]).T
        east, north, _ = pymap3d.geodetic2enu(lat, lon, 0.0, *ORIGIN, 0.0)
        worst_m = float(np.hypot(east - true[:, 0], north - true[:, 1]).max())
        text = (
            f"{len(true)} m: worst error {begun_m:.2f} m by odometry, {worst_m:.2f} m with the fixes; "
            f"{about['outliers']} of {about['fixes']} outliers, {len(wrong) // every} wrong; {took_s:.1f} s of a core"
        )
        worst = {"worst_by_odometry_m": round(begun_m, 3), "worst_m": round(worst_m, 3)}
        ledger.add(f"GNSS: {name}", text, **worst, **about)


def _session(place_map: PlaceMap, extend: bool) -> MapSession:
    return MapSession(CAMERA, place_map, extend, lambda features: features)  # type: ignore[arg-type]


def _distance_m(a: SE2, b: SE2) -> float:
    return float(np.hypot(a.x_m - b.x_m, a.y_m - b.y_m))


def size(ledger: Ledger) -> None:
    """Size and look-up time with simulated descriptors, some of which streets share."""
    chance = np.random.default_rng(0)
    common = chance.integers(0, 256, (4000, DESCRIPTOR_BYTES), dtype=np.uint8)
    for length_km in LENGTHS_KM:
        place_map = PlaceMap(MapCamera.of(CAMERA))
        count = round(1000.0 * length_km / SPACING_M)
        for number in range(count):
            flips = np.packbits(chance.random((MAX_POINTS, 8 * DESCRIPTOR_BYTES)) < 0.2, axis=1)
            descriptors = common[chance.integers(0, len(common), MAX_POINTS)] ^ flips
            points = chance.uniform(-20.0, 20.0, (MAX_POINTS, 3))
            T = SE2(SPACING_M * number, 0.0, 0.0)
            place_map.add(
                Keyframe(
                    *(number, 0, number, T, np.zeros((3, 3)), Attitude(), points),
                    *(np.full(MAX_POINTS, 0.05), descriptors, CAMERA.height_m),
                )
            )
        started = time.process_time()
        index = place_map.index()
        index.look_up(place_map.keyframes[0].descriptors, 6)
        built_s = time.process_time() - started
        took_ms, right = [], 0
        for number in range(0, count, max(1, count // LOOK_UPS)):
            own = place_map.keyframes[number].descriptors
            seen = own ^ np.packbits(chance.random((MAX_POINTS, 8 * DESCRIPTOR_BYTES)) < SAME_BITS, axis=1)
            started = time.process_time()
            found = index.look_up(seen, 6)
            took_ms.append(1e3 * (time.process_time() - started))
            right += number in found
        data = len(encode_map(place_map))
        p50_ms, worst_ms = float(np.median(took_ms)), max(took_ms)
        text = (
            f"{count} keyframes, {data / 1e6:.1f} MB ({data / 1e6 / length_km:.2f} a km); look-up {p50_ms:.1f} ms, "
            f"worst {worst_ms:.1f}; index made in {built_s:.1f} s; right place among six {right} of {len(took_ms)}"
        )
        ledger.add(
            f"map of {length_km} km",
            text,
            keyframes=count,
            bytes=data,
            look_up_ms=[round(each, 3) for each in took_ms],
            built_s=round(built_s, 2),
        )
