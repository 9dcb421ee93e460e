"""ROS 2 live: names and bytes beside those of an independent implementation, and messages both ways through a router.

The counterpart is the package zenoh-ros2-sdk in a separate process, not a real rmw_zenoh.
"""

from __future__ import annotations

import json
import struct
import subprocess
import threading
import time
from collections import Counter
from contextlib import ExitStack, suppress
from itertools import count, islice
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
import zenoh
from hypothesis import given
from hypothesis import strategies as st

from birdslam.geometry.camera import Camera
from birdslam.geometry.se2 import SE2
from birdslam.loops.gnss.files import GNSS_FILE, GnssError, read_fixes
from birdslam.loops.map_pose import MapPose, MapState
from birdslam.perf.processes import free_port
from birdslam.ros.bag import BagTopics
from birdslam.ros.message_types import MessageTypes
from birdslam.ros.messages import TOPICS, RosMessages
from birdslam.ros.rmw_zenoh import (
    LATCHED_QOS,
    NO_HASH,
    SENSOR_QOS,
    Node,
    Qos,
    attachment,
    check_namespace,
    publication_of,
    sequence_of,
    topic_key,
    type_of_key,
)
from birdslam.ros.sensor import FIX_SIGMA_M
from birdslam.runtime.cli.main import main
from birdslam.runtime.configuration import Configuration, ConfigurationError, ResultsConfig, RosConfig, SourceConfig
from birdslam.runtime.maps.drive_map import DriveMap
from birdslam.runtime.nodes.sources import SourceError, open_source
from birdslam.runtime.process.sender import RateLimit
from birdslam.runtime.ros.camera import CLOCK_FRAMES, GNSS_HEAD, SenderClock
from birdslam.runtime.ros.publisher import RosBridge
from birdslam.runtime.ros.session import NoRouter, RosNode, RosPublisher
from birdslam.runtime.supervision.query_server import QueryServer
from birdslam.sources.opening import open_recording
from birdslam.types import Estimate, Lane, LaneLine, Lanes, LineColour, LineKind
from tests.ros_peers import estimate, peer
from tests.test_bus import until

sdk = pytest.importorskip("zenoh_ros2_sdk")
processes = pytest.mark.processes
CAMERA = Camera(64, 32, 50.0, 50.0, 32.0, 16.0, 1.5, pitch_rad=0.05, roll_rad=-0.02)
LIMIT_S = 60.0
# Published: in the documentation of ROS 2 (Jazzy), `ros2 topic info --verbose`
KNOWN_HASHES = {
    "std_msgs/msg/String": "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18",
    "sensor_msgs/msg/Image": "RIHS01_d31d41a9a4c4bc8eae9be757b0beed306564f7526c88ea6a4588fb9582527d47",
}


# --- names and bytes ---


@pytest.mark.parametrize("namespace", ["/", "/red", "/fleet/red"])
@pytest.mark.parametrize("qos", [Qos(), LATCHED_QOS, SENSOR_QOS])
def test_names_are_those_of_the_other_implementation(namespace: str, qos: Qos) -> None:
    from zenoh_ros2_sdk import keyexpr
    from zenoh_ros2_sdk.entity import EndpointEntity, EntityKind, NodeEntity
    from zenoh_ros2_sdk.qos import QosDurability, QosProfile, QosReliability
    from zenoh_ros2_sdk.utils import ros2_to_dds_type

    theirs = QosProfile(
        reliability=QosReliability.RELIABLE if qos.reliable else QosReliability.BEST_EFFORT,
        durability=QosDurability.TRANSIENT_LOCAL if qos.transient_local else QosDurability.VOLATILE,
        history_depth=qos.depth,
    )
    node, hashed = Node(3, "a1b2", namespace, "birdslam"), KNOWN_HASHES["sensor_msgs/msg/Image"]
    other = NodeEntity(domain_id=3, session_id="a1b2", node_id=0, node_name="birdslam", namespace=namespace)
    assert node.token() == keyexpr.node_liveliness_keyexpr(other)
    dds = ros2_to_dds_type("sensor_msgs/msg/Image")
    for kind, token in (
        (EntityKind.PUBLISHER, node.publisher_token(7, "/front/image", "sensor_msgs/msg/Image", hashed, qos)),
        (EntityKind.SUBSCRIPTION, node.subscription_token(7, "/front/image", "sensor_msgs/msg/Image", hashed, qos)),
    ):
        end = EndpointEntity(other, 7, kind, "/front/image", dds, hashed, theirs.encode())
        assert token == keyexpr.endpoint_liveliness_keyexpr(end)
    assert topic_key(3, "/front/image", "sensor_msgs/msg/Image", hashed) == keyexpr.topic_keyexpr(
        3, "/front/image", dds, hashed
    )
    found = publication_of(node.publisher_token(7, "/front/image", "sensor_msgs/msg/Image", hashed, qos))
    assert found == ("/front/image", "sensor_msgs/msg/Image", hashed)


