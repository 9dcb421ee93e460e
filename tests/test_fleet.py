"""Many vehicles at one router, over real sessions with mutual TLS: access, floods, lost vehicles.

Certificates come from deploy/certificates.sh. No test asserts how fast something is: what is sent next is sent when
what was sent before has come.
"""

from __future__ import annotations

import io
import os
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import msgspec
import pytest
import zenoh
from hypothesis import given
from hypothesis import strategies as st

from birdslam.runtime.cli.vehicle.top import FleetTable, top_all
from birdslam.runtime.configuration import ConfigurationError, FleetConfig, RouterConfig, load
from birdslam.runtime.fleet.link import open_link
from birdslam.runtime.fleet.listener import Fleet, FleetReading
from birdslam.runtime.fleet.router import access_control, router_config
from birdslam.runtime.fleet.uplink import FORWARDED, Uplink
from birdslam.runtime.topology import PROCESSES, QUERIES, TOPICS, alive_key, every_key, key_of, vehicle_and_topic
from birdslam.runtime.transport.bus import Bus, BusClosed, BusError, Publisher
from birdslam.runtime.wire import Health, encode
from birdslam.types import Estimate
from tests.test_bus import estimate, measurements, until
from tests.tls import certificate, connect_to, free_port, insert, needs_openssl

ROOT = Path(__file__).resolve().parent.parent
LIMIT_S = 60.0
MESSAGES_HZ, APART_S = 100.0, 0.012  # what the router lets through, and a little more time between two messages
NAMES = ("red", "green", "blue")
_LETTERS = "abzAZ09-_*$#?/ .@\n\0é\u0661"

processes = pytest.mark.processes


# --- names and keys: no processes ---


@given(st.text(_LETTERS, max_size=40), st.sampled_from(sorted({*TOPICS, *QUERIES})))
def test_vehicle_name_matches_only_its_own_keys(name: str, topic: str) -> None:
    try:
        key = key_of(name, topic)
    except ValueError:
        assert not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9_-]{0,31}", name)
        return
    assert vehicle_and_topic(key) == (name, topic)
    assert not set(key) & set("*$#?")
    wanted = zenoh.KeyExpr(every_key(topic))
    assert wanted.includes(zenoh.KeyExpr(key))
    assert not zenoh.KeyExpr(key).intersects(zenoh.KeyExpr(key_of("other" if name != "other" else "another", topic)))


@given(
    st.one_of(
        st.text(_LETTERS, max_size=60), st.builds("birdslam/{}/v1/{}".format, *[st.text(_LETTERS, max_size=34)] * 2)
    )
)
def test_received_key_names_at_most_one_vehicle(key: str) -> None:
    found = vehicle_and_topic(key)
    if found is not None:
        vehicle, topic = found
        assert key_of(vehicle, "estimate")  # a name that may be one
        assert key == f"birdslam/{vehicle}/v1/{topic}"
        assert "*" not in key


@given(st.text(alphabet="abc*/$ .-_", min_size=1, max_size=12))
def test_name_with_wildcard_is_refused_in_any_table(name: str) -> None:
    good = re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9_-]{0,31}", name) is not None
    for table in (RouterConfig, FleetConfig):
        try:
            msgspec.convert({"vehicles": [name]}, table)
        except msgspec.ValidationError:
            assert not good
        else:
            assert good


