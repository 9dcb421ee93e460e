"""A replay gives the recorded estimates bit for bit, also after restarts of nodes and recorder."""

from __future__ import annotations

import argparse
import itertools
import math
import tempfile
from collections.abc import Iterable, Sequence
from pathlib import Path

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from birdslam.graph.g2o import g2o_lines
from birdslam.runtime.cli.commands import parse
from birdslam.runtime.cli.drives import replay as replay_command
from birdslam.runtime.configuration import ConfigurationError
from birdslam.runtime.nodes.capture import stamps
from birdslam.runtime.nodes.checkpoints import checkpoint_path, newest_checkpoint
from birdslam.runtime.nodes.recorder import about
from birdslam.runtime.recording.recording import Alive, GraphCheckpoint, Recording, RecordingError, RecordingWriter
from birdslam.runtime.replay import replay
from birdslam.runtime.replay.replay import compare
from birdslam.runtime.replay.report import report
from birdslam.runtime.replay.verdict import Verdict
from birdslam.types import Estimate, FrameRef, Measurements, Status
from tests.taped_drive import CAMERA, Tape, measured


def options(recording: Path, values: Sequence[str] = (), output: Path | None = None) -> argparse.Namespace:
    settings = [word for value in values for word in ("--set", value)]
    return parse(["replay", str(recording), *settings, *(("--output", str(output)) if output else ())])


def verdict_after(tape: Tape, frames: Iterable[Measurements]) -> Verdict:
    """Of a drive that ends after these frames."""
    *_, last = rest = list(frames)
    tape.step(*rest)
    tape.end(last)
    return compare(Recording(tape.path))


def test_replay_reproduces_estimates_and_map(tmp_path: Path) -> None:
    tape, frames = Tape(tmp_path), measured(50)
    verdict = verdict_after(tape, frames)
    assert verdict.same
    assert verdict.equal == 51  # the end too
    assert verdict.maps > 0
    assert (verdict.unknown, verdict.unanswered, verdict.restarts, verdict.epochs) == (0, 0, 0, 1)
    assert any(estimate.vehicles for estimate in tape.estimates)


def test_first_difference_is_named_to_the_last_bit(tmp_path: Path) -> None:
    tape, frames = Tape(tmp_path), measured(30)

    def bend(estimate: Estimate) -> Estimate:
        pose = estimate.T_world_ego
        bent = msgspec.structs.replace(pose, y_m=math.nextafter(pose.y_m, math.inf))
        return msgspec.structs.replace(estimate, T_world_ego=bent)

    write = tape.writer.add
    for measurements in frames:
        if measurements.frame_id == frames[17].frame_id:
            tape.writer.add = lambda topic, out, *rest: write(
                topic, bend(out) if isinstance(out, Estimate) else out, *rest
            )
        tape.step(measurements)
    tape.end(frames[-1])
    verdict = compare(Recording(tape.path))
    assert not verdict.same
    assert verdict.equal == 17
    assert verdict.difference.frame_id == frames[17].frame_id
    assert [where for where, _, _ in verdict.difference.fields] == ["T_world_ego[1]"]
    assert f"frame {frames[17].frame_id} DIFFERS" in report(verdict, Recording(tape.path))
    assert replay_command.run(options(tape.path)) == 1


def test_coasted_frames_and_late_measurements_are_replayed(tmp_path: Path) -> None:
    tape, frames = Tape(tmp_path), measured(30)
    tape.step(*frames[:10])
    first, second = tape.frame(frames[10]), tape.frame(frames[11])
    tape.coast(first)
    tape.coast(second)
    tape.take(tape.send(frames[10]))  # late: the newest frame is published again
    tape.take(tape.send(frames[11]))
    verdict = verdict_after(tape, frames[12:])
    assert [e.frame_id - frames[10].frame_id for e in tape.estimates[10:15]] == [0, 1, 1, 1, 2]
    assert verdict.same
    assert verdict.coasted == 2
    assert verdict.equal == len(tape.estimates)


def test_frame_written_after_its_prediction_is_replayed(tmp_path: Path) -> None:
    """As by a recorder that had to wait for a core."""
    tape, frames = Tape(tmp_path), measured(20)
    tape.step(*frames[:10])
    late = FrameRef(**stamps(frames[10]))
    tape.coast(late)
    tape.writer.add("frame", late, tape.tick())
    tape.take(tape.send(frames[10]))
    verdict = verdict_after(tape, frames[11:])
    assert verdict.same, verdict.difference
    assert (verdict.unknown, verdict.coasted, verdict.equal) == (0, 1, len(tape.estimates))


