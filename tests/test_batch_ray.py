"""A batch on a real Ray cluster of two nodes, one of which is lost; and remote drives."""

from __future__ import annotations

import subprocess
import sys
import threading
from pathlib import Path

import msgspec
import pytest

from birdslam.runtime.batch.drive import DRIVES, Job, run_drive
from birdslam.runtime.batch.drives import find_drives
from birdslam.runtime.batch.fetch import local_copy
from birdslam.runtime.cli.main import main
from birdslam.sources.recording import DatasetError
from tests.test_batch import contents, kitti, made

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
