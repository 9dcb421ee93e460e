"""The table of sources: all commands use it, and a new source is one file and one entry."""

from __future__ import annotations

import ast
from pathlib import Path

import cv2
import numpy as np
import pytest

from birdslam.geometry.camera import Camera
from birdslam.runtime import schemes as table
from birdslam.runtime.batch.drive import DRIVES, Job, run_drive
from birdslam.runtime.batch.drives import find_drives, sweep, tasks
from birdslam.runtime.cli.main import main
from birdslam.runtime.configuration import ConfigurationError, SourceConfig, load, without_passwords
from birdslam.runtime.nodes.cameras import LiveCamera
from birdslam.runtime.nodes.sources import open_source
from birdslam.sources import schemes
from birdslam.sources.camera_file import camera_text
from birdslam.sources.opening import open_recording
from birdslam.sources.recording import DatasetError, Recording
from birdslam.sources.schemes import Scheme

ROOT = Path(__file__).resolve().parent.parent
EVERY = pytest.mark.parametrize("scheme", table.all_schemes(), ids=lambda scheme: scheme.name)
NO_NETWORK = ("--model", "none")

# --- the entries ---


def test_a_folder_of_bags_is_not_taken_for_films(tmp_path: Path) -> None:
    """A bag of ROS 2 without its metadata.yaml, or several of ROS 1."""
    for name in ("a.bag", "b.bag", "notes.txt"):
        (tmp_path / name).touch()
    with pytest.raises(ValueError, match=r"name one of its bags: a\.bag, b\.bag$"):
        schemes.uri_of(str(tmp_path), table.all_schemes())


@EVERY
def test_an_entry_is_written_as_it_is_read(scheme: Scheme) -> None:
    for text in scheme.written:
        assert schemes.parse(text, table.all_schemes())[0] is scheme
        assert schemes.scheme_of(text, table.all_schemes()) is scheme
    assert table.is_live(f"{scheme.name}:x") == scheme.live
    assert [other.name for other in table.all_schemes()].count(scheme.name) == 1


@EVERY
def test_a_schemes_camera_facts_are_those_of_its_class(scheme: Scheme) -> None:
    kind = scheme.load()
    if scheme.live:
        assert kind.live
        assert issubclass(kind, LiveCamera) == (scheme.camera == "nothing")  # of a device or a stream
    else:
        assert issubclass(kind, Recording)
        assert (kind.own_lens.__func__ is not Recording.own_lens.__func__) == (scheme.camera == "intrinsics")
        assert kind.frame_size.__func__ is not Recording.frame_size.__func__ or scheme.camera == "calibration"


def test_every_option_is_a_key_of_a_source() -> None:
    taken = {option for scheme in table.all_schemes() for option in scheme.options}
    assert {key for scheme in table.all_schemes() for key in scheme.refused} < taken
    assert taken | {"uri", "rate", "frames"} == set(SourceConfig.__struct_fields__)


def test_each_table_names_classes_of_its_own_layer() -> None:
    """An opener is named in a string, which the walls of test_architecture.py do not see."""
    assert all(scheme.opener.startswith("birdslam.sources.") for scheme in schemes.RECORDED)
    runtime = {scheme.opener.rpartition(".")[0] for scheme in table.OF_THE_RUNTIME}
    assert runtime == {"birdslam.runtime.recording", "birdslam.runtime.nodes", "birdslam.runtime.ros"}


def compared_with(node: ast.AST) -> set[str]:
    """The texts with which something is compared: x == "a", x in ("a", "b"), x.startswith("a:")."""
    parts: list[ast.expr] = []
    if isinstance(node, ast.Compare):
        parts = node.comparators + [node.left] * isinstance(node.ops[0], ast.Eq | ast.NotEq)
    elif isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.func.attr == "startswith":
        parts = node.args
    constants = [text.value for part in parts for text in ast.walk(part) if isinstance(text, ast.Constant)]
    return {text.rstrip(":") for text in constants if isinstance(text, str)}


def test_only_the_table_compares_scheme_names() -> None:
    names = {scheme.name for scheme in table.all_schemes()}
    found = [
        f"{path.relative_to(ROOT)}: {ast.unparse(node)}"
        for folder in ("birdslam", "runtime")
        for path in sorted((ROOT / folder).rglob("*.py"))
        if any(f'"{name}"' in (text := path.read_text()) for name in names)
        for node in ast.walk(ast.parse(text))
        if compared_with(node) & names
    ]
    assert found == []


TOY_FILE = '''
"""Toy drives: one numpy file of images."""

import numpy as np

from birdslam.geometry.camera import Camera
from birdslam.sources.recording import RecordedFrame, Recording


class ToyRecording(Recording):
    def __init__(self, path, camera=None, stride=1):
        self._images = np.load(path)[::stride]
        self.name, self.rate_hz = path.stem, 10.0 / stride
        self.camera = camera or Camera(64, 32, 50.0, 50.0, 32.0, 16.0, 1.5)

    def __len__(self):
        return len(self._images)

    def frames(self, start=0):
        for index, image in enumerate(self._images[start:], start):
            yield RecordedFrame(index, round(index * 1e9 / self.rate_hz), image)
'''
TOY = Scheme(
    name="toy",
    written=("toy:FILE",),
    what="a toy",
    opener="toy_source:ToyRecording",
    camera="calibration",
    clock="frame rate",
    refused=("topics",),
    suffixes=(".npy",),
)


