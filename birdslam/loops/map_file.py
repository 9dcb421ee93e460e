"""Encodes a map: magic, version, length and CRC-32 of the body, and the body as MessagePack.

Points and lines are rounded to 1 cm and depth sigmas to 4 %; no images. Versions 2 (no lines) and 3 (no scales) are
readable, others are rejected. `decode_map` returns a complete map or raises MapError.
"""

from __future__ import annotations

import math
import struct
import zlib
from typing import Annotated

import msgspec
import numpy as np

from birdslam.geometry.se2 import SE2
from birdslam.loops.features import DESCRIPTOR_BYTES
from birdslam.loops.gnss.earth import Earth, is_on_earth
from birdslam.loops.keyframe import Fixed, Keyframe, LinePiece, Link
from birdslam.loops.place_map import MapCamera, PlaceMap
from birdslam.types import Attitude, Cov3, LineColour, LineKind

VERSION = 4
READ = 2, 3, 4  # 2 had no lines, 3 no scales
MAGIC = b"BirdSLAM map\n"
HEAD = struct.Struct("<HQI")  # version, bytes, CRC-32
MAX_BYTES = 1 << 31  # 1,000 km
MAX_KEYFRAMES, MAX_KEYFRAME_POINTS = 1_000_000, 2048
MAX_PIECES, MAX_NODES = 64, 64  # lines of a keyframe, points of a line
MIN_SCALE, MAX_SCALE_REL = 0.1, 10.0
POINT_M = 0.01  # resolution of a coordinate, in 16 bits
SIGMA_STEP = 0.04  # resolution of a log sigma, from MIN_SIGMA on, in 8 bits
MIN_SIGMA = 1e-4
_POINT_BYTES = 6 + 1 + DESCRIPTOR_BYTES

_Number = Annotated[int, msgspec.Meta(ge=0, le=2**62)]


class MapError(ValueError):
    """The bytes are not a usable map."""


class PieceRecord(msgspec.Struct, frozen=True, array_like=True, forbid_unknown_fields=True):
    """A line beside a keyframe in the file; `points` holds x, y (int16, cm)."""

    drive: _Number
    line: _Number
    kind: LineKind
    colour: LineColour
    points: bytes
    sigma_m: float


class KeyframeRecord(msgspec.Struct, frozen=True, array_like=True, forbid_unknown_fields=True):
    """A keyframe in the file; `points` holds x, y, z (int16, cm), then sigmas (uint8), then descriptors."""

    number: _Number
    drive: _Number
    t_source_ns: int
    T_map_keyframe: SE2
    cov: Cov3
    attitude: tuple[float, float, float]  # z_m, pitch_rad, roll_rad
    camera_height_m: float
    points: bytes
    gnss: tuple[float, float, float, float] | None = None  # latitude_deg, longitude_deg, sigma_m, weighed_m
    lines: tuple[PieceRecord, ...] = ()  # since version 3
    scale: float = 1.0  # since version 4


class LinkRecord(msgspec.Struct, frozen=True, array_like=True, forbid_unknown_fields=True):
    """A link in the file."""

    from_number: _Number
    to_number: _Number
    T_from_to: SE2
    cov: Cov3
    loop: bool
    scale_rel: float = 0.0  # since version 4


class EarthRecord(msgspec.Struct, frozen=True, array_like=True, forbid_unknown_fields=True):
    """The georeference of a map."""

    latitude_deg: float
    longitude_deg: float
    east_m: float
    north_m: float
    yaw_rad: float
    scale: float
    cov: Annotated[tuple[float, ...], msgspec.Meta(min_length=16, max_length=16)]
    fixes: _Number
    outliers: _Number
    rms_m: float
    late_m: float


