"""The command line: errors of one line with exit status 2, progress, and completion."""

from __future__ import annotations

import io
import os
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from birdslam.lanes.amodal.lanes import BOUNDARY, ROAD, LanesConfig
from birdslam.perception import ModelSpec
from birdslam.perception.completion import SHIPPED, GridCompletion
from birdslam.perception.manifest import ModelError
from birdslam.runtime.cli.commands import COMMANDS, Command, parse
from birdslam.runtime.cli.main import main
from birdslam.runtime.configuration import ConfigurationError
from birdslam.runtime.options import configuration_of
from birdslam.runtime.progress import Progress, time_to_go, with_progress
from tests.tiny_networks import echo

NOWHERE = "kitti:/nowhere/at/all"


def configuration(*arguments: str):
    return configuration_of(parse(arguments))


def test_no_map_overrides_the_map_of_the_configuration_file(tmp_path: Path) -> None:
    (tmp_path / "car.toml").write_text('[results]\nmap = "road.map"\n')
    arguments = ["run", str(tmp_path / "car.toml"), "--source", "v4l2:/dev/video0"]
    assert configuration(*arguments).maps_live
    assert not configuration(*arguments, "--no-map").maps_live


def test_version_is_printed(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as end:
        main(["--version"])
    assert end.value.code == 0
    assert capsys.readouterr().out.startswith("birdslam ")


@pytest.mark.parametrize("command", COMMANDS, ids=lambda command: command.words)
def test_every_command_of_the_table_exists(command: Command, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as end:
        main([*command.words.split(), "--help"])
    assert end.value.code == 0
    assert capsys.readouterr().out.startswith(f"usage: birdslam {command.words} [-h]")


@pytest.mark.processes
def test_help_imports_no_heavy_library(tmp_path: Path) -> None:
    code = "import sys; from birdslam.runtime.cli.commands import parse\ntry: parse(['--help'])\n"
    code += "except SystemExit: assert not {'numpy', 'cv2', 'zenoh', 'msgspec'} & set(sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], cwd=tmp_path, check=False).returncode == 0


@pytest.mark.parametrize("arguments", [[], ["fly"], ["run", "--pace", "3"], ["evaluate", "odometry"]])
def test_a_wrong_command_shows_the_usage(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as end:
        main(arguments)
    assert end.value.code == 2
    assert "usage: birdslam" in capsys.readouterr().err


def test_options_override_the_file(tmp_path: Path) -> None:
    path = tmp_path / "a.toml"
    path.write_text(
        'vehicle = "van"\noutput = "there"\n[source]\nrate = 3\n[models.detector]\npath = "old.onnx"\nevery = 2\n'
    )
    made = configuration(
        "run",
        str(path),
        *("--source", NOWHERE, "--rate", "max", "--stride", "2", "--output", "here", "--vehicle", "bus"),
        *("--model", "detector=a.onnx", "--model", "segmenter=b.onnx"),
        *("--set", "perceive.deadline_ms=15", "--set", "slam.graph.ego_nodes=6"),
    )
    assert (made.source.uri, made.source.rate, made.source.stride) == (NOWHERE, "max", 2)
    assert (made.vehicle, made.output, made.perceive.deadline_ms) == ("bus", "here", 15.0)
    assert made.slam.graph.ego_nodes == 6
    assert made.models.given() == {"detector": ModelSpec("a.onnx", every=2), "segmenter": ModelSpec("b.onnx")}
    assert configuration("run", str(path)).source.rate == 3.0
    assert configuration("run", "--rate", "33").source.rate == 33.0
    assert configuration("evaluate", "odometry", "00", "--config", str(path)).vehicle == "van"


def test_model_none_disables_the_shipped_network() -> None:
    assert configuration("run", "--model", "none").models.in_use() == {}
    one = configuration("run", "--model", "none", "--model", "detector=a.onnx").models
    assert one.in_use() == {"detector": ModelSpec("a.onnx")}


def test_a_model_needs_a_role() -> None:
    with pytest.raises(ConfigurationError, match=r"--model a\.onnx: expected ROLE=PATH"):
        configuration("run", "--model", "a.onnx")


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["run"], "no source"),
        (["run", "--source", NOWHERE], "/nowhere/at/all: no such directory"),
        (["run", "--source", "radar:1"], "radar:1: unknown source 'radar:'; choose from demo"),
        (["run", "missing.toml"], "missing.toml: No such file"),
        (["run", "--source", NOWHERE, "--rate", "fast"], "source.rate"),
        (["run", "--source", NOWHERE, "--set", "slam.colour=1"], "slam.colour: no such key"),
        (["run", "--source", NOWHERE, "--set", "slam.colour"], "--set slam.colour: expected KEY=VALUE"),
        (["run", "--source", NOWHERE, "--model", "nose=a.onnx"], "models.nose: no such key"),
        (["run", "--source", NOWHERE, "--camera", "missing.toml"], "camera file missing.toml"),
        (["run", "--source", NOWHERE, "--vehicle", "a b"], "vehicle"),
        (["run", "--source", "v4l2:/dev/video77"], "v4l2:/dev/video77: a live camera needs a camera file"),
        (["evaluate", "odometry", "/nowhere/at/all"], "/nowhere/at/all: no such directory"),
        (["evaluate", "odometry", NOWHERE, "--set", "source.loop=true"], "source.loop"),
        (["listen", "--vehicle", "a/b"], "vehicle"),
    ],
)
def test_a_user_error_is_one_line(arguments: list[str], said: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(arguments) == 2
    out, err = capsys.readouterr()
    assert err.count("\n") == 1
    assert err.startswith("birdslam: ")
    assert said in err
    assert out == ""


def test_listen_without_a_vehicle_ends_on_a_signal(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["listen", "--vehicle", "nobody", "--runtime-dir", str(tmp_path), "--timeout", "0.2"]) == 1
    assert "no estimate of vehicle 'nobody' in 0.2 s" in capsys.readouterr().err


@pytest.mark.parametrize(("text", "complaint"), [("14", "FIRST:END"), ("a:", "FIRST:END"), ("999:", "fewer than two")])
def test_invalid_frames_to_compare_are_a_one_line_error(
    text: str, complaint: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["evaluate", "odometry", "demo", "--model", "none", "--frames", text, "--output", str(tmp_path)]
    assert main(arguments if text != "999:" else [*arguments, "--stride", "50"]) == 2
    assert complaint in capsys.readouterr().err


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        (("--source", "demo", "--camera", "CAMERA", "--height", "1.4"), "the camera file has a height already"),
        (("--source", "v4l2:/dev/video9", "--height", "1.4"), "is live and has no first pass"),
        (("--source", "video:FILM", "--height", "1.4", "--fov", "3"), "--fov 3: expected a field of view"),
        (("--source", "video:FILM", "--height", "1.4", "--fov-sigma", "5"), "--fov-sigma: needs --fov"),
        (("--source", "video:FILM", "--height", "1.4", "--fov", "60", "--fov-sigma", "0"), "--fov-sigma 0: expected"),
    ],
)
def test_an_impossible_first_pass_is_rejected(
    options: tuple[str, ...], reason: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    camera, film = tmp_path / "camera.toml", tmp_path / "film.avi"
    numbers = {
        "width_px": 64,
        "height_px": 48,
        "fx_px": 50.0,
        "fy_px": 50.0,
        "cx_px": 32.0,
        "cy_px": 24.0,
        "height_m": 1.4,
    }
    camera.write_text("".join(f"{key} = {value}\n" for key, value in numbers.items()))
    writer = cv2.VideoWriter(str(film), cv2.VideoWriter.fourcc(*"MJPG"), 25.0, (64, 48))
    writer.write(np.zeros((48, 64, 3), np.uint8))
    writer.release()
    places = {"CAMERA": str(camera), "video:FILM": f"video:{film}"}
    given = [places.get(word, word) for word in options]
    assert main(["run", *given, "--output", str(tmp_path / "out")]) == 2
    assert reason in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "source"),
    [
        (["video:film.mp4"], "video:film.mp4"),
        (["film.mp4"], "video:film.mp4"),
        (["run", "film.mp4", "--stride", "2"], "video:film.mp4"),
        (["run", "car.toml", "film.mp4"], "video:film.mp4"),
        (["drive.bag"], "rosbag:drive.bag"),
        (["parts"], "video:parts"),
        (["demo"], "demo"),
    ],
)
def test_a_path_is_a_source_of_its_kind(
    arguments: list[str], source: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("film.mp4", "drive.bag", "car.toml"):
        (tmp_path / name).touch()
    (tmp_path / "parts").mkdir()
    options = parse(arguments)
    assert options.command == "run"
    assert configuration_of(options).source.uri == source


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["film.mp4"], "film.mp4: there is no such file"),
        (["run", "notes.txt"], "notes.txt: not recognized; name its kind: demo"),
        (["run", "demo", "demo:there"], "demo:there: there is a source already, demo"),
        (["run", "demo", "--source", "demo:there"], "demo: there is a source already, demo:there"),
        (["run", "a.toml", "b.toml"], "b.toml: there is a configuration file already, a.toml"),
    ],
)
def test_an_unknown_path_is_rejected(
    arguments: list[str],
    message: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "notes.txt").touch()
    assert main(arguments) == 2
    assert message in capsys.readouterr().err


