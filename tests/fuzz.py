"""Mutated bytes at every target: `make fuzz`, or `python -m tests.fuzz --cases 1000000 --seed 6`.

Targets are the messages of the bus, what a subscriber, a planner and the optimizer make of them, references to frames
in shared memory, and the files that a user gives: configuration, camera, calibration of another project, boxes,
manifest, speeds, fixes, trajectories, bags. Whatever comes in is either accepted, and then is a whole valid record that
can be sent on, or refused with the one exception that the target is there to raise. Anything else ends the run with
status 1 and the case that did it. The same seed gives the same cases.
"""

from __future__ import annotations

import argparse
import os
import resource
import sys
import tempfile
import time
import tomllib
import zlib
from collections.abc import Callable, Container, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import cv2
import msgpack
import msgspec
import numpy as np
import zenoh

from birdslam.calibration.camera_files import read_intrinsics
from birdslam.geometry.camera import Camera
from birdslam.geometry.se2 import SE2
from birdslam.graph.pose_graph import PoseGraph
from birdslam.loops.gnss.earth import Earth, is_on_earth
from birdslam.loops.gnss.files import GnssError, read_fixes
from birdslam.loops.keyframe import Fixed, Keyframe, LinePiece, Link
from birdslam.loops.map_file import HEAD, MAGIC, VERSION, MapError, decode_map, encode_map
from birdslam.loops.place_map import MapCamera, PlaceMap
from birdslam.perception.manifest import Manifest, ModelError
from birdslam.perception.manifest_file import read_manifest, shipped_manifests
from birdslam.runtime.client import reading_of
from birdslam.runtime.configuration import Configuration, ConfigurationError, dump, load
from birdslam.runtime.environment import ENVIRONMENT
from birdslam.runtime.maps.film_gnss import fixes_of_tags
from birdslam.runtime.topology import TOPICS, key_of
from birdslam.runtime.transport.bus import Subscriber
from birdslam.runtime.transport.ring import FrameError, FrameReader, FrameRing
from birdslam.runtime.wire import MAX_TRACE_BYTES, Trace, WireError, decode, encode
from birdslam.slam import SlamConfig
from birdslam.sources.camera_file import load_camera
from birdslam.sources.detection_file import read_detection_file
from birdslam.sources.kitti import read_image, read_projection, read_times
from birdslam.sources.odometry_file import read_odometry
from birdslam.sources.opening import open_recording
from birdslam.sources.recording import DatasetError
from birdslam.sources.speed_file import read_speed_curve, read_speeds
from birdslam.types import INVALIDATING, Attitude, FrameRef, LineColour, LineKind, Measurements
from tests.mutations import Chance, mutated, mutated_text, with_other_fields
from tests.ros_bags import Written, image, write_bag
from tests.test_camera_files import FILES as OTHER_CAMERAS
from tests.test_wire import BY_NAME, EXAMPLES

