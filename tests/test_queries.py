"""Queries of the bus: retained messages, planners' queries, and missing replies."""

from __future__ import annotations

import itertools
import math
import threading
from pathlib import Path
from typing import Any

import msgspec
import pytest
import zenoh
from hypothesis import given
from hypothesis import strategies as st

from birdslam.geometry.se2 import SE2
from birdslam.lanes.amodal.atlas import Atlas
from birdslam.queries import MapSnapshot, TimedPose, Trajectory, VehiclePath
from birdslam.runtime.client import Planner
from birdslam.runtime.configuration import Configuration, SourceConfig
from birdslam.runtime.supervision.query_server import QueryServer
from birdslam.runtime.topology import QUERIES, TOPICS, key_of
from birdslam.runtime.transport.bus import BusClosed, BusError
from birdslam.runtime.transport.queries import WAITING_QUERIES, QueryRefused, positive
from birdslam.runtime.transport.reply_parts import map_parts, trajectory_parts, whole_map, whole_trajectory
from birdslam.runtime.wire import Health, Part, encode
from birdslam.types import MapUpdate
from tests.foreign_sender import foreign_session
from tests.test_bus import LIMIT_S, estimate, measurements, until

pytestmark = pytest.mark.processes

CONFIGURATION = Configuration(source=SourceConfig(uri="rtsp://driver:secret@10.0.0.7/front"))


def at(number: int, x_m: float, y_m: float = 0.0) -> Any:
    return msgspec.structs.replace(
        estimate(number), t_source_ns=number * 100_000_000, T_world_ego=SE2(x_m, y_m, 0.0), epoch=3
    )


def test_last_messages_are_retained(join: Any) -> None:
    join("supervisor", hub=True)
    perceive = join("perceive")
    out = perceive.publisher("measurements")
    for number in range(TOPICS["measurements"].retained + 5):  # without subscriber
        out.put(measurements(number))
    optimize = join("optimize")
    perceive.declare_alive()
    assert not optimize.wait_alive({"perceive"}, LIMIT_S)
    kept = optimize.retained("measurements")
    assert [message.record.frame_id for message in kept] == list(range(5, TOPICS["measurements"].retained + 5))
    assert [message.trace.stages[-1].node for message in kept] == ["perceive"] * len(kept)
    assert optimize.retained("estimate", timeout_s=0.2) == []  # never sent


def test_late_planner_gets_the_last_estimate(join: Any, base: Path) -> None:
    join("supervisor", hub=True)
    optimize = join("optimize")
    out = optimize.publisher("estimate")
    said = optimize.publisher("health/optimize")
    optimize.declare_alive()
    out.put(estimate(41))
    said.put(Health(node="optimize", t_ns=5, frames=7))
    with Planner("car", base) as planner:
        until(lambda: planner.latest().estimate is not None, "the last estimate")
        reading = planner.latest()
        assert reading.estimate.frame_id == 41
        assert reading.alive
        health = planner.health("optimize")
        assert (health.node, health.frames) == ("optimize", 7)
        assert planner.health("capture", timeout_s=0.2) is None


def test_replies_to_planner_queries(join: Any, base: Path) -> None:
    server = QueryServer(CONFIGURATION, hub := join("supervisor", hub=True))
    with Planner("car", base) as planner:
        hub.declare_alive()
        until(lambda: planner.configuration() is not None, "an answer of the supervisor")
        with pytest.raises(BusError, match="there is no map yet"):
            planner.map()
        for number in range(50):
            server.add(at(number, float(number)))
            server.add_map(MapUpdate(epoch=3, frame_id=number, lanes_m=((float(number), 2.0),)))
        chart = planner.map()
        assert (chart.epoch, chart.frame_id) == (3, 49)
        assert sorted(chart.lanes_m) == [(float(number), 2.0) for number in range(50)]
        way = planner.trajectory()
        assert [pose.T_world_body.x_m for pose in way.ego] == [float(number) for number in range(50)]
        lately = planner.trajectory(last_s=1.0)
        assert [pose.frame_id for pose in lately.ego] == list(range(39, 50))
        for wrong in (0.0, -1.0, math.nan, math.inf):
            with pytest.raises(BusError, match="last_s"):
                planner.trajectory(last_s=wrong)
        told = planner.configuration()
        assert told["source"]["uri"] == "rtsp://10.0.0.7/front"
        assert msgspec.convert(told, Configuration).slam == CONFIGURATION.slam
        assert "secret" not in str(told)