def test_an_attachment_is_that_of_zenohs_serializer_and_of_the_other_implementation() -> None:
    from zenoh.ext import Int64, z_serialize
    from zenoh_ros2_sdk.attachment import Attachment

    said, gid = attachment(5, 1_700_000_000_000_000_001, bytes(range(16))), bytes(range(16))
    assert said == bytes(z_serialize((Int64(5), Int64(1_700_000_000_000_000_001), gid)))
    assert Attachment.from_bytes(said) == Attachment(5, 1_700_000_000_000_000_001, gid)
    assert (sequence_of(said), sequence_of(said[:-1]), sequence_of(b"")) == (5, None, None)


@pytest.mark.parametrize("name", sorted({*TOPICS.values(), *KNOWN_HASHES}))
def test_hashes_are_those_of_the_other_implementation(name: str, tmp_path: Path) -> None:
    from zenoh_ros2_sdk.message_registry import MessageRegistry
    from zenoh_ros2_sdk.utils import get_type_hash, load_dependencies_recursive

    from tests.ros_peer import write_definitions

    write_definitions(tmp_path)
    text = (tmp_path / f"{name}.msg").read_text()
    others = load_dependencies_recursive(name, text, MessageRegistry(str(tmp_path)))
    hashed = MessageTypes().type_hash(name)
    assert hashed == get_type_hash(name, msg_definition=text, dependencies=others)
    assert hashed == KNOWN_HASHES.get(name, hashed)


class Cdr:
    """Reads little-endian CDR (XCDR1): values are aligned to their size, after a header of four bytes."""

    def __init__(self, data: bytes) -> None:
        assert data[:4] == b"\0\1\0\0"
        self._data, self._at = data[4:], 0

    def number(self, kind: str) -> Any:
        size = struct.calcsize(kind)
        self._at += -self._at % size
        (value,) = struct.unpack_from(f"<{kind}", self._data, self._at)
        self._at += size
        return value

    def numbers(self, kind: str, count: int) -> list[Any]:
        return [self.number(kind) for _ in range(count)]

    def string(self) -> str:
        size = self.number("I")
        text = self._data[self._at : self._at + size]
        self._at += size
        assert text[-1:] == b"\0"
        return text[:-1].decode()

    def header(self) -> tuple[int, str]:
        sec, nanosec = self.number("i"), self.number("I")
        return sec * 10**9 + nanosec, self.string()

    @property
    def rest(self) -> bytes:
        return self._data[self._at :]


def messages(lanes: Lanes | None = None, frames: str = "") -> dict[str, tuple[Any, bytes]]:
    types, told = MessageTypes(), estimate(3, vehicles=2)
    told = Estimate(**{f: getattr(told, f) for f in told.__struct_fields__} | {"lanes": lanes})
    ros = RosMessages(types.make, CAMERA, "car", frames=frames)
    sent = [ros.fixed(told.t_utc_ns), *ros.of_estimate(told, told.t_utc_ns)]
    return {topic: (message, types.cdr(message)) for topic, message in sent}


def test_the_bytes_of_a_pose_field_by_field() -> None:
    message, data = messages()["/birdslam/odometry"]
    read = Cdr(data)
    t_ns, frame = read.header()
    stamp = message.header.stamp
    assert (t_ns, frame, read.string()) == (stamp.sec * 10**9 + stamp.nanosec, "odom", "base_link")
    assert read.numbers("d", 7) == pytest.approx([0.3, 0, 0, 0, 0, 0, 1])
    cov = np.reshape(read.numbers("d", 36), (6, 6))
    assert [cov[i, i] for i in range(6)] == pytest.approx([0.01, 0.01, 1e6, 1e6, 1e6, 1e-4])
    assert read.numbers("d", 6) == [0.0] * 6
    assert np.diag(np.reshape(read.numbers("d", 36), (6, 6))).tolist() == [1e6] * 6
    assert not read.rest.strip(b"\0")


