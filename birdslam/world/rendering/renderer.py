"""Renders bodies on a street: meshes, shadows, samples, shading, and the truth about each body."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from birdslam.geometry.arrays import Floats, Floats32, Ints
from birdslam.geometry.camera import Camera
from birdslam.world.rendering import ground
from birdslam.world.rendering import materials as m
from birdslam.world.rendering.contact import contact_map
from birdslam.world.rendering.light import hashed
from birdslam.world.rendering.rasteriser import count_inside, project, rasterize, shadow_map
from birdslam.world.rendering.scene import Bodies, Rendered
from birdslam.world.rendering.shading import plane_bases, shade_frame, wet_road
from birdslam.world.rendering.shapes import bodies, scenery, trucks
from birdslam.world.rendering.shapes.solids import new_buffer
from birdslam.world.rendering.textures import foliage_masks, noise_bank, pictures
from birdslam.world.street.street import ASPHALT, CEMENT, COBBLES, Street

_CAPACITY = 150_000  # triangles of a frame
_FINE_CELLS, _FINE_PER_M = 448, 16.0
_COARSE_CELLS, _COARSE_PER_M = 448, 4.0
_CLASS_OF_KINDS = (
    ((m.VEHICLE, m.TRUCK), 7), ((m.PEDESTRIAN, m.CYCLIST), 8), ((m.BUILDING,), 4), ((m.POST, m.SIGN, m.LIGHTS), 6),
)  # fmt: skip


@njit(cache=True, nogil=True)
def _emit(B, kind, P, ranges):  # type: ignore[no-untyped-def]
    """The meshes of all bodies in their own frames, and the ranges of their triangles."""
    for k in range(kind.shape[0]):
        ranges[k, 0] = B[5][0]
        what = kind[k]
        if what == m.VEHICLE:
            bodies.vehicle(B, k, P[k])
        elif what == m.TRUCK:
            trucks.truck(B, k, P[k])
        elif what == m.PEDESTRIAN:
            bodies.pedestrian(B, k, P[k])
            if P[k, m.GLOSS] > 0.5:
                bodies.pram(B, k, P[k])
        elif what == m.CYCLIST:
            bodies.cyclist(B, k, P[k])
        elif what == m.BUILDING:
            scenery.building(B, k, P[k])
        elif what == m.TREE:
            scenery.tree(B, k, P[k])
        elif what == m.HEDGE:
            scenery.hedge(B, k, P[k])
        elif what == m.POST:
            scenery.post(B, k, P[k])
        elif what == m.SIGN:
            scenery.sign(B, k, P[k])
        elif what == m.CRATE:
            scenery.crate(B, k, P[k])
        elif what == m.WALLING:
            scenery.walling(B, k, P[k])
        elif what == m.BRIDGE:
            scenery.bridge(B, k, P[k])
        elif what == m.LIGHTS:
            scenery.lights(B, k, P[k])
        ranges[k, 1] = B[5][0]


@njit(cache=True, nogil=True)
def _move(corners, owner, count, R, t):  # type: ignore[no-untyped-def]
    """Transforms from each body's frame to ego."""
    for k in range(count):
        b = owner[k]
        for c in range(3):
            x, y, z = corners[k, c, 0], corners[k, c, 1], corners[k, c, 2]
            for j in range(3):
                corners[k, c, j] = R[b, j, 0] * x + R[b, j, 1] * y + R[b, j, 2] * z + t[b, j]


@dataclass(frozen=True)
class _Mesh:
    """All triangles of a scene in ego, in a buffer of `solids.new_buffer`.

    Each body (the last is the ground) has a range of triangles, parameters and a pose in ego.
    """

    corners: Floats32
    attributes: Floats32
    normals: Floats32
    material: NDArray[np.int32]
    owner: NDArray[np.int32]
    count: int
    ranges: Ints
    parameters: Floats32
    R: Floats
    t: Floats


