"""Shading of the visible triangles: one pass over the pixels of a frame. Compiled by numba.

`shade` computes one point: its position on the triangle (`coordinates`), the normal (`unit_normal`), the material
(`surface`), and its light (`sunlight`, `skylight`, `glossed`, `hazed` in `light`). `shade_frame` describes `scene` and
`look`.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from birdslam.world.rendering import materials as m
from birdslam.world.rendering import paint, surfaces
from birdslam.world.rendering.compiled import inlined, per_pixel
from birdslam.world.rendering.ground import shade_ground
from birdslam.world.rendering.light import glossed, hazed, sky_colour, skylight, sunlight

# Class of each material, in the order of `materials`; those of ground and vehicle panels depend on the point
MATERIAL_CLASS = np.array([1, 7, 7, 7, 4, 9, 5, 5, 6, 6, 8, 9, 4, 9, 9, 8], np.uint8)
OTHER_CLASS = 9


@inlined
def hit(bases, t, C, ray):  # type: ignore[no-untyped-def]
    """Depth of the intersection of C + depth * ray with the plane of triangle t; negative without one."""
    nx, ny, nz = bases[t, 0], bases[t, 1], bases[t, 2]
    down = nx * ray[0] + ny * ray[1] + nz * ray[2]
    if abs(down) < 1e-12:
        return -1.0
    return (bases[t, 3] - nx * C[0] - ny * C[1] - nz * C[2]) / down


@per_pixel
def plane_bases(corners, count, bases):  # type: ignore[no-untyped-def]
    """`bases` (N, 12) of each triangle: its plane n.p = n0, then the weights of corners 1 and 2 as affine forms."""
    for t in range(count):
        ax, ay, az = float(corners[t, 0, 0]), float(corners[t, 0, 1]), float(corners[t, 0, 2])
        ux, uy, uz = corners[t, 1, 0] - ax, corners[t, 1, 1] - ay, corners[t, 1, 2] - az
        vx, vy, vz = corners[t, 2, 0] - ax, corners[t, 2, 1] - ay, corners[t, 2, 2] - az
        nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
        bases[t, 0], bases[t, 1], bases[t, 2], bases[t, 3] = nx, ny, nz, nx * ax + ny * ay + nz * az
        uu, uv, vv = ux * ux + uy * uy + uz * uz, ux * vx + uy * vy + uz * vz, vx * vx + vy * vy + vz * vz
        det = uu * vv - uv * uv
        inv = 1.0 / det if det > 1e-14 else 0.0
        for j in range(2):
            p, q = (vv * inv, -uv * inv) if j == 0 else (-uv * inv, uu * inv)
            gx, gy, gz = p * ux + q * vx, p * uy + q * vy, p * uz + q * vz
            bases[t, 4 + 4 * j], bases[t, 5 + 4 * j], bases[t, 6 + 4 * j] = gx, gy, gz
            bases[t, 7 + 4 * j] = -(gx * ax + gy * ay + gz * az)


@inlined
def side_inclination(P, z):  # type: ignore[no-untyped-def]
    """Inclination of a body's side at the height z over the road: slope of its normal."""
    return (0.5 + 0.9 * P[m.SEED]) * min(max(1.0 - (z - P[m.CLEARANCE]) / (0.25 + 0.2 * P[m.RIM]), 0.0), 1.0)


@inlined
def coordinates(t, x, y, z, scene):  # type: ignore[no-untyped-def]
    """Texture coordinates (u, v, w) of the point (x, y, z) of triangle t, and its normal in the body's frame."""
    bases, attributes, normals, material, _, _, _, _, _ = scene
    b = bases[t, 4] * x + bases[t, 5] * y + bases[t, 6] * z + bases[t, 7]
    c = bases[t, 8] * x + bases[t, 9] * y + bases[t, 10] * z + bases[t, 11]
    b, c = min(max(b, -0.5), 1.5), min(max(c, -0.5), 1.5)
    a = 1.0 - b - c
    u = a * attributes[t, 0, 0] + b * attributes[t, 1, 0] + c * attributes[t, 2, 0]
    v = a * attributes[t, 0, 1] + b * attributes[t, 1, 1] + c * attributes[t, 2, 1]
    w = a * attributes[t, 0, 2] + b * attributes[t, 1, 2] + c * attributes[t, 2, 2]
    lx = a * normals[t, 0, 0] + b * normals[t, 1, 0] + c * normals[t, 2, 0]
    ly = a * normals[t, 0, 1] + b * normals[t, 1, 1] + c * normals[t, 2, 1]
    lz = a * normals[t, 0, 2] + b * normals[t, 1, 2] + c * normals[t, 2, 2]
    if material[t] not in (m.GROUND, m.PAINT, m.SKIN):
        w = attributes[t, 0, 2] + 0.0  # exact number of the face
    return u, v, w, lx, ly, lz