@pytest.mark.parametrize("with_checkpoint", [True, False])
def test_restarts_of_the_optimizer(tmp_path: Path, with_checkpoint: bool) -> None:
    tape, frames = Tape(tmp_path), measured(40)
    tape.step(*frames[:20])
    tape.lose(*frames[20:23])  # while it is dead
    tape.restart(with_checkpoint)
    verdict = verdict_after(tape, frames[23:])
    told_of = {status for estimate in tape.estimates for status in estimate.status}
    assert (Status.GRAPH_RESTORED in told_of) == with_checkpoint
    assert (Status.GRAPH_RESET in told_of) != with_checkpoint
    assert verdict.same, verdict.difference
    assert verdict.equal == len(tape.estimates)
    assert verdict.restarts == 1
    assert verdict.epochs == (1 if with_checkpoint else 2)


def test_measurements_of_a_frame_published_before_the_restart_enter_the_restored_graph_unpublished(
    tmp_path: Path,
) -> None:
    """Its frame was coasted over, and the measurements came as the optimizer was dead."""
    tape, frames = Tape(tmp_path), measured(40)
    tape.step(*frames[:20])
    tape.coast(tape.frame(frames[20]))
    tape.send(frames[20])
    tape.restart(with_checkpoint=True)
    tape.coast(tape.frame(frames[21]))
    assert Status.GRAPH_RESTORED in tape.estimates[-1].status
    tape.take(tape.send(frames[21]))
    verdict = verdict_after(tape, frames[22:])
    assert verdict.same, verdict.difference
    assert verdict.equal == len(tape.estimates)
    assert (verdict.restarts, verdict.epochs, verdict.unanswered) == (1, 1, 1)


def test_graph_from_an_old_checkpoint_is_compared_after_a_new_epoch(tmp_path: Path) -> None:
    """Perceive was too busy to send what came since: that checkpoint is in no recording."""
    tape, frames = Tape(tmp_path), iter(measured(40))
    tape.step(*itertools.islice(frames, 15))
    old = checkpoint_path(tape.configuration).read_bytes()
    tape.step(*itertools.islice(frames, 5))
    checkpoint_path(tape.configuration).write_bytes(old)
    tape.perceive.forget(0)
    tape.restart(with_checkpoint=True)
    for measurements in itertools.islice(frames, 2):  # perceive had no time: a motion that is predicted
        coasting = Measurements(**stamps(measurements), status=(Status.COASTING,))
        tape.step(coasting)
    assert Status.GRAPH_RESTORED in tape.estimates[20].status
    assert tape.estimates[21].epoch == 0
    verdict = verdict_after(tape, frames)
    assert Status.GRAPH_RESET in tape.estimates[22].status
    assert verdict.difference is None, verdict.difference.frame_id
    assert (verdict.unknown, verdict.restarts, verdict.epochs) == (2, 1, 2)
    assert verdict.equal == len(tape.estimates) - 2


def test_long_restart_is_replayed(tmp_path: Path) -> None:
    """The checkpoint is whole, but nothing ties it to the oldest of them: a new world, and nothing was restored."""
    tape, frames = Tape(tmp_path), measured(60)
    tape.step(*frames[:20])
    tape.lose(*frames[20:45])
    tape.perceive.forget(10)
    tape.restart(with_checkpoint=True)
    verdict = verdict_after(tape, frames[45:])
    told_of = {status for estimate in tape.estimates for status in estimate.status}
    assert Status.GRAPH_RESET in told_of
    assert Status.GRAPH_RESTORED not in told_of
    assert verdict.same, verdict.difference
    assert (verdict.restarts, verdict.epochs) == (1, 2)
    assert verdict.equal == len(tape.estimates)


def test_new_epoch_without_restart_is_a_difference(tmp_path: Path) -> None:
    tape, frames = Tape(tmp_path), measured(20)
    tape.step(*frames[:10])
    tape.restart(with_checkpoint=False, noticed=False)
    verdict = verdict_after(tape, frames[10:])
    assert verdict.difference.frame_id == frames[10].frame_id


def test_lost_measurements_end_the_comparison_until_a_new_epoch(tmp_path: Path) -> None:
    tape, frames = Tape(tmp_path), measured(40)
    tape.step(*frames[:10])
    tape.frame(frames[10])
    tape.take(tape.send(frames[10], recorded=False))
    tape.step(*frames[11:20])
    verdict = verdict_after(tape, frames[21:])  # frame 20 never came to the optimizer: it restarts
    assert verdict.same
    assert verdict.unknown == 10
    assert verdict.equal == 10 + 19 + 1
    assert "were not recorded: 10" in report(verdict, Recording(tape.path))


