"""Appearance of vehicles and people at each point in their local coordinates. Compiled by numba.

Functions return (red, green, blue, mirror, light): albedo, reflectance at normal incidence (0.04 is lacquer), and
emitted light.
"""

from __future__ import annotations

import math

from birdslam.world.rendering import materials as m
from birdslam.world.rendering.compiled import per_pixel
from birdslam.world.rendering.light import hashed, noise
from birdslam.world.rendering.shapes.bodies import half_width, profile, roof_half_width


@per_pixel
def _plate(P, y, z, z_plate):  # type: ignore[no-untyped-def]
    """Brightness of the number plate at (y, z) of the tail or nose, -1 beside it."""
    u, v = y / 0.26, (z - z_plate) / 0.056
    if abs(u) > 1.0 or abs(v) > 1.0 or P[m.PLATE] > 1.5:
        return -1.0
    if abs(u) > 0.96 or abs(v) > 0.86:
        return 0.08
    cell = math.floor(u * 4.5)
    if abs(v) < 0.62 and hashed(P[m.SEED], cell) > 0.15:
        f = u * 4.5 - cell
        stroke = hashed(P[m.SEED] + math.floor(v * 2.5) * 0.13, cell + math.floor(f * 3.0) * 0.31)
        if 0.12 < f < 0.88 and stroke > 0.45:
            return 0.03
    return 0.75


@per_pixel
def apron(P):  # type: ignore[no-untyped-def]
    """Height in m of the bare plastic below the bumper's lacquer."""
    h = hashed(P[m.SEED], 3.0)
    return 0.2 * max(h - 0.35, 0.0) / 0.65


@per_pixel
def _face(P, y, z, side):  # type: ignore[no-untyped-def]
    """`_end` of a nose; `side` is |y| relative to its half width. Lamps, grille, intake and strips vary."""
    style, low, top = P[m.LAMPS], P[m.CLEARANCE], P[m.Z_NOSE]
    make_1, make_2, make_3 = hashed(P[m.SEED], 5.0), hashed(P[m.SEED], 6.0), hashed(P[m.SEED], 7.0)
    z_lamp = top - 0.1 - 0.06 * style
    plate = _plate(P, y, z, low + 0.34 * (top - low))
    if plate >= 0.0:
        return 1, plate
    inner, half = 0.45 + 0.22 * make_1, 0.045 + 0.05 * make_2 + 0.02 * style
    off = z - z_lamp - (0.25 * make_3 - 0.05) * (side - 0.8)
    if side > inner and abs(off) < half:
        if abs(off) > 0.8 * half:
            return 1, 0.05
        if make_3 > 0.6 and math.hypot((side - 0.5 * (1.0 + inner)) / (1.0 - inner), 0.3 * off / half) > 0.3:
            return 1, 0.04  # round lamps in a dark housing
        return 3, 0.35 + 0.65 * math.sin(26.0 * side) ** 2
    if math.hypot(y, z - z_lamp) < 0.05:  # the badge
        return 1, 0.6
    z_grille, tall = z_lamp - 0.1 * make_2 * make_3, 0.04 + 0.1 * make_1 * (1.0 - style)
    if side < 0.3 + 0.3 * make_2 and abs(z - z_grille) < tall:
        rim = abs(z - z_grille) > tall - 0.015 or (make_1 > 0.5 and abs(z - z_grille) < 0.012)
        return 1, (0.5 if P[m.GLOSS] > 0.55 and rim else 0.015)
    if side < 0.4 + 0.45 * make_3 and low + 0.05 < z < low + 0.15 + 0.1 * style:
        return 1, 0.015
    if abs(side - 0.72) < 0.07 and abs(z - low - 0.16) < 0.035:  # fog lamps or their recesses
        return (3, 0.3) if make_1 > 0.5 else (1, 0.02)
    if P[m.CLADDING] > 0.5 and abs(z - low - 0.5 * (top - low)) < 0.04:
        return 1, 0.025
    if z < low + 0.04 + 0.5 * apron(P):
        return 1, 0.02
    return 0, 0.0


