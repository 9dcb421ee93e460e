"""Distributions of fixed size, and stages that add up to the whole; signs of life; the live line."""

from __future__ import annotations

import io
import math
import os

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from birdslam.runtime.latency import Distribution, key_of, stages
from birdslam.runtime.process.vitals import Vitals
from birdslam.runtime.supervision.live import LiveLine
from birdslam.runtime.wire import Trace

MS = 1_000_000


@given(st.lists(st.floats(0.01, 5e4), min_size=1, max_size=200), st.floats(1.0, 100.0))
def test_a_percentile_is_exact_to_one_percent(values_ms: list[float], percent: float) -> None:
    distribution = Distribution()
    for value in values_ms:
        distribution.add(value)
    exact = float(np.percentile(values_ms, percent, method="inverted_cdf"))
    assert distribution.percentile(percent) == pytest.approx(exact, rel=0.0101)
    assert distribution.summary()["max"] == pytest.approx(max(values_ms), abs=1e-3)


def test_empty_histogram_has_no_percentile_and_any_value_fits() -> None:
    distribution = Distribution()
    assert math.isnan(distribution.percentile(50.0))
    assert distribution.summary() == {}
    for value in (-1.0, 0.0, 1e9):
        distribution.add(value)
    assert (distribution.count, distribution.max_ms) == (3, 1e9)


def test_the_stages_add_up_to_the_age() -> None:
    trace = (
        Trace()
        .after("capture", 10 * MS, 11 * MS)
        .after("perceive", 13 * MS, 40 * MS)
        .after("optimize", 43 * MS, 44 * MS, arrived_ns=41 * MS)
    )
    parts = dict(stages(trace, 50 * MS))
    assert parts == {
        "capture": 1.0,
        "capture -> perceive": 2.0,
        "perceive": 27.0,
        "perceive -> optimize": 1.0,
        "optimize queue": 2.0,
        "optimize": 1.0,
        "optimize -> planner": 6.0,
    }
    assert sum(parts.values()) == 40.0
    assert list(stages(Trace(), 5)) == []
    assert [key_of(part) for part in parts][1:5] == [
        "capture_to_perceive",
        "perceive",
        "perceive_to_optimize",
        "optimize_queue",
    ]


def test_vitals_are_shared_through_their_descriptor() -> None:
    here = Vitals()
    there = Vitals(os.dup(here.fd))
    there.beat()
    there.count(frames=7, ready=1)
    assert (here["frames"], here["ready"], here["dropped"]) == (7, 1, 0)
    assert here["beat_ns"] > 0
    here.close()
    there.close()
    assert here["frames"] == 7


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_plain_lines_where_there_is_no_terminal() -> None:
    stream = io.StringIO()
    live = LiveLine(stream)
    live.update("first")
    live.update("at once again")
    live.say("warning")
    assert stream.getvalue() == "first\nwarning\n"


def test_one_refreshed_line_on_a_terminal() -> None:
    stream = Terminal()
    live = LiveLine(stream)
    live.update("x" * 500)
    live.say("warning")
    assert stream.getvalue().startswith("\r\x1b[Kxxx")
    assert "\n" not in stream.getvalue().removesuffix("warning\n")
    assert stream.getvalue().endswith("\r\x1b[Kwarning\n")
