"""GNSS tracks inside films: containers as cameras write them, made here, and read by the real ExifTool."""

from __future__ import annotations

import shutil
import struct
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from pathlib import Path

import cv2
import numpy as np
import pytest

from birdslam.loops.gnss.files import GnssError, read_fixes
from birdslam.runtime.cli.main import main
from birdslam.runtime.maps.film_gnss import FilmFix, read_film, track_of_films, write_gpx
from birdslam.sources.speed_file import read_speeds

exiftool = pytest.mark.skipif(shutil.which("exiftool") is None, reason="ExifTool is not installed")
BEGIN = datetime(2023, 6, 1, 12, 30, 10, tzinfo=UTC)
FIXES = [FilmFix(BEGIN + timedelta(seconds=k), 48.1 + 1e-4 * k, -11.5 - 2e-4 * k, 10.0 + k) for k in range(5)]
KNOT_MPS = 0.514444


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
        t, (north, east) = fix.utc, sides(fix)
        speed = (fix.speed_mps or 0.0) / KNOT_MPS
        body = struct.pack("<6I", t.hour, t.minute, t.second, t.year - 2000, t.month, t.day)
        body += b"A" + north.encode() + east.encode() + b"\0"
        body += struct.pack("<4f", minutes(fix.latitude_deg), minutes(fix.longitude_deg), speed, 0.0)
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
        knots = (fix.speed_mps or 0.0) / KNOT_MPS
        body = f"GPRMC,{fix.utc:%H%M%S}.00,A,{minutes(fix.latitude_deg):010.5f},{north},"
        body += f"{minutes(fix.longitude_deg):011.5f},{east},{knots:.3f},0.0,{fix.utc:%d%m%y},,,A"
        check = 0
        for character in body.encode():
            check ^= character
        lines.append(f"[{round(fix.utc.timestamp() * 1000)}]${body}*{check:02X}\r\n")
    return data + box(b"free", box(b"gps ", "".join(lines).encode() + b"\0"))


@exiftool
@pytest.mark.parametrize("container", [novatek, blackvue])
def test_a_track_inside_a_film_is_read(container: Callable[[bytes, list[FilmFix]], bytes], tmp_path: Path) -> None:
    path = tmp_path / "film.mp4"
    path.write_bytes(container(film(path), FIXES))
    found = read_film(path)
    assert [fix.utc for fix in found] == [fix.utc for fix in FIXES]
    for fix, true in zip(found, FIXES, strict=True):
        assert fix.latitude_deg == pytest.approx(true.latitude_deg, abs=1e-5)  # Novatek: single precision
        assert fix.longitude_deg == pytest.approx(true.longitude_deg, abs=1e-5)
        assert fix.speed_mps == pytest.approx(true.speed_mps, abs=0.01)
    assert cv2.VideoCapture(str(path)).read()[0]  # it is a film still


@exiftool
def test_the_null_point_is_no_fix(tmp_path: Path) -> None:
    path = tmp_path / "film.mp4"
    lost = [FilmFix(BEGIN, 0.0, 0.0, 0.0), *FIXES[1:]]
    path.write_bytes(novatek(film(path), lost))
    assert len(read_film(path)) == len(FIXES) - 1


@exiftool
def test_films_of_a_drive_give_one_track(tmp_path: Path) -> None:
    for name, fixes in (("2.mp4", FIXES[:2]), ("1.mp4", FIXES[2:])):
        (tmp_path / name).write_bytes(novatek(film(tmp_path / name), fixes))
    track = tmp_path / "out" / "film.gpx"
    assert track_of_films(sorted(tmp_path.glob("*.mp4")), track) == len(FIXES)
    times_ns = [fix.t_source_ns for fix in read_fixes(track.read_bytes(), "film.gpx", 0)]
    assert np.diff(times_ns).tolist() == [1_000_000_000] * (len(FIXES) - 1)


def test_the_written_track_is_read_as_fixes_and_as_speeds(tmp_path: Path) -> None:
    path = tmp_path / "film.gpx"
    write_gpx(path, FIXES)
    fixes = read_fixes(path.read_bytes(), "film.gpx", 0)
    assert [fix.speed_mps for fix in fixes] == [fix.speed_mps for fix in FIXES]
    assert fixes[-1].t_source_ns - fixes[0].t_source_ns == 4_000_000_000
    assert max(reading.speed_mps for reading in read_speeds(path).readings) == pytest.approx(14.0)


@exiftool
@pytest.mark.parametrize("option", ["--gnss", "--speed"])
def test_a_film_without_a_track_is_refused_where_it_is_asked_for_one(
    option: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    film(tmp_path / "film.mp4")
    arguments = [str(tmp_path / "film.mp4"), option, "film", "--output", str(tmp_path / "out"), "--model", "none"]
    assert main(arguments) == 2
    assert "has no GNSS track" in capsys.readouterr().err


@exiftool
def test_a_file_that_is_no_film_has_no_track(tmp_path: Path) -> None:
    (tmp_path / "film.mp4").write_bytes(b"no film")
    assert read_film(tmp_path / "film.mp4") == []
    with pytest.raises(GnssError, match="ExifTool can't read it"):
        read_film(tmp_path / "missing.mp4")


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