@per_pixel
def _end(P, x, y, z, front):  # type: ignore[no-untyped-def]
    """Lamps, plate, grille, bumper of a nose or tail: (kind, value); kind 0 none, 1 grey, 2 red lamp, 3 head lamp."""
    w = half_width(P, x) + 1e-3
    side = abs(y) / w
    style = P[m.LAMPS]
    low, h = P[m.CLEARANCE], P[m.HEIGHT]
    tall = P[m.BELT] > 0.5 * h and h < 2.1
    if front:
        return _face(P, y, z, side)
    z_plate = 0.62 * P[m.BELT] if style < 0.65 else low + 0.25
    plate = _plate(P, y, z, z_plate)
    if plate >= 0.0:
        return 1, plate
    if tall:
        z0, z1 = 0.70 * P[m.BELT], P[m.BELT] - 0.02
        if style < 0.35:  # wide lamps
            inner, lo, hi = 0.62, z0 + 0.02, z1
        elif style < 0.7:  # vertical lamps
            inner, lo, hi = 0.76, z0 - 0.06, z1 + 0.12
        else:  # lamps at the pillars
            inner, lo, hi = 0.82, z0, min(0.9 * h, z1 + 0.42)
    else:
        inner, lo, hi = 0.84, low + 0.25, low + 0.25 + 0.12 * h
    if side > inner and lo < z < hi:
        if 0.45 < (z - lo) / (hi - lo) < 0.58:
            return 1, 0.55
        return 2, 1.0
    if side > 0.75 and abs(z - low - 0.12) < 0.03:
        return 2, 0.4
    if 0.25 < low < 0.36 and 1.72 < h < 2.0:  # the spare wheel of a jeep
        q = math.hypot(y, z - 0.55 * h) / 0.36
        if q < 1.0:
            return 1, (0.02 if q > 0.62 or P[m.GLOSS] > 0.65 else 0.06 + 0.4 * P[m.RIM] * (q > 0.2))
    if abs(y) < 0.32 and abs(z - z_plate) < 0.085:
        return 1, 0.02
    if abs(z - 0.52 * P[m.BELT]) < 0.008 and tall:
        return 1, 0.01
    if z < low + 0.1 + apron(P) + (0.16 if P[m.CLADDING] > 0.5 else 0.0):
        return 1, 0.02
    return 0, 0.0


@per_pixel
def _window(P, x, y, z, nx, ny):  # type: ignore[no-untyped-def]
    """0 no window, 1 glass, 2 its dark frame."""
    if z < P[m.BELT] + 0.015 and x < P[m.X_COWL] - 0.25:
        return 0
    top = profile(P, x)
    frame = 0.035
    if x < P[m.X_ROOF_END] and x > P[m.X_BACK_BOTTOM] - 0.3 and abs(ny) < 0.62:
        if P[m.X_GLASS_END] > 0.1 * P[m.LENGTH]:
            return 0  # a van's blind rear doors
        w = roof_half_width(P, x, z) * 0.9
        if abs(y) < w - 0.05 and P[m.BELT] + 0.05 < z < 0.945 * P[m.HEIGHT]:
            return 1
        return 2 if abs(y) < w and P[m.BELT] + 0.02 < z < 0.955 * P[m.HEIGHT] and P[m.LAMPS] > 0.3 else 0
    if P[m.X_SCREEN_TOP] - 0.02 < x <= P[m.X_COWL] and abs(ny) < 0.62 and z > P[m.Z_COWL] - 0.02 and nx > 0.1:
        w = roof_half_width(P, x, z) * 0.92
        return 1 if abs(y) < w - 0.03 and z < 0.955 * P[m.HEIGHT] and x < P[m.X_COWL] - 0.01 else 2
    if abs(ny) >= 0.5 and z > P[m.BELT] + 0.015:
        bottom, roof = P[m.BELT] + 0.03, top - 0.1 - 0.02 * P[m.HEIGHT]
        if P[m.HEIGHT] > 2.2:
            roof = min(roof, P[m.BELT] + (0.9 if P[m.LENGTH] < 8.0 else 1.25))
        if bottom < z < roof and P[m.X_GLASS_END] < x < P[m.X_COWL] - 0.12:
            slant = 0.25 * (z - bottom)
            if P[m.LENGTH] > 6.4:  # a bus: windows in a row
                f = (x / 1.4 + 20.0) % 1.0
                return 2 if f < 0.07 else 1
            if abs(x - P[m.X_PILLAR] - 0.1 * slant) < frame or abs(x - P[m.X_PILLAR_2] + 0.1 * slant) < frame:
                return 2
            if x < P[m.X_GLASS_END] + slant:
                return 0
            return 1
        if bottom - 0.02 < z < roof + 0.02 and P[m.X_GLASS_END] - 0.03 < x < P[m.X_COWL] - 0.1 and P[m.LAMPS] > 0.3:
            return 2
    return 0


