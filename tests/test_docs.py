"""The pages match the code: generated pages, and names in written pages."""

from __future__ import annotations

import html
import importlib
import inspect
import io
import re
import shutil
import subprocess
from collections.abc import Iterator, Mapping
from contextlib import redirect_stdout
from functools import cache
from pathlib import Path
from typing import Any

import msgspec
import pytest
import yaml

from birdslam.bench.simulation.odometry import OdometryNoise
from birdslam.perf.__main__ import benchmark_modules
from birdslam.runtime.cli.main import main
from birdslam.runtime.configuration import Configuration, ConfigurationError, load
from birdslam.runtime.fields import fields, stands_for
from birdslam.runtime.keys import GROUPS, KEYS
from birdslam.runtime.pages import configuration as configuration_page
from birdslam.runtime.pages.tables import comments
from birdslam.slam import SlamConfig
from tests.chromium import chromium, look

ROOT = Path(__file__).resolve().parent.parent
DOCS = ROOT / "docs"
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *DOCS.glob("*.md"), ROOT / "perf" / "README.md"]
PAGES += [ROOT / "deploy" / "README.md", ROOT / "CHANGELOG.md"]
FOLDERS = ("birdslam", "runtime", "perf", "docs", "tests", "configs", "deploy")


def named(name: str) -> Any:
    """The module, class, function or value of a dotted name. Raises where there is none."""
    parts = name.split(".")
    for end in range(len(parts), 0, -1):
        try:
            found: Any = importlib.import_module(".".join(parts[:end]))
        except ModuleNotFoundError:
            continue
        for part in parts[end:]:
            found = getattr(found, part)
        return found
    raise ModuleNotFoundError(name)


def rows(page: Path) -> Iterator[dict[str, str]]:
    """The rows of a page's tables, by the tables' heads."""
    head: list[str] = []
    for line in page.read_text().splitlines():
        cells = [cell.strip() for cell in line.strip("|").split(" | ")] if line.startswith("|") else []
        if not head or not cells:
            head = [cell.strip() for cell in line.strip("|").split("|")] if cells else []
        elif not set(line) <= set("|- "):
            yield dict(zip(head, (cell.strip("| ") for cell in cells), strict=False))


def in_the_code(row: dict[str, str]) -> list[str]:
    return [f"birdslam.{name}" for name in re.findall(r"`([\w.]+)`", row.get("in the code", ""))]


@pytest.mark.parametrize(("page", "names"), [("method.md", 40), ("road-users.md", 20)])
def test_every_name_of_the_page_is_in_the_code(page: str, names: int) -> None:
    found = [name for row in rows(DOCS / page) for name in in_the_code(row)]
    assert len(found) > names
    for name in found:
        assert named(name) is not None, name


def test_each_equation_is_where_the_page_says() -> None:
    told = {row["equation"]: in_the_code(row) for row in rows(DOCS / "method.md") if "equation" in row}
    assert list(told) == [f"Eq. {number}" for number in range(1, 9)]
    for equation, names in told.items():
        assert names, equation
        for name in names:
            assert re.search(rf"{re.escape(equation)}\b", inspect.getsource(named(name))), f"{equation} in {name}"


def test_every_estimate_of_a_vehicle_has_an_owner_an_equation_and_a_reader() -> None:
    """And each filter that has rows of vehicles is on the page."""
    estimates = [row for row in rows(DOCS / "road-users.md") if "estimate" in row]
    for row in estimates:
        assert len(in_the_code(row)) == 1, row
        assert all(row[column] for column in ("state and covariance", "measured by", "equation", "read by")), row
    owners = " ".join(in_the_code(row)[0] for row in estimates)
    with_rows = [path.stem for path in (ROOT / "birdslam").rglob("*.py") if "def keep_rows" in path.read_text()]
    assert {"user_filter", "ground_size_filter"} <= {*with_rows}
    assert all(f".{name}." in owners for name in with_rows if name != "track")


def test_the_method_page_has_every_table_and_section() -> None:
    told = list(rows(DOCS / "method.md"))
    assert [row["table"] for row in told if "table" in row] == [f"Table {number}" for number in range(1, 6)]
    sections = {row["section"].split(",")[0] for row in told if "section" in row}
    assert sections >= {"3", "3.1.1", "3.1.2", "3.1.3", "3.2", "3.3.1", "3.3.2", "4", "4.1", "4.2", "4.4", "4.4.5"}


def test_the_readme_is_one_page() -> None:
    text = (ROOT / "README.md").read_text()
    lines = text.splitlines()
    assert len(lines) <= 120
    assert len(text.split()) <= 900
    assert max(len(line) for line in lines if not line.startswith("|")) <= 120


def test_every_link_has_a_target() -> None:
    for page in PAGES:
        for target in re.findall(r"\]\(([^)#\s]+)(?:#[^)]*)?\)", page.read_text()):
            assert target.startswith("https://") or (page.parent / target).exists(), f"{page.name}: {target}"


