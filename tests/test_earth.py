"""Georeferencing: reading fixes, aligning a drive with them, and files for other programs."""

import io
import json
import math
from pathlib import Path

import geojson
import gpxpy
import msgspec
import numpy as np
import pymap3d
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from birdslam.geometry.camera import Camera
from birdslam.geometry.se2 import SE2
from birdslam.loops.gnss.earth import Earth, EarthError, GnssFix, align_with_fixes
from birdslam.loops.gnss.files import GnssError, read_fixes, read_track
from birdslam.outputs.earth_files import GeoLine, write_geo_lines

ORIGIN = 51.05, -114.05
YAW_RAD = 0.7  # of the drive's x axis from east


def a_drive(scale: float = 1.0) -> tuple[np.ndarray, list[SE2], np.ndarray]:
    """Times, odometry's poses in an L, and the true east and north of each; odometry is too short by `scale`."""
    t_ns = np.arange(400, dtype=np.int64) * 100_000_000
    way = np.column_stack([np.minimum(np.arange(400), 250.0), np.maximum(np.arange(400) - 250.0, 0.0)])
    poses = [SE2(float(x) / scale, float(y) / scale, 0.0) for x, y in way]
    c, s = math.cos(YAW_RAD), math.sin(YAW_RAD)
    return t_ns, poses, way @ np.array([[c, s], [-s, c]])


CAMERA = Camera(width_px=1242, height_px=375, fx_px=720.0, fy_px=720.0, cx_px=621.0, cy_px=180.0, height_m=1.65)


def fixes_of(t_ns: np.ndarray, enu: np.ndarray, noise_m: float, seed: int = 0) -> list[GnssFix]:
    chance = np.random.default_rng(seed)
    out = []
    for row in range(0, len(t_ns), 10):
        east, north = enu[row] + noise_m * chance.standard_normal(2)
        lat, lon, _ = pymap3d.enu2geodetic(east, north, 0.0, *ORIGIN, 0.0)
        fix = GnssFix(
            t_source_ns=int(t_ns[row]), latitude_deg=float(lat), longitude_deg=float(lon), sigma_m=noise_m or 1
        )
        out.append(fix)
    return out


def worst_m(earth: Earth, poses: list[SE2], enu: np.ndarray) -> float:
    degrees = earth.wgs84(np.array([(pose.x_m, pose.y_m) for pose in poses]))
    east, north, _ = pymap3d.geodetic2enu(degrees[:, 0], degrees[:, 1], 0.0, *ORIGIN, 0.0)
    return float(np.hypot(east - enu[:, 0], north - enu[:, 1]).max())


def test_drive_is_aligned_with_its_fixes() -> None:
    t_ns, poses, enu = a_drive()
    earth = align_with_fixes(t_ns, poses, fixes_of(t_ns, enu, 1.0))
    assert worst_m(earth, poses, enu) < 1.5
    assert earth.yaw_rad == pytest.approx(YAW_RAD, abs=0.02)
    assert earth.calibration_hint(CAMERA) == ""


def test_fixes_with_15_m_error_for_10_s_do_not_bend_the_drive() -> None:
    t_ns, poses, enu = a_drive()
    wrong = enu.copy()
    wrong[120:220] += (12.0, -9.0)
    earth = align_with_fixes(t_ns, poses, fixes_of(t_ns, wrong, 1.0))
    assert earth.outliers == 10
    assert worst_m(earth, poses, enu) < 2.0


def test_wrong_camera_height_is_reported() -> None:
    t_ns, poses, enu = a_drive(scale=0.94)
    earth = align_with_fixes(t_ns, poses, fixes_of(t_ns, enu, 1.0))
    assert earth.scale == pytest.approx(0.94, abs=0.01)
    assert "1.55 m instead of 1.65 m" in earth.calibration_hint(CAMERA)
    assert "a field of view of 85 degrees instead of 82" in earth.calibration_hint(CAMERA)


