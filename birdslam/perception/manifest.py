"""Model manifests: a small TOML file states a network's input and the meaning of each output.

Unknown keys are errors. manifest_file.py finds a network's manifest.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, Literal, get_args

import msgspec

SHIPPED_NETWORKS = Path(__file__).parent / "shipped"  # each with its manifest beside it, but that of lane grids
SHIPPED_MULTITASK = "multitask_int8.onnx"  # as good as the fp32 one in half the time; `--model multitask` is that

Role = Literal["detector", "segmenter", "depth", "multitask"]
Label = Literal["car", "truck", "bus", "person", "bicycle", "motorcycle"]
Meaning = Literal["road", "lane"]
Pixels = Annotated[int, msgspec.Meta(ge=8, le=8192)]
Fraction = Annotated[float, msgspec.Meta(ge=0.0, le=1.0)]
Count = Annotated[int, msgspec.Meta(ge=1)]
Variance = Annotated[float, msgspec.Meta(gt=0.0, le=10.0)]
SigmaRel = Annotated[float, msgspec.Meta(ge=0.0, lt=1.0)]
BiasRel = Annotated[float, msgspec.Meta(ge=-0.3, le=0.3)]
LowerEdge = Literal["body", "tyres"]  # see DetectorTable
Scoring = Literal["none", "sigmoid", "softmax"]  # what makes scores in [0, 1] of a detector's numbers
Sha256 = Annotated[str, msgspec.Meta(pattern="^([0-9a-f]{64})?$")]


class ModelError(ValueError):
    """A network or its manifest that can't be used; the message names the file, the key and both sides' statements."""


class ManifestMismatch(ValueError):
    """One key of a manifest that its network contradicts; `load_network` makes a ModelError of it."""

    def __init__(self, key: str, stated: object, has: object) -> None:
        super().__init__(f"{key}: the manifest says {stated}, the network has {has}")


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


class BoxSigma(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """1-sigma of each edge of a detector's boxes, as measured against the truth: `rel` of the box's side and `px`.

    Pixels are those of the network's input. It says how much Eq. 1 on the bottom of a box is worth. An edge that is
    named has its own number instead of `rel`; sides are the width for left and right, the height for upper and lower.
    """

    rel: SigmaRel
    px: Annotated[float, msgspec.Meta(gt=0.0, le=100.0)]
    left: SigmaRel | None = None
    right: SigmaRel | None = None
    upper: SigmaRel | None = None
    lower: SigmaRel | None = None


class DrawnInside(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """How far inside of an object's outline a detector draws each edge in the median, as a fraction of the box's side.

    Negative: outside of it. Sides are the width for left and right, the height for upper and lower. Every box is
    corrected by it: Eq. 1 makes too large a depth of a lower edge that is too high.
    """

    left: BiasRel = 0.0
    right: BiasRel = 0.0
    upper: BiasRel = 0.0
    lower: BiasRel = 0.0


class DetectorTable(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """What every detector's table has.

    A class without a label in `labels` is not reported. Labels that stand together in `rivals` suppress each other in
    NMS as if they were one class (one vehicle is not both a car and a truck). `lower_edge` says where boxes of vehicles
    end: with the cuboid around the body, as labels of KITTI do, or where the outline ends, which is at the tyres.
    """

    classes: Count
    labels: Annotated[dict[int, Label], msgspec.Meta(min_length=1)]
    score_threshold: Fraction
    nms_iou: Fraction
    rivals: tuple[tuple[Label, ...], ...] = ()
    box_sigma: BoxSigma | None = None  # None: localisation.sigma_box_rel and sigma_box_px of the configuration
    drawn_inside: DrawnInside = DrawnInside()
    lower_edge: LowerEdge = "body"

    def __post_init__(self) -> None:
        for index in self.labels:
            if not 0 <= index < self.classes:
                raise ValueError(f"labels: there is no class {index} among {self.classes} classes")


class Yolox(DetectorTable, frozen=True, forbid_unknown_fields=True, kw_only=True, tag_field="decoding", tag="yolox"):
    """(1, cells, 5 + classes): xy, log wh, objectness, classes (both already sigmoid) on square grids of `strides`.

    centre = (xy + cell) * stride, size = exp(wh) * stride, score = objectness * class.
    """

    output: str
    strides: Annotated[tuple[Count, ...], msgspec.Meta(min_length=1)]


class CenterNet(
    DetectorTable, frozen=True, forbid_unknown_fields=True, kw_only=True, tag_field="decoding", tag="centernet"
):
    """Objects as points: a heat map (1, classes, h, w) with a peak at each centre, its size and its offset in the cell.

    `sizes` is (1, 2, h, w) width and height, in cells of the map or in pixels of the input; `offsets`, where there is
    one, (1, 2, h, w) x and y in cells, to be added to the peak's cell. `heat` says what the heat map holds: scores, or
    logits that a sigmoid makes scores. A peak is the largest of its 3x3 cells. NMS joins tiles and rivals.
    """

    heat_map: str
    sizes: str
    offsets: str = ""
    heat: Literal["scores", "logits"] = "scores"
    size_unit: Literal["cells", "pixels"] = "cells"
    nms_iou: Fraction = 0.6


class Ssd(DetectorTable, frozen=True, forbid_unknown_fields=True, kw_only=True, tag_field="decoding", tag="ssd"):
    """Prior boxes (N, 4) as x1, y1, x2, y2 in fractions of the input, their shifts (1, N, 4), scores (1, N, classes).

    With a prior's centre c and size s, and v of the `variances`: centre = c + v[:2] * shift[:2] * s,
    size = s * exp(v[2:] * shift[2:]). `scoring` says what makes scores of the numbers; the background is a class too,
    without a label.
    """

    locations: str
    scores: str
    priors: str
    variances: tuple[Variance, Variance, Variance, Variance] = (0.1, 0.1, 0.2, 0.2)
    scoring: Scoring = "none"


class BoxList(DetectorTable, frozen=True, forbid_unknown_fields=True, kw_only=True, tag_field="decoding", tag="boxes"):
    """Decoded boxes with a score for each class: (1, N, 4) and (1, N, classes), in one output or in two.

    Without `scores` they follow the box in its own output, as YOLOv8 has them. `layout` says which axis comes first:
    "boxes" (1, N, channels) or "channels" (1, channels, N). `form` is what the four numbers are, `unit` theirs:
    pixels or fractions of the input. `scoring` makes scores of the numbers: a DETR's last class, of a softmax, is
    no object and has no label.
    """

    boxes: str
    scores: str = ""
    layout: Literal["boxes", "channels"] = "boxes"
    form: Literal["centre_size", "corners"] = "centre_size"
    unit: Literal["pixels", "fractions"] = "pixels"
    scoring: Scoring = "none"


class ClassMap(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """One meaning of a (1, channels, h, w) output of scores or logits.

    `channel` is one channel or a list of them, each a class that means the same. By rule "argmax" the meaning is where
    the largest of all channels is one of these; by "above" where one of these is over `threshold`, which with `sigmoid`
    is a probability that the output's logits are held against.
    """

    meaning: Meaning
    output: str
    channel: int | tuple[int, ...]
    channels: Count
    rule: Literal["argmax", "above"] = "argmax"
    threshold: float = 0.0
    sigmoid: bool = False

    def __post_init__(self) -> None:
        if not self.chosen or len(set(self.chosen)) != len(self.chosen):
            raise ValueError(f"channel: a channel, or a list with each channel once, got {self.channel}")
        for channel in self.chosen:
            if not 0 <= channel < self.channels:
                raise ValueError(f"channel: there is no channel {channel} among {self.channels}")
        if self.rule == "argmax" and self.channels <= len(self.chosen):
            raise ValueError('rule: "argmax" needs at least one channel more than those chosen: at least two channels')
        if not math.isfinite(self.threshold) or (self.rule == "argmax" and self.threshold != 0.0):
            raise ValueError('threshold: a finite number, and only with rule = "above"')
        if self.sigmoid and not (self.rule == "above" and 0.0 < self.threshold < 1.0):
            raise ValueError('sigmoid: only with rule = "above" and a threshold between 0 and 1')

    @property
    def chosen(self) -> tuple[int, ...]:
        """The channels of this meaning."""
        return (self.channel,) if isinstance(self.channel, int) else self.channel

    @property
    def level(self) -> float:
        """What a channel must exceed under rule "above", in the output's own numbers."""
        return math.log(self.threshold / (1.0 - self.threshold)) if self.sigmoid else self.threshold


