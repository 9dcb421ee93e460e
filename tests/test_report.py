"""The report of a drive: complete, offline, escaped, and rendered by a browser."""

from __future__ import annotations

import base64
import dataclasses
import json
import re
import shutil
from pathlib import Path

import cv2
import msgspec
import numpy as np
import pytest

from birdslam.geometry.camera import Camera
from birdslam.geometry.se2 import SE2
from birdslam.outputs.drive_files import Recorder, ResultsError
from birdslam.outputs.drive_video import SideBySide
from birdslam.outputs.earth_files import GeoLine, write_geo_lines
from birdslam.outputs.placed import Place, write_places
from birdslam.outputs.report.drawings import speeds
from birdslam.outputs.report.drive_table import read_drive
from birdslam.runtime.cli.main import main
from birdslam.sources.camera_file import camera_text
from birdslam.types import LaneLine, Lanes, LineKind, MapUpdate, Status, VehicleEstimate
from tests.cases import first
from tests.chromium import chromium, look
from tests.records import new_estimate
from tests.report_pages import LOOKS, faults, moved

pytest.importorskip("plotly", reason="a report is made by plotly (pip install birdslam[report])")

LINE = {"slope": 0.0, "curvature_per_m": 0.0, "curvature_rate_per_m2": 0.0, "cov": (0.001,) * 16}
CAMERA = Camera(160, 96, 130.0, 130.0, 80.0, 48.0, 1.4)
FRAMES, RESET = 60, 40
EVIL = "</script><script>document.title='broken'</script>"


