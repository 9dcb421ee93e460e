"""A recorded drive, one MCAP file (https://mcap.dev): written while it goes on, whole or up to where it was cut off.

Attachments: `about.json` (the whole configuration, the networks with their hashes, versions) and `camera.toml`. A
replay needs nothing else. Times are UTC by one offset to CLOCK_MONOTONIC, taken at the start, so that they never jump.
It is written in chunks, at least one in `flush_ms`: a kill or a full disk costs what came after the last. A file
without its end is read up to there; a chunk that was damaged is left out and counted.
"""

from __future__ import annotations

import io
import struct
import zlib
from collections.abc import Callable, Collection, Iterator
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import msgspec
import zstandard
from mcap.exceptions import McapError
from mcap.records import Attachment, Channel, Chunk, Footer, Message, Metadata
from mcap.stream_reader import StreamReader, breakup_chunk
from mcap.writer import CompressionType, Writer

from birdslam.geometry.camera import Camera
from birdslam.loops.map_pose import MapPose
from birdslam.runtime.recording.append_only import AppendOnlyFile
from birdslam.runtime.recording.foxglove import schema
from birdslam.runtime.recording.scene import CHANNELS
from birdslam.runtime.topology import PROCESSES
from birdslam.runtime.wire import Health, Trace, encode
from birdslam.types import Estimate, FrameRef, MapUpdate, Measurements, SpeedReading

# v1/frame, v1/measurements, v1/estimate, v1/map: MessagePack, the records byte for byte as on the bus (runtime/wire.py)
# v1/measurements/trace, v1/estimate/trace: MessagePack, the trace of the record with the same sequence number, by which
#     a replay knows which message an estimate answers
# v1/checkpoint: MessagePack, once in a file that begins in the middle of a drive: the graph there
# /estimate, /health/NODE, /latency, /alive, /speed: JSON with a schema, for plots
# /tf, /scene, ... (scene.py): JSON with a schema, what Foxglove draws; /camera/image where images were asked for
EXACT: dict[str, type[msgspec.Struct]] = {
    "frame": FrameRef,
    "measurements": Measurements,
    "estimate": Estimate,
    "map": MapUpdate,
}
TRACED = ("measurements", "estimate")
CHECKPOINT = "v1/checkpoint"
MAX_RECORD_BYTES = 1 << 28  # nothing that we write comes near it
_TORN = (McapError, struct.error, zlib.error, zstandard.ZstdError, RuntimeError, ValueError, MemoryError)


_Part = TypeVar("_Part", bound=msgspec.Struct)


class RecordingError(ValueError):
    """A file that is not a recording, or lacks what is asked for; the message names the file and the reason."""


class Latency(msgspec.Struct, frozen=True, kw_only=True):
    """Where the time of one frame's estimate went; the parts are those of BudgetsConfig."""

    frame_id: int
    age_ms: float  # from the frame's capture until the recorder had its estimate
    left_ms: float | None = None  # of the budget when the estimate was done
    stages_ms: dict[str, float] = {}


class GraphCheckpoint(msgspec.Struct, frozen=True, kw_only=True):
    """The optimizer's graph after a frame: where the replay of a file begins whose beginning another one has."""

    frame_id: int
    epoch: int
    data: bytes


class Alive(msgspec.Struct, frozen=True, kw_only=True):
    """A node became ready for work, or was gone."""

    node: str
    alive: bool


class About(msgspec.Struct, frozen=True, kw_only=True):
    """What a recording was made of."""

    configuration: dict[str, Any]
    models: dict[str, Any]
    versions: dict[str, str]
    utc_offset_ns: int  # UTC less CLOCK_MONOTONIC
    restarts: int = 0  # of the recorder: the files before this one have the beginning of the drive


JSON_CHANNELS: dict[str, type[msgspec.Struct]] = {
    "/estimate": Estimate,
    "/latency": Latency,
    "/alive": Alive,
    "/speed": SpeedReading,
    "/map_pose": MapPose,
    **{f"/health/{name}": Health for name in PROCESSES},
    **CHANNELS,
}


