"""Illumination and reflections of surfaces: sun, sky, shadows, noise; in ego axes. Compiled by numba.

`sky` holds: 0-2 towards the sun, 3-5 its light, 6-8 light from the zenith, 9-11 light from the horizon, 12-14 haze,
15 metres of sight, 16 wetness of the road, 17 clouds, 18 seed, 19 glare about the sun, 20 leaves' translucence,
21 light from a street canyon (ambient factor), 22 snow or dust on grass (brightness), 23 season's tint of grass,
24 coarseness of the asphalt's grit, 25 roughness of the grass (0: a lawn), 26-34 the rotation from ego to world, in
which clouds and skyline are fixed.
"""

from __future__ import annotations

import math

from birdslam.world.rendering import materials as m
from birdslam.world.rendering.compiled import inlined, per_pixel
from birdslam.world.rendering.contact import contact_light

SKY_SLOTS = 35


@per_pixel
def hashed(a, b):  # type: ignore[no-untyped-def]
    """A pseudo-random number in [0, 1) from two numbers."""
    v = math.sin(a * 127.1 + b * 311.7) * 43758.5453
    return v - math.floor(v)


@per_pixel
def noise(bank, channel, u, v, texels):  # type: ignore[no-untyped-def]
    """The channel at (u, v) in tiles, at the level that matches the pixel's size of `texels` at level 0."""
    level = 0
    while texels > 1.4 and level < 6:
        texels *= 0.5
        level += 1
    size = bank.shape[2] >> level
    half = 0.5 - 0.5 / (1 << level)  # aligns the centres of coarse and fine texels
    x, y = u * size - half, v * size - half
    xf, yf = math.floor(x), math.floor(y)
    fx, fy = x - xf, y - yf
    mask = size - 1
    x0, y0 = int(xf) & mask, int(yf) & mask
    x1, y1 = (x0 + 1) & mask, (y0 + 1) & mask
    top = bank[channel, level, y0, x0] * (1.0 - fx) + bank[channel, level, y0, x1] * fx
    low = bank[channel, level, y1, x0] * (1.0 - fx) + bank[channel, level, y1, x1] * fx
    return top * (1.0 - fy) + low * fy


@per_pixel
def _in_world(sky, x, y, z):  # type: ignore[no-untyped-def]
    return (
        sky[26] * x + sky[27] * y + sky[28] * z,
        sky[29] * x + sky[30] * y + sky[31] * z,
        sky[32] * x + sky[33] * y + sky[34] * z,
    )


@per_pixel
def sky_colour(sky, bank, x, y, z):  # type: ignore[no-untyped-def]
    """Light from the direction (x, y, z): a gradient, clouds, the glow about the sun."""
    east, north, up = _in_world(sky, x, y, z)
    t = max(up, 0.0) ** 0.5
    r = sky[9] + (sky[6] - sky[9]) * t
    g = sky[10] + (sky[7] - sky[10]) * t
    b = sky[11] + (sky[8] - sky[11]) * t
    if sky[17] > 0.02:
        k = 0.35 / (max(up, 0.0) + 0.12)
        c = 0.5 + 0.5 * noise(bank, 0, east * k * 0.5 + sky[18], north * k * 0.5, 0.0)
        c = min(max((c - 0.75 + sky[17]) * 1.6, 0.0), 1.0)
        white = 1.15 * (sky[9] + sky[10] + sky[11]) * 0.3333
        r, g, b = r + (white - r) * c, g + (white - g) * c, b + (white * 1.03 - b) * c
    sun = x * sky[0] + y * sky[1] + z * sky[2]
    if sun > 0.6:
        glow = sky[19] * (0.25 * (sun - 0.6) ** 2 + max(sun, 0.0) ** 160.0)
        r, g, b = r + glow * sky[3], g + glow * sky[4], b + glow * sky[5]
    return r, g, b


@per_pixel
def mirrored(sky, bank, x, y, z):  # type: ignore[no-untyped-def]
    """The reflection in the direction (x, y, z): sky, a skyline of houses and trees, the road."""
    east, north, _ = _in_world(sky, x, y, z)
    bearing = math.atan2(north, east)
    line = 0.12 + 0.05 * noise(bank, 0, bearing * 0.12 + sky[18], 0.37, 4.0)
    open_sky = min(max((z - line) * 6.0 + 0.5, 0.0), 1.0)
    dark = 0.16 + 0.05 * noise(bank, 0, bearing * 0.3, z * 0.4, 4.0)
    low = min(max(0.5 - z * 6.0, 0.0), 1.0)
    houses = (sky[7] + sky[4] * 0.2) * max(dark, 0.05)
    road = 0.12 * sky[7] + 0.08 * sky[4] * max(sky[2], 0.0)
    light = houses + (road - houses) * low
    r, g, b = sky_colour(sky, bank, x, y, max(z, 0.02))
    return light + (r - light) * open_sky, light + (g - light) * open_sky, light + (b - light) * open_sky