@pytest.fixture
def results(recorded: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(recorded, tmp_path / recorded.name))


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A drive of 60 frames at 10 Hz and 5 m/s: it starts without a scale, and restarts at frame 40."""
    directory = tmp_path_factory.mktemp("recorded") / "drive & <b>way"
    with Recorder(directory, CAMERA) as recorder:
        for k in range(FRAMES):
            status: tuple[Status, ...] = (Status.SCALE_INVALID,) if k < 10 else ()
            status += (Status.VIEW_OBSTRUCTED,) if k > 50 else ()
            epoch = int(k >= RESET)
            line = LaneLine(
                line=5, offset_m=1.8, seen_from_m=2.0, seen_to_m=20.0, to_m=25.0, kind=LineKind.SOLID, **LINE
            )
            car = VehicleEstimate(
                vehicle=3, T_world_vehicle=SE2(20.0 + 0.5 * (k - RESET * epoch), 3.0, 0.0), cov=(0.01,) * 9,
                velocity_mps=(5.0, 0.0), velocity_cov=(0.01,) * 4, age_ns=0, frames=k + 1, label=f"car{EVIL}",
            )  # fmt: skip
            walker = msgspec.structs.replace(car, vehicle=9, label="pedestrian")
            recorder.add(
                new_estimate(
                    epoch=epoch,
                    frame_id=k,
                    t_source_ns=k * 10**8,
                    T_world_ego=SE2(0.5 * (k - RESET * epoch), 0.0, 0.0),
                    cov=(0.01,) * 9,
                    valid=k >= 10,
                    vehicles=(car,),
                    people=(walker,),
                    lanes=Lanes(lines=(line,)),
                    scale_sigma_rel=0.03,
                    status=status,
                )
            )
            recorder.add_map(MapUpdate(epoch=epoch, frame_id=k, lanes_m=((1.0 * k, 1.8),)))
        write_places(directory, [place(k) for k in range(FRAMES)])
        stages = {f"perceive{EVIL}": {"p50": 4.0, "p99": 8.0, "max": 9.0}}
        recorder.finish(
            {
                "source": f"video:{EVIL}", "versions": {"birdslam": EVIL}, "stages_ms": stages,
                "age_ms": {"p50": 20.0, "p99": 32.0, "max": 40.0}, "earth": {"fixes": 9, "outliers": 1, "rms_m": 1.5},
            }
        )  # fmt: skip
    write_geo_lines(directory / "ego.geojson", [GeoLine(EVIL, np.array([[49.0, 8.4], [49.001, 8.401]]))])
    (directory / "camera.toml").write_text(f"# {EVIL}\n")
    return directory


def place(k: int) -> Place:
    """Frame k on Earth: ahead is north, 1e-5 degrees a frame."""
    T = SE2(0.5 * (k - RESET * (k >= RESET)), 0.0, 0.0)
    return Place(k * 10**8, int(k >= RESET), T, T, (49.0 + 1e-5 * k, 8.4, np.pi / 2.0, 1.0))


def film(path: Path, size_px: tuple[int, int] = (160, 96)) -> Path:
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 10.0, size_px)
    for k in range(FRAMES):
        writer.write(np.full((*size_px[::-1], 3), 4 * k, np.uint8))
    writer.release()
    return path


def report(results: Path, *more: str) -> Path:
    assert main(["report", str(results), "-o", str(results / "r.html"), *more]) == 0
    return results / "r.html"


def test_the_drive_is_read_back_in_one_plane(results: Path) -> None:
    drive = read_drive(results)
    assert drive.frame.tolist() == list(range(FRAMES))
    assert np.diff(drive.xy_m[:, 0])[: RESET - 1] == pytest.approx(0.5, abs=1e-6)
    assert drive.xy_m[RESET, 0] == pytest.approx(drive.xy_m[RESET - 1, 0])  # starts at the end of the other
    assert drive.xy_m[-1, 0] == pytest.approx(0.5 * (FRAMES - 2), abs=1e-6)
    assert np.isnan(drive.speed_mps[[0, RESET]]).all()
    assert np.delete(drive.speed_mps, [0, RESET]) == pytest.approx(5.0, abs=0.01)
    assert drive.valid.tolist() == [k >= 10 for k in range(FRAMES)]
    assert drive.statuses[0] == ("scale_invalid",)
    assert [(track.label[:3], track.is_person, len(track.t_s)) for track in drive.tracks] == [
        ("car", False, FRAMES),
        ("ped", True, FRAMES),
    ]
    assert {kind for kind, _ in drive.lines} == {"solid"}
    assert all(np.abs(xy_m[:, 1] - 1.8).max() < 0.01 for _, xy_m in drive.lines)
    assert drive.earth.t_s[[0, -1]] == pytest.approx([0.0, 0.1 * (FRAMES - 1)])
    assert drive.earth.at(drive.t_s[[0, 30]]) == pytest.approx(np.array([[49.0, 8.4], [49.0003, 8.4]]), abs=1e-6)
    assert len(drive.earth.tracks_deg) == 2
    assert drive.earth.road_deg
    files = {"ego.tum.txt", "ego.kitti.txt", "ego.geojson", "frames.csv", "map.geojson", "road.geojson"}
    assert set(drive.files) == {*files, "tracks.geojson"}
    assert len(drive.lanes_m) == FRAMES


def test_speed_band_has_gaps_at_invalid_frames(results: Path) -> None:
    drive = read_drive(results)
    half = len(drive.t_s) // 2
    valid = np.ones(len(drive.t_s), bool)
    valid[half] = False
    band = speeds(dataclasses.replace(drive, valid=valid), np.arange(len(drive.t_s)))[0]
    outlines = np.split(np.array(band["x"], float), np.flatnonzero([x is None for x in band["x"]]))
    spans = [(np.nanmin(part), np.nanmax(part)) for part in outlines if np.isfinite(part).any()]
    assert spans
    assert all(end < drive.t_s[half] or begin > drive.t_s[half] for begin, end in spans)


def test_the_page_is_complete_offline_and_escaped(results: Path, capsys: pytest.CaptureFixture[str]) -> None:
    page = report(results, "--video", str(film(results / "film.avi"))).read_text(encoding="utf-8")
    assert "opens in any browser" in capsys.readouterr().out
    assert len(page) < 15e6
    own = re.sub(r"<script>.*?</script>", "", page, count=1, flags=re.DOTALL)  # without plotly's own text
    assert not re.search(r"""(src|href)\s*=\s*["'](?!data:)""", own)  # nothing is fetched
    assert EVIL not in page
    assert "document.title='broken'</script>" not in page
    assert "drive &amp; &lt;b&gt;way" in page
    assert "83 % of frames are valid (50 of 60" in page
    assert "determine the scale" in page
    assert own.count('"jpeg":') == FRAMES
    for said in (
        "p50 4.0, p99 8.0 ms",
        "total",
        "p50 20.0, p99 32.0 ms",
        "49.000000, 8.400000",
        "RMS 1.5 m",
        "0.0 to 1.0 s",
    ):
        assert said in page
    assert '"name":"people"' in page
    taken = re.search(r'download="frames.csv" href="data:text/plain;base64,([^"]*)"', page)
    assert base64.b64decode(taken[1]) == (results / "frames.csv").read_bytes()


def test_the_camera_is_that_of_the_configuration_where_no_file_was_written(results: Path) -> None:
    (results / "camera.toml").unlink()
    assert read_drive(results).camera == ""
    summary = json.loads((results / "summary.json").read_text())
    summary["configuration"] = {"camera": {"height_m": 1.4, "distortion": [0.1], "name": EVIL, "none": None}}
    (results / "summary.json").write_text(json.dumps(summary))
    assert "height_m = 1.4\ndistortion = [0.1]\n" in read_drive(results).camera
    assert EVIL not in report(results).read_text(encoding="utf-8")