@pytest.mark.parametrize("missing", ["estimate", "measurements too"])
@pytest.mark.parametrize("restart", [False, True])
def test_new_epoch_with_lost_first_estimate_is_not_a_difference(tmp_path: Path, missing: str, restart: bool) -> None:
    tape, frames = Tape(tmp_path), measured(40)
    tape.step(*frames[:10])
    tape.frame(frames[10])
    tape.send(frames[10])  # never comes to the optimizer, which restarts with the next
    if restart:
        tape.restart(with_checkpoint=False)
    tape.take(tape.send(frames[11], recorded=missing == "estimate"), recorded=False)
    verdict = verdict_after(tape, frames[12:])
    assert tape.estimates[-1].epoch == 1
    assert verdict.difference is None, (verdict.difference, verdict)
    if missing == "estimate":
        assert (verdict.equal, verdict.unknown) == (len(tape.estimates) - 1, 0)
    else:
        assert (verdict.equal, verdict.unknown) == (10, len(tape.estimates) - 11)


@pytest.mark.parametrize("lost", [1, 2])
@pytest.mark.parametrize("dead", [0, 1])
def test_epoch_of_a_process_killed_before_its_estimates_is_replayed(tmp_path: Path, lost: int, dead: int) -> None:
    """The next process restores the checkpoint of an unpublished epoch."""
    tape, frames = Tape(tmp_path), iter(measured(40))
    tape.step(*itertools.islice(frames, 10))
    tape.restart(with_checkpoint=False)
    for measurements in itertools.islice(frames, lost):
        tape.frame(measurements)
        tape.take(tape.send(measurements), recorded=False)
    tape.lose(*itertools.islice(frames, dead))  # between the two
    tape.restart(with_checkpoint=True)
    verdict = verdict_after(tape, frames)
    heard = [estimate.status for estimate in tape.estimates if estimate.frame_id > 10 + lost]
    assert Status.GRAPH_RESET not in {status for each in heard for status in each}
    assert verdict.difference is None, verdict.difference.frame_id
    assert (verdict.restarts, verdict.epochs, verdict.unknown) == (2, 2, 0)
    assert verdict.equal == len(tape.estimates) - lost


def test_an_estimate_that_cannot_be_compared_is_not_replayed_twice(tmp_path: Path) -> None:
    """The frame that was coasted over as the world restarted is not in the recording."""
    tape, frames = Tape(tmp_path), measured(40)
    tape.step(*frames[:10])
    tape.coast(FrameRef(frame_id=frames[12].frame_id, t_source_ns=0, t_capture_ns=0, t_utc_ns=0))
    tape.take(tape.send(frames[11]))  # the one before it was dropped on its way
    assert Status.GRAPH_RESET in tape.estimates[-1].status
    tape.take(tape.send(frames[12]))
    verdict = verdict_after(tape, frames[13:])
    assert verdict.difference is None, (verdict.difference, verdict)
    assert (verdict.equal, verdict.unknown) == (len(tape.estimates) - 2, 2)


NEW_WORLDS = ("new world", "new world lost", "new world killed")
EVENTS = ("well", "well", "well", "dropped", "estimate lost", "late", "restored", *NEW_WORLDS)


@settings(max_examples=12)
@given(events=st.lists(st.sampled_from(EVENTS), min_size=5, max_size=18), seed=st.integers(0, 3))
def test_random_restarts_give_no_difference(events: list[str], seed: int) -> None:
    frames = iter(measured(4 * len(events) + 2, seed))
    with tempfile.TemporaryDirectory() as place:
        tape = Tape(Path(place))
        last = next(frames)
        tape.step(last)
        for event in events:
            last = next(frames)
            if event == "dropped":  # by the optimizer's queue
                tape.frame(last)
                tape.send(last)
            elif event in ("estimate lost", "new world lost", "new world killed"):  # on its way to the recorder
                if event in NEW_WORLDS:
                    tape.restart(with_checkpoint=False)
                tape.frame(last)
                tape.take(tape.send(last), recorded=False)
                if event == "new world killed":
                    tape.restart(with_checkpoint=True)
            elif event == "late":
                newer = next(frames)
                refs = tape.frame(last), tape.frame(newer)
                for ref in refs:
                    tape.coast(ref)
                for measurements in (last, newer):
                    tape.take(tape.send(measurements))
            elif event in ("restored", "new world"):
                tape.restart(with_checkpoint=event == "restored")
            last = next(frames)
            tape.step(last)
        tape.end(last)
        verdict = compare(Recording(tape.path))
        assert verdict.difference is None, (verdict.difference, verdict)
        unheard = ("estimate lost", "new world lost", "new world killed")
        assert verdict.equal + sum(event in unheard for event in events) == len(tape.estimates)
        killed = sum(event == "new world killed" for event in events)  # two processes
        assert verdict.restarts == sum(event in ("restored", *NEW_WORLDS) for event in events) + killed
        assert verdict.unknown == 0


