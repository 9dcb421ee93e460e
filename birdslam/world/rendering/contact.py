"""Contact shadows under and beside vehicles, as a map of the area ahead. Compiled by numba."""

from __future__ import annotations

import math

from numba import njit

from birdslam.world.rendering.compiled import inlined


@inlined
def contact_light(contact, x, y):  # type: ignore[no-untyped-def]
    """Fraction of the sky visible from the ground at (x, y), from a map of the area ahead.

    `contact` = (map, (x of its first row, y of its first column, cells a metre)).
    """
    shade_map, frame_m = contact
    u, v = (x - frame_m[0]) * frame_m[2], (y - frame_m[1]) * frame_m[2]
    i, j = math.floor(u), math.floor(v)
    if i < 0 or j < 0 or i >= shade_map.shape[0] - 1 or j >= shade_map.shape[1] - 1:
        return 1.0
    fu, fv = u - i, v - j
    top = shade_map[i, j] * (1.0 - fv) + shade_map[i, j + 1] * fv
    low = shade_map[i + 1, j] * (1.0 - fv) + shade_map[i + 1, j + 1] * fv
    return top * (1.0 - fu) + low * fu


@njit(cache=True, nogil=True)
def contact_map(shade_map, x0, y0, cells_per_m, poses, sizes, at_edge, reach_m):  # type: ignore[no-untyped-def]
    """Darken `shade_map` under each body: `poses` (n, 3) x y yaw, `sizes` (n, 2) length and width.

    `at_edge` is the fraction of light at a body's side; it rises to 1 over `reach_m`.
    """
    shade_map[:] = 1.0
    for k in range(poses.shape[0]):
        hx, hy = 0.5 * sizes[k, 0], 0.5 * sizes[k, 1]
        reach = math.hypot(hx, hy) + 0.8
        i0 = max(0, int((poses[k, 0] - reach - x0) * cells_per_m))
        i1 = min(shade_map.shape[0], int((poses[k, 0] + reach - x0) * cells_per_m) + 1)
        j0 = max(0, int((poses[k, 1] - reach - y0) * cells_per_m))
        j1 = min(shade_map.shape[1], int((poses[k, 1] + reach - y0) * cells_per_m) + 1)
        cos, sin = math.cos(poses[k, 2]), math.sin(poses[k, 2])
        for i in range(i0, i1):
            for j in range(j0, j1):
                dx, dy = x0 + i / cells_per_m - poses[k, 0], y0 + j / cells_per_m - poses[k, 1]
                ox, oy = abs(cos * dx + sin * dy) - hx, abs(cos * dy - sin * dx) - hy
                out = math.hypot(max(ox, 0.0), max(oy, 0.0)) + min(max(ox, oy), 0.0)
                light = at_edge + (out * (1.0 - at_edge) / reach_m if out > 0.0 else out)
                light = min(max(light, 0.06), 1.0)
                shade_map[i, j] = min(shade_map[i, j], light)