@pytest.mark.processes
@pytest.mark.parametrize(
    ("line", "offered"),
    [
        ("birdslam cal", "calibrate "),
        ("birdslam run --hei", "--height "),
        ("birdslam map exp", "export "),
        ("birdslam run --kind ", "dashcam phone"),
    ],
)
def test_the_shell_completes(line: str, offered: str, tmp_path: Path) -> None:
    pytest.importorskip("argcomplete")
    answer = tmp_path / "answer"
    asked = {"COMP_LINE": line, "COMP_POINT": str(len(line)), "_ARGCOMPLETE": "1", "_ARGCOMPLETE_IFS": " "}
    asked["_ARGCOMPLETE_STDOUT_FILENAME"] = str(answer)
    command = [sys.executable, "-m", "birdslam.runtime.cli.main"]
    subprocess.run(command, env={**os.environ, **asked}, check=False, timeout=60)
    assert answer.read_text().split() == offered.split()


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


class Clock:
    def __init__(self) -> None:
        self.now_s = 100.0

    def __call__(self) -> float:
        return self.now_s


@pytest.mark.parametrize(
    ("seconds", "text"), [(0.2, "0:00"), (7.4, "0:07"), (750.0, "12:30"), (3750.0, "1:02:30"), (-3.0, "0:00")]
)
def test_times_to_go(seconds: float, text: str) -> None:
    assert time_to_go(seconds) == text