ROOT = Path(__file__).resolve().parent.parent
FIXES = [
    "time_s,latitude_deg,longitude_deg,speed_mps\n0.5,51.0,-114.1,12.5\n1.5,51.1,-114.2,\n",
    "$GPRMC,123519,A,4807.038,N,01131.000,E,022.4,084.4,230394,003.1,W*6A\n",
    '<gpx><trk><trkseg><trkpt lat="48.1" lon="11.5"><time>2020-01-01T00:00:00Z</time></trkpt></trkseg></trk></gpx>',
    "$GPGGA,123519,4807.038,N,01131.000,E,1,08,0.9,545.4,M,46.9,M,,*47\n",
    "1\n00:00:01,000 --> 00:00:02,000\n[latitude: 48.1] [longitude: 11.5]\n\n2\n00:00:02,500 --> 0\nGPS(11.5,48.1,9)\n",
    "lat,lon,unix_s,speed_kmh\n48.1,11.5,1600000000.5,12\n48.1,11.6,1600000001.5,\n",
]
SPEEDS = [
    "# t v\n0 12.5\n0.02, 12.6, 0.05\n0.04, 12.7, , -0.01, 0.002\n0.06, nan\n",
    "t_s,speed_kmh,sigma_mps,yaw_rate_radps,note\n0,45,0.1,0.01,a\n0.1,46,,,b\n",
    "time,lat,lon\n0,48.1,11.5\n1,48.1001,11.5\n2,48.1002,11.5\n",
    "time,lat,lon,speed_mph\n0,48.1,11.5,20\n1,48.1001,11.5,21\n2,48.1002,11.5,\n",
    *FIXES[1:4],
]
TRAJECTORIES = [
    "# t x y z qx qy qz qw\n0 0 0 0 0 0 0 1\n0.1 1 0 0 0 0 0 1\n0.2 2 0 0 0 0 0.1 0.99\n",
    "1 0 0 0 0 1 0 0 0 0 1 0\n1 0 0 0.1 0 1 0 0 0 0 1 1\n",
]
FILM_TAGS = [
    '[{"SourceFile": "a.mp4", "Doc1:GPSLatitude": 48.1, "Doc1:GPSLongitude": 11.5, "Doc1:GPSDateTime":'
    ' "2020:01:31 12:00:00.5Z", "Doc2:GPSLatitude": 48.2, "Doc2:GPSLongitude": 11.5, "Doc2:SampleTime": 1.5}]',
    '[{"Doc1:SampleTime": 0.5, "Doc1:Text": "[latitude: 48.1] [longitude: 11.5]", "Doc2:SampleTime": 2.5, "Doc2:Text":'
    ' "GPS(11.5,48.2,9)"}]',
]
BOXES = [
    "1,7,10.5,20,30,40,0.9,1,0.8\n2,-1,10,20,30,40,-1,-1,-1,-1\n",
    "0 3 Car 0 1 -1.5 10 20 30 40 1.5 1.6 3.9 1.0 1.6 20 -1.5 0.9\n",
    '[{"image_id": 3, "category_id": 3, "bbox": [1, 2, 30, 4], "score": 0.5}]',
    '{"annotations": [{"image_id": 1, "category_id": 1, "bbox": [1, 2, 30, 4], "score": 0.5}],'
    ' "categories": [{"id": 1, "name": "car"}]}',
]
Target = Callable[[Chance], bool]  # makes a case and tries it; whether it was let in


def sendable(data: bytes, record: type[msgspec.Struct], max_bytes: int) -> bool:
    """Whether it decodes; if so, it must be a record that can be sent on."""
    try:
        found = decode(data, record, max_bytes)
    except WireError:
        return False
    decode(encode(found), record)
    return True


def bytes_of_messages() -> Target:
    """wire.decode on mutated bytes of each record."""
    goods = [(type(example), encode(example)) for example in EXAMPLES]

    def target(chance: Chance) -> bool:
        (record, good), (_, donor) = chance.choice(goods), chance.choice(goods)
        return sendable(mutated(chance, good, donor), record, 64_000)

    return target


def fields_of_messages() -> Target:
    """wire.decode on whole MessagePack with other contents."""
    goods = [(type(example), msgpack.unpackb(encode(example))) for example in EXAMPLES]

    def target(chance: Chance) -> bool:
        record, plain = chance.choice(goods)
        limit = MAX_TRACE_BYTES if record is Trace else 64_000
        return sendable(msgpack.packb(with_other_fields(chance, plain)), record, limit)

    return target


@dataclass
class Sample:
    """What zenoh hands to a subscriber."""

    key_expr: str
    payload: bytes
    attachment: bytes | None
    kind: zenoh.SampleKind


class Undeclared:
    """A session without a network: the samples are handed to what was subscribed by hand, on this thread."""

    def __init__(self) -> None:
        self.callbacks: dict[str, Callable[[object], object]] = {}

    def declare_subscriber(self, key: str, callback: zenoh.handlers.Callback) -> Undeclared:
        self.callbacks[key] = callback.callback
        return self

    def undeclare(self) -> None:
        """As zenoh's."""


