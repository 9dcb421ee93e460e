"""docs/examples/foxglove-layout.json against what a recording holds, and its picture."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import cv2
import msgspec
import pytest

from birdslam.perf.errors import PerfError
from birdslam.perf.reporting import foxglove
from birdslam.runtime.recording.foxglove import schema
from birdslam.runtime.recording.recording import JSON_CHANNELS, Recording
from tests.test_pipeline import call

ROOT = Path(__file__).resolve().parent.parent
LAYOUT: dict[str, Any] = json.loads((ROOT / foxglove.LAYOUT).read_text())
PATHS = sorted({path for panel in LAYOUT["configById"].values() for path in foxglove.paths_of(panel)})


def test_every_panel_has_its_place() -> None:
    placed = [name for name, _ in foxglove.boxes_of(LAYOUT["layout"], (0.0, 0.0, 1.0, 1.0))]
    assert sorted(placed) == sorted(LAYOUT["configById"])
    assert {name.partition("!")[0] for name in placed} == {"3D", "Image", "Plot", "StateTransitions"}
    (drive,) = (panel for name, panel in LAYOUT["configById"].items() if name.startswith("3D"))
    assert drive["followTf"] == "ego"  # as runtime/recording/scene.py names it


@pytest.mark.parametrize("path", PATHS)
def test_every_name_is_one_of_a_recordings(path: str) -> None:
    """By the schemas, which Foxglove reads: a field that they do not have is not drawn."""
    topic, keys = foxglove.topic_and_keys(path)
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
            topic, keys = foxglove.topic_and_keys(path)
            if topic == message.channel and not shown[path]:
                shown[path] = foxglove.value_at(msgspec.json.decode(message.data), keys) is not None
    assert [path for path, found in shown.items() if not found] == []
    foxglove.run([str(file), "--at", "3", "--layout", str(ROOT / foxglove.LAYOUT), "--output", str(place / "f.png")])
    picture = cv2.imread(str(place / "f.png"))
    assert picture.shape[:2] == (790, 1400)
    assert picture[40:230, 790:1380].std() > 20.0  # the camera's image


def test_an_unknown_name_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(PerfError, match=r"/latency\.: no path"):
        foxglove.topic_and_keys("/latency.")
    with pytest.raises(PerfError, match=r"none\.json"):
        foxglove.run(["a.mcap", "--layout", str(tmp_path / "none.json")])
    with pytest.raises(PerfError, match="can't be read"):
        foxglove.run([str(tmp_path / "a.mcap"), "--layout", str(ROOT / foxglove.LAYOUT)])
