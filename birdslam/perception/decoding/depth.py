"""Depth maps and their decoders."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Generic, TypeVar

import numpy as np

from birdslam.geometry.arrays import Floats, Floats32
from birdslam.geometry.camera import Camera
from birdslam.perception.manifest import Disparity, Input, ManifestMismatch, MetricDepth
from birdslam.perception.views import View

Table = TypeVar("Table", Disparity, MetricDepth)


@dataclass(frozen=True)
class DepthMap:
    """`depth_m` (h, w) float32: depth along the optical axis, positive and finite for every pixel.

    The map covers the whole undistorted image of `image_width_px` x `image_height_px` at its own resolution. With
    `canonical_focal_rel` > 0 depths refer to a focal length of this factor times the image width; `in_metres` converts
    them. Without `metric` the scale is unknown; the road gives it (birdslam/road_users/placement/pseudolidar.py).
    """

    depth_m: Floats32
    image_width_px: int
    image_height_px: int
    sigma_rel: float = 0.1  # 1-sigma of a pixel's depth, as a fraction of it
    metric: bool = True
    canonical_focal_rel: float = 0.0

    @property
    def scale(self) -> tuple[float, float]:
        """Map pixels per image pixel, along x and y."""
        return self.depth_m.shape[1] / self.image_width_px, self.depth_m.shape[0] / self.image_height_px

    def at(self, points_px: Floats) -> Floats32:
        """Depths (N,) at points (N, 2) of the image, from the nearest pixel of the map; NaN outside."""
        x, y = np.floor((points_px + 0.5) * self.scale).astype(np.int64).T
        height, width = self.depth_m.shape
        inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
        out = np.full(len(points_px), np.nan, dtype=np.float32)
        out[inside] = self.depth_m[y[inside], x[inside]]
        return out

    def cells(self, box_px: Sequence[float]) -> tuple[slice, slice]:
        """Rows and columns of the map whose centres are in a box x1, y1, x2, y2 of the image; may be empty."""
        sx, sy = self.scale
        height, width = self.depth_m.shape
        # Pixel i of the map has its centre at (i + 0.5) / scale in the image, in coordinates of pixel edges
        x1, x2 = (min(max(int(np.ceil(x * sx - 0.5)), 0), width) for x in (box_px[0], box_px[2]))
        y1, y2 = (min(max(int(np.ceil(y * sy - 0.5)), 0), height) for y in (box_px[1], box_px[3]))
        return slice(y1, max(y1, y2)), slice(x1, max(x1, x2))

    def points_cam_m(self, camera: Camera, rows: slice, columns: slice) -> Floats:
        """Pseudo-lidar points (N, 3) of a block of the map, in the camera frame."""
        sx, sy = self.scale
        depth = self.depth_m[rows, columns].astype(np.float64)
        u, v = np.meshgrid(
            (np.arange(columns.start, columns.stop) + 0.5) / sx - 0.5,
            (np.arange(rows.start, rows.stop) + 0.5) / sy - 0.5,
        )
        x, y = (u - camera.cx_px) / camera.fx_px * depth, (v - camera.cy_px) / camera.fy_px * depth
        return np.column_stack([x.ravel(), y.ravel(), depth.ravel()])

    def scaled(self, factor: float) -> DepthMap:
        """The map with all depths times a factor, in metres for this camera."""
        return replace(self, depth_m=self.depth_m * np.float32(factor), metric=True, canonical_focal_rel=0.0)

    def in_metres(self, camera: Camera) -> DepthMap:
        """Converts canonical depths to this camera's; returns itself if they are not canonical."""
        if self.canonical_focal_rel <= 0.0:
            return self
        factor = camera.fx_px / (self.canonical_focal_rel * self.image_width_px)
        return replace(self, depth_m=self.depth_m * np.float32(factor), canonical_focal_rel=0.0)


class _MapDecoder(Generic[Table]):
    """Decodes one map over the whole image."""

    def __init__(self, table: Table, input: Input, shapes: Mapping[str, tuple[int, ...]]) -> None:
        """Raises ManifestMismatch if the output is not a map."""
        self.table: Table = table
        self.input = input
        _check_map(table.output, shapes[table.output])

    def merge(self, parts: Sequence[DepthMap], views: Sequence[View]) -> DepthMap:
        """A depth network has one view."""
        (part,) = parts
        return part


class DisparityDecoder(_MapDecoder[Disparity]):
    """Reads sigmoid disparity (see `manifest.Disparity`)."""

    def read(self, tensors: Mapping[str, Floats32], view: View) -> DepthMap:
        """The depth of one run over the whole image."""
        table = self.table
        far, near = np.float32(1.0 / table.max_depth_m), np.float32(1.0 / table.min_depth_m)
        disparity = np.clip(_of_image(tensors[table.output], view, self.input), 0.0, 1.0)
        return DepthMap(
            np.float32(table.depth_scale) / (far + (near - far) * disparity),
            view.image_width_px,
            view.image_height_px,
            sigma_rel=table.sigma_rel,
            metric=table.metric,
        )


class MetricDepthDecoder(_MapDecoder[MetricDepth]):
    """Reads metric depth (see `manifest.MetricDepth`)."""

    def read(self, tensors: Mapping[str, Floats32], view: View) -> DepthMap:
        """The depth of one run over the whole image."""
        table = self.table
        depth = _of_image(tensors[table.output], view, self.input) * np.float32(table.metres_per_unit)
        return DepthMap(
            np.clip(depth, np.float32(table.min_depth_m), np.float32(table.max_depth_m)),
            view.image_width_px,
            view.image_height_px,
            sigma_rel=table.sigma_rel,
            canonical_focal_rel=table.canonical_focal_rel,
        )


def _check_map(output: str, shape: tuple[int, ...]) -> None:
    if len(shape) not in (3, 4) or any(size != 1 for size in shape[:-2]):
        raise ManifestMismatch("depth.output", f"{output} of shape (1, 1, h, w) or (1, h, w)", shape)


def _of_image(tensor: Floats32, view: View, input: Input) -> Floats32:
    """A copy of the part (h, w) of a map over the whole input that covers the image."""
    return view.crop(tensor.reshape(tensor.shape[-2], tensor.shape[-1]), input).copy()