@per_pixel
def bodywork(P, bank, x, y, z, nx, ny, nz, footprint):  # type: ignore[no-untyped-def]
    """Lacquer, windows, lamps, plates, gaps and wheel arches."""
    r, g, b = P[m.RED], P[m.GREEN], P[m.BLUE]
    R = P[m.WHEEL_RADIUS]
    if abs(ny) > 0.35 and z < 2.6 * R:
        for axle in (P[m.X_FRONT_AXLE], P[m.X_REAR_AXLE]):
            if (x - axle) ** 2 + (z - R) ** 2 < (1.16 * R) ** 2:
                return 0.008, 0.008, 0.008, 0.0, 0.0
    if z < P[m.CLEARANCE] + 0.03:
        return 0.015, 0.015, 0.015, 0.0, 0.0
    window = _window(P, x, y, z, nx, ny)
    if window == 1:
        t = (z - P[m.BELT]) / max(P[m.HEIGHT] - P[m.BELT], 0.1)
        seats = 0.4 + 0.6 * noise(bank, 0, 0.31 * x + P[m.SEED], 0.4 * z + 0.23 * y, 6.0)
        see = 0.008 + P[m.GLASS] * 0.06 * max(seats, 0.0) * (0.4 + t)
        screen = abs(ny) < 0.62 and P[m.GLASS] > 0.3 and 0.3 < t < 0.85 and P[m.LENGTH] < 5.6
        if screen and (abs(abs(y) - 0.36) > 0.13 or t > 0.62):  # through the other screen, past the head rests
            see += 0.22 * P[m.GLASS]
        return see, see * 1.05, see * 1.05, 0.03 + 0.05 * P[m.RIM], 0.0
    if window == 2:
        return 0.01, 0.01, 0.01, 0.03, 0.0
    near_end = x < P[m.LOFT_X0] + 0.26 and nx < -0.25
    nose = x > P[m.LOFT_X1] - 0.3 and nx > 0.2
    if near_end or nose:
        kind, value = _end(P, x, y, z, nose)
        if kind == 1:
            return value, value, value * (0.35 if P[m.PLATE] == 1.0 and value > 0.7 else 1.0), 0.02, 0.0
        if kind == 2:
            lit = P[m.BRAKING] * value
            return 0.25 * value + 0.02, 0.012, 0.012, 0.06, lit
        if kind == 3:
            return 0.3 + 0.3 * value, 0.3 + 0.3 * value, 0.32 + 0.3 * value, 0.12, 3.0 * P[m.HEADLIGHTS]
    gap = max(0.006, 0.35 * footprint)
    fade = min(1.0, 0.008 / gap)
    if abs(ny) > 0.5 and z > P[m.CLEARANCE] + 0.14:
        for at in (P[m.X_PILLAR] + 0.0, P[m.X_PILLAR_2] - 0.1, P[m.X_COWL] - 0.3):
            if abs(x - at) < gap:
                r, g, b = r * (1.0 - 0.85 * fade), g * (1.0 - 0.85 * fade), b * (1.0 - 0.85 * fade)
        z_handle = P[m.BELT] - 0.12
        for at in (P[m.X_PILLAR] + 0.16, P[m.X_PILLAR_2] + 0.06):
            if abs(x - at) < 0.09 and abs(z - z_handle) < 0.018:
                return 0.4 * r, 0.4 * g, 0.4 * b, 0.05, 0.0
        if P[m.CLADDING] > 0.5 and (z < P[m.CLEARANCE] + 0.14 or abs(z - 0.55 * P[m.BELT]) < 0.03):
            return 0.02, 0.02, 0.02, 0.01, 0.0
        if P[m.LENGTH] > 5.6 and P[m.SEED] > 0.5:  # stripes and lettering of vans and buses
            band = 0.5 * P[m.BELT] + 0.3 * P[m.SEED]
            if abs(z - band) < 0.16 * P[m.HEIGHT] * P[m.GLASS] + 0.08:
                return 0.6 * P[m.RIM], 0.5 * P[m.SEED] * P[m.LAMPS], 0.6 * (1.0 - P[m.RIM]), 0.04, 0.0
    if nx > 0.05 and x > P[m.X_COWL] and abs(abs(y) - 0.8 * half_width(P, x)) < gap and nz > 0.5:
        r, g, b = r * (1.0 - 0.7 * fade), g * (1.0 - 0.7 * fade), b * (1.0 - 0.7 * fade)
    dirt = P[m.DIRT] * max(0.0, 1.0 - z / 0.9) * (0.6 + 0.4 * noise(bank, 0, 0.3 * x, 0.3 * z + 0.3 * y, 3.0))
    dirt = min(max(dirt, 0.0), 0.85)
    r, g, b = r + (0.13 - r) * dirt, g + (0.115 - g) * dirt, b + (0.09 - b) * dirt
    return r, g, b, (0.03 + 0.035 * P[m.GLOSS]) * (1.0 - dirt), 0.0


@per_pixel
def wheel(P, u, v, disc):  # type: ignore[no-untyped-def]
    """Tyre and rim; (u, v) from the hub in radii."""
    if disc < 0.5:
        return 0.012, 0.012, 0.013, 0.0, 0.0
    q = math.sqrt(u * u + v * v)
    if q > 0.68 or (P[m.LENGTH] < 2.0 and q > 0.25):
        return 0.014, 0.014, 0.015, 0.0, 0.0
    bright = 0.08 + 0.5 * P[m.RIM]
    if q > 0.6 or q < 0.14:
        return bright, bright, bright, 0.08, 0.0
    spokes = 5.0 + math.floor(6.0 * P[m.LAMPS])
    f = math.sin(spokes * math.atan2(v, u) + 6.0 * P[m.SEED])
    if f > (0.35 - 0.8 * P[m.RIM]):
        return bright, bright, bright, 0.08, 0.0
    return 0.015, 0.015, 0.015, 0.0, 0.0


