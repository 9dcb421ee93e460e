"""Progress: a refreshed line on a terminal, a line per minute elsewhere, remaining time once it is known."""

from __future__ import annotations

import io

import pytest

from birdslam.runtime.progress import Progress, time_to_go, with_progress


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