def test_the_bytes_of_vehicles_field_by_field() -> None:
    _, data = messages(frames="red/")["/birdslam/vehicles"]
    read = Cdr(data)
    assert read.header()[1] == "red/odom"
    assert read.number("I") == 2
    for number in range(2):
        assert read.header()[1] == "red/odom"
        assert read.number("I") == 1  # hypotheses
        assert (read.string(), read.number("d")) == ("car", 1.0)
        assert read.numbers("d", 2) == pytest.approx([10.0 + number, 3.0])
        read.numbers("d", 5)
        read.numbers("d", 36)
        read.numbers("d", 7)  # of the box
        assert read.numbers("d", 3) == pytest.approx([4.2, 1.8, 1.5])
        assert read.string() == str(number)
    assert not read.rest.strip(b"\0")


def test_the_bytes_of_transforms_field_by_field() -> None:
    for topic, parent, child in (("/tf", "odom", "base_link"), ("/tf_static", "base_link", "camera_optical_frame")):
        message, data = messages()[topic]
        read = Cdr(data)
        assert read.number("I") == 1
        assert (read.header()[1], read.string()) == (parent, child)
        at, turn = message.transforms[0].transform.translation, message.transforms[0].transform.rotation
        assert read.numbers("d", 7) == [at.x, at.y, at.z, turn.x, turn.y, turn.z, turn.w]
        assert not read.rest.strip(b"\0")


def test_lines_and_the_ego_lane() -> None:
    cov = tuple(0.01 * np.eye(4).ravel())
    curve = {"slope": 0.0, "curvature_per_m": 0.002, "curvature_rate_per_m2": 0.0, "cov": cov, "to_m": 20.0}
    line = LaneLine(
        line=4, offset_m=1.8, seen_from_m=0.0, seen_to_m=15.0, kind=LineKind.DASHED, colour=LineColour.YELLOW, **curve
    )
    lane = Lane(offset_m=0.1, width_m=3.5, width_slope=0.0, width_sigma_m=0.1, **curve)
    found = messages(Lanes(lines=(line,), lanes=(lane,), ego_index=0))
    cleared, drawn = found["/birdslam/lane_lines"][0].markers
    assert (cleared.action, drawn.action) == (drawn.DELETEALL, drawn.ADD)
    assert (drawn.type, drawn.ns, drawn.id, drawn.header.frame_id) == (drawn.LINE_STRIP, "dashed", 4, "base_link")
    assert (drawn.color.r, drawn.color.b) == (1.0, 0.0)
    assert [p.y for p in drawn.points] == pytest.approx([line.y_m(p.x) for p in drawn.points])
    assert (drawn.points[0].x, drawn.points[-1].x) == (0.0, 20.0)
    path, _ = found["/birdslam/ego_lane"]
    assert path.poses[-1].pose.position.y == pytest.approx(lane.centre_m(20.0))


@given(st.text("abz09_/*$#?% .é-", max_size=30))
def test_name_matches_only_its_own_key(name: str) -> None:
    for checked in (lambda: topic_key(0, name, "std_msgs/msg/String", NO_HASH), lambda: check_namespace(name)):
        try:
            found = checked()
        except ValueError:
            continue
        assert not set(found) & set("*$#?% .é-")
        if found != "/":
            zenoh.KeyExpr(found.strip("/"))


@given(st.text("@ros2_lv/%MP*:_aA0", max_size=60), st.binary(max_size=80))
def test_foreign_messages_are_read_or_refused(token: str, data: bytes) -> None:
    assert publication_of(token) is None or token.count("/") == 12
    type_of_key(token)
    types = MessageTypes()
    for name in ("sensor_msgs/msg/Image", "sensor_msgs/msg/CameraInfo", "tf2_msgs/msg/TFMessage"):
        with suppress(ValueError):
            types.read(b"\0\1\0\0" + data, name)


