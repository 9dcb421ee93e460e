"""Manifests of Frustum-PointNets: the network's input and outputs."""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec

from birdslam.perception.manifest import Label, Schedule, Sha256

Feature = Literal["x", "y", "z", "u", "v", "log_depth"]


class Points(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The network's input, float32, `count` points of each of N boxes.

    x, y, z are metres times `scale`, in camera axes rotated to the box; with `centred` relative to a point in the box.
    u and v in [-1, 1] are the point's position in its box. log_depth is that of the box's middle relative to 20 m, the
    same for all points. A second input `class_name` (N, classes) takes the class one-hot, in the order of `classes`.
    """

    name: str
    count: Annotated[int, msgspec.Meta(ge=16, le=4096)]
    layout: Literal["NCP", "NPC"] = "NCP"
    features: Annotated[tuple[Feature, ...], msgspec.Meta(min_length=3)] = ("x", "y", "z")
    centred: bool = True
    scale: Annotated[float, msgspec.Meta(gt=0.0, le=100.0)] = 1.0
    class_name: str = ""
    classes: tuple[Label, ...] = ()

    def __post_init__(self) -> None:
        if bool(self.class_name) != bool(self.classes):
            raise ValueError("class_name and classes need each other: give both or neither")
        if len(set(self.features)) != len(self.features):
            raise ValueError(f"features must be distinct, got {', '.join(self.features)}")


class Body(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True, tag_field="decoding", tag="body"):
    """(N, 12): the centre x, y, z in metres, in the axes of the points; log of the Laplace scale of z; logs of length,
    width, height relative to `mean_m`; cos and sin of twice the yaw, times the von Mises concentration; cos and sin of
    the yaw, times the logit that the front points there; log of the relative Laplace scale of the sizes.

    The yaw is about up: 0 faces away along the box's ray, pi/2 faces left.
    """

    output: str
    mean_m: tuple[float, float, float] = (4.3, 1.8, 1.6)

    def __post_init__(self) -> None:
        if not all(0.0 < m < 100.0 for m in self.mean_m):
            raise ValueError("mean_m must be three lengths between 0 and 100 m")


class Bins(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True, tag_field="decoding", tag="bins"):
    """Frustum-PointNet's own outputs: centre (N, 3), heading scores and residuals (N, B), size scores (N, S) and
    residuals (N, S, 3).

    A heading is about the camera's down axis, 0 faces right; residuals are in half bins, sizes (length, width, height)
    in fractions of `templates_m`. The network outputs no sigmas; `sigma_rel` is that of the depth.
    """

    centre: str
    heading_scores: str
    heading_residuals: str
    size_scores: str
    size_residuals: str
    templates_m: Annotated[tuple[tuple[float, float, float], ...], msgspec.Meta(min_length=1)]
    sigma_rel: Annotated[float, msgspec.Meta(gt=0.0, lt=1.0)] = 0.05
    sigma_size_rel: Annotated[float, msgspec.Meta(gt=0.0, lt=1.0)] = 0.1
    sigma_yaw_rad: Annotated[float, msgspec.Meta(gt=0.0, lt=3.0)] = 0.2


class PointNetManifest(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Input and outputs of a Frustum-PointNet; its file begins with role = "pointnet"."""

    role: Literal["pointnet"]
    points: Points
    pointnet: Body | Bins
    title: str = ""
    sha256: Sha256 = ""
    schedule: Schedule = Schedule()