def test_speeds_of_fixes_determine_the_scale_where_positions_do_not() -> None:
    t_ns, poses, enu = a_drive(scale=0.94)
    fixes = [msgspec.structs.replace(fix, sigma_m=30.0) for fix in fixes_of(t_ns, enu, 20.0)]
    by_places = align_with_fixes(t_ns, poses, fixes)
    by_speeds = align_with_fixes(t_ns, poses, [msgspec.structs.replace(fix, speed_mps=10.0) for fix in fixes])
    assert by_speeds.speed_ratio == pytest.approx(1.0 / 0.94, abs=0.01)
    assert by_speeds.scale == pytest.approx(0.94, abs=0.02)
    assert by_speeds.cov[3, 3] < 0.1 * by_places.cov[3, 3]


def test_delay_of_fixes_is_estimated_in_a_turn() -> None:
    t_ns, poses, enu = a_drive()
    late = [
        GnssFix(**{**{n: getattr(fix, n) for n in fix.__struct_fields__}, "t_source_ns": fix.t_source_ns + 600_000_000})
        for fix in fixes_of(t_ns, enu, 0.3)
    ]
    earth = align_with_fixes(t_ns, poses, late)
    assert earth.delay_s == pytest.approx(0.6, abs=0.15)


@pytest.mark.parametrize(
    ("take", "why"), [(slice(0, 0), "no fixes"), (slice(0, 2), "fewer than 3"), (slice(0, 3), "are needed")]
)
def test_too_few_fixes_are_an_error(take: slice, why: str) -> None:
    t_ns, poses, enu = a_drive()
    with pytest.raises(EarthError, match=why):
        align_with_fixes(t_ns[:], [SE2()] * 400 if why == "are needed" else poses, fixes_of(t_ns, enu, 1.0)[take])


CSV = b"time_s,latitude_deg,longitude_deg,speed_mps\n0.5,51.04933,-114.05395,12.778\n1.5,51.04928,-114.05411,\n"
RMC = "GPRMC,123519.50,A,4807.038,N,01131.000,E,022.4,084.4,230394,003.1,W"
GPX = (
    b'<?xml version="1.0"?><gpx xmlns="http://www.topografix.com/GPX/1/1"><trk><trkseg>'
    b'<trkpt lat="48.1" lon="11.5"><time>2020-01-01T00:00:00Z</time></trkpt>'
    b'<trkpt lat="48.2" lon="11.6"><time>2020-01-01T00:00:02Z</time><hdop>2</hdop></trkpt></trkseg></trk></gpx>'
)


def sentence(body: str) -> bytes:
    total = 0
    for byte in body.encode():
        total ^= byte
    return f"${body}*{total:02X}\r\n".encode()


def test_csv_nmea_and_gpx_are_read() -> None:
    first, second = read_fixes(CSV, "a.csv", 0)
    assert (first.t_source_ns, first.latitude_deg, first.speed_mps) == (500_000_000, 51.04933, 12.778)
    assert second.speed_mps is None
    gga = "GPGGA,123519.50,4807.038,N,01131.000,E,1,08,0.9,545.4,M,46.9,M,,"
    (fix,) = read_fixes(sentence(gga) + sentence(RMC) + b"$GPRMC,cut off", "a.nmea", 7)
    assert fix.t_source_ns == 7  # UTC of another year: aligned to the start of the recording
    assert fix.latitude_deg == pytest.approx(48.0 + 7.038 / 60.0)
    assert fix.speed_mps == pytest.approx(22.4 * 0.514444)
    assert fix.sigma_m == pytest.approx(3.6)
    one, two = read_fixes(GPX, "a.gpx", 0)
    assert (one.t_source_ns, two.t_source_ns, two.sigma_m) == (0, 2_000_000_000, 8.0)


