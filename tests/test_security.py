"""Access control: sessions at the gate and at the vehicle's sockets, accepted or refused.

Certificates come from deploy/certificates.sh, the gate's file is the one that is installed.
"""

from __future__ import annotations

import json
import os
import re
import select
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest
import zenoh

from birdslam.loops.map_pose import MapPose, MapState
from birdslam.runtime.client import Planner
from birdslam.runtime.configuration import load
from birdslam.runtime.gate import GateError, gate_config
from birdslam.runtime.supervision.query_server import QueryServer
from birdslam.runtime.topology import CAR, PROCESSES, QUERIES, TOPICS, alive_key, key_of
from birdslam.runtime.transport.bus import Bus, Publisher, Subscriber
from birdslam.runtime.transport.presence import runtime_dir_of, socket_path
from birdslam.runtime.wire import MAX_TRACE_BYTES, Health, Trace, WireError, decode, encode
from birdslam.types import Estimate, MapUpdate, SpeedReading
from tests.foreign_sender import foreign_session
from tests.mutations import Chance, mutated
from tests.test_bus import estimate, measurements, until
from tests.tls import certificate, connect_to, free_port, insert, needs_openssl

pytestmark = pytest.mark.processes

ROOT = Path(__file__).resolve().parent.parent
DEPLOY = ROOT / "deploy"
LIMIT_S = 60.0
ASKABLE = {*QUERIES, "estimate", "map_pose", *(f"health/{node}" for node in PROCESSES)}
READABLE = {"estimate", "map", "map_pose", *(f"health/{node}" for node in PROCESSES)}