class MapRecord(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The body of the file."""

    camera: MapCamera
    drives: _Number
    words: bytes
    keyframes: list[KeyframeRecord]
    links: list[LinkRecord]
    earth: EarthRecord | None = None


def encode_map(place_map: PlaceMap) -> bytes:
    """Encodes a map."""
    words = b"" if place_map.words is None else place_map.words.tobytes()
    record = MapRecord(
        place_map.camera,
        place_map.drives,
        words,
        [_keyframe_record(keyframe) for keyframe in place_map.keyframes],
        [
            LinkRecord(link.from_number, link.to_number, link.T_from_to, _cov(link.cov), link.loop, link.scale_rel)
            for link in place_map.links
        ],
        None if place_map.earth is None else _earth_record(place_map.earth),
    )
    body = msgspec.msgpack.encode(record)
    return MAGIC + HEAD.pack(VERSION, len(body), zlib.crc32(body)) + body


def decode_map(data: bytes) -> PlaceMap:
    """Decodes a map. Raises MapError."""
    if not data:
        raise MapError("is empty")
    head = len(MAGIC) + HEAD.size
    if data[: len(MAGIC)] != MAGIC:
        raise MapError("is no map of BirdSLAM")
    if len(data) < head:
        raise MapError("is truncated in its header")
    version, length, crc = HEAD.unpack(data[len(MAGIC) : head])
    if version not in READ:
        reads = " and ".join(map(str, READ))
        raise MapError(f"is of version {version}; this BirdSLAM reads versions {reads}; create it again")
    if length > MAX_BYTES:
        raise MapError(f"declares {length} bytes, more than the limit of {MAX_BYTES}")
    if len(data) - head != length:
        raise MapError(f"is truncated: it has {len(data) - head} bytes after its header instead of {length}")
    body = data[head:]
    if zlib.crc32(body) != crc:
        raise MapError("is damaged: its CRC-32 differs")
    try:
        record = msgspec.msgpack.decode(body, type=MapRecord)
    except (msgspec.DecodeError, ValueError, RecursionError) as error:
        raise MapError(f"has an invalid body: {error}") from None
    return _map_of(record)


def _map_of(record: MapRecord) -> PlaceMap:
    camera = record.camera
    if not (math.isfinite(camera.fx_px) and camera.fx_px > 0.0 and 0.1 < camera.height_m < 10.0):
        raise MapError("has an invalid camera")
    if not (0 < camera.width_px <= 1 << 16 and 0 < camera.height_px <= 1 << 16):
        raise MapError("has an invalid camera")
    if len(record.keyframes) > MAX_KEYFRAMES:
        raise MapError(f"has {len(record.keyframes)} keyframes: more than {MAX_KEYFRAMES}")
    if len(record.words) % DESCRIPTOR_BYTES or len(record.words) > DESCRIPTOR_BYTES * (1 << 16):
        raise MapError("has invalid words")
    keyframes = [_keyframe(each) for each in record.keyframes]
    numbers = {keyframe.number for keyframe in keyframes}
    if len(numbers) != len(keyframes):
        raise MapError("has two keyframes with the same number")
    links = []
    for link in record.links:
        if link.from_number not in numbers or link.to_number not in numbers:
            raise MapError("has a link to a missing keyframe")
        if not 0.0 <= link.scale_rel <= MAX_SCALE_REL:
            raise MapError("has a link with an invalid scale")
        cov = _matrix(link.cov)
        links.append(Link(link.from_number, link.to_number, link.T_from_to, cov, link.loop, link.scale_rel))
    words = np.frombuffer(record.words, np.uint8).reshape(-1, DESCRIPTOR_BYTES) if record.words else None
    earth = None if record.earth is None else _earth(record.earth)
    return PlaceMap(camera, keyframes, links, words, record.drives, earth)


def _earth_record(earth: Earth) -> EarthRecord:
    at = earth.latitude_deg, earth.longitude_deg, earth.east_m, earth.north_m, earth.yaw_rad, earth.scale
    return EarthRecord(*at, _cov(earth.cov), earth.fixes, earth.outliers, earth.rms_m, earth.late_m)


def _earth(record: EarthRecord) -> Earth:
    numbers = (record.east_m, record.north_m, record.yaw_rad, record.rms_m, record.late_m)
    if not (math.isfinite(sum(numbers)) and is_on_earth(record.latitude_deg, record.longitude_deg)):
        raise MapError("has an invalid georeference")
    if not (0.5 < record.scale < 2.0 and max(map(abs, numbers)) < 1e7):
        raise MapError("has an invalid georeference")
    cov = np.array(record.cov).reshape(4, 4)
    if not math.isfinite(sum(record.cov)) or np.linalg.eigvalsh(cov)[0] < -1e-9:
        raise MapError("has an invalid covariance of its georeference")
    return Earth(
        *(record.latitude_deg, record.longitude_deg, record.east_m, record.north_m, record.yaw_rad, record.scale, cov),
        *(0.0, record.fixes, record.outliers, record.rms_m, None, record.late_m),
    )


def _keyframe_record(keyframe: Keyframe) -> KeyframeRecord:
    points = np.clip(np.round(keyframe.points_m / POINT_M), -32768, 32767).astype("<i2")
    steps = np.log(np.maximum(keyframe.sigma_depth_rel, MIN_SIGMA) / MIN_SIGMA) / SIGMA_STEP
    sigmas = np.clip(np.ceil(steps), 0, 255).astype(np.uint8)
    attitude, fixed = keyframe.attitude, keyframe.gnss
    return KeyframeRecord(
        keyframe.number,
        keyframe.drive,
        keyframe.t_source_ns,
        keyframe.T_map_keyframe,
        _cov(keyframe.cov),
        (attitude.z_m, attitude.pitch_rad, attitude.roll_rad),
        keyframe.camera_height_m,
        points.tobytes() + sigmas.tobytes() + keyframe.descriptors.tobytes(),
        None if fixed is None else (fixed.latitude_deg, fixed.longitude_deg, fixed.sigma_m, fixed.weighed_m),
        tuple(_piece_record(piece) for piece in keyframe.lines),
        keyframe.scale,
    )


def _piece_record(piece: LinePiece) -> PieceRecord:
    points = np.clip(np.round(piece.points_m / POINT_M), -32768, 32767).astype("<i2")
    return PieceRecord(piece.drive, piece.line, piece.kind, piece.colour, points.tobytes(), round(piece.sigma_m, 4))


def _piece(record: PieceRecord) -> LinePiece:
    count, rest = divmod(len(record.points), 4)
    if rest or not 0 < count <= MAX_NODES or not 0.0 <= record.sigma_m < 1e3:
        raise MapError(f"line {record.line}: has invalid points")
    points_m = np.frombuffer(record.points, "<i2").reshape(-1, 2) * POINT_M
    return LinePiece(record.drive, record.line, record.kind, record.colour, points_m, record.sigma_m)


def _keyframe(record: KeyframeRecord) -> Keyframe:
    count, rest = divmod(len(record.points), _POINT_BYTES)
    if rest or count > MAX_KEYFRAME_POINTS:
        raise MapError(f"keyframe {record.number}: has invalid points")
    if not math.isfinite(sum(record.attitude)) or max(map(abs, record.attitude[1:])) > 1.5:
        raise MapError(f"keyframe {record.number}: has an invalid attitude")
    if not 0.1 < record.camera_height_m < 10.0:
        raise MapError(f"keyframe {record.number}: has an invalid camera height")
    if not MIN_SCALE < record.scale < 1.0 / MIN_SCALE:
        raise MapError(f"keyframe {record.number}: has an invalid scale")
    if len(record.lines) > MAX_PIECES:
        raise MapError(f"keyframe {record.number}: has {len(record.lines)} lines: more than {MAX_PIECES}")
    fixed = None if record.gnss is None else Fixed(*record.gnss)
    if fixed is not None and not (
        is_on_earth(fixed.latitude_deg, fixed.longitude_deg) and 0.0 < fixed.sigma_m <= fixed.weighed_m < 1e9
    ):
        raise MapError(f"keyframe {record.number}: has an invalid GNSS fix")
    points = np.frombuffer(record.points, "<i2", 3 * count).reshape(-1, 3) * POINT_M
    sigmas = MIN_SIGMA * np.exp(SIGMA_STEP * np.frombuffer(record.points, np.uint8, count, 6 * count))
    descriptors = np.frombuffer(record.points, np.uint8, DESCRIPTOR_BYTES * count, 7 * count)
    return Keyframe(
        record.number,
        record.drive,
        record.t_source_ns,
        record.T_map_keyframe,
        _matrix(record.cov),
        Attitude(z_m=record.attitude[0], pitch_rad=record.attitude[1], roll_rad=record.attitude[2]),
        points,
        sigmas,
        descriptors.reshape(-1, DESCRIPTOR_BYTES),
        record.camera_height_m,
        fixed,
        tuple(_piece(each) for each in record.lines),
        record.scale,
    )


def _cov(cov: np.ndarray) -> tuple[float, ...]:
    return tuple(float(number) for number in cov.ravel())


def _matrix(cov: tuple[float, ...]) -> np.ndarray:
    if not math.isfinite(sum(cov)) or min(cov[::4]) < 0.0:
        raise MapError("has an invalid covariance")
    return np.array(cov).reshape(3, 3)