def test_every_path_in_the_pages_exists() -> None:
    for page in PAGES:
        for path in re.findall(r"`([\w./-]+/[\w./-]*)`", page.read_text()):
            if path.split("/")[0] in FOLDERS and ".." not in path:
                assert (ROOT / path).exists(), f"{page.name}: {path}"


def test_every_module_file_in_the_pages_exists() -> None:
    files = {path.name for folder in FOLDERS for path in (ROOT / folder).rglob("*.py")} | {"setup.py"}
    for page in PAGES:
        for name in re.findall(r"`(\w+\.py)`", page.read_text()):
            assert name in files, f"{page}: {name}"


def test_every_key_in_the_pages_exists() -> None:
    keys = {field.key for field in fields(Configuration)} | set(KEYS)
    tables = {".".join(words[:end]) for key in keys for words in [key.split(".")] for end in range(1, len(words))}
    tops = {name.partition(".")[0] for name in tables}
    for page in PAGES:
        for name in re.findall(r"(?:`|--set )((?:\w+\.)+\w+)(?:`| =|=)", page.read_text()):
            if (
                name.partition(".")[0] in tops
                and name == name.lower()
                and not name.endswith((".py", ".md", ".toml", ".png"))
            ):
                of_any = re.sub(r"\.vehicles\.\w+\.", ".vehicles.NAME.", name)  # a row of the table of classes
                assert {name, of_any} & (keys | tables) or named(f"birdslam.{name}") is not None, f"{page.name}: {name}"


@pytest.mark.parametrize(("subject", "status"), [("x" * 72, 0), ("é" * 72, 0), ("x" * 73, 1)])
def test_long_commit_subject_is_refused(tmp_path: Path, subject: str, status: int) -> None:
    message = tmp_path / "message"
    message.write_text(f"# a comment of git, {'of whatever length, ' * 5}is no subject\n{subject}\n")
    done = subprocess.run([str(ROOT / ".ci" / "commit-subject"), str(message)], capture_output=True, text=True)
    assert done.returncode == status
    assert ("73 characters" in done.stderr) == bool(status)


def test_every_hook_is_local() -> None:
    hooks = yaml.safe_load((ROOT / ".pre-commit-config.yaml").read_text())
    assert [repository["repo"] for repository in hooks["repos"]] == ["local"]
    assert {hook["id"] for hook in hooks["repos"][0]["hooks"]} == {"ruff", "ruff-format", "mypy", "commit-subject"}


NESTED = ("evaluate", "map", "models", "demo-drive")  # commands that have commands
WORDS: list[tuple[str, ...]] = [(), *((word,) for word in NESTED)]


@cache
def help_of(*words: str) -> str:
    """What `birdslam WORDS --help` prints, on long lines."""
    with pytest.MonkeyPatch.context() as patch, redirect_stdout(io.StringIO()) as out:
        patch.setenv("COLUMNS", "400")
        with pytest.raises(SystemExit):
            main([*words, "--help"])
    return out.getvalue()