def test_a_long_drive_is_answered_in_parts_that_fit(join: Any, base: Path) -> None:
    server = QueryServer(Configuration(), hub := join("supervisor", hub=True))
    with Planner("car", base) as planner:
        hub.declare_alive()
        until(lambda: planner.configuration() is not None, "an answer of the supervisor")
        atlas = Atlas(Configuration().atlas)
        for number in range(3000):
            server.add(here := at(number, float(number)))
            points = tuple((number + 0.3 * k, float(k)) for k in range(4))
            server.add_map(gained := MapUpdate(epoch=3, frame_id=number, lanes_m=points, landmarks_m=points))
            atlas.add(here)
            atlas.add(here, gained)
        way, chart = planner.trajectory(timeout_s=LIMIT_S), planner.map(timeout_s=LIMIT_S)
        assert way is not None
        assert chart is not None
        assert way == atlas.trajectory()
        assert chart == atlas.map()
        assert len(encode_all(map_parts(chart))) > 5


def encode_all(parts: Any) -> list[bytes]:
    return [encode(part) for part in parts]


points = st.lists(st.tuples(st.floats(-1e6, 1e6), st.floats(-1e6, 1e6)), max_size=30)


@given(st.integers(0, 4500), st.integers(0, 2500), st.booleans())
def test_map_is_reassembled(landmarks: int, lanes: int, named: bool) -> None:
    chart = MapSnapshot(
        epoch=1,
        frame_id=2,
        landmarks_m=tuple((float(k), 0.1) for k in range(landmarks)),
        lanes_m=tuple((float(k), 0.2) for k in range(lanes)),
        lane_ids=tuple(range(lanes)) if named else (),
    )
    parts = map_parts(chart)
    assert whole_map(parts) == chart
    assert len(encode_all(parts)) == max(1, -(-max(landmarks, lanes) // 1000))


@given(st.integers(0, 2000), st.lists(st.integers(0, 64), max_size=64))
def test_trajectory_is_reassembled(ego: int, vehicles: list[int]) -> None:
    def poses(count: int) -> tuple[TimedPose, ...]:
        return tuple(TimedPose(k, k * 10**17 // 5000, SE2(k + 0.1, 0.2, 0.3)) for k in range(count))

    way = Trajectory(
        epoch=1,
        frame_id=2,
        t_source_ns=3,
        ego=poses(ego),
        vehicles=tuple(VehiclePath(vehicle=n, poses=poses(count)) for n, count in enumerate(vehicles)),
    )
    parts = trajectory_parts(way)
    assert whole_trajectory(parts) == way
    assert encode_all(parts)


def test_wildcard_queries_get_no_reply(join: Any, base: Path) -> None:
    server = QueryServer(Configuration(), hub := join("supervisor", hub=True))
    server.add(at(1, 0.0))
    hub.declare_alive()
    with foreign_session(base) as guest:

        def answers(selector: str, limit_s: float) -> list[zenoh.Reply]:
            return [reply for reply in guest.get(selector, timeout=limit_s) if reply.ok is not None]

        until(lambda: answers(key_of("car", "map"), 2.0), "the map")
        for selector in ("birdslam/car/v1/*", "birdslam/**", "**"):
            assert answers(selector, 0.3) == []


def test_a_lost_part_of_a_reply_is_an_error(join: Any, base: Path) -> None:
    hub = join("supervisor", hub=True)
    key, answers = key_of("car", "map"), [(encode(MapSnapshot(epoch=1, frame_id=2)), encode(Part(1, 3)))]

    def answer(query: zenoh.Query) -> None:
        for data, attachment in answers:
            query.reply(key, data, attachment=attachment)
        query.drop()

    def answered() -> bool:
        try:
            return hub.query("map") != []
        except BusError:
            return True

    with foreign_session(base) as foreign:
        queryable = foreign.declare_queryable(key, answer)
        until(answered, "an answer")
        with pytest.raises(BusError, match="map: received 1 of the reply's 3 parts"):
            hub.query("map")
        for data, attachment in ((b"\xc1", encode(Part())), (answers[0][0], b"\x92\x00\x00")):
            answers[:] = [(data, attachment)]
            with pytest.raises(BusError, match="map: the reply is malformed"):
                hub.query("map")
        answers.clear()
        assert hub.query("map") == []
        queryable.undeclare()


def test_flood_of_queries_does_no_harm(join: Any, base: Path) -> None:
    hub, may_answer = join("supervisor", hub=True), threading.Event()
    way = Trajectory(epoch=1, frame_id=2, t_source_ns=3)

    def answer(parameters: Any) -> list[Trajectory]:
        assert may_answer.wait(LIMIT_S)
        return trajectory_parts(way)

    hub.answer_queries({"trajectory": answer})
    hub.publisher("estimate").put(estimate(1))  # is kept, and raised on the query thread
    with foreign_session(base) as foreign, Planner("car", base) as planner:

        def ask(topic: str) -> Any:
            return foreign.get(key_of("car", topic), zenoh.handlers.FifoChannel(8), timeout=LIMIT_S)

        until(lambda: any(reply.ok is not None for reply in ask("estimate")), "the hub's answer")
        handlers = [ask("trajectory") for _ in range(10 * WAITING_QUERIES)]
        assert any(reply.ok is not None for reply in ask("estimate"))  # so those before it have come
        may_answer.set()
        answered = sum(any(reply.ok is not None for reply in handler) for handler in handlers)
        assert 1 <= answered <= 2 * WAITING_QUERIES
        assert planner.trajectory(timeout_s=LIMIT_S) == way


def test_a_refusal_names_the_parameter() -> None:
    assert positive({}, "last_s") is None
    assert positive({"last_s": "2.5"}, "last_s") == 2.5
    for text in ("", "x", "nan", "inf", "-1", "0", "9" * 500):
        with pytest.raises(QueryRefused, match="last_s"):
            positive({"last_s": text}, "last_s")


def test_every_query_has_a_reply(join: Any) -> None:
    asked: dict[str, Any] = {}

    class Hub:
        def answer_queries(self, handlers: dict[str, Any]) -> None:
            asked.update(handlers)

    QueryServer(Configuration(), Hub())
    assert set(asked) == set(QUERIES)


def test_no_reply_is_reported_as_none(join: Any, base: Path) -> None:
    join("supervisor", hub=True)
    optimize = join("optimize")
    out = optimize.publisher("estimate")
    with Planner("car", base) as planner:
        readings = planner.estimates(max_age_ms=100.0)
        nothing = next(readings)
        assert (nothing.estimate, nothing.on_time, nothing.usable) == (None, False, False)
        assert out.wait_matched(LIMIT_S)
        optimize.declare_alive()
        until(lambda: planner.latest().alive, "the optimizer")
        out.put(estimate(1))
        fresh = next(reading for reading in readings if reading.estimate is not None)
        assert fresh.estimate.frame_id == 1
        stale = next(readings)
        assert stale.estimate == fresh.estimate
        assert stale.alive
        assert not stale.on_time
        assert stale.age_ms > 100.0
        assert not next(readings).on_time  # and again
        out.put(estimate(2))
        again = next(readings)
        while again.estimate is None or again.estimate.frame_id != 2:
            again = next(readings)
        planner.close()
        assert list(itertools.islice(readings, 3)) == []
        with pytest.raises(BusClosed):
            planner.wait(0.0)