@pytest.fixture(scope="module")
def certificates(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """`planner`, `stranger` and `car` of the vehicle's authority; in `other`, a planner and a vehicle of another."""
    folder = tmp_path_factory.mktemp("tls")
    for place in (folder, folder / "other"):
        certificate(place, "vehicle", "127.0.0.1", "localhost")
        certificate(place, "planner", "planner")
    certificate(folder, "planner", "stranger")
    certificate(folder, "car")
    return folder


def gate_file(folder: Path, certificates: Path, port: int, change: Callable[[str], str] = lambda text: text) -> Path:
    """The installed file with another port, and certificates of the test."""
    text = (DEPLOY / "gate.json5").read_text()
    text = text.replace("/etc/birdslam/tls", str(certificates)).replace("127.0.0.1:7447", f"127.0.0.1:{port}")
    path = folder / "gate.json5"
    path.write_text(change(text))
    return path


def outside(
    certificates: Path,
    port: int,
    name: str = "planner",
    *,
    mode: str = "client",
    authority: str = "ca.pem",
    limit_s: float = LIMIT_S,
) -> zenoh.Session:
    """A session from outside, by the planner's file that is installed. Raises ZError where it is not let in."""
    config = zenoh.Config.from_file(str(DEPLOY / "planner.json5"))
    settings = connect_to(port, certificates, name, authority, limit_s)
    settings["transport/link/tls"]["verify_name_on_connect"] = True
    protocols = ["tls", "unixsock-stream"]  # as one who would go past the gate
    insert(config, {"mode": mode, "listen/endpoints": [], "transport/link/protocols": protocols} | settings)
    return zenoh.open(config)


@dataclass
class Vehicle:
    """The vehicle's side: its three nodes, and all that anybody could write to."""

    base: Path
    port: int
    nodes: dict[str, Bus]
    publishers: dict[str, Publisher]
    listeners: dict[str, Subscriber]

    def say_all(self, number: int) -> None:
        """One message of every topic."""
        update = MapUpdate(epoch=0, frame_id=number, lanes_m=((1.0, 2.0),))
        times = {"t_source_ns": number, "t_capture_ns": number, "t_utc_ns": number}
        pose = MapPose(frame_id=number, **times, epoch=0, state=MapState.LOST)
        records = {"estimate": estimate(number), "measurements": measurements(number), "map": update, "map_pose": pose}
        for topic, publisher in self.publishers.items():
            publisher.put(records.get(topic) or Health(node=TOPICS[topic].producer, t_ns=number))


@dataclass
class Heard:
    """What a session from outside reads of all that it asks for."""

    keys: set[str] = field(default_factory=set)
    alive: set[str] = field(default_factory=set)
    ends: list[Any] = field(default_factory=list)

    def listen(self, session: zenoh.Session) -> None:
        for key in ("**", "birdslam/**", *(key_of("car", topic) for topic in TOPICS)):
            self.ends.append(session.declare_subscriber(key, lambda sample: self.keys.add(str(sample.key_expr))))
        tokens = session.liveliness().declare_subscriber(
            alive_key("car", "*"), lambda sample: self.alive.add(str(sample.key_expr)), history=True
        )
        self.ends.append(tokens)


@pytest.fixture
def vehicle(tmp_path_factory: pytest.TempPathFactory, certificates: Path) -> Iterator[Vehicle]:
    """The nodes on the bus, and the gate in a separate process."""
    base = tmp_path_factory.mktemp("run")
    (base / "car.toml").write_text('vehicle = "car"\n')
    with ExitStack() as stack:
        port = stack.enter_context(free_port())
        path = gate_file(base, certificates, port)
        hub = stack.enter_context(Bus("car", "supervisor", hub=True, runtime_dir=base))
        server = QueryServer(load(base / "car.toml"), hub)
        server.add(estimate(1))
        nodes = {name: stack.enter_context(Bus("car", name, runtime_dir=base)) for name in PROCESSES}
        for node in nodes.values():
            node.declare_alive()
        publishers = {t: nodes[TOPICS[t].producer].publisher(t) for t in TOPICS if t not in ("frame", *CAR.sends)}
        gate = subprocess.Popen(
            [
                *(sys.executable, "-P", "-m", "birdslam.runtime.gate", str(base / "car.toml"), str(path)),
                *("--runtime-dir", str(base)),
            ],
            stdout=subprocess.PIPE,
            text=True,
        )

        def end() -> None:
            gate.kill()
            gate.communicate()

        stack.callback(end)
        assert "is open" in gate.stdout.readline()
        listeners = {topic: nodes["capture"].subscriber(topic, depth=256) for topic in TOPICS}
        yield Vehicle(base, port, nodes, publishers, listeners)
        gate.terminate()
        assert gate.wait(LIMIT_S) == 0


def hear(vehicle: Vehicle, session: zenoh.Session, enough: set[str], limit_s: float = LIMIT_S) -> Heard:
    """What it hears of messages of every topic, until all of `enough`, or the limit."""
    heard, number, end_s = Heard(), 0, time.monotonic() + limit_s
    heard.listen(session)
    while time.monotonic() < end_s and not (heard.keys >= enough and enough):
        vehicle.say_all(number := number + 1)
        until_heard(vehicle.listeners["estimate"], number)
    return heard


def until_heard(listener: Subscriber, number: int) -> None:
    """The vehicle's own listener has that estimate: whoever may have it, has had its chance."""
    until(lambda: (m := listener.recv(LIMIT_S)) is not None and m.record.frame_id == number, f"estimate {number}")
    time.sleep(0.02)  # the hop more that the gate is


def keys(topics: set[str]) -> set[str]:
    return {key_of("car", topic) for topic in topics}


def test_gate_file_covers_exactly_the_topology() -> None:
    config = zenoh.Config.from_file(str(DEPLOY / "gate.json5"))
    access = json.loads(config.get_json("access_control"))
    alive = zenoh.KeyExpr(alive_key("car", "optimize"))
    for rule in access["rules"]:
        if rule["key_exprs"] == ["birdslam/*/v1/speed"]:
            continue  # see the test of the car
        allowed = [zenoh.KeyExpr(key) for key in rule["key_exprs"]]
        readable = {t for t in TOPICS if any(key.includes(zenoh.KeyExpr(key_of("car", t))) for key in allowed)}
        assert readable == READABLE, rule["id"]
        assert any(key.includes(alive) for key in allowed)
        assert not any(key.intersects(zenoh.KeyExpr("@/**")) for key in allowed)  # zenoh's own administration
    assert access["default_permission"] == "deny"


@needs_openssl
def test_planner_reads_only_permitted_topics(vehicle: Vehicle, certificates: Path) -> None:
    with outside(certificates, vehicle.port) as session:
        heard = hear(vehicle, session, keys(READABLE))
        until(lambda: len(heard.alive) == len(PROCESSES), "all nodes are alive")
        assert heard.keys == keys(READABLE)  # no measurements, no frames
        assert heard.alive == {alive_key("car", node) for node in PROCESSES}


def answers(session: zenoh.Session, topic: str, limit_s: float = 2.0) -> int:
    """How many messages answer a query of the key."""
    return sum(reply.ok is not None for reply in session.get(key_of("car", topic), timeout=limit_s))


@needs_openssl
def test_planner_sends_only_permitted_queries(vehicle: Vehicle, certificates: Path) -> None:
    with outside(certificates, vehicle.port) as session, outside(certificates, vehicle.port, "stranger") as stranger:
        hear(vehicle, session, keys(READABLE))  # each node has a retained message
        for topic in ASKABLE:
            until(lambda topic=topic: answers(session, topic) == 1, f"an answer about {topic}")
        assert vehicle.nodes["optimize"].retained("measurements", LIMIT_S)  # inside, they are there to be had
        assert answers(session, "measurements", 0.5) == 0
        assert answers(session, "frame", 0.5) == 0
        for topic in (*ASKABLE, "measurements"):
            assert answers(stranger, topic, 0.3) == 0, topic
        refused = session.get(f"{key_of('car', 'trajectory')}?last_s=-1", timeout=LIMIT_S)
        assert [bytes(reply.err.payload) for reply in refused if reply.err] == [b"last_s=-1: needs a positive number"]


@needs_openssl
def test_outsiders_cannot_write(vehicle: Vehicle, certificates: Path) -> None:
    with outside(certificates, vehicle.port) as session, outside(certificates, vehicle.port) as other:
        heard = hear(vehicle, other, keys(READABLE))
        for listener in vehicle.listeners.values():
            while listener.recv(0.0):
                pass
        said = SpeedReading(t_ns=9_999, speed_mps=9.0, sigma_mps=0.1)
        valid = {"estimate": estimate(9_999), "measurements": measurements(9_999), "speed": said}
        publishers = {topic: session.declare_publisher(key_of("car", topic)) for topic in TOPICS}
        token = session.liveliness().declare_token(alive_key("car", "impostor"))
        queryable = session.declare_queryable("birdslam/car/v1/**", lambda query: query.reply(query.key_expr, b"lie"))
        for _ in range(20):
            for topic, publisher in publishers.items():
                publisher.put(encode(valid.get(topic) or Health(node="capture", t_ns=9_999)))
                session.delete(key_of("car", topic))
            session.put("birdslam/**", b"wide")
        vehicle.say_all(77)
        until_heard(vehicle.listeners["estimate"], 77)
        lies = [
            (topic, message.record)
            for topic, listener in vehicle.listeners.items()
            for message in iter(lambda listener=listener: listener.recv(0.0), None)
            if getattr(message.record, "frame_id", getattr(message.record, "t_ns", 0)) == 9_999
        ]
        assert not lies
        assert all(listener.malformed == 0 for listener in vehicle.listeners.values())
        assert "impostor" not in vehicle.nodes["capture"].alive
        assert alive_key("car", "impostor") not in heard.alive
        with foreign_session(vehicle.base) as inside:
            until(lambda: answers(inside, "estimate"), "an answer")
            for topic in (*ASKABLE, "measurements", "frame"):
                asked = inside.get(key_of("car", topic), timeout=1.0, target=zenoh.QueryTarget.ALL)
                assert b"lie" not in [bytes(reply.ok.payload) for reply in asked if reply.ok], topic
        queryable.undeclare()
        token.undeclare()


@needs_openssl
def test_only_the_car_may_publish_speed(vehicle: Vehicle, certificates: Path) -> None:
    with outside(certificates, vehicle.port, "car") as car, ExitStack() as others:
        heard = Heard()
        heard.listen(others.enter_context(outside(certificates, vehicle.port, "car")))
        publishers = {topic: car.declare_publisher(key_of("car", topic)) for topic in TOPICS}
        token = car.liveliness().declare_token(alive_key("car", "impostor"))
        liars = [others.enter_context(outside(certificates, vehicle.port, name)) for name in ("planner", "stranger")]
        reading = SpeedReading(t_ns=77, speed_mps=12.5, sigma_mps=0.1)
        lie = SpeedReading(t_ns=9_999, speed_mps=40.0, sigma_mps=0.1)
        came: list[int] = []

        def comes() -> bool:
            for liar in liars:
                liar.put(key_of("car", "speed"), encode(lie))
            for topic, publisher in publishers.items():
                publisher.put(encode(reading if topic == "speed" else estimate(9_999)))
            car.delete(key_of("car", "speed"))
            message = vehicle.listeners["speed"].recv(0.1)
            came.extend([message.record.t_ns] if message else [])
            return len(came) >= 5

        until(comes, "readings of the car")
        vehicle.say_all(77)
        until_heard(vehicle.listeners["estimate"], 77)
        assert set(came) == {77}
        for topic, listener in vehicle.listeners.items():
            assert listener.malformed == 0, topic
            while (message := listener.recv(0.0)) is not None:
                assert getattr(message.record, "frame_id", 0) != 9_999, topic
        assert not heard.keys
        assert not heard.alive
        assert "impostor" not in vehicle.nodes["capture"].alive
        assert answers(car, "estimate", 0.3) == answers(car, "map", 0.3) == 0
        token.undeclare()


@needs_openssl
def test_the_example_of_a_car(vehicle: Vehicle, certificates: Path, tmp_path: Path) -> None:
    text = (DEPLOY / "car.json5").read_text().replace(":7447", f":{vehicle.port}")
    text = re.sub(r'"(ca|car)\.(pem|key)"', lambda m: json.dumps(str(certificates / m[0].strip('"'))), text)
    (tmp_path / "car.json5").write_text(text)
    hub = socket_path(runtime_dir_of("car", vehicle.base), "hub")
    for where, turn in ((tmp_path / "car.json5", None), (hub, -0.5)):
        example = subprocess.Popen(
            [sys.executable, str(ROOT / "docs" / "examples" / "car_speed.py"), str(where)],
            stdin=subprocess.PIPE,
            text=True,
        )
        try:
            found: list[SpeedReading] = []

            def comes(example: Any = example, found: list[SpeedReading] = found, turn: float | None = turn) -> bool:
                example.stdin.write(f"12.5{'' if turn is None else f' {turn}'}\n")
                example.stdin.flush()
                message = vehicle.listeners["speed"].recv(0.1)
                found.extend([message.record] if message else [])
                return bool(found)

            until(comes, "a reading of car_speed.py")
            assert (found[0].speed_mps, found[0].yaw_rate_radps) == (12.5, turn)
            assert (found[0].t_ns == 0) == (turn is None)
        finally:
            example.kill()
            example.communicate()
        while vehicle.listeners["speed"].recv(0.3) is not None:
            pass


@needs_openssl
def test_a_certificate_that_is_not_on_the_list_reads_nothing(vehicle: Vehicle, certificates: Path) -> None:
    with outside(certificates, vehicle.port, "stranger") as stranger, outside(certificates, vehicle.port) as planner:
        heard = Heard()
        heard.listen(stranger)
        assert hear(vehicle, planner, keys(READABLE)).keys == keys(READABLE)
        assert not heard.keys
        assert not heard.alive


REFUSED = (
    ("other/planner", "ca.pem"),  # of another authority
    ("", "ca.pem"),  # without a certificate
    ("vehicle", "ca.pem"),  # with the vehicle's own
    ("planner", "other/ca.pem"),  # that trusts another authority: it refuses the gate, it is mutual
)


def without_tls(port: int) -> zenoh.Session:
    config = zenoh.Config()
    endpoint = {"connect/endpoints": [f"tcp/127.0.0.1:{port}"], "connect/timeout_ms": 1500}
    insert(config, {"mode": "client", "scouting/multicast/enabled": False} | endpoint)
    return zenoh.open(config)


@needs_openssl
def test_gate_accepts_only_planners_with_its_certificates(vehicle: Vehicle, certificates: Path) -> None:
    with ThreadPoolExecutor() as pool:
        tried = [
            pool.submit(outside, certificates, vehicle.port, who, authority=authority, limit_s=1.5)
            for who, authority in REFUSED
        ]
        for refused in (*tried, pool.submit(without_tls, vehicle.port)):
            with pytest.raises(zenoh.ZError):
                refused.result(LIMIT_S)


@needs_openssl
def test_a_peer_learns_no_way_around_the_gate(vehicle: Vehicle, certificates: Path) -> None:
    """On this machine and as this user it could use the sockets if it knew them."""
    with outside(certificates, vehicle.port, mode="peer") as peer, outside(certificates, vehicle.port) as planner:
        heard = Heard()
        heard.listen(peer)
        assert hear(vehicle, planner, keys(READABLE)).keys == keys(READABLE)
        assert heard.keys <= keys(READABLE)
        peer.put(key_of("car", "estimate"), encode(estimate(9_999)))
        vehicle.say_all(78)
        until_heard(vehicle.listeners["estimate"], 78)
        assert len(peer.info.peers_zid()) == 1  # the gate


@needs_openssl
def test_noise_and_oversized_messages_do_not_stop_the_gate(vehicle: Vehicle, certificates: Path) -> None:
    """Who is in goes on reading meanwhile; who comes again may knock twice (zenoh pauses after a bad handshake)."""
    with outside(certificates, vehicle.port) as session:
        silent = [socket.create_connection(("127.0.0.1", vehicle.port)) for _ in range(8)]
        for number in range(20):
            with socket.create_connection(("127.0.0.1", vehicle.port)) as noise:
                noise.sendall(os.urandom(1 + 37 * number))
        for size in (70_000, 200_000, 4_000_000):
            session.put(key_of("car", "estimate"), bytes(size))
            session.get("birdslam/car/v1/map", payload=bytes(size), timeout=0.1)
    with outside(certificates, vehicle.port) as session:
        assert hear(vehicle, session, keys(READABLE)).keys == keys(READABLE)
        for number in range(20):
            with socket.create_connection(("127.0.0.1", vehicle.port)) as noise:
                noise.sendall(os.urandom(1 + 37 * number))
        assert hear(vehicle, session, keys(READABLE)).keys == keys(READABLE)
    for one in silent:
        one.close()


@needs_openssl
def test_planner_survives_a_restart_of_the_vehicle(vehicle: Vehicle, certificates: Path) -> None:
    with outside(certificates, vehicle.port) as session:
        heard = hear(vehicle, session, keys({"estimate"}))
        vehicle.nodes["optimize"].close()
        with Bus("car", "optimize", runtime_dir=vehicle.base) as again:
            publisher = again.publisher("estimate")
            heard.keys.clear()

            def comes_back() -> bool:
                publisher.put(estimate(1))
                return key_of("car", "estimate") in heard.keys

            until(comes_back, "an estimate of the new process")


@needs_openssl
def test_the_example_of_a_planner_elsewhere(vehicle: Vehicle, certificates: Path, tmp_path: Path) -> None:
    text = (DEPLOY / "planner.json5").read_text().replace(":7447", f":{vehicle.port}")
    text = re.sub(r'"(ca|planner)\.(pem|key)"', lambda m: json.dumps(str(certificates / m[0].strip('"'))), text)
    (tmp_path / "planner.json5").write_text(text)
    listen = subprocess.Popen(
        [sys.executable, str(DEPLOY / "listen.py"), str(tmp_path / "planner.json5")], stdout=subprocess.PIPE, text=True
    )
    try:
        line = ""

        def printed() -> bool:
            nonlocal line
            vehicle.say_all(5)
            if listen.stdout and select.select([listen.stdout], [], [], 0.1)[0]:
                line = listen.stdout.readline()
            return bool(line)

        until(printed, "a line of listen.py")
        assert line.startswith("frame 5 ")
        assert line.rstrip().endswith("DO NOT USE")  # its t_utc_ns is of 1970
    finally:
        listen.kill()
        listen.communicate()


@needs_openssl
def test_certificates_are_kept_and_made_only_by_the_authority(certificates: Path, tmp_path: Path) -> None:
    def attempt(*what: str) -> subprocess.CompletedProcess[str]:
        script = [str(DEPLOY / "certificates.sh"), str(tmp_path / "tls"), *what]
        return subprocess.run(script, capture_output=True, text=True, check=False)

    assert attempt("vehicle", "car.local", "10.0.0.5", "fd00::5").returncode == 0
    before = {path.name: path.read_bytes() for path in (tmp_path / "tls").iterdir()}
    assert "kept" in attempt("vehicle", "car.local").stdout
    assert {path.name: path.read_bytes() for path in (tmp_path / "tls").iterdir()} == before
    assert all(path.stat().st_mode & 0o077 == 0 for path in (tmp_path / "tls").glob("*.key"))
    for wrong in (
        ("planner", "../up"),
        ("planner", "ca"),
        ("planner", "vehicle"),
        ("planner", "car"),
        ("planner", "the car"),
        ("planner", "router"),
        ("uplink", "../up"),
        ("uplink", "-red"),
        ("uplink", "r*d"),
        ("uplink", "r" * 33),
        ("vehicle", "a,b"),
        ("other", "x"),
        (),
    ):
        done = attempt(*wrong)
        assert done.returncode == 2, wrong
        assert done.stderr.startswith("certificates.sh: ")
    (tmp_path / "tls" / "ca.key").unlink()
    assert "authority" in attempt("planner", "late").stderr
    assert not list((tmp_path / "tls").glob(".new*"))


@needs_openssl
@pytest.mark.parametrize(
    ("old", "new", "reason"),
    [
        ("enable_mtls: true", "enable_mtls: false", "enable_mtls"),
        ('default_permission: "deny"', 'default_permission: "allow"', "default_permission"),
        ("access_control: {\n    enabled: true", "access_control: {\n    enabled: false", "access_control/enabled"),
        ("gossip: { enabled: false }", "gossip: { enabled: true }", "gossip"),
        ('mode: "peer"', 'mode: "router"', "mode"),
        ('["tls/127.0.0.1', '["tcp/127.0.0.1', "listen/endpoints"),
        ('protocols: ["tls", "unixsock-stream"]', 'protocols: ["tls", "tcp", "unixsock-stream"]', "protocols"),
        ("max_message_size: 131072", "max_message_size: 1073741824", "max_message_size"),
        ("vehicle.key", "missing.key", "missing.key"),
        ('link_protocols: ["tls"], cert_common_names: ["planner"]', 'link_protocols: ["tls"]', "certificate"),
        ('"declare_subscriber", "query"', '"declare_subscriber", "put", "query"', "allows put"),
        ('cert_common_names: ["the car"]', 'cert_common_names: ["planner"]', "'car sends speed' allows put"),
        ('cert_common_names: ["the car"]', 'cert_common_names: ["the car", "planner"]', "allows put"),
        ('subjects: ["the car"]', 'subjects: ["the car", "planners"]', "allows put"),
        (
            'messages: ["put"],\n        key_exprs: ["birdslam/*/v1/speed"',
            'messages: ["put"], key_exprs: ["**"',
            "allows put",
        ),
        ('flows: ["ingress"],\n        messages: ["put"]', 'messages: ["put", "delete"]', "allows delete, put"),
        ("adminspace: {", "adminspaced: {", "gate.json5"),
        ("{\n", "", "gate.json5"),
    ],
)
def test_open_gate_does_not_start(tmp_path: Path, certificates: Path, old: str, new: str, reason: str) -> None:
    gate_config(gate_file(tmp_path, certificates, 1), "car", tmp_path / "rt")

    def change(text: str) -> str:
        assert old in text
        return text.replace(old, new, 1)

    with pytest.raises(GateError, match=re.escape(reason)) as caught:
        gate_config(gate_file(tmp_path, certificates, 1, change), "car", tmp_path / "rt")
    assert "gate.json5" in str(caught.value)


def test_gate_error_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "car.toml").write_text("")
    done = subprocess.run(
        [sys.executable, "-P", "-m", "birdslam.runtime.gate", str(tmp_path / "car.toml"), str(tmp_path / "none.json5")],
        capture_output=True,
        text=True,
        timeout=LIMIT_S,
        check=False,
    )
    assert done.returncode == 2
    assert len(done.stderr.splitlines()) == 1
    assert "none.json5" in done.stderr


