"""Model manifests: a small TOML file states a network's input and the meaning of each output.

Unknown keys are errors. manifest_file.py finds a network's manifest.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, Literal, get_args

import msgspec

SHIPPED_NETWORKS = Path(__file__).parent / "shipped"  # with their manifests; the lane-grid network has none
SHIPPED_MULTITASK = "multitask_int8.onnx"  # `--model multitask` selects the fp32 network

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
Scoring = Literal["none", "sigmoid", "softmax"]  # converts a detector's outputs to scores in [0, 1]
Sha256 = Annotated[str, msgspec.Meta(pattern="^([0-9a-f]{64})?$")]


class ModelError(ValueError):
    """An unusable network or manifest. The message names the file, the key and both values."""


class ManifestMismatch(ValueError):
    """A key of a manifest contradicts the network; `load_network` converts this to a ModelError."""

    def __init__(self, key: str, stated: object, has: object) -> None:
        super().__init__(f"{key}: the manifest says {stated}, the network has {has}")


class Stretch(msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag_field="mode", tag="stretch"):
    """The image is resized to the input's size; its aspect ratio is not kept."""


class FitPad(msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag_field="mode", tag="fit_pad"):
    """The image keeps its aspect ratio, fills the input in one direction and is padded in the other."""

    pad_value: Annotated[int, msgspec.Meta(ge=0, le=255)] = 114
    align: Literal["top_left", "centre"] = "top_left"