class ClassMaps(
    msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True, tag_field="decoding", tag="class_maps"
):
    """Segmentation by class channels that lie over the whole input (padding included)."""

    maps: Annotated[tuple[ClassMap, ...], msgspec.Meta(min_length=1)]

    def __post_init__(self) -> None:
        meanings = [m.meaning for m in self.maps]
        if len(set(meanings)) != len(meanings):
            raise ValueError(f"maps: each meaning once, got {', '.join(meanings)}")


class RowAnchors(
    msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True, tag_field="decoding", tag="row_anchors"
):
    """Lane lines by rows (1, columns + 1, rows, lines): logits of a line's column in a row, the last: not there.

    As exports of Ultra-Fast-Lane-Detection give them. `rows` are the rows as fractions of the input's height, in the
    output's order; `columns` lie evenly from the input's left to its right. The network knows lines and no road.
    """

    output: str
    columns: Count
    rows: Annotated[tuple[Fraction, ...], msgspec.Meta(min_length=2)]
    lines: Count = 4

    def __post_init__(self) -> None:
        if len(set(self.rows)) != len(self.rows):
            raise ValueError("rows: each row once")


class Disparity(
    msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True, tag_field="decoding", tag="disparity"
):
    """Monodepth2's and Lite-Mono's (1, 1, h, w) sigmoid disparity over the whole input.

    depth = depth_scale / (1 / max + (1 / min - 1 / max) * disparity), with the bounds that the network was trained
    with; `depth_scale` is 5.4 for networks trained on KITTI's stereo pairs. One trained on single images alone has no
    scale of its own: `metric` false has the road under the camera give it, frame by frame.
    """

    output: str
    min_depth_m: Annotated[float, msgspec.Meta(gt=0.0)] = 0.1
    max_depth_m: Annotated[float, msgspec.Meta(gt=0.0)] = 100.0
    depth_scale: Annotated[float, msgspec.Meta(gt=0.0)] = 1.0
    metric: bool = True
    sigma_rel: Annotated[float, msgspec.Meta(gt=0.0, lt=1.0)] = 0.15  # 1-sigma of a pixel's depth, as a fraction

    def __post_init__(self) -> None:
        if not self.min_depth_m < self.max_depth_m < math.inf:
            raise ValueError(f"max_depth_m: {self.max_depth_m} is not over min_depth_m = {self.min_depth_m}")
        if not math.isfinite(self.depth_scale):
            raise ValueError("depth_scale: a finite number")


