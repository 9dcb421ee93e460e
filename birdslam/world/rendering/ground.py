"""The ground: its mesh in strips along the street, and its surfaces and paint at each (s, d). Compiled by numba."""

from __future__ import annotations

import math

from numba import njit

from birdslam.world.rendering import materials as m
from birdslam.world.rendering.compiled import inlined, per_pixel
from birdslam.world.rendering.light import hashed, noise
from birdslam.world.rendering.shapes.solids import begin, corner
from birdslam.world.street import street as st

CLASS_ROAD, CLASS_LANE, CLASS_PAVEMENT, CLASS_GRASS, CLASS_OTHER = 1, 2, 3, 5, 9
_CROSSING_RAMP_M = 1.6


@njit(cache=True, nogil=True)
def _flat(crossings, s, side):  # type: ignore[no-untyped-def]
    """0 within a crossing, 1 at full kerb height."""
    out = 1.0
    for k in range(crossings.shape[0]):
        if crossings[k, 2 if side > 0 else 3] > 0.5:
            d = abs(s - crossings[k, 0]) - crossings[k, 1] - 0.35 * crossings[k, 4]
            out = min(out, min(max(d / _CROSSING_RAMP_M, 0.0), 1.0))
    return out


@njit(cache=True, nogil=True)
def strips(B, body, stations, bands, crossings, base):  # type: ignore[no-untyped-def]
    """`stations` (n, 5): s, and x y z yaw of the centre line in world; each band a strip of two triangles a step.
    `base` = (x, y, z, dz/dx, dz/dy) of the plane of fields under all.

    Corners are in world; attributes (s, d, height over the road).
    """
    k = begin(B, body, m.GROUND, 2)  # fields up to the horizon
    far, low = 1500.0, -0.35
    for c in range(6 if k >= 0 else 0):
        x, y = (-far if c in (0, 3, 5) else far), (-far if c in (0, 1, 3) else far)
        z = base[2] + base[3] * x + base[4] * y + low
        corner(B, k + c // 3, c % 3, base[0] + x, base[1] + y, z, x, y + 5000.0, low, -base[3], -base[4], 1.0)
    for j in range(bands.shape[0]):
        d0, d1, h0, h1 = bands[j, 0], bands[j, 1], bands[j, 2], bands[j, 3]
        side = 1 if d0 + d1 > 0.0 else -1
        t = begin(B, body, m.GROUND, 2 * (stations.shape[0] - 1))
        if t < 0:
            return
        wide = math.hypot(d1 - d0, h1 - h0) + 1e-9
        rise, run = (h1 - h0) / wide, (d1 - d0) / wide
        f0 = _flat(crossings, stations[0, 0], side)
        for i in range(stations.shape[0] - 1):
            f1 = _flat(crossings, stations[i + 1, 0], side)
            for c in range(6):
                k = i + (1 if c in (1, 2, 4) else 0)
                left = c in (2, 4, 5)
                f = f1 if k > i else f0
                d, h = (d1, h1 * f) if left else (d0, h0 * f)
                sin, cos = math.sin(stations[k, 4]), math.cos(stations[k, 4])
                x, y, z = stations[k, 1] - d * sin, stations[k, 2] + d * cos, stations[k, 3] + h
                corner(B, t + c // 3, c % 3, x, y, z, stations[k, 0], d, h, rise * sin, -rise * cos, run)
            f0 = f1
            t += 2


@inlined
def crossing_at(crossings, s, d, right, left):  # type: ignore[no-untyped-def]
    """0 beside crossings, 1 on a side road, 2 on the main road within a crossing, 3 on a side road's kerb."""
    for k in range(crossings.shape[0]):
        off = abs(s - crossings[k, 0])
        half, radius = crossings[k, 1], crossings[k, 4]
        if off > half + radius + 0.2:
            continue
        beyond = max(d - left, right - d)
        if beyond <= 0.0:
            if off < half + 1.0:
                return 2
            continue
        if crossings[k, 2 if d > 0.0 else 3] < 0.5:
            continue
        reach = half
        if beyond < radius:
            reach = half + radius - math.sqrt(max(radius * radius - (radius - beyond) ** 2, 0.0))
        if off < reach:
            return 1
        if off < reach + 0.15:
            return 3
    return 0


@inlined
def _coverage(off, half, footprint):  # type: ignore[no-untyped-def]
    """Fraction of a pixel of width `footprint` covered by a stripe of half width `half` at distance `off`."""
    lo, hi = max(off - 0.5 * footprint, -half), min(off + 0.5 * footprint, half)
    return max(0.0, hi - lo) / max(footprint, 1e-4)


@inlined
def _line_at(lines, s, d, footprint_d, footprint_s):  # type: ignore[no-untyped-def]
    """Fraction of the pixel covered by lane lines, and the line's index, -1 for none."""
    best, which = 0.0, -1
    for k in range(lines.shape[0]):
        kind, width = int(lines[k, 1]), lines[k, 2]
        if kind == 5:
            continue
        off = abs(d - lines[k, 0])
        if off > 3.0 * width + footprint_d:
            continue
        if kind >= 3:
            c = _coverage(off - width, 0.5 * width, footprint_d)
            if kind == 4 and d > lines[k, 0]:
                f = (s + lines[k, 5]) % lines[k, 3]
                c = c if f < lines[k, 4] else 0.0
        else:
            c = _coverage(off, 0.5 * width, footprint_d)
        if kind in (1, 2):
            period, dash = lines[k, 3], lines[k, 4]
            f = (s + lines[k, 5]) % period
            c *= (
                _coverage(f - 0.5 * dash, 0.5 * dash, min(footprint_s, period))
                if footprint_s < period
                else dash / period
            )
        if c > best:
            best, which = c, k
    return best, which


@inlined
def _mark_at(marks, by_metre, pictures, s, d):  # type: ignore[no-untyped-def]
    """(kind, strength) of the paint, patch or manhole at (s, d); kind -1 for none. `by_metre` lists marks by s."""
    metre = min(max(int(s), 0), by_metre.shape[0] - 1)
    for j in range(by_metre.shape[1]):
        k = by_metre[metre, j]
        if k < 0:
            break
        if not (marks[k, 1] <= s <= marks[k, 2] and marks[k, 3] <= d <= marks[k, 4]):
            continue
        kind = int(marks[k, 0])
        u, v = (s - marks[k, 1]) / (marks[k, 2] - marks[k, 1]), (d - marks[k, 3]) / (marks[k, 4] - marks[k, 3])
        if kind == st.STOP_LINE:
            return kind, 1.0
        if kind == st.ZEBRA:
            return kind, 1.0 if (d % 1.0) < 0.5 else 0.0
        if kind == st.ARROW:
            if marks[k, 5] < 0.0:
                u, v = 1.0 - u, 1.0 - v
            turn = abs(marks[k, 5]) - 1.0
            head = u > 0.62 and abs(v - 0.5) < 0.5 * (1.0 - u) / 0.38
            if turn > 0.5:
                side = v if turn < 1.5 else 1.0 - v
                head = 0.6 < u < 0.95 and side > 0.5 and abs(u - 0.78) < 0.34 * (1.0 - side)
                head = head or (0.7 < u < 0.84 and 0.42 < side < 0.8)
            return kind, 1.0 if head or (abs(v - 0.5) < 0.07 and u < 0.8) else 0.0
        if kind == st.HATCHED:
            return kind, 1.0 if ((s + 1.5 * d) % 2.4) < 0.7 else 0.0
        if kind == st.FIGURES:
            if marks[k, 5] < 0.0:
                u, v = 1.0 - u, 1.0 - v
            p = pictures[int(abs(marks[k, 5])) % 16, int(63.0 * (1.0 - u)), int(63.0 * (1.0 - v)), 0]
            q = pictures[int(abs(marks[k, 5]) + 5) % 16, int(63.0 * (1.0 - u)), int(63.0 * (1.0 - v)), 1]
            return kind, 1.0 if (p - q) > 0.25 else 0.0
        if kind == st.MANHOLE:
            q = (u - 0.5) ** 2 + (v - 0.5) ** 2
            if q < 0.25:
                return kind, 0.55 if q > 0.19 else 0.8 + 0.2 * math.sin(40.0 * u) * math.sin(40.0 * v)
            continue
        return kind, marks[k, 5]
    return -1, 0.0


@per_pixel
def _surface(kind, tone, bank, s, d, foot, sky):  # type: ignore[no-untyped-def]
    """(r, g, b, class) of a surface without paint; `foot` is the pixel's width on it in metres."""
    t = foot * 256.0
    large = noise(bank, 0, s * 0.043, d * 0.061, t * 0.05)
    mid = noise(bank, 0, s * 0.29 + 0.3, d * 0.29, t * 0.29)
    fine = noise(bank, 1, s * 0.9, d * 0.9, t * 0.9)
    if kind == st.ASPHALT or kind == st.PARKING or kind == st.CYCLE:
        grey = 0.105 * tone * (1.0 + 0.07 * large + 0.06 * mid + 0.2 * fine)
        if sky[24] > 0.0:
            grit = noise(bank, 1, s * 0.15, d * 0.15, t * 0.15) + 0.6 * noise(bank, 0, s * 0.11, d * 0.17, t * 0.14)
            grey *= max(1.0 + sky[24] * grit, 0.2)
        crack = noise(bank, 2, s * 0.06 + sky[18], d * 0.06, t * 0.06)
        if sky[18] > 0.35:
            grey *= 1.0 - 0.6 * min(crack * 1.2, 1.0)
        if kind == st.CYCLE and sky[18] > 0.5:
            return 1.9 * grey, 0.75 * grey, 0.6 * grey, CLASS_ROAD
        return grey, grey * 0.99, grey * 0.96, CLASS_ROAD
    if kind == st.CEMENT:
        grey = 0.24 * tone * (1.0 + 0.08 * large + 0.06 * mid + 0.08 * fine)
        if s % 5.0 < 0.04 + 0.3 * foot or abs(d) < 0.02:
            grey *= 0.7
        return grey, grey * 0.98, grey * 0.92, CLASS_ROAD
    if kind == st.COBBLES:
        i, j = math.floor(s / 0.14), math.floor(d / 0.14)
        f = min(max(1.6 - foot / 0.05, 0.0), 1.0)
        stone = 1.0 + f * 0.35 * (hashed(i, j) - 0.5)
        edge = (s / 0.14 - i < 0.14) or (d / 0.14 - j < 0.14)
        grey = 0.13 * tone * stone * (1.0 - 0.5 * f * edge) * (1.0 + 0.15 * mid)
        return grey * 1.05, grey, grey * 0.95, CLASS_ROAD
    if kind == st.SLABS:
        size = 0.5
        i, j = math.floor(s / size), math.floor(d / size)
        f = min(max(1.6 - foot / 0.12, 0.0), 1.0)
        edge = (s / size - i < 0.05) or (d / size - j < 0.05)
        grey = 0.2 * (0.7 + 0.6 * sky[23]) * (1.0 + 0.2 * f * (hashed(i, j) - 0.5)) * (1.0 - 0.35 * f * edge)
        grey *= 1.0 + 0.1 * large + 0.1 * mid + 0.08 * fine
        return grey * 1.03, grey, grey * 0.95, CLASS_PAVEMENT
    if kind == st.KERB:
        grey = 0.24 * (1.0 + 0.1 * mid + 0.1 * fine) * (0.75 + 0.4 * sky[23])
        if s % 1.0 < 0.02 + 0.2 * foot:
            grey *= 0.8
        return grey, grey, grey * 0.97, CLASS_PAVEMENT
    if kind == st.RAILS:
        d0 = abs(abs(d % 3.2 - 1.6) - 0.72)
        if d0 < 0.035 + 0.3 * foot:
            return 0.3, 0.3, 0.3, CLASS_OTHER
        grey = 0.12 * (1.0 + 0.35 * fine + 0.2 * mid)
        return grey * 1.1, grey, grey * 0.85, CLASS_OTHER
    if kind == st.SOIL:
        grey = 0.17 * (1.0 + 0.2 * large + 0.2 * mid + 0.3 * fine)
        return grey * 1.15, grey, grey * 0.75, CLASS_OTHER
    clump = noise(bank, 3, s * 0.5, d * 0.5, t * 0.5)
    rough = sky[25]
    k = max(0.25, 1.0 + (0.1 + 0.2 * rough) * (large + mid) + 0.4 * rough * clump + (0.1 + 0.2 * rough) * fine)
    k *= 0.6 + 0.8 * sky[22]
    dry = 0.5 + 0.5 * large * 0.5 + (sky[23] - 0.5)
    return (0.05 + 0.06 * dry) * k, (0.085 + 0.02 * dry) * k, 0.028 * k, CLASS_GRASS


@inlined
def shade_ground(ground, bank, pictures, sky, s, d, footprint_d, footprint_s):  # type: ignore[no-untyped-def]
    """(r, g, b, mirror, class) of the ground at (s, d) for a pixel with this footprint in metres across and along.

    `ground` = the street's (bands, lines, crossings, marks), `marks_by_metre`, and (right edge, left edge, surface and
    tone of side roads).
    """
    bands, lines, crossings, marks, by_metre, edges = ground
    foot = max(footprint_d, min(0.35 * footprint_s, 6.0 * footprint_d))
    crossing = crossing_at(crossings, s, d, edges[0], edges[1])
    kind, tone = st.GRASS, 1.0
    if crossing in (1, 2):
        kind = st.ASPHALT if bands[bands.shape[0] // 2, 4] > 9.0 else int(edges[2])
        tone = edges[3]
    elif crossing == 3:
        kind = st.KERB
    else:
        for j in range(bands.shape[0]):
            if bands[j, 0] <= d <= bands[j, 1]:
                kind, tone = int(bands[j, 4]), bands[j, 5]
                break
    r, g, b, label = _surface(kind, tone, bank, s, d, foot, sky)
    mirror = 0.0
    if label == CLASS_ROAD:
        worn = noise(bank, 0, s * 0.02, 0.5, 4.0)
        wheels = math.cos(2.0 * math.pi * d / 1.65)
        shade = 1.0 + 0.07 * wheels * (0.5 + 0.5 * worn)
        r, g, b = r * shade, g * shade, b * shade
        if edges[0] < d < edges[1]:
            mark, strength = _mark_at(marks, by_metre, pictures, s, d)
            if mark == st.PATCH or mark == st.MANHOLE:
                k = 0.35 + 0.65 * strength if mark == st.PATCH else strength * 0.8
                r, g, b = r * k, g * k, b * k
            elif (mark >= 0 and strength > 0.0 and mark != st.FIGURES) or (mark == st.FIGURES and strength > 0.5):
                w = 0.55 * (0.75 + 0.25 * noise(bank, 1, s * 0.8, d * 0.8, foot * 200.0))
                r, g, b = r + (w - r) * strength, g + (w - g) * strength, b + (w * 0.96 - b) * strength
            if crossing == 0:
                cover, which = _line_at(lines, s, d, footprint_d, footprint_s)
                if which >= 0 and cover > 0.0:
                    wear = lines[which, 7]
                    holes = noise(bank, 1, s * 0.7, d * 0.9, foot * 200.0) * 0.5 + noise(
                        bank, 0, s * 0.11, d * 0.4, foot * 60.0
                    )
                    keep = min(max(1.0 - wear * (0.5 + 0.45 * holes), 0.12), 1.0)
                    w = 0.62
                    blue = w * (0.18 if lines[which, 6] > 0.5 else 0.95)
                    red = w * (1.0 if lines[which, 6] < 0.5 else 0.95)
                    k = cover * keep
                    r, g, b = (
                        r + (red - r) * k,
                        g + (w * (1.0 if lines[which, 6] < 0.5 else 0.62) - g) * k,
                        b + (blue - b) * k,
                    )
                    if cover > 0.4:
                        label = CLASS_LANE
        if sky[16] > 0.0:
            puddle = min(max(sky[16] + 0.5 * noise(bank, 0, s * 0.07, d * 0.11, foot * 18.0), 0.0), 1.0)
            k = 1.0 - 0.45 * sky[16]
            r, g, b = r * k, g * k, b * k
            mirror = 0.03 * sky[16] + 0.12 * max(puddle - 0.5, 0.0)
    return r, g, b, mirror, label