@inlined
def unit_normal(P, R, mat, w, lx, ly, lz):  # type: ignore[no-untyped-def]
    """The normal in ego, of length 1."""
    nx = R[0, 0] * lx + R[0, 1] * ly + R[0, 2] * lz
    ny = R[1, 0] * lx + R[1, 1] * ly + R[1, 2] * lz
    nz = R[2, 0] * lx + R[2, 1] * ly + R[2, 2] * lz
    if mat == m.PAINT:  # bumpers and sills turn in towards the road
        nz -= side_inclination(P, w) * math.sqrt(nx * nx + ny * ny)
    norm = 1.0 / math.sqrt(nx * nx + ny * ny + nz * nz + 1e-12)
    return nx * norm, ny * norm, nz * norm


@inlined
def surface(P, mat, own_class, mask, look, u, v, w, lx, ly, lz, z, foot, facing):  # type: ignore[no-untyped-def]
    """(red, green, blue, mirror, light, class) of a material at (u, v, w), with its emitted light.

    `own_class` is the body's, 0 if it depends on the material; `foot` is the pixel's width on the surface in metres.
    """
    bank, masks, pictures, sky, _, ground, _, _ = look
    label = MATERIAL_CLASS[mat]
    mirror, light = 0.0, 0.0
    if mat == m.GROUND:
        along = foot / max(facing, 0.02)
        r, g, b, mirror, label = shade_ground(ground, bank, pictures, sky, u, v, foot, along)
    elif mat == m.PAINT:
        r, g, b, mirror, light = paint.bodywork(P, bank, u, v, w, lx, ly, lz, foot)
    elif mat == m.WHEEL:
        r, g, b, mirror, light = paint.wheel(P, u, v, w)
        label = own_class
    elif mat == m.CARGO:
        r, g, b, mirror, light = paint.cargo(P, bank, pictures, u, v, w, foot)
    elif mat == m.CLOTH or mat == m.SKIN:
        r, g, b, mirror, light = paint.clothing(P, mat, z, P[m.HEIGHT])
    elif mat == m.WALL:
        r, g, b, mirror = surfaces.facade(P, bank, pictures, u, v, w, foot)
        if w < 4.0:
            label = 4
    elif mat == m.FOLIAGE:
        r, g, b = surfaces.leaves(P, masks, u, v, mask)
    elif mat == m.PANEL:
        if P[9] > 3.5 or (P[8] > 3.0 and P[10] == 0.0):
            r, g, b, light = surfaces.traffic_light(P, u, v, w)
        else:
            r, g, b, light = surfaces.panel(P, pictures, u, v, w)
            if facing < 0.0:
                r, g, b = 0.3, 0.3, 0.3
    else:
        r, g, b, mirror = surfaces.plain(P, bank, pictures, mat, u, v, w, foot)
        if own_class > 0:
            label = own_class
        if mat == m.PLAIN and own_class == 0:
            label = OTHER_CLASS
    return r, g, b, mirror, light, label


@inlined
def shade(t, depth, C, ray, scene, look, out):  # type: ignore[no-untyped-def]
    """Writes the light of triangle t at a depth along the ray to out[:3], its class to out[3]."""
    _, attributes, _, material, owner, P_all, R_all, labels, _ = scene
    bank, _, _, sky, maps, _, contact, pixel_rad = look
    mat, k = material[t], owner[t]
    P = P_all[k]
    x, y, z = C[0] + depth * ray[0], C[1] + depth * ray[1], C[2] + depth * ray[2]
    u, v, w, lx, ly, lz = coordinates(t, x, y, z, scene)
    nx, ny, nz = unit_normal(P, R_all[k], mat, w, lx, ly, lz)
    length = math.sqrt(ray[0] * ray[0] + ray[1] * ray[1] + ray[2] * ray[2])
    ex, ey, ez = ray[0] / length, ray[1] / length, ray[2] / length
    facing = -(nx * ex + ny * ey + nz * ez)
    r, g, b, mirror, light, label = surface(
        P, mat, labels[k], attributes[t, 0, 2], look, u, v, w, lx, ly, lz, z, depth * pixel_rad, facing
    )
    bias, soft = 0.0, 0.0
    if mat == m.FOLIAGE:  # leaves have random normals and are translucent
        nx, ny, nz = 0.35 * (nx - ex), 0.35 * (ny - ey), 0.65
        bias, soft, facing = 0.35, 0.5, 1.0
    elif facing < 0.0:
        nx, ny, nz, facing = -nx, -ny, -nz, -facing
    direct = sunlight(sky, maps, x, y, z, nx, ny, nz, bias, soft)
    ar, ag, ab = skylight(sky, maps, contact, mat, x, y, z, w, nx, ny, nz)
    red = r * (ar + direct * sky[3]) + light * 2.0 * r * (sky[7] + 0.2 * sky[4])
    green = g * (ag + direct * sky[4]) + light * 2.0 * g * (sky[7] + 0.2 * sky[4])
    blue = b * (ab + direct * sky[5]) + light * 2.0 * b * (sky[7] + 0.2 * sky[4])
    if mirror > 0.0:
        red, green, blue = glossed(
            sky, bank, mat == m.GROUND, mirror, direct, facing, ex, ey, ez, nx, ny, nz, red, green, blue
        )
    out[0], out[1], out[2] = hazed(sky, depth * length, red, green, blue)
    out[3] = label


