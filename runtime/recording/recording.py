"""A recorded drive as one MCAP file (https://mcap.dev); a truncated file is readable up to its end.

Attachments: `about.json` (the configuration, the networks with their hashes, versions) and `camera.toml`. Times are
UTC by one offset to CLOCK_MONOTONIC, taken at the start. A chunk is written every `flush_ms`; a kill or a full disk
loses the data after the last chunk. Damaged chunks are skipped and counted.
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
# v1/measurements/trace, v1/estimate/trace: MessagePack, the trace of the record with the same sequence number; a replay
#     assigns estimates to measurements by it
# v1/checkpoint: MessagePack, the graph at the start of a file that starts in the middle of a drive
# /estimate, /health/NODE, /latency, /alive, /speed: JSON with a schema, for plots
# /tf, /scene, ... (scene.py): JSON with a schema, for Foxglove; /camera/image with recording.images
EXACT: dict[str, type[msgspec.Struct]] = {
    "frame": FrameRef,
    "measurements": Measurements,
    "estimate": Estimate,
    "map": MapUpdate,
}
TRACED = ("measurements", "estimate")
CHECKPOINT = "v1/checkpoint"
MAX_RECORD_BYTES = 1 << 28  # far above the records that are written
_TORN = (McapError, struct.error, zlib.error, zstandard.ZstdError, RuntimeError, ValueError, MemoryError)


_Part = TypeVar("_Part", bound=msgspec.Struct)


class RecordingError(ValueError):
    """A file is no recording or lacks a part; the message names the file and the reason."""


class Latency(msgspec.Struct, frozen=True, kw_only=True):
    """The age of one frame's estimate by stages, which are those of BudgetsConfig."""

    frame_id: int
    age_ms: float  # from the frame's capture to the recorder's receipt of its estimate
    left_ms: float | None = None  # of the budget when the estimate was done
    stages_ms: dict[str, float] = {}


class GraphCheckpoint(msgspec.Struct, frozen=True, kw_only=True):
    """The optimizer's graph after a frame: the start of a replay of a file without the start of its drive."""

    frame_id: int
    epoch: int
    data: bytes


class Alive(msgspec.Struct, frozen=True, kw_only=True):
    """A node became alive or dead."""

    node: str
    alive: bool


class About(msgspec.Struct, frozen=True, kw_only=True):
    """The metadata of a recording."""

    configuration: dict[str, Any]
    models: dict[str, Any]
    versions: dict[str, str]
    utc_offset_ns: int  # UTC less CLOCK_MONOTONIC
    restarts: int = 0  # of the recorder: earlier files have the start of the drive


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
    """Writes one recording. A disk failure sets `error`; later messages are discarded.

    Times are CLOCK_MONOTONIC. Raises OSError if the file can't be created (FileExistsError if it exists).
    """

    def __init__(self, path: Path, about: About, camera: Camera | None, flush_ms: float, sync: bool = True) -> None:
        self.messages = 0
        self._offset_ns = about.utc_offset_ns
        self._flush_ns = round(flush_ms * 1e6)
        self._flushed_ns: int | None = None
        self._file = AppendOnlyFile(path, sync)
        self._pending = _Pending()
        # `flush` ends the chunks, never between a record and its trace
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
        """The disk error that ended the recording."""
        return self._file.error

    @property
    def written_bytes(self) -> int:
        """Bytes in the file."""
        return self._file.written_bytes

    @property
    def handed_bytes(self) -> int:
        """Bytes passed to the writing thread."""
        return self._pending.taken_bytes

    def add(self, topic: str, record: msgspec.Struct, t_ns: int, trace: Trace | None = None) -> None:
        """Adds a record of the bus, received at `t_ns`, and its trace if the topic's traces are recorded."""
        self._add(f"v1/{topic}", encode(record), t_ns)
        if topic in TRACED:
            self._add(f"v1/{topic}/trace", encode(trace or Trace()), t_ns)

    def begin_from(self, checkpoint: GraphCheckpoint, t_ns: int) -> None:
        """Adds the checkpoint from which a replay of this file starts."""
        self._add(CHECKPOINT, msgspec.msgpack.encode(checkpoint), t_ns)

    def draw(self, channel: str, message: msgspec.Struct, t_ns: int) -> None:
        """Adds a message for viewers and plots."""
        self._add(channel, msgspec.json.encode(message), t_ns)

    def _add(self, channel: str, data: bytes, t_ns: int) -> None:
        sequence = self._sequences[channel] = self._sequences.get(channel, -1) + 1
        t_utc_ns = max(t_ns + self._offset_ns, 0)
        self._writer.add_message(self._channels[channel], t_utc_ns, data, t_utc_ns, sequence & 0xFFFFFFFF)
        self.messages += 1

    def flush_if_due(self, now_ns: int) -> bool:
        """Passes the collected messages to the disk if due; returns whether they were due."""
        due = self._flushed_ns is None or now_ns - self._flushed_ns >= self._flush_ns
        if due:
            self._flushed_ns = now_ns
            self._writer.flush()
            self._file.write(self._pending.take())
        return due

    def close(self, end: dict[str, str]) -> None:
        """Writes the rest, the metadata `end` and the index; waits for the disk."""
        self._writer.flush()
        self._writer.add_metadata("end", end)
        self._writer.finish()
        self._file.write(self._pending.take())
        self._file.close()


class _Pending(io.BytesIO):
    """Output of the writer since the last `take`; `tell` counts from the start of the file."""

    def __init__(self) -> None:
        super().__init__()
        self.taken_bytes = 0

    def tell(self) -> int:
        return self.taken_bytes + super().tell()

    def take(self) -> bytes:
        """Returns the collected bytes and clears the buffer."""
        piece = self.getvalue()
        self.taken_bytes += len(piece)
        self.seek(0)
        self.truncate()
        return piece


def _camera_toml(camera: Camera) -> bytes:
    """Returns a camera file as load_camera reads it."""
    values = msgspec.to_builtins(camera)
    return "".join(f"{key} = {msgspec.json.encode(value).decode()}\n" for key, value in values.items()).encode()


class Recorded(NamedTuple):
    """One encoded message of a recording."""

    channel: str
    sequence: int
    t_utc_ns: int
    data: bytes


class Recording:
    """Reads a recording. Raises RecordingError if the file is none.

    After a pass over `messages`: `complete` (the file has its end), `damaged` (number of skipped chunks), `end` (the
    writer's final metadata).
    """

    def __init__(self, path: Path, on_read: Callable[[int], object] | None = None) -> None:
        """`on_read` is called repeatedly with the number of bytes read, for progress."""
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
        raise RecordingError(f"{self.path}: is no recording of BirdSLAM")

    def part(self, name: str, kind: type[_Part]) -> _Part:
        """Returns a part of the recorded configuration, such as "slam.graph"; others may be of another version."""
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
        """Yields all records up to the end of the file or its truncation."""
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
        """Yields the messages of some channels (None: all) in the order of the file."""
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
