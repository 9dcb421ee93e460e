"""Serializes a pose graph for a later process: MessagePack with a checksum and the configuration.

Arrays are stored as raw bytes, so that a restored graph gives bit-identical results.
"""

from __future__ import annotations

import hashlib
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from birdslam.geometry.se2 import SE2
from birdslam.graph.pending_map import PendingState
from birdslam.graph.vehicles import VehicleNode
from birdslam.graph.window import WindowState
from birdslam.lanes.traffic import TrafficState
from birdslam.types import FollowedPerson

VERSION = 12
_MAGIC = b"BirdSLAM graph\n"
_SUM_BYTES = 16
_KINDS = {"<f8": np.float64, "<c16": np.complex128, "<i8": np.int64}


class CheckpointError(ValueError):
    """The bytes are not a checkpoint that this graph can continue from."""


class Epoch(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The state of a graph in its current epoch."""

    window: WindowState
    vehicles: list[VehicleNode]
    factors: dict[str, bytes]  # name -> `packed` state of each stateful factor
    t_ns: int
    t_before_ns: int
    motion: SE2
    people: list[FollowedPerson]  # of the newest measurements
    traffic: TrafficState  # directions of the lanes


class Checkpoint(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A graph between two frames; without `begun` before its first frame."""

    settings: dict[str, Any]  # its configuration, plain
    epoch: int
    started: Epoch | None
    pending: PendingState


def pack(checkpoint: Checkpoint) -> bytes:
    """The checkpoint as bytes: a magic number with the version, a checksum, and MessagePack."""
    body = _ENCODER.encode(checkpoint)
    return b"".join([_MAGIC, bytes([VERSION]), _sum(body), body])


def unpack(data: bytes, settings: dict[str, Any]) -> Checkpoint:
    """The checkpoint of these bytes, if it was made with the same `settings`. Raises CheckpointError."""
    head = len(_MAGIC) + 1
    if data[: len(_MAGIC)] != _MAGIC:
        raise CheckpointError("is not a checkpoint of a pose graph")
    if data[len(_MAGIC) : head] != bytes([VERSION]):
        raise CheckpointError(f"is a checkpoint of version {[*data[len(_MAGIC) : head]]}, expected [{VERSION}]")
    body = data[head + _SUM_BYTES :]
    if data[head : head + _SUM_BYTES] != _sum(body):
        raise CheckpointError("is damaged: its checksum does not match")
    try:
        checkpoint: Checkpoint = _DECODER.decode(body)
    except (ValueError, msgspec.DecodeError) as error:  # written by other code with the same version
        raise CheckpointError(f"can't be read: {error}") from None
    for name in sorted({*settings, *checkpoint.settings}):
        theirs, ours = checkpoint.settings.get(name), settings.get(name)
        if theirs != ours:
            raise CheckpointError(f"was written with {name} = {theirs}, this graph has {ours}")
    return checkpoint


def packed(state: object) -> bytes:
    """Serializes a factor's state, for an `Epoch`."""
    return _ENCODER.encode(state)


def unpacked(data: bytes, kind: type) -> Any:
    """Deserializes a factor's state of this type. Raises CheckpointError."""
    try:
        return msgspec.msgpack.decode(data, type=kind, dec_hook=_decode_array)
    except (ValueError, msgspec.DecodeError) as error:
        raise CheckpointError(f"can't be read: {error}") from None


def plain(**structs: msgspec.Struct) -> dict[str, Any]:
    """Every setting by its full name, such as "graph.ego_nodes", as plain values."""
    tree = msgspec.msgpack.decode(msgspec.msgpack.encode(structs))
    return {f"{part}.{name}": value for part, values in tree.items() for name, value in values.items()}


def _sum(body: bytes) -> bytes:
    return hashlib.blake2b(body, digest_size=_SUM_BYTES).digest()


def _encode_array(array: Any) -> Any:
    return array.dtype.str, array.shape, array.tobytes()


def _decode_array(kind: Any, parts: Any) -> NDArray[Any]:
    dtype, shape, data = parts
    return np.frombuffer(data, _KINDS[dtype]).reshape(shape).copy()


_ENCODER = msgspec.msgpack.Encoder(enc_hook=_encode_array)
_DECODER = msgspec.msgpack.Decoder(Checkpoint, dec_hook=_decode_array)
