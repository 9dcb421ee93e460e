"""`birdslam batch`: finding drives, one report of all, and resuming after an abort."""

from __future__ import annotations

import csv
import os
import signal
import subprocess
import sys
import threading
from pathlib import Path

import cv2
import msgspec
import numpy as np
import pytest

from birdslam.outputs import bev_picture
from birdslam.runtime.batch import drive as driving
from birdslam.runtime.batch import report
from birdslam.runtime.batch.drive import DRIVES, DriveResult, Failure, Job, done, failure_file, run_drive
from birdslam.runtime.batch.drives import Task, find_drives, sweep, tasks
from birdslam.runtime.batch.fetch import local_copy
from birdslam.runtime.batch.local import run_local
from birdslam.runtime.batch.report import write_report
from birdslam.runtime.cli.main import main
from birdslam.runtime.configuration import ConfigurationError
from birdslam.sources.recording import DatasetError

P0 = "50 0 32 0 0 50 16 0 0 0 1 0"
PLAIN = {"models.shipped": False}  # the ego alone: no network takes a second to load


def kitti(folder: Path, frames: int = 4, truth: bool = False) -> Path:
    """A drive along a random wall."""
    wall = cv2.GaussianBlur(
        np.random.default_rng(3).integers(0, 256, (64, 64 + 3 * frames), dtype=np.uint8), (0, 0), 1.0
    )
    (folder / "image_0").mkdir(parents=True)
    for number in range(frames):
        cv2.imwrite(str(folder / "image_0" / f"{number:06d}.png"), wall[16:48, 3 * number : 3 * number + 64])
    (folder / "calib.txt").write_text(f"P0: {P0}\n")
    if truth:
        poses = folder.parent.parent / "poses"
        poses.mkdir(exist_ok=True)
        rows = [f"1 0 0 {0.1 * n} 0 1 0 0 0 0 1 0" for n in range(frames)]
        (poses / f"{folder.name}.txt").write_text("\n".join(rows) + "\n")
    return folder


def made(places: list[Path], settings: tuple[str, ...] = ()) -> list[Task]:
    return tasks(find_drives([str(p) for p in places]), sweep(settings), None, PLAIN, [])


def contents(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def test_every_kind_of_drive_is_recognised_by_its_files(tmp_path: Path) -> None:
    kitti(tmp_path / "sequences" / "00", 1)
    kitti(tmp_path / "sequences" / "01", 1)
    (tmp_path / "bag").mkdir()
    (tmp_path / "bag" / "metadata.yaml").touch()
    for name in ("a.bag", "a.db3", "a.MP4"):
        (tmp_path / name).touch()
    (tmp_path / "ros.mcap").write_bytes(b"\x89MCAP0\r\n\x01" + (12).to_bytes(8, "little") + b"\4\0\0\0ros2\0\0\0\0")
    (tmp_path / "own.mcap").write_bytes(b"\x89MCAP0\r\n\x01" + (8).to_bytes(8, "little") + b"\0\0\0\0\0\0\0\0")
    (tmp_path / "all.txt").write_text(
        "# drives\nsequences\nbag\n\na.bag\na.db3\n'a.MP4' camera=c.toml source.stride=2\nros.mcap\nown.mcap\n"
        "rosbag:bag source.topics.image=/b\ndemo\nnowhere\n"
    )
    found = find_drives([str(tmp_path / "all.txt")])
    kinds = ["kitti", "kitti", "rosbag", "rosbag", "rosbag", "video", "rosbag", "mcap", "rosbag"]
    places = ["sequences/00", "sequences/01", "bag", "a.bag", "a.db3", "a.MP4", "ros.mcap", "own.mcap", "bag"]
    expected = [f"{kind}:{tmp_path / place}" for kind, place in zip(kinds, places, strict=True)]
    assert [drive.uri for drive in found] == [*expected, "demo", f"kitti:{tmp_path / 'nowhere'}"]
    assert found[5].settings == {"camera": str(tmp_path / "c.toml"), "source.stride": 2}
    assert found[8].settings == {"source.topics.image": "/b"}


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["demo", "demo"], "demo: is named twice"),
        (["s3://store/drive.mcap"], "unknown suffix; name the kind: rosbag:s3://store/drive.mcap"),
        (["list.txt"], "line 1: No closing quotation"),
    ],
)
def test_an_invalid_list_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, arguments: list[str], said: str
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "list.txt").write_text("'demo\n")
    with pytest.raises(ConfigurationError, match=said):
        find_drives(arguments)


