"""The page of constants has the values of the code."""

from __future__ import annotations

import importlib
import re
from pathlib import Path

import msgspec
import pytest

from birdslam.bench.simulation.odometry import OdometryNoise
from birdslam.runtime.fields import fields
from birdslam.runtime.pages.tables import comments
from birdslam.slam import SlamConfig

PAGE = Path(__file__).parent.parent / "docs" / "constants.md"
ROWS = re.findall(r"^\| `([\w.]+)` \| ([^|]+) \| ([^|]+) \| ([^|]+) \|$", PAGE.read_text(), re.MULTILINE)
RECORDINGS = re.compile(r"KITTI|\b00[01]\d\b|raw clip|motorway clip|shipped drive")


def in_code(name: str) -> object:
    """A field of the default configuration, or a constant of a module."""
    value: object
    if name.startswith("slam."):
        value, parts = SlamConfig(), name.split(".")[1:]
    else:
        words = name.split(".")
        at = next(k for k in range(len(words)) if not words[k].islower())
        value, parts = importlib.import_module(".".join(words[:at])), words[at:]
    for part in parts:
        value = value[part] if isinstance(value, dict) else getattr(value, part)
        value = value() if isinstance(value, type) else value
    return value


@pytest.mark.parametrize(("name", "stated"), [(name, stated.strip()) for name, stated, *_ in ROWS])
def test_a_constant_is_what_the_page_says(name: str, stated: str) -> None:
    value = in_code(name)
    if stated == "fitted":
        assert value == OdometryNoise()
    elif isinstance(value, msgspec.Struct):
        assert [float(number) for number in stated.split(",")] == list(msgspec.structs.astuple(value)[:3])
    else:
        assert value == float(stated)


def test_every_key_that_names_a_recording_is_on_the_page() -> None:
    names = {name for name, *_ in ROWS}
    assert len(names) == len(ROWS) > 20
    found = list(fields(SlamConfig, SlamConfig(), "slam."))
    assert {f.key for f in found if RECORDINGS.search(comments(f.struct).get(f.name, ""))} <= names


def test_page_matches_rows_of_the_papers_tables() -> None:
    """What the eleven sequences chose, 0010 and 0018 chose: the row of Tables 1-5 names each."""
    (tables,) = re.findall(r"^\| Tables 1-5 \| .*$", PAGE.read_text(), re.MULTILINE)
    chosen = [name.split(".")[-1] for name, _, data, _ in ROWS if "the eleven sequences" in data]
    assert len(chosen) == 7
    assert [name for name in chosen if f"`{name}`" not in tables] == []