@given(st.lists(st.from_regex(r"[ab0][ab_-]{0,3}", fullmatch=True), min_size=1, max_size=4, unique=True), st.data())
def test_vehicle_may_write_only_its_own_keys(names: list[str], data: st.DataObject) -> None:
    access = access_control(tuple(names), ("operator",))
    rules = {rule["id"]: rule for rule in access["rules"]}
    subjects = {subject["id"]: subject["cert_common_names"] for subject in access["subjects"]}
    speaker, named = data.draw(st.sampled_from(names)), data.draw(st.sampled_from([*names, "other"]))
    topic = data.draw(st.sampled_from(sorted({*TOPICS, *QUERIES})))
    writing = {"put", "delete", "declare_queryable", "reply", "liveliness_token"}

    def may(common_name: str, message: str, key: str) -> bool:
        return any(
            message in rules[name]["messages"]
            and rules[name]["flows"] == ["ingress"]
            and any(zenoh.KeyExpr(allowed).includes(zenoh.KeyExpr(key)) for allowed in rules[name]["key_exprs"])
            for policy in access["policies"]
            if any(common_name in subjects[subject] for subject in policy["subjects"])
            for name in policy["rules"]
        )

    own = f"vehicle {speaker}"
    assert may(own, "put", key_of(named, topic)) == (named == speaker and topic in FORWARDED)
    assert may(own, "liveliness_token", alive_key(named, "optimize")) == (named == speaker)
    assert may(own, "reply", key_of(named, topic)) == (named == speaker and topic in {*FORWARDED, *QUERIES})
    assert not any(may(own, message, key_of(named, topic)) for message in ("delete", "declare_subscriber", "query"))
    assert not any(may("operator", message, key_of(named, topic)) for message in writing)
    assert not any(may(speaker, message, key_of(named, topic)) for message in (*writing, "query"))  # a name alone


# --- real sessions ---