def test_a_sweep_is_every_combination_and_each_has_a_folder(tmp_path: Path) -> None:
    drive = kitti(tmp_path / "00", 1)
    made_of = made([drive], ("slam.graph.ego_nodes=6,8", "slam.weights.mode=paper,measured"))
    assert [task.settings for task in made_of] == [
        {"slam.graph.ego_nodes": nodes, "slam.weights.mode": mode} for nodes in (6, 8) for mode in ("paper", "measured")
    ]
    assert len({task.identity for task in made_of}) == len({task.name for task in made_of}) == 4
    assert made_of[0].name == "00@slam.graph.ego_nodes=6@slam.weights.mode=paper"
    for wrong in ("a", "=1", "a=1,,2"):
        with pytest.raises(ConfigurationError, match="expected KEY=V1,V2"):
            sweep([wrong])
    with pytest.raises(ConfigurationError, match="no such key"):
        made([drive], ("slam.nothing=1",))


def test_paths_are_independent_of_the_working_directory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    kitti(tmp_path / "00", 1)
    (tmp_path / "speed.txt").write_text("0 1\n")
    (tmp_path / "net.onnx").touch()
    monkeypatch.chdir(tmp_path)
    overrides = {"source.speed": "speed.txt", "models.detector.path": "net.onnx"}
    (task,) = tasks(find_drives(["00"]), sweep([]), None, overrides, [])
    assert task.uri == f"kitti:{tmp_path / '00'}"
    assert task.configuration["source"]["speed"] == str(tmp_path / "speed.txt")
    assert task.configuration["models"]["detector"]["path"] == str(tmp_path / "net.onnx")


def test_many_drives_take_little_memory_each(tmp_path: Path) -> None:
    (tmp_path / "all.txt").write_text("".join(f"video:film{n}.mp4\n" for n in range(200)))
    many = made([tmp_path / "all.txt"], ("slam.graph.ego_nodes=6,8",))
    assert len({task.identity for task in many}) == len(many) == 400
    assert len({id(task.configuration) for task in many}) == 2


def test_drives_of_one_name_have_separate_folders(tmp_path: Path) -> None:
    names = [task.name for task in made([kitti(tmp_path / "a" / "00", 1), kitti(tmp_path / "b" / "00", 1)])]
    assert len(set(names)) == 2
    assert all(name.startswith("00-") for name in names)