@per_pixel
def cargo(P, bank, pictures, u, v, face, footprint):  # type: ignore[no-untyped-def]
    """The load of a truck: (u, v) in metres on a box's face, or (angle, metres along) on a tank."""
    r, g, b = P[m.CARGO_RED], P[m.CARGO_GREEN], P[m.CARGO_BLUE]
    kind = int(P[m.CARGO_KIND])
    h = P[m.HEIGHT] - P[m.CARGO_Z0]
    if kind == 2:  # a tank: (angle from the right over the top, metres from its front)
        right = u < 0.5 * math.pi or u > 1.5 * math.pi
        up = (u if u < math.pi else u - 2.0 * math.pi) if right else math.pi - u
        begin, long = 1.5 + 2.0 * P[m.SEED], 2.5 + 2.5 * P[m.RIM]
        across = (v - begin) / long
        if P[m.LAMPS] > 0.35 and abs(up) < 0.55 and 0.0 < across < 1.0:  # lettering
            i, j = int((1.0 - across if right else across) * 63.9), int((0.5 - up / 1.1) * 63.9)
            p = pictures[int(P[m.PICTURE]) % 16, j, i]
            return p[0], p[1], p[2], 0.06, 0.0
        seam = 0.7 if (v % (1.4 + P[m.GLOSS])) < 0.05 + footprint else 1.0
        return r * seam, g * seam, b * seam, 0.1, 0.0
    if kind == 5:
        return r, g, b, 0.1, 0.0
    if face == 2.0:  # the rear
        w = P[m.WIDTH]
        if h > 0.0 and v < 0.26 and w - abs(2.0 * u - w) < 0.9 and kind != 1:
            return 0.3, 0.015, 0.012, 0.04, P[m.BRAKING]
        if abs(u - 0.5 * w) < 0.26 and v < 0.12:
            return 0.6, 0.6, 0.6, 0.02, 0.0
        if v < 0.3 and P[m.SEED] > 0.5:  # warning stripes
            stripe = ((u + v) * 4.0) % 1.0
            return (0.5, 0.02, 0.02, 0.03, 0.0) if stripe < 0.5 else (0.6, 0.55, 0.4, 0.03, 0.0)
        if abs(u - 0.5 * w) < 0.02 or abs(abs(u - 0.5 * w) - 0.25 * w) < 0.025:
            return 0.4 * r, 0.4 * g, 0.4 * b, 0.02, 0.0
    if face in (1.0, 3.0) or (face == 2.0 and P[m.RIM] > 0.6):
        if (P[m.LAMPS] > 0.4 and face != 2.0) or face == 2.0:
            long = P[m.CARGO_X1] - P[m.CARGO_X0] if face != 2.0 else P[m.WIDTH]
            i, j = int(u / max(long, 0.1) * 64.0), int((1.0 - v / max(h, 0.1)) * 64.0)
            if 8 < i < 56 and 10 < j < 50:
                p = pictures[int(P[m.PICTURE]) % 16, j, i]
                return p[0], p[1], p[2], 0.03, 0.0
        if kind == 1:
            fold = 1.0 + 0.18 * math.sin(u * 9.0 + 2.0 * math.sin(u)) * min(1.0, 0.1 / (footprint + 1e-3))
            return r * fold, g * fold, b * fold, 0.02, 0.0
        if v < 0.12 or v > h - 0.1 or (u * 0.8) % 1.0 < 0.02:
            return 0.6 * r, 0.6 * g, 0.6 * b, 0.03, 0.0
    return r, g, b, 0.035, 0.0


@per_pixel
def clothing(P, material, z, height_m):  # type: ignore[no-untyped-def]
    """Trousers, jacket, hands and face by height."""
    if material == m.CLOTH:
        return P[m.CARGO_RED], P[m.CARGO_GREEN], P[m.CARGO_BLUE], 0.0, 0.0
    if z > height_m - 0.24:
        if z > height_m - 0.1 or P[m.SEED] < 0.3:
            k = 0.02 + 0.25 * P[m.SEED] ** 4
            return k, 0.8 * k, 0.6 * k, 0.01, 0.0
        tone = 0.12 + 0.4 * P[m.SEED]
        return tone, 0.68 * tone, 0.52 * tone, 0.02, 0.0
    return P[m.RED], P[m.GREEN], P[m.BLUE], 0.0, 0.0