class RecordingWriter:
    """Writes one recording. `error` is set, and all that follows thrown away, where the disk fails.

    Times are CLOCK_MONOTONIC. Raises OSError where the file can't be made (FileExistsError where there is one).
    """

    def __init__(self, path: Path, about: About, camera: Camera | None, flush_ms: float, sync: bool = True) -> None:
        self.messages = 0
        self._offset_ns = about.utc_offset_ns
        self._flush_ns = round(flush_ms * 1e6)
        self._flushed_ns: int | None = None
        self._file = AppendOnlyFile(path, sync)
        self._pending = _Pending()
        # Chunks end where `flush` says, never between a record and its trace
        self._writer = Writer(self._pending, chunk_size=1 << 40, compression=CompressionType.ZSTD)
        self._writer.start(profile="", library=f"birdslam {about.versions.get('birdslam', '')}".strip())
        self._writer.add_attachment(0, 0, "about.json", "application/json", msgspec.json.encode(about))
        if camera is not None:
            self._writer.add_attachment(0, 0, "camera.toml", "application/toml", _camera_toml(camera))
        self._file.write(self._pending.take())
        self._sequences: dict[str, int] = {}
        self._schemas: dict[str, int] = {}
        exact = {f"v1/{name}": record for name, record in EXACT.items()} | {f"v1/{n}/trace": Trace for n in TRACED}
        self._channels = {name: self._register(name, record, "msgpack") for name, record in exact.items()}
        self._channels[CHECKPOINT] = self._register(CHECKPOINT, GraphCheckpoint, "msgpack")
        self._channels |= {name: self._register(name, record, "json") for name, record in JSON_CHANNELS.items()}

    def _register(self, channel: str, record: type[msgspec.Struct], encoding: str) -> int:
        name = f"{'foxglove' if channel in CHANNELS else 'birdslam'}.{record.__name__}"
        if name not in self._schemas:
            self._schemas[name] = self._writer.register_schema(name, "jsonschema", schema(record))
        return self._writer.register_channel(channel, encoding, self._schemas[name])

    @property
    def error(self) -> OSError | None:
        """Why nothing more is written."""
        return self._file.error

    @property
    def written_bytes(self) -> int:
        """That are in the file."""
        return self._file.written_bytes

    @property
    def handed_bytes(self) -> int:
        """That were handed to the disk; so many are written once it has caught up."""
        return self._pending.taken_bytes

    def add(self, topic: str, record: msgspec.Struct, t_ns: int, trace: Trace | None = None) -> None:
        """A record of the bus, received at `t_ns`, and its trace where the topic has one recorded."""
        self._add(f"v1/{topic}", encode(record), t_ns)
        if topic in TRACED:
            self._add(f"v1/{topic}/trace", encode(trace or Trace()), t_ns)

    def begin_from(self, checkpoint: GraphCheckpoint, t_ns: int) -> None:
        """Where a replay of this file begins."""
        self._add(CHECKPOINT, msgspec.msgpack.encode(checkpoint), t_ns)

    def draw(self, channel: str, message: msgspec.Struct, t_ns: int) -> None:
        """A message for people's tools."""
        self._add(channel, msgspec.json.encode(message), t_ns)

    def _add(self, channel: str, data: bytes, t_ns: int) -> None:
        sequence = self._sequences[channel] = self._sequences.get(channel, -1) + 1
        t_utc_ns = max(t_ns + self._offset_ns, 0)
        self._writer.add_message(self._channels[channel], t_utc_ns, data, t_utc_ns, sequence & 0xFFFFFFFF)
        self.messages += 1

    def flush_if_due(self, now_ns: int) -> bool:
        """Hands what has gathered to the disk, where it is time; whether it was."""
        due = self._flushed_ns is None or now_ns - self._flushed_ns >= self._flush_ns
        if due:
            self._flushed_ns = now_ns
            self._writer.flush()
            self._file.write(self._pending.take())
        return due

    def close(self, end: dict[str, str]) -> None:
        """The rest, how it ended, and the index; waits for the disk."""
        self._writer.flush()
        self._writer.add_metadata("end", end)
        self._writer.finish()
        self._file.write(self._pending.take())
        self._file.close()


