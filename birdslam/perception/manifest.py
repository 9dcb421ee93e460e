"""Model manifests: a small TOML file says what a network takes and what each of its outputs means.

A manifest is found by the first of these that exists: the one named explicitly (a path, or the name of a shipped one),
the file beside the network with the same stem, the shipped one with the network's SHA-256, the shipped one with the
network's stem. Unknown keys are errors.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, Literal

import msgspec

SHIPPED_DIRECTORY = Path(__file__).parent / "manifests"

Role = Literal["detector", "segmenter"]
Label = Literal["car", "truck", "bus", "person", "bicycle", "motorcycle"]
Meaning = Literal["road", "lane"]
Pixels = Annotated[int, msgspec.Meta(ge=8, le=8192)]
Fraction = Annotated[float, msgspec.Meta(ge=0.0, le=1.0)]
Count = Annotated[int, msgspec.Meta(ge=1)]
Sha256 = Annotated[str, msgspec.Meta(pattern="^([0-9a-f]{64})?$")]


class ModelError(ValueError):
    """A network or its manifest that can't be used; the message names the file, the key and both sides' statements."""


class Misfit(ValueError):
    """One key of a manifest that its network contradicts; `load_network` makes a ModelError of it."""

    def __init__(self, key: str, said: object, has: object) -> None:
        super().__init__(f"{key}: the manifest says {said}, the network has {has}")


class Stretch(msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag_field="mode", tag="stretch"):
    """The image is resized to the input's size whatever its aspect."""


class FitPad(msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag_field="mode", tag="fit_pad"):
    """The image keeps its aspect, fills the input in one direction and is padded in the other."""

    pad_value: Annotated[int, msgspec.Meta(ge=0, le=255)] = 114
    align: Literal["top_left", "centre"] = "top_left"