def test_remaining_time_ignores_the_first_item() -> None:
    clock, stream = Clock(), Terminal()
    with Progress("drive", 11, stream=stream, clock=clock) as progress:
        clock.now_s += 60.0  # loading
        progress.advance()
        assert progress.line(clock.now_s) == "drive: 1 of 11 frames"
        clock.now_s += 4.0
        progress.advance(2)
        assert progress.line(clock.now_s) == "drive: 3 of 11 frames, 0:16 to go"
    assert stream.getvalue().endswith("\r\x1b[K")
    assert "\n" not in stream.getvalue()


def test_a_second_pass_and_an_unknown_end() -> None:
    clock = Clock()
    progress = Progress("replay", None, "MB", 1e6, stream=Terminal(), clock=clock)
    progress.reach(1_500_000)
    clock.now_s += 1.0
    progress.reach(2_500_000)
    assert progress.line(clock.now_s) == "replay: 2.5 MB"
    progress.total = 4_500_000
    assert progress.line(clock.now_s) == "replay: 2.5 of 4.5 MB, 0:02 to go"
    progress.reach(500_000)
    assert progress.line(clock.now_s) == "replay: 0.5 of 4.5 MB"


def test_without_terminal_there_is_one_line_per_minute() -> None:
    clock, stream = Clock(), io.StringIO()
    with Progress("drive", 1000, stream=stream, clock=clock) as progress:
        for _ in range(150):
            clock.now_s += 1.0
            progress.advance()
    assert stream.getvalue() == "drive: 60 of 1000 frames, 15:40 to go\ndrive: 120 of 1000 frames, 14:40 to go\n"


def test_items_pass_through(capsys: pytest.CaptureFixture[str]) -> None:
    assert list(with_progress(iter("abc"), "letters", 3)) == ["a", "b", "c"]
    assert capsys.readouterr().err == ""


SHAPE = LanesConfig().shape


def test_a_network_of_the_right_shape_is_taken(tmp_path: Path) -> None:
    complete = GridCompletion((16, 8), echo(tmp_path / "echo.onnx", (1, 2, 16, 8)))
    grids = np.random.default_rng(0).random((2, 16, 8), dtype=np.float32)
    np.testing.assert_array_equal(complete(grids), grids)


def test_unsuitable_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ModelError, match=r"none\.onnx: the network can't be read"):
        GridCompletion(SHAPE, tmp_path / "none.onnx")
    (tmp_path / "text.onnx").write_text("no network")
    with pytest.raises(ModelError, match=r"text\.onnx: onnxruntime"):
        GridCompletion(SHAPE, tmp_path / "text.onnx")
    with pytest.raises(ModelError, match=r"inputs have shapes \[\[1, 2, 16, 8\]\], grids need \[1, 2, 128, 128\]"):
        GridCompletion(SHAPE, echo(tmp_path / "small.onnx", (1, 2, 16, 8)))


@pytest.mark.skipif(not SHIPPED.is_file(), reason="built without the lane network")
def test_shipped_network_joins_a_hidden_line() -> None:
    grids = np.zeros((2, *SHAPE), dtype=np.float32)
    grids[ROAD, :92, 44:84] = 1.0  # 10 m wide, seen up to 15 m ahead
    grids[BOUNDARY, :92, 63:65] = 1.0
    hidden = slice(40, 52)  # 3 m of it
    grids[:, hidden, 50:84] = 0.0
    complete = GridCompletion(SHAPE)
    out = complete(grids)
    assert out.shape == grids.shape
    assert out.min() >= 0.0
    assert out.max() <= 1.0
    assert np.mean(out[ROAD, hidden, 50:80] > 0.5) > 0.8
    assert np.mean(out[BOUNDARY, hidden, 62:66].max(axis=1) > 0.5) > 0.8
    assert np.mean(out[BOUNDARY, hidden, 70:80] > 0.5) < 0.05
    np.testing.assert_array_equal(complete(grids), out)
