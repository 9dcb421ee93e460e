"""GNSS tracks inside films: containers as cameras write them, made here and read by ExifTool."""

from __future__ import annotations

import shutil
import struct
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from fractions import Fraction
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from birdslam.geometry.se2 import SE2
from birdslam.loops.gnss.earth import EarthError
from birdslam.loops.gnss.files import GnssError, read_fixes
from birdslam.outputs.earth_files import GeoLine, write_geo_lines
from birdslam.runtime.cli.main import main
from birdslam.runtime.configuration import FILM, load
from birdslam.runtime.maps.film_gnss import FilmFix, fixes_beside, read_film, track_of_films
from birdslam.runtime.supervision.final_results import GNSS_UNUSED, FinalResults
from birdslam.sources.speed_file import read_speeds
from tests.test_results import estimate

exiftool = pytest.mark.skipif(shutil.which("exiftool") is None, reason="ExifTool is not installed")
BEGIN = datetime(2023, 6, 1, 12, 30, 10, tzinfo=UTC)
FIXES = [FilmFix(48.1 + 1e-4 * k, -11.5 - 2e-4 * k, BEGIN + timedelta(seconds=k)) for k in range(5)]


def film(path: Path) -> bytes:
    """A film of a second, without a track."""
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), 30.0, (64, 48))
    for k in range(30):
        writer.write(np.full((48, 64, 3), 4 * k, np.uint8))
    writer.release()
    return path.read_bytes()


def minutes(degrees: float) -> float:
    """DDMM.MMMM of NMEA and of Novatek."""
    whole = int(abs(degrees))
    return 100.0 * whole + 60.0 * (abs(degrees) - whole)


def sides(fix: FilmFix) -> tuple[str, str]:
    return "N" if fix.latitude_deg > 0 else "S", "E" if fix.longitude_deg > 0 else "W"


def box(kind: bytes, content: bytes) -> bytes:
    return struct.pack(">I", 8 + len(content)) + kind + content


def with_moov(data: bytes, more: bytes) -> bytes:
    """The film with another box at the start of its last box, `moov`."""
    at = data.rindex(b"moov") - 4
    size = struct.unpack(">I", data[at : at + 4])[0]
    assert at + size == len(data)
    return data[:at] + struct.pack(">I", size + len(more)) + b"moov" + more + data[at + 8 :]


def novatek(data: bytes, fixes: list[FilmFix]) -> bytes:
    """`free` boxes with a fix a second before a `moov` with their index (Viofo A119 V3)."""
    blocks = []
    for fix in fixes:
        t, (north, east) = fix.utc or BEGIN, sides(fix)
        body = struct.pack("<6I", t.hour, t.minute, t.second, t.year - 2000, t.month, t.day)
        body += b"A" + north.encode() + east.encode() + b"\0"
        body += struct.pack("<4f", minutes(fix.latitude_deg), minutes(fix.longitude_deg), 9.0, 0.0)
        blocks.append(box(b"free", (b"GPS " + struct.pack("<I", 0x3F0) + body).ljust(1016, b"\0")))
    at = data.rindex(b"moov") - 4
    head = data[:at] + b"".join(blocks)
    index = struct.pack(">2I", 0x101, len(blocks))
    for k, block in enumerate(blocks):
        index += struct.pack(">2I", at + k * len(block), len(block))
    return with_moov(head + data[at:], box(b"gps ", index))


def blackvue(data: bytes, fixes: list[FilmFix]) -> bytes:
    """A `free` box with NMEA sentences after times in brackets."""
    lines = []
    for fix in fixes:
        north, east = sides(fix)
        utc = fix.utc or BEGIN
        body = f"GPRMC,{utc:%H%M%S}.00,A,{minutes(fix.latitude_deg):010.5f},{north},"
        body += f"{minutes(fix.longitude_deg):011.5f},{east},9.0,0.0,{utc:%d%m%y},,,A"
        check = 0
        for character in body.encode():
            check ^= character
        lines.append(f"[{round(utc.timestamp() * 1000)}]${body}*{check:02X}\r\n")
    return data + box(b"free", box(b"gps ", "".join(lines).encode() + b"\0"))


