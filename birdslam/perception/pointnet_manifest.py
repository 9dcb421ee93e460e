"""Manifests of Frustum-PointNets: the network's input and outputs."""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec

from birdslam.perception.manifest import Label, Schedule, Sha256

Feature = Literal["x", "y", "z", "u", "v", "log_depth"]


class Points(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The network's input, float32, `count` points of each of N boxes.

    x, y, z in metres along the camera's axes turned to the box, `scale` times; with `centred` about a point in it; u
    and v in [-1, 1] are the point's place in its box; log_depth that of the box's middle against 20 m, for all points
    alike. `classes`, with the name of a second input `class_name` (N, classes), is what a one-hot class means.
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
            raise ValueError("class_name: stands with classes, or neither does")
        if len(set(self.features)) != len(self.features):
            raise ValueError(f"features: each once, got {', '.join(self.features)}")


class Body(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True, tag_field="decoding", tag="body"):
    """(N, 12): the centre x y z in metres, in the axes of the points; log of the Laplace scale of z; logs of length,
    width, height against `mean_m`; cos and sin of the doubled yaw, times von Mises' concentration; cos and sin of the
    yaw, times the logit that its front is there; log of the Laplace scale of the sizes, as a fraction of them.

    The yaw is about up: 0 faces away along the box's ray, pi/2 faces left.
    """

    output: str
    mean_m: tuple[float, float, float] = (4.3, 1.8, 1.6)

    def __post_init__(self) -> None:
        if not all(0.0 < m < 100.0 for m in self.mean_m):
            raise ValueError("mean_m: three lengths in metres")


class Bins(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True, tag_field="decoding", tag="bins"):
    """Frustum-PointNet's own outputs: centre (N, 3), heading scores and residuals (N, B), size scores (N, S) and
    residuals (N, S, 3).

    A heading is about the camera's down axis, 0 faces right; residuals are in half bins, sizes (length, width, height)
    in fractions of `templates_m`. Its answers have no sigmas of their own: `sigma_rel` is of the depth.
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
