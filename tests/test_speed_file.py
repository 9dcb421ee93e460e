"""The car's speed for a recording: file formats, and the readings of each frame."""

from __future__ import annotations

import math
import tempfile
from pathlib import Path

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from birdslam.runtime.cli.main import main
from birdslam.runtime.configuration import Configuration, ConfigurationError, SourceConfig, load
from birdslam.runtime.nodes.sources import RecordedSource, offline_frames, open_source
from birdslam.runtime.options import speeds_of
from birdslam.sources.opening import open_recording
from birdslam.sources.recording import DatasetError
from birdslam.sources.speed_file import (
    SIGMA_MPS,
    YAW_RATE_SIGMA_RADPS,
    of_sequence,
    read_speed_curve,
    read_speeds,
    with_speeds,
)
from birdslam.sources.speed_log import MAX_AGE_NS, MAX_READINGS, SpeedLog
from birdslam.types import SpeedReading
from tests.recordings import PERIOD_NS, Frames
from tests.recordings import SMALL as CAMERA


def reading(t_ns: int, speed_mps: float = 5.0) -> SpeedReading:
    return SpeedReading(t_ns=t_ns, speed_mps=speed_mps, sigma_mps=0.1)


def file(folder: Path, text: str) -> Path:
    path = folder / "speed.csv"
    path.write_text(text)
    return path


def test_columns_are_optional(tmp_path: Path) -> None:
    text = "# t v\n\n0.5 10\n1, 10.5\n1.5 11 0.25 # wheels\n2,-1,,0.125\n2.5,12,0.5,-0.25,0.0625\n3,13,,,\n"
    gyro = {"yaw_rate_radps": 0.125, "yaw_rate_sigma_radps": YAW_RATE_SIGMA_RADPS}
    exact = {"yaw_rate_radps": -0.25, "yaw_rate_sigma_radps": 0.0625}
    assert read_speeds(file(tmp_path, text)).readings == (
        SpeedReading(t_ns=500_000_000, speed_mps=10.0, sigma_mps=SIGMA_MPS),
        SpeedReading(t_ns=1_000_000_000, speed_mps=10.5, sigma_mps=SIGMA_MPS),
        SpeedReading(t_ns=1_500_000_000, speed_mps=11.0, sigma_mps=0.25),
        SpeedReading(t_ns=2_000_000_000, speed_mps=-1.0, sigma_mps=SIGMA_MPS, **gyro),
        SpeedReading(t_ns=2_500_000_000, speed_mps=12.0, sigma_mps=0.5, **exact),
        SpeedReading(t_ns=3_000_000_000, speed_mps=13.0, sigma_mps=SIGMA_MPS),
    )


@pytest.mark.parametrize(
    "line", ["3", "3,", "fast 3", "3 fast", "nan 3", "inf 3", "1e30 3", ",3", "1 2 3 4 5 6", "1;2", "2026-01-01 3"]
)
def test_a_torn_line_is_named(tmp_path: Path, line: str) -> None:
    with pytest.raises(DatasetError, match=r"speed\.csv: line 3 is not a time in s and a speed"):
        read_speeds(file(tmp_path, f"0 1\n# so far\n{line}\n4 5\n"))


def test_a_file_without_speeds_is_named(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match=r"speed\.csv: no speeds"):
        read_speeds(file(tmp_path, "# t v\n"))
    (tmp_path / "bytes").write_bytes(b"\xff\xfe\x00")
    for path in (tmp_path / "nowhere", tmp_path / "bytes", tmp_path):
        with pytest.raises(DatasetError, match="can't be read"):
            read_speeds(path)