@contextmanager
def subscribers() -> Iterator[Target]:
    """bus.Subscriber of every topic on mutated payloads, attachments, keys, kinds; estimates as planners read them."""
    session, ends = Undeclared(), {}
    goods = {type(example): encode(example) for example in EXAMPLES}
    for name, topic in TOPICS.items():
        ends[name] = Subscriber(session, key_of("car", name), topic, 2, False)

    def target(chance: Chance) -> bool:
        name = chance.choice(sorted(TOPICS))
        subscriber, key, good = ends[name], key_of("car", name), goods[TOPICS[name].record]
        donor = goods[chance.choice(sorted(goods, key=lambda record: record.__name__))]
        payload = mutated(chance, good, donor) if chance.random() < 0.8 else good
        attachment = mutated(chance, goods[Trace], donor) if chance.random() < 0.5 else goods[Trace]
        if chance.random() < 0.05:
            key = chance.choice(("birdslam/**", "**", "birdslam/car/v1/*", "x"))
        kind = zenoh.SampleKind.DELETE if chance.random() < 0.05 else zenoh.SampleKind.PUT
        before = subscriber.malformed, subscriber.newest
        sent = Sample(key, payload, attachment if chance.random() < 0.9 else None, kind)
        session.callbacks[key_of("car", name)](sent)
        if subscriber.malformed > before[0]:
            assert subscriber.newest is before[1], "a refused message was kept"
            return False
        record = subscriber.newest.record
        encode(record)
        if name == "estimate":
            reading = reading_of(subscriber.newest, alive=True, max_age_ms=1e9)
            assert reading.estimate is record
            assert not reading.valid or (record.valid and INVALIDATING.isdisjoint(record.status))
        return True

    yield target
    for end in ends.values():
        end.close()


@contextmanager
def references() -> Iterator[Target]:
    """frames.FrameReader on references that lead anywhere, and on rings whose head was overwritten."""
    with tempfile.TemporaryDirectory() as folder:
        path, broken = Path(folder, "ring"), Path(folder, "broken")
        image = np.arange(24 * 32, dtype=np.uint8).reshape(24, 32)
        with FrameRing(path, 24, 32, channels=1, slots=2) as ring:
            slot, sequence = ring.write(image)
            data = path.read_bytes()
            good = {
                **{"frame_id": 0, "t_source_ns": 0, "t_capture_ns": 0, "t_utc_ns": 0, "slot": slot},
                **{"sequence": sequence, "ring_epoch": ring.epoch, "width_px": 32, "height_px": 24, "channels": 1},
            }

            def target(chance: Chance) -> bool:
                plain, where = dict(good), path
                if chance.random() < 0.9:
                    for _ in range(chance.randint(1, 2)):
                        field = chance.choice(("slot", "sequence", "ring_epoch", "width_px", "height_px", "channels"))
                        plain[field] = chance.choice((0, 1, 2, 3, 24, 32, -1, 2**31, 2**62, -(2**63)))
                else:
                    where = broken
                    head = bytearray(data)
                    place = 8 * chance.randrange(8)
                    head[place : place + 8] = chance.choice((bytes(8), b"\xff" * 8, chance.randbytes(8)))
                    broken.write_bytes(bytes(head[: chance.choice((len(head), 64, 8, 0))]))
                try:
                    ref = msgspec.convert(plain, FrameRef)
                except msgspec.ValidationError:
                    return False
                with FrameReader(where) as reader:
                    try:
                        pixels = reader.read(ref)
                    except FrameError:
                        return False
                assert pixels is None or np.array_equal(pixels, image), "pixels that were never written"
                return pixels is not None

            yield target


def optimizer() -> Target:
    """graph.PoseGraph on arbitrary Measurements that passed the wire; its estimates can be sent."""
    config, good = SlamConfig(), msgpack.unpackb(encode(BY_NAME["Measurements"]))
    graph, frame = PoseGraph(config.graph, config.weights), 0

    def target(chance: Chance) -> bool:
        nonlocal graph, frame
        if chance.random() < 0.1:
            graph = PoseGraph(config.graph, config.weights)
        frame += 1
        edge = {"from_frame": frame - 1, "to_frame": frame}
        landmark, _, *rest = good["cp"][0]
        plain = {
            **good,
            **{"frame_id": frame, "t_source_ns": 33_000_000 * frame, "cc": {**good["cc"], **edge}},
            **{"cv": [{**good["cv"][0], "frame": frame}], "vv": [{**good["vv"][0], **edge}]},
            **{"cp": [[landmark, frame, *rest]]},
        }
        if chance.random() < 0.6:
            plain = with_other_fields(chance, plain)
        try:
            measurements = decode(msgpack.packb(plain), Measurements)
        except WireError:
            return False
        encode(graph.optimise(measurements))
        return True

    return target