@inlined
def triangles_of(row, column, factor, owner, nearest, of_body, seen, counts, inverse, visible):  # type: ignore[no-untyped-def]
    """Number of triangles in a pixel's samples; writes their indices, sample counts, and first 1 / depth."""
    kinds = 0
    for i in range(row * factor, (row + 1) * factor):
        for k in range(column * factor, (column + 1) * factor):
            t = owner[i, k]
            if t >= 0:
                visible[of_body[t]] += 1
            known = False
            for j in range(kinds):
                if seen[j] == t:
                    counts[j] += 1
                    known = True
                    break
            if not known:
                seen[kinds], counts[kinds], inverse[kinds] = t, 1, nearest[i, k]
                kinds += 1
    return kinds


@inlined
def merge_smooth(kinds, of_body, material, seen, counts, inverse):  # type: ignore[no-untyped-def]
    """Merges triangles of the same material and body, which are shaded once; returns the remaining number."""
    merged = 0
    for j in range(kinds):
        same = -1
        for i in range(merged):
            if (
                seen[j] >= 0
                and seen[i] >= 0
                and of_body[seen[j]] == of_body[seen[i]]
                and material[seen[j]] == material[seen[i]]
            ):
                same = i
                break
        if same >= 0:
            counts[same] += counts[j]
        else:
            seen[merged], counts[merged], inverse[merged] = seen[j], counts[j], inverse[j]
            merged += 1
    return merged


@per_pixel
def shade_frame(  # type: ignore[no-untyped-def]
    nearest, owner, factor, R, C, K, scene, look, image, depth_m, classes, instances, visible, spare
):  # fmt: skip
    """Shades all pixels of `factor` x `factor` samples: image (H, W, 3) linear BGR, depth, classes, instances.

    R rotates camera to ego; K = (fx, fy, cx, cy) in pixels. `visible` counts the samples of each body. `spare` is a
    buffer for a ray, a result, and the triangles of one pixel's samples.

    `scene` = (plane_bases, attributes, normals, material and body of each triangle; parameters, rotation, class and
    instance of each body); `look` = (noise_bank, foliage_masks, pictures, sky, shadow maps, ground, contact map, rad a
    pixel).
    """
    height, width = depth_m.shape
    bases, material, of_body, ids = scene[0], scene[3], scene[4], scene[8]
    bank, sky = look[0], look[3]
    ray, out, seen, counts, inverse = spare
    samples = factor * factor
    for row in range(height):
        for column in range(width):
            kinds = triangles_of(row, column, factor, owner, nearest, of_body, seen, counts, inverse, visible)
            cu, cv = (column - K[2]) / K[0], (row - K[3]) / K[1]
            for j in range(3):
                ray[j] = R[j, 0] * cu + R[j, 1] * cv + R[j, 2]
            most, label, depth = 0, 0, np.inf
            r = g = b = 0.0
            front = -1
            for j in range(merge_smooth(kinds, of_body, material, seen, counts, inverse)):
                t, n = seen[j], counts[j]
                if t < 0:
                    norm = math.sqrt(ray[0] ** 2 + ray[1] ** 2 + ray[2] ** 2)
                    sr, sg, sb = sky_colour(sky, bank, ray[0] / norm, ray[1] / norm, ray[2] / norm)
                    r, g, b = r + n * sr, g + n * sg, b + n * sb
                    if n > most:
                        most, label, depth, front = n, 0, np.inf, -1
                    continue
                d = hit(bases, t, C, ray)
                near = 1.0 / inverse[j]
                if d <= 0.0 or abs(d - near) > 0.15 * near:
                    d = near
                shade(t, d, C, ray, scene, look, out)
                r, g, b = r + n * out[0], g + n * out[1], b + n * out[2]
                if n > most:
                    most, label, depth, front = n, int(out[3]), d, t
            image[row, column, 0], image[row, column, 1], image[row, column, 2] = b / samples, g / samples, r / samples
            depth_m[row, column], classes[row, column] = depth, label
            instances[row, column] = ids[of_body[front]] if front >= 0 else 0


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def wet_road(light, classes, wetness):  # type: ignore[no-untyped-def]
    """Adds reflections of the scene in a wet road, stronger at grazing angles; in place."""
    height, width = classes.shape
    copy = light.copy()
    for column in range(width):
        foot, top = 0, -1
        for row in range(height):
            label = classes[row, column]
            if label != 1 and label != 2 and label != 3:
                foot = row
                continue
            if top < 0:
                top = row
            share = (row - top) / max(height - top, 1)
            k = wetness * (0.5 * (1.0 - share) ** 2 + 0.08) * (0.5 if label == 3 else 1.0)
            for channel in range(3):
                mean = 0.0
                for j in range(4):  # the road's roughness blurs reflections vertically
                    mirror = 2 * foot - row - j * (1 + (row - foot) // 8)
                    mean += 0.25 * min(copy[max(mirror, 0), column, channel], 4.0)
                light[row, column, channel] += k * (mean - light[row, column, channel])
