"""A recording in rerun, where rerun-sdk is installed (the extra `view`), and the layout of Foxglove."""

from __future__ import annotations

import importlib.util
import json
import re
import subprocess
import sys
import urllib.request
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import msgspec
import numpy as np
import psutil
import pytest

from birdslam.runtime.cli.main import main
from birdslam.runtime.configuration import RecordingConfig
from birdslam.runtime.recording import scene
from birdslam.runtime.recording.foxglove import schema
from birdslam.runtime.recording.recording import JSON_CHANNELS, Latency, Recording
from tests.chromium import SOFTWARE_GL, chromium
from tests.taped_drive import Tape, measured
from tests.test_pipeline import call

needs_rerun = pytest.mark.skipif(
    importlib.util.find_spec("rerun") is None, reason="rerun-sdk is not installed (pip install 'birdslam[view]')"
)


@pytest.fixture
def tape(tmp_path: Path) -> Tape:
    tape = Tape(tmp_path, recording=RecordingConfig(file="drive.mcap", images=True))
    frames = measured(30)
    for number, measurements in enumerate(frames):
        if number == 20:
            tape.restart(with_checkpoint=False)  # a new world
        ref = tape.frame(measurements)
        tape.writer.draw(*scene.from_image(np.full((192, 640), number, dtype=np.uint8), 90, ref.t_utc_ns), number)
        tape.take(tape.send(measurements))
        latency = Latency(frame_id=ref.frame_id, age_ms=20.0, left_ms=130.0, stages_ms={"capture -> perceive": 0.5})
        tape.writer.draw("/latency", latency, number)
    tape.end(frames[-1])
    return tape