def files(goods: list[str], read: Callable[[Path], object], refusal: type[Exception]) -> Callable[[Path], Target]:
    """Files that a user gives; `read` raises `refusal` or gives something whole."""

    def make(folder: Path) -> Target:
        path = folder / "file.toml"

        def target(chance: Chance) -> bool:
            path.write_bytes(mutated_text(chance, chance.choice(goods)))
            try:
                read(path)
            except refusal as error:
                assert path.name in str(error) or refusal is ConfigurationError  # noqa: PT017 # of a file it names
                return False
            return True

        return target

    return make


def _read_configuration(path: Path) -> None:
    configuration = load(path)
    assert msgspec.convert(dump(configuration), Configuration) == configuration


def _read_camera(path: Path) -> None:
    camera = load_camera(path)
    assert msgspec.convert(msgspec.to_builtins(camera), Camera) == camera


def _read_speeds(path: Path) -> None:
    log = read_speeds(path)
    assert log.until(max(reading.t_ns for reading in log.readings))


def _read_fixes(path: Path) -> None:
    fixes = read_fixes(path.read_bytes(), path.name, 0)
    assert all(abs(fix.latitude_deg) <= 90.0 and abs(fix.longitude_deg) <= 180.0 for fix in fixes)


def _read_other_camera(path: Path) -> None:
    lens = read_intrinsics(path)
    assert np.isfinite([lens.fx_px, lens.fy_px, lens.cx_px, lens.cy_px, *lens.distortion]).all()
    assert min(lens.fx_px, lens.fy_px) > 0.0


def _read_speed_curve(path: Path) -> None:
    assert (np.diff(read_speed_curve(path)[:, 0]) > 0.0).all()


def _read_odometry(path: Path) -> None:
    trajectory = read_odometry(path)
    assert np.isfinite(trajectory.poses).all()
    assert trajectory.t_ns is None or (np.diff(trajectory.t_ns) > 0).all()


def _read_film_tags(path: Path) -> None:
    fixes = fixes_of_tags(path.read_bytes())
    if not fixes:
        raise GnssError(f"{path}: has no fix")
    for fix in fixes:
        assert is_on_earth(fix.latitude_deg, fix.longitude_deg)
        assert isinstance(fix.t_ns, int)


def _read_boxes(path: Path) -> None:
    for detections in read_detection_file(path).values():
        assert np.isfinite(detections.boxes_px).all()
        assert ((detections.scores >= 0.0) & (detections.scores <= 1.0)).all()


def _read_manifest(path: Path) -> None:
    assert isinstance(read_manifest(path), Manifest)


def _read_recording(path: Path) -> None:
    if path.read_bytes()[:1] == b"P":
        assert np.isfinite(read_projection(path, "P0")).all()
    else:
        assert all(later > earlier for earlier, later in pairwise(read_times(path)))


def bags(folder: Path) -> Target:
    """Mutated bags of ROS 1 and ROS 2: frames of increasing times, or DatasetError with the file."""
    images = [image(np.zeros((6, 8), np.uint8), 10**9 * (number + 1)) for number in range(3)]
    messages: list[Written] = [("/c/image", number, one) for number, one in enumerate(images)]
    goods = [
        write_bag(folder / "good.bag", messages, "ros1"),
        *write_bag(folder / "good", messages, "mcap").glob("*.mcap"),
        *write_bag(folder / "good3", messages, "sqlite3").glob("*.db3"),
    ]
    camera = Camera(8, 6, 5.0, 5.0, 4.0, 3.0, 1.4)

    def target(chance: Chance) -> bool:
        good = chance.choice(goods)
        path = folder / f"file{good.suffix}"
        path.write_bytes(mutated(chance, data := good.read_bytes(), data))
        try:
            frames = list(open_recording(f"rosbag:{path}", camera).frames())
        except DatasetError as error:
            assert path.name in str(error)  # noqa: PT017
            return False
        assert all(later.t_source_ns > earlier.t_source_ns for earlier, later in pairwise(frames))
        assert all(frame.error for frame in frames if frame.image is None)
        return True

    return target