@inlined
def _lookup(highest, lean, origin, cells_per_m, x, y, z, bias):  # type: ignore[no-untyped-def]
    """Fraction of sunlight at (x, y, z), from four neighbouring rays; -1 outside of the map."""
    u = (x - z * lean[0] - origin[0]) * cells_per_m
    v = (y - z * lean[1] - origin[1]) * cells_per_m
    i, j = math.floor(u), math.floor(v)
    if i < 0 or j < 0 or i >= highest.shape[1] - 1 or j >= highest.shape[0] - 1:
        return -1.0
    fu, fv = u - i, v - j
    limit = z + bias
    a = 1.0 if highest[j, i] <= limit else 0.0
    b = 1.0 if highest[j, i + 1] <= limit else 0.0
    c = 1.0 if highest[j + 1, i] <= limit else 0.0
    d = 1.0 if highest[j + 1, i + 1] <= limit else 0.0
    top = a + (b - a) * fu
    return top + (c + (d - c) * fu - top) * fv


@inlined
def sunlit(maps, x, y, z, nx, ny, nz, bias):  # type: ignore[no-untyped-def]
    """Fraction of sunlight at a point with this normal, from the fine or the coarse map.

    `maps` = (fine, coarse, lean, origin of the fine, origin of the coarse, cells a metre of both); `lean` is the sun's
    direction per metre of height.
    """
    fine, coarse, lean, fine_origin, coarse_origin, per_m = maps
    off = 0.05 + bias
    x, y, z = x + off * nx, y + off * ny, z + off * nz
    s = _lookup(fine, lean, fine_origin, per_m[0], x, y, z, 0.03 + bias)
    if s < 0.0:
        s = _lookup(coarse, lean, coarse_origin, per_m[1], x + 0.1 * nx, y + 0.1 * ny, z, 0.12 + bias)
    return s if s >= 0.0 else 1.0


@inlined
def sunlight(sky, maps, x, y, z, nx, ny, nz, bias, soft):  # type: ignore[no-untyped-def]
    """Sunlight on a surface with this normal; `soft` surfaces also get light from behind."""
    toward = nx * sky[0] + ny * sky[1] + nz * sky[2]
    direct = 0.0
    if sky[4] > 0.0 and (toward > 0.0 or soft > 0.0):
        direct = (soft * 0.5 + (1.0 - soft) * max(toward, 0.0)) * sunlit(maps, x, y, z, nx, ny, nz, bias)
    return direct


@inlined
def skylight(sky, maps, contact, mat, x, y, z, w, nx, ny, nz):  # type: ignore[no-untyped-def]
    """(red, green, blue) of the light from the sky, the horizon, and the sunlit road.

    `w` is the height over the road of a vehicle's paint.
    """
    up = 0.5 + 0.5 * nz
    open_sky = sky[21] * (1.0 if mat != m.GROUND else contact_light(contact, x, y))
    high = w if mat == m.PAINT else z  # over the road
    if mat != m.GROUND and high < 0.8 and nz < 0.5:
        open_sky *= 0.6 + 0.4 * max(high, 0.0) / 0.8
    bounce, lit_road = 0.18 * (1.0 - up), max(sky[2], 0.0)
    if mat == m.PAINT and sky[4] > 0.0 and nz < 0.5:  # the road at a panel may be in the body's own shadow
        share = 0.0
        for j in range(3):
            away = 0.5 + 0.7 * j
            share += sunlit(maps, x + away * nx, y + away * ny, z - w, 0.0, 0.0, 1.0, 0.0)
        lit_road *= share / 3.0
    return (
        (sky[6] * up * 0.6 + sky[9] * 0.4 * (0.4 + 0.6 * up) + bounce * (sky[3] * lit_road + sky[6])) * open_sky,
        (sky[7] * up * 0.6 + sky[10] * 0.4 * (0.4 + 0.6 * up) + bounce * (sky[4] * lit_road + sky[7])) * open_sky,
        (sky[8] * up * 0.6 + sky[11] * 0.4 * (0.4 + 0.6 * up) + bounce * (sky[5] * lit_road + sky[8])) * open_sky,
    )


@inlined
def glossed(sky, bank, wet, mirror, direct, facing, ex, ey, ez, nx, ny, nz, red, green, blue):  # type: ignore[no-untyped-def]
    """Adds reflections of sky and skyline, and the sun's glint; `mirror` is the reflectance at normal incidence.

    (ex, ey, ez) is the line of sight, `facing` its cosine to the normal. A `wet` road reflects most at grazing angles.
    """
    f = max(0.0, 1.0 - facing)
    fresnel = mirror + (1.0 - mirror) * 0.9 * f * f * f * f * f
    if wet:
        fresnel = mirror * (0.3 + 6.0 * f * f * f * f)
    qx, qy, qz = ex + 2.0 * facing * nx, ey + 2.0 * facing * ny, ez + 2.0 * facing * nz
    mr, mg, mb = mirrored(sky, bank, qx, qy, qz)
    red, green, blue = red + (mr - red) * fresnel, green + (mg - green) * fresnel, blue + (mb - blue) * fresnel
    glint = qx * sky[0] + qy * sky[1] + qz * sky[2]
    if glint > 0.9 and direct > 0.0:
        s = direct * mirror * (35.0 * max(glint, 0.0) ** 220.0 + 1.2 * max(glint, 0.0) ** 24.0)
        red, green, blue = red + s * sky[3], green + s * sky[4], blue + s * sky[5]
    return red, green, blue


@inlined
def hazed(sky, far_m, red, green, blue):  # type: ignore[no-untyped-def]
    """Light from this distance through haze."""
    haze = 1.0 - math.exp(-far_m / sky[15]) if far_m > 0.01 * sky[15] else 0.0
    return red + (sky[12] - red) * haze, green + (sky[13] - green) * haze, blue + (sky[14] - blue) * haze