class _Pending(io.BytesIO):
    """What the writer has made since it was last taken; `tell` counts from the file's beginning."""

    def __init__(self) -> None:
        super().__init__()
        self.taken_bytes = 0

    def tell(self) -> int:
        return self.taken_bytes + super().tell()

    def take(self) -> bytes:
        """All of it; the file goes on behind."""
        piece = self.getvalue()
        self.taken_bytes += len(piece)
        self.seek(0)
        self.truncate()
        return piece


def _camera_toml(camera: Camera) -> bytes:
    """A camera file, as load_camera reads it."""
    values = msgspec.to_builtins(camera)
    return "".join(f"{key} = {msgspec.json.encode(value).decode()}\n" for key, value in values.items()).encode()


class Recorded(NamedTuple):
    """One message of a recording, still as bytes."""

    channel: str
    sequence: int
    t_utc_ns: int
    data: bytes


class Recording:
    """A recording to be read. Raises RecordingError where the file is none.

    After `messages` has run through, `complete` says whether the file has its end, and `damaged` how many chunks were
    left out; `end` is what its writer said at last.
    """

    def __init__(self, path: Path, on_read: Callable[[int], object] | None = None) -> None:
        """`on_read` is called with the bytes of the file that have been read, again and again, for progress."""
        self.path = path
        self._on_read = on_read
        self.complete = False
        self.damaged = 0
        self.end: dict[str, str] = {}
        self.about = self._read_about()

    def _read_about(self) -> About:
        try:
            for record in self._records():
                if isinstance(record, Attachment) and record.name == "about.json":
                    return msgspec.json.decode(record.data, type=About)
                if isinstance(record, Chunk):
                    break
        except OSError as error:
            raise RecordingError(f"{self.path}: can't be read: {error.strerror}") from None
        except msgspec.DecodeError as error:
            raise RecordingError(f"{self.path}: about.json: {error}") from None
        raise RecordingError(f"{self.path}: is no recording of BirdSLAM's")

    def part(self, name: str, kind: type[_Part]) -> _Part:
        """A part of the configuration that it was recorded with, "slam.graph"; the rest may be of another version."""
        tree: Any = self.about.configuration
        try:
            for key in name.split("."):
                tree = tree[key]
            return msgspec.convert(tree, kind)
        except (KeyError, TypeError):
            raise RecordingError(f"{self.path}: its configuration has no {name}") from None
        except msgspec.ValidationError as error:
            raise RecordingError(f"{self.path}: {name} is of another version: {error}") from None

    @property
    def camera(self) -> Camera | None:
        """The camera of the drive."""
        return None if self.about.configuration.get("camera") is None else self.part("camera", Camera)

    def _records(self) -> Iterator[Any]:
        """All records up to the end, or to where it was cut off."""
        with self.path.open("rb") as file:
            records = StreamReader(file, emit_chunks=True, record_size_limit=MAX_RECORD_BYTES).records
            while True:
                try:
                    record = next(records)
                except (StopIteration, *_TORN):
                    return
                if self._on_read is not None:
                    self._on_read(file.tell())
                yield record

    def messages(self, channels: Collection[str] | None = None) -> Iterator[Recorded]:
        """Those of some channels (None: of all) in the order in which they were written."""
        names: dict[int, str] = {}
        self.complete, self.damaged = False, 0
        for record in self._records():
            if isinstance(record, Chunk):
                for part in self._parts(record):
                    if isinstance(part, Channel):
                        names[part.id] = part.topic
                    elif isinstance(part, Message):
                        name = names.get(part.channel_id, "")
                        if channels is None or name in channels:
                            yield Recorded(name, part.sequence, part.log_time, part.data)
            elif isinstance(record, Metadata) and record.name == "end":
                self.end = dict(record.metadata)
            elif isinstance(record, Footer):
                self.complete = True

    def _parts(self, chunk: Chunk) -> list[Any]:
        if chunk.uncompressed_size <= MAX_RECORD_BYTES:
            try:
                return breakup_chunk(chunk, validate_crc=True)
            except _TORN:
                self.damaged += 1
                return []
        self.damaged += 1
        return []