def test_results_are_atomic_and_deterministic(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (task,) = made([kitti(tmp_path / "sequences" / "00", truth=True)])
    frames = []
    for output in ("once", "again"):
        run_drive(Job(task, str(tmp_path / output)), lambda *at: frames.append(at))
    assert frames == [(1, 4), (2, 4), (3, 4), (4, 4)] * 2
    once, again = (contents(tmp_path / output) for output in ("once", "again"))
    assert once == again
    assert {f"{DRIVES}/00/{name}" for name in ("ego.kitti.txt", "summary.json", "bev.png", "result.json")} <= set(once)
    assert done(tmp_path / "once", task)
    assert not list((tmp_path / "once" / ".working").iterdir())
    monkeypatch.setattr(driving, "pipeline", None)  # what has its results is not driven again
    run_drive(Job(task, str(tmp_path / "once")), lambda *at: None)
    with pytest.raises(ConfigurationError, match="other settings"):
        done(tmp_path / "once", msgspec.structs.replace(task, identity="0"))


def test_the_first_frames_of_a_drive_are_compared_with_the_truth(tmp_path: Path) -> None:
    drive = kitti(tmp_path / "sequences" / "00", frames=6, truth=True)
    (task,) = tasks(find_drives([str(drive)]), sweep([]), None, {**PLAIN, "source.frames": 4}, [])
    told = []
    run_drive(Job(task, str(tmp_path / "out")), lambda *at: told.append(at))
    assert told[-1] == (4, 4)
    result = msgspec.json.decode((tmp_path / "out" / DRIVES / "00" / "result.json").read_bytes(), type=DriveResult)
    assert result.frames == 4
    assert result.truth.ate_m is not None


def test_a_failed_drive_leaves_no_files(tmp_path: Path) -> None:
    (task,) = made([kitti(tmp_path / "00")])

    def full(*at: int) -> None:
        raise OSError(28, "No space left on device")

    with pytest.raises(OSError, match="No space"):
        run_drive(Job(task, str(tmp_path / "out")), full)
    assert contents(tmp_path / "out") == {}
    assert not done(tmp_path / "out", task)


def result(task: Task, number: int) -> DriveResult:
    return DriveResult(
        drive=task.name, source=task.uri, settings=task.settings, identity=task.identity, frames=number, path_m=2.5,
        statuses={"standstill": number},
    )  # fmt: skip


@pytest.mark.parametrize("count", [3, 5])
def test_the_report_lists_every_drive(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, count: int) -> None:
    monkeypatch.setattr(report, "MAX_BARS", 4)
    drive = kitti(tmp_path / "00", 1)
    (one,) = made([drive])
    todo = [msgspec.structs.replace(one, name=f"<{n}>", settings={"a": n}) for n in range(count)]
    for number, task in enumerate(todo[:-2]):
        place = tmp_path / DRIVES / task.name
        place.mkdir(parents=True)
        (place / "result.json").write_bytes(msgspec.json.encode(result(task, number)))
    failure_file(tmp_path, "").parent.mkdir()
    failure = Failure(drive=todo[-2].name, source="s", settings={"a": count - 2}, error="torn & gone")
    failure_file(tmp_path, todo[-2].name).write_bytes(msgspec.json.encode(failure))
    write_report(todo, tmp_path)
    told = msgspec.json.decode((tmp_path / "report.json").read_bytes())
    assert (told["done"], told["failed"], told["left"]) == (count - 2, 1, 1)
    assert [one["drive"] for one in told["drives"]] == [task.name for task in todo[:-1]]
    with (tmp_path / "report.csv").open() as file:
        lines = list(csv.DictReader(file))
    assert (lines[0]["path_m"], lines[0]["ate_m"], lines[-1]["error"]) == ("2.5", "", "torn & gone")
    page = (tmp_path / "report.html").read_text()
    assert "&lt;0&gt;" in page
    assert "torn &amp; gone" in page
    assert "<th>a=0</th>" in page
    assert "<td>standstill 0</td>" in page
    assert (tmp_path / "report.png").read_bytes().startswith(b"\x89PNG")
    assert not list(tmp_path.glob(".*"))


@pytest.mark.processes
def test_a_failed_drive_is_isolated_and_retried(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    good, broken = kitti(tmp_path / "sequences" / "00", truth=True), kitti(tmp_path / "sequences" / "01")
    calibration = (broken / "calib.txt").read_text()
    (broken / "calib.txt").unlink()
    output = tmp_path / "out"
    command = ["batch", str(good), str(broken), "--output", str(output), "--jobs", "2", "--model", "none"]
    assert main(command) == 1
    said = capsys.readouterr()
    assert f"01: {broken / 'calib.txt'}: can't be read" in said.err
    assert "1 of 2 drives" in said.out
    first = contents(output / DRIVES / "00")
    told = msgspec.json.decode((output / "report.json").read_bytes())
    assert told["drives"][0]["truth"]["ate_m"] is not None
    (broken / "calib.txt").write_text(calibration)
    assert main(command) == 0
    assert "1 of 2 drives are done already" in capsys.readouterr().out
    assert contents(output / DRIVES / "00") == first
    assert not (output / "failed" / "01.json").exists()


@pytest.mark.processes
def test_killed_process_fails_only_its_drive(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The first drive's process kills itself, as the kernel does where memory is short."""
    two = made([kitti(tmp_path / "00"), kitti(tmp_path / "01")])
    start = subprocess.Popen

    def killed(command: list[str], **options: object) -> subprocess.Popen[bytes]:
        if not started:
            command = [sys.executable, "-c", "import os, signal; os.kill(os.getpid(), signal.SIGKILL)"]
        started.append(command)
        return start(command, **options)

    started: list[list[str]] = []
    monkeypatch.setattr(subprocess, "Popen", killed)
    ended = [event for event in run_local(two, tmp_path / "out", 1) if event.ended]
    assert [event.failure and event.failure.error for event in ended] == ["was killed by signal 9", None]
    assert done(tmp_path / "out", two[1])


@pytest.mark.slow
@pytest.mark.processes
def test_a_killed_batch_resumes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Killed during its second drive: the drive's process ends too, and the next batch does the rest."""
    drives = [kitti(tmp_path / "00", 3), kitti(tmp_path / "01", 400)]
    output, alone = tmp_path / "out", tmp_path / "alone"
    command = [sys.executable, "-m", "birdslam.runtime.cli.main", "batch", *map(str, drives)]
    command += ["--model", "none", "--jobs", "1", "--output", str(output)]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    half = threading.Event()
    for _ in range(6000):
        rows = list((output / ".working").glob("*/01/ego.kitti.txt"))
        if rows and rows[0].stat().st_size:
            break
        half.wait(0.02)
    else:
        pytest.fail("the second drive never began")
    process.send_signal(signal.SIGKILL)
    process.wait()
    assert [path.name for path in (output / DRIVES).iterdir()] == ["00"]
    before = (output / DRIVES / "00" / "result.json").stat().st_mtime_ns
    assert subprocess.run(command, check=False, stdout=subprocess.DEVNULL).returncode == 0
    assert (output / DRIVES / "00" / "result.json").stat().st_mtime_ns == before
    monkeypatch.setattr(bev_picture, "DPI", 160)  # as in the processes of the batch
    run_drive(Job(made(drives)[1], str(alone)), lambda *at: None)
    found = contents(output / DRIVES / "01")
    found.pop("report.html", None)  # of a batch where plotly is installed
    assert found == contents(alone / DRIVES / "01")
    assert os.listdir(output / ".working") == []


DRIVES_OF_ALL, FRAMES = 6, 150


def test_drive_is_fetched_while_it_is_read(tmp_path: Path) -> None:
    fsspec = pytest.importorskip("fsspec")
    with fsspec.filesystem("memory").open("/store/drive.mp4", "wb") as file:
        file.write(b"film")
    with local_copy("video:memory://store/drive.mp4") as uri:
        place = Path(uri.removeprefix("video:"))
        assert (place.name, place.read_bytes()) == ("drive.mp4", b"film")
    assert not place.exists()
    with local_copy("video:/a/b.mp4") as uri:
        assert uri == "video:/a/b.mp4"
    with (
        pytest.raises(DatasetError, match=r"memory://store/none\.mp4: can't be fetched"),
        local_copy("video:memory://store/none.mp4"),
    ):
        pass
    for argument in ("video:memory://store/drive.mp4", "memory://store/drive.mp4"):
        (drive,) = find_drives([argument])
        assert drive.uri == "video:memory://store/drive.mp4"
    assert find_drives(["memory://store/a.bag"])[0].uri == "rosbag:memory://store/a.bag"


def test_a_fetched_drive_gives_the_same_bytes(tmp_path: Path) -> None:
    fsspec = pytest.importorskip("fsspec")
    drive = kitti(tmp_path / "00")
    fsspec.filesystem("memory").put(str(drive), "/far/00", recursive=True)
    (near,) = made([drive])
    far = msgspec.structs.replace(near, uri="kitti:memory://far/00")
    for task, output in ((near, "near"), (far, "far")):
        run_drive(Job(task, str(tmp_path / output)), lambda *at: None)
    ours, theirs = (contents(tmp_path / output / DRIVES / "00") for output in ("near", "far"))
    assert {name for name in ours if ours[name] != theirs[name]} == {"result.json"}  # which says where it was


def test_without_ray_the_extra_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    assert main(["batch", "demo", "--engine", "ray", "--output", str(tmp_path / "out")]) == 2
    assert "pip install 'birdslam[ray]'" in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.processes
@pytest.mark.filterwarnings("ignore")  # Ray's own
def test_lost_node_neither_loses_nor_duplicates_drives(tmp_path: Path) -> None:
    pytest.importorskip("ray")
    from ray.cluster_utils import Cluster

    drives = [kitti(tmp_path / f"{number:02d}", FRAMES) for number in range(DRIVES_OF_ALL)]
    torn = tmp_path / "torn"
    (torn / "image_0").mkdir(parents=True)
    output = tmp_path / "out"
    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1})
    try:
        second = cluster.add_node(num_cpus=1)
        cluster.wait_for_nodes()
        command = [sys.executable, "-m", "birdslam.runtime.cli.main", "batch", *map(str, [*drives, torn])]
        command += ["--engine", "ray", "--address", cluster.address, "--model", "none", "--output", str(output)]
        batch = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
        pause = threading.Event()
        while batch.poll() is None:  # both nodes at work, each beyond its first rows
            rows = [file for file in output.glob(".working/*/*/ego.kitti.txt") if file.stat().st_size]
            if len(rows) == 2 and list(output.glob(f"{DRIVES}/*")):
                break
            pause.wait(0.02)
        else:
            pytest.fail(f"the batch ended before two drives were on the way: {batch.communicate()[1]}")
        cluster.remove_node(second, allow_graceful=False)
        _, said = batch.communicate(timeout=500)
    finally:
        cluster.shutdown()
    assert batch.returncode == 1, said
    assert "torn: " in said
    told = msgspec.json.decode((output / "report.json").read_bytes())
    assert (told["done"], told["failed"], told["left"]) == (DRIVES_OF_ALL, 1, 0)
    assert sorted(path.name for path in (output / DRIVES).iterdir()) == [drive.name for drive in drives]
    (last,) = made(drives[-1:])
    run_drive(Job(last, str(tmp_path / "alone")), lambda *at: None)
    assert contents(output / DRIVES / last.name) == contents(tmp_path / "alone" / DRIVES / last.name)