class Input(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The network's one input, float32, batch 1, three channels: (pixel * scale - mean) / std.

    A grey image is repeated in all three channels. `mean` and `std` follow the order of `colour`, in scaled pixels.
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
    """A wide image is cut into at most `columns` columns of equal width; the network runs once per column.

    Fewer columns are used when they already match the input's aspect ratio: more would not raise the resolution.
    Neighbouring columns overlap by at least `overlap` of their width.
    """

    columns: Annotated[int, msgspec.Meta(ge=1, le=16)]
    overlap: Annotated[float, msgspec.Meta(ge=0.0, le=0.9)] = 0.2


class BoxSigma(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """1-sigma of a detector's box edges: `rel`, a fraction of the box's side, plus `px` of the network's input.

    It sets the covariance of Eq. 1 on the lower edge of a box. A value for a named edge replaces `rel`. The side is the
    width for the left and right edges, the height for the upper and lower ones.
    """

    rel: SigmaRel
    px: Annotated[float, msgspec.Meta(gt=0.0, le=100.0)]
    left: SigmaRel | None = None
    right: SigmaRel | None = None
    upper: SigmaRel | None = None
    lower: SigmaRel | None = None


class DrawnInside(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Median bias of each edge of a detector's boxes, as a fraction of the box's side; positive is inside the outline.

    The side is the width for the left and right edges, the height for the upper and lower ones. Every box is corrected:
    by Eq. 1 a lower edge that is too high gives too large a depth.
    """

    left: BiasRel = 0.0
    right: BiasRel = 0.0
    upper: BiasRel = 0.0
    lower: BiasRel = 0.0


class DetectorTable(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The keys common to all detectors.

    A class without a label in `labels` is not reported. Labels of one group in `rivals` suppress each other in NMS as
    if they were one class (a vehicle is not both a car and a truck). `lower_edge` states where boxes of vehicles end:
    at the cuboid around the body, as KITTI's labels do, or at the tyres.
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
                raise ValueError(f"labels: class {index} is not one of {self.classes} classes")


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

    `sizes` (1, 2, h, w) is width and height, in cells of the map or in pixels of the input. The optional `offsets`
    (1, 2, h, w), x and y in cells, are added to the peak's cell. `heat` states whether the heat map holds scores or
    logits. A peak is the maximum of its 3x3 cells. NMS merges tiles and rivals.
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
    size = s * exp(v[2:] * shift[2:]). `scoring` converts the outputs to scores. The background is a class without a
    label.
    """

    locations: str
    scores: str
    priors: str
    variances: tuple[Variance, Variance, Variance, Variance] = (0.1, 0.1, 0.2, 0.2)
    scoring: Scoring = "none"


class BoxList(DetectorTable, frozen=True, forbid_unknown_fields=True, kw_only=True, tag_field="decoding", tag="boxes"):
    """Decoded boxes with a score for each class: (1, N, 4) and (1, N, classes), in one output or in two.

    Without `scores` the scores follow the box in the same output, as in YOLOv8. `layout` is "boxes" (1, N, channels) or
    "channels" (1, channels, N). `form` is the meaning of the four numbers, `unit` their unit: pixels or fractions of
    the input. `scoring` converts the outputs to scores. The last class of a DETR, "no object", has no label.
    """

    boxes: str
    scores: str = ""
    layout: Literal["boxes", "channels"] = "boxes"
    form: Literal["centre_size", "corners"] = "centre_size"
    unit: Literal["pixels", "fractions"] = "pixels"
    scoring: Scoring = "none"


class ClassMap(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """One meaning of a (1, channels, h, w) output of scores or logits.

    `channel` is one channel or a list of channels with this meaning. Rule "argmax" selects the pixels whose largest
    channel is one of these; rule "above" those where one of these exceeds `threshold`. With `sigmoid` the outputs are
    logits and the threshold is a probability.
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
            raise ValueError(f"channel must be a channel or a list of distinct channels, got {self.channel}")
        for channel in self.chosen:
            if not 0 <= channel < self.channels:
                raise ValueError(f"channel: {channel} is not one of {self.channels} channels")
        if self.rule == "argmax" and self.channels <= len(self.chosen):
            raise ValueError('rule: "argmax" needs at least two channels, one of which is not listed in channel')
        if not math.isfinite(self.threshold) or (self.rule == "argmax" and self.threshold != 0.0):
            raise ValueError('threshold must be finite, and needs rule = "above"')
        if self.sigmoid and not (self.rule == "above" and 0.0 < self.threshold < 1.0):
            raise ValueError('sigmoid needs rule = "above" and a threshold between 0 and 1')

    @property
    def chosen(self) -> tuple[int, ...]:
        """The channels of this meaning."""
        return (self.channel,) if isinstance(self.channel, int) else self.channel

    @property
    def level(self) -> float:
        """The threshold of rule "above", in units of the output."""
        return math.log(self.threshold / (1.0 - self.threshold)) if self.sigmoid else self.threshold


class ClassMaps(
    msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True, tag_field="decoding", tag="class_maps"
):
    """Segmentation by class channels that cover the whole input (padding included)."""

    maps: Annotated[tuple[ClassMap, ...], msgspec.Meta(min_length=1)]

    def __post_init__(self) -> None:
        meanings = [m.meaning for m in self.maps]
        if len(set(meanings)) != len(meanings):
            raise ValueError(f"maps: each meaning must be given once, got {', '.join(meanings)}")


class RowAnchors(
    msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True, tag_field="decoding", tag="row_anchors"
):
    """Lane lines by rows (1, columns + 1, rows, lines): logits of a line's column in each row; the last is "absent".

    The format of Ultra-Fast-Lane-Detection. `rows` are fractions of the input's height, in the output's order; the
    `columns` are evenly spaced over the input's width. The network has no road mask.
    """

    output: str
    columns: Count
    rows: Annotated[tuple[Fraction, ...], msgspec.Meta(min_length=2)]
    lines: Count = 4

    def __post_init__(self) -> None:
        if len(set(self.rows)) != len(self.rows):
            raise ValueError("rows must be distinct")


class Disparity(
    msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True, tag_field="decoding", tag="disparity"
):
    """Monodepth2's and Lite-Mono's (1, 1, h, w) sigmoid disparity over the whole input.

    depth = depth_scale / (1 / max + (1 / min - 1 / max) * disparity), with the bounds used in training; `depth_scale`
    is 5.4 for networks trained on KITTI's stereo pairs. A network trained on single images has no metric scale: with
    `metric` false the road under the camera gives the scale in each frame.
    """

    output: str
    min_depth_m: Annotated[float, msgspec.Meta(gt=0.0)] = 0.1
    max_depth_m: Annotated[float, msgspec.Meta(gt=0.0)] = 100.0
    depth_scale: Annotated[float, msgspec.Meta(gt=0.0)] = 1.0
    metric: bool = True
    sigma_rel: Annotated[float, msgspec.Meta(gt=0.0, lt=1.0)] = 0.15  # 1-sigma of a pixel's depth, as a fraction

    def __post_init__(self) -> None:
        if not self.min_depth_m < self.max_depth_m < math.inf:
            raise ValueError(f"max_depth_m = {self.max_depth_m} must be larger than min_depth_m = {self.min_depth_m}")
        if not math.isfinite(self.depth_scale):
            raise ValueError("depth_scale must be finite")


class MetricDepth(
    msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True, tag_field="decoding", tag="metric"
):
    """(1, 1, h, w) or (1, h, w) depth along the optical axis over the whole input, in units of `metres_per_unit`.

    Depths are clipped to min_depth_m .. max_depth_m. With `canonical_focal_rel` > 0 the network assumes a focal length
    of this factor times the image width; its depths are rescaled to the camera's focal length.
    """

    output: str
    metres_per_unit: Annotated[float, msgspec.Meta(gt=0.0)] = 1.0
    min_depth_m: Annotated[float, msgspec.Meta(gt=0.0)] = 0.5
    max_depth_m: Annotated[float, msgspec.Meta(gt=0.0)] = 200.0
    canonical_focal_rel: Annotated[float, msgspec.Meta(ge=0.0, le=10.0)] = 0.0
    sigma_rel: Annotated[float, msgspec.Meta(gt=0.0, lt=1.0)] = 0.1

    def __post_init__(self) -> None:
        if not self.min_depth_m < self.max_depth_m < math.inf:
            raise ValueError(f"max_depth_m = {self.max_depth_m} must be larger than min_depth_m = {self.min_depth_m}")
        if not math.isfinite(self.metres_per_unit):
            raise ValueError("metres_per_unit must be finite")


class MultiTask(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Boxes with 3-D bodies, masks and depth in one run (perception/decoding/multitask.py).

    A box needs a centre score of at least `score_threshold`; a mask covers the pixels with a logit above its threshold.
    """

    score_threshold: Annotated[float, msgspec.Meta(gt=0.0, lt=1.0)] = 0.3
    nms_iou: Fraction = 0.5
    road_logit: float = 0.0
    lane_logit: float = 0.0
    box_sigma: BoxSigma = BoxSigma(rel=0.045, px=0.5)  # of the shipped network
    drawn_inside: DrawnInside = DrawnInside()
    lower_edge: LowerEdge = "tyres"  # the training boxes are outlines of rendered meshes
    depth_sigma_rel: Annotated[float, msgspec.Meta(gt=0.0, lt=1.0)] = 0.15  # 1-sigma of a pixel's depth, as a fraction

    def __post_init__(self) -> None:
        if not (math.isfinite(self.road_logit) and math.isfinite(self.lane_logit)):
            raise ValueError("road_logit and lane_logit must be finite")


class Schedule(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The default schedule of this network; a `ModelSpec` can override it.

    It runs on every `every`-th frame with `threads` threads. With `awaited` false no frame waits for it: its result is
    used as soon as it is available (with patience None every network is awaited).
    """

    every: Count = 1
    threads: Annotated[int, msgspec.Meta(ge=1, le=64)] = 1
    awaited: bool = True


class Manifest(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Input and outputs of a network. The table named after its role defines the outputs."""

    role: Role
    input: Input
    title: str = ""
    sha256: Sha256 = ""  # of the .onnx file; any other file is rejected
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
            raise ValueError(f"tiles: only a detector can run on tiles, not a {self.role}")
