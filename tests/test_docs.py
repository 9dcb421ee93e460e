"""The pages are what the code says: those that commands write, and what those by hand name."""

from __future__ import annotations

from pathlib import Path

import msgspec
import pytest

from birdslam.runtime.cli import configuration_page
from birdslam.runtime.cli.main import main
from birdslam.runtime.cli.pages import comments
from birdslam.runtime.configuration import Configuration, ConfigurationError, load

ROOT = Path(__file__).resolve().parent.parent
DOCS = ROOT / "docs"


def test_the_page_of_keys_is_up_to_date(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["configuration"]) == 0
    assert capsys.readouterr().out == (DOCS / "configuration.md").read_text(), (
        "birdslam configuration > docs/configuration.md"
    )


def test_every_key_has_a_meaning() -> None:
    without = [key.key for table in configuration_page.sections() for key in table.keys if len(key.meaning.split()) < 2]
    assert without == [], "a comment beside the field says what it means"


def test_every_key_of_the_code_is_on_the_page() -> None:
    """By another way than the page's: the default configuration as plain data."""

    def keys(tree: object, prefix: str) -> set[str]:
        if not isinstance(tree, dict):
            return {prefix}
        return {key for name, value in tree.items() for key in keys(value, f"{prefix}.{name}".lstrip("."))}

    told = {key.key for table in configuration_page.sections() for key in table.keys}
    tables = {table.name for table in configuration_page.sections()}
    there = keys(msgspec.to_builtins(Configuration()), "")
    for name in Configuration().slam.frontend.localisation.vehicles:
        told |= {key.replace(".NAME.", f".{name}.") for key in told}
    assert there - told - tables == set()
    assert "camera.height_m" in told
    assert "models.depth.path" in told


def test_the_page_states_limits_that_hold() -> None:
    rows = {key.key: key for table in configuration_page.sections() for key in table.keys}
    assert rows["recording.jpeg_quality"].may_be == "integer >= 1 and <= 100"
    with pytest.raises(ConfigurationError, match="jpeg_quality"):
        load(None, {"recording.jpeg_quality": 101})
    assert rows["slam.weights.mode"].may_be == '`"measured"`, `"paper"`'
    assert rows["runtime.beat_s"].unit == "s"
    assert rows["realtime.optimize.priority"].default == "`20`"


class Base(msgspec.Struct):
    """With fields of its own."""

    first: int = 1  # of the base
    # Told above,
    # in two lines
    second: float = 2.0


class Derived(Base):
    """A field's own line goes before what stands above it."""

    # A heading
    third: dict[str, int] = msgspec.field(
        default_factory=dict,  # over several lines
    )
    fourth: str = "#"
    first: int = 3  # again


def test_comments_of_fields() -> None:
    assert comments(Base) == {"first": "of the base", "second": "Told above, in two lines"}
    assert comments(Derived) == {
        "first": "again",
        "second": "Told above, in two lines",
        "third": "over several lines",
    }