def test_missing_or_damaged_results_are_a_one_line_error(
    tmp_path: Path, results: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "empty").mkdir()
    assert main(["report", str(tmp_path / "empty")]) == 2
    assert "no results of `birdslam run`" in capsys.readouterr().err
    (results / "frames.csv").write_text("frame,t_s\n1,2\n")
    with pytest.raises(ResultsError, match=r"frames\.csv: has no frames"):
        read_drive(results)
    (results / "summary.json").write_text("{")
    with pytest.raises(ResultsError, match="damaged"):
        read_drive(results)


@pytest.mark.skipif(chromium() is None, reason="no Chromium (Debian: apt install chromium)")
@pytest.mark.parametrize("way", first(1, LOOKS))
def test_a_browser_draws_it_and_the_slider_moves(results: Path, tmp_path: Path, way: str) -> None:
    path = report(results, "--video", str(film(results / "film.avi")))
    seen = moved(path, tmp_path / "seen.png", way)
    assert list(faults(seen, way)) == []  # the console, the slider, the film, the colours, nothing to the right
    middle = (FRAMES - 1) // 2 + 1
    assert seen.said["to"] == f"0,{0.5 * middle:g}"  # ahead of the start
    assert [float(x) for x in seen.said["earth"].split(",")] == pytest.approx([49.0 + 1e-5 * middle, 8.4], abs=1e-6)
    assert f"frame {middle}, 5.0 m/s" in seen.said["at"]
    assert int(seen.said["plots"]) >= 4
    assert seen.said["title"].startswith("BirdSLAM: drive")  # what the files hold has run nothing
    picture = cv2.imread(str(tmp_path / "seen.png"))
    assert picture.std() > 5.0


CLICKS = """<script>
const found = document.getElementById("picture");
// A load holds the browser's virtual time, a decode() does not
const twoClicks = () => {
  const box = found.getBoundingClientRect();
  for (const [x, y] of %s) {
    const at = { clientX: box.left + x * box.width, clientY: box.top + y * box.height, bubbles: true };
    found.dispatchEvent(new MouseEvent("click", at));
  }
  const known = document.getElementById("length");
  known.value = "3";
  known.dispatchEvent(new Event("input"));
  document.documentElement.dataset.measured = document.getElementById("measured").textContent;
};
if (found.complete) twoClicks();
else found.addEventListener("load", twoClicks);
</script>"""


@pytest.mark.skipif(chromium() is None, reason="no Chromium (Debian: apt install chromium)")
def test_two_clicks_measure_a_length_on_the_road(results: Path, tmp_path: Path) -> None:
    (results / "camera.toml").write_text(camera_text(CAMERA, ()), encoding="utf-8")
    drawn = SideBySide(CAMERA)
    width_px, height_px = drawn.size_px
    path = report(results, "--video", str(film(results / "film.avi", drawn.size_px)))
    ends_m = np.array([[-1.0, CAMERA.height_m, 6.0], [1.0, CAMERA.height_m, 6.0]])  # across the road, in camera axes
    ends_px = drawn.scale * (CAMERA.to_px(ends_m[:, :2] / ends_m[:, 2:]) + 0.5)
    clicks = CLICKS % json.dumps((ends_px / [width_px, height_px]).tolist())
    path.write_text(path.read_text(encoding="utf-8").replace("</body>", clicks + "</body>"), encoding="utf-8")
    seen = look(path.resolve().as_uri(), tmp_path / "seen.png")
    assert seen.console == []
    measured = re.fullmatch(
        r"Measured: ([\d.]+) m \u00b1 (\d+) %\. For 3 m pass --height ([\d.]+) \(\u00b1 \d+ %\)\.",
        seen.said["measured"],
    )
    assert float(measured[1]) == pytest.approx(2.0, abs=0.05)  # a click is at a whole pixel
    assert 3 <= int(measured[2]) <= 15
    assert float(measured[3]) == pytest.approx(3.0 / float(measured[1]) * CAMERA.height_m, abs=0.02)


def test_a_video_of_another_camera_has_no_ruler(results: Path) -> None:
    page = report(results, "--video", str(film(results / "film.avi"))).read_text(encoding="utf-8")
    assert "Click two points" not in page


@pytest.mark.slow  # a browser
@pytest.mark.skipif(chromium() is None, reason="no Chromium (Debian: apt install chromium)")
def test_faults_of_a_page_are_reported(results: Path, tmp_path: Path) -> None:
    path = report(results)
    text = path.read_text(encoding="utf-8")
    path.write_text(text.replace('slider.addEventListener("input", move);', 'console.log("here");'), encoding="utf-8")
    found = "\n".join(faults(moved(path, tmp_path / "seen.png", "light"), "light"))
    assert "the slider moves nothing" in found
    assert "here" in found