class _View:
    """The camera with `factor` x `factor` samples per pixel: visible triangles, and boxes of bodies."""

    def __init__(self, camera: Camera, factor: int) -> None:
        f = factor
        self.C = np.array([0.0, 0.0, camera.height_m])
        self.R_ego_cam = np.ascontiguousarray(camera.ground.R_ego_cam)
        self._R_cam_ego = np.ascontiguousarray(self.R_ego_cam.T)
        self.K = np.array([camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px])
        half = 0.5 * (f - 1)
        self._K_samples = np.array([f * self.K[0], f * self.K[1], f * self.K[2] + half, f * self.K[3] + half])
        self._size = camera.height_px, camera.width_px
        self._samples = camera.height_px * f, camera.width_px * f

    def nearest(self, mesh: _Mesh) -> tuple[Floats32, NDArray[np.int32]]:
        """1 / depth at every sample, and the triangle in front there, -1 for the sky."""
        nearest, front = np.zeros(self._samples, np.float32), np.full(self._samples, -1, np.int32)
        rasterize(
            0, mesh.count, mesh.corners, mesh.attributes, mesh.material, self._R_cam_ego, self.C, self._K_samples,
            foliage_masks(), nearest, front,
        )  # fmt: skip
        return nearest, front

    def boxes(self, mesh: _Mesh, moving: Ints, seen: Ints) -> tuple[Floats, Floats]:
        """Box (n, 4) in pixels of each moving body, and the visible fraction (n,) of its samples in the image."""
        boxes, visible = np.full((len(moving), 4), np.nan), np.zeros(len(moving))
        stamp = np.full(self._samples, -1, np.int32)
        height, width = self._size
        for row, index in enumerate(moving):
            first, last = mesh.ranges[index]
            box = project(first, last, mesh.corners, self._R_cam_ego, self.C, self.K)
            if box[2] <= box[0]:
                continue
            boxes[row] = box
            if box[2] > 0 and box[3] > 0 and box[0] < width and box[1] < height:
                whole = count_inside(first, last, mesh.corners, self._R_cam_ego, self.C, self._K_samples, stamp, row)
                visible[row] = seen[index] / whole if whole else 0.0
        return boxes, visible


