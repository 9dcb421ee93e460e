"""Fixes of GNSS as factors of a map's graph: the drive's bends are taken out, and the map comes to its place on Earth.

1. The drive as odometry has it is laid over its fixes (`place_on_earth`): delay, turn, shift, scale.
2. Each keyframe gets the fix nearest to it, brought there along the way.
3. Graduated non-convexity tells the fixes that fit from jumps and multipath.
4. Keyframes and links and fixes are one graph, in metres of the map, east and north; the scale is adjusted to what the
   fixes made of the links, and the graph is solved again.
5. The map keeps the pose of its first keyframe, and `Earth` is fitted to its keyframes' fixes.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from birdslam.geometry.arrays import Ints
from birdslam.geometry.se2 import SE2
from birdslam.loops.closing import PlaceFactor, Solved, close_loops, inliers
from birdslam.loops.gnss.earth import MIN_FIXES, Earth, EarthError, GnssFix, fit
from birdslam.loops.keyframe import Fixed, Link, Placed
from birdslam.types import NS_PER_S

REACH_M = 6.0  # from a fix to its keyframe, along the way
SHARED_S = 10.0  # errors of fixes so near in time are one error; a judgement
ROUNDS = 2  # of the scale: keyframes have their own, and take up the rest


@dataclass(frozen=True)
class Node:
    """A place of a drive that has no map: as a keyframe, without points."""

    number: int
    T_map_keyframe: SE2
    scale: float = 1.0


@dataclass(frozen=True, eq=False)
class OnEarth:
    """What fixes made of a graph."""

    earth: Earth
    poses: dict[int, Solved]  # of each keyframe in the map
    fixed: dict[int, Fixed]  # the fixes that fit, by their keyframes


def fixed_keyframes(
    earth: Earth, t_ns: Ints, poses: Sequence[SE2], fixes: Sequence[GnssFix], keyframes: Sequence[Placed]
) -> dict[int, Fixed]:
    """The fix nearest to each keyframe, of a drive that `earth` was laid over."""
    from scipy.spatial import cKDTree  # here: only who has fixes needs it

    xy = np.array([(pose.x_m, pose.y_m) for pose in poses])
    seconds = (t_ns - t_ns[0]) / NS_PER_S
    at = np.array([(fix.t_source_ns - int(t_ns[0])) / NS_PER_S for fix in fixes]) - earth.delay_s
    inside = np.flatnonzero((at >= seconds[0]) & (at <= seconds[-1]))
    here = np.column_stack([np.interp(at[inside], seconds, column) for column in xy.T])
    degrees = np.array([(fix.latitude_deg, fix.longitude_deg) for fix in fixes])[inside]
    places = np.array([(k.T_map_keyframe.x_m, k.T_map_keyframe.y_m) for k in keyframes])
    nearest: dict[int, tuple[float, int]] = {}
    for row, (distance, place) in enumerate(zip(*cKDTree(places).query(here.reshape(-1, 2)), strict=True)):
        if distance < min(REACH_M, nearest.get(int(place), (math.inf, 0))[0]):
            nearest[int(place)] = float(distance), row
    out = {}
    times = np.array([at[inside][row] for _, row in nearest.values()])
    for place, (_, row) in nearest.items():
        together = int((np.abs(times - at[inside][row]) <= SHARED_S / 2.0).sum())
        there = earth.xy(degrees[row : row + 1])[0] + places[place] - here[row]
        latitude_deg, longitude_deg = earth.wgs84(there[None])[0]
        sigma_m = max(fixes[inside[row]].sigma_m, 0.01)
        out[keyframes[place].number] = Fixed(
            float(latitude_deg), float(longitude_deg), sigma_m, sigma_m * math.sqrt(together)
        )
    return out


def tie(earth: Earth, keyframes: Sequence[Placed], links: Sequence[Link], fixed: dict[int, Fixed]) -> OnEarth:
    """The graph with its fixes. Raises EarthError where too few of them fit."""
    first, numbers = keyframes[0], list(fixed)
    degrees = np.array([(fixed[number].latitude_deg, fixed[number].longitude_deg) for number in numbers])
    kept = np.ones(len(numbers), bool)
    for turn in range(ROUNDS):
        T_earth_map = SE2(earth.east_m / earth.scale, earth.north_m / earth.scale, earth.yaw_rad)
        flat = replace(earth, east_m=0.0, north_m=0.0, yaw_rad=0.0)  # east and north in metres of the map
        nodes = [Node(each.number, T_earth_map @ each.T_map_keyframe, each.scale) for each in keyframes]
        factors = [
            PlaceFactor(
                number, (float(x), float(y)), fixed[number].sigma_m / earth.scale, fixed[number].weighed_m / earth.scale
            )
            for number, (x, y) in zip(numbers, flat.xy(degrees), strict=True)
        ]
        kept = inliers(nodes, links, factors)
        if kept.sum() < MIN_FIXES:
            raise EarthError(f"only {int(kept.sum())} of {len(kept)} fixes fit the drive's way")
        solved = close_loops(nodes, links, [factor for factor, fits in zip(factors, kept, strict=True) if fits])
        T_map_earth = first.T_map_keyframe @ solved[first.number][0].inverse()
        poses = {number: each._replace(T_map_keyframe=T_map_earth @ each[0]) for number, each in solved.items()}
        earth = _fitted(earth, poses, fixed, [number for number, fits in zip(numbers, kept, strict=True) if fits])
        if turn < ROUNDS - 1:
            earth = replace(earth, scale=earth.scale * _stretch(links, poses))
    fitting = {number: fixed[number] for number, fits in zip(numbers, kept, strict=True) if fits}
    return OnEarth(replace(earth, outliers=int((~kept).sum()), fixes=len(kept)), poses, fitting)


def _stretch(links: Sequence[Link], poses: dict[int, Solved]) -> float:
    """By how much longer the fixes made odometry's links."""
    asked = total = 0.0
    for link in links:
        if not link.loop:
            step, found = link.T_from_to, poses[link.from_number][0].between(poses[link.to_number][0])
            asked += step.x_m**2 + step.y_m**2
            total += step.x_m * found.x_m + step.y_m * found.y_m
    return total / asked if asked else 1.0


def _fitted(earth: Earth, poses: dict[int, Solved], fixed: dict[int, Fixed], numbers: list[int]) -> Earth:
    """Earth by the keyframes as they lie now, and the fixes that fit."""
    flat = replace(earth, east_m=0.0, north_m=0.0, yaw_rad=0.0, scale=1.0)
    degrees = np.array([(fixed[number].latitude_deg, fixed[number].longitude_deg) for number in numbers])
    xy = np.array([(poses[number][0].x_m, poses[number][0].y_m) for number in numbers])
    enu = flat.xy(degrees)
    sigma_m = np.array([fixed[number].weighed_m for number in numbers])
    parameters, cov, _ = fit(xy, enu, sigma_m, log_scale=earth.log_scale)
    found = replace(
        earth,
        east_m=float(parameters[0]),
        north_m=float(parameters[1]),
        yaw_rad=float(parameters[2]),
        scale=float(math.exp(parameters[3])),
    ).with_cov(cov)
    return replace(found, rms_m=float(np.sqrt(((found.enu(xy) - enu) ** 2).sum(axis=1).mean())))