@pytest.mark.parametrize("late", [False, True])
def test_file_from_the_middle_of_a_drive_replays_from_its_checkpoint(tmp_path: Path, late: bool) -> None:
    tape, frames = Tape(tmp_path), measured(40)
    tape.step(*frames[:15])
    kept = newest_checkpoint(checkpoint_path(tape.configuration))
    tape.writer.close({})
    path = tmp_path / "drive-2.mcap"
    tape.writer = RecordingWriter(path, about(tape.configuration, {}, restarts=1), CAMERA, 1e-3, sync=False)
    tape.writer.draw("/alive", Alive(node="optimize", alive=True), tape.tick())
    tape.writer.begin_from(GraphCheckpoint(frame_id=kept.frame_id, epoch=kept.epoch, data=kept.data), tape.tick())
    if late:  # the first frame of the file is answered when the next one has been coasted over
        tape.frame(frames[15])
        coasted = tape.frame(frames[16])
        first = tape.send(frames[15])
        tape.coast(coasted)
        tape.take(first)
        tape.take(tape.send(frames[16]))
    tape.step(*frames[17 if late else 15 : 30])
    tape.restart(with_checkpoint=True)
    tape.step(*frames[30:])
    tape.end(frames[-1])
    recording = Recording(path)
    verdict = compare(recording)
    assert verdict.difference is None
    assert verdict.same
    assert verdict.unknown == (2 if late else 0)
    assert verdict.equal == len(tape.estimates) - 15 - verdict.unknown
    assert verdict.restarts == 1


def test_truncated_recording_replays_up_to_its_end(tmp_path: Path) -> None:
    tape, frames = Tape(tmp_path), measured(40)
    tape.step(*frames)
    tape.close()
    whole = tape.path.read_bytes()
    tape.path.write_bytes(whole[: len(whole) // 2])
    recording = Recording(tape.path)
    verdict = compare(recording)
    assert verdict.same
    assert 5 < verdict.equal < 40
    assert not recording.complete
    assert "was cut off" in report(verdict, recording)


def test_last_estimates_of_a_truncated_file_may_lack_measurements(tmp_path: Path) -> None:
    tape, frames = Tape(tmp_path), measured(20)
    tape.step(*frames[:10])
    for measurements in frames[10:12]:  # over the slower link, and the recorder was killed meanwhile
        tape.frame(measurements)
        tape.take(tape.send(measurements, recorded=False))
    cut = tmp_path / "cut.mcap"
    tape.killed(cut)
    verdict = compare(Recording(cut))
    assert verdict.same
    assert (verdict.equal, verdict.unknown, verdict.open_end) == (10, 0, 2)
    tape.close()
    verdict = compare(Recording(tape.path))
    assert (verdict.equal, verdict.unknown, verdict.open_end) == (10, 2, 0)  # nothing was cut off: they are missing


def test_another_back_end_writes_results(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    tape, frames = Tape(tmp_path), measured(30)
    tape.step(*frames)
    tape.end(frames[-1])
    for name, values in (("same", ()), ("paper", ("method=paper",))):
        assert replay_command.run(options(tape.path, values, tmp_path / name)) == 0
        assert "results in" in capsys.readouterr().out
    same, paper = ((tmp_path / name / "ego.tum.txt").read_text() for name in ("same", "paper"))
    assert same != paper
    assert len(same.splitlines()) == len(paper.splitlines()) == 31
    recorded = [estimate for estimate in tape.estimates if Status.END_OF_SOURCE not in estimate.status]
    recording = Recording(tape.path)
    again = [out for out in replay.estimates(recording, replay.back_end(recording)) if isinstance(out, Estimate)]
    assert again == recorded
    with pytest.raises(ConfigurationError, match="back end alone"):
        replay_command.run(options(tape.path, ["slam.frontend.x=1"], tmp_path / "no"))
    with pytest.raises(ConfigurationError, match="no_such"):
        replay_command.run(options(tape.path, ["slam.graph.no_such=1"], tmp_path / "no"))


def test_the_graph_is_written_as_g2o(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    tape, frames = Tape(tmp_path), measured(12)
    tape.step(*frames)
    tape.end(frames[-1])
    asked = options(tape.path, ("slam.weights.mode=paper",))
    asked.g2o = tmp_path / "drive.g2o"
    assert replay_command.run(asked) == 0
    assert "graph in" in capsys.readouterr().out
    _, weights = replay.back_end(Recording(tape.path))
    expected = list(g2o_lines(frames, msgspec.structs.replace(weights, mode="paper")))
    assert sum(line.startswith("EDGE_SE2 ") for line in expected) > len(frames)
    assert asked.g2o.read_text().splitlines() == expected
    asked.g2o = tmp_path / "nowhere" / "drive.g2o"
    with pytest.raises(RecordingError, match="can't be written"):
        replay_command.run(asked)