def test_times_of_the_same_clock_are_exact_and_those_of_another_keep_their_intervals() -> None:
    clock, offset = SenderClock(), 10**18
    for arrived, delay in ((10**9, 3_000_000), (2 * 10**9, 40_000_000)):
        assert clock.monotonic_ns(arrived + offset - delay, arrived, arrived + offset) == arrived - delay
    assert clock.monotonic_ns(offset + 5, 3, offset + 3) == 3  # not from the future
    other, period = SenderClock(), 30_000_000
    delays = [4_000_000, 9_000_000, 1_000_000, 7_000_000, 2_000_000] * 40
    times = [other.monotonic_ns(k * period, 10**9 + k * period + d, offset) for k, d in enumerate(delays)]
    assert np.diff(times[3:]).tolist() == [period] * (len(delays) - 4)
    late = [other.monotonic_ns(k * period, 2 * 10**9 + k * period, offset) for k in range(500, 500 + CLOCK_FRAMES + 1)]
    assert late[-1] == 2 * 10**9 + (500 + CLOCK_FRAMES) * period  # the sender's clock was set: after some frames


def test_invalid_settings_are_named(tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: Any) -> None:
    for arguments, said in (
        (["ros", "--namespace", "/a b"], "ros.namespace: '/a b' is not a ROS topic"),
        (["ros", "--router", "nowhere"], "ros.router"),
        (["ros", "--domain", "400"], "ros.domain"),
        (["ros", "--rate", "0"], "--rate 0: needs a positive number"),
        (["run", "--source", "ros:front/image", "--output", str(tmp_path)], "is not a ROS topic"),
        (["run", "--source", "ros:/a", "--rate", "max", "--output", str(tmp_path)], 'rate "max" is for recordings'),
    ):
        assert main(arguments) == 2
        assert said in capsys.readouterr().err
    monkeypatch.setenv("ROS_DOMAIN_ID", "many")
    with pytest.raises(ConfigurationError, match="ROS_DOMAIN_ID='many'"):
        RosNode(RosConfig(), "birdslam")
    monkeypatch.setenv("ROS_DOMAIN_ID", "7")
    monkeypatch.setenv("ZENOH_SESSION_CONFIG_URI", str(tmp_path / "none.json5"))
    with pytest.raises(ConfigurationError, match=r"ZENOH_SESSION_CONFIG_URI=.*none\.json5"):
        RosNode(RosConfig(), "birdslam")


class Listener:
    """What a process of the other implementation hears: (topic, message) as they come."""

    def __init__(self, process: subprocess.Popen[str]) -> None:
        self.heard: list[tuple[str, Any]] = []
        self._process = process
        self._thread = threading.Thread(target=self._read, args=(process.stdout,), daemon=True)
        self._thread.start()

    def __enter__(self) -> Listener:
        return self

    def __exit__(self, *failure: object) -> None:
        """Ends the process and its output before the pipe is closed."""
        self._process.kill()
        self._thread.join()

    def _read(self, lines: Any) -> None:
        for line in lines:
            said = json.loads(line)
            self.heard.append((said["topic"], said["message"]))

    def of(self, topic: str) -> list[Any]:
        return [message for name, message in tuple(self.heard) if name == topic]


class Vehicle:
    """A vehicle's bus with its node of ROS beside it; a step sends an estimate, and is it passed on."""

    def __init__(self, join: Any, base: Path, port: int, rate_hz: float | None = None, **config: Any) -> None:
        hub = join("supervisor", hub=True)
        QueryServer(Configuration(camera=CAMERA), hub)
        self._out, self._map, self._frame = hub.publisher("estimate"), hub.publisher("map_pose"), 0
        node = RosNode(RosConfig(router=f"tcp/127.0.0.1:{port}", **config), "birdslam")
        self.bridge = RosBridge("car", node, base, rate_hz)
        assert self._out.wait_matched(LIMIT_S)
        assert self._map.wait_matched(LIMIT_S)

    def step(self) -> float:
        """Where the ego was."""
        told = estimate(self._frame, vehicles=2)
        found = MapPose(
            frame_id=self._frame, t_source_ns=told.t_source_ns, t_capture_ns=told.t_capture_ns, t_utc_ns=told.t_utc_ns,
            epoch=0, state=MapState.LOCALISED, T_map_odom=T_MAP_ODOM, T_odom_ego=told.T_world_ego, cov=told.cov,
        )  # fmt: skip
        self._frame += 1
        self._map.put(found)
        self._out.put(told)
        self.bridge.step(LIMIT_S)
        return told.T_world_ego.x_m

    def until_heard(self, listener: Listener, topic: str, before: int = 0) -> None:
        def heard() -> bool:
            self.step()
            return len(listener.of(topic)) > before

        until(heard, f"{topic} is not heard")