@contextmanager
def images(folder: Path) -> Iterator[Target]:
    """kitti.read_image on mutated PNGs and JPEGs: an image of a known kind, or ValueError."""
    grey = np.random.default_rng(6).integers(0, 256, (12, 16), dtype=np.uint8)
    goods = [
        (suffix, cv2.imencode(suffix, image)[1].tobytes())
        for suffix in (".png", ".jpg")
        for image in (grey, np.dstack([grey, grey, grey]))
    ]

    def target(chance: Chance) -> bool:
        suffix, good = chance.choice(goods)
        path = folder / f"image{suffix}"
        path.write_bytes(mutated(chance, good, chance.choice(goods)[1]))
        try:
            image = read_image(path)
        except ValueError:
            return False
        assert image.dtype == np.uint8
        assert image.ndim in (2, 3)
        return True

    spoken, quiet = os.dup(2), os.open(os.devnull, os.O_WRONLY)  # the decoders complain there of each
    try:
        os.dup2(quiet, 2)
        yield target
    finally:
        os.dup2(spoken, 2)
        os.close(spoken)
        os.close(quiet)


def maps() -> Target:
    """loops.map_file on mutated maps, most of them with a right sum; what is let in can be written and looked into."""
    keyframe = Keyframe(
        *(0, 0, 0, SE2(1.0, 2.0, 0.3), np.eye(3), Attitude(), np.ones((9, 3)), np.full(9, 0.1)),
        *(np.arange(288, dtype=np.uint8).reshape(9, 32), 1.65, Fixed(51.0, 7.0, 2.0, 5.0)),
        lines=(LinePiece(0, 7, LineKind.DASHED, LineColour.WHITE, np.ones((3, 2)), 0.1),),
    )
    links = [Link(0, 0, SE2(), np.eye(3), loop=True)]
    camera = MapCamera("0" * 16, 640, 480, 500.0, 1.65)
    earth = Earth(51.0, 7.0, 3.0, 4.0, 0.5, 1.01, np.eye(4), 0.1, 40, 2, 1.5, None, 0.3)
    good = encode_map(PlaceMap(camera, [keyframe], links, np.zeros((2, 32), np.uint8), 1, earth))
    head = len(MAGIC) + HEAD.size
    plain = msgpack.unpackb(good[head:])

    def target(chance: Chance) -> bool:
        if chance.random() < 0.2:
            data = mutated(chance, good, good)
        else:
            if chance.random() < 0.5:
                body = msgpack.packb(with_other_fields(chance, plain))
            else:
                body = mutated(chance, good[head:], good)
            data = MAGIC + HEAD.pack(VERSION, len(body), zlib.crc32(body)) + body
        try:
            found = decode_map(data)
        except MapError:
            return False
        decode_map(encode_map(found))
        found.index()
        found.on_earth(SE2(1.0, 2.0, 0.3), np.eye(3))
        found.lines()
        return True

    return target


def _configurations() -> list[str]:
    texts = [path.read_text() for path in sorted((ROOT / "configs").glob("*.toml"))]
    return [*texts, "[runtime]\nwatchdog_ms = 800\n[perceive]\ndeadline_ms = 20.0\n[source]\nrate = 33\nloop = true\n"]


def _cameras() -> list[str]:
    camera = tomllib.loads((ROOT / "configs" / "vehicle.toml").read_text())["camera"]
    return ["".join(f"{key} = {value}\n" for key, value in camera.items())]