def test_readings_of_a_failing_sensor_are_passed_on_unused(tmp_path: Path) -> None:
    path = file(tmp_path, "0 1\n1 nan\n2 900\n1.5 3\n3 4 nan\n")
    log = read_speeds(path)
    assert [one.t_ns // 10**8 for one in log.readings] == [0, 10, 20, 15, 30]
    assert math.isnan(log.readings[1].speed_mps)
    assert math.isnan(log.readings[4].sigma_mps)
    with pytest.raises(DatasetError, match="line 2: nan m/s at 1 s is not the speed of a car"):
        read_speed_curve(path)
    with pytest.raises(DatasetError, match="line 3 is not later"):
        read_speed_curve(file(tmp_path, "0 1\n2 1\n1 1\n"))
    assert read_speed_curve(file(tmp_path, "0 1\n2 1.5 0.1 0.2\n")).tolist() == [[0.0, 1.0], [2.0, 1.5]]


@given(st.lists(st.integers(-(10**10), 10**10), max_size=30), st.integers(-(10**10), 10**10))
def test_a_frame_carries_the_readings_of_the_second_before_it(times_ns: list[int], t_ns: int) -> None:
    readings = [reading(one, float(number)) for number, one in enumerate(times_ns)]
    come_ns = [max(times_ns[: number + 1]) for number in range(len(times_ns))]
    expected = [one for one, come in zip(readings, come_ns, strict=True) if t_ns - MAX_AGE_NS < come <= t_ns]
    assert list(SpeedLog(readings).until(t_ns)) == expected


def test_a_frame_carries_at_most_the_newest_readings() -> None:
    log = SpeedLog(reading(number * 1_000_000) for number in range(3_000))
    borne = log.until(2_000_500_000)
    assert len(borne) == MAX_READINGS
    assert borne[-1].t_ns == 2_000_000_000


def test_readings_of_frames_are_the_same_offline_and_looped(tmp_path: Path) -> None:
    path = file(tmp_path, "".join(f"{0.02 * number} {number}\n" for number in range(40)))
    recording = with_speeds(Frames(5), path)
    borne = [frame.speeds for frame in recording.undistorted_frames()]
    assert [one[-1].t_ns for one in borne] == [number * PERIOD_NS for number in range(5)]
    assert [frame.speeds for frame in offline_frames(RecordedSource(recording, SourceConfig()))] == borne
    looped = list(offline_frames(RecordedSource(recording, SourceConfig(loop=True, frames=9))))
    assert [frame.speeds for frame in looped[:5]] == borne
    again = [msgspec.structs.replace(one, t_ns=one.t_ns - 5 * PERIOD_NS) for one in looped[8].speeds]
    assert tuple(again) == borne[3]
    assert [frame.speeds for frame in Frames(2).undistorted_frames()] == [(), ()]


def test_a_file_of_another_clock_is_named(tmp_path: Path) -> None:
    for text in ("1700000000 3\n1700000001 3\n", "-9 3\n-8 3\n"):
        with pytest.raises(DatasetError, match=r"speed\.csv: its times .* are outside the recording's, 0 to 0\.5 s"):
            with_speeds(Frames(5), file(tmp_path, text))


def test_configuration_names_the_speed_file(tmp_path: Path) -> None:
    (tmp_path / "car.toml").write_text('[source]\nuri = "demo"\nspeed = "speed.csv"\n')
    path = file(tmp_path, "0 12\n0.02 12.5\n")
    configuration = load(tmp_path / "car.toml")
    assert configuration.source.speed == str(path)
    source = open_source(configuration)
    assert [len(frame.speeds) for frame, _ in zip(source.frames(), range(2), strict=False)] == [1, 2]
    assert open_recording("demo", speeds=path).speeds is not None
    live = Configuration(camera=CAMERA, source=SourceConfig(uri="v4l2:/dev/video0", speed=str(path)))
    with pytest.raises(ConfigurationError, match="on the bus"):
        open_source(live)


def test_several_drives_have_a_file_each(tmp_path: Path) -> None:
    asked = Configuration(source=SourceConfig(speed=str(file(tmp_path, "0 1\n"))))
    assert speeds_of(asked, 1) == tmp_path / "speed.csv"
    with pytest.raises(ConfigurationError, match=r"for 2 name a directory of NAME\.txt files"):
        speeds_of(asked, 2)
    assert speeds_of(Configuration(source=SourceConfig(speed=str(tmp_path))), 2) == tmp_path
    assert of_sequence(tmp_path, "06") == tmp_path / "06.txt"


def test_bad_speed_files_of_an_evaluation_are_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = ["--output", str(tmp_path / "out")]
    for speed, wanted in (
        (file(tmp_path, "0 1\n1 fast\n"), "speed.csv: line 2 is not a time"),
        (tmp_path, "demo.txt: can't be read"),
        (tmp_path / "none.csv", "none.csv: can't be read"),
    ):
        assert main(["evaluate", "odometry", "demo", "--speed", str(speed), *out]) == 2
        assert wanted in capsys.readouterr().err


@given(st.permutations(["time_s", "speed_kmh", "sigma_mps", "note"]), st.floats(0.0, 200.0))
def test_named_columns_may_be_in_any_order(columns: list[str], kmh: float) -> None:
    cells = {"time_s": "1.5", "speed_kmh": repr(kmh), "sigma_mps": "0.25", "note": "wet"}
    with tempfile.TemporaryDirectory() as folder:
        path = file(Path(folder), f"{','.join(columns)}\n{','.join(cells[name] for name in columns)}\n")
        (found,) = read_speeds(path).readings
    assert (found.t_ns, found.sigma_mps) == (1_500_000_000, 0.25)
    assert found.speed_mps == pytest.approx(kmh / 3.6)


def test_gps_at_1_hz_is_interpolated_with_sigma(tmp_path: Path) -> None:
    text = (
        "time_s,latitude_deg,longitude_deg,speed_mps\n0.5,51.0,-114.0,10.0\n1.5,51.0,-114.0,12.0\n9.5,51.0,-114.0,12\n"
    )
    curve = read_speed_curve(file(tmp_path, text))
    assert curve[:, 0] == pytest.approx([*np.linspace(0.5, 1.5, 11), 9.5])  # over eight seconds nothing is known
    assert curve[:11, 1] == pytest.approx(np.linspace(10.0, 12.0, 11))
    sigmas = [reading.sigma_mps for reading in read_speeds(tmp_path / "speed.csv").readings]
    assert sigmas[0] == 0.3
    assert min(sigmas[1:10]) > 0.4  # between two readings a car may have braked


def test_fixes_alone_give_the_speed(tmp_path: Path) -> None:
    rows = "".join(f"{k},{51.0 + k * 1e-4:.6f},-114.0\n" for k in range(5))  # 11.1 m north each second
    curve = read_speed_curve(file(tmp_path, f"time,lat,lon\n{rows}"))
    assert curve[:, 1] == pytest.approx(11.12, abs=0.02)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("time_s,colour\n1,2\n", "line 1: has no column of speed"),
        ("time_s,speed_mps\n1,2\nx,3\n", "line 3 does not match the header"),
        ("time_s,speed_mps\n1\n", "line 2 does not match"),
    ],
)
def test_invalid_table_is_named(text: str, said: str, tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match=said):
        read_speeds(file(tmp_path, text))


