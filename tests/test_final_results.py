"""Final results of a drive: the trajectories, bit for bit those that `evaluate` gives, and the video."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterable
from contextlib import ExitStack
from pathlib import Path

import cv2
import msgspec
import numpy as np
import pytest

from birdslam.bench.tracking.benchmark import Final, ours
from birdslam.geometry.camera import Camera
from birdslam.graph.graph_config import GraphConfig
from birdslam.graph.pose_graph import PoseGraph
from birdslam.graph.weights import WeightsConfig
from birdslam.outputs.drive_files import Recorder, ResultsError
from birdslam.outputs.drive_video import DriveVideo, SideBySide, check_video
from birdslam.outputs.final_trajectories import FinalTracks, last_seen
from birdslam.road_users.rts_smoother import RtsSmoother, SmootherConfig
from birdslam.runtime.cli.commands import parse
from birdslam.runtime.cli.drives import replay
from birdslam.runtime.cli.main import main
from birdslam.runtime.configuration import ConfigurationError, RecordingConfig, ResultsConfig, load
from birdslam.runtime.recording import scene
from birdslam.runtime.recording.recorded_drive import recorded_drive
from birdslam.runtime.recording.recording import Recording
from birdslam.runtime.supervision.final_results import FinalResults, check_results, recorded_frames, smooth
from birdslam.slam import SlamConfig
from birdslam.trajectory import ego_pose, tum_row
from birdslam.types import Attitude, Estimate, Measurements
from tests.taped_drive import CAMERA, Tape, measured


def rows(path: Path) -> list[str]:
    return [line for line in path.read_text().splitlines() if not line.startswith("#")]


def tracks(directory: Path) -> dict[int, list[str]]:
    return {int(path.name.split(".")[0]): rows(path) for path in directory.glob("*.final.tum.txt")}


def smoothed(pairs: Iterable[tuple[Measurements, Estimate]]) -> dict[int, list[str]]:
    """The rows of every vehicle by the smoother that the evaluation uses, which keeps the whole drive."""
    smoother, times = RtsSmoother(SmootherConfig()), {}
    for measurements, estimate in pairs:
        smoother.add(measurements, estimate)
        times[estimate.epoch, estimate.frame_id] = estimate.t_source_ns, estimate.attitude.z_m
    out: dict[int, list[str]] = {}
    for (epoch, vehicle), way in sorted(smoother.smooth().items()):
        for frame, pose in way.items():
            t_ns, z_m = times[epoch, frame]
            out.setdefault(vehicle, []).append(tum_row(t_ns, ego_pose(pose, Attitude(z_m=z_m))))
    return out


def write_live(tape: Tape, directory: Path) -> None:
    with Recorder(directory, CAMERA) as recorder:
        for estimate in tape.estimates:
            recorder.add(estimate)


def taped(directory: Path, frames: list[Measurements], end: bool = True) -> Tape:
    directory.mkdir()
    tape = Tape(directory)
    for number, measurements in enumerate(frames):
        tape.step(measurements)
        if number != 7:
            image = np.full((CAMERA.height_px, CAMERA.width_px), number, np.uint8)
            tape.writer.draw(*scene.from_image(image, 90, measurements.t_utc_ns), t_ns=tape.tick())
    if end:
        tape.end(frames[-1])
    return tape


def test_a_recording_gives_the_trajectories_that_are_evaluated_bit_for_bit(tmp_path: Path) -> None:
    frames = measured(60)
    tape = taped(tmp_path / "t", frames)
    write_live(tape, tmp_path / "out")
    found = smooth([tape.path], tmp_path / "out")
    final = tracks(tmp_path / "out" / "tracks")
    assert final == smoothed(zip(frames, tape.estimates, strict=False))
    assert found == len(final) > 1
    evaluated = Final(ours(SlamConfig()), SmootherConfig()).run(frames, CAMERA)
    assert {vehicle: len(poses) for vehicle, poses in final.items()} == {
        vehicle: len(poses) for vehicle, poses in evaluated.vehicles.items()
    }
    for vehicle, poses in evaluated.vehicles.items():  # world and first frame are the same in the first epoch
        xy = [tuple(map(float, row.split()[1:3])) for row in final[vehicle]]
        np.testing.assert_allclose(xy, [(pose.x_m, pose.y_m) for pose in poses.values()], atol=1e-8)
    for name in ("ego.tum.txt", "ego.kitti.txt"):
        live = (tmp_path / "out" / name).read_bytes()
        assert (tmp_path / "out" / name.replace("ego.", "ego.final.")).read_bytes() == live
        assert live.count(b"\n") >= 60


def test_new_epoch_continues_in_the_same_file(tmp_path: Path) -> None:
    frames = measured(60)
    (tmp_path / "t").mkdir()
    tape = Tape(tmp_path / "t")
    tape.step(*frames[:30])
    tape.restart(with_checkpoint=False)
    tape.step(*frames[30:])
    tape.end(frames[-1])
    write_live(tape, tmp_path / "out")
    smooth([tape.path], tmp_path / "out")
    estimates = {e.frame_id: e for e in tape.estimates}
    assert len({e.epoch for e in estimates.values()}) == 2
    assert tracks(tmp_path / "out" / "tracks") == smoothed((m, estimates[m.frame_id]) for m in frames)
    texts = [path.read_text() for path in (tmp_path / "out" / "tracks").glob("*.final.tum.txt")]
    assert all(text.count("# track") == 1 for text in texts)
    assert any("# epoch 1: a new world frame begins" in text for text in texts)


def test_memory_of_finished_tracks_is_released(tmp_path: Path) -> None:
    frames, graph = measured(60), PoseGraph(GraphConfig(), WeightsConfig())
    final = FinalTracks(tmp_path, last_seen(frames))
    for measurements in frames:
        final.add(measurements, graph.optimise(measurements))
        known = {vehicle for vehicle, frame in last_seen(frames).items() if frame > measurements.frame_id}
        assert set(final._open) <= known  # private: what is held in memory shows nowhere else
        assert {vehicle for _, vehicle in final._smoother._measurements} <= known  # private: likewise
    assert final.vehicles == len(list(tmp_path.glob("*.final.tum.txt")))


def test_truncated_recording_gives_partial_results(tmp_path: Path) -> None:
    frames = measured(40)
    tape = taped(tmp_path / "t", frames)
    tape.path.write_bytes(tape.path.read_bytes()[: tape.path.stat().st_size // 2])
    write_live(tape, tmp_path / "out")
    assert smooth([tape.path], tmp_path / "out") > 0
    there = [r for r in recorded_drive([Recording(tape.path)]) if isinstance(r, Estimate)]
    assert 5 < len(there) < 40
    assert tracks(tmp_path / "out" / "tracks") == smoothed(zip(frames, there, strict=False))


def test_estimates_without_recorded_measurements_are_skipped(tmp_path: Path) -> None:
    frames = measured(30)
    (tmp_path / "t").mkdir()
    tape = Tape(tmp_path / "t")
    for number, measurements in enumerate(frames):
        tape.frame(measurements)
        tape.take(tape.send(measurements, recorded=number not in (4, 5)))
    tape.end(frames[-1])
    records = list(recorded_drive([Recording(tape.path)]))
    assert [r for r in records if isinstance(r, Estimate)] == tape.estimates[:-1]
    assert [r.frame_id for r in records if isinstance(r, Measurements)] == [
        m.frame_id for number, m in enumerate(frames) if number not in (4, 5)
    ]


def test_a_drive_without_vehicles_has_the_ego_alone(tmp_path: Path) -> None:
    frames = [msgspec.structs.replace(m, cv=(), vv=()) for m in measured(10)]
    tape = taped(tmp_path / "t", frames)
    write_live(tape, tmp_path / "out")
    assert smooth([tape.path], tmp_path / "out") == 0
    assert not list((tmp_path / "out" / "tracks").iterdir())
    assert len(rows(tmp_path / "out" / "ego.final.tum.txt")) == 9  # the first frame has no motion and is not valid


def test_results_without_final_ones_replace_those_of_an_earlier_run(tmp_path: Path) -> None:
    frames = measured(30)
    tape = taped(tmp_path / "t", frames)
    write_live(tape, tmp_path / "out")
    smooth([tape.path], tmp_path / "out")
    write_live(tape, tmp_path / "out")
    assert not list((tmp_path / "out").rglob("*.final.*"))


def test_replay_writes_them_too(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    frames = measured(40)
    tape = taped(tmp_path / "t", frames)
    options = parse(["replay", str(tape.path), "--smooth", "--output", str(tmp_path / "out")])
    assert replay.run(options) == 0
    assert "results in" in capsys.readouterr().out
    assert tracks(tmp_path / "out" / "tracks") == smoothed(zip(frames, tape.estimates, strict=False))
    assert (tmp_path / "out" / "ego.final.tum.txt").read_bytes() == (tmp_path / "out" / "ego.tum.txt").read_bytes()


@pytest.mark.slow
@pytest.mark.processes
def test_run_writes_evaluated_trajectories_and_removes_temporary_recording(tmp_path: Path) -> None:
    """The shipped drive through the three processes; --record only so that the test can evaluate the same records."""
    arguments = [
        *("run", "--source", "demo", "--rate", "max", "--set", "source.frames=24", "--smooth"),
        *("--set", "runtime.watchdog_ms=60000", "--set", f"runtime.runtime_dir={tmp_path / 'rt'}"),
    ]
    (tmp_path / "rt").mkdir(mode=0o700)
    recorded = [*arguments, "--record", str(tmp_path / "d.mcap"), "--output", str(tmp_path / "a")]
    assert call(*recorded, "--video", str(tmp_path / "a" / "v.mp4")) == 0
    records = list(recorded_drive([Recording(tmp_path / "d.mcap")]))
    log = [record for record in records if isinstance(record, Measurements)]
    estimates = [record for record in records if isinstance(record, Estimate)]
    assert len(log) == len(estimates) == 24
    final = tracks(tmp_path / "a" / "tracks")
    assert final == smoothed(zip(log, estimates, strict=True))
    assert final
    assert len(pictures(tmp_path / "a" / "v.mp4")) == 12
    assert call(*arguments, "--output", str(tmp_path / "b")) == 0
    assert tracks(tmp_path / "b" / "tracks") == final
    names = sorted(path.name for path in (tmp_path / "b").iterdir() if path.name != "report.html")  # an extra's
    assert names == sorted(
        [
            *("README.txt", "bev.png", "drive.mp4", "ego.final.kitti.txt", "ego.final.tum.txt", "ego.kitti.txt"),
            *("ego.tum.txt", "frames.csv", "logs", "map.csv", "map.geojson", "summary.json", "tracks"),
        ]
    )


def call(*arguments: str) -> int:
    """Runs the command in a separate process with its own environment."""
    return subprocess.run([sys.executable, "-m", "birdslam.runtime.cli.main", *arguments], timeout=170).returncode


def pictures(path: Path) -> list[np.ndarray]:
    video, out = cv2.VideoCapture(str(path)), []
    while (read := video.read())[0]:
        out.append(read[1])
    video.release()
    return out


def test_every_frame_up_to_the_last_estimate_is_drawn(tmp_path: Path) -> None:
    graph, frames = PoseGraph(GraphConfig(), WeightsConfig()), measured(12)
    estimates = [graph.optimise(measurements) for measurements in frames]
    grey = np.full((CAMERA.height_px, CAMERA.width_px), 90, np.uint8)

    def images() -> Iterable[tuple[int, int, np.ndarray | None]]:
        for number in range(100):
            assert number <= 13, "read on behind the last estimate"
            yield number, number * 10**8, None if number == 5 else grey

    first = estimates[0].frame_id
    with DriveVideo(tmp_path / "v.mp4", CAMERA, 10.0, iter(images())) as video:
        for estimate in estimates:
            if estimate.frame_id != first + 3:  # its frame shows the one before
                video.add(estimate)
        video.finish()
    drawn = pictures(tmp_path / "v.mp4")
    assert len(drawn) == 12 - 1  # without the unreadable one
    assert drawn[0].shape[1::-1] == SideBySide(CAMERA).size_px


def test_a_large_camera_is_drawn_smaller_and_a_fast_one_by_every_second_frame(tmp_path: Path) -> None:
    large = Camera(3840, 2160, 2000.0, 2000.0, 1920.0, 1080.0, 1.5)
    assert SideBySide(large).size_px[0] < 1700
    estimates = [msgspec.structs.replace(taken, frame_id=k) for k, taken in enumerate([estimate()] * 9)]
    image = np.zeros((CAMERA.height_px, CAMERA.width_px, 3), np.uint8)
    with DriveVideo(tmp_path / "v.mp4", CAMERA, 33.0, ((k, k, image) for k in range(9))) as video:
        for taken in estimates:
            video.add(taken)
        video.finish()
    assert len(pictures(tmp_path / "v.mp4")) == 5


def estimate() -> Estimate:
    return PoseGraph(GraphConfig(), WeightsConfig()).optimise(measured(1)[0])


def test_the_images_of_a_recording_are_drawn_by_their_numbers_in_the_run(tmp_path: Path) -> None:
    tape = Tape(tmp_path, recording=RecordingConfig(images=True))
    frames = [msgspec.structs.replace(m, frame_id=m.frame_id) for m in measured(20)]
    for number, measurements in enumerate(frames):
        tape.step(measurements)
        image = np.full((CAMERA.height_px, CAMERA.width_px), number, np.uint8)
        tape.writer.draw(*scene.from_image(image, 90, measurements.t_utc_ns), t_ns=tape.tick())
    tape.end(frames[-1])
    camera, rate_hz, images = recorded_frames([tape.path])
    assert camera == CAMERA
    assert rate_hz == pytest.approx(33.0)
    assert [(k, None if image is None else int(image.mean())) for k, _, image in images] == [
        (m.frame_id, number) for number, m in enumerate(frames)
    ]
    video = tmp_path / "v.mp4"
    options = ["replay", str(tape.path), "--video", str(video), "--output", str(tmp_path / "out")]
    assert replay.run(parse(options)) == 0
    assert len(pictures(video)) == 10  # every second frame of 33 Hz


def test_unwritable_video_is_named_before_start(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "is.mp4").mkdir()
    (tmp_path / "file").touch()
    for name, reason in (
        ("file/v.mp4", "can't be created"),
        ("v.gif", "expected FILE.mp4"),
        ("is.mp4", "is a directory"),
    ):
        output = str(tmp_path / "out")
        assert main(["run", "--source", "demo", "--video", str(tmp_path / name), "--output", output]) == 2
        error = capsys.readouterr().err
        assert error.startswith("birdslam: video ")
        assert reason in error
        assert error.count("\n") == 1
        assert not (tmp_path / "out").exists()
    monkeypatch.setattr("birdslam.outputs.drive_video.CODEC", "none")
    with pytest.raises(ResultsError, match="can't write none"):
        check_video(tmp_path / "v.mp4", CAMERA, 10.0)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["file", "is.mp4"]


def test_folders_of_a_video_are_created(tmp_path: Path) -> None:
    check_video(tmp_path / "new" / "folder" / "v.mp4", CAMERA, 10.0)
    assert list((tmp_path / "new" / "folder").iterdir()) == []


def test_a_live_camera_that_is_recorded_without_images_has_no_video(tmp_path: Path) -> None:
    settings = {
        "source.uri": "v4l2:/dev/video9",
        "results.video": str(tmp_path / "v.mp4"),
        "recording.file": str(tmp_path / "d.mcap"),
    }

    class Source:
        camera, rate_hz = CAMERA, 30.0

    with pytest.raises(ConfigurationError, match="--record-images"):
        check_results(load(None, settings), Source())
    check_results(load(None, {**settings, "recording.images": True}), Source())


def test_a_temporary_recording_is_made_where_one_is_needed_with_images_of_a_live_camera(tmp_path: Path) -> None:
    camera, drive = {"source.uri": "v4l2:/dev/video9"}, {"source.uri": "kitti:x"}
    video, smooth_too = {"results.video": str(tmp_path / "v.mp4")}, {"results.smooth": True}
    for settings, needed, images in (
        (camera, False, False),
        (camera | smooth_too, True, False),
        (camera | video, True, True),
        (drive | video, True, False),  # the drive's own images are there when it is over
        (drive | smooth_too | {"recording.file": "mine.mcap"}, False, False),
    ):
        configuration = load(None, {"output": str(tmp_path), **settings})
        with ExitStack() as stack:
            recorded = FinalResults(configuration, None).recorded(stack)
            assert (recorded != configuration) == needed
            assert recorded.recording.images == images
            assert not needed or Path(recorded.recording.file).parent.is_dir()
        assert not list(tmp_path.iterdir())


def test_paths_of_a_file_are_relative_to_it(tmp_path: Path) -> None:
    path = tmp_path / "a.toml"
    path.write_text('[results]\nsmooth = true\nvideo = "v.mp4"\n')
    assert load(path).results == ResultsConfig(smooth=True, video=str(tmp_path / "v.mp4"))
    made = load(None)
    assert made.results == ResultsConfig()