class Renderer:
    """Renders scenes on one street; `factor` x `factor` samples a pixel."""

    def __init__(self, street: Street, sky: Floats, factor: int = 2) -> None:
        self.street, self.factor = street, factor
        self._sky = sky  # towards the sun in world
        self._ground = (
            street.bands, street.lines, street.crossings, street.marks, _marks_by_metre(street),
            np.array([street.right_m, street.left_m, *_crossing_surface(street)]),
        )  # fmt: skip

    def render(self, scene: Bodies, camera: Camera, T_world_ego: Floats, s_m: float) -> Rendered:
        """Renders the scene from `camera` at `T_world_ego` (4, 4), near `s_m` on the street."""
        sky, view = self._sky_in_ego(T_world_ego), _View(camera, self.factor)
        mesh = self._mesh(scene, T_world_ego, s_m)
        nearest, front = view.nearest(mesh)
        shadows = self._shadows(sky, mesh)
        moving = np.flatnonzero(scene.object_id >= 0)
        contact = self._contact(scene, mesh.R, mesh.t, moving)
        height, width, f = camera.height_px, camera.width_px, self.factor
        light = np.empty((height, width, 3), np.float32)
        depth_m = np.empty((height, width), np.float32)
        classes = np.empty((height, width), np.uint8)
        instances = np.empty((height, width), np.uint16)
        seen = np.zeros(len(scene.kind) + 1, np.int64)
        bases = np.empty((mesh.count, 12))
        plane_bases(mesh.corners, mesh.count, bases)
        ids = np.concatenate([scene.object_id + 1, [0]]).astype(np.uint16)
        shade_frame(
            nearest, front, f, view.R_ego_cam, view.C, view.K,
            (bases, mesh.attributes, mesh.normals, mesh.material, mesh.owner, mesh.parameters, mesh.R, _classes(scene),
             ids),
            (noise_bank(), foliage_masks(), pictures(), sky, shadows, self._ground, contact, 1.0 / camera.fx_px),
            light, depth_m, classes, instances, seen,
            (np.empty(3), np.empty(4), np.empty(f * f, np.int64), np.empty(f * f, np.int64), np.empty(f * f)),
        )  # fmt: skip
        if sky[16] > 0.0:
            wet_road(light, classes, float(sky[16]))
        boxes, visible = view.boxes(mesh, moving, seen)
        return Rendered(light, depth_m, classes, instances, boxes, moving, visible)

    def _sky_in_ego(self, T_world_ego: Floats) -> Floats:
        sky = self._sky.copy()
        sky[:3] = T_world_ego[:3, :3].T @ sky[:3]
        sky[26:35] = T_world_ego[:3, :3].ravel()
        return sky

    def _mesh(self, scene: Bodies, T_world_ego: Floats, s_m: float) -> _Mesh:
        """The triangles of all bodies, then those of the ground. Raises ValueError if there are too many."""
        R, t = self._poses(scene, T_world_ego)
        B = new_buffer(_CAPACITY)
        corners, attributes, normals, material, owner, counts = B
        body = len(scene.kind)
        ranges = np.zeros((body + 1, 2), np.int64)
        parameters = np.concatenate([scene.parameters, np.zeros((1, m.SLOTS), np.float32)])
        self._face_cards(scene, parameters, R, t)
        _emit(B, scene.kind, parameters, ranges)
        ranges[body, 0] = counts[0]
        ground.strips(B, body, self._stations(s_m), self.street.bands, self.street.crossings, self._base(s_m))
        ranges[body, 1] = count = int(counts[0])
        if counts[1]:
            raise ValueError(f"{counts[1]} triangles of the scene do not fit in {_CAPACITY}")
        _move(corners, owner, count, R, t)
        return _Mesh(corners, attributes, normals, material, owner, count, ranges, parameters, R, t)

    def _poses(self, scene: Bodies, T_world_ego: Floats) -> tuple[Floats, Floats]:
        """Rotations (n + 1, 3, 3) and positions (n + 1, 3) in ego; the last is that of the ground, in world."""
        c, s = np.cos(scene.yaw_rad), np.sin(scene.yaw_rad)
        norm = 1.0 / np.sqrt(1.0 + np.square(scene.slope))
        cp, sp = norm, scene.slope * norm  # x axis climbs by the slope
        zero = np.zeros_like(c)
        R_world = np.stack(
            [np.stack([c * cp, -s, -c * sp], -1), np.stack([s * cp, c, -s * sp], -1), np.stack([sp, zero, cp], -1)], -2
        )
        R_world = np.concatenate([R_world, np.eye(3)[None]])
        t_world = np.concatenate([scene.position_m, np.zeros((1, 3))])
        R_ego_world = T_world_ego[:3, :3].T
        return np.ascontiguousarray(R_ego_world @ R_world), (t_world - T_world_ego[:3, 3]) @ R_ego_world.T

    @staticmethod
    def _face_cards(scene: Bodies, parameters: Floats32, R: Floats, t: Floats) -> None:
        """Turns cards of leaves to the camera: writes its direction in each body's frame."""
        towards = -np.einsum("nji,nj->ni", R[:-1], t[:-1])[:, :2]
        towards /= np.maximum(np.linalg.norm(towards, axis=1, keepdims=True), 1e-6)
        cards = np.isin(scene.kind, (m.TREE, m.HEDGE))
        parameters[:-1, 13:15][cards] = towards[cards]

    def _stations(self, s_m: float) -> Floats:
        """Seams of the ground's strips, at whole metres so that they are fixed while the ego moves."""
        base = math.floor(s_m / 4.0) * 4.0
        s = np.concatenate([np.arange(-8.0, 32.0, 1.0), np.arange(32.0, 80.0, 2.0), np.arange(80.0, 260.0, 4.0)]) + base
        s = s[(s >= 0.0) & (s <= self.street.length_m)]
        x, y, z, yaw, _ = self.street.place(s, np.zeros_like(s))
        return np.stack([s, x, y, z, yaw], axis=1)

    def _base(self, s_m: float) -> Floats:
        """The plane of the street at `s_m`, lowered so that it stays under the street ahead."""
        s = np.clip(np.arange(s_m - 8.0, s_m + 260.0, 4.0), 0.0, self.street.length_m)
        x, y, z, yaw, slope = self.street.place(s, np.zeros_like(s))
        here = 2
        gx, gy = slope[here] * math.cos(yaw[here]), slope[here] * math.sin(yaw[here])
        over = z[here] + gx * (x - x[here]) + gy * (y - y[here]) - z
        return np.array([x[here], y[here], z[here] - max(float(over.max()), 0.0), gx, gy])

    @staticmethod
    def _shadows(sky: Floats, mesh: _Mesh) -> tuple[Floats32, Floats32, Floats, Floats, Floats, Floats]:
        """A fine shadow map near the camera and a coarse one of the street ahead (see `light.sunlit`)."""
        fine = np.full((_FINE_CELLS, _FINE_CELLS), -1e3, np.float32)
        coarse = np.full((_COARSE_CELLS, _COARSE_CELLS), -1e3, np.float32)
        lean = sky[:2] / max(float(sky[2]), 0.08)
        fine_origin, coarse_origin = np.array([1.0, -14.0]), np.array([-6.0, -56.0])
        if sky[4] > 0.0:
            spare = np.empty((max(_FINE_CELLS, _COARSE_CELLS),) * 2, np.int32)
            for origin, per_m, highest in ((fine_origin, _FINE_PER_M, fine), (coarse_origin, _COARSE_PER_M, coarse)):
                shadow_map(
                    0, mesh.count, mesh.corners, mesh.attributes, mesh.material, lean, origin, per_m, foliage_masks(),
                    highest, spare,
                )  # fmt: skip
        return fine, coarse, lean, fine_origin, coarse_origin, np.array([_FINE_PER_M, _COARSE_PER_M])

    def _contact(self, scene: Bodies, R: Floats, t: Floats, moving: Ints) -> tuple[Floats32, Floats]:
        shade_map = np.empty((280, 160), np.float32)
        wide = moving[np.isin(scene.kind[moving], (m.VEHICLE, m.TRUCK))]
        poses = np.column_stack([t[wide, 0], t[wide, 1], np.arctan2(R[wide, 1, 0], R[wide, 0, 0])])
        sizes = scene.parameters[wide][:, [m.LENGTH, m.WIDTH]].astype(np.float64)
        seed = float(self._sky[18])  # varies the softness of these shadows
        at_edge, reach_m = 0.3 + 0.3 * seed, 0.4 + 2.0 * hashed(seed, 5.0) ** 2
        contact_map(shade_map, -2.0, -16.0, 5.0, np.ascontiguousarray(poses), sizes, at_edge, reach_m)
        return shade_map, np.array([-2.0, -16.0, 5.0])