def test_a_track_gives_the_speed(tmp_path: Path) -> None:
    """1.1 m a second to the north, by GPX without speeds; the film's clock starts at 0."""
    path, step_deg = tmp_path / "track.gpx", math.degrees(1.1 / 6_371_000.0)
    points = "".join(
        f'<trkpt lat="{50.0 + k * step_deg:.9f}" lon="7.0"><time>2024-05-01T10:00:{k:02d}Z</time></trkpt>'
        for k in range(5)
    )
    path.write_text(f"<gpx><trk><trkseg>{points}</trkseg></trk></gpx>")
    readings = read_speeds(path).readings
    assert [reading.speed_mps for reading in readings] == pytest.approx([1.1] * len(readings), rel=1e-3)
    assert (readings[0].t_ns, readings[-1].t_ns) == (500_000_000, 3_500_000_000)
    path.write_text("<gpx></gpx>")
    with pytest.raises(DatasetError, match="has no fix"):
        read_speeds(path)


def test_a_table_in_utf_16_is_read(tmp_path: Path) -> None:
    path = tmp_path / "speed.csv"
    path.write_bytes("time_s,speed_kmh\n0.0,36\n1.0,72\n".encode("utf-16"))
    assert [reading.speed_mps for reading in read_speeds(path).readings] == pytest.approx([10.0, 20.0])
