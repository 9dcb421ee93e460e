"""Frustum-PointNet: locates the body in each box from the pseudo-lidar points inside the box.

A manifest states the network's input and outputs, as for networks on images. The points of a box are rotated about the
camera's down axis until the box's middle is straight ahead, as in the Frustum-PointNet paper. With `centred` in the
manifest they are relative to the point of that ray at the depth of the box's middle.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from birdslam.geometry.arrays import Floats, Floats32
from birdslam.geometry.camera import Camera
from birdslam.perception.boxes3d import Boxes3d
from birdslam.perception.manifest import ManifestMismatch, ModelError, Schedule
from birdslam.perception.manifest_file import find_as
from birdslam.perception.network import ModelSpec, check_weights_are_inside
from birdslam.perception.pointnet_manifest import Bins, Body, PointNetManifest, Points

CORE_RATIO = 0.5  # central part of a box's width and height, which shows its vehicle
MAX_DEPTH_OFFSET_M = 8.0  # from the core's depth; points beyond belong to another body or the background
MIN_POINTS = 16
REFERENCE_DEPTH_M = 20.0  # of the feature log_depth
MIN_HALF_SPAN = 1e-6  # of a box, at a depth of 1


@dataclass(frozen=True)
class Frustum:
    """The network's input for one box, and the transform of its output back to the camera frame."""

    features: Floats32  # (C, count)
    azimuth_rad: float  # of the box's middle, to the right of the optical axis
    middle_m: Floats  # (3,) origin of the points in the rotated axes; zero if they are not centred

    def to_camera(self, turned_m: Floats) -> Floats:
        """Transforms a point (3,) from the rotated axes to the camera frame."""
        x, y, z = (turned_m + self.middle_m).tolist()
        c, s = math.cos(self.azimuth_rad), math.sin(self.azimuth_rad)
        return np.array([c * x + s * z, y, c * z - s * x])


