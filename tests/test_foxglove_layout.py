"""docs/examples/foxglove-layout.json matches the contents of a recording."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import msgspec
import pytest

from birdslam.runtime.recording.foxglove import schema
from birdslam.runtime.recording.recording import JSON_CHANNELS, Recording
from tests.test_pipeline import call

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