@pytest.mark.parametrize(
    ("data", "why"),
    [
        (b"", "empty"),
        (b"\xff\xfe\x00", "no text"),
        (b"t,lat\n", "name the columns"),
        (b"time_s,latitude_deg,longitude_deg\n", "no fix"),
        (b"time_s,latitude_deg,longitude_deg\n0,91,0\n", "line 2"),
        (b"time_s,latitude_deg,longitude_deg\n0,x,0\n", "line 2"),
        (b"<gpx>", "no XML"),
        (b'<!DOCTYPE a [<!ENTITY b "c">]><gpx/>', "DOCTYPE"),
    ],
)
def test_file_without_fixes_is_refused(data: bytes, why: str) -> None:
    with pytest.raises(GnssError, match=why):
        read_fixes(data, "a", 0)


@given(st.sampled_from([CSV, sentence(RMC), GPX]), st.integers(0, 400), st.binary(max_size=6))
def test_mutated_files_give_fixes_or_the_error(good: bytes, place: int, noise: bytes) -> None:
    try:
        fixes = read_fixes(good[:place] + noise + good[place + len(noise) :], "a", 0)
    except GnssError:
        return
    assert all(abs(fix.latitude_deg) <= 90.0 and math.isfinite(fix.sigma_m) for fix in fixes)


def test_track_of_another_clock_is_aligned_by_shape() -> None:
    """The fixes start ten minutes before the drive and end two minutes after it."""
    t_ns, poses, enu = a_drive()
    before = enu[0] + np.outer(np.arange(600, 0, -1), (-7.0, 3.0)) + 40.0 * np.sin(np.arange(600))[:, None]
    after = enu[-1] + np.outer(np.arange(1, 121), (2.0, 9.0))
    track = np.concatenate([before, enu[::10], after])
    times_ns = np.arange(len(track), dtype=np.int64) * 1_000_000_000
    lat, lon, _ = pymap3d.enu2geodetic(track[:, 0], track[:, 1], 0.0, *ORIGIN, 0.0)
    rows = zip(times_ns.tolist(), lat.tolist(), lon.tolist(), strict=True)
    fixes = [GnssFix(t_source_ns=t, latitude_deg=a, longitude_deg=b, sigma_m=2.0) for t, a, b in rows]
    earth = align_with_fixes(t_ns, poses, fixes, clock_is_known=False)
    assert worst_m(earth, poses, enu) < 5.0
    assert earth.delay_s == pytest.approx(600.0, abs=0.5)


def test_a_straight_drive_within_a_straight_track_of_another_clock_is_an_error() -> None:
    t_ns, poses, enu = a_drive()
    straight = fixes_of(t_ns, enu, 1.0)[:25]  # before the turn
    with pytest.raises(EarthError, match="--gnss-offset"):
        align_with_fixes(t_ns[:100], poses[:100], straight, clock_is_known=False)
    assert align_with_fixes(t_ns[:100], poses[:100], straight).fixes >= 9


def test_the_stated_offset_ties_a_track_to_the_recording() -> None:
    (first, second), known = read_track(GPX, "a.gpx", 7, 1.5).fixes, read_track(GPX, "a.gpx", 7, 1.5).clock_is_known
    assert (first.t_source_ns, second.t_source_ns) == (7 - 1_500_000_000, 7 + 500_000_000)
    assert known
    assert not read_track(GPX, "a.gpx", 7).clock_is_known


GGA = "GPGGA,{},4807.038,N,01131.000,E,1,08,0.9,545.4,M,46.9,M,,"


@pytest.mark.parametrize("before", [b"", b"[1541616573000]", b" "])
def test_nmea_is_recognized_after_a_dashcam_header(before: bytes) -> None:
    """The first line is cut off; each sentence may have a time in brackets."""
    (fix,) = read_fixes(b"31.000,E,022.4,084.4*11\r\n" + before + sentence(RMC), "a.nmea", 0)
    assert fix.latitude_deg == pytest.approx(48.0 + 7.038 / 60.0)