def frustum_of(points_cam_m: Floats, points: Points) -> Frustum | None:
    """Selects the points (N, 3) of one box near its body, rotates and centres them; None where there are too few."""
    if len(points_cam_m) < MIN_POINTS:
        return None
    u, v = points_cam_m[:, 0] / points_cam_m[:, 2], points_cam_m[:, 1] / points_cam_m[:, 2]
    offsets = [(w - (w.min() + w.max()) / 2.0) / max((w.max() - w.min()) / 2.0, MIN_HALF_SPAN) for w in (u, v)]
    core = (np.abs(offsets[0]) <= CORE_RATIO) & (np.abs(offsets[1]) <= CORE_RATIO)
    depth_m = float(np.median(points_cam_m[core, 2])) if core.any() else float(np.median(points_cam_m[:, 2]))
    near = np.flatnonzero(np.abs(points_cam_m[:, 2] - depth_m) <= MAX_DEPTH_OFFSET_M)
    if len(near) < MIN_POINTS or depth_m <= 0.0:
        return None
    picked = near[np.arange(points.count) * len(near) // points.count]  # evenly, in the order of the pixels
    middle_u, middle_v = (u.min() + u.max()) / 2.0, (v.min() + v.max()) / 2.0
    azimuth_rad = math.atan(middle_u)
    c, s = math.cos(azimuth_rad), math.sin(azimuth_rad)
    x, y, z = points_cam_m[picked].T
    turned = np.stack([c * x - s * z, y, s * x + c * z])
    middle_m = np.array([0.0, middle_v * depth_m, depth_m / c]) if points.centred else np.zeros(3)
    rows = dict(zip(("x", "y", "z"), (turned - middle_m[:, None]) * points.scale, strict=True))
    rows.update(
        u=offsets[0][picked],
        v=offsets[1][picked],
        log_depth=np.full(len(picked), math.log(depth_m / REFERENCE_DEPTH_M)),
    )
    return Frustum(np.stack([rows[name] for name in points.features]).astype(np.float32), azimuth_rad, middle_m)


class PointNet:
    """A loaded and warmed-up Frustum-PointNet. Attributes as those of `network.Network`."""

    def __init__(self, path: Path, manifest: PointNetManifest, sha256: str, content: bytes, schedule: Schedule) -> None:
        """Raises ManifestMismatch if manifest and network disagree, an onnxruntime error if the network cannot run."""
        self.name = self.role = "pointnet"
        self.path, self.manifest, self.sha256, self.schedule = path, manifest, sha256, schedule
        from birdslam.perception.session import plain_session  # here, as in network.py

        self._session = plain_session(content, schedule.threads)
        points, table = manifest.points, manifest.pointnet
        has = {i.name: i for i in self._session.get_inputs()}
        wanted = [points.name, *([points.class_name] if points.class_name else [])]
        if sorted(has) != sorted(wanted):
            raise ManifestMismatch("points.name", wanted, f"the inputs {sorted(has)}")
        self._batch = has[points.name].shape[0] if isinstance(has[points.name].shape[0], int) else None
        self._outputs = (table.output,) if isinstance(table, Body) else _outputs_of(table)
        missing = set(self._outputs) - {o.name for o in self._session.get_outputs()}
        if missing:
            raise ManifestMismatch(
                "pointnet", sorted(missing), f"the outputs {[o.name for o in self._session.get_outputs()]}"
            )
        shapes = {
            name: out.shape for name, out in self._run(np.zeros((1, *self._box_shape), np.float32), ["car"]).items()
        }
        self.output_shapes = shapes
        for name, shape in self._expected().items():
            if shapes[name] != shape:
                raise ManifestMismatch("pointnet", f"{name} of shape {('N', *shape[1:])}", shapes[name])

    @property
    def _box_shape(self) -> tuple[int, int]:
        shape = (len(self.manifest.points.features), self.manifest.points.count)
        return shape if self.manifest.points.layout == "NCP" else (shape[1], shape[0])

    def _expected(self) -> dict[str, tuple[int, ...]]:
        table = self.manifest.pointnet
        if isinstance(table, Body):
            return {table.output: (1, 12)}
        sizes, bins = len(table.templates_m), self.output_shapes[table.heading_scores][-1]
        names = _outputs_of(table)
        return dict(zip(names, ((1, 3), (1, bins), (1, bins), (1, sizes), (1, sizes, 3)), strict=True))

    def _run(self, boxes: Floats32, labels: Sequence[str]) -> dict[str, Floats32]:
        """Outputs for N boxes; a network with a fixed batch size runs several times."""
        points, step = self.manifest.points, self._batch or max(len(boxes), 1)
        parts: list[list[Floats32]] = []
        for start in range(0, len(boxes), step):
            part = boxes[start : start + step]
            filled = np.zeros((step, *part.shape[1:]), np.float32)
            filled[: len(part)] = part
            feeds: dict[str, Any] = {points.name: filled}
            if points.class_name:
                one_hot = np.zeros((step, len(points.classes)), np.float32)
                for row, label in enumerate(labels[start : start + step]):
                    if label in points.classes:
                        one_hot[row, points.classes.index(label)] = 1.0
                feeds[points.class_name] = one_hot
            parts.append([out[: len(part)] for out in self._session.run(list(self._outputs), feeds)])
        return {name: np.concatenate(outs) for name, outs in zip(self._outputs, zip(*parts, strict=True), strict=True)}

    def locate(self, frusta_cam_m: Sequence[Floats], labels: Sequence[str], camera: Camera) -> Boxes3d | None:
        """The body for the points (N, 3) of each box, in the camera frame; None if an output is not finite.

        A box with too few points near its middle has an unknown body, with infinite sigmas.
        """
        frusta = [frustum_of(points, self.manifest.points) for points in frusta_cam_m]
        known = [(i, frustum) for i, frustum in enumerate(frusta) if frustum is not None]
        out = _unknown(len(frusta))
        if not known:
            return out
        boxes = np.stack([frustum.features for _, frustum in known])
        if self.manifest.points.layout == "NPC":
            boxes = np.ascontiguousarray(np.swapaxes(boxes, 1, 2))
        tensors = self._run(boxes, [labels[i] for i, _ in known])
        if not all(np.isfinite(tensor).all() for tensor in tensors.values()):
            return None
        table = self.manifest.pointnet
        for row, (i, frustum) in enumerate(known):
            answer = {name: tensor[row].astype(np.float64) for name, tensor in tensors.items()}
            if isinstance(table, Body):
                decode_body(table, answer, frustum, camera, out, i)
            else:
                decode_bins(table, answer, frustum, camera, out, i)
        return out

    def describe(self) -> dict[str, Any]:
        """The network's settings as plain values, for a summary."""
        from birdslam.perception.session import onnxruntime_version

        return {
            "name": self.name,
            "role": self.role,
            "title": self.manifest.title,
            "file": self.path.name,
            "sha256": self.sha256,
            "points": self.manifest.points.count,
            "every": self.schedule.every,
            "threads": self.schedule.threads,
            "onnxruntime": onnxruntime_version(),
        }


def decode_body(
    table: Body, tensors: dict[str, Floats], frustum: Frustum, camera: Camera, out: Boxes3d, row: int
) -> None:
    """Decodes the outputs of one box (see `pointnet_manifest.Body`) into a row of `out`."""
    at = tensors[table.output]
    axis, front = at[7:9], at[9:11]
    yaw = 0.5 * math.atan2(axis[1], axis[0])
    logit = front[0] * math.cos(yaw) + front[1] * math.sin(yaw)
    if logit < 0.0:
        yaw -= math.copysign(math.pi, yaw)
    _write(frustum, at[:3], yaw, camera, out, row)
    out.sigma_depth_m[row] = math.sqrt(2.0) * math.exp(min(at[3], 10.0))
    out.size_m[row] = np.exp(np.clip(at[4:7], -3.0, 3.0)) * table.mean_m
    out.sigma_size_m[row] = out.size_m[row] * math.sqrt(2.0) * math.exp(min(at[11], 3.0))
    out.sigma_alpha_rad[row] = 0.5 / math.sqrt(max(math.hypot(*axis), 0.5))
    out.flip[row] = 1.0 / (1.0 + math.exp(min(abs(logit), 60.0)))


def decode_bins(
    table: Bins, tensors: dict[str, Floats], frustum: Frustum, camera: Camera, out: Boxes3d, row: int
) -> None:
    """Decodes the outputs of one box (see `pointnet_manifest.Bins`) into a row of `out`."""
    scores = tensors[table.heading_scores]
    bin_, size = int(scores.argmax()), int(tensors[table.size_scores].argmax())
    width_rad = 2.0 * math.pi / len(scores)
    heading_rad = bin_ * width_rad + float(tensors[table.heading_residuals][bin_]) * width_rad / 2.0
    # From a rotation about down, 0 to the right, to one about up, 0 ahead
    _write(frustum, tensors[table.centre], -heading_rad - math.pi / 2.0, camera, out, row)
    out.sigma_depth_m[row] = table.sigma_rel * out.depth_m[row]
    template = np.array(table.templates_m[size])
    out.size_m[row] = np.maximum(template * (1.0 + tensors[table.size_residuals][size]), 0.1)
    out.sigma_size_m[row] = out.size_m[row] * table.sigma_size_rel
    out.sigma_alpha_rad[row] = table.sigma_yaw_rad
    out.flip[row] = 0.05


def _write(frustum: Frustum, centre_m: Floats, yaw_rad: float, camera: Camera, out: Boxes3d, row: int) -> None:
    """Writes centre and observation angle: the yaw is relative to the box's ray, alpha to the centre's ray."""
    x, y, z = frustum.to_camera(centre_m).tolist()
    z = max(z, 0.1)
    out.centre_px[row] = camera.fx_px * x / z + camera.cx_px, camera.fy_px * y / z + camera.cy_px
    out.depth_m[row] = z
    alpha = yaw_rad - frustum.azimuth_rad + math.atan2(x, z)
    out.alpha_rad[row] = math.remainder(alpha, 2.0 * math.pi)


def _unknown(count: int) -> Boxes3d:
    """Unknown bodies: infinite sigmas."""
    return Boxes3d(
        centre_px=np.zeros((count, 2)),
        depth_m=np.ones(count),
        size_m=np.ones((count, 3)),
        alpha_rad=np.zeros(count),
        sigma_depth_m=np.full(count, np.inf),
        sigma_size_m=np.full((count, 3), np.inf),
        sigma_alpha_rad=np.full(count, np.inf),
        flip=np.full(count, 0.5),
    )


def _outputs_of(table: Bins) -> tuple[str, ...]:
    return (table.centre, table.heading_scores, table.heading_residuals, table.size_scores, table.size_residuals)


def load_pointnet(spec: ModelSpec) -> PointNet:
    """Opens a Frustum-PointNet and checks its manifest against its real inputs and outputs. Raises ModelError."""
    path = Path(spec.path)
    try:
        content = path.read_bytes()
    except OSError as error:
        raise ModelError(f"{path}: the network can't be read: {error.strerror}") from error
    sha256 = hashlib.sha256(content).hexdigest()
    manifest, origin = find_as(path, sha256, spec.manifest, PointNetManifest)
    stated: dict[str, int] = {k: v for k in ("every", "threads") if (v := getattr(spec, k)) is not None}
    check_weights_are_inside(path, content)
    from birdslam.perception.session import SESSION_ERRORS

    try:
        return PointNet(path, manifest, sha256, content, msgspec.structs.replace(manifest.schedule, **stated))
    except ManifestMismatch as error:
        raise ModelError(f"{path}: {error} (manifest {origin})") from error
    except SESSION_ERRORS as error:
        raise ModelError(f"{path}: onnxruntime can't run this network: {error}") from error