def readers() -> Iterator[tuple[str, float, list[str], Callable[[Path], object], type[Exception]]]:
    """Name, share of all cases, valid files, what reads them, and how it refuses one."""
    manifests = [path.read_text() for path in shipped_manifests().values()]
    times = "".join(f"{0.1 * i:e}\n" for i in range(8))
    projections = "".join(f"P{i}: 700 0 300 {-i} 0 700 100 0 0 0 1 0\n" for i in range(2))
    others = [text for _, text in OTHER_CAMERAS.values()]
    yield "GNSS fixes", 0.01, FIXES, _read_fixes, GnssError
    yield "calibrations of others", 0.01, others, _read_other_camera, DatasetError
    yield "boxes of others", 0.02, BOXES, _read_boxes, DatasetError
    yield "speed files", 0.01, SPEEDS, _read_speeds, DatasetError
    yield "speed curves", 0.005, SPEEDS[:2], _read_speed_curve, DatasetError
    yield "trajectories", 0.005, TRAJECTORIES, _read_odometry, DatasetError
    yield "GNSS tags of films", 0.005, FILM_TAGS, _read_film_tags, GnssError
    yield "recordings' text files", 0.01, [times, projections], _read_recording, DatasetError
    yield "configuration files", 0.02, _configurations(), _read_configuration, ConfigurationError
    yield "camera files", 0.02, _cameras(), _read_camera, DatasetError
    yield "manifest files", 0.02, manifests, _read_manifest, ModelError


def targets(folder: Path) -> Iterator[tuple[str, float, Callable[[], object]]]:
    """Name, share of all cases, and what makes the target."""
    yield "bytes of messages", 0.505, bytes_of_messages
    yield "fields of messages", 0.17, fields_of_messages
    yield "optimizer", 0.02, optimizer
    yield "subscribers and planner", 0.13, subscribers
    yield "references to frames", 0.02, references
    yield "images", 0.005, lambda: images(folder)
    yield "maps", 0.01, maps
    yield "bags", 0.005, lambda: bags(folder)
    for name, share, goods, read, refusal in readers():
        make = files(goods, read, refusal)
        yield name, share, lambda make=make: make(folder)


@dataclass(frozen=True)
class Count:
    """What one target did."""

    name: str
    cases: int
    let_in: int
    seconds: float
    slowest_s: float


def run(cases: int, seed: int, only: Container[str] | None = None) -> Iterator[Count]:
    """All targets, or `only` some; raises what a target should not have raised, with the case's number in a note."""
    with tempfile.TemporaryDirectory() as folder:
        chosen = [target for target in targets(Path(folder)) if only is None or target[0] in only]
        shares = sum(share for _, share, _ in chosen)
        for name, share, make in chosen:
            chance, begun_s, let_in = Chance(f"{seed} {name}"), time.monotonic(), 0
            number, slowest_s, last_s = round(cases * share / shares), 0.0, begun_s
            made = make()
            with made if hasattr(made, "__enter__") else _open(made) as target:
                for case in range(number):
                    try:
                        let_in += target(chance)
                        now_s = time.monotonic()
                        slowest_s, last_s = max(slowest_s, now_s - last_s), now_s
                    except Exception as error:
                        error.add_note(f"case {case} of {name!r}, seed {seed}")
                        raise
            yield Count(name, number, let_in, time.monotonic() - begun_s, slowest_s)


@contextmanager
def _open(target: object) -> Iterator[object]:
    yield target


def main(arguments: list[str] | None = None) -> int:
    """Entry point."""
    parser = argparse.ArgumentParser(prog="tests.fuzz", description="Mutated bytes at every target.")
    parser.add_argument("--cases", type=int, default=1_000_000, metavar="N")
    parser.add_argument("--seed", type=int, default=6, metavar="N")
    parser.add_argument("--only", action="append", metavar="TARGET", help="one of the targets; repeatable")
    options = parser.parse_args(arguments)
    total = 0
    for count in run(options.cases, options.seed, options.only):
        total += count.cases
        let_in = f"{count.cases - count.let_in:>9} refused  {count.let_in:>9} valid"
        times = f"{count.seconds:6.1f} s, slowest {1e3 * count.slowest_s:4.0f} ms"
        print(f"{count.name:26}{count.cases:>9} cases  {let_in}  {times}", flush=True)
    memory_mib = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss >> 10
    print(f"{'all':26}{total:>9} cases, none did harm (seed {options.seed}), at most {memory_mib} MiB")
    return 0


if __name__ == "__main__":
    if not ENVIRONMENT.items() <= os.environ.items():  # OpenCV has read it when it was imported
        os.execve(sys.executable, [sys.executable, "-m", "tests.fuzz", *sys.argv[1:]], {**os.environ, **ENVIRONMENT})
    sys.exit(main())