def gopro(data: bytes, fixes: list[FilmFix]) -> bytes:
    """A track of GPMF samples, one a second, with 18 equal positions each (GoPro HERO5 to HERO10)."""

    def klv(key: bytes, kind: bytes, size: int, count: int, content: bytes) -> bytes:
        return key + kind + struct.pack(">BH", size, count) + content.ljust((len(content) + 3) // 4 * 4, b"\0")

    def nested(key: bytes, content: bytes) -> bytes:
        return klv(key, b"\0", 1, len(content), content)

    samples = []
    for fix in fixes:
        scaled = (fix.latitude_deg * 1e7, fix.longitude_deg * 1e7, 0.0, 9e3, 0.0)
        date = b"" if fix.utc is None else klv(b"GPSU", b"U", 16, 1, f"{fix.utc:%y%m%d%H%M%S}.000".encode())
        stream = date
        stream += klv(b"SCAL", b"l", 4, 5, struct.pack(">5i", 10_000_000, 10_000_000, 1000, 1000, 100))
        stream += klv(b"GPS5", b"l", 20, 18, struct.pack(">5i", *map(round, scaled)) * 18)
        samples.append(nested(b"DEVC", klv(b"DVID", b"L", 4, 1, b"\0\0\0\1") + nested(b"STRM", stream)))
    at, count = data.rindex(b"moov") - 4, len(samples)
    table = box(b"stsd", struct.pack(">2I", 0, 1) + box(b"gpmd", b"\0" * 6 + b"\0\1" + b"\0" * 4))
    table += box(b"stts", struct.pack(">4I", 0, 1, count, 1000))
    table += box(b"stsc", struct.pack(">5I", 0, 1, 1, count, 1))
    table += box(b"stsz", struct.pack(">3I", 0, 0, count) + b"".join(struct.pack(">I", len(each)) for each in samples))
    table += box(b"stco", struct.pack(">3I", 0, 1, at + 8))
    head = box(b"mdhd", struct.pack(">6I", 0, 0, 0, 1000, 1000 * count, 0))
    head += box(b"hdlr", b"\0" * 8 + b"meta" + b"\0" * 13)
    media = box(b"mdia", head + box(b"minf", box(b"stbl", table)))
    track = box(b"trak", box(b"tkhd", b"\0" * 84) + media)
    end = struct.unpack(">I", data[at : at + 4])[0]
    moov = struct.pack(">I", end + len(track)) + data[at + 4 :] + track
    return data[:at] + box(b"mdat", b"".join(samples)) + moov


@exiftool
@pytest.mark.parametrize("container", [novatek, blackvue, gopro])
def test_a_track_inside_a_film_is_read(container: Callable[[bytes, list[FilmFix]], bytes], tmp_path: Path) -> None:
    path = tmp_path / "film.mp4"
    path.write_bytes(container(film(path), FIXES))
    found = read_film(path)
    assert [fix.utc for fix in found] == [fix.utc for fix in FIXES]
    for fix, true in zip(found, FIXES, strict=True):
        assert fix.latitude_deg == pytest.approx(true.latitude_deg, abs=1e-5)  # Novatek: single precision
        assert fix.longitude_deg == pytest.approx(true.longitude_deg, abs=1e-5)
    assert cv2.VideoCapture(str(path)).read()[0]  # it is a film still


@exiftool
def test_fix_at_zero_zero_is_ignored(tmp_path: Path) -> None:
    path = tmp_path / "film.mp4"
    lost = [FilmFix(0.0, 0.0, BEGIN), *FIXES[1:]]
    path.write_bytes(novatek(film(path), lost))
    assert len(read_film(path)) == len(FIXES) - 1


@exiftool
def test_films_of_a_drive_share_one_track(tmp_path: Path) -> None:
    for name, fixes in (("2.mp4", FIXES[:2]), ("1.mp4", FIXES[2:])):
        (tmp_path / name).write_bytes(novatek(film(tmp_path / name), fixes))
    track = tmp_path / "out" / "film.gpx"
    assert track_of_films(sorted(tmp_path.glob("*.mp4")), track) == len(FIXES)
    times_ns = [fix.t_source_ns for fix in read_fixes(track.read_bytes(), "film.gpx", 0)]
    assert np.diff(times_ns).tolist() == [1_000_000_000] * (len(FIXES) - 1)


def undated(path: Path) -> None:
    """A film whose fixes have times in the film alone."""
    fixes = [FilmFix(fix.latitude_deg, fix.longitude_deg, None) for fix in FIXES]
    path.write_bytes(gopro(film(path), fixes))


@exiftool
def test_the_track_is_read_as_fixes_and_as_speeds(tmp_path: Path) -> None:
    path, track = tmp_path / "film.mp4", tmp_path / "film.gpx"
    path.write_bytes(gopro(film(path), FIXES))
    assert track_of_films([path], track) == len(FIXES)
    assert len(read_fixes(track.read_bytes(), "film.gpx", 0)) == len(FIXES)
    step_m = np.hypot(1e-4, 2e-4 * np.cos(np.radians(48.1))) * np.pi / 180.0 * 6_371_000.0
    speeds = [reading.speed_mps for reading in read_speeds(track).readings]
    assert speeds == pytest.approx([step_m] * len(speeds), rel=0.01)  # a step a second


@exiftool
def test_fixes_without_a_date_have_the_times_of_their_film(tmp_path: Path) -> None:
    path, track = tmp_path / "film.mp4", tmp_path / "film.gpx"
    undated(path)
    assert track_of_films([path], track) == len(FIXES)
    times_ns = [fix.t_source_ns for fix in read_fixes(track.read_bytes(), "film.gpx", 0)]
    assert np.diff(times_ns).tolist() == [1_000_000_000] * (len(FIXES) - 1)
    undated(tmp_path / "film2.mp4")
    with pytest.raises(GnssError, match="have no date"):
        track_of_films([path, tmp_path / "film2.mp4"], track)


def cue(k: int, text: str) -> str:
    return f"{k + 1}\n00:00:{k // 2:02d},{500 * (k % 2):03d} --> 00:00:{k // 2 + 1:02d},000\n{text}\n"


SUBTITLES = {
    "DJI": "<font>FrameCnt: 1, iso: 100 [latitude: {lat:.6f}] [longitude: {lon:.6f}] [rel_alt: 1.3]</font>",
    "DJI before 2018": "HOME(1.0,2.0) GPS({lon:.6f},{lat:.6f},15) BAROMETER:1.2",
    "dashcam": "N{lat:.6f} W{west:.6f} 34 km/h",
    "dashcam, hemisphere last": "{lat:.6f}\u00b0 N, {west:.6f}\u00b0 W",
}


@pytest.mark.parametrize("form", SUBTITLES)
def test_subtitles_beside_a_film_are_read_without_exiftool(
    form: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two cues a second from a receiver of one fix a second: the repeated positions are dropped."""
    monkeypatch.setenv("PATH", str(tmp_path))
    film(tmp_path / "film.mp4")
    fixes = [(fix.latitude_deg, fix.longitude_deg) for fix in FIXES for _ in range(2)]
    cues = [cue(k, SUBTITLES[form].format(lat=lat, lon=lon, west=-lon)) for k, (lat, lon) in enumerate(fixes)]
    (tmp_path / "film.srt").write_text("\n".join(cues), encoding="utf-8-sig")
    assert track_of_films([tmp_path / "film.mp4"], tmp_path / "film.gpx") == len(FIXES)
    of_film = read_fixes((tmp_path / "film.gpx").read_bytes(), "film.gpx", 0)
    of_subtitles = read_fixes((tmp_path / "film.srt").read_bytes(), "film.srt", 0)
    for found in (of_film, of_subtitles):
        assert [fix.t_source_ns for fix in found] == [k * 1_000_000_000 for k in range(len(FIXES))]
        degrees = [(fix.latitude_deg, fix.longitude_deg) for fix in found]
        assert degrees == pytest.approx(np.array(fixes[::2]), abs=1e-6)


def test_subtitles_without_positions_are_no_track(tmp_path: Path) -> None:
    (tmp_path / "film.srt").write_text(cue(0, "Latitude is a band.") + "\n" + cue(1, "N. 12 E. 4"))
    assert fixes_beside(tmp_path / "film.mp4") == []
    with pytest.raises(GnssError, match="has no fix"):
        read_fixes((tmp_path / "film.srt").read_bytes(), "film.srt", 0)


@given(st.text(max_size=200))
def test_any_subtitle_text_gives_fixes_or_an_error(text: str) -> None:
    try:
        fixes = read_fixes(cue(0, text).encode(), "film.srt", 0)
    except GnssError:
        fixes = []
    assert all(abs(fix.latitude_deg) <= 90.0 for fix in fixes)


@exiftool
@pytest.mark.parametrize("form", SUBTITLES)
def test_a_subtitle_track_of_a_film_is_read(form: str, tmp_path: Path) -> None:
    av = pytest.importorskip("av", reason="films with subtitles are written by PyAV (pip install av)")
    path = tmp_path / "film.mp4"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=1)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        subtitles = container.add_mux_stream("mov_text")
        subtitles.time_base = Fraction(1, 1000)
        for k, fix in enumerate(FIXES):
            picture = av.VideoFrame.from_ndarray(np.full((48, 64, 3), 9 * k, np.uint8), "bgr24")
            container.mux(stream.encode(picture))
            text = SUBTITLES[form].format(lat=fix.latitude_deg, lon=fix.longitude_deg, west=-fix.longitude_deg).encode()
            packet = av.packet.Packet(struct.pack(">H", len(text)) + text)
            packet.stream, packet.pts, packet.dts, packet.duration = subtitles, 1000 * k, 1000 * k, 1000
            container.mux(packet)
        container.mux(stream.encode())
    found = read_film(path)
    assert [fix.t_film_s for fix in found] == pytest.approx(range(len(FIXES)), abs=0.01)
    degrees = [(fix.latitude_deg, fix.longitude_deg) for fix in found]
    assert degrees == pytest.approx(np.array([(fix.latitude_deg, fix.longitude_deg) for fix in FIXES]), abs=1e-6)


@exiftool
def test_single_fix_is_not_a_track(tmp_path: Path) -> None:
    path = tmp_path / "film.mp4"
    path.write_bytes(novatek(film(path), FIXES[:1]))
    assert track_of_films([path], tmp_path / "film.gpx") == 0


@exiftool
@pytest.mark.parametrize("option", ["--gnss", "--speed"])
def test_film_without_requested_track_is_refused(
    option: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    film(tmp_path / "film.mp4")
    arguments = [str(tmp_path / "film.mp4"), option, "film", "--output", str(tmp_path / "out"), "--model", "none"]
    assert main(arguments) == 2
    assert "has no GNSS track" in capsys.readouterr().err


@exiftool
def test_non_film_file_has_no_track(tmp_path: Path) -> None:
    (tmp_path / "film.mp4").write_bytes(b"no film")
    assert read_film(tmp_path / "film.mp4") == read_film(tmp_path / "missing.mp4") == []


def test_without_exiftool_the_remedy_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    film(tmp_path / "film.mp4")
    monkeypatch.setenv("PATH", str(tmp_path))
    arguments = [str(tmp_path / "film.mp4"), "--gnss", "film", "--output", str(tmp_path / "out"), "--model", "none"]
    assert main(arguments) == 2
    assert "apt install libimage-exiftool-perl" in capsys.readouterr().err
    assert main(["demo", "--gnss", "film", "--output", str(tmp_path / "out")]) == 2
    assert "no film" in capsys.readouterr().err


def test_unusable_track_does_not_affect_other_results(tmp_path: Path) -> None:
    """A requested one is an error, since its results are missing."""
    track = tmp_path / "film.gpx"
    write_geo_lines(track, [GeoLine("film", np.array([[48.0, 11.0], [49.0, 11.0]]), [0, 1_000_000_000])])
    overrides = {"source.uri": "demo", "output": str(tmp_path)}
    found = FinalResults(load(None, overrides), None, track)
    requested = FinalResults(load(None, {**overrides, "results.gnss": str(track)}), None)
    for final in (found, requested):
        final.map.add(estimate(0, SE2()))
    assert "within the drive" in found.write(())[GNSS_UNUSED]
    with pytest.raises(EarthError, match="within the drive"):
        requested.write(())


def test_a_configuration_file_names_the_track_inside_the_film(tmp_path: Path) -> None:
    path = tmp_path / "car.toml"
    path.write_text('[results]\ngnss = "film"\n[source]\nspeed = "film"\n')
    configuration = load(path)
    assert (configuration.results.gnss, configuration.source.speed) == (FILM, FILM)