@pytest.fixture(scope="module")
def tls(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Certificates of the router, three vehicles and two listeners; in `other`, a vehicle of another authority."""
    folder = tmp_path_factory.mktemp("tls")
    certificate(folder, "router", "127.0.0.1", "localhost")
    for name in NAMES:
        certificate(folder, "uplink", name)
    for name in ("operator", "stranger"):
        certificate(folder, "planner", name)
    certificate(folder / "other", "uplink", "red")
    return folder


@pytest.fixture
def port() -> Iterator[int]:
    with free_port() as number:
        yield number


def router_table(tls: Path, port: int, **changes: Any) -> RouterConfig:
    table = RouterConfig(
        listen=f"tls/127.0.0.1:{port}",
        ca=str(tls / "ca.pem"),
        certificate=str(tls / "router.pem"),
        key=str(tls / "router.key"),
        vehicles=NAMES,
        listeners=("operator",),
        messages_hz=MESSAGES_HZ,
    )
    return msgspec.structs.replace(table, **changes)


def link(tls: Path, port: int, name: str, **changes: Any) -> FleetConfig:
    table = FleetConfig(
        router=f"tls/127.0.0.1:{port}",
        ca=str(tls / "ca.pem"),
        certificate=str(tls / f"{name}.pem"),
        key=str(tls / f"{name}.key"),
    )
    return msgspec.structs.replace(table, **changes)


def now_estimate(frame_id: int) -> Estimate:
    return msgspec.structs.replace(estimate(frame_id), t_utc_ns=time.time_ns())


class Vehicle:
    """A vehicle's bus with its optimizer, and its uplink."""

    def __init__(self, name: str, base: Path, tls: Path, port: int, **changes: Any) -> None:
        self.name = name
        self.bus = Bus(name, "optimize", hub=True, runtime_dir=base)
        self.estimates, self.healths = self.bus.publisher("estimate"), self.bus.publisher("health/optimize")
        self.bus.declare_alive()
        config = link(tls, port, f"{name}.vehicle", **changes)
        self.session = open_link(config, LIMIT_S)
        self.uplink = Uplink(name, config, self.session, base)
        assert self.estimates.wait_matched(LIMIT_S)

    def close(self) -> None:
        self.uplink.close()
        self.bus.close()


@contextmanager
def opened(*ends: Any) -> Iterator[None]:
    with ExitStack() as stack:
        for end in ends:
            stack.callback(end.close)
        yield


def arrived(vehicle: Vehicle, fleet: Fleet, frame_id: int) -> bool:
    found = fleet.latest(vehicle.name).estimate if vehicle.name in fleet.vehicles else None
    return found is not None and found.frame_id == frame_id


def first(vehicle: Vehicle, fleet: Fleet) -> None:
    """Waits until vehicle and listener are connected and no message is in transit."""
    until(lambda: vehicle.name in fleet.vehicles and fleet.latest(vehicle.name).alive, f"{vehicle.name} is alive")
    end_s, frame_id = time.monotonic() + LIMIT_S, 0
    while not arrived(vehicle, fleet, frame_id):
        assert time.monotonic() < end_s
        frame_id += 1
        vehicle.estimates.put(now_estimate(frame_id))
        fleet.wait(1.0)


def say(vehicle: Vehicle, fleet: Fleet) -> FleetReading:
    """The vehicle's next estimate, as far from the one before as the router demands, and waited for."""
    time.sleep(APART_S)
    frame_id = 1 + (fleet.latest(vehicle.name).estimate or estimate(0)).frame_id
    vehicle.estimates.put(now_estimate(frame_id))
    until(lambda: arrived(vehicle, fleet, frame_id), f"estimate {frame_id} of {vehicle.name}")
    return fleet.latest(vehicle.name, 1e6)


@processes
@needs_openssl
def test_one_listener_follows_three_vehicles(tmp_path_factory: pytest.TempPathFactory, tls: Path, port: int) -> None:
    base = tmp_path_factory.mktemp("f")
    expected = link(tls, port, "operator", vehicles=(*NAMES, "white"))
    with zenoh.open(router_config(router_table(tls, port))):
        vehicles = [Vehicle(name, base, tls, port) for name in NAMES]
        with opened(*vehicles), Fleet(expected) as fleet, zenoh.open(raw_config(tls, port, "operator")) as raw:
            keys: set[str] = set()
            ends = [raw.declare_subscriber(key, lambda s: keys.add(str(s.key_expr))) for key in ("**", "birdslam/**")]
            for vehicle in vehicles:
                first(vehicle, fleet)
            for _ in range(5):
                for vehicle in vehicles:
                    reading = say(vehicle, fleet)
                    assert reading.usable
                    assert reading.trace.stages[-1].node == "uplink"
            assert [fleet.received(name).lost for name in NAMES] == [0, 0, 0]
            red = vehicles[0]
            red.healths.put(Health(node="optimize", t_ns=1, frames=7))
            until(lambda: (h := fleet.health("red", "optimize")) is not None and h.frames == 7, "a health")
            assert fleet.alive("red") == {"optimize"}
            red.bus.publisher("measurements").put(measurements(1))
            red.bus.answer_queries({"configuration": lambda _: (FleetConfig(router="tls/x:1"),)})
            until(lambda: fleet.configuration("red") is not None, "an answer through router and uplink")
            assert fleet.trajectory("red", timeout_s=0.3) is None  # its supervisor is not there
            assert [r.vehicle for r in fleet.readings()] == sorted((*NAMES, "white"))
            assert fleet.latest("white").silent_ms == float("inf")
            silent = next(r for r in fleet.estimates(200.0) if r.vehicle == "white")  # without a message from it
            assert not silent.alive
            assert not silent.on_time
            say(red, fleet)
            table = FleetTable(fleet).table()
            assert "4 vehicles: 3 alive" in table
            rows = {line.split()[0]: line.split() for line in table.splitlines()}
            assert rows["red"][1:3] == ["alive", "yes"]
            assert rows["white"][1] == "UNHEARD"
            assert not keys  # a wildcard over more than the list reads nothing
            del ends


def raw_config(tls: Path, port: int, name: str, authority: str = "ca.pem", limit_s: float = LIMIT_S) -> zenoh.Config:
    """A session without our client's manners."""
    config = zenoh.Config()
    insert(config, {"mode": "client", "scouting/multicast/enabled": False, "transport/link/protocols": ["tls"]})
    insert(config, connect_to(port, tls, name, authority, limit_s))
    return config


@processes
@needs_openssl
def test_each_certificate_has_only_its_permissions(tls: Path, port: int) -> None:
    with ExitStack() as stack:
        stack.enter_context(zenoh.open(router_config(router_table(tls, port))))
        fleet = stack.enter_context(Fleet(link(tls, port, "operator")))
        red, green, operator, stranger = (
            stack.enter_context(zenoh.open(raw_config(tls, port, name)))
            for name in ("red.vehicle", "green.vehicle", "operator", "stranger")
        )
        overheard: list[str] = []
        ears = []
        for name in ("green.vehicle", "stranger"):
            session = stack.enter_context(zenoh.open(raw_config(tls, port, name)))  # a session hears its own words
            ears.append(session)
            for key in ("**", every_key("estimate"), key_of("red", "estimate")):
                stack.callback(session.declare_subscriber(key, lambda s: overheard.append(str(s.key_expr))).undeclare)
        liars = [stack.enter_context(zenoh.open(raw_config(tls, port, n))) for n in ("blue.vehicle", "operator")]
        lie, truth = encode(now_estimate(666)), encode(now_estimate(1))
        tokens = []
        for liar in (*liars, operator, stranger):
            tokens.append(liar.liveliness().declare_token(alive_key("red", "optimize")))
            tokens.append(liar.declare_queryable(key_of("red", "map"), lambda q: q.reply(key_of("red", "map"), b"lie")))
        number = 0

        def came() -> bool:
            nonlocal number
            number += 1
            for liar in (*liars, operator, stranger):
                for key in (key_of("red", "estimate"), "birdslam/*/v1/estimate", "birdslam/red/**"):
                    liar.put(key, lie)
                liar.delete(key_of("red", "estimate"))
            red.put(key_of("red", "estimate"), truth)
            green.put(key_of("green", "estimate"), truth)
            return {"red", "green"} <= set(fleet.vehicles) and fleet.received("red").estimates >= 5

        until(came, "true estimates")
        for name in ("red", "green"):
            found = fleet.latest(name).estimate
            assert found.frame_id == 1
            assert fleet.received(name).malformed == 0
        assert "blue" not in fleet.vehicles
        assert fleet.refused == 0
        assert fleet.alive("red") == frozenset()  # only the vehicle declares its liveliness
        assert fleet.map("red", timeout_s=0.3) is None
        assert not overheard
        for session in ears:
            assert not list(session.get(key_of("red", "map"), timeout=0.3))


@processes
@needs_openssl
def test_connection_needs_a_certificate_of_the_authority(tls: Path, port: int) -> None:
    with zenoh.open(router_config(router_table(tls, port))):
        for name, authority in (("", "ca.pem"), ("other/red.vehicle", "ca.pem")):
            with pytest.raises(zenoh.ZError):
                zenoh.open(raw_config(tls, port, name, authority, limit_s=0.5))
        wrong = link(tls, port, "operator", ca=str(tls / "other/ca.pem"))  # a router of somebody else's
        with pytest.raises(BusError, match="no connection within"):
            open_link(wrong, 0.5)


@processes
@needs_openssl
def test_flood_and_crash_do_not_affect_other_vehicles(
    tmp_path_factory: pytest.TempPathFactory, tls: Path, port: int
) -> None:
    base = tmp_path_factory.mktemp("f")
    with zenoh.open(router_config(router_table(tls, port))):
        red, green, blue = vehicles = [Vehicle(name, base, tls, port) for name in NAMES]
        with opened(*vehicles), Fleet(link(tls, port, "operator")) as fleet:
            for vehicle in vehicles:
                first(vehicle, fleet)
            before = {name: fleet.received(name) for name in NAMES}
            stop, sent = threading.Event(), [0]
            flood = Publisher(red.session, key_of("red", "estimate"), TOPICS["estimate"], "flood", False)

            def flooding() -> None:
                while not stop.is_set():
                    flood.put(now_estimate(9_999))
                    sent[0] += 1

            thread = threading.Thread(target=flooding, daemon=True)
            thread.start()
            until(lambda: sent[0] > 100, "a flood")
            for vehicle in (green, blue) * 20:
                say(vehicle, fleet)
            stop.set()
            thread.join()
            heard = fleet.received("red").estimates - before["red"].estimates
            assert heard < sent[0] / 2  # the router has thinned it
            red.session.close()
            until(lambda: not fleet.latest("red").alive, "red is not alive")
            for vehicle in (green, blue) * 5:
                say(vehicle, fleet)
            for name in ("green", "blue"):
                assert fleet.received(name).estimates - before[name].estimates == 25
                assert fleet.received(name).lost == before[name].lost
                assert fleet.received(name).malformed == 0
                assert fleet.latest(name, 1e6).usable
            told = next(r for r in fleet.estimates(50.0) if r.vehicle == "red" and not r.on_time)
            assert not told.alive


@processes
@needs_openssl
def test_restarted_router_is_found(tmp_path_factory: pytest.TempPathFactory, tls: Path, port: int) -> None:
    table = router_table(tls, port)
    router = zenoh.open(router_config(table))
    red = Vehicle("red", tmp_path_factory.mktemp("f"), tls, port)
    with opened(red), Fleet(link(tls, port, "operator")) as fleet:
        first(red, fleet)
        router.close()
        until(lambda: not fleet.connected and not fleet.latest("red").alive, "the router is gone")
        assert "THE ROUTER IS GONE" in FleetTable(fleet).table()
        with zenoh.open(router_config(table)):
            first(red, fleet)
            assert fleet.latest("red", 1e6).usable
            red.bus.close()  # the run ends, its uplink stays
            until(lambda: not fleet.latest("red").alive, "red's run has ended")


@pytest.mark.slow
@processes
@needs_openssl
def test_commands_reconnect(tmp_path_factory: pytest.TempPathFactory, tls: Path, port: int) -> None:
    base = tmp_path_factory.mktemp("f")
    (base / "router.toml").write_text(
        f'[router]\nlisten = "tls/127.0.0.1:{port}"\nca = "{tls}/ca.pem"\ncertificate = "{tls}/router.pem"\n'
        f'key = "{tls}/router.key"\nvehicles = ["red"]\nlisteners = ["operator"]\n'
    )
    (base / "red.toml").write_text(
        f'vehicle = "red"\n[runtime]\nruntime_dir = "{base}"\n[fleet]\nrouter = "tls/127.0.0.1:{port}"\n'
        f'ca = "{tls}/ca.pem"\ncertificate = "{tls}/red.vehicle.pem"\nkey = "{tls}/red.vehicle.key"\n'
    )
    (base / "operator.toml").write_text(
        f'[fleet]\nrouter = "tls/127.0.0.1:{port}"\nca = "{tls}/ca.pem"\ncertificate = "{tls}/operator.pem"\n'
        f'key = "{tls}/operator.key"\nvehicles = ["red"]\n'
    )
    environment = os.environ | {"RUST_LOG": "error,zenoh::net::routing::interceptor::access_control=trace"}
    started: list[subprocess.Popen[bytes]] = []

    def start(*what: str, says: str) -> tuple[subprocess.Popen[bytes], Path]:
        """Waits until a command has printed this; zenoh logs to the standard output too."""
        log = base / f"{len(started)}.log"
        with log.open("wb") as out:
            command = [sys.executable, "-P", "-m", "birdslam.runtime.cli.main", *what]
            started.append(subprocess.Popen(command, stdout=out, stderr=out, env=environment))
        until(lambda: says in log.read_text(), says)
        return started[-1], log

    def end() -> None:
        for process in started:
            process.kill()
            process.wait()

    with ExitStack() as stack:
        stack.callback(end)
        bus = stack.enter_context(Bus("red", "optimize", hub=True, runtime_dir=base))
        estimates = bus.publisher("estimate")
        bus.declare_alive()
        uplink, uplink_log = start("uplink", str(base / "red.toml"), says="no connection within")
        router, log = start("router", str(base / "router.toml"), says="is open for 1 vehicles")
        until(lambda: "is connected to" in uplink_log.read_text(), "the uplink has found its router")
        fleet = stack.enter_context(Fleet(load(base / "operator.toml").fleet, LIMIT_S))

        def comes() -> bool:
            estimates.put(now_estimate(5))
            return fleet.latest("red", 5e3).usable

        until(comes, "an estimate through the commands")
        out = io.StringIO()
        assert top_all(base / "operator.toml", once=True, out=out) == 0
        assert re.search(r"^red +(alive|LATE) ", out.getvalue(), re.M)

        red = stack.enter_context(zenoh.open(raw_config(tls, port, "red.vehicle")))
        refusal = re.compile(r"CertCommonName\(vehicle red\).* unauthorized to Put .*on birdslam/green/v1/estimate")

        def told() -> bool:
            red.put(key_of("green", "estimate"), b"a lie")
            return refusal.search(log.read_text()) is not None

        until(told, "the router's log tells of the refusal")

        router.kill()
        until(lambda: not fleet.latest("red").alive and not fleet.connected, "the router is gone")
        second, _ = start("router", str(base / "router.toml"), says="is open")
        until(lambda: fleet.connected and fleet.latest("red").alive, "red is alive again")
        until(comes, "an estimate through the second router")

        uplink.send_signal(signal.SIGSTOP)  # as one whose network is gone: its connection stays, and is silent
        until(lambda: not fleet.latest("red").alive, "red is given up")
        uplink.send_signal(signal.SIGCONT)
        until(comes, "an estimate of red after its silence")
        uplink.kill()
        until(lambda: not fleet.latest("red").alive, "red is not alive")
        second.send_signal(signal.SIGTERM)
        assert second.wait(LIMIT_S) == 0


@processes
@needs_openssl
def test_an_uplink_keeps_its_configured_rate(tmp_path_factory: pytest.TempPathFactory, tls: Path, port: int) -> None:
    """An hour apart at the most: of ten estimates two leave the vehicle, and none counts as lost."""
    base = tmp_path_factory.mktemp("f")
    with zenoh.open(router_config(router_table(tls, port))):
        red = Vehicle("red", base, tls, port, estimates_hz=1 / 3600)
        with opened(red), Fleet(link(tls, port, "operator")) as fleet:
            until(lambda: "red" in fleet.vehicles and fleet.latest("red").alive, "red is alive")
            heard = red.bus.subscriber("estimate", depth=64)
            for number in range(10):
                red.estimates.put(now_estimate(number))
                until(lambda n=number: heard.newest and heard.newest.record.frame_id == n, "it")
            red.healths.put(Health(node="optimize", t_ns=1))
            until(lambda: fleet.health("red", "optimize") is not None, "what was said after them")
            assert fleet.received("red").estimates <= 2
            assert fleet.received("red").lost == 0


@processes
@needs_openssl
def test_closing_a_client_wakes_its_waiters(tls: Path, port: int) -> None:
    with zenoh.open(router_config(router_table(tls, port))):
        fleet = Fleet(link(tls, port, "operator"))
        woken: list[type] = []

        def wait() -> None:
            try:
                fleet.wait()
            except BusClosed as error:
                woken.append(type(error))

        thread = threading.Thread(target=wait)
        thread.start()
        fleet.close()
        thread.join(LIMIT_S)
        assert woken == [BusClosed]
        fleet.close()


@needs_openssl
@processes
def test_invalid_table_names_its_key(tls: Path) -> None:
    for changes, key in (
        ({"listen": "tcp/127.0.0.1:1"}, "router.listen"),
        ({"ca": str(tls / "none.pem")}, "router.ca"),
        ({"key": ""}, "router.key"),
        ({"vehicles": ()}, "router.vehicles"),
    ):
        with pytest.raises(ConfigurationError, match=re.escape(key)):
            router_config(router_table(tls, 1, **changes))
    for changes, key in (({"router": "tcp/h:1"}, "fleet.router"), ({"certificate": "none.pem"}, "fleet.certificate")):
        with pytest.raises(ConfigurationError, match=re.escape(key)):
            open_link(link(tls, 1, "operator", **changes), 0.1)


def test_only_estimates_and_health_leave_a_vehicle() -> None:
    assert set(FORWARDED) == {"estimate", *(f"health/{node}" for node in PROCESSES)}
