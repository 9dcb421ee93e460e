"""The report of a drive: whole, offline, escaped, and what a browser makes of it."""

from __future__ import annotations

import base64
import re
import shutil
import subprocess
from pathlib import Path

import cv2
import msgspec
import numpy as np
import pytest

from birdslam.geometry.camera import Camera
from birdslam.geometry.se2 import SE2
from birdslam.outputs.drive_files import Recorder, ResultsError
from birdslam.outputs.earth_files import Way, write_ways
from birdslam.outputs.report.drive_table import read_drive
from birdslam.runtime.cli.main import main
from birdslam.types import Estimate, LaneLine, Lanes, LineKind, MapUpdate, Status, VehicleEstimate

pytest.importorskip("plotly", reason="a report is made by plotly (pip install birdslam[report])")

LINE = {"slope": 0.0, "curvature_per_m": 0.0, "curvature_rate_per_m2": 0.0, "cov": (0.001,) * 16}
CAMERA = Camera(160, 96, 130.0, 130.0, 80.0, 48.0, 1.4)
FRAMES, RESET = 60, 40
EVIL = "</script><script>document.title='broken'</script>"


@pytest.fixture
def results(tmp_path: Path) -> Path:
    """A drive of 60 frames at 10 Hz and 5 m/s: it begins without a scale, and begins anew at frame 40."""
    directory = tmp_path / "drive & <b>way"
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
                Estimate(
                    epoch=epoch,
                    frame_id=k,
                    t_source_ns=k * 10**8,
                    t_capture_ns=0,
                    t_utc_ns=0,
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
        stages = {f"perceive{EVIL}": {"p50": 4.0, "p99": 8.0, "max": 9.0}}
        recorder.finish(
            {
                "source": f"video:{EVIL}", "versions": {"birdslam": EVIL}, "stages_ms": stages,
                "age_ms": {"p50": 20.0, "p99": 32.0, "max": 40.0}, "earth": {"fixes": 9, "outliers": 1, "rms_m": 1.5},
            }
        )  # fmt: skip
    write_ways(directory / "ego.geojson", [Way(EVIL, np.array([[49.0, 8.4], [49.001, 8.401]]))])
    (directory / "camera.toml").write_text(f"# {EVIL}\n")
    return directory


def film(path: Path) -> Path:
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 10.0, (160, 96))
    for k in range(FRAMES):
        writer.write(np.full((96, 160, 3), 4 * k, np.uint8))
    writer.release()
    return path


def report(results: Path, *more: str) -> Path:
    assert main(["report", str(results), "-o", str(results / "r.html"), *more]) == 0
    return results / "r.html"


def test_the_drive_is_read_back_in_one_plane(results: Path) -> None:
    drive = read_drive(results)
    assert drive.frame.tolist() == list(range(FRAMES))
    assert np.diff(drive.xy_m[:, 0])[: RESET - 1] == pytest.approx(0.5, abs=1e-6)
    assert drive.xy_m[RESET, 0] == pytest.approx(drive.xy_m[RESET - 1, 0])  # begins where the other was left
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
    assert drive.earth_deg is not None
    assert drive.earth_deg.tolist() == [[49.0, 8.4], [49.001, 8.401]]
    assert set(drive.files) == {"ego.tum.txt", "ego.kitti.txt", "ego.geojson", "frames.csv", "map.geojson"}
    assert len(drive.lanes_m) == FRAMES


def test_the_page_is_whole_offline_and_escaped(results: Path, capsys: pytest.CaptureFixture[str]) -> None:
    page = report(results, "--video", str(film(results / "film.avi"))).read_text(encoding="utf-8")
    assert "opens in any browser" in capsys.readouterr().out
    assert len(page) < 15e6
    own = re.sub(r"<script>.*?</script>", "", page, count=1, flags=re.DOTALL)  # without plotly's own text
    assert not re.search(r"""(src|href)\s*=\s*["'](?!data:)""", own)  # nothing is fetched
    assert EVIL not in page
    assert "document.title='broken'</script>" not in page
    assert "drive &amp; &lt;b&gt;way" in page
    assert "83 % is valid: 50 of 60 frames" in page
    assert "how long a metre is" in page
    assert own.count('"jpeg":') == FRAMES
    for said in ("p50 4.0, p99 8.0 ms", "in all", "p50 20.0, p99 32.0 ms", "49.000000, 8.400000", "RMS 1.5 m"):
        assert said in page
    assert '"name":"people"' in page
    taken = re.search(r'download="frames.csv" href="data:text/plain;base64,([^"]*)"', page)
    assert taken is not None
    assert base64.b64decode(taken[1]) == (results / "frames.csv").read_bytes()


def test_what_is_no_drive_is_one_line(tmp_path: Path, results: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "empty").mkdir()
    assert main(["report", str(tmp_path / "empty")]) == 2
    assert "no results of `birdslam run`" in capsys.readouterr().err
    (results / "frames.csv").write_text("frame,t_s\n1,2\n")
    with pytest.raises(ResultsError, match=r"frames\.csv: holds no frames"):
        read_drive(results)
    (results / "summary.json").write_text("{")
    with pytest.raises(ResultsError, match="torn"):
        read_drive(results)


@pytest.mark.parametrize(("dark", "width_px"), [(False, 1280), (True, 1280), (False, 390)])
def test_a_browser_draws_it_and_the_slider_moves(results: Path, dark: bool, width_px: int) -> None:
    browser = shutil.which("chromium") or shutil.which("chromium-browser")
    if browser is None:
        pytest.skip("no Chromium (Debian: apt install chromium)")
    path = report(results, "--video", str(film(results / "film.avi")))
    moved = """<script>
      const first = document.getElementById("picture").src;
      slider.value = "55"; slider.dispatchEvent(new Event("input"));
      document.documentElement.dataset.moved = document.getElementById("picture").src === first ? "no" : "yes";
      document.documentElement.dataset.at = String(document.getElementById("map").data.at(-1).y[0]);
      document.documentElement.dataset.plots = String(document.querySelectorAll(".plot .main-svg").length);
      document.documentElement.dataset.title = document.title;
      document.documentElement.dataset.over = String(document.documentElement.scrollWidth - innerWidth);
      document.documentElement.dataset.ground = getComputedStyle(document.body).backgroundColor;
    </script>"""
    path.write_text(path.read_text(encoding="utf-8").replace("</body>", moved + "</body>"), encoding="utf-8")
    done = subprocess.run(
        [browser, "--headless", "--no-sandbox", "--disable-gpu", "--enable-logging=stderr", "--dump-dom",
         f"--blink-settings=preferredColorScheme={int(not dark)}", f"--window-size={width_px},900",
         "--virtual-time-budget=8000", path.as_uri()],
        capture_output=True, text=True, timeout=180, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert [line for line in done.stderr.splitlines() if "CONSOLE" in line] == []
    head = re.search("<html[^>]*>", done.stdout)
    assert head is not None
    told = dict(re.findall(r'data-(\w+)="([^"]*)"', head[0]))
    assert told["ready"] == told["moved"] == "yes"
    assert float(told["at"]) == pytest.approx(0.5 * 54)  # ahead of the start, in the plane of both epochs
    assert int(told["plots"]) >= 3
    assert float(told["over"]) <= 0.0  # nothing stands out to the right
    assert (sum(map(int, re.findall(r"\d+", told["ground"])[:3])) < 3 * 64) == dark
    assert told["title"].startswith("BirdSLAM: drive")  # what the files hold has run nothing
    assert "55" in re.findall(r'<output id="words">([^<]*)', done.stdout)[0]