class MetricDepth(
    msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True, tag_field="decoding", tag="metric"
):
    """(1, 1, h, w) or (1, h, w) depth along the optical axis over the whole input, in units of `metres_per_unit`.

    What lies outside of min_depth_m to max_depth_m is moved to that bound. `canonical_focal_rel` > 0: the network
    answers for a focal length of this factor times the image width, and is scaled to the camera's.
    """

    output: str
    metres_per_unit: Annotated[float, msgspec.Meta(gt=0.0)] = 1.0
    min_depth_m: Annotated[float, msgspec.Meta(gt=0.0)] = 0.5
    max_depth_m: Annotated[float, msgspec.Meta(gt=0.0)] = 200.0
    canonical_focal_rel: Annotated[float, msgspec.Meta(ge=0.0, le=10.0)] = 0.0
    sigma_rel: Annotated[float, msgspec.Meta(gt=0.0, lt=1.0)] = 0.1

    def __post_init__(self) -> None:
        if not self.min_depth_m < self.max_depth_m < math.inf:
            raise ValueError(f"max_depth_m: {self.max_depth_m} is not over min_depth_m = {self.min_depth_m}")
        if not math.isfinite(self.metres_per_unit):
            raise ValueError("metres_per_unit: a finite number")


class MultiTask(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The shipped kind of network: boxes with bodies, masks and depth in one run (perception/decoding/multitask.py).

    A box's centre counts from `score_threshold` on; a mask is where its logit is over the bar.
    """

    score_threshold: Annotated[float, msgspec.Meta(gt=0.0, lt=1.0)] = 0.3
    nms_iou: Fraction = 0.5
    road_logit: float = 0.0
    lane_logit: float = 0.0
    box_sigma: BoxSigma = BoxSigma(rel=0.045, px=0.5)  # of the shipped one, on held-out worlds at two image sizes
    drawn_inside: DrawnInside = DrawnInside()
    lower_edge: LowerEdge = "tyres"  # boxes of the built-in world are outlines of its meshes
    depth_sigma_rel: Annotated[float, msgspec.Meta(gt=0.0, lt=1.0)] = 0.15  # 1-sigma of a pixel's depth, as a fraction

    def __post_init__(self) -> None:
        if not (math.isfinite(self.road_logit) and math.isfinite(self.lane_logit)):
            raise ValueError("road_logit and lane_logit must be finite")


class Schedule(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """When this network runs, where a `ModelSpec` states nothing else.

    It runs on every `every`-th frame with `threads` threads. Where `awaited` is false no frame waits for it: its result
    is used once it is there (with patience None it is awaited all the same).
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
    detector: Yolox | CenterNet | Ssd | BoxList | None = None
    segmenter: ClassMaps | RowAnchors | None = None
    depth: Disparity | MetricDepth | None = None
    multitask: MultiTask | None = None

    def __post_init__(self) -> None:
        given = [role for role in get_args(Role) if getattr(self, role) is not None]
        if given != [self.role]:
            raise ValueError(f"role: a {self.role} needs the table [{self.role}] and no other, got {given}")
        if self.tiles is not None and self.detector is None:
            raise ValueError(f"tiles: a {self.role} can't run on tiles, only a detector")