def test_message_over_the_limit_is_not_reassembled(tmp_path_factory: pytest.TempPathFactory) -> None:
    """From a process of the vehicle's own user, past the checks of our own sender."""
    base = tmp_path_factory.mktemp("run")
    with Bus("car", "supervisor", hub=True, runtime_dir=base) as hub:
        listener = hub.subscriber("estimate")
        config = zenoh.Config()
        hub_socket = socket_path(runtime_dir_of("car", base), "hub")
        config.insert_json5("mode", '"client"')
        config.insert_json5("connect/endpoints", json.dumps([f"unixsock-stream/{hub_socket}"]))
        config.insert_json5("scouting/multicast/enabled", "false")
        with zenoh.open(config) as rough:
            for size in (66_000, 140_000, 3_000_000):
                rough.put(key_of("car", "estimate"), bytes(size))
        with zenoh.open(config) as rough:

            def comes() -> bool:
                rough.put(key_of("car", "estimate"), encode(estimate(3)))
                return listener.recv(0.1) is not None

            until(comes, "an estimate after the giants")
        assert listener.malformed == 0


def is_refused(payload: bytes, attachment: bytes | None) -> bool:
    try:
        decode(payload, Estimate)
        if attachment is not None:
            decode(attachment, Trace, MAX_TRACE_BYTES)
    except WireError:
        return True
    return False