def test_every_command_in_the_pages_exists() -> None:
    """`birdslam WORD`, `python -m perf WORD` and `make WORD`, in the words of the programs."""
    commands = {words: set(re.findall(r"^    ([a-z][a-z-]+)", help_of(*words), re.MULTILINE)) for words in WORDS}
    benchmarks = benchmark_modules()
    targets = set(re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
    for page in PAGES:
        text = page.read_text()
        for first, second in re.findall(r"(?:^    |`|bin/)birdslam ([a-z-]+)(?: ([a-z-]+))?", text, re.MULTILINE):
            assert first in commands[()], f"{page}: birdslam {first}"
            if first in NESTED and second:
                assert second in commands[(first,)], f"{page}: birdslam {first} {second}"
        for word in re.findall(r"python -m perf(?: |\.[a-z_]+\.)([a-z_]+)", text):
            assert word in benchmarks, f"{page}: python -m perf {word}"
        for word in re.findall(r"`make ([a-z][a-z-]*)`", text):
            assert word in targets, f"{page}: make {word}"


def test_every_option_in_the_pages_exists() -> None:
    for page in PAGES:
        text = page.read_text().replace("\\\n", " ")
        shown = re.findall(r"^    (?:\.venv/bin/)?birdslam ([^#\n]+)", text, re.MULTILINE)
        for line in (*shown, *re.findall(r"`birdslam ([^`]+)`", text)):
            first, *others = line.split()
            words = (first, *others[:1]) if first in NESTED else (first,)
            for option in re.findall(r"(?<=\s)--[a-z-]+", line):
                assert option in help_of(*words), f"{page}: birdslam {' '.join(words)} {option}"


def test_the_page_of_keys_is_up_to_date(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["configuration"]) == 0
    assert capsys.readouterr().out == (DOCS / "configuration.md").read_text(), (
        "birdslam configuration > docs/configuration.md"
    )


def test_the_page_of_sources_is_up_to_date(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["sources"]) == 0
    reference = capsys.readouterr().out
    assert (DOCS / "sources.md").read_text().endswith(f"\n{reference}"), "its end is the output of `birdslam sources`"


def test_every_setting_in_the_pages_is_a_configuration_key() -> None:
    known = {field.key for field in fields(Configuration)}
    for page in PAGES:
        text = page.read_text()
        for name in re.findall(r"--(?:set|sweep) ([a-z_.]+)=", text):
            assert name in known, f"{page.name}: {name}"


def leaves(tree: Mapping[str, Any], prefix: str = "") -> Iterator[str]:
    """The keys of nested tables: {"a": {"b": 1}} has a.b."""
    for name, value in tree.items():
        if isinstance(value, Mapping):
            yield from leaves(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}"


def test_every_field_has_a_meaning() -> None:
    without = [
        field.key for field in fields(Configuration) if len(comments(field.struct).get(field.name, "").split()) < 2
    ]
    assert without == [], "a comment beside the field says what it means"


def test_the_fields_are_those_of_the_default_configuration() -> None:
    """By another way: the default configuration as plain data."""
    there = set(leaves(msgspec.to_builtins(Configuration())))
    told = {field.key for field in fields(Configuration)}
    empty = {"camera", *(f"models.{role}" for role in ("detector", "segmenter", "depth", "multitask", "pointnet"))}
    assert {key for key in there if not any(stands_for(name, key) for name in told)} == empty
    assert {"camera.height_m", "models.depth.path"} <= told


def test_the_page_states_limits_that_hold() -> None:
    rows = {row.key: row for group in GROUPS for row in configuration_page.rows(group)}
    assert rows["recording.jpeg_quality"].may_be == "integer >= 1 and <= 100"
    with pytest.raises(ConfigurationError, match="jpeg_quality"):
        load(None, {"recording.jpeg_quality": 101})
    assert rows["method"].may_be == '`"birdslam"`, `"paper"`'
    assert rows["source.camera_timeout_s"].unit == "s"
    assert rows["realtime.NODE.priority"].default == "capture `30`, perceive `10`, optimize `20`"
    assert rows["perceive.schedule.ROLE.hz"].default == "none"


class Base(msgspec.Struct):
    """Has fields."""

    first: int = 1  # of the base
    # Told above,
    # in two lines
    second: float = 2.0


class Derived(Base):
    """A comment on a field's line has priority over one above it."""

    # A heading
    third: dict[str, int] = msgspec.field(
        default_factory=dict  # over several lines
    )
    fourth: str = "#"
    first: int = 3  # again


def test_comments_of_fields() -> None:
    assert comments(Base) == {"first": "of the base", "second": "Told above, in two lines"}
    assert comments(Derived) == {"first": "again", "second": "Told above, in two lines", "third": "over several lines"}


SCRIPT = Path(__file__).resolve().parent.parent / "docs" / "site" / "iframe-worker.js"
PAGE = """<!doctype html><html><head><meta charset="utf-8"><script src="iframe-worker.js"></script></head><body><script>
const worker = new Worker("worker.js");
worker.addEventListener("message", ({data}) => document.documentElement.dataset.heard = JSON.stringify(data));
worker.postMessage({type: 0, words: ["one", "two"]});
</script></body></html>"""
WORKER = """addEventListener("message", async ({data}) => {
  postMessage({words: data.words.length, inFrame: self !== parent});
});"""


@pytest.mark.slow
@pytest.mark.processes
@pytest.mark.skipif(chromium() is None, reason="no Chromium")
def test_a_page_from_disk_has_a_worker_that_answers(tmp_path: Path) -> None:
    shutil.copy(SCRIPT, tmp_path)
    (tmp_path / "page.html").write_text(PAGE)
    (tmp_path / "worker.js").write_text(WORKER)
    seen = look((tmp_path / "page.html").as_uri(), tmp_path / "page.png")
    assert seen.console == []
    assert html.unescape(seen.said["heard"]) == '{"words":2,"inFrame":true}'


CONSTANTS_PAGE = Path(__file__).parent.parent / "docs" / "constants.md"
ROWS = re.findall(r"^\| `([\w.]+)` \| ([^|]+) \| ([^|]+) \| ([^|]+) \|$", CONSTANTS_PAGE.read_text(), re.MULTILINE)
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
    (tables,) = re.findall(r"^\| Tables 1-5 \| .*$", CONSTANTS_PAGE.read_text(), re.MULTILINE)
    chosen = [name.split(".")[-1] for name, _, data, _ in ROWS if "the eleven sequences" in data]
    assert len(chosen) == 7
    assert [name for name in chosen if f"`{name}`" not in tables] == []