def _classes(scene: Bodies) -> NDArray[np.uint8]:
    """The class of each body (bodies + 1,), 0 if it depends on the material, as for the ground."""
    out = np.zeros(len(scene.kind) + 1, np.uint8)
    for kinds, label in _CLASS_OF_KINDS:
        out[:-1][np.isin(scene.kind, kinds)] = label
    return out


def _marks_by_metre(street: Street) -> NDArray[np.int16]:
    """Indices of the marks on each metre of the street (metres, 12), -1 after the last."""
    out = np.full((int(street.length_m) + 2, 12), -1, np.int16)
    used = np.zeros(len(out), np.int64)
    for k, (s0, s1) in enumerate(street.marks[:, 1:3].tolist()):
        for metre in range(max(int(s0), 0), min(int(s1), len(out) - 1) + 1):
            if used[metre] < out.shape[1]:
                out[metre, used[metre]] = k
                used[metre] += 1
    return out


def _crossing_surface(street: Street) -> tuple[float, float]:
    """Surface and tone of side roads: as the main road."""
    driven = street.bands[np.isin(street.bands[:, 4], (ASPHALT, CEMENT, COBBLES))]
    return (float(driven[0, 4]), float(driven[0, 5])) if len(driven) else (float(ASPHALT), 1.0)