class Input(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The network's one input, float32, batch 1, three channels: (pixel * scale - mean) / std.

    A grey image is given three times. `mean` and `std` are in the order of `colour`, in units of the scaled pixel.
    """

    name: str
    width_px: Pixels
    height_px: Pixels
    layout: Literal["NCHW", "NHWC"]
    colour: Literal["RGB", "BGR"]
    resize: Stretch | FitPad
    scale: float = 1.0
    mean: tuple[float, float, float] = (0.0, 0.0, 0.0)
    std: tuple[float, float, float] = (1.0, 1.0, 1.0)

    def __post_init__(self) -> None:
        if not all(math.isfinite(x) for x in (self.scale, *self.mean, *self.std)) or self.scale <= 0.0:
            raise ValueError("scale, mean and std must be finite, scale positive")
        if min(self.std) <= 0.0:
            raise ValueError(f"std must be positive, got {self.std}")


class Tiles(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A wide image is cut into at most `columns` columns of equal width, each a run of its own.

    Fewer are cut where they already fill the input's aspect: more would cost and not enlarge anything. Neighbours share
    at least `overlap` of a column's width.
    """

    columns: Annotated[int, msgspec.Meta(ge=1, le=16)]
    overlap: Annotated[float, msgspec.Meta(ge=0.0, le=0.9)] = 0.2


class Yolox(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True, tag_field="decoding", tag="yolox"):
    """(1, cells, 5 + classes): xy, log wh, objectness, classes (both already sigmoid) on square grids of `strides`.

    centre = (xy + cell) * stride, size = exp(wh) * stride, score = objectness * class. A class without a label in
    `labels` is not reported. Labels that stand together in `rivals` suppress each other in NMS as if they were one
    class (one vehicle is not both a car and a truck).
    """

    output: str
    strides: Annotated[tuple[Count, ...], msgspec.Meta(min_length=1)]
    classes: Count
    labels: Annotated[dict[int, Label], msgspec.Meta(min_length=1)]
    score_threshold: Fraction
    nms_iou: Fraction
    rivals: tuple[tuple[Label, ...], ...] = ()

    def __post_init__(self) -> None:
        for index in self.labels:
            if not 0 <= index < self.classes:
                raise ValueError(f"labels: there is no class {index} among {self.classes} classes")


class ClassMap(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """One meaning of a (1, channels, h, w) output: where `channel` is the largest, or where it is above `threshold`."""

    meaning: Meaning
    output: str
    channel: Annotated[int, msgspec.Meta(ge=0)]
    channels: Count
    rule: Literal["argmax", "above"] = "argmax"
    threshold: float = 0.0

    def __post_init__(self) -> None:
        if self.channel >= self.channels:
            raise ValueError(f"channel: there is no channel {self.channel} among {self.channels}")
        if self.rule == "argmax" and self.channels < 2:
            raise ValueError('rule: "argmax" needs at least two channels')
        if not math.isfinite(self.threshold) or (self.rule == "argmax" and self.threshold != 0.0):
            raise ValueError('threshold: a finite number, and only with rule = "above"')


class ClassMaps(
    msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True, tag_field="decoding", tag="class_maps"
):
    """Segmentation by class channels that lie over the whole input (padding included)."""

    maps: Annotated[tuple[ClassMap, ...], msgspec.Meta(min_length=1)]

    def __post_init__(self) -> None:
        meanings = [m.meaning for m in self.maps]
        if len(set(meanings)) != len(meanings):
            raise ValueError(f"maps: each meaning once, got {', '.join(meanings)}")


class Schedule(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """What suits this network; a `ModelSpec` may say otherwise.

    It runs on every `every`-th frame with `threads` threads. Where `awaited` is false no frame waits for it: its result
    is taken when it is there (with patience None it is awaited all the same).
    """

    every: Count = 1
    threads: Annotated[int, msgspec.Meta(ge=1, le=64)] = 1
    awaited: bool = True


class Manifest(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """What a network takes and gives. The table named like its role says what the outputs mean."""

    role: Role
    input: Input
    title: str = ""
    sha256: Sha256 = ""  # of the .onnx file; a file with another one is refused
    schedule: Schedule = Schedule()
    tiles: Tiles | None = None
    detector: Yolox | None = None
    segmenter: ClassMaps | None = None

    def __post_init__(self) -> None:
        given = [role for role in ("detector", "segmenter") if getattr(self, role) is not None]
        if given != [self.role]:
            raise ValueError(f"role: a {self.role} needs the table [{self.role}] and no other, got {given}")
        if self.tiles is not None and self.detector is None:
            raise ValueError(f"tiles: a {self.role} can't run on tiles, only a detector")


def read_manifest(path: Path) -> Manifest:
    """The manifest in a TOML file. Raises ModelError naming the file and the key."""
    try:
        return msgspec.toml.decode(path.read_bytes(), type=Manifest)
    except OSError as error:
        raise ModelError(f"{path}: the manifest can't be read: {error.strerror}") from error
    except (msgspec.MsgspecError, UnicodeDecodeError) as error:
        raise ModelError(f"{path}: {error}") from error


def shipped_manifests() -> dict[str, Path]:
    """Name -> file of the manifests inside the package, in order of name."""
    return {path.stem: path for path in sorted(SHIPPED_DIRECTORY.glob("*.toml"))}


def find_manifest(network: Path, sha256: str, explicit: str = "") -> tuple[Manifest, Path]:
    """The manifest of a network file with the given hash, and the file it came from (see the module's docstring).

    Raises ModelError where there is none, where it can't be read, or where it pins another hash.
    """
    path, manifest = _locate(network, sha256, explicit)
    if manifest.sha256 and manifest.sha256 != sha256:
        raise ModelError(f"{network}: sha256: the manifest {path} says {manifest.sha256}, the file has {sha256}")
    return manifest, path


def _locate(network: Path, sha256: str, explicit: str) -> tuple[Path, Manifest]:
    shipped = shipped_manifests()
    if explicit:
        path = shipped.get(explicit, Path(explicit))
        if not path.is_file():
            raise ModelError(f"{network}: no manifest {explicit!r}: no such file, and shipped are {', '.join(shipped)}")
        return path, read_manifest(path)
    beside = network.with_suffix(".toml")
    if beside.is_file():
        return beside, read_manifest(beside)
    for path in shipped.values():
        manifest = read_manifest(path)
        if manifest.sha256 == sha256:
            return path, manifest
    if network.stem in shipped:
        path = shipped[network.stem]
        return path, read_manifest(path)
    raise ModelError(
        f"{network}: no manifest: none beside it ({beside.name}), none shipped with its SHA-256 {sha256} or its name "
        f"(shipped: {', '.join(shipped)}); state one by manifest ="
    )
