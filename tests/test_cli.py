"""The command line: a user error is one line on standard error and exit status 2."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from birdslam.perception import ModelSpec
from birdslam.runtime.cli.commands import COMMANDS, Command, parse
from birdslam.runtime.cli.main import main
from birdslam.runtime.configuration import ConfigurationError
from birdslam.runtime.options import configuration_of

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
    """It does not import the libraries for computation."""
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