@pytest.fixture
def toy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A drive along a random wall, of a source that the table has since this test."""
    (tmp_path / "toy_source.py").write_text(TOY_FILE)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(schemes, "RECORDED", (*schemes.RECORDED, TOY))
    wall = cv2.GaussianBlur(np.random.default_rng(3).integers(0, 256, (64, 80), dtype=np.uint8), (0, 0), 1.0)
    path = tmp_path / "drive.npy"
    np.save(path, np.stack([wall[16:48, 3 * number : 3 * number + 64] for number in range(4)]))
    return path


def test_a_toy_source_opens_in_python_and_for_a_run(toy: Path) -> None:
    assert len(open_recording(f"toy:{toy}")) == 4
    config = toy.with_name("run.toml")
    config.write_text(f'[source]\nuri = "toy:{toy.name}"\nstride = 2\n')  # relative to the file
    configuration = load(config)
    assert not configuration.live
    source = open_source(configuration)
    assert [frame.t_source_ns for frame in source.frames()] == [0, 200_000_000]


def test_evaluate_and_calibrate_and_batch_take_a_toy_source(toy: Path, capsys: pytest.CaptureFixture[str]) -> None:
    output = toy.parent / "out"
    assert main(["evaluate", "odometry", f"toy:{toy}", "--output", str(output), *NO_NETWORK]) == 0
    assert (output / "drive" / "ego.kitti.txt").is_file()
    lanes = ["evaluate", "lanes", f"toy:{toy}", "--output", str(toy.parent / "lanes"), *NO_NETWORK]
    assert main(lanes) == 0
    assert (toy.parent / "lanes" / "lanes_drive_3.png").is_file()
    assert main(["calibrate", f"toy:{toy}", "--output", str(toy.parent / "camera.toml"), *NO_NETWORK]) == 2
    assert f"toy:{toy}: too little motion" in capsys.readouterr().err
    (task,) = tasks(find_drives([str(toy)]), sweep([]), None, {"models.shipped": False}, [])
    assert task.uri == f"toy:{toy}"
    run_drive(Job(task, str(toy.parent / "batch")), lambda *at: None)
    assert (toy.parent / "batch" / DRIVES / "drive" / "summary.json").is_file()


def test_help_the_page_and_messages_name_a_toy_source(toy: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for words in ("--help",), ("run", "--help"), ("calibrate", "--help"):
        with pytest.raises(SystemExit):
            main([*words])
        assert "toy:FILE" in capsys.readouterr().out
    main(["sources"])
    assert "| `toy:FILE` | a toy | recorded | calibration | frame rate |" in capsys.readouterr().out
    for door in (["run", "--source", "toi:x"], ["evaluate", "odometry", "toi:x"], ["calibrate", "toi:x"]):
        assert main([*door, "--output", str(toy.parent / "out")]) == 2
        assert "unknown source 'toi:'; choose from demo, " in (said := capsys.readouterr().err)
        assert "toy:FILE" in said
    with pytest.raises(DatasetError, match="topics need a ROS bag"):
        open_source(load(None, {"source.uri": f"toy:{toy}", "source.topics.image": "/a"}))


LIVE_FILE = '''
"""A toy camera."""

from birdslam.sources.recording import RecordedFrame


class ToyCamera:
    live, rate_hz = True, 20.0

    def __init__(self, configuration, must_open):
        source = configuration.source
        self.name, self.camera, self.left = source.uri, configuration.camera, source.frames

    def frames(self):
        yield from (RecordedFrame(index, index, None, "dark") for index in range(self.left))

    def resume(self, frame_id, t_source_ns):
        pass

    def close(self):
        pass
'''
LIVE = Scheme(
    name="eye",
    written=("eye:HOST",),
    what="a toy camera",
    opener="toy_camera:ToyCamera",
    camera="nothing",
    clock="this computer's",
    address="network",
    live=True,
    options=table.OF_A_CAMERA,
    refused=table.OF_RECORDINGS,
)


def test_a_toy_camera_is_one_file_and_one_entry_too(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "toy_camera.py").write_text(LIVE_FILE)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(table, "OF_THE_RUNTIME", (*table.OF_THE_RUNTIME, LIVE))
    (tmp_path / "camera.toml").write_text(camera_text(Camera(64, 32, 50.0, 50.0, 32.0, 16.0, 1.5), ()))
    overrides = {"source.uri": "eye:me:secret@host", "source.frames": 3}
    with pytest.raises(ConfigurationError, match="a live camera needs a camera file"):
        open_source(load(None, overrides))
    configuration = load(None, overrides | {"camera": str(tmp_path / "camera.toml")})
    assert configuration.live
    assert without_passwords(configuration).source.uri == "eye:host"
    assert len(list(open_source(configuration).frames())) == 3
    with pytest.raises(ConfigurationError, match="eye:me:secret@host: an odometry file is for recordings"):
        open_source(load(None, overrides | {"camera": str(tmp_path / "camera.toml"), "source.odometry": "x"}))
    with pytest.raises(ConfigurationError, match="is a live camera; a batch needs recordings"):
        find_drives(["eye:host"])
    for door in (["evaluate", "odometry", "eye:host"], ["calibrate", "eye:host"]):
        assert main([*door, "--output", str(tmp_path / "out")]) == 2
        assert "eye:host: is a live camera; expected one of demo, " in capsys.readouterr().err


@pytest.mark.parametrize(
    ("uri", "kept"),
    [
        ("rtsp://me:secret@host/path", "rtsp://host/path"),
        ("rtsp:me:secret@host/path", "rtsp:host/path"),
        ("rosbag:s3://me:secret@store/drive.bag", "rosbag:s3://store/drive.bag"),
        ("video:/films/a@b.mp4", "video:/films/a@b.mp4"),
        ("demo", "demo"),
    ],
)
def test_no_password_is_kept(uri: str, kept: str) -> None:
    assert without_passwords(load(None, {"source.uri": uri})).source.uri == kept