def topics(*names: str, namespace: str = "") -> list[str]:
    return [f"{namespace * name.startswith('/birdslam')}{name}={TOPICS[name]}" for name in names]


def states(listener: Listener) -> Counter[str]:
    """Counts of the diagnostics' messages."""
    return Counter(message["status"][0]["message"] for message in listener.of("/diagnostics"))


ODOMETRY = "/birdslam/odometry"
MAP_POSE = "/birdslam/map_pose"
T_MAP_ODOM = SE2(7.0, -3.0, 0.5)


def place(odometry: Any) -> float:
    """How far ahead."""
    return float(odometry["pose"]["pose"]["position"]["x"])


@processes
def test_subscriber_gets_all_messages_and_reconnects(join: Any, base: Path) -> None:
    port = free_port()
    with ExitStack() as stack:
        with pytest.raises(NoRouter, match=f"ros.router tcp/127.0.0.1:{port}: the router is not reachable"):
            RosNode(RosConfig(router=f"tcp/127.0.0.1:{port}"), "birdslam", timeout_s=0.2)
        with peer("router", str(port)):
            vehicle = Vehicle(join, base, port, domain=4)
            stack.enter_context(vehicle.bridge)
            wanted = topics(ODOMETRY, "/tf", "/tf_static", "/birdslam/vehicles", "/diagnostics")
            listener = stack.enter_context(Listener(stack.enter_context(peer("hear", str(port), "4", *wanted))))
            vehicle.until_heard(listener, ODOMETRY)
            sent = [vehicle.step() for _ in range(30)]
            until(lambda: place(listener.of(ODOMETRY)[-1]) == pytest.approx(sent[-1]), "messages are lost")
            until(lambda: listener.of("/tf_static"), "who comes late has no /tf_static")
            at = list(map(place, listener.of(ODOMETRY)))
            assert at[-30:] == pytest.approx(sent)
            assert at == sorted(at)
            until(lambda: len(listener.of("/birdslam/vehicles")) > 30, "boxes are lost")
            until(lambda: listener.of("/tf"), "/tf is lost")
            # Of places in the map only the newest is passed on: how many come hangs on the computer
            until(lambda: states(listener)["ok"] > 30 and states(listener)["localised"], "diagnostics are lost")
            (_, box) = listener.of("/birdslam/vehicles")[-1]["detections"]
            assert (box["bbox"]["size"]["x"], box["id"]) == (4.2, "1")
            joined = {message["transforms"][0]["child_frame_id"] for message in listener.of("/tf")}
            assert joined == {"base_link", "odom"}
            others = set(states(listener)) - {"ok", "localised"}  # on a busy computer the vehicle falls silent at times
            assert all(state.startswith("no estimate") for state in others)
            with zenoh.open(client(port)) as other:
                said = [str(reply.ok.key_expr) for reply in other.liveliness().get("@ros2_lv/4/**") if reply.ok]
            found = {one.topic for token in said if (one := publication_of(token)) is not None}
            assert found == set(TOPICS)
        until(lambda: not vehicle.bridge.connected, "the router's end is not noticed")
        vehicle.step()  # goes nowhere, and waits for nothing
        with peer("router", str(port)):
            vehicle.until_heard(listener, ODOMETRY, before=len(listener.of(ODOMETRY)))


@processes
def test_namespace_prefixes_topics_and_frames(join: Any, base: Path) -> None:
    port = free_port()
    with ExitStack() as stack:
        stack.enter_context(peer("router", str(port)))
        vehicle = Vehicle(join, base, port, domain=0, namespace="red")
        stack.enter_context(vehicle.bridge)
        wanted = topics(ODOMETRY, MAP_POSE, "/tf", namespace="/red")
        listener = stack.enter_context(Listener(stack.enter_context(peer("hear", str(port), "0", *wanted))))
        vehicle.until_heard(listener, f"/red{ODOMETRY}")
        until(lambda: listener.of("/tf"), "/tf is not heard")
        message = listener.of(f"/red{ODOMETRY}")[-1]
        assert (message["header"]["frame_id"], message["child_frame_id"]) == ("red/odom", "red/base_link")
        vehicle.until_heard(listener, f"/red{MAP_POSE}")
        assert listener.of(f"/red{MAP_POSE}")[-1]["header"]["frame_id"] == "red/map"

        def joined() -> list[Any]:
            every = [one for message in listener.of("/tf") for one in message["transforms"]]
            return [one for one in every if one["child_frame_id"] == "red/odom"]

        until(joined, "nothing joins the map and odometry")
        at = joined()[-1]["transform"]["translation"]
        assert (joined()[-1]["header"]["frame_id"], at["x"], at["y"]) == ("red/map", T_MAP_ODOM.x_m, T_MAP_ODOM.y_m)