def test_a_flood_of_mutants_reaches_no_planner(tmp_path_factory: pytest.TempPathFactory) -> None:
    base, chance = tmp_path_factory.mktemp("run"), Chance(6)
    good = encode(estimate(3))
    refused = 0
    with (
        foreign_session(base, as_hub=True, patient=True) as foreign,
        Bus("car", "planner-0", runtime_dir=base, lossless=True) as another,
        Planner("car", base) as planner,
    ):
        counting = another.subscriber("estimate")
        block = zenoh.CongestionControl.BLOCK  # each one arrives, however busy the machine is
        publisher = foreign.declare_publisher(key_of("car", "estimate"), congestion_control=block, express=True)

        def come(frame_id: int) -> bool:
            """Whether both that subscribe have an estimate of that number."""
            publisher.put(encode(estimate(frame_id)))
            found = planner.latest().estimate
            assert found is None or encode(found)
            newest = counting.newest
            return bool(found and newest and found.frame_id == newest.record.frame_id == frame_id)

        until(lambda: come(76), "an estimate before the flood")
        for _ in range(3_000):
            attachment = mutated(chance, good, good) if chance.random() < 0.5 else None
            payload = mutated(chance, good, good)
            refused += is_refused(payload, attachment)
            publisher.put(payload, attachment=attachment)
        until(lambda: come(77), "an estimate after the flood")
        assert counting.malformed == refused > 1_000
        assert planner.latest(1e6).estimate is not None


@pytest.mark.skipif(os.geteuid() != 0, reason="acting as another user needs root")
def test_another_user_does_not_reach_the_sockets(tmp_path_factory: pytest.TempPathFactory) -> None:
    base = tmp_path_factory.mktemp("run")
    for parent in (base, *base.parents):
        if parent.stat().st_uid == os.getuid() and not parent.stat().st_mode & 0o001:
            parent.chmod(parent.stat().st_mode | 0o011)
    with Bus("car", "supervisor", hub=True, runtime_dir=base):
        attempt = (
            "import os, socket, sys; os.setgroups([]); os.setgid(65534); os.setuid(65534); "
            "socket.socket(socket.AF_UNIX).connect(sys.argv[1])"
        )
        done = subprocess.run(
            [sys.executable, "-c", attempt, str(socket_path(base / "car", "hub"))],
            capture_output=True,
            text=True,
            check=False,
        )
        assert "PermissionError" in done.stderr
