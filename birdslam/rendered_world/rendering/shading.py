"""From triangles in front to light: one pass over the pixels of a frame. Compiled by numba."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from birdslam.rendered_world.rendering import materials as m
from birdslam.rendered_world.rendering import paint, surfaces
from birdslam.rendered_world.rendering.compiled import inlined, per_pixel
from birdslam.rendered_world.rendering.contact import contact_light
from birdslam.rendered_world.rendering.ground import shade_ground
from birdslam.rendered_world.rendering.light import mirrored, sky_colour, sunlit

# Class of each material, in the order of `materials`; the ground's and a vehicle's panels tell theirs
MATERIAL_CLASS = np.array([1, 7, 7, 7, 4, 9, 5, 5, 6, 6, 8, 9, 4, 9, 9, 8], np.uint8)
VEHICLE_CLASS, PERSON_CLASS, OTHER_CLASS = 7, 8, 9


@inlined
def hit(bases, t, C, ray):  # type: ignore[no-untyped-def]
    """Depth where the ray C + depth * ray meets the plane of triangle t; negative where it does not."""
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
def tuck(P, z):  # type: ignore[no-untyped-def]
    """How far a body's side leans in at the height z over the road: its normal's fall per its level part."""
    return (0.5 + 0.9 * P[m.SEED]) * min(max(1.0 - (z - P[m.CLEARANCE]) / (0.25 + 0.2 * P[m.RIM]), 0.0), 1.0)


@inlined
def shade(  # type: ignore[no-untyped-def]
    t, depth, C, ray, bases, attributes, normals, material, owner, P_all, R_all, labels, bank, masks, pictures, sky,
    fine, coarse, lean, fine_origin, coarse_origin, per_m, bands, lines, crossings, marks, by_metre, edges, shade_map,
    shade_frame_m,
    pixel_rad, out,
):  # fmt: skip
    """Light of triangle t along the ray at a depth into out[:3], its class into out[3]."""
    x, y, z = C[0] + depth * ray[0], C[1] + depth * ray[1], C[2] + depth * ray[2]
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
        w = attributes[t, 0, 2] + 0.0  # which face, exactly
    k = owner[t]
    P, R = P_all[k], R_all[k]
    nx = R[0, 0] * lx + R[0, 1] * ly + R[0, 2] * lz
    ny = R[1, 0] * lx + R[1, 1] * ly + R[1, 2] * lz
    nz = R[2, 0] * lx + R[2, 1] * ly + R[2, 2] * lz
    mat = material[t]
    if mat == m.PAINT:  # bumpers and sills turn in towards the road
        nz -= tuck(P, w) * math.sqrt(nx * nx + ny * ny)
    norm = 1.0 / math.sqrt(nx * nx + ny * ny + nz * nz + 1e-12)
    nx, ny, nz = nx * norm, ny * norm, nz * norm
    length = math.sqrt(ray[0] * ray[0] + ray[1] * ray[1] + ray[2] * ray[2])
    ex, ey, ez = ray[0] / length, ray[1] / length, ray[2] / length
    facing = -(nx * ex + ny * ey + nz * ez)
    foot = depth * pixel_rad
    label = MATERIAL_CLASS[mat]
    mirror, light, bias, soft = 0.0, 0.0, 0.0, 0.0
    if mat == m.GROUND:
        along = foot / max(facing, 0.02)
        r, g, bl, mirror, label = shade_ground(
            bands, lines, crossings, marks, by_metre, edges, bank, pictures, sky, u, v, foot, along
        )
    elif mat == m.PAINT:
        r, g, bl, mirror, light = paint.bodywork(P, bank, u, v, w, lx, ly, lz, foot)
    elif mat == m.WHEEL:
        r, g, bl, mirror, light = paint.wheel(P, u, v, w)
        label = labels[k]
    elif mat == m.CARGO:
        r, g, bl, mirror, light = paint.cargo(P, bank, pictures, u, v, w, foot)
    elif mat == m.CLOTH or mat == m.SKIN:
        r, g, bl, mirror, light = paint.clothing(P, mat, C[2] * 0.0 + z, P[m.HEIGHT])
    elif mat == m.WALL:
        r, g, bl, mirror = surfaces.facade(P, bank, pictures, u, v, w, foot)
        if w == 0.0 or w < 4.0:
            label = 4
    elif mat == m.FOLIAGE:
        r, g, bl = surfaces.leaves(P, masks, u, v, attributes[t, 0, 2])
        nx, ny, nz = 0.35 * (nx - ex), 0.35 * (ny - ey), 0.65
        bias, soft, facing = 0.35, 0.5, 1.0
    elif mat == m.PANEL:
        if P[9] > 3.5 or (P[8] > 3.0 and P[10] == 0.0):
            r, g, bl, light = surfaces.traffic_light(P, u, v, w)
        else:
            r, g, bl, light = surfaces.panel(P, pictures, u, v, w)
            if facing < 0.0:
                r, g, bl = 0.3, 0.3, 0.3
    else:
        r, g, bl, mirror = surfaces.plain(P, bank, pictures, mat, u, v, w, foot)
        if labels[k] > 0:
            label = labels[k]
        if mat == m.PLAIN and labels[k] == 0:
            label = OTHER_CLASS
    if facing < 0.0 and mat != m.FOLIAGE:
        nx, ny, nz, facing = -nx, -ny, -nz, -facing
    # sun and sky
    toward = nx * sky[0] + ny * sky[1] + nz * sky[2]
    direct = 0.0
    if sky[4] > 0.0 and (toward > 0.0 or soft > 0.0):
        direct = (soft * 0.5 + (1.0 - soft) * max(toward, 0.0)) * sunlit(
            fine, coarse, lean, fine_origin, coarse_origin, per_m, x, y, z, nx, ny, nz, bias
        )
    up = 0.5 + 0.5 * nz
    open_sky = sky[21] * (1.0 if mat != m.GROUND else contact_light(shade_map, shade_frame_m, x, y))
    high = w if mat == m.PAINT else z  # over the road
    if mat != m.GROUND and high < 0.8 and nz < 0.5:
        open_sky *= 0.6 + 0.4 * max(high, 0.0) / 0.8
    bounce, lit_road = 0.18 * (1.0 - up), max(sky[2], 0.0)
    if mat == m.PAINT and sky[4] > 0.0 and nz < 0.5:  # the road that a panel faces may lie in the body's own shadow
        share = 0.0
        for j in range(3):
            away = 0.5 + 0.7 * j
            share += sunlit(
                fine, coarse, lean, fine_origin, coarse_origin, per_m, x + away * nx, y + away * ny, z - w,
                0.0, 0.0, 1.0, 0.0,
            )  # fmt: skip
        lit_road *= share / 3.0
    ar = (sky[6] * up * 0.6 + sky[9] * 0.4 * (0.4 + 0.6 * up) + bounce * (sky[3] * lit_road + sky[6])) * open_sky
    ag = (sky[7] * up * 0.6 + sky[10] * 0.4 * (0.4 + 0.6 * up) + bounce * (sky[4] * lit_road + sky[7])) * open_sky
    ab = (sky[8] * up * 0.6 + sky[11] * 0.4 * (0.4 + 0.6 * up) + bounce * (sky[5] * lit_road + sky[8])) * open_sky
    red = r * (ar + direct * sky[3]) + light * 2.0 * r * (sky[7] + 0.2 * sky[4])
    green = g * (ag + direct * sky[4]) + light * 2.0 * g * (sky[7] + 0.2 * sky[4])
    blue = bl * (ab + direct * sky[5]) + light * 2.0 * bl * (sky[7] + 0.2 * sky[4])
    if mirror > 0.0:
        f = max(0.0, 1.0 - facing)
        fresnel = mirror + (1.0 - mirror) * 0.9 * f * f * f * f * f
        if mat == m.GROUND:
            fresnel = mirror * (0.3 + 6.0 * f * f * f * f)
        qx, qy, qz = ex + 2.0 * facing * nx, ey + 2.0 * facing * ny, ez + 2.0 * facing * nz
        mr, mg, mb = mirrored(sky, bank, qx, qy, qz)
        red, green, blue = red + (mr - red) * fresnel, green + (mg - green) * fresnel, blue + (mb - blue) * fresnel
        glint = qx * sky[0] + qy * sky[1] + qz * sky[2]
        if glint > 0.9 and direct > 0.0:
            s = direct * mirror * (35.0 * max(glint, 0.0) ** 220.0 + 1.2 * max(glint, 0.0) ** 24.0)
            red, green, blue = red + s * sky[3], green + s * sky[4], blue + s * sky[5]
    haze = 1.0 - math.exp(-depth * length / sky[15]) if depth * length > 0.01 * sky[15] else 0.0
    out[0] = red + (sky[12] - red) * haze
    out[1] = green + (sky[13] - green) * haze
    out[2] = blue + (sky[14] - blue) * haze
    out[3] = label


@per_pixel
def shade_frame(  # type: ignore[no-untyped-def]
    nearest, owner, factor, R, C, K, scene, look, image, depth_m, classes, instances, visible, spare
):  # fmt: skip
    """Every pixel of samples `factor` x `factor`: image (H, W, 3) linear BGR, depth, classes, instances.

    R turns camera to ego; K = (fx, fy, cx, cy) of pixels. `visible` counts the samples of each body. `spare` is room
    for a ray, an answer, and the triangles of one pixel's samples: whose, how many, and 1 / depth of the first.
    """
    height, width = depth_m.shape
    bases, attributes, normals, material, of_body, P_all, R_all, labels, ids = scene
    bank, masks, pictures, sky, maps, ground, contact, pixel_rad = look
    fine, coarse, lean, fine_origin, coarse_origin, per_m = maps
    bands, lines, crossings, marks, by_metre, edges = ground
    shade_map, shade_frame_m = contact
    ray, out, seen, counts, inverse = spare
    samples = factor * factor
    for row in range(height):
        for column in range(width):
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
            cu, cv = (column - K[2]) / K[0], (row - K[3]) / K[1]
            for j in range(3):
                ray[j] = R[j, 0] * cu + R[j, 1] * cv + R[j, 2]
            # Neighbouring triangles of one smooth surface are shaded once
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
            most, label, depth = 0, 0, np.inf
            r = g = b = 0.0
            front = -1
            for j in range(merged):
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
                shade(
                    t, d, C, ray, bases, attributes, normals, material, of_body, P_all, R_all, labels, bank, masks,
                    pictures, sky, fine, coarse, lean, fine_origin, coarse_origin, per_m, bands, lines, crossings,
                    marks, by_metre, edges, shade_map, shade_frame_m, pixel_rad, out,
                )  # fmt: skip
                r, g, b = r + n * out[0], g + n * out[1], b + n * out[2]
                if n > most:
                    most, label, depth, front = n, int(out[3]), d, t
            image[row, column, 0], image[row, column, 1], image[row, column, 2] = b / samples, g / samples, r / samples
            depth_m[row, column], classes[row, column] = depth, label
            instances[row, column] = ids[of_body[front]] if front >= 0 else 0


@njit(cache=True, nogil=True, fastmath=True, error_model="numpy")
def wet_road(light, classes, wetness):  # type: ignore[no-untyped-def]
    """What stands over a wet road shows in it upside down, the more the flatter one looks; in place."""
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
                for j in range(4):  # the road's roughness draws reflections out
                    mirror = 2 * foot - row - j * (1 + (row - foot) // 8)
                    mean += 0.25 * min(copy[max(mirror, 0), column, channel], 4.0)
                light[row, column, channel] += k * (mean - light[row, column, channel])