@processes
def test_rate_limit_thins_estimates_and_map_poses(join: Any, base: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    said: Counter[str] = Counter()
    monkeypatch.setattr(RosPublisher, "publish", lambda self, message: said.update([message.__msgtype__]))
    port, in_map = free_port(), TOPICS[MAP_POSE]
    with peer("router", str(port)):
        vehicle = Vehicle(join, base, port, rate_hz=0.001, domain=0)
        with vehicle.bridge:
            until(lambda: vehicle.step() >= 0.0 and said[in_map], "no place in the map is said")
            for _ in range(20):
                vehicle.step()
    assert (said[in_map], said[TOPICS["/birdslam/vehicles"]]) == (1, 2)  # boxes: of vehicles, and of people


def test_rate_limit_holds_in_the_mean_without_catching_up() -> None:
    limit, everything = RateLimit(10.0), RateLimit(None)
    times = [30_000_000 * k for k in range(100)] + [10**11 + 30_000_000 * k for k in range(100)]
    passed = [t for t in times if limit.passes(t)]
    assert sum(t < 10**11 for t in passed) == pytest.approx(30, abs=1)
    assert sum(t >= 10**11 for t in passed) == pytest.approx(30, abs=1)
    assert all(map(everything.passes, times))


def client(port: int) -> zenoh.Config:
    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("connect/endpoints", json.dumps([f"tcp/127.0.0.1:{port}"]))
    config.insert_json5("scouting/multicast/enabled", "false")
    return config


def configuration(port: int, output: Path, **source: Any) -> Configuration:
    topics = BagTopics(speed="/wheels")
    return Configuration(
        source=SourceConfig(uri="ros:/front/image", topics=topics, camera_timeout_s=LIMIT_S, **source),
        ros=RosConfig(router=f"tcp/127.0.0.1:{port}", domain=0),
        output=str(output),
        results=ResultsConfig(gnss="topic:/fix"),
    )


@processes
def test_images_of_a_topic_are_a_source_with_their_camera_speed_and_fixes(tmp_path: Path) -> None:
    port, recording = free_port(), open_recording("demo")
    with peer("router", str(port)), peer("car", str(port), "0", "demo", "20"):
        source = open_source(configuration(port, tmp_path, frames=40))
        frames = list(source.frames())
    assert source.live
    given, own = source.camera, recording.camera
    assert (given.width_px, given.fx_px) == (own.width_px, own.fx_px)
    assert given.ground.height_m == pytest.approx(own.ground.height_m)
    assert given.ground.pitch_rad == pytest.approx(own.ground.pitch_rad, abs=1e-9)
    images = [frame for frame in frames if frame.image is not None]
    assert len(images) >= 30
    first = next(k for k, one in enumerate(recording.frames()) if np.array_equal(one.image, images[0].image))
    true = list(islice(recording.frames(), first, first + len(frames) + 40))
    place = 0
    for frame in images:  # in their order, each as it was sent, whatever was dropped between
        place = next(k for k in range(place, len(true)) if np.array_equal(true[k].image, frame.image)) + 1
    times = [frame.t_source_ns for frame in frames]
    assert times == sorted(set(times))
    assert {reading.speed_mps for reading in images[-1].speeds} == {5.0}
    assert all(reading.t_ns <= time.monotonic_ns() for reading in images[-1].speeds)
    fixes = read_fixes((tmp_path / GNSS_FILE).read_bytes(), "fixes", 0)
    assert [fix.sigma_m for fix in fixes] == [FIX_SIGMA_M] * len(fixes)
    assert 49.0 < fixes[-1].latitude_deg < 49.1
    assert times[0] - 10**10 < fixes[0].t_source_ns < times[-1]


def test_live_drive_is_georeferenced_by_fixes(tmp_path: Path) -> None:
    live = msgspec.structs.replace(configuration(1, tmp_path), camera=CAMERA)
    drive = DriveMap.of(live)
    for k in range(60):
        told = estimate(k, vehicles=0)
        drive.add(msgspec.structs.replace(told, t_source_ns=k * 10**8, T_world_ego=SE2(float(k), 0.0, 0.0)))
    with pytest.raises(GnssError, match=r"gnss\.csv: no fix was received"):
        drive.finish(CAMERA, iter(()), tmp_path)
    east = 1.0 / 73_055.0  # degrees of longitude in a metre, at 49 degrees
    rows = [f"{0.1 * k:.9f},49.0,{8.4 + east * k:.9f},1.000" for k in range(60)]
    (tmp_path / GNSS_FILE).write_text("\n".join((GNSS_HEAD, *rows)) + "\n")
    earth = drive.finish(CAMERA, iter(()), tmp_path)["earth"]
    assert earth["fixes"] > 10
    assert earth["outliers"] == 0
    assert earth["x_axis_from_east_rad"] == pytest.approx(0.0, abs=0.01)
    assert (tmp_path / "ego.gpx").is_file()


@processes
def test_source_without_images_reports_the_reason(tmp_path: Path) -> None:
    port = free_port()
    asked = configuration(port, tmp_path)
    short = msgspec.structs.replace(asked, source=msgspec.structs.replace(asked.source, camera_timeout_s=0.5))
    with pytest.raises(SourceError, match="the router is not reachable"):
        open_source(short)
    with peer("router", str(port)):
        with pytest.raises(SourceError, match="/front/image has no publisher in domain 0"):
            open_source(short)
        with peer("car", str(port), "0", "demo", "20"):
            other = msgspec.structs.replace(asked.source, uri="ros:/front/camera_info")
            with pytest.raises(SourceError, match="/front/camera_info is sensor_msgs/CameraInfo; expected"):
                open_source(msgspec.structs.replace(asked, source=other))
            given = msgspec.structs.replace(asked, camera=CAMERA)
            with pytest.raises(SourceError, match="the camera is for 64x32"):
                open_source(given)


@processes
def test_lost_images_are_counted(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    port, types, over = free_port(), MessageTypes(), threading.Event()
    key = topic_key(0, "/front/image", "sensor_msgs/msg/Image", types.type_hash("sensor_msgs/msg/Image"))

    def send_every_third() -> None:
        with zenoh.open(client(port)) as session:
            for number in count(1, 3):
                stamp = types.make("builtin_interfaces/msg/Time", sec=number, nanosec=0)
                header = types.make("std_msgs/msg/Header", stamp=stamp, frame_id="camera")
                image = types.make(
                    "sensor_msgs/msg/Image", header=header, height=CAMERA.height_px, width=CAMERA.width_px,
                    encoding="mono8", step=CAMERA.width_px, data=np.zeros(CAMERA.height_px * CAMERA.width_px, np.uint8),
                )  # fmt: skip
                session.put(key, types.cdr(image), attachment=attachment(number, 0, bytes(16)))
                if over.wait(0.02):
                    return

    given = msgspec.structs.replace(configuration(port, tmp_path, rate=20.0), camera=CAMERA)
    with peer("router", str(port)):
        sender = threading.Thread(target=send_every_third)
        sender.start()
        try:
            source = open_source(given)
            assert all(frame.image is not None for frame in islice(source.frames(), 5))
            source.close()
        finally:
            over.set()
            sender.join()
    (said,) = (record.getMessage() for record in caplog.records if "lost in transit" in record.getMessage())
    came, lost = (int(word) for word in said.replace(":", " ").split() if word.isdecimal())
    assert came >= 5
    assert lost == 2 * (came - 1)


@processes
def test_lost_router_is_reported_and_images_return(tmp_path: Path) -> None:
    port = free_port()
    with ExitStack() as stack:
        router = stack.enter_context(ExitStack())
        router.enter_context(peer("router", str(port)))
        stack.enter_context(peer("car", str(port), "0", "demo", "20"))
        source = open_source(configuration(port, tmp_path))
        frames = source.frames()
        stack.callback(source.close)
        assert next(frames).image is not None
        router.close()
        # Images that arrive out of order have errors of their own
        assert any("no image for" in str(frame.error) for frame in frames)
        until(
            lambda: "the router is not connected" in str(next(frames).error), "it does not say that the router is gone"
        )
        stack.enter_context(peer("router", str(port)))
        until(lambda: next(frames).image is not None, "no image comes again")