def test_fixes_without_date_continue_over_midnight() -> None:
    lines = b"".join(sentence(GGA.format(time)) for time in ("235958.00", "235959.50", "000001.00"))
    fixes = read_fixes(lines, "a.nmea", 5)
    assert [fix.t_source_ns - 5 for fix in fixes] == [0, 1_500_000_000, 3_000_000_000]
    noon_s = 1_700_000_000 // 86_400 * 86_400 + 43_200
    begin_ns = (noon_s + 12 * 3_600 - 2) * 1_000_000_000  # the recording's clock is UTC: the fixes are of its day
    assert [fix.t_source_ns - begin_ns for fix in read_fixes(lines, "a.nmea", begin_ns)] == [0, 1.5e9, 3e9]


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16"])
def test_table_columns_are_identified_by_meaning(encoding: str) -> None:
    text = "Time,Lat,Lon,Speed_kmh\n1700000000.5,51.0,7.0,36\n1700000001.5,51.1,7.0,\n"
    track = read_track(text.encode(encoding), "a.csv", 3)
    assert [fix.t_source_ns for fix in track.fixes] == [3, 1_000_000_003]  # Unix time; the film starts at 0
    assert track.fixes[0].speed_mps == pytest.approx(10.0)
    assert not track.clock_is_known


def test_the_files_are_valid_and_contain_the_line(tmp_path: Path) -> None:
    degrees = np.array([(51.0, -114.0), (51.1, -114.1), (51.2, -114.3)])
    way = GeoLine("ego & <more>", degrees, [0, 1_500_000_000, 3_000_000_000], {"rms_m": 1.5})
    for suffix in (".geojson", ".gpx", ".kml"):
        write_geo_lines(tmp_path / f"way{suffix}", [way])
    found = geojson.loads((tmp_path / "way.geojson").read_text())
    assert found.is_valid, found.errors()
    assert json.loads(geojson.dumps(found))["features"][0]["geometry"]["coordinates"][1] == [-114.1, 51.1]
    track = gpxpy.parse(io.StringIO((tmp_path / "way.gpx").read_text())).tracks[0]
    assert track.name == "ego & <more>"
    assert [(p.latitude, p.longitude) for p in track.segments[0].points] == [tuple(row) for row in degrees]
    assert "-114.30000000,51.20000000" in (tmp_path / "way.kml").read_text()
    with pytest.raises(ValueError, match="expected a suffix of"):
        write_geo_lines(tmp_path / "way.shp", [way])


def test_fixes_inside_a_dashcam_film_are_read(data_dir: Path) -> None:
    path = data_dir / "dashcam" / "town_gps.csv"
    if not path.exists():
        pytest.skip(f"{path}: is not there")
    fixes = read_fixes(path.read_bytes(), str(path), 0)
    assert len(fixes) == 20
    assert all(7.0 < fix.speed_mps < 13.0 for fix in fixes if fix.speed_mps)


@settings(max_examples=12)
@given(
    st.dictionaries(st.integers(0, 39), st.tuples(st.floats(-1e5, 1e5), st.floats(-1e5, 1e5)), max_size=4),
    st.integers(0, 5),
)
def test_few_outlier_fixes_do_not_move_the_drive(wrong: dict[int, tuple[float, float]], seed: int) -> None:
    """Of 40 fixes up to four are off by up to 100 km, the first ones too."""
    t_ns, poses, enu = a_drive()
    moved = enu.copy()
    for k, offset in wrong.items():
        moved[10 * k] += offset
    earth = align_with_fixes(t_ns, poses, fixes_of(t_ns, moved, 1.0, seed))
    assert worst_m(earth, poses, enu) < 5.0
    assert earth.outliers <= len(wrong) + 4  # of 40 fixes 0.4 are beyond the gate of 3 sigma by chance


def test_fix_at_zero_zero_is_ignored() -> None:
    rows = "time_s,latitude_deg,longitude_deg\n" + "\n".join(f"{k},{51.0 + 1e-5 * k},7.0" for k in range(5))
    found = read_fixes(f"{rows}\n5,0.0,0.0\n6,51.0,7.0\n".encode(), "fixes.csv", 0)
    assert len(found) == 6
