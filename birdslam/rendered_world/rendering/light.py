"""Sun, sky, shadows and noise as shading asks for them, in ego axes. Compiled by numba.

`sky` holds: 0-2 towards the sun, 3-5 its light, 6-8 light from the zenith, 9-11 light from the horizon, 12-14 haze,
15 metres of sight, 16 wetness of the road, 17 clouds, 18 seed, 19 glare about the sun, 20 leaves' translucence,
21 light from a street canyon (ambient factor), 22 snow or dust on grass (brightness), 23 season's tint of grass,
24 how coarse the grit of asphalt is, 25 how rough the grass is, 0 a mown lawn, 26-34 the rotation from ego to world,
in which clouds and skyline stay where they are while the ego turns.
"""

from __future__ import annotations

import math

from birdslam.rendered_world.rendering.compiled import inlined, per_pixel

SKY_SLOTS = 35


@per_pixel
def hashed(a, b):  # type: ignore[no-untyped-def]
    """A number in [0, 1) of two others, without pattern."""
    v = math.sin(a * 127.1 + b * 311.7) * 43758.5453
    return v - math.floor(v)


@per_pixel
def noise(bank, channel, u, v, texels):  # type: ignore[no-untyped-def]
    """The channel at (u, v) in tiles, of the level whose texels are as large as the pixel (`texels` of level 0)."""
    level = 0
    while texels > 1.4 and level < 6:
        texels *= 0.5
        level += 1
    size = bank.shape[2] >> level
    half = 0.5 - 0.5 / (1 << level)  # a coarse texel's middle lies between fine ones: nothing moves with the level
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
    """What a glossy surface shows in the direction (x, y, z): sky, a skyline of houses and trees, the road."""
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
    """Share of the sun that reaches (x, y, z): four neighbouring rays blended; -1 outside of the map."""
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
def sunlit(fine, coarse, lean, fine_origin, coarse_origin, per_m, x, y, z, nx, ny, nz, bias):  # type: ignore[no-untyped-def]
    """Share of the sun that reaches a point of a surface with this normal, from the fine map or the coarse one.

    `lean` is the sun's direction per metre of height, `per_m` the cells a metre of the two maps.
    """
    off = 0.05 + bias
    x, y, z = x + off * nx, y + off * ny, z + off * nz
    s = _lookup(fine, lean, fine_origin, per_m[0], x, y, z, 0.03 + bias)
    if s < 0.0:
        s = _lookup(coarse, lean, coarse_origin, per_m[1], x + 0.1 * nx, y + 0.1 * ny, z, 0.12 + bias)
    return s if s >= 0.0 else 1.0