def test_non_recording_file_is_refused_before_serving(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    web = SimpleNamespace(WebViewer=lambda port: pytest.fail("it serves a page"))
    monkeypatch.setitem(sys.modules, "birdslam.runtime.recording.rerun_web", web)
    assert main(["view", str(tmp_path), "--web"]) == 2
    said = capsys.readouterr()
    assert said.out == ""
    assert f"{tmp_path}: can't be read: Is a directory" in said.err


@needs_rerun
def test_a_recording_becomes_a_file_of_reruns(tape: Tape, tmp_path: Path) -> None:
    from birdslam.runtime.recording import rerun_view as view

    file = tmp_path / "drive.rrd"
    view.show_recording(Recording(tape.path), file)
    data = file.read_bytes()
    assert data.startswith(b"RRF")
    for entity in (b"world/vehicles", b"bev/bodies", b"latency/capture_to_perceive", b"camera/boxes", b"world/map"):
        assert entity in data, entity


@needs_rerun
def test_everything_of_a_drive_is_sent(tape: Tape) -> None:
    from birdslam.runtime.recording import rerun_view as view

    class Stream:
        def __init__(self) -> None:
            self.logged: dict[str, int] = {}

        def log(self, entity: str, *what: object, static: bool = False) -> None:
            self.logged[entity] = self.logged.get(entity, 0) + 1

        def set_time(self, timeline: str, **when: object) -> None:
            assert timeline in ("frame", "drive")

        def send_blueprint(self, blueprint: object) -> None:
            self.blueprint = blueprint

    stream = Stream()
    view.send_recording(Recording(tape.path), view.Viewer(stream))
    logged = stream.logged
    for entity in ("camera", "camera/boxes", "bev/lanes", "latency/age", "latency/left"):
        assert logged[entity] == 30, entity
    for entity in (
        "world/ego",
        "world/ego_ellipse",
        "world/vehicles",
        "world/vehicles/ellipse",
        "bev/bodies",
        "bev/lines",
    ):
        assert logged[entity] == 30, entity
    assert logged["world"] == 3  # its axes, and the start of two epochs
    assert any(entity.startswith("world/map/") for entity in logged)
    assert logged["ego/sigma_yaw_rad"] == 30
    assert logged["status"] >= 2


@pytest.mark.processes
@pytest.mark.skipif(importlib.util.find_spec("rerun") is not None, reason="rerun-sdk is installed")
def test_missing_rerun_is_named(tape: Tape) -> None:
    answer = call("view", str(tape.path), "--save", str(tape.path.with_suffix(".rrd")))
    assert answer.returncode == 2
    assert "birdslam[view]" in answer.stderr
    assert "Traceback" not in answer.stderr


@needs_rerun
@pytest.mark.processes
@pytest.mark.skipif(chromium() is None, reason="no Chromium (Debian: apt install chromium)")
def test_viewer_starts_in_a_browser_without_other_hosts(tmp_path: Path) -> None:
    """Whatever its page asks of other hosts the policy refuses, and that alone is wrong on the console."""
    from birdslam.runtime.recording.rerun_web import POLICY, WebViewer

    program, gl = str(chromium()), SOFTWARE_GL
    with WebViewer(0) as viewer:
        with urllib.request.urlopen(viewer.page) as answer:
            assert answer.headers["Content-Security-Policy"] == POLICY
            assert b"re_viewer" in answer.read()
        heard = {
            one.laddr.ip for one in psutil.net_connections("tcp") if one.status == psutil.CONN_LISTEN and is_ours(one)
        }
        assert heard == {"127.0.0.1"}
        options = ("--headless", "--no-sandbox", "--enable-logging=stderr", f"--user-data-dir={tmp_path}", *gl)
        said: list[str] = []
        with subprocess.Popen([program, *options, viewer.page], stderr=subprocess.PIPE, text=True) as browser:
            try:
                for line in browser.stderr:
                    said += [line] if "CONSOLE" in line else []
                    if "App started" in line:
                        break
            finally:
                browser.terminate()
    assert "App started" in said[-1]
    wrong = [line for line in said if re.search("error|violates|failed|refused", line, re.IGNORECASE)]
    assert [line for line in wrong if "Content Security Policy" not in line and "Failed to fetch" not in line] == []
    assert any("Content Security Policy" in line for line in wrong)  # it did ask


def is_ours(connection: Any) -> bool:
    """Of this process or one that it began."""
    me = psutil.Process()
    return connection.pid in {me.pid, *(child.pid for child in me.children(recursive=True))}


ROOT = Path(__file__).resolve().parent.parent
LAYOUT: dict[str, Any] = json.loads((ROOT / "docs/examples/foxglove-layout.json").read_text())
_PATH = re.compile(r"(/[\w/]+)((?:\.\w+|\[\d+\])*)")


def paths_of(panel: dict[str, Any]) -> Iterator[str]:
    """What a panel reads: topics, and fields of them as in "/latency.age_ms"."""
    yield from (path["value"] for path in panel.get("paths", ()))
    yield from (topic for topic, settings in panel.get("topics", {}).items() if settings.get("visible"))
    image = panel.get("imageMode", {})
    yield from (image[key] for key in ("imageTopic", "calibrationTopic") if key in image)
    yield from image.get("annotations", {})


def topic_and_keys(path: str) -> tuple[str, list[str | int]]:
    """ "/a/b.c[1]" as "/a/b" and ["c", 1]."""
    match = _PATH.fullmatch(path)
    assert match is not None, path
    keys = re.findall(r"\.(\w+)|\[(\d+)\]", match[2])
    return match[1], [name or int(index) for name, index in keys]


def value_at(message: Any, keys: Sequence[str | int]) -> Any:
    """None where it has no such field, or its list is shorter."""
    for key in keys:
        try:
            message = message[key]
        except (KeyError, IndexError):
            return None
    return message


def panels_of(part: Any) -> Iterator[str]:
    """The names of the panels in a layout."""
    if isinstance(part, str):
        yield part
        return
    yield from panels_of(part["first"])
    yield from panels_of(part["second"])


PATHS = sorted({path for panel in LAYOUT["configById"].values() for path in paths_of(panel)})


def test_every_panel_has_a_position() -> None:
    placed = list(panels_of(LAYOUT["layout"]))
    assert sorted(placed) == sorted(LAYOUT["configById"])
    assert {name.partition("!")[0] for name in placed} == {"3D", "Image", "Plot", "StateTransitions"}
    (drive,) = (panel for name, panel in LAYOUT["configById"].items() if name.startswith("3D"))
    assert drive["followTf"] == "ego"  # as runtime/recording/scene.py names it


@pytest.mark.parametrize("path", PATHS)
def test_every_name_exists_in_a_recording(path: str) -> None:
    """By the schemas, which Foxglove reads: a field that they do not have is not drawn."""
    topic, keys = topic_and_keys(path)
    part = msgspec.json.decode(schema(JSON_CHANNELS[topic]))
    for key in keys:
        part = part["items"] if isinstance(key, int) else part["properties"][key]
    if keys:
        assert part["type"] in ("number", "integer", "boolean", "string")


@pytest.mark.slow
@pytest.mark.processes
def test_a_recorded_drive_has_all_that_the_layout_shows(tmp_path_factory: pytest.TempPathFactory) -> None:
    place = tmp_path_factory.mktemp("f")
    file = place / "drive.mcap"
    done = call(
        *("run", "--source", "demo", "--output", str(place / "out"), "--set", "source.frames=90", "--rate", "20"),
        *("--record", str(file), "--record-images", "--set", f"runtime.runtime_dir={place / 'rt'}"),
    )
    assert done.returncode == 0, done.stderr
    shown = dict.fromkeys(PATHS, False)
    for message in Recording(file).messages(JSON_CHANNELS):
        for path in PATHS:
            topic, keys = topic_and_keys(path)
            if topic == message.channel and not shown[path]:
                shown[path] = value_at(msgspec.json.decode(message.data), keys) is not None
    assert [path for path, found in shown.items() if not found] == []
