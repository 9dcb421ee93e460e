"""The Foxglove types that a recording uses (https://docs.foxglove.dev, "Message schemas"), and their JSON schemas.

Structs and fields have the names of the Foxglove types; bytes are encoded as base64.
"""

from __future__ import annotations

from typing import Any

import msgspec

FLOAT32 = 7  # numeric type of PackedElementField
LINE_STRIP, LINE_LOOP = 0, 1  # types of LinePrimitive
ALL = 1  # type of SceneEntityDeletion


class Time(msgspec.Struct, frozen=True):
    sec: int = 0
    nsec: int = 0


class Color(msgspec.Struct, frozen=True):
    r: float
    g: float
    b: float
    a: float = 1.0


WHITE, CLEAR = Color(1.0, 1.0, 1.0), Color(0.0, 0.0, 0.0, 0.0)


class Point2(msgspec.Struct, frozen=True):
    x: float
    y: float


class Vector3(msgspec.Struct, frozen=True):
    x: float = 0.0
    y: float = 0.0
    z: float = 0.0


class Quaternion(msgspec.Struct, frozen=True):
    x: float = 0.0
    y: float = 0.0
    z: float = 0.0
    w: float = 1.0


class FoxglovePose(msgspec.Struct, frozen=True):
    position: Vector3 = Vector3()
    orientation: Quaternion = Quaternion()


class FrameTransform(msgspec.Struct, frozen=True, kw_only=True):
    timestamp: Time
    parent_frame_id: str
    child_frame_id: str
    translation: Vector3
    rotation: Quaternion


class PoseInFrame(msgspec.Struct, frozen=True, kw_only=True):
    timestamp: Time
    frame_id: str
    pose: FoxglovePose


class CubePrimitive(msgspec.Struct, frozen=True, kw_only=True):
    pose: FoxglovePose
    size: Vector3
    color: Color


class LinePrimitive(msgspec.Struct, frozen=True, kw_only=True):
    type: int
    pose: FoxglovePose = FoxglovePose()
    thickness: float = 0.1
    scale_invariant: bool = False
    points: tuple[Vector3, ...]
    color: Color
    colors: tuple[Color, ...] = ()
    indices: tuple[int, ...] = ()


class TextPrimitive(msgspec.Struct, frozen=True, kw_only=True):
    pose: FoxglovePose
    billboard: bool = True
    font_size: float = 0.8
    scale_invariant: bool = False
    color: Color = WHITE
    text: str


class SceneEntity(msgspec.Struct, frozen=True, kw_only=True):
    timestamp: Time
    frame_id: str
    id: str
    lifetime: Time = Time()
    frame_locked: bool = False
    cubes: tuple[CubePrimitive, ...] = ()
    lines: tuple[LinePrimitive, ...] = ()
    texts: tuple[TextPrimitive, ...] = ()


class SceneEntityDeletion(msgspec.Struct, frozen=True, kw_only=True):
    timestamp: Time
    type: int
    id: str = ""


class SceneUpdate(msgspec.Struct, frozen=True, kw_only=True):
    deletions: tuple[SceneEntityDeletion, ...]
    entities: tuple[SceneEntity, ...]


class PackedElementField(msgspec.Struct, frozen=True):
    name: str
    offset: int
    type: int = FLOAT32


class PointCloud(msgspec.Struct, frozen=True, kw_only=True):
    timestamp: Time
    frame_id: str
    pose: FoxglovePose = FoxglovePose()
    point_stride: int = 12
    fields: tuple[PackedElementField, ...] = tuple(PackedElementField(name, 4 * i) for i, name in enumerate("xyz"))
    data: bytes


class CompressedImage(msgspec.Struct, frozen=True, kw_only=True):
    timestamp: Time
    frame_id: str
    data: bytes
    format: str


class CameraCalibration(msgspec.Struct, frozen=True, kw_only=True):
    timestamp: Time
    frame_id: str
    width: int
    height: int
    distortion_model: str = "plumb_bob"
    D: tuple[float, ...] = ()
    K: tuple[float, ...]
    R: tuple[float, ...] = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
    P: tuple[float, ...]


class PointsAnnotation(msgspec.Struct, frozen=True, kw_only=True):
    timestamp: Time
    type: int = 2  # LINE_LOOP
    points: tuple[Point2, ...]
    outline_color: Color
    outline_colors: tuple[Color, ...] = ()
    fill_color: Color = CLEAR
    thickness: float = 2.0


class TextAnnotation(msgspec.Struct, frozen=True, kw_only=True):
    timestamp: Time
    position: Point2
    text: str
    font_size: float = 12.0
    text_color: Color = WHITE
    background_color: Color = Color(0.0, 0.0, 0.0, 0.5)


class ImageAnnotations(msgspec.Struct, frozen=True, kw_only=True):
    circles: tuple[()] = ()
    points: tuple[PointsAnnotation, ...]
    texts: tuple[TextAnnotation, ...]


def schema(record: type[msgspec.Struct]) -> bytes:
    """Returns the JSON schema of a struct for Foxglove: an object at the top, no unions.

    It also avoids references and objects of unknown fields, which Lichtblick does not support.
    """
    (top,), parts = msgspec.json.schema_components([record], ref_template="{name}")
    return msgspec.json.encode(_simple(top, parts))


def _simple(part: Any, parts: dict[str, Any]) -> Any:
    """Resolves references, converts tuples of one type to arrays, and removes null from unions."""
    if isinstance(part, list):
        return [_simple(item, parts) for item in part]
    if not isinstance(part, dict):
        return part
    if "$ref" in part:
        return _simple(parts[part["$ref"]], parts)
    if "anyOf" in part:
        (kept,) = [choice for choice in part["anyOf"] if choice.get("type") != "null"]
        return _simple(kept, parts)
    part = {key: value for key, value in part.items() if key not in ("default", "examples", "additionalProperties")}
    if "prefixItems" in part:
        part["items"], *others = part.pop("prefixItems")
        if any(other != part["items"] for other in others):
            part["items"] = {}  # of any type; not in channels that Foxglove draws
    if "enum" in part:
        part = {"type": "string"}
    if part.get("type") == "object":
        part.setdefault("properties", {})
    if part.get("type") == "array":
        part.setdefault("items", {"type": "object", "properties": {}})  # an array that stays empty
    return {key: _simple(value, parts) for key, value in part.items()}
